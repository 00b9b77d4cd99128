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
    touch_tolerance = _TOUCH_TOLERANCE * float(np.ptp(points, axis=0).max())
    for triangle_pairs in _near_triangle_pairs(points[cells], touch_tolerance):
        num_shared = (cells[triangle_pairs[:, 0], :, None] == cells[triangle_pairs[:, 1], None, :]).sum(axis=(1, 2))
        is_crossing = np.zeros(len(triangle_pairs), bool)
        has_no_shared_node, has_shared_node, has_shared_edge = num_shared == 0, num_shared == 1, num_shared == 2
        is_crossing[has_no_shared_node] = _triangles_intersect(
            points, cells, triangle_pairs[has_no_shared_node], touch_tolerance
        )
        is_crossing[has_shared_node] = _triangles_cross_opposite_node(
            points, cells, triangle_pairs[has_shared_node], touch_tolerance
        )
        is_crossing[has_shared_edge] = _overlap_at_edge(points, cells, triangle_pairs[has_shared_edge])
        if is_crossing.any():
            first_cell, second_cell = np.sort(triangle_pairs[is_crossing][0]).tolist()
            return first_cell, second_cell
    return None


def _near_triangle_pairs(triangle_corners: np.ndarray, touch_tolerance: float) -> Iterator[np.ndarray]:
    """Yield pairs (p, 2) of triangles whose bounding boxes overlap, in batches.

    Triangles are grouped by size, and each group has its own search tree. A few large triangles then do not enlarge the
    search radius of all other triangles.
    """
    triangle_centroids = triangle_corners.mean(axis=1)
    triangle_radii = np.linalg.norm(triangle_corners - triangle_centroids[:, None], axis=2).max(axis=1)
    lower_corners, upper_corners = (
        triangle_corners.min(axis=1) - touch_tolerance,
        triangle_corners.max(axis=1) + touch_tolerance,
    )
    size_class = np.floor(np.log2(triangle_radii)).astype(int)
    size_classes = [np.flatnonzero(size_class == class_number) for class_number in np.unique(size_class)]
    for k, triangles_of_class in enumerate(size_classes):
        centroid_tree = KDTree(triangle_centroids[triangles_of_class])
        same_size_or_larger_triangles = np.concatenate(size_classes[k:])
        batch_size = max(1, _PAIRS_PER_BATCH // 64)
        for batch_start in range(0, len(same_size_or_larger_triangles), batch_size):
            queried_triangles = same_size_or_larger_triangles[batch_start : batch_start + batch_size]
            neighbour_lists = centroid_tree.query_ball_point(
                triangle_centroids[queried_triangles],
                triangle_radii[queried_triangles] + triangle_radii[triangles_of_class].max() + touch_tolerance,
            )
            num_neighbours = np.fromiter(map(len, neighbour_lists), int, len(neighbour_lists))
            first_cells = np.repeat(queried_triangles, num_neighbours)
            second_cells = triangles_of_class[
                np.concatenate([np.asarray(neighbour_indices, int) for neighbour_indices in neighbour_lists])
            ]
            # A pair of triangles of the same size class occurs twice; return it once.
            is_first_occurrence = np.where(
                size_class[first_cells] == size_class[second_cells], first_cells < second_cells, True
            )
            are_boxes_overlapping = (lower_corners[first_cells] <= upper_corners[second_cells]).all(axis=1) & (
                lower_corners[second_cells] <= upper_corners[first_cells]
            ).all(axis=1)
            yield np.column_stack([first_cells, second_cells])[is_first_occurrence & are_boxes_overlapping]


def _triangles_intersect(
    points: np.ndarray, cells: np.ndarray, triangle_pairs: np.ndarray, touch_tolerance: float
) -> np.ndarray:
    """Whether the two triangles of each pair intersect (p,); the triangles have no node in common."""
    first_corners, second_corners = points[cells[triangle_pairs[:, 0]]], points[cells[triangle_pairs[:, 1]]]
    is_crossing = _overlap_in_plane(first_corners, second_corners, touch_tolerance)
    for segment_triangles, face_triangles in ((first_corners, second_corners), (second_corners, first_corners)):
        for k in range(3):
            is_crossing |= _segments_intersect_triangles(
                segment_triangles[:, k], segment_triangles[:, _NEXT_CORNER[k]], face_triangles, touch_tolerance
            )
    return is_crossing


def _triangles_cross_opposite_node(
    points: np.ndarray, cells: np.ndarray, triangle_pairs: np.ndarray, touch_tolerance: float
) -> np.ndarray:
    """Whether the two triangles of each pair (p, 2), which have one common node, intersect elsewhere: the edge of one
    triangle that is opposite to the common node pierces the other triangle."""
    is_crossing = np.zeros(len(triangle_pairs), bool)
    for segment_triangles, face_triangles in (triangle_pairs.T, triangle_pairs.T[::-1]):
        segment_cells = cells[segment_triangles]
        common_corner = (segment_cells[:, :, None] == cells[face_triangles][:, None, :]).any(axis=2).argmax(axis=1)
        segment_starts, segment_ends = (
            points[segment_cells[np.arange(len(segment_cells)), (common_corner + corner_step) % 3]]
            for corner_step in (1, 2)
        )
        is_crossing |= _segments_intersect_triangles(
            segment_starts, segment_ends, points[cells[face_triangles]], touch_tolerance
        )
    return is_crossing


def _overlap_at_edge(points: np.ndarray, cells: np.ndarray, triangle_pairs: np.ndarray) -> np.ndarray:
    """Whether the two triangles of each pair overlap (p,); the triangles share an edge."""
    first_cells, second_cells = cells[triangle_pairs[:, 0]], cells[triangle_pairs[:, 1]]
    is_opposite_corner = ~(first_cells[:, :, None] == second_cells[:, None, :]).any(axis=2)
    is_other_tip = ~(second_cells[:, :, None] == first_cells[:, None, :]).any(axis=2)
    tip_points = points[first_cells[is_opposite_corner]], points[second_cells[is_other_tip]]
    shared_edges = first_cells[~is_opposite_corner].reshape(-1, 2)
    edge_starts, edge_directions = points[shared_edges[:, 0]], points[shared_edges[:, 1]] - points[shared_edges[:, 0]]
    edge_directions = edge_directions / np.linalg.norm(edge_directions, axis=1, keepdims=True)
    tip_perpendiculars = [
        opposite_corner
        - edge_starts
        - ((opposite_corner - edge_starts) * edge_directions).sum(axis=1, keepdims=True) * edge_directions
        for opposite_corner in tip_points
    ]
    perpendicular_lengths = [np.linalg.norm(tip_perpendicular, axis=1) for tip_perpendicular in tip_perpendiculars]
    return (tip_perpendiculars[0] * tip_perpendiculars[1]).sum(axis=1) > (1 - 1e-12) * perpendicular_lengths[
        0
    ] * perpendicular_lengths[1]


def _segments_intersect_triangles(
    segment_starts: np.ndarray, segment_ends: np.ndarray, triangle_corners: np.ndarray, touch_tolerance: float
) -> np.ndarray:
    """Whether the segments from `segment_starts` to `segment_ends` (p, 3) intersect the triangles (p, 3, 3), as
    booleans (p,). A segment that lies in the plane of its triangle does not count."""
    a, b = triangle_corners[:, 1] - triangle_corners[:, 0], triangle_corners[:, 2] - triangle_corners[:, 0]
    triangle_normals = np.cross(a, b)
    doubled_areas = np.linalg.norm(triangle_normals, axis=1)
    unit_normals = triangle_normals / doubled_areas[:, None]
    start_height, end_height = (
        ((segment_point - triangle_corners[:, 0]) * unit_normals).sum(axis=1)
        for segment_point in (segment_starts, segment_ends)
    )
    is_crossing = (np.minimum(start_height, end_height) <= touch_tolerance) & (
        np.maximum(start_height, end_height) >= -touch_tolerance
    )
    is_crossing &= np.maximum(np.abs(start_height), np.abs(end_height)) > touch_tolerance
    crossing_fraction = np.clip(start_height / np.where(is_crossing, start_height - end_height, 1.0), 0, 1)
    intersection_points = (
        segment_starts + crossing_fraction[:, None] * (segment_ends - segment_starts) - triangle_corners[:, 0]
    )
    u = (np.cross(intersection_points, b) * unit_normals).sum(axis=1) / doubled_areas
    v = (np.cross(a, intersection_points) * unit_normals).sum(axis=1) / doubled_areas
    return is_crossing & (np.minimum(np.minimum(u, v), 1 - u - v) >= -_TOUCH_TOLERANCE)


def _overlap_in_plane(first_triangles: np.ndarray, second_triangles: np.ndarray, touch_tolerance: float) -> np.ndarray:
    """Whether the two triangles with corners `first_triangles` and `second_triangles` (p, 3, 3) are coplanar and
    overlap, as booleans (p,). Coplanar triangles do not overlap if the line through an edge of either triangle
    separates them."""
    plane_normals = np.cross(
        first_triangles[:, 1] - first_triangles[:, 0], first_triangles[:, 2] - first_triangles[:, 0]
    )
    unit_normals = plane_normals / np.linalg.norm(plane_normals, axis=1, keepdims=True)
    heights_above_plane = np.einsum("pki,pi->pk", second_triangles - first_triangles[:, :1], unit_normals)
    is_overlapping = np.abs(heights_above_plane).max(axis=1) <= touch_tolerance
    first_triangles, second_triangles, unit_normals = (
        first_triangles[is_overlapping],
        second_triangles[is_overlapping],
        unit_normals[is_overlapping],
    )
    is_separated = np.zeros(len(first_triangles), bool)
    for edge_triangles in (first_triangles, second_triangles):
        for k in range(3):
            edge_normals = np.cross(edge_triangles[:, _NEXT_CORNER[k]] - edge_triangles[:, k], unit_normals)
            edge_normals = edge_normals / np.linalg.norm(edge_normals, axis=1, keepdims=True)
            normal_projections = [
                np.einsum("pki,pi->pk", triangle_corners, edge_normals)
                for triangle_corners in (first_triangles, second_triangles)
            ]
            projection_gap = np.maximum(
                normal_projections[0].min(axis=1) - normal_projections[1].max(axis=1),
                normal_projections[1].min(axis=1) - normal_projections[0].max(axis=1),
            )
            is_separated |= projection_gap > touch_tolerance
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
    is_to_flip = is_odd_permutation[first_edges] == is_odd_permutation[second_edges]
    is_flipped = _find_triangles_to_flip(first_triangle, second_triangle, is_to_flip, cells)
    _check_node_contacts(cells, first_edges, second_edges)
    if np.count_nonzero(is_flipped) * 2 > len(cells):
        is_flipped = ~is_flipped
    is_closed = 2 * len(first_edges) == 3 * len(cells)
    oriented_cells = np.where(is_flipped[:, None], cells[:, [0, 2, 1]], cells)
    if points is None:
        return oriented_cells
    if (crossing_pair := first_crossing(points, cells)) is not None:
        crossing_centre = points[cells[crossing_pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"cells: the surface crosses or touches itself: triangles {crossing_pair[0]} and {crossing_pair[1]} meet, "
            f"at {crossing_centre} m. Move the nodes apart, or unite what overlaps where the surface was made."
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
    centred_corners = points[cells] - points.mean(axis=0)
    return float(np.linalg.det(centred_corners).sum() / 6)


def _pair_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows of `topology.cell_facets(cells)` that contain the same edge. Raises `ValueError` for an edge of
    more than two triangles."""
    cell_edges = topology.cell_facets(cells)
    first_edges, second_edges, overcrowded_edges = topology.match_facets(cell_edges, int(cells.max()) + 1)
    if overcrowded_edges.size:
        nodes = np.sort(cell_edges[overcrowded_edges[0]]).tolist()
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
    graph_rows = np.concatenate([first_edges, first_edges + num_triangles])
    graph_columns = np.concatenate(
        [second_edges + num_triangles * has_opposite_direction, second_edges + num_triangles * ~has_opposite_direction]
    )
    orientation_graph = coo_array(
        (np.ones(len(graph_rows)), (graph_rows, graph_columns)), shape=(2 * num_triangles, 2 * num_triangles)
    )
    _, component_labels = connected_components(orientation_graph, directed=False)
    if component_labels[0] == component_labels[num_triangles]:
        raise ValueError(
            "cells: the surface has one side only, as a Möbius strip: going round on it, its triangles face the other "
            "way. A skin has an inner and an outer side; cut the surface open, or look for a seam joined with a twist."
        )
    return component_labels[:num_triangles] != component_labels[0]


def _check_node_contacts(cells: np.ndarray, first_edges: np.ndarray, second_edges: np.ndarray) -> None:
    """Raise `ValueError` if parts of a surface meet only in a node, so that the triangles around this node form several
    fans."""
    corner_index = np.arange(cells.size).reshape(cells.shape)
    edge_ends = topology.LOCAL_FACETS[2]
    connected_corners = []
    for a in range(2):
        for b in range(2):
            first_corner, second_corner = (
                corner_index[first_edges // 3, edge_ends[first_edges % 3, a]],
                corner_index[second_edges // 3, edge_ends[second_edges % 3, b]],
            )
            is_same_node = cells.ravel()[first_corner] == cells.ravel()[second_corner]
            connected_corners.append(np.stack([first_corner[is_same_node], second_corner[is_same_node]]))
    graph_rows, graph_columns = np.concatenate(connected_corners, axis=1)
    corner_graph = coo_array((np.ones(len(graph_rows)), (graph_rows, graph_columns)), shape=(cells.size, cells.size))
    _, component_labels = connected_components(corner_graph, directed=False)
    nodes_of_fans = np.unique(np.stack([cells.ravel(), component_labels]), axis=1)[0]
    touched_nodes, num_fans = np.unique(nodes_of_fans, return_counts=True)
    if (num_fans > 1).any():
        raise ValueError(
            f"cells: the surface touches itself at node {touched_nodes[num_fans > 1][0]}: parts of it hang together "
            "there by the node alone. Give each part a node of its own, or join them along edges."
        )
