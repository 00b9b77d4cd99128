"""Arrays of numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeit.arguments.kinds import told


def real_array(name: str, given: Any, wanted: str) -> np.ndarray:
    """What was given as an array of float64. Raises `ValueError`, about the argument `name`, for what holds no real
    numbers, or rows of several lengths; `wanted` says what is."""
    try:
        values = np.asarray(given)
    except (ValueError, TypeError):
        raise ValueError(f"{name} must be {wanted}; it is {told(given)}, which is no array.") from None
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {wanted}, real numbers; it is {told(values)}.")
    return values.astype(float)
