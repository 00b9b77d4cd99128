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
        on_curves = [
            curve.points_at(arc_lengths) for curve, arc_lengths in zip(self.curves, self.node_arc_lengths, strict=True)
        ]
        return np.concatenate([*on_curves, self.fixed_nodes, self.free_nodes])

    def segments(self) -> np.ndarray:
        """Outline segments as pairs of nodes (s, 2), in the order of their first nodes."""
        segments, offset = [], 0
        for arc_lengths in self.node_arc_lengths:
            node_indices = np.arange(offset, offset + len(arc_lengths))
            segments.append(np.stack([node_indices, np.roll(node_indices, -1)], axis=1))
            offset += len(arc_lengths)
        return np.concatenate(segments)

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
            length = self.curves[k].length
            next_stops = np.append(arc_lengths[1:], arc_lengths[0] + length)
            self.node_arc_lengths[k] = np.sort(
                np.concatenate([arc_lengths, (0.5 * (arc_lengths + next_stops))[segments_of_curve] % length])
            )
            offset += len(arc_lengths)


def triangulate(state: GeneratorState, points: np.ndarray) -> np.ndarray:
    """Delaunay triangles (m, 3) inside the outline, counter-clockwise."""
    outline = points[: state.num_outline]
    # With distant auxiliary nodes, the outline is not part of the convex hull, where collinear nodes would produce
    # slivers.
    largest_side = np.ptp(outline, axis=0).max()
    angle = 2 * np.pi * (np.arange(16) + 0.37) / 16
    auxiliary_nodes = outline.mean(axis=0) + 4 * largest_side * np.stack([np.cos(angle), np.sin(angle)], axis=1)
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
    corners = points[cells]
    return cross_product(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def circumcircles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (m, 2) and radii (m,) of the circumscribed circles."""
    a = points[cells[:, 0]]
    b, c = points[cells[:, 1]] - a, points[cells[:, 2]] - a
    area = 2 * cross_product(b, c)
    area = np.where(np.abs(area) < 1e-300, 1e-300, area)
    bb, cc = (b**2).sum(1), (c**2).sum(1)
    centre = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / area[:, None]
    return a + centre, np.linalg.norm(centre, axis=1)


def smallest_angles(corners: np.ndarray) -> np.ndarray:
    """Smallest angle (…) of triangles (…, 3, 2), in degrees; negative for clockwise triangles."""
    edges = np.roll(corners, -1, axis=-2) - corners
    length = np.sort(np.sqrt((edges**2).sum(-1)), axis=-1)
    area = cross_product(edges[..., 0, :], edges[..., 1, :])
    # Sine of the angle opposite to the shortest side, which is below 90°, so that its arcsine is the angle.
    sine = area / np.maximum(length[..., 1] * length[..., 2], 1e-300)
    return np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))


def select_spaced_points(points: np.ndarray, radius: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """Select points greedily in order of decreasing `priority`, skipping points within `radius` of a selected point.
    Returns the indices of the selected points."""
    priority_order = np.argsort(-priority, kind="stable")
    neighbours = KDTree(points[priority_order]).query_ball_point(
        points[priority_order], radius[priority_order], return_sorted=False
    )
    is_selected = np.zeros(len(points), bool)
    is_blocked = np.zeros(len(points), bool)
    for rank, neighbour_indices in enumerate(neighbours):
        if not is_blocked[rank]:
            is_selected[rank] = True
            is_blocked[neighbour_indices] = True
    return priority_order[is_selected]


def is_away_from_outline(state: GeneratorState, nodes: np.ndarray, points: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Whether each of `points` lies inside the outline, at a distance of more than `gap` from the outline. `nodes` are
    the nodes of `state`."""
    if not len(points):
        return np.zeros(0, bool)
    segments = state.segments()
    start, end = nodes[segments[:, 0]], nodes[segments[:, 1]]
    tree = KDTree(0.5 * (start + end))
    _, nearest_segments = tree.query(points, k=min(3, len(segments)))
    distances = np.full(len(points), np.inf)
    for column in nearest_segments.reshape(len(points), -1).T:
        direction, offset = end[column] - start[column], points - start[column]
        fraction = np.clip((offset * direction).sum(1) / (direction**2).sum(1), 0.0, 1.0)
        distances = np.minimum(distances, np.linalg.norm(offset - fraction[:, None] * direction, axis=1))
    is_away = distances > gap
    is_away[is_away] = is_inside_curves(state.curves, points[is_away])
    return is_away


# Angles in degrees: the guaranteed minimum angle; the minimum that `repair` aims at, which is slightly larger; and the
# angle below which `improve_worst_cells` improves a cell. Last, the maximum number of rounds of `repair`.
GUARANTEED_MIN_ANGLE = 25.0
_MIN_ANGLE_OF_REPAIR = 25.5
_IMPROVEMENT_ANGLE = 31.0
_MAX_REPAIR_ROUNDS = 120

_STEP_ANGLES = 2 * np.pi * np.arange(8) / 8
_STEP_DIRECTIONS = np.stack([np.cos(_STEP_ANGLES), np.sin(_STEP_ANGLES)], axis=1)
_TRIAL_DISPLACEMENTS = np.concatenate([length * _STEP_DIRECTIONS for length in (0.02, 0.06, 0.15, 0.3)])


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
        angle = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((angle < _IMPROVEMENT_ANGLE) & is_improvable(state, cells))
        movable_nodes = np.unique(cells[bad_cells])
        movable_nodes = movable_nodes[movable_nodes >= num_immovable_nodes]
        if not movable_nodes.size:
            return
        sort_order = np.argsort(cells.ravel(), kind="stable")
        bounds = np.searchsorted(cells.ravel()[sort_order], np.arange(len(points) + 1))
        has_moved = False
        for node in movable_nodes.tolist():
            star_corners = sort_order[bounds[node] : bounds[node + 1]]
            corner = star_corners % 3
            star_cells = cells[star_corners // 3]
            second_corners = points[star_cells[np.arange(len(star_corners)), (corner + 1) % 3]]
            third_corners = points[star_cells[np.arange(len(star_corners)), (corner + 2) % 3]]
            mean_length = np.linalg.norm(second_corners - points[node], axis=1).mean()
            trial_points = points[node] + np.concatenate([np.zeros((1, 2)), mean_length * _TRIAL_DISPLACEMENTS])
            shape = (len(trial_points), len(star_corners), 2)
            corners = np.stack(
                [
                    np.broadcast_to(trial_points[:, None], shape),
                    np.broadcast_to(second_corners, shape),
                    np.broadcast_to(third_corners, shape),
                ],
                axis=2,
            )
            min_angles = smallest_angles(corners).min(axis=1)
            best_index = int(np.argmax(min_angles))
            if min_angles[best_index] > min_angles[0] + 1e-3:
                points[node] = trial_points[best_index]
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
            _recover(state, points, missing_indices, removes_nodes=round_number < 10)
            continue
        angle = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((angle < _MIN_ANGLE_OF_REPAIR) & is_improvable(state, cells))
        if not bad_cells.size:
            return True
        _insert_circumcentres(state, points, cells[bad_cells], angle[bad_cells])
        if round_number % 3 == 2:
            improve_worst_cells(state, num_passes=2)
    return False


def _diametral_circles(state: GeneratorState, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    end_points = points[state.segments()]
    return end_points.mean(axis=1), 0.5 * np.linalg.norm(end_points[:, 1] - end_points[:, 0], axis=1)


def _is_divisible(state: GeneratorState) -> np.ndarray:
    """Whether each outline segment may be divided: neither of its ends is a sharp corner."""
    return np.logical_not(state.is_sharp_corner()[state.segments()].any(axis=1))


def _recover(state: GeneratorState, points: np.ndarray, missing_indices: np.ndarray, *, removes_nodes: bool) -> None:
    """Make missing outline segments appear as edges of cells: remove the free nodes close to them or, if there are
    none, halve the segments."""
    centres, radii = _diametral_circles(state, points)
    if removes_nodes and len(state.free_nodes):
        neighbours = KDTree(state.free_nodes).query_ball_point(centres[missing_indices], radii[missing_indices])
        removed_nodes = np.unique(np.concatenate([np.asarray(indices, dtype=int) for indices in neighbours]))
        if removed_nodes.size:
            state.free_nodes = np.delete(state.free_nodes, removed_nodes, axis=0)
            return
    is_divisible = _is_divisible(state)[missing_indices]
    state.divide(missing_indices[is_divisible])


def _insert_circumcentres(state: GeneratorState, points: np.ndarray, bad_cells: np.ndarray, angle: np.ndarray) -> None:
    centre, radius = circumcircles(points, bad_cells)
    selected = select_spaced_points(centre, radius, -angle)
    centre = centre[selected]
    centres, radii = _diametral_circles(state, points)
    is_divisible = _is_divisible(state)
    # A segment is encroached upon if a new node lies in the circle whose diameter is the segment.
    neighbours = KDTree(centre).query_ball_point(centres, radii * (1 - 1e-9))
    is_encroached = np.array([len(indices) > 0 for indices in neighbours])
    is_affected = np.zeros(len(centre), bool)
    for cell_index in np.flatnonzero(is_encroached):
        is_affected[neighbours[cell_index]] = True
    is_outside = ~is_inside_curves(state.curves, centre)
    outside_centres = np.flatnonzero(is_outside & ~is_affected)
    if outside_centres.size:
        is_encroached[KDTree(centres).query(centre[outside_centres])[1]] = True
    accepted = centre[~is_affected & ~is_outside]
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
        for corner in sharp_corners:
            corner_length = curve.corners[corner]
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
        centre, radius = circumcircles(points, cells)
        sizes = size(centre)
        is_large = radius > _MAX_CIRCUMRADIUS_RATIO * sizes
        centre, ratio, sizes = centre[is_large], (radius / sizes)[is_large], sizes[is_large]
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
        corners = points[cells]
        centroids = corners.mean(axis=1)
        offset = circumcircles(points, cells)[0] - centroids
        # The circumcentre of an obtuse cell lies far outside it and would displace nodes too far.
        radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
        offset *= np.minimum(1.0, radii / np.maximum(np.linalg.norm(offset, axis=1), 1e-300))[:, None]
        weight = doubled_areas(points, cells) / size(centroids) ** 3
        weighted_centres = weight[:, None] * np.concatenate([centroids + offset, np.ones((len(cells), 1))], axis=1)
        node_sums = np.stack(
            [
                np.bincount(cells.ravel(), np.repeat(weight_column, 3), minlength=len(points))
                for weight_column in weighted_centres.T
            ],
            axis=1,
        )[num_immovable_nodes:]
        has_cells = node_sums[:, 2] > 0
        target = np.where(
            has_cells[:, None], node_sums[:, :2] / np.where(has_cells, node_sums[:, 2], 1.0)[:, None], state.free_nodes
        )
        is_away = is_away_from_outline(state, points, target, 0.45 * size(target))
        state.free_nodes = np.where(is_away[:, None], target, state.free_nodes)


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
        angle = smallest_angles(points[cells])
        if is_repaired and angle[is_improvable(state, cells)].min(initial=90.0) >= GUARANTEED_MIN_ANGLE:
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
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(points),) * 2)
    node_order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    node_order = np.concatenate([[0], node_order[node_order != 0]])
    rank = np.empty(len(points), dtype=np.int64)
    rank[node_order] = np.arange(len(points))
    cells = rank[cells]
    return points[node_order], cells[np.argsort(cells.min(axis=1), kind="stable")]
