"""Imports when one measured frame is imaged: no application, and few modules of the core."""

import subprocess
import sys

import numpy as np
import scipy.io

from jeit import BoundaryElectrodes, Disk, ForwardModel, ring
from jeit.protocol import adjacent

PROGRAM = """
import sys
from jeit.cli import main
status = main(sys.argv[1:])
print(*(name for name in sys.modules if name.split(".")[0] == "jeit"), file=sys.stderr)
sys.exit(status)
"""
MOST = 130


def test_reconstruct_imports_no_application_and_few_modules(tmp_path):
    """A file in the format of the KIT4 archive, with the method that needs the fewest steps."""
    protocol = adjacent(16)
    model = ForwardModel(Disk(0.14).mesh(num_points=400), BoundaryElectrodes(ring(0.14, 16), 0.025, 0.01), protocol)
    drives, measurements = np.asarray(protocol.drive), np.asarray(protocol.measurement)
    conductivity = np.full(model.mesh.num_cells, 1e-3)
    for name in ("empty", "body"):
        potentials = np.asarray(model.transfer_impedance(conductivity))
        voltages = measurements @ potentials @ drives.T
        content = {"Uel": 1e-3 * voltages, "CurrentPattern": drives.T, "MeasPattern": measurements.T}
        scipy.io.savemat(tmp_path / f"{name}.mat", content)
        near = np.linalg.norm(np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)].mean(axis=1) - 0.05, axis=1)
        conductivity[near < 0.03] = 3e-3
    options = ["--method", "one-step", "--num-points", "300", "--output", str(tmp_path / "out"), "--as-is"]
    arguments = ["reconstruct", str(tmp_path / "body.mat"), "--reference", str(tmp_path / "empty.mat"), *options]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    modules = done.stderr.split()
    assert not [name for name in modules if name.split(".")[1:2] in (["acoustic"], ["design"], ["touch"])]
    assert len(modules) <= MOST, sorted(modules)
