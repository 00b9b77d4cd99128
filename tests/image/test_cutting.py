"""Sections and isosurfaces of solids: areas, volumes and positions against known values."""

import numpy as np
import pytest

from jeit.image import Plane, cut_by_plane, isosurface_of, node_values
from jeit.image.plane import crossed_cells, cut_above_level
from jeit.mesh import Mesh, box, centroids, cylinder, measures, rectangle

BOX = (0.17, 0.255, 0.17)


@pytest.fixture(scope="module")
def tank():
    return box(*BOX, num_points=3000)


@pytest.mark.parametrize(
    ("plane", "area"),
    [
        (Plane.at("z", 0.05), BOX[0] * BOX[1]),
        (Plane.at("z", BOX[2] / 2), BOX[0] * BOX[1]),
        (Plane.at("x", 0.013), BOX[1] * BOX[2]),
        (Plane.at("y", -0.1), BOX[0] * BOX[2]),
        # A section across the diagonal of two axes is longer by the inverse cosine.
        (Plane.through((0, 0, 0.085), (1, 0, 1)), np.sqrt(2) * BOX[2] * BOX[1]),
        # Along walls, seen from either side: the cells behind the wall are cut, once.
        (Plane.at("z", BOX[2]), BOX[0] * BOX[1]),
        (Plane.at("z", 0.0), BOX[0] * BOX[1]),
        (Plane.at("y", BOX[1] / 2), BOX[0] * BOX[2]),
    ],
)
def test_a_cut_has_the_area_of_the_section(tank, plane, area):
    assert cut_by_plane(tank, plane).area == pytest.approx(area, rel=1e-12)


def test_a_cut_through_nodes_contains_every_cell_once(tank):
    """In a layered mesh, all nodes of a layer lie in one plane."""
    z = np.unique(np.round(np.asarray(tank.points)[:, 2], 12))[3]
    cut = cut_by_plane(tank, Plane.at("z", float(z)))
    assert cut.area == pytest.approx(BOX[0] * BOX[1], rel=1e-12)
    assert len(set(cut.cell.tolist())) == len(cut.cell)


def test_a_cut_shows_the_cells_in_its_plane(tank):
    plane = Plane.at("x", 0.0123)
    cut = cut_by_plane(tank, plane)
    middle = cut.polygons[:, :3].mean(axis=1)
    places = np.column_stack([np.full(len(middle), 0.0123), middle])
    corners = np.asarray(tank.points)[np.asarray(tank.cells)[cut.cell]]
    local = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), (places - corners[:, 0])[..., None])
    assert min(local.min(), (1 - local.sum(axis=1)).min()) > -1e-9


