"""The order of elimination as a tree of fronts, grouped into stages of like fronts.

A *front* is a small dense matrix: its *pivots* are rows that are eliminated together, its *border* the later rows that
their elimination touches (multifrontal method; Duff and Reid, ACM Trans. Math. Softw. 9, 1983). The fronts at the same
height of the tree form a *stage*: they are padded to one shape and go through JAX as one batch.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from jeit_solvers.sparse.dissection import nested_dissection
from jeit_solvers.sparse.pattern import SparsityPattern

# Fronts this small still use matrix products well, and are small enough to be eliminated without looking inside.
_LEAF_SIZE = 24
# The launch of one stage's operations takes as long as about this many floating-point operations.
_OPERATIONS_WORTH_A_STAGE = 1e6


class EliminationTree:
    """Fronts, numbered from 0, of a sparsity pattern, and the borders that elimination gives them.

    - `front`, `place` (n,): each matrix row's front, and its place among the front's pivots.
    - `parent`, `stage`, `slot` (fronts,): each front's parent (-1 at the root), stage, and position in the stage.
    - `early`, `late` (nnz,): the ends of each matrix entry, the one that is eliminated first and the other.
    - For each stage: `borders`, sorted keys front * n + row; `batch`, `pivots`, `border`: its padded shape.
    """

    def __init__(self, pattern: SparsityPattern, coordinates: np.ndarray | None):
        """Dissect the pattern's graph, and find out what elimination in that order touches."""
        size = pattern.size
        rows, columns = np.asarray(pattern.rows, dtype=np.int64), np.asarray(pattern.columns, dtype=np.int64)
        self.size = size
        depth = max(0, int(np.ceil(np.log2(size / _LEAF_SIZE))))
        owner = nested_dissection(_graph(rows, columns, size), depth, coordinates)
        self._make_fronts(owner, depth)
        order = np.argsort(self.front, kind="stable")
        self.place = np.empty(size, dtype=np.int64)
        self.place[order] = rank_within(self.front[order])
        rows_first = self.stage[self.front[rows]] <= self.stage[self.front[columns]]
        self.early, self.late = np.where(rows_first, rows, columns), np.where(rows_first, columns, rows)
        self._find_borders()
        self.pivot_count = np.bincount(self.front, minlength=self.parent.size)
        stages = range(self.num_stages)
        self.batch = np.bincount(self.stage, minlength=self.num_stages)
        self.pivots = [max(1, int(self.pivot_count[self.stage == stage].max())) for stage in stages]
        self.border = [int(rank_within(keys // size).max(initial=-1)) + 1 for keys in self.borders]

    def _make_fronts(self, owner: np.ndarray, depth: int) -> None:
        """Fronts out of tree nodes: small separators are eliminated together with those below them."""
        nodes = np.arange(2 ** (depth + 1) - 1)
        level = np.floor(np.log2(nodes + 1)).astype(int)
        largest = np.zeros(depth + 1, dtype=int)
        np.maximum.at(largest, level, np.bincount(owner, minlength=nodes.size))
        heights = _merged_levels(largest)
        first_level = depth + 1 - np.cumsum(heights)
        stage_of_level = np.searchsorted(-first_level, -np.arange(depth + 1), side="left")
        top = nodes.copy()
        for _ in range(max(heights)):
            top = np.where(level[top] > first_level[stage_of_level[level[top]]], (top - 1) // 2, top)
        kept, front_of_node = np.unique(top, return_inverse=True)
        self.front = front_of_node[owner]
        self.parent = np.where(kept > 0, front_of_node[(kept - 1) // 2], -1)
        self.stage = stage_of_level[level[kept]]
        self.num_stages = len(heights)
        by_stage = np.argsort(self.stage, kind="stable")
        self.slot = np.empty(kept.size, dtype=np.int64)
        self.slot[by_stage] = rank_within(self.stage[by_stage])

    def _find_borders(self) -> None:
        """A front's border: the later ends of its entries, and its children's borders without its own pivots."""
        first, second = self.front[self.early], self.front[self.late]
        pending = np.unique(first[first != second] * self.size + self.late[first != second])
        self.borders = []
        for stage in range(self.num_stages):
            mine = self.stage[pending // self.size] == stage
            border = pending[mine]
            self.borders.append(border)
            child, row = np.divmod(border, self.size)
            above = self.parent[child]
            inherited = (above * self.size + row)[self.front[row] != above]
            pending = np.unique(np.concatenate([pending[~mine], inherited]))

    def position(self, fronts: np.ndarray, rows: np.ndarray, stage: int) -> np.ndarray:
        """Local row of matrix rows in fronts of one stage: pivots first, then the border."""
        keys, border = fronts * self.size + rows, self.borders[stage]
        in_border = np.searchsorted(border, keys) - np.searchsorted(border, fronts * self.size)
        return np.where(self.front[rows] == fronts, self.place[rows], self.pivots[stage] + in_border)

    @property
    def num_operations(self) -> float:
        """Floating-point operations of one factorisation, padding included."""
        pivots, border = np.asarray(self.pivots, dtype=float), np.asarray(self.border, dtype=float)
        return float((self.batch * (4 / 3 * pivots**3 + 2 * pivots**2 * border + 2 * pivots * border**2)).sum())

    @property
    def num_factor_entries(self) -> int:
        """Numbers in the factor, padding included."""
        return int(sum(c * (s + b) * s for c, s, b in zip(self.batch, self.pivots, self.border, strict=True)))

    @property
    def num_front_entries(self) -> int:
        """Numbers in all fronts, about as many as the plan has indices."""
        return int(sum(c * (s + b) ** 2 for c, s, b in zip(self.batch, self.pivots, self.border, strict=True)))


def _merged_levels(largest: np.ndarray) -> list[int]:
    """Number of levels of the tree in each stage, from the leaves up, for levels with separators up to `largest`.

    Eliminating a separator together with the two below it makes a stage less, and wastes operations on the zeros
    between these two. It is done where the waste is smaller than what a stage costs in itself.
    """

    def operations(batch: int, pivots: int, border: int) -> float:
        return batch * (4 / 3 * pivots**3 + 2 * pivots**2 * border + 2 * pivots * border**2)

    heights, level = [1], len(largest) - 2
    while level >= 0:
        height, pivots = 1, int(largest[level])
        while level > 0:
            # Half a front's surroundings were cut by the separators next above: borders are a few of these long.
            batch, above = 2 ** (level - 1), int(largest[level - 1])
            border = 3 * above
            apart = operations(2 * batch, pivots, border) + operations(batch, above, border)
            if operations(batch, 2 * pivots + above, border) - apart > _OPERATIONS_WORTH_A_STAGE:
                break
            height, pivots, level = height + 1, 2 * pivots + above, level - 1
        heights.append(height)
        level -= 1
    return heights


def rank_within(groups: np.ndarray) -> np.ndarray:
    """Position of every element among the equal elements of a sorted array of small integers."""
    counts = np.bincount(groups)
    return np.arange(groups.size) - np.repeat(np.cumsum(counts) - counts, counts)


def _graph(rows: np.ndarray, columns: np.ndarray, size: int) -> csr_array:
    """The pattern without its diagonal, both triangles."""
    rows, columns = rows[size:], columns[size:]
    ends = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    return csr_array((np.ones(2 * rows.size, dtype=np.int8), ends), shape=(size, size))
