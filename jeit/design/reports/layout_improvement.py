"""Files of an optimised layout: for the laser cutter, a plot of the electrodes' paths, and a report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jeit.design.improvement import ImprovedLayout
from jeit.design.scores import Scores
from jeit.layout import write_layout
from jeit.mesh import Disk, Domain, Rectangle
from jeit.report.folder import describe_domain, plain, results, write_json


def write_improved_layout(result: ImprovedLayout, folder: str | Path) -> None:
    """Write `layout.csv`, `layout.svg`, `travel.png` and `report.json` into `folder`, created if needed.

    Raises `ValueError` for what cannot be one.
    """
    with results(folder, ("layout.csv", "layout.svg", "travel.png", "report.json")) as made:
        write_layout(result.layout, made / "layout.csv")
        write_layout(result.layout, made / "layout.svg")
        draw_improved_layout(result).savefig(made / "travel.png", dpi=150)
        write_json(report_improved_layout(result), made / "report.json")


def draw_improved_layout(result: ImprovedLayout):
    """Plot the electrodes' paths, as a matplotlib `Figure`."""
    from matplotlib.figure import Figure

    from jeit.design.plots import plot_travel

    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    found = result.optimisation
    plot_travel(found, found.best or 0, keep_out=result.space.keep_out, ax=figure.subplots())
    return figure


def report_improved_layout(result: ImprovedLayout) -> dict[str, Any]:
    """Report of the optimisation, figures of the given layout ("start") and of the better one ("optimised"), both on
    the finer mesh, and the options, as plain numbers and strings; None where there is no finite value."""
    found, skin, space = result.optimisation, result.skin, result.space
    content = {
        "layout": result.start.name,
        "status": found.status,
        "reason": found.reason,
        "start": _figures(result.before),
        "optimised": _figures(result.after),
        "starts": found.values,
        "steps": found.history.shape[1] - 1,
        "seed": result.seed,
        "options": {
            "thickness_mm": 1e3 * skin.thickness,
            "conductivity_S_per_m": skin.conductivity,
            "noise_V": result.noise,
            "minimum_spacing_mm": 1e3 * space.minimum_spacing,
            "keep_out_mm": [_region(domain) for domain in space.keep_out],
            "symmetry": space.symmetry,
            "sizes": space.sizes,
            "num_points": result.num_points,
        },
    }
    return plain(content)


def _figures(scores: Scores) -> dict[str, Any]:
    return {
        "worst_sensitivity_V": scores.worst,
        "mean_sensitivity_V": scores.mean,
        "uniformity": scores.uniformity,
        "mean_variance": scores.mean_variance,
        "log_information_nats": scores.log_information,
        "largest_variance": scores.largest_variance,
        "mean_localisation_error_m": scores.localisation_error.mean(),
    }


def _region(domain: Domain) -> str | dict[str, Any]:
    """Region in the format of the command: a disc "x,y,radius" or rectangle "x1,y1,x2,y2", millimetres; others in
    words."""
    if isinstance(domain, Disk):
        numbers = (*domain.centre, domain.radius)
    elif isinstance(domain, Rectangle):
        low_x, high_x, low_y, high_y = domain.extent
        numbers = (low_x, low_y, high_x, high_y)
    else:
        return describe_domain(domain)
    return ",".join(f"{1e3 * number:.6g}" for number in numbers)
