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
        array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"points: expected real numbers of shape (n, 2) or (n, 3); {error}.") from None
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        shape_hint = " Transpose the array." if array.ndim == 2 and array.shape[0] in (2, 3) else ""
        raise ValueError(f"points: expected shape (n, 2) or (n, 3), got {array.shape}.{shape_hint}")
    invalid_nodes = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if invalid_nodes.size:
        raise ValueError(
            f"points: {invalid_nodes.size} node(s) hold NaN or infinity, first node {invalid_nodes[0]}: "
            f"{array[invalid_nodes[0]].tolist()}. Drop these nodes and the cells that use them."
        )
    if not len(array):
        raise ValueError("points: the array is empty; a mesh needs at least one cell.")
    warn_large(float(np.ptp(array, axis=0).max()), "points", is_from_file=True)
    return array


def check_cells(cells: ArrayLike, num_points: int, dimension: int) -> np.ndarray:
    """Convert the node indices of cells to integers (m, k). With `dimension` coordinates per point, k is `dimension` +
    1, or 3 for a surface in space. Raises `ValueError` for invalid indices, duplicated cells and unused nodes."""
    array = np.asarray(cells)
    widths = (3,) if dimension == 2 else (4, 3)
    if array.ndim != 2 or array.shape[1] not in widths or not len(array):
        kind = "triangles of shape (m, 3)" if dimension == 2 else "tetrahedra of shape (m, 4), or triangles (m, 3),"
        raise ValueError(f"cells: points in {dimension}-D need {kind} with m > 0, got {array.shape}.")
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"cells: node indices must be integers, got {array.dtype}. Convert with .astype(int).")
    array = array.astype(np.int64)
    if num_points > MAX_POINTS:
        raise ValueError(f"points: {num_points} nodes are more than the {MAX_POINTS} that jeit can index.")
    lowest_index, highest_index = int(array.min()), int(array.max())
    if lowest_index < 0 or highest_index >= num_points:
        index_hint = " They look one-based: subtract 1." if lowest_index >= 1 and highest_index == num_points else ""
        raise ValueError(
            f"cells: node indices run from {lowest_index} to {highest_index}, but the mesh has nodes 0 to "
            f"{num_points - 1}.{index_hint}"
        )
    sorted_cells = np.sort(array, axis=1)
    repeated_cells = np.flatnonzero((sorted_cells[:, 1:] == sorted_cells[:, :-1]).any(axis=1))
    if repeated_cells.size:
        raise ValueError(
            f"cells: cell {repeated_cells[0]} uses a node twice: {array[repeated_cells[0]].tolist()}. Remove such "
            "cells."
        )
    sort_order = np.lexsort(sorted_cells.T[::-1])
    duplicate_positions = np.flatnonzero((sorted_cells[sort_order][1:] == sorted_cells[sort_order][:-1]).all(axis=1))
    if duplicate_positions.size:
        pair = np.sort(sort_order[duplicate_positions[0] : duplicate_positions[0] + 2]).tolist()
        raise ValueError(
            f"cells: {duplicate_positions.size} cell(s) are duplicated, first cells {pair[0]} and {pair[1]} with nodes "
            f"{sorted_cells[sort_order[duplicate_positions[0]]].tolist()}. Keep one of each."
        )
    unused_nodes = np.setdiff1d(np.arange(num_points), array)
    if unused_nodes.size:
        raise ValueError(
            f"points: {unused_nodes.size} node(s) belong to no cell, first node {unused_nodes[0]}. They would make the "
            "stiffness matrix singular: drop them and renumber the cells."
        )
    return array


def check_coinciding(points: np.ndarray) -> None:
    """Raise `ValueError` if two nodes coincide."""
    if len(points) < 2:
        return
    distance, neighbour = map(np.asarray, KDTree(points).query(points, k=2))
    close_nodes = np.flatnonzero(distance[:, 1] <= _COINCIDENT_DISTANCE * np.ptp(points, axis=0).max())
    if close_nodes.size:
        first_node = int(close_nodes[0])
        neighbour_index = int(
            neighbour[first_node, 1] if neighbour[first_node, 1] != first_node else neighbour[first_node, 0]
        )
        raise ValueError(
            f"points: {close_nodes.size} nodes coincide with another, first nodes {first_node} and {neighbour_index} "
            f"at {points[first_node].tolist()}. Merge them, or the mesh has an invisible crack there."
        )


