"""`Geodesics`: geodesic distances along a triangulated surface between any of its points.

A wave front propagates over the triangles. From the distances at two corners of a triangle, the triangle and the
virtual source of the wave are laid into one plane. If the straight line from the source to the third corner crosses the
side between the two corners, its length is the distance at the third corner; otherwise the shortest path passes through
one of the two corners. This is exact where the triangles between can be laid into one plane. (Novotni and Klein, WSCG
2002, 341-347, who extend the fast marching of Kimmel and Sethian, PNAS 95 (1998) 8431-8435, to circular waves.)

On other surfaces, Gaussian curvature K changes the curvature of the front: after a path of length d, by about K d/3;
the formula for a sphere of that curvature is used. Updates only ever lower distances, so the nodes may be processed in
any order: those that changed, for all sources together, until none changes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.mesh.geodesic.triangles import SurfacePlaces, Triangles
from jeit.mesh.mesh import Mesh
from jeit_solvers.module import Module

# Minimum relative decrease of a distance that is propagated, and number of sources processed together, which limits the
# memory for distances (s, n).
_MIN_DECREASE, _SOURCES_PER_BATCH = 1e-10, 128
# Maximum length of a path on a sphere, in radians: near the antipode the wave converges to a point.
_MAX_SPHERE_ANGLE = 2.6
# Tolerated disagreement between the distances at the corners of a triangle, as a fraction of its side, if they belong
# to the same wave.
_WAVE_TOLERANCE = 0.02
# Maximum distance of given points from the surface, relative to the surface's extent: points on the other side of a
# thick skin are accepted.
_MAX_OFF_SURFACE = 0.25


class _Corners(NamedTuple):
    """All corners of all triangles, each in the plane of its triangle: the opposite side starts at the origin and runs
    along x."""

    node: np.ndarray  # (c,) node at the corner, and the two nodes of the opposite side
    start: np.ndarray
    end: np.ndarray
    side: np.ndarray  # (c,) length of the side, and coordinates of the corner, metres
    x: np.ndarray
    y: np.ndarray


class Geodesics(Module):
    """Geodesic distances on a surface; created by `Geodesics.create`.

    **Fields**: `surface`: the triangles; `corners`: their corners; `curvature` (n,): Gaussian curvature at the nodes,
    1/m²; `touching` (6 m,): corners grouped by the nodes of their opposite sides, the group of node i being
    `touching[first[i]:first[i + 1]]`; `first` (n + 1,): bounds of the groups.

    **Example:**

    ```python
    paths = Geodesics.create(sleeve)
    paths.distances(sleeve.points[:2])
    ```
    """

    surface: Triangles
    corners: _Corners
    curvature: Float[np.ndarray, " n"]
    first: Int[np.ndarray, " n1"]
    touching: Int[np.ndarray, " q"]

    @classmethod
    def create(cls, surface: Triangles | Mesh, face: str | None = None) -> "Geodesics":
        """Prepare distances on a surface, or on the facets of a shell that have the tag `face`. Raises `ValueError` as
        `Triangles.of` does."""
        triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
        cells, points = triangles.cells, triangles.points
        node, start, end = (np.roll(cells, -turn, axis=1).ravel() for turn in range(3))
        local = _triangle_coordinates(points[start], points[end], points[node])
        ends = np.concatenate([start, end])
        order = np.argsort(ends, kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=len(points)))])
        corners = _Corners(node, start, end, *local)
        return cls(triangles, corners, _gaussian_curvature(triangles, corners), first, order % len(node))

    def distances(
        self,
        sources: ArrayLike | SurfacePlaces,
        targets: ArrayLike | SurfacePlaces | None = None,
        *,
        limit: float = np.inf,
    ) -> Float[np.ndarray, "s p"]:
        """Geodesic distances (s, p), metres, from `sources` (s, 3) to `targets` (p, 3), or (s, n) to all nodes if there
        are no targets. Points off the surface are projected to the nearest point on it.

        Distances beyond `limit`, metres, and between disconnected parts are infinite. Raises `ValueError` for points
        farther from the surface than a quarter of its extent.
        """
        begun = sources if isinstance(sources, SurfacePlaces) else self._project("sources", sources)
        if isinstance(targets, SurfacePlaces) or targets is None:
            reached = targets
        else:
            reached = self._project("targets", targets)
        found = []
        for low in range(0, len(begun.triangle), _SOURCES_PER_BATCH):
            some = SurfacePlaces(*(getattr(begun, one)[low : low + _SOURCES_PER_BATCH] for one in _PLACE_FIELDS))
            lengths, bent = self._distances_to_nodes(some, limit)
            found.append(lengths if reached is None else self._distances_in_triangles(some, lengths, bent, reached))
        found = np.concatenate(found) if found else np.zeros((0, 0))
        found[found > limit] = np.inf
        return found

    def _project(self, name: str, places: ArrayLike) -> SurfacePlaces:
        """Nearest points on the surface. Raises `ValueError` with the argument's `name` for points that are too far
        from it."""
        at = self.surface.nearest(places)
        extent = float(np.ptp(self.surface.points, axis=0).max())
        lost = np.flatnonzero(~(at.away <= _MAX_OFF_SURFACE * extent))
        if lost.size:
            raise ValueError(
                f"{name}: {lost.size} of {len(at.away)} lie off the surface, the first, at "
                f"{np.asarray(places, float)[lost[0]].tolist()} m, by {1e3 * at.away[lost[0]]:.3g} mm; give places on "
                "it, in metres."
            )
        return at

    def between(self, places: ArrayLike) -> Float[np.ndarray, "p p"]:
        """Geodesic distances (p, p) between all pairs of points (p, 3), metres: symmetric, with a zero diagonal."""
        at = self.surface.nearest(places)
        lengths = self.distances(at, at)
        lengths = (lengths + lengths.T) / 2
        np.fill_diagonal(lengths, 0)
        return lengths

    def owners(self, sources: ArrayLike | SurfacePlaces) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """For each node, the index of the nearest of the `sources` (s, 3) and the geodesic distance to it, metres."""
        at = sources if isinstance(sources, SurfacePlaces) else self.surface.nearest(sources)
        nodes = self.surface.cells[at.triangle]
        length = np.linalg.norm(self.surface.points[nodes] - at.points[:, None], axis=-1)
        lengths, owner = np.full(len(self.surface.points), np.inf), np.full(len(self.surface.points), -1)
        number = np.repeat(np.arange(len(nodes)), 3)
        changed = _lower_distances(lengths, owner, nodes.ravel(), length.ravel(), number)
        while changed.size:
            _, corner = self._opposite_corners(changed, np.zeros_like(changed))
            start, end, node = self.corners.start[corner], self.corners.end[corner], self.corners.node[corner]
            local = (part[corner] for part in self.corners[3:])
            through, along = _distances_across(
                lengths[start], lengths[end], *local, same_source=owner[start] == owner[end]
            )
            changed = _lower_distances(lengths, owner, node, through, np.where(along, owner[start], owner[end]))
        return owner, lengths

    def _distances_to_nodes(self, sources: SurfacePlaces, limit: float):
        """Distances (s, n) from the sources to all nodes, and mean curvatures (s, n) along the paths."""
        count = len(self.surface.points)
        lengths = np.full(len(sources.triangle) * count, np.inf)
        bent = np.tile(self.curvature, len(sources.triangle))
        nodes = self.surface.cells[sources.triangle]
        place = (np.arange(len(nodes))[:, None] * count + nodes).ravel()
        lengths[place] = np.linalg.norm(self.surface.points[nodes] - sources.points[:, None], axis=-1).ravel()
        changed = place
        while changed.size:
            source, corner = self._opposite_corners(changed % count, changed - changed % count)
            start, end = source + self.corners.start[corner], source + self.corners.end[corner]
            local = (part[corner] for part in self.corners[3:])
            mean = (bent[start] + bent[end]) / 2
            through, by_start = _distances_across(lengths[start], lengths[end], *local, curvature=mean)
            node = self.corners.node[corner]
            place = source + node
            lower = (through < (1 - _MIN_DECREASE) * lengths[place]) & (through <= 2 * limit)
            place, through, node = place[lower], through[lower], node[lower]
            before = np.where(by_start, lengths[start], lengths[end])[lower]
            np.minimum.at(lengths, place, through)
            with np.errstate(invalid="ignore"):
                share = np.where(through > 0, np.clip(before / through, 0, 1), 0.0)
            least = through == lengths[place]
            bent[place[least]] = (share * mean[lower] + (1 - share) * self.curvature[node])[least]
            # Nodes beyond the limit are not propagated.
            changed = np.unique(place[lengths[place] <= limit])
        return lengths.reshape(-1, count), bent.reshape(-1, count)

    def _opposite_corners(self, nodes, carried):
        """The corners opposite to the sides at the `nodes`, and for each of these corners the value `carried` by its
        node."""
        number = self.first[nodes + 1] - self.first[nodes]
        total = np.cumsum(number)
        inside = np.arange(total[-1]) - np.repeat(total - number, number)
        return np.repeat(carried, number), self.touching[np.repeat(self.first[nodes], number) + inside]

    def near(self, sources: ArrayLike, targets: SurfacePlaces, limit: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each of the `sources` (s, 3), the indices of the targets within a geodesic distance of `limit` metres,
        and their distances. Only targets within `limit` in a straight line are considered."""
        begun = self.surface.nearest(sources)
        tree, found = KDTree(targets.points), []
        for low in range(0, len(begun.triangle), _SOURCES_PER_BATCH):
            some = SurfacePlaces(*(getattr(begun, one)[low : low + _SOURCES_PER_BATCH] for one in _PLACE_FIELDS))
            lengths, bent = self._distances_to_nodes(some, limit)
            close = [np.asarray(one, int) for one in tree.query_ball_point(some.points, limit, return_sorted=True)]
            source = np.repeat(np.arange(len(close)), [len(one) for one in close])
            every = np.concatenate(close) if close else np.zeros(0, int)
            at = SurfacePlaces(*(getattr(targets, one)[every] for one in _PLACE_FIELDS))
            length = self._distances_in_triangles(some, lengths, bent, at, source)
            ends = np.cumsum([len(one) for one in close])[:-1]
            for index, own in zip(np.split(every, ends), np.split(length, ends), strict=True):
                found.append((index[own < limit], own[own < limit]))
        return found

    def _distances_in_triangles(
        self, sources: SurfacePlaces, lengths: Float[np.ndarray, "s n"], bent, targets: SurfacePlaces, source=None
    ):
        """Distances (s, p) at points inside triangles; or (p,), if `source` gives the index of the source for each
        target."""
        cells = self.surface.cells[targets.triangle]
        corners = self.surface.points[cells]
        of = np.arange(len(lengths))[:, None] if source is None else source
        found = np.inf
        for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            ends = (of, cells[:, first]), (of, cells[:, second])
            start, end = (lengths[one] for one in ends)
            side, x, y = _triangle_coordinates(corners[:, first], corners[:, second], targets.points)
            through, _ = _distances_across(start, end, side, x, y, curvature=(bent[ends[0]] + bent[ends[1]]) / 2)
            # Where paths from two directions meet, the distances at the ends of a side belong to different waves, and
            # contradict the distance at the third corner. The path is then taken through a corner.
            with np.errstate(invalid="ignore", over="ignore"):
                seen, behind, _ = _virtual_source(start, end, side)
                _, across, off = _triangle_coordinates(corners[:, first], corners[:, second], corners[:, third])
                apart = np.hypot(across - seen, off + behind) - lengths[of, cells[:, third]]
            by_corner = start + np.sqrt(x**2 + y**2)
            found = np.minimum(found, np.where(np.abs(apart) < _WAVE_TOLERANCE * side, through, by_corner))
        straight = np.linalg.norm(sources.points[of] - targets.points, axis=-1)
        return np.where(sources.triangle[of] == targets.triangle, straight, found)


