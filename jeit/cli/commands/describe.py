"""`jeit describe`: find out how the voltages in a file may have been measured, write a description of the file, and
image its first frame."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jeit.cli.options import (
    DataArgument,
    KeyOption,
    QuietOption,
    ReferenceArgument,
    ReferenceKeyOption,
    make_folder,
    naming_options_in_errors,
)

if TYPE_CHECKING:
    from jeit.imaging.describe import Findings

# For each shape of a body, the names of its sizes in a description, and the name of the layout of its electrodes.
_SHAPES = {
    "disk": (("radius",), "ring"),
    "rectangle": (("width", "height"), "perimeter"),
    "cylinder": (("radius", "height"), "ring"),
    "box": (("width", "depth", "height"), "perimeter"),
}
_DESCRIPTION_FILE = "description.toml"
_WRITTEN_FILES = (_DESCRIPTION_FILE, "image.png", "image.npz", "report.json", "image.vtu")
# Maximum number of explanations that are listed.
_MAX_LISTED_EXPLANATIONS = 5


def describe(
    data: DataArgument,
    reference: ReferenceArgument = None,
    key: KeyOption = None,
    reference_key: ReferenceKeyOption = None,
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
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"Folder for {_DESCRIPTION_FILE} and the first image.")
    ] = Path("."),
    quiet: QuietOption = False,
) -> None:
    """Find out how the voltages in a file without a description may be arranged: electrodes, protocol, channels, signs,
    frames.

    Lists the explanations with the evidence for each, writes a commented description.toml, and images the first frame
    that differs from REFERENCE, or from the array --reference-key. In Python:
    `jeit.imaging.find_description`.
    """
    from jeit.arguments import check_name
    from jeit.cli.commands.reconstruct import print_imaging_result
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.data import read
    from jeit.data.frame_checks import assess
    from jeit.files.atomic_write import atomically_written_file
    from jeit.imaging import image_difference
    from jeit.imaging.describe import find_description
    from jeit.report import write_image

    known_values: dict[str, Any] = {"number": electrodes, "order": order}
    if protocol is not None:
        known_values["kind"] = protocol.replace("-", "_")
        check_name("--protocol", known_values["kind"], ("adjacent", "skip", "opposite", "two_terminal"))
    if order is not None:
        check_name("--order", order, ("rotating", "fixed"))
    examples = {"--shape disk:0.1": shape, "--width 0.01": width}
    missing = [example for example, value in examples.items() if value is None]
    if missing and not sys.stdin.isatty():
        raise ValueError(f"the file does not state all sizes; add them in metres, such as {' '.join(missing)}.")
    geometry, electrode_table = _body_tables(
        _value_or_prompt(shape, "The body in metres, such as disk:0.1"), width, height
    )
    make_folder(output, _WRITTEN_FILES)
    target = output / _DESCRIPTION_FILE
    if target.exists():
        raise ValueError(f"--output: {target} exists already; move it, or give another folder.")
    console = plain_console()
    given_values = {name: value for name, value in known_values.items() if value is not None}
    option_names = {"key": "--key", "number": "--electrodes", "width": "--width", "height": "--height"}
    with Steps(console, quiet=quiet) as step, naming_options_in_errors(option_names), _naming_size_options_in_errors():
        findings = find_description(
            data,
            geometry,
            electrode_table,
            reference=reference,
            keys=(key, reference_key),
            known=given_values,
            current=current,
            progress=step,
        )
    if not quiet:
        _print_findings(console, data, findings)
    if findings.fault:
        raise ValueError(findings.fault)
    if findings.undecided:
        other_names = "; ".join(candidate.name for candidate in findings.undecided)
        raise ValueError(
            f"undecided: {findings.candidates[0].name}, or {other_names} explain the voltages as well. Decide by "
            "--electrodes, --protocol or --order."
        )
    with atomically_written_file(target) as file:
        file.write(findings.text.encode())
    if reference is None and reference_key is None:
        frames = findings.candidates[0].frames
        hint = (
            f"; or say which of its {frames} frames are of the empty body, and which to image: jeit reconstruct {data} "
            f"--description {target} --reference-frames 0-1 --frame {frames - 1}"
        )
        console.print(
            f"Written: {target}. Give --reference, a file of the empty body, to image it{hint * (frames > 1)}.",
            soft_wrap=True,
        )
        return
    with Steps(console, quiet=quiet) as step:
        reference_measurement = read(data if reference is None else reference, description=target, key=reference_key)
        measured = read(data, description=target, like=reference_measurement, key=key)
        imageable_frames = [
            k for k, quality in enumerate(assess(measured, reference_measurement.mean_frame())) if quality.imageable
        ]
        result = image_difference(
            measured, reference_measurement, frame=imageable_frames[0] if imageable_frames else None, progress=step
        )
        step("write the first image")
        write_image(result, output)
    if not quiet:
        print_imaging_result(console, result)
        print_written_files(console, target, *_WRITTEN_FILES[1 : 4 + (result.mesh.dimension == 3)])


@contextmanager
def _naming_size_options_in_errors() -> Iterator[None]:
    """Context manager that names the options --shape, --width and --height in error messages about bodies and
    electrodes."""
    try:
        yield
    except ValueError as error:
        message = str(error).removeprefix("the description: ")
        if " overlap;" in message:
            message = f"--width: {message[0].lower()}{message[1:]}"
        message = re.sub(r"^geometry(\.\w+)?", "--shape", re.sub(r"^electrodes\.(width|height)", r"--\1", message))
        if not message.startswith("--"):
            raise
        raise ValueError(re.sub(r"^(--\w+): \1: ", r"\1: ", message)) from error


def _value_or_prompt(value: Any, question: str) -> Any:
    """Return the `value` of an option; if the value is missing, ask the user on the terminal."""
    return typer.prompt(question) if value is None else value


def _body_tables(shape: str, width: float | None, height: float | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sections `[geometry]` and `[electrodes]` of a description, from the options. Raises `ValueError` for invalid
    values."""
    name, _, sizes_text = shape.partition(":")
    try:
        numbers = [float(number) for number in sizes_text.split(",")]
    except ValueError:
        numbers = []
    size_names, layout = _SHAPES.get(name, ((), ""))
    if not numbers or len(numbers) != len(size_names):
        options = ", ".join(
            f"{shape_name}:{','.join(body_sizes).upper()}" for shape_name, (body_sizes, _) in _SHAPES.items()
        )
        raise ValueError(f"--shape: give one of {options}, in metres; it is {shape[:40]!r}.")
    geometry = {"shape": name, **dict(zip(size_names, numbers, strict=True))}
    electrode_width = float(_value_or_prompt(width, "Width of an electrode in metres, such as 0.01"))
    electrode_table: dict[str, Any] = {"layout": layout, "width": electrode_width}
    if name in ("cylinder", "box"):
        electrode_height = geometry["height"] if height is None else height
        electrode_table = {
            "kind": "patch",
            **electrode_table,
            "height": electrode_height,
            "levels": geometry["height"] / 2,
        }
    elif height is not None:
        raise ValueError(f"--height: a {name} is a sheet; leave it out.")
    return geometry, electrode_table


def _print_findings(console, data: Path, findings: "Findings") -> None:
    """Print the explanations of the file that were found."""
    from jeit.arguments import counted, percent
    from jeit.cli.console import name_value_table

    rows = []
    for candidate in findings.candidates[:_MAX_LISTED_EXPLANATIONS]:
        evidence = [counted(candidate.frames, "frame")]
        evidence += [] if candidate.reciprocity is None else [f"reciprocity broken by {percent(candidate.reciprocity)}"]
        evidence += [f"frames of the empty body differ by {percent(candidate.spread)}"] if candidate.spread else []
        misfit = "not compared" if candidate.wiring is None else f"misfit {percent(candidate.misfit)}"
        rows.append((misfit, f"{candidate.name}: {', '.join(evidence)}"))
    best_candidate = findings.candidates[0]
    rows += [("note", note) for note in best_candidate.measurement.notes]
    if best_candidate.gains is not None:
        rows.append(("gains", "those of the measurements differ, and are corrected: [data] gains of the description"))
    if best_candidate.wiring is not None and best_candidate.wiring.explanation and not best_candidate.reversed_signs:
        rows.append(("wiring", best_candidate.wiring.explanation))
    console.print()
    console.print(name_value_table(f"{data.name} may be", rows))
    console.print()
