"""What every rule for the hyperparameter chose on a measured difference, on disk: a picture and a report."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jeit.imaging.compared_rules import ComparedRules
from jeit.report.describe import describe_measurement, plain
from jeit.report.folder import results_folder


def write_choice(result: ComparedRules, folder: str | Path) -> None:
    """Write `choice.png` and `choice.json` into `folder`, made if need be.

    Raises `ValueError` for what cannot be one.
    """
    folder = results_folder(folder, ("choice.png", "choice.json"))
    draw_choice(result).savefig(folder / "choice.png", dpi=120)
    text = json.dumps(report_choice(result), indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "choice.json").write_text(text + "\n", "utf-8")


def draw_choice(result: ComparedRules):
    """The image of every rule above the curves that they were chosen by, as a matplotlib `Figure`."""
    from matplotlib.figure import Figure

    from jeit.plot import ColourScale, plot_choice, plot_image
    from jeit.plot.axes import INK
    from jeit.plot.imaging.hyperparameter import COLOURS

    outcomes = result.outcomes
    figure = Figure(figsize=(max(2.1 * len(outcomes), 8.4), 7.4), layout="constrained")
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.9)))
    factor, unit = (1e3, "mS") if result.prepared.mesh.dimension == 2 else (1.0, "S/m")
    columns = np.atleast_1d(upper.subplots(1, len(outcomes)))
    for ax, (name, outcome) in zip(columns, outcomes.items(), strict=True):
        plot_image(
            result.prepared.mesh, outcome.change, inclusions=outcome.inclusions, scale=ColourScale(bar=False), ax=ax
        )
        largest = factor * float(jnp.abs(outcome.change).max())
        ax.set_title(name, color=COLOURS.get(name, INK), fontsize=11, pad=0)
        ax.text(1, 0, f"± {largest:.3g} {unit}", transform=ax.transAxes, ha="right", va="bottom", fontsize=9)
    choices = {name: outcome.choice for name, outcome in outcomes.items()}
    plot_choice(choices, title=result.prepared.measurement.name, ax=lower.subplots())
    return figure


def report_choice(result: ComparedRules) -> dict[str, Any]:
    """All that was found, as plain numbers, strings, lists and dictionaries; what is not known is None."""
    prepared, settings = result.prepared, result.settings
    unit = "S" if prepared.mesh.dimension == 2 else "S/m"
    rules = []
    for name, outcome in result.outcomes.items():
        choice = outcome.choice
        rules.append(
            {
                "rule": name,
                "hyperparameter": choice.hyperparameter,
                "edge_of_grid": choice.edge or None,
                "note": choice.note or None,
                "relative_residual": outcome.residual,
                "noise_figure": outcome.noise_figure,
                "inclusions": [
                    {"sign": found.sign, "kind": found.kind, "centroid": list(found.centroid), "peak": found.peak}
                    for found in outcome.inclusions
                ],
                "target": choice.target,
                "candidates": choice.candidates,
                "criterion": choice.criterion,
                "residual": choice.residual,
                "penalty": choice.penalty,
            }
        )
    content = {
        "data": describe_measurement(prepared.measurement),
        "reference": describe_measurement(prepared.reference),
        "mesh": {"points": prepared.mesh.num_points, "cells": prepared.mesh.num_cells},
        "prior": settings.prior if isinstance(settings.prior, str) else type(settings.prior).__name__,
        "background": float(prepared.calibration.conductivity),
        "conductivity_unit": unit,
        "centroid_unit": "m",
        "residual_unit": "standard deviations of jeit.inverse.relative_noise",
        "rules": rules,
        "refused": result.refused,
    }
    return plain(content)
