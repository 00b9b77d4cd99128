"""Order of elimination with exact (not padded) fronts. NumPy factorises matrices in this order
(`exact_fronts_numpy.py`).

A *front* is a small dense matrix: its *pivots* are rows that are eliminated together, and its *border* consists of the
later rows that their elimination changes (multifrontal method; Duff and Reid, ACM Trans. Math. Softw. 9, 1983). Rows
are numbered in the order of elimination; the pivots of a front are consecutive. The order starts with independent
subtrees of the elimination tree, one after the other, followed by the fronts above them, level by level.
"""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Int

from jeit_solvers.sparse.dissection import nested_dissection
from jeit_solvers.sparse.padded_fronts import checked_coordinates, graph_of
from jeit_solvers.sparse.pattern import SparsityPattern

# Size of the fronts at the leaves of the elimination tree: small enough to be treated as dense, and large enough for
# the time in BLAS to exceed that of calling BLAS.
_LEAF_SIZE = 128
# Number of levels of the elimination tree above the subtrees that are eliminated in parallel.
_LEVELS_ABOVE_SUBTREES = 3
# Number of bits to which coordinates are rounded before rows are ordered along a space-filling curve.
_COORDINATE_BITS = 10


class Front(NamedTuple):
    """Dense matrix of one elimination step. **Fields**: `pivots`: number p of its pivots; `border`: number b of its
    border rows; `first`: number of the first pivot; `rows`: (b,) numbers of the border rows, ascending; `entries`:
    range of the matrix entries in the rows of its pivots; `panel_indices`: indices of these entries in the flattened
    panel (p, p + b), which holds the rows of the pivots; `children`: numbers of the fronts that have this front as
    their parent; `rows_in_parent`: (b,) indices of the border rows among the rows of the parent, in which the pivots
    come first; `num_parent_pivots`: number of border rows that are pivots of the parent; `num_subtree_rows`: number of
    border rows that are eliminated within the front's independent subtree."""

    pivots: int
    border: int
    first: int
    rows: Int[np.ndarray, " b"]
    entries: slice
    panel_indices: Int[np.ndarray, " e"]
    children: tuple[int, ...]
    rows_in_parent: Int[np.ndarray, " b"]
    num_parent_pivots: int
    num_subtree_rows: int


@dataclass(frozen=True, eq=False)
class Fronts:
    """Fronts of a sparsity pattern, in the order of their elimination. Two objects are equal if their patterns and
    orders are equal.

    **Fields**: `size`, `num_entries`: rows and entries of the pattern; `order`: (n,) matrix rows in the order of
    elimination; `entry_order`: (nnz,) indices of the matrix entries in the order of the fronts to which they belong;
    `fronts`: all fronts; `steps`: for each step of the elimination the slices of fronts that can be eliminated in
    parallel: first the subtrees, then the fronts of each level above the subtrees; `top`: number of the first row that
    a front above the subtrees eliminates; `key`: digest of the pattern and the order, by which objects are compared.

    **Example:**

    ```python
    fronts = find_fronts(pattern, coordinates)
    fronts.num_operations, fronts.order
    ```
    """

    size: int
    num_entries: int
    order: Int[np.ndarray, " n"]
    entry_order: Int[np.ndarray, " nnz"]
    fronts: tuple[Front, ...]
    steps: tuple[tuple[slice, ...], ...]
    top: int
    key: bytes

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fronts) and self.key == other.key

    def __repr__(self) -> str:
        return f"Fronts({self.size} rows, {len(self.fronts)} fronts, {self.num_operations:.1e} operations)"

    @property
    def num_operations(self) -> float:
        """Number of floating-point operations of a factorisation."""
        return float(sum(_num_front_operations(front.pivots, front.border) for front in self.fronts))

    @property
    def num_factor_entries(self) -> int:
        """Number of stored entries of the factor."""
        return sum(front.pivots * (front.pivots + front.border) for front in self.fronts)

    @property
    def num_waiting_entries(self) -> int:
        """Maximum number of entries of Schur complements that are stored until their parents are eliminated, if fronts
        are eliminated one after the other."""
        num_waiting = max_waiting = 0
        for front in self.fronts:
            max_waiting = max(max_waiting, num_waiting + front.border**2)
            num_waiting += front.border**2 - sum(self.fronts[child].border ** 2 for child in front.children)
        return max_waiting


def _num_front_operations(pivots: Any, border: Any) -> Any:
    return pivots**3 / 3 + pivots**2 * border + 1.0 * pivots * border**2


def find_fronts(pattern: SparsityPattern, coordinates: Any = None) -> Fronts:
    """Find the order of elimination of a sparsity pattern and its fronts, in NumPy and SciPy, once per pattern.

    **Arguments:**

    - `pattern`, `coordinates`: as for `analyse`.

    Raises `ValueError` if the coordinates have a wrong shape or are not finite.

    **Example:**

    ```python
    fronts = find_fronts(pattern, coordinates)
    ```
    """
    coordinates = checked_coordinates(pattern, coordinates)
    rows, columns = (np.asarray(indices, dtype=np.int64) for indices in (pattern.rows, pattern.columns))
    pattern_digest = hashlib.blake2b(digest_size=16)
    for hashed_array in (rows, columns, coordinates if coordinates is not None else np.zeros(0), np.array(_LEAF_SIZE)):
        pattern_digest.update(np.ascontiguousarray(hashed_array).tobytes())
    cache_key = pattern_digest.digest()
    if (fronts := _CACHED_FRONTS.get(cache_key)) is None:
        _CACHED_FRONTS[cache_key] = fronts = _build_fronts(pattern.size, rows, columns, coordinates, cache_key)
    return fronts


