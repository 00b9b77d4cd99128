"""Plots of the damage of a skin on its sheet, and over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.plot.axes import (
    CHANGE,
    INK,
    SERIES_COLOURS,
    SOFT,
    ColourScale,
    axes_or_new,
    draw_scale_bar,
    extent_of,
    hide_axes,
    soften_axes,
)
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import draw_outline, plot_image
from jeit.touch.health import EventKind, EventStatus, HealthEvent, SkinHealth
from jeit.touch.health.event import change_size

_HALO = [withStroke(linewidth=4, foreground="white")]
_CUT, _MENDED = SERIES_COLOURS[1], SERIES_COLOURS[2]


def plot_health(
    health: SkinHealth,
    image: ArrayLike | None = None,
    *,
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a skin with its cuts and failed electrodes.

    Each cut is labelled with its length, the standard deviation of the length, and the time when it occurred; mended
    cuts are dashed. A cross marks every failed electrode.

    **Arguments:**

    - `health`: the monitored skin, with a model.
    - `image`: image (m,) that is drawn below, as from `SkinHealth.images`, S (3-D: S/m).
    - `scale`: mapping from its values to colours.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

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
        ax = axes_or_new(ax)
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
    failed = [one.electrode for one in health.open_events if one.electrode is not None]
    if failed:
        places = np.asarray(electrodes.position)[failed, :2]  # pyright: ignore[reportAttributeAccessIssue]
        ax.plot(*places.T, "x", color=_CUT, markersize=11, markeredgewidth=2.4, zorder=6, path_effects=_HALO)
    return ax


def _draw_cut(ax: Axes, event: HealthEvent) -> None:
    mended, path = event.status == EventStatus.MENDED, np.asarray(event.path)
    colour = _MENDED if mended else _CUT
    style = (0, (2.5, 1.5)) if mended else "-"
    ax.plot(*path.T, color=colour, linestyle=style, linewidth=2.4, zorder=5, path_effects=_HALO)
    # The deviation is omitted where it rounds to 0 mm.
    known = f" ± {1e3 * event.deviation:.0f}" if 1e3 * event.deviation >= 0.5 else ""
    said = f"{'mended' if mended else 'cut'}, {1e3 * event.length:.0f}{known} mm, at {event.time:.4g} s"
    low, high = ax.get_xlim()
    top = path[path[:, 1].argmax()]
    # A label near the edge of the skin extends away from the edge.
    share = (top[0] - low) / (high - low)
    aligned = "left" if share < 0.25 else "right" if share > 0.75 else "center"
    ax.annotate(
        said,
        top,
        (0, 7),
        textcoords="offset points",
        ha=aligned,
        color=colour,
        fontsize=9,
        zorder=7,
        path_effects=_HALO,
    )


# Maximum number of events with labels; minimum upper end of the y axis, as a multiple of the limit.
_MOST_LABELS, _LEAST = 12, 1.5


def plot_health_course(
    health: SkinHealth, times: ArrayLike, frames: ArrayLike, *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the change of frames relative to the healthy skin, and a line at the time of every event.

    The change is given in multiples of the limit above which a lasting change counts as damage. Touches may cause
    changes as large as damage, but only for a time.

    **Arguments:**

    - `health`: the monitored skin after these frames.
    - `times`: times (F,), seconds.
    - `frames`: frames (F, M), volts.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new ones.

    Raises `ValueError` for shapes that do not match.

    **Example:**

    ```python
    ax = plot_health_course(watch(health, damaged), np.arange(len(damaged)), damaged)
    ax.figure.savefig("course.png")
    ```
    """
    check_kind("health", health, SkinHealth, "a SkinHealth, as of watch(health, frames)")
    when, read = np.asarray(times, float), np.asarray(frames, float)
    if read.shape != (len(when), health.reference.size):
        raise ValueError(f"frames have shape {read.shape}; give ({len(when)}, {health.reference.size}).")
    healthy = health.healthy
    there = healthy.used & np.isfinite(read)
    off = np.where(there, (read - healthy.reference) / np.where(healthy.used, healthy.scale, np.inf), np.nan)
    size = np.where(there.any(axis=1), change_size(off) / healthy.limit, np.nan)
    ax = axes_or_new(ax, (9.0, 3.2))
    ax.plot(when, size, color=INK, linewidth=0.8)
    ax.axhline(1.0, color=SOFT, linewidth=1, linestyle=(0, (4, 3)))
    ax.text(1, 1.0, " limit", color=SOFT, fontsize=8, va="center", transform=ax.get_yaxis_transform())
    for event in health.events:
        colour = SERIES_COLOURS[2] if event.kind == EventKind.REPAIRED else SERIES_COLOURS[1]
        ax.axvline(event.time, color=colour, linewidth=1.4)
        if len(health.events) <= _MOST_LABELS:
            own = "" if event.electrode is None else f" {event.electrode + 1}"
            ax.annotate(
                f"{event.kind}{own}",
                (event.time, 1),
                (3, -3 - 11 * (event.number % 3)),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                va="top",
                color=colour,
                fontsize=8,
            )
    ax.set_yscale("symlog", linthresh=1.0)
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.set_ylim(0, max(_LEAST, 1.6 * float(np.nanmax(size, initial=1.0))))
    ax.set_ylabel("Change, times the limit", color=INK)
    soften_axes(ax)
    if title is not None:
        ax.set_title(title)
    return ax
