"""Refinement of meshes of triangles, in the plane or in space, or of tetrahedra: `bisect` refines cells to the lengths
that a size function allows, `cut` divides cells along a surface.

An edge is split in all the cells around it, so the mesh stays conforming. `bisect` splits an edge at its midpoint, and
only if it is the longest edge of each of those cells, so that cells keep their shape: Rivara, International Journal for
Numerical Methods in Engineering 20 (1984) 745.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import check_kind, describe
from jeit.mesh.checks import MOST_POINTS, size_checked
from jeit.mesh.mesh import Mesh

# Maximum distance from the end of an edge to the point where a surface crosses the edge, divided by the edge's length,
# at which the end is moved onto the surface.
_MAX_MOVE = 0.25
# Minimum volume of a cell after its nodes have moved, divided by its volume before.
_MIN_VOLUME_RATIO = 0.1
# Number of bisection steps to locate the point where a surface crosses an edge.
_BISECTION_STEPS = 30


def bisect(mesh: Mesh, size: Callable[[Float[np.ndarray, "m k s"]], Float[np.ndarray, " m"]]) -> Mesh:
    """Refine a mesh until no cell's longest edge exceeds the length that `size` allows.

    Neighbouring cells are divided as needed to keep the mesh conforming. Tags are kept, and the boundary keeps its
    shape.

    **Arguments:**

    - `mesh`: the mesh to refine.
    - `size`: function of the corners of cells (m, k, s), metres, that returns the maximum length of the longest edge of
      each cell (m,), metres; infinity leaves a cell as it is.

    Raises `ValueError` if `size` does not return one positive number per cell, or asks for more than 2,000,000 nodes.

    **Example:**

    ```python
    near = lambda corners: np.where(corners[..., 0].mean(axis=1) > 0.05, 0.01, np.inf)
    bisect(mesh, near).num_cells
    ```
    """
    return bisect_with_parents(mesh, size)[0]


def bisect_with_parents(mesh: Mesh, size: Callable[..., Float[np.ndarray, " m"]]) -> tuple[Mesh, Int[np.ndarray, " m"]]:
    """Refine a mesh as `bisect` does. Also returns, for each cell of the new mesh, the index of the cell of the given
    mesh that contains it. Raises `ValueError` as `bisect` does."""
    division = _SplitMesh.from_mesh(mesh)
    parent = np.arange(len(division.cells))
    wanted = _exceeds_size(division, slice(None), size)
    while wanted.any():
        points, cells = division.points, division.cells
        near = _is_node_of(cells[wanted], len(points))
        while True:
            some = np.flatnonzero(near[cells].any(axis=1))
            edges, number, rank = _edges(points, cells[some])
            longest = _longest_edge_of_cell(number, rank)
            marked = np.zeros(len(edges), bool)
            marked[longest[wanted[some]]] = True
            # If a marked edge is not the longest edge of a cell, mark that cell's longest edge, which is split first.
            while not marked[more := longest[marked[number].any(axis=1)]].all():
                marked[more] = True
            if near[edges[marked]].all():
                break
            near |= _is_node_of(edges[marked], len(points))
        chosen = edges[marked & _is_longest_around(number, rank)]
        if len(points) + len(chosen) > MOST_POINTS:
            raise ValueError(f"size asks for more than {MOST_POINTS:,} nodes; give longer edges. Are they in metres?")
        division, came = division.split(chosen, points[chosen].mean(axis=1))
        parent = parent[came]
        new, wanted = np.bincount(came)[came] > 1, wanted[came]
        wanted[new] = _exceeds_size(division, new, size)
    return division.mesh(mesh.tags), parent


def cut(mesh: Mesh, level: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, " n"]]) -> Mesh:
    """Divide the cells of a mesh along the surface on which `level` is zero, so that no cell lies on both sides of it.

    Nodes near the surface are moved onto it, except nodes of the boundary. Cells should be small relative to the body
    that the surface bounds (see `bisect`).

    **Arguments:**

    - `mesh`: the mesh to divide.
    - `level`: function of points (n, s), metres, that returns one number per point (n,), negative on one side of the
      surface and positive on the other.

    Raises `ValueError` if `level` does not return one finite number per point.

    **Example:**

    ```python
    circle = lambda points: np.hypot(points[:, 0], points[:, 1]) - 0.05
    cut(mesh, circle).num_cells
    ```
    """
    division, value = _move_nodes_onto(_SplitMesh.from_mesh(mesh), level)
    while True:
        points, cells = division.points, division.cells
        side = np.sign(value)[cells]
        some = np.flatnonzero(side.min(axis=1) * side.max(axis=1) < 0)
        if not len(some):
            return division.mesh(mesh.tags)
        some = np.flatnonzero(_is_node_of(cells[some], len(points))[cells].any(axis=1))
        edges, number, rank = _edges(points, cells[some])
        crossed = np.prod(np.sign(value)[edges], axis=1) < 0
        chosen = edges[crossed & _is_longest_around(number, np.where(crossed, rank, -1))]
        division, _ = division.split(chosen, _zero_on_edges(points[chosen], value[chosen[:, 0]], level))
        value = np.append(value, np.zeros(len(chosen)))


@dataclass(frozen=True)
class _SplitMesh:
    """Arrays of a mesh whose edges are being split.

    **Fields**: `points` (n, s): coordinates, metres; `cells` (m, d + 1): nodes of each cell; `facets` (b, d): nodes of
    each boundary facet; `side` (b,): index of the original facet that contains each facet.
    """

    points: Float[np.ndarray, "n s"]
    cells: Int[np.ndarray, "m k"]
    facets: Int[np.ndarray, "b d"]
    side: Int[np.ndarray, " b"]

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> _SplitMesh:
        """Copy the arrays of a mesh; no edge is split yet."""
        check_kind("mesh", mesh, Mesh, "a mesh, such as jeit.mesh.disk or jeit.mesh.read return")
        points, cells, facets = (np.asarray(one) for one in (mesh.points, mesh.cells, mesh.facets))
        return cls(points, cells, facets, np.arange(len(facets)))

    def mesh(self, tags) -> Mesh:
        """Create the mesh, with the `tags` of the original mesh."""
        named = {name: self.facets[np.isin(self.side, np.asarray(index))] for name, index in tags.items()}
        with size_checked():
            return Mesh.create(self.points, self.cells, tags=named)

    def split(self, edges: Int[np.ndarray, "e 2"], middles: Float[np.ndarray, "e s"]) -> tuple[_SplitMesh, np.ndarray]:
        """Split `edges`, of which no cell may have two, at their `middles`, metres. Returns the new division, and for
        each of its cells the index of the cell that contains it."""
        node = len(self.points) + np.arange(len(edges))
        cells, came = _split_simplices(self.cells, edges, node, len(self.points))
        facets, side = _split_simplices(self.facets, edges, node, len(self.points))
        return _SplitMesh(np.concatenate([self.points, middles]), cells, facets, self.side[side]), came


def _exceeds_size(division: _SplitMesh, selected_cells, size) -> Bool[np.ndarray, " m"]:
    """Whether the longest edge of each cell exceeds the allowed length. Raises `ValueError` for invalid results of
    `size`."""
    cells = division.cells[selected_cells]
    most = np.asarray(size(division.points[cells]))
    if most.shape != (len(cells),) or not (most > 0).all():
        raise ValueError(
            f"size must give one number per cell, metres, above zero (numpy.inf leaves it); of {len(cells)} cells it "
            f"gave {describe(most)}."
        )
    return _longest_edge_lengths(division.points, cells) > most


def _move_nodes_onto(division: _SplitMesh, level) -> tuple[_SplitMesh, Float[np.ndarray, " n"]]:
    """Move nodes that are near the surface level = 0 onto it, along edges. Nodes of the boundary stay, and nodes whose
    movement would leave a cell with hardly any volume. Also returns the level at all nodes."""
    points, cells = division.points, division.cells
    value = np.asarray(level(points))
    if value.shape != (len(points),) or not np.isfinite(value).all():
        raise ValueError(
            f"level must give one finite number per point; of {len(points)} points it gave {describe(value)}."
        )
    side = np.sign(value)[cells]
    edges, _, _ = _edges(points, cells[side.min(axis=1) * side.max(axis=1) < 0])
    edges = edges[np.prod(np.sign(value)[edges], axis=1) < 0]
    place = _zero_on_edges(points[edges], value[edges[:, 0]], level)
    distance = np.linalg.norm(points[edges] - place[:, None], axis=2) / _edge_lengths(points[edges])[:, None]
    ends, order = edges.ravel(), np.argsort(-distance.ravel())  # a node's nearest crossing is assigned last
    nearest, target = np.full(len(points), np.inf), points.copy()
    nearest[ends[order]], target[ends[order]] = distance.ravel()[order], np.repeat(place, 2, axis=0)[order]
    moves = (nearest < _MAX_MOVE) & ~_is_node_of(division.facets, len(points))
    before = _volumes(points, cells)
    while True:
        moved = np.where(moves[:, None], target, points)
        crushed = _volumes(moved, cells) < _MIN_VOLUME_RATIO * before
        if not crushed.any():
            return replace(division, points=moved), np.where(moves, 0, value)
        moves &= ~_is_node_of(cells[crushed], len(points))


def _zero_on_edges(
    ends: Float[np.ndarray, "e 2 s"], first_level: Float[np.ndarray, " e"], level
) -> Float[np.ndarray, "e s"]:
    """Locate the point on each edge where the level is zero, by bisection. `first_level` (e,): levels at the first
    ends; the level at the other ends has the opposite sign."""
    low, high = np.zeros((len(ends), 1)), np.ones((len(ends), 1))
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    for _ in range(_BISECTION_STEPS):
        middle = (low + high) / 2
        same = (level(start + middle * along) * first_level > 0)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return start + high * along


def _edges(points, simplices) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "m k"], Int[np.ndarray, " e"]]:
    """All edges, each with its lower node first; the indices of the edges of each simplex; and the ranks of the edges
    by length."""
    ends = _edge_nodes(simplices).reshape(-1, 2)
    key, edge_index = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(key, len(points)), axis=1)
    rank = np.empty(len(edges), int)
    rank[np.argsort(_edge_lengths(points[edges]), kind="stable")] = np.arange(len(edges))
    return edges, edge_index.reshape(len(simplices), -1), rank


def _edge_nodes(simplices) -> Int[np.ndarray, "m k 2"]:
    """The two nodes of each edge of each simplex, the lower node first."""
    pairs = np.array(list(itertools.combinations(range(simplices.shape[1]), 2)))
    return np.sort(simplices[:, pairs].astype(np.int64), axis=2)


def _edge_lengths(ends: Float[np.ndarray, "... 2 s"]) -> Float[np.ndarray, "..."]:
    """Lengths of edges."""
    return np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1)


def _longest_edge_lengths(points, cells) -> Float[np.ndarray, " m"]:
    """Length of the longest edge of each cell, metres."""
    return _edge_lengths(points[_edge_nodes(cells)]).max(axis=1)


def _longest_edge_of_cell(edge_indices, rank) -> Int[np.ndarray, " m"]:
    """Index of the longest edge of each cell, by the ranks of the edges."""
    return np.take_along_axis(edge_indices, np.argmax(rank[edge_indices], axis=1)[:, None], axis=1)[:, 0]


def _is_longest_around(edge_indices, rank) -> Bool[np.ndarray, " e"]:
    """Whether each edge is the longest one of all the cells around it, by the ranks of the edges."""
    return np.bincount(_longest_edge_of_cell(edge_indices, rank), minlength=len(rank)) == np.bincount(
        edge_indices.ravel(), minlength=len(rank)
    )


def _is_node_of(simplices, num_points: int) -> Bool[np.ndarray, " n"]:
    """Whether each node belongs to any of the simplices."""
    there = np.zeros(num_points, bool)
    there[simplices] = True
    return there


def _volumes(points, cells) -> Float[np.ndarray, " m"]:
    """Volumes of cells up to a constant factor, negative for inverted cells; areas of triangles in space are never
    negative."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    if sides.shape[1] < sides.shape[2]:
        return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return np.linalg.det(sides)


def _split_simplices(simplices, edges, node, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Split each simplex that has one of the `edges` into two at the new `node`. Also returns the index of the original
    simplex that contains each result."""
    some = np.flatnonzero(_is_node_of(edges, num_points)[simplices].sum(axis=1) > 1)
    key = edges @ [num_points, 1]
    order = np.argsort(key)
    ends = _edge_nodes(simplices[some])
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
