"""`jeit stream`: image frame by frame, from a file or from standard input."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.applications import check_method, image_by_network
from jeit.cli.options import (
    NETWORK_METHOD,
    AsIsOption,
    ContactOption,
    DescriptionOption,
    FormatOption,
    KeyOption,
    ModelOption,
    QuietOption,
    ReferenceFramesOption,
    ReferenceKeyOption,
    convert_to_number_if_possible,
    make_folder,
    naming_options_in_errors,
    read_file,
    read_pair,
    reference_of_frames,
)


def stream(
    data: Annotated[
        str,
        typer.Argument(
            help="Measured file with the frames, or - for standard input: a frame a line, its voltages parted by "
            "spaces or commas (nan: no reading), or several lines after a separator line.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for frames.csv, images.npz and pictures.", show_default=False)
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Measured file of the undisturbed body; says protocol and electrodes. Needed unless "
            "--reference-frames are given.",
            show_default=False,
        ),
    ] = None,
    reference_frames: ReferenceFramesOption = None,
    key: KeyOption = None,
    reference_key: ReferenceKeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="gauss-newton (default), levenberg-marquardt, or one-step for linear images; network, maps of depth "
            "by one that learnt the skin (--model)."
        ),
    ] = None,
    hyperparameter: Annotated[
        str | None,
        typer.Option(help="A number, or the rule that chooses it (default noise-figure).", metavar="VALUE|RULE"),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Most iterations for a frame (default 4).")] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            help="Frames over which an image changes: smooths in time (Kalman). 0 (default): every frame alone."
        ),
    ] = None,
    contact: ContactOption = None,
    num_points: Annotated[int | None, typer.Option(help="Nodes of the mesh, about (default 1200).")] = None,
    as_is: AsIsOption = False,
    film: Annotated[
        str,
        typer.Option(help="Film's name: .gif, or .mp4 where ffmpeg is installed (default film.gif); none for none."),
    ] = "film.gif",
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames in a second: times in place of numbers, and the film's pace (default: what DATA says, or 10)."
        ),
    ] = None,
    model: ModelOption = None,
    quiet: QuietOption = False,
) -> None:
    """Image every frame of DATA as it arrives; faulty frames are refused with a reason, and the stream continues.
    If the voltages look as if electrodes on the edge of a sheet had moved, images show the rest of the difference.

    Writes frames.csv line by line (x, y: centroid in metres of the region around the strongest change; peak change in
    S), and at the end images.npz with `conductivity` (frames, cells), NaN for frames that were refused, `points`,
    `cells` and `background`; frames.png, some frames on one colour scale; and a film. If all frames were refused, the
    exit status is 1. With --method network, the indentation depth of a skin is imaged: frames.csv, depth.npz, depth.png
    and report.json.
    """
    if method == NETWORK_METHOD or model is not None:
        unused_options = {
            "hyperparameter": hyperparameter,
            "steps": steps,
            "memory": memory,
            "contact": contact,
            "num-points": num_points,
            "rate": rate,
            "film": None if film in ("film.gif", "none") else film,
            "as-is": as_is or None,
            "reference-frames": reference_frames,
        }
        if reference is None:
            raise ValueError(f"--reference is needed with --method {NETWORK_METHOD}.")
        setting_values = data if data == "-" else Path(data), reference, format, description
        image_by_network(
            model, setting_values, output, method=method, unused_options=unused_options, quiet=quiet, streamed=True
        )
        return
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, format_with_unit, plain_console, print_written_files
    from jeit.cli.streams import FrameCounter, StreamStopper
    from jeit.data.formats.lines import LineParser, read_lines
    from jeit.data.screening import mask_spikes
    from jeit.imaging.doubts import doubts_of_data
    from jeit.imaging.stream_preparation import StreamSettings, frames_of, image_stream, prepare_imager
    from jeit.inverse import stream as stream_as_is
    from jeit.inverse.nonlinear.solvers import SOLVERS, frame_solvers
    from jeit.report import write_stream
    from jeit.report.series import check_film
    from jeit.report.stream import PICTURES

    if method not in SOLVERS:
        check_method(method, frame_solvers())
    setting_values = {
        "solver": method,
        "max_steps": steps,
        "hyperparameter": None if hyperparameter is None else convert_to_number_if_possible(hyperparameter),
        "memory": memory,
        "contact": contact,
        "num_points": num_points,
        "as_is": as_is,
    }
    with naming_options_in_errors({"solver": "--method", "max_steps": "--steps"}):
        settings = StreamSettings(**{name: value for name, value in setting_values.items() if value is not None})
    film_name = None if film == "none" else film
    with naming_options_in_errors({"film": "--film"}):
        film_names = () if film_name is None else (check_film(film_name),)
    if reference is None and (reference_frames is None or data == "-"):
        raise ValueError(
            "--reference is missing: give a measured file of the undisturbed body"
            + ("." if data == "-" else ", or --reference-frames, the frames of DATA that are of it, such as 0-17.")
        )
    console = plain_console()
    with StreamStopper() as stream_stopper:
        make_folder(output, ("frames.csv", "images.npz", "frames.png", *film_names))
        with Steps(console, quiet=quiet) as step:
            step("read")
            if data == "-":
                reference_measurement = read_file(
                    "--reference", Path(reference or ""), format, description, key=reference_key
                )
                reference_measurement = (
                    reference_measurement
                    if reference_frames is None
                    else reference_of_frames(reference_measurement, reference_frames)
                )
                measurement = reference_measurement
            else:
                array_keys = (key, reference_key)
                measurement, separate_reference = read_pair(
                    Path(data), reference, reference_frames, format, description, array_keys
                )
                reference_measurement = measurement if separate_reference is None else separate_reference
            imager, calibration = prepare_imager(
                reference_measurement, settings, measurement=measurement, progress=step
            )
        if data == "-":
            frames, num_frames = (
                read_lines(getattr(sys.stdin, "buffer", sys.stdin), LineParser(description, reference_measurement)),
                None,
            )
        else:
            measurement = measurement if settings.as_is else mask_spikes(measurement, reference_measurement)
            frames, num_frames = frames_of(measurement), measurement.num_frames
            rate = measurement.frame_rate if rate is None else rate
        notes = (*measurement.notes, *reference_measurement.notes, *([calibration.note] if calibration.note else []))
        for note in () if quiet else dict.fromkeys(notes):
            console.print(f"  note: {note}", soft_wrap=True, markup=False)
        reference_frame = reference_measurement.mean_frame()
        for doubt in () if quiet else doubts_of_data(reference_frame, reference_frame, calibration):
            console.print(f"  doubt: {doubt}", soft_wrap=True, markup=False)
        with naming_options_in_errors({"rate": "--rate"}), Steps(console, quiet=quiet) as step:
            step("image")
            frame_counter = FrameCounter(step, num_frames)

            def show_frame(frame_image) -> None:
                frame_counter.count_frame()
                if frame_image.reason and not quiet:
                    console.print(
                        f"  frame {frame_image.number}: {frame_image.status}. {frame_image.reason}", soft_wrap=True
                    )

            def show_movement(frame_number: int, electrode_change) -> None:
                if not quiet:
                    console.print(
                        f"  doubt: from frame {frame_number} on, {electrode_change.doubt}", soft_wrap=True, markup=False
                    )

            report_drawing = stream_stopper.drawing_reporter(PICTURES, step)
            arriving_frames = stream_stopper.frames_until_signal(frames)
            images = (
                stream_as_is(imager, arriving_frames)
                if settings.as_is
                else image_stream(imager, calibration, arriving_frames, show_movement)
            )
            with stream_stopper.exit_after_signal(frame_counter, "frames.csv", "images.npz"):
                written_stream = write_stream(
                    images,
                    calibration,
                    output,
                    name=data,
                    film=film_name,
                    rate=rate,
                    progress=show_frame,
                    drawing=report_drawing,
                )
    if not written_stream.latency.size:
        raise ValueError(
            f"'{data}': {counted(written_stream.number, 'frame')}, and none could be imaged; the first: "
            f"{written_stream.first_reason}"
        )
    if quiet:
        return
    counts_text = ", ".join(f"{count} {status}" for status, count in sorted(written_stream.counts.items()))
    background = format_with_unit(
        float(calibration.conductivity), "S" if calibration.model.mesh.dimension == 2 else "S/m"
    )
    console.print(f"\n{counted(written_stream.number, 'frame')}: {counts_text}; background {background}")
    median_latency, latency_quantile_99 = 1e3 * np.quantile(written_stream.latency, (0.5, 0.99))
    console.print(f"latency: median {median_latency:.2f} ms, 99 % within {latency_quantile_99:.2f} ms")
    print_written_files(console, output / "frames.csv", "images.npz", "frames.png", *film_names)
