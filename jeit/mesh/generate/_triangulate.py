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

from jeit.mesh.generate.curve import Curve, Size, divide, is_inside_curves


@dataclass
class Front:
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
            own_segments = segments[(segments >= offset) & (segments < offset + len(arc_lengths))] - offset
            length = self.curves[k].length
            next_stops = np.append(arc_lengths[1:], arc_lengths[0] + length)
            self.node_arc_lengths[k] = np.sort(
                np.concatenate([arc_lengths, (0.5 * (arc_lengths + next_stops))[own_segments] % length])
            )
            offset += len(arc_lengths)


def triangulate(front: Front, points: np.ndarray) -> np.ndarray:
    """Delaunay triangles (m, 3) inside the outline, counter-clockwise."""
    outline = points[: front.num_outline]
    # With distant auxiliary nodes, the outline is not part of the convex hull, where collinear nodes would produce
    # slivers.
    largest_side = np.ptp(outline, axis=0).max()
    angle = 2 * np.pi * (np.arange(16) + 0.37) / 16
    auxiliary_nodes = outline.mean(axis=0) + 4 * largest_side * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cells = Delaunay(np.concatenate([points, auxiliary_nodes])).simplices
    cells = cells[(cells < len(points)).all(axis=1)]
    # A cell with a node in the interior lies inside; only cells whose nodes are all on the outline need a test.
    outline_cells = np.flatnonzero((cells < front.num_outline).all(axis=1))
    is_inside = np.ones(len(cells), bool)
    is_inside[outline_cells] = is_inside_curves(front.curves, points[cells[outline_cells]].mean(axis=1))
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


