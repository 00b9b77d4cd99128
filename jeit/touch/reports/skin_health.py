"""Write the damage and repairs of a monitored skin to a folder: a table, a report and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.report.folder import package_version, results, to_plain_values, write_json, write_rows
from jeit.touch.health import HealthEvent, SkinHealth

HEALTH_FILES = ("events.csv", "report.json", "health.png")
_REPORTED_PACKAGES = ("jeit", "jax", "numpy", "scipy")
_EVENT_COLUMNS = (
    "event", "kind", "status", "time", "noticed", "frame", "electrode", "channels", "strength", "length_m",
    "length_deviation_m", "path_m", "reason",
)  # fmt: skip


def write_health(
    health: SkinHealth,
    times: Float[np.ndarray, " F"],
    frames: Float[np.ndarray, "F M"],
    folder: str | Path,
    *,
    name: str = "recording",
    timed: bool = True,
    notes: Sequence[str] = (),
) -> None:
    """Write the damage and repairs that `watch` detected to `events.csv`, `report.json` and the picture `health.png`.

    `frames` (F, M): the monitored frames, recorded at `times` (F,); `name`: name of the recording; `timed`: True if
    times are in seconds, False if they are numbers of frames; `notes`: reasons to doubt the result. In the table
    `events.csv`, the path of a cut is a list of points x y in metres, separated by semicolons; electrodes are numbered
    from 1. Raises `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, HEALTH_FILES) as result_folder:
        write_rows(result_folder / "events.csv", _EVENT_COLUMNS, (_event_row(event) for event in health.events))
        write_json(report_health(health, name, timed) | {"notes": list(notes)}, result_folder / "report.json")
        draw_health(health, times, frames, timed).savefig(result_folder / "health.png", dpi=130)


def report_health(health: SkinHealth, name: str, timed: bool) -> dict[str, Any]:
    """Report detected damage and repairs as plain numbers, strings, lists and dictionaries; unknown values are None."""
    held_event = health.held
    return to_plain_values(
        {
            "recording": name,
            "frames": health.frames,
            "events": [
                {
                    "event": event.number,
                    "kind": event.kind,
                    "status": event.status,
                    "time": event.time,
                    "noticed": event.noticed,
                    "frame": event.frame,
                    "electrode": None if event.electrode is None else event.electrode + 1,
                    "channels": np.flatnonzero(event.channels),
                    "strength": event.strength,
                    "length_m": None if event.path is None else event.length,
                    "length_deviation_m": None if event.path is None else event.deviation,
                    "through": event.through,
                    "path_m": event.path,
                    "reason": event.reason,
                }
                for event in health.events
            ],
            "held": None
            if held_event is None
            else {"time": held_event.time, "kind": held_event.kind, "reason": held_event.reason},
            "trusted_channels": np.flatnonzero(health.trusted),
            "channels_without_a_reading": np.flatnonzero(~health.healthy.used),
            "patience": health.patience,
            "with_a_model": health.skin is not None,
            "units": {"length": "m", "time": "s" if timed else "frames"},
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def draw_health(health: SkinHealth, times: Float[np.ndarray, " F"], frames: Float[np.ndarray, "F M"], timed: bool):
    """Draw damage and repairs over time, and on the skin if it has a model, as a `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_health, plot_health_course

    figure = Figure(figsize=(13.0, 4.6) if health.skin is not None else (9.5, 3.6), layout="constrained")
    if health.skin is not None:
        ax, skin_axes = figure.subplots(1, 2, width_ratios=(1.7, 1))
        plot_health(health, title="The skin now", ax=skin_axes)
    else:
        ax = figure.subplots()
    num_events = len(health.events)
    course_title = f"{num_events} event{'' if num_events == 1 else 's'} in {len(frames):,} frames"
    plot_health_course(health, times, frames, title=course_title, ax=ax)
    ax.set_xlabel("Time (s)" if timed else "Frame")
    return figure


def _event_row(event: HealthEvent) -> list[object]:
    """Create the row of the table `events.csv` for an event: damage or repair."""
    path_text = "" if event.path is None else "; ".join(f"{x:.5f} {y:.5f}" for x, y in event.path)
    return [
        event.number,
        event.kind,
        event.status,
        f"{event.time:.6g}",
        f"{event.noticed:.6g}",
        event.frame,
        "" if event.electrode is None else event.electrode + 1,
        int(event.channels.sum()),
        f"{event.strength:.4g}",
        "" if event.path is None else f"{event.length:.5f}",
        "" if event.path is None else f"{event.deviation:.5f}",
        path_text,
        event.reason,
    ]
