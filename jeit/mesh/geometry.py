"""Measures, centroids, normals and P1 gradients of cells and facets. These quantities are differentiable with respect
to the points, and are computed by NumPy unless JAX traces the points."""

from __future__ import annotations

import functools
import operator

import numpy as np
from jaxtyping import Array, Float, Int

from jeit.mesh.mesh import Mesh
from jeit.mesh.topology import cell_facets, pair_facets
from jeit_solvers.engines import either_engine, has_values, namespace


def check_flat(mesh: Mesh, what: str) -> None:
    """Raise `ValueError` for a surface in space.

    **Arguments:**

    - `mesh`: any mesh.
    - `what`: plural noun in the error message for what requires a flat sheet or a solid, such as "rasters".

    **Example:**

    ```python
    check_flat(mesh, "rasters")
    ```
    """
    if mesh.is_surface:
        raise ValueError(
            f"mesh is a surface in space, and {what} are of flat sheets and solids; take the flat sheet that it was "
            "bent from, or a shell of it (jeit.mesh.shell)."
        )


@either_engine
def measures(mesh: Mesh) -> Float[Array, " m"]:
    """Area in m² (2-D) or volume in m³ (3-D) of every cell (m,); positive for a valid mesh.

    **Arguments:**

    - `mesh`: any mesh.

    **Example:**

    ```python
    area = measures(mesh).sum()
    ```
    """
    corners = mesh.points[mesh.cells]
    edges = corners[:, 1:] - corners[:, :1]
    xp = namespace(mesh.points)
    if mesh.is_surface:
        return 0.5 * _length(xp.cross(edges[:, 0], edges[:, 1]))
    if mesh.dimension == 2:
        return 0.5 * _cross(edges[:, 0], edges[:, 1])
    return xp.sum(xp.cross(edges[:, 0], edges[:, 1]) * edges[:, 2], axis=-1) / 6.0


@either_engine
def gradients(mesh: Mesh) -> Float[Array, "m k s"]:
    """Gradients (m, d + 1, s), in 1/m, of the d + 1 linear basis functions on every cell, where d is the dimension of
    the cells and s that of the space.

    φ_i is 1 at node i of the cell and 0 at its other nodes. With E the matrix of edges x_i − x_0, the gradients of φ_1
    … φ_d are the columns of E⁻¹, and the gradient of φ_0 is minus their sum. E⁻¹ is computed from cross products of
    edges divided by the determinant. On a triangle in space with edges a, b and normal n = a × b, the gradients lie in
    its plane: ∇φ_1 = b × n / |n|² and ∇φ_2 = n × a / |n|².

    **Arguments:**

    - `mesh`: any mesh.

    **Example:**

    ```python
    potential = mesh.points[:, 0]  # a potential that rises along x
    field = -np.einsum("mks,mk->ms", gradients(mesh), potential[mesh.cells])
    ```
    """
    xp = namespace(mesh.points)
    corners = mesh.points[mesh.cells]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.is_surface:
        a, b = edges[:, 0], edges[:, 1]
        normal = xp.cross(a, b)
        determinant = xp.sum(normal**2, axis=-1)[:, None]
        later_gradients = xp.stack([xp.cross(b, normal), xp.cross(normal, a)], axis=1)
    elif mesh.dimension == 2:
        a, b = edges[:, 0], edges[:, 1]
        determinant = _cross(a, b)[:, None]
        later_gradients = xp.stack([xp.stack([b[:, 1], -b[:, 0]], -1), xp.stack([-a[:, 1], a[:, 0]], -1)], axis=1)
    else:
        a, b, c = edges[:, 0], edges[:, 1], edges[:, 2]
        normal = xp.cross(b, c)
        determinant = xp.sum(a * normal, axis=-1)[:, None]
        later_gradients = xp.stack([normal, xp.cross(c, a), xp.cross(a, b)], axis=1)
    later_gradients = later_gradients / determinant[:, :, None]
    # Explicit sum, because XLA converts a sum over such a short axis into a slow matrix product.
    first_gradient = -functools.reduce(operator.add, [later_gradients[:, k] for k in range(mesh.dimension)])
    return xp.concatenate([first_gradient[:, None], later_gradients], axis=1)


