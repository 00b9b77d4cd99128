"""Write a sound classifier, and the sounds that it classifies in a recording, to folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jeit.report.folder import package_version, results, to_plain_values, write_json, write_rows
from jeit.touch.listening import Listener, SoundLabels
from jeit.touch.listening.feature_images import WINDOW_DURATION, WINDOW_INTERVAL

LISTENER_FILES = ("listener.jeit", "report.json", "learning.png")
SOUND_LABEL_FILES = ("events.csv", "report.json", "timeline.png")
_REPORTED_PACKAGES = ("jeit", "jax", "numpy", "scipy", "scikit-learn")


def write_listener(listener: Listener, folder: str | Path) -> None:
    """Write a trained sound classifier, a report of its accuracy and its confusion matrix into a folder.

    The files are `listener.jeit`, `report.json` and `learning.png`.

    **Arguments:**

    - `listener`: the trained classifier.
    - `folder`: the folder, which is created if needed.

    Raises `ValueError` if `folder` cannot be a folder.

    **Example:**

    ```python
    write_listener(listener, "listener")
    listener = Listener.read("listener")
    ```
    """
    with results(folder, LISTENER_FILES) as result_folder:
        listener.write(result_folder / "listener.jeit")
        write_json(report_listener(listener), result_folder / "report.json")
        draw_listener(listener).savefig(result_folder / "learning.png", dpi=150)


def write_sound_labels(labels: SoundLabels, folder: str | Path, *, model: str) -> None:
    """Write the classified sounds of a recording into a folder: `events.csv`, `report.json` and `timeline.png`.

    The table `events.csv` has a line for each window, every 0.1 s: `time_s`, the middle of the window; `sound`, the
    most probable class, empty if the window is quiet; `probability`, the probability of this class, and `p_…`, those of
    all classes; `microphone`, the number, from 0, of the loudest microphone; and, if positions were estimated, `x_m`,
    `y_m` (`z_m`) and `std_x_m` …, empty for windows without a position.

    **Arguments:**

    - `labels`: the classified recording, as returned by `Listener.classify`.
    - `folder`: the folder, which is created if needed.
    - `model`: name of the listener, for the report.

    Raises `ValueError` if `folder` cannot be a folder.

    **Example:**

    ```python
    sounds = listener.classify(recordings[0])
    write_sound_labels(sounds, "out", model="listener")
    ```
    """
    table_columns = _table_columns(labels)
    with results(folder, SOUND_LABEL_FILES) as result_folder:
        write_rows(result_folder / "events.csv", list(table_columns), zip(*table_columns.values(), strict=True))
        write_json(report_sound_labels(labels, model=model), result_folder / "report.json")
        draw_sound_labels(labels).savefig(result_folder / "timeline.png", dpi=150)


def report_listener(listener: Listener) -> dict[str, Any]:
    """Report a sound classifier's accuracy on held-out clips as plain numbers, strings, lists and dictionaries."""
    standing, held_out = listener.standing, None
    if standing is not None:
        is_right = standing.held_out == standing.right
        held_out = {
            "clips": len(is_right),
            "right": is_right.mean(),
            "right_by_chance": 1 / len(listener.names),
            "right_of_each": {name: is_right[standing.right == name].mean() for name in np.unique(standing.right)},
            "tried": [{"method": name, "right": 1 - error_rate} for name, error_rate in standing.tried],
        }
    return to_plain_values(
        {
            "clips": listener.name,
            "classes": list(listener.names),
            "method": listener.method,
            "channels": listener.channels,
            "highest_frequency_Hz": listener.highest,
            "loudness_counts": listener.loudness,
            "held_out": held_out,
            "notes": list(listener.notes),
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def report_sound_labels(labels: SoundLabels, *, model: str) -> dict[str, Any]:
    """Report the classified sounds as plain numbers, strings, lists and dictionaries; unknown values are None."""
    recording_class, class_probability = labels.whole
    class_names, window_counts = np.unique(labels.named, return_counts=True)
    event_reports = [
        {
            "sound": event.name or None,
            "from_s": event.start,
            "to_s": event.end,
            "probability": event.probability if event.name else None,
            "mean_position_m": event.place,
        }
        for event in labels.events
    ]
    return to_plain_values(
        {
            "recording": labels.name,
            "model": model,
            "windows": len(labels),
            "window_s": WINDOW_DURATION,
            "every_s": WINDOW_INTERVAL,
            "whole": {"sound": recording_class or None, "probability": class_probability if recording_class else None},
            "windows_of_each": {
                class_name or "quiet": window_count
                for class_name, window_count in zip(class_names, window_counts, strict=True)
            },
            "events": event_reports,
            "notes": list(labels.notes),
            "units": {"length": "m", "time": "s"},
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def summary(listener: Listener) -> str:
    """Summarise in one line how accurate a sound classifier is on held-out clips."""
    standing = listener.standing
    if standing is None:
        return "not known: nothing could be held out"
    percentage_right = 100 * np.mean(standing.held_out == standing.right)
    method_texts = ", ".join(
        f"{method_name} {100 * (1 - error_rate):.1f} %" for method_name, error_rate in standing.tried
    )
    return f"{percentage_right:.1f} % of {len(standing.right)} clips right; tried: {method_texts}"


def draw_listener(listener: Listener):
    """Draw a sound classifier's confusion matrix on held-out clips, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_confusion

    figure = Figure(figsize=(5.8, 5.2), layout="constrained")
    ax = figure.subplots()
    if listener.standing is None:
        ax.set_axis_off()
        ax.set_title("No clips could be held out")
        return figure
    percentage_right = 100 * np.mean(listener.standing.held_out == listener.standing.right)
    num_clips = len(listener.standing.right)
    plot_confusion(
        listener.standing,
        title=f"{listener.method}: {percentage_right:.1f} % of {num_clips} clips held out classified correctly",
        ax=ax,
    )
    return figure


def draw_sound_labels(labels: SoundLabels):
    """Draw the classified sounds of a recording over time, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_sound_labels

    figure = Figure(figsize=(8.0, max(2.4, 1.4 + 0.28 * len(labels.names))), layout="constrained")
    plot_sound_labels(labels, ax=figure.subplots())
    return figure


def _table_columns(labels: SoundLabels) -> dict[str, list]:
    """Return the columns of the table `events.csv`, by name."""
    table_columns: dict[str, list] = {
        "time_s": [f"{window_time:.4f}" for window_time in labels.times],
        "sound": labels.named.tolist(),
        "probability": _format_numbers(labels.probability),
        **{
            f"p_{class_name}": _format_numbers(numbers_of_windows)
            for class_name, numbers_of_windows in zip(labels.names, labels.probabilities.T, strict=True)
        },
        "microphone": labels.strongest.tolist(),
    }
    if labels.position is not None and labels.position_std is not None:
        coordinate_names = "xyz"[: labels.position.shape[1]]
        table_columns |= {
            f"{coordinate_name}_m": _format_numbers(numbers_of_windows)
            for coordinate_name, numbers_of_windows in zip(coordinate_names, labels.position.T, strict=True)
        }
        table_columns |= {
            f"std_{coordinate_name}_m": _format_numbers(numbers_of_windows)
            for coordinate_name, numbers_of_windows in zip(coordinate_names, labels.position_std.T, strict=True)
        }
    return table_columns


def _format_numbers(values: np.ndarray) -> list[str]:
    return [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
