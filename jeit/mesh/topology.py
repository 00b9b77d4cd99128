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
    key = np.zeros(len(facets), dtype=np.int64)
    for column in np.sort(facets.astype(np.int64), axis=1).T:
        key = key * num_points + column
    return key


def odd_permutation(facets: np.ndarray) -> np.ndarray:
    """Whether sorting the nodes of each facet reverses its orientation."""
    if facets.shape[1] == 2:
        return facets[:, 0] > facets[:, 1]
    a, b, c = facets.T
    return ((a > b).astype(int) + (b > c) + (a > c)) % 2 == 1


def match_facets(facets: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of rows of `facets` with the same nodes, as (first, second, crowded): `first` and `second` contain the two
    rows of each pair. If a facet occurs three times, `crowded` contains its three rows, and no pairs are returned."""
    key = facet_keys(facets, num_points)
    sort_order = np.argsort(key, kind="stable")
    sorted_keys = key[sort_order]
    is_same_as_next = sorted_keys[1:] == sorted_keys[:-1]
    triply_used_positions = np.flatnonzero(is_same_as_next[1:] & is_same_as_next[:-1])
    if triply_used_positions.size:
        return sort_order[:0], sort_order[:0], sort_order[triply_used_positions[0] : triply_used_positions[0] + 3]
    position = np.flatnonzero(is_same_as_next)
    return sort_order[position], sort_order[position + 1], sort_order[:0]


def pair_facets(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interior facets as pairs of rows of `cell_facets`, and the rows of boundary facets, as (first, second, single).

    Raises `ValueError` if a facet belongs to more than two cells, or if the two cells of a facet lie on the same side
    of the facet.
    """
    facets = cell_facets(cells)
    width = cells.shape[1]
    first_facets, second_facets, overcrowded_facets = match_facets(facets, int(cells.max()) + 1)
    if overcrowded_facets.size:
        raise ValueError(
            f"cells: the facet with nodes {np.sort(facets[overcrowded_facets[0]]).tolist()} belongs to more than two "
            f"cells (among them {(overcrowded_facets // width).tolist()}), so the mesh is not manifold. Remove the "
            "surplus cells."
        )
    is_odd_permutation = odd_permutation(facets)
    overlaps = np.flatnonzero(is_odd_permutation[first_facets] == is_odd_permutation[second_facets])
    if overlaps.size:
        pair = np.sort([first_facets[overlaps[0]] // width, second_facets[overlaps[0]] // width]).tolist()
        raise ValueError(
            f"cells: {overlaps.size} pair(s) of neighbouring cells overlap, first {pair}: both lie on the same side "
            "of the facet they share. A node has been moved across a facet (an inverted cell), or the cells "
            "come from two meshes laid over each other. Rebuild the mesh or move the node back."
        )
    is_paired = np.zeros(len(facets), bool)
    is_paired[first_facets] = is_paired[second_facets] = True
    return first_facets, second_facets, np.flatnonzero(~is_paired)


def order_loops(facets: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Sort the boundary edges of triangles head to tail, one loop after the other, the outer loop first.

    Each loop starts at its node of the lowest index. The outer loop is the loop with positive area; without `points`,
    the loop with the most edges; for a surface in space, the longest loop. Raises `ValueError` if loops meet in a node.
    """
    start, counts = np.unique(facets[:, 0], return_counts=True)
    if np.any(counts > 1):
        raise ValueError(
            f"cells: the boundary touches itself at node {start[counts > 1][0]}: parts of the mesh hang together "
            "by a single node. Join them along an edge, or separate them and keep one."
        )
    next_nodes = dict(zip(facets[:, 0].tolist(), facets[:, 1].tolist(), strict=True))
    loops = []
    for node in start.tolist():
        if node not in next_nodes:
            continue
        loop = [node]
        while (next_node := next_nodes.pop(loop[-1])) != node:
            loop.append(next_node)
        loops.append(np.array(loop))
    if points is None:
        loops.sort(key=len, reverse=True)
    elif points.shape[1] == 3:
        loops.sort(key=lambda loop: -np.linalg.norm(points[loop] - points[np.roll(loop, -1)], axis=1).sum())
    else:
        loops.sort(key=lambda loop: -signed_area(points[loop]))
    return np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops])


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
        loop = np.asarray(vertices, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected coordinates of shape (k, 2) in metres; {error}.") from None
    if loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3:
        raise ValueError(f"{name}: expected at least three vertices, shape (k, 2), got {loop.shape}.")
    if not np.isfinite(loop).all():
        invalid_vertex = int(np.flatnonzero(~np.isfinite(loop).all(axis=1))[0])
        raise ValueError(
            f"{name}: vertex {invalid_vertex} is {loop[invalid_vertex].tolist()}. Every coordinate must be a finite "
            "number."
        )
    largest_side = np.ptp(loop, axis=0).max()
    length = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    if length.min() <= 1e-9 * largest_side:
        first_index = int(np.argmin(length))
        vertex_hint = " Do not repeat the first vertex at the end." if first_index == len(loop) - 1 else " Remove one."
        raise ValueError(f"{name}: vertices {first_index} and {(first_index + 1) % len(loop)} coincide.{vertex_hint}")
    sides = _first_crossing(loop)
    if sides is not None:
        raise ValueError(
            f"{name}: the outline crosses or touches itself: side {sides[0]} (from vertex {sides[0]}) meets side "
            f"{sides[1]}. Give the vertices in order along a simple closed outline."
        )
    if (signed_area(loop) < 0) != clockwise:
        loop = np.concatenate([loop[:1], loop[:0:-1]])
    return loop


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
    result = np.zeros(len(points), bool)
    x, y = points.T
    for loop in loops:
        for (x0, y0), (x1, y1) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            result ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return result


def project_to_loop(points: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Arc length (p,) from the first vertex of a loop to the point of the loop that is nearest to each of `points` (p,
    2)."""
    sides = np.roll(loop, -1, axis=0) - loop
    offset = points[:, None] - loop
    fraction = np.clip((offset * sides).sum(-1) / (sides**2).sum(-1), 0.0, 1.0)
    nearest_sides = np.argmin(np.linalg.norm(offset - fraction[..., None] * sides, axis=-1), axis=1)
    length = np.linalg.norm(sides, axis=1)
    return (
        np.cumsum(length)[nearest_sides] - (1 - fraction[np.arange(len(points)), nearest_sides]) * length[nearest_sides]
    )


def distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distances (p, s) of points (p, 2) from segments with end points `start` and `end` (s, 2)."""
    direction = end - start
    offset = points[:, None] - start
    fraction = np.clip((offset * direction).sum(-1) / (direction**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - fraction[..., None] * direction, axis=-1)


def _signed_area_of_corner(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _intersecting_sides(first_loop: np.ndarray, second_loop: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Yield, in order and in batches, pairs (p, 2) of a side of the first loop and a side of the second loop that cross
    or come within `tolerance` of each other. Only sides whose bounding boxes overlap are tested."""
    a, b, c, d = first_loop, np.roll(first_loop, -1, axis=0), second_loop, np.roll(second_loop, -1, axis=0)
    lower_corners, upper_corners = np.minimum(a, b) - tolerance, np.maximum(a, b) + tolerance
    other_lower_corners, other_upper_corners = np.minimum(c, d), np.maximum(c, d)
    batch_size = max(1, _PAIRS_PER_BATCH // len(second_loop))
    for start in range(0, len(first_loop), batch_size):
        block = slice(start, start + batch_size)
        boxes_overlap = (
            (lower_corners[block, None] <= other_upper_corners) & (other_lower_corners <= upper_corners[block, None])
        ).all(axis=-1)
        first_side, second_side = np.nonzero(boxes_overlap)
        first_side += start
        yield np.column_stack([first_side, second_side])[
            _intersects(a[first_side], b[first_side], c[second_side], d[second_side], tolerance)
        ]


def _intersects(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether each segment from a to b crosses the segment from c to d or comes within `tolerance` of it; `a` to `d`:
    end points (p, 2)."""
    is_crossing = (_signed_area_of_corner(a, b, c) * _signed_area_of_corner(a, b, d) < 0) & (
        _signed_area_of_corner(c, d, a) * _signed_area_of_corner(c, d, b) < 0
    )
    is_near = (_segment_distance(a, c, d) <= tolerance) | (_segment_distance(b, c, d) <= tolerance)
    return is_crossing | is_near | (_segment_distance(c, a, b) <= tolerance) | (_segment_distance(d, a, b) <= tolerance)


def _segment_distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance (p,) of each of points (p, 2) from the segment of the same index."""
    direction, offset = end - start, points - start
    fraction = np.clip((offset * direction).sum(-1) / (direction**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - fraction[:, None] * direction, axis=-1)


def _first_crossing(loop: np.ndarray) -> tuple[int, int] | None:
    num_sides = len(loop)
    for pairs in _intersecting_sides(loop, loop, 1e-9 * np.ptp(loop, axis=0).max()):
        index_distance = np.abs(pairs[:, 0] - pairs[:, 1])
        nonadjacent_pairs = pairs[(index_distance > 1) & (index_distance < num_sides - 1)]
        if len(nonadjacent_pairs):
            return int(nonadjacent_pairs[0].min()), int(nonadjacent_pairs[0].max())
    # Neighbouring sides share a vertex, and can overlap elsewhere only by folding back onto each other.
    previous_sides, next_sides = np.roll(loop, 1, axis=0) - loop, np.roll(loop, -1, axis=0) - loop
    cosine = (previous_sides * next_sides).sum(1) / (
        np.linalg.norm(previous_sides, axis=1) * np.linalg.norm(next_sides, axis=1)
    )
    folded_vertices = np.flatnonzero(cosine > 1 - 1e-12)
    if folded_vertices.size:
        vertex = int(folded_vertices[0])
        return (vertex - 1) % num_sides, vertex
    return None


def _are_touching(first_loop: np.ndarray, second_loop: np.ndarray) -> bool:
    return any(
        len(pairs) for pairs in _intersecting_sides(first_loop, second_loop, 1e-9 * np.ptp(second_loop, axis=0).max())
    )
