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
    refined_mesh = bisect_with_parents(mesh, size, MAX_POINTS)
    if refined_mesh is None:
        raise ValueError(f"size asks for more than {MAX_POINTS:,} nodes; give longer edges. Are they in metres?")
    return refined_mesh[0]


def bisect_with_parents(
    mesh: Mesh, size: Callable[..., Float[np.ndarray, " m"]], max_points: int
) -> tuple[Mesh, Int[np.ndarray, " m"]] | None:
    """Refine a mesh as `bisect` does. Also returns, for each cell of the new mesh, the index of the cell of the
    original mesh that contains it. Returns None if `size` requires more than `max_points` nodes. Raises `ValueError` as
    `bisect` does."""
    mesh_in_progress = _SplitMesh.from_mesh(mesh)
    parent_cells, all_cells = np.arange(len(mesh_in_progress.cells)), slice(None)
    longest_edge, longest_length = _longest_edges(mesh_in_progress, all_cells)
    is_too_long = _exceeds_size(mesh_in_progress, all_cells, longest_length, size)
    while is_too_long.any():
        points = mesh_in_progress.points
        split_edges = _find_edges_to_split(
            mesh_in_progress.cells, longest_edge, np.unique(longest_edge[is_too_long]), len(points)
        )
        if len(points) + len(split_edges) > max_points:
            return None
        mesh_in_progress, old_cells = mesh_in_progress.split(split_edges, points[split_edges].mean(axis=1))
        parent_cells, longest_edge, is_too_long = (
            parent_cells[old_cells],
            longest_edge[old_cells],
            is_too_long[old_cells],
        )
        is_new = np.bincount(old_cells)[old_cells] > 1
        longest_edge[is_new], longest_length = _longest_edges(mesh_in_progress, is_new)
        is_too_long[is_new] = _exceeds_size(mesh_in_progress, is_new, longest_length, size)
    return mesh_in_progress.mesh(mesh.tags), parent_cells


def _find_edges_to_split(cells, longest_edge, marked_edges, num_points: int) -> Int[np.ndarray, "e 2"]:
    """The edges (e, 2) that are split next so that the edges `marked_edges` can be split: the longest edges of all the
    cells around them. If a marked edge is not the longest edge of a cell, that cell's longest edge is marked, too.

    `longest_edge` (m,) and `marked_edges` are numbers of edges, as returned by `_edge_numbers`.
    """
    edges_to_split, new_edges = [], marked_edges
    while len(new_edges):
        cells_at_edges, edges_of_cells = _find_cells_of_edges(cells, new_edges, num_points)
        is_longest = longest_edge[cells_at_edges] == edges_of_cells
        edges_to_split.append(np.setdiff1d(new_edges, edges_of_cells[~is_longest], assume_unique=True))
        new_edges = np.setdiff1d(longest_edge[cells_at_edges[~is_longest]], marked_edges)
        marked_edges = np.union1d(marked_edges, new_edges)
    return _edges_of_numbers(np.sort(np.concatenate(edges_to_split)))


def _find_cells_of_edges(cells, edge_numbers, num_points: int) -> tuple[Int[np.ndarray, " i"], Int[np.ndarray, " i"]]:
    """All pairs of a cell and an edge of the cell among `edge_numbers`, which are sorted numbers: indices of the cells,
    and numbers of the edges."""
    candidate_cells = _find_simplices_with_two_nodes(cells, _edges_of_numbers(edge_numbers), num_points)
    cell_edge_numbers = _edge_numbers(_edge_nodes(cells[candidate_cells]))
    candidate_rows, edge_columns = np.nonzero(
        edge_numbers[np.minimum(np.searchsorted(edge_numbers, cell_edge_numbers), len(edge_numbers) - 1)]
        == cell_edge_numbers
    )
    return candidate_cells[candidate_rows], cell_edge_numbers[candidate_rows, edge_columns]


