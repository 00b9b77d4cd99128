"""Reports on the comparison of two electrode layouts and on the optimisation of a layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jeit.design.comparison import LayoutComparison
from jeit.design.improvement import ImprovedLayout
from jeit.design.scores import Scores
from jeit.layout import write_layout
from jeit.mesh import Disk, Domain, Rectangle
from jeit.report.folder import describe_domain, results, to_plain_values, write_json

# Maximum number of characters of a layout's name in a plot.
_MAX_NAME_LENGTH = 32


def write_layout_comparison(result: LayoutComparison, folder: str | Path) -> None:
    """Write the comparison of two layouts to `comparison.png` and `report.json` in a folder.

    **Arguments:**

    - `result`: result of `compare_layouts`.
    - `folder`: the folder, which is created if needed.

    Raises `ValueError` if the folder cannot be created or written.

    **Example:**

    ```python
    comparison = compare_layouts(sheet, other, places=8, num_taxels=4)
    write_layout_comparison(comparison, "out")
    ```
    """
    with results(folder, ("comparison.png", "report.json")) as temporary_folder:
        write_json(report_layout_comparison(result), temporary_folder / "report.json")
        draw_layout_comparison(result).savefig(temporary_folder / "comparison.png", dpi=130)


def report_layout_comparison(result: LayoutComparison) -> dict[str, Any]:
    """Scores of the two compared layouts ("layouts"), and parameters of the skins and touches ("options"), as plain
    numbers and strings."""
    first_skin, first_response = result.skins[0], result.responses[0]
    comparison_options = {
        "thickness_mm": 1e3 * first_skin.thickness,
        "conductivity_S_per_m": first_skin.conductivity,
        "pairs": first_skin.model.protocol.num_measurements,
        "taxels": len(first_response.taxels.areas),
        "contrast": result.contrast,
        "margin_mm": 1e3 * result.margin,
        "places": result.places,
        "cell_mm": None if first_skin.cell_size is None else 1e3 * first_skin.cell_size,
        "seed": result.seed,
    }
    return to_plain_values({"layouts": result.figures, "options": comparison_options})


def draw_layout_comparison(result: LayoutComparison):
    """Plot the sensitivity and taxel maps of two layouts with the same colour scales, and histograms of sensitivity and
    taxel area, as a matplotlib `Figure`."""
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, PathPatch

    from jeit.design.plots import plot_sensitivity_histograms, plot_sensitivity_map, plot_taxel_areas, plot_taxels
    from jeit.design.plots.travel import outline_path
    from jeit.layout.surface_layout import flat_layout
    from jeit.plot.axes import draw_scale_bar, hide_axes
    from jeit.plot.colours import DARK_GREY

    figure = Figure(figsize=(14.4, 8.8), layout="constrained")
    figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.12)
    figure_axes = figure.subplots(2, 3, width_ratios=(1.1, 1.1, 1))
    responses = result.responses
    max_sensitivity = max(float(layout_response.sensitivity.values.max()) for layout_response in responses)
    max_taxel_area = max(float(layout_response.taxels.max_area) for layout_response in responses)
    layout_names = distinct_names([_shorten_name(layout_response.layout.name) for layout_response in responses])
    for row_axes, layout_name, layout_response in zip(figure_axes, layout_names, responses, strict=True):
        electrode_centres, skin_outline = (
            layout_response.layout.centres,
            flat_layout(layout_response.layout).known_outline,
        )
        plot_sensitivity_map(
            layout_response.sensitivity,
            electrodes=electrode_centres,
            limit=max_sensitivity,
            title=f"{layout_name}: sensitivity",
            ax=row_axes[0],
        )
        plot_taxels(
            layout_response.taxels,
            electrodes=electrode_centres,
            limit=max_taxel_area,
            title=f"{layout_name}: taxels",
            ax=row_axes[1],
        )
        # The scale bar of the taxel map is placed for the touched part of the skin only. It is replaced by a scale bar
        # for the whole skin, which both maps show.
        for scale_bar_part in (row_axes[1].lines[-1], row_axes[1].texts[-1]):
            scale_bar_part.remove()
        draw_scale_bar(row_axes[1], skin_outline.extent)
        for ax in row_axes[:2]:
            ax.add_patch(PathPatch(outline_path(skin_outline), facecolor="none", edgecolor=DARK_GREY, linewidth=0.9))
            hide_axes(ax, skin_outline.extent, numbered=False)
    plot_sensitivity_histograms(
        {
            layout_name: layout_response.sensitivity
            for layout_name, layout_response in zip(layout_names, responses, strict=True)
        },
        ax=figure_axes[0, 2],
    )
    plot_taxel_areas(
        {
            layout_name: layout_response.taxels
            for layout_name, layout_response in zip(layout_names, responses, strict=True)
        },
        ax=figure_axes[1, 2],
    )
    electrode_marker: dict[str, Any] = {
        "marker": "o",
        "linestyle": "none",
        "markerfacecolor": "white",
        "markeredgecolor": DARK_GREY,
    }
    legend_handles: list[Artist] = [Line2D([], [], label="electrode", **electrode_marker)]
    if result.margin > 0:
        margin_label = f"not touched: {1e3 * result.margin:.3g} mm wide"
        legend_handles.append(Patch(facecolor="white", edgecolor=DARK_GREY, linewidth=0.9, label=margin_label))
    figure.legend(handles=legend_handles, loc="outside lower left", ncols=2, frameon=False)
    return figure


def distinct_names(names: list[str]) -> list[str]:
    """Return the two layout names, with numbers appended if the names are equal."""
    return names if names[0] != names[1] else [f"{layout_name} ({k})" for k, layout_name in enumerate(names, 1)]


def _shorten_name(layout_name: str) -> str:
    """A layout's name, shortened to fit above a map."""
    return layout_name if len(layout_name) <= _MAX_NAME_LENGTH else f"{layout_name[: _MAX_NAME_LENGTH - 1]}…"


