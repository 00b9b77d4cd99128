"""Write a trained gesture classifier, the classified touches of a stream, or the contacts of a recording to folders."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted
from jeit.report.folder import package_version, results, results_folder, to_plain_values, write_json, write_rows
from jeit.report.stream import GrowingTable
from jeit.touch import LearntGestures, NamedTouch, RecordedContacts, TouchImages, TouchWatch, WatchedFrame
from jeit.touch.gestures.gesture_model import GESTURE_FILE

GESTURE_FILES = (GESTURE_FILE, "report.json", "gestures.png")
_LEARNING_PACKAGES = ("jeit", "numpy", "scikit-learn", "skops")


def write_gestures(learnt: LearntGestures, folder: str | Path, *, name: str = "recordings") -> None:
    """Write a trained gesture classifier, its accuracy and its confusion matrix into `folder`, created if needed.

    The files are `gestures.skops`, `report.json` and `gestures.png`. `name`: name of the recordings. Raises
    `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, GESTURE_FILES) as result_folder:
        learnt.model.write(result_folder / GESTURE_FILE)
        write_json(report_gestures(learnt, name), result_folder / "report.json")
        draw_gestures(learnt).savefig(result_folder / "gestures.png", dpi=150)


def report_gestures(learnt: LearntGestures, name: str) -> dict[str, Any]:
    """Report how accurate a gesture classifier is, as plain numbers, strings, lists and dictionaries."""
    model, standing = learnt.model, learnt.model.standing
    gesture_report: dict[str, Any] = {
        "recordings": name,
        "gestures": list(model.names),
        "classifier": f"{model.method} on {model.form}",
        "reading": None if model.reading is None else vars(model.reading),
        "recordings_without_a_touch": list(learnt.without_touch),
        "notes": list(model.notes),
        "units": {"level": "S", "rate": "1/s"},
        "versions": {package_name: package_version(package_name) for package_name in _LEARNING_PACKAGES},
    }
    if standing is not None:
        is_right = standing.held_out == standing.right
        gesture_report["held_out"] = {
            "touches": len(standing.right),
            "right": is_right.mean(),
            "right_by_gesture": {name: is_right[standing.right == name].mean() for name in model.names},
            "tried": [{"classifier": name, "right": 1 - error_rate} for name, error_rate in standing.tried],
        }
    return to_plain_values(gesture_report)


def draw_gestures(learnt: LearntGestures):
    """Draw a gesture classifier's confusion matrix, and the accuracy of all classifiers tried, as a `Figure`."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_confusion, plot_tried

    standing = learnt.model.standing
    figure = Figure(figsize=(12.0, 5.4), layout="constrained")
    if standing is not None:
        left_axes, right_axes = figure.subplots(1, 2)
        percentage_right = 100 * np.mean(standing.held_out == standing.right)
        plot_confusion(standing, title=f"Gestures: {percentage_right:.1f} % right of touches held out", ax=left_axes)
        plot_tried(standing, ax=right_axes)
    return figure


WATCH_FILES = ("events.csv", "paths.csv", "report.json", "timeline.png")
_WATCH_PACKAGES = ("jeit", "jax", "numpy", "scikit-learn")
_EVENT_COLUMNS = (
    "touch", "onset_s", "offset_s", "gesture", "probability", "unlike", "x_m", "y_m", "path_length_m",
    "displacement_m", "peak_S", "area_m2", "begun_before", "cut_off", "held", "lost_frames", "longest_gap_s", "named_s",
    "latency_ms",
)  # fmt: skip
_PATH_COLUMNS = ("touch", "time_s", "x_m", "y_m", "peak_S")


@dataclass(frozen=True)
class WrittenWatch:
    """Summary of the touches that `write_watch` has written.

    **Fields**: `touches`: detected touches; `seconds`, `peaks` (F,): time, seconds, and maximum change, S, of each of F
    frames; `latency` (K,): seconds from a frame to its result, for the K frames at which a touch was classified;
    `counts`: number of frames by status; `first_reason`: why the first refused frame was refused, empty if none was;
    `notes`: remarks on the frames.
    """

    touches: tuple[NamedTouch, ...]
    seconds: Float[np.ndarray, " F"]
    peaks: Float[np.ndarray, " F"]
    latency: Float[np.ndarray, " K"]
    counts: dict[str, int]
    first_reason: str = ""
    notes: tuple[str, ...] = ()


def write_watch(
    watched: Iterable[WatchedFrame],
    watch: TouchWatch,
    folder: str | Path,
    *,
    name: str = "stream",
    progress: Callable[[WatchedFrame], None] | None = None,
) -> WrittenWatch:
    """Write the classified touches of a stream into `folder`, as they end, and finally a report and a picture.

    `events.csv` gets a line for every touch as the touch ends; `paths.csv` gets the position of the touch in each of
    its frames. `report.json` and `timeline.png` follow at the end. A touch unlike all touches of the training set has
    no gesture.

    `watched`: the results that `watch.follow(frames)` yields. Positions are in metres, changes in S; `named_s` is the
    time in the stream at which a touch was classified, `latency_ms` the delay of the prediction after the last frame.
    `progress` is called with every result. Raises `ValueError`, with the `name` of the stream, if there was no frame,
    and if `folder` cannot be a folder.
    """
    folder = results_folder(folder, WATCH_FILES)
    for file_name in WATCH_FILES[2:]:
        (folder / file_name).unlink(missing_ok=True)  # files of earlier touches
    touches: list[NamedTouch] = []
    frame_times, frame_peaks, gesture_latencies, status_counts, first_refusal_reason, frame_notes = (
        [],
        [],
        [],
        {},
        "",
        [],
    )
    with (
        GrowingTable(folder / "events.csv", _EVENT_COLUMNS) as event_table,
        GrowingTable(folder / "paths.csv", _PATH_COLUMNS) as path_table,
    ):
        for frame in watched:
            for touch in frame.ended:
                touches.append(touch)
                event_table.write(_event_row(touch))
                for path_row in _path_rows(touch):
                    path_table.write(path_row)
            if frame.image is not None:
                frame_times.append(frame.second)
                frame_peaks.append(frame.peak)
                status_counts[str(frame.image.status)] = status_counts.get(str(frame.image.status), 0) + 1
                first_refusal_reason = first_refusal_reason or ("" if frame.image.imaged else frame.image.reason)
            gesture_latencies += [frame.latency] if frame.named is not None else []
            frame_notes += [frame.note] if frame.note else []
            if progress is not None:
                progress(frame)
    if not frame_times:
        raise ValueError(f"'{name}': there was no frame in it.")
    written_watch = WrittenWatch(
        touches=tuple(touches),
        seconds=np.array(frame_times),
        peaks=np.array(frame_peaks),
        latency=np.array(gesture_latencies),
        counts=status_counts,
        first_reason=first_refusal_reason,
        notes=tuple(frame_notes),
    )
    with results(folder, WATCH_FILES[2:]) as result_folder:
        write_json(report_watch(written_watch, watch, name), result_folder / "report.json")
        draw_watch(written_watch, watch).savefig(result_folder / "timeline.png", dpi=130)
    return written_watch


def report_watch(written_watch: WrittenWatch, watch: TouchWatch, name: str) -> dict[str, Any]:
    """Report classified touches as plain numbers, strings, lists and dictionaries; unknown values are None."""
    gesture_names, gesture_counts = np.unique(
        [touch.gesture for touch in written_watch.touches if not touch.unlike], return_counts=True
    )
    gesture_latencies = written_watch.latency
    return to_plain_values(
        {
            "stream": name,
            "frames": len(written_watch.seconds),
            "duration_s": written_watch.seconds[-1] - written_watch.seconds[0],
            "status": written_watch.counts,
            "first_refusal": written_watch.first_reason or None,
            "touches": len(written_watch.touches),
            "gestures": dict(zip(gesture_names.tolist(), gesture_counts.tolist(), strict=True)),
            "unlike_any_learnt": sum(touch.unlike for touch in written_watch.touches),
            "cut_off": sum(not touch.touch.whole for touch in written_watch.touches),
            "held": sum(touch.held for touch in written_watch.touches),
            "gestures_known": list(watch.model.names),
            "classifier": f"{watch.model.method} on {watch.model.form}",
            "level_S": watch.level.level,
            "gap_s": watch.gap,
            "patience_s": watch.patience,
            "named_within_s": {
                "median": np.median(gesture_latencies),
                "99_percent": np.quantile(gesture_latencies, 0.99),
            }
            if gesture_latencies.size
            else None,
            "background_S": watch.images.background,
            "notes": [*watch.notes, *written_watch.notes, *watch.model.notes, *watch.images.reference.notes],
            "units": {"length": "m", "time": "s", "change": "S"},
            "versions": {package_name: package_version(package_name) for package_name in _WATCH_PACKAGES},
        }
    )


def draw_watch(written_watch: WrittenWatch, watch: TouchWatch):
    """Draw the classified touches of a stream over time, and their paths, as a `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_changes, plot_timeline, plot_touch_paths

    gesture_names = watch.model.names
    figure = Figure(figsize=(13.0, 2.6 + 0.42 * max(len(gesture_names), 5)), layout="constrained")
    axes_grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1), height_ratios=(1, 1.25))
    upper_axes = figure.add_subplot(axes_grid[0, 0])
    lower_axes = figure.add_subplot(axes_grid[1, 0], sharex=upper_axes)
    num_refused = int(np.isnan(written_watch.peaks).sum())
    stream_duration = written_watch.seconds[-1] - written_watch.seconds[0]
    stream_title = f"{counted(len(written_watch.touches), 'touch')} in {stream_duration:.4g} s"
    stream_title += f"; {counted(num_refused, 'frame')} refused" if num_refused else ""
    plot_changes(written_watch.seconds, written_watch.peaks, watch.level.level, title=stream_title, ax=upper_axes)
    plot_timeline(list(written_watch.touches), gesture_names, ax=lower_axes)
    upper_axes.set_xlim(*_time_range(written_watch.seconds))
    upper_axes.tick_params(labelbottom=False)
    forward_model = watch.images.calibration.model
    plot_touch_paths(
        forward_model.mesh,
        list(written_watch.touches),
        gesture_names,
        forward_model.electrodes,
        title="Where they went, from the dots on",
        ax=figure.add_subplot(axes_grid[:, 1]),
    )
    return figure


