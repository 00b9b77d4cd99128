"""Every rule for the hyperparameter on one measured difference: what each chooses, and the image that comes of it.

This is what `jeit choose` runs, as one function; on simulated data use `jeit.inverse.compare_rules`.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.data import Measurement
from jeit.image import Inclusion, find_inclusions
from jeit.imaging import ImagingSettings, prior_for, rule_for
from jeit.inverse import RULES, Choice
from jeit.inverse.hyperparameter import choose
from jeit.inverse.linearisation import Linearisation
from jeit.preparation import Clock, PreparedDifference, prepare_difference
from jeit.report import describe_measurement, plain


@dataclass(frozen=True)
class RuleOutcome:
    """What one rule makes of a difference.

    - `choice`: the λ chosen, and the curve it was chosen by.
    - `residual`: ‖w (v - Jx)‖ / ‖w v‖, the share of the difference that its image leaves unexplained.
    - `noise_figure`: signal-to-noise ratio of the data over that of the image (see `jeit.inverse.RULES`).
    - `change`: the image, change of conductivity per cell (m,), S/m (2-D: S).
    - `inclusions`: found in it, strongest first.
    """

    choice: Choice
    residual: float
    noise_figure: float
    change: Float[Array, " m"]
    inclusions: tuple[Inclusion, ...]


@dataclass(frozen=True)
class ComparedRules:
    """What `compare_on_data` found.

    - `prepared`: the difference that was imaged.
    - `settings`: how it was imaged; the prior is in it.
    - `outcomes`: what each rule made of it, by name.
    - `refused`: rules that could not choose, by name, and why.
    """

    prepared: PreparedDifference
    settings: ImagingSettings
    outcomes: dict[str, RuleOutcome]
    refused: dict[str, str]


def compare_on_data(
    measurement: Measurement,
    reference: Measurement | None = None,
    settings: ImagingSettings | None = None,
    *,
    rules: Sequence[str] | None = None,
    frame: int | str | None = None,
    progress: Callable[[str], None] | None = None,
) -> ComparedRules:
    """Image what changed between a reference frame and a frame of `measurement`, once for each rule's hyperparameter.

    `rules`: names in `jeit.inverse.RULES`, all unless given. Of `settings` the prior, the mesh and the calibration are
    used; the images are one-step's. Other arguments and errors as in `jeit.imaging.image_difference`; a rule that
    cannot work on these data is `refused`, unless it is the only one asked for.
    """
    settings = ImagingSettings() if settings is None else settings
    names = list(dict.fromkeys(RULES if rules is None else rules))
    for name in names:
        if name not in RULES:
            raise ValueError(f"rules: there is no '{name}'; give some of {', '.join(RULES)}.")
    if not names:
        raise ValueError(f"rules: none is named; give some of {', '.join(RULES)}.")
    clock = Clock(progress)
    prepared = prepare_difference(
        measurement, reference, frame=frame, contact=settings.contact, num_points=settings.num_points, clock=clock
    )
    mesh = prepared.mesh
    with clock("linearise"):
        linear = Linearisation.create(
            prepared.model,
            prepared.calibration.conductivity,
            prior=prior_for(settings.prior, prepared.domain),
            noise=prepared.deviation,
            mask=prepared.mask,
        )
        data = linear.whiten(prepared.difference)
        jax.block_until_ready(linear.spectrum)
    outcomes, refused = {}, {}
    with clock("choose"):
        figures = choose(linear.spectrum, "noise-figure", data, mesh)
        for name in names:
            try:
                rule = figures if name == figures.rule else rule_for(name, prepared)
                choice = choose(linear.spectrum, rule, data, mesh)
            except ValueError as error:
                if len(names) == 1:
                    raise
                refused[name] = str(error)
                continue
            change = linear.spectrum.image(data, choice.hyperparameter)
            inclusions = find_inclusions(mesh, change, level=settings.level, least_peak=settings.least_peak)
            outcomes[name] = RuleOutcome(
                choice,
                choice.read(choice.residual) / float(jnp.linalg.norm(data)),
                figures.read(figures.criterion, choice.hyperparameter),
                change,
                tuple(inclusions),
            )
    return ComparedRules(prepared, settings, outcomes, refused)


def write(result: ComparedRules, folder: str | Path) -> None:
    """Write `choice.png` and `choice.json` into `folder`, made if need be."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    draw(result).savefig(folder / "choice.png", dpi=120)
    text = json.dumps(report(result), indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "choice.json").write_text(text + "\n", "utf-8")


def draw(result: ComparedRules):
    """The image of every rule above the curves that they were chosen by, as a matplotlib `Figure`."""
    from matplotlib.figure import Figure

    from jeit.plot import plot_choice, plot_image
    from jeit.plot.choice import COLOURS

    outcomes = result.outcomes
    figure = Figure(figsize=(max(2.1 * len(outcomes), 8.4), 7.4), layout="constrained")
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.9)))
    factor, unit = (1e3, "mS") if result.prepared.mesh.dimension == 2 else (1.0, "S/m")
    columns = np.atleast_1d(upper.subplots(1, len(outcomes)))
    for ax, (name, outcome) in zip(columns, outcomes.items(), strict=True):
        plot_image(result.prepared.mesh, outcome.change, inclusions=outcome.inclusions, colour_bar=False, ax=ax)
        largest = factor * float(jnp.abs(outcome.change).max())
        ax.set_title(name, color=COLOURS[name], fontsize=11, pad=0)
        ax.text(1, 0, f"± {largest:.3g} {unit}", transform=ax.transAxes, ha="right", va="bottom", fontsize=9)
    choices = {name: outcome.choice for name, outcome in outcomes.items()}
    plot_choice(choices, title=result.prepared.measurement.name, ax=lower.subplots())
    return figure


def report(result: ComparedRules) -> dict[str, Any]:
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
