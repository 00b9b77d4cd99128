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
    surface_view = create_view(array)
    num_microphones = len(surface_view.microphones)
    if locations.used.shape != (len(track.times), num_microphones) or track.position.shape != locations.position.shape:
        raise ValueError(
            f"locations: {locations.used.shape[0]} frames of {locations.used.shape[1]} microphones do not go with a "
            f"track of {len(track.times)} frames and an array of {num_microphones} microphones."
        )
    overlay_image = None if overlay is None else np.asarray(overlay, float)
    if overlay_image is not None and overlay_image.ndim != 2:
        raise ValueError(
            f"overlay has shape {overlay_image.shape}; give one picture (rows, columns), the last of several."
        )
    if len(track.times):
        surface_view = surface_view._replace(usable=surface_view.usable & locations.used.any(axis=0))
    true_path = None if truth is None else surface_view.chart(truth, "truth")
    track_path = surface_view.chart(track.position, "track")
    ax = get_or_create_axes(ax)
    if overlay_image is not None:
        image_style: dict[str, Any] = {"interpolation": "bilinear", "cmap": _OVERLAY_COLOURS, "clim": (0, 1)}
        image_artist = ax.imshow(
            np.nan_to_num(overlay_image), extent=surface_view.extent, origin="lower", **image_style
        )
        image_artist.set_clip_path(outline_path(surface_view), ax.transData)
    legend_handles = draw_surface(ax, surface_view, is_faint=True)
    ax.set_title(title or "")
    if true_path is not None:
        legend_handles += ax.plot(
            *true_path.T, color=DARK_GREY, linewidth=0.9, linestyle=(0, (4, 3)), zorder=3.6, label="truth"
        )
    if not track.touches:
        _label_no_touch(ax, surface_view, locations)
        draw_legend(ax, legend_handles)
        return ax
    start_time, end_time = track.touches[0].onset, track.touches[-1].offset
    time_colours = ScalarMappable(
        Normalize(start_time, end_time if end_time > start_time else start_time + 1e-3), _TIME_COLOURS
    )
    for touch in track.touches:
        legend_handles += _draw_touch(
            ax,
            surface_view,
            track,
            touch,
            track_path,
            time_colours,
            existing_labels={legend_handle.get_label() for legend_handle in legend_handles},
        )
    legend_handles += _draw_frames(ax, surface_view, track, locations, time_colours)
    draw_legend(ax, legend_handles)
    if colour_bar and end_time > start_time:
        draw_colour_bar(ax, time_colours, "Time (s)")
    return ax


def _label_no_touch(ax: Axes, surface_view: View, locations: Locations) -> None:
    x_min, x_max, y_min, y_max = surface_view.extent
    no_touch_text = "no touch" if (locations.status != LocationStatus.UNUSABLE).any() else "no usable frame"
    text_box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    text_style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 15, "color": DARK_GREY, "zorder": 5}
    ax.text((x_min + x_max) / 2, (y_min + y_max) / 2, no_touch_text, bbox=text_box, **text_style)


def _draw_touch(
    ax: Axes,
    surface_view: View,
    track: Track,
    touch: Touch,
    track_path,
    time_colours: ScalarMappable,
    existing_labels: set,
) -> list:
    """Draw the path of a touch, and return those legend entries whose labels are not in `existing_labels`."""
    frame_slice = slice(touch.first, touch.last + 1)
    touch_positions, frame_times = track_path[frame_slice], track.times[frame_slice]
    best_frame = touch.first + int(np.argmin(np.trace(track.covariance[frame_slice], axis1=1, axis2=2)))
    best_covariance = surface_view.chart_covariance(track.covariance[best_frame], track.position[best_frame])
    x_min, x_max, y_min, y_max = surface_view.extent
    max_displacement = np.linalg.norm(touch_positions - touch_positions.mean(axis=0), axis=1).max()
    min_displacement = max(
        _MIN_PATH_DEVIATIONS * np.sqrt(np.linalg.eigvalsh(best_covariance)[-1]),
        0.5 * _MIN_RELATIVE_PATH_DIAMETER * max(x_max - x_min, y_max - y_min),
    )
    mark_style: dict[str, Any] = {
        "linestyle": "none",
        "markeredgecolor": DARK_GREY,
        "markeredgewidth": 1.2,
        "zorder": 5,
    }
    if max_displacement < min_displacement:
        touch_colour = time_colours.to_rgba(track.times[best_frame])
        draw_ellipse(ax, track_path[best_frame], best_covariance, colour=DARK_GREY)
        ax.plot(*track_path[best_frame], marker="o", markersize=5, markerfacecolor=touch_colour, **mark_style)
        dot_handle = Line2D(
            [], [], marker="o", markersize=5, markerfacecolor=LIGHT_GREY, label="touch, 95 %", **mark_style
        )
        return [] if "touch, 95 %" in existing_labels else [dot_handle]
    path_segments = np.stack([touch_positions[:-1], touch_positions[1:]], axis=1)
    for line_width, segment_colours, draw_order in (
        (5.0, "white", 3.4),
        (3.0, time_colours.to_rgba((frame_times[:-1] + frame_times[1:]) / 2), 3.5),
    ):
        segment_collection = LineCollection(
            list(path_segments), colors=segment_colours, linewidths=line_width, capstyle="round", zorder=draw_order
        )
        ax.add_collection(segment_collection)
    end_handles = []
    for end_position, end_marker, end_name in (
        (touch_positions[0], "o", "onset"),
        (touch_positions[-1], "s", "offset"),
    ):
        end_artists = ax.plot(
            *end_position, marker=end_marker, markersize=7.5, markerfacecolor="white", **mark_style, label=end_name
        )
        end_handles += [] if end_name in existing_labels else end_artists
    return end_handles


