"""Entries of A⁻¹ between nearby unknowns of a sparse matrix A, by elimination from strip to strip.

Unknowns are partitioned into strips, each coupled only to its neighbours: the levels of a breadth-first search from one
side. With blocks A_i of a strip and E_i between strips i and i + 1, elimination from the first strip on gives

    P_i = (A_i - Eᵀ_(i-1) P_(i-1) E_(i-1))⁻¹,  W_i = P_i E_i,

and then, from the last strip back, the blocks of G = A⁻¹ are (Takahashi, Fagan and Chin, Proc. 8th PICA Conf., 1973)

    G_ij = -W_i G_(i+1)j  for j > i,    G_ii = P_i + W_i G_(i+1)(i+1) W_iᵀ.

Only blocks with j up to i + `reach` are computed. The work consists of products of a few large matrices.
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
from jeit_solvers.sparse.operator import SparseSymmetric
from jeit_solvers.sparse.pattern import SparsityPattern


class Strips(eqx.Module):
    """Unknowns of a matrix, partitioned into strips, with the wanted unknowns first in each strip.

    `position`: (n,) strip · `size` + index within the strip; `number`: number of strips; `size`: maximum number of
    unknowns in a strip; `wanted`: maximum number of wanted unknowns in a strip, rounded up. The `place` of a wanted
    unknown is strip · `wanted` + index within the strip.
    """

    position: Int[np.ndarray, " n"]
    number: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    wanted: int = eqx.field(static=True)

    @classmethod
    def create(
        cls, pattern: SparsityPattern, coordinates: Inexact[np.ndarray, "n d"], wanted: Bool[np.ndarray, " n"]
    ) -> "Strips":
        """Strips perpendicular to the longest extent of the unknowns' coordinates."""
        long, *others = coordinates.T[np.argsort(-np.ptp(coordinates, axis=0))]
        strip = _levels(pattern, long)
        # Neighbours in a strip are neighbours in memory.
        order = np.lexsort((*others[::-1], ~wanted, strip))
        counts = np.bincount(strip)
        within = np.empty(len(strip), int)
        within[order] = np.arange(len(strip)) - np.repeat(np.cumsum(counts) - counts, counts)
        size = int(counts.max())
        most = int(np.bincount(strip[wanted], minlength=1).max())
        most = min(-(-max(most, 1) // 8) * 8, size)  # rounded to few sizes, because a program is compiled for each
        return cls((strip * size + within).astype(np.int32), len(counts), size, most)

    @property
    def place(self) -> Int[np.ndarray, " n"]:
        """Places (n,) of the wanted unknowns, in 0 … `number` · `wanted` - 1; meaningless for other unknowns."""
        return self.position // self.size * self.wanted + self.position % self.size

    def reach(self, groups: Int[np.ndarray, "g k"]) -> int:
        """Maximum number of strips between the first and the last place of a group, at least 1."""
        strips = np.asarray(groups) // self.wanted
        return max(1, int((strips.max(axis=1) - strips.min(axis=1)).max()))

    def spread(self, rows: Inexact[Array, "n *k"]) -> Inexact[Array, "p *k"]:
        """Rows of the unknowns in the order of places; zeros where a strip has fewer wanted unknowns than `wanted`."""
        shape = self.number * self.size, *rows.shape[1:]
        spread = jnp.zeros(shape, rows.dtype).at[self.position].set(rows).reshape(self.number, self.size, *shape[1:])
        return spread[:, : self.wanted].reshape(-1, *shape[1:])


class NearInverse(eqx.Module):
    """G between places at most a few strips apart. **Fields**: `band`: (strips, wanted, columns) blocks G_ij, with j
    from the strip i of the row to a few strips further, because G is symmetric; `left` and `right`: (p, r) factors of a
    term left rightᵀ that is added to G."""

    band: Inexact[Array, "s p q"]
    left: Inexact[Array, "p r"]
    right: Inexact[Array, "p r"]

    def blocks(self, places: Int[Array, "g k"]) -> Inexact[Array, "g k k"]:
        """Blocks of G between the places of each group."""
        _, wanted, width = self.band.shape
        added = self.left[places] @ jnp.swapaxes(self.right[places], 1, 2)
        if self.band.size >= 2**31:  # places are 32-bit integers, and their products would overflow
            places = places.astype(jnp.int64)
        row, column = places[:, :, None], places[:, None]
        row, column = jnp.minimum(row, column), jnp.maximum(row, column)
        index = row * width + column - row // wanted * wanted
        return self.band.reshape(-1).at[index].get(mode="promise_in_bounds") + added

    def add(self, left: Inexact[Array, "p r"], right: Inexact[Array, "p r"]) -> "NearInverse":
        """G + left rightᵀ, which must be symmetric; both factors have rows in the order of places."""
        joined = (jnp.concatenate(pair, axis=1) for pair in ((self.left, left), (self.right, right)))
        return NearInverse(self.band, *joined)


@partial(jax.jit, static_argnums=2)
def near_inverse(strips: Strips, operator: SparseSymmetric, reach: int) -> NearInverse:
    """G = A⁻¹ between wanted unknowns of strips at most `reach` apart; NaN if A is not positive definite."""
    size, wanted = strips.size, strips.wanted
    blocks, couplings = _blocks(strips, operator)

    def eliminate(taken, strip):
        block, coupling = strip
        pivot = symmetric_inverse(block - taken)
        weights = pivot @ coupling
        return coupling.T @ weights, (pivot, weights)

    def substitute(following, strip):
        pivot, weights = strip
        ahead = -weights @ following
        own = pivot - ahead[:, :size] @ weights.T
        own = (own + own.T) / 2
        near = jnp.concatenate([own[:, :wanted], ahead[:, :wanted], ahead[:, size:]], axis=1)[:wanted]
        kept = size + (reach - 1) * wanted
        following = jnp.concatenate([own, ahead[:, :wanted], ahead[:, size:]], axis=1)[:, :kept]
        return following, near

    nothing = jnp.zeros((size, size), operator.values.dtype)
    _, eliminated = jax.lax.scan(eliminate, nothing, (blocks, couplings))
    nothing = jnp.zeros((size, size + (reach - 1) * wanted), operator.values.dtype)
    _, upper = jax.lax.scan(substitute, nothing, eliminated, reverse=True)
    none = jnp.zeros((strips.number * wanted, 0), upper.dtype)
    return NearInverse(upper, none, none)


def _blocks(strips: Strips, operator: SparseSymmetric):
    """A_i and E_i (number, size, size). Strips are filled up with unknowns that are not coupled to others."""
    shape = strips.number, strips.size, strips.size
    position = jnp.asarray(strips.position)
    rows, columns = position[operator.pattern.rows], position[operator.pattern.columns]
    first, last = jnp.minimum(rows, columns), jnp.maximum(rows, columns)
    strip, row, column = first // strips.size, first % strips.size, last % strips.size
    inside = jnp.where(last // strips.size == strip, strip, strips.number)
    across = jnp.where(last // strips.size == strip, strips.number, strip)
    filler = jnp.ones(strips.number * strips.size).at[position].set(0).reshape(shape[:2])
    blocks = jnp.eye(strips.size, dtype=operator.values.dtype) * filler[:, None]
    blocks = blocks.at[inside, row, column].set(operator.values, mode="drop")
    blocks = blocks.at[inside, column, row].set(operator.values, mode="drop")
    couplings = jnp.zeros(shape, operator.values.dtype).at[across, row, column].set(operator.values, mode="drop")
    return blocks, couplings


def _levels(pattern: SparsityPattern, along: np.ndarray) -> Int[np.ndarray, " n"]:
    """Levels (n,) of a breadth-first search that starts where the coordinate `along` is smallest, in each connected
    component."""
    rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    graph = csr_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(pattern.size, pattern.size))
    graph = graph + graph.T
    level, number = np.full(pattern.size, -1), 0
    frontier = np.zeros(pattern.size, bool)
    while (unseen := level < 0).any():
        if not frontier.any():
            end = np.flatnonzero(unseen)[along[unseen].argmin()]
            neighbours = graph.indices[graph.indptr[end] : graph.indptr[end + 1]]
            frontier = unseen & (along <= (along[end] + along[neighbours].max()) / 2)
        level[frontier] = number
        number += 1
        frontier = (graph @ frontier.astype(np.float32) > 0) & (level < 0)
    return level