def signed_measures(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Signed areas or volumes (m,) of the cells; for triangles in space, the areas are always positive."""
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    if cells.shape[1] == points.shape[1]:
        return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    return np.linalg.det(edges) / (2.0 if cells.shape[1] == 3 else 6.0)


def orient(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Reorder the nodes of cells so that every cell has positive area or volume. Raises `ValueError` for degenerate
    cells."""
    measure = signed_measures(points, cells)
    dimension = cells.shape[1] - 1
    corners = points[cells]
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    flat_cells = np.flatnonzero(np.abs(measure) <= _MIN_RELATIVE_MEASURE * size**dimension)
    if flat_cells.size:
        name = "area" if dimension == 2 else "volume"
        raise ValueError(
            f"cells: {flat_cells.size} cell(s) have no {name}, first cell {flat_cells[0]} with nodes "
            f"{cells[flat_cells[0]].tolist()}: its nodes lie on one line or plane. Remove it or move a node."
        )
    swapped_cells = cells.copy()
    swapped_cells[:, [-2, -1]] = cells[:, [-1, -2]]
    return np.where((measure > 0)[:, None], cells, swapped_cells)


def check_connected(first_cells: np.ndarray, second_cells: np.ndarray, num_cells: int) -> None:
    """Raise `ValueError` if the `num_cells` cells are not connected; `first_cells` and `second_cells`: indices of the
    two cells at each interior facet."""
    graph = coo_array((np.ones(len(first_cells)), (first_cells, second_cells)), shape=(num_cells, num_cells))
    num_parts, label = connected_components(graph, directed=False)
    if num_parts > 1:
        sizes = np.bincount(label)
        raise ValueError(
            f"cells: the mesh falls into {num_parts} separate parts of {np.sort(sizes)[::-1][:5].tolist()} cells. "
            "No current flows between them: keep one part, or merge the nodes along their common boundary."
        )


def locate_tags(tags: Mapping[str, ArrayLike], facets: np.ndarray) -> dict[str, np.ndarray]:
    """Convert the facets of each tag to indices (t,) into `facets`. Raises `ValueError` for a tag with a facet that is
    not in `facets`."""
    located_tags = {}
    for name, value in tags.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"tags: names must be non-empty strings, got {name!r}.")
        array = np.asarray(value)
        if array.size == 0:
            raise ValueError(f"tags: {name!r} is empty. Leave it out, or name at least one boundary facet.")
        if not np.issubdtype(array.dtype, np.integer):
            raise ValueError(f"tags: {name!r} must hold integers, got {array.dtype}.")
        if array.ndim == 2 and array.shape[1] == facets.shape[1]:
            array = _match_facets(name, array.astype(np.int64), facets)
        elif array.ndim != 1:
            raise ValueError(
                f"tags: {name!r} must be facet indices (t,) or facet nodes (t, {facets.shape[1]}), got {array.shape}."
            )
        if array.min() < 0 or array.max() >= len(facets):
            raise ValueError(
                f"tags: {name!r} holds facet indices from {array.min()} to {array.max()}, but the mesh has boundary "
                f"facets 0 to {len(facets) - 1}."
            )
        located_tags[name] = np.unique(array)
    return located_tags


def _match_facets(name: str, nodes: np.ndarray, facets: np.ndarray) -> np.ndarray:
    num_nodes = int(max(facets.max(), nodes.max())) + 1
    keys = topology.facet_keys(facets, num_nodes)
    sort_order = np.argsort(keys)
    tag_keys = topology.facet_keys(nodes, num_nodes)
    facet_positions = np.minimum(np.searchsorted(keys[sort_order], tag_keys), len(keys) - 1)
    missing_facets = np.flatnonzero((keys[sort_order][facet_positions] != tag_keys) | (nodes.min(axis=1) < 0))
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
    token = _IS_SIZE_CHECKED.set(True)
    try:
        yield
    finally:
        _IS_SIZE_CHECKED.reset(token)


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
