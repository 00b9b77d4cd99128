"""The score of the Kuopio Tomography Challenge 2023 for an image cut up into classes."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Int

_DEVIATION = 80
_REACH = 160
_C1, _C2 = 1e-4, 9e-4
RESISTIVE, CONDUCTIVE = 1, 2


def challenge_score(labels: Int[np.ndarray, "256 256"], truth: Int[np.ndarray, "256 256"]) -> float:
    """Structural similarity of the conductive and of the resistive mask with the truth's, averaged: 1 is perfect.

    `labels`, `truth`: 0 background, 1 resistive, 2 conductive; 256 × 256 pixels, as the challenge has it. Means,
    variances and covariance are taken in Gaussian windows of 80 pixels standard deviation cut at ±160 pixels and
    normalised at the border; c1 = 1e-4, c2 = 9e-4; mean over all pixels. A class absent from both scores 1. Raises
    `ValueError` for images of another shape or with other labels. Räsänen et al., KTC2023, doi 10.5281/zenodo.8252370.
    """
    labels, truth = np.asarray(labels), np.asarray(truth)
    for name, image in (("labels", labels), ("truth", truth)):
        if image.shape != (256, 256) or not np.isin(image, (0, RESISTIVE, CONDUCTIVE)).all():
            raise ValueError(
                f"{name}: the score is for 256 × 256 pixels of 0 (background), 1 (resistive) and 2 (conductive); "
                f"got shape {image.shape} with values {np.unique(image)[:5].tolist()}."
            )
    return float(np.mean([_similarity(labels == kind, truth == kind) for kind in (CONDUCTIVE, RESISTIVE)]))


def _similarity(first: np.ndarray, second: np.ndarray) -> float:
    """Structural similarity of two masks, mean over the pixels. Wang et al., IEEE Trans. Image Process. 13 (2004)."""
    window = _window(first.shape[0])
    # Masks are their own squares.
    a, b, product = (window @ image.astype(float) @ window.T for image in (first, second, first & second))
    variance_a, variance_b, covariance = a - a**2, b - b**2, product - a * b
    luminance = (2 * a * b + _C1) / (a**2 + b**2 + _C1)
    return float(np.mean(luminance * (2 * covariance + _C2) / (variance_a + variance_b + _C2)))


@functools.cache
def _window(size: int) -> np.ndarray:
    """Rows of normalised weights along one axis: the window is separable, and so is its normalisation."""
    distance = np.arange(size)[:, None] - np.arange(size)
    weight = np.where(np.abs(distance) <= _REACH, np.exp(-(distance**2) / (2 * _DEVIATION**2)), 0)
    return weight / weight.sum(axis=1, keepdims=True)
