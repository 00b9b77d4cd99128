"""Delaunay triangulation of points within an outline, with all outline segments as edges of cells, and repair of bad
cells.

The steps:

1. `outline_nodes`: place nodes along the outline at distances of the cell size;
2. `insert_nodes`: insert circumcentres of cells that are too large, many at a time (Delaunay refinement);
3. `smooth_nodes`: move every free node to the weighted mean of the circumcentres around it (optimal Delaunay
   triangulation, L. Chen and J. Xu, J. Comput. Math. 22 (2004) 299), triangulating again after each step;
4. `improve_worst_cells` and `repair` until the smallest angle is large enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.spatial import Delaunay, KDTree

from jeit.mesh.generate.curve import Curve, SizeFunction, divide, is_inside_curves


@dataclass
class GeneratorState:
    """State of the mesh generator: arc lengths of the nodes on every boundary curve, and positions of the fixed and
    free nodes inside.

    `guards[k]` contains the arc lengths of the sharp corners of curve k; segments that end there are not divided.
    """

    curves: list[Curve]
    node_arc_lengths: list[np.ndarray]
    guards: list[np.ndarray]
    fixed_nodes: np.ndarray
    free_nodes: np.ndarray

    @property
    def num_outline(self) -> int:
        """Number of nodes on the outline."""
        return sum(len(arc_lengths) for arc_lengths in self.node_arc_lengths)

    @property
    def num_immovable_nodes(self) -> int:
        """Number of nodes that may not move: the nodes on the outline and the fixed nodes."""
        return self.num_outline + len(self.fixed_nodes)

    def points(self) -> np.ndarray:
        """All nodes (n, 2): the nodes of the first curve, of the second curve and so on, then fixed nodes, then free
        nodes."""
        points_on_curves = [
            curve.points_at(arc_lengths) for curve, arc_lengths in zip(self.curves, self.node_arc_lengths, strict=True)
        ]
        return np.concatenate([*points_on_curves, self.fixed_nodes, self.free_nodes])

    def segments(self) -> np.ndarray:
        """Outline segments as pairs of nodes (s, 2), in the order of their first nodes."""
        segment_arrays, first_node = [], 0
        for arc_lengths in self.node_arc_lengths:
            node_indices = np.arange(first_node, first_node + len(arc_lengths))
            segment_arrays.append(np.stack([node_indices, np.roll(node_indices, -1)], axis=1))
            first_node += len(arc_lengths)
        return np.concatenate(segment_arrays)

    def is_sharp_corner(self) -> np.ndarray:
        """Whether each node on the outline is a sharp corner (num_outline,)."""
        return np.concatenate(
            [
                np.isin(arc_lengths, guarded_lengths)
                for arc_lengths, guarded_lengths in zip(self.node_arc_lengths, self.guards, strict=True)
            ]
        )

    def divide(self, segments: np.ndarray) -> None:
        """Insert a node in the middle of each of the outline segments with the indices `segments`."""
        offset = 0
        for k, arc_lengths in enumerate(self.node_arc_lengths):
            segments_of_curve = segments[(segments >= offset) & (segments < offset + len(arc_lengths))] - offset
            curve_length = self.curves[k].length
            next_stops = np.append(arc_lengths[1:], arc_lengths[0] + curve_length)
            self.node_arc_lengths[k] = np.sort(
                np.concatenate([arc_lengths, (0.5 * (arc_lengths + next_stops))[segments_of_curve] % curve_length])
            )
            offset += len(arc_lengths)


def triangulate(state: GeneratorState, points: np.ndarray) -> np.ndarray:
    """Delaunay triangles (m, 3) inside the outline, counter-clockwise."""
    outline = points[: state.num_outline]
    # With distant auxiliary nodes, the outline is not part of the convex hull, where collinear nodes would produce
    # slivers.
    largest_side = np.ptp(outline, axis=0).max()
    angles = 2 * np.pi * (np.arange(16) + 0.37) / 16
    auxiliary_nodes = outline.mean(axis=0) + 4 * largest_side * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    cells = Delaunay(np.concatenate([points, auxiliary_nodes])).simplices
    cells = cells[(cells < len(points)).all(axis=1)]
    # A cell with a node in the interior lies inside; only cells whose nodes are all on the outline need a test.
    outline_cells = np.flatnonzero((cells < state.num_outline).all(axis=1))
    is_inside = np.ones(len(cells), bool)
    is_inside[outline_cells] = is_inside_curves(state.curves, points[cells[outline_cells]].mean(axis=1))
    cells = cells[is_inside]
    is_clockwise = doubled_areas(points, cells) < 0
    cells[is_clockwise] = cells[is_clockwise][:, [0, 2, 1]]
    return cells


def cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (…) of plane vectors (…, 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def doubled_areas(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Twice the signed area (m,) of the triangles."""
    cell_corners = points[cells]
    return cross_product(cell_corners[:, 1] - cell_corners[:, 0], cell_corners[:, 2] - cell_corners[:, 0])


