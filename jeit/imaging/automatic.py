"""Automatic choice of the imaging method, with its reason: one-step imaging where the linear image is sound, otherwise
Gauss-Newton imaging and a fit of the shapes of bodies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import percent
from jeit.imaging.method import METHODS, Asked, Imaged, of_shapes, shapes_in
from jeit.imaging.preparation import PreparedDifference
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.prior.matern import MEASURED
from jeit.inverse.shapes import ShapeReconstruction

# Changes relative to the background above which voltages are not linear in conductivity: in general, and for noisy
# data, whose images are damped far below the true change. Share of noise in the difference above which data are noisy.
_STRONG, _STRONG_IN_NOISE, _NOISY = 0.3, 0.1, 0.3
# Tolerances for the share of the difference that the voltages of a linear image do not explain: relative to the share
# not explained in the linear approximation, and absolute.
_WORSE, _MUCH = 1.1, 0.1
# Lower bound of the conductivity of a linear image, as a share of the background.
_LEAST = 0.01
# Maximum change of an image, relative to the background, above which bodies are fitted in a solid.
_LEAST_FOR_BODIES = 0.05
# Step along the linear image for the finite difference that approximates the derivative of the voltages.
_STEP = 1e-4


class Chosen(NamedTuple):
    """**Fields**: `method`: name of the chosen method; `why`: the reason, in a sentence; `imaged`: its result;
    `shapes`: the fitted bodies, if they explain the voltages."""

    method: str
    why: str
    imaged: Imaged
    shapes: ShapeReconstruction | None = None


def image_automatically(prepared: PreparedDifference, asked: Asked, segmented: bool = False) -> Chosen:
    """Compute the one-step image if it is sound, otherwise the Gauss-Newton image with its bodies fitted as shapes. If
    Gauss-Newton imaging fails, the one-step image is returned.

    In a solid with the default prior, bodies are also fitted where the one-step image is sound. Each method uses its
    default λ, not the requested one. If the image is to be `segmented` and no shapes were fitted, total variation is
    used.
    """
    imaged = _by("one-step", prepared, asked)
    if np.iscomplexobj(prepared.difference):
        return Chosen("one-step", "images of complex voltages are linear.", imaged)
    fault, plain = unsound(prepared, imaged[1]), prepared.mesh.dimension == 3 and asked.prior != MEASURED
    if fault:
        try:
            better = _by("gauss-newton", prepared, asked)
        except ValueError as error:
            return Chosen("one-step", f"{fault}; but Gauss-Newton found no image. {error}", imaged)
        assert isinstance(better[0], Reconstruction)
        shapes, outlined = (None, "") if plain else _shapes(prepared, better[0], asked)
        if shapes is not None or not segmented:
            return _with_bodies(prepared, f"{fault}: solved for conductivity itself{outlined}.", better, shapes)
    elif not (segmented or plain) and (bodies := _bodies_in_solid(prepared, asked, imaged[1])):
        return bodies
    if segmented:
        why = f"{fault or 'bodies are weak'}: cut up an image of few pieces."
        return Chosen("total-variation", why, _by("total-variation", prepared, asked))
    return Chosen("one-step", "the linear image is sound: changes are small, and it explains the voltages.", imaged)


def _by(name: str, prepared: PreparedDifference, asked: Asked) -> Imaged:
    """Image by the method `name` with its default λ."""
    method = METHODS[name]
    return method.image(prepared, asked._replace(hyperparameter=method.hyperparameter))


def _bodies_in_solid(prepared: PreparedDifference, asked: Asked, change: Float[Array, " m"]) -> Chosen | None:
    """Fit bodies to the data of a solid; None for sheets, weak changes (see `_LEAST_FOR_BODIES`), noisy data, or if no
    bodies explain the voltages."""
    noise = prepared.quality.difference_noise
    strongest = np.abs(np.asarray(change)).max() / float(prepared.calibration.conductivity)
    if prepared.mesh.dimension < 3 or strongest < _LEAST_FOR_BODIES or (noise is not None and noise.relative > _NOISY):
        return None
    try:
        smooth = _by("gauss-newton", prepared, asked)
    except ValueError:
        return None
    assert isinstance(smooth[0], Reconstruction)
    shapes, _ = _shapes(prepared, smooth[0], asked)
    why = f"the voltages show bodies, which a linear image of a solid blurs: their {_edges(prepared)} were fitted."
    return shapes and _with_bodies(prepared, why, smooth, shapes)


def _with_bodies(prepared: PreparedDifference, why: str, smooth: Imaged, shapes: ShapeReconstruction | None) -> Chosen:
    """Result with fitted bodies: for a sheet, the smooth image and the outlines; for a solid, the image of the bodies
    and of the smooth field around them. In a solid, a smooth image alone shows strong bodies at a tenth of their
    contrast, with artefacts about as strong."""
    if shapes is None or prepared.mesh.dimension < 3:
        return Chosen("gauss-newton", why, smooth, shapes)
    return Chosen("shapes", why, of_shapes(prepared, shapes), shapes)


def _edges(prepared: PreparedDifference) -> str:
    """Word for the boundaries of bodies, for messages: surfaces in a solid, outlines in a sheet."""
    return "surfaces" if prepared.mesh.dimension == 3 else "outlines"


def _shapes(
    prepared: PreparedDifference, smooth: Reconstruction, asked: Asked
) -> tuple[ShapeReconstruction | None, str]:
    """Fit the bodies of a smooth image as shapes, and say so in half a sentence; None, with the reason, if none are
    found, or if their misfit exceeds both that of the smooth image and one standard deviation of
    `PreparedDifference.sharp_noise`."""
    found, edges = shapes_in(prepared, smooth, asked), _edges(prepared)
    if not found.bodies:
        return None, f"; no body's {edges[:-1]} explains the voltages better than errors of the model do"
    if (misfit := float(found.misfit)) > (most := max(1.0, float(smooth.misfit))):
        return None, f"; {edges} of bodies miss the voltages by {misfit:.2g} standard deviations, {most:.2g} at most"
    return found, f", and its bodies' {edges} fitted"


def unsound(prepared: PreparedDifference, change: Float[Array, " m"]) -> str:
    """Describe the fault of a linear image, the `change` of conductivity per cell in S/m (2-D: S); empty if it has
    none."""
    background, relative = float(prepared.calibration.conductivity), np.asarray(change)
    relative = relative / background
    lowest, highest = float(relative.min()), float(relative.max())
    if lowest < -1:
        return f"the linear image falls to {percent(lowest)} of the background, below -100 %"
    noisy = (quality := prepared.quality.difference_noise) is not None and quality.relative > _NOISY
    if max(-lowest, highest) > (_STRONG_IN_NOISE if noisy else _STRONG):
        strongest = lowest if -lowest > highest else highest
        return f"the linear image reaches {percent(strongest)} of the background, where voltages are no longer linear"
    linear, real = (_missed(prepared, background, relative, step) for step in (_STEP, 1.0))
    if real > max(_WORSE * linear, _MUCH):
        return f"the linear image's own voltages miss {percent(real)} of the difference, {percent(linear)} if linear"
    return ""


def _missed(prepared: PreparedDifference, background: float, relative: np.ndarray, step: float) -> float:
    """Share of the measured difference that is not explained by the change of voltages for a step along the image,
    divided by the length of the step. The norm is weighted by the inverse of the noise."""
    model, used = prepared.model, np.asarray(prepared.mask)
    conductivity = background * np.maximum(1 + step * relative, _LEAST)
    predicted = (np.asarray(model.voltages(conductivity)) - np.asarray(model.voltages(background))) / step
    noise, difference = np.asarray(prepared.relative_noise)[used], np.asarray(prepared.difference)[used]
    return float(np.linalg.norm((predicted[used] - difference) / noise) / np.linalg.norm(difference / noise))
