"""Plots over the skin: the map of the localisation objective for one frame, and the receptive fields of microphones."""

from __future__ import annotations

import textwrap
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike

from jeit.acoustic.calibration.calibrate import CalibrationFit
from jeit.acoustic.plots.surface_view import (
    ESTIMATE_COLOUR,
    HALO,
    MICROPHONE_COLOUR,
    AnySurface,
    View,
    create_view,
    draw_ellipse,
    draw_legend,
    draw_surface,
    outline_path,
)
from jeit.arguments import check_kind, check_name
from jeit.plot.axes import get_or_create_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SEQUENTIAL_COLOUR_MAP, draw_colour_bar
from jeit_solvers.engines import on_host

# Dynamic range in decibels of the circles that show the received intensities: the circle of a microphone this far below
# the loudest microphone has the minimum size.
_DYNAMIC_RANGE_DB = 30.0
# Upper end of the colour scale above the minimum of the map: in standard deviations ("likelihood"), or decibels
# ("consistency").
_MAX_COLOUR_SCALE_VALUES = {"likelihood": 15.0, "consistency": 40.0}
_MAP_LABELS = {
    "likelihood": "Standard deviations worse than the best place",
    "consistency": "Loss above the least (dB)",
}


class MapMarks(NamedTuple):
    """True and estimated positions to mark on a map.

    **Fields**: `truth`: true position (d,) in metres; `estimate`: estimated position (d,) in metres; `covariance`:
    covariance of the estimate (d, d) in m², drawn as a 95 % ellipse.

    **Example:**

    ```python
    marks = MapMarks(truth=(0.03, 0.02), estimate=(0.031, 0.021))
    ax = plot_loss_map(loss_map, calibration, marks=marks)
    ```
    """

    truth: ArrayLike | None = None
    estimate: ArrayLike | None = None
    covariance: ArrayLike | None = None


