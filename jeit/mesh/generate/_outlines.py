"""How the built-in outlines are meshed: `shapes` and the domains' own `mesh` methods both end here."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jeit.mesh.generate import structured, unstructured
from jeit.mesh.generate.curve import Curve, circle, closed_line
from jeit.mesh.generate.refine import Refine, Refinement
from jeit.mesh.mesh import Mesh

if TYPE_CHECKING:
    from jeit.mesh.domain import Disk, Polygon, Rectangle


def mesh_disk(
    domain: Disk,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
    num_boundary: int | None = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """See `jeit.mesh.disk`."""
    middle = np.asarray(domain.centre)
    target = unstructured.Target.create(num_points, cell_size)
    if num_boundary is not None:
        num_boundary = unstructured.check_count("num_boundary", num_boundary, 3)
        if callable(refine):
            raise ValueError("num_boundary: cannot be combined with a size function; let the function give the size.")
        along = Refine(cell_size=domain.perimeter / num_boundary)
        others = () if refine is None else (refine,) if isinstance(refine, Refine) else tuple(refine)
        refine = (along, *others)
    if refine is None and boundary_points is None and interior_points is None:
        if target.cell_size is None:
            rings = structured.choose_rings(target.num_points)
        else:
            # Six nodes a ring: cells with legs t and π/3 t have the area of equilateral ones with edge 1.1 t.
            num_rings = max(1, round(1.1 * domain.radius / target.cell_size))
            rings = (num_rings, 6 * num_rings)
        unstructured.check_total(rings[0] * rings[1] // 2, "cell_size")
        points, cells = structured.ring_disk(*rings)
        return Mesh.create(middle + domain.radius * points, cells)
    stops = np.zeros(1)
    if boundary_points is not None:
        angles = unstructured.check_positions("boundary_points", boundary_points)
        stops = domain.radius * np.mod(angles, 2 * np.pi)
    curve = circle(domain.radius, middle)
    points, cells = unstructured.mesh([curve], [stops], interior_points, refine, target, domain.area)
    mesh = Mesh.create(points, cells)
    if num_boundary is not None and abs(mesh.num_facets - num_boundary) > 0.1 * num_boundary + np.size(stops):
        raise ValueError(
            f"num_boundary: cells of the size asked give {mesh.num_facets} nodes on the circle, not {num_boundary}. "
            "Ask for fewer nodes inside (num_points), larger cells, or more nodes on the circle."
        )
    return mesh


def mesh_rectangle(
    domain: Rectangle,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """See `jeit.mesh.rectangle`."""
    left, right, bottom, top = domain.extent
    target = unstructured.Target.create(num_points, cell_size)
    if refine is None and boundary_points is None and interior_points is None:
        rows = structured.choose_rows(domain.width, domain.height, target.num_points, target.cell_size)
        unstructured.check_total(rows[0] * rows[1], "cell_size")
        points, cells = structured.row_rectangle(domain.width, domain.height, *rows)
        points = points + np.array([left, bottom])
    else:
        curve = closed_line(np.asarray(domain.vertices))
        stops = _arc_lengths(curve, boundary_points)
        points, cells = unstructured.mesh([curve], [stops], interior_points, refine, target, domain.area)
    mesh = Mesh.create(points, cells)
    ends = np.asarray(mesh.points)[np.asarray(mesh.facets)]
    tolerance = 1e-9 * max(domain.width, domain.height)
    sides = {"left": (0, left), "right": (0, right), "bottom": (1, bottom), "top": (1, top)}
    tags = {
        name: jnp.asarray(np.flatnonzero((np.abs(ends[:, :, axis] - value) < tolerance).all(axis=1)), jnp.int32)
        for name, (axis, value) in sides.items()
    }
    return Mesh(mesh.points, mesh.cells, mesh.facets, tags)


def mesh_polygon(
    domain: Polygon,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """See `jeit.mesh.polygon`."""
    target = unstructured.Target.create(num_points, cell_size)
    curves = [closed_line(np.asarray(loop)) for loop in (domain.vertices, *domain.holes)]
    stops = [_arc_lengths(curves[0], boundary_points)] + [np.zeros(0)] * (len(curves) - 1)
    points, cells = unstructured.mesh(curves, stops, interior_points, refine, target, float(domain.area))
    return Mesh.create(points, cells)


def _arc_lengths(curve: Curve, positions: ArrayLike | None) -> np.ndarray:
    if positions is None:
        return np.zeros(0)
    return np.mod(unstructured.check_positions("boundary_points", positions), curve.length)