# Existing fronts, reused by further models on the same mesh.
_CACHED_FRONTS: WeakValueDictionary[bytes, Fronts] = WeakValueDictionary()


def _build_fronts(
    matrix_size: int, rows: np.ndarray, columns: np.ndarray, coordinates: np.ndarray | None, cache_key: bytes
) -> Fronts:
    tree_depth = max(0, int(np.ceil(np.log2(matrix_size / _LEAF_SIZE))))
    front_indices = nested_dissection(graph_of(rows, columns, matrix_size), tree_depth, coordinates)
    nodes, front_indices = np.unique(front_indices, return_inverse=True)
    level_of_node = np.floor(np.log2(nodes + 1)).astype(int)
    num_top_levels = min(_LEVELS_ABOVE_SUBTREES, tree_depth)
    # Steps: the subtrees are number 0, the levels above them 1, 2, …
    step_of_node = np.maximum(num_top_levels - level_of_node, 0)
    subtree_of_node = np.where(step_of_node, 0, (nodes + 1) >> np.maximum(level_of_node - num_top_levels, 0))
    old_numbers = np.lexsort((_post_order_positions(nodes, level_of_node, tree_depth), subtree_of_node, step_of_node))
    new_numbers = np.argsort(old_numbers)
    elimination_tree = _EliminationTree(
        matrix_size, rows, columns, new_numbers[front_indices], level_of_node[old_numbers], coordinates
    )
    part_of_front = np.where(step_of_node, nodes, subtree_of_node)[old_numbers]
    part_starts = np.flatnonzero(np.diff(part_of_front, prepend=-1))
    front_slices = [
        slice(slice_start, slice_end)
        for slice_start, slice_end in itertools.pairwise([*part_starts.tolist(), len(nodes)])
    ]
    step_of_front = step_of_node[old_numbers][part_starts]
    step_slices = tuple(
        tuple(itertools.compress(front_slices, step_of_front == step_number))
        for step_number in range(num_top_levels + 1)
    )
    first_top_row = int(elimination_tree.pivots[: np.count_nonzero(step_of_node == 0)].sum())
    return Fronts(
        matrix_size,
        len(rows),
        elimination_tree.elimination_order,
        elimination_tree.entry_order,
        elimination_tree.fronts(first_top_row),
        step_slices,
        first_top_row,
        cache_key,
    )


def _post_order_positions(nodes: np.ndarray, node_levels: np.ndarray, tree_depth: int) -> np.ndarray:
    """Positions of nodes of a complete binary tree in post-order: every node comes after all nodes below it."""
    post_order_position = np.full(len(nodes), 2 ** (tree_depth + 1) - 2)
    for levels_above in range(tree_depth):
        # The ancestor of a node just below level `levels_above`: a left ancestor comes before the whole subtree of its
        # right sibling.
        subtree_height = node_levels - levels_above - 1
        is_left_child = (subtree_height >= 0) & ((((nodes + 1) >> np.maximum(subtree_height, 0)) & 1) == 0)
        post_order_position -= np.where(
            subtree_height >= 0, 1 + np.where(is_left_child, 2 ** (tree_depth - levels_above) - 1, 0), 0
        )
    return post_order_position


