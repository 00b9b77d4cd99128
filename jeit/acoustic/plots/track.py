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
from jeit.acoustic.plots.surface_view import View, create_view, draw_ellipse, draw_legend, draw_surface, outline_path
from jeit.acoustic.touch_tracks import Touch, Track
from jeit.arguments import check_kind
from jeit.plot.axes import get_or_create_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, draw_colour_bar

_OVERLAY_COLOURS = LinearSegmentedColormap.from_list("glow", ["#ffffff", "#bccddf", "#6a8aae"])
_TIME_COLOURS = LinearSegmentedColormap.from_list("time", ["#0d0887", "#7e03a8", "#cc4778", "#f89540", "#fbd724"])
# Markers of frames with a position whose status is not "touch".
_STATUS_MARKERS = {
    LocationStatus.TWO_TOUCHES: "D",
    LocationStatus.OUTSIDE: "^",
    LocationStatus.MISFIT: "X",
    LocationStatus.AMBIGUOUS: "P",
}
# Distance of a touch's path from the mean of the path, in standard deviations, below which the touch is drawn as a
# single position.
_MIN_PATH_DEVIATIONS = 4.0
# Diameter of the path, as a fraction of the size of the surface, below which a touch is drawn as a single position.
_MIN_RELATIVE_PATH_DIAMETER = 0.05


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
    """Plot the path of every touch in a recording, coloured by time, with its onset and offset. Dots are the positions
    of individual frames.

    A touch at rest is drawn as a dot with its 95 % ellipse. Frames whose status is not "touch" have their own markers,
    which the legend explains. A curved surface is drawn in the coordinates of its chart.

    **Arguments:**

    - `track`: smoothed positions, as returned by the function `track`.
    - `locations`: positions of the frames, as returned by `locate`.
    - `array`: a `Calibration` or `MicrophoneArray`; microphones that are unusable, or not used in any frame of
      `locations`, are drawn as crosses.
    - `overlay`: brightness (rows, columns) from 0 to 1 over the bounding box of the outline, bottom row first, as in
      the last image of `overlay_images`.
    - `truth`: true path (N, d) of the touch, metres, if known.
    - `title`: title of the plot.
    - `colour_bar`: whether to draw a colour bar.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for shapes that disagree, and for arguments of the wrong type.

    **Example:**

    ```python
    ax = plot_track(track(locations), locations, calibration, truth=[(0.03, 0.02)])
    ax.figure.savefig("track.png")
    ```
    """
    check_kind("track", track, Track, "a Track, as of jeit.acoustic.track(locations)")
    check_kind("locations", locations, Locations, "Locations, as of jeit.acoustic.locate")
    view = create_view(array)
    num_microphones = len(view.microphones)
    if locations.used.shape != (len(track.times), num_microphones) or track.position.shape != locations.position.shape:
        raise ValueError(
            f"locations: {locations.used.shape[0]} frames of {locations.used.shape[1]} microphones do not go with a "
            f"track of {len(track.times)} frames and an array of {num_microphones} microphones."
        )
    image = None if overlay is None else np.asarray(overlay, float)
    if image is not None and image.ndim != 2:
        raise ValueError(f"overlay has shape {image.shape}; give one picture (rows, columns), the last of several.")
    if len(track.times):
        view = view._replace(usable=view.usable & locations.used.any(axis=0))
    true_path = None if truth is None else view.chart(truth, "truth")
    path = view.chart(track.position, "track")
    ax = get_or_create_axes(ax)
    if image is not None:
        style: dict[str, Any] = {"interpolation": "bilinear", "cmap": _OVERLAY_COLOURS, "clim": (0, 1)}
        image_artist = ax.imshow(np.nan_to_num(image), extent=view.extent, origin="lower", **style)
        image_artist.set_clip_path(outline_path(view), ax.transData)
    handles = draw_surface(ax, view, is_faint=True)
    ax.set_title(title or "")
    if true_path is not None:
        handles += ax.plot(
            *true_path.T, color=DARK_GREY, linewidth=0.9, linestyle=(0, (4, 3)), zorder=3.6, label="truth"
        )
    if not track.touches:
        _label_no_touch(ax, view, locations)
        draw_legend(ax, handles)
        return ax
    start_time, end_time = track.touches[0].onset, track.touches[-1].offset
    time_colours = ScalarMappable(
        Normalize(start_time, end_time if end_time > start_time else start_time + 1e-3), _TIME_COLOURS
    )
    for touch in track.touches:
        handles += _draw_touch(
            ax, view, track, touch, path, time_colours, existing_labels={handle.get_label() for handle in handles}
        )
    handles += _draw_frames(ax, view, track, locations, time_colours)
    draw_legend(ax, handles)
    if colour_bar and end_time > start_time:
        draw_colour_bar(ax, time_colours, "Time (s)")
    return ax


def _label_no_touch(ax: Axes, view: View, locations: Locations) -> None:
    left, right, bottom, top = view.extent
    label = "no touch" if (locations.status != LocationStatus.UNUSABLE).any() else "no usable frame"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    text_style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 15, "color": DARK_GREY, "zorder": 5}
    ax.text((left + right) / 2, (bottom + top) / 2, label, bbox=box, **text_style)


