"""Topology of meshes: facets of cells, neighbouring cells and boundary loops; and geometric checks of polygon loops."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

# Facets of a positively oriented simplex, each with the simplex on its left (2-D) or with an outward normal (3-D).
LOCAL_FACETS = {
    2: np.array([[0, 1], [1, 2], [2, 0]]),
    3: np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
}


def cell_facets(cells: np.ndarray) -> np.ndarray:
    """All facets (m (d + 1), d) of all `cells` (m, d + 1), in the order of the cells, oriented outward."""
    dimension = cells.shape[1] - 1
    return cells[:, LOCAL_FACETS[dimension]].reshape(-1, dimension)


def facet_keys(facets: np.ndarray, num_points: int) -> np.ndarray:
    """One integer per facet that identifies it, independent of the order of its nodes."""
    facet_key = np.zeros(len(facets), dtype=np.int64)
    for node_column in np.sort(facets.astype(np.int64), axis=1).T:
        facet_key = facet_key * num_points + node_column
    return facet_key


def odd_permutation(facets: np.ndarray) -> np.ndarray:
    """Whether sorting the nodes of each facet reverses its orientation."""
    if facets.shape[1] == 2:
        return facets[:, 0] > facets[:, 1]
    a, b, c = facets.T
    return ((a > b).astype(int) + (b > c) + (a > c)) % 2 == 1


def match_facets(facets: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of rows of `facets` with the same nodes, as (first, second, crowded): `first` and `second` contain the two
    rows of each pair. If a facet occurs three times, `crowded` contains its three rows, and no pairs are returned."""
    facet_key_numbers = facet_keys(facets, num_points)
    sort_order = np.argsort(facet_key_numbers, kind="stable")
    sorted_keys = facet_key_numbers[sort_order]
    is_same_as_next = sorted_keys[1:] == sorted_keys[:-1]
    triply_used_positions = np.flatnonzero(is_same_as_next[1:] & is_same_as_next[:-1])
    if triply_used_positions.size:
        return sort_order[:0], sort_order[:0], sort_order[triply_used_positions[0] : triply_used_positions[0] + 3]
    equal_positions = np.flatnonzero(is_same_as_next)
    return sort_order[equal_positions], sort_order[equal_positions + 1], sort_order[:0]


