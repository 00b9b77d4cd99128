"""Refinement of meshes of triangles, in the plane or in space, or of tetrahedra: `bisect` refines cells to the lengths
that a size function allows, `cut` divides cells along a surface.

An edge is split in all the cells around it, so the mesh stays conforming. `bisect` splits an edge at its midpoint, and
only if it is the longest edge of every cell around it, so that repeated splitting does not make cells thin: Rivara,
International Journal for Numerical Methods in Engineering 20 (1984) 745.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import check_kind, describe
from jeit.mesh.checks import MAX_POINTS, size_checked
from jeit.mesh.mesh import Mesh

# An end of an edge is moved onto a surface that crosses the edge if its distance from the crossing, divided by the
# edge's length, is below this value.
_MAX_RELATIVE_NODE_MOVE = 0.25
# Minimum volume of a cell after its nodes have moved, divided by its volume before the move.
_MIN_VOLUME_RATIO = 0.1
# Number of bisection steps to locate the point where a surface crosses an edge.
_BISECTION_STEPS = 30


def bisect(mesh: Mesh, size: Callable[[Float[np.ndarray, "m k s"]], Float[np.ndarray, " m"]]) -> Mesh:
    """Refine a mesh until no cell's longest edge exceeds the length that `size` allows.

    Neighbouring cells are divided as needed to keep the mesh conforming. The new mesh has the same tags, and its
    boundary has the same shape.

    **Arguments:**

    - `mesh`: the mesh to refine.
    - `size`: function of the corners of cells (m, k, s), metres, that returns the maximum length of the longest edge of
      each cell (m,), metres; infinity leaves a cell unchanged.

    Raises `ValueError` if `size` does not return one positive number per cell, or requires more than 2,000,000 nodes.

    **Example:**

    ```python
    near = lambda corners: np.where(corners[..., 0].mean(axis=1) > 0.05, 0.01, np.inf)
    bisect(mesh, near).num_cells
    ```
    """
    refined = bisect_with_parents(mesh, size, MAX_POINTS)
    if refined is None:
        raise ValueError(f"size asks for more than {MAX_POINTS:,} nodes; give longer edges. Are they in metres?")
    return refined[0]


def bisect_with_parents(
    mesh: Mesh, size: Callable[..., Float[np.ndarray, " m"]], max_points: int
) -> tuple[Mesh, Int[np.ndarray, " m"]] | None:
    """Refine a mesh as `bisect` does. Also returns, for each cell of the new mesh, the index of the cell of the
    original mesh that contains it. Returns None if `size` requires more than `max_points` nodes. Raises `ValueError` as
    `bisect` does."""
    mesh_in_progress = _SplitMesh.from_mesh(mesh)
    parent_cells, all_cells = np.arange(len(mesh_in_progress.cells)), slice(None)
    longest_edge, longest_length = _longest_edges(mesh_in_progress, all_cells)
    exceeds_size = _exceeds_size(mesh_in_progress, all_cells, longest_length, size)
    while exceeds_size.any():
        points = mesh_in_progress.points
        split_edges = _find_edges_to_split(
            mesh_in_progress.cells, longest_edge, np.unique(longest_edge[exceeds_size]), len(points)
        )
        if len(points) + len(split_edges) > max_points:
            return None
        mesh_in_progress, origin = mesh_in_progress.split(split_edges, points[split_edges].mean(axis=1))
        parent_cells, longest_edge, exceeds_size = parent_cells[origin], longest_edge[origin], exceeds_size[origin]
        is_new = np.bincount(origin)[origin] > 1
        longest_edge[is_new], longest_length = _longest_edges(mesh_in_progress, is_new)
        exceeds_size[is_new] = _exceeds_size(mesh_in_progress, is_new, longest_length, size)
    return mesh_in_progress.mesh(mesh.tags), parent_cells


def _find_edges_to_split(cells, longest_edge, marked_edges, num_points: int) -> Int[np.ndarray, "e 2"]:
    """The edges (e, 2) that are split next so that the edges `marked_edges` can be split: the longest edges of all the
    cells around them. If a marked edge is not the longest edge of a cell, that cell's longest edge is marked, too.

    `longest_edge` (m,) and `marked_edges` are numbers of edges, as returned by `_edge_numbers`.
    """
    edges_to_split, new_edges = [], marked_edges
    while len(new_edges):
        cells_at_edges, edge = _find_cells_of_edges(cells, new_edges, num_points)
        is_longest = longest_edge[cells_at_edges] == edge
        edges_to_split.append(np.setdiff1d(new_edges, edge[~is_longest], assume_unique=True))
        new_edges = np.setdiff1d(longest_edge[cells_at_edges[~is_longest]], marked_edges)
        marked_edges = np.union1d(marked_edges, new_edges)
    return _edges_of_numbers(np.sort(np.concatenate(edges_to_split)))


def _find_cells_of_edges(cells, edges, num_points: int) -> tuple[Int[np.ndarray, " i"], Int[np.ndarray, " i"]]:
    """All pairs of a cell and an edge of the cell among `edges`, which are sorted numbers: indices of the cells, and
    numbers of the edges."""
    candidates = _find_simplices_with_two_nodes(cells, _edges_of_numbers(edges), num_points)
    numbers = _edge_numbers(_edge_nodes(cells[candidates]))
    row, column = np.nonzero(edges[np.minimum(np.searchsorted(edges, numbers), len(edges) - 1)] == numbers)
    return candidates[row], numbers[row, column]


def cut(mesh: Mesh, level: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, " n"]]) -> Mesh:
    """Divide the cells of a mesh along the surface on which `level` is zero, so that no cell lies on both sides of the
    surface.

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
    split_mesh, levels = _move_nodes_onto(_SplitMesh.from_mesh(mesh), level)
    while True:
        points, cells = split_mesh.points, split_mesh.cells
        sign_of_level = np.sign(levels)[cells]
        crossed_cells = np.flatnonzero(sign_of_level.min(axis=1) * sign_of_level.max(axis=1) < 0)
        if not len(crossed_cells):
            return split_mesh.mesh(mesh.tags)
        crossed_cells = np.flatnonzero(_mark_nodes(cells[crossed_cells], len(points))[cells].any(axis=1))
        edges, edge_indices, rank = _edges(points, cells[crossed_cells])
        is_crossed = np.prod(np.sign(levels)[edges], axis=1) < 0
        split_edges = edges[is_crossed & _is_longest_in_its_cells(edge_indices, np.where(is_crossed, rank, -1))]
        split_mesh, _ = split_mesh.split(
            split_edges, _find_zeros_on_edges(points[split_edges], levels[split_edges[:, 0]], level)
        )
        levels = np.append(levels, np.zeros(len(split_edges)))


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
        points, cells, facets = (np.asarray(array) for array in (mesh.points, mesh.cells, mesh.facets))
        return cls(points, cells, facets, np.arange(len(facets)))

    def mesh(self, tags) -> Mesh:
        """Create a `Mesh` from the arrays, with the `tags` of the original mesh."""
        named = {
            name: self.facets[np.isin(self.side, np.asarray(facet_indices))] for name, facet_indices in tags.items()
        }
        with size_checked():
            return Mesh.create(self.points, self.cells, tags=named)

    def split(
        self, edges: Int[np.ndarray, "e 2"], midpoints: Float[np.ndarray, "e s"]
    ) -> tuple[_SplitMesh, np.ndarray]:
        """Split `edges` at the points `midpoints`, metres; no cell may contain two of the edges. Returns the arrays
        after the split and, for each new cell, the index of the old cell that contains it."""
        new_nodes = len(self.points) + np.arange(len(edges))
        cells, origin = _split_simplices(self.cells, edges, new_nodes, len(self.points))
        facets, side = _split_simplices(self.facets, edges, new_nodes, len(self.points))
        return _SplitMesh(np.concatenate([self.points, midpoints]), cells, facets, self.side[side]), origin


