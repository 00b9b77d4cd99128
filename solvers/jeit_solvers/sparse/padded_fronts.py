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
        matrix_size = pattern.size
        rows, columns = np.asarray(pattern.rows, dtype=np.int64), np.asarray(pattern.columns, dtype=np.int64)
        self.size = matrix_size
        tree_depth = 0 if matrix_size <= _MAX_SINGLE_FRONT else int(np.ceil(np.log2(matrix_size / _LEAF_SIZE)))
        front_indices = nested_dissection(graph_of(rows, columns, matrix_size), tree_depth, coordinates)
        self._make_fronts(front_indices, tree_depth)
        sort_order = np.argsort(self.front, kind="stable")
        self.place = np.empty(matrix_size, dtype=np.int64)
        self.place[sort_order] = rank_within(self.front[sort_order])
        is_row_first = self.stage[self.front[rows]] <= self.stage[self.front[columns]]
        self.earlier_rows, self.later_rows = (
            np.where(is_row_first, rows, columns),
            np.where(is_row_first, columns, rows),
        )
        self._find_borders()
        self.pivot_count = np.bincount(self.front, minlength=self.parent.size)
        stage_numbers = range(self.num_stages)
        self.batch = np.bincount(self.stage, minlength=self.num_stages)
        self.pivots = [max(1, int(self.pivot_count[self.stage == k].max())) for k in stage_numbers]
        self.border = [int(rank_within(border_keys // matrix_size).max(initial=-1)) + 1 for border_keys in self.borders]

    def _make_fronts(self, front_indices: np.ndarray, tree_depth: int) -> None:
        """Form the fronts from the nodes of the dissection: small separators are eliminated together with the
        separators below them."""
        nodes = np.arange(2 ** (tree_depth + 1) - 1)
        level_of_node = np.floor(np.log2(nodes + 1)).astype(int)
        max_separators = np.zeros(tree_depth + 1, dtype=int)
        np.maximum.at(max_separators, level_of_node, np.bincount(front_indices, minlength=nodes.size))
        stage_heights = _merged_levels(max_separators)
        first_level = tree_depth + 1 - np.cumsum(stage_heights)
        stage_of_level = np.searchsorted(-first_level, -np.arange(tree_depth + 1), side="left")
        top_nodes = nodes.copy()
        for _ in range(max(stage_heights)):
            top_nodes = np.where(
                level_of_node[top_nodes] > first_level[stage_of_level[level_of_node[top_nodes]]],
                (top_nodes - 1) // 2,
                top_nodes,
            )
        front_nodes, front_of_node = np.unique(top_nodes, return_inverse=True)
        self.front = front_of_node[front_indices]
        self.parent = np.where(front_nodes > 0, front_of_node[(front_nodes - 1) // 2], -1)
        self.stage = stage_of_level[level_of_node[front_nodes]]
        self.num_stages = len(stage_heights)
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
        for stage_number in range(self.num_stages):
            is_border_of_stage = self.stage[pending_entries // self.size] == stage_number
            stage_border = pending_entries[is_border_of_stage]
            self.borders.append(stage_border)
            child_fronts, border_rows = np.divmod(stage_border, self.size)
            parent_front = self.parent[child_fronts]
            inherited_entries = (parent_front * self.size + border_rows)[self.front[border_rows] != parent_front]
            pending_entries = np.unique(np.concatenate([pending_entries[~is_border_of_stage], inherited_entries]))

    def position(self, fronts: np.ndarray, rows: np.ndarray, stage: int) -> np.ndarray:
        """Local indices of matrix rows within fronts of one stage, in which the pivots come first and then the
        border."""
        border_keys, stage_border = fronts * self.size + rows, self.borders[stage]
        border_positions = np.searchsorted(stage_border, border_keys) - np.searchsorted(
            stage_border, fronts * self.size
        )
        return np.where(self.front[rows] == fronts, self.place[rows], self.pivots[stage] + border_positions)


def _merged_levels(largest_separators: np.ndarray) -> list[int]:
    """Number of levels of the tree in each stage, from the leaves up. `largest_separators`: size of the largest
    separator of each level.

    Eliminating a separator together with the two separators below it saves a stage, but wastes operations on the zeros
    between the two lower separators. Levels are merged if these operations cost less than a stage.
    """

    def count_operations(num_fronts: int, num_pivots: int, border_size: int) -> float:
        return num_fronts * (4 / 3 * num_pivots**3 + 2 * num_pivots**2 * border_size + 2 * num_pivots * border_size**2)

    stage_heights, tree_level = [1], len(largest_separators) - 2
    while tree_level >= 0:
        stage_height, num_pivots = 1, int(largest_separators[tree_level])
        while tree_level > 0:
            # About half of the boundary of a front's region consists of separators of the next levels above, so its
            # border is a few times as long as these separators.
            num_fronts, next_separator = 2 ** (tree_level - 1), int(largest_separators[tree_level - 1])
            border_size = 3 * next_separator
            separate_operations = count_operations(2 * num_fronts, num_pivots, border_size) + count_operations(
                num_fronts, next_separator, border_size
            )
            if (
                count_operations(num_fronts, 2 * num_pivots + next_separator, border_size) - separate_operations
                > _OPERATIONS_PER_STAGE_LAUNCH
            ):
                break
            stage_height, num_pivots, tree_level = stage_height + 1, 2 * num_pivots + next_separator, tree_level - 1
        stage_heights.append(stage_height)
        tree_level -= 1
    return stage_heights


def rank_within(groups: np.ndarray) -> np.ndarray:
    """For every element of a sorted array of small integers: its position among the elements equal to it."""
    group_sizes = np.bincount(groups)
    return np.arange(groups.size) - np.repeat(np.cumsum(group_sizes) - group_sizes, group_sizes)


def graph_of(rows: np.ndarray, columns: np.ndarray, size: int) -> csr_array:
    """Graph of a sparsity pattern: its off-diagonal entries, in both triangles."""
    rows, columns = rows[size:], columns[size:]
    entry_coordinates = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    return csr_array((np.ones(2 * rows.size, dtype=np.int8), entry_coordinates), shape=(size, size))


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
    plan_key = _plan_key(pattern, tree)
    cached_indices, cached_layout = _CACHED_INDICES.get(plan_key), _CACHED_LAYOUTS.get(plan_key)
    if cached_indices is None or cached_layout is None:
        index_store = IndexStore()
        plan_stages = tuple(_build_stage(index_store, pattern, tree, k) for k in range(tree.num_stages))
        stage_offsets = np.cumsum([0, *(plan_stage.batch * plan_stage.pivots for plan_stage in plan_stages)])
        stage_of_row = tree.stage[tree.front]
        solution_positions = (
            stage_offsets[stage_of_row] + tree.slot[tree.front] * np.asarray(tree.pivots)[stage_of_row] + tree.place
        )
        cached_layout = IndexLayout(plan_stages, index_store.add(solution_positions))
        cached_indices = index_store.pack()
        _CACHED_INDICES[plan_key], _CACHED_LAYOUTS[plan_key] = cached_indices, cached_layout
    return FactorisationPlan(cached_indices, cached_layout, pattern.size, pattern.num_entries)


def _plan_key(pattern: SparsityPattern, tree: EliminationTree) -> bytes:
    """Key of the plan of an elimination tree in the cache of plans."""
    plan_digest = hashlib.blake2b(digest_size=16)
    for hashed_array in (pattern.rows, pattern.columns, tree.front, tree.place, tree.parent, tree.stage, tree.slot):
        plan_digest.update(np.asarray(hashed_array).tobytes())
    return plan_digest.digest()


# Index maps of existing plans. They are reused, because the plan of a solid takes seconds to compute and hundreds of
# megabytes to store.
_CACHED_INDICES: WeakValueDictionary[bytes, Array] = WeakValueDictionary()
_CACHED_LAYOUTS: WeakValueDictionary[bytes, IndexLayout] = WeakValueDictionary()


def _build_stage(store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int) -> Stage:
    num_fronts, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    front_height = pivots + border
    stage_rows = np.flatnonzero(tree.stage[tree.front] == stage)
    right_hand_side = np.full((num_fronts, pivots), tree.size)
    right_hand_side[tree.slot[tree.front[stage_rows]], tree.place[stage_rows]] = stage_rows

    # Positions of the border rows of this stage among the rows of their parents.
    child_fronts, child_rows = np.divmod(tree.borders[stage], tree.size)
    parent_front = tree.parent[child_fronts]
    parent_stage = int(tree.stage[parent_front[0]]) if child_fronts.size else -1
    border_rows = np.zeros((num_fronts, border), dtype=np.int64)
    if child_fronts.size:
        parent_height = tree.pivots[parent_stage] + tree.border[parent_stage]
        border_rows[:] = tree.batch[parent_stage] * parent_height
        parent_positions = tree.slot[parent_front] * parent_height + tree.position(
            parent_front, child_rows, parent_stage
        )
        border_rows[tree.slot[child_fronts], rank_within(child_fronts)] = parent_positions

    source_stages = np.unique(tree.stage[(tree.parent >= 0) & (tree.stage[tree.parent] == stage)])
    return Stage(
        num_fronts,
        pivots,
        border,
        _plan_matrix_entries(store, pattern, tree, stage, front_height),
        tuple(
            _plan_link(store, tree, int(source_stage), stage)
            for source_stage in source_stages
            if tree.border[source_stage]
        ),
        store.add(right_hand_side),
        parent_stage,
        store.add(border_rows),
    )


def _plan_matrix_entries(
    store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int, front_height: int
) -> PaddedSum:
    """Sums that add the entries of the matrix to the fronts that eliminate them, and ones to the diagonal of padded
    pivots."""
    num_fronts, pivots = int(tree.batch[stage]), tree.pivots[stage]
    stage_entries = np.flatnonzero(tree.stage[tree.front[tree.earlier_rows]] == stage)
    earlier_rows, later_rows = tree.earlier_rows[stage_entries], tree.later_rows[stage_entries]
    entry_fronts = tree.front[earlier_rows]
    entry_columns, entry_rows = tree.place[earlier_rows], tree.position(entry_fronts, later_rows, stage)
    # Pivot blocks of the fronts are filled on both sides of the diagonal.
    is_mirrored = (entry_rows < pivots) & (entry_rows != entry_columns)
    first_positions = tree.slot[entry_fronts] * front_height
    stage_fronts = np.argsort(np.where(tree.stage == stage, tree.slot, tree.parent.size), kind="stable")[:num_fronts]
    padded_fronts, padded_pivots = np.nonzero(np.arange(pivots) >= tree.pivot_count[stage_fronts][:, None])
    entry_targets = [
        (first_positions + entry_rows) * pivots + entry_columns,
        ((first_positions + entry_columns) * pivots + entry_rows)[is_mirrored],
    ]
    entry_targets.append((padded_fronts * front_height + padded_pivots) * pivots + padded_pivots)
    entry_sources = [stage_entries, stage_entries[is_mirrored], np.full(padded_fronts.size, pattern.num_entries)]
    return PaddedSum.create(
        store,
        np.concatenate(entry_targets),
        np.concatenate(entry_sources),
        num_fronts * front_height * pivots,
        pattern.num_entries + 1,
    )


def _plan_link(store: IndexStore, tree: EliminationTree, source_stage: int, stage: int) -> StageLink:
    num_fronts, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    front_height, num_children, child_border = pivots + border, int(tree.batch[source_stage]), tree.border[source_stage]
    child_fronts, border_rows = np.divmod(tree.borders[source_stage], tree.size)
    border_indices, parent_fronts = rank_within(child_fronts), tree.parent[child_fronts]
    # Local row in the parent front of each border row of each child; -1 marks padding.
    parent_rows = np.full((num_children, child_border), -1)
    parent_rows[tree.slot[child_fronts], border_indices] = tree.position(parent_fronts, border_rows, stage)
    parent_slot = np.zeros(num_children, dtype=np.int64)
    parent_slot[tree.slot[child_fronts]] = tree.slot[parent_fronts]
    flat_indices = np.arange(num_children * child_border * child_border).reshape(
        num_children, child_border, child_border
    )
    first_rows, second_rows, front_slots = np.broadcast_arrays(
        parent_rows[:, :, None], parent_rows[:, None, :], parent_slot[:, None, None]
    )
    is_valid = (first_rows >= 0) & (second_rows >= 0)
    is_in_panel, is_in_corner = (
        is_valid & (second_rows < pivots),
        is_valid & (first_rows >= pivots) & (second_rows >= pivots),
    )
    panel_target_indices = ((front_slots * front_height + first_rows) * pivots + second_rows)[is_in_panel]
    corner_targets = ((front_slots * border + first_rows - pivots) * border + second_rows - pivots)[is_in_corner]
    row_targets = parent_slot[:, None] * front_height + parent_rows
    is_used = parent_rows >= 0
    return StageLink(
        source_stage,
        PaddedSum.create(
            store,
            panel_target_indices,
            flat_indices[is_in_panel],
            num_fronts * front_height * pivots,
            flat_indices.size,
        ),
        PaddedSum.create(
            store, corner_targets, flat_indices[is_in_corner], num_fronts * border * border, flat_indices.size
        ),
        PaddedSum.create(
            store, row_targets[is_used], np.flatnonzero(is_used), num_fronts * front_height, num_children * child_border
        ),
    )
