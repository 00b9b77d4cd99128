"""Plot of the touches in a recording: onset, path and offset of each touch, on an overlay of the maps of all frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from jeit.acoustic import Calibration, MicrophoneArray
from jeit.acoustic.localisation.locations import Locations, LocationStatus
from jeit.acoustic.plots.surface_view import View, draw_ellipse, draw_legend, draw_surface, outline_of, view_of
from jeit.acoustic.tracking import Touch, Track
from jeit.arguments import check_kind
from jeit.plot.axes import INK, SOFT, axes_or_new, draw_colour_bar

_GLOW = LinearSegmentedColormap.from_list("glow", ["#ffffff", "#bccddf", "#6a8aae"])
_TIME = LinearSegmentedColormap.from_list("time", ["#0d0887", "#7e03a8", "#cc4778", "#f89540", "#fbd724"])
# Markers of located frames whose status is not "touch".
_STATUS_MARKERS = {
    LocationStatus.TWO_TOUCHES: "D",
    LocationStatus.OUTSIDE: "^",
    LocationStatus.MISFIT: "X",
    LocationStatus.AMBIGUOUS: "P",
}
# Thresholds of motion below which a touch is drawn as a single position: the distance of its path from the mean of the
# path, in standard deviations; and the diameter of the path, as a fraction of the size of the surface.
_MOVED_DEVIATIONS, _LEAST = 4.0, 0.05


def plot_track(
    track: Track,
    locations: Locations,
    array: Calibration | MicrophoneArray,
    *,
    overlay: ArrayLike | None = None,
    truth: ArrayLike | None = None,
    title: str | None = None,
    colour_bar: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Plot the path of every touch, coloured by time, with its onset and offset. Dots are the positions of individual
    frames.

    A touch at rest is drawn as a dot with its 95 % ellipse. Frames whose status is not "touch" have their own markers,
    explained in the legend. A curved surface is drawn in the coordinates of its chart.

    **Arguments:**

    - `track`: smoothed positions, as from the function `track`.
    - `locations`: positions of the frames, as from `locate`.
    - `array`: a `Calibration` or `MicrophoneArray`; microphones that are unusable, or not used in any frame of
      `locations`, are drawn as crosses.
    - `overlay`: brightness (rows, columns) from 0 to 1 over the bounding box of the outline, bottom row first, as in
      the last image of `overlay_images`.
    - `truth`: true path (N, d), metres, if known.
    - `title`: title of the plot.
    - `colour_bar`: whether to draw a colour bar.
    - `ax`: axes to draw into; by default new ones.

    Raises `ValueError` for shapes that disagree, and for arguments of the wrong type.

    **Example:**

    ```python
    ax = plot_track(track(locations), locations, calibration, truth=[(0.03, 0.02)])
    ax.figure.savefig("track.png")
    ```
    """
    check_kind("track", track, Track, "a Track, as of jeit.acoustic.track(locations)")
    check_kind("locations", locations, Locations, "Locations, as of jeit.acoustic.locate")
    view = view_of(array)
    number = len(view.microphones)
    if locations.used.shape != (len(track.times), number) or track.position.shape != locations.position.shape:
        raise ValueError(
            f"locations: {locations.used.shape[0]} frames of {locations.used.shape[1]} microphones do not go with a "
            f"track of {len(track.times)} frames and an array of {number} microphones."
        )
    image = None if overlay is None else np.asarray(overlay, float)
    if image is not None and image.ndim != 2:
        raise ValueError(f"overlay has shape {image.shape}; give one picture (rows, columns), the last of several.")
    if len(track.times):
        view = view._replace(usable=view.usable & locations.used.any(axis=0))
    known = None if truth is None else view.chart(truth, "truth")
    path = view.chart(track.position, "track")
    ax = axes_or_new(ax)
    if image is not None:
        style: dict[str, Any] = {"interpolation": "bilinear", "cmap": _GLOW, "clim": (0, 1)}
        drawn = ax.imshow(np.nan_to_num(image), extent=view.extent, origin="lower", **style)
        drawn.set_clip_path(outline_of(view), ax.transData)
    handles = draw_surface(ax, view, faint=True)
    ax.set_title(title or "")
    if known is not None:
        handles += ax.plot(*known.T, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), zorder=3.6, label="truth")
    if not track.touches:
        _label_no_touch(ax, view, locations)
        draw_legend(ax, handles)
        return ax
    first, last = track.touches[0].onset, track.touches[-1].offset
    times = ScalarMappable(Normalize(first, last if last > first else first + 1e-3), _TIME)
    for touch in track.touches:
        handles += _draw_touch(ax, view, track, touch, path, times, named={handle.get_label() for handle in handles})
    handles += _draw_frames(ax, view, track, locations, times)
    draw_legend(ax, handles)
    if colour_bar and last > first:
        draw_colour_bar(ax, times, "Time (s)")
    return ax


