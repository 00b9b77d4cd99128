"""`Geodesics`: lengths of the shortest ways along a triangulated surface, from any of its points to any other (NumPy).

A wave runs over the triangles: from the lengths at two corners the third one's follows, by laying the triangle and the
point that the wave seems to come from into one plane, as long as the straight line between them crosses the side
between the two corners; else the way goes through one of these. That is exact wherever the triangles between lie in a
plane or can be laid into one, whatever way they point. (Novotni and Klein, WSCG 2002, 341-347: Kimmel and Sethian's
fast marching, PNAS 95 (1998) 8431-8435, with a wave that is round.) Elsewhere the wave is flatter, or rounder, than one
from so far away in a plane: after a way d over the Gaussian curvature K by K d/3, and more exactly by what a sphere of
that curvature does. Each length only ever falls, and lengths too large give lengths too large, so that nodes may be
worked on in any order: those that changed, of all sources together, until none does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.mesh.geodesic.triangles import SurfacePlaces, Triangles
from jeit.mesh.mesh import Mesh

# Lengths that fall by less, relative, are not passed on; and sources worked on at once, as lengths (s, n) are kept.
_ENOUGH, _TOGETHER = 1e-10, 128
# Greatest length of a way on a sphere, radians: farther on, near the antipode, a wave closes in on a point.
_FARTHEST = 2.6
# Share of a side by which lengths of one wave may disagree.
_APART = 0.02
# Greatest distance of places from the surface, in units of its extent, such as of those on the other side of a thick
# skin.
_OFF = 0.25


class _Corners(NamedTuple):
    """Each corner of each triangle, and the side opposite to it, which begins at the origin and goes along x."""

    node: np.ndarray  # (c,), and the two nodes of the side
    start: np.ndarray
    end: np.ndarray
    side: np.ndarray  # (c,) its length; x and y of the corner, metres
    x: np.ndarray
    y: np.ndarray


class Geodesics(eqx.Module):
    """Ways along a surface; make it with `Geodesics.create`.

    **Fields**: `surface`; `corners` of its triangles; `curvature` (n,), Gaussian, 1/m²; `first` (n + 1,) and `touching`
    (6 m,): the corners whose opposite side each node is on.
    """

    surface: Triangles
    corners: _Corners
    curvature: Float[np.ndarray, " n"]
    first: Int[np.ndarray, " n1"]
    touching: Int[np.ndarray, " q"]

    @classmethod
    def create(cls, surface: Triangles | Mesh, face: str | None = None) -> "Geodesics":
        """Create for a surface, or for a `face` of a shell as in `Triangles.of`. Raises `ValueError` as that does."""
        triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
        cells, points = triangles.cells, triangles.points
        node, start, end = (np.roll(cells, -turn, axis=1).ravel() for turn in range(3))
        local = _in_plane(points[start], points[end], points[node])
        ends = np.concatenate([start, end])
        order = np.argsort(ends, kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=len(points)))])
        corners = _Corners(node, start, end, *local)
        return cls(triangles, corners, _curvature(triangles, corners), first, order % len(node))

    def distances(
        self,
        sources: ArrayLike | SurfacePlaces,
        targets: ArrayLike | SurfacePlaces | None = None,
        *,
        limit: float = np.inf,
    ) -> Float[np.ndarray, "s p"]:
        """Lengths (s, p), metres, of the shortest ways from `sources` (s, 3) to `targets` (p, 3), places on the
        surface, or near it, for the nearest of it is taken; to all nodes (s, n) unless targets are given.

        Infinite beyond `limit`, metres, where that is given, and between parts that do not hang together. Raises
        `ValueError` for places farther off the surface than a quarter of its extent.
        """
        begun = sources if isinstance(sources, SurfacePlaces) else self._nearest("sources", sources)
        if isinstance(targets, SurfacePlaces) or targets is None:
            reached = targets
        else:
            reached = self._nearest("targets", targets)
        found = []
        for low in range(0, len(begun.triangle), _TOGETHER):
            some = SurfacePlaces(*(getattr(begun, one)[low : low + _TOGETHER] for one in _FIELDS))
            lengths, bent = self._from(some, limit)
            found.append(lengths if reached is None else self._at(some, lengths, bent, reached))
        found = np.concatenate(found) if found else np.zeros((0, 0))
        found[found > limit] = np.inf
        return found

    def _nearest(self, name: str, places: ArrayLike) -> SurfacePlaces:
        """Places on the surface. Raises `ValueError`, about the argument `name`, for those that are not near it."""
        at = self.surface.nearest(places)
        extent = float(np.ptp(self.surface.points, axis=0).max())
        lost = np.flatnonzero(~(at.away <= _OFF * extent))
        if lost.size:
            raise ValueError(
                f"{name}: {lost.size} of {len(at.away)} lie off the surface, the first, at "
                f"{np.asarray(places, float)[lost[0]].tolist()} m, by {1e3 * at.away[lost[0]]:.3g} mm; give places on "
                "it, in metres."
            )
        return at

    def between(self, places: ArrayLike) -> Float[np.ndarray, "p p"]:
        """Lengths between all of some places (p, 3), metres: symmetric, zero on the diagonal."""
        at = self.surface.nearest(places)
        lengths = self.distances(at, at)
        lengths = (lengths + lengths.T) / 2
        np.fill_diagonal(lengths, 0)
        return lengths

    def owners(self, sources: ArrayLike | SurfacePlaces) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Number of the nearest of the `sources` (s, 3) for each node, and the length of the way to it, metres."""
        at = sources if isinstance(sources, SurfacePlaces) else self.surface.nearest(sources)
        nodes = self.surface.cells[at.triangle]
        length = np.linalg.norm(self.surface.points[nodes] - at.points[:, None], axis=-1)
        lengths, owner = np.full(len(self.surface.points), np.inf), np.full(len(self.surface.points), -1)
        number = np.repeat(np.arange(len(nodes)), 3)
        changed = _lowered(lengths, owner, nodes.ravel(), length.ravel(), number)
        while changed.size:
            _, corner = self._touched(changed, np.zeros_like(changed))
            start, end, node = self.corners.start[corner], self.corners.end[corner], self.corners.node[corner]
            local = (part[corner] for part in self.corners[3:])
            through, along = _laid(lengths[start], lengths[end], *local, joined=owner[start] == owner[end])
            changed = _lowered(lengths, owner, node, through, np.where(along, owner[start], owner[end]))
        return owner, lengths

    def _from(self, sources: SurfacePlaces, limit: float):
        """Lengths (s, n), and the mean curvature (s, n) of the ways there."""
        count = len(self.surface.points)
        lengths = np.full(len(sources.triangle) * count, np.inf)
        bent = np.tile(self.curvature, len(sources.triangle))
        nodes = self.surface.cells[sources.triangle]
        place = (np.arange(len(nodes))[:, None] * count + nodes).ravel()
        lengths[place] = np.linalg.norm(self.surface.points[nodes] - sources.points[:, None], axis=-1).ravel()
        changed = place
        while changed.size:
            source, corner = self._touched(changed % count, changed - changed % count)
            start, end = source + self.corners.start[corner], source + self.corners.end[corner]
            local = (part[corner] for part in self.corners[3:])
            mean = (bent[start] + bent[end]) / 2
            through, by_start = _laid(lengths[start], lengths[end], *local, curvature=mean)
            node = self.corners.node[corner]
            place = source + node
            lower = (through < (1 - _ENOUGH) * lengths[place]) & (through <= 2 * limit)
            place, through, node = place[lower], through[lower], node[lower]
            before = np.where(by_start, lengths[start], lengths[end])[lower]
            np.minimum.at(lengths, place, through)
            with np.errstate(invalid="ignore"):
                share = np.where(through > 0, np.clip(before / through, 0, 1), 0.0)
            least = through == lengths[place]
            bent[place[least]] = (share * mean[lower] + (1 - share) * self.curvature[node])[least]
            # Nodes beyond the limit pass nothing on.
            changed = np.unique(place[lengths[place] <= limit])
        return lengths.reshape(-1, count), bent.reshape(-1, count)

    def _touched(self, nodes, carried):
        """The corners opposite to nodes, and what the nodes carry, for each of these corners."""
        number = self.first[nodes + 1] - self.first[nodes]
        total = np.cumsum(number)
        inside = np.arange(total[-1]) - np.repeat(total - number, number)
        return np.repeat(carried, number), self.touching[np.repeat(self.first[nodes], number) + inside]

    def near(self, sources: ArrayLike, targets: SurfacePlaces, limit: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Targets no farther than `limit` metres from each of some `sources` (s, 3) by the way along the surface, as
        their numbers, and their distances; targets far away are not searched."""
        begun = self.surface.nearest(sources)
        tree, found = KDTree(targets.points), []
        for low in range(0, len(begun.triangle), _TOGETHER):
            some = SurfacePlaces(*(getattr(begun, one)[low : low + _TOGETHER] for one in _FIELDS))
            lengths, bent = self._from(some, limit)
            close = [np.asarray(one, int) for one in tree.query_ball_point(some.points, limit, return_sorted=True)]
            source = np.repeat(np.arange(len(close)), [len(one) for one in close])
            every = np.concatenate(close) if close else np.zeros(0, int)
            at = SurfacePlaces(*(getattr(targets, one)[every] for one in _FIELDS))
            length = self._at(some, lengths, bent, at, source)
            ends = np.cumsum([len(one) for one in close])[:-1]
            for index, own in zip(np.split(every, ends), np.split(length, ends), strict=True):
                found.append((index[own < limit], own[own < limit]))
        return found

    def _at(self, sources: SurfacePlaces, lengths: Float[np.ndarray, "s n"], bent, targets: SurfacePlaces, source=None):
        """Lengths (s, p) inside the triangles; or (p,), of each target from a source with that number."""
        cells = self.surface.cells[targets.triangle]
        corners = self.surface.points[cells]
        of = np.arange(len(lengths))[:, None] if source is None else source
        found = np.inf
        for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            ends = (of, cells[:, first]), (of, cells[:, second])
            start, end = (lengths[one] for one in ends)
            side, x, y = _in_plane(corners[:, first], corners[:, second], targets.points)
            through, _ = _laid(start, end, side, x, y, curvature=(bent[ends[0]] + bent[ends[1]]) / 2)
            # Where ways from two sides meet, the ends' lengths are of different waves, and the third corner is not as
            # far from what they seem to come from as it is.
            with np.errstate(invalid="ignore", over="ignore"):
                seen, behind, _ = _origin(start, end, side)
                _, across, off = _in_plane(corners[:, first], corners[:, second], corners[:, third])
                apart = np.hypot(across - seen, off + behind) - lengths[of, cells[:, third]]
            by_corner = start + np.sqrt(x**2 + y**2)
            found = np.minimum(found, np.where(np.abs(apart) < _APART * side, through, by_corner))
        straight = np.linalg.norm(sources.points[of] - targets.points, axis=-1)
        return np.where(sources.triangle[of] == targets.triangle, straight, found)


_FIELDS = "triangle", "weights", "points", "away"


def _in_plane(start, end, corner):
    """Length of the side from `start` to `end`, and where the `corner` is, x along the side from its start and y off
    it; metres, all (c,)."""
    side = np.linalg.norm(end - start, axis=-1)
    x = ((corner - start) * (end - start)).sum(axis=-1) / side
    return side, x, np.sqrt(np.maximum(((corner - start) ** 2).sum(axis=-1) - x**2, 0.0))


def _laid(start, end, side, x, y, *, joined: Any = True, curvature: Any = 0.0):
    """Lengths at corners from those at the `start` and `end` of their sides, and whether the way comes by the start; in
    a straight line only where both ends' are `joined`. `curvature`: mean of the way, 1/m²."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        along = np.sqrt(x**2 + y**2) + start
        back = np.sqrt((side - x) ** 2 + y**2) + end
        seen, behind, off = _origin(start, end, side)
        crossing = (seen * y + x * behind) / np.where(behind + y > 0, behind + y, 1.0)
        straight = (off >= 0) & (crossing >= 0) & (crossing <= side) & joined & (behind + y > 0)
        length = np.sqrt((x - seen) ** 2 + (y + behind) ** 2)
        # The wave's sagitta at the crossing, off that of a plane's.
        square = (crossing - seen) ** 2 + off
        across = np.where(square > 0, off / np.where(square > 0, square, 1.0), 0.0)
        length += 0.5 * _flatter(curvature, np.sqrt(square)) * across * crossing * (side - crossing)
    return np.where(straight, length, np.minimum(along, back)), along <= back


def _origin(start, end, side):
    """Where a wave seems to come from that is so far away from the start and the end of a side: along it, and behind
    it; and the square of the latter, negative where it cannot be."""
    seen = (start**2 - end**2 + side**2) / (2 * side)
    off = start**2 - seen**2
    return seen, np.sqrt(np.maximum(off, 0.0)), off


def _flatter(curvature, length):
    """1/length - κ, 1/m, of the front's curvature κ after a way over a Gaussian curvature: √K cot(√K length) on a
    sphere, with the hyperbolic cotangent on a saddle."""
    angle = np.sqrt(np.abs(curvature)) * length
    small, round_, saddle = angle < 1e-3, np.clip(angle, 1e-3, _FARTHEST), np.clip(angle, 1e-3, 10.0)
    share = np.where(curvature > 0, 1 - round_ / np.tan(round_), 1 - saddle / np.tanh(saddle))
    return np.where(small, curvature * length / 3, share / np.where(small, 1.0, length))


def _curvature(surface: Triangles, corners: _Corners) -> Float[np.ndarray, " n"]:
    """Gaussian, of the nodes, 1/m²: what their triangles' angles lack of a full turn, over a third of the triangles'
    areas, evened out over two rings of neighbours; on the edge that of the nodes inside."""
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


def _lowered(lengths, owner, nodes, through, number) -> np.ndarray:
    """Lower the lengths of `nodes` to the least of what comes `through`, with the owner's number; those that fell."""
    lower = through < (1 - _ENOUGH) * lengths[nodes]
    nodes, through, number = nodes[lower], through[lower], number[lower]
    order = np.lexsort((through, nodes))
    changed, first = np.unique(nodes[order], return_index=True)
    lengths[changed], owner[changed] = through[order][first], number[order][first]
    return changed
