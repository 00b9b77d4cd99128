"""Comparison of the rules for the hyperparameter λ on one measured difference: the λ that each rule chooses, and the
image with this λ.

The command `jeit choose` runs `compare_on_data`; for simulated data see `jeit.inverse.compare_rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.arguments import check_name
from jeit.data import Measurement
from jeit.image import Inclusion
from jeit.image.inclusions import inclusion_regions
from jeit.imaging.automatic import change_and_noise, estimate_unexplained_noise
from jeit.imaging.calibration import StepTimer
from jeit.imaging.method import ImagingSettings, as_settings, choose_rule, prior_for
from jeit.imaging.preparation import PreparedDifference, check_real, prepare_difference
from jeit.inverse import RULES
from jeit.inverse.hyperparameter.choice import DEFAULT_RULE, Choice
from jeit.inverse.hyperparameter.rules import choose
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.linearisation import Linearisation


@dataclass(frozen=True)
class RuleOutcome:
    """Value of λ that one rule chooses for a measured difference, and the image with this λ.

    **Fields**

    - `choice`: the chosen λ, and the curve from which it was chosen.
    - `residual`: ‖w (v - Jx)‖ / ‖w v‖, the share of the voltage difference v that the image x does not explain. J is
      the Jacobian, w are the weights of the channels.
    - `noise_figure`: signal-to-noise ratio of the data divided by that of the image (see `jeit.inverse.RULES`).
    - `change`: the image, change of conductivity per cell (m,), S/m (2-D: S).
    - `inclusions`: inclusions that exceed the noise of the image, as of `image_difference`, strongest first.

    **Example:**

    ```python
    outcome = compare_on_data(pressed, rest, quick, rules=["gcv"]).outcomes["gcv"]
    outcome.residual, outcome.inclusions
    ```
    """

    choice: Choice
    residual: float
    noise_figure: float
    change: Float[Array, " m"]
    inclusions: tuple[Inclusion, ...]


@dataclass(frozen=True)
class ComparedRules:
    """Images of one difference with the λ of each rule: the result of `compare_on_data`.

    **Fields**

    - `prepared`: the imaged difference; a noise that was not known is estimated from the image of the default rule.
    - `settings`: the settings used, among them the prior.
    - `outcomes`: the result of each rule, by name.
    - `refused`: the reason why a rule could not choose λ, by name of the rule.

    **Example:**

    ```python
    compared = compare_on_data(pressed, rest, quick, rules=["gcv", "l-curve"])
    {name: outcome.choice.hyperparameter for name, outcome in compared.outcomes.items()}
    ```
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
    """Image the change between a reference frame and a frame of `measurement` with the hyperparameter that each rule
    chooses.

    The images are computed by one-step imaging. A rule that cannot be applied to the data is listed in
    `refused`, or raises `ValueError` if it is the only rule requested.

    **Arguments:**

    - `measurement`, `reference`, `frame`, `progress`: as in `image_difference`.
    - `settings`: prior, mesh, calibration, and search for inclusions.
    - `rules`: names in `jeit.inverse.RULES`; default: all.

    Raises `ValueError` for unknown rules, and in the same cases as `image_difference`.

    **Example:**

    ```python
    compared = compare_on_data(pressed, rest, quick, rules=["gcv", "l-curve"])
    ```
    """
    settings = as_settings(settings)
    rule_names = list(dict.fromkeys(RULES if rules is None else rules))
    for rule_name in rule_names:
        check_name("rules", rule_name, RULES)
    if not rule_names:
        raise ValueError(f"rules: none is named; give some of {', '.join(RULES)}.")
    step_timer = StepTimer(progress)
    prepared = prepare_difference(
        measurement,
        reference,
        frame=frame,
        contact=settings.contact,
        num_points=settings.num_points,
        as_is=settings.as_is,
        clock=step_timer,
    )
    check_real(prepared.measurement)
    mesh = prepared.mesh
    with step_timer("linearise"):
        linearisation = Linearisation.create(
            prepared.model,
            prepared.calibration.conductivity,
            prior=prior_for(settings.prior, prepared.domain),
            noise=prepared.relative_noise,
            mask=prepared.mask,
        )
        whitened_difference = linearisation.whiten(prepared.difference)
        jax.block_until_ready(linearisation.spectrum)
    rule_outcomes, refusal_reasons, prepared_with_noise = {}, {}, prepared
    with step_timer("choose"):
        noise_figure_choice = choose(linearisation.spectrum, "noise-figure", whitened_difference, mesh)
        for rule_name in rule_names:
            try:
                rule = (
                    noise_figure_choice if rule_name == noise_figure_choice.rule else choose_rule(rule_name, prepared)
                )
                hyperparameter_choice = choose(linearisation.spectrum, rule, whitened_difference, mesh)
            except ValueError as error:
                if len(rule_names) == 1:
                    raise
                refusal_reasons[rule_name] = str(error)
                continue
            reconstruction_factors = linearisation.factors(hyperparameter_choice.hyperparameter)
            reconstruction_fields = (
                hyperparameter_choice.hyperparameter,
                hyperparameter_choice.rule,
                "one-step",
                hyperparameter_choice,
            )
            reconstruction = LinearReconstruction.of_factors(
                prepared.model, reconstruction_factors, *reconstruction_fields
            )
            conductivity_change = reconstruction.image(prepared.difference)
            prepared_with_estimated_noise = estimate_unexplained_noise(prepared, reconstruction, conductivity_change)
            change_without_common, noise_per_cell = change_and_noise(
                prepared_with_estimated_noise, reconstruction, conductivity_change
            )
            inclusions_with_regions = inclusion_regions(
                mesh, change_without_common, level=settings.level, least_peak=settings.least_peak, noise=noise_per_cell
            )
            rule_outcomes[rule_name] = RuleOutcome(
                hyperparameter_choice,
                hyperparameter_choice.read(hyperparameter_choice.residual)
                / float(jnp.linalg.norm(whitened_difference)),
                noise_figure_choice.read(noise_figure_choice.criterion, hyperparameter_choice.hyperparameter),
                conductivity_change,
                tuple(inclusion for inclusion, _ in inclusions_with_regions),
            )
            if rule_name == DEFAULT_RULE or len(rule_outcomes) == 1:
                prepared_with_noise = prepared_with_estimated_noise
    return ComparedRules(prepared_with_noise, settings, rule_outcomes, refusal_reasons)
