"""Exact voltages of homogeneous disks and of sheets with discs, flat or curved.

**A disk fed through its rim: the Neumann-to-Dirichlet kernel, and point electrodes.** A current density j(φ) (A/m) that
enters a disk of radius a and sheet conductivity σ through its rim raises the potential of the rim, up to a constant, to

    u(θ) = ∫ N(θ − φ) j(φ) a dφ,    N(δ) = 1/(πσ) Σ_k λ_k cos(kδ)/k .

For the homogeneous disk λ_k = 1 and the series is −log|2 sin(δ/2)|/(πσ) (on the rim, u = r^k cos kθ satisfies σ ∂u/∂r =
σk/a · u). With a concentric inclusion of radius ρa and conductivity σ_i, continuity of potential and current at r = ρa
gives

    λ_k = (1 − μ ρ^{2k}) / (1 + μ ρ^{2k}),    μ = (σ_i − σ)/(σ_i + σ),

so that the inclusion adds the smooth series −2 Σ_k μρ^{2k}/(1 + μρ^{2k}) cos(kδ)/k to the logarithm (Isaacson 1986,
"Distinguishability of conductivities by electric current computed tomography").

**A disk fed through its rim: the complete electrode model, to many digits.** On electrode l, an arc of half-angle h_l
about θ_l, the current density satisfies the integral equation of the second kind

    z_l j(θ) + ∫ N(θ − φ) j(φ) a dφ = U_l − c,    a ∫ j dθ = I_l.

For z > 0 the density is bounded, and behaves like s log s at a distance s from the edge of an electrode; Legendre
polynomials of degree < p on each arc therefore give electrode potentials to O(p^-6). The logarithm on a single arc is
integrated exactly:

    ∫∫ P_m(x) P_n(y) log|x − y| dx dy = 8 / [(m+n)(m+n+2)((m−n)²−1)]   for m + n even and positive,

0 for m + n odd and 4 log 2 − 6 for m = n = 0 (from ∫ P_n(x) log|y−x| dx = 2 (Q_{n+1} − Q_{n−1})(y)/(2n+1) and ∫ P_m Q_n
= 2/((m−n)(m+n+1)) for m + n odd, DLMF 14.17). All other integrands are smooth and are integrated by Gauss-Legendre
quadrature.

**Disc electrodes on a conducting sheet that is itself a disk with an insulated rim.** Under a disc of radius b, contact
impedance z and potential U, current flows between the sheet and the disc at every point: σ Δu = (u − U)/z. With the
transfer length λ = √(σz) the potential of the sheet under the disc is U + Σ_n A_n I_n(r/λ) cos n(φ − φ_n); outside the
discs u is harmonic.

For a single disc in the middle and all current leaving through the rim, only n = 0 occurs, and the solution has a
closed form. For several discs at any places, the field around each disc is expanded in the multipoles (b/r)^n of the
disc, and in the regular harmonics (r/b)^n of the field of the other discs and of the mirror images in the rim.
Continuity of potential and flux at r = b gives

    multipole_n = regular_n (n − q_n)/(n + q_n),    q_n = (b/λ) I_n'(b/λ) / I_n(b/λ),

a linear system whose truncation error decreases geometrically with the number of multipoles. A harmonic function h
satisfies the insulating condition on |w| = a if its image h(a²/w̄) is added.

**Curved sheets fed through points: a closed sphere, and a sleeve (an open cylinder).** A current of one ampere that is
fed into a sphere of sheet conductivity σ at a point, and taken out uniformly over the sphere, gives the potential

    u = −1/(2πσ) log |chord|,

because stereographic projection is conformal and maps this potential to the logarithm in the plane.

On a sleeve of radius R, u is a Fourier series in n φ. On an infinite sleeve the terms n > 0 sum to, with s = |z −
z'|/R,

    1/(2πσ) Σ_n e^{−ns} cos(nφ) / n = −1/(4πσ) log(1 − 2 e^{−s} cos φ + e^{−2s}),

and insulated ends at z = 0 and z = H mirror the source repeatedly, to 2kH ± z'. The term n = 0 is the potential of a
rod with a source and a uniform sink: 1/(2πRσ) [(z² + z'²)/2H − max(z, z')].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ive


@dataclass(frozen=True)
class ConductingDisk:
    """A homogeneous disk, or a disk with a concentric inclusion. **Fields**: `radius` in metres; `conductivity`: sheet
    conductivity in siemens; `inclusion_ratio`: radius of the inclusion divided by that of the disk, 0 for no inclusion;
    `inclusion_conductivity`: sheet conductivity of the inclusion in siemens."""

    radius: float = 1.0
    conductivity: complex = 1.0
    inclusion_ratio: float = 0.0
    inclusion_conductivity: complex = 1.0

    def inclusion_kernel(self, angle: np.ndarray) -> np.ndarray:
        """Contribution of the inclusion to the Neumann-to-Dirichlet kernel N at the angular distance `angle`, in
        ohm."""
        angle = np.asarray(angle, dtype=float)
        if self.inclusion_ratio == 0.0:
            return np.zeros_like(angle)
        reflection_coefficient = (self.inclusion_conductivity - self.conductivity) / (
            self.inclusion_conductivity + self.conductivity
        )
        mode_numbers = np.arange(1, 3 + int(np.ceil(np.log(1e-18) / (2.0 * np.log(self.inclusion_ratio)))))
        mode_coefficients = reflection_coefficient * self.inclusion_ratio ** (2.0 * mode_numbers)
        image_series = np.polynomial.chebyshev.chebval(
            np.cos(angle), np.concatenate([[0.0], -2.0 * mode_coefficients / (1.0 + mode_coefficients) / mode_numbers])
        )
        return image_series / (np.pi * self.conductivity)

    def kernel(self, angle: np.ndarray) -> np.ndarray:
        """The Neumann-to-Dirichlet kernel N of the disk, in ohm, at nonzero angular distances."""
        log_kernel = -np.log(np.abs(2.0 * np.sin(np.asarray(angle) / 2.0)))
        return log_kernel / (np.pi * self.conductivity) + self.inclusion_kernel(angle)


def point_transfer_impedance(disk: ConductingDisk, angles: np.ndarray) -> np.ndarray:
    """Potential (V) at L points on the rim of a disk, at the `angles` (L,), for one ampere into each point; (L, L), up
    to a constant.

    The potential at a point that feeds a current is infinite, so the diagonal is set to zero. Use the matrix only for
    channels that do not measure on driven electrodes.
    """
    angle_differences = angles[:, None] - angles[None, :]
    off_diagonal = ~np.eye(len(angles), dtype=bool)
    impedance = np.zeros(angle_differences.shape, dtype=np.result_type(disk.kernel(np.ones(1))))
    impedance[off_diagonal] = disk.kernel(angle_differences[off_diagonal])
    return impedance


def point_inclusion_effect(disk: ConductingDisk, angles: np.ndarray) -> np.ndarray:
    """Contribution (L, L) of the inclusion of a disk to `point_transfer_impedance`, in ohm; finite on the diagonal
    too."""
    return disk.inclusion_kernel(angles[:, None] - angles[None, :])


def point_potentials(disk: ConductingDisk, angles: np.ndarray, current: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Potential (V) at `points` (n, 2) of a disk without inclusion; `current` (L,), with sum zero, enters at
    `angles`."""
    projected_points = disk.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    distances_to_electrodes = np.linalg.norm(points[:, None, :] - projected_points[None, :, :], axis=-1)
    return -np.log(distances_to_electrodes) @ current / (np.pi * disk.conductivity)