def _draw_touch(
    ax: Axes, view: View, track: Track, touch: Touch, path, time_colours: ScalarMappable, existing_labels: set
) -> list:
    """Draw the path of a touch, and return those legend entries whose labels are not in `existing_labels`."""
    frames = slice(touch.first, touch.last + 1)
    positions, frame_times = path[frames], track.times[frames]
    best_frame = touch.first + int(np.argmin(np.trace(track.covariance[frames], axis1=1, axis2=2)))
    covariance = view.chart_covariance(track.covariance[best_frame], track.position[best_frame])
    left, right, bottom, top = view.extent
    max_displacement = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()
    min_displacement = max(
        _MIN_PATH_DEVIATIONS * np.sqrt(np.linalg.eigvalsh(covariance)[-1]),
        0.5 * _MIN_RELATIVE_PATH_DIAMETER * max(right - left, top - bottom),
    )
    mark_style: dict[str, Any] = {
        "linestyle": "none",
        "markeredgecolor": DARK_GREY,
        "markeredgewidth": 1.2,
        "zorder": 5,
    }
    if max_displacement < min_displacement:
        colour = time_colours.to_rgba(track.times[best_frame])
        draw_ellipse(ax, path[best_frame], covariance, colour=DARK_GREY)
        ax.plot(*path[best_frame], marker="o", markersize=5, markerfacecolor=colour, **mark_style)
        dot_handle = Line2D(
            [], [], marker="o", markersize=5, markerfacecolor=LIGHT_GREY, label="touch, 95 %", **mark_style
        )
        return [] if "touch, 95 %" in existing_labels else [dot_handle]
    segments = np.stack([positions[:-1], positions[1:]], axis=1)
    for width, colours, draw_order in (
        (5.0, "white", 3.4),
        (3.0, time_colours.to_rgba((frame_times[:-1] + frame_times[1:]) / 2), 3.5),
    ):
        line = LineCollection(list(segments), colors=colours, linewidths=width, capstyle="round", zorder=draw_order)
        ax.add_collection(line)
    end_handles = []
    for position, marker, name in ((positions[0], "o", "onset"), (positions[-1], "s", "offset")):
        end = ax.plot(*position, marker=marker, markersize=7.5, markerfacecolor="white", **mark_style, label=name)
        end_handles += [] if name in existing_labels else end
    return end_handles


def _draw_frames(ax: Axes, view: View, track: Track, locations: Locations, time_colours: ScalarMappable) -> list:
    """Draw the position of each frame as a dot, with a ring if the track rejects the position, and with a marker if the
    status is not "touch". Returns the legend entries."""
    positions = view.chart(locations.position, "locations")
    is_drawn_as_dot = locations.has_position & ~np.isin(locations.status, list(_STATUS_MARKERS))
    is_accepted, is_rejected = is_drawn_as_dot & ~track.rejected, locations.has_position & track.rejected
    handles = []
    dot_options = {"s": 7, "linewidths": 0, "alpha": 0.6, "zorder": 3.7}
    ax.scatter(*positions[is_accepted].T, color=time_colours.to_rgba(track.times[is_accepted]), **dot_options)
    if is_rejected.any():
        # If the frame has a marker for its status, the ring is drawn larger, around this marker.
        ring_options: dict[str, Any] = {
            "s": np.where(is_drawn_as_dot, 16, 60)[is_rejected],
            "linewidths": 0.8,
            "facecolors": "none",
        }
        ring_options |= {"zorder": 3.7, "edgecolors": time_colours.to_rgba(track.times[is_rejected])}
        ax.scatter(*positions[is_rejected].T, **ring_options)
        ring_style: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "markeredgecolor": LIGHT_GREY}
        handles.append(
            Line2D([], [], marker="o", markersize=4, label=f"not believed ({is_rejected.sum()})", **ring_style)
        )
    return handles + _draw_other_frames(ax, view, locations, positions, time_colours)


def _draw_other_frames(
    ax: Axes, view: View, locations: Locations, positions: np.ndarray, time_colours: ScalarMappable
) -> list:
    """Draw the positions of frames with the status "outside", "misfit", "ambiguous" or "two touches"; for "two
    touches", both positions. Returns the legend entries."""
    handles = []
    second_positions = view.chart(locations.second, "locations.second")
    for status, marker in _STATUS_MARKERS.items():
        has_status = (locations.status == status) & locations.has_position
        if not has_status.any():
            continue
        marker_style = {"marker": marker, "s": 22, "linewidths": 0.8, "edgecolors": DARK_GREY, "zorder": 4.5}
        has_second_position = has_status & np.isfinite(second_positions).all(axis=1)
        if has_second_position.any():
            pairs = list(np.stack([positions, second_positions], axis=1)[has_second_position])
            ax.add_collection(LineCollection(pairs, colors=LIGHT_GREY, linewidths=0.5, zorder=3))
            ax.scatter(
                *second_positions[has_second_position].T,
                color=time_colours.to_rgba(locations.times[has_second_position]),
                **marker_style,
            )
        ax.scatter(*positions[has_status].T, color=time_colours.to_rgba(locations.times[has_status]), **marker_style)
        legend_style: dict[str, Any] = {
            "markersize": 5,
            "markerfacecolor": LIGHT_GREY,
            "markeredgecolor": DARK_GREY,
            "linestyle": "none",
        }
        handles.append(Line2D([], [], marker=marker, label=f"{status} ({has_status.sum()})", **legend_style))
    return handles
