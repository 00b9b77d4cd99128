"""Covariances of low rank: Γ ≈ S Sᵀ with far fewer columns than cells, by a pivoted Cholesky factorisation.

One column after the other, where the diagonal of Γ - S Sᵀ is largest, until its sum is below a share of that of Γ.
Harbrecht, Peters and Schneider, Appl. Numer. Math. 62 (2012) 428-440.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Of places that are as large but for this, as those of symmetric meshes are, the first: rounding is not to decide.
_AS_LARGE = 1 - 1e-4


def pivoted_cholesky(
    diagonal: np.ndarray, column: Callable[[int], np.ndarray], *, tolerance: float, max_rank: int
) -> np.ndarray:
    """S (m, n) with Γ ≈ S Sᵀ, for a covariance Γ given by its diagonal (m,) and a function that returns a column.

    `tolerance`: the share of the diagonal's sum that may be left out.
    """
    left = np.array(diagonal, float)
    enough = tolerance * left.sum()
    shapes = np.zeros((min(max_rank, left.size), left.size))
    for rank in range(shapes.shape[0]):
        if left.sum() <= enough:
            return shapes[:rank].T
        pivot = int(np.argmax(left >= _AS_LARGE * left.max()))
        row = column(pivot) - shapes[:rank, pivot] @ shapes[:rank]
        shapes[rank] = row / np.sqrt(left[pivot])
        left = np.maximum(left - shapes[rank] ** 2, 0)
        left[pivot] = 0
    return shapes.T


def traced_pivoted_cholesky(scaled: Float[Array, "m d"], *, tolerance: float, max_rank: int) -> Float[Array, "m k"]:
    """The same of Γ = exp(-|x_i - x_j|²) for points `scaled` that are traced: k = min(m, max_rank) columns, those that
    are not needed zero.

    Its derivative is that of Γ[:, P] L⁻ᵀ, Γ[P, P] = L Lᵀ, for the pivots P as they are: exact but where they change.
    """
    size = min(max_rank, len(scaled))
    pivots, rank = _pivots(jax.lax.stop_gradient(scaled), tolerance, size)
    needed = jnp.arange(size) < rank
    chosen = scaled[pivots]
    columns = jnp.where(needed, jnp.exp(-_squared_distances(scaled, chosen)), 0)
    inner = jnp.exp(-_squared_distances(chosen, chosen))
    lower = jnp.linalg.cholesky(jnp.where(needed & needed[:, None], inner, jnp.eye(size)))
    return jax.scipy.linalg.solve_triangular(lower, columns.T, lower=True).T


def _squared_distances(one, other):
    return ((one[:, None] - other) ** 2).sum(axis=-1)


def _pivots(scaled, tolerance: float, size: int):
    """Which points are pivots (size,), and how many of them are needed."""
    enough = tolerance * len(scaled)

    def go_on(state):
        rank, _, _, left = state
        return (rank < size) & (left.sum() > enough)

    def add(state):
        rank, pivots, shapes, left = state
        pivot = jnp.argmax(left >= _AS_LARGE * left.max())
        row = jnp.exp(-((scaled - scaled[pivot]) ** 2).sum(axis=1)) - shapes[:, pivot] @ shapes
        row = row / jnp.sqrt(left[pivot])
        left = jnp.maximum(left - row**2, 0).at[pivot].set(0)
        return rank + 1, pivots.at[rank].set(pivot), shapes.at[rank].set(row), left

    nothing = 0, jnp.zeros(size, int), jnp.zeros((size, len(scaled))), jnp.ones(len(scaled))
    rank, pivots, _, _ = jax.lax.while_loop(go_on, add, nothing)
    return pivots, rank
