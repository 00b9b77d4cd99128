"""Plot of the map of one touch: the objective at every position of the skin."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from jeit.acoustic.plots.surface_view import (
    FOUND,
    HALO,
    MICROPHONE,
    AnySurface,
    View,
    draw_ellipse,
    draw_legend,
    draw_surface,
    outline_of,
    view_of,
)
from jeit.arguments import check_kind, check_name
from jeit.plot.axes import INK, SEQUENTIAL, axes_or_new, draw_colour_bar

# Range in decibels over which the size of a microphone's circle shows the received intensity.
_RANGE = 30.0
# Range of a map above its minimum, in standard deviations or decibels.
_MOST = {"likelihood": 15.0, "consistency": 40.0}
_MAP_LABELS = {
    "likelihood": "Standard deviations worse than the best place",
    "consistency": "Loss above the least (dB)",
}


class Marks(NamedTuple):
    """Positions marked on a map: the `truth` (d,) and an `estimate` (d,), metres, whose `covariance` (d, d), m², is
    drawn as its 95 % ellipse."""

    truth: ArrayLike | None = None
    estimate: ArrayLike | None = None
    covariance: ArrayLike | None = None


def plot_loss_map(
    values: ArrayLike,
    surface: AnySurface,
    *,
    microphones: ArrayLike | None = None,
    received: ArrayLike | None = None,
    marks: Marks | None = None,
    method: str = "likelihood",
    title: str | None = None,
    colour_bar: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Plot the map of one frame from `Localiser.with_maps`; it is brightest where the touch most probably is.

    `values` (rows, columns), bottom row first, over the box of the outline, NaN outside it. `surface`: a `Calibration`,
    `MicrophoneArray`, a surface, or an outline. `microphones` (M, d): metres, those of the array unless given; the size
    of their circles increases with the intensities `received` (M,). `marks`: the truth and an estimate to mark.
    `method`: "likelihood" maps are drawn as √(2 (map − least)), the number of standard deviations by which a position
    is worse than the best; the paper's loss, "consistency", in decibels above its minimum. Raises `ValueError` for
    other methods and shapes, and for marks that are none.
    """
    if marks is not None:
        check_kind("marks", marks, Marks, "Marks, such as Marks(truth=(0.02, 0.01))")
    pixels = np.asarray(values, float)
    if pixels.ndim != 2 or not np.isfinite(pixels).any():
        raise ValueError(f"values has shape {pixels.shape}; give (rows, columns) with at least one finite value.")
    check_name("method", method, _MAP_LABELS)
    view = view_of(surface, microphones)
    number = len(view.microphones)
    level = None if received is None else np.asarray(received, float)
    if level is not None and level.shape != (number,):
        raise ValueError(f"received has shape {level.shape}; give one for each of the {number} microphones.")
    ax = axes_or_new(ax)
    shown = _above_least(pixels, method)
    most = min(float(np.nanmax(shown)), _MOST[method]) or 1.0
    colours = colormaps[SEQUENTIAL + "_r"].copy()
    colours.colorbar_extend = "max" if np.nanmax(shown) > most else "neither"  # pyright: ignore[reportAttributeAccessIssue]
    drawn = ax.imshow(shown, extent=view.extent, origin="lower", interpolation="nearest", cmap=colours, clim=(0, most))
    drawn.set_clip_path(outline_of(view), ax.transData)
    handles = draw_surface(ax, view, microphones=level is None and number > 0)
    if level is not None:
        handles.append(_draw_levels(ax, view.microphones, level))
    if marks is not None:
        handles += _draw_marks(ax, view, marks)
    draw_legend(ax, handles)
    ax.set_title(title or "")
    if colour_bar:
        draw_colour_bar(ax, drawn, _MAP_LABELS[method])
    return ax


def _draw_marks(ax: Axes, view: View, marks: Marks) -> list[Line2D]:
    """Draw the marks and return their legend entries. Raises `ValueError` for shapes that do not match the surface."""
    if marks.covariance is not None and marks.estimate is None:
        raise ValueError("covariance needs an estimate: the place that it is the covariance of.")
    handles = []
    style: dict[str, Any] = {"linestyle": "none", "zorder": 5, "path_effects": HALO}
    if marks.truth is not None:
        cross: dict[str, Any] = {"marker": "+", "color": INK, "markersize": 13, "markeredgewidth": 1.8}
        handles += ax.plot(*view.chart_point(marks.truth, "truth"), label="truth", **cross, **style)
    if marks.estimate is not None:
        found, label = view.chart_point(marks.estimate, "estimate"), "estimate"
        if marks.covariance is not None:
            draw_ellipse(ax, found, view.chart_covariance(marks.covariance, marks.estimate))
            label = "estimate, 95 %"
        handles += ax.plot(*found, marker="o", color=FOUND, markersize=5.5, label=label, **style)
    return handles


def _above_least(pixels: np.ndarray, method: str) -> np.ndarray:
    least = np.nanmin(pixels)
    if method == "likelihood":
        return np.sqrt(2 * (pixels - least))
    # The loss may vanish in the noiseless case: it is clipped at 120 dB below its maximum.
    bottom = max(least, 1e-12 * np.nanmax(pixels), np.finfo(float).tiny)
    return 10 * np.log10(np.maximum(pixels, bottom) / bottom)


def _draw_levels(ax: Axes, place: np.ndarray, received: np.ndarray) -> Line2D:
    """Draw the microphones as circles with areas proportional to their levels in decibels above the least shown."""
    positive = np.isfinite(received) & (received > 0)
    loudest = received[positive].max(initial=1e-300)
    level = 10 * np.log10(np.where(positive, received, 1e-300) / loudest)
    area = 8 + 150 * np.clip(1 + level / _RANGE, 0, 1)
    ax.scatter(*place.T, s=area, facecolor="white", edgecolor=MICROPHONE, linewidth=1.2, alpha=0.9, zorder=3)
    return Line2D(
        [],
        [],
        marker="o",
        linestyle="none",
        markersize=8,
        markerfacecolor="white",
        markeredgecolor=MICROPHONE,
        label="microphone, by level",
    )
