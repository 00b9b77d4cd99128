"""The method that the settings name, applied to a prepared difference: linear or iterative, with its prior and λ."""

from functools import partial

from jeit.imaging.preparation import PreparedDifference
from jeit.imaging.settings import ImagingSettings, prior_for
from jeit.inverse import (
    RULES,
    LinearReconstruction,
    Reconstruction,
    TotalVariation,
    back_projection,
    one_step,
    reconstruct,
)
from jeit.inverse.hyperparameter.rules import Rule, discrepancy


def rule_for(name: str, prepared: PreparedDifference) -> Rule:
    """The rule of that name, told of the noise in the data if it needs to know. Raises `ValueError` if none does."""
    if name != "discrepancy":
        return RULES[name]
    if prepared.noise is None:
        raise ValueError(
            "hyperparameter: 'discrepancy' needs to know the noise, and no two channels of "
            f"'{prepared.model.protocol.name}' are tied by reciprocity to tell it from; choose another rule, or a "
            "number."
        )
    return partial(discrepancy, noise=prepared.noise)


def linear_reconstruction(prepared: PreparedDifference, settings: ImagingSettings) -> LinearReconstruction:
    model, conductivity = prepared.model, prepared.calibration.conductivity
    hyperparameter = settings.hyperparameter
    if settings.method != "one-step":
        filtered = settings.method.startswith("filtered")
        given = {"hyperparameter": hyperparameter} if isinstance(hyperparameter, (int, float)) else {}
        return back_projection(model, conductivity, filtered=filtered, mask=prepared.mask, **given)
    assert hyperparameter is not None
    return one_step(
        model,
        conductivity,
        prior=prior_for(settings.prior, prepared.domain),
        hyperparameter=rule_for(hyperparameter, prepared) if isinstance(hyperparameter, str) else hyperparameter,
        difference=prepared.difference,
        noise=prepared.deviation,
        mask=prepared.mask,
    )


def iterative_reconstruction(prepared: PreparedDifference, settings: ImagingSettings) -> Reconstruction:
    """The conductivity whose voltages differ from the model's own as the frame differs from its reference.

    So what the model gets wrong alike with and without objects is left out. Raises `ValueError` if the solver fails.
    """
    model, background = prepared.model, prepared.calibration.conductivity
    total_variation = settings.method == "total-variation"
    hyperparameter = settings.hyperparameter
    if isinstance(hyperparameter, str):
        hyperparameter = rule_for(hyperparameter, prepared)
    found = reconstruct(
        model,
        model.voltages(background) + prepared.difference,
        background,
        prior=TotalVariation() if total_variation else prior_for(settings.prior, prepared.domain),
        hyperparameter=hyperparameter,
        noise=prepared.deviation,
        mask=prepared.mask,
        solver="gauss-newton" if total_variation else settings.method,
        max_steps=100,
        rtol=1e-4,
    )
    if found.status == "failed":
        raise ValueError(f"'{prepared.measurement.name}': the reconstruction failed. {found.reason}")
    return found
