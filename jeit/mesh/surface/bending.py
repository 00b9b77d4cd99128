"""`bend`: a flat sheet rolled round a cylinder without stretching."""

from __future__ import annotations

import numpy as np

from jeit.arguments import told
from jeit.mesh.mesh import Mesh

# A fold is moved onto a node within this share of the distance of folds, for cells would be cut into slivers.
_ONTO = 0.1
# Nodes within this share of the sheet's width of a line are on it.
_ON = 1e-12


def bend(mesh: Mesh, radius: float, *, axis: str = "y", num_folds: int | None = None) -> Mesh:
    """A flat sheet, rolled round a cylinder of `radius` metres that touches it from below along its middle.

    Paper bends without stretching, and so does this: the sheet is folded along straight lines, parallel to the
    cylinder's `axis` ("x" or "y"), and stays flat between them. Every length on it stays what it was, and so do all
    voltages. Folds run along the rows of nodes where the mesh has such rows (`jeit.mesh.rectangle` has, for axis "x");
    else there are `num_folds` strips, about one for each cell across, and cells are cut where folds pass through them:
    `bend(mesh, numpy.inf)` is the flat sheet with the same cells. Fold lines lie on the cylinder. The upper side is the
    outer one; a negative `radius` bends the sheet upward. Tags stay.

    Raises `ValueError` for what is no flat sheet, a radius of zero, and a sheet so wide that it would overlap itself.
    """
    if mesh.dimension != 2 or mesh.is_surface:
        raise ValueError("mesh: only a flat (2-D) sheet bends without stretching; this one is not flat.")
    if axis not in ("x", "y"):
        raise ValueError(f"axis: the cylinder's axis is 'x' or 'y', not {told(axis)}.")
    if isinstance(radius, bool) or not isinstance(radius, float | int | np.floating) or not abs(radius) > 0:
        raise ValueError(f"radius: expected a length in metres that is not zero, got {told(radius)}.")
    if num_folds is not None and (isinstance(num_folds, bool) or not isinstance(num_folds, int) or num_folds < 1):
        raise ValueError(f"num_folds: expected a whole number of at least 1, got {told(num_folds)}.")
    across = 0 if axis == "y" else 1
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    folds = _folds(points[:, across], points[cells], across, num_folds)
    edges = {name: np.asarray(mesh.facets)[np.asarray(index)] for name, index in mesh.tags.items()}
    for line in folds[1:-1]:
        points, cells, edges = _cut(points, cells, edges, points[:, across] - line)
    out, up = _rolled(points[:, across], folds, float(radius))
    columns = [out, points[:, 1], up] if across == 0 else [points[:, 0], out, up]
    return Mesh.create(np.stack(columns, axis=1), cells, tags=edges)


def _folds(places: np.ndarray, corners: np.ndarray, across: int, num_folds: int | None) -> np.ndarray:
    """Where the sheet is folded, from one side to the other, those included."""
    width = np.ptp(places)
    ordered = np.sort(places)
    rows = ordered[np.concatenate([[True], np.diff(ordered) > _ON * width])]
    own = corners[..., across]
    low, high = (np.searchsorted(rows, side - _ON * width) for side in (own.min(axis=1), own.max(axis=1)))
    if num_folds is None and (high - low <= 1).all():
        return rows
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
    lines = np.linspace(rows[0], rows[-1], 1 + (num_folds or max(1, round(width / edge))))
    nearest = ordered[np.abs(ordered - lines[:, None]).argmin(axis=1)]
    near = np.abs(nearest - lines) < _ONTO * (lines[1] - lines[0])
    return np.where(near, nearest, lines)


def _cut(
    points: np.ndarray, cells: np.ndarray, edges: dict[str, np.ndarray], height: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points, cells and named edges after all are cut along a line; `height` (n,), distances of the nodes from it."""
    side = np.where(np.abs(height) <= _ON * np.ptp(height), 0, np.sign(height)).astype(int)
    sides = side[cells]
    crossed = (sides.min(axis=1) < 0) & (sides.max(axis=1) > 0)
    if not crossed.any():
        return points, cells, edges
    pairs = np.sort(cells[crossed][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs = np.unique(pairs[side[pairs].prod(axis=1) < 0], axis=0)
    share = (height[pairs[:, 0]] / (height[pairs[:, 0]] - height[pairs[:, 1]]))[:, None]
    middles = {(a, b): len(points) + k for k, (a, b) in enumerate(map(tuple, pairs.tolist()))}
    points = np.concatenate([points, (1 - share) * points[pairs[:, 0]] + share * points[pairs[:, 1]]])

    def middle(a: int, b: int) -> int:
        return middles[min(a, b), max(a, b)]

    pieces = []
    for corners in cells[crossed].tolist():
        signs = side[corners].tolist()
        if 0 in signs:
            k = signs.index(0)
            a, b, c = corners[k:] + corners[:k]
            d = middle(b, c)
            pieces += [(a, b, d), (a, d, c)]
        else:
            k = signs.index(-sum(signs))
            a, b, c = corners[k:] + corners[:k]
            d, e = middle(a, b), middle(a, c)
            pieces.append((a, d, e))
            shorter = np.linalg.norm(points[d] - points[c]) < np.linalg.norm(points[b] - points[e])
            pieces += [(d, b, c), (d, c, e)] if shorter else [(d, b, e), (b, c, e)]
    named = {}
    for name, ends in edges.items():
        through = side[ends].prod(axis=1) < 0
        halves = [[(a, middle(a, b)), (middle(a, b), b)] for a, b in ends[through].tolist()]
        named[name] = np.concatenate([ends[~through], np.array(halves, int).reshape(-1, 2)])
    return points, np.concatenate([cells[~crossed], np.array(pieces)]), named


def _rolled(places: np.ndarray, folds: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates across and up of places (n,) on the sheet, whose `folds` lie on a circle; the middle stays at 0."""
    middle = (folds[0] + folds[-1]) / 2
    if np.isinf(radius):
        return places - middle, np.zeros_like(places)
    strips = np.diff(folds)
    size = abs(radius)
    too_wide = strips.max() > 2 * size
    turned = 2 * np.arcsin(np.minimum(strips / (2 * size), 1))
    if too_wide or turned.sum() >= 2 * np.pi:
        width = folds[-1] - folds[0]
        raise ValueError(
            f"radius: a sheet {width:.4g} m wide would overlap itself on a cylinder of radius {size:.4g} m. It needs "
            f"more than {width / (2 * np.pi):.4g} m, and finer cells where these are large; a closed sleeve is a "
            "jeit.mesh.tube."
        )
    angle = np.concatenate([[0.0], np.cumsum(turned)])
    angle -= np.interp(middle, folds, angle)
    out, up = size * np.sin(angle), size * (np.cos(angle) - 1) * np.sign(radius)
    return np.interp(places, folds, out), np.interp(places, folds, up)
