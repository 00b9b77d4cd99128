"""Refinement of meshes of triangles, in the plane or in space, or tetrahedra: `bisect` refines where a size function
asks for it, `cut` divides cells along a surface.

Edges are split, each in all the cells round it, so that cells go on meeting side to side. At their middles only where
they are the longest of all those cells: Rivara, International Journal for Numerical Methods in Engineering 20 (1984)
745. So cells keep their shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import check_kind, describe
from jeit.mesh._checks import MOST_POINTS
from jeit.mesh.mesh import Mesh
from jeit.mesh.sizes import size_checked

# If a surface crosses an edge nearer to its end than this share of its length, the end is moved onto the surface.
_NEAR = 0.25
# Least volume of a cell, of what it was, after its corners have moved.
_LEAST = 0.1
# Halvings that find where an edge is crossed.
_HALVINGS = 30


def bisect(mesh: Mesh, size: Callable[[Float[np.ndarray, "m k s"]], Float[np.ndarray, " m"]]) -> Mesh:
    """The mesh, with no cell whose longest edge is longer than asked for.

    `size` takes the corners of cells (m, k, s), metres, and returns the greatest length allowed for the longest edge of
    each, metres; infinite where cells stay as they are. Neighbours are divided as far as that needs. Tags stay; the
    boundary is that of the given mesh, of more facets.

    Raises `ValueError` for a `size` that is not one number per cell, above zero, or asks for more than 2,000,000 nodes.
    """
    return bisected(mesh, size)[0]


def bisected(mesh: Mesh, size: Callable[..., Float[np.ndarray, " m"]]) -> tuple[Mesh, Int[np.ndarray, " m"]]:
    """The mesh of `bisect`, and the cell of the given mesh that each of its cells comes from. Raises `ValueError` as
    `bisect` does."""
    division = _Division.of(mesh)
    parent = np.arange(len(division.cells))
    wanted = _too_long(division, slice(None), size)
    while wanted.any():
        points, cells = division.points, division.cells
        near = _nodes(cells[wanted], len(points))
        while True:
            some = np.flatnonzero(near[cells].any(axis=1))
            edges, number, rank = _edges(points, cells[some])
            longest = _first(number, rank)
            marked = np.zeros(len(edges), bool)
            marked[longest[wanted[some]]] = True
            # Where a marked edge is not the longest of a cell, that cell's longest one is split first.
            while not marked[more := longest[marked[number].any(axis=1)]].all():
                marked[more] = True
            if near[edges[marked]].all():
                break
            near |= _nodes(edges[marked], len(points))
        chosen = edges[marked & _first_of_all(number, rank)]
        if len(points) + len(chosen) > MOST_POINTS:
            raise ValueError(f"size asks for more than {MOST_POINTS:,} nodes; give longer edges. Are they in metres?")
        division, came = division.split(chosen, points[chosen].mean(axis=1))
        parent = parent[came]
        new, wanted = np.bincount(came)[came] > 1, wanted[came]
        wanted[new] = _too_long(division, new, size)
    return division.mesh(mesh.tags), parent


def cut(mesh: Mesh, level: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, " n"]]) -> Mesh:
    """The mesh, with no cell on both sides of the surface on which `level`, of points (n, s), metres, is zero.

    So a body's surface is made of sides of cells, and no cell holds it in part. Nodes that lie near the surface are
    moved onto it, those of the boundary not. Cells should be small beside the body (`bisect`).

    Raises `ValueError` for a `level` that is not one finite number per point.
    """
    division, value = _moved_onto(_Division.of(mesh), level)
    while True:
        points, cells = division.points, division.cells
        side = np.sign(value)[cells]
        some = np.flatnonzero(side.min(axis=1) * side.max(axis=1) < 0)
        if not len(some):
            return division.mesh(mesh.tags)
        some = np.flatnonzero(_nodes(cells[some], len(points))[cells].any(axis=1))
        edges, number, rank = _edges(points, cells[some])
        crossed = np.prod(np.sign(value)[edges], axis=1) < 0
        chosen = edges[crossed & _first_of_all(number, np.where(crossed, rank, -1))]
        division, _ = division.split(chosen, _crossing(points[chosen], value[chosen[:, 0]], level))
        value = np.append(value, np.zeros(len(chosen)))


@dataclass(frozen=True)
class _Division:
    """A mesh in arrays, while its edges are split.

    **Fields**: `points` (n, s), metres; `cells` (m, d + 1); `facets` (b, d); `side` (b,), the facet that each comes
    from.
    """

    points: Float[np.ndarray, "n s"]
    cells: Int[np.ndarray, "m k"]
    facets: Int[np.ndarray, "b d"]
    side: Int[np.ndarray, " b"]

    @classmethod
    def of(cls, mesh: Mesh) -> _Division:
        """The division of a mesh of which nothing is split yet."""
        check_kind("mesh", mesh, Mesh, "a mesh, such as jeit.mesh.disk or jeit.mesh.read return")
        points, cells, facets = (np.asarray(one) for one in (mesh.points, mesh.cells, mesh.facets))
        return cls(points, cells, facets, np.arange(len(facets)))

    def mesh(self, tags) -> Mesh:
        """The mesh, with the `tags` of that which was divided."""
        named = {name: self.facets[np.isin(self.side, np.asarray(index))] for name, index in tags.items()}
        with size_checked():
            return Mesh.create(self.points, self.cells, tags=named)

    def split(self, edges: Int[np.ndarray, "e 2"], middles: Float[np.ndarray, "e s"]) -> tuple[_Division, np.ndarray]:
        """The division with `edges`, no two of one cell, split at their `middles`, metres; and the cell that each new
        cell comes from."""
        node = len(self.points) + np.arange(len(edges))
        cells, came = _halved(self.cells, edges, node, len(self.points))
        facets, side = _halved(self.facets, edges, node, len(self.points))
        return _Division(np.concatenate([self.points, middles]), cells, facets, self.side[side]), came


def _too_long(division: _Division, some, size) -> Bool[np.ndarray, " m"]:
    """Whether cells have longer edges than allowed. Raises `ValueError`."""
    cells = division.cells[some]
    most = np.asarray(size(division.points[cells]))
    if most.shape != (len(cells),) or not (most > 0).all():
        raise ValueError(
            f"size must give one number per cell, metres, above zero (numpy.inf leaves it); of {len(cells)} cells it "
            f"gave {describe(most)}."
        )
    return _longest(division.points, cells) > most


def _moved_onto(division: _Division, level) -> tuple[_Division, Float[np.ndarray, " n"]]:
    """The mesh with nodes near the surface moved onto it, along edges, except for those of the boundary and where cells
    would be crushed; and the level at all nodes."""
    points, cells = division.points, division.cells
    value = np.asarray(level(points))
    if value.shape != (len(points),) or not np.isfinite(value).all():
        raise ValueError(
            f"level must give one finite number per point; of {len(points)} points it gave {describe(value)}."
        )
    side = np.sign(value)[cells]
    edges, _, _ = _edges(points, cells[side.min(axis=1) * side.max(axis=1) < 0])
    edges = edges[np.prod(np.sign(value)[edges], axis=1) < 0]
    place = _crossing(points[edges], value[edges[:, 0]], level)
    distance = np.linalg.norm(points[edges] - place[:, None], axis=2) / _lengths(points[edges])[:, None]
    ends, order = edges.ravel(), np.argsort(-distance.ravel())  # the nearest comes last, and stays
    nearest, target = np.full(len(points), np.inf), points.copy()
    nearest[ends[order]], target[ends[order]] = distance.ravel()[order], np.repeat(place, 2, axis=0)[order]
    moves = (nearest < _NEAR) & ~_nodes(division.facets, len(points))
    before = _volumes(points, cells)
    while True:
        moved = np.where(moves[:, None], target, points)
        crushed = _volumes(moved, cells) < _LEAST * before
        if not crushed.any():
            return replace(division, points=moved), np.where(moves, 0, value)
        moves &= ~_nodes(cells[crushed], len(points))


def _crossing(ends: Float[np.ndarray, "e 2 s"], first: Float[np.ndarray, " e"], level) -> Float[np.ndarray, "e s"]:
    """Points on edges where the level, `first` (e,) at the first ends and of the other sign at the others, is zero."""
    low, high = np.zeros((len(ends), 1)), np.ones((len(ends), 1))
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        same = (level(start + middle * along) * first > 0)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return start + high * along


def _edges(points, simplices) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "m k"], Int[np.ndarray, " e"]]:
    """All edges, the lower node first; the numbers of those of every simplex; and their ranks by length."""
    ends = _ends(simplices).reshape(-1, 2)
    key, number = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(key, len(points)), axis=1)
    rank = np.empty(len(edges), int)
    rank[np.argsort(_lengths(points[edges]), kind="stable")] = np.arange(len(edges))
    return edges, number.reshape(len(simplices), -1), rank


def _ends(simplices) -> Int[np.ndarray, "m k 2"]:
    """The nodes of every simplex's edges, the lower one first."""
    pairs = np.array(list(itertools.combinations(range(simplices.shape[1]), 2)))
    return np.sort(simplices[:, pairs].astype(np.int64), axis=2)