def _longest_edges(split_mesh: _SplitMesh, selected_cells) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Number and length in metres of the longest edge of each selected cell. Of edges of the same length, the one with
    the largest number counts as the longest, in every cell."""
    end_nodes = _edge_nodes(split_mesh.cells[selected_cells])
    lengths, numbers = _edge_lengths(split_mesh.points[end_nodes]), _edge_numbers(end_nodes)
    longest_length = lengths.max(axis=1)
    return np.where(lengths == longest_length[:, None], numbers, -1).max(axis=1), longest_length


def _exceeds_size(split_mesh: _SplitMesh, selected_cells, longest_length, size) -> Bool[np.ndarray, " m"]:
    """Whether the longest edge of each selected cell, of `longest_length` in metres, exceeds the length that `size`
    allows. Raises `ValueError` if `size` does not return one positive number per cell."""
    cells = split_mesh.cells[selected_cells]
    max_lengths = np.asarray(size(split_mesh.points[cells]))
    if max_lengths.shape != (len(cells),) or not (max_lengths > 0).all():
        raise ValueError(
            f"size must give one number per cell, metres, above zero (numpy.inf leaves it); of {len(cells)} cells it "
            f"gave {describe(max_lengths)}."
        )
    return longest_length > max_lengths


def _move_nodes_onto(split_mesh: _SplitMesh, level) -> tuple[_SplitMesh, Float[np.ndarray, " n"]]:
    """Move nodes that are near the surface `level` = 0 onto this surface, along edges. Nodes of the boundary are not
    moved, nor are nodes whose movement would reduce the volume of a cell to less than `_MIN_VOLUME_RATIO` times its
    value. Also returns the values of `level` at all nodes."""
    points, cells = split_mesh.points, split_mesh.cells
    levels = np.asarray(level(points))
    if levels.shape != (len(points),) or not np.isfinite(levels).all():
        raise ValueError(
            f"level must give one finite number per point; of {len(points)} points it gave {describe(levels)}."
        )
    sign_of_level = np.sign(levels)[cells]
    edges, _, _ = _edges(points, cells[sign_of_level.min(axis=1) * sign_of_level.max(axis=1) < 0])
    edges = edges[np.prod(np.sign(levels)[edges], axis=1) < 0]
    crossing_points = _find_zeros_on_edges(points[edges], levels[edges[:, 0]], level)
    distance = np.linalg.norm(points[edges] - crossing_points[:, None], axis=2) / _edge_lengths(points[edges])[:, None]
    end_nodes, sort_order = edges.ravel(), np.argsort(-distance.ravel())  # a node's nearest crossing is assigned last
    nearest_distance, target = np.full(len(points), np.inf), points.copy()
    nearest_distance[end_nodes[sort_order]], target[end_nodes[sort_order]] = (
        distance.ravel()[sort_order],
        np.repeat(crossing_points, 2, axis=0)[sort_order],
    )
    is_moved_node = (nearest_distance < _MAX_RELATIVE_NODE_MOVE) & ~_mark_nodes(split_mesh.facets, len(points))
    volumes_before = _volumes(points, cells)
    while True:
        moved_points = np.where(is_moved_node[:, None], target, points)
        is_too_small = _volumes(moved_points, cells) < _MIN_VOLUME_RATIO * volumes_before
        if not is_too_small.any():
            return replace(split_mesh, points=moved_points), np.where(is_moved_node, 0, levels)
        is_moved_node &= ~_mark_nodes(cells[is_too_small], len(points))


def _find_zeros_on_edges(
    end_points: Float[np.ndarray, "e 2 s"], first_level: Float[np.ndarray, " e"], level
) -> Float[np.ndarray, "e s"]:
    """Locate the point on each edge where `level` is zero, by bisection. `first_level` (e,): values of `level` at the
    first ends of the edges; its values at the second ends have the opposite sign."""
    lower_fractions, upper_fractions = np.zeros((len(end_points), 1)), np.ones((len(end_points), 1))
    start, direction = end_points[:, 0], end_points[:, 1] - end_points[:, 0]
    for _ in range(_BISECTION_STEPS):
        midpoint = (lower_fractions + upper_fractions) / 2
        is_same_sign = (level(start + midpoint * direction) * first_level > 0)[:, None]
        lower_fractions, upper_fractions = (
            np.where(is_same_sign, midpoint, lower_fractions),
            np.where(is_same_sign, upper_fractions, midpoint),
        )
    return start + upper_fractions * direction


def _edges(points, simplices) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "m k"], Int[np.ndarray, " e"]]:
    """All edges (e, 2) of the simplices, each with its lower-numbered node first; the indices (m, k) of the edges of
    each simplex; and the ranks (e,) of the edges by length."""
    end_nodes = _edge_nodes(simplices).reshape(-1, 2)
    key, edge_index = np.unique(end_nodes[:, 0] * len(points) + end_nodes[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(key, len(points)), axis=1)
    rank = np.empty(len(edges), int)
    rank[np.argsort(_edge_lengths(points[edges]), kind="stable")] = np.arange(len(edges))
    return edges, edge_index.reshape(len(simplices), -1), rank


def _edge_nodes(simplices) -> Int[np.ndarray, "m k 2"]:
    """The two nodes of each edge of each simplex, the lower-numbered node first."""
    pairs = np.array(list(itertools.combinations(range(simplices.shape[1]), 2)))
    first_nodes, second_nodes = (simplices[:, nodes].astype(np.int64) for nodes in pairs.T)
    return np.stack([np.minimum(first_nodes, second_nodes), np.maximum(first_nodes, second_nodes)], axis=2)


def _edge_numbers(edges: Int[np.ndarray, "... 2"]) -> Int[np.ndarray, "..."]:
    """Number (…) of each edge (…, 2), which is ordered as the edge's nodes are."""
    return edges[..., 0] << 32 | edges[..., 1]


