"""Plates on meshes refined for them: exact integrals, and voltages that converge as the mesh is refined at their
edges."""

import numpy as np
import pytest

from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.electrodes.facets import _clipped_moments, covered_moments
from jeit.forward import ForwardModel
from jeit.mesh import Disk, Rectangle, Solid, layer, measures, rectangle
from jeit.protocol import adjacent


def test_moments_of_a_clipped_triangle_by_sampling():
    rng = np.random.default_rng(0)
    corners, half = rng.normal(size=(50, 3, 2)), rng.uniform(0.2, 1.5, size=(50, 2))
    once, twice = covered_moments(corners, half)
    step = (np.arange(300) + 0.5) / 300
    first, second = (index.ravel() for index in np.meshgrid(step, step))
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)  # points to be weighted with 2 first
    for triangle, size, single, double in zip(corners, half, once, twice, strict=True):
        inside = 2 * first * (np.abs(weights @ triangle) <= size).all(axis=1) / len(first)
        assert single == pytest.approx(inside @ weights, abs=3e-3)
        assert double == pytest.approx((weights.T * inside) @ weights, abs=3e-3)
    assert twice.sum(axis=-1) == pytest.approx(once, abs=1e-9)


def test_triangles_inside_and_outside_of_a_rectangle_need_not_be_clipped():
    corners = np.random.default_rng(1).normal(size=(500, 3, 2))
    for got, clipped in zip(covered_moments(corners, np.ones(2)), _clipped_moments(corners, np.ones(2)), strict=True):
        np.testing.assert_allclose(got, clipped, atol=1e-7)  # thin triangles are rounded when clipped
    assert 20 < (np.abs(corners) <= 1).all(axis=(1, 2)).sum() < 100


def test_moments_of_a_whole_triangle():
    corners = np.array([[0.0, 0.0], [0.3, 0.1], [0.1, 0.4]])
    once, twice = covered_moments(corners, np.array([1.0, 1.0]))
    assert once == pytest.approx(np.full(3, 1 / 3), rel=1e-12)
    assert twice == pytest.approx((np.ones((3, 3)) + np.eye(3)) / 12, rel=1e-12)


def plated_box():
    body = Solid(Rectangle(0.17, 0.255), 0.17)
    places = [[x, y, z] for x in (-0.085, 0.085) for y in (-0.06, 0.06) for z in (0.04, 0.13)]
    places += [[x, y, 0.17] for x in (-0.04, 0.04) for y in (-0.06, 0.06)]
    return body, FacePatches(places, 0.07, 0.07, 1e-3)


def test_mesh_edges_follow_the_plates():
    body, plates = plated_box()
    mesh = body_mesh(body, plates, 3000)
    assert 2300 < mesh.num_points < 3700
    assert measures(mesh).sum() == pytest.approx(0.17 * 0.255 * 0.17, rel=1e-12)
    areas = np.asarray(plates.contact(mesh).load).sum(axis=0) * 1e-3
    assert areas == pytest.approx(np.full(12, 0.07**2), rel=1e-12)
    x, y, z = np.asarray(mesh.points).T
    for axis, ends in ((x, 0.075), (y, 0.025), (z, 0.165)):
        assert np.abs(axis - ends).min() < 1e-12
    assert set(mesh.tags) == {"left", "right", "front", "back", "bottom", "top", "side"}


@pytest.mark.parametrize(
    "numbers", [(1000, 2000, 4000), pytest.param((2000, 6000, 16000), marks=pytest.mark.slow)], ids=str
)
def test_plates_converge_on_graded_meshes(numbers):
    """Relative to the finest mesh, the error is less than 15 % on the coarsest and 8 % on a finer one. Uniform meshes
    have twice that error."""
    body, plates = plated_box()

    def impedance(mesh):
        return np.asarray(ForwardModel(mesh, plates, adjacent(12)).transfer_impedance(0.024))

    few, more, most = numbers
    fine = impedance(body_mesh(body, plates, most))
    meshes = [body_mesh(body, plates, few), body_mesh(body, plates, more), body.mesh(num_points=more)]
    coarse, finer, alike = (np.linalg.norm(impedance(mesh) - fine) / np.linalg.norm(fine) for mesh in meshes)
    assert coarse < 0.15
    assert finer < min(0.08, 0.7 * coarse)
    assert alike > 2 * finer


def test_strips_on_a_cylinder_end_at_nodes():
    body, angle = Solid(Disk(0.15), 0.2), 2 * np.pi * np.arange(8) / 8
    places = np.column_stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.full(8, 0.1)])
    strips = FacePatches(places, 0.03, 0.15, 1e-3)
    mesh = body_mesh(body, strips, 4000)
    assert 2500 < mesh.num_points < 6000
    ends = np.arctan2(0.015, np.sqrt(0.15**2 - 0.015**2))
    rim = np.arctan2(np.asarray(mesh.points)[:, 1], np.asarray(mesh.points)[:, 0])
    assert np.abs(rim - ends).min() < 0.01
    areas = np.asarray(strips.contact(mesh).load).sum(axis=0) * 1e-3
    assert areas == pytest.approx(np.full(8, 0.03 * 0.15), rel=0.03)


def test_heights_that_do_not_increase_are_refused():
    with pytest.raises(ValueError, match="heights"):
        layer(rectangle(1.0, 1.0, num_points=9), 1.0, heights=[0.0, 0.6, 0.5, 1.0])