class _EliminationTree:
    """Elimination tree of fronts that are numbered in the order of elimination. For each front the tree stores the
    number of `pivots`, the number of `border` rows, the index in `parent_fronts` and the level in `front_levels` (0 at
    the root). `elimination_order`, `entry_order`: `order` and `entry_order` as in `Fronts`."""

    def __init__(self, size: int, rows, columns, front_of_row, level, coordinates):
        self.matrix_size, self.front_levels = size, level
        sorting_keys = (front_of_row,) if coordinates is None else (_morton_positions(coordinates), front_of_row)
        self.elimination_order = np.lexsort(sorting_keys)
        row_numbers = np.empty(size, dtype=np.int64)
        row_numbers[self.elimination_order] = np.arange(size)
        self.front_of_row = front_of_row[self.elimination_order]
        num_fronts = len(level)
        self.pivots = np.bincount(self.front_of_row, minlength=num_fronts)
        self.first_pivots = np.cumsum(self.pivots) - self.pivots
        first_pivots, second_pivots = row_numbers[rows], row_numbers[columns]
        self.earlier_rows, self.later_rows = (
            np.minimum(first_pivots, second_pivots),
            np.maximum(first_pivots, second_pivots),
        )
        self._find_borders(num_fronts)
        self.border = np.bincount(self.fronts_of_border, minlength=num_fronts)
        self.border_starts = np.cumsum(self.border) - self.border
        self.rows_in_parent = self._local_indices(self.parent_fronts[self.fronts_of_border], self.border_rows)
        front_of_entry = self.front_of_row[self.earlier_rows]
        self.entry_order = np.argsort(front_of_entry, kind="stable")

    def _find_borders(self, num_fronts: int) -> None:
        """Find the border rows of each front and its parent. The border rows are the later rows of the front's entries,
        and the border rows of its children that are not its pivots. The parent is the front that eliminates the first
        border row."""
        matrix_size, front_of_row = self.matrix_size, self.front_of_row
        first_fronts, second_fronts = front_of_row[self.earlier_rows], front_of_row[self.later_rows]
        pending_entries = np.unique((first_fronts * matrix_size + self.later_rows)[first_fronts != second_fronts])
        self.parent_fronts, level_borders = np.full(num_fronts, -1), [np.zeros(0, dtype=np.int64)]
        for tree_level in range(int(self.front_levels.max()), -1, -1):
            is_in_level = self.front_levels[pending_entries // matrix_size] == tree_level
            border_entries, pending_entries = pending_entries[is_in_level], pending_entries[~is_in_level]
            child_fronts, border_rows = np.divmod(border_entries, matrix_size)
            level_borders.append(border_entries)
            border_starts = np.flatnonzero(np.diff(child_fronts, prepend=-1))
            self.parent_fronts[child_fronts[border_starts]] = front_of_row[border_rows[border_starts]]
            parent_front = self.parent_fronts[child_fronts]
            pending_entries = np.unique(
                np.concatenate(
                    [
                        pending_entries,
                        (parent_front * matrix_size + border_rows)[front_of_row[border_rows] != parent_front],
                    ]
                )
            )
        self.border_keys = np.sort(np.concatenate(level_borders))
        self.fronts_of_border, self.border_rows = np.divmod(self.border_keys, matrix_size)

    def _local_indices(self, fronts: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Index of each matrix row within the given front, in which the pivots come first and then the border."""
        border_positions = (
            np.searchsorted(self.border_keys, fronts * self.matrix_size + rows) - self.border_starts[fronts]
        )
        is_pivot = self.front_of_row[rows] == fronts
        return np.where(is_pivot, rows - self.first_pivots[fronts], self.pivots[fronts] + border_positions)

    def fronts(self, first_top_row: int) -> tuple[Front, ...]:
        """All fronts of the tree; `first_top_row`: number of the first row that a front above the subtrees
        eliminates."""
        front_of_entry = self.front_of_row[self.earlier_rows]
        front_heights = self.pivots + self.border
        panel_indices = (self.earlier_rows - self.first_pivots[front_of_entry]) * front_heights[
            front_of_entry
        ] + self._local_indices(front_of_entry, self.later_rows)
        panel_indices = panel_indices[self.entry_order]
        entry_offsets = np.searchsorted(front_of_entry[self.entry_order], np.arange(len(front_heights) + 1)).tolist()
        is_parent_pivot = self.rows_in_parent < self.pivots[self.parent_fronts[self.fronts_of_border]]
        num_parent_pivots = np.bincount(self.fronts_of_border[is_parent_pivot], minlength=len(front_heights)).tolist()
        num_subtree_rows = np.bincount(
            self.fronts_of_border[self.border_rows < first_top_row], minlength=len(front_heights)
        ).tolist()
        child_lists: list[list[int]] = [[] for _ in front_heights]
        for child_front, parent_front in enumerate(self.parent_fronts.tolist()):
            if parent_front >= 0:
                child_lists[parent_front].append(child_front)
        border_starts, border_counts = self.border_starts.tolist(), self.border.tolist()
        fronts = []
        for k, (pivots, first_pivot) in enumerate(zip(self.pivots.tolist(), self.first_pivots.tolist(), strict=True)):
            rows = slice(border_starts[k], border_starts[k] + border_counts[k])
            entry_slice = slice(entry_offsets[k], entry_offsets[k + 1])
            front = Front(
                pivots, border_counts[k], first_pivot, self.border_rows[rows], entry_slice, panel_indices[entry_slice],
                tuple(child_lists[k]), self.rows_in_parent[rows], num_parent_pivots[k], num_subtree_rows[k]
            )  # fmt: skip
            fronts.append(front)
        return tuple(fronts)


def _morton_positions(coordinates: np.ndarray) -> np.ndarray:
    """Positions of points along a space-filling curve (Morton order). Rows that are near each other in space are then
    near each other in a front, so that the rows of a child are nearly consecutive rows of its parent."""
    bounding_size = max(np.ptp(coordinates, axis=0).max(), np.finfo(float).tiny)
    cells = ((coordinates - coordinates.min(axis=0)) / bounding_size * (2**_COORDINATE_BITS - 1)).astype(np.int64)
    morton_positions = np.zeros(len(cells), dtype=np.int64)
    for bit_number in range(_COORDINATE_BITS - 1, -1, -1):
        for cell_coordinate in cells.T:
            morton_positions = 2 * morton_positions + ((cell_coordinate >> bit_number) & 1)
    return morton_positions
