"""`jeit touch gestures` and `jeit touch watch`: learn gestures from recordings, and classify touches as they end."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import AsIsOption, QuietOption, check_positive, make_folder, naming_options_in_errors

SkinOption = Annotated[
    Path,
    typer.Option(metavar="SKIN.toml", help="Geometry, electrodes and protocol of the skin.", show_default=False),
]


def gestures(
    recordings: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDINGS.npz",
            help="n recordings, one after the other: voltages (F, M) and seconds (F,) of all frames; start (n + 1,), "
            "number of the first frame of each recording, and F; gesture (n,) text; person (n,), if more than one; "
            "reference (M,) and untouched (u, M), frames of the untouched skin.",
            show_default=False,
        ),
    ],
    skin: SkinOption,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="MODEL", help="Folder for the learnt gestures.", show_default=False),
    ],
    method: Annotated[
        str | None,
        typer.Option(
            help="logit-boost, linear-discriminant, temporal-network or another classifier; auto (default): the "
            "classifier that is most accurate for held-out people."
        ),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Train a gesture classifier on recordings; prints its accuracy for people who were held out of the training.

    Writes gestures.skops, report.json and gestures.png, the confusion matrix, to the folder MODEL.
    """
    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, name_value_table, plain_console, print_written_files
    from jeit.data import GestureSet, load_description
    from jeit.touch import learn_gestures
    from jeit.touch.reports.touch_watch import GESTURE_FILES, write_gestures

    require_extra("learn", "learning gestures")
    make_folder(output, GESTURE_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        with naming_options_in_errors({"which": "--skin", "description": "--skin"}):
            description = load_description(skin)
        gesture_set = GestureSet.read(recordings)
        show_step("learn")
        learnt = learn_gestures(description, gesture_set, method=method or "auto", progress=show_step.report)
        show_step("write")
        write_gestures(learnt, output, name=recordings.name)
    if quiet:
        return
    gesture_model, standing = learnt.model, learnt.model.standing
    num_people = len(set(gesture_set.person.tolist()))
    table_rows = [("recordings", f"{len(gesture_set)}, of {num_people} {'people' if num_people > 1 else 'person'}")]
    table_rows += [
        ("gestures", ", ".join(gesture_model.names)),
        ("classifier", f"{gesture_model.method} on {gesture_model.form}"),
    ]
    if standing is not None:
        is_correct = standing.held_out == standing.right
        accuracies_text = ", ".join(
            f"{gesture_name} {100 * is_correct[standing.right == gesture_name].mean():.0f}"
            for gesture_name in gesture_model.names
        )
        table_rows.append(("right, held out", f"{100 * is_correct.mean():.1f} % ({accuracies_text})"))
    table_rows += [("note", note) for note in gesture_model.notes]
    console.print()
    console.print(name_value_table(f"Learnt from {recordings.name}", table_rows))
    print_written_files(console, output / "gestures.skops", "report.json", "gestures.png")


def watch(
    stream: Annotated[
        str,
        typer.Argument(
            help="File of frames (.npz with frames and seconds, or a table), or - for standard input: one frame in "
            "each line, its voltages separated by spaces or commas (nan: no reading).",
            show_default=False,
        ),
    ],
    skin: SkinOption,
    gestures: Annotated[
        Path,
        typer.Option(
            metavar="MODEL", help="Folder that 'jeit touch gestures' wrote, or the file in it.", show_default=False
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for events.csv and timeline.png.", show_default=False)
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            help="File of frames of the untouched skin; by default the reference in the stream's file, or the first "
            "frames of the stream."
        ),
    ] = None,
    untouched: Annotated[
        float, typer.Option(help="Seconds at the start of the stream in which nobody touches the skin.")
    ] = 1.0,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames per second, if the stream has no times; by default that of the training recordings. Frames "
            "from standard input are timed by the clock."
        ),
    ] = None,
    patience: Annotated[
        float, typer.Option(help="Seconds after which a lasting touch becomes part of the reference.")
    ] = 30.0,
    quiet: QuietOption = False,
    as_is: AsIsOption = False,
) -> None:
    """Name the gestures of touches as they end: when, where, which gesture, and how probable it is.

    Writes events.csv and paths.csv line by line, and at the end report.json and timeline.png. With standard input, a
    line is printed with the first frame after a touch; if the touch continues within 100 ms, its gesture is named anew.
    Ctrl-C and SIGTERM end the command, and all files are written.
    """
    from dataclasses import replace

    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, plain_console
    from jeit.cli.streams import LiveFrames, StreamStopper
    from jeit.data import load_description, read_frame_recording
    from jeit.imaging.stream_preparation import parse_frames
    from jeit.touch import GestureModel, TouchImages, TouchWatch
    from jeit.touch.gestures.touch_images import TOUCH_IMAGES
    from jeit.touch.reports.touch_watch import WATCH_FILES, write_watch

    require_extra("learn", "naming gestures")
    check_positive({"--untouched": untouched, "--patience": patience} | ({} if rate is None else {"--rate": rate}))
    console = plain_console()
    with StreamStopper() as stream_stopper:
        make_folder(output, WATCH_FILES)
        with Steps(console, quiet=quiet) as show_step:
            show_step("read")
            with naming_options_in_errors({"description": "--skin"}):
                description = load_description(skin)
            gesture_model = GestureModel.read(gestures)
            untouched_frames = None if reference is None else read_frame_recording(reference, description).frames
            default_rate = 60.0 if gesture_model.reading is None else gesture_model.reading.rate
            live_frames = None
            if stream == "-":
                live_frames = LiveFrames(parse_frames(sys.stdin), rate, default_rate)
                if untouched_frames is None:
                    show_step(f"untouched, for {untouched:g} s")
                    untouched_frames = live_frames.initial_frames(untouched)
                frames, frame_rate = live_frames, live_frames.measured_rate
            else:
                frames, untouched_frames, frame_rate = _read_recording(
                    Path(stream), description, untouched_frames, untouched, rate or default_rate
                )
            show_step("prepare")
            touch_images = TouchImages.prepare(
                description, untouched_frames, replace(TOUCH_IMAGES, as_is=as_is), progress=show_step.report
            )
            touch_watch = TouchWatch.create(
                touch_images, gesture_model, untouched_frames, rate=frame_rate, patience=patience
            )
        for note in () if quiet else touch_watch.notes:
            console.print(f"  note: {note}", soft_wrap=True)

        if live_frames is not None and not quiet:
            console.print("  ready: the skin may be touched")

        def show_frame(frame) -> None:
            if frame.note and not quiet:
                console.print(f"  note: {frame.note}", soft_wrap=True)
            # In a live stream, a touch is printed once it is classified; in a file, once it has ended, with its final
            # prediction.
            finished_touches = frame.ended if stream != "-" else () if frame.named is None else (frame.named,)
            for touch in () if quiet else finished_touches:
                console.print(_describe_touch(touch))

        written_watch = write_watch(
            touch_watch.follow(stream_stopper.frames_until_signal(frames)),
            touch_watch,
            output,
            name=stream,
            progress=show_frame,
        )
    if not quiet:
        _print_summary(console, written_watch, live_frames, output)
    if stream_stopper.signal == signal.SIGTERM:
        raise typer.Exit(128 + signal.SIGTERM)


