"""Series solutions for spheres, cylinders, boxes and curved sheets: against special functions, each other, and
limits."""

import numpy as np
import pytest
from scipy.special import iv, ivp, kv, kvp

from jeit.forward.exact import (
    ConductingCylinder,
    ConductingSphere,
    cap_impedance,
    face_patch_impedance,
    plate_resistance,
    sleeve_sheet_impedance,
    sphere_sheet_impedance,
    wall_patch_impedance,
)

ANGLES, HEIGHTS = np.array([0.1, 1.2, 2.9, 4.4]), np.array([0.02, 0.05, 0.035, 0.06])
DRIVE, MEASURE = np.array([1.0, -1, 0, 0]), np.array([0, 0, 1.0, -1])


def channel(impedance):
    return MEASURE @ impedance @ DRIVE


def directions(number, seed=0):
    made = np.random.default_rng(seed).normal(size=(number, 3))
    return made / np.linalg.norm(made, axis=1, keepdims=True)


@pytest.mark.parametrize("inner", [0.0, 0.04])
def test_modes_of_a_cylinder_by_bessel_functions(inner):
    body = ConductingCylinder(0.05, 0.08, inner_radius=inner)
    found = body.response(12, 9)
    for n in range(12):
        for m in range(1, 9):
            k = m * np.pi / 0.08
            share = ivp(n, k * inner) / kvp(n, k * inner) if inner else 0.0
            value = iv(n, k * 0.05) - share * kv(n, k * 0.05)
            slope = k * (ivp(n, k * 0.05) - share * kvp(n, k * 0.05))
            assert found[n, m] == pytest.approx(value / slope, rel=1e-11)
    # High orders do not overflow and are not influenced by the axis: F = r^n.
    high = body.response(900, 3)
    assert np.isfinite(high).all()
    assert high[899, 1] == pytest.approx(0.05 / np.hypot(899, np.pi / 0.08 * 0.05), rel=2e-3)


def test_a_thin_cylinder_is_a_sleeve():
    """Potentials between small distant patches, to the order of the relative thickness and of the square of the
    patches' size."""
    errors = []
    for thickness in (2e-3, 1e-3, 5e-4):
        body = ConductingCylinder(0.05 + thickness / 2, 0.08, 3.0, 0.05 - thickness / 2)
        patches = wall_patch_impedance(body, ANGLES, HEIGHTS, (2e-3, 2e-3), (600, 600))
        sheet = sleeve_sheet_impedance(0.05, 0.08, ANGLES, HEIGHTS, 3.0 * thickness)
        errors.append(abs(channel(patches) / channel(sheet) - 1))
    assert errors[2] < 1e-3
    assert errors[2] < errors[0] / 2


def test_a_sleeve_against_its_fourier_series():
    radius, height = 0.05, 0.03
    n = np.arange(1, 4000)[:, None, None]
    k = n / radius
    angles, heights = ANGLES, HEIGHTS / 2.5
    around, apart = angles[:, None] - angles, np.abs(heights[:, None] - heights)
    total = heights[:, None] + heights
    grown = (
        np.exp(-k * apart) + np.exp(-k * (2 * height - apart)) + np.exp(-k * total) + np.exp(-k * (2 * height - total))
    )
    series = (np.cos(n * around) / n * grown / (1 - np.exp(-2 * k * height))).sum(axis=0) / (2 * np.pi)
    rod = (heights[:, None] ** 2 + heights**2) / (2 * height) - np.maximum(heights[:, None], heights)
    series += rod / (2 * np.pi * radius)
    found = sleeve_sheet_impedance(radius, height, angles, heights, 1.0)
    off = ~np.eye(4, dtype=bool)
    np.testing.assert_allclose(found[off], series[off], rtol=1e-12, atol=1e-13)


def test_a_wide_sleeve_is_a_plane():
    """Points near each other on a very wide sleeve: −log(distance)/(2πσ)."""
    places = np.array([[0.0, 0.0], [0.02, 0.01], [-0.01, 0.03], [0.015, -0.02]])
    errors = []
    for radius in (1.0, 2.0, 4.0):
        found = sleeve_sheet_impedance(radius, 20 * radius, places[:, 0] / radius, 10 * radius + places[:, 1], 1.0)
        distance = np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(4)
        errors.append(abs(channel(found) / channel(-np.log(distance) / (2 * np.pi)) - 1))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[2] < 1e-4


