"""Triangles in space: measures, gradients, orientation, edges, and faulty surfaces."""

import time

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jeit import protocol
from jeit.electrodes import BoundaryElectrodes, NodeElectrodes, PointElectrodes, SheetDiscs, plates
from jeit.forward import ForwardModel
from jeit.image import Raster
from jeit.mesh import Mesh, centroids, gradients, measures, normals, quality, rectangle
from jeit.mesh._surface import first_crossing
from jeit.mesh.mesh import boundary_loops, facet_measures

FLAT = rectangle(0.2, 0.1, num_points=200)
TURN = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
TURN = TURN * np.sign(np.linalg.det(TURN))
PLACES = np.random.default_rng(1).uniform([-0.08, -0.04], [0.08, 0.04], (8, 2))


def in_space(places):
    return np.column_stack([places, np.full(len(places), 0.03)]) @ TURN.T


PLATE = Mesh.create(in_space(np.asarray(FLAT.points)), FLAT.cells, tags={"left": FLAT.tags["left"]})
TETRAHEDRON = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
OUTWARD = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def ball(number, seed=0):
    points = np.random.default_rng(seed).normal(size=(number, 3))
    points *= 0.1 / np.linalg.norm(points, axis=1, keepdims=True)
    return points, ConvexHull(points).simplices


def strip(turns, count=24, width=0.02):
    """A closed strip with this number of half turns; with one, a Möbius strip."""
    angle = 2 * np.pi * np.arange(count) / count
    across = turns * angle / 2
    middle = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    out = np.stack([np.cos(across) * np.cos(angle), np.cos(across) * np.sin(angle), np.sin(across)], axis=1)
    low, high = np.arange(count), np.arange(count) + count
    nxt, above = np.roll(low, -1), np.roll(high, -1)
    if turns % 2:
        nxt[-1], above[-1] = above[-1], nxt[-1]
    cells = np.concatenate([np.stack([low, nxt, high], 1), np.stack([nxt, above, high], 1)])
    return np.concatenate([middle - width / 2 * out, middle + width / 2 * out]), cells


def test_a_plate_in_space_equals_the_plane_plate():
    assert (PLATE.dimension, PLATE.space_dimension, PLATE.is_surface) == (2, 3, True)
    assert (FLAT.dimension, FLAT.space_dimension, FLAT.is_surface) == (2, 2, False)
    np.testing.assert_array_equal(PLATE.cells, FLAT.cells)
    np.testing.assert_allclose(measures(PLATE), measures(FLAT), rtol=1e-12)
    np.testing.assert_allclose(facet_measures(PLATE), facet_measures(FLAT), rtol=1e-12)
    np.testing.assert_allclose(boundary_loops(PLATE)[1], boundary_loops(FLAT)[1], rtol=1e-12)
    np.testing.assert_allclose(gradients(PLATE) @ TURN[:, :2], gradients(FLAT), rtol=0, atol=1e-10 * 200)
    np.testing.assert_allclose(centroids(PLATE), in_space(np.asarray(centroids(FLAT))), atol=1e-15)
    np.testing.assert_allclose(normals(PLATE), np.broadcast_to(TURN[:, 2], (PLATE.num_cells, 3)), atol=1e-12)
    np.testing.assert_allclose(quality(PLATE).radius_ratio, quality(FLAT).radius_ratio, rtol=1e-10)
    np.testing.assert_array_equal(PLATE.tags["left"], FLAT.tags["left"])


def test_gradients_are_tangential_and_reproduce_linear_functions():
    mesh = Mesh.create(*ball(300))
    slope = np.array([1.0, -2.0, 0.5])
    values = np.asarray(mesh.points) @ slope
    found = np.einsum("mki,mk->mi", gradients(mesh), values[np.asarray(mesh.cells)])
    normal = np.asarray(normals(mesh))
    np.testing.assert_allclose(found, slope - normal * (normal @ slope)[:, None], atol=1e-9)
    np.testing.assert_allclose((np.asarray(centroids(mesh)) * normal).sum(axis=1) > 0, True)


def test_voltages_and_jacobian_of_a_plate_in_space():
    pattern = protocol.adjacent(8)
    flat = ForwardModel(FLAT, PointElectrodes(PLACES), pattern)
    plate = ForwardModel(PLATE, PointElectrodes(in_space(PLACES)), pattern)
    conductivity = np.exp(np.random.default_rng(2).normal(size=FLAT.num_cells))
    scale = float(np.abs(flat.voltages(conductivity)).max())
    np.testing.assert_allclose(plate.voltages(conductivity), flat.voltages(conductivity), atol=1e-11 * scale)
    np.testing.assert_allclose(plate.jacobian(conductivity), flat.jacobian(conductivity), atol=1e-11 * scale)
    # Tensors act in the plane of each triangle; their components across it do not matter.
    tensor = np.broadcast_to([[2.0, 0.3], [0.3, 0.7]], (FLAT.num_cells, 2, 2))
    turned = TURN[:, :2] @ tensor @ TURN[:, :2].T
    np.testing.assert_allclose(plate.voltages(turned), flat.voltages(tensor), atol=1e-11 * scale)
    with pytest.raises(ValueError, match="positive everywhere"):
        plate.voltages(turned - 3 * np.outer(TURN[:, 0], TURN[:, 0]))
    ends = plates(PLATE, ["left"], 0.01)
    np.testing.assert_allclose(ends.contact(PLATE).load.sum() * 0.01, 0.1, rtol=1e-12)