def cut(mesh: Mesh, level: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, " n"]]) -> Mesh:
    """Divide the cells of a mesh along the surface on which `level` is zero, so that no cell lies on both sides of the
    surface.

    Nodes near the surface are moved onto it, except nodes of the boundary. Cells should be small relative to the body
    that the surface bounds (see `bisect`).

    **Arguments:**

    - `mesh`: the mesh to divide.
    - `level`: function of points (n, s), metres, that returns one number per point (n,), negative on one side of the
      surface and positive on the other.

    Raises `ValueError` if `level` does not return one finite number per point, or has one sign at all nodes.

    **Example:**

    ```python
    circle = lambda points: np.hypot(points[:, 0], points[:, 1]) - 0.05
    cut(mesh, circle).num_cells
    ```
    """
    split_mesh, node_levels = _move_nodes_onto_level(_SplitMesh.from_mesh(mesh), level)
    while True:
        points, cells = split_mesh.points, split_mesh.cells
        sign_of_level = np.sign(node_levels)[cells]
        crossed_cells = np.flatnonzero(sign_of_level.min(axis=1) * sign_of_level.max(axis=1) < 0)
        if not len(crossed_cells):
            return split_mesh.mesh(mesh.tags)
        crossed_cells = np.flatnonzero(_mark_nodes(cells[crossed_cells], len(points))[cells].any(axis=1))
        crossed_edges, edge_indices, length_ranks = _edges_of_simplices(points, cells[crossed_cells])
        is_crossed = np.prod(np.sign(node_levels)[crossed_edges], axis=1) < 0
        split_edges = crossed_edges[
            is_crossed & _is_longest_in_its_cells(edge_indices, np.where(is_crossed, length_ranks, -1))
        ]
        split_mesh, _ = split_mesh.split(
            split_edges, _find_zeros_on_edges(points[split_edges], node_levels[split_edges[:, 0]], level)
        )
        node_levels = np.append(node_levels, np.zeros(len(split_edges)))


@dataclass(frozen=True)
class _SplitMesh:
    """Arrays of a mesh whose edges are being split.

    **Fields**: `points` (n, s): coordinates, metres; `cells` (m, d + 1): nodes of each cell; `facets` (b, d): nodes of
    each boundary facet; `original_facets` (b,): index of the original facet that contains each facet.
    """

    points: Float[np.ndarray, "n s"]
    cells: Int[np.ndarray, "m k"]
    facets: Int[np.ndarray, "b d"]
    original_facets: Int[np.ndarray, " b"]

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> _SplitMesh:
        """Copy the arrays of a mesh; no edge is split yet."""
        check_kind("mesh", mesh, Mesh, "a mesh, such as jeit.mesh.disk or jeit.mesh.read return")
        points, cells, facets = (np.asarray(array) for array in (mesh.points, mesh.cells, mesh.facets))
        return cls(points, cells, facets, np.arange(len(facets)))

    def mesh(self, original_tags) -> Mesh:
        """Create a `Mesh` from the arrays, with the tags `original_tags`."""
        tagged_facets = {
            name: self.facets[np.isin(self.original_facets, np.asarray(facet_indices))]
            for name, facet_indices in original_tags.items()
        }
        with size_checked():
            return Mesh.create(self.points, self.cells, tags=tagged_facets)

    def split(
        self, edges: Int[np.ndarray, "e 2"], midpoints: Float[np.ndarray, "e s"]
    ) -> tuple[_SplitMesh, np.ndarray]:
        """Split `edges` at the points `midpoints`, metres; no cell may contain two of the edges. Returns the arrays
        after the split and, for each new cell, the index of the old cell that contains it."""
        new_nodes = len(self.points) + np.arange(len(edges))
        cells, old_cells = _split_simplices(self.cells, edges, new_nodes, len(self.points))
        facets, old_facets = _split_simplices(self.facets, edges, new_nodes, len(self.points))
        return _SplitMesh(
            np.concatenate([self.points, midpoints]), cells, facets, self.original_facets[old_facets]
        ), old_cells


