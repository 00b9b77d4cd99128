"""Exact voltages of homogeneous boxes, cylinders and spheres, as series.

**A solid or hollow cylinder** is fed through patches of its wall, with a current that is uniform over each patch (the
gap model). The cylinder fills 0 < z < H, with insulated ends, and R₁ < r < R₂, insulated at R₁. Potentials are sums of
F(r) cos nφ cos kz, k = mπ/H, with

    F = I_n(kr) − I_n'(kR₁)/K_n'(kR₁) K_n(kr)   for m > 0,      F = (r/R₂)^n + (R₁²/rR₂)^n   for m = 0 < n,

and a current density j in this mode raises the potential of the wall by j F(R₂) / (σ F'(R₂)). A patch of half-angle α
and height h at (φ_l, z_l) that carries one ampere has the density Σ ε_n ε_m w_nm cos n(φ − φ_l) cos kz / (2πR₂H), with
w_nm = sin(nα)/(nα) · sin(kh/2)/(kh/2) · cos kz_l, where ε_0 = 1 and all other ε are 2; the mean potential over the
patch weights the modes in the same way. Ratios of Bessel functions are computed from recurrences in their stable
directions: downwards for I_n, upwards for K_n.

An electrode whose contact impedance z is large compared with its size divided by σ carries a uniform current density.
Such an electrode measures the mean potential beneath it, plus the voltage z I / area across its contact for a current
I.

**A solid or hollow ball** is fed through caps of its surface, with a current that is uniform over each cap (the gap
model). With an insulated inner surface at R₁, potentials are sums of F(r) P_n(cos γ), F = r^n + n/(n+1) R₁^{2n+1}
r^{−n−1}. A cap of half-angle α that carries one ampere has the density Σ (2n+1) w_n P_n(cos γ) / (4πR₂²), where γ is
the angle from the centre of the cap, with

    w_n = (P_{n−1}(cos α) − P_{n+1}(cos α)) / ((2n+1)(1 − cos α)),

the mean of P_n over the cap. By the addition theorem the mean of P_n(cos γ) over a different cap of the same size is
w_n P_n(cos β), where β is the angle between the centres of the caps. Contact impedances act as in the cylinder.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ive, kve


def plate_resistance(length: float, area: float, conductivity: complex, contact_impedance: complex) -> complex:
    """Resistance R = ℓ/(σA) + 2z/A in ohm between two plates: Ohm's law for the conductor of length ℓ and one contact
    layer at each plate.

    In 3-D `area` is in m², `conductivity` in S/m and `contact_impedance` in ohm·m²; in 2-D `area` is the length of the
    plate in metres, `conductivity` is in siemens and `contact_impedance` in ohm·m.
    """
    return length / (conductivity * area) + 2.0 * contact_impedance / area


def face_patch_impedance(
    size: tuple[float, float, float],
    positions: np.ndarray,
    patch: tuple[float, float],
    conductivity: complex,
    num_modes: tuple[int, int] = (300, 300),
) -> np.ndarray:
    """Mean potential (V) under each of L patches on the lower and upper face of a box, for one ampere into each patch,
    with a uniform current density (the gap model); (L, L), up to terms that cancel for currents that sum to zero.

    `size`: lengths (a, b, c) of the sides of the box, which fills 0 ≤ x ≤ a, 0 ≤ y ≤ b, 0 ≤ z ≤ c; `positions`: (L, 3)
    centres of the patches, with z = 0 or c; `patch`: widths of the patches along x and y; all in metres. `conductivity`
    in S/m.

    The mode cos(pπx/a) cos(qπy/b), of wave number κ, has the potential coth(κc)/κ on the face through which it is fed
    and 1/(κ sinh κc) on the opposite face. The mode p = q = 0 is the potential of a rod with a uniform sink, whose ends
    differ by c/2.
    """
    a, b, c = size
    wavenumbers = [
        np.arange(num_modes_along_axis) * np.pi / body_side
        for num_modes_along_axis, body_side in zip(num_modes, (a, b), strict=True)
    ]
    modes_x, modes_y = (
        np.sinc(k * patch_width / 2 / np.pi) * np.cos(k * positions[:, axis, None])
        for axis, (k, patch_width) in enumerate(zip(wavenumbers, patch, strict=True))
    )
    decay_rates = np.hypot(wavenumbers[0][:, None], wavenumbers[1])
    decay_rates[0, 0] = 1.0
    mode_weights = np.outer(*(np.where(k > 0, 2, 1) for k in wavenumbers))
    decay_factor = np.exp(-decay_rates * c)
    same_face_modes, opposite_face_modes = (
        (1 + decay_factor**2) / (1 - decay_factor**2) / decay_rates,
        2 * decay_factor / (1 - decay_factor**2) / decay_rates,
    )
    same_face_modes[0, 0], opposite_face_modes[0, 0] = 0.0, -c / 2
    is_same_face = np.equal.outer(positions[:, 2] > c / 2, positions[:, 2] > c / 2)
    same_face, opposite_face = (
        np.einsum("lp,kp,pq,lq,kq->lk", modes_x, modes_x, mode_weights * mode, modes_y, modes_y, optimize=True)
        for mode in (same_face_modes, opposite_face_modes)
    )
    return np.where(is_same_face, same_face, opposite_face) / (a * b * conductivity)


@dataclass(frozen=True)
class ConductingCylinder:
    """An upright cylinder from z = 0 to its `height`. `radius` and `height` in metres, `conductivity` in S/m;
    `inner_radius` in metres: radius of the insulated inner wall of a hollow cylinder, 0 for a solid cylinder."""

    radius: float
    height: float
    conductivity: complex = 1.0
    inner_radius: float = 0.0

    def response(self, num_around: int, num_along: int) -> np.ndarray:
        """Ratio F(R₂) / F'(R₂), (n, m) in metres, of the radial functions F of the modes n < `num_around` and m <
        `num_along`; 0 for the constant mode."""
        bessel_orders = np.arange(num_around)[:, None]
        radius_ratio = self.inner_radius / self.radius
        mode_response = np.zeros((num_around, num_along))
        power_of_ratio = radius_ratio ** (2.0 * bessel_orders[1:, 0])
        mode_response[1:, 0] = self.radius / bessel_orders[1:, 0] * (1 + power_of_ratio) / (1 - power_of_ratio)
        axial_wavenumbers = np.arange(1, num_along) * np.pi / self.height
        outer_bessel = _Bessel(num_around, axial_wavenumbers * self.radius)
        mode_response[:, 1:] = 1 / (axial_wavenumbers * outer_bessel.growth)
        if self.inner_radius > 0:
            inner_bessel = _Bessel(num_around, axial_wavenumbers * self.inner_radius)
            # Ratio of the K_n term of F to its I_n term at R₂.
            second_kind_share = (
                inner_bessel.growth
                / inner_bessel.decay
                * np.exp(inner_bessel.log_i - inner_bessel.log_k + outer_bessel.log_k - outer_bessel.log_i)
            )
            mode_response[:, 1:] *= (1 + second_kind_share) / (
                1 - second_kind_share * outer_bessel.decay / outer_bessel.growth
            )
        return mode_response


def wall_patch_impedance(
    cylinder: ConductingCylinder,
    angles: np.ndarray,
    heights: np.ndarray,
    size: tuple[float, float],
    num_modes: tuple[int, int] = (300, 300),
) -> np.ndarray:
    """Mean potential (V) under each of L patches on the wall of a cylinder, for one ampere into each patch; (L, L), up
    to a constant.

    The centres of the patches lie at `angles` (L,) in radians and `heights` (L,) in metres; all patches have the `size`
    (arc length, height) in metres. `num_modes`: number of modes summed around and along the cylinder.
    """
    n, m = np.arange(num_modes[0]), np.arange(num_modes[1])
    axial_wavenumber = m * np.pi / cylinder.height
    # sin(x)/x is numpy.sinc(x/π).
    circumferential_factor = np.sinc(n * size[0] / (2 * cylinder.radius) / np.pi)
    axial_factors = np.sinc(axial_wavenumber * size[1] / 2 / np.pi) * np.cos(axial_wavenumber * heights[:, None])
    mode_factors = np.outer(np.where(n > 0, 2, 1), np.where(m > 0, 2, 1))
    mode_weights = mode_factors * cylinder.response(*num_modes) * circumferential_factor[:, None] ** 2
    angular_factors = np.cos(n * (angles[:, None] - angles)[..., None])
    impedance = np.einsum(
        "lkn,nm,lm,km->lk", angular_factors, mode_weights, axial_factors, axial_factors, optimize=True
    )
    return impedance / (2 * np.pi * cylinder.radius * cylinder.height * cylinder.conductivity)


class _Bessel:
    """Modified Bessel functions I_n and K_n of orders n < `count` at x (m,), as arrays (n, m) of their logarithms, of
    the growth I_n'/I_n and of the decay −K_n'/K_n."""

    def __init__(self, count: int, x: np.ndarray):
        bessel_orders = np.arange(count)[:, None]
        first_kind_ratios, second_kind_ratios = np.empty((count, len(x))), np.empty((count, len(x)))
        bessel_ratio = x / (2.0 * (count + 60))
        for n in range(count + 59, -1, -1):  # I_{n+1} / I_n
            bessel_ratio = 1 / (2 * (n + 1) / x + bessel_ratio)
            if n < count:
                first_kind_ratios[n] = bessel_ratio
        second_kind_ratios[0] = kve(1, x) / kve(0, x)  # K_{n+1} / K_n
        for n in range(1, count):
            second_kind_ratios[n] = 2 * n / x + 1 / second_kind_ratios[n - 1]
        zero_row = np.zeros((1, len(x)))
        self.log_i = (
            np.log(ive(0, x)) + x + np.concatenate([zero_row, np.cumsum(np.log(first_kind_ratios[:-1]), axis=0)])
        )
        self.log_k = (
            np.log(kve(0, x)) - x + np.concatenate([zero_row, np.cumsum(np.log(second_kind_ratios[:-1]), axis=0)])
        )
        self.growth, self.decay = first_kind_ratios + bessel_orders / x, second_kind_ratios - bessel_orders / x


@dataclass(frozen=True)
class ConductingSphere:
    """A ball around the origin. `radius` in metres, `conductivity` in S/m; `inner_radius` in metres: radius of the
    insulated inner surface of a hollow ball, 0 for a solid ball."""

    radius: float
    conductivity: complex = 1.0
    inner_radius: float = 0.0


def cap_impedance(sphere: ConductingSphere, directions: np.ndarray, radius: float, num_modes: int = 400) -> np.ndarray:
    """Mean potential (V) under each of L caps on the surface of a ball, for one ampere into each cap; (L, L), up to a
    constant.

    `directions`: (L, 3) unit vectors to the centres of the caps; `radius`: radius of all caps in metres, measured in a
    straight line from centre to rim, as for `jeit.electrodes.FaceDiscs`. `num_modes`: number of modes summed.
    """
    n = np.arange(1, num_modes + 1)
    cap_cosine = 1 - (radius / sphere.radius) ** 2 / 2  # a chord is 2 R sin(α/2)
    legendre_values = np.polynomial.legendre.legvander(np.array([cap_cosine]), num_modes + 1)[0]
    mean = (legendre_values[n - 1] - legendre_values[n + 1]) / ((2 * n + 1) * (1 - cap_cosine))
    power_of_ratio = (sphere.inner_radius / sphere.radius) ** (2.0 * n + 1)
    mode_response = (1 + n / (n + 1) * power_of_ratio) / (n * (1 - power_of_ratio))
    cosines_between_caps = np.clip(directions @ directions.T, -1, 1)
    coefficients = np.concatenate([[0.0], (2 * n + 1) * mode_response * mean**2])
    legendre_series = np.polynomial.legendre.legval(cosines_between_caps, coefficients)
    return legendre_series / (4 * np.pi * sphere.radius * sphere.conductivity)
