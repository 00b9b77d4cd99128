"""Automatic choice of the method: one step where it is sound, else Gauss-Newton and shapes of strong bodies; and the
reason."""

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

# Change relative to the background beyond which voltages are far from linear in it; and beyond which the same is
# assumed where noise is such a share of the difference that images are damped far below the true change.
_STRONG, _STRONG_IN_NOISE, _NOISY = 0.3, 0.1, 0.3
# Share of the voltages that a linear image may miss: relative to the share missed if voltages are linear in it, and in
# all.
_WORSE, _MUCH = 1.1, 0.1
# Share of the background that conductivity is kept above where a linear image claims less.
_LEAST = 0.01
# Change relative to the background beyond which bodies are looked for in a solid, where smooth images are poorest.
_LEAST_FOR_BODIES = 0.05
# Step along the linear image that gives its derivative.
_STEP = 1e-4


class Chosen(NamedTuple):
    """**Fields**: `method` chosen; `why`, in a sentence; what it `imaged`; `shapes` of the bodies in it, if those
    explain the voltages."""

    method: str
    why: str
    imaged: Imaged
    shapes: ShapeReconstruction | None = None


def image_automatically(prepared: PreparedDifference, asked: Asked, segmented: bool = False) -> Chosen:
    """The one-step image, unless it is unsound; then Gauss-Newton's with its bodies as shapes, unless that fails.

    In a solid, bodies are also looked for where the one-step image is sound, unless a prior was asked for, which would
    only apply to the field beside them. Each method uses its default λ, not the one asked for. Where the image is to be
    `segmented` and there are no shapes, it is made by total variation.
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
        shapes = None if plain else _shapes(prepared, better[0], asked)
        if shapes is not None or not segmented:
            outlined = "" if shapes is None else f", and its bodies' {_edges(prepared)} fitted"
            return _with_bodies(prepared, f"{fault}: solved for conductivity itself{outlined}.", better, shapes)
    elif not (segmented or plain) and (bodies := _bodies_in_solid(prepared, asked, imaged[1])):
        return bodies
    if segmented:
        why = f"{fault or 'bodies are weak'}: cut up an image of few pieces."
        return Chosen("total-variation", why, _by("total-variation", prepared, asked))
    return Chosen("one-step", "the linear image is sound: changes are small, and it explains the voltages.", imaged)


def _by(name: str, prepared: PreparedDifference, asked: Asked) -> Imaged:
    """The image by the method of that name, with its own λ."""
    method = METHODS[name]
    return method.image(prepared, asked._replace(hyperparameter=method.hyperparameter))


def _bodies_in_solid(prepared: PreparedDifference, asked: Asked, change: Float[Array, " m"]) -> Chosen | None:
    """Bodies that the data of a solid support, where a sound linear image shows more than a trace and the noise allows
    it."""
    noise = prepared.quality.difference_noise
    strongest = np.abs(np.asarray(change)).max() / float(prepared.calibration.conductivity)
    if prepared.mesh.dimension < 3 or strongest < _LEAST_FOR_BODIES or (noise is not None and noise.relative > _NOISY):
        return None
    try:
        smooth = _by("gauss-newton", prepared, asked)
    except ValueError:
        return None
    assert isinstance(smooth[0], Reconstruction)
    shapes = _shapes(prepared, smooth[0], asked)
    why = f"the voltages show bodies, which a linear image of a solid blurs: their {_edges(prepared)} were fitted."
    return shapes and _with_bodies(prepared, why, smooth, shapes)


def _with_bodies(prepared: PreparedDifference, why: str, smooth: Imaged, shapes: ShapeReconstruction | None) -> Chosen:
    """In a sheet the smooth image, with outlines beside it; in a solid that of the bodies and what is smooth beside
    them: a smooth image alone shows strong ones at a tenth of their contrast there, with ghosts about as strong."""
    if shapes is None or prepared.mesh.dimension < 3:
        return Chosen("gauss-newton", why, smooth, shapes)
    return Chosen("shapes", why, of_shapes(prepared, shapes), shapes)


def _edges(prepared: PreparedDifference) -> str:
    """Name of the bodies' boundaries."""
    return "surfaces" if prepared.mesh.dimension == 3 else "outlines"


def _shapes(prepared: PreparedDifference, smooth: Reconstruction, asked: Asked) -> ShapeReconstruction | None:
    """The bodies of a smooth image as shapes, if there are any and they explain the voltages within what sharp outlines
    may miss, or as well as the image does."""
    found = shapes_in(prepared, smooth, asked)
    explains = float(found.misfit) <= max(1.0, float(smooth.misfit))
    return found if found.bodies and explains else None


def unsound(prepared: PreparedDifference, change: Float[Array, " m"]) -> str:
    """Fault of a linear image, S/m (2-D: S) per cell, in half a sentence; empty if there is none."""
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
    """Share of the difference that is missed by a step along the image, over its length; in the noise's norm."""
    model, used = prepared.model, np.asarray(prepared.mask)
    conductivity = background * np.maximum(1 + step * relative, _LEAST)
    predicted = (np.asarray(model.voltages(conductivity)) - np.asarray(model.voltages(background))) / step
    noise, difference = np.asarray(prepared.relative_noise)[used], np.asarray(prepared.difference)[used]
    return float(np.linalg.norm((predicted[used] - difference) / noise) / np.linalg.norm(difference / noise))
