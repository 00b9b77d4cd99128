"""Delaunay triangulation of points within an outline whose segments are kept as edges, and repair of bad cells.

The steps:

1. `outline_nodes`: place nodes along the outline at distances of the cell size;
2. `fill`: insert circumcentres of cells that are too large, many at a time (Delaunay refinement);
3. `smooth`: move every free node to the weighted mean of the circumcentres around it (optimal Delaunay
   triangulation, L. Chen and J. Xu, J. Comput. Math. 22 (2004) 299), triangulating anew each time;
4. `polish` and `repair` until the smallest angle is large enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.spatial import Delaunay, KDTree

from jeit.mesh.generate.curve import Curve, Size, divide, within


@dataclass
class Front:
    """State of the generator: nodes on every curve, by arc length, and fixed and free nodes inside.

    `guards[k]` contains the arc lengths of the sharp corners of curve k; segments that end there are not divided.
    """

    curves: list[Curve]
    stops: list[np.ndarray]
    guards: list[np.ndarray]
    fixed: np.ndarray
    free: np.ndarray

    @property
    def num_outline(self) -> int:
        """Number of nodes on the outline."""
        return sum(len(stops) for stops in self.stops)

    @property
    def num_held(self) -> int:
        """Number of nodes that may not move: those on the outline and the fixed ones."""
        return self.num_outline + len(self.fixed)

    def points(self) -> np.ndarray:
        """All nodes (n, 2): nodes of each curve in turn, then fixed nodes, then free nodes."""
        on_curves = [curve.at(stops) for curve, stops in zip(self.curves, self.stops, strict=True)]
        return np.concatenate([*on_curves, self.fixed, self.free])

    def segments(self) -> np.ndarray:
        """Outline segments as pairs of nodes (s, 2), in the order of their first nodes."""
        pieces, offset = [], 0
        for stops in self.stops:
            index = np.arange(offset, offset + len(stops))
            pieces.append(np.stack([index, np.roll(index, -1)], axis=1))
            offset += len(stops)
        return np.concatenate(pieces)

    def guarded(self) -> np.ndarray:
        """Whether each node on the outline is a sharp corner (num_outline,)."""
        return np.concatenate([np.isin(s, g) for s, g in zip(self.stops, self.guards, strict=True)])

    def divide(self, chosen: np.ndarray) -> None:
        """Insert a node in the middle of each of the `chosen` outline segments (indices)."""
        offset = 0
        for k, stops in enumerate(self.stops):
            mine = chosen[(chosen >= offset) & (chosen < offset + len(stops))] - offset
            length = self.curves[k].length
            following = np.append(stops[1:], stops[0] + length)
            self.stops[k] = np.sort(np.concatenate([stops, (0.5 * (stops + following))[mine] % length]))
            offset += len(stops)


def triangulate(front: Front, points: np.ndarray) -> np.ndarray:
    """Delaunay triangles (m, 3) inside the outline, counter-clockwise."""
    outline = points[: front.num_outline]
    # Distant auxiliary nodes keep the outline off the convex hull, where collinear nodes would produce slivers.
    reach = np.ptp(outline, axis=0).max()
    angle = 2 * np.pi * (np.arange(16) + 0.37) / 16
    far = outline.mean(axis=0) + 4 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cells = Delaunay(np.concatenate([points, far])).simplices
    cells = cells[(cells < len(points)).all(axis=1)]
    # A cell with a node in the interior lies inside; only cells whose nodes are all on the outline need a test.
    doubtful = np.flatnonzero((cells < front.num_outline).all(axis=1))
    keep = np.ones(len(cells), bool)
    keep[doubtful] = within(front.curves, points[cells[doubtful]].mean(axis=1))
    cells = cells[keep]
    clockwise = doubled_areas(points, cells) < 0
    cells[clockwise] = cells[clockwise][:, [0, 2, 1]]
    return cells


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (…) of plane vectors (…, 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def doubled_areas(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Twice the signed area (m,) of the triangles."""
    corners = points[cells]
    return cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def circumcircles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (m, 2) and radii (m,) of the circumscribed circles."""
    a = points[cells[:, 0]]
    b, c = points[cells[:, 1]] - a, points[cells[:, 2]] - a
    area = 2 * cross(b, c)
    area = np.where(np.abs(area) < 1e-300, 1e-300, area)
    bb, cc = (b**2).sum(1), (c**2).sum(1)
    centre = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / area[:, None]
    return a + centre, np.linalg.norm(centre, axis=1)


def smallest_angles(corners: np.ndarray) -> np.ndarray:
    """Smallest angle (…) of triangles (…, 3, 2), in degrees; negative for clockwise triangles."""
    edges = np.roll(corners, -1, axis=-2) - corners
    length = np.sort(np.sqrt((edges**2).sum(-1)), axis=-1)
    area = cross(edges[..., 0, :], edges[..., 1, :])
    # Sine of the angle opposite to the shortest side, which is below 90°, so that its arcsine is the angle.
    sine = area / np.maximum(length[..., 1] * length[..., 2], 1e-300)
    return np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))


def select_apart(points: np.ndarray, radius: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """Select points greedily in order of decreasing `priority`, skipping points within `radius` of a selected one.
    Returns their indices."""
    order = np.argsort(-priority, kind="stable")
    near = KDTree(points[order]).query_ball_point(points[order], radius[order], return_sorted=False)
    taken = np.zeros(len(points), bool)
    blocked = np.zeros(len(points), bool)
    for index, others in enumerate(near):
        if not blocked[index]:
            taken[index] = True
            blocked[others] = True
    return order[taken]


def clear_of_outline(front: Front, nodes: np.ndarray, points: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Whether each of `points` lies inside the outline, at a distance of more than `gap` from it. `nodes` are the nodes
    of `front`."""
    if not len(points):
        return np.zeros(0, bool)
    segments = front.segments()
    start, end = nodes[segments[:, 0]], nodes[segments[:, 1]]
    tree = KDTree(0.5 * (start + end))
    _, nearest = tree.query(points, k=min(3, len(segments)))
    apart = np.full(len(points), np.inf)
    for column in nearest.reshape(len(points), -1).T:
        along, offset = end[column] - start[column], points - start[column]
        fraction = np.clip((offset * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
        apart = np.minimum(apart, np.linalg.norm(offset - fraction[:, None] * along, axis=1))
    clear = apart > gap
    clear[clear] = within(front.curves, points[clear])
    return clear


# Angles in degrees: the guaranteed minimum angle; the minimum that `repair` aims at, which is slightly larger; and the
# angle below which `polish` improves a cell. Last, the maximum number of rounds of `repair`.
PROMISED_ANGLE = 25.0
_REPAIR_ANGLE = 25.5
_POLISH_ANGLE = 31.0
_MAX_REPAIR_ROUNDS = 120

_STEP_ANGLES = 2 * np.pi * np.arange(8) / 8
_STEP_DIRECTIONS = np.stack([np.cos(_STEP_ANGLES), np.sin(_STEP_ANGLES)], axis=1)
_TRIAL_STEPS = np.concatenate([length * _STEP_DIRECTIONS for length in (0.02, 0.06, 0.15, 0.3)])


def improvable(front: Front, cells: np.ndarray) -> np.ndarray:
    """Whether each cell can be improved: no cell at a sharp corner can, since the outline determines its shape."""
    sharp = np.zeros(cells.max() + 1, bool)
    sharp[: front.num_outline] = front.guarded()
    return np.logical_not(sharp[cells].any(axis=1))


def missing_segments(front: Front, cells: np.ndarray, num_points: int) -> np.ndarray:
    """Indices of the outline segments that are not an edge of any cell."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]).astype(np.int64)
    segments = front.segments().astype(np.int64)
    present = np.isin(segments[:, 0] * num_points + segments[:, 1], edges[:, 0] * num_points + edges[:, 1])
    return np.flatnonzero(~present)


def polish(front: Front, passes: int = 4) -> None:
    """Move the free nodes of the worst cells so that the smallest angle around each of these nodes grows.

    Steps in eight directions are tried for each node, because the smallest angle is not differentiable where two cells
    tie.
    """
    held = front.num_held
    for _ in range(passes):
        points = front.points()
        cells = triangulate(front, points)
        angle = smallest_angles(points[cells])
        bad = np.flatnonzero((angle < _POLISH_ANGLE) & improvable(front, cells))
        movable = np.unique(cells[bad])
        movable = movable[movable >= held]
        if not movable.size:
            return
        order = np.argsort(cells.ravel(), kind="stable")
        bounds = np.searchsorted(cells.ravel()[order], np.arange(len(points) + 1))
        moved = False
        for node in movable.tolist():
            star = order[bounds[node] : bounds[node + 1]]
            corner = star % 3
            around = cells[star // 3]
            second = points[around[np.arange(len(star)), (corner + 1) % 3]]
            third = points[around[np.arange(len(star)), (corner + 2) % 3]]
            reach = np.linalg.norm(second - points[node], axis=1).mean()
            places = points[node] + np.concatenate([np.zeros((1, 2)), reach * _TRIAL_STEPS])
            shape = (len(places), len(star), 2)
            corners = np.stack(
                [
                    np.broadcast_to(places[:, None], shape),
                    np.broadcast_to(second, shape),
                    np.broadcast_to(third, shape),
                ],
                axis=2,
            )
            worst = smallest_angles(corners).min(axis=1)
            best = int(np.argmax(worst))
            if worst[best] > worst[0] + 1e-3:
                points[node] = places[best]
                moved = True
        front.free = points[held:]
        if not moved:
            return


def repair(front: Front) -> bool:
    """Insert nodes until all outline segments are edges and every cell has the required minimum angle. Returns False if
    this fails within the maximum number of rounds.

    J. Ruppert, J. Algorithms 18 (1995) 548: a node is inserted at the circumcentre of a bad cell, unless it would lie
    too close to an outline segment, which is halved instead. Many cells far enough from each other are treated at once.
    """
    for round_number in range(_MAX_REPAIR_ROUNDS):
        points = front.points()
        cells = triangulate(front, points)
        missing = missing_segments(front, cells, len(points))
        if missing.size:
            _recover(front, points, missing, remove=round_number < 10)
            continue
        angle = smallest_angles(points[cells])
        bad = np.flatnonzero((angle < _REPAIR_ANGLE) & improvable(front, cells))
        if not bad.size:
            return True
        _insert_circumcentres(front, points, cells[bad], angle[bad])
        if round_number % 3 == 2:
            polish(front, passes=2)
    return False


def _diametral_circles(front: Front, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ends = points[front.segments()]
    return ends.mean(axis=1), 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def _is_divisible(front: Front) -> np.ndarray:
    """Whether each outline segment may be divided: neither of its ends is a sharp corner."""
    return np.logical_not(front.guarded()[front.segments()].any(axis=1))


def _recover(front: Front, points: np.ndarray, missing: np.ndarray, *, remove: bool) -> None:
    """Make missing outline segments appear: remove the free nodes close to them or, if there are none, halve the
    segments."""
    middle, half = _diametral_circles(front, points)
    if remove and len(front.free):
        near = KDTree(front.free).query_ball_point(middle[missing], half[missing])
        doomed = np.unique(np.concatenate([np.asarray(n, dtype=int) for n in near]))
        if doomed.size:
            front.free = np.delete(front.free, doomed, axis=0)
            return
    divisible = _is_divisible(front)[missing]
    front.divide(missing[divisible])


def _insert_circumcentres(front: Front, points: np.ndarray, bad: np.ndarray, angle: np.ndarray) -> None:
    centre, radius = circumcircles(points, bad)
    chosen = select_apart(centre, radius, -angle)
    centre = centre[chosen]
    middle, half = _diametral_circles(front, points)
    divisible = _is_divisible(front)
    # A segment is encroached upon if a new node lies in the circle whose diameter is the segment.
    near = KDTree(centre).query_ball_point(middle, half * (1 - 1e-9))
    encroached = np.array([len(n) > 0 for n in near])
    affected = np.zeros(len(centre), bool)
    for index in np.flatnonzero(encroached):
        affected[near[index]] = True
    outside = ~within(front.curves, centre)
    lost = np.flatnonzero(outside & ~affected)
    if lost.size:
        encroached[KDTree(middle).query(centre[lost])[1]] = True
    accepted = centre[~affected & ~outside]
    if len(accepted):
        accepted = accepted[clear_of_outline(front, points, accepted, np.zeros(len(accepted)))]
    halved = np.flatnonzero(encroached & divisible)
    front.free = np.concatenate([front.free, accepted])
    front.divide(halved)


# Maximum ratio of circumradius to cell size, chosen so that the mean edge equals the cell size (the ratio of an
# equilateral triangle is 0.577).
_RADIUS_PER_SIZE = 0.74
_SMOOTHING_STEPS = 14
# Angle below which a corner is cut off by a single isosceles cell: two cells there would be too thin.
_SHARP_CORNER = np.radians(75.0)


def outline_nodes(curves: list[Curve], stops: list[np.ndarray], fixed: np.ndarray, size: Size, guard: float) -> Front:
    """Place nodes on the outline and cut off sharp corners at a distance of `guard` times the local cell size."""
    all_stops, guards = [], []
    for curve, own in zip(curves, stops, strict=True):
        stop = np.unique(np.concatenate([curve.corners, own % curve.length]))
        sharp = np.flatnonzero(curve.angles < _SHARP_CORNER)
        extra = []
        for corner in sharp:
            place = curve.corners[corner]
            ahead = np.min((stop - place - 1e-12 * curve.length) % curve.length)
            behind = np.min((place - stop - 1e-12 * curve.length) % curve.length)
            cut = min(guard * float(size(curve.at(np.array([place])))[0]), 0.45 * ahead, 0.45 * behind)
            extra += [(place + cut) % curve.length, (place - cut) % curve.length]
        all_stops.append(divide(curve, np.concatenate([stop, extra]), size))
        guards.append(curve.corners[sharp])
    return Front(curves, all_stops, guards, fixed, np.zeros((0, 2)))


def fill(front: Front, size: Size) -> None:
    """Insert nodes until no cell is larger than `size` allows."""
    for _ in range(200):
        points = front.points()
        cells = triangulate(front, points)
        centre, radius = circumcircles(points, cells)
        wanted = size(centre)
        large = radius > _RADIUS_PER_SIZE * wanted
        centre, ratio, wanted = centre[large], (radius / wanted)[large], wanted[large]
        good = clear_of_outline(front, points, centre, 0.5 * wanted)
        if not good.any():
            return
        centre, ratio, wanted = centre[good], ratio[good], wanted[good]
        front.free = np.concatenate([front.free, centre[select_apart(centre, 0.95 * wanted, ratio)]])


def smooth(front: Front, size: Size, steps: int = _SMOOTHING_STEPS) -> None:
    """Move the free nodes towards the optimal Delaunay triangulation for the requested cell sizes."""
    held = front.num_held
    if not len(front.free):
        return
    for _ in range(steps):
        points = front.points()
        cells = triangulate(front, points)
        corners = points[cells]
        middle = corners.mean(axis=1)
        offset = circumcircles(points, cells)[0] - middle
        # The circumcentre of an obtuse cell lies far outside it and would displace nodes too far.
        reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
        offset *= np.minimum(1.0, reach / np.maximum(np.linalg.norm(offset, axis=1), 1e-300))[:, None]
        weight = doubled_areas(points, cells) / size(middle) ** 3
        weighted = weight[:, None] * np.concatenate([middle + offset, np.ones((len(cells), 1))], axis=1)
        summed = np.stack(
            [np.bincount(cells.ravel(), np.repeat(w, 3), minlength=len(points)) for w in weighted.T], axis=1
        )[held:]
        known = summed[:, 2] > 0
        target = np.where(known[:, None], summed[:, :2] / np.where(known, summed[:, 2], 1.0)[:, None], front.free)
        good = clear_of_outline(front, points, target, 0.45 * size(target))
        front.free = np.where(good[:, None], target, front.free)


def generate(
    curves: list[Curve], stops: list[np.ndarray], fixed: np.ndarray, size: Size, front: Front | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the region inside the first of `curves` and outside the others: points (n, 2) and cells (m, 3).

    `stops` are arc lengths on each curve, and `fixed` points (f, 2) inside, at which nodes are placed; `size` returns
    the requested edge length at points (p, 2). If a `front` already filled for this size is given, the first two steps
    are skipped. Node 0 is the first node of the first curve. Raises `ValueError` if no mesh with the guaranteed minimum
    angle is found.
    """
    for guard in (1.0, 0.5, 0.25):
        if front is None:
            front = outline_nodes(curves, stops, fixed, size, guard)
            fill(front, size)
        smooth(front, size)
        polish(front)
        done = repair(front)
        polish(front, passes=1)
        points = front.points()
        cells = triangulate(front, points)
        angle = smallest_angles(points[cells])
        if done and angle[improvable(front, cells)].min(initial=90.0) >= PROMISED_ANGLE:
            return order_nodes(points, cells)
        front = None
    raise ValueError(
        "refine: no mesh with angles of at least 25° was found for this outline and these cell sizes. Ask for smaller "
        "cells near narrow places and nodes that lie close together, or for slower growth."
    )


def order_nodes(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber nodes and cells so that neighbours have close indices; node 0 stays first, and unused nodes are
    removed."""
    used = np.unique(cells)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    points, cells = points[used], number[cells]
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(points),) * 2)
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    order = np.concatenate([[0], order[order != 0]])
    rank = np.empty(len(points), dtype=np.int64)
    rank[order] = np.arange(len(points))
    cells = rank[cells]
    return points[order], cells[np.argsort(cells.min(axis=1), kind="stable")]
