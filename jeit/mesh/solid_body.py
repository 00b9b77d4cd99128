"""`Solid` and `OwnMesh`: bodies other than a plane outline."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind
from jeit.mesh.generate.refine import Refinement, nodes_of_solid
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Domain
from jeit.mesh.outline.domain import Body, check_length
from jeit.mesh.sizes import size_checked
from jeit_solvers.engines import as_array


class Solid(Body):
    """Solid that stands upright above a plane outline, from z = 0 up to `thickness`, metres: a tank, a box, a layer.

    `Solid(Disk(radius), height)` is a cylinder, `Solid(Rectangle(width, depth), height)` a box.
    """

    outline: Domain
    thickness: float

    def __init__(self, outline: Domain, thickness: float):
        """Raises `ValueError` for what is no outline, and a thickness that is not positive."""
        check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
        self.outline, self.thickness = outline, check_length("thickness", thickness)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box of the outline."""
        return self.outline.extent

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """None: electrodes on a solid do not follow each other along an edge."""
        return ()

    def describe(self) -> dict[str, Any]:
        """The outline, and the thickness."""
        return {**self.outline.describe(), "thickness": float(self.thickness)}

    @size_checked()
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """Layers of tetrahedra above a mesh of the outline, about as high as its cells are wide; see `jeit.mesh.box`.

        Tags: 'bottom', 'top', 'side', and those of the outline's mesh. Raises as `jeit.mesh.box`.
        """
        from jeit.mesh.solids import choose_layers, in_plane, layer

        number, layers = choose_layers(float(self.outline.area), self.thickness, num_points, cell_size, None)
        with nodes_of_solid(num_points, in_plane(float(self.outline.area), self.thickness, None)):
            plane = self.outline.mesh(num_points=number, cell_size=cell_size, refine=refine)
        return layer(plane, self.thickness, layers)


class OwnMesh(Body):
    """A body that comes as a mesh, and is imaged on it as it is."""

    given: Mesh

    def __init__(self, given: Mesh):
        """Raises `ValueError` for what is no mesh."""
        check_kind("given", given, Mesh, "a Mesh, such as jeit.mesh.read('tank.msh', scale=1e-3)")
        self.given = given

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box of the nodes."""
        points = np.asarray(self.given.points)[:, :2]
        (x_min, y_min), (x_max, y_max) = points.min(axis=0), points.max(axis=0)
        return float(x_min), float(x_max), float(y_min), float(y_max)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """The edges of a plane mesh; none of a solid one, or of a surface in space."""
        if self.given.space_dimension == 3:
            return ()
        points, facets = np.asarray(self.given.points), np.asarray(self.given.facets)
        begins = np.flatnonzero(facets[1:, 0] != facets[:-1, 1]) + 1  # facets follow each other, loop after loop
        return tuple(as_array(points[loop[:, 0]]) for loop in np.split(facets, begins))

    def describe(self) -> dict[str, Any]:
        """Dimension, nodes and cells."""
        return {
            "shape": "mesh",
            "dimension": self.given.dimension,
            **({"space_dimension": 3} if self.given.is_surface else {}),
            "points": self.given.num_points,
            "cells": self.given.num_cells,
        }

    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """The mesh itself, whatever is asked for."""
        return self.given


def as_body(given: Body | Mesh) -> Body:
    """A body, or a mesh as one. Raises `ValueError` for something else."""
    if isinstance(given, Mesh):
        return OwnMesh(given)
    check_kind("domain", given, Body, "an outline such as Disk(0.05), a Solid, or a Mesh")
    return given
