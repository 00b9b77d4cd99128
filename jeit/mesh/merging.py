"""Nodes at one place made one: what files of loose triangles need (NumPy)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree


def merged(points: np.ndarray, cells: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, d) without those within `tolerance` metres of an earlier one, and cells (m, k) that use these.

    Cells that lose a corner by it are left out.
    """
    close = KDTree(points).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(close)), close.T), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    _, first, number = np.unique(label, return_index=True, return_inverse=True)
    # In the order in which they first occur.
    order = np.argsort(first)
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    renumbered = place[number][cells]
    ordered = np.sort(renumbered, axis=1)
    whole = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    return points[first[order]], renumbered[whole]
