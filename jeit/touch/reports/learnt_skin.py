"""Write a learnt skin, and its predictions for frames, to folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jeit.report.folder import as_plain_values, results, version_of, write_json, write_rows
from jeit.touch import LearntSkin, Standing, Touches, write_skin

SKIN_FILES = ("skin.skops", "report.json", "learning.png")
TOUCH_FILES = ("touches.csv", "report.json", "touches.png")
_PACKAGES = ("jeit", "numpy", "scikit-learn", "skops")


def write_learnt_skin(skin: LearntSkin, folder: str | Path) -> None:
    """Write `skin.skops`, `report.json` and the picture `learning.png` into `folder`, which is created if needed.

    Raises `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, SKIN_FILES) as made:
        write_skin(skin, made / "skin.skops")
        write_json(report_learnt_skin(skin), made / "report.json")
        draw_learning(skin).savefig(made / "learning.png", dpi=150)


def write_touches(touches: Touches, folder: str | Path, *, skin: str, name: str) -> None:
    """Write `touches.csv`, `report.json` and the picture `touches.png` of a `skin`'s predictions for the frames `name`.

    The table has a line for each frame, numbered from 0, with columns for the quantities that the skin has learnt:
    `x_m`, `y_m` (`z_m`), their standard deviations, `force_N`, `std_force_N`, `label`, `probability`, `key_0` … (1
    where pressed) with `probability_0` …. The column `unlike` is 1 for frames unlike all frames of the training set,
    for which nothing is predicted. Raises `ValueError` if `folder` cannot be a folder.
    """
    columns = _table_columns(touches)
    dead = np.flatnonzero(~touches.alive.any(axis=0))
    report = {
        "frames": name,
        "skin": skin,
        "number": len(touches),
        "unlike": np.flatnonzero(touches.unlike),
        "channels_not_used": dead,
        "notes": list(touches.notes),
        "units": {"length": "m", "force": "N"},
        "versions": {package: version_of(package) for package in _PACKAGES},
    }
    if touches.label is not None:
        kinds, counts = np.unique(touches.label[~touches.unlike], return_counts=True)
        report["labels"] = dict(zip(kinds.tolist(), counts.tolist(), strict=True))
    with results(folder, TOUCH_FILES) as made:
        write_rows(made / "touches.csv", list(columns), zip(*columns.values(), strict=True))
        write_json(as_plain_values(report), made / "report.json")
        draw_touches(touches).savefig(made / "touches.png", dpi=150)


def report_learnt_skin(skin: LearntSkin) -> dict[str, Any]:
    """Report how well a skin has learnt, as plain numbers, strings, lists and dictionaries."""
    return as_plain_values(
        {
            "presses": skin.name,
            "channels": len(skin.channels.used),
            "channels_used": np.flatnonzero(skin.channels.used),
            "rows_frames_come_late": skin.lag,
            "held_out": {name: _error_statistics(name, one) for name, one in skin.standing.items()},
            "notes": skin.notes,
            "units": {"length": "m", "force": "N"},
            "versions": {package: version_of(package) for package in _PACKAGES},
        }
    )


def summary(name: str, standing: Standing) -> str:
    """Summarise in one line how well one quantity was learnt."""
    said = _error_statistics(name, standing)
    if name == "place":
        mean, median, most, guess = (
            f"{1e3 * said[key]:.3g} mm"
            for key in ("mean_error_m", "median_error_m", "error_of_95_percent_m", "mean_error_of_a_guess_m")
        )
        return f"{mean} off on average, median {median}, 95 % within {most}; guessing the middle: {guess}"
    if name == "force":
        guess = said["mean_error_of_a_guess_N"]
        return f"{said['mean_error_N']:.3g} N off on average; guessing the mean: {guess:.3g} N"
    if name == "label":
        commonest = 100 * said["right_by_the_commonest"]
        return f"{100 * said['right']:.1f} % right; the commonest label alone: {commonest:.1f} %"
    whole = 100 * said["right_of_whole_patterns"]
    return f"{100 * said['right_of_each_key']:.1f} % of the keys right, {whole:.1f} % of whole patterns"


def draw_learning(skin: LearntSkin):
    """Draw the errors on held-out presses, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_confusion, plot_force_errors, plot_key_errors, plot_place_errors

    draw = {"place": plot_place_errors, "force": plot_force_errors, "label": plot_confusion, "keys": plot_key_errors}
    figure = Figure(figsize=(5.8 * len(skin.standing), 5.2), layout="constrained")
    panels = figure.subplots(1, len(skin.standing), squeeze=False)[0]
    for ax, (name, standing) in zip(panels, skin.standing.items(), strict=True):
        draw[name](standing, ax=ax)
    return figure


def draw_touches(touches: Touches):
    """Draw the predictions for frames, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_answers, plot_places

    draw = [plot_places] if touches.position is not None else []
    if any(one is not None for one in (touches.touched, touches.label, touches.force)):
        draw.append(plot_answers)
    figure = Figure(figsize=(6.2 * len(draw), 5.2), layout="constrained")
    for ax, one in zip(figure.subplots(1, len(draw), squeeze=False)[0], draw, strict=True):
        one(touches, ax=ax)
    return figure


def _error_statistics(name: str, standing: Standing) -> dict[str, Any]:
    """Compute error statistics of held-out presses."""
    said: dict[str, Any] = {"method": standing.method, "presses": len(standing.right)}
    if name in ("place", "force"):
        unit = "m" if name == "place" else "N"
        off = np.linalg.norm(standing.held_out - standing.right, axis=1)
        guess = np.linalg.norm(standing.right - standing.right.mean(axis=0), axis=1)
        ratio = np.abs(standing.held_out - standing.right) / standing.std
        said |= {
            f"mean_error_{unit}": off.mean(),
            f"median_error_{unit}": np.median(off),
            f"error_of_95_percent_{unit}": np.quantile(off, 0.95),
            f"mean_error_of_a_guess_{unit}": guess.mean(),
            "share_within_one_standard_deviation": np.mean(ratio <= 1),
            "share_within_1.96_standard_deviations": np.mean(ratio <= 1.96),
        }
        return said | {"tried": [{"method": one, f"mean_error_{unit}": error} for one, error in standing.tried]}
    right = standing.held_out == standing.right
    if name == "label":
        counts = np.unique(standing.right, return_counts=True)[1]
        said |= {"right": right.mean(), "right_by_the_commonest": counts.max() / counts.sum()}
        return said | {"tried": [{"method": one, "right": 1 - error} for one, error in standing.tried]}
    said |= {"right_of_each_key": right.mean(), "right_of_whole_patterns": right.all(axis=1).mean()}
    return said | {"keys": [{"method": one, "right": 1 - error} for one, error in standing.tried]}


def _table_columns(touches: Touches) -> dict[str, list]:
    """Columns of `touches.csv`, by name."""
    columns: dict[str, list] = {"frame": list(range(len(touches)))}
    if touches.position is not None and touches.position_std is not None:
        axes = "xyz"[: touches.position.shape[1]]
        columns |= {f"{axis}_m": _format_numbers(one) for axis, one in zip(axes, touches.position.T, strict=True)}
        columns |= {
            f"std_{axis}_m": _format_numbers(one) for axis, one in zip(axes, touches.position_std.T, strict=True)
        }
    if touches.force is not None and touches.force_std is not None:
        columns |= {"force_N": _format_numbers(touches.force), "std_force_N": _format_numbers(touches.force_std)}
    if touches.label is not None and touches.probability is not None:
        columns |= {"label": touches.label.tolist(), "probability": _format_numbers(touches.probability)}
    if touches.touched is not None and touches.key_probability is not None:
        said = np.where(touches.unlike[:, None], "", touches.touched.astype(int).astype(str))
        for key, (one, probability) in enumerate(zip(said.T, touches.key_probability.T, strict=True)):
            columns |= {f"key_{key}": one.tolist(), f"probability_{key}": _format_numbers(probability)}
    columns["unlike"] = touches.unlike.astype(int).tolist()
    return columns


def _format_numbers(values: np.ndarray) -> list[str]:
    return [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
