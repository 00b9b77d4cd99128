"""Figures of merit of reconstructions, side by side, against the target's distance from the centre."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jeit.arguments import check_kind
from jeit.image.merit import FiguresOfMerit
from jeit.plot.axes import INK, SERIES_COLOURS, SERIES_MARKERS, SOFT, axes_or_new, draw_horizontal_grid, soften_axes

# Field, title, unit on the axis, factor to that unit, and the value that a perfect image would have, if there is one.
_PANELS = (
    ("amplitude_response", "Amplitude response", "image / truth", 1.0, 1.0),
    ("position_error", "Position error", "mm (+ is towards the centre)", 1e3, 0.0),
    ("resolution", "Resolution", "% of the body's radius", 1e2, None),
    ("shape_deformation", "Shape deformation", "% of the image's area", 1e2, 0.0),
    ("ringing", "Ringing", "% of the target's image", 1e2, 0.0),
)


def plot_figures_of_merit(
    figures: Mapping[str, FiguresOfMerit], *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the five GREIT figures of merit of one or several reconstructions against the distance of the targets.

    `figures`: the name of each reconstruction, for the legend, with its figures for many targets (T,), as
    `jeit.image.figures_of_merit` gives them. Lines go through the mean of targets at the same distance; grey dashes
    are what a perfect image has. The five plots are insets of the axes returned. Raises `ValueError` for no figures,
    more than six reconstructions, or figures of a single image.
    """
    check_kind("figures", figures, Mapping, "{name: figures}, as of jeit.image.figures_of_merit")
    if not 1 <= len(figures) <= len(SERIES_COLOURS):
        raise ValueError(
            f"figures has {len(figures)} reconstructions; give 1 to {len(SERIES_COLOURS)}, {{name: figures}}."
        )
    for name, merit in figures.items():
        if not isinstance(merit, FiguresOfMerit) or np.ndim(merit.distance) != 1:
            raise ValueError(f"figures['{name}'] must be what figures_of_merit gives for many targets (T,).")
    ax = axes_or_new(ax, (10.6, 5.6))
    ax.set_axis_off()
    ax.set_title(title or "")
    reach = max(1e3 * float(np.max(merit.body_radius)) for merit in figures.values())
    for number, (field, heading, unit, factor, perfect) in enumerate(_PANELS):
        column, row = number % 3, number // 3
        panel = ax.inset_axes((0.36 * column, 0.55 * (1 - row), 0.28, 0.43))
        if perfect is not None:
            panel.axhline(factor * perfect, color=SOFT, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1)
        for merit, colour, marker in zip(figures.values(), SERIES_COLOURS, SERIES_MARKERS, strict=False):
            distance, value = 1e3 * np.asarray(merit.distance), factor * np.asarray(getattr(merit, field))
            shown = np.isfinite(value)
            place, mean = _means(distance[shown], value[shown], 1e-3 * reach)
            panel.plot(place, mean, color=colour, linewidth=1.6, zorder=3)
            panel.plot(distance[shown], value[shown], marker, color=colour, markersize=3.2, zorder=3)
        _dress(panel, heading, unit, reach)
        if number >= 2:  # the lowest of its column
            panel.set_xlabel("Target's distance from the centre (mm)", fontsize=9, color=INK)
    styles = zip(figures, SERIES_COLOURS, SERIES_MARKERS, strict=False)
    lines = [Line2D([], [], color=colour, marker=marker, markersize=5, label=name) for name, colour, marker in styles]
    lines.append(Line2D([], [], color=SOFT, linewidth=1.0, linestyle=(0, (4, 3)), label="perfect image"))
    ax.legend(handles=lines, frameon=False, loc="center", bbox_to_anchor=(0.72, 0, 0.28, 0.43), fontsize=11)
    return ax


def _means(distance: np.ndarray, value: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances in order, and the mean of the values at each; those closer than `tolerance` are one."""
    ring, inverse = np.unique(np.round(distance / tolerance), return_inverse=True)
    return ring * tolerance, np.bincount(inverse, value) / np.bincount(inverse)


def _dress(panel: Axes, heading: str, unit: str, reach: float) -> None:
    panel.set_title(heading, loc="left", fontsize=11, color=INK)
    panel.set_ylabel(unit, fontsize=9, color=INK)
    panel.set_xlim(0, reach)
    low, high = panel.get_ylim()
    panel.set_ylim(min(low, 0), high)  # from zero: what varies little should look so
    soften_axes(panel)
    panel.tick_params(length=3, labelsize=9)
    draw_horizontal_grid(panel)
