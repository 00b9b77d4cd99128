"""A box: between two plates that cover its opposite faces, and fed through patches of its lower and upper face."""

from __future__ import annotations

import numpy as np


def plate_resistance(length: float, area: float, conductivity: complex, contact_impedance: complex) -> complex:
    """R = ℓ/(σA) + 2z/A, in ohm: Ohm's law, and one contact layer at each plate.

    In 3-D `area` is in m², `conductivity` in S/m, `contact_impedance` in ohm·m²; in 2-D `area` is the plate's
    length in metres, `conductivity` in siemens, `contact_impedance` in ohm·m.
    """
    return length / (conductivity * area) + 2.0 * contact_impedance / area


def face_patch_impedance(
    size: tuple[float, float, float],
    positions: np.ndarray,
    patch: tuple[float, float],
    conductivity: complex,
    num_modes: tuple[int, int] = (300, 300),
) -> np.ndarray:
    """Mean potential (V) under each of L patches on the lower and upper face of a box for one ampere into each, spread
    evenly over it (the gap model): (L, L), but for what cancels over currents of sum zero.

    `size` (a, b, c) of the box, which fills 0 ≤ x ≤ a, 0 ≤ y ≤ b, 0 ≤ z ≤ c; `positions` (L, 3) of the patches'
    middles, with z = 0 or c; `patch`: their widths along x and y, all in metres; `conductivity` in S/m.

    Modes cos(pπx/a) cos(qπy/b), of wave number κ, have the potential coth(κc)/κ on the face that they are fed through
    and 1/(κ sinh κc) on the other; p = q = 0 is a rod, with c/2 between its ends and an even sink.
    """
    a, b, c = size
    wave = [np.arange(number) * np.pi / side for number, side in zip(num_modes, (a, b), strict=True)]
    across, along = (
        np.sinc(k * width / 2 / np.pi) * np.cos(k * positions[:, axis, None])
        for axis, (k, width) in enumerate(zip(wave, patch, strict=True))
    )
    kappa = np.hypot(wave[0][:, None], wave[1])
    kappa[0, 0] = 1.0
    doubled = np.outer(*(np.where(k > 0, 2, 1) for k in wave))
    decay = np.exp(-kappa * c)
    same, other = (1 + decay**2) / (1 - decay**2) / kappa, 2 * decay / (1 - decay**2) / kappa
    same[0, 0], other[0, 0] = 0.0, -c / 2
    together = np.equal.outer(positions[:, 2] > c / 2, positions[:, 2] > c / 2)
    near, far = (
        np.einsum("lp,kp,pq,lq,kq->lk", across, across, doubled * mode, along, along, optimize=True)
        for mode in (same, other)
    )
    return np.where(together, near, far) / (a * b * conductivity)
