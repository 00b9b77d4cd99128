"""Prisms above triangles, cut into three tetrahedra each: what layers and shells are stacked of (NumPy)."""

from __future__ import annotations

import numpy as np


def stacked_cells(cells: np.ndarray, count: int, num_layers: int) -> np.ndarray:
    """Tetrahedra (3 m num_layers, 4) of the prisms above triangles (m, 3); node k · count + i is node i after k layers.

    Every prism is cut along the diagonals that rise from its lower-numbered to its higher-numbered node, so that
    neighbours agree.
    """
    a, b, c = np.sort(cells.astype(np.int64), axis=1).T
    up = count
    prism = np.stack(
        [
            np.stack([a, b, c, c + up], axis=1),
            np.stack([a, b, b + up, c + up], axis=1),
            np.stack([a, a + up, b + up, c + up], axis=1),
        ],
        axis=1,
    ).reshape(-1, 4)
    return np.concatenate([prism + k * count for k in range(num_layers)])


def stacked_wall(edges: np.ndarray, count: int, num_layers: int) -> np.ndarray:
    """Triangles (2 e num_layers, 3) of the wall above edges (e, 2), cut as the prisms are."""
    low, high = np.sort(edges.astype(np.int64), axis=1).T
    lower = np.stack([low, high, high + count], axis=1)
    upper = np.stack([low, low + count, high + count], axis=1)
    return np.concatenate([face + k * count for k in range(num_layers) for face in (lower, upper)])
