"""Effective pressure of a material as a function of the pressure over time: hysteresis, then creep.

**Hysteresis** is a generalised play (Visintin, Differential Models of Hysteresis, 1994, section III.2) between the
curves w = p, on which load rises, and w = p / (1 − H), on which it falls: w stays as it is between them. It is
rate-independent; both curves end at zero, and their greatest difference after a load of p is H p.

**Creep** is that of a standard linear solid with several branches: a share a_k of w is delayed,

q = (1 − Σ a_k) w + Σ a_k y_k, τ_k dy_k/dt = w − y_k,

solved exactly for w that is linear between two times.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.touch.simulate.contact.materials import Material


class Strain(NamedTuple):
    """State of a material at m places: `held` w (m,) and the `late` branches y (k, m), pascals."""

    held: Float[np.ndarray, " m"]
    late: Float[np.ndarray, "k m"]


def unstrained(material: Material, number: int) -> Strain:
    """State of `number` places without earlier load."""
    return Strain(np.zeros(number), np.zeros((len(material.creep), number)))


def advance(
    material: Material, strain: Strain, pressure: Float[np.ndarray, " m"], seconds: float
) -> tuple[Strain, Float[np.ndarray, " m"]]:
    """Return the state and the effective pressure (m,), pascals, `seconds` after `strain`, under `pressure` (m,)."""
    held = np.maximum(pressure, np.minimum(strain.held, pressure / (1 - material.hysteresis)))
    shares, times = _branches(material)
    late = strain.late
    if seconds > 0:
        passed = seconds / times
        kept = np.exp(-passed)
        slope = 1 + np.expm1(-passed) / passed
        late = kept * late + (1 - kept) * strain.held + slope * (held - strain.held)
    return Strain(held, late), (1 - shares.sum()) * held + np.sum(shares * late, axis=0)


def held_pressure(material: Material, pressure: Float[np.ndarray, "..."], seconds: float) -> Float[np.ndarray, "..."]:
    """Effective pressure (…) of a first load that came at once and has stayed for `seconds`; pascals."""
    shares, times = _branches(material)
    return np.asarray(pressure) * (1 - np.sum(shares * np.exp(-seconds / times)))


def _branches(material: Material) -> tuple[np.ndarray, np.ndarray]:
    """Shares and time constants, seconds, of the branches (k, 1)."""
    pairs = np.array(material.creep, float).reshape(-1, 2)
    return pairs[:, :1], pairs[:, 1:]
