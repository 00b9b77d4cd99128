"""Local mesh refinement by bisection, and meshes cut along surfaces."""

import numpy as np
import pytest

from jeit.mesh import bisect, bisection, box, centroids, cut, disk, measures, quality, sphere, tube


def finer(centre, radius, edge):
    """Refine to this edge length within a ball."""

    def size(corners):
        return np.where(np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < radius, edge, np.inf)

    return size


def longest(mesh):
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    return np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max(axis=(1, 2))


MESHES = {"disk": disk(1.0, num_points=200), "box": box(1.0, 1.0, 1.0, num_points=400)}


@pytest.mark.parametrize("name", MESHES)
def test_cells_have_the_requested_size_only_where_requested(name):
    """The mesh stays conforming (`Mesh.create` refuses others), keeps its measure, and keeps the quality of its
    cells."""
    mesh = MESHES[name]
    centre, edge = np.full(mesh.dimension, 0.4), 0.06
    found = bisect(mesh, finer(centre, 0.2, edge))
    distance = np.linalg.norm(np.asarray(centroids(found)) - centre, axis=1)
    assert longest(found)[distance < 0.2].max() <= edge
    np.testing.assert_allclose(np.sum(measures(found)), np.sum(measures(mesh)), rtol=1e-12)
    assert np.mean(longest(found)[distance > 0.55]) > 0.5 * np.mean(longest(mesh))
    assert np.min(quality(found).smallest_angle) > 0.45 * np.min(quality(mesh).smallest_angle)


def test_facets_keep_their_tags():
    mesh = MESHES["box"]
    found = bisect(mesh, finer([0.5, 0.5, 0.0], 0.3, 0.08))
    assert found.tags.keys() == mesh.tags.keys()
    for name, index in mesh.tags.items():
        assert area(found, found.tags[name]) == pytest.approx(area(mesh, index), rel=1e-12)
    assert len(found.tags["bottom"]) > 2 * len(mesh.tags["bottom"])


def area(mesh, index):
    a, b, c = np.moveaxis(np.asarray(mesh.points)[np.asarray(mesh.facets)[np.asarray(index)]], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("name", ["disk", pytest.param("box", marks=pytest.mark.slow)])
def test_a_cut_mesh_resolves_the_surface(name):
    mesh = MESHES[name]
    centre, radius = np.asarray(centroids(mesh)).mean(axis=0) + 0.03, 0.3

    def level(points):
        return np.linalg.norm(points - centre, axis=1) - radius

    errors = []
    for edge in (0.2, 0.1):
        found = cut(bisect(mesh, finer(centre, 0.45, edge)), level)
        value = level(np.asarray(found.points))
        value[np.abs(value) < 1e-8] = 0
        sides = np.sign(value)[np.asarray(found.cells)]
        assert (sides.min(axis=1) * sides.max(axis=1) >= 0).all()
        np.testing.assert_allclose(np.sum(measures(found)), np.sum(measures(mesh)), rtol=1e-12)
        within = np.asarray(measures(found))[level(np.asarray(centroids(found))) < 0].sum()
        exact = np.pi * radius**2 if name == "disk" else 4 / 3 * np.pi * radius**3
        errors.append(1 - within / exact)
    assert 0 < errors[1] < 0.4 * errors[0]  # chords enclose too little, by the square of their length
    assert errors[1] < 0.03


def test_surfaces_may_extend_beyond_the_body():
    mesh = MESHES["box"]
    found = cut(mesh, lambda points: points[:, 0] + 0.3 * points[:, 2] - 0.11)
    side = np.asarray(found.points) @ [1, 0, 0.3] - 0.11
    side[np.abs(side) < 1e-8] = 0
    within = np.sign(side)[np.asarray(found.cells)].min(axis=1) < 0
    assert np.asarray(measures(found))[within].sum() == pytest.approx(0.61 - 0.15, rel=1e-6)


def test_a_mesh_whose_facets_form_the_surface_is_left_as_it_is():
    def level(points):
        return np.round(points[:, 0] - 0.11, 8)

    once = cut(MESHES["disk"], level)
    again = cut(once, level)
    np.testing.assert_array_equal(again.points, once.points)
    np.testing.assert_array_equal(again.cells, once.cells)


@pytest.mark.parametrize("surface", [sphere(1.0, num_points=400), tube(0.5, 1.5, num_points=400)], ids=["ball", "tube"])
def test_meshes_of_surfaces_in_space_are_refined_and_cut(surface):
    edge = 0.08
    finer_there = bisect(surface, finer([0.5, 0.2, 0.1], 0.5, edge))
    found = cut(finer_there, lambda points: points[:, 0] - 0.21)
    np.testing.assert_allclose(np.sum(measures(finer_there)), np.sum(measures(surface)), rtol=1e-12)
    assert longest(finer_there).min() <= edge < longest(surface).min()
    side = np.asarray(found.points)[:, 0] - 0.21
    sides = np.sign(np.where(np.abs(side) < 1e-8, 0, side))[np.asarray(found.cells)]
    assert (sides.min(axis=1) * sides.max(axis=1) >= 0).all()


def test_more_nodes_than_can_be_indexed_are_refused(monkeypatch):
    monkeypatch.setattr(bisection, "MAX_POINTS", 1000)
    with pytest.raises(ValueError, match=r"size asks for more than 1,000 nodes; give longer"):
        bisect(MESHES["disk"], lambda corners: np.full(len(corners), 1e-6))


def test_invalid_input_is_refused():
    mesh = MESHES["disk"]
    with pytest.raises(ValueError, match=r"^mesh"):
        bisect(None, lambda corners: corners)  # pyright: ignore
    for wrong in (0.1, np.zeros(mesh.num_cells), np.full(mesh.num_cells, np.nan)):
        with pytest.raises(ValueError, match=r"size must give one number per cell, metres, above zero"):
            bisect(mesh, lambda corners, wrong=wrong: wrong)
    for sign in (-1.0, 1.0):
        with pytest.raises(ValueError, match=r"level has one sign at all nodes .* larger than a cell\?"):
            cut(mesh, lambda points, sign=sign: np.full(len(points), sign))
    with pytest.raises(ValueError, match=r"level must give one finite number per point"):
        cut(mesh, lambda points: np.full(len(points), np.nan))
