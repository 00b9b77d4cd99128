"""Every built-in plane mesh: conforming, accurate at its outline, of the requested size, and without angles below
25°."""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from jeit.mesh import Polygon, Refine, disk, polygon, quality, rectangle

L_SHAPE = [[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.2], [0, 0.2]]
EDGES = np.arange(32) * 2 * np.pi / 32
EDGE_POINTS = 0.1 * np.stack([np.cos(EDGES), np.sin(EDGES)], axis=1)


def areas(mesh):
    """Signed areas in NumPy, because `measures` would be compiled for every mesh."""
    a, b, c = (np.asarray(mesh.points)[np.asarray(mesh.cells)[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def lengths(mesh):
    """Lengths of the boundary facets in NumPy."""
    return np.linalg.norm(
        np.subtract(*(np.asarray(mesh.points)[np.asarray(mesh.facets)[:, k]] for k in (0, 1))), axis=1
    )


def check(mesh, holes=0, smallest=25.0):
    """Check angles, conformity (Euler characteristic) and orientation."""
    shape = quality(mesh)
    assert shape.smallest_angle.min() >= smallest - 1e-9
    cells, facets = np.asarray(mesh.cells), np.asarray(mesh.facets)
    edges = np.unique(np.sort(np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]), axis=1), axis=0)
    assert mesh.num_points - len(edges) + mesh.num_cells == 1 - holes
    assert 3 * mesh.num_cells == 2 * len(edges) - len(facets)
    assert (areas(mesh) > 0).all()
    return shape


@pytest.mark.parametrize("num_points", [7, 20, 50, 100, 331, 1200, 5000, pytest.param(20000, marks=pytest.mark.slow)])
def test_uniform_disks_of_rings(num_points):
    mesh = disk(0.1, num_points=num_points)
    assert check(mesh, smallest=35.0).smallest_angle.mean() > 45
    assert mesh.num_points == pytest.approx(num_points, rel=0.05, abs=2 if num_points < 60 else 0)
    on_circle = np.linalg.norm(np.asarray(mesh.points)[np.asarray(mesh.facets)[:, 0]], axis=1)
    np.testing.assert_allclose(on_circle, 0.1, rtol=1e-14)


# 30 nodes are too few for the long strips.
COMPACT, STRIPS = [(0.1, 0.1), (0.32, 0.2)], [(0.05, 0.4), (0.3, 0.03)]
RECTANGLES = [(*size, number) for size in COMPACT for number in (30, 300, 1200)]
RECTANGLES += [(*size, number) for size in STRIPS for number in (300, 1200)]
RECTANGLES += [pytest.param(*size, 10000, marks=pytest.mark.slow) for size in COMPACT + STRIPS]


@pytest.mark.parametrize(("width", "height", "num_points"), RECTANGLES)
def test_uniform_rectangles_of_rows(width, height, num_points):
    mesh = rectangle(width, height, num_points=num_points)
    assert check(mesh, smallest=30.0).smallest_angle.mean() > 43
    assert mesh.num_points == pytest.approx(num_points, rel=0.05 if num_points > 50 else 0.12)
    assert areas(mesh).sum() == pytest.approx(width * height, rel=1e-12)


@pytest.mark.parametrize("cell_size", [0.002, 0.01, 0.04, 1.0])
def test_requested_cell_size(cell_size):
    meshes = [disk(0.1, cell_size=cell_size), rectangle(0.2, 0.1, cell_size=cell_size)]
    for mesh in [*meshes, polygon(L_SHAPE, cell_size=cell_size) if cell_size > 0.005 else meshes[0]]:
        check(mesh)
        if cell_size < 0.02:
            # The edge of an equilateral triangle of the mean area.
            assert np.sqrt(areas(mesh).mean() * 4 / np.sqrt(3)) == pytest.approx(cell_size, rel=0.05)


def test_area_and_perimeter_of_the_disk_converge_at_second_order():
    sizes = np.array([100, 400, 1600, 6400])
    errors = np.array(
        [
            [1 - areas(mesh).sum() / np.pi, 1 - lengths(mesh).sum() / (2 * np.pi)]
            for mesh in (disk(1.0, num_points=int(n)) for n in sizes)
        ]
    )
    order = np.polyfit(np.log(1 / np.sqrt(sizes)), np.log(errors), 1)[0]
    np.testing.assert_allclose(order, 2.0, atol=0.1)
    # The inscribed N-gon is smaller by 2π²/(3N²), here N = 6 n / √(3 n).
    assert errors[-1, 0] < 6e-4


GRADED = {
    "electrode edges, gentle": {"num_points": 1200, "refine": Refine(EDGE_POINTS, factor=8, growth=0.4)},
    "electrode edges as nodes": {
        "num_points": 1200,
        "refine": Refine(EDGE_POINTS, factor=30, growth=0.6),
        "boundary_points": EDGES,
    },
    "electrode edges, steep": {"cell_size": 0.015, "refine": Refine(EDGE_POINTS, cell_size=2e-4, growth=0.8)},
    "steepest": {"cell_size": 0.02, "refine": Refine(EDGE_POINTS, cell_size=1e-4, growth=1.0)},
    "boundary": {"num_points": 1200, "refine": Refine(factor=5)},
    "boundary nodes": {"num_points": 1200, "num_boundary": 256},
    "two refinements": {
        "num_points": 1500,
        "refine": [Refine(factor=3), Refine([[0.02, 0.03]], factor=10, distance=0.01)],
    },
    "size function": {"refine": lambda p: 0.002 + 0.1 * np.linalg.norm(p, axis=1)},
    "jumping size function": {"num_points": 1000, "refine": lambda p: np.where(p[:, 0] > 0, 0.01, 0.001)},
    "close boundary nodes": {"cell_size": 0.02, "boundary_points": [0.0, 1.0, 1.001, 4.0]},
    "inner nodes": {"num_points": 500, "interior_points": [[0, 0], [0.01, 0], [0.05, 0.05], [0.0, -0.098]]},
}


# The steepest refinement represents gentler ones.
GENTLE = {"electrode edges, gentle", "electrode edges, steep"}
SLOW = GENTLE | {"boundary nodes", "two refinements", "jumping size function"}
CASES = [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in GRADED]


@pytest.mark.parametrize("name", CASES)
def test_graded_disks(name):
    options = GRADED[name]
    mesh = disk(0.1, **options)
    check(mesh)
    if "num_points" in options:
        assert mesh.num_points == pytest.approx(options["num_points"], rel=0.05)
    points = np.asarray(mesh.points)
    boundary = points[np.asarray(mesh.facets)[:, 0]]
    np.testing.assert_allclose(np.linalg.norm(boundary, axis=1), 0.1, rtol=1e-12)
    for angle in options.get("boundary_points", []):
        place = 0.1 * np.array([np.cos(angle), np.sin(angle)])
        assert np.linalg.norm(boundary - place, axis=1).min() < 1e-12
    for place in options.get("interior_points", []):
        assert np.linalg.norm(points - place, axis=1).min() < 1e-12


def test_requested_local_refinement():
    mesh = disk(0.1, cell_size=0.01, refine=Refine(EDGE_POINTS, cell_size=5e-4, growth=0.4))
    shape = quality(mesh)
    centre = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    apart = np.linalg.norm(centre[:, None] - EDGE_POINTS, axis=2).min(axis=1)
    wanted = np.minimum(0.01, 5e-4 + 0.4 * apart)
    ratio = 0.5 * (shape.shortest_edge + shape.longest_edge) / wanted
    assert ratio.mean() == pytest.approx(1.0, abs=0.1)
    assert 0.4 < ratio.min() < ratio.max() < 1.9


def test_number_of_boundary_nodes_is_exact():
    for number in (48, 256):
        mesh = disk(0.1, cell_size=0.02, num_boundary=number)
        assert mesh.num_facets == number
        length = lengths(mesh)
        np.testing.assert_allclose(length, length[0], rtol=1e-9)


@pytest.mark.parametrize("corner", [30, 35, 45, 59, 60, 75, 80, 89])
def test_triangles_with_sharp_corners(corner):
    apex = [0.1 * np.cos(np.radians(corner)), 0.1 * np.sin(np.radians(corner))]
    for cell_size in (0.03, 0.006):
        check(polygon([[0, 0], [0.1, 0], apex], cell_size=cell_size))


@pytest.mark.parametrize(
    ("vertices", "holes", "options"),
    [
        (L_SHAPE, [], {"num_points": 300}),
        (L_SHAPE, [], {"num_points": 1000, "refine": Refine([[0.1, 0.1]], factor=20)}),
        ([[0, 0], [0.2, 0], [0.2, 0.005], [0, 0.005]], [], {"cell_size": 0.03}),
        ([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], [[[0.04, 0.04], [0.06, 0.04], [0.05, 0.06]]], {"num_points": 600}),
        (
            [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]],
            [[[0.02, 0.02], [0.048, 0.03], [0.03, 0.05]], [[0.052, 0.03], [0.08, 0.05], [0.052, 0.06]]],
            {"cell_size": 0.01},
        ),
    ],
    ids=["L", "L graded", "thin strip", "hole", "two holes close together"],
)
def test_polygons(vertices, holes, options):
    mesh = polygon(vertices, holes=holes, **options)
    check(mesh, holes=len(holes))
    domain = Polygon(vertices, holes)
    assert areas(mesh).sum() == pytest.approx(float(domain.area), rel=1e-9)
    for vertex in np.concatenate([np.asarray(loop) for loop in (vertices, *holes)]):
        assert np.linalg.norm(np.asarray(mesh.points) - vertex, axis=1).min() < 1e-12
    if "num_points" in options:
        assert mesh.num_points == pytest.approx(options["num_points"], rel=0.05)


