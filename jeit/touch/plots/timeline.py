"""Plots of changes, classified touches and classified sounds over time, and of the paths of touches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh
from jeit.plot.axes import draw_scale_bar, extent_of, get_or_create_axes, hide_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SERIES_COLOURS, choose_si_prefix, draw_colour_bar
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import draw_outline
from jeit.touch.gestures.touch_watch import NamedTouch
from jeit.touch.listening import SoundLabels
from jeit.touch.listening.feature_images import WINDOW_INTERVAL

# Minimum gap between frames at which a curve is interrupted, as a multiple of the median interval.
_MIN_GAP_RATIO = 10.0
# Maximum number of points of a curve.
_MAX_CURVE_POINTS = 3000
# Minimum length of a touch's bar, as a share of the whole time.
_MIN_BAR_SHARE = 0.003
# Maximum number of touches with numbers.
_MAX_NUMBERED_TOUCHES = 60
_UNKNOWN_TOUCH_COLOUR = "#b9bdc4"


def plot_changes(
    seconds: ArrayLike,
    peaks: ArrayLike,
    level: float,
    *,
    unit: str = "S",
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the maximum change of conductivity over time, and the level that touches exceed.

    `seconds` (F,): times of the frames; `peaks` (F,): maximum change in each frame, in `unit`; `level`: the level, in
    `unit`. Refused frames, which are NaN, leave gaps. Raises `ValueError` if `seconds` and `peaks` differ in shape.
    """
    frame_times, peak_changes = np.asarray(seconds, float), np.asarray(peaks, float)
    if frame_times.shape != peak_changes.shape or frame_times.ndim != 1:
        raise ValueError(
            f"peaks have shape {peak_changes.shape} and seconds {frame_times.shape}; give one of each for every frame."
        )
    ax = get_or_create_axes(ax, (9.0, 2.6))
    unit_factor, prefixed_unit = choose_si_prefix(float(np.nanmax(peak_changes, initial=level)), unit)
    ax.plot(
        *_reduce_points(*_interrupt_at_gaps(frame_times, unit_factor * peak_changes)), color=DARK_GREY, linewidth=0.8
    )
    ax.axhline(unit_factor * level, color=LIGHT_GREY, linewidth=1, linestyle=(0, (4, 3)))
    ax.text(
        1, unit_factor * level, " level", color=LIGHT_GREY, fontsize=8, va="center", transform=ax.get_yaxis_transform()
    )
    ax.set_ylabel(f"Greatest change ({prefixed_unit})", color=DARK_GREY)
    ax.set_ylim(bottom=min(0.0, unit_factor * float(np.nanmin(peak_changes, initial=0.0))))
    style_graph_axes(ax)
    if title is not None:
        ax.set_title(title)
    return ax


