"""The symbolic half of the direct solver: where every number goes, found once for a sparsity pattern, in NumPy."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int

from jeit_solvers.sparse.elimination_tree import EliminationTree, rank_within
from jeit_solvers.sparse.index_store import IndexLayout, IndexStore, PaddedSum, Slot
from jeit_solvers.sparse.pattern import SparsityPattern


class Link(NamedTuple):
    """Transfer to a stage from the fronts of an earlier one, `source`: sums over that stage's flattened Schur
    complements, into `panel` and `corner`, and over its flattened right-hand-side updates, into `rows`."""

    source: int
    panel: PaddedSum
    corner: PaddedSum
    rows: PaddedSum


class Stage(NamedTuple):
    """A batch of fronts padded to one shape: `pivots` rows eliminated in each, `border` rows updated.

    `entries` sums the matrix's values, and a one appended to them for padded pivots, into the fronts' first columns
    (batch, pivots + border, pivots). `right_hand_side` (batch, pivots) names matrix rows, `above` (batch, border) rows
    of the stage `parent`'s fronts; both are out of range for padding.
    """

    batch: int
    pivots: int
    border: int
    entries: PaddedSum
    links: tuple[Link, ...]
    right_hand_side: Slot
    parent: int
    above: Slot


class FactorisationPlan(eqx.Module):
    """Everything that `factorise` and `solve` need to know about a sparsity pattern; made by `analyse`.

    The index maps are one leaf of the pytree: pass a plan to a jitted function as an argument.
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
    def solution(self) -> Slot:
        """Index of each matrix row among the pivots of all stages, one stage after the other."""
        return self.layout.content[1]

    @property
    def num_pivots(self) -> int:
        """Rows of what `half_solve` returns, padding included."""
        return sum(stage.batch * stage.pivots for stage in self.stages)

    @property
    def num_factor_entries(self) -> int:
        """Numbers in the factor, padding included; its memory is this times the size of a number."""
        return sum(stage.batch * (stage.pivots + stage.border) * stage.pivots for stage in self.stages)

    @property
    def num_operations(self) -> int:
        """Floating-point operations of one factorisation, padding included."""
        return sum(
            stage.batch * (4 * s**3 // 3 + 2 * s * s * stage.border + 2 * s * stage.border**2)
            for stage in self.stages
            for s in [stage.pivots]
        )


def analyse(pattern: SparsityPattern, coordinates: Any = None) -> FactorisationPlan:
    """Find the order of elimination and the index maps of the direct solver for a sparsity pattern.

    Runs in NumPy and SciPy, outside `jit`, once for a pattern. `coordinates` (n, d) of the unknowns, if they have any,
    give a better order than the pattern alone. Raises a ValueError if their shape does not fit or they are not finite.
    """
    return plan_of_tree(pattern, elimination_tree(pattern, coordinates))


def elimination_tree(pattern: SparsityPattern, coordinates: Any = None) -> EliminationTree:
    """Elimination tree from which `analyse` makes a plan; cheap to compute, and enough to estimate the plan's cost.

    Raises `ValueError` for coordinates of another shape than (n, d), or not finite.
    """
    if coordinates is not None:
        coordinates = np.asarray(coordinates, dtype=float)
        if coordinates.ndim != 2 or coordinates.shape[0] != pattern.size or coordinates.shape[1] < 1:
            raise ValueError(
                f"analyse: `coordinates` must have shape (n, d) with n = {pattern.size} unknowns; "
                f"got {coordinates.shape}."
            )
        if not np.isfinite(coordinates).all():
            raise ValueError("analyse: `coordinates` hold NaN or infinity.")
    return EliminationTree(pattern, coordinates)


def plan_of_tree(pattern: SparsityPattern, tree: EliminationTree) -> FactorisationPlan:
    """All index maps for an elimination tree: those of another plan, while one of the same tree is in use, such as that
    of a forward model whose mesh a prior has matrices on."""
    known = _known(pattern, tree)
    indices, layout = _INDICES.get(known), _LAYOUTS.get(known)
    if indices is None or layout is None:
        store = IndexStore()
        stages = tuple(_stage(store, pattern, tree, stage) for stage in range(tree.num_stages))
        offsets = np.cumsum([0, *(stage.batch * stage.pivots for stage in stages)])
        stage_of_row = tree.stage[tree.front]
        solution = offsets[stage_of_row] + tree.slot[tree.front] * np.asarray(tree.pivots)[stage_of_row] + tree.place
        layout = IndexLayout(stages, store.add(solution))
        indices = store.pack()
        _INDICES[known], _LAYOUTS[known] = indices, layout
    return FactorisationPlan(indices, layout, pattern.size, pattern.num_entries)


def _known(pattern: SparsityPattern, tree: EliminationTree) -> bytes:
    """Key by which a plan is recognised."""
    found = hashlib.blake2b(digest_size=16)
    for one in (pattern.rows, pattern.columns, tree.front, tree.place, tree.parent, tree.stage, tree.slot):
        found.update(np.asarray(one).tobytes())
    return found.digest()


# Indices of plans in use: making a plan of a solid takes seconds, and keeping it hundreds of megabytes.
_INDICES: WeakValueDictionary[bytes, Array] = WeakValueDictionary()
_LAYOUTS: WeakValueDictionary[bytes, IndexLayout] = WeakValueDictionary()


def _stage(store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int) -> Stage:
    batch, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    height = pivots + border
    rows = np.flatnonzero(tree.stage[tree.front] == stage)
    right_hand_side = np.full((batch, pivots), tree.size)
    right_hand_side[tree.slot[tree.front[rows]], tree.place[rows]] = rows

    # Where this stage's borders are found among the rows of their parents.
    child, row = np.divmod(tree.borders[stage], tree.size)
    parent_front = tree.parent[child]
    parent = int(tree.stage[parent_front[0]]) if child.size else -1
    above = np.zeros((batch, border), dtype=np.int64)
    if child.size:
        parent_height = tree.pivots[parent] + tree.border[parent]
        above[:] = tree.batch[parent] * parent_height
        position = tree.slot[parent_front] * parent_height + tree.position(parent_front, row, parent)
        above[tree.slot[child], rank_within(child)] = position

    sources = np.unique(tree.stage[(tree.parent >= 0) & (tree.stage[tree.parent] == stage)])
    return Stage(
        batch,
        pivots,
        border,
        _matrix_entries(store, pattern, tree, stage, height),
        tuple(_link(store, tree, int(source), stage) for source in sources if tree.border[source]),
        store.add(right_hand_side),
        parent,
        store.add(above),
    )


def _matrix_entries(
    store: IndexStore, pattern: SparsityPattern, tree: EliminationTree, stage: int, height: int
) -> PaddedSum:
    """The matrix's values into the fronts that eliminate them, and ones on the diagonal of padded pivots."""
    batch, pivots = int(tree.batch[stage]), tree.pivots[stage]
    entries = np.flatnonzero(tree.stage[tree.front[tree.early]] == stage)
    early, late = tree.early[entries], tree.late[entries]
    front = tree.front[early]
    column, row = tree.place[early], tree.position(front, late, stage)
    # The fronts' pivot blocks are filled on both sides of the diagonal.
    both = (row < pivots) & (row != column)
    first = tree.slot[front] * height
    members = np.argsort(np.where(tree.stage == stage, tree.slot, tree.parent.size), kind="stable")[:batch]
    padded, pad = np.nonzero(np.arange(pivots) >= tree.pivot_count[members][:, None])
    target = [(first + row) * pivots + column, ((first + column) * pivots + row)[both]]
    target.append((padded * height + pad) * pivots + pad)
    source = [entries, entries[both], np.full(padded.size, pattern.num_entries)]
    return PaddedSum.create(
        store, np.concatenate(target), np.concatenate(source), batch * height * pivots, pattern.num_entries + 1
    )


def _link(store: IndexStore, tree: EliminationTree, source: int, stage: int) -> Link:
    batch, pivots, border = int(tree.batch[stage]), tree.pivots[stage], tree.border[stage]
    height, count, width = pivots + border, int(tree.batch[source]), tree.border[source]
    child, row = np.divmod(tree.borders[source], tree.size)
    place, front = rank_within(child), tree.parent[child]
    # Local row in the parent of each border row of each child; -1 is padding.
    into = np.full((count, width), -1)
    into[tree.slot[child], place] = tree.position(front, row, stage)
    parent_slot = np.zeros(count, dtype=np.int64)
    parent_slot[tree.slot[child]] = tree.slot[front]
    flat = np.arange(count * width * width).reshape(count, width, width)
    first, second, base = np.broadcast_arrays(into[:, :, None], into[:, None, :], parent_slot[:, None, None])
    valid = (first >= 0) & (second >= 0)
    panel, corner = valid & (second < pivots), valid & (first >= pivots) & (second >= pivots)
    in_panel = ((base * height + first) * pivots + second)[panel]
    in_corner = ((base * border + first - pivots) * border + second - pivots)[corner]
    in_rows = parent_slot[:, None] * height + into
    used = into >= 0
    return Link(
        source,
        PaddedSum.create(store, in_panel, flat[panel], batch * height * pivots, flat.size),
        PaddedSum.create(store, in_corner, flat[corner], batch * border * border, flat.size),
        PaddedSum.create(store, in_rows[used], np.flatnonzero(used), batch * height, count * width),
    )
