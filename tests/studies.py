"""Small design studies, and helpers to inspect their stores."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from jeit.design.skin.touched_cells import TouchedCells
from jeit.forward import ForwardModel

# Two points in two chunks.
SMALL = """
chunk_points = 1
[skin]
width_mm = 100
height_mm = 80
[electrodes]
layouts = ["grid-4x2", "perimeter-8"]
diameter_mm = 10
contact_impedance_ohm_m2 = 1e-3
[measurement]
protocol = "adjacent"
[touch]
columns = 6
rows = 5
[mesh]
cell_mm = 8
"""
# Six points with the scores that take no time to compile.
SWEEP = """
chunk_points = 2
[skin]
width_mm = 100
height_mm = 80
thickness_mm = [5, 8]
conductivity_S_per_m = 0.5
[electrodes]
layouts = ["grid-4x2", "perimeter-8", "inner-8"]
diameter_mm = 10
contact_impedance_ohm_m2 = 1e-3
[measurement]
protocol = "two-terminal"
pairs = 10
noise_V = 1e-3
[touch]
columns = 6
rows = 5
[mesh]
cell_mm = 8
[scores]
wanted = ["minimum", "mean", "uniformity", "blind_spot"]
"""
# The same points with every score.
EVERY_SCORE = SWEEP.replace(
    '"blind_spot"]',
    """"blind_spot", "taxels", "information", "mean_variance", "largest_variance", "localisation_error"]
num_taxels = 5
correlation_mm = 20
""",
)
# Chunks of the sweep, all of one shape, and the arrays of each.
CHUNKS, ARRAYS = 3, 5


def changed(**lines: str) -> str:
    """The sweep with two of its layouts and no scores, and with other lines at the beginning of sections."""
    text = SWEEP.replace('"grid-4x2", "perimeter-8", "inner-8"', '"grid-4x2", "perimeter-8"')
    text = text[: text.index("[scores]")].replace("noise_V = 1e-3\n", "")
    if "protocol" in lines.get("measurement", ""):
        text = text.replace('protocol = "two-terminal"\npairs = 10\n', "")
    for section, more in lines.items():
        text = text.replace(f"[{section}]\n", f"[{section}]\n{more}\n")
    return text


def linear_changes(model: ForwardModel, conductivity: float, touched: TouchedCells) -> np.ndarray:
    """First-order voltage changes (n, M) by n touches: the Jacobian times their conductivity changes, in NumPy."""
    jacobian = np.asarray(model.jacobian(conductivity)).T
    change = conductivity * np.asarray(touched.change)
    return np.array([row @ jacobian[cells] for row, cells in zip(change, np.asarray(touched.cells), strict=True)])


def contents(store: Path) -> dict[str, bytes]:
    """The content of every file of a store, by its relative path."""
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("*") if file.is_file()}


def in_another_process(code: str, *arguments, **environment: str) -> subprocess.CompletedProcess:
    """Run Python `code` with these arguments and environment variables in another process, and wait for its end."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=120)
