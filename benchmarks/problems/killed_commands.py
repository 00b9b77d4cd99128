"""Commands that are killed: their input, their output, and checks of whether the output can be read and is correct."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

STUDY = """
chunk_points = 1
[skin]
width_mm = 100
height_mm = 80
thickness_mm = [4, 5, 6, 8]
[electrodes]
layouts = ["grid-4x2", "perimeter-8", "inner-8"]
diameter_mm = 10
contact_impedance_ohm_m2 = 1e-3
[measurement]
protocol = "adjacent"
[touch]
columns = 16
rows = 14
exact = true
[mesh]
cell_mm = 4
"""
_FRAMES, _NODES = 60, 400


@dataclass(frozen=True)
class Command:
    """A command of jeit that is run in `folder`.

    `arguments`: arguments of the command; `resume`: arguments to resume it, if they differ; `output`: file or folder of
    the results; `begun`: pattern of files that exist once the command writes; `same`: files whose bytes do not depend
    on when the command ends; `environment`: additional environment variables; `afresh`: paths that are deleted before
    each run.
    """

    name: str
    folder: Path
    arguments: tuple[str, ...]
    output: Path
    begun: str
    same: tuple[str, ...] = ()
    resume: tuple[str, ...] = ()
    afresh: tuple[Path, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)

    def start(self, *, again: bool = False) -> subprocess.Popen:
        """Start a process of the command, with the arguments for resuming if `again`."""
        arguments = self.resume if again and self.resume else self.arguments
        command = [sys.executable, "-m", "jeit", *arguments]
        environment = os.environ | {"XDG_CACHE_HOME": str(self.folder / "cache")} | self.environment
        return subprocess.Popen(
            command, cwd=self.folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )

    def whole(self) -> tuple[float, float, dict[str, bytes]]:
        """Run the command undisturbed; return the seconds until it writes, the seconds until it ends, and its
        output."""
        start, stamp, begun = time.perf_counter(), time.time(), 0.0
        process = self.start()
        while process.poll() is None:
            if not begun and self.writes(stamp):
                begun = time.perf_counter() - start
            time.sleep(0.01)
        self.ended(process)
        return begun, time.perf_counter() - start, self.written()

    def writes(self, stamp: float) -> bool:
        """Whether a run that was started at the time `stamp` has begun to write."""
        for path in self.output.parent.glob(self.begun):
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_mtime >= stamp:
                    return True
        return False

    def ended(self, process: subprocess.Popen) -> None:
        """Wait for the end of a process of the command. Raises `RuntimeError` if the command fails or prints
        anything."""
        error_output = process.communicate()[1]
        if process.returncode or error_output:
            raise RuntimeError(f"{self.name}: status {process.returncode}: {error_output.strip()}")

    def written(self) -> dict[str, bytes]:
        """Contents, by name, of the output files that must be the same in every run: the files `same`, or all files if
        `same` is empty."""
        names = self.same or [str(one.relative_to(self.output)) for one in self.output.rglob("*") if one.is_file()]
        return {name: (self.output / name).read_bytes() for name in names if (self.output / name).exists()}

    def clear(self, *, all: bool = False) -> None:
        """Delete the paths `afresh`, which must not exist before a run; if `all`, also delete all output."""
        for path in (*self.afresh, *([self.output] if all else [])):
            shutil.rmtree(path, ignore_errors=True)


def unreadable(folder: Path) -> list[str]:
    """Messages about files of a folder that are incomplete."""
    wrong = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        look = _LOOKS.get(path.suffix)
        if path.name.startswith(".") or look is None:
            continue
        try:
            look(path)
        except Exception as error:  # any message of a reader about damaged files
            wrong.append(f"{path.name}: {type(error).__name__}: {error}")
    return wrong


def _look_at_table(path: Path) -> None:
    content = path.read_bytes().decode()
    rows = list(csv.reader(content.splitlines()))
    if not content.endswith("\n") or len({len(row) for row in rows}) != 1:
        raise ValueError("a line is cut short")


def _look_at_arrays(path: Path) -> None:
    with np.load(path) as held:
        for name in held.files:
            held[name]


def _look_at_picture(path: Path) -> None:
    from PIL import Image

    with Image.open(path) as picture:
        for number in range(getattr(picture, "n_frames", 1)):
            picture.seek(number)
            picture.load()


_LOOKS: dict[str, Callable[[Path], object]] = {
    ".csv": _look_at_table,
    ".npz": _look_at_arrays,
    ".png": _look_at_picture,
    ".gif": _look_at_picture,
    ".json": lambda path: json.loads(path.read_bytes()),
}


def study(folder: Path, name: str, scheduler: str | None = None) -> Command:
    """Command that runs a design study of twelve points in twelve chunks with exact maps, by the workers of a Dask
    `scheduler` if it is given."""
    folder.mkdir(parents=True)
    (folder / "study.toml").write_text(STUDY, "utf-8")
    options = ("study.toml", "--quiet", *(() if scheduler is None else ("--scheduler", scheduler)))
    run, resume = ("study", "run", *options), ("study", "resume", *options)
    return Command(name, folder, run, folder / "study.zarr", ".study.zarr.lock", resume=resume)


def tank(folder: Path) -> dict[str, Command]:
    """Commands that stream frames, compute an image, and compute the same image without cached compiled code, for a
    disk with a moving touch."""
    from benchmarks.problems.touched_sensors import bodies, simulate
    from jeit.data import Measurement, write_table
    from jeit.mesh import Disk

    make, reach = bodies()["disk, 16 electrodes"]
    model = make(_NODES)
    frames, rest = simulate(model, reach, _FRAMES)
    folder.mkdir(parents=True)
    for name, some in (("rest", rest[None]), ("touched", frames)):
        measured = Measurement(
            some, np.ones(some.shape, bool), model.protocol, electrodes=model.electrodes, domain=Disk(0.1), name=name
        )
        write_table(measured, folder / f"{name}.npz")
    given = ("touched.npz", "--reference", "rest.npz", "--quiet", "--num-points", str(_NODES), "--output")
    out, cache = folder / "streamed", folder / "empty"
    image = ("image.npz", "image.png")
    return {
        "stream": Command(
            "stream",
            folder,
            ("stream", *given, out.name),
            out,
            f"{out.name}/frames.csv",
            same=("images.npz", "frames.png", "film.gif"),
        ),
        "reconstruct": Command(
            "reconstruct", folder, ("reconstruct", *given, "imaged"), folder / "imaged", "imaged/*", same=image
        ),
        "compiling": Command(
            "reconstruct, nothing compiled",
            folder,
            ("reconstruct", *given, "compiled"),
            folder / "compiled",
            "empty/jeit/jax/*/*-cache",
            same=image,
            afresh=(cache,),
            environment={"XDG_CACHE_HOME": str(cache)},
        ),
    }


def watch(folder: Path) -> Command:
    """Command that classifies gestures on a small sheet, each when it ends."""
    import jax

    from jeit.electrodes import PointElectrodes
    from jeit.forward import ForwardModel
    from jeit.layout import perimeter
    from jeit.mesh import Rectangle
    from jeit.protocol import reference_electrode
    from jeit.touch.simulate import Person, PressedSkin, material, simulate_gesture_stream, simulate_gestures

    sheet, current = Rectangle(0.32, 0.2), 1.8e-3
    places = np.vstack([perimeter(Rectangle(0.3, 0.18), 8, start=0.06), [[0.0, 0.0]]])
    model = ForwardModel(sheet.mesh(num_points=300), PointElectrodes(places), reference_electrode(8, current=current))
    skin = PressedSkin(jax.random.key(0), model, material("conductive fabric"))
    people = [Person.draw(key) for key in jax.random.split(jax.random.key(1), 2)]
    folder.mkdir(parents=True)
    simulate_gestures(jax.random.key(2), skin, sheet, people, 3).write(folder / "gestures.npz")
    stream = simulate_gesture_stream(jax.random.key(3), skin, sheet, people, 6)
    np.savez(folder / "stream.npz", frames=stream.voltages, seconds=stream.seconds)
    (folder / "skin.toml").write_text(
        f'[geometry]\nshape = "rectangle"\nwidth = 0.32\nheight = 0.2\n[electrodes]\nkind = "point"\n'
        f'positions = {places.tolist()}\n[protocol]\nkind = "reference_electrode"\ncurrent = {current}\n',
        "utf-8",
    )
    learn = ("touch", "gestures", "gestures.npz", "--skin", "skin.toml", "--output", "model", "--quiet")
    made = Command("learn", folder, (*learn, "--method", "linear-discriminant"), folder / "model", "model/*")
    made.ended(made.start())
    arguments = ("touch", "watch", "stream.npz", "--skin", "skin.toml", "--gestures", "model", "--quiet")
    out = folder / "watched"
    same = ("paths.csv", "timeline.png")
    return Command("touch watch", folder, (*arguments, "--output", out.name), out, "watched/events.csv", same=same)
