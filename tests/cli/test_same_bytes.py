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

from jeit.layout import named_layout, write_layout
from jeit.mesh import Rectangle

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
_PROGRAM = "from jeit.cli import main; raise SystemExit(main())"


@pytest.fixture
def given(tank):
    """The files that the commands read."""
    np.savez(tank.folder / "presses.npz", **record(60))
    (tank.folder / "study.toml").write_text(SMALL)
    for name in ("grid-4x4", "inner-16"):
        write_layout(named_layout(name, Rectangle(0.1, 0.1)), tank.folder / f"{name}.svg")
    return {one.name: one.read_bytes() for one in tank.folder.iterdir()}


def written(name: str, given: dict[str, bytes], folder: Path, seed: str) -> dict[str, bytes]:
    """The files that a command writes in a folder that holds the `given` files."""
    folder.mkdir()
    for one, content in given.items():
        (folder / one).write_bytes(content)
    run = [sys.executable, "-c", _PROGRAM, *RUNS[name]]
    subprocess.run(
        run, cwd=folder, env={**os.environ, "PYTHONHASHSEED": seed}, check=True, capture_output=True, timeout=300
    )
    files = {str(one.relative_to(folder)): one for one in sorted(folder.rglob("*")) if one.is_file()}
    return {one: path.read_bytes() for one, path in files.items() if one not in given}


def without_times(name: str, content: bytes):
    if name.endswith("report.json"):
        return {key: value for key, value in json.loads(content).items() if key not in _TIMES}
    if name.endswith("frames.csv"):
        rows = [line.split(",") for line in content.decode().splitlines()]
        kept = [column for column, title in enumerate(rows[0]) if title not in _TIMES]
        return [[row[column] for column in kept] for row in rows]
    return content


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_two_runs_write_the_same_bytes(name, given, tmp_path):
    one, other = (written(name, given, tmp_path / f"run{seed}", seed) for seed in ("1", "2"))
    assert one
    assert list(one) == list(other)
    assert [file for file in one if without_times(file, one[file]) != without_times(file, other[file])] == []
