"""Search for the cells of a skin within reach of a touch, by distance along the surface and depth below the surface
(NumPy)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.mesh import Mesh, centroids
from jeit.mesh.geodesic import Geodesics, Triangles

# Maximum distance of touched positions from the surface of a curved skin, relative to the skin's thickness, or for a
# sheet to the size of its cells.
_MAX_RELATIVE_DISTANCE = 0.5


class ReachedCells(NamedTuple):
    """Mesh cells of a skin within reach of n touches.

    **Fields**: `cells`: indices of the cells within reach of each touch; `distances`: distances of these cells'
    centroids from the position of the touch along the surface, metres; `centroid_depths` (m,): depth below the surface
    of the centroid of every cell of the mesh, metres; `thickness`: thickness of a layer, metres, None for a sheet.
    """

    cells: list[Int[np.ndarray, " c"]]
    distances: list[Float[np.ndarray, " c"]]
    centroid_depths: Float[np.ndarray, " m"]
    thickness: float | None


def is_curved(mesh: Mesh) -> bool:
    """Whether a mesh is that of a curved skin: a surface in space, or a shell on such a surface."""
    return mesh.is_surface or {"inner", "outer"} <= set(mesh.tags)


def touched_surface(mesh: Mesh, face: str = "outer") -> Triangles:
    """The touched surface of a curved skin: the sheet itself, or the face ("outer" or "inner") of a shell that `face`
    names."""
    return Triangles.of(mesh, None if mesh.is_surface else face)


def reached_cells(
    mesh: Mesh, places: Float[np.ndarray, "n d"], radius: float, max_depth: float, face: str = "outer"
) -> ReachedCells:
    """Find the cells whose centroids lie within `radius` metres of `places` along the surface of a skin, and less than
    `max_depth` metres below the surface.

    In a flat layer, depth is measured from its top, at the maximum z; in a shell, from its `face` along the inward
    normal. Raises `ValueError` for positions that are not on the surface of a curved skin.
    """
    cell_centroids = np.asarray(centroids(mesh))
    if is_curved(mesh):
        return _reached_cells_on_surface(mesh, cell_centroids, places, radius, max_depth, face)
    centroid_depths, thickness = np.zeros(len(cell_centroids)), None
    if mesh.dimension == 3:
        heights = np.asarray(mesh.points)[:, 2]
        centroid_depths, thickness = heights.max() - cell_centroids[:, 2], float(np.ptp(heights))
    candidates = np.flatnonzero(centroid_depths < max_depth)
    candidate_indices = KDTree(cell_centroids[candidates, :2]).query_ball_point(places, radius, return_sorted=True)
    cells = [candidates[np.asarray(indices, int)] for indices in candidate_indices]
    distances = [
        np.linalg.norm(cell_centroids[touch_cells, :2] - place, axis=-1)
        for touch_cells, place in zip(cells, places, strict=True)
    ]
    return ReachedCells(cells, distances, centroid_depths, thickness)


def _reached_cells_on_surface(
    mesh: Mesh, centroids, places, radius: float, max_depth: float, face: str
) -> ReachedCells:
    surface = touched_surface(mesh, face)
    thickness = None if mesh.is_surface else shell_thickness(mesh)
    max_distance = _MAX_RELATIVE_DISTANCE * (np.sqrt(surface.areas.max()) if thickness is None else thickness)
    surface_distances = surface.nearest(places).away
    invalid_places = np.flatnonzero(surface_distances > max_distance)
    if invalid_places.size:
        raise ValueError(
            f"places: {invalid_places.size} of {len(places)} lie off the skin's surface, the first, at "
            f"{millimetre_text(places[invalid_places[0]])} "
            f"mm, by {1e3 * surface_distances[invalid_places[0]]:.3g} mm; give places on the touched face, in metres, "
            "such as touch_grid(skin.outline).places."
        )
    nearest_points = surface.nearest(centroids)
    centroid_depths = np.zeros(len(centroids)) if mesh.is_surface else nearest_points.away
    candidates = np.flatnonzero(centroid_depths < max_depth)
    candidate_points = type(nearest_points)(
        nearest_points.triangle[candidates],
        nearest_points.weights[candidates],
        nearest_points.points[candidates],
        nearest_points.away[candidates],
    )
    indices_and_lengths = Geodesics.create(surface).near(places, candidate_points, radius)
    return ReachedCells(
        [candidates[indices] for indices, _ in indices_and_lengths],
        [lengths for _, lengths in indices_and_lengths],
        centroid_depths,
        thickness,
    )


def shell_thickness(mesh: Mesh) -> float:
    """Thickness of a shell, metres: the median distance of the nodes of its inner face from its outer face."""
    inner_points = Triangles.of(mesh, "inner").points
    return float(np.median(Triangles.of(mesh, "outer").nearest(inner_points).away))


def millimetre_text(place) -> str:
    """Format a position in metres as a text in millimetres, such as "(12, 3.5)"."""
    return "(" + ", ".join(f"{1e3 * value:.4g}" for value in place) + ")"