def _edges_of_numbers(numbers: Int[np.ndarray, " e"]) -> Int[np.ndarray, "e 2"]:
    """The two nodes of each edge of `numbers`."""
    return np.stack([numbers >> 32, numbers & 0xFFFFFFFF], axis=1)


def _edge_lengths(end_points: Float[np.ndarray, "... 2 s"]) -> Float[np.ndarray, "..."]:
    """Lengths (…) of edges with the end points `end_points` (…, 2, s)."""
    return np.linalg.norm(end_points[..., 1, :] - end_points[..., 0, :], axis=-1)


def _longest_edge_of_cell(edge_indices, rank) -> Int[np.ndarray, " m"]:
    """Index of the longest edge of each cell, determined from the ranks of the edges by length."""
    return np.take_along_axis(edge_indices, np.argmax(rank[edge_indices], axis=1)[:, None], axis=1)[:, 0]


def _is_longest_in_its_cells(edge_indices, rank) -> Bool[np.ndarray, " e"]:
    """Whether each edge is the longest edge of every cell that contains it, according to the ranks of the edges by
    length."""
    return np.bincount(_longest_edge_of_cell(edge_indices, rank), minlength=len(rank)) == np.bincount(
        edge_indices.ravel(), minlength=len(rank)
    )


def _mark_nodes(simplices, num_points: int) -> Bool[np.ndarray, " n"]:
    """Whether each node belongs to any of the simplices."""
    is_node = np.zeros(num_points, bool)
    is_node[simplices] = True
    return is_node


