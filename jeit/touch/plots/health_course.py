"""Plot the change of a skin from its healthy state over time, and the events that were detected."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.plot.axes import INK, SERIES_COLOURS, SOFT, axes_or_new, soften_axes
from jeit.touch.health import EventKind, SkinHealth
from jeit.touch.health.lasting import size_of

# The greatest number of events that are labelled; and the least height of the axes, as a multiple of the limit.
_WRITTEN, _LEAST = 12, 1.5


def plot_health_course(
    health: SkinHealth, times: ArrayLike, frames: ArrayLike, *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the change of frames (F, M) at `times` (F,) from the healthy skin, and a line at the time of every event.

    The change is in multiples of the limit that a lasting change exceeds. Touches stand out as far as damage may, but
    come back; damage stays. Raises `ValueError` for shapes that disagree.
    """
    check_kind("health", health, SkinHealth, "a SkinHealth, as of watch(health, frames)")
    when, read = np.asarray(times, float), np.asarray(frames, float)
    if read.shape != (len(when), health.reference.size):
        raise ValueError(f"frames have shape {read.shape}; give ({len(when)}, {health.reference.size}).")
    healthy = health.healthy
    there = healthy.used & np.isfinite(read)
    off = np.where(there, (read - healthy.reference) / np.where(healthy.used, healthy.scale, np.inf), np.nan)
    size = np.where(there.any(axis=1), size_of(off) / healthy.limit, np.nan)
    ax = axes_or_new(ax, (9.0, 3.2))
    ax.plot(when, size, color=INK, linewidth=0.8)
    ax.axhline(1.0, color=SOFT, linewidth=1, linestyle=(0, (4, 3)))
    ax.text(1, 1.0, " limit", color=SOFT, fontsize=8, va="center", transform=ax.get_yaxis_transform())
    for event in health.events:
        colour = SERIES_COLOURS[2] if event.kind == EventKind.REPAIRED else SERIES_COLOURS[1]
        ax.axvline(event.time, color=colour, linewidth=1.4)
        if len(health.events) <= _WRITTEN:
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
