"""Triangles in space as a surface: edges of two triangles at most, sides that agree, one sheet round every node."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jeit.mesh import _topology
from jeit.mesh._crossings import first_crossing


def orient_surface(cells: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Triangles (m, 3) turned so that neighbours agree which side is out.

    Of a closed surface that is the outside, of an open one the side that most of the triangles gave. Where `points` are
    not known, most of the triangles decide. Raises `ValueError` for edges of more than two triangles, for a surface
    with one side only, for sheets that meet in a node, and for triangles that cross; warns of a closed surface whose
    triangles all faced inwards.
    """
    first, second = _pair_edges(cells)
    row, other = first // 3, second // 3
    odd = _topology.odd_permutation(_topology.cell_facets(cells))
    # Two triangles agree where they run along their edge in opposite directions; else one of them must be turned.
    turn = odd[first] == odd[second]
    turned = _sides(row, other, turn, cells)
    _check_fans(cells, first, second)
    if np.count_nonzero(turned) * 2 > len(cells):
        turned = ~turned
    closed = 2 * len(first) == 3 * len(cells)
    swapped = np.where(turned[:, None], cells[:, [0, 2, 1]], cells)
    if points is None:
        return swapped
    if (pair := first_crossing(points, cells)) is not None:
        middle = points[cells[pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"cells: the surface crosses or touches itself: triangles {pair[0]} and {pair[1]} meet, at {middle} m. "
            "Move the nodes apart, or unite what overlaps where the surface was made."
        )
    if closed and enclosed_volume(points, swapped) < 0:
        if not turned.any():
            warnings.warn(
                "cells: the surface is closed and inside out, every triangle faces inwards; they have been turned. "
                "Give the corners counter-clockwise, seen from outside.",
                UserWarning,
                stacklevel=3,
            )
        swapped = swapped[:, [0, 2, 1]]
    return swapped


def enclosed_volume(points: np.ndarray, cells: np.ndarray) -> float:
    """Volume in m³ within a closed surface (Gauss's theorem), negative where its triangles face inwards."""
    corners = points[cells] - points.mean(axis=0)
    return float(np.linalg.det(corners).sum() / 6)


def _pair_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `cell_facets` that are the same edge."""
    edges = _topology.cell_facets(cells)
    first, second, crowded = _topology.match_facets(edges, int(cells.max()) + 1)
    if crowded.size:
        nodes = np.sort(edges[crowded[0]]).tolist()
        raise ValueError(
            f"cells: the edge of nodes {nodes} belongs to more than two triangles (among them "
            f"{sorted((crowded // 3).tolist())}), so the surface is not manifold there: walls meet in a T. Remove the "
            "triangles that are not of the skin, such as inner walls."
        )
    return first, second


def _sides(first: np.ndarray, second: np.ndarray, turn: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Which triangles to turn (m,) for all to agree with triangle 0; `ValueError` where that cannot be.

    Every triangle counts twice, as it is and turned: a surface with two sides falls into two parts.
    """
    count = len(cells)
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + count * turn, second + count * ~turn])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    if label[0] == label[count]:
        raise ValueError(
            "cells: the surface has one side only, as a Möbius strip: going round on it, its triangles face the other "
            "way. A skin has an inner and an outer side; cut the surface open, or look for a seam joined with a twist."
        )
    return label[:count] != label[0]


def _check_fans(cells: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """Raise `ValueError` where the triangles round a node are not one fan: sheets that meet in nothing but a node."""
    corner = np.arange(cells.size).reshape(cells.shape)
    ends = _topology.LOCAL_FACETS[2]
    pairs = []
    for a in range(2):
        for b in range(2):
            one, other = corner[first // 3, ends[first % 3, a]], corner[second // 3, ends[second % 3, b]]
            same = cells.ravel()[one] == cells.ravel()[other]
            pairs.append(np.stack([one[same], other[same]]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(cells.size, cells.size))
    _, label = connected_components(graph, directed=False)
    fans = np.unique(np.stack([cells.ravel(), label]), axis=1)[0]
    node, number = np.unique(fans, return_counts=True)
    if (number > 1).any():
        raise ValueError(
            f"cells: the surface touches itself at node {node[number > 1][0]}: parts of it hang together there by the "
            "node alone. Give each part a node of its own, or join them along edges."
        )