def _label_no_touch(ax: Axes, view: View, locations: Locations) -> None:
    left, right, bottom, top = view.extent
    words = "no touch" if (locations.status != LocationStatus.UNUSABLE).any() else "no usable frame"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    text: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 15, "color": INK, "zorder": 5}
    ax.text((left + right) / 2, (bottom + top) / 2, words, bbox=box, **text)


def _draw_touch(ax: Axes, view: View, track: Track, touch: Touch, path, times: ScalarMappable, named: set) -> list:
    """Draw a touch and return its legend entries whose labels are not in `named`."""
    frames = slice(touch.first, touch.last + 1)
    places, when = path[frames], track.times[frames]
    surest = touch.first + int(np.argmin(np.trace(track.covariance[frames], axis1=1, axis2=2)))
    spread = view.chart_covariance(track.covariance[surest], track.position[surest])
    left, right, bottom, top = view.extent
    moved = np.linalg.norm(places - places.mean(axis=0), axis=1).max()
    still = max(
        _MOVED_DEVIATIONS * np.sqrt(np.linalg.eigvalsh(spread)[-1]), 0.5 * _LEAST * max(right - left, top - bottom)
    )
    mark: dict[str, Any] = {"linestyle": "none", "markeredgecolor": INK, "markeredgewidth": 1.2, "zorder": 5}
    if moved < still:
        colour = times.to_rgba(track.times[surest])
        draw_ellipse(ax, path[surest], spread, colour=INK)
        ax.plot(*path[surest], marker="o", markersize=5, markerfacecolor=colour, **mark)
        dot = Line2D([], [], marker="o", markersize=5, markerfacecolor=SOFT, label="touch, 95 %", **mark)
        return [] if "touch, 95 %" in named else [dot]
    segments = np.stack([places[:-1], places[1:]], axis=1)
    for width, colours, order in ((5.0, "white", 3.4), (3.0, times.to_rgba((when[:-1] + when[1:]) / 2), 3.5)):
        line = LineCollection(list(segments), colors=colours, linewidths=width, capstyle="round", zorder=order)
        ax.add_collection(line)
    ends = []
    for place, marker, name in ((places[0], "o", "onset"), (places[-1], "s", "offset")):
        end = ax.plot(*place, marker=marker, markersize=7.5, markerfacecolor="white", **mark, label=name)
        ends += [] if name in named else end
    return ends


def _draw_frames(ax: Axes, view: View, track: Track, locations: Locations, times: ScalarMappable) -> list:
    """Draw the position of each frame: a dot; a ring if the track rejects the position; a marker for each status other
    than "touch". Return the legend entries."""
    places = view.chart(locations.position, "locations")
    plain = locations.has_position & ~np.isin(locations.status, list(_STATUS_MARKERS))
    believed, doubted = plain & ~track.rejected, locations.has_position & track.rejected
    handles = []
    dots = {"s": 7, "linewidths": 0, "alpha": 0.6, "zorder": 3.7}
    ax.scatter(*places[believed].T, color=times.to_rgba(track.times[believed]), **dots)
    if doubted.any():
        # If the frame has a marker for its status, the ring is drawn larger, around that marker.
        rings: dict[str, Any] = {"s": np.where(plain, 16, 60)[doubted], "linewidths": 0.8, "facecolors": "none"}
        rings |= {"zorder": 3.7, "edgecolors": times.to_rgba(track.times[doubted])}
        ax.scatter(*places[doubted].T, **rings)
        ring: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "markeredgecolor": SOFT}
        handles.append(Line2D([], [], marker="o", markersize=4, label=f"not believed ({doubted.sum()})", **ring))
    return handles + _draw_other_frames(ax, view, locations, places, times)


def _draw_other_frames(ax: Axes, view: View, locations: Locations, places: np.ndarray, times: ScalarMappable) -> list:
    """Draw frames with the status "outside", "misfit", "ambiguous" or "two touches", and the second touch of the last;
    return the legend entries."""
    handles = []
    second = view.chart(locations.second, "locations.second")
    for status, marker in _STATUS_MARKERS.items():
        which = (locations.status == status) & locations.has_position
        if not which.any():
            continue
        style = {"marker": marker, "s": 22, "linewidths": 0.8, "edgecolors": INK, "zorder": 4.5}
        both = which & np.isfinite(second).all(axis=1)
        if both.any():
            pairs = list(np.stack([places, second], axis=1)[both])
            ax.add_collection(LineCollection(pairs, colors=SOFT, linewidths=0.5, zorder=3))
            ax.scatter(*second[both].T, color=times.to_rgba(locations.times[both]), **style)
        ax.scatter(*places[which].T, color=times.to_rgba(locations.times[which]), **style)
        named: dict[str, Any] = {"markersize": 5, "markerfacecolor": SOFT, "markeredgecolor": INK, "linestyle": "none"}
        handles.append(Line2D([], [], marker=marker, label=f"{status} ({which.sum()})", **named))
    return handles
