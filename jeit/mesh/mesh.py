"""`Mesh`: points, simplicial cells, boundary facets and named groups of facets; and measures, centroids, normals and P1
gradients of its cells and facets. These quantities are differentiable with respect to the points, and are computed by
NumPy unless JAX traces the points.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import object_html, object_text, picture
from jeit.mesh import checks, topology
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled
from jeit_solvers.module import Module


class Mesh(Module):
    """A conforming mesh of triangles in the plane or in space (2-D), or of tetrahedra (3-D).

    Create a mesh with functions such as `jeit.mesh.disk` or `jeit.mesh.read`, or from arrays with `Mesh.create`, which
    checks and orients them. All array fields are pytree leaves, so JAX can trace a mesh, batch over its points, and
    differentiate with respect to them.

    **Fields**: `points` (n, s): coordinates in metres, s = 2 or 3; `cells` (m, d + 1): node indices of the cells of
    dimension d, positively oriented; `facets` (b, d): boundary edges or triangles, oriented with the domain on the left
    (2-D) or with outward normals (3-D), and in 2-D ordered head to tail, one loop after the other, the outer loop
    first; `tags`: names of groups of facets, with their indices into `facets`. Triangles in space form a surface: they
    are counter-clockwise as seen from outside, and `facets` has shape (0, 2) if the surface is closed.

    **Example:**

    ```python
    square = Mesh.create([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    square.num_cells, square.points
    ```
    """

    points: Float[Array, "n s"]
    cells: Int[Array, "m k"]
    facets: Int[Array, "b d"]
    tags: dict[str, Int[Array, " t"]]

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Mesh({self.num_points} nodes, {self.num_cells} cells, {self.dimension}-D"
                + (f", {len(self.tags)} groups of facets)" if self.tags else ")")
            ),
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    @property
    def dimension(self) -> int:
        """Dimension of the cells: 2 for triangles, 3 for tetrahedra."""
        return self.cells.shape[1] - 1

    @property
    def space_dimension(self) -> int:
        """Number of coordinates per point, 2 or 3."""
        return self.points.shape[1]

    @property
    def is_surface(self) -> bool:
        """Whether the cells are triangles in space."""
        return self.space_dimension > self.dimension

    @property
    def num_points(self) -> int:
        """Number of nodes n."""
        return self.points.shape[0]

    @property
    def num_cells(self) -> int:
        """Number of cells m."""
        return self.cells.shape[0]

    @property
    def num_facets(self) -> int:
        """Number of boundary facets b."""
        return self.facets.shape[0]

    @staticmethod
    def create(points: ArrayLike, cells: ArrayLike, *, tags: Mapping[str, ArrayLike] | None = None) -> Mesh:
        """Create a `Mesh` from arrays: check them, orient the cells and find the boundary.

        **Arguments**: `points` (n, 2) or (n, 3): coordinates in metres; `cells`: zero-based node indices of triangles
        (m, 3), in the plane or in space, or of tetrahedra (m, 4), in either orientation; `tags`: names of groups of
        boundary facets, each specified by the facets' nodes, (t, d) integers in any order, or by indices (t,) into the
        resulting `facets`.

        In 2-D each loop of `facets` starts at its node of the lowest index; the outer loop runs counter-clockwise,
        holes clockwise. For a surface in space the longest loop comes first. The triangles of a closed surface are
        oriented outward. Those of an open surface all get the orientation that most of them have in the input. `points`
        may be traced by JAX. The coordinates are then not checked, and the cells must already be positively oriented.

        Raises `ValueError` if arrays have the wrong shape or type, or contain NaN or indices out of range; if the mesh
        has degenerate, duplicated or overlapping cells, unused or coincident nodes, facets shared by three cells, or
        several disconnected parts; and if a surface is one-sided, or touches or crosses itself. Warns if all triangles
        of a closed surface face inwards, and if the extent exceeds 10 m, which usually means that coordinates are in
        millimetres.
        """
        if not has_values(cells):
            raise ValueError(
                "cells: the boundary cannot be found from traced node indices. Create the mesh outside the "
                "transformed function and pass it in, or replace its points with equinox.tree_at."
            )
        checked_points = checks.check_points(points) if has_values(points) else None
        num_points, space_dimension = np.shape(points if checked_points is None else checked_points)
        checked_cells = checks.check_cells(cells, num_points, space_dimension)
        dimension = checked_cells.shape[1] - 1
        if checked_points is not None:
            checks.check_coinciding(checked_points)
            checked_cells = checks.orient(checked_points, checked_cells)
        if space_dimension > dimension:
            from jeit.mesh import _surface

            checked_cells = _surface.orient_surface(checked_cells, checked_points)
        first_facets, second_facets, facets_of_one_cell = topology.pair_facets(checked_cells)
        checks.check_connected(first_facets // (dimension + 1), second_facets // (dimension + 1), len(checked_cells))
        boundary_facets = topology.cell_facets(checked_cells)[facets_of_one_cell]
        if dimension == 2:
            boundary_facets = (
                topology.order_loops(boundary_facets, checked_points) if len(boundary_facets) else boundary_facets
            )
        located_tags = checks.locate_tags(tags or {}, boundary_facets)
        return Mesh(
            points=as_array(points if checked_points is None else checked_points),
            cells=as_array(checked_cells.astype(np.int32)),
            facets=as_array(boundary_facets.astype(np.int32)),
            tags={name: as_array(facet_indices.astype(np.int32)) for name, facet_indices in located_tags.items()},
        )


def check_flat(mesh: Mesh, what: str) -> None:
    """Raise `ValueError` for a surface in space.

    **Arguments:**

    - `mesh`: any mesh.
    - `what`: plural noun for the error message that names the objects that require a flat sheet or a solid, such as
      "rasters".

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