def _longest_edges(split_mesh: _SplitMesh, selected_cells) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Number and length in metres of the longest edge of each selected cell. Of edges of the same length, the one with
    the largest number counts as the longest, in every cell."""
    end_nodes = _edge_nodes(split_mesh.cells[selected_cells])
    edge_lengths, edge_numbers = _edge_lengths(split_mesh.points[end_nodes]), _edge_numbers(end_nodes)
    longest_length = edge_lengths.max(axis=1)
    return np.where(edge_lengths == longest_length[:, None], edge_numbers, -1).max(axis=1), longest_length


def _exceeds_size(split_mesh: _SplitMesh, selected_cells, longest_length, size_function) -> Bool[np.ndarray, " m"]:
    """Whether the longest edge of each selected cell, of `longest_length` in metres, exceeds the length that
    `size_function` allows. Raises `ValueError` if `size_function` does not return one positive number per cell."""
    cells = split_mesh.cells[selected_cells]
    max_lengths = np.asarray(size_function(split_mesh.points[cells]))
    if max_lengths.shape != (len(cells),) or not (max_lengths > 0).all():
        raise ValueError(
            f"size must give one number per cell, metres, above zero (numpy.inf leaves it); of {len(cells)} cells it "
            f"gave {describe(max_lengths)}."
        )
    return longest_length > max_lengths


def _move_nodes_onto_level(split_mesh: _SplitMesh, level_function) -> tuple[_SplitMesh, Float[np.ndarray, " n"]]:
    """Move nodes that are near the surface `level_function` = 0 onto this surface, along edges. Nodes of the boundary
    are not moved, nor are nodes whose movement would reduce the volume of a cell to less than `_MIN_VOLUME_RATIO` times
    its value. Also returns the values of `level_function` at all nodes."""
    points, cells = split_mesh.points, split_mesh.cells
    node_levels = np.asarray(level_function(points))
    if node_levels.shape != (len(points),) or not np.isfinite(node_levels).all():
        raise ValueError(
            f"level must give one finite number per point; of {len(points)} points it gave {describe(node_levels)}."
        )
    if node_levels.min() >= 0 or node_levels.max() <= 0:
        raise ValueError(
            f"level has one sign at all nodes of the mesh, {describe(node_levels)}: there is nothing to cut. Is the "
            "body inside the mesh, and larger than a cell? If it is small, refine the mesh there by bisect first."
        )
    sign_of_level = np.sign(node_levels)[cells]
    is_crossed_cell = sign_of_level.min(axis=1) * sign_of_level.max(axis=1) < 0
    if not is_crossed_cell.any():  # the surface consists of facets of the mesh
        return split_mesh, node_levels
    crossed_edges, _, _ = _edges_of_simplices(points, cells[is_crossed_cell])
    crossed_edges = crossed_edges[np.prod(np.sign(node_levels)[crossed_edges], axis=1) < 0]
    crossing_points = _find_zeros_on_edges(points[crossed_edges], node_levels[crossed_edges[:, 0]], level_function)
    relative_distances = (
        np.linalg.norm(points[crossed_edges] - crossing_points[:, None], axis=2)
        / _edge_lengths(points[crossed_edges])[:, None]
    )
    # A node's nearest crossing is assigned last.
    end_nodes, sort_order = (
        crossed_edges.ravel(),
        np.argsort(-relative_distances.ravel()),
    )
    nearest_relative_distance, target_points = np.full(len(points), np.inf), points.copy()
    nearest_relative_distance[end_nodes[sort_order]], target_points[end_nodes[sort_order]] = (
        relative_distances.ravel()[sort_order],
        np.repeat(crossing_points, 2, axis=0)[sort_order],
    )
    is_moved_node = (nearest_relative_distance < _MAX_RELATIVE_NODE_MOVE) & ~_mark_nodes(split_mesh.facets, len(points))
    volumes_before_move = _scaled_cell_volumes(points, cells)
    while True:
        moved_points = np.where(is_moved_node[:, None], target_points, points)
        is_too_small = _scaled_cell_volumes(moved_points, cells) < _MIN_VOLUME_RATIO * volumes_before_move
        if not is_too_small.any():
            return replace(split_mesh, points=moved_points), np.where(is_moved_node, 0, node_levels)
        is_moved_node &= ~_mark_nodes(cells[is_too_small], len(points))


def _find_zeros_on_edges(
    end_points: Float[np.ndarray, "e 2 s"], first_level: Float[np.ndarray, " e"], level_function
) -> Float[np.ndarray, "e s"]:
    """Locate the point on each edge where `level_function` is zero, by bisection. `first_level` (e,): values of
    `level_function` at the first ends of the edges; its values at the second ends have the opposite sign."""
    lower_fractions, upper_fractions = np.zeros((len(end_points), 1)), np.ones((len(end_points), 1))
    edge_starts, edge_directions = end_points[:, 0], end_points[:, 1] - end_points[:, 0]
    for _ in range(_BISECTION_STEPS):
        midpoint_fractions = (lower_fractions + upper_fractions) / 2
        is_same_sign = (level_function(edge_starts + midpoint_fractions * edge_directions) * first_level > 0)[:, None]
        lower_fractions, upper_fractions = (
            np.where(is_same_sign, midpoint_fractions, lower_fractions),
            np.where(is_same_sign, upper_fractions, midpoint_fractions),
        )
    return edge_starts + upper_fractions * edge_directions


def _edges_of_simplices(
    points, simplices
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "m k"], Int[np.ndarray, " e"]]:
    """All edges (e, 2) of the simplices, each with its lower-numbered node first; the indices (m, k) of the edges of
    each simplex; and the ranks (e,) of the edges by length."""
    end_nodes = _edge_nodes(simplices).reshape(-1, 2)
    edge_keys, edge_index = np.unique(end_nodes[:, 0] * len(points) + end_nodes[:, 1], return_inverse=True)
    distinct_edges = np.stack(np.divmod(edge_keys, len(points)), axis=1)
    length_ranks = np.empty(len(distinct_edges), int)
    length_ranks[np.argsort(_edge_lengths(points[distinct_edges]), kind="stable")] = np.arange(len(distinct_edges))
    return distinct_edges, edge_index.reshape(len(simplices), -1), length_ranks


def _edge_nodes(simplices) -> Int[np.ndarray, "m k 2"]:
    """The two nodes of each edge of each simplex, the lower-numbered node first."""
    corner_pairs = np.array(list(itertools.combinations(range(simplices.shape[1]), 2)))
    first_nodes, second_nodes = (simplices[:, nodes].astype(np.int64) for nodes in corner_pairs.T)
    return np.stack([np.minimum(first_nodes, second_nodes), np.maximum(first_nodes, second_nodes)], axis=2)


def _edge_numbers(edges: Int[np.ndarray, "... 2"]) -> Int[np.ndarray, "..."]:
    """Number (…) of each edge (…, 2), which is ordered as the edge's nodes are."""
    return edges[..., 0] << 32 | edges[..., 1]


