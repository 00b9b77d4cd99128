"""`Solid` and `OwnMesh`: bodies that are not plane outlines."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind
from jeit.mesh.checks import size_checked
from jeit.mesh.generate.refine import Refinement, nodes_of_solid
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Domain
from jeit.mesh.outline.domain import Body, check_length
from jeit_solvers.engines import as_array


class Solid(Body):
    """An upright solid above a plane outline, from z = 0 to `thickness` metres: a tank, a box, a layer.

    `Solid(Disk(radius), height)` is a cylinder, `Solid(Rectangle(width, depth), height)` a box.

    **Arguments:**

    - `outline`: outline of the base.
    - `thickness`: height in metres, positive.

    **Example:**

    ```python
    tank = Solid(Disk(0.14), 0.05)
    tank.mesh(num_points=800)
    ```
    """

    outline: Domain
    thickness: float

    def __init__(self, outline: Domain, thickness: float):
        """Raises `ValueError` if `outline` is not an outline, or the thickness is not positive."""
        check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
        self.outline, self.thickness = outline, check_length("thickness", thickness)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box of the outline, (x_min, x_max, y_min, y_max) in metres."""
        return self.outline.extent

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Empty, because a solid, unlike a plane body, has no boundary loops."""
        return ()

    def describe(self) -> dict[str, Any]:
        """Shape and sizes of the outline, and the thickness, in metres."""
        return {**self.outline.describe(), "thickness": float(self.thickness)}

    @size_checked()
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """Mesh the solid with layers of tetrahedra that are about as high as the cells of the outline's mesh are wide.

        The mesh has the tags 'bottom', 'top', 'side', and the tags of the outline's mesh. Raises `ValueError` as
        `jeit.mesh.box` does.
        """
        from jeit.mesh.solids import choose_layers, count_of_base_nodes, layer

        num_base_points, num_layers = choose_layers(
            float(self.outline.area), self.thickness, num_points, cell_size, None
        )
        with nodes_of_solid(num_points, count_of_base_nodes(float(self.outline.area), self.thickness, None)):
            base_mesh = self.outline.mesh(num_points=num_base_points, cell_size=cell_size, refine=refine)
        return layer(base_mesh, self.thickness, num_layers)


class OwnMesh(Body):
    """A body defined by an existing mesh, which is used without remeshing.

    **Arguments:**

    - `given`: the mesh.

    **Example:**

    ```python
    body = OwnMesh(mesh)
    body.extent
    ```
    """

    given: Mesh

    def __init__(self, given: Mesh):
        """Raises `ValueError` if `given` is not a mesh."""
        check_kind("given", given, Mesh, "a Mesh, such as jeit.mesh.read('tank.msh', scale=1e-3)")
        self.given = given

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box of the nodes seen from above, (x_min, x_max, y_min, y_max) in metres."""
        points = np.asarray(self.given.points)[:, :2]
        (x_min, y_min), (x_max, y_max) = points.min(axis=0), points.max(axis=0)
        return float(x_min), float(x_max), float(y_min), float(y_max)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the boundary loops of a plane mesh; empty for a solid, and for a surface in space."""
        if self.given.space_dimension == 3:
            return ()
        points, facets = np.asarray(self.given.points), np.asarray(self.given.facets)
        # Facets are ordered head to tail, loop by loop.
        loop_starts = np.flatnonzero(facets[1:, 0] != facets[:-1, 1]) + 1
        return tuple(as_array(points[loop_facets[:, 0]]) for loop_facets in np.split(facets, loop_starts))

    def describe(self) -> dict[str, Any]:
        """Dimensions of the mesh, and numbers of its nodes and cells."""
        return {
            "shape": "mesh",
            "dimension": self.given.dimension,
            **({"space_dimension": 3} if self.given.is_surface else {}),
            "points": self.given.num_points,
            "cells": self.given.num_cells,
        }

    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """Return the stored mesh; all arguments are ignored."""
        return self.given


def as_body(mesh_or_body: Body | Mesh) -> Body:
    """Convert a mesh to a body; a body is returned unchanged. Raises `ValueError` for an argument that is neither a
    body nor a mesh."""
    if isinstance(mesh_or_body, Mesh):
        return OwnMesh(mesh_or_body)
    check_kind("domain", mesh_or_body, Body, "an outline such as Disk(0.05), a Solid, or a Mesh")
    return mesh_or_body