def logarithm_moments(order: int) -> np.ndarray:
    """Integrals ∫∫ P_m(x) P_n(y) log|x − y| over [−1, 1]², for Legendre polynomials P_m, P_n of degrees m, n <
    `order`."""
    m, n = np.meshgrid(np.arange(order), np.arange(order), indexing="ij")
    with np.errstate(divide="ignore"):
        chebyshev_moments = 8.0 / ((m + n) * (m + n + 2.0) * ((m - n) ** 2.0 - 1.0))
    chebyshev_moments[(m + n) % 2 == 1] = 0.0
    chebyshev_moments[0, 0] = 4.0 * np.log(2.0) - 6.0
    return chebyshev_moments


def arc_transfer_impedance(
    disk: ConductingDisk,
    angles: np.ndarray,
    widths: np.ndarray,
    contact_impedance: np.ndarray,
    order: int = 48,
) -> np.ndarray:
    """Potentials (V) of L arc electrodes on the rim of a disk, with sum zero, for one ampere into each electrode and
    −1/L into all electrodes; (L, L).

    `angles` (L,) are the centres of the arcs in radians, `widths` (L,) their lengths in metres along the circle,
    `contact_impedance` (L,) is in ohm·m. For drive patterns D and measurement patterns M with sum zero, the voltages
    are M Z Dᵀ, where Z is the matrix returned.
    """
    num_electrodes = len(angles)
    half_angles = np.broadcast_to(widths, (num_electrodes,)) / (2.0 * disk.radius)
    z = np.broadcast_to(contact_impedance, (num_electrodes,))
    nodes, quadrature_weights = np.polynomial.legendre.leggauss(2 * order + 16)
    basis = np.polynomial.legendre.legvander(nodes, order - 1)
    weighted_basis = quadrature_weights[:, None] * basis

    node_angles = angles[:, None] + half_angles[:, None] * nodes
    matrix_dtype = np.result_type(disk.kernel(np.ones(1)), z)
    galerkin_matrix = np.zeros((num_electrodes, order, num_electrodes, order), dtype=matrix_dtype)
    mean_potential_source = np.zeros((num_electrodes, order, num_electrodes))
    for row in range(num_electrodes):
        for column in range(num_electrodes):
            angle_differences = node_angles[row][:, None] - node_angles[column][None, :]
            galerkin_scale = disk.radius**2 * half_angles[row] * half_angles[column]
            if row != column:
                galerkin_block = weighted_basis.T @ disk.kernel(angle_differences) @ weighted_basis
            else:
                # 2 sin(δ/2)/δ, computed with sinc(x) = sin(πx)/(πx), is the smooth factor of the logarithm's argument.
                smooth_kernel_part = -np.log(np.sinc(angle_differences / (2.0 * np.pi))) / (np.pi * disk.conductivity)
                galerkin_block = (
                    weighted_basis.T @ (smooth_kernel_part + disk.inclusion_kernel(angle_differences)) @ weighted_basis
                )
                log_moments = logarithm_moments(order)
                log_moments[0, 0] += 4.0 * np.log(half_angles[row])
                galerkin_block = galerkin_block - log_moments / (np.pi * disk.conductivity)
                mass = disk.radius * half_angles[row] * 2.0 / (2.0 * np.arange(order) + 1.0)
                galerkin_matrix[row, :, row, :] += z[row] * np.diag(mass)
            galerkin_matrix[row, :, column, :] += galerkin_scale * galerkin_block
        mean_potential_source[row, 0, row] = 2.0 * disk.radius * half_angles[row]

    mean_potential_source = mean_potential_source.reshape(num_electrodes * order, num_electrodes)
    current_density = np.linalg.solve(
        galerkin_matrix.reshape(num_electrodes * order, num_electrodes * order), mean_potential_source
    )
    impedance = np.linalg.inv(mean_potential_source.T @ current_density)
    centring_matrix = np.eye(num_electrodes) - 1.0 / num_electrodes
    return centring_matrix @ impedance @ centring_matrix


