"""Automatic choice of the imaging method, with its reason: one-step imaging where the linear image is sound, otherwise
Gauss-Newton imaging and a fit of the shapes of bodies."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Inexact

from jeit.arguments import percent
from jeit.imaging.method import METHODS, Imaged, MethodOptions, conductivity_change_of_shapes, shapes_in
from jeit.imaging.preparation import PreparedDifference
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.prior.matern import MEASURED_DATA_PRIOR
from jeit.inverse.shapes import ShapeReconstruction
from jeit_solvers import results_on_cores
from jeit_solvers.engines import as_array

# Changes of conductivity, relative to the background, above which voltages are not linear in conductivity. The second
# value applies to noisy data, whose images show far less than the true change. Data are noisy if the share of noise in
# the voltage difference exceeds `_MIN_NOISY_NOISE_SHARE`.
_STRONG_CONDUCTIVITY_CHANGE, _STRONG_CONDUCTIVITY_CHANGE_IN_NOISE, _MIN_NOISY_NOISE_SHARE = 0.3, 0.1, 0.3
# A linear image has a fault if the voltages computed from it leave too large a share of the voltage difference
# unexplained: more than `_LARGE_MISFIT`, and more than `_MAX_MISFIT_RATIO` times the share that linearised voltages
# leave unexplained.
_MAX_MISFIT_RATIO, _LARGE_MISFIT = 1.1, 0.1
# Lower bound of the conductivity of a linear image, as a share of the background conductivity.
_MIN_CONDUCTIVITY = 0.01
# Bodies are fitted in a solid if the largest change of conductivity in an image exceeds this share of the background.
_MIN_RELATIVE_BODY_CHANGE = 0.05
# Maximum ratio of the misfit of fitted bodies to the misfit of the smooth image. Up to this ratio, fitted bodies are
# preferred, since they have far fewer parameters. In simulated tanks in which the misfit of the bodies exceeded one
# standard deviation, the ratio was 1.0 to 1.2 for homogeneous bodies and 2.2 to 18 for smooth conductivity.
_MAX_SHAPE_MISFIT_RATIO = 1.5
# Step along the linear image for the finite difference that approximates the derivative of the voltages.
_DERIVATIVE_STEP = 1e-4


class ChosenMethod(NamedTuple):
    """Automatically chosen imaging method and its image. **Fields**: `method`: name of the method; `reason`: why the
    method was chosen, in a sentence; `imaged`: its reconstruction and image; `shapes`: the fitted bodies, if they
    explain the voltages."""

    method: str
    reason: str
    imaged: Imaged
    shapes: ShapeReconstruction | None = None


def image_automatically(prepared: PreparedDifference, options: MethodOptions, segmented: bool = False) -> ChosenMethod:
    """Compute the one-step image if it is sound (see `linear_image_fault`), otherwise the Gauss-Newton image with the
    bodies in it fitted as shapes. If Gauss-Newton imaging fails, the one-step image is returned.

    In a solid with the default prior, bodies are also fitted where the one-step image is sound. Each method uses its
    default λ, not the requested λ. If the image is to be `segmented` and no shapes were fitted, total variation is
    used.
    """
    one_step_image = _image_with_method("one-step", prepared, options)
    if np.iscomplexobj(prepared.difference):
        return ChosenMethod("one-step", "images of complex voltages are linear.", one_step_image)
    image_fault, has_custom_prior = (
        linear_image_fault(prepared, one_step_image[1]),
        prepared.mesh.dimension == 3 and options.prior != MEASURED_DATA_PRIOR,
    )
    if image_fault:
        try:
            gauss_newton_image = _smooth_image_for_bodies(prepared, options)
        except ValueError as error:
            return ChosenMethod("one-step", f"{image_fault}; but Gauss-Newton found no image. {error}", one_step_image)
        assert isinstance(gauss_newton_image[0], Reconstruction)
        fitted_shapes, outline_note = (
            (None, "") if has_custom_prior else _fit_shapes(prepared, gauss_newton_image[0], options)
        )
        if fitted_shapes is not None or not segmented:
            return _result_with_bodies(
                prepared,
                f"{image_fault}: solved for conductivity itself{outline_note}.",
                gauss_newton_image,
                fitted_shapes,
            )
    elif not (segmented or has_custom_prior) and (
        image_with_bodies := _fit_bodies_in_solid(prepared, options, one_step_image[1])
    ):
        return image_with_bodies
    if segmented:
        choice_reason = f"{image_fault or 'bodies are weak'}: cut up an image of few pieces."
        return ChosenMethod("total-variation", choice_reason, _image_with_method("total-variation", prepared, options))
    return ChosenMethod(
        "one-step", "the linear image is sound: changes are small, and it explains the voltages.", one_step_image
    )


def _image_with_method(method_name: str, prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    """Image a difference by the method `method_name` with the method's default λ."""
    imaging_method = METHODS[method_name]
    return imaging_method.image(prepared, options._replace(hyperparameter=imaging_method.hyperparameter))


