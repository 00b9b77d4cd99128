"""Delaunay triangulation of the inside of an outline, and measures of its triangles (NumPy, SciPy)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, KDTree

from jeit.mesh.generate.curve import Curve, within


@dataclass
class Front:
    """Working state of the generator: nodes on every curve by arc length, fixed and free nodes inside.

    `guards[k]` holds the arc lengths on curve k of sharp corners, whose two sides are not to be divided.
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
        """All nodes (n, 2): curve after curve, then fixed, then free ones."""
        on_curves = [curve.at(stops) for curve, stops in zip(self.curves, self.stops, strict=True)]
        return np.concatenate([*on_curves, self.fixed, self.free])

    def segments(self) -> np.ndarray:
        """Outline segments as node pairs (s, 2), in the order of the nodes they start at."""
        pieces, offset = [], 0
        for stops in self.stops:
            index = np.arange(offset, offset + len(stops))
            pieces.append(np.stack([index, np.roll(index, -1)], axis=1))
            offset += len(stops)
        return np.concatenate(pieces)

    def guarded(self) -> np.ndarray:
        """True for the nodes on the outline that are sharp corners, (num_outline,)."""
        return np.concatenate([np.isin(s, g) for s, g in zip(self.stops, self.guards, strict=True)])

    def divide(self, chosen: np.ndarray) -> None:
        """Put a node in the middle of the chosen outline segments (indices)."""
        offset = 0
        for k, stops in enumerate(self.stops):
            mine = chosen[(chosen >= offset) & (chosen < offset + len(stops))] - offset
            length = self.curves[k].length
            following = np.append(stops[1:], stops[0] + length)
            self.stops[k] = np.sort(np.concatenate([stops, (0.5 * (stops + following))[mine] % length]))
            offset += len(stops)


def triangulate(front: Front, points: np.ndarray) -> np.ndarray:
    """Delaunay triangles (m, 3), counter-clockwise, that lie inside the outline."""
    outline = points[: front.num_outline]
    # Far nodes around the domain keep the outline off the hull, where collinear nodes make slivers.
    reach = np.ptp(outline, axis=0).max()
    angle = 2 * np.pi * (np.arange(16) + 0.37) / 16
    far = outline.mean(axis=0) + 4 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cells = Delaunay(np.concatenate([points, far])).simplices
    cells = cells[(cells < len(points)).all(axis=1)]
    # A cell with a node inside the domain is inside; only those spanned by the outline need a test.
    doubtful = np.flatnonzero((cells < front.num_outline).all(axis=1))
    keep = np.ones(len(cells), bool)
    keep[doubtful] = within(front.curves, points[cells[doubtful]].mean(axis=1))
    cells = cells[keep]
    clockwise = doubled_areas(points, cells) < 0
    cells[clockwise] = cells[clockwise][:, [0, 2, 1]]
    return cells


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of plane vectors (…, 2)."""
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
    """Smallest angle (…) in degrees of triangles (…, 3, 2); negative where they are clockwise."""
    edges = np.roll(corners, -1, axis=-2) - corners
    length = np.sort(np.sqrt((edges**2).sum(-1)), axis=-1)
    area = cross(edges[..., 0, :], edges[..., 1, :])
    # sin of the angle opposite the shortest side; that angle is below 90°, so the arcsine is the angle.
    sine = area / np.maximum(length[..., 1] * length[..., 2], 1e-300)
    return np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))


def select_apart(points: np.ndarray, radius: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """Indices of points taken greedily by falling `priority`, none within `radius` of one taken before."""
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
    """True for `points` that lie inside the outline and farther than `gap` from it; `nodes` as in the front."""
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
