"""Plots of sensitivity maps and their histograms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.design.sensitivity import SensitivityMap
from jeit.plot.axes import (
    INK,
    SEQUENTIAL,
    SOFT,
    axes_or_new,
    draw_colour_bar,
    draw_legend_above,
    draw_scale_bar,
    hide_axes,
    soften_axes,
)

_COLOURS = (INK, "#c8102e", "#1f6fb4", "#2a9d6f")


def plot_sensitivity_map(
    theta: SensitivityMap,
    *,
    electrodes: ArrayLike | None = None,
    limit: float | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the sensitivity Θ to touches over the skin, in millivolts.

    **Arguments:**

    - `theta`: the sensitivity map.
    - `electrodes`: positions (L, 2) of the electrodes to be marked, metres.
    - `limit`: upper end of the colour bar, volts, by default the maximum of Θ.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if `theta` is not a `SensitivityMap`.

    **Example:**

    ```python
    ax = plot_sensitivity_map(response.sensitivity, electrodes=layout.centres)
    ax.figure.savefig("sensitivity.png")
    ```
    """
    _check_is_sensitivity_map("theta", theta)
    ax = axes_or_new(ax)
    grid = theta.grid
    rows, columns = grid.shape
    corner = np.asarray(grid.places[0]) - np.array([grid.columns[0], grid.rows[0]]) * np.array(grid.pitch)
    corner = corner - np.array(grid.pitch) / 2
    extent = (corner[0], corner[0] + columns * grid.pitch[0], corner[1], corner[1] + rows * grid.pitch[1])
    max_sensitivity = float(np.max(np.asarray(theta.values))) if limit is None else limit
    image = ax.imshow(
        1e3 * theta.image(),
        origin="lower",
        extent=extent,
        cmap=SEQUENTIAL,
        vmin=0,
        vmax=1e3 * max_sensitivity,
        aspect="equal",
    )
    draw_colour_bar(ax, image, "Sensitivity (mV)")
    if electrodes is not None:
        x, y = np.asarray(electrodes).T[:2]
        ax.plot(x, y, "o", markersize=4, markerfacecolor="white", markeredgecolor=INK, markeredgewidth=0.8)
    hide_axes(ax, extent, numbered=False)
    draw_scale_bar(ax, extent)
    if title:
        ax.set_title(title)
    return ax


def plot_sensitivity_histograms(
    maps: Mapping[str, SensitivityMap], *, bins: int = 40, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot histograms of several sensitivity maps, as shares of the skin's area. A dashed line marks the minimum of the
    first map.

    **Arguments:**

    - `maps`: sensitivity maps by name, for the legend.
    - `bins`: number of bins of equal width in the histogram.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if `maps` is not a mapping to sensitivity maps.

    **Example:**

    ```python
    ax = plot_sensitivity_histograms({"grid": response.sensitivity}, bins=10)
    ax.figure.savefig("histogram.png")
    ```
    """
    check_kind("maps", maps, Mapping, "{name: map}")
    for name, sensitivity in maps.items():
        _check_is_sensitivity_map(f"maps['{name}']", sensitivity)
    ax = axes_or_new(ax)
    max_sensitivity = max(float(np.max(np.asarray(sensitivity.values))) for sensitivity in maps.values())
    edges = np.linspace(0, max_sensitivity, bins + 1)
    for colour, (name, sensitivity) in zip(_COLOURS, maps.items(), strict=False):
        ax.stairs(100 * sensitivity.histogram(edges)[0], 1e3 * edges, color=colour, label=name, linewidth=1.4)
    first_name, sensitivity = next(iter(maps.items()))
    ax.axvline(
        1e3 * float(sensitivity.minimum), color=SOFT, linewidth=1, linestyle="--", label=f"least of {first_name}"
    )
    ax.set_xlabel("Sensitivity (mV)", color=INK)
    ax.set_ylabel("Share of the area (%)", color=INK)
    soften_axes(ax)
    draw_legend_above(ax)
    if title:
        ax.set_title(title)
    return ax


def _check_is_sensitivity_map(argument_name: str, sensitivity_map: SensitivityMap) -> None:
    check_kind(argument_name, sensitivity_map, SensitivityMap, "a SensitivityMap, as of jeit.design.sensitivity_map")
