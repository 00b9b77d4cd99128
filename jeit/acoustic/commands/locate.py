"""`jeit locate`: positions and times of the touches in a recording of a calibrated array of microphones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.acoustic.commands.calibrate_microphones import (
    HighestFrequencyOption,
    HopOption,
    LowestFrequencyOption,
    WindowOption,
    intensity_settings,
)
from jeit.cli.options import QuietOption, make_folder, naming_options_in_errors, with_option_names

if TYPE_CHECKING:
    from jeit.acoustic import LocatedTouches, Recording

_OPTION_NAMES = {"intensity": "--low, --high, --window and --hop"}
# Length of the path of a touch above which its start and end are printed instead of its mean position.
_MIN_STROKE_PATH_LENGTH = 0.015  # m


def locate(
    recording: Annotated[
        Path,
        typer.Argument(
            help="NPZ file with samples (M, S) and rate in hertz, or intensity (F, M) and times (F,) in seconds; or a "
            "WAV file with a channel for each microphone.",
            show_default=False,
        ),
    ],
    calibration: Annotated[
        Path,
        typer.Option("--calibration", "-c", help="File that 'jeit calibrate-microphones' wrote.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for track.csv, report.json, track.png.", show_default=False)
    ],
    method: Annotated[
        str,
        typer.Option(
            help="likelihood: maximum likelihood; consistency: the loss of Park 2022 on a 200 × 200 map, refined."
        ),
    ] = "likelihood",
    gap: Annotated[float, typer.Option(help="Time without a position after which a touch has ended, seconds.")] = 0.15,
    silence: Annotated[
        Path | None,
        typer.Option(
            help="Recording of the untouched array, samples or WAV, from which the noise floor is estimated; needed if "
            "touches never pause.",
            show_default=False,
        ),
    ] = None,
    gain_drift: Annotated[
        float,
        typer.Option(
            help="Standard deviation of the changes of the microphones' gains since the calibration, as a fraction of "
            "the intensities; 0 if they have not changed."
        ),
    ] = 0.1,
    low: LowestFrequencyOption = None,
    high: HighestFrequencyOption = None,
    window: WindowOption = None,
    hop: HopOption = None,
    quiet: QuietOption = False,
) -> None:
    """Locate every touch of a recording; writes track.csv, report.json and track.png."""
    from jeit.acoustic import Calibration, locate_touches, read_recording
    from jeit.acoustic.localisation.localiser import METHODS
    from jeit.acoustic.reports import write_track
    from jeit.arguments import check_name
    from jeit.cli.console import Steps, plain_console, print_written_files

    check_name("--method", method, METHODS)
    if not 0 < gap < float("inf"):
        raise ValueError(f"--gap must be positive, in seconds; it is {gap}.")
    if not 0 <= gain_drift < float("inf"):
        raise ValueError(f"--gain-drift must be zero or positive, as a fraction; it is {gain_drift}.")
    intensity_options = intensity_settings(low, high, window, hop)
    make_folder(output, ("track.csv", "report.json", "track.png"))
    console = plain_console()
    with Steps(console, quiet=quiet) as progress_steps, naming_options_in_errors(_OPTION_NAMES):
        progress_steps("read")
        loaded_calibration = Calibration.load(calibration)
        loaded_recording = read_recording(recording)
        silence_recording = None if silence is None else _read_silence(silence, loaded_recording)
        location_options = {
            "method": method,
            "gap": gap,
            "intensity": intensity_options,
            "silence": silence_recording,
            "gain_drift": gain_drift,
        }
        located_touches = locate_touches(
            loaded_recording, loaded_calibration, **location_options, progress=progress_steps
        )
        progress_steps("write")
        write_track(located_touches, output)
    if not quiet:
        _print_summary(console, located_touches)
        print_written_files(console, output / "track.csv", "report.json", "track.png")


def _read_silence(silence_path: Path, touch_recording) -> "Recording":
    from jeit.acoustic import Recording, read_recording

    silence_recording = read_recording(silence_path)
    if not (isinstance(touch_recording, Recording) and isinstance(silence_recording, Recording)):
        raise ValueError(
            "--silence applies to recordings of samples, and must contain samples; recordings of intensities "
            "have their floor."
        )
    return silence_recording


def _print_summary(console, located_touches: "LocatedTouches") -> None:
    from rich.table import Table

    from jeit.acoustic.signal.faults import describe_faults
    from jeit.cli.console import name_value_table

    locations = located_touches.locations
    counts_text = ", ".join(f"{num_frames} {status}" for status, num_frames in locations.counts().items())
    table_rows = [
        ("frames", f"{len(locations.times)}: {counts_text}"),
        ("touches", str(len(located_touches.track.touches))),
    ]
    table_rows += [("faults", describe_faults(locations.faults))] * any(locations.faults)
    table_rows += [
        ("note", with_option_names(warning_note, {"silence": "--silence"})) for warning_note in locations.notes
    ]
    console.print()
    console.print(name_value_table(locations.name, table_rows))
    if located_touches.track.touches:
        console.print()
        column_titles = ("touch", "from / s", "to / s", "x / mm", "y / mm", "± / mm", "path / mm")
        touch_table = Table(*column_titles, box=None, padding=(0, 1, 0, 0))
        for table_column in touch_table.columns:
            table_column.justify, table_column.no_wrap = "right", True
        touch_table.add_column("frames", justify="right")
        for table_row in _table_rows(located_touches):
            touch_table.add_row(*table_row)
        console.print(touch_table)
    console.print()


def _table_rows(located_touches: "LocatedTouches") -> Iterator[tuple[str, ...]]:
    """Yield a row of the printed table for each touch, and another row for the second of two simultaneous touches."""
    import numpy as np

    from jeit.acoustic.localisation.locations import LocationStatus

    locations, track = located_touches.locations, located_touches.track
    for touch_number, touch in enumerate(track.touches, 1):
        frame_slice = slice(touch.first, touch.last + 1)
        positions_mm = 1e3 * track.position[frame_slice, :2]
        error_mm = 1e3 * float(np.median(np.sqrt(np.linalg.eigvalsh(track.covariance[frame_slice])[:, -1])))
        if touch.length > _MIN_STROKE_PATH_LENGTH:
            position_cells = [
                f"{coordinate_values[0]:z.1f} → {coordinate_values[-1]:z.1f}" for coordinate_values in positions_mm.T
            ]
        else:
            position_cells = [f"{coordinate_values.mean():z.1f}" for coordinate_values in positions_mm.T]
        frame_statuses = [
            frame_status for frame_status in locations.status[frame_slice] if frame_status != LocationStatus.NO_TOUCH
        ]
        counts_text = ", ".join(
            f"{frame_statuses.count(frame_status)} {frame_status}" for frame_status in dict.fromkeys(frame_statuses)
        )
        time_cells = (f"{touch.onset:.3f}", f"{touch.offset:.3f}")
        yield (
            str(touch_number),
            *time_cells,
            *position_cells,
            f"{error_mm:.1f}",
            f"{1e3 * touch.length:.0f}",
            counts_text,
        )
        two_touch_frames = touch.first + np.flatnonzero(locations.status[frame_slice] == LocationStatus.TWO_TOUCHES)
        if two_touch_frames.size:
            # Which of two touches is the stronger may change from frame to frame. The second touch is the touch farther
            # from the track.
            pair_positions = np.stack([locations.position[two_touch_frames], locations.second[two_touch_frames]])
            distances_from_track = np.linalg.norm(pair_positions - track.position[two_touch_frames], axis=-1)
            second_touch_position = 1e3 * pair_positions[
                distances_from_track.argmax(axis=0), np.arange(two_touch_frames.size), :2
            ].mean(axis=0)
            time_cells = (f"{locations.times[two_touch_frames[0]]:.3f}", f"{locations.times[two_touch_frames[-1]]:.3f}")
            pair_count = f"{two_touch_frames.size} {LocationStatus.TWO_TOUCHES}"
            yield (
                f"{touch_number}, other",
                *time_cells,
                *(f"{coordinate_values:z.1f}" for coordinate_values in second_touch_position),
                "",
                "",
                pair_count,
            )
