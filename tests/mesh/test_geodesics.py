"""Geodesic distances against great circles, unrolled cylinders and cones; and flattened surfaces."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from jeit.mesh import Rectangle, bend, forearm, shell, sphere, tube
from jeit.mesh.geodesic import Geodesics, Triangles, unroll

RADIUS = 0.03


def on_cylinder(number: int, height: float, seed: int = 0):
    angle, z = np.random.default_rng(seed).uniform([[0], [0]], [[2 * np.pi], [height]], (2, number))
    return np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z], axis=1), angle, z


def along_cylinder(angle, z):
    turn = np.abs(angle[:, None] - angle)
    return np.hypot(RADIUS * np.minimum(turn, 2 * np.pi - turn), z[:, None] - z)


@pytest.mark.slow
def test_great_circles_on_5000_nodes():
    mesh = sphere(0.05, num_points=5000)
    places = np.random.default_rng(1).normal(size=(10, 3))
    places *= 0.05 / np.linalg.norm(places, axis=1, keepdims=True)
    found = Geodesics.create(mesh).between(places)
    exact = 0.05 * np.arccos(np.clip(places @ places.T / 0.05**2, -1, 1))
    far = exact > 0.005
    error = np.abs(found - exact)[far] / exact[far]
    assert error.max() < 0.01
    assert np.median(error) < 5e-4


def test_convergence_to_great_circles():
    ways = []
    for number in (300, 1200, 4800):
        mesh = sphere(0.05, num_points=number)
        lengths = Geodesics.create(mesh).distances(np.asarray(mesh.points)[:1])[0]
        exact = 0.05 * np.arccos(np.clip(np.asarray(mesh.points) @ np.asarray(mesh.points)[0] / 0.05**2, -1, 1))
        near = (exact > 0.01) & (exact < 0.12)
        ways.append(np.abs(lengths - exact)[near].max())
    assert ways[2] < ways[1] / 1.8 < ways[0] / 3.2
    assert ways[2] < 1e-4  # metres, of up to 120 mm


def test_distances_on_cylinders():
    places, angle, z = on_cylinder(14, 0.15)
    mesh = tube(RADIUS, 0.15, num_points=2000)
    found, exact = Geodesics.create(mesh).between(places), along_cylinder(angle, z)
    far = exact > 0.003
    error = np.abs(found - exact)[far] / exact[far]
    assert error.max() < 0.01
    assert np.quantile(error, 0.95) < 1e-3


def test_orientation_of_triangles_does_not_matter():
    mesh = tube(RADIUS, 0.12, num_points=1500)
    points, ways = np.asarray(mesh.points), Geodesics.create(mesh)
    start = points[[np.argmin(np.linalg.norm(points - [RADIUS, 0, 0.06], axis=1))]]
    begin = np.arctan2(start[0, 1], start[0, 0])
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = begin + 0.04 / RADIUS * np.cos(turn)
    height = start[0, 2] + 0.04 * np.sin(turn)
    ends = np.stack([RADIUS * np.cos(around), RADIUS * np.sin(around), height], axis=1)
    lengths = ways.distances(start, ends)[0]
    assert np.ptp(lengths) < 2e-3 * 0.04
    edges = np.unique(np.sort(np.asarray(mesh.cells)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    size = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = csr_array((size, edges.T), shape=(len(points), len(points)))
    first = int(np.argmin(np.linalg.norm(points - start[0], axis=1)))
    nodes = ways.distances(start)[0]
    by_edges = dijkstra(graph, directed=False, indices=first)
    assert (nodes <= by_edges + 1e-12).all()
    assert (nodes >= 0.8 * by_edges).all()


def test_distances_on_cones():
    mesh = forearm(0.2, 0.025, 0.045, num_points=2000)
    apex, flat = unroll(mesh), Geodesics.create(mesh)
    angle = np.array([0.3, 0.9, 1.4])
    z = np.array([0.05, 0.11, 0.16])
    radius = 0.025 + 0.1 * z
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    laid = apex.flat(places)
    exact = np.linalg.norm(laid[:, None] - laid, axis=-1)
    slant = np.hypot(1, 0.1) * radius / 0.1  # distance from the apex, and the angle to which a turn unrolls
    turned = np.abs(angle[:, None] - angle) * 0.1 / np.hypot(1, 0.1)
    cone = np.sqrt(slant[:, None] ** 2 + slant**2 - 2 * slant[:, None] * slant * np.cos(turned))
    np.testing.assert_allclose(exact, cone, atol=1e-4)
    np.testing.assert_allclose(flat.between(places), cone, atol=1e-4)
    assert apex.distortion < 1e-4


def test_distances_on_a_bent_sheet_equal_those_on_the_flat_one():
    sheet = Rectangle(0.1, 0.1).mesh(num_points=600)
    bent = bend(sheet, RADIUS)
    points = np.asarray(bent.points)
    ways = Geodesics.create(bent)
    chosen = points[[3, 100, 250, 400, 550]]
    laid = unroll(bent)
    flat = laid.flat(chosen)
    np.testing.assert_allclose(ways.between(chosen), np.linalg.norm(flat[:, None] - flat, axis=-1), rtol=1e-3)
    assert laid.distortion < 1e-9
    assert not len(laid.seam)


def test_places_at_nodes_on_edges_and_on_faces_of_shells():
    mesh = shell(tube(RADIUS, 0.1, num_points=900), 0.01, 2)
    for face, radius in (("inner", RADIUS), ("outer", RADIUS + 0.01)):
        ways = Geodesics.create(mesh, face)
        nodes = ways.surface.points[:5]
        assert np.isfinite(ways.between(nodes)).all()
        ends = np.array([[radius, 0, 0.05], [-radius, 0, 0.05]])
        assert ways.between(ends)[0, 1] == pytest.approx(np.pi * radius, rel=0.01)


def test_limits_and_nearest_neighbours():
    places, _, _ = on_cylinder(30, 0.1, seed=3)
    ways = Geodesics.create(tube(RADIUS, 0.1, num_points=1500))
    full = ways.distances(places, places)
    limited = ways.distances(places, places, limit=0.04)
    within = full < 0.039
    np.testing.assert_allclose(limited[within], full[within], rtol=1e-9)
    assert np.isinf(limited[full > 0.041]).all()
    at = ways.surface.nearest(places)
    for row, (index, own) in enumerate(ways.near(places, at, 0.04)):
        np.testing.assert_allclose(own, full[row, index], rtol=1e-9)
        assert set(np.flatnonzero(full[row] < 0.0399)) <= set(index)


def test_places_off_the_surface_are_refused():
    ways, on = Geodesics.create(tube(RADIUS, 0.1, num_points=300)), [[RADIUS, 0, 0.05]]
    assert np.isfinite(ways.distances([[1.04 * RADIUS, 0, 0.05]], on)).all()
    assert np.isfinite(ways.distances([[1.3 * RADIUS, 0, 0.05]], on)).all()  # across a thick skin
    message = (
        r": 1 of 1 lie off the surface, the first, at \[5\.0, 0\.0, 0\.0\] m, by 4\.9\d+e\+03 mm; give places on it"
    )
    with pytest.raises(ValueError, match="^sources" + message):
        ways.distances([[5.0, 0, 0]], on)
    with pytest.raises(ValueError, match="^targets" + message):
        ways.distances(on, [[5.0, 0, 0]])


def test_distortion_of_surfaces_that_are_not_developable():
    flat = unroll(sphere(0.05, num_points=300))
    assert flat.mean_distortion > 0.05
    oval = unroll(forearm(0.2, (0.02, 0.03), (0.045, 0.035), num_points=600))
    assert 1e-5 < oval.mean_distortion < 0.005
    assert len(oval.seam)


def test_other_meshes_are_refused():
    with pytest.raises(ValueError, match="mesh is plane"):
        Triangles.of(Rectangle(0.1, 0.1).mesh(num_points=100))
    with pytest.raises(ValueError, match="face: the mesh has the tags"):
        Triangles.of(shell(tube(RADIUS, 0.1, num_points=300), 0.005, 1), "middle")
