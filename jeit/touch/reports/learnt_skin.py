"""Write a learnt skin, and the touches that it predicts from frames, to folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jeit.report.folder import package_version, results, to_plain_values, write_json, write_rows
from jeit.touch import LearntSkin, Standing, Touches, write_skin

SKIN_FILES = ("skin.skops", "report.json", "learning.png")
TOUCH_FILES = ("touches.csv", "report.json", "touches.png")
_REPORTED_PACKAGES = ("jeit", "numpy", "scikit-learn", "skops")


def write_learnt_skin(skin: LearntSkin, folder: str | Path) -> None:
    """Write a learnt skin and its errors into `folder`: `skin.skops`, `report.json` and `learning.png`.

    Raises `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, SKIN_FILES) as result_folder:
        write_skin(skin, result_folder / "skin.skops")
        write_json(report_learnt_skin(skin), result_folder / "report.json")
        draw_learning(skin).savefig(result_folder / "learning.png", dpi=150)


def write_touches(touches: Touches, folder: str | Path, *, skin: str, name: str) -> None:
    """Write the touches that a learnt skin predicts from frames to `touches.csv`, `report.json` and `touches.png`.

    `skin`, `name`: names of the skin and the frames. `touches.csv` has a line for each frame, numbered from 0, with
    columns for the quantities that the skin has learnt: `x_m`, `y_m` (`z_m`), their standard deviations, `force_N`,
    `std_force_N`, `label`, `probability`, `key_0` … (1 where pressed) with `probability_0` …. The column `unlike` is 1
    for frames unlike all frames of the training set, for which nothing is predicted. Raises `ValueError` if `folder`
    cannot be a folder.
    """
    table_columns = _table_columns(touches)
    dead_channels = np.flatnonzero(~touches.alive.any(axis=0))
    touch_report = {
        "frames": name,
        "skin": skin,
        "number": len(touches),
        "unlike": np.flatnonzero(touches.unlike),
        "channels_not_used": dead_channels,
        "notes": list(touches.notes),
        "units": {"length": "m", "force": "N"},
        "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
    }
    if touches.label is not None:
        label_names, label_counts = np.unique(touches.label[~touches.unlike], return_counts=True)
        touch_report["labels"] = dict(zip(label_names.tolist(), label_counts.tolist(), strict=True))
    with results(folder, TOUCH_FILES) as result_folder:
        write_rows(result_folder / "touches.csv", list(table_columns), zip(*table_columns.values(), strict=True))
        write_json(to_plain_values(touch_report), result_folder / "report.json")
        draw_touches(touches).savefig(result_folder / "touches.png", dpi=150)


def report_learnt_skin(skin: LearntSkin) -> dict[str, Any]:
    """Report a learnt skin's errors on held-out presses as plain numbers, strings, lists and dictionaries."""
    return to_plain_values(
        {
            "presses": skin.name,
            "channels": len(skin.channels.used),
            "channels_used": np.flatnonzero(skin.channels.used),
            "rows_frames_come_late": skin.lag,
            "held_out": {
                quantity_name: _error_statistics(quantity_name, standing)
                for quantity_name, standing in skin.standing.items()
            },
            "notes": skin.notes,
            "units": {"length": "m", "force": "N"},
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def summary(name: str, standing: Standing) -> str:
    """Summarise in one line how well a skin has learnt the quantity `name`, such as "place"."""
    statistics = _error_statistics(name, standing)
    if name == "place":
        mean_error, median_error, high_percentile_error, guess_error = (
            f"{1e3 * statistics[statistics_key]:.3g} mm"
            for statistics_key in ("mean_error_m", "median_error_m", "error_of_95_percent_m", "mean_error_of_a_guess_m")
        )
        return (
            f"{mean_error} off on average, median {median_error}, 95 % within {high_percentile_error}; guessing "
            f"the middle: {guess_error}"
        )
    if name == "force":
        guess_error = statistics["mean_error_of_a_guess_N"]
        return f"{statistics['mean_error_N']:.3g} N off on average; guessing the mean: {guess_error:.3g} N"
    if name == "label":
        percentage_of_commonest_class = 100 * statistics["right_by_the_commonest"]
        return (
            f"{100 * statistics['right']:.1f} % right; the commonest label alone: {percentage_of_commonest_class:.1f} %"
        )
    pattern_share = 100 * statistics["right_of_whole_patterns"]
    return f"{100 * statistics['right_of_each_key']:.1f} % of the keys right, {pattern_share:.1f} % of whole patterns"


def draw_learning(skin: LearntSkin):
    """Draw the errors of a learnt skin on held-out presses, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_confusion, plot_force_errors, plot_key_errors, plot_place_errors

    plot_functions = {
        "place": plot_place_errors,
        "force": plot_force_errors,
        "label": plot_confusion,
        "keys": plot_key_errors,
    }
    figure = Figure(figsize=(5.8 * len(skin.standing), 5.2), layout="constrained")
    figure_axes = figure.subplots(1, len(skin.standing), squeeze=False)[0]
    for ax, (quantity_name, standing) in zip(figure_axes, skin.standing.items(), strict=True):
        plot_functions[quantity_name](standing, ax=ax)
    return figure


def draw_touches(touches: Touches):
    """Draw the touches predicted from frames, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_answers, plot_places

    plot_functions = [plot_places] if touches.position is not None else []
    if any(quantity is not None for quantity in (touches.touched, touches.label, touches.force)):
        plot_functions.append(plot_answers)
    figure = Figure(figsize=(6.2 * len(plot_functions), 5.2), layout="constrained")
    for ax, plot_function in zip(
        figure.subplots(1, len(plot_functions), squeeze=False)[0], plot_functions, strict=True
    ):
        plot_function(touches, ax=ax)
    return figure


def _error_statistics(quantity_name: str, standing: Standing) -> dict[str, Any]:
    """Compute error statistics of the quantity `quantity_name` on held-out presses."""
    error_statistics: dict[str, Any] = {"method": standing.method, "presses": len(standing.right)}
    if quantity_name in ("place", "force"):
        quantity_unit = "m" if quantity_name == "place" else "N"
        error_magnitudes = np.linalg.norm(standing.held_out - standing.right, axis=1)
        guess_errors = np.linalg.norm(standing.right - standing.right.mean(axis=0), axis=1)
        error_ratios = np.abs(standing.held_out - standing.right) / standing.std
        error_statistics |= {
            f"mean_error_{quantity_unit}": error_magnitudes.mean(),
            f"median_error_{quantity_unit}": np.median(error_magnitudes),
            f"error_of_95_percent_{quantity_unit}": np.quantile(error_magnitudes, 0.95),
            f"mean_error_of_a_guess_{quantity_unit}": guess_errors.mean(),
            "share_within_one_standard_deviation": np.mean(error_ratios <= 1),
            "share_within_1.96_standard_deviations": np.mean(error_ratios <= 1.96),
        }
        return error_statistics | {
            "tried": [
                {"method": method_name, f"mean_error_{quantity_unit}": method_error}
                for method_name, method_error in standing.tried
            ]
        }
    is_correct = standing.held_out == standing.right
    if quantity_name == "label":
        class_counts = np.unique(standing.right, return_counts=True)[1]
        error_statistics |= {
            "right": is_correct.mean(),
            "right_by_the_commonest": class_counts.max() / class_counts.sum(),
        }
        return error_statistics | {
            "tried": [
                {"method": method_name, "right": 1 - method_error} for method_name, method_error in standing.tried
            ]
        }
    error_statistics |= {
        "right_of_each_key": is_correct.mean(),
        "right_of_whole_patterns": is_correct.all(axis=1).mean(),
    }
    return error_statistics | {
        "keys": [{"method": method_name, "right": 1 - method_error} for method_name, method_error in standing.tried]
    }


def _table_columns(touches: Touches) -> dict[str, list]:
    """Return the columns of the table `touches.csv`, by name."""
    table_columns: dict[str, list] = {"frame": list(range(len(touches)))}
    if touches.position is not None and touches.position_std is not None:
        coordinate_names = "xyz"[: touches.position.shape[1]]
        table_columns |= {
            f"{coordinate_name}_m": _format_numbers(coordinates)
            for coordinate_name, coordinates in zip(coordinate_names, touches.position.T, strict=True)
        }
        table_columns |= {
            f"std_{coordinate_name}_m": _format_numbers(coordinates)
            for coordinate_name, coordinates in zip(coordinate_names, touches.position_std.T, strict=True)
        }
    if touches.force is not None and touches.force_std is not None:
        table_columns |= {"force_N": _format_numbers(touches.force), "std_force_N": _format_numbers(touches.force_std)}
    if touches.label is not None and touches.probability is not None:
        table_columns |= {"label": touches.label.tolist(), "probability": _format_numbers(touches.probability)}
    if touches.touched is not None and touches.key_probability is not None:
        key_texts = np.where(touches.unlike[:, None], "", touches.touched.astype(int).astype(str))
        for key_number, (key_states, key_probabilities) in enumerate(
            zip(key_texts.T, touches.key_probability.T, strict=True)
        ):
            table_columns |= {
                f"key_{key_number}": key_states.tolist(),
                f"probability_{key_number}": _format_numbers(key_probabilities),
            }
    table_columns["unlike"] = touches.unlike.astype(int).tolist()
    return table_columns


def _format_numbers(values: np.ndarray) -> list[str]:
    return [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
