"""Reproducibility: two runs of a command, in processes with different hash seeds, give the same bytes, except for
times."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made_skins import record
from studies import SMALL

from jeit.data import load_description
from jeit.layout import named_layout, write_layout
from jeit.mesh import Rectangle, centroids

# Keys of reports and columns of tables that hold computing times.
_TIMES = ("timings", "latency_ms")
FEW = ("--cell-mm", "8", "--places", "16", "--taxels", "20")
RUNS = {
    "demo": ["demo", "--output", "out"],
    "reconstruct": ["reconstruct", "touched.csv", "--reference", "rest.csv", "--output", "out", "--num-points", "300"],
    "stream": ["stream", "touched.csv", "--reference", "rest.csv", "--output", "out", "--num-points", "300"],
    "layout compare": ["layout", "compare", "grid-4x4.svg", "inner-16.svg", "--output", "out", *FEW],
    "touch fit": ["touch", "fit", "presses.npz", "--output", "out", "--method", "forest"],
    "study": ["study", "run", "study.toml", "--output", "out.zarr"],
}
# All commands, each in a folder of its own, in one process.
_PROGRAM = """
import contextlib, json, sys
from jeit.cli import main
for folder, arguments in json.loads(sys.argv[1]).items():
    with contextlib.chdir(folder):
        if main(arguments):
            raise SystemExit(folder)
"""


@pytest.fixture
def given(tank):
    """The files that the commands read. The body is conductive enough to be fitted as a shape."""
    model = load_description(tank.folder / "rest.toml").model("rest.csv", num_points=400)
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.03, 0.02], axis=1) < 0.03
    noise = 1 + 1e-4 * np.random.default_rng(0).normal(size=(2, model.protocol.num_measurements))
    for name, ratio, error in zip(("rest", "touched"), (1.0, 20.0), noise, strict=True):
        tank.write(name, error * np.asarray(model.voltages(np.where(inside, ratio * 1e-3, 1e-3))))
    np.savez(tank.folder / "presses.npz", **record(60))
    (tank.folder / "study.toml").write_text(SMALL)
    for name in ("grid-4x4", "inner-16"):
        write_layout(named_layout(name, Rectangle(0.1, 0.1)), tank.folder / f"{name}.svg")
    return {one.name: one.read_bytes() for one in tank.folder.iterdir()}


def written(given: dict[str, bytes], folder: Path, seed: str) -> dict[str, dict[str, bytes]]:
    """The files that each command writes in a folder that holds the `given` files."""
    for name in RUNS:
        (folder / name).mkdir(parents=True)
        for one, content in given.items():
            (folder / name / one).write_bytes(content)
    run = [sys.executable, "-c", _PROGRAM, json.dumps(RUNS)]
    subprocess.run(
        run, cwd=folder, env={**os.environ, "PYTHONHASHSEED": seed}, check=True, capture_output=True, timeout=300
    )
    found = {}
    for name in RUNS:
        files = {str(one.relative_to(folder / name)): one for one in (folder / name).rglob("*") if one.is_file()}
        found[name] = {one: path.read_bytes() for one, path in sorted(files.items()) if one not in given}
    return found


def without_times(name: str, content: bytes):
    if name.endswith("report.json"):
        return {key: value for key, value in json.loads(content).items() if key not in _TIMES}
    if name.endswith("frames.csv"):
        rows = [line.split(",") for line in content.decode().splitlines()]
        kept = [column for column, title in enumerate(rows[0]) if title not in _TIMES]
        return [[row[column] for column in kept] for row in rows]
    return content


@pytest.mark.slow(first=True)
def test_two_runs_write_the_same_bytes(given, tmp_path):
    runs = [written(given, tmp_path / f"run{seed}", seed) for seed in ("1", "2")]
    for name in RUNS:
        one, other = (run[name] for run in runs)
        assert one, name
        assert list(one) == list(other)
        assert [file for file in one if without_times(file, one[file]) != without_times(file, other[file])] == [], name
