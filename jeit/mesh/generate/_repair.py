"""Raise the smallest angle of a triangulation: move nodes where that is enough, insert some where not."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from jeit.mesh.generate._delaunay import (
    Front,
    circumcircles,
    clear_of_outline,
    select_apart,
    smallest_angles,
    triangulate,
)
from jeit.mesh.generate.curve import within

# Degrees. What is asked of the repair is a little more than what is promised.
PROMISED_ANGLE = 25.0
_REPAIR_ANGLE = 25.5
_POLISH_ANGLE = 31.0
_ROUNDS = 120

_ANGLES = 2 * np.pi * np.arange(8) / 8
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_STEPS = np.concatenate([length * _DIRECTIONS for length in (0.02, 0.06, 0.15, 0.3)])


def improvable(front: Front, cells: np.ndarray) -> np.ndarray:
    """True for cells not cut off by a sharp corner of the outline, whose shape is given."""
    sharp = np.zeros(cells.max() + 1, bool)
    sharp[: front.num_outline] = front.guarded()
    return np.logical_not(sharp[cells].any(axis=1))


def missing_segments(front: Front, cells: np.ndarray, num_points: int) -> np.ndarray:
    """Indices of outline segments that are not an edge of any cell."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]).astype(np.int64)
    segments = front.segments().astype(np.int64)
    present = np.isin(segments[:, 0] * num_points + segments[:, 1], edges[:, 0] * num_points + edges[:, 1])
    return np.flatnonzero(~present)


def polish(front: Front, passes: int = 4) -> None:
    """Move the free nodes of the worst cells to where the smallest angle around them is largest.

    Every node tries steps in eight directions, which raises the least angle without needing its gradient
    (it has none where two cells tie).
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
            places = points[node] + np.concatenate([np.zeros((1, 2)), reach * _STEPS])
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
    """Insert nodes until the outline is there and every cell meets the angle asked; False if it does not end.

    J. Ruppert, J. Algorithms 18 (1995) 548: a bad cell gets a node at its circumcentre, unless that comes too
    close to an outline segment, which is halved instead. Many are done at a time, apart from each other.
    """
    for round_number in range(_ROUNDS):
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
        _refine(front, points, cells[bad], angle[bad])
        if round_number % 3 == 2:
            polish(front, passes=2)
    return False


def _diametral(front: Front, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ends = points[front.segments()]
    return ends.mean(axis=1), 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def _divisible(front: Front) -> np.ndarray:
    """True for outline segments that do not end in a sharp corner."""
    return np.logical_not(front.guarded()[front.segments()].any(axis=1))


def _recover(front: Front, points: np.ndarray, missing: np.ndarray, *, remove: bool) -> None:
    """Make missing segments appear: remove the free nodes close to them, or else halve them."""
    middle, half = _diametral(front, points)
    if remove and len(front.free):
        near = KDTree(front.free).query_ball_point(middle[missing], half[missing])
        doomed = np.unique(np.concatenate([np.asarray(n, dtype=int) for n in near]))
        if doomed.size:
            front.free = np.delete(front.free, doomed, axis=0)
            return
    divisible = _divisible(front)[missing]
    front.divide(missing[divisible])


def _refine(front: Front, points: np.ndarray, bad: np.ndarray, angle: np.ndarray) -> None:
    centre, radius = circumcircles(points, bad)
    chosen = select_apart(centre, radius, -angle)
    centre = centre[chosen]
    middle, half = _diametral(front, points)
    divisible = _divisible(front)
    # A segment is encroached upon if the new node falls into the circle over it.
    near = KDTree(centre).query_ball_point(middle, half * (1 - 1e-9))
    encroached = np.array([len(n) > 0 for n in near])
    spoilt = np.zeros(len(centre), bool)
    for index in np.flatnonzero(encroached):
        spoilt[near[index]] = True
    outside = ~within(front.curves, centre)
    lost = np.flatnonzero(outside & ~spoilt)
    if lost.size:
        encroached[KDTree(middle).query(centre[lost])[1]] = True
    accepted = centre[~spoilt & ~outside]
    if len(accepted):
        accepted = accepted[clear_of_outline(front, points, accepted, np.zeros(len(accepted)))]
    halved = np.flatnonzero(encroached & divisible)
    front.free = np.concatenate([front.free, accepted])
    front.divide(halved)