def _time_range(frame_times: np.ndarray) -> tuple[float, float]:
    """Return the times of the first and the last frame, seconds, at least 1 ms apart."""
    return float(frame_times[0]), max(float(frame_times[-1]), float(frame_times[0]) + 1e-3)


def _event_row(touch: NamedTouch) -> list[object]:
    """Create the row of the table `events.csv` for a touch."""
    time_course = touch.touch.course
    peak_frame = int(time_course.peak.argmax())
    touch_centroids = time_course.centroid[np.isfinite(time_course.centroid).all(axis=1)]
    path_length = float(np.linalg.norm(np.diff(touch_centroids, axis=0), axis=1).sum())
    return [
        touch.number,
        f"{touch.touch.onset:.4f}",
        f"{touch.touch.offset:.4f}",
        "" if touch.unlike else touch.gesture,
        f"{touch.probability:.4f}",
        int(touch.unlike),
        *(f"{coordinate:.5f}" for coordinate in time_course.centroid[peak_frame]),
        f"{path_length:.5f}",
        f"{np.linalg.norm(touch_centroids[-1] - touch_centroids[0]):.5f}",
        f"{time_course.peak[peak_frame]:.6g}",
        f"{time_course.area[peak_frame]:.6g}",
        int(touch.touch.begun_before),
        int(touch.touch.cut_off),
        int(touch.held),
        touch.touch.lost,
        f"{touch.touch.longest_gap:.4f}",
        f"{touch.named:.4f}",
        f"{1e3 * touch.latency:.3f}",
    ]


