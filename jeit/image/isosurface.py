"""Surfaces on which an image of a solid has one value, closed by the wall where they meet it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.arguments import is_number, told
from jeit.image.marching import part_above, passed
from jeit.image.plane import check_solid
from jeit.mesh import Mesh, measures


@dataclass(frozen=True)
class TriangleSurface:
    """A surface of triangles in space: `points` (n, 3) metres, `triangles` (m, 3) into them, with normals outward."""

    points: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "m 3"]

    @property
    def enclosed(self) -> float:
        """The volume enclosed by a closed surface, m³."""
        a, b, c = (
            np.swapaxes(self.points[self.triangles] - self.points.mean(axis=0), 0, 1)
            if len(self.points)
            else np.zeros((3, 0, 3))
        )
        return float(np.sum(a * np.cross(b, c)) / 6)


def node_values(mesh: Mesh, image: Float[np.ndarray, "..."]) -> Float[np.ndarray, " n"]:
    """An image at the nodes (n,): of values per cell (m,) the mean of the cells round each node, weighted by their
    measure; values per node as they are. Raises `ValueError` for another shape, complex values and NaN."""
    values = np.asarray(image)
    if values.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {values.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(values):
        raise ValueError("values are complex; take their real or imaginary part.")
    if not np.isfinite(values).all():
        raise ValueError("values must be finite to be drawn.")
    if values.shape == (mesh.num_points,):
        return values.astype(float)
    cells, weight = np.asarray(mesh.cells), np.asarray(measures(mesh))
    corners = cells.shape[1]
    total = np.bincount(cells.ravel(), np.repeat(weight * values, corners), mesh.num_points)
    return total / np.bincount(cells.ravel(), np.repeat(weight, corners), mesh.num_points)


def isosurface_of(mesh: Mesh, values: Float[np.ndarray, "..."], level: float) -> TriangleSurface:
    """The closed surface round where an image exceeds `level`, or for a negative level falls below it.

    `values` (m,) per cell, which are averaged to nodes first, or (n,) per node; linear in between. Where the region
    touches the wall, the wall closes it. Without triangles where the image does not get there. Raises `ValueError` for
    a level that is zero or no number, and as `node_values`.
    """
    check_solid(mesh)
    if not is_number(level) or level == 0:
        raise ValueError(f"level must be a value of the image, above or below zero; it is {told(level)}.")
    sign = 1.0 if level > 0 else -1.0
    height = sign * node_values(mesh, values) - abs(level)
    points = np.asarray(mesh.points)
    inner, wall = passed(np.asarray(mesh.cells), height), part_above(np.asarray(mesh.facets), height)
    ends, share = np.concatenate([inner.ends, wall.ends]), np.concatenate([inner.share, wall.share])
    # One point for each edge passed and each node of the wall, whichever cells share it.
    ends = np.where(
        ((share == 0) | (share == 1))[..., None], np.where(share == 1, ends[..., 1], ends[..., 0])[..., None], ends
    )
    share = np.where(ends[..., 0] == ends[..., 1], 0.0, share)
    low = ends.min(axis=-1).astype(np.int64)
    key = low * len(points) + ends.max(axis=-1)
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    ends, share, number = ends.reshape(-1, 2)[first], share.reshape(-1)[first], number.reshape(-1, 4)
    places = (1 - share)[:, None] * points[ends[:, 0]] + share[:, None] * points[ends[:, 1]]
    # Outward is from what is above to what is below; the wall's facets have their normals outward.
    inside = points[inner.ends[..., 1]].sum(axis=1) - points[inner.ends[..., 0]].sum(axis=1)
    outward = np.concatenate([inside, _normals(points[np.asarray(mesh.facets)[wall.cell]])])
    triangles = np.concatenate([number[:, [0, 1, 2]], number[:, [0, 2, 3]]])
    turned = np.sum(_normals(places[triangles]) * np.concatenate([outward, outward]), axis=1) < 0
    triangles[turned] = triangles[turned][:, ::-1]
    a, b, c = triangles.T
    return TriangleSurface(places, triangles[(a != b) & (b != c) & (a != c)])


def _normals(corners: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m 3"]:
    """Normals of triangles, twice as long as their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