def plot_timeline(
    touches: Sequence[NamedTouch], names: Sequence[str], *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw classified touches from onset to end, each in the lane of its predicted gesture.

    Bars are fainter for less probable gestures; touches unlike any in the training set have their own lane.

    **Arguments:**

    - `touches`: the classified touches, as returned by `TouchWatch.follow`.
    - `names`: names (C,) of the gestures.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if an item of `touches` is not a `NamedTouch`.

    **Example:**

    ```python
    ax = plot_timeline(named_touches, gestures.names)
    ax.figure.savefig("timeline.png")
    ```
    """
    check_named_touches(touches)
    ax = get_or_create_axes(ax, (9.0, 2.6))
    row_names = [*names, *(["unlike any"] if any(touch.unlike for touch in touches) else [])]
    touch_end_times = [touch.touch.offset for touch in touches]
    timeline_duration = max(touch_end_times, default=1.0) - min((touch.touch.onset for touch in touches), default=0.0)
    for touch in touches:
        row_index = len(names) if touch.unlike else row_names.index(touch.gesture)
        bar_length = max(touch.touch.offset - touch.touch.onset, _MIN_BAR_SHARE * timeline_duration)
        touch_bar = Rectangle(
            (touch.touch.onset, row_index - 0.36),
            bar_length,
            0.72,
            color=gesture_colour(touch, names),
            alpha=_touch_opacity(touch),
            linewidth=0,
        )
        ax.add_patch(touch_bar)
        if not touch.touch.whole:
            ax.plot(
                touch.touch.offset if touch.touch.cut_off else touch.touch.onset,
                row_index,
                marker="|",
                color=DARK_GREY,
                markersize=14,
            )
        if len(touches) <= _MAX_NUMBERED_TOUCHES:
            label_position = (touch.touch.onset + bar_length / 2, row_index - 0.42)
            ax.annotate(
                f"{touch.number}",
                label_position,
                (0, 1),
                textcoords="offset points",
                ha="center",
                color=DARK_GREY,
                fontsize=7,
            )
    ax.set_yticks(range(len(row_names)), row_names)
    ax.set_ylim(len(row_names) - 0.4, -0.75)
    ax.autoscale_view(scaley=False)
    ax.set_xlabel("Time (s)", color=DARK_GREY)
    style_graph_axes(ax)
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
    """Draw the outline of a skin and the paths of touches on it, in the colours of their gestures.

    Each path is a line from a dot at its start. The number of each touch is written beside the dot.

    **Arguments:**

    - `mesh`: mesh of the images of the skin.
    - `touches`: the classified touches, as returned by `TouchWatch.follow`.
    - `names`: names (C,) of the gestures.
    - `electrodes`: electrodes to be drawn.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if an item of `touches` is not a `NamedTouch`.

    **Example:**

    ```python
    ax = plot_touch_paths(images.mesh, named_touches, gestures.names)
    ax.figure.savefig("paths.png")
    ```
    """
    check_named_touches(touches)
    ax = get_or_create_axes(ax)
    extent = extent_of(np.asarray(mesh.points))
    draw_outline(mesh, ax)
    if electrodes is not None:
        draw_electrodes(mesh, electrodes, numbers=False, ax=ax)
    for touch in touches:
        touch_centroids = touch.touch.course.centroid
        touch_centroids = touch_centroids[np.isfinite(touch_centroids).all(axis=1)]
        if len(touch_centroids):
            path_colour = gesture_colour(touch, names)
            ax.plot(*touch_centroids.T, color=path_colour, linewidth=1.4, alpha=_touch_opacity(touch), zorder=3)
            ax.plot(
                *touch_centroids[0],
                marker="o",
                markersize=4.5,
                color=path_colour,
                alpha=_touch_opacity(touch),
                markeredgewidth=0,
                zorder=4,
            )
            if len(touches) <= _MAX_NUMBERED_TOUCHES:
                ax.annotate(
                    f"{touch.number}",
                    touch_centroids[0],
                    (4, 2),
                    textcoords="offset points",
                    color=DARK_GREY,
                    fontsize=7,
                    zorder=5,
                )
    hide_axes(ax, extent)
    draw_scale_bar(ax, extent)
    if title is not None:
        ax.set_title(title)
    return ax


def gesture_colour(touch: NamedTouch, names: Sequence[str]) -> str:
    """Return the colour of a touch's gesture in plots; grey for touches unlike any in the training set."""
    return (
        _UNKNOWN_TOUCH_COLOUR
        if touch.unlike
        else SERIES_COLOURS[list(names).index(touch.gesture) % len(SERIES_COLOURS)]
    )


def check_named_touches(touches) -> None:
    """Raise `ValueError` unless `touches` is a list of `NamedTouch`, touches with a predicted gesture."""
    check_kind("touches", touches, (list, tuple), "a list of named touches, as TouchWatch.follow gives them")
    for touch_index, touch in enumerate(touches):
        check_kind(f"touches[{touch_index}]", touch, NamedTouch, "a NamedTouch")


def _touch_opacity(touch: NamedTouch) -> float:
    return 1.0 if touch.unlike else 0.35 + 0.65 * touch.probability


def _interrupt_at_gaps(times: np.ndarray, curve_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert NaN into a curve of values over times at long gaps between frames, so that the curve is interrupted."""
    time_intervals = np.diff(times)
    gap_indices = (
        1 + np.flatnonzero(time_intervals > _MIN_GAP_RATIO * np.median(time_intervals))
        if time_intervals.size
        else np.zeros(0, int)
    )
    return np.insert(times, gap_indices, times[gap_indices]), np.insert(curve_values, gap_indices, np.nan)


def _reduce_points(times: np.ndarray, curve_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve of values over times to about `_MAX_CURVE_POINTS` points, keeping its extremes."""
    if len(times) <= _MAX_CURVE_POINTS:
        return times, curve_values
    index_segments = np.array_split(np.arange(len(times)), _MAX_CURVE_POINTS // 2)
    filled_values = np.where(np.isfinite(curve_values), curve_values, 0.0)
    kept_indices = np.unique(
        [
            index_segment[extreme_index]
            for index_segment in index_segments
            for extreme_index in (filled_values[index_segment].argmin(), filled_values[index_segment].argmax())
        ]
    )
    return times[kept_indices], curve_values[kept_indices]


def plot_sound_labels(labels: SoundLabels, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the probability of every class of sound over time, in one row per class.

    A bar in the row of the most likely class marks each sound. Quiet windows of the recording are blank.

    **Arguments:**

    - `labels`: the classified recording, as returned by `Listener.classify`.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    **Example:**

    ```python
    ax = plot_sound_labels(listener.classify(recordings[0]))
    ax.figure.savefig("sounds.png")
    ```
    """
    ax = get_or_create_axes(ax, (8.0, 3.2))
    class_names, window_times = labels.names, labels.times
    shown_probabilities = np.where((labels.named != "")[:, None], labels.probabilities, np.nan).T
    extent = (
        float(window_times[0]) - WINDOW_INTERVAL / 2,
        float(window_times[-1]) + WINDOW_INTERVAL / 2,
        -0.5,
        len(class_names) - 0.5,
    )
    probability_image = ax.imshow(
        100 * shown_probabilities,
        aspect="auto",
        origin="lower",
        extent=extent,
        cmap="Blues",
        vmin=0,
        vmax=100,
        interpolation="nearest",
    )
    draw_colour_bar(ax, probability_image, "Probability (%)")
    for event in labels.events:
        if event.name:
            bar_height, bar_limits = class_names.index(event.name) - 0.42, [event.start, event.end]
            ax.plot(bar_limits, [bar_height, bar_height], color=SERIES_COLOURS[1], linewidth=2.5, solid_capstyle="butt")
    ax.set_yticks(range(len(class_names)), class_names)
    ax.set_xlim(0, extent[1])
    ax.set_xlabel("Time (s)", color=DARK_GREY)
    num_quiet = int((labels.named == "").sum())
    default_title = f"{labels.name}: sounds in red" + (
        f"; blank, {num_quiet} of {len(labels)} windows quiet" if num_quiet else ""
    )
    ax.set_title(default_title if title is None else title)
    style_graph_axes(ax)
    return ax
