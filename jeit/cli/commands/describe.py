"""`jeit describe`: estimate how the voltages in a file were measured, write a description of the file, and image its
first frame."""

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
_BODY_SHAPES = {
    "disk": (("radius",), "ring"),
    "rectangle": (("width", "height"), "perimeter"),
    "cylinder": (("radius", "height"), "ring"),
    "box": (("width", "depth", "height"), "perimeter"),
}
_DESCRIPTION_FILE = "description.toml"
_WRITTEN_FILES = (_DESCRIPTION_FILE, "image.png", "image.npz", "report.json", "image.vtu")
# Maximum number of explanations of a file that are printed.
_MAX_PRINTED_EXPLANATIONS = 5


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

    protocol_options: dict[str, Any] = {"number": electrodes, "order": order}
    if protocol is not None:
        protocol_options["kind"] = protocol.replace("-", "_")
        check_name("--protocol", protocol_options["kind"], ("adjacent", "skip", "opposite", "two_terminal"))
    if order is not None:
        check_name("--order", order, ("rotating", "fixed"))
    option_examples = {"--shape disk:0.1": shape, "--width 0.01": width}
    missing_examples = [example for example, value in option_examples.items() if value is None]
    if missing_examples and not sys.stdin.isatty():
        raise ValueError(
            f"the file does not state all sizes; add them in metres, such as {' '.join(missing_examples)}."
        )
    geometry, electrode_table = _body_tables(
        _value_or_prompt(shape, "The body in metres, such as disk:0.1"), width, height
    )
    make_folder(output, _WRITTEN_FILES)
    description_path = output / _DESCRIPTION_FILE
    if description_path.exists():
        raise ValueError(f"--output: {description_path} exists already; move it, or give another folder.")
    console = plain_console()
    known_protocol = {name: value for name, value in protocol_options.items() if value is not None}
    option_names = {"key": "--key", "number": "--electrodes", "width": "--width", "height": "--height"}
    with Steps(console, quiet=quiet) as step, naming_options_in_errors(option_names), _naming_size_options_in_errors():
        findings = find_description(
            data,
            geometry,
            electrode_table,
            reference=reference,
            keys=(key, reference_key),
            known=known_protocol,
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
    with atomically_written_file(description_path) as file:
        file.write(findings.text.encode())
    if reference is None and reference_key is None:
        num_frames = findings.candidates[0].frames
        frames_hint = (
            f"; or say which of its {num_frames} frames are of the empty body, and which to image: "
            f"jeit reconstruct {data} --description {description_path} --reference-frames 0-1 --frame {num_frames - 1}"
        )
        console.print(
            f"Written: {description_path}. Give --reference, a file of the empty body, to image it"
            f"{frames_hint * (num_frames > 1)}.",
            soft_wrap=True,
        )
        return
    with Steps(console, quiet=quiet) as step:
        reference_measurement = read(
            data if reference is None else reference, description=description_path, key=reference_key
        )
        measurement = read(data, description=description_path, like=reference_measurement, key=key)
        imageable_frames = [
            k for k, quality in enumerate(assess(measurement, reference_measurement.mean_frame())) if quality.imageable
        ]
        result = image_difference(
            measurement, reference_measurement, frame=imageable_frames[0] if imageable_frames else None, progress=step
        )
        step("write the first image")
        write_image(result, output)
    if not quiet:
        print_imaging_result(console, result)
        print_written_files(console, description_path, *_WRITTEN_FILES[1 : 4 + (result.mesh.dimension == 3)])


@contextmanager
def _naming_size_options_in_errors() -> Iterator[None]:
    """Context manager that replaces names of entries of a description by the options --shape, --width and --height in
    error messages about bodies and electrodes."""
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
    """Create the sections `[geometry]` and `[electrodes]` of a description from the options. Raises `ValueError` for
    invalid values."""
    body_shape, _, sizes_text = shape.partition(":")
    try:
        size_values = [float(number) for number in sizes_text.split(",")]
    except ValueError:
        size_values = []
    size_names, electrode_layout = _BODY_SHAPES.get(body_shape, ((), ""))
    if not size_values or len(size_values) != len(size_names):
        shape_options = ", ".join(
            f"{shape_name}:{','.join(body_sizes).upper()}" for shape_name, (body_sizes, _) in _BODY_SHAPES.items()
        )
        raise ValueError(f"--shape: give one of {shape_options}, in metres; it is {shape[:40]!r}.")
    geometry = {"shape": body_shape, **dict(zip(size_names, size_values, strict=True))}
    electrode_width = float(_value_or_prompt(width, "Width of an electrode in metres, such as 0.01"))
    electrode_table: dict[str, Any] = {"layout": electrode_layout, "width": electrode_width}
    if body_shape in ("cylinder", "box"):
        electrode_height = geometry["height"] if height is None else height
        electrode_table = {
            "kind": "patch",
            **electrode_table,
            "height": electrode_height,
            "levels": geometry["height"] / 2,
        }
    elif height is not None:
        raise ValueError(f"--height: a {body_shape} is a sheet; leave it out.")
    return geometry, electrode_table


def _print_findings(console, data: Path, findings: "Findings") -> None:
    """Print the arrangements of electrodes and channels that may explain the voltages in the file."""
    from jeit.arguments import counted, percent
    from jeit.cli.console import name_value_table

    table_rows = []
    for candidate in findings.candidates[:_MAX_PRINTED_EXPLANATIONS]:
        evidence_texts = [counted(candidate.frames, "frame")]
        evidence_texts += (
            [] if candidate.reciprocity is None else [f"reciprocity broken by {percent(candidate.reciprocity)}"]
        )
        evidence_texts += (
            [f"frames of the empty body differ by {percent(candidate.spread)}"] if candidate.spread else []
        )
        misfit_text = "not compared" if candidate.wiring is None else f"misfit {percent(candidate.misfit)}"
        table_rows.append((misfit_text, f"{candidate.name}: {', '.join(evidence_texts)}"))
    best_candidate = findings.candidates[0]
    table_rows += [("note", note) for note in best_candidate.measurement.notes]
    if best_candidate.gains is not None:
        table_rows.append(
            ("gains", "those of the measurements differ, and are corrected: [data] gains of the description")
        )
    if best_candidate.wiring is not None and best_candidate.wiring.explanation and not best_candidate.reversed_signs:
        table_rows.append(("wiring", best_candidate.wiring.explanation))
    console.print()
    console.print(name_value_table(f"{data.name} may be", table_rows))
    console.print()
