"""Marching simplices: where values at nodes, linear in every cell, pass a level; and the part of a surface above it.

What is cut out of a simplex is a triangle or a quadrilateral, so four corners hold it, the last one twice in a
triangle. Doi and Koide, IEICE Trans. E74 (1991) 214-224, for tetrahedra; all at once, without a loop over cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# A tetrahedron's nodes from the highest to the lowest: the ends of the edges that a level passes, round the polygon,
# by the number of nodes above it.
_PASSED = {
    1: [[0, 1], [0, 2], [0, 3], [0, 3]],
    2: [[0, 2], [0, 3], [1, 3], [1, 2]],
    3: [[0, 3], [1, 3], [2, 3], [2, 3]],
}
# A triangle's: the corners of the part above, a node where both ends are one.
_ABOVE = {
    1: [[0, 0], [0, 1], [0, 2], [0, 2]],
    2: [[0, 0], [1, 1], [1, 2], [0, 2]],
    3: [[0, 0], [1, 1], [2, 2], [2, 2]],
}
_EDGE = [[0, 1], [0, 2]]


class Pieces(NamedTuple):
    """Pieces cut out of simplices, one or none of each.

    **Fields**: `ends` (p, c, 2), nodes between which each corner lies; `share` (p, c), how far from the first to the
    second; `cell` (p,), the simplex that each was cut out of.
    """

    ends: Int[np.ndarray, "p c 2"]
    share: Float[np.ndarray, "p c"]
    cell: Int[np.ndarray, " p"]

    def at_corners(self, values: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "p c ..."]:
        """What is linear between nodes, such as their places (n, d), at the corners."""
        share = self.share.reshape(*self.share.shape, *[1] * (values.ndim - 1))
        return (1 - share) * values[self.ends[..., 0]] + share * values[self.ends[..., 1]]


def passed(cells: Int[np.ndarray, "m 4"], values: Float[np.ndarray, " n"], level: float = 0.0) -> Pieces:
    """The surface in tetrahedra on which `values` (n,) per node have a level: polygons of four corners, in order round
    them. A node at the level counts as above it, so that two cells never both have the facet between them."""
    return _cut(cells, values, level, _PASSED)


def part_above(triangles: Int[np.ndarray, "b 3"], values: Float[np.ndarray, " n"], level: float = 0.0) -> Pieces:
    """The part of a surface of triangles on which `values` (n,) per node are at or above a level."""
    return _cut(triangles, values, level, _ABOVE)


def passed_edges(triangles: Int[np.ndarray, "b 3"], values: Float[np.ndarray, " n"], level: float = 0.0) -> Pieces:
    """The lines on a surface of triangles on which `values` (n,) per node have a level: pieces of two corners."""
    return _cut(triangles, values, level, {1: _EDGE, 2: [[0, 2], [1, 2]]})


def _cut(cells, values, level: float, cases: dict[int, list[list[int]]]) -> Pieces:
    number = (values[cells] >= level).sum(axis=1)
    found = []
    for above, corners in cases.items():
        cell = np.flatnonzero(number == above)
        order = np.argsort(-values[cells[cell]], axis=1, kind="stable")
        ends = np.take_along_axis(cells[cell], order, axis=1)[:, np.array(corners)]
        high, low = values[ends[..., 0]], values[ends[..., 1]]
        with np.errstate(invalid="ignore"):
            share = np.where(high > low, (high - level) / np.where(high > low, high - low, 1), 0)
        found.append((ends, share, cell))
    return Pieces(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
