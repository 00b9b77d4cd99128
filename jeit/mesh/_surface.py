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
    """Indices of two triangles of `cells` (m, 3) that cross, touch or overlap outside the nodes and edges that they
    share; None if there are no such triangles."""
    tolerance = _TOUCH_TOLERANCE * float(np.ptp(points, axis=0).max())
    for pairs in _near_pairs(points[cells], tolerance):
        num_shared = (cells[pairs[:, 0], :, None] == cells[pairs[:, 1], None, :]).sum(axis=(1, 2))
        is_crossing = np.zeros(len(pairs), bool)
        shares_no_node, shares_node, shares_edge = num_shared == 0, num_shared == 1, num_shared == 2
        is_crossing[shares_no_node] = _intersect(points, cells, pairs[shares_no_node], tolerance)
        is_crossing[shares_node] = _cross_opposite(points, cells, pairs[shares_node], tolerance)
        is_crossing[shares_edge] = _overlap_at_edge(points, cells, pairs[shares_edge])
        if is_crossing.any():
            first_cell, second_cell = np.sort(pairs[is_crossing][0]).tolist()
            return first_cell, second_cell
    return None


def _near_pairs(corners: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Yield pairs (p, 2) of triangles whose bounding boxes overlap, in batches.

    Triangles are grouped by size, and each group has its own search tree. A few large triangles then do not enlarge the
    search radius of all other triangles.
    """
    centroids = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    lower_corners, upper_corners = corners.min(axis=1) - tolerance, corners.max(axis=1) + tolerance
    size_class = np.floor(np.log2(radii)).astype(int)
    size_classes = [np.flatnonzero(size_class == value) for value in np.unique(size_class)]
    for k, members in enumerate(size_classes):
        tree = KDTree(centroids[members])
        same_size_or_larger_triangles = np.concatenate(size_classes[k:])
        batch_size = max(1, _PAIRS_PER_BATCH // 64)
        for start in range(0, len(same_size_or_larger_triangles), batch_size):
            queried_triangles = same_size_or_larger_triangles[start : start + batch_size]
            neighbours = tree.query_ball_point(
                centroids[queried_triangles], radii[queried_triangles] + radii[members].max() + tolerance
            )
            num_neighbours = np.fromiter(map(len, neighbours), int, len(neighbours))
            first_cells = np.repeat(queried_triangles, num_neighbours)
            second_cells = members[np.concatenate([np.asarray(indices, int) for indices in neighbours])]
            # A pair of triangles of the same size class occurs twice; return it once.
            is_first_occurrence = np.where(
                size_class[first_cells] == size_class[second_cells], first_cells < second_cells, True
            )
            boxes_overlap = (lower_corners[first_cells] <= upper_corners[second_cells]).all(axis=1) & (
                lower_corners[second_cells] <= upper_corners[first_cells]
            ).all(axis=1)
            yield np.column_stack([first_cells, second_cells])[is_first_occurrence & boxes_overlap]


def _intersect(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether the two triangles of each pair intersect (p,); the triangles have no node in common."""
    first_corners, second_corners = points[cells[pairs[:, 0]]], points[cells[pairs[:, 1]]]
    is_crossing = _overlap_in_plane(first_corners, second_corners, tolerance)
    for segment_triangles, face_triangles in ((first_corners, second_corners), (second_corners, first_corners)):
        for k in range(3):
            is_crossing |= _segments_intersect_triangles(
                segment_triangles[:, k], segment_triangles[:, _NEXT_CORNER[k]], face_triangles, tolerance
            )
    return is_crossing


def _cross_opposite(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether the two triangles of each pair (p, 2), which have one common node, intersect elsewhere: the edge of one
    triangle that is opposite to the common node pierces the other triangle."""
    is_crossing = np.zeros(len(pairs), bool)
    for segment_triangles, face_triangles in (pairs.T, pairs.T[::-1]):
        segment_cells = cells[segment_triangles]
        common_corner = (segment_cells[:, :, None] == cells[face_triangles][:, None, :]).any(axis=2).argmax(axis=1)
        start, end = (
            points[segment_cells[np.arange(len(segment_cells)), (common_corner + step) % 3]] for step in (1, 2)
        )
        is_crossing |= _segments_intersect_triangles(start, end, points[cells[face_triangles]], tolerance)
    return is_crossing


def _overlap_at_edge(points: np.ndarray, cells: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Whether the two triangles of each pair overlap (p,); the triangles share an edge."""
    first_cells, second_cells = cells[pairs[:, 0]], cells[pairs[:, 1]]
    is_opposite_corner = ~(first_cells[:, :, None] == second_cells[:, None, :]).any(axis=2)
    is_other_tip = ~(second_cells[:, :, None] == first_cells[:, None, :]).any(axis=2)
    tip_points = points[first_cells[is_opposite_corner]], points[second_cells[is_other_tip]]
    edge = first_cells[~is_opposite_corner].reshape(-1, 2)
    start, direction = points[edge[:, 0]], points[edge[:, 1]] - points[edge[:, 0]]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    perpendiculars = [
        opposite_corner - start - ((opposite_corner - start) * direction).sum(axis=1, keepdims=True) * direction
        for opposite_corner in tip_points
    ]
    lengths = [np.linalg.norm(perpendicular, axis=1) for perpendicular in perpendiculars]
    return (perpendiculars[0] * perpendiculars[1]).sum(axis=1) > (1 - 1e-12) * lengths[0] * lengths[1]


def _segments_intersect_triangles(
    start: np.ndarray, end: np.ndarray, corners: np.ndarray, tolerance: float
) -> np.ndarray:
    """Whether the segments from `start` to `end` (p, 3) intersect the triangles (p, 3, 3), as booleans (p,). A segment
    that lies in the plane of its triangle does not count."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    doubled_areas = np.linalg.norm(normal, axis=1)
    unit = normal / doubled_areas[:, None]
    start_height, end_height = (((point - corners[:, 0]) * unit).sum(axis=1) for point in (start, end))
    is_crossing = (np.minimum(start_height, end_height) <= tolerance) & (
        np.maximum(start_height, end_height) >= -tolerance
    )
    is_crossing &= np.maximum(np.abs(start_height), np.abs(end_height)) > tolerance
    fraction = np.clip(start_height / np.where(is_crossing, start_height - end_height, 1.0), 0, 1)
    intersection_points = start + fraction[:, None] * (end - start) - corners[:, 0]
    u = (np.cross(intersection_points, b) * unit).sum(axis=1) / doubled_areas
    v = (np.cross(a, intersection_points) * unit).sum(axis=1) / doubled_areas
    return is_crossing & (np.minimum(np.minimum(u, v), 1 - u - v) >= -_TOUCH_TOLERANCE)


def _overlap_in_plane(first_triangles: np.ndarray, second_triangles: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether the two triangles with corners `first_triangles` and `second_triangles` (p, 3, 3) are coplanar and
    overlap, as booleans (p,). Coplanar triangles do not overlap if the line through an edge of either triangle
    separates them."""
    normal = np.cross(first_triangles[:, 1] - first_triangles[:, 0], first_triangles[:, 2] - first_triangles[:, 0])
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("pki,pi->pk", second_triangles - first_triangles[:, :1], unit)
    is_overlapping = np.abs(height).max(axis=1) <= tolerance
    first_triangles, second_triangles, unit = (
        first_triangles[is_overlapping],
        second_triangles[is_overlapping],
        unit[is_overlapping],
    )
    is_separated = np.zeros(len(first_triangles), bool)
    for edge_triangles in (first_triangles, second_triangles):
        for k in range(3):
            edge_normals = np.cross(edge_triangles[:, _NEXT_CORNER[k]] - edge_triangles[:, k], unit)
            edge_normals = edge_normals / np.linalg.norm(edge_normals, axis=1, keepdims=True)
            projections = [
                np.einsum("pki,pi->pk", corners, edge_normals) for corners in (first_triangles, second_triangles)
            ]
            gap = np.maximum(
                projections[0].min(axis=1) - projections[1].max(axis=1),
                projections[1].min(axis=1) - projections[0].max(axis=1),
            )
            is_separated |= gap > tolerance
    is_overlapping[is_overlapping] = ~is_separated
    return is_overlapping


def orient_surface(cells: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Orient triangles (m, 3) consistently, so that neighbours agree on which side is outside.

    The triangles of a closed surface are turned outwards. The triangles of an open surface, and of any surface if
    `points` is None, are turned to the side that most of them already face. Raises `ValueError` for an edge shared by
    more than two triangles, a one-sided surface, parts of the surface that meet only in a node, and triangles that
    cross. Warns if all triangles of a closed surface face inwards.
    """
    first_edges, second_edges = _pair_edges(cells)
    first_triangle, second_triangle = first_edges // 3, second_edges // 3
    is_odd_permutation = topology.odd_permutation(topology.cell_facets(cells))
    # Two triangles have the same orientation if they traverse their common edge in opposite directions; otherwise one
    # of the two must be turned.
    needs_flip = is_odd_permutation[first_edges] == is_odd_permutation[second_edges]
    is_flipped = _find_triangles_to_flip(first_triangle, second_triangle, needs_flip, cells)
    _check_node_contacts(cells, first_edges, second_edges)
    if np.count_nonzero(is_flipped) * 2 > len(cells):
        is_flipped = ~is_flipped
    is_closed = 2 * len(first_edges) == 3 * len(cells)
    oriented_cells = np.where(is_flipped[:, None], cells[:, [0, 2, 1]], cells)
    if points is None:
        return oriented_cells
    if (pair := first_crossing(points, cells)) is not None:
        crossing_centre = points[cells[pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"cells: the surface crosses or touches itself: triangles {pair[0]} and {pair[1]} meet, at "
            f"{crossing_centre} m. Move the nodes apart, or unite what overlaps where the surface was made."
        )
    if is_closed and enclosed_volume(points, oriented_cells) < 0:
        if not is_flipped.any():
            warnings.warn(
                "cells: the surface is closed and inside out, every triangle faces inwards; they have been turned. "
                "Give the corners counter-clockwise, seen from outside.",
                UserWarning,
                stacklevel=3,
            )
        oriented_cells = oriented_cells[:, [0, 2, 1]]
    return oriented_cells


def enclosed_volume(points: np.ndarray, cells: np.ndarray) -> float:
    """Volume in m³ enclosed by a closed surface (Gauss's theorem); negative if its triangles face inwards."""
    corners = points[cells] - points.mean(axis=0)
    return float(np.linalg.det(corners).sum() / 6)


def _pair_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows of `topology.cell_facets(cells)` that contain the same edge. Raises `ValueError` for an edge of
    more than two triangles."""
    edges = topology.cell_facets(cells)
    first_edges, second_edges, overcrowded_edges = topology.match_facets(edges, int(cells.max()) + 1)
    if overcrowded_edges.size:
        nodes = np.sort(edges[overcrowded_edges[0]]).tolist()
        raise ValueError(
            f"cells: the edge of nodes {nodes} belongs to more than two triangles (among them "
            f"{sorted((overcrowded_edges // 3).tolist())}), so the surface is not manifold there, as where walls "
            "meet in a T. Remove the triangles that are not of the skin, such as inner walls."
        )
    return first_edges, second_edges


def _find_triangles_to_flip(
    first_edges: np.ndarray, second_edges: np.ndarray, has_opposite_direction: np.ndarray, cells: np.ndarray
) -> np.ndarray:
    """Whether each triangle (m,) must be reversed so that all are oriented like triangle 0. Raises `ValueError` for a
    one-sided surface.

    A graph has two nodes per triangle, one for each orientation, and connects the orientations that match across an
    edge. The graph falls into two components if the surface has two sides.
    """
    num_triangles = len(cells)
    rows = np.concatenate([first_edges, first_edges + num_triangles])
    columns = np.concatenate(
        [second_edges + num_triangles * has_opposite_direction, second_edges + num_triangles * ~has_opposite_direction]
    )
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * num_triangles, 2 * num_triangles))
    _, label = connected_components(graph, directed=False)
    if label[0] == label[num_triangles]:
        raise ValueError(
            "cells: the surface has one side only, as a Möbius strip: going round on it, its triangles face the other "
            "way. A skin has an inner and an outer side; cut the surface open, or look for a seam joined with a twist."
        )
    return label[:num_triangles] != label[0]


def _check_node_contacts(cells: np.ndarray, first_edges: np.ndarray, second_edges: np.ndarray) -> None:
    """Raise `ValueError` if parts of a surface meet only in a node, so that the triangles around this node form several
    fans."""
    corner_index = np.arange(cells.size).reshape(cells.shape)
    edge_ends = topology.LOCAL_FACETS[2]
    pairs = []
    for a in range(2):
        for b in range(2):
            first_corner, second_corner = (
                corner_index[first_edges // 3, edge_ends[first_edges % 3, a]],
                corner_index[second_edges // 3, edge_ends[second_edges % 3, b]],
            )
            is_same_node = cells.ravel()[first_corner] == cells.ravel()[second_corner]
            pairs.append(np.stack([first_corner[is_same_node], second_corner[is_same_node]]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(cells.size, cells.size))
    _, label = connected_components(graph, directed=False)
    fan_nodes = np.unique(np.stack([cells.ravel(), label]), axis=1)[0]
    node, num_fans = np.unique(fan_nodes, return_counts=True)
    if (num_fans > 1).any():
        raise ValueError(
            f"cells: the surface touches itself at node {node[num_fans > 1][0]}: parts of it hang together there by "
            "the node alone. Give each part a node of its own, or join them along edges."
        )
