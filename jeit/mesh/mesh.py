"""`Mesh`: points, simplicial cells, boundary facets and named groups of facets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import brief, page, picture
from jeit.mesh import checks, topology
from jeit_solvers.engines import as_array, has_values
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
        return brief(
            lambda: (
                f"Mesh({self.num_points} nodes, {self.num_cells} cells, {self.dimension}-D"
                + (f", {len(self.tags)} groups of facets)" if self.tags else ")")
            ),
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return page(self)

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
        boundary facets, each given by the facets' nodes, (t, d) integers in any order, or by indices (t,) into the
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
        coordinates = checks.check_points(points) if has_values(points) else None
        num_points, space = np.shape(points if coordinates is None else coordinates)
        indices = checks.check_cells(cells, num_points, space)
        dimension = indices.shape[1] - 1
        if coordinates is not None:
            checks.check_coinciding(coordinates)
            indices = checks.orient(coordinates, indices)
        if space > dimension:
            from jeit.mesh import _surface

            indices = _surface.orient_surface(indices, coordinates)
        first, second, single_facets = topology.pair_facets(indices)
        checks.check_connected(first // (dimension + 1), second // (dimension + 1), len(indices))
        facets = topology.cell_facets(indices)[single_facets]
        if dimension == 2:
            facets = topology.order_loops(facets, coordinates) if len(facets) else facets
        located = checks.locate_tags(tags or {}, facets)
        return Mesh(
            points=as_array(points if coordinates is None else coordinates),
            cells=as_array(indices.astype(np.int32)),
            facets=as_array(facets.astype(np.int32)),
            tags={name: as_array(index.astype(np.int32)) for name, index in located.items()},
        )
