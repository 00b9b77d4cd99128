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

# Changes of conductivity relative to the background above which voltages are not linear in conductivity: in general,
# and for noisy data, whose images show far less than the true change. Data are noisy if the share of noise in the
# voltage difference exceeds `_MIN_NOISY_NOISE_SHARE`.
_STRONG_CONDUCTIVITY_CHANGE, _STRONG_CONDUCTIVITY_CHANGE_IN_NOISE, _MIN_NOISY_NOISE_SHARE = 0.3, 0.1, 0.3
# A linear image has a fault if the voltages computed from it leave too large a share of the voltage difference
# unexplained: more than `_LARGE_MISFIT`, and more than `_MAX_MISFIT_RATIO` times the share that linearised voltages
# leave unexplained.
_MAX_MISFIT_RATIO, _LARGE_MISFIT = 1.1, 0.1
# Lower bound of the conductivity of a linear image, as a share of the background conductivity.
_MIN_CONDUCTIVITY = 0.01
# Bodies are fitted in a solid if the largest change of conductivity in an image exceeds this share of the background.
_MIN_RELATIVE_BODY_CHANGE = 0.05
# Fitted bodies, a few numbers, are preferred to a smooth image, which has many, unless their misfit is so many times
# larger. On simulated tanks where it exceeds one standard deviation, it was 1.0 to 1.2 times as large for homogeneous
# bodies, and 2.2 to 18 times for smooth conductivity.
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
    imaged = _image_with_method("one-step", prepared, options)
    if np.iscomplexobj(prepared.difference):
        return ChosenMethod("one-step", "images of complex voltages are linear.", imaged)
    fault, uses_own_prior = (
        linear_image_fault(prepared, imaged[1]),
        prepared.mesh.dimension == 3 and options.prior != MEASURED_DATA_PRIOR,
    )
    if fault:
        try:
            gauss_newton = _image_for_bodies(prepared, options)
        except ValueError as error:
            return ChosenMethod("one-step", f"{fault}; but Gauss-Newton found no image. {error}", imaged)
        assert isinstance(gauss_newton[0], Reconstruction)
        shapes, outline_note = (None, "") if uses_own_prior else _fit_shapes(prepared, gauss_newton[0], options)
        if shapes is not None or not segmented:
            return _add_bodies(
                prepared, f"{fault}: solved for conductivity itself{outline_note}.", gauss_newton, shapes
            )
    elif not (segmented or uses_own_prior) and (bodies := _bodies_in_solid(prepared, options, imaged[1])):
        return bodies
    if segmented:
        reason = f"{fault or 'bodies are weak'}: cut up an image of few pieces."
        return ChosenMethod("total-variation", reason, _image_with_method("total-variation", prepared, options))
    return ChosenMethod(
        "one-step", "the linear image is sound: changes are small, and it explains the voltages.", imaged
    )


