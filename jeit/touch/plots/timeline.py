"""Plots over time: changes, named touches and labels of sounds; and paths of touches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh
from jeit.plot.axes import (
    INK,
    SERIES_COLOURS,
    SOFT,
    axes_or_new,
    draw_colour_bar,
    draw_scale_bar,
    extent_of,
    hide_axes,
    soften_axes,
    with_si_prefix,
)
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import draw_outline
from jeit.touch.gestures.touch_watch import NamedTouch
from jeit.touch.listening import SoundLabels
from jeit.touch.listening.feature_images import WINDOW_INTERVAL

# Gap between frames, as a multiple of the median interval, at which a curve is interrupted; maximum number of points of
# a curve; minimum length of a bar, as a share of the whole time; maximum number of touches with numbers.
_LONG_GAP, _POINTS, _SHORTEST, _NUMBERED = 10.0, 3000, 0.003, 60
_UNLIKE = "#b9bdc4"


def plot_changes(
    seconds: ArrayLike,
    peaks: ArrayLike,
    level: float,
    *,
    unit: str = "S",
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the maximum change `peaks` (F,) of frames at times `seconds` (F,), and the `level` that touches exceed, both
    in `unit`.

    Refused frames, which are NaN, leave gaps. Raises `ValueError` for shapes that do not match.
    """
    when, values = np.asarray(seconds, float), np.asarray(peaks, float)
    if when.shape != values.shape or when.ndim != 1:
        raise ValueError(f"peaks have shape {values.shape} and seconds {when.shape}; give one of each for every frame.")
    ax = axes_or_new(ax, (9.0, 2.6))
    factor, name = with_si_prefix(float(np.nanmax(values, initial=level)), unit)
    ax.plot(*_reduce_points(*_interrupt_at_gaps(when, factor * values)), color=INK, linewidth=0.8)
    ax.axhline(factor * level, color=SOFT, linewidth=1, linestyle=(0, (4, 3)))
    ax.text(1, factor * level, " level", color=SOFT, fontsize=8, va="center", transform=ax.get_yaxis_transform())
    ax.set_ylabel(f"Greatest change ({name})", color=INK)
    ax.set_ylim(bottom=min(0.0, factor * float(np.nanmin(values, initial=0.0))))
    soften_axes(ax)
    if title is not None:
        ax.set_title(title)
    return ax


