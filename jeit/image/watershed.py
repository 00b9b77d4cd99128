"""Watersheds: the cells of a mesh divided among the peaks of an image."""

import numpy as np
from jaxtyping import Float, Int

from jeit.mesh import Mesh
from jeit.mesh.geometry import interior_facets


def cell_neighbours(mesh: Mesh) -> Int[np.ndarray, "m k"]:
    """The cells that share a facet with each cell, -1 where there are fewer than it has facets; once per mesh."""
    pairs, _ = interior_facets(mesh)
    cell, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.argsort(cell, kind="stable")
    cell, other = cell[order], other[order]
    neighbours = np.full((mesh.num_cells, mesh.dimension + 1), -1)
    neighbours[cell, np.arange(len(cell)) - np.searchsorted(cell, cell)] = other
    return neighbours


def basins(
    change: Float[np.ndarray, " m"],
    neighbours: Int[np.ndarray, "m k"],
    *,
    floor: float,
    least_prominence: float,
) -> Int[np.ndarray, " m"]:
    """The peak (a cell's index) that every cell above `floor` belongs to, -1 below: a watershed from the top down.

    `change` (m,) of every cell, and its `neighbours`, as of `cell_neighbours`. Where two basins meet, the lower one is
    swallowed unless its peak stands out from the meeting point, by `least_prominence` times its height.
    """
    peak = np.full(len(change), -1)
    swallowed: dict[int, int] = {}

    def root(label: int) -> int:
        while label in swallowed:
            label = swallowed[label]
        return label

    cells = np.flatnonzero(change > floor)
    for cell in cells[np.argsort(-change[cells], kind="stable")].tolist():
        labels = {root(int(peak[other])) for other in neighbours[cell].tolist() if other >= 0 and peak[other] >= 0}
        if not labels:
            peak[cell] = cell
            continue
        highest = max(labels, key=lambda label: change[label])
        peak[cell] = highest
        for label in labels - {highest}:
            if change[label] - change[cell] < least_prominence * change[label]:
                swallowed[label] = highest
    peak[cells] = [root(label) for label in peak[cells].tolist()]
    return peak
