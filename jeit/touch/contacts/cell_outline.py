"""Compute outlines of sets of cells."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def outline_of_cells(points: Float[np.ndarray, "n d"], cells: Int[np.ndarray, "c 3"]) -> Float[np.ndarray, "k d"]:
    """Outline of a set of cells: vertices (k, d), in metres, of the longest loop of its boundary edges.

    Boundary edges belong to one of the `cells` (c, 3) only. Cells have the same orientation, and so have their edges,
    so that the boundary edges follow one another; where the set touches itself in a node, the loop takes either way.
    """
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    _, which, number = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    onward: dict[int, list[int]] = {}
    for start, end in edges[number[which] == 1].tolist():
        onward.setdefault(start, []).append(end)
    longest: list[int] = []
    while onward:
        loop = [next(iter(onward))]
        while loop[-1] in onward:
            ends = onward[loop[-1]]
            last = loop[-1]
            loop.append(ends.pop())
            if not ends:
                del onward[last]
        longest = max(longest, loop[:-1], key=len)
    return points[longest]
