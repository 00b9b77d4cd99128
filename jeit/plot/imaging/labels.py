"""Segmentations: the outlines of what is resistive and what is conductive."""

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from jeit.image.score import CONDUCTIVE, RESISTIVE
from jeit.plot.axes import INK, axes_or_new


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
    for label, style, name in ((RESISTIVE, "dashed", "resistive"), (CONDUCTIVE, "solid", "conductive")):
        region = pixels == label
        if region.any():
            ax.contour(x, y, region, levels=[0.5], colors=INK, linewidths=1.4, linestyles=style)
            ax.plot([], [], color=INK, linewidth=1.4, linestyle=style, label=name)
    return ax