def _smooth_image_for_bodies(prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    """Compute the Gauss-Newton image from which bodies are fitted. In a solid, the accuracy of the voltage difference,
    which the fit of bodies needs, is computed in parallel."""
    if prepared.mesh.dimension < 3:
        return _image_with_method("gauss-newton", prepared, options)
    computations = [lambda: _image_with_method("gauss-newton", prepared, options), lambda: prepared.accuracy]
    return results_on_cores(lambda computation: computation(), computations)[0]


def _fit_bodies_in_solid(
    prepared: PreparedDifference, options: MethodOptions, conductivity_change: Float[Array, " m"]
) -> ChosenMethod | None:
    """Fit bodies to the data of a solid. Returns None for sheets, weak changes (see `_MIN_RELATIVE_BODY_CHANGE`) and
    noisy data, and if no bodies explain the voltages."""
    difference_noise = prepared.quality.difference_noise
    max_relative_change = np.abs(np.asarray(conductivity_change)).max() / float(prepared.calibration.conductivity)
    if (
        prepared.mesh.dimension < 3
        or max_relative_change < _MIN_RELATIVE_BODY_CHANGE
        or (difference_noise is not None and difference_noise.relative > _MIN_NOISY_NOISE_SHARE)
    ):
        return None
    try:
        smooth_image = _smooth_image_for_bodies(prepared, options)
    except ValueError:
        return None
    assert isinstance(smooth_image[0], Reconstruction)
    fitted_shapes, _ = _fit_shapes(prepared, smooth_image[0], options)
    choice_reason = (
        "the voltages show bodies, which a linear image of a solid blurs: their "
        f"{_word_for_edges(prepared)} were fitted."
    )
    return fitted_shapes and _result_with_bodies(prepared, choice_reason, smooth_image, fitted_shapes)


def _result_with_bodies(
    prepared: PreparedDifference, choice_reason: str, smooth_image: Imaged, fitted_shapes: ShapeReconstruction | None
) -> ChosenMethod:
    """Return the result with fitted bodies: for a sheet, the smooth image and the outlines of the bodies; for a solid,
    the image of the bodies and of the smooth field around them. In a solid, a smooth image alone shows strong bodies at
    a tenth of their contrast, with artefacts about as strong."""
    if fitted_shapes is None or prepared.mesh.dimension < 3:
        return ChosenMethod("gauss-newton", choice_reason, smooth_image, fitted_shapes)
    return ChosenMethod("shapes", choice_reason, conductivity_change_of_shapes(prepared, fitted_shapes), fitted_shapes)


def _word_for_edges(prepared: PreparedDifference) -> str:
    """Return the word for the boundaries of bodies in messages: surfaces in a solid, outlines in a sheet."""
    return "surfaces" if prepared.mesh.dimension == 3 else "outlines"


def _fit_shapes(
    prepared: PreparedDifference, smooth_image: Reconstruction, options: MethodOptions
) -> tuple[ShapeReconstruction | None, str]:
    """Fit the bodies of a smooth image as shapes. Returns the shapes and a clause for the message. Returns None and the
    reason if no bodies are found, or if the misfit of the shapes exceeds both one standard deviation of
    `PreparedDifference.sharp_noise` and `_MAX_SHAPE_MISFIT_RATIO` times the misfit of the smooth image."""
    fitted_shapes, edge_word = shapes_in(prepared, smooth_image, options), _word_for_edges(prepared)
    if not fitted_shapes.bodies:
        return None, f"; no body's {edge_word[:-1]} explains the voltages better than errors of the model do"
    # Where the noise is not known, it is estimated so that the smooth image has a misfit of at most 1.
    smooth_misfit = float(smooth_image.misfit) if prepared.noise is not None else min(float(smooth_image.misfit), 1.0)
    if (shape_misfit := float(fitted_shapes.misfit)) > (
        max_misfit := max(1.0, _MAX_SHAPE_MISFIT_RATIO * smooth_misfit)
    ):
        return (
            None,
            f"; {edge_word} of bodies miss the voltages by {shape_misfit:.2g} standard deviations, {max_misfit:.2g} "
            "at most",
        )
    return fitted_shapes, f", and its bodies' {edge_word} fitted"


def linear_image_fault(prepared: PreparedDifference, change: Float[Array, " m"]) -> str:
    """Describe the fault of a linear image with the `change` of conductivity per cell in S/m (2-D: S). Returns an empty
    string if the image has no fault."""
    background_conductivity, relative_change = float(prepared.calibration.conductivity), np.asarray(change)
    relative_change = relative_change / background_conductivity
    min_change, max_change = float(relative_change.min()), float(relative_change.max())
    if min_change < -1:
        return f"the linear image falls to {percent(min_change)} of the background, below -100 %"
    is_difference_noisy = (
        difference_noise := prepared.quality.difference_noise
    ) is not None and difference_noise.relative > _MIN_NOISY_NOISE_SHARE
    if max(-min_change, max_change) > (
        _STRONG_CONDUCTIVITY_CHANGE_IN_NOISE if is_difference_noisy else _STRONG_CONDUCTIVITY_CHANGE
    ):
        extreme_change = min_change if -min_change > max_change else max_change
        return (
            f"the linear image reaches {percent(extreme_change)} of the background, where voltages are no longer linear"
        )
    linear_misfit, nonlinear_misfit = (
        _unexplained_share(prepared, background_conductivity, relative_change, step_width)
        for step_width in (_DERIVATIVE_STEP, 1.0)
    )
    if nonlinear_misfit > max(_MAX_MISFIT_RATIO * linear_misfit, _LARGE_MISFIT):
        return (
            f"the linear image's own voltages miss {percent(nonlinear_misfit)} of the difference, "
            f"{percent(linear_misfit)} if linear"
        )
    return ""


def estimate_unexplained_noise(
    prepared: PreparedDifference, reconstruction: LinearReconstruction, change: Float[Array, " m"]
) -> PreparedDifference:
    """Copy of the difference whose noise, if it is not known, is estimated from what its linear image, the `change` of
    conductivity per cell in S/m (2-D: S), leaves unexplained.

    An image also explains a part of the noise, which is estimated from the image of random noise, and it leaves errors
    of the linear model unexplained. The share of noise that a doubt states is corrected for the explained part. The
    noise that inclusions must exceed is not corrected, so that strong bodies are listed."""
    if prepared.noise is not None:
        return prepared
    background_conductivity, relative_noise = (
        float(prepared.calibration.conductivity),
        np.asarray(prepared.relative_noise),
    )
    usable_channels, difference = np.asarray(prepared.mask), np.asarray(prepared.difference)
    difference_rms, rms_without_common, modelled_noise_rms = (
        float(np.sqrt(np.mean((np.asarray(channel_voltages) / relative_noise)[usable_channels] ** 2)))
        for channel_voltages in (difference, difference - prepared.common_change, prepared.modelled_noise)
    )
    random_difference = np.where(
        usable_channels,
        difference_rms * relative_noise * np.random.default_rng(0).standard_normal(usable_channels.size),
        0,
    )
    unexplained_share, unexplained_noise_share = (
        _unexplained_share(
            compared_difference,
            background_conductivity,
            np.asarray(conductivity_image) / background_conductivity,
            _DERIVATIVE_STEP,
        )
        for compared_difference, conductivity_image in (
            (prepared, change),
            (replace(prepared, difference=as_array(random_difference)), reconstruction.image(random_difference)),
        )
    )
    return prepared.with_noise_from(
        unexplained_share * difference_rms / modelled_noise_rms,
        unexplained_share / unexplained_noise_share * difference_rms / rms_without_common,
    )


def change_and_noise(
    prepared: PreparedDifference, reconstruction: LinearReconstruction, change: Inexact[Array, " m"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Values per cell (m,) of a linear image in which inclusions are found, and their noise, S/m (2-D: S): the real
    part of the `change` of conductivity without a change common to all voltages."""
    noise_per_cell = reconstruction.image_noise(np.where(prepared.mask, prepared.modelled_noise, 0))
    conductivity_change = np.real(change)
    if not np.iscomplexobj(change):
        conductivity_change = conductivity_change - np.asarray(reconstruction.image(prepared.common_change))
    return as_array(conductivity_change), as_array(noise_per_cell)


def _unexplained_share(
    prepared: PreparedDifference, background_conductivity: float, relative_change: np.ndarray, step_width: float
) -> float:
    """Share of the measured voltage difference that the model leaves unexplained: what remains after the derivative of
    the modelled voltages in the direction of the `relative_change` is subtracted, with the derivative computed as a
    difference quotient of width `step_width`. Channels are divided by their noise."""
    model, usable_channels = prepared.model, np.asarray(prepared.mask)
    conductivity = background_conductivity * np.maximum(1 + step_width * relative_change, _MIN_CONDUCTIVITY)
    predicted_difference = (
        np.asarray(model.voltages(conductivity)) - np.asarray(model.voltages(background_conductivity))
    ) / step_width
    channel_noise, measured_difference = (
        np.asarray(prepared.relative_noise)[usable_channels],
        np.asarray(prepared.difference)[usable_channels],
    )
    return float(
        np.linalg.norm((predicted_difference[usable_channels] - measured_difference) / channel_noise)
        / np.linalg.norm(measured_difference / channel_noise)
    )
