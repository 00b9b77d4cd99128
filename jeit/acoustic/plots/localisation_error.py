"""Plots of localisation errors: pairs of true and estimated positions on the skin, and curves of the error against a
quantity."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

from jeit.acoustic.plots.surface_view import ESTIMATE_COLOUR, AnySurface, create_view, draw_legend, draw_surface
from jeit.arguments import check_kind, check_name
from jeit.plot.axes import draw_horizontal_grid, get_or_create_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, SERIES_COLOURS, SERIES_MARKERS

_ERROR_STATISTICS = {
    "median": lambda errors: np.nanmedian(errors, axis=1),
    "mean": lambda errors: np.nanmean(errors, axis=1),
    "rms": lambda errors: np.sqrt(np.nanmean(errors**2, axis=1)),
}


def plot_position_errors(
    true: ArrayLike,
    found: ArrayLike,
    microphones: ArrayLike,
    surface: AnySurface,
    *,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot true positions of sources and the corresponding estimates, on a drawing of the surface with its microphones.

    True positions of sources without an estimate (NaN) are drawn as hollow markers.

    **Arguments:**

    - `true`: true positions (P, d) of the sources, metres.
    - `found`: estimated positions (P, d), metres.
    - `microphones`: positions (M, d), metres.
    - `surface`: an outline, a surface, a `MicrophoneArray` or a `Calibration`.
    - `title`: title of the plot; by default the mean ± standard deviation of the localisation error.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for shapes that disagree.

    **Example:**

    ```python
    true = np.array([[0.03, 0.02], [-0.05, 0.01]])
    ax = plot_position_errors(true, true + 2e-3, skin.microphones, calibration)
    ```
    """
    surface_view = create_view(surface, microphones)
    true_points, estimated_points = surface_view.chart(true, "true"), surface_view.chart(found, "found")
    if true_points.shape != estimated_points.shape:
        raise ValueError(
            f"true has {len(true_points)} places and found {len(estimated_points)}; give them pair by pair."
        )
    has_estimate = np.isfinite(estimated_points).all(axis=1)
    errors_mm = 1e3 * np.linalg.norm(np.asarray(found, float) - np.asarray(true, float), axis=1)[has_estimate]
    ax = get_or_create_axes(ax)
    legend_handles = draw_surface(ax, surface_view)
    ax.add_collection(
        LineCollection(
            list(np.stack([true_points, estimated_points], axis=1)[has_estimate]),
            colors=DARK_GREY,
            linewidths=0.9,
            zorder=3,
        )
    )
    marker_style = {"marker": "o", "linestyle": "none", "markersize": 4.2}
    legend_handles += ax.plot(
        *true_points[has_estimate].T, color=DARK_GREY, markeredgewidth=0, zorder=4, label="true", **marker_style
    )
    if not has_estimate.all():
        legend_handles += ax.plot(
            *true_points[~has_estimate].T,
            color=DARK_GREY,
            fillstyle="none",
            zorder=4,
            label="not found",
            **marker_style,
        )
    legend_handles += ax.plot(
        *estimated_points[has_estimate].T,
        color=ESTIMATE_COLOUR,
        markeredgewidth=0,
        zorder=5,
        label="estimated",
        **marker_style,
    )
    draw_legend(ax, legend_handles)
    if title is None:
        title = f"{errors_mm.mean():.1f} ± {errors_mm.std():.1f} mm" if errors_mm.size else "none found"
    ax.set_title(title)
    return ax


