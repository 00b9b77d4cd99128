"""Measures and P1 gradients of cells and facets: pure JAX, differentiable in the points.

Compiled one by one, for outside of compiled code, op by op, their first calls would take a second.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jeit.mesh._topology import cell_facets, pair_facets
from jeit.mesh.mesh import Mesh


@jax.jit
def measures(mesh: Mesh) -> Float[Array, " m"]:
    """Area in m² (2-D) or volume in m³ (3-D) of every cell, (m,), positive for a valid mesh."""
    corners = mesh.points[mesh.cells]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        return 0.5 * _cross(edges[:, 0], edges[:, 1])
    return jnp.sum(jnp.cross(edges[:, 0], edges[:, 1]) * edges[:, 2], axis=-1) / 6.0


@jax.jit
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
    # Written out, for XLA makes a slow matrix product of a sum over so short an axis.
    first = -functools.reduce(jnp.add, [others[:, k] for k in range(mesh.dimension)])
    return jnp.concatenate([first[:, None], others], axis=1)


@jax.jit
def centroids(mesh: Mesh) -> Float[Array, "m d"]:
    """Centre of gravity in metres of every cell, (m, d)."""
    return jnp.mean(mesh.points[mesh.cells], axis=1)


@jax.jit
def facet_measures(mesh: Mesh) -> Float[Array, " b"]:
    """Length in m (2-D) or area in m² (3-D) of every boundary facet, (b,)."""
    corners = mesh.points[mesh.facets]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.dimension == 2:
        return jnp.sqrt(edges[:, 0, 0] ** 2 + edges[:, 0, 1] ** 2)
    return 0.5 * jnp.sqrt(jnp.sum(jnp.cross(edges[:, 0], edges[:, 1]) ** 2, axis=-1))


def boundary_loops(mesh: Mesh) -> tuple[Int[Array, " b"], Float[Array, " b"]]:
    """For each boundary facet of a 2-D mesh: the number of its loop, and the arc length in metres where it starts.

    Both (b,). Arc length counts along `mesh.facets` from the first node of each loop, counter-clockwise on the outer
    one; the perimeter of a loop is the sum of its `facet_measures`. Raises `ValueError` in 3-D.
    """
    if mesh.dimension != 2:
        raise ValueError("mesh: arc length is defined on the boundary of 2-D meshes only, this one is 3-D.")
    first = jnp.concatenate([jnp.ones(1, bool), mesh.facets[1:, 0] != mesh.facets[:-1, 1]])
    # Sums over all pairs of facets: XLA turns a cumulative sum into dozens of small operations.
    order = jnp.arange(mesh.num_facets)
    loop = jnp.sum((order <= order[:, None]) & first, axis=1)
    earlier = (order < order[:, None]) & (loop == loop[:, None])
    return loop, jnp.sum(jnp.where(earlier, facet_measures(mesh), 0), axis=1)


def interior_facets(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cells that share a facet, (f, 2), and the nodes of that facet, (f, d). NumPy; once per mesh.

    Raises `ValueError` for a mesh that is being traced.
    """
    if isinstance(mesh.cells, Tracer):
        raise ValueError("interior_facets needs a mesh with values; call it outside jit and vmap.")
    cells = np.asarray(mesh.cells)
    first, second, _ = pair_facets(cells)
    return np.stack([first, second], axis=1) // cells.shape[1], cell_facets(cells)[first]


def _cross(a: Float[Array, "m 2"], b: Float[Array, "m 2"]) -> Float[Array, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