def _path_rows(touch: NamedTouch) -> list[list[object]]:
    """Create the rows of the table `paths.csv` for a touch, one for each frame of the touch."""
    time_course = touch.touch.course
    return [
        [
            touch.number,
            f"{frame_time:.4f}",
            *(f"{coordinate:.5f}" if np.isfinite(coordinate) else "" for coordinate in frame_centroid),
            f"{frame_peak:.6g}",
        ]
        for frame_time, frame_centroid, frame_peak in zip(
            time_course.seconds, time_course.centroid, time_course.peak, strict=True
        )
    ]


CONTACT_FILES = ("contacts.csv", "report.json", "contacts.png")
_CONTACT_COLUMNS = ("frame", "time_s", "touch", "x_m", "y_m", "deviation_m", "area_m2", "peak_S")
# Maximum number of paths that have a number in the picture.
_MAX_NUMBERED_TOUCHES = 20


def write_contacts(recorded_contacts: RecordedContacts, images: TouchImages, folder: str | Path, *, name: str) -> None:
    """Write the contacts of a recording into `folder`, which is created if needed: a table, a report and a picture.

    The files are `contacts.csv`, `report.json` and `contacts.png`. `name`: name of the recording. Raises `ValueError`
    if `folder` cannot be a folder.
    """
    table_rows = (
        [
            frame_number,
            f"{recorded_contacts.seconds[frame_number]:.6g}",
            recorded_contacts.number_of(frame_number, contact),
        ]
        + [f"{metres:.6f}" for metres in (*contact.centroid, contact.deviation)]
        + [f"{contact.area:.4g}", f"{contact.peak:.4g}"]
        for frame_number, contacts in enumerate(recorded_contacts.contacts)
        for contact in contacts
    )
    with results(folder, CONTACT_FILES) as temporary_folder:
        write_rows(temporary_folder / "contacts.csv", _CONTACT_COLUMNS, table_rows)
        write_json(_report_contacts(recorded_contacts, images, name), temporary_folder / "report.json")
        _draw_contacts(recorded_contacts, images).savefig(temporary_folder / "contacts.png", dpi=130)