def circumcircles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (m, 2) and radii (m,) of the circumscribed circles."""
    a = points[cells[:, 0]]
    b, c = points[cells[:, 1]] - a, points[cells[:, 2]] - a
    scaled_areas = 2 * cross_product(b, c)
    scaled_areas = np.where(np.abs(scaled_areas) < 1e-300, 1e-300, scaled_areas)
    bb, cc = (b**2).sum(1), (c**2).sum(1)
    centres = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / scaled_areas[:, None]
    return a + centres, np.linalg.norm(centres, axis=1)


def smallest_angles(corners: np.ndarray) -> np.ndarray:
    """Smallest angle (…) of triangles (…, 3, 2), in degrees; negative for clockwise triangles."""
    edge_vectors = np.roll(corners, -1, axis=-2) - corners
    sorted_lengths = np.sort(np.sqrt((edge_vectors**2).sum(-1)), axis=-1)
    doubled_area = cross_product(edge_vectors[..., 0, :], edge_vectors[..., 1, :])
    # Sine of the angle opposite to the shortest side, which is below 90°, so that its arcsine is the angle.
    sine_of_smallest = doubled_area / np.maximum(sorted_lengths[..., 1] * sorted_lengths[..., 2], 1e-300)
    return np.degrees(np.arcsin(np.clip(sine_of_smallest, -1.0, 1.0)))


def select_spaced_points(points: np.ndarray, radius: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """Select points greedily in order of decreasing `priority`, skipping points within `radius` of a selected point.
    Returns the indices of the selected points."""
    priority_order = np.argsort(-priority, kind="stable")
    neighbour_lists = KDTree(points[priority_order]).query_ball_point(
        points[priority_order], radius[priority_order], return_sorted=False
    )
    is_selected = np.zeros(len(points), bool)
    is_blocked = np.zeros(len(points), bool)
    for priority_rank, neighbour_indices in enumerate(neighbour_lists):
        if not is_blocked[priority_rank]:
            is_selected[priority_rank] = True
            is_blocked[neighbour_indices] = True
    return priority_order[is_selected]


def is_away_from_outline(state: GeneratorState, nodes: np.ndarray, points: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Whether each of `points` lies inside the outline, at a distance of more than `gap` from the outline. `nodes` are
    the nodes of `state`."""
    if not len(points):
        return np.zeros(0, bool)
    segments = state.segments()
    start_points, end_points = nodes[segments[:, 0]], nodes[segments[:, 1]]
    midpoint_tree = KDTree(0.5 * (start_points + end_points))
    _, nearest_segments = midpoint_tree.query(points, k=min(3, len(segments)))
    distances = np.full(len(points), np.inf)
    for nearest in nearest_segments.reshape(len(points), -1).T:
        directions, offsets = end_points[nearest] - start_points[nearest], points - start_points[nearest]
        fractions = np.clip((offsets * directions).sum(1) / (directions**2).sum(1), 0.0, 1.0)
        distances = np.minimum(distances, np.linalg.norm(offsets - fractions[:, None] * directions, axis=1))
    is_away = distances > gap
    is_away[is_away] = is_inside_curves(state.curves, points[is_away])
    return is_away


# Angles in degrees: the guaranteed minimum angle; the minimum that `repair` aims at, which is slightly larger; and the
# angle below which `improve_worst_cells` improves a cell. Last, the maximum number of rounds of `repair`.
GUARANTEED_MIN_ANGLE = 25.0
_MIN_ANGLE_OF_REPAIR = 25.5
_IMPROVEMENT_ANGLE = 31.0
_MAX_REPAIR_ROUNDS = 120

_TRIAL_ANGLES = 2 * np.pi * np.arange(8) / 8
_TRIAL_DIRECTIONS = np.stack([np.cos(_TRIAL_ANGLES), np.sin(_TRIAL_ANGLES)], axis=1)
_TRIAL_DISPLACEMENTS = np.concatenate([length * _TRIAL_DIRECTIONS for length in (0.02, 0.06, 0.15, 0.3)])


