"""Meshes of plane outlines: `disk`, `rectangle`, `polygon`."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from jeit.mesh.generate.refine import Refinement
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Disk, Polygon, Rectangle


def disk(
    radius: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Refinement = None,
    num_boundary: int | None = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh of a disk of `radius` metres; its boundary nodes lie on the circle.

    Without refinement the mesh is made of concentric rings, and node 0 lies at angle 0. Otherwise it is
    unstructured, and node 0 is the first boundary node counter-clockwise from angle 0.

    **Arguments**: `num_points`, number of nodes, met within about 5 % (1,200 if nothing is said), or
    `cell_size`, edge length in metres; `centre` (x, y) in metres; `refine`, see `Refine`: one, several, or a function
    that takes points (p, 2) and returns the edge length wanted there (p,) in metres (with `num_points`, up to a common
    factor); `num_boundary`, number of nodes on the circle, cells growing from there inwards;
    `boundary_points`, angles in radians at which there must be nodes; `interior_points` (k, 2), places in metres
    at which there must be nodes.

    The mesh is the polygon inscribed in the circle: with N boundary nodes its area falls short by the fraction
    (2 π² / 3) / N². Every angle is at least 25°. Raises `ValueError` on bad or contradicting arguments.
    """
    return Disk(radius, centre).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        num_boundary=num_boundary,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )


def rectangle(
    width: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh of a rectangle of `width` (along x) by `height` (along y) metres.

    Without refinement the mesh is made of rows of nearly equilateral cells. Node 0 is the lower left corner. The sides
    are tagged 'left', 'right', 'bottom', 'top'. `boundary_points` are arc lengths in metres, counter-clockwise from
    the lower left corner; the other arguments are those of `disk`, and so are the errors.
    """
    return Rectangle(width, height, centre).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )


def polygon(
    vertices: ArrayLike,
    *,
    holes: Sequence[ArrayLike] = (),
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh of the inside of a simple polygon with `vertices` (k, 2) in metres, outside its `holes`.

    The vertices are nodes, the first of them node 0. Every angle is at least 25°, except the polygon's own sharper
    corners, each of which is cut off as one cell with two equal sides. `boundary_points` are arc lengths in metres
    along the outer outline, counter-clockwise from the first vertex; the other arguments are those of `disk`.

    Raises `ValueError` on an outline that is not simple, and on bad or contradicting arguments.
    """
    return Polygon(vertices, holes).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )
