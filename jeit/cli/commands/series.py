"""`jeit series`: image all frames of a recording at once, with curves of regions over time and maps of
oscillations."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import (
    AsIsOption,
    ContactOption,
    DataArgument,
    DescriptionOption,
    FormatOption,
    KeyOption,
    NodesOption,
    QuietOption,
    ReferenceFramesOption,
    ReferenceKeyOption,
    convert_to_number_if_possible,
    make_folder,
    naming_options_in_errors,
    read_pair,
)

if TYPE_CHECKING:
    from jeit.mesh import Mesh

# Maximum number of refused frames that are printed.
_MAX_PRINTED_FRAMES = 8


def series(
    data: DataArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Folder for series.png, series.npz, regions.csv, report.json.", show_default=False
        ),
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Measured file of the undisturbed body; DATA's frame 'reference', or its mean, unless given."
        ),
    ] = None,
    reference_frames: ReferenceFramesOption = None,
    frequency: Annotated[
        list[str] | None,
        typer.Option(
            help="Map amplitude and phase at so many hertz, or at the strongest in a band: 0.3, or 0.1-0.6; may be "
            "given repeatedly.",
            metavar="HZ|LOW-HIGH",
        ),
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(
            help="Region of interest, metres: ball:X,Y[,Z],RADIUS or box:X,Y[,Z],X,Y[,Z] (two corners) or "
            "half:DX,DY[,DZ] (from the middle that way); may be given repeatedly. The whole body unless given.",
            metavar="SHAPE:NUMBERS",
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Frames in a second, where neither DATA nor its description says so.")
    ] = None,
    key: KeyOption = None,
    reference_key: ReferenceKeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
    hyperparameter: Annotated[
        str | None, typer.Option(help="A number, or the rule that chooses it (default noise-figure).")
    ] = None,
    contact: ContactOption = None,
    num_points: NodesOption = None,
    film: Annotated[
        str, typer.Option(help="Film's name: .gif, or .mp4 where ffmpeg is installed; none for none (default).")
    ] = "none",
    as_is: AsIsOption = False,
    quiet: QuietOption = False,
) -> None:
    """Image all frames of DATA against one reference, linearly and at once, and analyse the changes over time.

    Writes series.png (frames, the functional image, maps of amplitude and phase, curves and spectra of regions),
    series.npz, regions.csv and report.json. 'jeit stream' images frames one by one as they arrive.

    In Python: `jeit.imaging.image_sequence`, `jeit.image.oscillation`, `jeit.report.write_series`.
    """
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, format_with_unit, plain_console, print_written_files
    from jeit.image import oscillation
    from jeit.imaging import ImagingSettings, image_sequence
    from jeit.report import write_series
    from jeit.report.series import SERIES_FILES, check_film

    setting_values = {
        "hyperparameter": None if hyperparameter is None else convert_to_number_if_possible(hyperparameter),
        "contact": contact,
        "num_points": num_points,
        "as_is": as_is,
    }
    settings = ImagingSettings(
        "one-step", **{name: value for name, value in setting_values.items() if value is not None}
    )
    film_name = None if film == "none" else film
    with naming_options_in_errors({"film": "--film"}):
        film_names = () if film_name is None else (check_film(film_name),)
    bands = [_parse_band(band_text) for band_text in frequency or ()]
    parsed_regions = {region_text: _parse_region(region_text) for region_text in region or ()}
    make_folder(output, (*SERIES_FILES, *film_names))
    console = plain_console()
    with Steps(console, quiet=quiet) as step:
        step("read")
        measurement, reference_measurement = read_pair(
            data, reference, reference_frames, format, description, (key, reference_key)
        )
        with naming_options_in_errors({"rate": "--rate"}):
            measurement = measurement if rate is None else measurement.at_rate(rate)
        with naming_options_in_errors({"frequency": "--frequency"}):
            if measurement.times is None and bands:
                raise ValueError(f"frequency: '{measurement.name}' says no times; give --rate, in frames a second.")
            if measurement.times is not None:
                for band in bands:
                    oscillation(np.zeros((measurement.num_frames, 1)), measurement.times, band)
        regions = {
            text: partial(_region_mask, text, shape_and_numbers) for text, shape_and_numbers in parsed_regions.items()
        }
        sequence = image_sequence(measurement, reference_measurement, settings, regions=regions, progress=step)
        with naming_options_in_errors({"frequency": "--frequency"}):
            oscillations = [oscillation(sequence.series.changes, sequence.series.times, band) for band in bands]
        step("write")
        report = write_series(sequence, output, regions=sequence.regions, oscillations=oscillations, film=film_name)
    if quiet:
        return
    frames_text, unit = counted(report["frames"], "frame"), report["unit"]
    frame_rate_text = "" if report["frame_rate"] is None else f", {report['frame_rate']:.4g} a second"
    missing_times_text = (
        "" if measurement.times is not None else "; no times are known (--rate gives them), frames are numbered"
    )
    console.print(f"\n{frames_text}{frame_rate_text}, {report['refused']} refused{missing_times_text}")
    for frame_number, reason in sorted(sequence.reasons.items())[:_MAX_PRINTED_FRAMES]:
        console.print(f"  frame {frame_number}: refused. {reason}", soft_wrap=True, markup=False)
    if (num_unprinted_frames := len(sequence.reasons) - _MAX_PRINTED_FRAMES) > 0:
        console.print(f"  {num_unprinted_frames} more are in report.json.")
    for note in dict.fromkeys(
        (*sequence.prepared.measurement.notes, *(() if reference_measurement is None else reference_measurement.notes))
    ):
        console.print(f"  {note}", style="dim")
    for doubt in sequence.doubts:
        console.print(f"  doubt: {doubt}", soft_wrap=True, markup=False)
    for oscillation_report in report["oscillations"]:
        console.print(
            f"{oscillation_report['frequency']:.4g} Hz (resolution {oscillation_report['resolution']:.2g} Hz):"
        )
        for name, region_report in oscillation_report["regions"].items():
            amplitude_text = (
                f"{format_with_unit(region_report['amplitude'], unit)} ± "
                f"{format_with_unit(region_report['noise'], unit)}"
            )
            console.print(
                f"  {name}: amplitude {amplitude_text}, phase {region_report['phase_degrees']:.0f}°", markup=False
            )
    print_written_files(console, output / "series.png", "series.npz", "regions.csv", "report.json", *film_names)


def _parse_band(text: str) -> "float | tuple[float, float]":
    """Parse a frequency, or a band of frequencies, in hertz. Raises `ValueError` for an invalid text."""
    number_texts = text.split("-")
    try:
        numbers = [float(number_text) for number_text in number_texts]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise ValueError(f"--frequency: give hertz such as 0.3, or a band such as 0.1-0.6; it is {text[:40]!r}.")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def _parse_region(text: str) -> tuple[str, list[float]]:
    """Parse the shape and the numbers of a region of interest, such as "ball:0,0,0.02". Raises `ValueError` for an
    invalid text."""
    shape, _, numbers_text = text.partition(":")
    try:
        return shape, [float(number_text) for number_text in numbers_text.split(",")]
    except ValueError:
        raise ValueError(f"--region: {text[:40]!r} is no shape and numbers, such as ball:0.02,0,0.01.") from None


def _region_mask(text: str, shape_and_numbers: tuple[str, list[float]], mesh: "Mesh"):
    """Mask of the cells of the mesh that lie in a region of interest. Raises `ValueError` if the region does not fit
    the mesh."""
    from jeit.image import ball_region, box_region, half_region

    (shape, numbers), dimension = shape_and_numbers, mesh.dimension
    num_numbers_by_shape = {"ball": dimension + 1, "box": 2 * dimension, "half": dimension}
    if num_numbers_by_shape.get(shape) != len(numbers):
        example = "ball:0.02,0,0.01" if dimension == 2 else "ball:0.02,0,0.05,0.01"
        raise ValueError(
            f"--region: {text[:40]!r} is none of a body of {dimension} dimensions; give {example}, box: or half:."
        )
    try:
        if shape == "ball":
            return ball_region(mesh, numbers[:dimension], numbers[dimension])
        return (
            box_region(mesh, numbers[:dimension], numbers[dimension:]) if shape == "box" else half_region(mesh, numbers)
        )
    except ValueError as error:
        raise ValueError(f"--region {text[:40]!r}: {error}") from None
