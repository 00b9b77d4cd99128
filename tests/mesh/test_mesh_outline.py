"""Outlines: area, extent, interior, and boundary by arc length."""

import tracemalloc

import jax
import numpy as np
import pytest

from jeit.mesh import Disk, Polygon, Rectangle, quality
from jeit.mesh.outline import OUTLINES

L_SHAPE = [[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.2], [0, 0.2]]
HOLE = [[0.02, 0.02], [0.06, 0.02], [0.06, 0.06], [0.02, 0.06]]
DOMAINS = [Disk(0.1, (0.3, -0.2)), Rectangle(0.3, 0.2, (0.1, 0.05)), Polygon(L_SHAPE), Polygon(L_SHAPE, [HOLE])]
NAMES = ["disk", "rectangle", "polygon", "polygon with a hole"]


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_area_by_counting_points(domain):
    left, right, low, high = domain.extent
    x, y = np.meshgrid(np.linspace(left, right, 801), np.linspace(low, high, 801))
    fraction = np.mean(np.asarray(domain.contains(np.stack([x, y], axis=-1))))
    # A grid of 800² points counts an area to about its perimeter over 800.
    assert fraction * (right - left) * (high - low) == pytest.approx(float(domain.area), rel=5e-3)


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_boundary_runs_counter_clockwise_at_unit_speed_periodically(domain):
    perimeter = float(domain.perimeter)
    arc = np.linspace(0, perimeter, 4001)
    points = np.asarray(domain.boundary(arc))
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(perimeter, rel=1e-5)
    x, y = points[:-1].T
    enclosed = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    holes = 0.0016 if isinstance(domain, Polygon) and domain.holes else 0.0
    assert enclosed == pytest.approx(float(domain.area) + holes, rel=1e-4)
    np.testing.assert_allclose(domain.boundary(arc[7] + perimeter), points[7], atol=1e-12)
    np.testing.assert_allclose(domain.boundary(arc[7] - perimeter), points[7], atol=1e-12)


def test_start_of_the_boundary():
    np.testing.assert_allclose(Disk(0.1, (1.0, 2.0)).boundary(0.0), [1.1, 2.0])
    np.testing.assert_allclose(Disk(0.1).boundary(0.1 * np.pi / 2), [0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(
        Rectangle(0.2, 0.1).boundary(np.array([0.0, 0.2, 0.25])), [[-0.1, -0.05], [0.1, -0.05], [0.1, 0.0]], atol=1e-15
    )
    clockwise = Polygon([[0, 0], [0, 1], [1, 1], [1, 0]])
    np.testing.assert_allclose(clockwise.boundary(np.array([0.0, 0.5])), [[0, 0], [0.5, 0]])


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_boundary_derivative_is_the_unit_tangent(domain):
    tangent = jax.jit(jax.jacfwd(domain.boundary))(0.123 * float(domain.perimeter))
    assert float(np.linalg.norm(tangent)) == pytest.approx(1.0, rel=1e-12)


def test_derivative_with_respect_to_the_radius():
    slope = jax.jit(jax.grad(lambda radius: Disk(radius).boundary(0.0)[0]))(0.1)
    assert float(slope) == pytest.approx(1.0)


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_outlines_mesh_themselves(domain):
    mesh = domain.mesh(num_points=300)
    assert mesh.num_points == pytest.approx(300, rel=0.06)
    assert quality(mesh).smallest_angle.min() >= 25
    assert np.asarray(domain.contains(np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1))).all()


def _sampled(loop, every=5e-4):
    sides = np.roll(loop, -1, axis=0) - loop
    counts = np.ceil(np.linalg.norm(sides, axis=1) / every).astype(int)
    return np.concatenate(
        [start + side * np.arange(n)[:, None] / n for start, side, n in zip(loop, sides, counts, strict=True)]
    )


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_distances_and_nearest_places_agree_with_the_edge(domain):
    left, right, low, high = domain.extent
    x, y = np.meshgrid(np.linspace(left - 0.05, right + 0.05, 23), np.linspace(low - 0.05, high + 0.05, 19))
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    edge = np.concatenate([_sampled(np.asarray(loop)) for loop in domain.loops()])
    apart = np.linalg.norm(points[:, None] - edge, axis=-1).min(axis=1)
    distance, inside = np.asarray(domain.signed_distance(points)), np.asarray(domain.contains(points))
    # The edge is sampled every half a millimetre, which matters within a few millimetres of it.
    np.testing.assert_allclose(np.abs(distance), apart, atol=6e-4)
    clear = apart > 1e-3
    np.testing.assert_array_equal(distance[clear] > 0, inside[clear])
    nearest = np.asarray(domain.nearest(points))
    np.testing.assert_allclose(nearest[inside], points[inside], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1)[~inside], -distance[~inside], atol=1e-9)


@pytest.mark.parametrize("domain", DOMAINS, ids=NAMES)
def test_an_outline_is_rebuilt_from_its_description(domain):
    described = domain.describe()
    again = OUTLINES[described.pop("shape")](**described)
    assert type(again) is type(domain)
    for loop, wanted in zip(again.loops(), domain.loops(), strict=True):
        np.testing.assert_array_equal(loop, wanted)


@pytest.mark.slow
def test_many_vertices_are_compared_in_blocks():
    """A circle, a comb and a path through random points, simple or self-intersecting, in little memory."""
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    spikes = circle * np.where(np.arange(2000) % 2, 1, 0.001)[:, None]
    swapped = circle.copy()
    swapped[[1500, 1502]] = swapped[[1502, 1500]]
    tracemalloc.start()
    try:
        assert float(Polygon(circle).area) == pytest.approx(np.pi, rel=1e-5)
        Polygon(spikes)
        with pytest.raises(ValueError, match=r"side 1499 .* meets side 150[12]"):
            Polygon(swapped)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
