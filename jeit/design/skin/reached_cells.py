"""Search for the cells of a skin within reach of a touch, by distance along the surface and depth below it (NumPy)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.mesh import Mesh, centroids
from jeit.mesh.geodesic import Geodesics, Triangles

# Maximum distance of positions from the surface of a curved skin, relative to its thickness, or to the size of the
# cells of a sheet.
_MAX_OFF_SURFACE = 0.5


class ReachedCells(NamedTuple):
    """Cells within reach of n touches.

    **Fields**: `near`: indices of the cells of each touch; `distance`: distances of their centroids from the position
    of the touch along the surface, metres; `below` (m,): depth of the centroid of every cell of the mesh below the
    surface, metres; `thickness`: thickness of a layer, metres, None for a sheet.
    """

    near: list[Int[np.ndarray, " c"]]
    distance: list[Float[np.ndarray, " c"]]
    below: Float[np.ndarray, " m"]
    thickness: float | None


def is_curved(mesh: Mesh) -> bool:
    """Whether a mesh is a surface in space, or a shell on such a surface."""
    return mesh.is_surface or {"inner", "outer"} <= set(mesh.tags)


def touched_surface(mesh: Mesh, face: str = "outer") -> Triangles:
    """The touched surface of a curved skin: the sheet itself, or the `face` of a shell."""
    return Triangles.of(mesh, None if mesh.is_surface else face)


def reached_cells(
    mesh: Mesh, places: Float[np.ndarray, "n d"], radius: float, max_depth: float, face: str = "outer"
) -> ReachedCells:
    """Find the cells whose centroids lie within `radius` metres of `places` along the surface, and less than
    `max_depth` metres below it.

    In a flat layer, depth is measured from its top, at the maximum z; in a shell, from its `face` along the inward
    normal. Raises `ValueError` for positions that are not on a curved surface.
    """
    middle = np.asarray(centroids(mesh))
    if is_curved(mesh):
        return _reached_on_surface(mesh, middle, places, radius, max_depth, face)
    below, thickness = np.zeros(len(middle)), None
    if mesh.dimension == 3:
        height = np.asarray(mesh.points)[:, 2]
        below, thickness = height.max() - middle[:, 2], float(np.ptp(height))
    candidates = np.flatnonzero(below < max_depth)
    found = KDTree(middle[candidates, :2]).query_ball_point(places, radius, return_sorted=True)
    near = [candidates[np.asarray(index, int)] for index in found]
    distance = [np.linalg.norm(middle[own, :2] - place, axis=-1) for own, place in zip(near, places, strict=True)]
    return ReachedCells(near, distance, below, thickness)


def _reached_on_surface(mesh: Mesh, centroids, places, radius: float, max_depth: float, face: str) -> ReachedCells:
    surface = touched_surface(mesh, face)
    thickness = None if mesh.is_surface else shell_thickness(mesh)
    allowed = _MAX_OFF_SURFACE * (np.sqrt(surface.areas.max()) if thickness is None else thickness)
    off = surface.nearest(places).away
    lost = np.flatnonzero(off > allowed)
    if lost.size:
        raise ValueError(
            f"places: {lost.size} of {len(places)} lie off the skin's surface, the first, at "
            f"{millimetre_text(places[lost[0]])} "
            f"mm, by {1e3 * off[lost[0]]:.3g} mm; give places on the touched face, in metres, such as "
            "touch_grid(skin.outline).places."
        )
    at = surface.nearest(centroids)
    below = np.zeros(len(centroids)) if mesh.is_surface else at.away
    candidates = np.flatnonzero(below < max_depth)
    feet = type(at)(at.triangle[candidates], at.weights[candidates], at.points[candidates], at.away[candidates])
    found = Geodesics.create(surface).near(places, feet, radius)
    return ReachedCells([candidates[index] for index, _ in found], [length for _, length in found], below, thickness)


def shell_thickness(mesh: Mesh) -> float:
    """Thickness of a shell, metres: the median distance of the nodes of its inner face from its outer face."""
    inner = Triangles.of(mesh, "inner").points
    return float(np.median(Triangles.of(mesh, "outer").nearest(inner).away))


def millimetre_text(place) -> str:
    """Text of a position in millimetres: "(12, 3.5)"."""
    return "(" + ", ".join(f"{1e3 * value:.4g}" for value in place) + ")"
