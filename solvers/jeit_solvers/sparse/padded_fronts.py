"""Plan of a sparse factorisation with padded fronts: elimination tree, fronts and stages. `padded_fronts_jax.py`
carries out the plan.

A *front* is a small dense matrix: its *pivots* are rows that are eliminated together, and its *border* consists of the
later rows that their elimination changes (multifrontal method; Duff and Reid, ACM Trans. Math. Softw. 9, 1983). Fronts
at the same height of the elimination tree form a *stage*: they are padded to one shape and processed by JAX as one
batch.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int
from scipy.sparse import csr_array

from jeit_solvers.module import Module
from jeit_solvers.sparse.dissection import nested_dissection
from jeit_solvers.sparse.index_store import IndexLayout, IndexSlot, IndexStore, PaddedSum
from jeit_solvers.sparse.pattern import SparsityPattern

# Size of the fronts at the leaves of the elimination tree: large enough for efficient matrix products, and small enough
# to be treated as dense.
_LEAF_SIZE = 24
# Maximum size of a matrix that is a single front: programs of two stages take 1.5 times as long to compile. They run as
# fast for one matrix, and faster only for batches.
_MAX_SINGLE_FRONT = 64
# Number of floating-point operations that take as long as the overhead of launching a stage.
_OPERATIONS_PER_STAGE_LAUNCH = 1e6


class EliminationTree:
    """Elimination tree: fronts of a sparsity pattern, numbered from 0, and their borders.

    - `front`, `place`: (n,) front of each matrix row, and index of the row among the pivots of the front.
    - `parent`, `stage`, `slot`: (fronts,) parent of each front (-1 at the root), stage of each front, and position of
      the front in the stage.
    - `early`, `late`: (nnz,) the two rows of each matrix entry: the row that is eliminated earlier, and the row that is
      eliminated later.
    - `borders`: for each stage the sorted keys front * n + row of the border rows of its fronts; `batch`, `pivots`,
      `border`: number of fronts of each stage, and padded numbers of pivots and border rows.
    """

    def __init__(self, pattern: SparsityPattern, coordinates: np.ndarray | None):
        """Dissect the graph of the pattern, and find the rows that elimination in the resulting order changes."""
        size = pattern.size
        rows, columns = np.asarray(pattern.rows, dtype=np.int64), np.asarray(pattern.columns, dtype=np.int64)
        self.size = size
        depth = 0 if size <= _MAX_SINGLE_FRONT else int(np.ceil(np.log2(size / _LEAF_SIZE)))
        front_indices = nested_dissection(graph_of(rows, columns, size), depth, coordinates)
        self._make_fronts(front_indices, depth)
        sort_order = np.argsort(self.front, kind="stable")
        self.place = np.empty(size, dtype=np.int64)
        self.place[sort_order] = rank_within(self.front[sort_order])
        is_row_first = self.stage[self.front[rows]] <= self.stage[self.front[columns]]
        self.earlier_rows, self.later_rows = (
            np.where(is_row_first, rows, columns),
            np.where(is_row_first, columns, rows),
        )
        self._find_borders()
        self.pivot_count = np.bincount(self.front, minlength=self.parent.size)
        stages = range(self.num_stages)
        self.batch = np.bincount(self.stage, minlength=self.num_stages)
        self.pivots = [max(1, int(self.pivot_count[self.stage == stage].max())) for stage in stages]
        self.border = [int(rank_within(keys // size).max(initial=-1)) + 1 for keys in self.borders]

    def _make_fronts(self, front_indices: np.ndarray, depth: int) -> None:
        """Form the fronts from the nodes of the dissection: small separators are eliminated together with the
        separators below them."""
        nodes = np.arange(2 ** (depth + 1) - 1)
        level = np.floor(np.log2(nodes + 1)).astype(int)
        max_separators = np.zeros(depth + 1, dtype=int)
        np.maximum.at(max_separators, level, np.bincount(front_indices, minlength=nodes.size))
        heights = _merged_levels(max_separators)
        first_level = depth + 1 - np.cumsum(heights)
        stage_of_level = np.searchsorted(-first_level, -np.arange(depth + 1), side="left")
        top_nodes = nodes.copy()
        for _ in range(max(heights)):
            top_nodes = np.where(
                level[top_nodes] > first_level[stage_of_level[level[top_nodes]]], (top_nodes - 1) // 2, top_nodes
            )
        front_nodes, front_of_node = np.unique(top_nodes, return_inverse=True)
        self.front = front_of_node[front_indices]
        self.parent = np.where(front_nodes > 0, front_of_node[(front_nodes - 1) // 2], -1)
        self.stage = stage_of_level[level[front_nodes]]
        self.num_stages = len(heights)
        stage_order = np.argsort(self.stage, kind="stable")
        self.slot = np.empty(front_nodes.size, dtype=np.int64)
        self.slot[stage_order] = rank_within(self.stage[stage_order])

    def _find_borders(self) -> None:
        """Find the border of each front: the later rows of the front's entries, and the borders of its children without
        its own pivots."""
        first_fronts, second_fronts = self.front[self.earlier_rows], self.front[self.later_rows]
        pending_entries = np.unique(
            first_fronts[first_fronts != second_fronts] * self.size + self.later_rows[first_fronts != second_fronts]
        )
        self.borders = []
        for stage in range(self.num_stages):
            is_border_of_stage = self.stage[pending_entries // self.size] == stage
            border = pending_entries[is_border_of_stage]
            self.borders.append(border)
            child, row = np.divmod(border, self.size)
            parent_front = self.parent[child]
            inherited_entries = (parent_front * self.size + row)[self.front[row] != parent_front]
            pending_entries = np.unique(np.concatenate([pending_entries[~is_border_of_stage], inherited_entries]))

    def position(self, fronts: np.ndarray, rows: np.ndarray, stage: int) -> np.ndarray:
        """Local indices of matrix rows within fronts of one stage, in which the pivots come first and then the
        border."""
        keys, border = fronts * self.size + rows, self.borders[stage]
        border_positions = np.searchsorted(border, keys) - np.searchsorted(border, fronts * self.size)
        return np.where(self.front[rows] == fronts, self.place[rows], self.pivots[stage] + border_positions)


def _merged_levels(largest_separators: np.ndarray) -> list[int]:
    """Number of levels of the tree in each stage, from the leaves up. `largest_separators`: size of the largest
    separator of each level.

    Eliminating a separator together with the two separators below it saves a stage, but wastes operations on the zeros
    between the two lower separators. Levels are merged if these operations cost less than a stage.
    """

    def operations(batch: int, pivots: int, border: int) -> float:
        return batch * (4 / 3 * pivots**3 + 2 * pivots**2 * border + 2 * pivots * border**2)

    heights, level = [1], len(largest_separators) - 2
    while level >= 0:
        height, pivots = 1, int(largest_separators[level])
        while level > 0:
            # About half of the boundary of a front's region consists of separators of the next levels above, so its
            # border is a few times as long as these separators.
            batch, next_separator = 2 ** (level - 1), int(largest_separators[level - 1])
            border = 3 * next_separator
            separate_operations = operations(2 * batch, pivots, border) + operations(batch, next_separator, border)
            if (
                operations(batch, 2 * pivots + next_separator, border) - separate_operations
                > _OPERATIONS_PER_STAGE_LAUNCH
            ):
                break
            height, pivots, level = height + 1, 2 * pivots + next_separator, level - 1
        heights.append(height)
        level -= 1
    return heights


def rank_within(groups: np.ndarray) -> np.ndarray:
    """For every element of a sorted array of small integers: its position among the elements equal to it."""
    counts = np.bincount(groups)
    return np.arange(groups.size) - np.repeat(np.cumsum(counts) - counts, counts)


def graph_of(rows: np.ndarray, columns: np.ndarray, size: int) -> csr_array:
    """Graph of a sparsity pattern: its off-diagonal entries, in both triangles."""
    rows, columns = rows[size:], columns[size:]
    coordinates = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    return csr_array((np.ones(2 * rows.size, dtype=np.int8), coordinates), shape=(size, size))


class StageLink(NamedTuple):
    """Transfer of contributions from the fronts of an earlier stage, `source`, to the fronts of a later stage.
    **Fields**: `panel`, `corner`: sums of the entries of the flattened Schur complements of `source`; `rows`: sums of
    the flattened right-hand-side updates of `source`."""

    source: int
    panel: PaddedSum
    corner: PaddedSum
    rows: PaddedSum


class Stage(NamedTuple):
    """A stage of a factorisation: a batch of fronts padded to one shape. In each front `pivots` rows are eliminated and
    `border` rows are updated.

    `entries` adds the entries of the matrix, to which a one for padded pivots is appended, to the pivot columns of the
    fronts (batch, pivots + border, pivots). `right_hand_side` (batch, pivots) contains indices of matrix rows, and
    `above` (batch, border) indices of rows in the fronts of the stage `parent`; indices out of range mark padding.
    """

    batch: int
    pivots: int
    border: int
    entries: PaddedSum
    links: tuple[StageLink, ...]
    right_hand_side: IndexSlot
    parent: int
    above: IndexSlot


class FactorisationPlan(Module):
    """Order of elimination and index maps of a sparsity pattern for `factorise` and `solve`; computed by `analyse`.

    **Fields**: `indices` (total,): all index maps; `layout`: position of each index map in `indices`; `size`: number of
    rows n; `num_entries`: number of entries of the pattern. The index maps are one leaf of the plan's pytree; pass a
    plan to a jitted function as an argument.

    **Example:**

    ```python
    plan = analyse(pattern, coordinates)
    plan.num_factor_entries, plan.num_operations
    ```
    """

    indices: Int[Array, " total"]
    layout: IndexLayout = eqx.field(static=True)
    size: int = eqx.field(static=True)
    num_entries: int = eqx.field(static=True)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Batches of fronts, in the order of elimination."""
        return self.layout.content[0]

    @property
    def solution(self) -> IndexSlot:
        """Index of each matrix row among the pivots of all stages, concatenated in the order of the stages."""
        return self.layout.content[1]

    @property
    def num_pivots(self) -> int:
        """Number of rows that `half_solve` returns, including padding."""
        return sum(stage.batch * stage.pivots for stage in self.stages)

    @property
    def num_factor_entries(self) -> int:
        """Number of entries of the factor, including padding."""
        return sum(stage.batch * (stage.pivots + stage.border) * stage.pivots for stage in self.stages)

    @property
    def num_operations(self) -> int:
        """Number of floating-point operations of a factorisation, including padding."""
        return sum(
            stage.batch * (4 * s**3 // 3 + 2 * s * s * stage.border + 2 * s * stage.border**2)
            for stage in self.stages
            for s in [stage.pivots]
        )


def analyse(pattern: SparsityPattern, coordinates: Any = None) -> FactorisationPlan:
    """Find the order of elimination and the index maps of the direct solver for a sparsity pattern. The analysis runs
    in NumPy and SciPy, outside `jax.jit`, once per pattern.

    **Arguments:**

    - `pattern`: sparsity pattern of n unknowns.
    - `coordinates` (n, d): coordinates of the unknowns, which give a better order than the pattern alone.

    Raises `ValueError` if the coordinates have a wrong shape or are not finite.

    **Example:**

    ```python
    plan = analyse(pattern, coordinates)
    ```
    """
    return _plan_of_tree(pattern, EliminationTree(pattern, checked_coordinates(pattern, coordinates)))


def checked_coordinates(pattern: SparsityPattern, coordinates: Any) -> np.ndarray | None:
    """Coordinates (n, d) of the unknowns as an array, or None. Raises `ValueError` if the coordinates have a wrong
    shape or are not finite."""
    if coordinates is None:
        return None
    coordinates = np.asarray(coordinates, dtype=float)
    if coordinates.ndim != 2 or coordinates.shape[0] != pattern.size or coordinates.shape[1] < 1:
        raise ValueError(
            f"analyse: `coordinates` must have shape (n, d) with n = {pattern.size} unknowns; got {coordinates.shape}."
        )
    if not np.isfinite(coordinates).all():
        raise ValueError("analyse: `coordinates` hold NaN or infinity.")
    return coordinates


def _plan_of_tree(pattern: SparsityPattern, tree: EliminationTree) -> FactorisationPlan:
    """Compute the factorisation plan with all index maps for an elimination tree. If a plan of the same tree exists,
    for example in a forward model on the same mesh, its index maps are reused."""
    key = _plan_key(pattern, tree)
    indices, layout = _CACHED_INDICES.get(key), _CACHED_LAYOUTS.get(key)
    if indices is None or layout is None:
        store = IndexStore()
        stages = tuple(_build_stage(store, pattern, tree, stage) for stage in range(tree.num_stages))
        offsets = np.cumsum([0, *(stage.batch * stage.pivots for stage in stages)])
        stage_of_row = tree.stage[tree.front]
        solution = offsets[stage_of_row] + tree.slot[tree.front] * np.asarray(tree.pivots)[stage_of_row] + tree.place
        layout = IndexLayout(stages, store.add(solution))
        indices = store.pack()
        _CACHED_INDICES[key], _CACHED_LAYOUTS[key] = indices, layout
    return FactorisationPlan(indices, layout, pattern.size, pattern.num_entries)


def _plan_key(pattern: SparsityPattern, tree: EliminationTree) -> bytes:
    """Key of the plan of an elimination tree in the cache of plans."""
    digest = hashlib.blake2b(digest_size=16)
    for array in (pattern.rows, pattern.columns, tree.front, tree.place, tree.parent, tree.stage, tree.slot):
        digest.update(np.asarray(array).tobytes())
    return digest.digest()


# Index maps of existing plans. They are reused, because the plan of a solid takes seconds to compute and hundreds of
# megabytes to store.
_CACHED_INDICES: WeakValueDictionary[bytes, Array] = WeakValueDictionary()
_CACHED_LAYOUTS: WeakValueDictionary[bytes, IndexLayout] = WeakValueDictionary()


def _build_stage(store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int) -> Stage:
    batch, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    height = pivots + border
    rows = np.flatnonzero(tree.stage[tree.front] == stage)
    right_hand_side = np.full((batch, pivots), tree.size)
    right_hand_side[tree.slot[tree.front[rows]], tree.place[rows]] = rows

    # Positions of the border rows of this stage among the rows of their parents.
    child, row = np.divmod(tree.borders[stage], tree.size)
    parent_front = tree.parent[child]
    parent = int(tree.stage[parent_front[0]]) if child.size else -1
    border_rows = np.zeros((batch, border), dtype=np.int64)
    if child.size:
        parent_height = tree.pivots[parent] + tree.border[parent]
        border_rows[:] = tree.batch[parent] * parent_height
        position = tree.slot[parent_front] * parent_height + tree.position(parent_front, row, parent)
        border_rows[tree.slot[child], rank_within(child)] = position

    sources = np.unique(tree.stage[(tree.parent >= 0) & (tree.stage[tree.parent] == stage)])
    return Stage(
        batch,
        pivots,
        border,
        _plan_matrix_entries(store, pattern, tree, stage, height),
        tuple(_plan_link(store, tree, int(source), stage) for source in sources if tree.border[source]),
        store.add(right_hand_side),
        parent,
        store.add(border_rows),
    )


def _plan_matrix_entries(
    store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int, height: int
) -> PaddedSum:
    """Sums that add the entries of the matrix to the fronts that eliminate them, and ones to the diagonal of padded
    pivots."""
    batch, pivots = int(tree.batch[stage]), tree.pivots[stage]
    entries = np.flatnonzero(tree.stage[tree.front[tree.earlier_rows]] == stage)
    earlier_rows, later_rows = tree.earlier_rows[entries], tree.later_rows[entries]
    front = tree.front[earlier_rows]
    column, row = tree.place[earlier_rows], tree.position(front, later_rows, stage)
    # Pivot blocks of the fronts are filled on both sides of the diagonal.
    is_mirrored = (row < pivots) & (row != column)
    first_positions = tree.slot[front] * height
    members = np.argsort(np.where(tree.stage == stage, tree.slot, tree.parent.size), kind="stable")[:batch]
    padded_fronts, padded_pivots = np.nonzero(np.arange(pivots) >= tree.pivot_count[members][:, None])
    target = [(first_positions + row) * pivots + column, ((first_positions + column) * pivots + row)[is_mirrored]]
    target.append((padded_fronts * height + padded_pivots) * pivots + padded_pivots)
    source = [entries, entries[is_mirrored], np.full(padded_fronts.size, pattern.num_entries)]
    return PaddedSum.create(
        store, np.concatenate(target), np.concatenate(source), batch * height * pivots, pattern.num_entries + 1
    )


def _plan_link(store: IndexStore, tree: EliminationTree, source: int, stage: int) -> StageLink:
    batch, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    height, count, width = pivots + border, int(tree.batch[source]), tree.border[source]
    child, row = np.divmod(tree.borders[source], tree.size)
    border_indices, front = rank_within(child), tree.parent[child]
    # Local row in the parent front of each border row of each child; -1 marks padding.
    parent_rows = np.full((count, width), -1)
    parent_rows[tree.slot[child], border_indices] = tree.position(front, row, stage)
    parent_slot = np.zeros(count, dtype=np.int64)
    parent_slot[tree.slot[child]] = tree.slot[front]
    flat_indices = np.arange(count * width * width).reshape(count, width, width)
    first, second, base = np.broadcast_arrays(
        parent_rows[:, :, None], parent_rows[:, None, :], parent_slot[:, None, None]
    )
    is_valid = (first >= 0) & (second >= 0)
    panel, corner = is_valid & (second < pivots), is_valid & (first >= pivots) & (second >= pivots)
    panel_target_indices = ((base * height + first) * pivots + second)[panel]
    corner_targets = ((base * border + first - pivots) * border + second - pivots)[corner]
    row_targets = parent_slot[:, None] * height + parent_rows
    is_used = parent_rows >= 0
    return StageLink(
        source,
        PaddedSum.create(store, panel_target_indices, flat_indices[panel], batch * height * pivots, flat_indices.size),
        PaddedSum.create(store, corner_targets, flat_indices[corner], batch * border * border, flat_indices.size),
        PaddedSum.create(store, row_targets[is_used], np.flatnonzero(is_used), batch * height, count * width),
    )
