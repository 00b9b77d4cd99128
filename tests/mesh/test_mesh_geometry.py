"""Measures and P1 gradients: exact for linear functions, equal to finite differences, and valid in transformations."""

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.mesh import box, centroids, disk, gradients, layer, measures, polygon
from jeit.mesh.mesh import facet_measures

PLANE = polygon([[0, 0], [0.3, 0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.3], [0, 0.3]], cell_size=0.05)
SOLID = layer(disk(0.1, num_points=40), 0.03, 2)


@pytest.mark.parametrize("mesh", [PLANE, SOLID], ids=["2-D", "3-D"])
def test_gradients_of_a_linear_function_are_exact(mesh):
    slope = np.array([1.3, -0.7, 2.1])[: mesh.dimension]
    values = np.asarray(mesh.points) @ slope + 0.4
    gradient = np.einsum("mk,mkd->md", values[np.asarray(mesh.cells)], gradients(mesh))
    # Rounding is proportional to the inverse of the cell size (0.01 m).
    np.testing.assert_allclose(gradient, np.broadcast_to(slope, gradient.shape), atol=1e-12)
    np.testing.assert_allclose(np.asarray(gradients(mesh)).sum(axis=1), 0.0, atol=1e-11)


@pytest.mark.parametrize("mesh", [PLANE, SOLID], ids=["2-D", "3-D"])
def test_closed_surface_and_divergence_theorem(mesh):
    # ∮ n dS = 0 and ∮ x · n dS = d |Ω| hold only if every facet is there and points outward.
    corners = np.asarray(mesh.points)[np.asarray(mesh.facets)]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        normal = np.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1)
    else:
        normal = 0.5 * np.cross(edges[:, 0], edges[:, 1])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), facet_measures(mesh), rtol=1e-12)
    np.testing.assert_allclose(normal.sum(axis=0), 0.0, atol=1e-15)
    flux = np.sum(normal * np.asarray(mesh.points)[np.asarray(mesh.facets)].mean(axis=1))
    assert flux == pytest.approx(mesh.dimension * float(np.asarray(measures(mesh)).sum()), rel=1e-12)


def test_areas_and_volumes_by_formula():
    assert float(np.asarray(measures(PLANE)).sum()) == pytest.approx(0.05, rel=1e-13)
    solid = box(0.2, 0.1, 0.05, cell_size=0.03)
    assert float(np.asarray(measures(solid)).sum()) == pytest.approx(1e-3, rel=1e-13)
    assert float(np.asarray(facet_measures(solid)).sum()) == pytest.approx(2 * (0.02 + 0.01 + 0.005), rel=1e-13)
    moment = np.sum(np.asarray(measures(solid))[:, None] * np.asarray(centroids(solid)), axis=0)
    np.testing.assert_allclose(moment / 1e-3, [0.0, 0.0, 0.025], atol=1e-14)


@pytest.mark.parametrize("function", [measures, gradients, facet_measures, centroids])
@pytest.mark.parametrize("mesh", [PLANE, SOLID], ids=["2-D", "3-D"])
def test_derivatives_with_respect_to_points(mesh, function):
    direction, points = np.random.default_rng(0).normal(size=mesh.points.shape), np.asarray(mesh.points)

    def along(step):
        return function(eqx.tree_at(lambda m: m.points, mesh, points + step * direction))

    exact = np.asarray(jax.jit(lambda at: jax.jvp(along, (at,), (1.0,))[1])(0.0))
    difference = (np.asarray(along(1e-7)) - np.asarray(along(-1e-7))) / 2e-7
    # Central differences: truncation (step / cell size)² = 1e-10, rounding 1e-16 / 1e-7 times the condition.
    scale = float(np.abs(exact).max())
    np.testing.assert_allclose(difference, exact, atol=1e-6 * scale)


@pytest.mark.parametrize("function", [measures, gradients, facet_measures, centroids])
def test_a_compiled_batch_equals_a_loop(function):
    points = np.asarray(SOLID.points) + 1e-3 * np.random.default_rng(1).normal(size=(3, *SOLID.points.shape))

    def of(p):
        return function(eqx.tree_at(lambda m: m.points, SOLID, p))

    loop = np.stack([of(p) for p in points])
    scale = float(np.abs(loop).max())
    np.testing.assert_allclose(jax.jit(jax.vmap(of))(points), loop, rtol=0, atol=1e-13 * scale)
