"""Plots of the errors of a learnt skin on held-out presses: places, forces, labels and keys."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jeit.plot.axes import (
    INK,
    SEQUENTIAL,
    SERIES_COLOURS,
    SOFT,
    axes_or_new,
    draw_colour_bar,
    draw_scale_bar,
    extent_of,
    hide_axes,
    soften_axes,
)
from jeit.touch import Standing

# Maximum number of labels for which a confusion matrix has tick labels.
_MAX_TICK_LABELS = 24


def plot_place_errors(place: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the errors of the places estimated for held-out presses, at the true places, in millimetres.

    `place`: accuracy of the places learnt by a `LearntSkin`, its `standing["place"]`.
    """
    ax = axes_or_new(ax)
    errors_mm = 1e3 * np.linalg.norm(place.held_out - place.right, axis=1)
    extent = extent_of(place.right)
    hide_axes(ax, extent, numbered=False)
    colour_limit = float(np.quantile(errors_mm, 0.98)) or 1.0
    order = np.argsort(errors_mm)
    points = ax.scatter(
        *place.right[order, :2].T, c=errors_mm[order], s=22, cmap=SEQUENTIAL, vmin=0, vmax=colour_limit, linewidths=0
    )
    draw_scale_bar(ax, extent)
    draw_colour_bar(ax, points, "Error of presses held out (mm)")
    ax.set_title(
        f"Places: {errors_mm.mean():.3g} mm on average, median {np.median(errors_mm):.3g} mm"
        if title is None
        else title
    )
    return ax


def plot_force_errors(force: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the forces that a learnt skin estimates for held-out presses against the true forces, in newtons."""
    ax = axes_or_new(ax)
    true_forces, estimated_forces = force.right[:, 0], force.held_out[:, 0]
    limits = [min(true_forces.min(), estimated_forces.min()), max(true_forces.max(), estimated_forces.max())]
    ax.plot(limits, limits, color=SOFT, linewidth=1, zorder=1)
    ax.plot(
        true_forces,
        estimated_forces,
        linestyle="none",
        marker="o",
        markersize=3.5,
        alpha=0.6,
        color=SERIES_COLOURS[0],
        markeredgewidth=0,
    )
    ax.set_xlabel("Force (N)", color=INK)
    ax.set_ylabel("Estimated force of presses held out (N)", color=INK)
    ax.set_title(
        f"Forces: {np.abs(estimated_forces - true_forces).mean():.3g} N off on average" if title is None else title
    )
    soften_axes(ax)
    return ax


def plot_confusion(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the confusion matrix of a classifier on held-out presses, in per cent of the presses of each label.

    **Arguments:**

    - `label`: true labels of held-out presses, and those that the classifier predicts.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    **Example:**

    ```python
    ax = plot_confusion(gestures.standing)
    ax.figure.savefig("confusion.png")
    ```
    """
    ax = axes_or_new(ax)
    labels = np.unique(label.right)
    counts = np.array(
        [
            [np.sum((label.right == true_label) & (label.held_out == predicted_label)) for predicted_label in labels]
            for true_label in labels
        ]
    )
    shares = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    matrix_image = ax.imshow(shares, cmap="Blues", vmin=0, vmax=100)
    draw_colour_bar(ax, matrix_image, "Share of the kind (%)")
    if len(labels) <= _MAX_TICK_LABELS:
        rotation = 90 if max(len(text) for text in labels) > 3 else 0
        ax.set_xticks(range(len(labels)), labels, rotation=rotation)
        ax.set_yticks(range(len(labels)), labels)
    if len(labels) <= 10:
        for row, column in np.argwhere(shares >= 0.5):
            colour = "white" if shares[row, column] > 50 else INK
            ax.text(column, row, f"{shares[row, column]:.0f}", ha="center", va="center", color=colour, fontsize=8)
    ax.set_xlabel("Predicted label", color=INK)
    ax.set_ylabel("True label", color=INK)
    percentage = 100 * np.mean(label.right == label.held_out)
    ax.set_title(f"Labels: {percentage:.1f} % right of presses held out" if title is None else title)
    return ax


def plot_key_errors(keys: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw, for each key of a learnt skin, the share of held-out presses in which it was classified wrongly."""
    ax = axes_or_new(ax)
    error_rates = 100 * np.mean(keys.held_out != keys.right, axis=0)
    ax.bar(range(len(error_rates)), error_rates, color=SERIES_COLOURS[0], width=0.7)
    ax.set_xticks(range(len(error_rates)))
    ax.set_xlabel("Key", color=INK)
    ax.set_ylabel("Classified wrongly (%)", color=INK)
    ax.set_ylim(0, max(1.0, 1.1 * error_rates.max()))
    pattern_share = 100 * np.mean((keys.held_out == keys.right).all(axis=1))
    default_title = f"Keys: {100 - error_rates.mean():.1f} % right, whole patterns {pattern_share:.1f} %"
    ax.set_title(default_title if title is None else title)
    soften_axes(ax)
    return ax


def plot_tried(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the accuracy of each classifier that was tried, on held-out presses, in per cent, the best at the top."""
    ax = axes_or_new(ax)
    names, percentages = [name for name, _ in label.tried], [100 * (1 - error) for _, error in label.tried]
    colours = [SERIES_COLOURS[0] if name == label.method else "#c9d3de" for name in names]
    ax.barh(range(len(names)), percentages, color=colours, height=0.7)
    for row, value in enumerate(percentages):
        ax.text(value, row, f" {value:.0f}", va="center", color=INK, fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.invert_yaxis()
    ax.set_xlim(0, 105)
    ax.set_xlabel("Right of what was held out (%)", color=INK)
    ax.set_title("What was tried" if title is None else title)
    soften_axes(ax)
    return ax
