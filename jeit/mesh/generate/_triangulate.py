"""Triangulate any outline with cells of a wanted size (NumPy and SciPy; deterministic).

The steps:

1. `outline_nodes`: nodes along the outline, one per cell size;
2. `fill`: insert circumcentres of cells that are too large, many at a time (Delaunay refinement);
3. `smooth`: move every free node to the weighted mean of the circumcentres around it (optimal Delaunay
   triangulation, L. Chen and J. Xu, J. Comput. Math. 22 (2004) 299), triangulating anew each time;
4. `polish` and `repair` (in `_repair`) until the smallest angle is large enough.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jeit.mesh.generate import _repair
from jeit.mesh.generate._delaunay import (
    Front,
    circumcircles,
    clear_of_outline,
    doubled_areas,
    select_apart,
    smallest_angles,
    triangulate,
)
from jeit.mesh.generate.curve import Curve, Size, divide

# Largest circumradius per wanted cell size: makes the mean edge equal the size (an equilateral cell has 0.577).
_FILLING = 0.74
_SMOOTHING_STEPS = 14
# A corner sharper than this is cut off as one cell with equal sides: two cells there would be too thin.
_SHARP = np.radians(75.0)


def outline_nodes(curves: list[Curve], stops: list[np.ndarray], fixed: np.ndarray, size: Size, guard: float) -> Front:
    """Nodes on the outline, with the sharp corners cut off at `guard` times the cell size there."""
    all_stops, guards = [], []
    for curve, own in zip(curves, stops, strict=True):
        stop = np.unique(np.concatenate([curve.corners, own % curve.length]))
        sharp = np.flatnonzero(curve.angles < _SHARP)
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
    """Insert nodes until no cell is larger than asked."""
    for _ in range(200):
        points = front.points()
        cells = triangulate(front, points)
        centre, radius = circumcircles(points, cells)
        wanted = size(centre)
        large = radius > _FILLING * wanted
        centre, ratio, wanted = centre[large], (radius / wanted)[large], wanted[large]
        good = clear_of_outline(front, points, centre, 0.5 * wanted)
        if not good.any():
            return
        centre, ratio, wanted = centre[good], ratio[good], wanted[good]
        front.free = np.concatenate([front.free, centre[select_apart(centre, 0.95 * wanted, ratio)]])


def smooth(front: Front, size: Size, steps: int = _SMOOTHING_STEPS) -> None:
    """Move the free nodes towards the optimal Delaunay triangulation for the wanted sizes."""
    held = front.num_held
    if not len(front.free):
        return
    for _ in range(steps):
        points = front.points()
        cells = triangulate(front, points)
        corners = points[cells]
        middle = corners.mean(axis=1)
        offset = circumcircles(points, cells)[0] - middle
        # The circumcentre of an obtuse cell lies far outside it and would throw nodes about.
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
    """Points (n, 2) and cells (m, 3) inside `curves`, the first of which encloses the others.

    `stops` are arc lengths on each curve and `fixed` points (f, 2) inside where nodes must be; `size` gives the
    wanted edge length at points (p, 2). A `front` already filled for this size saves the first two
    steps. Node 0 is the first node of the first curve. Raises `ValueError` if no mesh with the promised angle is
    found.
    """
    for guard in (1.0, 0.5, 0.25):
        if front is None:
            front = outline_nodes(curves, stops, fixed, size, guard)
            fill(front, size)
        smooth(front, size)
        _repair.polish(front)
        done = _repair.repair(front)
        _repair.polish(front, passes=1)
        points = front.points()
        cells = triangulate(front, points)
        angle = smallest_angles(points[cells])
        if done and angle[_repair.improvable(front, cells)].min(initial=90.0) >= _repair.PROMISED_ANGLE:
            return order_nodes(points, cells)
        front = None
    raise ValueError(
        "refine: no mesh with angles of at least 25° was found for this outline and these cell sizes. Ask for smaller "
        "cells near narrow places and nodes that lie close together, or for slower growth."
    )


def order_nodes(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number neighbouring nodes and cells close to each other, keeping node 0 first (drops unused nodes)."""
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
