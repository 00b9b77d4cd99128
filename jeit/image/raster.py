"""Rasters: grids of pixels on which images on the cells of a mesh are sampled."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Inexact, Int
from scipy.spatial import KDTree

from jeit.mesh import Mesh, check_flat
from jeit_solvers.engines import as_array, either_engine, namespace
from jeit_solvers.module import Module


class Raster(Module):
    """Grid of pixels, with the cell of a mesh that contains each pixel; made once for a mesh and used for every image
    on this mesh.

    **Fields**: `cell`: (rows, columns) index of the cell that contains the centre of each pixel, or -1 outside the
    mesh; row 0 is at the top (largest y), column 0 at the left; `extent`: (x_min, x_max, y_min, y_max) in metres, the
    outer edges of the outermost pixels.

    **Example:**

    ```python
    raster = Raster.create(mesh, shape=(64, 64))
    raster.sample(image), raster.extent
    ```
    """

    cell: Int[Array, "rows columns"]
    extent: tuple[float, float, float, float] = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        mesh: Mesh,
        *,
        shape: tuple[int, int] = (256, 256),
        extent: tuple[float, float, float, float] | None = None,
        height: float | None = None,
    ) -> "Raster":
        """Make a raster of a mesh. `shape`: (rows, columns). `extent`: (x_min, x_max, y_min, y_max) in metres; by
        default the smallest square around the mesh. `height`: z in metres of the slice through a 3-D mesh, by default
        half of its height. Raises `ValueError` for an empty extent, and for a surface in space."""
        check_flat(mesh, "rasters")
        points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
        low, high = points.min(axis=0), points.max(axis=0)
        if extent is None:
            centre, half = (low + high)[:2] / 2, (high - low)[:2].max() / 2
            extent = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
        x_min, x_max, y_min, y_max = (float(value) for value in extent)
        if not (x_max > x_min and y_max > y_min) or min(shape) < 1:
            raise ValueError(f"extent {extent} must be (x_min, x_max, y_min, y_max) in metres, and shape positive.")
        rows, columns = shape
        x = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
        y = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if mesh.dimension == 3:
            z = (low[2] + high[2]) / 2 if height is None else float(height)
            grid = np.column_stack([grid, np.full(len(grid), z)])
        cell = find_cells(points, cells, grid).reshape(shape)
        return cls(as_array(cell, np.int32), (x_min, x_max, y_min, y_max))

    @property
    def pixel_area(self) -> float:
        """Area of a pixel in m²."""
        x_min, x_max, y_min, y_max = self.extent
        return (x_max - x_min) * (y_max - y_min) / self.cell.size

    def pixel_centres(self) -> np.ndarray:
        """Centres of the pixels (rows, columns, 2) in metres."""
        rows, columns = self.cell.shape
        x_min, x_max, y_min, y_max = self.extent
        x = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
        y = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows
        return np.stack(np.meshgrid(x, y), axis=-1)

    def sample(self, image: Inexact[Array, "*frames m"]) -> Float[Array, "*frames rows columns"]:
        """Values at the pixels of one image (m,) or several images (frames, m) on m cells; NaN outside the mesh."""
        return _sample(self.cell, image)


@either_engine
def _sample(cell, image):
    xp = namespace(cell, image)
    return xp.where(cell >= 0, image[..., xp.maximum(cell, 0)], xp.nan)


def find_cells(points: np.ndarray, cells: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Index of the cell that contains each of the `positions` (q, d), -1 for positions outside all cells.

    For each position the cells with the nearest centroids are tested first, then more cells for the positions that are
    not yet found. Only cells that reach into the bounding box of the positions are considered; if the positions lie in
    a slice, these are the cells that the slice cuts.
    """
    corners = points[cells]
    tolerance = 1e-9 * np.ptp(points, axis=0).max()
    lower_corner, upper_corner = positions.min(axis=0) - tolerance, positions.max(axis=0) + tolerance
    candidates = np.flatnonzero(
        ((corners.max(axis=1) >= lower_corner) & (corners.min(axis=1) <= upper_corner)).all(axis=1)
    )
    if not len(candidates):
        return np.full(len(positions), -1)
    corners = corners[candidates]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    tree = KDTree(corners.mean(axis=1))
    max_reach = np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=-1).max()
    cell_of_position = np.full(len(positions), -1)
    remaining = np.flatnonzero(tree.query(positions)[0] <= max_reach)
    num_tried, num_nearest = 0, 8
    while remaining.size and num_tried < len(candidates):
        num_nearest = min(num_nearest, len(candidates))
        nearest = tree.query(positions[remaining], k=num_nearest)
        distance, candidate_index = np.asarray(nearest[0])[:, num_tried:], np.asarray(nearest[1])[:, num_tried:]
        barycentric = np.einsum(
            "qkij,qkj->qki", inverse[candidate_index], positions[remaining][:, None] - corners[candidate_index, 0]
        )
        is_inside = np.minimum(barycentric.min(axis=-1), 1 - barycentric.sum(axis=-1)) > -1e-9
        is_found = is_inside.any(axis=1)
        cell_of_position[remaining[is_found]] = candidates[
            candidate_index[is_found, is_inside[is_found].argmax(axis=1)]
        ]
        # A cell cannot contain a position that is farther from its centroid than its farthest corner.
        remaining = remaining[~is_found & (distance[:, -1] <= max_reach)]
        num_tried, num_nearest = num_nearest, 4 * num_nearest
    return cell_of_position
