"""Disc electrodes lying on a conducting sheet that is itself a disk with an insulated rim.

Under a disc of radius b the contact takes current from the sheet everywhere, σ Δu = (u − U)/z, so that with
the transfer length λ = √(σz) the potential there is U + Σ_n A_n I_n(r/λ) cos n(φ − φ_n); outside the discs u
is harmonic.

One disc in the middle, all current leaving through the rim, has only n = 0: a closed form. For several discs
anywhere, the field about each disc is expanded in its own multipoles (b/r)^n and in the regular harmonics
(r/b)^n that the other discs and the mirror images in the rim raise there; matching value and flux on r = b
gives

    multipole_n = regular_n (n − q_n)/(n + q_n),    q_n = (b/λ) I_n'(b/λ) / I_n(b/λ),

a linear system whose truncation error falls geometrically with the number of multipoles. A harmonic function
h satisfies the insulating condition on |w| = a when h(a²/w̄), its image, is added.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ive

from jeit.forward.exact.rim import ConductingDisk


def disc_contact_resistance(conductivity: complex, radius: float, contact_impedance: complex) -> complex:
    """U − u on the disc's edge, in volts, per ampere fed into the disc: λ I_0(b/λ) / (2πσb I_1(b/λ)).

    Sheet `conductivity` σ in siemens, `radius` b in metres, `contact_impedance` z in ohm·m². As b/λ → 0 this is
    z/(πb²), a contact fed uniformly; as b/λ → ∞ it is that of a ring of width λ.
    """
    transfer_length = np.sqrt(conductivity * contact_impedance)
    argument = radius / transfer_length
    return transfer_length * ive(0, argument) / (2.0 * np.pi * conductivity * radius * ive(1, argument))


def centre_to_rim_resistance(
    disk: ConductingDisk, radius: float, contact_impedance: complex, rim_contact_impedance: complex
) -> complex:
    """Resistance (ohm) from a disc electrode in the middle to an electrode that covers the whole rim.

    `contact_impedance` of the disc in ohm·m², of the rim in ohm·m.
    """
    spreading = np.log(disk.radius / radius) / (2.0 * np.pi * disk.conductivity)
    rim = rim_contact_impedance / (2.0 * np.pi * disk.radius)
    return disc_contact_resistance(disk.conductivity, radius, contact_impedance) + spreading + rim


def disc_transfer_impedance(
    disk: ConductingDisk,
    positions: np.ndarray,
    radii: np.ndarray,
    contact_impedance: np.ndarray,
    num_multipoles: int = 24,
) -> np.ndarray:
    """Electrode potentials (V), of sum zero, for one ampere into each disc and −1/L into all: (L, L).

    `positions` (L, 2) and `radii` (L,) in metres, `contact_impedance` (L,) in ohm·m²; no inclusion.
    """
    num = len(positions)
    order = np.arange(1, num_multipoles + 1)
    centre = positions[:, 0] + 1j * positions[:, 1]
    num_samples = 4 * num_multipoles
    circle = np.exp(2j * np.pi * np.arange(num_samples) / num_samples)
    # Row n of `analysis` takes samples on a circle to the coefficient of cos nφ; row N + n to that of sin nφ.
    harmonics = circle ** order[:, None]
    analysis = np.concatenate([harmonics.real, harmonics.imag]) * (2.0 / num_samples)
    dtype = np.result_type(disk.conductivity, contact_impedance, 1.0)
    centring = np.eye(num) - 1.0 / num

    regular = np.zeros((num, 2 * num_multipoles, num, 2 * num_multipoles))
    regular_mean = np.zeros((num, num, 2 * num_multipoles))
    fed = np.zeros((num, 2 * num_multipoles, num))
    fed_mean = np.zeros((num, num))
    reflection = np.zeros((num, 2 * num_multipoles), dtype=dtype)
    contact = np.zeros(num, dtype=dtype)
    for at in range(num):
        transfer_length = np.sqrt(disk.conductivity * contact_impedance[at])
        argument = radii[at] / transfer_length
        slope = argument * ive(order + 1, argument) / ive(order, argument) + order
        reflection[at] = np.tile((order - slope) / (order + slope), 2)
        contact[at] = disc_contact_resistance(disk.conductivity, radii[at], contact_impedance[at])

        point = centre[at] + radii[at] * circle
        for source in range(num):
            # The image a²/w̄ − w_l = (a² − w_l w̄)/w̄; the log|w̄| it brings cancels over currents of sum zero.
            logarithm = -np.log(np.abs(disk.radius**2 - centre[source] * point.conj()))
            # Multipole cos nφ is the real part of (b/(w − w_l))^n, sin nφ minus its imaginary part.
            field = (radii[source] * point.conj() / (disk.radius**2 - centre[source] * point.conj()))[:, None] ** order
            if at == source:
                logarithm = logarithm - np.log(radii[source])
            else:
                logarithm = logarithm - np.log(np.abs(point - centre[source]))
                field = field + (radii[source] / (point - centre[source]))[:, None] ** order
            multipoles = np.concatenate([field.real, -field.imag], axis=1)
            regular[at, :, source, :] = analysis @ multipoles
            regular_mean[at, source] = multipoles.mean(axis=0)
            fed[at, :, source] = analysis @ logarithm
            fed_mean[at, source] = logarithm.mean()

    current = centring / (2.0 * np.pi * disk.conductivity)
    size = num * 2 * num_multipoles
    scatter = reflection[:, :, None, None] * regular
    incident = reflection[:, :, None] * fed
    amplitude = np.linalg.solve(np.eye(size) - scatter.reshape(size, size), incident.reshape(size, num) @ current)
    potential = fed_mean @ current + regular_mean.reshape(num, size) @ amplitude + contact[:, None] * centring
    return centring @ potential
