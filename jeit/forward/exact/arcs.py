"""The complete electrode model on the rim of a disk, to many digits.

On electrode l, an arc of half-angle h_l about θ_l, the current density obeys the integral equation

    z_l j(θ) + ∫ N(θ − φ) j(φ) a dφ = U_l − c,    a ∫ j dθ = I_l,

of the second kind (N: the kernel of `jeit.forward.exact.disk`). With z > 0 the density is bounded, and behaves like
s log s at a distance s from an electrode's edge; Legendre polynomials of degree < p on each arc therefore
give electrode potentials to O(p^-6). The logarithm on one and the same arc is integrated exactly:

    ∫∫ P_m(x) P_n(y) log|x − y| dx dy = 8 / [(m+n)(m+n+2)((m−n)²−1)]   for m + n even and positive,

0 for m + n odd and 4 log 2 − 6 for m = n = 0 (from ∫ P_n(x) log|y−x| dx = 2 (Q_{n+1} − Q_{n−1})(y)/(2n+1)
and ∫ P_m Q_n = 2/((m−n)(m+n+1)) for m + n odd, DLMF 14.17). All else is smooth and left to Gauss-Legendre.
"""

from __future__ import annotations

import numpy as np

from jeit.forward.exact.disk import ConductingDisk


def logarithm_moments(order: int) -> np.ndarray:
    """∫∫ P_m(x) P_n(y) log|x − y| over [−1, 1]², for m, n < `order`."""
    m, n = np.meshgrid(np.arange(order), np.arange(order), indexing="ij")
    with np.errstate(divide="ignore"):
        moments = 8.0 / ((m + n) * (m + n + 2.0) * ((m - n) ** 2.0 - 1.0))
    moments[(m + n) % 2 == 1] = 0.0
    moments[0, 0] = 4.0 * np.log(2.0) - 6.0
    return moments


def arc_transfer_impedance(
    disk: ConductingDisk,
    angles: np.ndarray,
    widths: np.ndarray,
    contact_impedance: np.ndarray,
    order: int = 48,
) -> np.ndarray:
    """Electrode potentials (V), of sum zero, for one ampere into each electrode and −1/L into all: (L, L).

    `angles` (L,) are the arcs' centres in radians, `widths` (L,) their lengths in metres along the circle,
    `contact_impedance` (L,) is in ohm·m. For drive patterns D and measurement patterns M, of sum zero, the
    voltages are M Z Dᵀ.
    """
    num = len(angles)
    half = np.broadcast_to(widths, (num,)) / (2.0 * disk.radius)
    z = np.broadcast_to(contact_impedance, (num,))
    nodes, weights = np.polynomial.legendre.leggauss(2 * order + 16)
    basis = np.polynomial.legendre.legvander(nodes, order - 1)
    weighted = weights[:, None] * basis

    theta = angles[:, None] + half[:, None] * nodes
    dtype = np.result_type(disk.kernel(np.ones(1)), z)
    galerkin = np.zeros((num, order, num, order), dtype=dtype)
    source = np.zeros((num, order, num))
    for row in range(num):
        for column in range(num):
            distance = theta[row][:, None] - theta[column][None, :]
            scale = disk.radius**2 * half[row] * half[column]
            if row != column:
                block = weighted.T @ disk.kernel(distance) @ weighted
            else:
                # 2 sin(δ/2)/δ, by sinc(x) = sin(πx)/(πx), is the smooth factor of the logarithm's argument.
                smooth = -np.log(np.sinc(distance / (2.0 * np.pi))) / (np.pi * disk.conductivity)
                block = weighted.T @ (smooth + disk.inclusion_kernel(distance)) @ weighted
                logarithm = logarithm_moments(order)
                logarithm[0, 0] += 4.0 * np.log(half[row])
                block = block - logarithm / (np.pi * disk.conductivity)
                mass = disk.radius * half[row] * 2.0 / (2.0 * np.arange(order) + 1.0)
                galerkin[row, :, row, :] += z[row] * np.diag(mass)
            galerkin[row, :, column, :] += scale * block
        source[row, 0, row] = 2.0 * disk.radius * half[row]

    source = source.reshape(num * order, num)
    density = np.linalg.solve(galerkin.reshape(num * order, num * order), source)
    impedance = np.linalg.inv(source.T @ density)
    centring = np.eye(num) - 1.0 / num
    return centring @ impedance @ centring
