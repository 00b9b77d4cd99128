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
_MOST_TICK_LABELS = 24


def plot_place_errors(place: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the errors of the places estimated for held-out presses, at the true places, in millimetres.

    `place`: the standing `place` of a `LearntSkin`.
    """
    ax = axes_or_new(ax)
    off = 1e3 * np.linalg.norm(place.held_out - place.right, axis=1)
    extent = extent_of(place.right)
    hide_axes(ax, extent, numbered=False)
    most = float(np.quantile(off, 0.98)) or 1.0
    order = np.argsort(off)
    drawn = ax.scatter(*place.right[order, :2].T, c=off[order], s=22, cmap=SEQUENTIAL, vmin=0, vmax=most, linewidths=0)
    draw_scale_bar(ax, extent)
    draw_colour_bar(ax, drawn, "Error of presses held out (mm)")
    ax.set_title(f"Places: {off.mean():.3g} mm on average, median {np.median(off):.3g} mm" if title is None else title)
    return ax


def plot_force_errors(force: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the forces estimated for held-out presses against the true forces, in newtons."""
    ax = axes_or_new(ax)
    right, said = force.right[:, 0], force.held_out[:, 0]
    ends = [min(right.min(), said.min()), max(right.max(), said.max())]
    ax.plot(ends, ends, color=SOFT, linewidth=1, zorder=1)
    ax.plot(
        right, said, linestyle="none", marker="o", markersize=3.5, alpha=0.6, color=SERIES_COLOURS[0], markeredgewidth=0
    )
    ax.set_xlabel("Force (N)", color=INK)
    ax.set_ylabel("Estimated force of presses held out (N)", color=INK)
    ax.set_title(f"Forces: {np.abs(said - right).mean():.3g} N off on average" if title is None else title)
    soften_axes(ax)
    return ax


def plot_confusion(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the confusion matrix of held-out presses, in per cent of the presses of each label.

    **Arguments:**

    - `label`: accuracy with which labels were learnt.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

    **Example:**

    ```python
    ax = plot_confusion(gestures.standing)
    ax.figure.savefig("confusion.png")
    ```
    """
    ax = axes_or_new(ax)
    kinds = np.unique(label.right)
    counts = np.array([[np.sum((label.right == one) & (label.held_out == other)) for other in kinds] for one in kinds])
    shares = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    drawn = ax.imshow(shares, cmap="Blues", vmin=0, vmax=100)
    draw_colour_bar(ax, drawn, "Share of the kind (%)")
    if len(kinds) <= _MOST_TICK_LABELS:
        turned = 90 if max(len(one) for one in kinds) > 3 else 0
        ax.set_xticks(range(len(kinds)), kinds, rotation=turned)
        ax.set_yticks(range(len(kinds)), kinds)
    if len(kinds) <= 10:
        for row, column in np.argwhere(shares >= 0.5):
            colour = "white" if shares[row, column] > 50 else INK
            ax.text(column, row, f"{shares[row, column]:.0f}", ha="center", va="center", color=colour, fontsize=8)
    ax.set_xlabel("Predicted label", color=INK)
    ax.set_ylabel("True label", color=INK)
    right = 100 * np.mean(label.right == label.held_out)
    ax.set_title(f"Labels: {right:.1f} % right of presses held out" if title is None else title)
    return ax


def plot_key_errors(keys: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the share of held-out presses in which each key was classified wrongly, in per cent."""
    ax = axes_or_new(ax)
    wrong = 100 * np.mean(keys.held_out != keys.right, axis=0)
    ax.bar(range(len(wrong)), wrong, color=SERIES_COLOURS[0], width=0.7)
    ax.set_xticks(range(len(wrong)))
    ax.set_xlabel("Key", color=INK)
    ax.set_ylabel("Classified wrongly (%)", color=INK)
    ax.set_ylim(0, max(1.0, 1.1 * wrong.max()))
    whole = 100 * np.mean((keys.held_out == keys.right).all(axis=1))
    said = f"Keys: {100 - wrong.mean():.1f} % right, whole patterns {whole:.1f} %"
    ax.set_title(said if title is None else title)
    soften_axes(ax)
    return ax


def plot_tried(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the accuracy of each method that was tried, on held-out presses, in per cent; the best is at the top."""
    ax = axes_or_new(ax)
    names, right = [one for one, _ in label.tried], [100 * (1 - error) for _, error in label.tried]
    colours = [SERIES_COLOURS[0] if one == label.method else "#c9d3de" for one in names]
    ax.barh(range(len(names)), right, color=colours, height=0.7)
    for row, value in enumerate(right):
        ax.text(value, row, f" {value:.0f}", va="center", color=INK, fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.invert_yaxis()
    ax.set_xlim(0, 105)
    ax.set_xlabel("Right of what was held out (%)", color=INK)
    ax.set_title("What was tried" if title is None else title)
    soften_axes(ax)
    return ax
