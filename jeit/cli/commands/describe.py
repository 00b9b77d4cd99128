"""`jeit describe`: find out what a file of voltages may be, write a description of it, and image its first frame."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jeit.cli.options import Data, Key, Quiet, Reference, ReferenceKey, make_folder, naming_options

if TYPE_CHECKING:
    from jeit.imaging.describe import Findings

# For each shape the names of its sizes in a description, and of the layout of its electrodes.
_SHAPES = {
    "disk": (("radius",), "ring"),
    "rectangle": (("width", "height"), "perimeter"),
    "cylinder": (("radius", "height"), "ring"),
    "box": (("width", "depth", "height"), "perimeter"),
}
_FILE = "description.toml"
_WRITTEN = (_FILE, "image.png", "image.npz", "report.json", "image.vtu")
# Explanations that are listed.
_LISTED = 5


def describe(
    data: Data,
    reference: Reference = None,
    key: Key = None,
    reference_key: ReferenceKey = None,
    shape: Annotated[
        str | None,
        typer.Option(
            help="The body, metres: disk:RADIUS, rectangle:WIDTH,HEIGHT, cylinder:RADIUS,HEIGHT or "
            "box:WIDTH,DEPTH,HEIGHT; asked for unless given.",
            metavar="SHAPE:SIZES",
        ),
    ] = None,
    width: Annotated[float | None, typer.Option(help="Of electrodes, metres; asked for unless given.")] = None,
    height: Annotated[
        float | None, typer.Option(help="Of electrodes of a solid, metres; as high as the solid unless given.")
    ] = None,
    electrodes: Annotated[int | None, typer.Option(help="How many, if it is known.")] = None,
    protocol: Annotated[
        str | None, typer.Option(help="adjacent, skip, opposite or two-terminal, if it is known.")
    ] = None,
    order: Annotated[str | None, typer.Option(help="Of measurements: rotating or fixed, if it is known.")] = None,
    current: Annotated[float, typer.Option(help="Amplitude, amperes; scales conductivities alone.")] = 1e-3,
    output: Annotated[Path, typer.Option("--output", "-o", help=f"Folder for {_FILE} and the first image.")] = Path(
        "."
    ),
    quiet: Quiet = False,
) -> None:
    """Find out what a file that nobody has described may be: electrodes, protocol, order of channels, signs, frames.

    Lists the explanations with the evidence for each, writes a commented description.toml, and images the first frame
    that differs from REFERENCE, or from the array --reference-key. In Python:
    `jeit.imaging.find_description`.
    """
    from jeit.arguments import check_name
    from jeit.cli.commands.reconstruct import show
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.data import read
    from jeit.data.imageable import assess
    from jeit.files.whole import written_whole
    from jeit.imaging import image_difference
    from jeit.imaging.describe import find_description
    from jeit.report import write_image

    known: dict[str, Any] = {"number": electrodes, "order": order}
    if protocol is not None:
        known["kind"] = protocol.replace("-", "_")
        check_name("--protocol", known["kind"], ("adjacent", "skip", "opposite", "two_terminal"))
    if order is not None:
        check_name("--order", order, ("rotating", "fixed"))
    geometry, places = _body(
        _asked("--shape", shape, "The body in metres, such as disk:0.1", "disk:0.1"), width, height
    )
    make_folder(output, _WRITTEN)
    target = output / _FILE
    if target.exists():
        raise ValueError(f"--output: {target} exists already; move it, or give another folder.")
    console = plain_console()
    given = {name: value for name, value in known.items() if value is not None}
    named = {"key": "--key", "number": "--electrodes", "width": "--width", "height": "--height"}
    with Steps(console, quiet=quiet) as step, naming_options(named), _naming_sizes():
        found = find_description(
            data,
            geometry,
            places,
            reference=reference,
            keys=(key, reference_key),
            known=given,
            current=current,
            progress=step,
        )
    if not quiet:
        _show(console, data, found)
    if found.fault:
        raise ValueError(found.fault)
    if found.undecided:
        others = "; ".join(one.name for one in found.undecided)
        raise ValueError(
            f"undecided: {found.candidates[0].name}, or {others} explain the voltages as well. Decide by --electrodes, "
            "--protocol or --order."
        )
    with written_whole(target) as file:
        file.write(found.text.encode())
    if reference is None and reference_key is None:
        frames = found.candidates[0].frames
        several = (
            f"; or say which of its {frames} frames are of the empty body, and which to image: jeit reconstruct {data} "
            f"--description {target} --reference-frames 0-1 --frame {frames - 1}"
        )
        console.print(
            f"Written: {target}. Give --reference, a file of the empty body, to image it{several * (frames > 1)}.",
            soft_wrap=True,
        )
        return
    with Steps(console, quiet=quiet) as step:
        base = read(data if reference is None else reference, description=target, key=reference_key)
        measured = read(data, description=target, like=base, key=key)
        sound = [k for k, one in enumerate(assess(measured, base.mean_frame())) if one.imageable]
        result = image_difference(measured, base, frame=sound[0] if sound else None, progress=step)
        step("write the first image")
        write_image(result, output)
    if not quiet:
        show(console, result)
        say_written(console, target, *_WRITTEN[1 : 4 + (result.mesh.dimension == 3)])


@contextmanager
def _naming_sizes() -> Iterator[None]:
    """Context manager that names the options --shape, --width and --height in errors about what they describe."""
    try:
        yield
    except ValueError as error:
        said = str(error).removeprefix("the description: ")
        if " overlap;" in said:
            said = f"--width: {said[0].lower()}{said[1:]}"
        said = re.sub(r"^geometry(\.\w+)?", "--shape", re.sub(r"^electrodes\.(width|height)", r"--\1", said))
        if not said.startswith("--"):
            raise
        raise ValueError(re.sub(r"^(--\w+): \1: ", r"\1: ", said)) from error


def _asked(option: str, given: Any, question: str, example: str) -> Any:
    """The value of an option, asked for on a terminal. Raises `ValueError` if there is none."""
    if given is not None:
        return given
    if not sys.stdin.isatty():
        raise ValueError(f"{option}: no file says it; give {option} {example}, in metres.")
    return typer.prompt(question)


def _body(shape: str, width: float | None, height: float | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tables `[geometry]` and `[electrodes]` of a description. Raises `ValueError`."""
    name, _, rest = shape.partition(":")
    try:
        numbers = [float(one) for one in rest.split(",")]
    except ValueError:
        numbers = []
    names, layout = _SHAPES.get(name, ((), ""))
    if not numbers or len(numbers) != len(names):
        options = ", ".join(f"{one}:{','.join(sizes).upper()}" for one, (sizes, _) in _SHAPES.items())
        raise ValueError(f"--shape: give one of {options}, in metres; it is {shape[:40]!r}.")
    geometry = {"shape": name, **dict(zip(names, numbers, strict=True))}
    wide = float(_asked("--width", width, "Width of an electrode in metres, such as 0.01", "0.01"))
    places: dict[str, Any] = {"layout": layout, "width": wide}
    if name in ("cylinder", "box"):
        tall = geometry["height"] if height is None else height
        places = {"kind": "patch", **places, "height": tall, "levels": geometry["height"] / 2}
    elif height is not None:
        raise ValueError(f"--height: a {name} is a sheet; leave it out.")
    return geometry, places


def _show(console, data: Path, found: "Findings") -> None:
    """Print the explanations that were found."""
    from jeit.arguments import counted, percent
    from jeit.cli.console import pairs

    rows = []
    for one in found.candidates[:_LISTED]:
        evidence = [counted(one.frames, "frame")]
        evidence += [] if one.reciprocity is None else [f"reciprocity broken by {percent(one.reciprocity)}"]
        evidence += [f"frames of the empty body differ by {percent(one.spread)}"] if one.spread else []
        misfit = "not compared" if one.wiring is None else f"misfit {percent(one.misfit)}"
        rows.append((misfit, f"{one.name}: {', '.join(evidence)}"))
    best = found.candidates[0]
    rows += [("note", note) for note in best.measurement.notes]
    if best.gains is not None:
        rows.append(("gains", "those of the measurements differ, and are corrected: [data] gains of the description"))
    if best.wiring is not None and best.wiring.explanation and not best.reversed_signs:
        rows.append(("wiring", best.wiring.explanation))
    console.print()
    console.print(pairs(f"{data.name} may be", rows))
    console.print()
