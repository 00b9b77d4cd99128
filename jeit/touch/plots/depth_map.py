"""Plot maps of the indentation depth of a skin, and the losses of a training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jeit.arguments import check_kind, real_array
from jeit.plot.axes import (
    INK,
    SEQUENTIAL,
    SERIES_COLOURS,
    axes_or_new,
    bare,
    draw_colour_bar,
    draw_legend_above,
    draw_scale_bar,
    soften_axes,
)
from jeit.touch.training import Trained


def plot_depth_map(
    depth: Float[np.ndarray, "rows columns"],
    extent: tuple[float, float, float, float],
    *,
    most: float | None = None,
    colour_bar: bool = True,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a map of indentation depth (rows, columns), metres, row 0 at the least y, as `ImageNetwork` estimates.

    `extent`: (x_min, x_max, y_min, y_max), metres; `most`: the depth at the end of the colour scale. Raises
    `ValueError` for what is no map.
    """
    depth = real_array("depth", depth, "a map (rows, columns) of depths in metres")
    if depth.ndim != 2:
        raise ValueError(f"depth must be a map (rows, columns); it has shape {depth.shape}.")
    ax = axes_or_new(ax)
    bare(ax, extent, numbered=False)
    top = 1e3 * (float(depth.max()) if most is None else most) or 1.0
    drawn = ax.imshow(
        1e3 * depth, origin="lower", extent=extent, cmap=SEQUENTIAL, vmin=0.0, vmax=top, interpolation="nearest"
    )
    draw_scale_bar(ax, extent)
    if colour_bar:
        draw_colour_bar(ax, drawn, "Depth (mm)")
    if title is not None:
        ax.set_title(title)
    return ax


def plot_losses(courses: Mapping[str, Trained], *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the held-out losses of trainings by name, relative to the first evaluation, and mark the best of each.

    `courses`: as from `jeit.touch.training.fit`. Raises `ValueError` for what are none.
    """
    check_kind("courses", courses, Mapping, "trainings by name, such as learnt.courses")
    ax = axes_or_new(ax)
    for (name, trained), colour in zip(courses.items(), SERIES_COLOURS * len(courses), strict=False):
        check_kind(f"courses[{name!r}]", trained, Trained, "a Trained, as of fit")
        own = trained.course
        shares = np.array(own.validation) / own.validation[0]
        ax.plot(own.steps, shares, color=colour, linewidth=1.6, label=name)
        ax.plot(own.steps[own.best], shares[own.best], marker="o", color=colour, markersize=5)
    ax.set_xlabel("Batches", color=INK)
    ax.set_ylabel("Loss of touches held out, of that at first", color=INK)
    soften_axes(ax)
    draw_legend_above(ax)
    if title is not None:
        ax.set_title(title)
    return ax
