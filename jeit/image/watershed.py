"""Watersheds: the cells of a mesh divided among the peaks of an image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jeit.mesh import Mesh
from jeit.mesh.geometry import interior_facets


def shared_facets(mesh: Mesh) -> Int[np.ndarray, "m k"]:
    """Numbers of the facets that each cell shares with another, -1 for those on the boundary; once per mesh."""
    pairs, _ = interior_facets(mesh)
    cell, facet = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.argsort(cell, kind="stable")
    cell, facet = cell[order], facet[order]
    shared = np.full((mesh.num_cells, mesh.dimension + 1), -1)
    shared[cell, np.arange(len(cell)) - np.searchsorted(cell, cell)] = facet
    return shared


def basins(
    change: Float[np.ndarray, " m"],
    shared: Int[np.ndarray, "m k"],
    *,
    floor: float,
    least_prominence: float,
) -> Int[np.ndarray, " m"]:
    """The peak (a cell's index) that every cell above `floor` belongs to, -1 below: a watershed from the top down.

    `change` (m,) of every cell, and numbers of what it shares with others, its facets (`shared_facets`) or nodes, -1
    for none. Where two basins meet, the lower one is swallowed unless its peak stands out from the meeting point, by
    `least_prominence` times its height.
    """
    peak = np.full(len(change), -1)
    reached: dict[int, int] = {}
    swallowed: dict[int, int] = {}

    def root(label: int) -> int:
        while label in swallowed:
            label = swallowed[label]
        return label

    cells = np.flatnonzero(change > floor)
    for cell in cells[np.argsort(-change[cells], kind="stable")].tolist():
        places = [place for place in shared[cell].tolist() if place >= 0]
        labels = {root(reached[place]) for place in places if place in reached}
        highest = max(labels, key=lambda label: change[label], default=cell)
        for label in labels - {highest}:
            if change[label] - change[cell] < least_prominence * change[label]:
                swallowed[label] = highest
        peak[cell] = highest
        reached.update(dict.fromkeys(places, highest))
    peak[cells] = [root(label) for label in peak[cells].tolist()]
    return peak