def _print_summary(console, written_watch, live_frames, output: Path) -> None:
    """Print a summary of the classified touches, the delays and the refused frames of a stream."""
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import print_written_files

    frame_counts = ", ".join(
        f"{frame_count} {frame_status}" for frame_status, frame_count in sorted(written_watch.counts.items())
    )
    num_unlike_touches = sum(touch.unlike for touch in written_watch.touches)
    console.print(f"\n{counted(len(written_watch.seconds), 'frame')}: {frame_counts}")
    console.print(
        f"{counted(len(written_watch.touches), 'touch')}, {num_unlike_touches} of them unlike any learnt from"
    )
    if written_watch.latency.size:
        median_latency, high_latency = 1e3 * np.quantile(written_watch.latency, (0.5, 0.99))
        console.print(
            f"named within {median_latency:.1f} ms of the frame after (median), 99 % within {high_latency:.1f} ms"
        )
    if live_frames is not None and live_frames.left_out:
        console.print(f"{counted(live_frames.left_out, 'frame')} left out that had come before they could be read")
    if written_watch.first_reason:
        console.print(f"first refusal: {written_watch.first_reason}", soft_wrap=True)
    print_written_files(console, output / "events.csv", "paths.csv", "report.json", "timeline.png")


def _read_recording(
    recording_path: Path, description, untouched_voltages, untouched_duration: float, frame_rate: float
):
    """Read a recording: return its frames with their times, the frames of the untouched skin, and the frame rate."""
    import numpy as np

    from jeit.data import read_frame_recording
    from jeit.touch import untouched_frames

    recording = read_frame_recording(recording_path, description)
    frame_times = recording.seconds
    if frame_times is None:
        frame_times = np.arange(len(recording.frames)) / frame_rate
    elif len(frame_times) > 1 and np.median(np.diff(frame_times)) > 0:
        frame_rate = 1 / float(np.median(np.diff(frame_times)))
    if untouched_voltages is None:
        with naming_options_in_errors({"untouched": "--untouched"}):
            untouched_voltages = untouched_frames(recording, frame_times, untouched_duration)
    return zip(frame_times.tolist(), recording.frames, strict=True), untouched_voltages, frame_rate


def _describe_touch(touch) -> str:
    time_course = touch.touch.course
    x, y = 1e3 * time_course.centroid[int(time_course.peak.argmax())]
    gesture_text = "unlike any" if touch.unlike else f"{touch.gesture:<12}{100 * touch.probability:3.0f} %"
    gesture_text += ", held" if touch.held else ", cut off" if touch.touch.cut_off else ""
    touch_duration = touch.touch.offset - touch.touch.onset
    return f"  {touch.touch.onset:8.2f} s  {touch_duration:5.2f} s  {gesture_text:<18} ({x:+.0f}, {y:+.0f}) mm"