def _report_contacts(recorded_contacts: RecordedContacts, images: TouchImages, recording_name: str) -> dict[str, Any]:
    return to_plain_values(
        {
            "recording": recording_name,
            "frames": len(recorded_contacts.seconds),
            "background": images.background,
            "touches": [
                {
                    "touch": touch_path.number,
                    "onset": touch_path.onset,
                    "offset": touch_path.offset,
                    "frames": len(touch_path.times),
                    "first_position": touch_path.position[0],
                    "last_position": touch_path.position[-1],
                    "mean_position": touch_path.position.mean(axis=0),
                    "path_length": touch_path.length,
                    "peak": touch_path.peak[np.abs(touch_path.peak).argmax()],
                }
                for touch_path in recorded_contacts.touches
            ],
            "notes": list(recorded_contacts.notes),
            "units": {"onset": "s", "position": "m", "path_length": "m", "peak": "S", "background": "S"},
            "versions": {package_name: package_version(package_name) for package_name in _WATCH_PACKAGES[:3]},
        }
    )


def _draw_contacts(recorded_contacts: RecordedContacts, images: TouchImages):
    """Draw the image of the frame with the strongest contacts, and the paths of all touches, as a `Figure`."""
    from matplotlib.figure import Figure

    from jeit.plot.axes import draw_scale_bar, extent_of, hide_axes
    from jeit.plot.imaging.electrodes import draw_electrodes
    from jeit.plot.imaging.image import draw_outline
    from jeit.touch.plots import plot_contacts

    electrodes, extent = images.calibration.model.electrodes, extent_of(np.asarray(images.mesh.points))
    figure = Figure(figsize=(12.0, 5.4), layout="constrained")
    image_axes, path_axes = figure.subplots(1, 2)
    frame_strengths = [sum(abs(contact.integral) for contact in contacts) for contacts in recorded_contacts.contacts]
    strongest_frame = int(np.argmax(frame_strengths))
    frame_title = f"Frame {strongest_frame}, {recorded_contacts.seconds[strongest_frame]:.2f} s"
    plot_contacts(
        images.mesh,
        np.nan_to_num(recorded_contacts.changes[strongest_frame]),
        recorded_contacts.contacts[strongest_frame],
        electrodes,
        title=frame_title,
        ax=image_axes,
    )
    draw_outline(images.mesh, path_axes)
    draw_electrodes(images.mesh, electrodes, numbers=False, ax=path_axes)
    for touch_path in recorded_contacts.touches:
        (path_line,) = path_axes.plot(*touch_path.position.T, linewidth=1.6)
        path_axes.plot(*touch_path.position[0], marker="o", markersize=5, color=path_line.get_color())
        if len(recorded_contacts.touches) <= _MAX_NUMBERED_TOUCHES:
            path_axes.annotate(
                str(touch_path.number), touch_path.position[0], (5, 3), textcoords="offset points", fontsize=9
            )
    hide_axes(path_axes, extent)
    draw_scale_bar(path_axes, extent)
    path_axes.set_title(f"Paths of {counted(len(recorded_contacts.touches), 'touch')}, from their dots")
    return figure
