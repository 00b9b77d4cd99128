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
    names = list(dict.fromkeys(RULES if rules is None else rules))
    for name in names:
        check_name("rules", name, RULES)
    if not names:
        raise ValueError(f"rules: none is named; give some of {', '.join(RULES)}.")
    clock = StepTimer(progress)
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
        linearisation = Linearisation.create(
            prepared.model,
            prepared.calibration.conductivity,
            prior=prior_for(settings.prior, prepared.domain),
            noise=prepared.relative_noise,
            mask=prepared.mask,
        )
        data = linearisation.whiten(prepared.difference)
        jax.block_until_ready(linearisation.spectrum)
    outcomes, refusal_reasons, prepared_with_noise = {}, {}, prepared
    with clock("choose"):
        noise_figure_choice = choose(linearisation.spectrum, "noise-figure", data, mesh)
        for name in names:
            try:
                rule = noise_figure_choice if name == noise_figure_choice.rule else choose_rule(name, prepared)
                choice = choose(linearisation.spectrum, rule, data, mesh)
            except ValueError as error:
                if len(names) == 1:
                    raise
                refusal_reasons[name] = str(error)
                continue
            factors = linearisation.factors(choice.hyperparameter)
            fields = choice.hyperparameter, choice.rule, "one-step", choice
            reconstruction = LinearReconstruction.of_factors(prepared.model, factors, *fields)
            change = reconstruction.image(prepared.difference)
            prepared_with_estimated_noise = estimate_unexplained_noise(prepared, reconstruction, change)
            conductivity_change, noise = change_and_noise(prepared_with_estimated_noise, reconstruction, change)
            regions = inclusion_regions(
                mesh, conductivity_change, level=settings.level, least_peak=settings.least_peak, noise=noise
            )
            outcomes[name] = RuleOutcome(
                choice,
                choice.read(choice.residual) / float(jnp.linalg.norm(data)),
                noise_figure_choice.read(noise_figure_choice.criterion, choice.hyperparameter),
                change,
                tuple(inclusion for inclusion, _ in regions),
            )
            if name == DEFAULT_RULE or len(outcomes) == 1:
                prepared_with_noise = prepared_with_estimated_noise
    return ComparedRules(prepared_with_noise, settings, outcomes, refusal_reasons)