def plot_timeline(
    touches: Sequence[NamedTouch], names: Sequence[str], *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw classified touches from onset to end, each in the lane of its predicted gesture.

    Bars are fainter for less probable gestures; touches unlike any in the training set have their own lane.

    **Arguments:**

    - `touches`: the touches, as from `TouchWatch.follow`.
    - `names`: names (C,) of the gestures.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

    Raises `ValueError` if an item of the list is not a `NamedTouch`.

    **Example:**

    ```python
    ax = plot_timeline(named_touches, gestures.names)
    ax.figure.savefig("timeline.png")
    ```
    """
    check_named_touches(touches)
    ax = axes_or_new(ax, (9.0, 2.6))
    lanes = [*names, *(["unlike any"] if any(one.unlike for one in touches) else [])]
    ends = [one.touch.offset for one in touches]
    span = max(ends, default=1.0) - min((one.touch.onset for one in touches), default=0.0)
    for one in touches:
        lane = len(names) if one.unlike else lanes.index(one.gesture)
        length = max(one.touch.offset - one.touch.onset, _SHORTEST * span)
        bar = Rectangle(
            (one.touch.onset, lane - 0.36),
            length,
            0.72,
            color=gesture_colour(one, names),
            alpha=_opacity(one),
            linewidth=0,
        )
        ax.add_patch(bar)
        if not one.touch.whole:
            ax.plot(
                one.touch.offset if one.touch.cut_off else one.touch.onset, lane, marker="|", color=INK, markersize=14
            )
        if len(touches) <= _NUMBERED:
            where = (one.touch.onset + length / 2, lane - 0.42)
            ax.annotate(f"{one.number}", where, (0, 1), textcoords="offset points", ha="center", color=INK, fontsize=7)
    ax.set_yticks(range(len(lanes)), lanes)
    ax.set_ylim(len(lanes) - 0.4, -0.75)
    ax.autoscale_view(scaley=False)
    ax.set_xlabel("Time (s)", color=INK)
    soften_axes(ax)
    if title is not None:
        ax.set_title(title)
    return ax


def plot_touch_paths(
    mesh: Mesh,
    touches: Sequence[NamedTouch],
    names: Sequence[str],
    electrodes: AbstractElectrodes | None = None,
    *,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the skin and the paths of touches, each a line from a dot at its start, in the colour of its gesture. The
    number of each touch is written beside it.

    **Arguments:**

    - `mesh`: mesh of the images.
    - `touches`: the touches, as from `TouchWatch.follow`.
    - `names`: names (C,) of the gestures.
    - `electrodes`: electrodes to be drawn.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

    Raises `ValueError` if an item of the list is not a `NamedTouch`.

    **Example:**

    ```python
    ax = plot_touch_paths(images.mesh, named_touches, gestures.names)
    ax.figure.savefig("paths.png")
    ```
    """
    check_named_touches(touches)
    ax = axes_or_new(ax)
    extent = extent_of(np.asarray(mesh.points))
    draw_outline(mesh, ax)
    if electrodes is not None:
        draw_electrodes(mesh, electrodes, numbers=False, ax=ax)
    for one in touches:
        place = one.touch.course.centroid
        place = place[np.isfinite(place).all(axis=1)]
        if len(place):
            colour = gesture_colour(one, names)
            ax.plot(*place.T, color=colour, linewidth=1.4, alpha=_opacity(one), zorder=3)
            ax.plot(
                *place[0], marker="o", markersize=4.5, color=colour, alpha=_opacity(one), markeredgewidth=0, zorder=4
            )
            if len(touches) <= _NUMBERED:
                ax.annotate(
                    f"{one.number}", place[0], (4, 2), textcoords="offset points", color=INK, fontsize=7, zorder=5
                )
    hide_axes(ax, extent)
    draw_scale_bar(ax, extent)
    if title is not None:
        ax.set_title(title)
    return ax


def gesture_colour(touch: NamedTouch, names: Sequence[str]) -> str:
    """Colour of a touch's gesture; grey for touches unlike any in the training set."""
    return _UNLIKE if touch.unlike else SERIES_COLOURS[list(names).index(touch.gesture) % len(SERIES_COLOURS)]


def check_named_touches(touches) -> None:
    """Check that `touches` is a list of named touches. Raises `ValueError` otherwise."""
    check_kind("touches", touches, (list, tuple), "a list of named touches, as TouchWatch.follow gives them")
    for number, one in enumerate(touches):
        check_kind(f"touches[{number}]", one, NamedTouch, "a NamedTouch")


def _opacity(touch: NamedTouch) -> float:
    return 1.0 if touch.unlike else 0.35 + 0.65 * touch.probability


def _interrupt_at_gaps(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert NaN into a curve at long gaps between frames, so that it is interrupted."""
    passed = np.diff(times)
    gaps = 1 + np.flatnonzero(passed > _LONG_GAP * np.median(passed)) if passed.size else np.zeros(0, int)
    return np.insert(times, gaps, times[gaps]), np.insert(values, gaps, np.nan)


def _reduce_points(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve to about `_POINTS` points, keeping its extremes."""
    if len(times) <= _POINTS:
        return times, values
    parts = np.array_split(np.arange(len(times)), _POINTS // 2)
    filled = np.where(np.isfinite(values), values, 0.0)
    rows = np.unique([part[at] for part in parts for at in (filled[part].argmin(), filled[part].argmax())])
    return times[rows], values[rows]


def plot_sound_labels(labels: SoundLabels, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the probability of every name over time, one row per name, with a bar below the chosen name during each
    sound; quiet windows are blank.

    **Arguments:**

    - `labels`: the classified recording, as from `Listener.classify`.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

    **Example:**

    ```python
    ax = plot_sound_labels(listener.classify(recordings[0]))
    ax.figure.savefig("sounds.png")
    ```
    """
    ax = axes_or_new(ax, (8.0, 3.2))
    names, times = labels.names, labels.times
    shown = np.where((labels.named != "")[:, None], labels.probabilities, np.nan).T
    extent = (float(times[0]) - WINDOW_INTERVAL / 2, float(times[-1]) + WINDOW_INTERVAL / 2, -0.5, len(names) - 0.5)
    drawn = ax.imshow(
        100 * shown,
        aspect="auto",
        origin="lower",
        extent=extent,
        cmap="Blues",
        vmin=0,
        vmax=100,
        interpolation="nearest",
    )
    draw_colour_bar(ax, drawn, "Probability (%)")
    for event in labels.events:
        if event.name:
            row, span = names.index(event.name) - 0.42, [event.start, event.end]
            ax.plot(span, [row, row], color=SERIES_COLOURS[1], linewidth=2.5, solid_capstyle="butt")
    ax.set_yticks(range(len(names)), names)
    ax.set_xlim(0, extent[1])
    ax.set_xlabel("Time (s)", color=INK)
    quiet = int((labels.named == "").sum())
    said = f"{labels.name}: sounds in red" + (f"; blank, {quiet} of {len(labels)} windows quiet" if quiet else "")
    ax.set_title(said if title is None else title)
    soften_axes(ax)
    return ax
