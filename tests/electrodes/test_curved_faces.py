"""Discs and patches on the curved faces of shells: areas, positions, derivatives, and separation from the other
face."""

import jax
import numpy as np
import pytest

from jeit.electrodes import FaceDiscs, FacePatches
from jeit.mesh import shell, tube

RADIUS, THICKNESS, HEIGHT = 0.05, 0.004, 0.08
ANGLE = 0.37


def skin(cell_size, height=HEIGHT):
    return shell(tube(RADIUS - THICKNESS, height, cell_size=cell_size), THICKNESS, 1)


def spot(radius=RADIUS, height=HEIGHT):
    return np.array([radius * np.cos(ANGLE), radius * np.sin(ANGLE), 0.51 * height])


def disc_area(radius):
    """Area that a ball cuts out of a cylinder, |z| < √(r² − 4R² sin²(θ/2)), by Gauss quadrature in θ = α sin(πx/2)."""
    x, weight = np.polynomial.legendre.leggauss(200)
    widest = 2 * np.arcsin(radius / (2 * RADIUS))
    angle = widest * np.sin(np.pi * x / 2)
    half = np.sqrt(np.maximum(radius**2 - 4 * RADIUS**2 * np.sin(angle / 2) ** 2, 0))
    return RADIUS * np.sum(weight * widest * np.pi / 2 * np.cos(np.pi * x / 2) * 2 * half)


@pytest.mark.parametrize("ratio", [pytest.param(0.2, marks=pytest.mark.slow), 0.6])
def test_areas_of_discs_converge(ratio):
    """Discs that are small against the radius of the cylinder, and larger ones."""
    radius, errors = ratio * RADIUS, []
    for cell_size in (0.008, 0.004, 0.002):
        height = 2.4 * radius
        contact = FaceDiscs([spot(height=height)], radius, 1.0).contact(skin(cell_size, height))
        errors.append(abs(float(contact.load.sum()) / disc_area(radius) - 1))
    assert errors[0] < 1e-3
    assert errors[2] < errors[0] / 4  # at least of the order of the square of the cell size
    assert errors[2] < 5e-5
    # Relative to a flat disc the area is larger by (r / R)² / 24, or half of that.
    assert disc_area(radius) / (np.pi * radius**2) == pytest.approx(1 + ratio**2 / 32, abs=ratio**4 / 50)


def test_areas_of_patches_converge():
    """A plate 30 mm long round the cylinder, projected along its normal."""
    arc, errors = 0.03, []
    width = 2 * RADIUS * np.sin(arc / (2 * RADIUS))
    for cell_size in (0.008, 0.004, 0.002):
        contact = FacePatches([spot(height=0.03)], width, 0.02, 1.0).contact(skin(cell_size, 0.03))
        errors.append(abs(float(contact.load.sum()) / (arc * 0.02) - 1))
    assert errors[2] < 1e-3
    assert errors[2] < errors[0] / 4


@pytest.mark.parametrize("ratio", [0.2, 0.95])
def test_no_disc_reaches_the_other_face(ratio):
    """Discs of up to twelve times the thickness."""
    mesh = skin(0.005, 2.2 * RADIUS)
    inner = np.unique(np.asarray(mesh.facets)[np.asarray(mesh.tags["inner"])])
    electrodes = FaceDiscs([spot(height=2.2 * RADIUS)], ratio * RADIUS, 1.0)
    electrodes.check(mesh)
    load = np.asarray(electrodes.contact(mesh).load)[:, 0]
    assert np.abs(load[inner]).max() == 0
    assert load.sum() == pytest.approx(disc_area(ratio * RADIUS), rel=1e-3)
    own = FaceDiscs([spot(RADIUS - THICKNESS, 2.2 * RADIUS)], 0.2 * RADIUS, 1.0)
    load = np.asarray(own.contact(mesh).load)[:, 0]
    assert np.abs(np.delete(load, inner)).max() == 0


@pytest.mark.parametrize("kind", ["disc", "patch"])
def test_position_derivatives_by_taylor(kind):
    mesh = skin(0.005, 0.04)
    along = np.array([-np.sin(ANGLE), np.cos(ANGLE), 0.6])

    def at(step):
        place = (spot(height=0.04) + 1e-3 * step * along)[None]
        made = FaceDiscs(place, 0.012, 1.0) if kind == "disc" else FacePatches(place, 0.02, 0.015, 1.0)
        load = made.contact(mesh).load[:, 0]
        return (load @ mesh.points) / load.sum()

    moment = jax.jit(lambda step: jax.jvp(at, (step,), (1.0,)))
    base, slope = map(np.asarray, moment(0.0))
    np.testing.assert_allclose(base, at(0.0), rtol=0, atol=1e-12 * RADIUS, err_msg="NumPy finds the same")
    rest = [np.abs(np.asarray(moment(step)[0]) - base - step * slope).max() for step in (0.2, 0.1, 0.05)]
    assert rest[0] / rest[1] == pytest.approx(4, rel=0.3)
    assert rest[1] / rest[2] == pytest.approx(4, rel=0.3)
    # The middle of the covered area moves with the electrode, up to the resolution of the cells.
    np.testing.assert_allclose(slope, 1e-3 * along, atol=1.5e-4)


def test_a_compiled_batch_equals_numpy():
    mesh = skin(0.008, 0.05)
    radii = np.array([0.008, 0.012, 0.02])

    def load(radius):
        return FaceDiscs([spot(height=0.05)], radius, 2.0).contact(mesh).load

    each = np.stack([np.asarray(load(radius)) for radius in radii])
    np.testing.assert_allclose(jax.jit(jax.vmap(load))(radii), each, rtol=0, atol=1e-12 * each.max())
