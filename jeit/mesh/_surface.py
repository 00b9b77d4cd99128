"""Triangulated surfaces of bodies: orientation of the triangles and detection of self-intersection."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jeit.mesh import topology

# Distance, relative to the extent of the surface, below which triangles count as touching.
_TOUCH_TOLERANCE = 1e-9
# Approximate number of pairs of triangles that are tested together.
_PAIRS_PER_BATCH = 500_000
# For each corner of a triangle, the next corner.
_NEXT_CORNER = np.array([1, 2, 0])


def first_crossing(points: np.ndarray, cells: np.ndarray) -> tuple[int, int] | None:
    """Find a pair of triangles (m, 3) that cross, touch or overlap outside the nodes and edges they share; None if no
    pair does."""
    tolerance = _TOUCH_TOLERANCE * float(np.ptp(points, axis=0).max())
    for pairs in _near_pairs(points[cells], tolerance):
        shared = (cells[pairs[:, 0], :, None] == cells[pairs[:, 1], None, :]).sum(axis=(1, 2))
        meet = np.zeros(len(pairs), bool)
        apart, one, two = shared == 0, shared == 1, shared == 2
        meet[apart] = _intersect(points, cells, pairs[apart], tolerance)
        meet[one] = _cross_opposite(points, cells, pairs[one], tolerance)
        meet[two] = _overlap_at_edge(points, cells, pairs[two])
        if meet.any():
            first, second = np.sort(pairs[meet][0]).tolist()
            return first, second
    return None


def _near_pairs(corners: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Yield pairs (p, 2) of triangles whose bounding boxes overlap, in batches.

    Triangles are grouped by size and each group has its own search tree, so that a few large triangles do not widen the
    search for all others.
    """
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    low, high = corners.min(axis=1) - tolerance, corners.max(axis=1) + tolerance
    size = np.floor(np.log2(reach)).astype(int)
    kinds = [np.flatnonzero(size == value) for value in np.unique(size)]
    for k, members in enumerate(kinds):
        tree = KDTree(middle[members])
        larger = np.concatenate(kinds[k:])
        step = max(1, _PAIRS_PER_BATCH // 64)
        for start in range(0, len(larger), step):
            asked = larger[start : start + step]
            found = tree.query_ball_point(middle[asked], reach[asked] + reach[members].max() + tolerance)
            number = np.fromiter(map(len, found), int, len(found))
            first = np.repeat(asked, number)
            second = members[np.concatenate([np.asarray(each, int) for each in found])]
            # A pair of triangles of the same size class is found twice; keep it once.
            once = np.where(size[first] == size[second], first < second, True)
            overlap = (low[first] <= high[second]).all(axis=1) & (low[second] <= high[first]).all(axis=1)
            yield np.column_stack([first, second])[once & overlap]


def _intersect(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether the two triangles of each pair intersect (p,); the triangles have no node in common."""
    first, second = points[cells[pairs[:, 0]]], points[cells[pairs[:, 1]]]
    meet = _overlap_in_plane(first, second, tolerance)
    for one, other in ((first, second), (second, first)):
        for k in range(3):
            meet |= _pierces(one[:, k], one[:, _NEXT_CORNER[k]], other, tolerance)
    return meet


def _cross_opposite(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether two triangles with one common node intersect elsewhere (p,): the edge of either triangle that is opposite
    to the common node pierces the other triangle."""
    meet = np.zeros(len(pairs), bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        mine = cells[one]
        common = (mine[:, :, None] == cells[other][:, None, :]).any(axis=2).argmax(axis=1)
        start, end = (points[mine[np.arange(len(mine)), (common + step) % 3]] for step in (1, 2))
        meet |= _pierces(start, end, points[cells[other]], tolerance)
    return meet


def _overlap_at_edge(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Whether the two triangles of each pair overlap (p,); the triangles share an edge."""
    first, second = cells[pairs[:, 0]], cells[pairs[:, 1]]
    own = ~(first[:, :, None] == second[:, None, :]).any(axis=2)
    others = ~(second[:, :, None] == first[:, None, :]).any(axis=2)
    tips = points[first[own]], points[second[others]]
    edge = first[~own].reshape(-1, 2)
    start, along = points[edge[:, 0]], points[edge[:, 1]] - points[edge[:, 0]]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    away = [tip - start - ((tip - start) * along).sum(axis=1, keepdims=True) * along for tip in tips]
    lengths = [np.linalg.norm(one, axis=1) for one in away]
    return (away[0] * away[1]).sum(axis=1) > (1 - 1e-12) * lengths[0] * lengths[1]


def _pierces(start: np.ndarray, end: np.ndarray, corners: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether the segments from `start` to `end` (p, 3) intersect the triangles (p, 3, 3), as booleans (p,). A segment
    that lies in the plane of its triangle does not count."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    size = np.linalg.norm(normal, axis=1)
    unit = normal / size[:, None]
    ahead, behind = (((place - corners[:, 0]) * unit).sum(axis=1) for place in (start, end))
    through = (np.minimum(ahead, behind) <= tolerance) & (np.maximum(ahead, behind) >= -tolerance)
    through &= np.maximum(np.abs(ahead), np.abs(behind)) > tolerance
    share = np.clip(ahead / np.where(through, ahead - behind, 1.0), 0, 1)
    place = start + share[:, None] * (end - start) - corners[:, 0]
    u = (np.cross(place, b) * unit).sum(axis=1) / size
    v = (np.cross(a, place) * unit).sum(axis=1) / size
    return through & (np.minimum(np.minimum(u, v), 1 - u - v) >= -_TOUCH_TOLERANCE)


def _overlap_in_plane(first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether pairs of triangles (p, 3, 3) are coplanar and overlap (p,): they do not if the line through an edge of
    either separates them."""
    normal = np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("pki,pi->pk", second - first[:, :1], unit)
    overlap = np.abs(height).max(axis=1) <= tolerance
    first, second, unit = first[overlap], second[overlap], unit[overlap]
    apart = np.zeros(len(first), bool)
    for one in (first, second):
        for k in range(3):
            outward = np.cross(one[:, _NEXT_CORNER[k]] - one[:, k], unit)
            outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
            spans = [np.einsum("pki,pi->pk", corners, outward) for corners in (first, second)]
            gap = np.maximum(spans[0].min(axis=1) - spans[1].max(axis=1), spans[1].min(axis=1) - spans[0].max(axis=1))
            apart |= gap > tolerance
    overlap[overlap] = ~apart
    return overlap


def orient_surface(cells: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Orient triangles (m, 3) consistently, so that neighbours agree on which side is outside.

    The triangles of a closed surface are made to face outwards; those of an open surface, or if `points` is None, the
    way that most of them do already. Raises `ValueError` for an edge shared by more than two triangles, a one-sided
    surface, sheets that meet only in a node, and triangles that cross. Warns if all triangles of a closed surface face
    inwards.
    """
    first, second = _pair_edges(cells)
    row, other = first // 3, second // 3
    odd = topology.odd_permutation(topology.cell_facets(cells))
    # Two triangles have the same orientation if they traverse their common edge in opposite directions; otherwise one
    # of them must be turned.
    turn = odd[first] == odd[second]
    turned = _triangles_to_turn(row, other, turn, cells)
    _check_node_contacts(cells, first, second)
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
    """Volume in m³ enclosed by a closed surface (Gauss's theorem); negative if its triangles face inwards."""
    corners = points[cells] - points.mean(axis=0)
    return float(np.linalg.det(corners).sum() / 6)


def _pair_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows of `cell_facets` that are the same edge. Raises `ValueError` for an edge of more than two
    triangles."""
    edges = topology.cell_facets(cells)
    first, second, crowded = topology.match_facets(edges, int(cells.max()) + 1)
    if crowded.size:
        nodes = np.sort(edges[crowded[0]]).tolist()
        raise ValueError(
            f"cells: the edge of nodes {nodes} belongs to more than two triangles (among them "
            f"{sorted((crowded // 3).tolist())}), so the surface is not manifold there, as where walls "
            "meet in a T. Remove the triangles that are not of the skin, such as inner walls."
        )
    return first, second


def _triangles_to_turn(first: np.ndarray, second: np.ndarray, opposite: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Whether each triangle (m,) must be reversed so that all are oriented like triangle 0. Raises `ValueError` for a
    one-sided surface.

    The graph has two nodes per triangle, as given and turned. It falls into two components if the surface has two
    sides.
    """
    count = len(cells)
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + count * opposite, second + count * ~opposite])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    if label[0] == label[count]:
        raise ValueError(
            "cells: the surface has one side only, as a Möbius strip: going round on it, its triangles face the other "
            "way. A skin has an inner and an outer side; cut the surface open, or look for a seam joined with a twist."
        )
    return label[:count] != label[0]


def _check_node_contacts(cells: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """Raise `ValueError` if sheets of a surface meet only in a node, so that the triangles around it form several
    fans."""
    corner = np.arange(cells.size).reshape(cells.shape)
    ends = topology.LOCAL_FACETS[2]
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
