"""The closed-form solutions checked against each other, against limits, and against an ordinary differential
equation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import eval_legendre

from jeit.forward.exact import (
    ConductingDisk,
    arc_transfer_impedance,
    centre_to_rim_resistance,
    disc_contact_resistance,
    disc_transfer_impedance,
    logarithm_moments,
    point_inclusion_effect,
    point_potentials,
    point_transfer_impedance,
)

ANGLES = np.array([0.1, 0.9, 2.0, 3.3, 5.0])
CENTRED = np.eye(5) - 0.2
INCLUSION = ConductingDisk(2.0, 0.5, 0.6, 3.0)


def relative(value, reference):
    return np.abs(value - reference).max() / np.abs(reference).max()


def test_logarithm_moments_by_quadrature():
    nodes, weights = np.polynomial.legendre.leggauss(60)
    for m, n in [(0, 0), (1, 1), (0, 2), (3, 1), (2, 4), (1, 2)]:
        total = 0.0
        for y, weight in zip(nodes, weights, strict=True):
            for end in (-1.0, 1.0):  # x = y + (end − y) t⁴ smooths the logarithm at x = y
                t = (nodes + 1.0) / 2.0
                x = y + (end - y) * t**4
                integrand = eval_legendre(m, x) * (np.log(abs(end - y)) + 4.0 * np.log(t)) * 4.0 * t**3
                total += weight * eval_legendre(n, y) * abs(end - y) / 2.0 * (weights @ integrand)
        assert total == pytest.approx(logarithm_moments(6)[m, n], abs=1e-6)  # 60-point quadrature of y log y


@pytest.mark.parametrize(
    "disk", [ConductingDisk(), ConductingDisk(2.0, 0.5 + 0.2j, 0.6, 3.0 - 1.0j)], ids=["homogeneous", "inclusion"]
)
def test_arcs_converge_with_the_polynomial_degree(disk):
    widths = np.array([0.2, 0.3, 0.25, 0.4, 0.1]) * disk.radius
    impedance = np.array([0.01, 0.1, 0.03, 0.5, 0.02])
    best = arc_transfer_impedance(disk, ANGLES, widths, impedance, order=96)
    errors = [relative(arc_transfer_impedance(disk, ANGLES, widths, impedance, order=p), best) for p in (6, 12, 24)]
    order = np.polyfit(np.log([6, 12, 24]), np.log(errors), 1)[0]
    assert order < -5.0  # p^-6, of an s log s density
    assert relative(arc_transfer_impedance(disk, ANGLES, widths, impedance), best) < 1e-8
    assert relative(best, best.T) < 1e-12


def test_narrow_arcs_approach_points():
    narrow = arc_transfer_impedance(INCLUSION, ANGLES, np.full(5, 1e-3), np.full(5, 1e-3), order=12)
    drive, measurement = np.array([1.0, -1.0, 0, 0, 0]), np.array([0, 0, 1.0, 0, -1.0])
    points = point_transfer_impedance(INCLUSION, ANGLES)
    # They differ by (width/distance)².
    assert measurement @ narrow @ drive == pytest.approx(measurement @ points @ drive, rel=1e-6)


def test_resistive_contacts_carry_uniform_current():
    widths, impedance = np.full(5, 0.3), np.array([1.0, 2.0, 3.0, 4.0, 5.0]) * 1e6
    layers = CENTRED @ np.diag(impedance / widths) @ CENTRED
    assert relative(arc_transfer_impedance(ConductingDisk(), ANGLES, widths, impedance, order=8), layers) < 1e-5  # 1/z


def test_uniform_currents_of_wide_arcs():
    """Without the voltage drop at the contacts, the mean potentials are a Fourier series."""
    widths, impedance = np.array([0.7, 0.8, 1.2, 1.3, 1.2]), np.full(5, 1e4)
    found = arc_transfer_impedance(ConductingDisk(1.0, 2.0), ANGLES, widths, impedance, order=8)
    modes = np.arange(1, 3000)[:, None, None]
    means = np.sinc(modes * widths / (2 * np.pi))
    series = np.cos(modes * (ANGLES[:, None] - ANGLES)) * means * means.transpose(0, 2, 1) / (2.0 * np.pi * modes)
    expected = CENTRED @ series.sum(axis=0) @ CENTRED
    assert relative(found - CENTRED @ np.diag(impedance / widths) @ CENTRED, expected) < 1e-4  # 1/z


def test_inclusion_of_equal_conductivity_and_insulating_inclusion():
    assert np.abs(point_inclusion_effect(ConductingDisk(1.0, 2.0, 0.5, 2.0), ANGLES)).max() < 1e-15
    # An insulating core leaves an annulus: modes k have ND eigenvalue (1 + ρ^{2k})/(1 − ρ^{2k})/k.
    annulus = ConductingDisk(1.0, 1.0, 0.5, 0.0)
    k = np.arange(1, 60)
    extra = (2.0 * 0.25**k / (1.0 - 0.25**k) / k) @ np.cos(k[:, None] * 1.3) / np.pi
    assert annulus.inclusion_kernel(np.array([1.3]))[0] == pytest.approx(extra.item(), rel=1e-14)


def test_point_potentials_at_the_rim():
    current = np.array([1.0, -2.0, 0.5, 0.0, 0.5])
    rim = np.array([0.4, 4.0])
    disk = ConductingDisk(0.1, 3.0)
    points = disk.radius * np.stack([np.cos(rim), np.sin(rim)], axis=-1)
    inside = point_potentials(disk, ANGLES, current, points)
    along = disk.kernel(rim[:, None] - ANGLES) @ current
    assert inside[0] - inside[1] == pytest.approx(along[0] - along[1], rel=1e-13)


def test_disc_contact_against_the_radial_equation():
    radius, conductivity, impedance = 0.3, 2.0, 0.01

    def equation(r, state):  # state: u − U and r u'
        return [state[1] / r, r * state[0] / (conductivity * impedance)]

    start = 1e-6
    solution = solve_ivp(
        equation,
        (start, radius),
        [-1.0, -(start**2) / (2 * conductivity * impedance)],
        rtol=1e-11,
        atol=1e-14,
    )
    drop, slope = solution.y[:, -1]
    fed = -slope * 2.0 * np.pi * conductivity
    assert disc_contact_resistance(conductivity, radius, impedance) == pytest.approx(-drop / fed, rel=1e-8)
    uniform = 1e4 / (np.pi * radius**2)
    assert disc_contact_resistance(conductivity, radius, 1e4) == pytest.approx(uniform, rel=1e-5)


def test_discs_converge_scale_and_approach_points():
    positions = np.array([[0.0, 0.0], [0.5, 0.1], [-0.4, 0.3], [-0.1, -0.6]])
    radii = np.array([0.1, 0.15, 0.12, 0.2])
    impedance = np.array([0.003, 0.02, 0.01, 0.005])
    best = disc_transfer_impedance(ConductingDisk(), positions, radii, impedance)
    assert (
        relative(disc_transfer_impedance(ConductingDisk(), positions, radii, impedance, num_multipoles=10), best)
        < 1e-12
    )
    assert relative(best, best.T) < 1e-13
    small = disc_transfer_impedance(ConductingDisk(0.1, 2.0), 0.1 * positions, 0.1 * radii, 0.005 * impedance)
    assert relative(2.0 * small, best) < 1e-13

    # Tiny discs in a huge disk: −log(distance)/(2πσ) between them.
    tiny = disc_transfer_impedance(ConductingDisk(1e6, 1.0), positions, np.full(4, 1e-4), np.full(4, 1e-8))
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1) + np.eye(4)
    drive, measurement = np.array([1.0, -1.0, 0, 0]), np.array([0, 0, 1.0, -1.0])
    expected = measurement @ -np.log(distance) @ drive / (2.0 * np.pi)
    assert measurement @ tiny @ drive == pytest.approx(expected, rel=1e-6)


def test_discs_that_hardly_resist_at_any_angle():
    """Two equipotential discs of radius r at a distance d in an infinite sheet: R = arcosh(d / 2r) / (πσ)."""
    drive = np.array([1.0, -1.0])
    for angle in (0.0, 0.7, np.pi / 2, 2.5):
        positions = 0.15 * np.array([1.0, -1.0])[:, None] * [np.cos(angle), np.sin(angle)]
        discs = np.full(2, 0.1), np.full(2, 1e-16)
        found = disc_transfer_impedance(ConductingDisk(1e6, 2.0), positions, *discs)
        # Current passes through the rims of the discs, within a transfer length of 1e-8 m.
        assert drive @ found @ drive == pytest.approx(np.arccosh(1.5) / (2.0 * np.pi), rel=1e-6)


def test_centre_to_rim_resistance_is_the_sum_of_its_layers():
    # Sheet between radii b and a: log(a/b)/(2πσ).
    disk = ConductingDisk(0.1, 2.0)
    total = centre_to_rim_resistance(disk, 0.02, 1e-4, 0.05)
    layers = disc_contact_resistance(2.0, 0.02, 1e-4) + 0.05 / (0.2 * np.pi)
    assert total - layers == pytest.approx(np.log(5.0) / (4.0 * np.pi), rel=1e-13)
