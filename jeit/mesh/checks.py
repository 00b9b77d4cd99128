"""Checks of the arrays that define a mesh, and of its size; each error names the fault and its remedy."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jeit.mesh import topology

# Minimum area of a cell divided by the square of its longest edge, or minimum volume divided by the cube of its longest
# edge. Gradients on flatter cells are inaccurate in double precision.
_MIN_RELATIVE_MEASURE = 1e-10
# Maximum distance between two nodes, relative to the extent of the mesh, at which they are treated as coincident.
_COINCIDENT_DISTANCE = 1e-10
# Maximum number of nodes: the three node numbers of a facet are packed into one 64-bit integer.
MAX_POINTS = 2_000_000


def check_points(points: ArrayLike) -> np.ndarray:
    """Convert coordinates to float64 (n, d). Raises `ValueError` for a wrong shape or type and for NaN or infinity."""
    try:
        point_array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"points: expected real numbers of shape (n, 2) or (n, 3); {error}.") from None
    if point_array.ndim != 2 or point_array.shape[1] not in (2, 3):
        shape_hint = " Transpose the array." if point_array.ndim == 2 and point_array.shape[0] in (2, 3) else ""
        raise ValueError(f"points: expected shape (n, 2) or (n, 3), got {point_array.shape}.{shape_hint}")
    nodes_not_finite = np.flatnonzero(~np.isfinite(point_array).all(axis=1))
    if nodes_not_finite.size:
        raise ValueError(
            f"points: {nodes_not_finite.size} node(s) hold NaN or infinity, first node {nodes_not_finite[0]}: "
            f"{point_array[nodes_not_finite[0]].tolist()}. Drop these nodes and the cells that use them."
        )
    if not len(point_array):
        raise ValueError("points: the array is empty; a mesh needs at least one cell.")
    warn_large(float(np.ptp(point_array, axis=0).max()), "points", is_from_file=True)
    return point_array


def check_cells(cells: ArrayLike, num_points: int, dimension: int) -> np.ndarray:
    """Convert the node indices of cells to integers (m, k). With `dimension` coordinates per point, k is `dimension` +
    1, or 3 for a surface in space. Raises `ValueError` for invalid indices, duplicated cells and unused nodes."""
    cell_array = np.asarray(cells)
    allowed_widths = (3,) if dimension == 2 else (4, 3)
    if cell_array.ndim != 2 or cell_array.shape[1] not in allowed_widths or not len(cell_array):
        cell_kind_text = (
            "triangles of shape (m, 3)" if dimension == 2 else "tetrahedra of shape (m, 4), or triangles (m, 3),"
        )
        raise ValueError(f"cells: points in {dimension}-D need {cell_kind_text} with m > 0, got {cell_array.shape}.")
    if not np.issubdtype(cell_array.dtype, np.integer):
        raise ValueError(f"cells: node indices must be integers, got {cell_array.dtype}. Convert with .astype(int).")
    cell_array = cell_array.astype(np.int64)
    if num_points > MAX_POINTS:
        raise ValueError(f"points: {num_points} nodes are more than the {MAX_POINTS} that jeit can index.")
    lowest_node_index, highest_node_index = int(cell_array.min()), int(cell_array.max())
    if lowest_node_index < 0 or highest_node_index >= num_points:
        index_hint = (
            " They look one-based: subtract 1." if lowest_node_index >= 1 and highest_node_index == num_points else ""
        )
        raise ValueError(
            f"cells: node indices run from {lowest_node_index} to {highest_node_index}, but the mesh has nodes 0 to "
            f"{num_points - 1}.{index_hint}"
        )
    sorted_cells = np.sort(cell_array, axis=1)
    repeated_cells = np.flatnonzero((sorted_cells[:, 1:] == sorted_cells[:, :-1]).any(axis=1))
    if repeated_cells.size:
        raise ValueError(
            f"cells: cell {repeated_cells[0]} uses a node twice: {cell_array[repeated_cells[0]].tolist()}. Remove such "
            "cells."
        )
    sort_order = np.lexsort(sorted_cells.T[::-1])
    duplicate_positions = np.flatnonzero((sorted_cells[sort_order][1:] == sorted_cells[sort_order][:-1]).all(axis=1))
    if duplicate_positions.size:
        equal_cells = np.sort(sort_order[duplicate_positions[0] : duplicate_positions[0] + 2]).tolist()
        raise ValueError(
            f"cells: {duplicate_positions.size} cell(s) are duplicated, first cells {equal_cells[0]} and "
            f"{equal_cells[1]} with nodes {sorted_cells[sort_order[duplicate_positions[0]]].tolist()}. Keep one of "
            "each."
        )
    unused_nodes = np.setdiff1d(np.arange(num_points), cell_array)
    if unused_nodes.size:
        raise ValueError(
            f"points: {unused_nodes.size} node(s) belong to no cell, first node {unused_nodes[0]}. They would make the "
            "stiffness matrix singular: drop them and renumber the cells."
        )
    return cell_array


def check_coinciding(points: np.ndarray) -> None:
    """Raise `ValueError` if two nodes coincide."""
    if len(points) < 2:
        return
    neighbour_distances, nearest_neighbours = map(np.asarray, KDTree(points).query(points, k=2))
    close_nodes = np.flatnonzero(neighbour_distances[:, 1] <= _COINCIDENT_DISTANCE * np.ptp(points, axis=0).max())
    if close_nodes.size:
        first_node = int(close_nodes[0])
        neighbour_index = int(
            nearest_neighbours[first_node, 1]
            if nearest_neighbours[first_node, 1] != first_node
            else nearest_neighbours[first_node, 0]
        )
        raise ValueError(
            f"points: {close_nodes.size} nodes coincide with another, first nodes {first_node} and {neighbour_index} "
            f"at {points[first_node].tolist()}. Merge them, or the mesh has an invisible crack there."
        )


def signed_measures(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Signed areas or volumes (m,) of the cells; for triangles in space, the areas are always positive."""
    edge_vectors = points[cells[:, 1:]] - points[cells[:, :1]]
    if cells.shape[1] == points.shape[1]:
        return np.linalg.norm(np.cross(edge_vectors[:, 0], edge_vectors[:, 1]), axis=1) / 2
    return np.linalg.det(edge_vectors) / (2.0 if cells.shape[1] == 3 else 6.0)


