"""`Mesh`: points, simplicial cells, boundary facets and named groups of facets."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.mesh import _checks, topology
from jeit_solvers.engines import as_array, has_values


class Mesh(eqx.Module):
    """A conforming mesh of triangles in the plane or in space (2-D), or of tetrahedra (3-D).

    Build one with `jeit.mesh.disk` and its siblings, `jeit.mesh.read`, or from raw arrays with
    `Mesh.create`, which checks and orients them. All array fields are pytree leaves, so a mesh can be
    traced, batched over its points, and differentiated with respect to them.

    **Fields**: `points` (n, s) in metres, s = 2 or 3; `cells` (m, d + 1) node indices, positively oriented;
    `facets` (b, d) boundary edges or triangles, oriented with the domain on the left (2-D) or the normal
    outward (3-D), and in 2-D ordered head to tail, loop after loop, the outer loop first; `tags` maps a
    name to indices into `facets`. Triangles in space are a surface: counter-clockwise as seen from outside, with edges
    (0, 2) where it is closed.
    """

    points: Float[Array, "n s"]
    cells: Int[Array, "m k"]
    facets: Int[Array, "b d"]
    tags: dict[str, Int[Array, " t"]]

    @property
    def dimension(self) -> int:
        """Dimension of the cells: 2 of triangles, 3 of tetrahedra."""
        return self.cells.shape[1] - 1

    @property
    def space_dimension(self) -> int:
        """Number of coordinates of a point, 2 or 3."""
        return self.points.shape[1]

    @property
    def is_surface(self) -> bool:
        """Whether these are triangles in space."""
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
        """Check raw arrays, orient the cells, find the boundary, and make a `Mesh`.

        **Arguments**: `points` (n, 2) or (n, 3) in metres; `cells` (m, 3) triangles, in the plane or in space, or
        (m, 4) tetrahedra: zero-based node indices in either orientation (clockwise cells are turned round); `tags` maps
        a name to boundary facets, given either as their nodes, (t, d) integers in any order, or as indices (t,) into
        the resulting `facets`.

        In 2-D each loop of `facets` starts at its lowest-numbered node; the outer loop runs
        counter-clockwise, holes clockwise; of a surface in space the longest loop comes first. A closed surface faces
        outward, an open one to the side that most of its triangles gave. `points` may be traced by JAX: the checks on
        values are then skipped and the cells are taken to be positively oriented already.

        Raises `ValueError` if the arrays have the wrong shape or type, hold NaN or indices out of range,
        or describe a mesh with degenerate, duplicated or overlapping cells, unused or coinciding nodes,
        facets shared by three cells, or several separate parts; a surface with one side only, or one that touches or
        crosses itself. Warns of a closed surface that came inside out, and if the extent exceeds 10 m, which
        almost always means millimetres.
        """
        if not has_values(cells):
            raise ValueError(
                "cells: the boundary cannot be found from traced node indices. Create the mesh outside the "
                "transformed function and pass it in, or replace its points with equinox.tree_at."
            )
        coordinates = _checks.check_points(points) if has_values(points) else None
        num_points, space = np.shape(points if coordinates is None else coordinates)
        indices = _checks.check_cells(cells, num_points, space)
        dimension = indices.shape[1] - 1
        if coordinates is not None:
            _checks.check_coinciding(coordinates)
            indices = _checks.orient(coordinates, indices)
        if space > dimension:
            from jeit.mesh import _surface

            indices = _surface.orient_surface(indices, coordinates)
        first, second, single = topology.pair_facets(indices)
        _checks.check_connected(first // (dimension + 1), second // (dimension + 1), len(indices))
        facets = topology.cell_facets(indices)[single]
        if dimension == 2:
            facets = topology.order_loops(facets, coordinates) if len(facets) else facets
        located = _checks.locate_tags(tags or {}, facets)
        return Mesh(
            points=as_array(points if coordinates is None else coordinates),
            cells=as_array(indices.astype(np.int32)),
            facets=as_array(facets.astype(np.int32)),
            tags={name: as_array(index.astype(np.int32)) for name, index in located.items()},
        )