def is_clear_of_outline(front: Front, nodes: np.ndarray, points: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Whether each of `points` lies inside the outline, at a distance of more than `gap` from the outline. `nodes` are
    the nodes of `front`."""
    if not len(points):
        return np.zeros(0, bool)
    segments = front.segments()
    start, end = nodes[segments[:, 0]], nodes[segments[:, 1]]
    tree = KDTree(0.5 * (start + end))
    _, nearest_segments = tree.query(points, k=min(3, len(segments)))
    distances = np.full(len(points), np.inf)
    for column in nearest_segments.reshape(len(points), -1).T:
        direction, offset = end[column] - start[column], points - start[column]
        fraction = np.clip((offset * direction).sum(1) / (direction**2).sum(1), 0.0, 1.0)
        distances = np.minimum(distances, np.linalg.norm(offset - fraction[:, None] * direction, axis=1))
    is_clear = distances > gap
    is_clear[is_clear] = is_inside_curves(front.curves, points[is_clear])
    return is_clear


# Angles in degrees: the guaranteed minimum angle; the minimum that `repair` aims at, which is slightly larger; and the
# angle below which `improve_worst_cells` improves a cell. Last, the maximum number of rounds of `repair`.
PROMISED_ANGLE = 25.0
_REPAIR_ANGLE = 25.5
_POLISH_ANGLE = 31.0
_MAX_REPAIR_ROUNDS = 120

_STEP_ANGLES = 2 * np.pi * np.arange(8) / 8
_STEP_DIRECTIONS = np.stack([np.cos(_STEP_ANGLES), np.sin(_STEP_ANGLES)], axis=1)
_TRIAL_STEPS = np.concatenate([length * _STEP_DIRECTIONS for length in (0.02, 0.06, 0.15, 0.3)])


def is_improvable(front: Front, cells: np.ndarray) -> np.ndarray:
    """Whether each cell can be improved; a cell at a sharp corner cannot, since the outline determines its shape."""
    is_sharp = np.zeros(cells.max() + 1, bool)
    is_sharp[: front.num_outline] = front.is_sharp_corner()
    return np.logical_not(is_sharp[cells].any(axis=1))


def missing_segments(front: Front, cells: np.ndarray, num_points: int) -> np.ndarray:
    """Indices of the outline segments that are not edges of cells."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]).astype(np.int64)
    segments = front.segments().astype(np.int64)
    is_present = np.isin(segments[:, 0] * num_points + segments[:, 1], edges[:, 0] * num_points + edges[:, 1])
    return np.flatnonzero(~is_present)


def improve_worst_cells(front: Front, passes: int = 4) -> None:
    """Move the free nodes of the worst cells so that the smallest angle around each of these nodes grows.

    Steps in eight directions are tried for each node, because the smallest angle is not differentiable where two cells
    have equal smallest angles.
    """
    num_immovable_nodes = front.num_immovable_nodes
    for _ in range(passes):
        points = front.points()
        cells = triangulate(front, points)
        angle = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((angle < _POLISH_ANGLE) & is_improvable(front, cells))
        movable = np.unique(cells[bad_cells])
        movable = movable[movable >= num_immovable_nodes]
        if not movable.size:
            return
        sort_order = np.argsort(cells.ravel(), kind="stable")
        bounds = np.searchsorted(cells.ravel()[sort_order], np.arange(len(points) + 1))
        has_moved = False
        for node in movable.tolist():
            star_corners = sort_order[bounds[node] : bounds[node + 1]]
            corner = star_corners % 3
            star_cells = cells[star_corners // 3]
            second_corners = points[star_cells[np.arange(len(star_corners)), (corner + 1) % 3]]
            third_corners = points[star_cells[np.arange(len(star_corners)), (corner + 2) % 3]]
            mean_length = np.linalg.norm(second_corners - points[node], axis=1).mean()
            trial_points = points[node] + np.concatenate([np.zeros((1, 2)), mean_length * _TRIAL_STEPS])
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
        front.free_nodes = points[num_immovable_nodes:]
        if not has_moved:
            return


def repair(front: Front) -> bool:
    """Insert nodes until all outline segments are edges and every cell has the required minimum angle. Returns False if
    some cell or segment is still bad after the maximum number of rounds.

    J. Ruppert, J. Algorithms 18 (1995) 548: a node is inserted at the circumcentre of a bad cell, unless the node would
    lie too close to an outline segment, which is halved instead. In each round, many cells far enough from each other
    are treated at once.
    """
    for round_number in range(_MAX_REPAIR_ROUNDS):
        points = front.points()
        cells = triangulate(front, points)
        missing_indices = missing_segments(front, cells, len(points))
        if missing_indices.size:
            _recover(front, points, missing_indices, remove=round_number < 10)
            continue
        angle = smallest_angles(points[cells])
        bad_cells = np.flatnonzero((angle < _REPAIR_ANGLE) & is_improvable(front, cells))
        if not bad_cells.size:
            return True
        _insert_circumcentres(front, points, cells[bad_cells], angle[bad_cells])
        if round_number % 3 == 2:
            improve_worst_cells(front, passes=2)
    return False


def _diametral_circles(front: Front, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    end_points = points[front.segments()]
    return end_points.mean(axis=1), 0.5 * np.linalg.norm(end_points[:, 1] - end_points[:, 0], axis=1)


def _is_divisible(front: Front) -> np.ndarray:
    """Whether each outline segment may be divided: neither of its ends is a sharp corner."""
    return np.logical_not(front.is_sharp_corner()[front.segments()].any(axis=1))


def _recover(front: Front, points: np.ndarray, missing_indices: np.ndarray, *, remove: bool) -> None:
    """Make missing outline segments appear as edges of cells: remove the free nodes close to them or, if there are
    none, halve the segments."""
    centres, radii = _diametral_circles(front, points)
    if remove and len(front.free_nodes):
        neighbours = KDTree(front.free_nodes).query_ball_point(centres[missing_indices], radii[missing_indices])
        removed_nodes = np.unique(np.concatenate([np.asarray(indices, dtype=int) for indices in neighbours]))
        if removed_nodes.size:
            front.free_nodes = np.delete(front.free_nodes, removed_nodes, axis=0)
            return
    is_divisible = _is_divisible(front)[missing_indices]
    front.divide(missing_indices[is_divisible])


def _insert_circumcentres(front: Front, points: np.ndarray, bad_cells: np.ndarray, angle: np.ndarray) -> None:
    centre, radius = circumcircles(points, bad_cells)
    selected = select_spaced_points(centre, radius, -angle)
    centre = centre[selected]
    centres, radii = _diametral_circles(front, points)
    is_divisible = _is_divisible(front)
    # A segment is encroached upon if a new node lies in the circle whose diameter is the segment.
    neighbours = KDTree(centre).query_ball_point(centres, radii * (1 - 1e-9))
    is_encroached = np.array([len(indices) > 0 for indices in neighbours])
    is_affected = np.zeros(len(centre), bool)
    for cell_index in np.flatnonzero(is_encroached):
        is_affected[neighbours[cell_index]] = True
    is_outside = ~is_inside_curves(front.curves, centre)
    lost_centres = np.flatnonzero(is_outside & ~is_affected)
    if lost_centres.size:
        is_encroached[KDTree(centres).query(centre[lost_centres])[1]] = True
    accepted = centre[~is_affected & ~is_outside]
    if len(accepted):
        accepted = accepted[is_clear_of_outline(front, points, accepted, np.zeros(len(accepted)))]
    halved_segments = np.flatnonzero(is_encroached & is_divisible)
    front.free_nodes = np.concatenate([front.free_nodes, accepted])
    front.divide(halved_segments)


# Maximum ratio of circumradius to cell size, chosen so that the mean edge equals the cell size (the ratio of an
# equilateral triangle is 0.577).
_RADIUS_PER_SIZE = 0.74
_SMOOTHING_STEPS = 14
# Angle below which a corner is cut off by a single isosceles cell: two cells there would be too thin.
_SHARP_CORNER = np.radians(75.0)


def outline_nodes(
    curves: list[Curve], arc_lengths: list[np.ndarray], fixed_nodes: np.ndarray, size: Size, guard_ratio: float
) -> Front:
    """Place nodes on the outline and cut off sharp corners at a distance of `guard_ratio` times the local cell size."""
    all_stops, guarded_lengths = [], []
    for curve, required_stops in zip(curves, arc_lengths, strict=True):
        stop_lengths = np.unique(np.concatenate([curve.corners, required_stops % curve.length]))
        sharp_corners = np.flatnonzero(curve.angles < _SHARP_CORNER)
        added_stops = []
        for corner in sharp_corners:
            corner_length = curve.corners[corner]
            gap_ahead = np.min((stop_lengths - corner_length - 1e-12 * curve.length) % curve.length)
            gap_behind = np.min((corner_length - stop_lengths - 1e-12 * curve.length) % curve.length)
            cut_length = min(
                guard_ratio * float(size(curve.points_at(np.array([corner_length])))[0]),
                0.45 * gap_ahead,
                0.45 * gap_behind,
            )
            added_stops += [(corner_length + cut_length) % curve.length, (corner_length - cut_length) % curve.length]
        all_stops.append(divide(curve, np.concatenate([stop_lengths, added_stops]), size))
        guarded_lengths.append(curve.corners[sharp_corners])
    return Front(curves, all_stops, guarded_lengths, fixed_nodes, np.zeros((0, 2)))


def insert_nodes(front: Front, size: Size) -> None:
    """Insert nodes until no cell is larger than `size` allows."""
    for _ in range(200):
        points = front.points()
        cells = triangulate(front, points)
        centre, radius = circumcircles(points, cells)
        sizes = size(centre)
        is_large = radius > _RADIUS_PER_SIZE * sizes
        centre, ratio, sizes = centre[is_large], (radius / sizes)[is_large], sizes[is_large]
        is_clear = is_clear_of_outline(front, points, centre, 0.5 * sizes)
        if not is_clear.any():
            return
        centre, ratio, sizes = centre[is_clear], ratio[is_clear], sizes[is_clear]
        front.free_nodes = np.concatenate([front.free_nodes, centre[select_spaced_points(centre, 0.95 * sizes, ratio)]])


def smooth_nodes(front: Front, size: Size, steps: int = _SMOOTHING_STEPS) -> None:
    """Move the free nodes towards the optimal Delaunay triangulation for the requested cell sizes."""
    num_immovable_nodes = front.num_immovable_nodes
    if not len(front.free_nodes):
        return
    for _ in range(steps):
        points = front.points()
        cells = triangulate(front, points)
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
            has_cells[:, None], node_sums[:, :2] / np.where(has_cells, node_sums[:, 2], 1.0)[:, None], front.free_nodes
        )
        is_clear = is_clear_of_outline(front, points, target, 0.45 * size(target))
        front.free_nodes = np.where(is_clear[:, None], target, front.free_nodes)


def generate(
    curves: list[Curve], arc_lengths: list[np.ndarray], fixed_nodes: np.ndarray, size: Size, front: Front | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the region inside the first of `curves` and outside the other curves, which are holes: points (n, 2) and
    cells (m, 3).

    Nodes are placed at `arc_lengths`, arc lengths on each curve, and at `fixed_nodes`, points (f, 2) inside the region.
    `size` returns the requested edge length at points (p, 2). If `front` is specified, it must already be filled for
    this size, and the steps `outline_nodes` and `insert_nodes` are skipped. Node 0 is the first node of the first
    curve. Raises `ValueError` if no mesh with the guaranteed minimum angle is found.
    """
    for guard_ratio in (1.0, 0.5, 0.25):
        if front is None:
            front = outline_nodes(curves, arc_lengths, fixed_nodes, size, guard_ratio)
            insert_nodes(front, size)
        smooth_nodes(front, size)
        improve_worst_cells(front)
        is_repaired = repair(front)
        improve_worst_cells(front, passes=1)
        points = front.points()
        cells = triangulate(front, points)
        angle = smallest_angles(points[cells])
        if is_repaired and angle[is_improvable(front, cells)].min(initial=90.0) >= PROMISED_ANGLE:
            return order_nodes(points, cells)
        front = None
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