def test_a_sphere_by_its_differential_equation():
    """The potential of two points is harmonic: the mean over a small circle equals the value at its centre."""
    feeds = directions(2)
    middle = directions(5, seed=3)
    helper = np.eye(3)[np.abs(middle).argmin(axis=1)]
    first = np.cross(middle, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(middle, first)
    turn = 2 * np.pi * np.arange(16) / 16
    circle = middle[:, None] * np.cos(0.05) + np.sin(0.05) * (
        first[:, None] * np.cos(turn)[:, None] + second[:, None] * np.sin(turn)[:, None]
    )

    def potential(places):
        found = sphere_sheet_impedance(np.concatenate([feeds, places]), 2.0)
        return found[2:, 0] - found[2:, 1]

    around = np.array([potential(each).mean() for each in circle])
    np.testing.assert_allclose(around, potential(middle), atol=1e-12)
    # One ampere flows through a circle round the source: 2π sin(γ) σ ∂u/∂γ.
    ahead, behind = (
        potential(feeds[:1] * np.cos(angle) + np.sin(angle) * np.cross(feeds[0], [0.0, 0, 1])[None])
        for angle in (0.011, 0.009)
    )
    assert ((behind - ahead) / 0.002 * 2 * np.pi * 0.01 * 2.0).item() == pytest.approx(1, rel=0.02)


def test_small_caps_on_a_ball_are_points():
    """Σ (2n+1)/n P_n(cos γ) = 1/s − 2 − log(s (1 + s)) with s = sin(γ/2) (Whittaker and Watson, chapter 15)."""
    faces = directions(4)
    body = ConductingSphere(0.05, 2.0)
    half = np.linalg.norm(faces[:, None] - faces, axis=-1) / 2 + np.eye(4)
    points = (1 / half - 2 - np.log(half * (1 + half))) / (4 * np.pi * 0.05 * 2.0)
    errors = [abs(channel(cap_impedance(body, faces, 0.05 * r, 3000)) / channel(points) - 1) for r in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    assert errors[1] < 2e-3


def test_a_thin_ball_is_a_sheet():
    faces = directions(4)
    sheet = sphere_sheet_impedance(faces, 2.0 * 1e-4)
    body = ConductingSphere(1.00005, 2.0, 0.99995)
    assert channel(cap_impedance(body, faces, 0.01, 3000)) == pytest.approx(channel(sheet), rel=1e-3)


def test_two_hemispherical_caps():
    """Caps that cover a hemisphere each: w_n of the Legendre series by quadrature of P_n."""
    nodes, weights = np.polynomial.legendre.leggauss(300)
    n = np.arange(1, 200)
    mean = np.polynomial.legendre.legvander((nodes + 1) / 2, 199)[:, 1:].T @ weights / 2
    expected = 4 * ((2 * n + 1) / n * mean**2)[::2].sum() / (4 * np.pi)
    found = cap_impedance(ConductingSphere(1.0), np.array([[0, 0, 1.0], [0, 0, -1]]), np.sqrt(2.0), 199)
    assert found[0, 0] + found[1, 1] - 2 * found[0, 1] == pytest.approx(expected, rel=1e-10)


def test_whole_faces_of_a_box_are_plates():
    places = np.array([[0.1, 0.05, 0.0], [0.1, 0.05, 0.06]])
    found = face_patch_impedance((0.2, 0.1, 0.06), places, (0.2, 0.1), 0.5)
    between = found[0, 0] + found[1, 1] - 2 * found[0, 1]
    assert between == pytest.approx(plate_resistance(0.06, 0.02, 0.5, 0.0), rel=1e-12)


def test_results_are_invariant_to_rotations_of_a_box():
    """Two patches on the lower face and two on the upper one: turned over, turned by a quarter, and by the box's own
    series."""
    places = np.array([[0.05, 0.03, 0], [0.15, 0.06, 0.06], [0.12, 0.02, 0], [0.07, 0.08, 0.06]])
    size, patch = (0.2, 0.1, 0.06), (0.02, 0.03)
    found = face_patch_impedance(size, places, patch, 0.5)
    assert channel(found) == pytest.approx(
        channel(face_patch_impedance(size, places, patch, 0.5, (150, 150))), rel=1e-3
    )
    over = face_patch_impedance(size, places * [1, 1, -1] + [0, 0, 0.06], patch, 0.5)
    turned = face_patch_impedance((0.1, 0.2, 0.06), places[:, [1, 0, 2]], (0.03, 0.02), 0.5)
    assert channel(over) == pytest.approx(channel(found), rel=1e-12)
    assert channel(turned) == pytest.approx(channel(found), rel=1e-12)
    np.testing.assert_allclose(found, found.T, rtol=1e-12)
