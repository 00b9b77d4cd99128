"""Entries of A⁻¹ between nearby unknowns of a sparse symmetric matrix A, by elimination of a block tridiagonal matrix.

The unknowns are partitioned into blocks, called *strips*, such that A couples each strip only to the strips before and
after it. The strips are the levels of a breadth-first search that starts at one side of the body. With the diagonal
blocks A_i of strip i and the blocks E_i between strips i and i + 1, elimination from the first strip on gives

    P_i = (A_i - Eᵀ_(i-1) P_(i-1) E_(i-1))⁻¹,  W_i = P_i E_i,

and then, from the last strip back, the blocks of G = A⁻¹ are (Takahashi, Fagan and Chin, Proc. 8th PICA Conf., 1973)

    G_ij = -W_i G_(i+1)j  for j > i,    G_ii = P_i + W_i G_(i+1)(i+1) W_iᵀ.

Only blocks with j - i up to `max_distance` are computed. Nearly all work is in products of large matrices.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact, Int
from scipy.sparse import csr_array

from jeit_solvers.dense import symmetric_inverse
from jeit_solvers.module import Module
from jeit_solvers.sparse.operator import SparseSymmetric
from jeit_solvers.sparse.pattern import SparsityPattern


class Strips(Module):
    """Partition of the unknowns of a matrix into strips, each coupled only to its two neighbours, for `near_inverse`.
    The selected unknowns, between which the inverse is computed, come first in each strip.

    **Fields**: `position`: (n,) position of each unknown, which is strip · `strip_size` + index within the strip;
    `num_strips`: number of strips; `strip_size`: maximum number of unknowns in a strip; `selected_per_strip`: maximum
    number of selected unknowns in a strip, rounded up. The `place` of a selected unknown is its strip ·
    `selected_per_strip` + its index within the strip.

    **Example:**

    ```python
    strips = Strips.create(pattern, coordinates, np.ones(50, bool))
    strips.num_strips, strips.place
    ```
    """

    position: Int[np.ndarray, " n"]
    num_strips: int = eqx.field(static=True)
    strip_size: int = eqx.field(static=True)
    selected_per_strip: int = eqx.field(static=True)

    @classmethod
    def create(
        cls, pattern: SparsityPattern, coordinates: Inexact[np.ndarray, "n d"], selected: Bool[np.ndarray, " n"]
    ) -> "Strips":
        """Partition the unknowns into strips perpendicular to the longest extent of their `coordinates` (n, d).
        `selected` (n,): the unknowns between which the inverse is needed."""
        longest_axis, *other_axes = coordinates.T[np.argsort(-np.ptp(coordinates, axis=0))]
        strip_of_row = _breadth_first_levels(pattern, longest_axis)
        # Sort the unknowns of a strip by their other coordinates, so that neighbours in space are neighbours in memory.
        sort_order = np.lexsort((*other_axes[::-1], ~selected, strip_of_row))
        rows_per_strip = np.bincount(strip_of_row)
        index_in_strip = np.empty(len(strip_of_row), int)
        index_in_strip[sort_order] = np.arange(len(strip_of_row)) - np.repeat(
            np.cumsum(rows_per_strip) - rows_per_strip, rows_per_strip
        )
        strip_size = int(rows_per_strip.max())
        num_selected = int(np.bincount(strip_of_row[selected], minlength=1).max())
        num_selected = min(
            -(-max(num_selected, 1) // 8) * 8, strip_size
        )  # rounded to few sizes, because a program is compiled for each size
        return cls(
            (strip_of_row * strip_size + index_in_strip).astype(np.int32), len(rows_per_strip), strip_size, num_selected
        )

    @property
    def place(self) -> Int[np.ndarray, " n"]:
        """Places (n,) of the selected unknowns, in 0 … `num_strips` · `selected_per_strip` - 1; meaningless for other
        unknowns."""
        return self.position // self.strip_size * self.selected_per_strip + self.position % self.strip_size

    def max_strip_distance(self, groups: Int[np.ndarray, "g k"]) -> int:
        """Largest difference between the strip numbers of two places in the same row of `groups` (g, k); at least 1."""
        strip_numbers = np.asarray(groups) // self.selected_per_strip
        return max(1, int((strip_numbers.max(axis=1) - strip_numbers.min(axis=1)).max()))

    def spread(self, rows: Inexact[Array, "n *k"]) -> Inexact[Array, "p *k"]:
        """Reorder `rows` (n, …), one per unknown, to the order of places. Places without an unknown get zeros."""
        padded_shape = self.num_strips * self.strip_size, *rows.shape[1:]
        spread_rows = (
            jnp.zeros(padded_shape, rows.dtype)
            .at[self.position]
            .set(rows)
            .reshape(self.num_strips, self.strip_size, *padded_shape[1:])
        )
        return spread_rows[:, : self.selected_per_strip].reshape(-1, *padded_shape[1:])


class NearInverse(Module):
    """Entries of the inverse G = A⁻¹ between places that are at most a few strips apart. **Fields**: `band`: (strips,
    selected unknowns, columns) blocks G_ij with j ≥ i only, because G is symmetric; `left`, `right`: (p, r) factors of
    a matrix left rightᵀ that is added to G.

    **Example:**

    ```python
    strips = Strips.create(pattern, coordinates, np.ones(50, bool))
    near_inverse(strips, operator, 2).blocks(strips.place[:, None])
    ```
    """

    band: Inexact[Array, "s p q"]
    left: Inexact[Array, "p r"]
    right: Inexact[Array, "p r"]

    def blocks(self, places: Int[Array, "g k"]) -> Inexact[Array, "g k k"]:
        """Blocks (g, k, k) of the inverse G between the k places of each group."""
        _, num_selected, band_width = self.band.shape
        low_rank_blocks = self.left[places] @ jnp.swapaxes(self.right[places], 1, 2)
        if self.band.size >= 2**31:  # places are 32-bit integers, and their products would overflow
            places = places.astype(jnp.int64)
        row_places, column_places = places[:, :, None], places[:, None]
        row_places, column_places = jnp.minimum(row_places, column_places), jnp.maximum(row_places, column_places)
        entry_index = row_places * band_width + column_places - row_places // num_selected * num_selected
        return self.band.reshape(-1).at[entry_index].get(mode="promise_in_bounds") + low_rank_blocks

    def add(self, left: Inexact[Array, "p r"], right: Inexact[Array, "p r"]) -> "NearInverse":
        """Return the sum G + left rightᵀ, which must be symmetric. The rows of `left` and `right` are in the order of
        places."""
        joined_factors = (
            jnp.concatenate(factor_pair, axis=1) for factor_pair in ((self.left, left), (self.right, right))
        )
        return NearInverse(self.band, *joined_factors)


@partial(jax.jit, static_argnums=2)
def near_inverse(strips: Strips, operator: SparseSymmetric, max_distance: int) -> NearInverse:
    """Compute the entries of A⁻¹ between selected unknowns that are at most a few strips apart. The entries are NaN if
    A is not positive definite.

    **Arguments:**

    - `strips`: partition of the unknowns.
    - `operator`: the matrix A.
    - `max_distance`: maximum difference of strip numbers.

    **Example:**

    ```python
    strips = Strips.create(pattern, coordinates, np.ones(50, bool))
    near = near_inverse(strips, operator, 2)
    ```
    """
    strip_size, num_selected = strips.strip_size, strips.selected_per_strip
    diagonal_blocks, coupling_blocks = _strip_blocks(strips, operator)

    def eliminate_strip(schur_update, strip_index):
        diagonal_block, coupling_block = strip_index
        pivot_inverse = symmetric_inverse(diagonal_block - schur_update)
        coupling_weights = pivot_inverse @ coupling_block
        return coupling_block.T @ coupling_weights, (pivot_inverse, coupling_weights)

    def substitute_strip(following_blocks, strip_index):
        pivot_inverse, coupling_weights = strip_index
        later_blocks = -coupling_weights @ following_blocks
        diagonal_block = pivot_inverse - later_blocks[:, :strip_size] @ coupling_weights.T
        diagonal_block = (diagonal_block + diagonal_block.T) / 2
        selected_blocks = jnp.concatenate(
            [diagonal_block[:, :num_selected], later_blocks[:, :num_selected], later_blocks[:, strip_size:]], axis=1
        )[:num_selected]
        num_columns = strip_size + (max_distance - 1) * num_selected
        following_blocks = jnp.concatenate(
            [diagonal_block, later_blocks[:, :num_selected], later_blocks[:, strip_size:]], axis=1
        )[:, :num_columns]
        return following_blocks, selected_blocks

    zero_block = jnp.zeros((strip_size, strip_size), operator.values.dtype)
    _, eliminated_strips = jax.lax.scan(eliminate_strip, zero_block, (diagonal_blocks, coupling_blocks))
    zero_block = jnp.zeros((strip_size, strip_size + (max_distance - 1) * num_selected), operator.values.dtype)
    _, upper_blocks = jax.lax.scan(substitute_strip, zero_block, eliminated_strips, reverse=True)
    empty_factors = jnp.zeros((strips.num_strips * num_selected, 0), upper_blocks.dtype)
    return NearInverse(upper_blocks, empty_factors, empty_factors)


def _strip_blocks(strips: Strips, operator: SparseSymmetric):
    """Diagonal blocks A_i and blocks E_i between neighbouring strips, both (num_strips, strip_size, strip_size). Strips
    are padded to equal size with unknowns that are not coupled to others."""
    block_shape = strips.num_strips, strips.strip_size, strips.strip_size
    padded_positions = jnp.asarray(strips.position)
    entry_rows, entry_columns = padded_positions[operator.pattern.rows], padded_positions[operator.pattern.columns]
    smaller_indices, larger_indices = jnp.minimum(entry_rows, entry_columns), jnp.maximum(entry_rows, entry_columns)
    strip_of_entry, row_in_strip, column_in_strip = (
        smaller_indices // strips.strip_size,
        smaller_indices % strips.strip_size,
        larger_indices % strips.strip_size,
    )
    strip_of_diagonal_entry = jnp.where(
        larger_indices // strips.strip_size == strip_of_entry, strip_of_entry, strips.num_strips
    )
    coupling_strip = jnp.where(larger_indices // strips.strip_size == strip_of_entry, strips.num_strips, strip_of_entry)
    is_padding = jnp.ones(strips.num_strips * strips.strip_size).at[padded_positions].set(0).reshape(block_shape[:2])
    diagonal_blocks = jnp.eye(strips.strip_size, dtype=operator.values.dtype) * is_padding[:, None]
    diagonal_blocks = diagonal_blocks.at[strip_of_diagonal_entry, row_in_strip, column_in_strip].set(
        operator.values, mode="drop"
    )
    diagonal_blocks = diagonal_blocks.at[strip_of_diagonal_entry, column_in_strip, row_in_strip].set(
        operator.values, mode="drop"
    )
    coupling_blocks = (
        jnp.zeros(block_shape, operator.values.dtype)
        .at[coupling_strip, row_in_strip, column_in_strip]
        .set(operator.values, mode="drop")
    )
    return diagonal_blocks, coupling_blocks


def _breadth_first_levels(pattern: SparsityPattern, coordinate: np.ndarray) -> Int[np.ndarray, " n"]:
    """Levels (n,) of a breadth-first search that starts where `coordinate` (n,) is smallest, in each connected
    component."""
    entry_rows, entry_columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    pattern_graph = csr_array(
        (np.ones(len(entry_rows), np.float32), (entry_rows, entry_columns)), shape=(pattern.size, pattern.size)
    )
    pattern_graph = pattern_graph + pattern_graph.T
    node_levels, level_number = np.full(pattern.size, -1), 0
    is_in_frontier = np.zeros(pattern.size, bool)
    while (is_unvisited := node_levels < 0).any():
        if not is_in_frontier.any():
            first_node = np.flatnonzero(is_unvisited)[coordinate[is_unvisited].argmin()]
            neighbour_nodes = pattern_graph.indices[
                pattern_graph.indptr[first_node] : pattern_graph.indptr[first_node + 1]
            ]
            is_in_frontier = is_unvisited & (
                coordinate <= (coordinate[first_node] + coordinate[neighbour_nodes].max()) / 2
            )
        node_levels[is_in_frontier] = level_number
        level_number += 1
        is_in_frontier = (pattern_graph @ is_in_frontier.astype(np.float32) > 0) & (node_levels < 0)
    return node_levels