def disc_contact_resistance(conductivity: complex, radius: float, contact_impedance: complex) -> complex:
    """Contact resistance λ I_0(b/λ) / (2πσb I_1(b/λ)) of a disc electrode, with the transfer length λ = √(σz): the
    potential of the electrode minus the potential of the sheet at the edge of the disc, in volts per ampere fed into
    the disc.

    Sheet `conductivity` σ in siemens, `radius` b in metres, `contact_impedance` z in ohm·m². For b/λ → 0 the result
    tends to z/(πb²), the resistance of a contact with uniform current density; for b/λ → ∞ it tends to the resistance
    of a ring of width λ.
    """
    transfer_length = np.sqrt(conductivity * contact_impedance)
    bessel_argument = radius / transfer_length
    return transfer_length * ive(0, bessel_argument) / (2.0 * np.pi * conductivity * radius * ive(1, bessel_argument))


def centre_to_rim_resistance(
    disk: ConductingDisk, radius: float, contact_impedance: complex, rim_contact_impedance: complex
) -> complex:
    """Resistance (ohm) of a disk from a disc electrode in the middle to an electrode that covers the whole rim.

    `contact_impedance` of the disc is in ohm·m², `rim_contact_impedance` in ohm·m.
    """
    spreading_resistance = np.log(disk.radius / radius) / (2.0 * np.pi * disk.conductivity)
    rim_resistance = rim_contact_impedance / (2.0 * np.pi * disk.radius)
    return disc_contact_resistance(disk.conductivity, radius, contact_impedance) + spreading_resistance + rim_resistance


