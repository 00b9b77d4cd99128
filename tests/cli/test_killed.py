"""Commands killed with kill -9 at critical moments: the remaining files are readable, and the next run is
undisturbed."""

import csv
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from studies import in_another_process

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")

KILLED = """
import os, signal, sys
from {module} import {owner}

whole, calls = {owner}.{method}, []

def dying(self, *given, **options):
    calls.append(1)
    if len(calls) == {calls}:
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(self, *given, **options)

{owner}.{method} = dying
from jeit.cli import main
sys.exit(main(sys.argv[1:]))
"""
# The function in which the process dies, the number of the call, and the files that exist then.
STREAM = {
    "its third line": ("jeit.report.stream", "GrowingTable", "write", 4, {"frames.csv"}),
    "its images": ("zipfile", "_ZipWriteFile", "write", 3, {"frames.csv"}),
    "its sheet": ("jeit.plot.imaging.series", "FramePicture", "show", 3, {"frames.csv", "images.npz"}),
    "its film": ("jeit.plot.imaging.series", "FramePicture", "show", 9, {"frames.csv", "images.npz", "frames.png"}),
}


@pytest.mark.slow
def test_a_stream(tank, run, tmp_path):
    """Killed at each moment: complete lines and files remain, and the next run gives the results of an undisturbed
    one."""
    data = tank.write("many", np.stack([tank.touched, tank.rest, 1.02 * tank.touched, tank.touched]))
    given = "stream", data, "--reference", tank.folder / "rest.csv", "--method", "one-step", "--num-points", 250
    assert run(*given, "--quiet", "--output", tmp_path / "undisturbed")[0] == 0
    for moment, (module, owner, method, calls, left) in STREAM.items():
        out = tmp_path / moment
        code = KILLED.format(module=module, owner=owner, method=method, calls=calls)
        ended = in_another_process(code, *given, "--quiet", "--output", out)
        assert ended.returncode == -signal.SIGKILL, ended.stderr
        assert {path.name for path in out.iterdir() if path.name[0] != "."} == left, moment
        lines = (out / "frames.csv").read_text().splitlines(keepends=True)
        assert len(lines) == (3 if moment == "its third line" else 5)
        assert all(line.endswith("\n") for line in lines)
        assert {len(row) for row in csv.reader(lines)} == {10}
        if "images.npz" in left:
            with np.load(out / "images.npz") as held:
                assert held["conductivity"].shape[0] == 4
        assert run(*given, "--quiet", "--output", out)[0] == 0
        for name in ("images.npz", "frames.png", "film.gif"):
            assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes(), moment
        assert sorted(os.listdir(out)) == sorted(os.listdir(tmp_path / "undisturbed"))


@pytest.mark.slow
def test_an_image(tank, run, tmp_path):
    """The process dies while it replaces the second file: one file is new, the others are those of an earlier run."""
    given = "--reference", tank.folder / "rest.csv", "--method", "one-step", "--num-points", 250, "--quiet", "--output"
    assert run("reconstruct", tank.write("less", 0.5 * (tank.rest + tank.touched)), *given, tmp_path / "out")[0] == 0
    code = KILLED.format(module="pathlib", owner="Path", method="replace", calls=2)
    ended = in_another_process(code, "reconstruct", tank.folder / "touched.csv", *given, tmp_path / "out")
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    with np.load(tmp_path / "out" / "image.npz") as held:
        assert all(held[name].size for name in held.files)
    with Image.open(tmp_path / "out" / "image.png") as picture:
        picture.load()
    for folder in ("out", "undisturbed"):
        assert run("reconstruct", tank.folder / "touched.csv", *given, tmp_path / folder)[0] == 0
    for name in ("image.npz", "image.png"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()


KILLED_IN_THE_CACHE = """
import os, signal, sys
from pathlib import Path

whole = Path.write_bytes

def dying(self, content):
    if self.name.endswith("-cache") and len(content) > 2000:
        whole(self, content[: len(content) // 2])
        print(self, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(self, content)

Path.write_bytes = dying
from jeit.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_while_compiled_code_is_kept(tank, run, tmp_path):
    """Half a compiled program remains; the next run replaces it without a message."""
    given = [
        "reconstruct",
        tank.folder / "touched.csv",
        "--reference",
        tank.folder / "rest.csv",
        "--method",
        "one-step",
    ]
    given = [*map(str, given), "--num-points", "250", "--quiet", "--output"]
    kept = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "JEIT_COMPILATION_CACHE")
    environment = {name: value for name, value in os.environ.items() if name not in kept}

    def start(cache, *command):
        home = {"XDG_CACHE_HOME": str(tmp_path / cache), "LOCALAPPDATA": str(tmp_path / cache), "HOME": str(tmp_path)}
        return subprocess.run([sys.executable, *command], env=environment | home, capture_output=True, text=True)

    ended = start("cache", "-c", KILLED_IN_THE_CACHE, *given, tmp_path / "out")
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    torn = ended.stdout.strip()
    size = os.path.getsize(torn)
    ended = start("cache", "-m", "jeit", *given, tmp_path / "out")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert not os.path.exists(torn) or os.path.getsize(torn) > size
    assert run(*given, tmp_path / "undisturbed")[0] == 0
    assert (tmp_path / "out" / "image.npz").read_bytes() == (tmp_path / "undisturbed" / "image.npz").read_bytes()