def orient(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Reorder the nodes of cells so that every cell has positive area or volume. Raises `ValueError` for degenerate
    cells."""
    cell_measures = signed_measures(points, cells)
    dimension = cells.shape[1] - 1
    cell_corners = points[cells]
    cell_sizes = np.linalg.norm(cell_corners - np.roll(cell_corners, 1, axis=1), axis=2).max(axis=1)
    flat_cells = np.flatnonzero(np.abs(cell_measures) <= _MIN_RELATIVE_MEASURE * cell_sizes**dimension)
    if flat_cells.size:
        name = "area" if dimension == 2 else "volume"
        raise ValueError(
            f"cells: {flat_cells.size} cell(s) have no {name}, first cell {flat_cells[0]} with nodes "
            f"{cells[flat_cells[0]].tolist()}: its nodes lie on one line or plane. Remove it or move a node."
        )
    swapped_cells = cells.copy()
    swapped_cells[:, [-2, -1]] = cells[:, [-1, -2]]
    return np.where((cell_measures > 0)[:, None], cells, swapped_cells)


def check_connected(first_cells: np.ndarray, second_cells: np.ndarray, num_cells: int) -> None:
    """Raise `ValueError` if the `num_cells` cells are not connected; `first_cells` and `second_cells`: indices of the
    two cells at each interior facet."""
    cell_graph = coo_array((np.ones(len(first_cells)), (first_cells, second_cells)), shape=(num_cells, num_cells))
    num_parts, component_labels = connected_components(cell_graph, directed=False)
    if num_parts > 1:
        component_sizes = np.bincount(component_labels)
        raise ValueError(
            f"cells: the mesh falls into {num_parts} separate parts of {np.sort(component_sizes)[::-1][:5].tolist()} "
            "cells. No current flows between them: keep one part, or merge the nodes along their common boundary."
        )


def locate_tags(tags: Mapping[str, ArrayLike], facets: np.ndarray) -> dict[str, np.ndarray]:
    """Convert the facets of each tag to indices (t,) into `facets`. Raises `ValueError` for a tag with a facet that is
    not in `facets`."""
    located_tags = {}
    for name, tagged_facets in tags.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"tags: names must be non-empty strings, got {name!r}.")
        facet_array = np.asarray(tagged_facets)
        if facet_array.size == 0:
            raise ValueError(f"tags: {name!r} is empty. Leave it out, or name at least one boundary facet.")
        if not np.issubdtype(facet_array.dtype, np.integer):
            raise ValueError(f"tags: {name!r} must hold integers, got {facet_array.dtype}.")
        if facet_array.ndim == 2 and facet_array.shape[1] == facets.shape[1]:
            facet_array = _match_facets(name, facet_array.astype(np.int64), facets)
        elif facet_array.ndim != 1:
            raise ValueError(
                f"tags: {name!r} must be facet indices (t,) or facet nodes (t, {facets.shape[1]}), got "
                f"{facet_array.shape}."
            )
        if facet_array.min() < 0 or facet_array.max() >= len(facets):
            raise ValueError(
                f"tags: {name!r} holds facet indices from {facet_array.min()} to {facet_array.max()}, but the mesh has "
                f"boundary facets 0 to {len(facets) - 1}."
            )
        located_tags[name] = np.unique(facet_array)
    return located_tags


def _match_facets(name: str, nodes: np.ndarray, facets: np.ndarray) -> np.ndarray:
    num_nodes = int(max(facets.max(), nodes.max())) + 1
    facet_keys = topology.facet_keys(facets, num_nodes)
    sort_order = np.argsort(facet_keys)
    tag_keys = topology.facet_keys(nodes, num_nodes)
    facet_positions = np.minimum(np.searchsorted(facet_keys[sort_order], tag_keys), len(facet_keys) - 1)
    missing_facets = np.flatnonzero((facet_keys[sort_order][facet_positions] != tag_keys) | (nodes.min(axis=1) < 0))
    if missing_facets.size:
        raise ValueError(
            f"tags: {name!r} names the facet with nodes {nodes[missing_facets[0]].tolist()}, which is not on the "
            "boundary of the mesh. Tags group boundary facets only."
        )
    return sort_order[facet_positions]


MAX_PLAUSIBLE_SIZE = 10.0
"""Size in metres above which a warning is issued: no tank or skin is larger."""
_IS_SIZE_CHECKED: ContextVar[bool] = ContextVar("size_checked", default=False)


@contextmanager
def size_checked() -> Iterator[None]:
    """Context manager or decorator that suppresses warnings about large sizes, for meshes created from a body or mesh
    whose size has already been checked."""
    context_token = _IS_SIZE_CHECKED.set(True)
    try:
        yield
    finally:
        _IS_SIZE_CHECKED.reset(context_token)


def warn_large(largest_side: float, name: str, size_factor: float = 1.0, *, is_from_file: bool = False) -> None:
    """Warn if an object is so large that its length of `largest_side` metres was probably specified in a different
    unit.

    `size_factor`: size of the object divided by `largest_side`; `is_from_file`: whether the length may come from a
    file; if so, the message suggests a scale. No warning is issued inside `size_checked`.
    """
    if not size_factor * largest_side > MAX_PLAUSIBLE_SIZE or _IS_SIZE_CHECKED.get():
        return
    scale_hints = [
        f" (a file is read with scale={unit_scale})" if is_from_file else ""
        for unit_scale in ("1e-3", "1e-2", "0.0254")
    ]
    warnings.warn(
        f"{name}: {largest_side:g} m is large for what electrodes are put on. If the lengths are millimetres, give "
        f"{1e-3 * largest_side:g}{scale_hints[0]}, if centimetres, {1e-2 * largest_side:g}{scale_hints[1]}, if inches, "
        f"{0.0254 * largest_side:g}{scale_hints[2]}: jeit computes in metres.",
        UserWarning,
        stacklevel=4,
    )
