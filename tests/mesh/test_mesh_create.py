"""`Mesh.create`: orientation, boundary, tags, and meshes in JAX transformations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.mesh import Mesh, disk, measures, polygon, rectangle
from jeit.mesh.mesh import boundary_loops, facet_measures

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
HOLE = [[0.4, 0.4], [0.6, 0.4], [0.6, 0.6], [0.4, 0.6]]


@pytest.mark.parametrize("cells", [TWO_TRIANGLES, TWO_TRIANGLES[:, ::-1], [[0, 2, 1], [0, 2, 3]]])
def test_cells_are_oriented_counter_clockwise(cells):
    mesh = Mesh.create(SQUARE, cells)
    np.testing.assert_allclose(measures(mesh), 0.5)
    np.testing.assert_array_equal(mesh.facets, [[0, 1], [1, 2], [2, 3], [3, 0]])


def test_types_and_sizes():
    mesh = Mesh.create(SQUARE.tolist(), TWO_TRIANGLES.tolist())
    assert (mesh.dimension, mesh.num_points, mesh.num_cells, mesh.num_facets) == (2, 4, 2, 4)
    assert mesh.points.dtype == jnp.float64
    assert mesh.cells.dtype == mesh.facets.dtype == jnp.int32


def test_loops_are_ordered_outer_first_and_holes_clockwise():
    mesh = polygon(SQUARE, holes=[HOLE], cell_size=0.1)
    points, facets = np.asarray(mesh.points), np.asarray(mesh.facets)
    ends = np.flatnonzero(facets[1:, 0] != facets[:-1, 1]) + 1
    assert len(ends) == 1
    outer, hole = np.split(facets, ends)
    for loop, area in ((outer, 1.0), (hole, -0.04)):
        assert loop[-1, 1] == loop[0, 0] == loop.min()
        x, y = points[loop[:, 0]].T
        assert 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) == pytest.approx(area, rel=1e-12)


def test_every_boundary_edge_has_its_cell_on_the_left():
    mesh = polygon(SQUARE, holes=[HOLE], num_points=200)
    edges = {tuple(edge) for cell in np.asarray(mesh.cells) for edge in zip(cell, np.roll(cell, -1), strict=True)}
    assert all(tuple(facet) in edges and tuple(facet[::-1]) not in edges for facet in np.asarray(mesh.facets))


def test_tags_by_index_and_by_nodes_agree():
    by_index = Mesh.create(SQUARE, TWO_TRIANGLES, tags={"right": [1], "all": [3, 2, 1, 0]})
    by_nodes = Mesh.create(SQUARE, TWO_TRIANGLES, tags={"right": [[2, 1]], "all": [[0, 1], [1, 2], [2, 3], [3, 0]]})
    for name in ("right", "all"):
        np.testing.assert_array_equal(by_index.tags[name], by_nodes.tags[name])
    np.testing.assert_array_equal(by_index.tags["right"], [1])


def test_tetrahedron_has_outward_facets_for_either_orientation():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    for cell in ([0, 1, 2, 3], [0, 2, 1, 3]):
        mesh = Mesh.create(points, [cell])
        corners = points[np.asarray(mesh.facets)]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.sum(normal * (corners.mean(axis=1) - points.mean(axis=0)), axis=1) > 0).all()
        assert float(measures(mesh)[0]) == pytest.approx(1 / 6)


def test_boundary_starts_where_the_outline_does():
    assert np.asarray(disk(0.1, num_points=100).points)[0] == pytest.approx([0.1, 0.0], abs=1e-15)
    assert np.asarray(rectangle(0.2, 0.1, num_points=100).points)[0] == pytest.approx([-0.1, -0.05])
    assert np.asarray(polygon(SQUARE[[2, 3, 0, 1]], num_points=100).points)[0] == pytest.approx([1.0, 1.0])


def test_arc_length_counts_along_each_loop():
    mesh = polygon(SQUARE, holes=[HOLE], num_points=300)
    loop, arc = map(np.asarray, boundary_loops(mesh))
    assert loop[0] == loop.min()
    assert np.unique(loop).size == 2
    for number in np.unique(loop):
        length = np.asarray(facet_measures(mesh))[loop == number]
        np.testing.assert_allclose(arc[loop == number], np.concatenate([[0.0], np.cumsum(length)[:-1]]), rtol=1e-13)
    with pytest.raises(ValueError, match="2-D"):
        boundary_loops(Mesh.create(np.eye(4, 3), [[0, 1, 2, 3]]))


def test_a_mesh_is_a_pytree_for_jit_and_vmap():
    mesh = disk(0.1, num_points=50)
    scale = jnp.array([1.0, 2.0, 3.0])
    area = jax.jit(jax.vmap(lambda s: measures(eqx.tree_at(lambda m: m.points, mesh, s * mesh.points)).sum()))(scale)
    np.testing.assert_allclose(area, float(measures(mesh).sum()) * scale**2, rtol=1e-12)


def test_create_accepts_traced_points():
    mesh = disk(0.1, num_points=50)

    @jax.jit
    def total(points):
        return measures(Mesh.create(points, np.asarray(mesh.cells))).sum()

    assert float(total(mesh.points)) == pytest.approx(float(measures(mesh).sum()), rel=1e-14)
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda cells: Mesh.create(mesh.points, cells))(mesh.cells)


def test_large_coordinates_give_a_warning():
    with pytest.warns(UserWarning, match="millimetres"):
        Mesh.create(100 * SQUARE, TWO_TRIANGLES)
    with pytest.warns(UserWarning, match="millimetres"):
        disk(100.0, num_points=50)