def disc_transfer_impedance(
    disk: ConductingDisk,
    positions: np.ndarray,
    radii: np.ndarray,
    contact_impedance: np.ndarray,
    num_multipoles: int = 24,
) -> np.ndarray:
    """Potentials (V) of L disc electrodes on a disk, with sum zero, for one ampere into each disc and −1/L into all
    discs; (L, L).

    `positions` (L, 2) and `radii` (L,) in metres, `contact_impedance` (L,) in ohm·m²; the disk has no inclusion.
    """
    num_electrodes = len(positions)
    multipole_orders = np.arange(1, num_multipoles + 1)
    centre = positions[:, 0] + 1j * positions[:, 1]
    num_samples = 4 * num_multipoles
    unit_circle = np.exp(2j * np.pi * np.arange(num_samples) / num_samples)
    # Row n of `multipole_analysis_matrix` maps samples on a circle to the coefficient of cos nφ, and row N + n to that
    # of sin nφ.
    complex_harmonics = unit_circle ** multipole_orders[:, None]
    multipole_analysis_matrix = np.concatenate([complex_harmonics.real, complex_harmonics.imag]) * (2.0 / num_samples)
    matrix_dtype = np.result_type(disk.conductivity, contact_impedance, 1.0)
    centring_matrix = np.eye(num_electrodes) - 1.0 / num_electrodes

    regular_kernel = np.zeros((num_electrodes, 2 * num_multipoles, num_electrodes, 2 * num_multipoles))
    regular_mean = np.zeros((num_electrodes, num_electrodes, 2 * num_multipoles))
    fed_multipoles = np.zeros((num_electrodes, 2 * num_multipoles, num_electrodes))
    fed_mean = np.zeros((num_electrodes, num_electrodes))
    reflection_factors = np.zeros((num_electrodes, 2 * num_multipoles), dtype=matrix_dtype)
    contact = np.zeros(num_electrodes, dtype=matrix_dtype)
    for electrode_index in range(num_electrodes):
        transfer_length = np.sqrt(disk.conductivity * contact_impedance[electrode_index])
        bessel_argument = radii[electrode_index] / transfer_length
        logarithmic_derivative = (
            bessel_argument * ive(multipole_orders + 1, bessel_argument) / ive(multipole_orders, bessel_argument)
            + multipole_orders
        )
        reflection_factors[electrode_index] = np.tile(
            (multipole_orders - logarithmic_derivative) / (multipole_orders + logarithmic_derivative), 2
        )
        contact[electrode_index] = disc_contact_resistance(
            disk.conductivity, radii[electrode_index], contact_impedance[electrode_index]
        )

        rim_points = centre[electrode_index] + radii[electrode_index] * unit_circle
        for source_index in range(num_electrodes):
            # The image is a²/w̄ − w_l = (a² − w_l w̄)/w̄; its term log|w̄| cancels for currents with sum zero.
            log_kernel = -np.log(np.abs(disk.radius**2 - centre[source_index] * rim_points.conj()))
            # The multipole cos nφ is the real part of (b/(w − w_l))^n, and sin nφ is minus its imaginary part.
            field_of_source = (
                radii[source_index] * rim_points.conj() / (disk.radius**2 - centre[source_index] * rim_points.conj())
            )[:, None] ** multipole_orders
            if electrode_index == source_index:
                log_kernel = log_kernel - np.log(radii[source_index])
            else:
                log_kernel = log_kernel - np.log(np.abs(rim_points - centre[source_index]))
                field_of_source = (
                    field_of_source
                    + (radii[source_index] / (rim_points - centre[source_index]))[:, None] ** multipole_orders
                )
            source_multipoles = np.concatenate([field_of_source.real, -field_of_source.imag], axis=1)
            regular_kernel[electrode_index, :, source_index, :] = multipole_analysis_matrix @ source_multipoles
            regular_mean[electrode_index, source_index] = source_multipoles.mean(axis=0)
            fed_multipoles[electrode_index, :, source_index] = multipole_analysis_matrix @ log_kernel
            fed_mean[electrode_index, source_index] = log_kernel.mean()

    current = centring_matrix / (2.0 * np.pi * disk.conductivity)
    num_unknowns = num_electrodes * 2 * num_multipoles
    scattering_matrix = reflection_factors[:, :, None, None] * regular_kernel
    incident_multipoles = reflection_factors[:, :, None] * fed_multipoles
    multipole_amplitudes = np.linalg.solve(
        np.eye(num_unknowns) - scattering_matrix.reshape(num_unknowns, num_unknowns),
        incident_multipoles.reshape(num_unknowns, num_electrodes) @ current,
    )
    potential = (
        fed_mean @ current
        + regular_mean.reshape(num_electrodes, num_unknowns) @ multipole_amplitudes
        + contact[:, None] * centring_matrix
    )
    return centring_matrix @ potential