def plot_loss_map(
    values: ArrayLike,
    surface: AnySurface,
    *,
    microphones: ArrayLike | None = None,
    received: ArrayLike | None = None,
    marks: MapMarks | None = None,
    method: str = "likelihood",
    title: str | None = None,
    colour_bar: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Plot the map of the localisation objective for one frame, from `Localiser.with_maps`. The most probable positions
    have the brightest colours.

    A likelihood map is drawn as √(2 (map − minimum)), the number of standard deviations by which a position is worse
    than the best position; a map of the consistency loss (Park 2022) is drawn in decibels above its minimum.

    **Arguments:**

    - `values`: map (rows, columns) over the bounding box of the outline, bottom row first, NaN outside the outline.
    - `surface`: a `Calibration`, a `MicrophoneArray`, a surface or an outline.
    - `microphones`: positions (M, d) of the microphones, metres; by default those of `surface`.
    - `received`: intensities (M,), shown by the size of the microphones' circles.
    - `marks`: true and estimated position to mark.
    - `method`: "likelihood" or "consistency", the method of the localiser.
    - `title`: title of the plot.
    - `colour_bar`: whether to draw a colour bar.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for an unknown `method`, shapes that disagree, and `marks` that are not `MapMarks`.

    **Example:**

    ```python
    ax = plot_loss_map(loss_map, calibration, received=power[0], marks=MapMarks(truth=(0.03, 0.02)))
    ax.figure.savefig("map.png")
    ```
    """
    if marks is not None:
        check_kind("marks", marks, MapMarks, "MapMarks, such as MapMarks(truth=(0.02, 0.01))")
    pixel_values = np.asarray(values, float)
    if pixel_values.ndim != 2 or not np.isfinite(pixel_values).any():
        raise ValueError(f"values has shape {pixel_values.shape}; give (rows, columns) with at least one finite value.")
    check_name("method", method, _MAP_LABELS)
    surface_view = create_view(surface, microphones)
    num_microphones = len(surface_view.microphones)
    received_power = None if received is None else np.asarray(received, float)
    if received_power is not None and received_power.shape != (num_microphones,):
        raise ValueError(
            f"received has shape {received_power.shape}; give one for each of the {num_microphones} microphones."
        )
    ax = get_or_create_axes(ax)
    map_values = _above_minimum(pixel_values, method)
    max_shown_value = min(float(np.nanmax(map_values)), _MAX_COLOUR_SCALE_VALUES[method]) or 1.0
    colour_map = colormaps[SEQUENTIAL_COLOUR_MAP + "_r"].copy()
    colour_map.colorbar_extend = "max" if np.nanmax(map_values) > max_shown_value else "neither"  # pyright: ignore[reportAttributeAccessIssue]
    map_image = ax.imshow(
        map_values,
        extent=surface_view.extent,
        origin="lower",
        interpolation="nearest",
        cmap=colour_map,
        clim=(0, max_shown_value),
    )
    map_image.set_clip_path(outline_path(surface_view), ax.transData)
    legend_handles = draw_surface(ax, surface_view, microphones=received_power is None and num_microphones > 0)
    if received_power is not None:
        legend_handles.append(_draw_levels(ax, surface_view.microphones, received_power))
    if marks is not None:
        legend_handles += _draw_marks(ax, surface_view, marks)
    draw_legend(ax, legend_handles)
    ax.set_title(title or "")
    if colour_bar:
        draw_colour_bar(ax, map_image, _MAP_LABELS[method])
    return ax


def _draw_marks(ax: Axes, surface_view: View, marks: MapMarks) -> list[Line2D]:
    """Draw the true and estimated positions in `marks`, and return their legend entries. Raises `ValueError` for shapes
    that do not match the surface, and for a covariance without an estimate."""
    if marks.covariance is not None and marks.estimate is None:
        raise ValueError("covariance: give estimate too, the position whose covariance it is.")
    legend_handles = []
    mark_style: dict[str, Any] = {"linestyle": "none", "zorder": 5, "path_effects": HALO}
    if marks.truth is not None:
        cross_style: dict[str, Any] = {"marker": "+", "color": DARK_GREY, "markersize": 13, "markeredgewidth": 1.8}
        legend_handles += ax.plot(
            *surface_view.chart_point(marks.truth, "truth"), label="truth", **cross_style, **mark_style
        )
    if marks.estimate is not None:
        estimate_point, estimate_label = surface_view.chart_point(marks.estimate, "estimate"), "estimate"
        if marks.covariance is not None:
            draw_ellipse(ax, estimate_point, surface_view.chart_covariance(marks.covariance, marks.estimate))
            estimate_label = "estimate, 95 %"
        legend_handles += ax.plot(
            *estimate_point, marker="o", color=ESTIMATE_COLOUR, markersize=5.5, label=estimate_label, **mark_style
        )
    return legend_handles


def _above_minimum(pixel_values: np.ndarray, method: str) -> np.ndarray:
    """Convert a map of the objective to standard deviations ("likelihood") or decibels ("consistency") above its
    minimum."""
    lowest_value = np.nanmin(pixel_values)
    if method == "likelihood":
        return np.sqrt(2 * (pixel_values - lowest_value))
    # Without noise the minimum of the loss may be zero, so the loss is clipped at 120 dB below its maximum.
    lower_limit = max(lowest_value, 1e-12 * np.nanmax(pixel_values), np.finfo(float).tiny)
    return 10 * np.log10(np.maximum(pixel_values, lower_limit) / lower_limit)


def _draw_levels(ax: Axes, microphone_positions: np.ndarray, received_power: np.ndarray) -> Line2D:
    """Draw the microphones as circles whose area grows linearly with the received level in decibels; return the legend
    entry."""
    is_positive_power = np.isfinite(received_power) & (received_power > 0)
    max_power = received_power[is_positive_power].max(initial=1e-300)
    level_db = 10 * np.log10(np.where(is_positive_power, received_power, 1e-300) / max_power)
    circle_areas = 8 + 150 * np.clip(1 + level_db / _DYNAMIC_RANGE_DB, 0, 1)
    ax.scatter(
        *microphone_positions.T,
        s=circle_areas,
        facecolor="white",
        edgecolor=MICROPHONE_COLOUR,
        linewidth=1.2,
        alpha=0.9,
        zorder=3,
    )
    return Line2D(
        [],
        [],
        marker="o",
        linestyle="none",
        markersize=8,
        markerfacecolor="white",
        markeredgecolor=MICROPHONE_COLOUR,
        label="microphone, by level",
    )


_TAP_COLOUR = "#8fb4d9"


def plot_receptive_fields(
    fit: CalibrationFit, *, microphones: ArrayLike | None = None, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot the receptive field of each microphone: the intensity of each tap, divided by the strength of the tap,
    against distance, with the fitted decay model.

    Red circles are taps excluded from the fit. The panel of an unusable microphone states why it is unusable. The
    dashed line is the standard deviation of the noise divided by the median strength of the taps. The number beside the
    microphone's index is the distance at which the response is half the response to a tap directly above the
    microphone. The panels are insets of the returned axes.

    **Arguments:**

    - `fit`: result of `calibrate_microphones`.
    - `microphones`: indices of the microphones to draw, from 0 as in the messages of the calibration; by default all.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for microphones that do not exist, and if `fit` is not a `CalibrationFit`.

    **Example:**

    ```python
    ax = plot_receptive_fields(fit, microphones=[0, 1, 2])
    ax.figure.savefig("fields.png")
    ```
    """
    check_kind("fit", fit, CalibrationFit, "a CalibrationFit, as of calibrate_microphones")
    num_microphones = fit.power.shape[1]
    selected_microphones = np.arange(num_microphones) if microphones is None else np.atleast_1d(np.asarray(microphones))
    if selected_microphones.ndim != 1 or selected_microphones.dtype.kind not in "iu" or not selected_microphones.size:
        raise ValueError(
            f"microphones: give indices of microphones, whole numbers; got shape {selected_microphones.shape}."
        )
    if selected_microphones.min() < 0 or selected_microphones.max() >= num_microphones:
        raise ValueError(
            f"microphones must be from 0 to {num_microphones - 1}; they are {selected_microphones.min()} to "
            f"{selected_microphones.max()}."
        )
    num_columns = (
        selected_microphones.size
        if selected_microphones.size <= 3
        else int(np.ceil(np.sqrt(selected_microphones.size)))
    )
    num_rows = -(-selected_microphones.size // num_columns)
    ax = get_or_create_axes(ax, (max(4.8, min(11.0, 2.2 * num_columns)), max(3.6, min(9.0, 1.75 * num_rows))))
    ax.set_axis_off()
    # The position of the title is fixed, since matplotlib would derive the position from all panels.
    ax.set_title(title or "", loc="left", y=1.0, pad=26)
    plotted_distances = np.linspace(0, float(fit.distance.max()), 200)
    decay_model = on_host(fit.calibration.microphone_array.decay)
    response_curves = np.asarray(
        decay_model.response(np.broadcast_to(plotted_distances**2, (num_microphones, plotted_distances.size)))
    )
    relative_intensities = fit.power / _tap_strengths(fit)[:, None]
    noise_levels = np.asarray(fit.calibration.microphone_array.noise.deviation) / np.nanmedian(fit.strength)
    positive_intensities = relative_intensities[:, selected_microphones][
        np.isfinite(relative_intensities[:, selected_microphones]) & (relative_intensities[:, selected_microphones] > 0)
    ]
    is_usable = fit.calibration.usable[selected_microphones]
    shown_curves = (
        response_curves[selected_microphones][is_usable] if is_usable.any() else response_curves[selected_microphones]
    )
    lower_axis_limit = (
        min(shown_curves.min(), np.quantile(positive_intensities, 0.02) if positive_intensities.size else np.inf) / 1.5
    )
    upper_axis_limit = (
        max(shown_curves.max(), np.quantile(positive_intensities, 0.999) if positive_intensities.size else 0.0) * 1.8
    )
    panel_width, panel_height = 1 / num_columns, 1 / num_rows
    for panel_index, microphone_index in enumerate(selected_microphones):
        row_index, column_index = divmod(panel_index, num_columns)
        panel_axes = ax.inset_axes(
            (column_index * panel_width, 1 - (row_index + 1) * panel_height, 0.93 * panel_width, 0.9 * panel_height)
        )
        panel_axes.set_in_layout(False)  # the labels of panels extend beyond the axes
        _draw_receptive_field(
            panel_axes,
            fit,
            int(microphone_index),
            relative_intensities[:, microphone_index],
            (plotted_distances, response_curves[microphone_index], noise_levels[microphone_index]),
            num_columns,
        )
        panel_axes.set_xlim(0, 1e3 * plotted_distances[-1])
        panel_axes.set_ylim(lower_axis_limit, upper_axis_limit)
        panel_axes.tick_params(
            labelleft=column_index == 0, labelbottom=panel_index + num_columns >= selected_microphones.size
        )
    _label_panels(ax, fit, has_noise_curve=bool(noise_levels[selected_microphones].max() > lower_axis_limit))
    return ax


def _label_panels(ax: Axes, calibration_fit: CalibrationFit, *, has_noise_curve: bool) -> None:
    """Draw the axis labels shared by all panels, and the legend above the panels."""
    label_style: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "color": DARK_GREY}
    label_style["annotation_clip"] = False
    ax.annotate("Distance (mm)", (0.5, 0), (0, -22), ha="center", va="top", **label_style)
    ax.annotate(
        "Intensity / strength of the tap", (0, 0.5), (-34, 0), ha="right", va="center", rotation=90, **label_style
    )
    legend_handles = [
        Line2D([], [], marker="o", linestyle="none", color=_TAP_COLOUR, markersize=4, label="tap"),
        Line2D(
            [],
            [],
            color=DARK_GREY,
            linewidth=1.6,
            label=f"fit, {type(calibration_fit.calibration.microphone_array.decay).name}",
        ),
    ]
    if has_noise_curve:
        legend_handles.append(
            Line2D([], [], color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="noise, 1 σ")
        )
    if calibration_fit.outlier.any():
        ring_style: dict[str, Any] = {"marker": "o", "linestyle": "none", "fillstyle": "none", "markersize": 4}
        legend_handles.append(Line2D([], [], color=ESTIMATE_COLOUR, label="left out", **ring_style))
    legend_style: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 4}
    ax.legend(handles=legend_handles, frameon=False, fontsize=9.5, borderpad=0, **legend_style)


