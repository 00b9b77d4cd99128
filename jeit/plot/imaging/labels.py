"""Outlines of what is resistive and what is conductive: of labelled pixels, and of bodies fitted as shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from jeit.image.score import CONDUCTIVE, RESISTIVE
from jeit.inverse.shapes import Star
from jeit.plot.axes import INK, axes_or_new

_STYLES = ((-1, RESISTIVE, "dashed", "resistive"), (1, CONDUCTIVE, "solid", "conductive"))


def draw_labels(labels: ArrayLike, extent: tuple[float, float, float, float], *, ax: Axes | None = None) -> Axes:
    """Outline the regions of a segmentation (rows, columns), see `jeit.image.segment`: resistive ones dashed.

    `extent`: (x_min, x_max, y_min, y_max) in metres. Raises `ValueError` for labels that are not (rows, columns).
    """
    pixels = np.asarray(labels)
    if pixels.ndim != 2:
        raise ValueError(f"labels has shape {pixels.shape}; give (rows, columns).")
    ax = axes_or_new(ax)
    rows, columns = pixels.shape
    x_min, x_max, y_min, y_max = extent
    x = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
    y = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows
    for _, label, style, name in _STYLES:
        region = pixels == label
        if region.any():
            ax.contour(x, y, region, levels=[0.5], colors=INK, linewidths=1.4, linestyles=style)
            ax.plot([], [], color=INK, linewidth=1.4, linestyle=style, label=name)
    return ax


def draw_outlines(stars: Sequence[Star], *, ax: Axes | None = None) -> Axes:
    """Outlines of bodies in a sheet, see `jeit.inverse.shapes`: of resistive ones dashed. Metres."""
    ax = axes_or_new(ax)
    for sign, _, style, name in _STYLES:
        for number, one in enumerate(one for one in stars if one.sign == sign):
            closed = np.concatenate([one.outline, one.outline[:1]])
            ax.plot(*closed.T, color=INK, linewidth=1.4, linestyle=style, label=None if number else name)
    return ax
