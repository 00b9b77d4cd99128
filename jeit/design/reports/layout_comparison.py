"""Files of a comparison of two layouts: a plot and a report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jeit.design.comparison import LayoutComparison
from jeit.report.folder import plain, results, write_json

# Most letters of a name in the plot.
_LONGEST = 32


def write_layout_comparison(result: LayoutComparison, folder: str | Path) -> None:
    """Write `comparison.png` and `report.json` into `folder`, created if needed.

    Raises `ValueError` for what cannot be one.
    """
    with results(folder, ("comparison.png", "report.json")) as made:
        write_json(report_layout_comparison(result), made / "report.json")
        draw_layout_comparison(result).savefig(made / "comparison.png", dpi=130)


def report_layout_comparison(result: LayoutComparison) -> dict[str, Any]:
    """Report of both "layouts", and the "options" of skins and touches, as plain numbers and strings."""
    skin, response = result.skins[0], result.responses[0]
    options = {
        "thickness_mm": 1e3 * skin.thickness,
        "conductivity_S_per_m": skin.conductivity,
        "pairs": skin.model.protocol.num_measurements,
        "taxels": len(response.taxels.areas),
        "contrast": result.contrast,
        "margin_mm": 1e3 * result.margin,
        "places": result.places,
        "cell_mm": None if skin.cell_size is None else 1e3 * skin.cell_size,
        "seed": result.seed,
    }
    return plain({"layouts": result.figures, "options": options})


def draw_layout_comparison(result: LayoutComparison):
    """Plot the sensitivity and taxel maps of both layouts on one scale, and their histograms, as a matplotlib
    `Figure`."""
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, PathPatch

    from jeit.design.plots import plot_sensitivity_histograms, plot_sensitivity_map, plot_taxel_areas, plot_taxels
    from jeit.design.plots.travel import outline_path
    from jeit.layout.surface_layout import flat_layout
    from jeit.plot.axes import INK, bare, draw_scale_bar

    figure = Figure(figsize=(14.4, 8.8), layout="constrained")
    figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.12)
    axes = figure.subplots(2, 3, width_ratios=(1.1, 1.1, 1))
    both = result.responses
    highest = max(float(one.sensitivity.values.max()) for one in both)
    largest = max(float(one.taxels.max_area) for one in both)
    names = distinct_names([_shortened(one.layout.name) for one in both])
    for row, name, one in zip(axes, names, both, strict=True):
        centres, outline = one.layout.centres, flat_layout(one.layout).known_outline
        plot_sensitivity_map(
            one.sensitivity, electrodes=centres, limit=highest, title=f"{name}: sensitivity", ax=row[0]
        )
        plot_taxels(one.taxels, electrodes=centres, limit=largest, title=f"{name}: taxels", ax=row[1])
        # The colour bar, drawn last, is placed by the touched part; both maps show the whole skin.
        for bar in (row[1].lines[-1], row[1].texts[-1]):
            bar.remove()
        draw_scale_bar(row[1], outline.extent)
        for ax in row[:2]:
            ax.add_patch(PathPatch(outline_path(outline), facecolor="none", edgecolor=INK, linewidth=0.9))
            bare(ax, outline.extent, numbered=False)
    plot_sensitivity_histograms({name: one.sensitivity for name, one in zip(names, both, strict=True)}, ax=axes[0, 2])
    plot_taxel_areas({name: one.taxels for name, one in zip(names, both, strict=True)}, ax=axes[1, 2])
    disc: dict[str, Any] = {"marker": "o", "linestyle": "none", "markerfacecolor": "white", "markeredgecolor": INK}
    handles: list[Artist] = [Line2D([], [], label="electrode", **disc)]
    if result.margin > 0:
        untouched = f"not touched: {1e3 * result.margin:.3g} mm wide"
        handles.append(Patch(facecolor="white", edgecolor=INK, linewidth=0.9, label=untouched))
    figure.legend(handles=handles, loc="outside lower left", ncols=2, frameon=False)
    return figure


def distinct_names(names: list[str]) -> list[str]:
    """Two names, numbered if they are the same."""
    return names if names[0] != names[1] else [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _shortened(name: str) -> str:
    """A layout's name, shortened to fit above a map."""
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…"