def is_improvable(state: GeneratorState, cells: np.ndarray) -> np.ndarray:
    """Whether each cell can be improved; a cell at a sharp corner cannot, since the outline determines its shape."""
    is_sharp_node = np.zeros(cells.max() + 1, bool)
    is_sharp_node[: state.num_outline] = state.is_sharp_corner()
    return np.logical_not(is_sharp_node[cells].any(axis=1))


def missing_segments(state: GeneratorState, cells: np.ndarray, num_points: int) -> np.ndarray:
    """Indices of the outline segments that are not edges of cells."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]).astype(np.int64)
    segments = state.segments().astype(np.int64)
    is_edge = np.isin(segments[:, 0] * num_points + segments[:, 1], edges[:, 0] * num_points + edges[:, 1])
    return np.flatnonzero(~is_edge)


def improve_worst_cells(state: GeneratorState, num_passes: int = 4) -> None:
    """Move the free nodes of the worst cells so that the smallest angle around each of these nodes grows.

    Steps in eight directions are tried for each node, because the smallest angle is not differentiable where two cells
    have equal smallest angles.
    """
    num_immovable_nodes = state.num_immovable_nodes
    for _ in range(num_passes):
        points = state.points()
        cells = triangulate(state, points)
        cell_angles = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((cell_angles < _IMPROVEMENT_ANGLE) & is_improvable(state, cells))
        movable_nodes = np.unique(cells[bad_cells])
        movable_nodes = movable_nodes[movable_nodes >= num_immovable_nodes]
        if not movable_nodes.size:
            return
        sort_order = np.argsort(cells.ravel(), kind="stable")
        star_bounds = np.searchsorted(cells.ravel()[sort_order], np.arange(len(points) + 1))
        has_moved = False
        for moved_node in movable_nodes.tolist():
            star_corners = sort_order[star_bounds[moved_node] : star_bounds[moved_node + 1]]
            corner_of_star = star_corners % 3
            star_cells = cells[star_corners // 3]
            second_corners = points[star_cells[np.arange(len(star_corners)), (corner_of_star + 1) % 3]]
            third_corners = points[star_cells[np.arange(len(star_corners)), (corner_of_star + 2) % 3]]
            mean_length = np.linalg.norm(second_corners - points[moved_node], axis=1).mean()
            trial_points = points[moved_node] + np.concatenate([np.zeros((1, 2)), mean_length * _TRIAL_DISPLACEMENTS])
            corner_shape = (len(trial_points), len(star_corners), 2)
            trial_corners = np.stack(
                [
                    np.broadcast_to(trial_points[:, None], corner_shape),
                    np.broadcast_to(second_corners, corner_shape),
                    np.broadcast_to(third_corners, corner_shape),
                ],
                axis=2,
            )
            min_angles = smallest_angles(trial_corners).min(axis=1)
            best_index = int(np.argmax(min_angles))
            if min_angles[best_index] > min_angles[0] + 1e-3:
                points[moved_node] = trial_points[best_index]
                has_moved = True
        state.free_nodes = points[num_immovable_nodes:]
        if not has_moved:
            return


def repair(state: GeneratorState) -> bool:
    """Insert nodes until all outline segments are edges and every cell has the required minimum angle. Returns False if
    some cell or segment is still bad after the maximum number of rounds.

    J. Ruppert, J. Algorithms 18 (1995) 548: a node is inserted at the circumcentre of a bad cell, unless the node would
    lie too close to an outline segment, which is halved instead. In each round, many cells far enough from each other
    are treated at once.
    """
    for round_number in range(_MAX_REPAIR_ROUNDS):
        points = state.points()
        cells = triangulate(state, points)
        missing_indices = missing_segments(state, cells, len(points))
        if missing_indices.size:
            _fix_edges(state, points, missing_indices, removes_nodes=round_number < 10)
            continue
        min_angles = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((min_angles < _MIN_ANGLE_OF_REPAIR) & is_improvable(state, cells))
        if not bad_cells.size:
            return True
        _insert_circumcentres(state, points, cells[bad_cells], min_angles[bad_cells])
        if round_number % 3 == 2:
            improve_worst_cells(state, num_passes=2)
    return False


def _diametral_circles(generator_state: GeneratorState, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    end_points = points[generator_state.segments()]
    return end_points.mean(axis=1), 0.5 * np.linalg.norm(end_points[:, 1] - end_points[:, 0], axis=1)


def _is_divisible(generator_state: GeneratorState) -> np.ndarray:
    """Whether each outline segment may be divided: neither of its ends is a sharp corner."""
    return np.logical_not(generator_state.is_sharp_corner()[generator_state.segments()].any(axis=1))


def _fix_edges(state: GeneratorState, points: np.ndarray, missing_indices: np.ndarray, *, removes_nodes: bool) -> None:
    """Make missing outline segments appear as edges of cells: remove the free nodes close to them or, if there are
    none, halve the segments."""
    centres, radii = _diametral_circles(state, points)
    if removes_nodes and len(state.free_nodes):
        close_nodes = KDTree(state.free_nodes).query_ball_point(centres[missing_indices], radii[missing_indices])
        removed_nodes = np.unique(np.concatenate([np.asarray(indices, dtype=int) for indices in close_nodes]))
        if removed_nodes.size:
            state.free_nodes = np.delete(state.free_nodes, removed_nodes, axis=0)
            return
    is_divisible = _is_divisible(state)[missing_indices]
    state.divide(missing_indices[is_divisible])


def _insert_circumcentres(state: GeneratorState, points: np.ndarray, bad_cells: np.ndarray, angles: np.ndarray) -> None:
    centres, radii = circumcircles(points, bad_cells)
    spaced_indices = select_spaced_points(centres, radii, -angles)
    centres = centres[spaced_indices]
    segment_middles, segment_radii = _diametral_circles(state, points)
    is_divisible = _is_divisible(state)
    # A segment is encroached upon if a new node lies in the circle whose diameter is the segment.
    encroaching_centres = KDTree(centres).query_ball_point(segment_middles, segment_radii * (1 - 1e-9))
    is_encroached = np.array([len(centre_indices) > 0 for centre_indices in encroaching_centres])
    is_affected = np.zeros(len(centres), bool)
    for cell_index in np.flatnonzero(is_encroached):
        is_affected[encroaching_centres[cell_index]] = True
    is_outside = ~is_inside_curves(state.curves, centres)
    outside_centres = np.flatnonzero(is_outside & ~is_affected)
    if outside_centres.size:
        is_encroached[KDTree(segment_middles).query(centres[outside_centres])[1]] = True
    accepted = centres[~is_affected & ~is_outside]
    if len(accepted):
        accepted = accepted[is_away_from_outline(state, points, accepted, np.zeros(len(accepted)))]
    halved_segments = np.flatnonzero(is_encroached & is_divisible)
    state.free_nodes = np.concatenate([state.free_nodes, accepted])
    state.divide(halved_segments)


# Maximum ratio of circumradius to cell size, chosen so that the mean edge equals the cell size (the ratio of an
# equilateral triangle is 0.577).
_MAX_CIRCUMRADIUS_RATIO = 0.74
_SMOOTHING_STEPS = 14
# Angle below which a corner is cut off by a single isosceles cell: two cells there would be too thin.
_MAX_SHARP_CORNER_ANGLE = np.radians(75.0)


def outline_nodes(
    curves: list[Curve], arc_lengths: list[np.ndarray], fixed_nodes: np.ndarray, size: SizeFunction, guard_ratio: float
) -> GeneratorState:
    """Place nodes on the outline and cut off sharp corners at a distance of `guard_ratio` times the local cell size."""
    stops_of_curves, guarded_lengths = [], []
    for curve, required_stops in zip(curves, arc_lengths, strict=True):
        stop_lengths = np.unique(np.concatenate([curve.corners, required_stops % curve.length]))
        sharp_corners = np.flatnonzero(curve.angles < _MAX_SHARP_CORNER_ANGLE)
        added_stops = []
        for sharp_corner in sharp_corners:
            corner_length = curve.corners[sharp_corner]
            gap_to_next = np.min((stop_lengths - corner_length - 1e-12 * curve.length) % curve.length)
            gap_to_previous = np.min((corner_length - stop_lengths - 1e-12 * curve.length) % curve.length)
            cut_length = min(
                guard_ratio * float(size(curve.points_at(np.array([corner_length])))[0]),
                0.45 * gap_to_next,
                0.45 * gap_to_previous,
            )
            added_stops += [(corner_length + cut_length) % curve.length, (corner_length - cut_length) % curve.length]
        stops_of_curves.append(divide(curve, np.concatenate([stop_lengths, added_stops]), size))
        guarded_lengths.append(curve.corners[sharp_corners])
    return GeneratorState(curves, stops_of_curves, guarded_lengths, fixed_nodes, np.zeros((0, 2)))


def insert_nodes(state: GeneratorState, size: SizeFunction) -> None:
    """Insert nodes until no cell is larger than `size` allows."""
    for _ in range(200):
        points = state.points()
        cells = triangulate(state, points)
        centre, radii = circumcircles(points, cells)
        sizes = size(centre)
        is_large = radii > _MAX_CIRCUMRADIUS_RATIO * sizes
        centre, ratio, sizes = centre[is_large], (radii / sizes)[is_large], sizes[is_large]
        is_away = is_away_from_outline(state, points, centre, 0.5 * sizes)
        if not is_away.any():
            return
        centre, ratio, sizes = centre[is_away], ratio[is_away], sizes[is_away]
        state.free_nodes = np.concatenate([state.free_nodes, centre[select_spaced_points(centre, 0.95 * sizes, ratio)]])


def smooth_nodes(state: GeneratorState, size: SizeFunction, steps: int = _SMOOTHING_STEPS) -> None:
    """Move the free nodes towards the optimal Delaunay triangulation for the requested cell sizes."""
    num_immovable_nodes = state.num_immovable_nodes
    if not len(state.free_nodes):
        return
    for _ in range(steps):
        points = state.points()
        cells = triangulate(state, points)
        cell_corners = points[cells]
        centroids = cell_corners.mean(axis=1)
        shifts = circumcircles(points, cells)[0] - centroids
        # The circumcentre of an obtuse cell lies far outside it and would displace nodes too far.
        radii = np.linalg.norm(cell_corners - centroids[:, None], axis=2).max(axis=1)
        shifts *= np.minimum(1.0, radii / np.maximum(np.linalg.norm(shifts, axis=1), 1e-300))[:, None]
        weights = doubled_areas(points, cells) / size(centroids) ** 3
        weighted_centres = weights[:, None] * np.concatenate([centroids + shifts, np.ones((len(cells), 1))], axis=1)
        node_sums = np.stack(
            [
                np.bincount(cells.ravel(), np.repeat(weight_column, 3), minlength=len(points))
                for weight_column in weighted_centres.T
            ],
            axis=1,
        )[num_immovable_nodes:]
        has_cells = node_sums[:, 2] > 0
        target_points = np.where(
            has_cells[:, None], node_sums[:, :2] / np.where(has_cells, node_sums[:, 2], 1.0)[:, None], state.free_nodes
        )
        is_away = is_away_from_outline(state, points, target_points, 0.45 * size(target_points))
        state.free_nodes = np.where(is_away[:, None], target_points, state.free_nodes)


def generate(
    curves: list[Curve],
    arc_lengths: list[np.ndarray],
    fixed_nodes: np.ndarray,
    size: SizeFunction,
    state: GeneratorState | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the region inside the first of `curves` and outside the other curves, which are holes: points (n, 2) and
    cells (m, 3).

    Nodes are placed at `arc_lengths`, arc lengths on each curve, and at `fixed_nodes`, points (f, 2) inside the region.
    `size` returns the requested edge length at points (p, 2). If `state` is specified, it must already be filled for
    this size, and the steps `outline_nodes` and `insert_nodes` are skipped. Node 0 is the first node of the first
    curve. Raises `ValueError` if no mesh with the guaranteed minimum angle is found.
    """
    for guard_ratio in (1.0, 0.5, 0.25):
        if state is None:
            state = outline_nodes(curves, arc_lengths, fixed_nodes, size, guard_ratio)
            insert_nodes(state, size)
        smooth_nodes(state, size)
        improve_worst_cells(state)
        is_repaired = repair(state)
        improve_worst_cells(state, num_passes=1)
        points = state.points()
        cells = triangulate(state, points)
        min_angles = smallest_angles(points[cells])
        if is_repaired and min_angles[is_improvable(state, cells)].min(initial=90.0) >= GUARANTEED_MIN_ANGLE:
            return order_nodes(points, cells)
        state = None
    raise ValueError(
        "refine: no mesh with angles of at least 25° was found for this outline and these cell sizes. Ask for smaller "
        "cells near narrow places and nodes that lie close together, or for slower growth."
    )


def order_nodes(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber nodes and cells so that neighbours have close indices; node 0 stays first, and unused nodes are
    removed."""
    used_nodes = np.unique(cells)
    new_index = np.full(len(points), -1)
    new_index[used_nodes] = np.arange(len(used_nodes))
    points, cells = points[used_nodes], new_index[cells]
    cell_edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    node_graph = coo_array((np.ones(len(cell_edges)), (cell_edges[:, 0], cell_edges[:, 1])), shape=(len(points),) * 2)
    node_order = reverse_cuthill_mckee((node_graph + node_graph.T).tocsr(), symmetric_mode=True)
    node_order = np.concatenate([[0], node_order[node_order != 0]])
    node_ranks = np.empty(len(points), dtype=np.int64)
    node_ranks[node_order] = np.arange(len(points))
    cells = node_ranks[cells]
    return points[node_order], cells[np.argsort(cells.min(axis=1), kind="stable")]
