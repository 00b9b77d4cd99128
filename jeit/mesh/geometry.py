"""Measures and P1 gradients of cells and facets: pure JAX, differentiable in the points."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.mesh.mesh import Mesh


def measures(mesh: Mesh) -> Float[Array, " m"]:
    """Area in m² (2-D) or volume in m³ (3-D) of every cell, (m,), positive for a valid mesh."""
    corners = mesh.points[mesh.cells]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        return 0.5 * _cross(edges[:, 0], edges[:, 1])
    return jnp.sum(jnp.cross(edges[:, 0], edges[:, 1]) * edges[:, 2], axis=-1) / 6.0


def gradients(mesh: Mesh) -> Float[Array, "m k d"]:
    """Gradients in 1/m of the d + 1 linear basis functions on every cell, (m, d + 1, d).

    φ_i is 1 at node i of the cell and 0 at the others, so with E the matrix of edges x_i − x_0 the
    gradients of φ_1 … φ_d are the columns of E⁻¹, and that of φ_0 is minus their sum. E⁻¹ is written out:
    cross products of edges over the determinant.
    """
    corners = mesh.points[mesh.cells]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        a, b = edges[:, 0], edges[:, 1]
        determinant = _cross(a, b)[:, None]
        others = jnp.stack([jnp.stack([b[:, 1], -b[:, 0]], -1), jnp.stack([-a[:, 1], a[:, 0]], -1)], axis=1)
    else:
        a, b, c = edges[:, 0], edges[:, 1], edges[:, 2]
        normal = jnp.cross(b, c)
        determinant = jnp.sum(a * normal, axis=-1)[:, None]
        others = jnp.stack([normal, jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    others = others / determinant[:, :, None]
    return jnp.concatenate([-jnp.sum(others, axis=1, keepdims=True), others], axis=1)


def centroids(mesh: Mesh) -> Float[Array, "m d"]:
    """Centre of gravity in metres of every cell, (m, d)."""
    return jnp.mean(mesh.points[mesh.cells], axis=1)


def facet_measures(mesh: Mesh) -> Float[Array, " b"]:
    """Length in m (2-D) or area in m² (3-D) of every boundary facet, (b,)."""
    corners = mesh.points[mesh.facets]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        return jnp.sqrt(jnp.sum(edges[:, 0] ** 2, axis=-1))
    return 0.5 * jnp.sqrt(jnp.sum(jnp.cross(edges[:, 0], edges[:, 1]) ** 2, axis=-1))


def facet_centroids(mesh: Mesh) -> Float[Array, "b d"]:
    """Centre in metres of every boundary facet, (b, d)."""
    return jnp.mean(mesh.points[mesh.facets], axis=1)


def boundary_arc_length(mesh: Mesh) -> Float[Array, " b"]:
    """Arc length in metres at which each boundary facet of a 2-D mesh starts, (b,).

    Counted along `mesh.facets`, counter-clockwise from the first node of the outer loop; facets of holes
    follow and go on counting. The perimeter is the sum of `facet_measures`.
    """
    if mesh.dimension != 2:
        raise ValueError("mesh: arc length is defined on the boundary of 2-D meshes only, this one is 3-D.")
    length = facet_measures(mesh)
    return jnp.cumsum(length) - length


def _cross(a: Float[Array, "m 2"], b: Float[Array, "m 2"]) -> Float[Array, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