_PLACE_FIELDS = "triangle", "weights", "points", "away"


def _triangle_coordinates(start, end, corner):
    """Length of the side from `start` to `end`, and coordinates of the `corner`: x along the side from its start, and y
    perpendicular to it; metres, each (c,)."""
    side = np.linalg.norm(end - start, axis=-1)
    x = ((corner - start) * (end - start)).sum(axis=-1) / side
    return side, x, np.sqrt(np.maximum(((corner - start) ** 2).sum(axis=-1) - x**2, 0.0))


def _distances_across(start, end, side, x, y, *, same_source: Any = True, curvature: Any = 0.0):
    """Distances at corners, computed from the distances at the `start` and `end` of the opposite sides, and whether the
    path through the start is the shorter one. Paths across the interior of a side are considered only where
    `same_source` is True, i.e. where the distances at both of its ends are from the same source. `curvature`: mean
    Gaussian curvature along the path, 1/m²."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        along = np.sqrt(x**2 + y**2) + start
        back = np.sqrt((side - x) ** 2 + y**2) + end
        seen, behind, off = _virtual_source(start, end, side)
        crossing = (seen * y + x * behind) / np.where(behind + y > 0, behind + y, 1.0)
        straight = (off >= 0) & (crossing >= 0) & (crossing <= side) & same_source & (behind + y > 0)
        length = np.sqrt((x - seen) ** 2 + (y + behind) ** 2)
        # Difference between the sagitta of the wave front at the crossing and that of a front in the plane.
        square = (crossing - seen) ** 2 + off
        across = np.where(square > 0, off / np.where(square > 0, square, 1.0), 0.0)
        length += 0.5 * _front_flattening(curvature, np.sqrt(square)) * across * crossing * (side - crossing)
    return np.where(straight, length, np.minimum(along, back)), along <= back


def _virtual_source(start, end, side):
    """Virtual source of a wave with given distances at the start and the end of a side: its coordinate along the side,
    its distance behind the side, and the square of this distance, which is negative for incompatible distances."""
    seen = (start**2 - end**2 + side**2) / (2 * side)
    off = start**2 - seen**2
    return seen, np.sqrt(np.maximum(off, 0.0)), off


def _front_flattening(curvature, length):
    """1/length - κ, in 1/m, where κ is the curvature of the wave front after a path of this `length`, metres, on a
    surface of Gaussian curvature K = `curvature`, 1/m²: κ = √K cot(√K length), with the hyperbolic cotangent for
    negative K."""
    angle = np.sqrt(np.abs(curvature)) * length
    small, round_, saddle = angle < 1e-3, np.clip(angle, 1e-3, _MAX_SPHERE_ANGLE), np.clip(angle, 1e-3, 10.0)
    share = np.where(curvature > 0, 1 - round_ / np.tan(round_), 1 - saddle / np.tanh(saddle))
    return np.where(small, curvature * length / 3, share / np.where(small, 1.0, length))


def _gaussian_curvature(surface: Triangles, corners: _Corners) -> Float[np.ndarray, " n"]:
    """Gaussian curvature (n,) at the nodes, 1/m²: angle defect, i.e. 2π minus the sum of the angles at the node,
    divided by a third of the area of its triangles; both are averaged over two rings of neighbours. Nodes on the border
    do not contribute."""
    count, node = len(surface.points), corners.node
    angle = np.arctan2(corners.y, corners.x), np.arctan2(corners.y, corners.side - corners.x)
    lacking = 2 * np.pi - np.bincount(node, np.pi - angle[0] - angle[1], count)
    area = surface.node_areas
    border = np.unique(surface.border)
    lacking[border], area[border] = 0.0, 0.0
    for _ in range(2):
        lacking, area = (
            one
            + np.bincount(corners.start, one[corners.end], count)
            + np.bincount(corners.end, one[corners.start], count)
            for one in (lacking, area)
        )
    return np.where(area > 0, lacking / np.where(area > 0, area, 1.0), 0.0)


def _lower_distances(lengths, owner, nodes, through, number) -> np.ndarray:
    """Lower the distances of `nodes` to the minimum of the new distances `through`, and store the owner's index.
    Returns the nodes whose distance has decreased."""
    lower = through < (1 - _MIN_DECREASE) * lengths[nodes]
    nodes, through, number = nodes[lower], through[lower], number[lower]
    order = np.lexsort((through, nodes))
    changed, first = np.unique(nodes[order], return_index=True)
    lengths[changed], owner[changed] = through[order][first], number[order][first]
    return changed
