"""Plot a learnt skin's predictions for frames: places over the skin, with their standard deviations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jeit.plot.axes import (
    INK,
    SEQUENTIAL,
    SERIES_COLOURS,
    axes_or_new,
    bare,
    draw_colour_bar,
    draw_scale_bar,
    extent_of,
    soften_axes,
)
from jeit.touch import Touches

# The greatest number of ellipses that are drawn: more would hide each other.
_MOST = 400


def plot_places(touches: Touches, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the estimated places of frames, the later the brighter, with ellipses of one standard deviation.

    Raises `ValueError` for touches of a skin that did not learn places.
    """
    if touches.position is None:
        raise ValueError("touches have no places: the skin did not learn any.")
    ax = axes_or_new(ax)
    there = np.flatnonzero(np.isfinite(touches.position).all(axis=1))
    if not there.size:
        ax.set_axis_off()
        said = "All frames unlike any learnt from" if touches.unlike.all() else "No touch"
        ax.set_title(said if title is None else title)
        return ax
    place, std = touches.position[there, :2], touches.position_std[there, :2]  # pyright: ignore[reportOptionalSubscript]
    extent = extent_of(np.vstack([place - std, place + std]))
    bare(ax, extent, numbered=False)
    some = np.linspace(0, len(there) - 1, min(len(there), _MOST)).astype(int)
    size = 2 * std[some]
    ax.add_collection(
        EllipseCollection(
            size[:, 0],
            size[:, 1],
            np.zeros(len(some)),
            units="xy",
            offsets=place[some],
            transOffset=ax.transData,
            facecolors="none",
            edgecolors=SERIES_COLOURS[0],
            linewidths=0.5,
            alpha=0.35,
        )
    )
    drawn = ax.scatter(*place.T, c=there, s=12, cmap=SEQUENTIAL, linewidths=0, zorder=3)
    draw_scale_bar(ax, extent)
    draw_colour_bar(ax, drawn, "Frame")
    ax.set_title(f"{len(there)} touches, ellipses of one standard deviation" if title is None else title)
    return ax


def plot_answers(touches: Touches, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the predictions for consecutive frames: pressed keys, labels, or forces in newtons."""
    ax = axes_or_new(ax)
    frame = np.arange(len(touches))
    if touches.touched is not None:
        ax.imshow(
            touches.touched.T, aspect="auto", cmap="Blues", vmin=0, vmax=1.2, interpolation="nearest", origin="lower"
        )
        ax.set_yticks(range(touches.touched.shape[1]))
        ax.set_ylabel("Key", color=INK)
    elif touches.label is not None:
        kinds = [str(one) for one in np.unique(touches.label) if one]
        said = touches.label != ""
        level = np.searchsorted(kinds, touches.label[said])
        ax.plot(
            frame[said], level, linestyle="none", marker="o", markersize=3.5, color=SERIES_COLOURS[0], markeredgewidth=0
        )
        ax.set_yticks(range(len(kinds)), kinds)
    elif touches.force is not None and touches.force_std is not None:
        low, high = touches.force - touches.force_std, touches.force + touches.force_std
        ax.fill_between(frame, low, high, color=SERIES_COLOURS[0], alpha=0.2, linewidth=0)
        ax.plot(frame, touches.force, color=SERIES_COLOURS[0], linewidth=1.2)
        ax.set_ylabel("Force (N)", color=INK)
    for one in frame[touches.unlike]:
        ax.axvline(one, color=SERIES_COLOURS[1], linewidth=0.6, alpha=0.5, zorder=0)
    ax.set_xlabel("Frame", color=INK)
    unlike = int(touches.unlike.sum())
    ax.set_title((f"red: {unlike} frames unlike any learnt from" if unlike else "") if title is None else title)
    soften_axes(ax)
    return ax
