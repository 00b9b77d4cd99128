"""Write a learnt gesture classifier to a folder: the model, a report, and a picture of the confusion matrix."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jeit.report.folder import plain, results, version_of, write_json
from jeit.touch import LearntGestures
from jeit.touch.gestures.gesture_model import GESTURE_FILE

GESTURE_FILES = (GESTURE_FILE, "report.json", "gestures.png")
_PACKAGES = ("jeit", "numpy", "scikit-learn", "skops")


def write_gestures(learnt: LearntGestures, folder: str | Path, *, name: str = "recordings") -> None:
    """Write `gestures.skops`, `report.json` and the picture `gestures.png` into `folder`, which is made if need be.

    `name`: the name of the recordings. Raises `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, GESTURE_FILES) as made:
        learnt.model.write(made / GESTURE_FILE)
        write_json(report_gestures(learnt, name), made / "report.json")
        draw_gestures(learnt).savefig(made / "gestures.png", dpi=150)


def report_gestures(learnt: LearntGestures, name: str) -> dict[str, Any]:
    """Report how well gestures were learnt, as plain numbers, strings, lists and dictionaries."""
    model, standing = learnt.model, learnt.model.standing
    report: dict[str, Any] = {
        "recordings": name,
        "gestures": list(model.names),
        "classifier": f"{model.method} on {model.form}",
        "reading": None if model.reading is None else vars(model.reading),
        "recordings_without_a_touch": list(learnt.without_touch),
        "notes": list(model.notes),
        "units": {"level": "S", "rate": "1/s"},
        "versions": {package: version_of(package) for package in _PACKAGES},
    }
    if standing is not None:
        right = standing.held_out == standing.right
        report["held_out"] = {
            "touches": len(standing.right),
            "right": right.mean(),
            "right_by_gesture": {one: right[standing.right == one].mean() for one in model.names},
            "tried": [{"classifier": one, "right": 1 - error} for one, error in standing.tried],
        }
    return plain(report)


def draw_gestures(learnt: LearntGestures):
    """Draw the confusion matrix and the accuracy of each classifier, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_confusion, plot_tried

    standing = learnt.model.standing
    figure = Figure(figsize=(12.0, 5.4), layout="constrained")
    if standing is not None:
        left, right = figure.subplots(1, 2)
        share = 100 * np.mean(standing.held_out == standing.right)
        plot_confusion(standing, title=f"Gestures: {share:.1f} % right of touches held out", ax=left)
        plot_tried(standing, ax=right)
    return figure
