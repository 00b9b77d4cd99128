"""Exact solutions of a disk fed through its rim: point electrodes, and the complete electrode model.

A disk fed through its rim: the Neumann-to-Dirichlet kernel, and point electrodes.

A current density j(φ) (A/m) leaving the rim of a disk of radius a and sheet conductivity σ inwards raises
the rim's potential, up to a constant, to

    u(θ) = ∫ N(θ − φ) j(φ) a dφ,    N(δ) = 1/(πσ) Σ_k λ_k cos(kδ)/k .

For the homogeneous disk λ_k = 1 and the series is −log|2 sin(δ/2)|/(πσ) (u = r^k cos kθ has σ ∂u/∂r = σk/a
times itself on the rim). With a concentric inclusion of radius ρa and conductivity σ_i, matching
potential and current on r = ρa gives

    λ_k = (1 − μ ρ^{2k}) / (1 + μ ρ^{2k}),    μ = (σ_i − σ)/(σ_i + σ),

so that the inclusion adds the smooth series −2 Σ_k μρ^{2k}/(1 + μρ^{2k}) cos(kδ)/k to the logarithm
(Isaacson 1986, "Distinguishability of conductivities by electric current computed tomography").

The complete electrode model on the rim of a disk, to many digits.

On electrode l, an arc of half-angle h_l about θ_l, the current density obeys the integral equation

    z_l j(θ) + ∫ N(θ − φ) j(φ) a dφ = U_l − c,    a ∫ j dθ = I_l,

of the second kind (N: the kernel of `jeit.forward.exact.rim`). With z > 0 the density is bounded, and behaves like
s log s at a distance s from an electrode's edge; Legendre polynomials of degree < p on each arc therefore
give electrode potentials to O(p^-6). The logarithm on one and the same arc is integrated exactly:

    ∫∫ P_m(x) P_n(y) log|x − y| dx dy = 8 / [(m+n)(m+n+2)((m−n)²−1)]   for m + n even and positive,

0 for m + n odd and 4 log 2 − 6 for m = n = 0 (from ∫ P_n(x) log|y−x| dx = 2 (Q_{n+1} − Q_{n−1})(y)/(2n+1)
and ∫ P_m Q_n = 2/((m−n)(m+n+1)) for m + n odd, DLMF 14.17). All else is smooth and left to Gauss-Legendre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ConductingDisk:
    """A disk: `radius` in metres, sheet `conductivity` in siemens, and perhaps a concentric inclusion
    of `inclusion_ratio` times the radius and of `inclusion_conductivity`."""

    radius: float = 1.0
    conductivity: complex = 1.0
    inclusion_ratio: float = 0.0
    inclusion_conductivity: complex = 1.0

    def inclusion_kernel(self, angle: np.ndarray) -> np.ndarray:
        """Contribution of the inclusion to the kernel N at angular distance `angle`, in ohm."""
        angle = np.asarray(angle, dtype=float)
        if self.inclusion_ratio == 0.0:
            return np.zeros_like(angle)
        contrast = (self.inclusion_conductivity - self.conductivity) / (self.inclusion_conductivity + self.conductivity)
        modes = np.arange(1, 3 + int(np.ceil(np.log(1e-18) / (2.0 * np.log(self.inclusion_ratio)))))
        decay = contrast * self.inclusion_ratio ** (2.0 * modes)
        series = np.polynomial.chebyshev.chebval(
            np.cos(angle), np.concatenate([[0.0], -2.0 * decay / (1.0 + decay) / modes])
        )
        return series / (np.pi * self.conductivity)

    def kernel(self, angle: np.ndarray) -> np.ndarray:
        """The kernel N, in ohm, at angular distances that are not zero."""
        logarithm = -np.log(np.abs(2.0 * np.sin(np.asarray(angle) / 2.0)))
        return logarithm / (np.pi * self.conductivity) + self.inclusion_kernel(angle)


def point_transfer_impedance(disk: ConductingDisk, angles: np.ndarray) -> np.ndarray:
    """Rim potential (V) at each of `angles` (L,) for one ampere into each: (L, L), but for a constant.

    A point that feeds a current has an infinite potential; the diagonal holds zero there, so use the matrix
    only where the measured electrodes are not the driven ones.
    """
    distance = angles[:, None] - angles[None, :]
    off_diagonal = ~np.eye(len(angles), dtype=bool)
    impedance = np.zeros(distance.shape, dtype=np.result_type(disk.kernel(np.ones(1))))
    impedance[off_diagonal] = disk.kernel(distance[off_diagonal])
    return impedance


def point_inclusion_effect(disk: ConductingDisk, angles: np.ndarray) -> np.ndarray:
    """Contribution of the inclusion to `point_transfer_impedance`: (L, L), finite on the diagonal too."""
    return disk.inclusion_kernel(angles[:, None] - angles[None, :])


def point_potentials(disk: ConductingDisk, angles: np.ndarray, current: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Potential (V) at `points` (n, 2), no inclusion; `current` (L,) in all zero entering at `angles`."""
    feet = disk.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    distance = np.linalg.norm(points[:, None, :] - feet[None, :, :], axis=-1)
    return -np.log(distance) @ current / (np.pi * disk.conductivity)


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