@either_engine
def centroids(mesh: Mesh) -> Float[Array, "m s"]:
    """Centroid (m, s) of every cell, in metres.

    **Arguments:**

    - `mesh`: any mesh.

    **Example:**

    ```python
    right = centroids(mesh)[:, 0] > 0
    ```
    """
    return mesh.points[mesh.cells].mean(axis=1)


def normals(mesh: Mesh) -> Float[Array, "m 3"]:
    """Unit normals (m, 3) of the triangles of a surface in space; outward if the surface is closed.

    The normals of a plane mesh are (0, 0, 1). Raises `ValueError` for a solid, which has normals on its facets but not
    its cells.

    **Arguments:**

    - `mesh`: a surface in space, or a plane mesh.

    **Example:**

    ```python
    facing_up = normals(sleeve)[:, 2] > 0.5
    ```
    """
    if mesh.dimension != 2:
        raise ValueError("mesh: a solid's cells have no normals; take those of its surface, surface_of(mesh).")
    return _normals(mesh)


@either_engine
def _normals(mesh: Mesh):
    xp = namespace(mesh.points)
    if not mesh.is_surface:
        return xp.broadcast_to(np.array([0.0, 0.0, 1.0], mesh.points.dtype), (mesh.num_cells, 3))
    corners = mesh.points[mesh.cells]
    normal = xp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / _length(normal)[:, None]


@either_engine
def facet_measures(mesh: Mesh) -> Float[Array, " b"]:
    """Length in m (2-D) or area in m² (3-D) of every boundary facet (b,)."""
    corners = mesh.points[mesh.facets]
    edges = corners[:, 1:] - corners[:, :1]
    xp = namespace(mesh.points)
    if mesh.is_surface:
        return _length(edges[:, 0])
    if mesh.dimension == 2:
        return xp.sqrt(edges[:, 0, 0] ** 2 + edges[:, 0, 1] ** 2)
    return 0.5 * xp.sqrt(xp.sum(xp.cross(edges[:, 0], edges[:, 1]) ** 2, axis=-1))


def boundary_loops(mesh: Mesh) -> tuple[Int[Array, " b"], Float[Array, " b"]]:
    """For each boundary edge of a 2-D mesh, the number (b,) of the boundary loop that contains the edge, and the arc
    length (b,) in metres at the start of the edge.

    Arc length is measured along `mesh.facets` from the first node of each loop, counter-clockwise on the outer loop;
    the perimeter of a loop is the sum of its `facet_measures`. Raises `ValueError` for a 3-D mesh.
    """
    if mesh.dimension != 2:
        raise ValueError("mesh: arc length is defined on the boundary of 2-D meshes only, this one is 3-D.")
    xp = namespace(mesh)
    is_loop_start = xp.concatenate([xp.ones(1, bool), mesh.facets[1:, 0] != mesh.facets[:-1, 1]])
    # Sums over all pairs of facets, because XLA converts a cumulative sum into dozens of small operations.
    order = np.arange(mesh.num_facets)
    loop = xp.sum((order <= order[:, None]) & is_loop_start, axis=1)
    is_earlier = (order < order[:, None]) & (loop == loop[:, None])
    return loop, xp.sum(xp.where(is_earlier, facet_measures(mesh), 0), axis=1)


def interior_facets(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cells (f, 2) that share a facet, and the nodes (f, d) of that facet, as NumPy arrays.

    Raises `ValueError` for a mesh that is being traced by JAX.
    """
    if not has_values(mesh.cells):
        raise ValueError("interior_facets needs a mesh with values; call it outside jit and vmap.")
    cells = np.asarray(mesh.cells)
    first, second, _ = pair_facets(cells)
    return np.stack([first, second], axis=1) // cells.shape[1], cell_facets(cells)[first]


def _length(vectors):
    """Lengths (m,) of vectors (m, 3), with an explicit sum for XLA."""
    return namespace(vectors).sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2)


def _cross(a: Float[Array, "m 2"], b: Float[Array, "m 2"]) -> Float[Array, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
