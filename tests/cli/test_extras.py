"""Without the packages of an extra, each command that needs them fails before any work and names the extra to
install."""

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from scipy.io import wavfile
from studies import SMALL

from jeit.arguments.extras import EXTRAS
from jeit.cli.app import run_as_command

ROOT = Path(__file__).resolve().parents[2]
SKIN = "[electrodes]\nlayout = 'grid-4x4'\n[skin]\nwidth_mm = 100\n"
CAD = """
[surface]
file = "part.step"
unit = "mm"
[electrodes]
layout = "inner-8"
diameter_mm = 10
[mesh]
cell_mm = 8
"""

# The arguments with which each command is called, for each extra that it or some of its input needs.
NEEDED = [
    ("layout compare", "cad", "skin.dxf ring-16 -o out"),
    ("layout optimise", "cad", "skin.dxf -o out"),
    ("learn image", "learn", "skin.toml -o out"),
    ("learn image", "cluster", "skin.toml -o out"),
    ("learn image", "mesh", "cad.toml -o out"),
    ("listen recording", "sound", "one.flac --model model -o out"),
    ("listen fit", "learn", "clips -o out"),
    ("live", "live", "demo"),
    ("locate", "sound", "one.flac --calibration calibration.json -o out"),
    ("study report", "cluster", "study.toml"),
    ("study resume", "cluster", "study.toml"),
    ("study run", "cluster", "study.toml -o new.zarr"),
    ("study run", "mesh", "cad_study.toml"),
    ("study status", "cluster", "study.toml"),
    ("touch fit", "learn", "presses.npz -o out"),
    ("touch gestures", "learn", "gestures.npz --skin tank.toml -o out"),
    ("touch predict", "learn", "skin.jeit presses.npz -o out"),
    ("touch watch", "learn", "presses.npz --skin tank.toml --gestures skin.jeit -o out"),
]
NOTHING_NEEDED = {
    *("calibrate-microphones", "choose", "demo", "describe", "info"),
    *("reconstruct", "series", "stream", "touch contacts", "touch health", "view"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of every kind that the commands read. The packages are checked before the content of these files."""
    folder = tmp_path_factory.mktemp("extras")
    random = np.random.default_rng(0)
    frames = random.standard_normal((20, 10))
    np.savez(folder / "presses.npz", frames=frames, positions=0.01 * frames[:, :2])
    (folder / "skin.toml").write_text(SKIN)
    (folder / "cad.toml").write_text(CAD)
    (folder / "cad_study.toml").write_text(CAD.replace("layout =", "layouts ="))
    (folder / "study.toml").write_text(SMALL)
    (folder / "study.zarr").mkdir()
    (folder / "part.step").write_text("ISO-10303-21;")
    (folder / "skin.dxf").write_text("0\nSECTION\n")
    (folder / "skin.jeit").write_bytes(b"PK")
    (folder / "one.flac").write_bytes(b"fLaC and more")
    for name in ("low", "high"):
        (folder / "clips" / name).mkdir(parents=True)
        for number in range(3):
            sound = random.standard_normal(8000).astype(np.float32)
            wavfile.write(folder / "clips" / name / f"{number}.wav", 16_000, 0.1 * sound)
    return folder


def commands(one=None, path=()):
    """Every command that is not a group of commands, by its words."""
    one = one or run_as_command()
    inside = getattr(one, "commands", {})
    for name, other in inside.items():
        yield from commands(other, (*path, name))
    if path and not inside:
        yield " ".join(path)


def test_every_command_is_tested():
    assert set(commands()) == {name for name, _, _ in NEEDED} | NOTHING_NEEDED


@pytest.mark.parametrize(("command", "extra", "arguments"), NEEDED)
def test_missing_extra_is_named(folder, run, monkeypatch, command, extra, arguments):
    for module in EXTRAS[extra]:
        monkeypatch.setitem(sys.modules, module, None)
    for reader in ("jeit.touch.listening.Listener.read", "jeit.acoustic.Calibration.load"):
        monkeypatch.setattr(reader, lambda path: None)
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    status, out, error = run(*command.removesuffix(" recording").split(), *arguments.split())
    assert (status, out) == (1, "")
    assert f"pip install 'jeit[{extra}]'" in error
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("package", "arguments"),
    [("ezdxf", "layout compare skin.dxf ring-16 -o out"), ("sklearn", "touch fit presses.npz -o out")],
)
def test_package_that_cannot_be_imported(folder, run, monkeypatch, tmp_path, package, arguments):
    """The package is installed but its import fails: the error is one line with the reason."""
    (tmp_path / f"{package}.py").write_text("raise ImportError('libnothing.so: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.chdir(folder)
    status, _, error = run(*arguments.split())
    assert status == 1
    assert "cannot be imported (libnothing.so: no such file)" in error
    assert "should not have happened" not in error


def test_extras_are_those_of_the_project():
    """The extras and their packages are those of pyproject.toml."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    named = {extra: {Requirement(one).name for one in needs} for extra, needs in extras.items()}
    given = {extra: set(packages.values()) for extra, packages in EXTRAS.items()}
    assert given == {extra: named[extra] | ({"distributed"} if extra == "cluster" else set()) for extra in EXTRAS}
    assert set(named) - set(EXTRAS) == {"test", "docs", "dev"}