def test_derivatives_along_the_surface_by_taylor():
    """Where nodes, electrodes or conductivity change, and where all of them do."""
    points, cells = ball(120)
    mesh = Mesh.create(points, cells)
    places = np.asarray(centroids(mesh))[[3, 20, 40, 60, 80, 100]]
    model = ForwardModel(mesh, PointElectrodes(places), protocol.adjacent(6))
    rng = np.random.default_rng(3)
    ways = 1e-3 * rng.normal(size=points.shape), 1e-3 * rng.normal(size=places.shape), rng.normal(size=mesh.num_cells)

    def changed(size, ways):
        nodes, along, rise = (size * way for way in ways)
        moved = eqx.tree_at(lambda one: one.mesh.points, model, np.asarray(mesh.points) + nodes)
        return moved.with_electrodes(PointElectrodes(places + along)).voltages(1.0 + rise)

    compiled = jax.jit(lambda ways: jax.jvp(lambda size: changed(size, ways), (0.0,), (1.0,)))
    for chosen in ((1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)):
        some = tuple(on * way for on, way in zip(chosen, ways, strict=True))
        base, slope = map(np.asarray, compiled(some))
        rest = [float(np.abs(np.asarray(changed(e, some)) - base - e * slope).max()) for e in (1e-2, 5e-3)]
        assert rest[0] / rest[1] == pytest.approx(4, rel=0.1)


@pytest.mark.slow
def test_batches_of_surfaces_are_loops():
    model = ForwardModel(Mesh.create(*ball(120)), NodeElectrodes([3, 40, 60, 90]), protocol.adjacent(4))
    steps = 1e-3 * np.random.default_rng(4).normal(size=(3, 120, 3))

    def moved(step):
        return eqx.tree_at(lambda m: m.mesh.points, model, np.asarray(model.mesh.points) + step).voltages(1.0)

    each = np.stack([moved(step) for step in steps])
    np.testing.assert_allclose(jax.jit(jax.vmap(moved))(steps), each, rtol=0, atol=1e-10 * np.abs(each).max())


def test_orientation_of_neighbours_agrees_and_closed_surfaces_face_outward():
    points, cells = ball(500)
    rng = np.random.default_rng(5)
    mixed = np.where(rng.random(len(cells))[:, None] < 0.4, cells[:, ::-1], cells)
    mesh = Mesh.create(points, mixed)
    assert ((np.asarray(normals(mesh)) * np.asarray(centroids(mesh))).sum(axis=1) > 0).all()
    assert mesh.facets.shape == (0, 2)
    # An open surface keeps the orientation of most of its triangles.
    for side in (1, -1):
        given = np.asarray(PLATE.cells)[:, ::side].copy()
        given[:20] = given[:20, ::-1]
        open_one = Mesh.create(PLATE.points, given)
        np.testing.assert_allclose(normals(open_one), np.broadcast_to(side * TURN[:, 2], (len(given), 3)), atol=1e-12)


def test_inside_out_meshes_are_reported_and_turned():
    with pytest.warns(UserWarning, match="inside out"):
        mesh = Mesh.create(TETRAHEDRON, OUTWARD[:, ::-1])
    assert ((np.asarray(centroids(mesh)) - 0.025) * np.asarray(normals(mesh))).sum(axis=1).min() > 0


def test_a_strip_with_a_full_turn_is_a_surface():
    mesh = Mesh.create(*strip(2))
    starts = np.flatnonzero(np.asarray(mesh.facets)[1:, 0] != np.asarray(mesh.facets)[:-1, 1])
    assert len(starts) == 1  # two edges
    assert facet_measures(mesh)[: starts[0] + 1].sum() >= facet_measures(mesh)[starts[0] + 1 :].sum()


SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
TWO = [[0, 1, 2], [0, 2, 3]]
FAULTS = {
    "a T": (lambda: Mesh.create([*SQUARE, [0, 0, 0.1]], [*TWO, [0, 4, 2]]), "edge of nodes .0, 2.*not manifold.*T"),
    "Möbius": (lambda: Mesh.create(*strip(1)), "one side only.*Möbius"),
    "two balls in a node": (
        lambda: Mesh.create(
            np.concatenate([TETRAHEDRON, -TETRAHEDRON[1:]]), [*OUTWARD, *np.sign(OUTWARD) * 3 + OUTWARD]
        ),
        "touches itself at node 0",
    ),
    "two balls": (
        lambda: Mesh.create(np.concatenate([TETRAHEDRON, TETRAHEDRON + 1]), np.concatenate([OUTWARD, OUTWARD + 4])),
        "2 separate parts",
    ),
    "a sheet that touches itself in a node": (
        # A ring of eight triangles whose first and last corner are one.
        lambda: Mesh.create(*_pinched()),
        "touches itself at node 0",
    ),
    "a wall through a wall": (lambda: Mesh.create(*_crossing(0.01)), "crosses or touches itself: triangles"),
    "a wall that touches a wall": (lambda: Mesh.create(*_crossing(0.0)), "crosses or touches itself"),
    "a fan that goes through itself": (
        lambda: Mesh.create(
            0.1 * np.array([[0, 0, 0], [1, -1, 0], [1, 1, 0], [0.5, 0.2, 0.5], [0.5, 0, -0.5]]),
            [[0, 1, 2], [0, 2, 3], [0, 3, 4]],
        ),
        "triangles 0 and 2 meet",
    ),
    "folded flat": (
        lambda: Mesh.create([*SQUARE[:3], [0.08, 0.02, 0]], [[0, 1, 2], [0, 2, 3]]),
        "crosses or touches itself",
    ),
    "no area": (lambda: Mesh.create([*SQUARE, [0.05, 0, 0]], [*TWO, [0, 4, 1]]), "no area"),
    "discs on it": (lambda: SheetDiscs(PLACES, 0.01, 0.1).check(PLATE), "do not live on a surface in space"),
    "arcs on its edge": (
        lambda: BoundaryElectrodes(PLACES, 0.01, 0.1).check(PLATE),
        "do not live on a surface in space",
    ),
    "a point off it": (lambda: PointElectrodes(in_space(PLACES) + 0.02 * TURN[:, 2]).check(PLATE), "off the surface"),
    "points in the plane": (lambda: PointElectrodes(PLACES).check(PLATE), "2 coordinates and the mesh is in 3-D"),
    "a raster": (lambda: Raster.create(PLATE), "surface in space, and rasters are of flat"),
}


def _pinched():
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    low = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    high = low + np.array([0, 0, 0.05])
    high[4] = low[0] + [0.02, 0, 0.05]
    points = np.concatenate([low, high])
    first, second = np.arange(7), np.arange(7) + 8
    cells = np.concatenate([np.stack([first, first + 1, second], 1), np.stack([first + 1, second + 1, second], 1)])
    # The last lower node of the strip becomes its first.
    return np.delete(points, 7, axis=0), np.where(cells == 7, 0, np.where(cells > 7, cells - 1, cells))


def _crossing(below):
    """A sheet folded to a U, with one end bent back to and through the other leaf."""
    x = [0.0, 0.1, 0.1, 0.05]
    z = [0.0, 0.0, 0.05, -below]
    points = np.array([[a, y, b] for a, b in zip(x, z, strict=True) for y in (0.0, 0.1)])
    points[6:, 1] = (0.03, 0.07)
    cells = [[2 * k + a, 2 * k + b, 2 * k + c] for k in range(3) for a, b, c in ((0, 2, 1), (1, 2, 3))]
    return points, cells


@pytest.mark.parametrize("case", FAULTS)
def test_faults(case):
    make, match = FAULTS[case]
    with pytest.raises(ValueError, match=match):
        make()


def test_millimetres_and_inches_give_a_warning():
    with pytest.warns(UserWarning, match=r"millimetres.*inches.*scale="):
        Mesh.create(1000 * TETRAHEDRON, OUTWARD)


@pytest.mark.slow
def test_twenty_thousand_triangles_are_checked_in_seconds():
    points, cells = ball(10_000)
    begun = time.process_time()
    mesh = Mesh.create(points, cells)
    assert mesh.num_cells > 19_900
    assert time.process_time() - begun < 5  # 0.7 s on two cores


def test_intersections_are_detected_among_cells_of_all_sizes():
    """Two intersecting balls, joined by nothing but a distant seam, with large and small triangles."""
    points, cells = ball(800)
    small, other = ball(400, seed=7)
    both = np.concatenate([points, 0.02 * small + [0.1, 0, 0]])
    first, second = first_crossing(both, np.concatenate([cells, other + 800]))
    assert first < len(cells) <= second
    apart = np.concatenate([points, 0.02 * small + [0.15, 0, 0]])
    assert first_crossing(apart, np.concatenate([cells, other + 800])) is None