def _draw_frames(
    ax: Axes, surface_view: View, track: Track, locations: Locations, time_colours: ScalarMappable
) -> list:
    """Draw the position of each frame as a dot, with a ring if the track rejects the position, and with a marker if the
    status is not "touch". Returns the legend entries."""
    frame_positions = surface_view.chart(locations.position, "locations")
    is_drawn_as_dot = locations.has_position & ~np.isin(locations.status, list(_STATUS_MARKERS))
    is_accepted_position, is_rejected_position = (
        is_drawn_as_dot & ~track.rejected,
        locations.has_position & track.rejected,
    )
    legend_handles = []
    dot_options = {"s": 7, "linewidths": 0, "alpha": 0.6, "zorder": 3.7}
    ax.scatter(
        *frame_positions[is_accepted_position].T,
        color=time_colours.to_rgba(track.times[is_accepted_position]),
        **dot_options,
    )
    if is_rejected_position.any():
        # If the frame has a marker for its status, the ring is drawn larger, around this marker.
        ring_options: dict[str, Any] = {
            "s": np.where(is_drawn_as_dot, 16, 60)[is_rejected_position],
            "linewidths": 0.8,
            "facecolors": "none",
        }
        ring_options |= {"zorder": 3.7, "edgecolors": time_colours.to_rgba(track.times[is_rejected_position])}
        ax.scatter(*frame_positions[is_rejected_position].T, **ring_options)
        ring_style: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "markeredgecolor": LIGHT_GREY}
        legend_handles.append(
            Line2D([], [], marker="o", markersize=4, label=f"not believed ({is_rejected_position.sum()})", **ring_style)
        )
    return legend_handles + _draw_other_frames(ax, surface_view, locations, frame_positions, time_colours)


def _draw_other_frames(
    ax: Axes, surface_view: View, locations: Locations, frame_positions: np.ndarray, time_colours: ScalarMappable
) -> list:
    """Draw the positions of frames with the status "outside", "misfit", "ambiguous" or "two touches"; for "two
    touches", both positions. Returns the legend entries."""
    legend_handles = []
    second_positions = surface_view.chart(locations.second, "locations.second")
    for frame_status, status_marker in _STATUS_MARKERS.items():
        has_status = (locations.status == frame_status) & locations.has_position
        if not has_status.any():
            continue
        marker_style = {"marker": status_marker, "s": 22, "linewidths": 0.8, "edgecolors": DARK_GREY, "zorder": 4.5}
        has_second_position = has_status & np.isfinite(second_positions).all(axis=1)
        if has_second_position.any():
            position_pairs = list(np.stack([frame_positions, second_positions], axis=1)[has_second_position])
            ax.add_collection(LineCollection(position_pairs, colors=LIGHT_GREY, linewidths=0.5, zorder=3))
            ax.scatter(
                *second_positions[has_second_position].T,
                color=time_colours.to_rgba(locations.times[has_second_position]),
                **marker_style,
            )
        ax.scatter(
            *frame_positions[has_status].T, color=time_colours.to_rgba(locations.times[has_status]), **marker_style
        )
        legend_style: dict[str, Any] = {
            "markersize": 5,
            "markerfacecolor": LIGHT_GREY,
            "markeredgecolor": DARK_GREY,
            "linestyle": "none",
        }
        legend_handles.append(
            Line2D([], [], marker=status_marker, label=f"{frame_status} ({has_status.sum()})", **legend_style)
        )
    return legend_handles
