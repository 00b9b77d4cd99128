"""Plots of the damage of a skin: cuts and failed electrodes on the sheet, and changes over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.plot.axes import draw_scale_bar, extent_of, get_or_create_axes, hide_axes, style_graph_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, LIGHT_GREY, SERIES_COLOURS, ColourScale
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import draw_outline, plot_image
from jeit.touch.health import EventKind, EventStatus, HealthEvent, SkinHealth
from jeit.touch.health.event import change_size

_WHITE_HALO = [withStroke(linewidth=4, foreground="white")]
_CUT_COLOUR, _MENDED_COLOUR = SERIES_COLOURS[1], SERIES_COLOURS[2]


def plot_health(
    health: SkinHealth,
    image: ArrayLike | None = None,
    *,
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a skin with its cuts and failed electrodes.

    Each cut is labelled with its length, the standard deviation of the length, and the time when it occurred; mended
    cuts are dashed. A cross marks every failed electrode.

    **Arguments:**

    - `health`: health of the monitored skin, with a model of the skin.
    - `image`: image (m,) that is drawn below the damage, as returned by `SkinHealth.images`, S (3-D: S/m).
    - `scale`: mapping from values of the image to colours.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for a skin without a model, and as `jeit.plot.plot_image`.

    **Example:**

    ```python
    ax = plot_health(modelled_health)
    ax.figure.savefig("health.png")
    ```
    """
    check_kind("health", health, SkinHealth, "a SkinHealth, as of SkinHealth.fit(frames, model=model, …)")
    if health.skin is None:
        raise ValueError(
            "health has no model: give it to SkinHealth.fit, and it knows where the skin's electrodes are."
        )
    mesh, electrodes = health.skin.model.mesh, health.skin.model.electrodes
    if image is not None:
        ax = plot_image(mesh, image, electrodes, scale=scale, title=title, ax=ax)
    else:
        ax = get_or_create_axes(ax)
        extent = extent_of(np.asarray(mesh.points))
        draw_outline(mesh, ax)
        draw_electrodes(mesh, electrodes, ax=ax)
        hide_axes(ax, extent)
        draw_scale_bar(ax, extent)
        if title:
            ax.set_title(title)
    for event in health.events:
        if event.path is not None and event.status != EventStatus.DENIED:
            _draw_cut(ax, event)
    failed_electrodes = [event.electrode for event in health.open_events if event.electrode is not None]
    if failed_electrodes:
        electrode_places = np.asarray(electrodes.position)[failed_electrodes, :2]  # pyright: ignore[reportAttributeAccessIssue]
        ax.plot(
            *electrode_places.T,
            "x",
            color=_CUT_COLOUR,
            markersize=11,
            markeredgewidth=2.4,
            zorder=6,
            path_effects=_WHITE_HALO,
        )
    return ax


def _draw_cut(ax: Axes, event: HealthEvent) -> None:
    """Draw the path of a cut, labelled with its length and time; a mended cut is dashed."""
    is_mended, cut_path = event.status == EventStatus.MENDED, np.asarray(event.path)
    cut_colour = _MENDED_COLOUR if is_mended else _CUT_COLOUR
    line_style = (0, (2.5, 1.5)) if is_mended else "-"
    ax.plot(*cut_path.T, color=cut_colour, linestyle=line_style, linewidth=2.4, zorder=5, path_effects=_WHITE_HALO)
    # The standard deviation of the length is omitted where it rounds to 0 mm.
    deviation_text = f" ± {1e3 * event.deviation:.0f}" if 1e3 * event.deviation >= 0.5 else ""
    cut_label = (
        f"{'mended' if is_mended else 'cut'}, {1e3 * event.length:.0f}{deviation_text} mm, at {event.time:.4g} s"
    )
    left_limit, right_limit = ax.get_xlim()
    highest_point = cut_path[cut_path[:, 1].argmax()]
    # A label near the edge of the skin extends away from the edge.
    relative_x = (highest_point[0] - left_limit) / (right_limit - left_limit)
    text_alignment = "left" if relative_x < 0.25 else "right" if relative_x > 0.75 else "center"
    ax.annotate(
        cut_label,
        highest_point,
        (0, 7),
        textcoords="offset points",
        ha=text_alignment,
        color=cut_colour,
        fontsize=9,
        zorder=7,
        path_effects=_WHITE_HALO,
    )


# Maximum number of events with labels.
_MAX_LABELS = 12
# Minimum upper end of the y axis, as a multiple of the limit of damage.
_MIN_AXIS_LIMIT = 1.5


def plot_health_course(
    health: SkinHealth, times: ArrayLike, frames: ArrayLike, *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the change of frames relative to the healthy skin over time, and a line at the time of every event.

    The change is given in multiples of the limit above which a lasting change counts as damage. Touches may cause
    changes as large as those of damage, but these changes do not last.

    **Arguments:**

    - `health`: health of the skin after these frames, as returned by `watch`.
    - `times`: times (F,) of the frames, seconds.
    - `frames`: frames (F, M), volts.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` unless `frames` has a row for each time and a column for each channel of the skin.

    **Example:**

    ```python
    ax = plot_health_course(watch(health, damaged), np.arange(len(damaged)), damaged)
    ax.figure.savefig("course.png")
    ```
    """
    check_kind("health", health, SkinHealth, "a SkinHealth, as of watch(health, frames)")
    time_values, frame_values = np.asarray(times, float), np.asarray(frames, float)
    if frame_values.shape != (len(time_values), health.reference.size):
        raise ValueError(f"frames have shape {frame_values.shape}; give ({len(time_values)}, {health.reference.size}).")
    healthy_state = health.healthy
    has_reading = healthy_state.used & np.isfinite(frame_values)
    scaled_changes = np.where(
        has_reading,
        (frame_values - healthy_state.reference) / np.where(healthy_state.used, healthy_state.scale, np.inf),
        np.nan,
    )
    relative_changes = np.where(has_reading.any(axis=1), change_size(scaled_changes) / healthy_state.limit, np.nan)
    ax = get_or_create_axes(ax, (9.0, 3.2))
    ax.plot(time_values, relative_changes, color=DARK_GREY, linewidth=0.8)
    ax.axhline(1.0, color=LIGHT_GREY, linewidth=1, linestyle=(0, (4, 3)))
    ax.text(1, 1.0, " limit", color=LIGHT_GREY, fontsize=8, va="center", transform=ax.get_yaxis_transform())
    for event in health.events:
        event_colour = SERIES_COLOURS[2] if event.kind == EventKind.REPAIRED else SERIES_COLOURS[1]
        ax.axvline(event.time, color=event_colour, linewidth=1.4)
        if len(health.events) <= _MAX_LABELS:
            electrode_text = "" if event.electrode is None else f" {event.electrode + 1}"
            ax.annotate(
                f"{event.kind}{electrode_text}",
                (event.time, 1),
                (3, -3 - 11 * (event.number % 3)),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                va="top",
                color=event_colour,
                fontsize=8,
            )
    ax.set_yscale("symlog", linthresh=1.0)
    ax.yaxis.set_major_formatter(lambda tick_value, _: f"{tick_value:g}")
    ax.set_ylim(0, max(_MIN_AXIS_LIMIT, 1.6 * float(np.nanmax(relative_changes, initial=1.0))))
    ax.set_ylabel("Change, times the limit", color=DARK_GREY)
    style_graph_axes(ax)
    if title is not None:
        ax.set_title(title)
    return ax