def _edges_of_numbers(edge_numbers: Int[np.ndarray, " e"]) -> Int[np.ndarray, "e 2"]:
    """The two nodes of each edge of `edge_numbers`."""
    return np.stack([edge_numbers >> 32, edge_numbers & 0xFFFFFFFF], axis=1)


def _edge_lengths(end_points: Float[np.ndarray, "... 2 s"]) -> Float[np.ndarray, "..."]:
    """Lengths (…) of edges with the end points `end_points` (…, 2, s)."""
    return np.linalg.norm(end_points[..., 1, :] - end_points[..., 0, :], axis=-1)


def _longest_edge_of_cell(edge_indices, length_ranks) -> Int[np.ndarray, " m"]:
    """Index of the longest edge of each cell, determined from the ranks of the edges by length."""
    return np.take_along_axis(edge_indices, np.argmax(length_ranks[edge_indices], axis=1)[:, None], axis=1)[:, 0]


def _is_longest_in_its_cells(edge_indices, length_ranks) -> Bool[np.ndarray, " e"]:
    """Whether each edge is the longest edge of every cell that contains it, according to the ranks of the edges by
    length."""
    return np.bincount(_longest_edge_of_cell(edge_indices, length_ranks), minlength=len(length_ranks)) == np.bincount(
        edge_indices.ravel(), minlength=len(length_ranks)
    )


def _mark_nodes(simplices, num_points: int) -> Bool[np.ndarray, " n"]:
    """Whether each node belongs to any of the simplices."""
    is_node = np.zeros(num_points, bool)
    is_node[simplices] = True
    return is_node


def _find_simplices_with_two_nodes(simplices, edge_nodes, num_points: int) -> Int[np.ndarray, " c"]:
    """Indices of the simplices with at least two nodes that belong to any of the edges."""
    is_node = _mark_nodes(edge_nodes, num_points).astype(np.int8)
    return np.flatnonzero(sum(is_node[nodes] for nodes in simplices.T) > 1)  # quicker than sum(axis=1)


def _scaled_cell_volumes(points, cells) -> Float[np.ndarray, " m"]:
    """Volumes of cells up to a constant factor, negative for inverted cells; areas of triangles in space are never
    negative."""
    side_vectors = points[cells[:, 1:]] - points[cells[:, :1]]
    if side_vectors.shape[1] < side_vectors.shape[2]:
        return np.linalg.norm(np.cross(side_vectors[:, 0], side_vectors[:, 1]), axis=1)
    return np.linalg.det(side_vectors)


def _split_simplices(simplices, edges, new_nodes, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Split each simplex that contains one of the `edges` into two, at the edge's new node in `new_nodes`. Also
    returns, for each resulting simplex, the index of the original simplex that contains it."""
    candidate_simplices = _find_simplices_with_two_nodes(simplices, edges, num_points)
    keys_of_split_edges = edges @ [num_points, 1]
    sort_order = np.argsort(keys_of_split_edges)
    edge_ends = _edge_nodes(simplices[candidate_simplices])
    edge_keys = edge_ends @ [num_points, 1]
    edge_positions = sort_order[
        np.minimum(np.searchsorted(keys_of_split_edges[sort_order], edge_keys), len(keys_of_split_edges) - 1)
    ]
    is_split = keys_of_split_edges[edge_positions] == edge_keys
    has_split_edge = is_split.any(axis=1)
    candidate_simplices, split_edge = candidate_simplices[has_split_edge], np.argmax(is_split[has_split_edge], axis=1)
    split_rows = np.flatnonzero(has_split_edge)
    middle_nodes = new_nodes[edge_positions[split_rows, split_edge]][:, None]
    half_simplices = [
        np.where(simplices[candidate_simplices] == replaced_ends[:, None], middle_nodes, simplices[candidate_simplices])
        for replaced_ends in edge_ends[split_rows, split_edge].T
    ]
    unsplit_indices = np.delete(np.arange(len(simplices)), candidate_simplices)
    return np.concatenate([simplices[unsplit_indices], *half_simplices]), np.concatenate(
        [unsplit_indices, candidate_simplices, candidate_simplices]
    )