def plot_error_curve(
    values: ArrayLike,
    errors: Mapping[str, ArrayLike],
    *,
    bound: ArrayLike | None = None,
    quantity: str = "Signal-to-noise ratio (dB)",
    statistic: str = "median",
    logarithmic: bool = False,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot localisation errors of one or several methods against a quantity such as the signal-to-noise ratio.

    If each value has the errors of several positions, a line shows the `statistic` of the errors, and a band the
    interquartile range. NaN is ignored. The axis of errors is logarithmic.

    **Arguments:**

    - `values`: values (K,) of the quantity on the abscissa.
    - `errors`: dictionary from the name of each method to its errors (K,) or (K, N), metres, for N positions per value.
    - `bound`: the Cramér-Rao bound (K,) or (K, N), metres; for (K, N) the `statistic` of the bound is drawn.
    - `quantity`: label of the axis of `values`.
    - `statistic`: statistic of the errors over positions, "median", "mean" or "rms".
    - `logarithmic`: whether the axis of `values` is logarithmic, for example for numbers of microphones.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for shapes that disagree, for an empty `errors`, and for more than six methods.

    **Example:**

    ```python
    errors = {"likelihood": [8e-3, 4e-3, 2e-3], "consistency": [12e-3, 7e-3, 5e-3]}
    ax = plot_error_curve([0, 10, 20], errors)
    ```
    """
    x = np.asarray(values, float)
    if x.ndim != 1 or not x.size or not np.isfinite(x).all() or (logarithmic and not (x > 0).all()):
        positive_prefix = "positive " if logarithmic else ""
        raise ValueError(
            f"values has shape {x.shape}; give (K,) finite {positive_prefix}numbers, one for each row of errors."
        )
    check_kind("errors", errors, Mapping, "{name: errors}")
    if not 1 <= len(errors) <= len(SERIES_COLOURS):
        raise ValueError(f"errors has {len(errors)} methods; give 1 to {len(SERIES_COLOURS)}, {{name: errors}}.")
    check_name("statistic", statistic, _ERROR_STATISTICS)
    errors_by_method = {
        method_name: _errors_in_millimetres(method_errors, f"errors['{method_name}']", x.size)
        for method_name, method_errors in errors.items()
    }
    bound_values = (
        None if bound is None else _ERROR_STATISTICS[statistic](_errors_in_millimetres(bound, "bound", x.size))
    )
    sort_order = np.argsort(x)
    ax = get_or_create_axes(ax, (5.8, 4.2))
    ax.set_yscale("log")
    for (method_name, error_rows), method_colour, method_marker in zip(
        errors_by_method.items(), SERIES_COLOURS, SERIES_MARKERS, strict=False
    ):
        line_style = {"color": method_colour, "marker": method_marker, "markersize": 5, "linewidth": 1.8, "zorder": 3}
        ax.plot(x[sort_order], _ERROR_STATISTICS[statistic](error_rows)[sort_order], label=method_name, **line_style)
        if error_rows.shape[1] > 1:
            lower_quartile, upper_quartile = np.nanquantile(error_rows, [0.25, 0.75], axis=1)
            ax.fill_between(
                x[sort_order],
                lower_quartile[sort_order],
                upper_quartile[sort_order],
                color=method_colour,
                alpha=0.18,
                linewidth=0,
                zorder=2,
            )
    if bound_values is not None:
        bound_style = {"color": DARK_GREY, "linewidth": 1.4, "linestyle": (0, (4, 3)), "zorder": 4}
        ax.plot(x[sort_order], bound_values[sort_order], label="Cramér-Rao bound", **bound_style)
    ax.set_xlabel(quantity, color=DARK_GREY)
    ax.set_ylabel({"rms": "RMS error (mm)"}.get(statistic, f"{statistic.capitalize()} error (mm)"), color=DARK_GREY)
    ax.set_title(title or "")
    _mark_axes(ax, x, logarithmic)
    ax.legend(frameon=False)
    return ax


def _mark_axes(ax: Axes, x: np.ndarray, is_logarithmic: bool) -> None:
    """Set the ticks and grid lines of the axes of an error curve with abscissae `x`."""
    if is_logarithmic:
        ax.set_xscale("log", base=2)
        ax.set_xticks(x)
        ax.minorticks_off()
        ax.xaxis.set_major_formatter(lambda tick_value, _: f"{tick_value:g}")
    else:
        ax.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(lambda tick_value, _: f"{tick_value:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())
    style_graph_axes(ax)
    draw_horizontal_grid(ax)


def _errors_in_millimetres(errors: ArrayLike, argument_name: str, num_values: int) -> np.ndarray:
    """Convert errors in metres, (K,) or (K, N), to an array (K, N) in millimetres, and check its shape and values."""
    error_array = np.asarray(errors, float)
    error_rows = error_array[:, None] if error_array.ndim == 1 else error_array
    if error_rows.ndim != 2 or len(error_rows) != num_values or not error_rows.shape[1]:
        raise ValueError(
            f"{argument_name} has shape {error_array.shape}; give ({num_values},) or ({num_values}, places), in metres."
        )
    if (error_rows < 0).any() or not np.isfinite(error_rows).any(axis=1).all():
        raise ValueError(
            f"{argument_name}: errors are distances, not negative, and every row needs one that is finite."
        )
    return 1e3 * error_rows