def _find_simplices_with_two_nodes(simplices, edges, num_points: int) -> Int[np.ndarray, " c"]:
    """Indices of the simplices with at least two nodes that belong to any of the edges."""
    is_node = _mark_nodes(edges, num_points).astype(np.int8)
    return np.flatnonzero(sum(is_node[nodes] for nodes in simplices.T) > 1)  # quicker than sum(axis=1)


def _volumes(points, cells) -> Float[np.ndarray, " m"]:
    """Volumes of cells up to a constant factor, negative for inverted cells; areas of triangles in space are never
    negative."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    if sides.shape[1] < sides.shape[2]:
        return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return np.linalg.det(sides)


def _split_simplices(simplices, edges, new_nodes, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Split each simplex that contains one of the `edges` into two, at the edge's new node in `new_nodes`. Also
    returns, for each resulting simplex, the index of the original simplex that contains it."""
    candidates = _find_simplices_with_two_nodes(simplices, edges, num_points)
    split_keys = edges @ [num_points, 1]
    sort_order = np.argsort(split_keys)
    ends = _edge_nodes(simplices[candidates])
    edge_keys = ends @ [num_points, 1]
    edge_positions = sort_order[np.minimum(np.searchsorted(split_keys[sort_order], edge_keys), len(split_keys) - 1)]
    is_split = split_keys[edge_positions] == edge_keys
    has_split_edge = is_split.any(axis=1)
    candidates, split_edge = candidates[has_split_edge], np.argmax(is_split[has_split_edge], axis=1)
    rows = np.flatnonzero(has_split_edge)
    middle_nodes = new_nodes[edge_positions[rows, split_edge]][:, None]
    half_simplices = [
        np.where(simplices[candidates] == end[:, None], middle_nodes, simplices[candidates])
        for end in ends[rows, split_edge].T
    ]
    unsplit_indices = np.delete(np.arange(len(simplices)), candidates)
    return np.concatenate([simplices[unsplit_indices], *half_simplices]), np.concatenate(
        [unsplit_indices, candidates, candidates]
    )
