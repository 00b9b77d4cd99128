"""A disk fed through its rim: the Neumann-to-Dirichlet kernel, and point electrodes.

A current density j(φ) (A/m) leaving the rim of a disk of radius a and sheet conductivity σ inwards raises
the rim's potential, up to a constant, to

    u(θ) = ∫ N(θ − φ) j(φ) a dφ,    N(δ) = 1/(πσ) Σ_k λ_k cos(kδ)/k .

For the homogeneous disk λ_k = 1 and the series is −log|2 sin(δ/2)|/(πσ) (u = r^k cos kθ has σ ∂u/∂r = σk/a
times itself on the rim). With a concentric inclusion of radius ρa and conductivity σ_i, matching
potential and current on r = ρa gives

    λ_k = (1 − μ ρ^{2k}) / (1 + μ ρ^{2k}),    μ = (σ_i − σ)/(σ_i + σ),

so that the inclusion adds the smooth series −2 Σ_k μρ^{2k}/(1 + μρ^{2k}) cos(kδ)/k to the logarithm
(Isaacson 1986, "Distinguishability of conductivities by electric current computed tomography").
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
        """What the inclusion adds to the kernel N at angular distance `angle`, in ohm."""
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
    """What the inclusion adds to `point_transfer_impedance`: (L, L), finite on the diagonal too."""
    return disk.inclusion_kernel(angles[:, None] - angles[None, :])


def point_potentials(disk: ConductingDisk, angles: np.ndarray, current: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Potential (V) at `points` (n, 2), no inclusion; `current` (L,) in all zero entering at `angles`."""
    feet = disk.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    distance = np.linalg.norm(points[:, None, :] - feet[None, :, :], axis=-1)
    return -np.log(distance) @ current / (np.pi * disk.conductivity)