@numpy_or_compiled
def measures(mesh: Mesh) -> Float[Array, " m"]:
    """Area in m² (2-D) or volume in m³ (3-D) of every cell (m,); positive for a valid mesh.

    **Arguments:**

    - `mesh`: any mesh.

    **Example:**

    ```python
    area = measures(mesh).sum()
    ```
    """
    cell_corners = mesh.points[mesh.cells]
    edge_vectors = cell_corners[:, 1:] - cell_corners[:, :1]
    xp = namespace(mesh.points)
    if mesh.is_surface:
        return 0.5 * _vector_lengths(xp.cross(edge_vectors[:, 0], edge_vectors[:, 1]))
    if mesh.dimension == 2:
        return 0.5 * _cross_product(edge_vectors[:, 0], edge_vectors[:, 1])
    return xp.sum(xp.cross(edge_vectors[:, 0], edge_vectors[:, 1]) * edge_vectors[:, 2], axis=-1) / 6.0


@numpy_or_compiled
def gradients(mesh: Mesh) -> Float[Array, "m k s"]:
    """Gradients (m, d + 1, s), in 1/m, of the d + 1 linear basis functions on every cell, where d is the dimension of
    the cells and s the dimension of the space.

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
    cell_corners = mesh.points[mesh.cells]
    edge_vectors = cell_corners[:, 1:] - cell_corners[:, :1]
    if mesh.is_surface:
        a, b = edge_vectors[:, 0], edge_vectors[:, 1]
        cell_normals = xp.cross(a, b)
        squared_normals = xp.sum(cell_normals**2, axis=-1)[:, None]
        other_gradients = xp.stack([xp.cross(b, cell_normals), xp.cross(cell_normals, a)], axis=1)
    elif mesh.dimension == 2:
        a, b = edge_vectors[:, 0], edge_vectors[:, 1]
        squared_normals = _cross_product(a, b)[:, None]
        other_gradients = xp.stack([xp.stack([b[:, 1], -b[:, 0]], -1), xp.stack([-a[:, 1], a[:, 0]], -1)], axis=1)
    else:
        a, b, c = edge_vectors[:, 0], edge_vectors[:, 1], edge_vectors[:, 2]
        cell_normals = xp.cross(b, c)
        squared_normals = xp.sum(a * cell_normals, axis=-1)[:, None]
        other_gradients = xp.stack([cell_normals, xp.cross(c, a), xp.cross(a, b)], axis=1)
    other_gradients = other_gradients / squared_normals[:, :, None]
    # Explicit sum, because XLA converts a sum over such a short axis into a slow matrix product.
    first_gradient = -functools.reduce(operator.add, [other_gradients[:, k] for k in range(mesh.dimension)])
    return xp.concatenate([first_gradient[:, None], other_gradients], axis=1)


@numpy_or_compiled
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
    return _cell_normals(mesh)


@numpy_or_compiled
def _cell_normals(mesh: Mesh):
    xp = namespace(mesh.points)
    if not mesh.is_surface:
        return xp.broadcast_to(np.array([0.0, 0.0, 1.0], mesh.points.dtype), (mesh.num_cells, 3))
    cell_corners = mesh.points[mesh.cells]
    cell_normals = xp.cross(cell_corners[:, 1] - cell_corners[:, 0], cell_corners[:, 2] - cell_corners[:, 0])
    return cell_normals / _vector_lengths(cell_normals)[:, None]


@numpy_or_compiled
def facet_measures(mesh: Mesh) -> Float[Array, " b"]:
    """Length in m (2-D) or area in m² (3-D) of every boundary facet (b,)."""
    facet_corners = mesh.points[mesh.facets]
    edge_vectors = facet_corners[:, 1:] - facet_corners[:, :1]
    xp = namespace(mesh.points)
    if mesh.is_surface:
        return _vector_lengths(edge_vectors[:, 0])
    if mesh.dimension == 2:
        return xp.sqrt(edge_vectors[:, 0, 0] ** 2 + edge_vectors[:, 0, 1] ** 2)
    return 0.5 * xp.sqrt(xp.sum(xp.cross(edge_vectors[:, 0], edge_vectors[:, 1]) ** 2, axis=-1))


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
    facet_order = np.arange(mesh.num_facets)
    loop_numbers = xp.sum((facet_order <= facet_order[:, None]) & is_loop_start, axis=1)
    is_earlier = (facet_order < facet_order[:, None]) & (loop_numbers == loop_numbers[:, None])
    return loop_numbers, xp.sum(xp.where(is_earlier, facet_measures(mesh), 0), axis=1)


def interior_facets(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cells (f, 2) that share a facet, and the nodes (f, d) of that facet, as NumPy arrays.

    Raises `ValueError` for a mesh that is being traced by JAX.
    """
    if not has_values(mesh.cells):
        raise ValueError("interior_facets needs a mesh with values; call it outside jit and vmap.")
    cells = np.asarray(mesh.cells)
    first_facets, second_facets, _ = topology.pair_facets(cells)
    return np.stack([first_facets, second_facets], axis=1) // cells.shape[1], topology.cell_facets(cells)[first_facets]


def _vector_lengths(vectors):
    """Lengths (m,) of vectors (m, 3), with an explicit sum for XLA."""
    return namespace(vectors).sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2)


def _cross_product(a: Float[Array, "m 2"], b: Float[Array, "m 2"]) -> Float[Array, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
