"""Channels that a frame has no reading of, told by those that it has."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Of the channels, the share without which a frame still says enough.
MOST_MISSING = 0.5


def filled(
    changes: Float[np.ndarray, "n M"], covariance: Float[np.ndarray, "M M"], noise: float
) -> Float[np.ndarray, "n M"]:
    """Changes whose missing channels, NaN, are what is expected of them, C₂₁ (C₁₁ + noise² 1)⁻¹ y₁, where touches give
    channels the `covariance` C and those known are y₁; in Gaussian noise of this deviation."""
    found = np.array(changes, float)
    known = np.isfinite(found)
    for mask in np.unique(known[~known.all(axis=1)], axis=0):
        rows = (known == mask).all(axis=1)
        own = covariance[np.ix_(mask, mask)] + noise**2 * np.eye(int(mask.sum()))
        expected = np.linalg.solve(own, covariance[np.ix_(mask, ~mask)])
        found[np.ix_(rows, ~mask)] = found[np.ix_(rows, mask)] @ expected
    return found
