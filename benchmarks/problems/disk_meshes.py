"""Meshes of a disk that are generated without jeit: given points with a jittered grid between them, triangulated by
SciPy."""

import numpy as np
from scipy.spatial import Delaunay


def meshed_disk(fixed: np.ndarray, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n, 2) of a mesh of the unit disk, with the k `fixed` points (k, 2) first, and counter-clockwise cells (m,
    3).

    `fixed` includes the boundary. The other nodes are about `spacing` apart.
    """
    steps = np.arange(-1, 1, spacing)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    grid = grid + rng.uniform(-0.25, 0.25, grid.shape) * spacing
    grid = grid[np.hypot(*grid.T) < 0.94]
    far = np.min(np.linalg.norm(grid[:, None] - fixed, axis=2), axis=1) > 0.6 * spacing
    points = np.concatenate([fixed, grid[far]])
    cells = Delaunay(points).simplices
    first, second, third = (points[cells[:, k]] for k in range(3))
    area = np.linalg.det(np.stack([second - first, third - first], axis=1))
    cells[area < 0] = cells[area < 0][:, ::-1]
    return points, cells[np.abs(area) > 1e-9]
