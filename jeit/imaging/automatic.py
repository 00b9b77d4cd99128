"""Linear or not: the one-step image where it is sound, Gauss-Newton's where it is not, and why."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import percent
from jeit.imaging.method import METHODS, Imaged, NamedPrior
from jeit.imaging.preparation import PreparedDifference
from jeit.inverse.nonlinear.reconstruct import Reconstruction

# Change relative to the background beyond which voltages are far from linear in it.
_STRONG = 0.3
# What a linear image may miss of the voltages: over what it misses if they are taken to be linear in it, and in all.
_WORSE, _MUCH = 1.1, 0.1
# Share of the background that conductivity is kept above where a linear image claims less.
_LEAST = 0.01
# Step along the linear image that gives its derivative.
_STEP = 1e-4


class Chosen(NamedTuple):
    """**Fields**: `method` chosen, `why`, in a sentence, and what it `imaged`."""

    method: str
    why: str
    imaged: Imaged


def image_automatically(prepared: PreparedDifference, prior: NamedPrior) -> Chosen:
    """The one-step image, unless it is unsound; then Gauss-Newton's, unless that fails. Each with its default λ."""
    linear, newton = METHODS["one-step"], METHODS["gauss-newton"]
    imaged = linear.image(prepared, prior, linear.hyperparameter)
    if np.iscomplexobj(prepared.difference):
        return Chosen("one-step", "images of complex voltages are linear.", imaged)
    fault = unsound(prepared, imaged[1])
    if not fault:
        return Chosen("one-step", "the linear image is sound: changes are small, and it explains the voltages.", imaged)
    try:
        better = newton.image(prepared, prior, newton.hyperparameter)
    except ValueError as error:
        return Chosen("one-step", f"{fault}; but Gauss-Newton found no image. {error}", imaged)
    assert isinstance(better[0], Reconstruction)
    return Chosen("gauss-newton", f"{fault}: solved for conductivity itself.", better)


def unsound(prepared: PreparedDifference, change: Float[Array, " m"]) -> str:
    """What is wrong with a linear image, S/m (2-D: S) per cell, in half a sentence; empty if nothing is."""
    background, relative = float(prepared.calibration.conductivity), np.asarray(change)
    relative = relative / background
    lowest, highest = float(relative.min()), float(relative.max())
    if lowest < -1:
        return f"the linear image falls to {percent(lowest)} of the background, below -100 %"
    if max(-lowest, highest) > _STRONG:
        strongest = lowest if -lowest > highest else highest
        return f"the linear image reaches {percent(strongest)} of the background, where voltages are no longer linear"
    linear, real = (_missed(prepared, background, relative, step) for step in (_STEP, 1.0))
    if real > max(_WORSE * linear, _MUCH):
        return f"the linear image's own voltages miss {percent(real)} of the difference, {percent(linear)} if linear"
    return ""


def _missed(prepared: PreparedDifference, background: float, relative: np.ndarray, step: float) -> float:
    """Share of the difference that is missed by a step along the image, over its length; in the noise's norm."""
    model, used = prepared.model, np.asarray(prepared.mask)
    conductivity = background * np.maximum(1 + step * relative, _LEAST)
    predicted = (np.asarray(model.voltages(conductivity)) - np.asarray(model.voltages(background))) / step
    noise, difference = np.asarray(prepared.relative_noise)[used], np.asarray(prepared.difference)[used]
    return float(np.linalg.norm((predicted[used] - difference) / noise) / np.linalg.norm(difference / noise))