def write_improved_layout(result: ImprovedLayout, folder: str | Path) -> None:
    """Write an optimised layout to `layout.csv`, `layout.svg`, `travel.png` and `report.json` in a folder.

    **Arguments:**

    - `result`: result of `improve_layout`.
    - `folder`: the folder, which is created if needed.

    Raises `ValueError` if the folder cannot be created or written.

    **Example:**

    ```python
    improved = improve_layout(layout, DesignSpace(minimum_spacing=0.012), steps=1, num_points=400)
    write_improved_layout(improved, "out")
    ```
    """
    with results(folder, ("layout.csv", "layout.svg", "travel.png", "report.json")) as temporary_folder:
        write_layout(result.layout, temporary_folder / "layout.csv")
        write_layout(result.layout, temporary_folder / "layout.svg")
        draw_improved_layout(result).savefig(temporary_folder / "travel.png", dpi=150)
        write_json(report_improved_layout(result), temporary_folder / "report.json")


def draw_improved_layout(result: ImprovedLayout):
    """Plot the paths of the electrodes in the optimisation, as a matplotlib `Figure`."""
    from matplotlib.figure import Figure

    from jeit.design.plots import plot_travel

    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    optimisation = result.optimisation
    plot_travel(optimisation, optimisation.best or 0, keep_out=result.space.keep_out, ax=figure.subplots())
    return figure


def report_improved_layout(result: ImprovedLayout) -> dict[str, Any]:
    """Result of the layout optimisation, scores of the given ("start") and the optimised layout ("optimised") on the
    finer mesh, and the options, as plain numbers and strings. Values that are not finite are None."""
    optimisation, skin, design_space = result.optimisation, result.skin, result.space
    layout_report = {
        "layout": result.start.name,
        "status": optimisation.status,
        "reason": optimisation.reason,
        "start": _score_figures(result.before),
        "optimised": _score_figures(result.after),
        "starts": optimisation.values,
        "steps": optimisation.history.shape[1] - 1,
        "seed": result.seed,
        "options": {
            "thickness_mm": 1e3 * skin.thickness,
            "conductivity_S_per_m": skin.conductivity,
            "noise_V": result.noise,
            "minimum_spacing_mm": 1e3 * design_space.minimum_spacing,
            "keep_out_mm": [_format_region(keep_out_domain) for keep_out_domain in design_space.keep_out],
            "symmetry": design_space.symmetry,
            "sizes": design_space.sizes,
            "num_points": result.num_points,
        },
    }
    return to_plain_values(layout_report)


def _score_figures(scores: Scores) -> dict[str, Any]:
    return {
        "worst_sensitivity_V": scores.worst,
        "mean_sensitivity_V": scores.mean,
        "uniformity": scores.uniformity,
        "mean_variance": scores.mean_variance,
        "log_information_nats": scores.log_information,
        "largest_variance": scores.largest_variance,
        "mean_localisation_error_m": scores.localisation_error.mean(),
    }


def _format_region(keep_out_domain: Domain) -> str | dict[str, Any]:
    """Keep-out region in the format of the option --keep-out, a disc "x,y,radius" or a rectangle "x1,y1,x2,y2" in
    millimetres. For a region of a different shape, a description is returned."""
    if isinstance(keep_out_domain, Disk):
        region_numbers = (*keep_out_domain.centre, keep_out_domain.radius)
    elif isinstance(keep_out_domain, Rectangle):
        low_x, high_x, low_y, high_y = keep_out_domain.extent
        region_numbers = (low_x, low_y, high_x, high_y)
    else:
        return describe_domain(keep_out_domain)
    return ",".join(f"{1e3 * region_number:.6g}" for region_number in region_numbers)
