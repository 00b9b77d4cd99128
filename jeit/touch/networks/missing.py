"""Estimate the missing channels of a frame from its channels that have a reading."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Maximum fraction of missing channels with which a frame is still used.
MOST_MISSING = 0.5


def filled(
    changes: Float[np.ndarray, "n M"], covariance: Float[np.ndarray, "M M"], noise: float
) -> Float[np.ndarray, "n M"]:
    """Replace missing channels, NaN, by their expected values given the others, C₂₁ (C₁₁ + noise² 1)⁻¹ y₁.

    C is the `covariance` of the changes that touches cause; index 1 stands for known channels, 2 for missing ones; y₁
    are the known changes. `noise`: standard deviation of the Gaussian noise of each channel.
    """
    found = np.array(changes, float)
    known = np.isfinite(found)
    for mask in np.unique(known[~known.all(axis=1)], axis=0):
        rows = (known == mask).all(axis=1)
        own = covariance[np.ix_(mask, mask)] + noise**2 * np.eye(int(mask.sum()))
        expected = np.linalg.solve(own, covariance[np.ix_(mask, ~mask)])
        found[np.ix_(rows, ~mask)] = found[np.ix_(rows, mask)] @ expected
    return found
