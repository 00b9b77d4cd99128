"""Sheets that are curved, fed through points: a closed sphere, and a sleeve that is open at its ends.

A current of one ampere fed into a sphere of sheet conductivity σ at a point, and taken out evenly all over it, raises

    u = −1/(2πσ) log |chord|

there: stereographic projection is conformal, and turns it into the plane's logarithm.

Round a sleeve of radius R, u is a Fourier series in n φ. An endless one has, for n > 0 and s = |z − z'|/R,

    1/(2πσ) Σ_n e^{−ns} cos(nφ) / n = −1/(4πσ) log(1 − 2 e^{−s} cos φ + e^{−2s}),

and insulated ends at z = 0 and z = H mirror the source, again and again, to 2kH ± z'. What is left is n = 0, a rod with
a source and an even sink: 1/(2πRσ) [(z² + z'²)/2H − max(z, z')].
"""

from __future__ import annotations

import numpy as np

# Images that are farther off than this many radii are not seen in double precision.
_FARTHEST = 45.0


def sphere_sheet_impedance(positions: np.ndarray, conductivity: complex) -> np.ndarray:
    """Potential (V) at each of `positions` (L, 3), metres, on a sphere for one ampere into each: (L, L), but for a
    constant.

    Sheet `conductivity` in siemens. A point that feeds a current has an infinite potential; the diagonal holds zero.
    """
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    np.fill_diagonal(distance, 1.0)
    return -np.log(distance) / (2 * np.pi * conductivity)


def sleeve_sheet_impedance(
    radius: float, height: float, angles: np.ndarray, heights: np.ndarray, conductivity: complex
) -> np.ndarray:
    """Potential (V) at each of L points of a sleeve for one ampere into each: (L, L), but for what cancels over
    currents of sum zero.

    `radius` and `height` of the sleeve in metres; the points' `angles` (L,) round it in radians and `heights` (L,)
    above its lower end in metres; sheet `conductivity` in siemens. The diagonal holds zero, as of a sphere.
    """
    around = angles[:, None] - angles
    z, source = heights[:, None], heights
    number = int(np.ceil(_FARTHEST * radius / (2 * height))) + 1
    potential = np.zeros(around.shape)
    for k in range(-number, number + 1):
        for apart in (z - source + 2 * k * height, z + source + 2 * k * height):
            decay = np.exp(-np.abs(apart) / radius)
            inside = 1 - 2 * decay * np.cos(around) + decay**2
            potential -= np.log(np.where(inside > 0, inside, 1.0)) / 2
    rod = (z**2 + source**2) / (2 * height) - np.maximum(z, source)
    potential += rod / radius
    np.fill_diagonal(potential, 0.0)
    return potential / (2 * np.pi * conductivity)