def pair_facets(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interior facets as pairs of rows of `cell_facets`, and the rows of boundary facets, as (first, second, single).

    Raises `ValueError` if a facet belongs to more than two cells, or if the two cells of a facet lie on the same side
    of the facet.
    """
    facets_of_cells = cell_facets(cells)
    nodes_per_cell = cells.shape[1]
    first_facets, second_facets, overcrowded_facets = match_facets(facets_of_cells, int(cells.max()) + 1)
    if overcrowded_facets.size:
        raise ValueError(
            f"cells: the facet with nodes {np.sort(facets_of_cells[overcrowded_facets[0]]).tolist()} belongs to more "
            f"than two cells (among them {(overcrowded_facets // nodes_per_cell).tolist()}), so the mesh is not "
            "manifold. Remove the surplus cells."
        )
    is_odd_permutation = odd_permutation(facets_of_cells)
    same_orientation_pairs = np.flatnonzero(is_odd_permutation[first_facets] == is_odd_permutation[second_facets])
    if same_orientation_pairs.size:
        overlapping_cells = np.sort(
            [
                first_facets[same_orientation_pairs[0]] // nodes_per_cell,
                second_facets[same_orientation_pairs[0]] // nodes_per_cell,
            ]
        ).tolist()
        raise ValueError(
            f"cells: {same_orientation_pairs.size} pair(s) of neighbouring cells overlap, first {overlapping_cells}: "
            "both lie on the same side of the facet they share. A node has been moved across a facet (an inverted "
            "cell), or the cells come from two meshes laid over each other. Rebuild the mesh or move the node back."
        )
    is_paired = np.zeros(len(facets_of_cells), bool)
    is_paired[first_facets] = is_paired[second_facets] = True
    return first_facets, second_facets, np.flatnonzero(~is_paired)


def order_loops(facets: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Sort the boundary edges of triangles head to tail, one loop after the other, the outer loop first.

    Each loop starts at its node of the lowest index. The outer loop is the loop with positive area; without `points`,
    the loop with the most edges; for a surface in space, the longest loop. Raises `ValueError` if loops meet in a node.
    """
    facet_starts, start_counts = np.unique(facets[:, 0], return_counts=True)
    if np.any(start_counts > 1):
        raise ValueError(
            f"cells: the boundary touches itself at node {facet_starts[start_counts > 1][0]}: parts of the mesh hang "
            "together by a single node. Join them along an edge, or separate them and keep one."
        )
    next_nodes = dict(zip(facets[:, 0].tolist(), facets[:, 1].tolist(), strict=True))
    node_loops = []
    for start_node in facet_starts.tolist():
        if start_node not in next_nodes:
            continue
        loop_nodes = [start_node]
        while (next_node := next_nodes.pop(loop_nodes[-1])) != start_node:
            loop_nodes.append(next_node)
        node_loops.append(np.array(loop_nodes))
    if points is None:
        node_loops.sort(key=len, reverse=True)
    elif points.shape[1] == 3:
        node_loops.sort(
            key=lambda loop_nodes: -np.linalg.norm(points[loop_nodes] - points[np.roll(loop_nodes, -1)], axis=1).sum()
        )
    else:
        node_loops.sort(key=lambda loop_nodes: -signed_area(points[loop_nodes]))
    return np.concatenate([np.stack([loop_nodes, np.roll(loop_nodes, -1)], axis=1) for loop_nodes in node_loops])


def signed_area(outline: np.ndarray) -> float:
    """Area enclosed by a closed polygon (k, 2), positive if counter-clockwise (shoelace formula)."""
    x, y = (outline - outline[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


# Maximum number of pairs of sides that are compared at once.
_PAIRS_PER_BATCH = 250_000


def check_loop(vertices: ArrayLike, name: str, *, clockwise: bool) -> np.ndarray:
    """Check that vertices (k, 2) form a simple loop, and orient the loop as requested, keeping the first vertex. Raises
    `ValueError` unless the vertices form a simple loop."""
    try:
        loop_vertices = np.asarray(vertices, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected coordinates of shape (k, 2) in metres; {error}.") from None
    if loop_vertices.ndim != 2 or loop_vertices.shape[1] != 2 or len(loop_vertices) < 3:
        raise ValueError(f"{name}: expected at least three vertices, shape (k, 2), got {loop_vertices.shape}.")
    if not np.isfinite(loop_vertices).all():
        invalid_vertex = int(np.flatnonzero(~np.isfinite(loop_vertices).all(axis=1))[0])
        raise ValueError(
            f"{name}: vertex {invalid_vertex} is {loop_vertices[invalid_vertex].tolist()}. Every coordinate must be a "
            "finite number."
        )
    largest_side = np.ptp(loop_vertices, axis=0).max()
    side_lengths = np.linalg.norm(np.roll(loop_vertices, -1, axis=0) - loop_vertices, axis=1)
    if side_lengths.min() <= 1e-9 * largest_side:
        first_crossing_side = int(np.argmin(side_lengths))
        vertex_hint = (
            " Do not repeat the first vertex at the end."
            if first_crossing_side == len(loop_vertices) - 1
            else " Remove one."
        )
        raise ValueError(
            f"{name}: vertices {first_crossing_side} and {(first_crossing_side + 1) % len(loop_vertices)} "
            f"coincide.{vertex_hint}"
        )
    crossing_sides = _first_crossing_sides(loop_vertices)
    if crossing_sides is not None:
        raise ValueError(
            f"{name}: the outline crosses or touches itself: side {crossing_sides[0]} (from vertex "
            f"{crossing_sides[0]}) meets side {crossing_sides[1]}. Give the vertices in order along a simple closed "
            "outline."
        )
    if (signed_area(loop_vertices) < 0) != clockwise:
        loop_vertices = np.concatenate([loop_vertices[:1], loop_vertices[:0:-1]])
    return loop_vertices


def check_holes(outer_loop: np.ndarray, holes: Sequence[np.ndarray]) -> None:
    """Raise `ValueError` unless every hole lies inside the outline and is separate from the other holes."""
    for k, hole in enumerate(holes):
        if not is_inside_loops(hole, [outer_loop]).all() or _are_touching(hole, outer_loop):
            raise ValueError(f"holes[{k}]: does not lie strictly inside the outline. Move or shrink it.")
        for j, other_hole in enumerate(holes[:k]):
            if (
                _are_touching(hole, other_hole)
                or is_inside_loops(hole[:1], [other_hole])[0]
                or is_inside_loops(other_hole[:1], [hole])[0]
            ):
                raise ValueError(f"holes[{k}]: overlaps or touches holes[{j}]. Merge them into one hole.")


def is_inside_loops(points: np.ndarray, loops: Sequence[np.ndarray]) -> np.ndarray:
    """Whether points (p, 2) lie inside an odd number of loops (even-odd rule), as booleans (p,)."""
    is_inside = np.zeros(len(points), bool)
    x, y = points.T
    for loop in loops:
        for (x0, y0), (x1, y1) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            is_inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return is_inside


def project_to_loop(points: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Arc length (p,) from the first vertex of a loop to the point of the loop that is nearest to each of `points` (p,
    2)."""
    side_vectors = np.roll(loop, -1, axis=0) - loop
    vertex_offsets = points[:, None] - loop
    side_fractions = np.clip((vertex_offsets * side_vectors).sum(-1) / (side_vectors**2).sum(-1), 0.0, 1.0)
    nearest_sides = np.argmin(
        np.linalg.norm(vertex_offsets - side_fractions[..., None] * side_vectors, axis=-1), axis=1
    )
    side_lengths = np.linalg.norm(side_vectors, axis=1)
    return (
        np.cumsum(side_lengths)[nearest_sides]
        - (1 - side_fractions[np.arange(len(points)), nearest_sides]) * side_lengths[nearest_sides]
    )


def distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distances (p, s) of points (p, 2) from segments with end points `start` and `end` (s, 2)."""
    segment_directions = end - start
    start_offsets = points[:, None] - start
    segment_fractions = np.clip(
        (start_offsets * segment_directions).sum(-1) / (segment_directions**2).sum(-1), 0.0, 1.0
    )
    return np.linalg.norm(start_offsets - segment_fractions[..., None] * segment_directions, axis=-1)


def _signed_area_of_corner(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _intersecting_sides(
    first_loop: np.ndarray, second_loop: np.ndarray, touch_tolerance: float
) -> Iterator[np.ndarray]:
    """Yield, in order and in batches, pairs (p, 2) of a side of the first loop and a side of the second loop that cross
    or come within `touch_tolerance` of each other. Only sides whose bounding boxes overlap are tested."""
    a, b, c, d = first_loop, np.roll(first_loop, -1, axis=0), second_loop, np.roll(second_loop, -1, axis=0)
    lower_corners, upper_corners = np.minimum(a, b) - touch_tolerance, np.maximum(a, b) + touch_tolerance
    other_lower_corners, other_upper_corners = np.minimum(c, d), np.maximum(c, d)
    batch_size = max(1, _PAIRS_PER_BATCH // len(second_loop))
    for batch_start in range(0, len(first_loop), batch_size):
        batch_slice = slice(batch_start, batch_start + batch_size)
        are_boxes_overlapping = (
            (lower_corners[batch_slice, None] <= other_upper_corners)
            & (other_lower_corners <= upper_corners[batch_slice, None])
        ).all(axis=-1)
        first_side, second_side = np.nonzero(are_boxes_overlapping)
        first_side += batch_start
        yield np.column_stack([first_side, second_side])[
            _segments_intersect(a[first_side], b[first_side], c[second_side], d[second_side], touch_tolerance)
        ]


def _segments_intersect(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, touch_tolerance: float
) -> np.ndarray:
    """Whether each segment from a to b crosses the segment from c to d or comes within `touch_tolerance` of it; `a` to
    `d`: end points (p, 2)."""
    is_crossing = (_signed_area_of_corner(a, b, c) * _signed_area_of_corner(a, b, d) < 0) & (
        _signed_area_of_corner(c, d, a) * _signed_area_of_corner(c, d, b) < 0
    )
    is_near = (_segment_distance(a, c, d) <= touch_tolerance) | (_segment_distance(b, c, d) <= touch_tolerance)
    return (
        is_crossing
        | is_near
        | (_segment_distance(c, a, b) <= touch_tolerance)
        | (_segment_distance(d, a, b) <= touch_tolerance)
    )


def _segment_distance(points: np.ndarray, segment_starts: np.ndarray, segment_ends: np.ndarray) -> np.ndarray:
    """Distance (p,) of each of points (p, 2) from the segment of the same index."""
    segment_directions, start_offsets = segment_ends - segment_starts, points - segment_starts
    segment_fractions = np.clip(
        (start_offsets * segment_directions).sum(-1) / (segment_directions**2).sum(-1), 0.0, 1.0
    )
    return np.linalg.norm(start_offsets - segment_fractions[:, None] * segment_directions, axis=-1)


def _first_crossing_sides(loop: np.ndarray) -> tuple[int, int] | None:
    num_sides = len(loop)
    for side_pairs in _intersecting_sides(loop, loop, 1e-9 * np.ptp(loop, axis=0).max()):
        index_distance = np.abs(side_pairs[:, 0] - side_pairs[:, 1])
        nonadjacent_pairs = side_pairs[(index_distance > 1) & (index_distance < num_sides - 1)]
        if len(nonadjacent_pairs):
            return int(nonadjacent_pairs[0].min()), int(nonadjacent_pairs[0].max())
    # Neighbouring sides share a vertex, and can overlap elsewhere only by folding back onto each other.
    previous_sides, next_sides = np.roll(loop, 1, axis=0) - loop, np.roll(loop, -1, axis=0) - loop
    turning_cosine = (previous_sides * next_sides).sum(1) / (
        np.linalg.norm(previous_sides, axis=1) * np.linalg.norm(next_sides, axis=1)
    )
    folded_vertices = np.flatnonzero(turning_cosine > 1 - 1e-12)
    if folded_vertices.size:
        folded_vertex = int(folded_vertices[0])
        return (folded_vertex - 1) % num_sides, folded_vertex
    return None


def _are_touching(first_loop: np.ndarray, second_loop: np.ndarray) -> bool:
    return any(
        len(side_pairs)
        for side_pairs in _intersecting_sides(first_loop, second_loop, 1e-9 * np.ptp(second_loop, axis=0).max())
    )
