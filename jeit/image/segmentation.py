"""Segmentation: an image cut up into background, resistive and conductive regions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from jeit.image.score import CONDUCTIVE, RESISTIVE


def segment(
    image: Float[np.ndarray, "rows columns"],
    *,
    level: float = 0.5,
    least_peak: float = 0.3,
    least_area: float = 0.004,
) -> UInt8[np.ndarray, "rows columns"]:
    """Labels of the pixels: 0 background, 1 resistive, 2 conductive; 0 outside the body.

    `image` (rows, columns): departure from the background, negative where resistive, NaN outside the body; for absolute
    images the logarithm of conductivity over background, which weighs both signs alike. Either sign is kept if its peak
    is at least `least_peak` times the strongest of both, and covers what exceeds `level` times its own peak: where that
    is half, the middle of a blurred edge. Islands of less than `least_area` of the body are artefacts. Raises
    `ValueError` for an image that is not two-dimensional, or has no pixel inside the body.
    """
    values = np.asarray(image)
    if values.ndim != 2 or np.iscomplexobj(values):
        raise ValueError(f"image must be real, (rows, columns); it has shape {values.shape} of {values.dtype}.")
    if not (0 < level < 1 and 0 <= least_peak <= 1 and 0 <= least_area < 1):
        raise ValueError(
            f"level, least_peak and least_area are shares, from 0 to 1: {level}, {least_peak}, {least_area}."
        )
    inside = np.isfinite(values)
    if not inside.any():
        raise ValueError("image: no pixel lies inside the body; all are NaN.")
    values = np.where(inside, values, 0)
    strongest = np.abs(values).max()
    labels = np.zeros(values.shape, np.uint8)
    for sign, label in ((1, CONDUCTIVE), (-1, RESISTIVE)):
        peak = (sign * values).max()
        if peak <= 0 or peak < least_peak * strongest:
            continue
        islands = np.zeros(values.shape, np.int32)
        ndimage.label(sign * values > level * peak, output=islands)
        size = np.bincount(islands.ravel())
        size[0] = 0
        labels[size[islands] >= max(1, least_area * inside.sum())] = label
    return labels