def test_the_outline_is_that_of_the_section(tank):
    cut = cut_by_plane(tank, Plane.at("y", 0.02))
    length = np.linalg.norm(cut.outline[:, 1] - cut.outline[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * (BOX[0] + BOX[2]), rel=1e-12)
    assert cut.outline[..., 1].max() == pytest.approx(BOX[2])


def test_a_section_of_a_cylinder_is_its_polygon():
    tank = cylinder(0.075, 0.1, num_points=2000)
    base = cut_by_plane(tank, Plane.at("z", 0.031))
    assert base.area == pytest.approx(float(measures(tank).sum()) / 0.1, rel=1e-10)


@pytest.mark.parametrize(("axis", "right", "up"), [("x", "y", "z"), ("y", "x", "z"), ("z", "x", "y")])
def test_pages_show_the_other_axes_to_the_right_and_up(axis, right, up):
    plane, unit = Plane.at(axis, 0.1), dict(zip("xyz", np.eye(3), strict=True))
    np.testing.assert_array_equal(plane.right, unit[right])
    np.testing.assert_array_equal(plane.up, unit[up])
    assert plane.name == f"{axis} = 100 mm"


def test_pages_of_any_plane_are_orthonormal():
    plane = Plane.through((0.01, 0, 0.02), (1, 2, -3))
    page = np.stack([plane.right, plane.up, plane.toward])
    np.testing.assert_allclose(page @ page.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(page) == pytest.approx(1)
    assert plane.up[2] > 0
    np.testing.assert_allclose(Plane.through((0, 0, 0), (0, 0, 2)).up, Plane.at("z", 0.0).up)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane.at("w", 0.1), "axis must be"),
        (lambda: Plane.at("z", np.nan), "value must be"),
        (lambda: Plane.through((0, 0), (0, 0, 1)), "point must be three"),
        (lambda: Plane.through((0, 0, 0), (0, 0, 0)), "normal is zero"),
        (lambda: Plane.through((0, 0, 0), ("a", 0, 0)), "normal must be three"),
        (lambda: cut_by_plane(box(0.1, 0.1, 0.1, num_points=100), Plane.at("z", 50.0)), "misses the body"),
        (lambda: cut_by_plane(rectangle(0.1, 0.1, num_points=50), Plane.at("z", 0.0)), "plane mesh"),
        (lambda: cut_by_plane(box(0.1, 0.1, 0.1, num_points=100), "z"), "plane must be a Plane"),
    ],
)
def test_invalid_planes(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def ball(tank, radius, middle):
    """A function of the nodes whose isosurface at level 1 is a sphere."""
    return 1 + (radius - np.linalg.norm(np.asarray(tank.points) - middle, axis=1)) / radius


def test_enclosed_volume_converges_to_that_of_a_ball():
    error, sizes = [], [0.02, 0.01]
    for size in sizes:
        tank = box(0.1, 0.1, 0.1, cell_size=size)
        inside = isosurface_of(tank, ball(tank, 0.03, [0, 0, 0.05]), 1.0)
        error.append(abs(inside.enclosed / (4 / 3 * np.pi * 0.03**3) - 1))
        distance = np.linalg.norm(inside.points - [0, 0, 0.05], axis=1)
        assert np.abs(distance - 0.03).max() < 0.25 * size
    assert error[1] < 0.05
    assert np.log2(error[0] / error[1]) > 1.6  # second order


def closed(surface):
    """Whether every edge has a triangle on either side, with the same orientation."""
    triangles = surface.triangles
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    return len(there) == len(edges) and all((b, a) in there for a, b in there)


@pytest.mark.parametrize("sign", [1, -1])
def test_surfaces_are_closed_and_oriented_outward_at_the_wall_too(tank, sign):
    for middle in ([0.01, 0.02, 0.08], [0.085, 0, 0.1], [0.085, 0.1275, 0.17]):
        share = 0.5 ** sum(abs(abs(m) - w) < 1e-9 for m, w in zip(middle, [0.085, 0.1275, 0.17], strict=True))
        surface = isosurface_of(tank, sign * ball(tank, 0.05, middle), sign * 1.0)
        assert closed(surface)
        assert surface.enclosed == pytest.approx(share * 4 / 3 * np.pi * 0.05**3, rel=0.15)


def test_linear_values_are_cut_exactly(tank):
    values = 2 * np.asarray(tank.points)[:, 2] + 0.1
    above = isosurface_of(tank, values, 0.2)
    assert above.enclosed == pytest.approx(BOX[0] * BOX[1] * (BOX[2] - 0.05), rel=1e-12)


def test_an_image_below_the_level_has_no_surface(tank):
    assert len(isosurface_of(tank, np.zeros(tank.num_cells), 1.0).triangles) == 0
    assert isosurface_of(tank, np.zeros(tank.num_cells), 1.0).enclosed == 0


def test_cells_are_averaged_by_their_volume(tank):
    slope = 3 * np.asarray(centroids(tank))[:, 1]
    at_nodes, weight = node_values(tank, slope), np.asarray(measures(tank))
    node = 100
    round_it = (np.asarray(tank.cells) == node).any(axis=1)
    assert at_nodes[node] == pytest.approx(np.average(slope[round_it], weights=weight[round_it]), rel=1e-12)
    # Constant values stay constant.
    np.testing.assert_allclose(node_values(tank, np.full(tank.num_cells, 2.5)), 2.5, rtol=1e-13)


@pytest.mark.parametrize(
    ("values", "message"),
    [(np.zeros(3), "values has shape"), (None, "complex"), ("nan", "finite")],
)
def test_invalid_values(tank, values, message):
    made = {None: np.zeros(tank.num_cells, complex), "nan": np.full(tank.num_cells, np.nan)}
    with pytest.raises(ValueError, match=message):
        node_values(tank, made[values] if values is None or isinstance(values, str) else values)
    with pytest.raises(ValueError, match="level must be"):
        isosurface_of(tank, np.zeros(tank.num_cells), 0.0)


def test_every_section_of_a_tetrahedron():
    """Polygons for all sixteen combinations of signs at four nodes, against their areas in the unit tetrahedron."""
    points, cell = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])
    for number in range(16):
        signs = np.array([1.0 if number >> k & 1 else -1.0 for k in range(4)])
        pieces = crossed_cells(cell, signs)
        above = int((signs > 0).sum())
        assert len(pieces.cell) == (above in (1, 2, 3))
        if not len(pieces.cell):
            continue
        corners = pieces.at_corners(points)[0]
        edges = np.diff(corners, axis=0, append=corners[:1])
        lengths = np.linalg.norm(edges, axis=1)
        # Half way along edges: half the size of the facet opposite to one node, and a parallelogram between two pairs.
        assert (lengths < 1e-12).sum() == (0 if above == 2 else 1)
        if above == 2:
            np.testing.assert_allclose(edges[0], -edges[2], atol=1e-12)


def test_parts_of_a_surface_above_a_level():
    plane = rectangle(1.0, 1.0, num_points=200)
    points, triangles = np.asarray(plane.points), np.asarray(plane.cells)
    pieces = cut_above_level(triangles, points[:, 0], 0.2)
    corners = pieces.at_corners(points)
    x, y = corners[..., 0], corners[..., 1]
    area = 0.5 * np.abs((x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)).sum()
    assert area == pytest.approx(0.3, rel=1e-12)
    assert isinstance(plane, Mesh)
