"""Contact integrals of arcs on the boundary of a mesh, for the SciPy baseline."""

from __future__ import annotations

import numpy as np
import scipy.sparse


def contact_integrals(points, cells, position, width, contact_impedance):
    """Sparse contact mass (n, n), load (n, L) and admittance (L,) of L arcs on the boundary polygon of a mesh with n
    nodes.

    For the basis functions φ and the contact impedance z, the entries are ∫φ_iφ_j/z, ∫φ_i/z and (b - a)/z over the
    covered piece [a, b] of an edge with ends i, j, summed over edges.
    """
    edges = _boundary(cells)
    length = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    start = np.concatenate([[0.0], np.cumsum(length)[:-1]])
    perimeter = length.sum()
    tail, along = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    rows, columns, values = [], [], []
    load, area = np.zeros((len(points), len(position))), np.zeros(len(position))
    for electrode, (centre, extent, impedance) in enumerate(zip(position, width, contact_impedance, strict=True)):
        fraction = np.clip(np.einsum("bd,bd->b", centre - tail, along) / length**2, 0, 1)
        nearest = np.argmin(np.linalg.norm(centre - tail - fraction[:, None] * along, axis=1))
        middle = start[nearest] + fraction[nearest] * length[nearest]
        for turn in (-perimeter, 0.0, perimeter):
            low = np.clip(middle + turn - extent / 2 - start, 0, length)
            high = np.clip(middle + turn + extent / 2 - start, 0, length)
            for b in np.flatnonzero(high > low):
                # Gauss points integrate the products of two linear functions exactly.
                t = (low[b] + high[b]) / 2 + (high[b] - low[b]) / 2 * np.array([-1, 1]) / np.sqrt(3)
                phi = np.stack([1 - t / length[b], t / length[b]]) * np.sqrt((high[b] - low[b]) / 2)
                rows.append(np.repeat(edges[b], 2))
                columns.append(np.tile(edges[b], 2))
                values.append((phi @ phi.T / impedance).ravel())
                load[edges[b], electrode] += phi.sum(axis=1) * np.sqrt((high[b] - low[b]) / 2) / impedance
                area[electrode] += (high[b] - low[b]) / impedance
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_matrix(entries, (len(points), len(points))).tocsr(), load, area


def _boundary(cells):
    """Boundary edges (b, 2) in the order in which they follow each other."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    there = {(int(a), int(b)) for a, b in edges}
    following = {a: b for a, b in there if (b, a) not in there}
    loop = [min(following)]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    return np.stack([loop, np.roll(loop, -1)], axis=1)
