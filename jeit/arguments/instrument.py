"""Numbers that an instrument gave."""

from __future__ import annotations

import numpy as np

# No instrument reads more, in volts or any part of them; the squares of such numbers are still of use.
_MOST = 1e12


def readings(values: np.ndarray) -> np.ndarray:
    """Values with NaN where there is no reading: where they are NaN, infinite, or beyond any instrument (1e12)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.abs(values) <= _MOST, values, np.nan)
