"""Topology of meshes: cells that share a facet, and facets of the boundary (NumPy; done once per mesh)."""

from __future__ import annotations

import numpy as np

# Facets of a positively oriented simplex, each with the simplex on its left (2-D) or its normal outward (3-D).
LOCAL_FACETS = {
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
}


def cell_facets(cells: np.ndarray) -> np.ndarray:
    """All facets of all cells, (m (d + 1), d), cell after cell, oriented outward."""
    dimension = cells.shape[1] - 1
    return cells[:, LOCAL_FACETS[dimension]].reshape(-1, dimension)


def facet_keys(facets: np.ndarray, num_points: int) -> np.ndarray:
    """One integer per facet that does not depend on the order of its nodes."""
    key = np.zeros(len(facets), dtype=np.int64)
    for column in np.sort(facets.astype(np.int64), axis=1).T:
        key = key * num_points + column
    return key


def odd_permutation(facets: np.ndarray) -> np.ndarray:
    """True where sorting the nodes of a facet reverses its orientation."""
    if facets.shape[1] == 2:
        return facets[:, 0] > facets[:, 1]
    a, b, c = facets.T
    return ((a > b).astype(int) + (b > c) + (a > c)) % 2 == 1


def match_facets(facets: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of `facets` with the same nodes, in pairs (first, second), and three of one facet if any occurs so often."""
    key = facet_keys(facets, num_points)
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    same = ordered[1:] == ordered[:-1]
    triple = np.flatnonzero(same[1:] & same[:-1])
    if triple.size:
        return order[:0], order[:0], order[triple[0] : triple[0] + 3]
    position = np.flatnonzero(same)
    return order[position], order[position + 1], order[:0]


def pair_facets(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interior facets as pairs of rows of `cell_facets`, and the rows that have no partner.

    Returns (first, second, single). Raises `ValueError` if a facet belongs to more than two cells, or if
    the two cells of a facet lie on the same side of it.
    """
    facets = cell_facets(cells)
    width = cells.shape[1]
    first, second, crowded = match_facets(facets, int(cells.max()) + 1)
    if crowded.size:
        raise ValueError(
            f"cells: the facet with nodes {np.sort(facets[crowded[0]]).tolist()} belongs to more than two cells "
            f"(among them {(crowded // width).tolist()}), so the mesh is not manifold. Remove the surplus cells."
        )
    odd = odd_permutation(facets)
    folded = np.flatnonzero(odd[first] == odd[second])
    if folded.size:
        pair = np.sort([first[folded[0]] // width, second[folded[0]] // width]).tolist()
        raise ValueError(
            f"cells: {folded.size} pair(s) of neighbouring cells overlap, first {pair}: both lie on the same side of "
            "the facet they share. A node has been moved across a facet (an inverted cell), or the cells "
            "come from two meshes laid over each other. Rebuild the mesh or move the node back."
        )
    paired = np.zeros(len(facets), bool)
    paired[first] = paired[second] = True
    return first, second, np.flatnonzero(~paired)


def order_loops(facets: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Boundary edges of triangles sorted head to tail, loop after loop, the outer loop first.

    Each loop starts at its lowest-numbered node. The outer loop is the one that encloses a positive area; where
    `points` are not known, that of most edges, and of a surface in space, the longest one. Raises `ValueError` where
    loops meet in a node.
    """
    start, counts = np.unique(facets[:, 0], return_counts=True)
    if np.any(counts > 1):
        raise ValueError(
            f"cells: the boundary touches itself at node {start[counts > 1][0]}: parts of the mesh hang together "
            "by a single node. Join them along an edge, or separate them and keep one."
        )
    following = dict(zip(facets[:, 0].tolist(), facets[:, 1].tolist(), strict=True))
    loops = []
    for node in start.tolist():
        if node not in following:
            continue
        loop = [node]
        while (nxt := following.pop(loop[-1])) != node:
            loop.append(nxt)
        loops.append(np.array(loop))
    if points is None:
        loops.sort(key=len, reverse=True)
    elif points.shape[1] == 3:
        loops.sort(key=lambda loop: -np.linalg.norm(points[loop] - points[np.roll(loop, -1)], axis=1).sum())
    else:
        loops.sort(key=lambda loop: -signed_area(points[loop]))
    return np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops])


def signed_area(outline: np.ndarray) -> float:
    """Area enclosed by a closed polygon (k, 2), positive if counter-clockwise (shoelace formula)."""
    x, y = (outline - outline[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
