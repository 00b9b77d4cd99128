"""Approximations of the covariance of many cells: low-rank factors, and products by way of a regular grid.

A pivoted Cholesky factorisation gives Γ ≈ S Sᵀ with far fewer columns than cells. Columns are added one by one, each at
the largest diagonal entry of Γ - S Sᵀ, until the trace of Γ - S Sᵀ is below a given fraction of that of Γ. Harbrecht,
Peters and Schneider, Appl. Numer. Math. 62 (2012) 428-440.

A Gaussian covariance between many points is approximated by Γ = P G Pᵀ without a matrix over all pairs. G is the
covariance on a grid with a spacing of a third of the correlation length; it is a product of covariances along x, y and
z and is applied axis by axis. P is cubic interpolation from four grid points along each axis, with an error of some
thousandths at that spacing.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

# Diagonal entries of at least this fraction of the largest count as equal to it, as in symmetric meshes. The first of
# them is the pivot, so that rounding errors do not decide.
_EQUAL_DIAGONAL = 1 - 1e-4


def pivoted_cholesky(
    diagonal: np.ndarray, column: Callable[[int], np.ndarray], *, tolerance: float, max_rank: int
) -> np.ndarray:
    """S (m, n) with Γ ≈ S Sᵀ, for a covariance Γ given by its diagonal (m,) and a function that returns a column.

    `tolerance`: fraction of the trace of Γ that may be left out.
    """
    left = np.array(diagonal, float)
    enough = tolerance * left.sum()
    shapes = np.zeros((min(max_rank, left.size), left.size))
    for rank in range(shapes.shape[0]):
        if left.sum() <= enough:
            return shapes[:rank].T
        pivot = int(np.argmax(left >= _EQUAL_DIAGONAL * left.max()))
        row = column(pivot) - shapes[:rank, pivot] @ shapes[:rank]
        shapes[rank] = row / np.sqrt(left[pivot])
        left = np.maximum(left - shapes[rank] ** 2, 0)
        left[pivot] = 0
    return shapes.T


def traced_pivoted_cholesky(scaled: Float[Array, "m d"], *, tolerance: float, max_rank: int) -> Float[Array, "m k"]:
    """`pivoted_cholesky` of Γ = exp(-|x_i - x_j|²) for traced points `scaled`. Returns k = min(m, max_rank) columns;
    columns that are not needed are zero.

    The derivative is that of Γ[:, P] L⁻ᵀ with Γ[P, P] = L Lᵀ for fixed pivots P: exact except where the pivots change.
    """
    size = min(max_rank, len(scaled))
    pivots, rank = _pivots(jax.lax.stop_gradient(scaled), tolerance, size)
    needed = jnp.arange(size) < rank
    chosen = scaled[pivots]
    columns = jnp.where(needed, jnp.exp(-_squared_distances(scaled, chosen)), 0)
    inner = jnp.exp(-_squared_distances(chosen, chosen))
    lower = jnp.linalg.cholesky(jnp.where(needed & needed[:, None], inner, jnp.eye(size)))
    return jax.scipy.linalg.solve_triangular(lower, columns.T, lower=True).T


def _squared_distances(points, other_points):
    return ((points[:, None] - other_points) ** 2).sum(axis=-1)


def _pivots(scaled, tolerance: float, max_rank: int):
    """Indices (size,) of the pivots, and how many of them are needed."""
    enough = tolerance * len(scaled)

    def go_on(state):
        rank, _, _, left = state
        return (rank < max_rank) & (left.sum() > enough)

    def add(state):
        rank, pivots, shapes, left = state
        pivot = jnp.argmax(left >= _EQUAL_DIAGONAL * left.max())
        row = jnp.exp(-((scaled - scaled[pivot]) ** 2).sum(axis=1)) - shapes[:, pivot] @ shapes
        row = row / jnp.sqrt(left[pivot])
        left = jnp.maximum(left - row**2, 0).at[pivot].set(0)
        return rank + 1, pivots.at[rank].set(pivot), shapes.at[rank].set(row), left

    nothing = 0, jnp.zeros(max_rank, int), jnp.zeros((max_rank, len(scaled))), jnp.ones(len(scaled))
    rank, pivots, _, _ = jax.lax.while_loop(go_on, add, nothing)
    return pivots, rank


# Grid points per correlation length; number of grid points along an axis from which the cubic interpolates.
_GRID_POINTS_PER_LENGTH, _CUBIC = 3, 4
# Limits within which a grid is worthwhile: maximum number of grid points per point, and in total.
_MAX_GRID_RATIO, _MAX_GRID_POINTS = 8, 500_000
# Number of columns processed at a time, which limits the memory of the grid.
_COLUMNS_AT_ONCE = 64


class GriddedGaussian:
    """Covariance Γ_ij = exp(-|x_i - x_j|² / 2 length²) between points `places` (m, d), approximated on a grid.

    `places` and `length` in metres. `variance` (m,): diagonal of the approximation, one except for interpolation error.
    """

    def __init__(self, places: Float[np.ndarray, "m d"], length: float):
        spacing = length / _GRID_POINTS_PER_LENGTH
        low = places.min(axis=0) - 1.5 * spacing
        self._shape = tuple(int(count) for count in np.ceil((places.max(axis=0) - low) / spacing) + 2)
        steps = [np.arange(count) for count in self._shape]
        self._along = [np.exp(-((one[:, None] - one) ** 2) / (2 * _GRID_POINTS_PER_LENGTH**2)) for one in steps]
        place = (places - low) / spacing
        self._interpolation = _cubic_interpolation(place, self._shape)
        weights, nodes = _cubic_weights(place), np.arange(_CUBIC)
        between = np.exp(-((nodes[:, None] - nodes) ** 2) / (2 * _GRID_POINTS_PER_LENGTH**2))
        self.variance = np.prod(np.einsum("mdi,ij,mdj->md", weights, between, weights), axis=1)

    @staticmethod
    def suits(places: Float[np.ndarray, "m d"], length: float) -> bool:
        """Whether the grid has few enough points to be worthwhile."""
        extent = np.ptp(places, axis=0) / length * _GRID_POINTS_PER_LENGTH + 5
        return bool(np.prod(extent) < min(_MAX_GRID_RATIO * len(places), _MAX_GRID_POINTS))

    def product(self, columns: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m k"]:
        """Γ times columns."""
        found = np.empty(columns.shape)
        for start in range(0, columns.shape[1], _COLUMNS_AT_ONCE):
            some = slice(start, start + _COLUMNS_AT_ONCE)
            grid = (self._interpolation.T @ columns[:, some]).reshape(*self._shape, -1)
            for axis, along in enumerate(self._along):
                grid = np.moveaxis(np.tensordot(along, grid, axes=(1, axis)), 0, axis)
            found[:, some] = self._interpolation @ grid.reshape(int(np.prod(self._shape)), -1)
        return found


def _cubic_weights(place: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d 4"]:
    """Weights of cubic Lagrange interpolation from the two grid points on either side, along every axis."""
    t = place - np.floor(place) + 1
    nodes = np.arange(_CUBIC)
    return np.stack([np.prod([(t - j) / (i - j) for j in nodes if j != i], axis=0) for i in nodes], axis=-1)


def _cubic_interpolation(place: Float[np.ndarray, "m d"], shape: tuple[int, ...]) -> scipy.sparse.csr_array:
    """Sparse matrix (m, grid points) that interpolates from the grid to points `place`, in units of the spacing."""
    first, nodes, along = np.floor(place).astype(int) - 1, np.arange(_CUBIC), _cubic_weights(place)
    weight, index = np.ones((len(place), 1)), np.zeros((len(place), 1), int)
    for axis, count in enumerate(shape):
        weight = (weight[:, :, None] * along[:, axis, None, :]).reshape(len(place), -1)
        index = (index[:, :, None] * count + (first[:, axis, None] + nodes)[:, None, :]).reshape(len(place), -1)
    ends = np.arange(0, weight.size + 1, weight.shape[1])
    return scipy.sparse.csr_array((weight.ravel(), index.ravel(), ends), shape=(len(place), int(np.prod(shape))))
