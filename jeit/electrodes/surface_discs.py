"""Round electrodes in a sheet that is curved: discs on a surface of triangles in space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.electrodes.discs import (
    EDGE,
    AbstractDiscs,
    as_discs,
    check_discs,
    nearest_electrodes,
    squared_distances,
    triangle_quadrature,
    window_contact,
    window_within,
)
from jeit.electrodes.electrodes import Contact
from jeit.mesh import Body, Mesh, Refine, measures, normals
from jeit.mesh.geodesic import Triangles, unfold
from jeit_solvers.engines import has_values, namespace, on_host, undifferentiated, values_at_once

# Cosine of the angle between normals: a disc as large as the surface's radius of curvature turns by one radian.
_FACING = float(np.cos(1.0))


class SurfaceDiscs(AbstractDiscs):
    """Complete electrodes that are discs in a curved sheet, a surface of triangles in space, free of its nodes.

    `SheetDiscs` of curved sheets. Where the surface round its middle can be laid flat without stretching, as bent
    sheets and tubes can, a disc is the part of the surface within its radius along the surface: exactly, so that
    bending changes nothing. Elsewhere the ways by which triangles can be laid into a plane disagree, and a disc is the
    part of the surface within its radius straight through space that faces as its middle does: with a radius of
    curvature R longer along the surface by a part radius² / 24 R², and nothing of what lies opposite. Differentiable in
    position, of which only moves along the surface count: a move off it changes nothing to first order.

    **Fields**: `position` (L, 3) metres, on the surface; `radius` (L,) metres; `contact_impedance` (L,) ohm·m².
    """

    position: Float[Array, "L 3"]
    radius: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, radius: ArrayLike, contact_impedance: ArrayLike):
        """`radius` and `contact_impedance` may be one number for all electrodes. Raises `ValueError`."""
        self.position, self.radius, self.contact_impedance = as_discs(position, 3, radius, contact_impedance)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """None: they are not of a plane mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """The triangles of `mesh`."""
        return (mesh.cells,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the triangles, by quadrature of the windows."""
        xp = namespace(self, mesh)
        area = measures(mesh)
        barycentric, _ = triangle_quadrature()
        corners = mesh.points[mesh.cells]
        points = xp.einsum("pi,mid->mpd", barycentric, corners)
        edge = EDGE * xp.sqrt(area)
        middle = points.mean(axis=1)
        near = nearest_electrodes(middle, self.position, self.radius)
        longest = xp.sqrt(((corners - xp.roll(corners, 1, axis=1)) ** 2).sum(axis=-1).max(axis=1))
        around = unfold(mesh, self.position, self.radius[:, None] + edge + longest)
        normal = xp.asarray(undifferentiated(normals(mesh)))
        at = xp.argmin(undifferentiated(((self.position[:, None] - middle) ** 2).sum(axis=-1)), axis=1)
        along, faces = around.exact[near], xp.take_along_axis(normal @ normal[at].T, near, axis=1) > 0
        covered = xp.where(along, xp.take_along_axis(around.reached.T, near, axis=1), faces)
        squared = xp.where(
            along[..., None], around.squared(barycentric, near), squared_distances(points, self.position[near])
        )
        window = window_within(squared, self.radius[near], edge) * covered[..., None]
        return window_contact(mesh.cells, area, window, near, self.contact_impedance, mesh.num_points)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for discs off the surface, over its edge, as large as its radius of curvature,
        overlapping, or too small for the mesh."""
        if not mesh.is_surface:
            raise ValueError("SurfaceDiscs live on a surface in space, and this mesh is none; see jeit.mesh.tube.")
        if not has_values(self, mesh):
            return
        discs, mesh = on_host((self, mesh))
        check_on_surface(discs.position, discs.radius, Triangles.of(mesh))
        check_discs(discs, mesh, measures(mesh))


def check_on_surface(position, radius, surface: Triangles) -> None:
    """Raise `ValueError` for discs at `position` (L, 3) of `radius` (L,), metres, farther off the surface than they are
    large, over its edge, and as large as its radius of curvature."""
    position, radius = np.asarray(position), np.asarray(radius)
    at = surface.nearest(position)
    border = surface.distance_to_border(at.points)
    middles, normal = surface.corners.mean(axis=1), surface.normals
    for number, (place, size) in enumerate(zip(position, radius, strict=True)):
        x, y, z = 1e3 * place
        where = f"electrode {number + 1}, {2e3 * size:.3g} mm across at ({x:.4g}, {y:.4g}, {z:.4g}) mm,"
        if at.away[number] > size:
            raise ValueError(
                f"position: {where} is {1e3 * at.away[number]:.3g} mm off the surface, farther than its radius; move "
                "it onto the surface. Are both in metres?"
            )
        if border[number] < 0.9 * size:
            raise ValueError(
                f"position: {where} lies on the surface's edge, {1e3 * border[number]:.3g} mm from it; move it inside."
            )
        within = np.linalg.norm(middles - at.points[number], axis=1) < size
        turned = normal[within] @ normal[at.triangle[number]]
        if (np.abs(turned) < _FACING).any():
            raise ValueError(
                f"radius: {where} is larger than the surface's radius of curvature there; a disc so large is no disc, "
                "give less."
            )
