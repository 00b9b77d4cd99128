"""Commands on invalid files, as `Reader` objects: what a command prints, where `readers` checks what a function
raises."""

import contextlib
import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.io.wavfile
from readers import BODY, READERS, Reader  # first: it adds folders of other tests to the path

from made_clips import struck  # isort: skip

from jeit.cli import main

COMMANDS: dict[str, Reader] = {}


class Fault(Exception):
    """A command ended in another way than by success or one line of error."""


def _run(*arguments: str) -> Callable[[Path], None]:
    """A command in which {folder} is the folder of the file and {output} another.

    It raises `ValueError` with the printed error, and `Fault` if the error is internal, longer than a line, or leaves
    files.
    """

    def use(path: Path) -> None:
        with tempfile.TemporaryDirectory() as place, io.StringIO() as out, io.StringIO() as err:
            output = Path(place) / "output"
            given = [one.format(file=path, folder=path.parent, output=output) for one in arguments]
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                status = main(given)
            lines = [one for one in err.getvalue().splitlines() if not one.startswith("jeit: warning: ")]
            if status == 0:
                return
            if status not in (1, 2) or len(lines) != 1 or "should not have happened" in lines[0]:
                raise Fault(f"{status}: {' / '.join(lines)}")
            if [*Path(place).iterdir()] and "none could be imaged" not in lines[0]:  # the note of a stream
                raise Fault(f"left {sorted(map(str, output.rglob('*')))}")
            raise ValueError(lines[0])

    return use


def _command(name: str, kind: str, *arguments: str, also: Callable[[Path], object] = lambda folder: None) -> None:
    reader = READERS[kind]

    def make(folder: Path) -> None:
        reader.make(folder)
        also(folder)

    COMMANDS[name] = Reader(name, reader.main, make, lambda folder: _run(*arguments)(folder / reader.main))


def _touched(folder: Path) -> None:
    """Write a table of a tank, and one with a body in it."""
    from jeit.data import load_description

    (folder / "a.toml").write_text(
        BODY.replace('unit = "mV"\ngain = 2.0\nsaturation = 900.0\n', "").replace('frame_names = ["a", "b"]\n', "")
    )
    model = load_description(folder / "a.toml").model("a.csv", num_points=300)
    whole = np.ones(model.mesh.num_cells)
    middles = np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)].mean(axis=1)
    near = np.linalg.norm(middles - 0.05, axis=1) < 0.02
    rng = np.random.default_rng(0)
    for name, conductivity in (("a", whole * np.where(near, 0.2, 1)), ("empty", whole)):
        frame = np.asarray(model.voltages(conductivity))
        np.savetxt(folder / f"{name}.csv", frame[None] * (1 + 1e-4 * rng.normal(size=frame.size)), delimiter=",")
    (folder / "empty.toml").write_text((folder / "a.toml").read_text())


def _nine_microphones(folder: Path) -> None:
    """Write a second of noise with a tap, recorded by nine microphones as calibrated.

    A compiled program searches for changes since the calibration, and is seldom needed here.
    """
    from microphone_arrays import array, received_power

    READERS["calibration"].make(folder)
    rng, strength = np.random.default_rng(0), np.sqrt(received_power(array(9), [[0.02, 0.01]])[0])
    samples = 1e-3 * rng.normal(size=(8000, 9))
    samples[3000:3400] += 0.05 * rng.normal(size=(400, 1)) * strength / strength.max()
    scipy.io.wavfile.write(folder / "a.wav", 8000, samples.astype("f4"))


def _tapped(folder: Path) -> None:
    """Write a tap and a listener."""
    READERS["listener"].make(folder)
    tap = struck(np.random.default_rng(5), "metal")
    scipy.io.wavfile.write(folder / "a.wav", 44_100, np.asarray(tap.samples).T.astype("f4"))


def _healthy(folder: Path) -> None:
    """Write a minute of one skin, and one in which a channel fails."""
    rng = np.random.default_rng(0)
    frames = 1 + rng.random(40) + 1e-3 * rng.normal(size=(240, 40))
    np.savez(folder / "whole.npz", frames=frames, seconds=np.arange(240) / 4)
    frames[100:, 3] = 0
    np.savez(folder / "a.npz", frames=frames, seconds=np.arange(240) / 4)


_command("jeit info, csv", "table, csv", "info", "{file}")
_command("jeit info, npz", "table, npz", "info", "{file}")
_command("jeit info, mat", "kit4", "info", "{file}")
_command(
    "jeit reconstruct", "table, csv", "reconstruct", "{file}", "--reference", "{folder}/empty.csv", "--output",
    "{output}", "--method", "one-step", "--num-points", "300", also=_touched,
)  # fmt: skip
_command(
    "jeit stream", "table, csv", "stream", "{file}", "--reference", "{folder}/empty.csv", "--output", "{output}",
    "--method", "one-step", "--num-points", "300", "--film", "none", also=_touched,
)  # fmt: skip
_command(
    "jeit locate", "sound, wav", "locate", "{file}", "--calibration", "{folder}/a.json", "--output", "{output}",
    also=_nine_microphones,
)  # fmt: skip
_command("jeit study status", "store of a study", "study", "status", "{folder}/a.toml", "--output", "{file}")
_command(
    "jeit touch predict", "learnt skin", "touch", "predict", "{file}", "{folder}/a.npz", "--output", "{output}",
    also=READERS["presses"].make,
)  # fmt: skip
_command(
    "jeit listen", "sound, wav", "listen", "{file}", "--model", "{folder}/a.jeit", "--output", "{output}", also=_tapped,
)  # fmt: skip
_command(
    "jeit touch health", "frames", "touch", "health", "{file}", "--healthy", "{folder}/whole.npz", "--output",
    "{output}", also=_healthy,
)  # fmt: skip
READERS |= COMMANDS
