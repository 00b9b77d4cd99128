"""A ball, or a hollow one, fed through caps of its surface, the current spread evenly over each (the gap model).

Between an insulated R₁ and R₂ potentials are sums of F(r) P_n(cos γ), F = r^n + n/(n+1) R₁^{2n+1} r^{−n−1}. A cap of
half-angle α that carries one ampere has the density Σ (2n+1) w_n P_n(cos γ) / (4πR₂²), γ the angle from its middle,
with

    w_n = (P_{n−1}(cos α) − P_{n+1}(cos α)) / ((2n+1)(1 − cos α)),

the mean of P_n over the cap; by the addition theorem the mean of P_n(cos γ) over another cap is w_n P_n of the angle
between them. The effect of contact impedances is described in `jeit.forward.exact.cylinder`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ConductingSphere:
    """A ball round the origin: `radius` in metres, `conductivity` in S/m, and, if it is hollow, an insulated
    `inner_radius`."""

    radius: float
    conductivity: complex = 1.0
    inner_radius: float = 0.0


def cap_impedance(sphere: ConductingSphere, directions: np.ndarray, radius: float, num_modes: int = 400) -> np.ndarray:
    """Mean potential (V) under each of L caps for one ampere into each: (L, L), but for a constant.

    `directions` (L, 3): unit vectors to the caps' middles; `radius`: of all, metres, in a straight line from the middle
    to the rim, as of `jeit.electrodes.FaceDiscs`. `num_modes`: how many are summed.
    """
    n = np.arange(1, num_modes + 1)
    cosine = 1 - (radius / sphere.radius) ** 2 / 2  # a chord is 2 R sin(α/2)
    values = np.polynomial.legendre.legvander(np.array([cosine]), num_modes + 1)[0]
    mean = (values[n - 1] - values[n + 1]) / ((2 * n + 1) * (1 - cosine))
    power = (sphere.inner_radius / sphere.radius) ** (2.0 * n + 1)
    response = (1 + n / (n + 1) * power) / (n * (1 - power))
    between = np.clip(directions @ directions.T, -1, 1)
    coefficients = np.concatenate([[0.0], (2 * n + 1) * response * mean**2])
    series = np.polynomial.legendre.legval(between, coefficients)
    return series / (4 * np.pi * sphere.radius * sphere.conductivity)