# Distance in radii of the sleeve beyond which mirror images are negligible in double precision.
_MAX_IMAGE_DISTANCE = 45.0


def sphere_sheet_impedance(positions: np.ndarray, conductivity: complex) -> np.ndarray:
    """Potential (V) of a closed sphere at `positions` (L, 3), metres, for one ampere into each of these points; (L, L),
    up to a constant.

    Sheet `conductivity` in siemens. The potential at a point that feeds a current is infinite; the diagonal is set to
    zero.
    """
    distances_between_electrodes = np.linalg.norm(positions[:, None] - positions, axis=-1)
    np.fill_diagonal(distances_between_electrodes, 1.0)
    return -np.log(distances_between_electrodes) / (2 * np.pi * conductivity)


def sleeve_sheet_impedance(
    radius: float, height: float, angles: np.ndarray, heights: np.ndarray, conductivity: complex
) -> np.ndarray:
    """Potential (V) at each of L points of a sleeve (an open cylinder) for one ampere into each point; (L, L), up to
    terms that cancel for currents with sum zero.

    `radius` and `height` of the sleeve in metres; `angles` (L,) of the points around the sleeve in radians, and
    `heights` (L,) of the points above the sleeve's lower end in metres; sheet `conductivity` in siemens. The diagonal
    is set to zero, where the potential is infinite.
    """
    angle_difference = angles[:, None] - angles
    z, source_heights = heights[:, None], heights
    num_images = int(np.ceil(_MAX_IMAGE_DISTANCE * radius / (2 * height))) + 1
    potential = np.zeros(angle_difference.shape)
    for k in range(-num_images, num_images + 1):
        for axial_distance in (z - source_heights + 2 * k * height, z + source_heights + 2 * k * height):
            exponential_decay = np.exp(-np.abs(axial_distance) / radius)
            squared_distance = 1 - 2 * exponential_decay * np.cos(angle_difference) + exponential_decay**2
            potential -= np.log(np.where(squared_distance > 0, squared_distance, 1.0)) / 2
    axial_mean_term = (z**2 + source_heights**2) / (2 * height) - np.maximum(z, source_heights)
    potential += axial_mean_term / radius
    np.fill_diagonal(potential, 0.0)
    return potential / (2 * np.pi * conductivity)