def _lengths(ends: Float[np.ndarray, "... 2 s"]) -> Float[np.ndarray, "..."]:
    """Lengths of edges."""
    return np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1)


def _longest(points, cells) -> Float[np.ndarray, " m"]:
    """The length of every cell's longest edge, metres."""
    return _lengths(points[_ends(cells)]).max(axis=1)


def _first(number, rank) -> Int[np.ndarray, " m"]:
    """The edge of the highest rank of every cell."""
    return np.take_along_axis(number, np.argmax(rank[number], axis=1)[:, None], axis=1)[:, 0]


def _first_of_all(number, rank) -> Bool[np.ndarray, " e"]:
    """Edges of the highest rank in all the cells round them."""
    return np.bincount(_first(number, rank), minlength=len(rank)) == np.bincount(number.ravel(), minlength=len(rank))


def _nodes(simplices, num_points: int) -> Bool[np.ndarray, " n"]:
    """Nodes of some simplices."""
    there = np.zeros(num_points, bool)
    there[simplices] = True
    return there


def _volumes(points, cells) -> Float[np.ndarray, " m"]:
    """Volumes of cells, up to a factor; negative where turned round, but for triangles in space, which have no sign."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    if sides.shape[1] < sides.shape[2]:
        return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return np.linalg.det(sides)


def _halved(simplices, edges, node, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplices, each in two where one of its edges is split at a `node`; and which each comes from."""
    some = np.flatnonzero(_nodes(edges, num_points)[simplices].sum(axis=1) > 1)
    key = edges @ [num_points, 1]
    order = np.argsort(key)
    ends = _ends(simplices[some])
    own = ends @ [num_points, 1]
    place = order[np.minimum(np.searchsorted(key[order], own), len(key) - 1)]
    split = key[place] == own
    has = split.any(axis=1)
    some, which = some[has], np.argmax(split[has], axis=1)
    rows = np.flatnonzero(has)
    middle = node[place[rows, which]][:, None]
    halves = [np.where(simplices[some] == end[:, None], middle, simplices[some]) for end in ends[rows, which].T]
    whole = np.delete(np.arange(len(simplices)), some)
    return np.concatenate([simplices[whole], *halves]), np.concatenate([whole, some, some])
