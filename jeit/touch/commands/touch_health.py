"""`jeit touch health`: monitor a skin for damage: cuts, electrodes that fail, repair."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import QuietOption, check_positive, make_folder, naming_options_in_errors

# Number of frames processed between two progress messages.
_FRAMES_PER_MESSAGE = 500


def health(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Recording of the skin to be checked: .npz with frames (F, M) and seconds (F,), or a table of frames.",
            show_default=False,
        ),
    ],
    healthy: Annotated[
        Path,
        typer.Option(
            help="Recording of the same skin while it was healthy, preferably with touches.", show_default=False
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for events.csv and health.png.", show_default=False)
    ],
    skin: Annotated[
        Path | None,
        typer.Option(
            metavar="SKIN.toml",
            help="Description of the skin: with a protocol, failing electrodes are identified; with geometry and "
            "electrodes too, cuts are located and drawn.",
        ),
    ] = None,
    lowers: Annotated[
        bool, typer.Option("--lowers", help="A touch lowers conductivity, as on hydrogel (default: it raises it).")
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames per second, if the recordings have no times; without it, times are numbers of frames."
        ),
    ] = None,
    patience: Annotated[
        float | None,
        typer.Option(
            help="Time that no touch lasts, in seconds, or in frames if there are no times (default 30 s, or three "
            "windows)."
        ),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Detect cuts, failing electrodes and repairs by comparing a recording with a recording of the healthy skin.

    Writes events.csv, report.json and health.png. The skin may have any number of channels, in any unit.
    """
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.data import load_description, read_frame_recording
    from jeit.touch import doubts_of, learn_health, watch
    from jeit.touch.health.health_learning import seconds_of
    from jeit.touch.reports.skin_health import HEALTH_FILES, write_health

    check_positive(
        {
            option_name: option_value
            for option_name, option_value in {"--rate": rate, "--patience": patience}.items()
            if option_value is not None
        }
    )
    make_folder(output, HEALTH_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        with naming_options_in_errors({"description": "--skin"}):
            description = None if skin is None else load_description(skin)
        healthy_recording, checked_recording = (
            read_frame_recording(recording_path, description) for recording_path in (healthy, recording)
        )
        if checked_recording.frames.shape[1] != healthy_recording.frames.shape[1]:
            raise ValueError(
                f"'{recording}' has {checked_recording.frames.shape[1]} channels, and '{healthy}' "
                f"{healthy_recording.frames.shape[1]}: give both of one skin."
            )
        if (checked_recording.seconds is None) != (healthy_recording.seconds is None) and rate is None:
            raise ValueError("--rate: only one of the recordings says when its frames came; give the frames a second.")
        show_step("learn")
        healthy_state = learn_health(
            healthy_recording,
            description,
            sign=-1 if lowers else 1,
            rate=rate,
            patience=patience,
            progress=show_step.report,
        )
        show_step("watch")
        recorded_times = seconds_of(checked_recording, rate)
        frame_times = (
            np.arange(len(checked_recording.frames), dtype=float) if recorded_times is None else recorded_times
        )
        with naming_options_in_errors({"frames": f"'{recording}'"}):
            doubt_texts = doubts_of(healthy_state, healthy_recording, checked_recording.frames)
        skin_state = healthy_state
        for first_frame in range(0, len(frame_times), _FRAMES_PER_MESSAGE):
            show_step.report(f"{first_frame:,} of {counted(len(frame_times), 'frame')}")
            skin_state = watch(
                skin_state,
                checked_recording.frames[first_frame : first_frame + _FRAMES_PER_MESSAGE],
                frame_times[first_frame : first_frame + _FRAMES_PER_MESSAGE],
            )
        show_step("write")
        write_health(
            skin_state,
            frame_times,
            checked_recording.frames,
            output,
            name=recording.name,
            timed=recorded_times is not None,
            notes=doubt_texts,
        )
    if quiet:
        return
    time_unit = "frame" if recorded_times is None else "s"
    console.print(f"\n{counted(skin_state.frames, 'frame')}: {counted(len(skin_state.events), 'event')}")
    for doubt_text in doubt_texts:
        console.print(f"  note: {doubt_text}", soft_wrap=True)
    for event in skin_state.events:
        electrode_text = "" if event.electrode is None else f" {event.electrode + 1}"
        length_text = "" if event.path is None else f", {1e3 * event.length:.0f} ± {1e3 * event.deviation:.0f} mm long"
        time_text = f"{time_unit} {event.time:.0f}" if recorded_times is None else f"{event.time:.2f} s"
        console.print(
            f"  {time_text}: {event.kind}{electrode_text}{length_text}, {event.status}. {event.reason}", soft_wrap=True
        )
    if (held_event := skin_state.held) is not None:
        console.print(f"  held at the end: {held_event.reason}", soft_wrap=True)
    print_written_files(console, output / "events.csv", "report.json", "health.png")