def test_graded_rectangle_keeps_its_tags_and_boundary_nodes():
    mesh = rectangle(0.3, 0.2, num_points=300, refine=Refine(factor=3), boundary_points=[0.1, 0.35])
    check(mesh)
    boundary = np.asarray(mesh.points)[np.asarray(mesh.facets)[:, 0]]
    for place in ([-0.05, -0.1], [0.15, -0.05]):
        assert np.linalg.norm(boundary - place, axis=1).min() < 1e-12
    for name, length in {"left": 0.2, "right": 0.2, "bottom": 0.3, "top": 0.3}.items():
        assert lengths(mesh)[np.asarray(mesh.tags[name])].sum() == pytest.approx(length, rel=1e-12)


def test_meshes_are_reproducible():
    first, second = (disk(0.1, num_points=150, refine=Refine(EDGE_POINTS, factor=5)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.cells, second.cells)


def test_neighbouring_nodes_have_near_numbers():
    for mesh in (disk(0.1, num_points=1000), disk(0.1, num_points=1000, num_boundary=200)):
        cells = np.asarray(mesh.cells)
        # All but node 0, which is kept at the start of the boundary.
        spread = np.ptp(cells[(cells != 0).all(axis=1)], axis=1)
        assert np.median(spread) < 5 * np.sqrt(mesh.num_points)


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    radii=st.sampled_from([3, 5, 8]).flatmap(lambda n: st.lists(st.floats(0.3, 1.0), min_size=n, max_size=n)),
    turn=st.floats(0, 6.28),
    cells=st.sampled_from([0.3, 0.1]),
)
def test_any_simple_outline(radii, turn, cells):
    angle = turn + 2 * np.pi * np.arange(len(radii)) / len(radii)
    vertices = np.asarray(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    before, after = np.roll(vertices, 1, axis=0) - vertices, np.roll(vertices, -1, axis=0) - vertices
    corner = np.degrees(
        np.mod(np.arctan2(after[:, 0] * before[:, 1] - after[:, 1] * before[:, 0], (after * before).sum(1)), 2 * np.pi)
    )
    assume(corner.min() >= 30)
    mesh = polygon(vertices, cell_size=cells)
    check(mesh)
    x, y = vertices.T
    assert areas(mesh).sum() == pytest.approx(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y), rel=1e-9)
    assert lengths(mesh).sum() == pytest.approx(np.linalg.norm(after, axis=1).sum(), rel=1e-9)
