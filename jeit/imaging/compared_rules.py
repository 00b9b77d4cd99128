"""Comparison of the rules for the hyperparameter on one measured difference: the λ that each chooses, and its image.

This is what `jeit choose` runs, as one function; on simulated data use `jeit.inverse.compare_rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.arguments import check_name
from jeit.data import Measurement
from jeit.image import Inclusion, find_inclusions
from jeit.imaging.method import ImagingSettings, as_settings, prior_for, rule_for
from jeit.imaging.preparation import Clock, PreparedDifference, check_real, prepare_difference
from jeit.inverse import RULES
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.hyperparameter.rules import choose
from jeit.inverse.linearisation import Linearisation


@dataclass(frozen=True)
class RuleOutcome:
    """Result of one rule for a difference.

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
    """Result of `compare_on_data`.

    - `prepared`: the difference that was imaged.
    - `settings`: the settings used; the prior is in them.
    - `outcomes`: the result of each rule, by name.
    - `refused`: rules that could not choose, by name, with the reason.
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
    cannot work on these data is `refused`, unless it is the only one asked for. Raises `ValueError` for a rule that
    there is not, and as they do.
    """
    settings = as_settings(settings)
    names = list(dict.fromkeys(RULES if rules is None else rules))
    for name in names:
        check_name("rules", name, RULES)
    if not names:
        raise ValueError(f"rules: none is named; give some of {', '.join(RULES)}.")
    clock = Clock(progress)
    prepared = prepare_difference(
        measurement,
        reference,
        frame=frame,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=clock,
    )
    check_real(prepared.measurement)
    mesh = prepared.mesh
    with clock("linearise"):
        linear = Linearisation.create(
            prepared.model,
            prepared.calibration.conductivity,
            prior=prior_for(settings.prior, prepared.domain),
            noise=prepared.relative_noise,
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