def _tap_strengths(calibration_fit: CalibrationFit) -> Float[np.ndarray, " T"]:
    """Strength (T,) of each tap. For taps excluded from the fit, the strength is the median over the usable microphones
    of intensity divided by response."""
    microphone_responses = np.asarray(
        on_host(calibration_fit.calibration.microphone_array.decay).response(calibration_fit.distance.T**2)
    ).T
    strength_estimates = np.where(
        (calibration_fit.power > 0) & calibration_fit.calibration.usable,
        calibration_fit.power / microphone_responses,
        np.nan,
    )
    is_received_tap = np.isfinite(strength_estimates).any(axis=1)
    median_strengths = np.full(len(strength_estimates), np.nan)
    median_strengths[is_received_tap] = np.nanmedian(strength_estimates[is_received_tap], axis=1)
    return np.where(np.isfinite(calibration_fit.strength), calibration_fit.strength, median_strengths)


def _draw_receptive_field(
    panel_axes: Axes,
    calibration_fit: CalibrationFit,
    microphone_index: int,
    relative_intensities,
    panel_lines,
    num_columns: int,
) -> None:
    """Draw the panel of one microphone: taps, fitted decay model and noise. `panel_lines`: distances in metres, the
    response at these distances, and the noise."""
    plotted_distances, response_curve, noise_level = panel_lines
    exclusion_reason = calibration_fit.calibration.reasons[microphone_index]
    is_positive_intensity = np.isfinite(relative_intensities) & (relative_intensities > 0)
    panel_axes.set_yscale("log")
    for is_drawn_tap, drawing_style in (
        (
            is_positive_intensity & ~calibration_fit.outlier,
            {"color": LIGHT_GREY if exclusion_reason else _TAP_COLOUR, "alpha": 0.6, "linewidths": 0},
        ),
        (
            is_positive_intensity & calibration_fit.outlier,
            {"facecolors": "none", "edgecolors": ESTIMATE_COLOUR, "linewidths": 0.7, "zorder": 2.5},
        ),
    ):
        marker_size = 9 if num_columns <= 2 else 5
        panel_axes.scatter(
            1e3 * calibration_fit.distance[is_drawn_tap, microphone_index],
            relative_intensities[is_drawn_tap],
            s=marker_size,
            rasterized=True,
            **drawing_style,
        )
    drawing_style = (
        {"color": LIGHT_GREY, "linewidth": 1.2, "linestyle": (0, (1, 1))}
        if exclusion_reason
        else {"color": DARK_GREY, "linewidth": 1.6}
    )
    # No curve is drawn for a microphone without positive intensities.
    is_within_tap_distances = (
        plotted_distances <= calibration_fit.distance[:, microphone_index].max()
    ) & is_positive_intensity.any()
    panel_axes.plot(
        1e3 * plotted_distances[is_within_tap_distances],
        response_curve[is_within_tap_distances],
        zorder=3,
        **drawing_style,
    )
    if noise_level > 0:
        panel_axes.axhline(noise_level, color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1)
    font_size = 8.5 if num_columns <= 5 else 7
    text_style: dict[str, Any] = {"transform": panel_axes.transAxes, "va": "top", "path_effects": HALO, "zorder": 4}
    panel_axes.text(
        0.05,
        0.97,
        str(microphone_index),
        ha="left",
        fontsize=font_size,
        fontweight="bold",
        color=DARK_GREY,
        **text_style,
    )
    if exclusion_reason:
        short_reason = textwrap.shorten(exclusion_reason.split(" (")[0], 60, placeholder=" …")
        wrapped_reason = textwrap.fill(short_reason, 24 if num_columns <= 5 else 18)
        panel_axes.text(
            0.97, 0.97, wrapped_reason, ha="right", fontsize=font_size - 1, color=ESTIMATE_COLOUR, **text_style
        )
    elif num_columns <= 6:
        half_distance = plotted_distances[np.argmin(np.abs(response_curve / response_curve[0] - 0.5))]
        panel_axes.text(
            0.97,
            0.97,
            f"½ at {1e3 * half_distance:.0f} mm",
            ha="right",
            fontsize=font_size - 1,
            color=DARK_GREY,
            **text_style,
        )
    style_graph_axes(panel_axes)
    panel_axes.tick_params(length=2.5, labelsize=font_size - 0.5, which="both")
    panel_axes.xaxis.set_major_locator(MaxNLocator(4 if num_columns <= 5 else 3, steps=[1, 2, 5, 10], prune="upper"))
    panel_axes.yaxis.set_major_locator(LogLocator(numticks=4))
    panel_axes.yaxis.set_minor_locator(NullLocator())
    panel_axes.yaxis.set_minor_formatter(NullFormatter())