def _image_with_method(name: str, prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    """Image a difference by the method `name` with the method's default λ."""
    method = METHODS[name]
    return method.image(prepared, options._replace(hyperparameter=method.hyperparameter))


def _image_for_bodies(prepared: PreparedDifference, options: MethodOptions) -> Imaged:
    """Gauss-Newton image, from which bodies are fitted. In a solid, the accuracy of the difference, which their fit
    needs, is computed at the same time."""
    if prepared.mesh.dimension < 3:
        return _image_with_method("gauss-newton", prepared, options)
    functions = [lambda: _image_with_method("gauss-newton", prepared, options), lambda: prepared.accuracy]
    return results_on_cores(lambda job: job(), functions)[0]


def _bodies_in_solid(
    prepared: PreparedDifference, options: MethodOptions, change: Float[Array, " m"]
) -> ChosenMethod | None:
    """Fit bodies to the data of a solid. Returns None for sheets, weak changes (see `_MIN_RELATIVE_BODY_CHANGE`) and
    noisy data, and if no bodies explain the voltages."""
    noise = prepared.quality.difference_noise
    max_change = np.abs(np.asarray(change)).max() / float(prepared.calibration.conductivity)
    if (
        prepared.mesh.dimension < 3
        or max_change < _MIN_RELATIVE_BODY_CHANGE
        or (noise is not None and noise.relative > _MIN_NOISY_NOISE_SHARE)
    ):
        return None
    try:
        smooth_image = _image_for_bodies(prepared, options)
    except ValueError:
        return None
    assert isinstance(smooth_image[0], Reconstruction)
    shapes, _ = _fit_shapes(prepared, smooth_image[0], options)
    reason = f"the voltages show bodies, which a linear image of a solid blurs: their {_edges(prepared)} were fitted."
    return shapes and _add_bodies(prepared, reason, smooth_image, shapes)


def _add_bodies(
    prepared: PreparedDifference, reason: str, smooth_image: Imaged, shapes: ShapeReconstruction | None
) -> ChosenMethod:
    """Result with fitted bodies: for a sheet, the smooth image and the outlines; for a solid, the image of the bodies
    and of the smooth field around them. In a solid, a smooth image alone shows strong bodies at a tenth of their
    contrast, with artefacts about as strong."""
    if shapes is None or prepared.mesh.dimension < 3:
        return ChosenMethod("gauss-newton", reason, smooth_image, shapes)
    return ChosenMethod("shapes", reason, conductivity_change_of_shapes(prepared, shapes), shapes)


def _edges(prepared: PreparedDifference) -> str:
    """Word for the boundaries of bodies, for messages: surfaces in a solid, outlines in a sheet."""
    return "surfaces" if prepared.mesh.dimension == 3 else "outlines"


def _fit_shapes(
    prepared: PreparedDifference, smooth_image: Reconstruction, options: MethodOptions
) -> tuple[ShapeReconstruction | None, str]:
    """Fit the bodies of a smooth image as shapes. Returns the shapes and a clause for the message. Returns None and the
    reason if no bodies are found, or if the misfit of the shapes exceeds both one standard deviation of
    `PreparedDifference.sharp_noise` and `_MAX_SHAPE_MISFIT_RATIO` times the misfit of the smooth image."""
    shapes, edges = shapes_in(prepared, smooth_image, options), _edges(prepared)
    if not shapes.bodies:
        return None, f"; no body's {edges[:-1]} explains the voltages better than errors of the model do"
    # Where the noise is not known, it is estimated so that the smooth image has a misfit of at most 1.
    smooth_misfit = float(smooth_image.misfit) if prepared.noise is not None else min(float(smooth_image.misfit), 1.0)
    if (misfit := float(shapes.misfit)) > (max_misfit := max(1.0, _MAX_SHAPE_MISFIT_RATIO * smooth_misfit)):
        return (
            None,
            f"; {edges} of bodies miss the voltages by {misfit:.2g} standard deviations, {max_misfit:.2g} at most",
        )
    return shapes, f", and its bodies' {edges} fitted"


def linear_image_fault(prepared: PreparedDifference, change: Float[Array, " m"]) -> str:
    """Describe the fault of a linear image, the `change` of conductivity per cell in S/m (2-D: S); empty if the image
    has no fault."""
    background, relative_change = float(prepared.calibration.conductivity), np.asarray(change)
    relative_change = relative_change / background
    min_change, max_change = float(relative_change.min()), float(relative_change.max())
    if min_change < -1:
        return f"the linear image falls to {percent(min_change)} of the background, below -100 %"
    is_difference_noisy = (
        quality := prepared.quality.difference_noise
    ) is not None and quality.relative > _MIN_NOISY_NOISE_SHARE
    if max(-min_change, max_change) > (
        _STRONG_CONDUCTIVITY_CHANGE_IN_NOISE if is_difference_noisy else _STRONG_CONDUCTIVITY_CHANGE
    ):
        extreme_change = min_change if -min_change > max_change else max_change
        return (
            f"the linear image reaches {percent(extreme_change)} of the background, where voltages are no longer linear"
        )
    linear_misfit, misfit = (
        _unexplained_share(prepared, background, relative_change, step) for step in (_DERIVATIVE_STEP, 1.0)
    )
    if misfit > max(_MAX_MISFIT_RATIO * linear_misfit, _LARGE_MISFIT):
        return (
            f"the linear image's own voltages miss {percent(misfit)} of the difference, {percent(linear_misfit)} if "
            "linear"
        )
    return ""


def estimate_unexplained_noise(
    prepared: PreparedDifference, reconstruction: LinearReconstruction, change: Float[Array, " m"]
) -> PreparedDifference:
    """Copy of the difference whose noise, if it is not known, is estimated from what its linear image, the `change` of
    conductivity per cell in S/m (2-D: S), leaves unexplained.

    An image explains a part of noise, too, which is estimated from the image of random noise, and leaves errors of the
    linear model unexplained. The doubt allows for the first; inclusions have to exceed what is left unexplained only,
    so that strong bodies are listed."""
    if prepared.noise is not None:
        return prepared
    background, relative_noise = float(prepared.calibration.conductivity), np.asarray(prepared.relative_noise)
    is_used, difference = np.asarray(prepared.mask), np.asarray(prepared.difference)
    size, unexplained_difference, modelled_difference = (
        float(np.sqrt(np.mean((np.asarray(volts) / relative_noise)[is_used] ** 2)))
        for volts in (difference, difference - prepared.common_change, prepared.modelled_noise)
    )
    random = np.where(is_used, size * relative_noise * np.random.default_rng(0).standard_normal(is_used.size), 0)
    unexplained, unexplained_noise = (
        _unexplained_share(pair, background, np.asarray(image) / background, _DERIVATIVE_STEP)
        for pair, image in (
            (prepared, change),
            (replace(prepared, difference=as_array(random)), reconstruction.image(random)),
        )
    )
    return prepared.with_noise_from(
        unexplained * size / modelled_difference, unexplained / unexplained_noise * size / unexplained_difference
    )


def change_and_noise(
    prepared: PreparedDifference, reconstruction: LinearReconstruction, change: Inexact[Array, " m"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Values per cell (m,) of a linear image in which inclusions are found, and their noise, S/m (2-D: S): the real
    part of the `change` of conductivity without a change common to all voltages."""
    noise = reconstruction.image_noise(np.where(prepared.mask, prepared.modelled_noise, 0))
    conductivity_change = np.real(change)
    if not np.iscomplexobj(change):
        conductivity_change = conductivity_change - np.asarray(reconstruction.image(prepared.common_change))
    return as_array(conductivity_change), as_array(noise)


def _unexplained_share(prepared: PreparedDifference, background: float, change: np.ndarray, step: float) -> float:
    """Share of the measured voltage difference that the model leaves unexplained: what remains after the derivative of
    the modelled voltages in the direction of the `change` is subtracted, with the derivative computed as a
    difference quotient of width `step`. Channels are divided by their noise."""
    model, is_used = prepared.model, np.asarray(prepared.mask)
    conductivity = background * np.maximum(1 + step * change, _MIN_CONDUCTIVITY)
    predicted_difference = (np.asarray(model.voltages(conductivity)) - np.asarray(model.voltages(background))) / step
    noise, difference = np.asarray(prepared.relative_noise)[is_used], np.asarray(prepared.difference)[is_used]
    return float(
        np.linalg.norm((predicted_difference[is_used] - difference) / noise) / np.linalg.norm(difference / noise)
    )
