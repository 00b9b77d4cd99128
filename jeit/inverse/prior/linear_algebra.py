"""Linear algebra of priors on many cells, without matrices over all pairs of cells: direct solution of sparse systems
over the nodes of a mesh, averages of nodal values over cells, and approximations of a covariance by low-rank factors or
on a regular grid.

A pivoted Cholesky factorisation gives Γ ≈ S Sᵀ with far fewer columns than cells. Columns are added one by one, each at
the largest diagonal entry of Γ - S Sᵀ, until the trace of Γ - S Sᵀ is below a specified fraction of the trace of Γ.
Harbrecht, Peters and Schneider, Appl. Numer. Math. 62 (2012) 428-440.

A Gaussian covariance between many points is approximated by Γ = P G Pᵀ without a matrix over all pairs. G is the
covariance on a grid with a spacing of a third of the correlation length; it is a product of covariances along x, y and
z and is applied axis by axis. P is cubic interpolation from four grid points along each axis, with an error of some
thousandths at that spacing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from jeit.mesh import Mesh
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    Fronts,
    SparsityPattern,
    factorise,
    factorise_fronts,
    find_fronts,
    half_solve,
    on_cores,
    solve,
)
from jeit_solvers.engines import on_host

# Number of right-hand sides solved at a time, with a plan's padded fronts and with fronts of exact size: more would
# exceed the caches.
_COLUMNS_BY_PLAN, _COLUMNS_BY_FRONTS = 32, 256

Solve = Callable[[Any], Any]
"""Function that solves a linear system for columns (n, k)."""


class NodalSystem(NamedTuple):
    """Structure of sparse matrices whose entries couple the nodes of a cell.

    **Fields**: `mesh`: mesh with NumPy arrays; `pattern`: sparsity pattern; `fronts`: order of the factorisation;
    `means` (m, n): matrix that averages nodal values over each cell.
    """

    mesh: Mesh
    pattern: SparsityPattern
    fronts: Fronts
    means: scipy.sparse.csr_array

    @classmethod
    def create(cls, mesh: Mesh) -> "NodalSystem":
        """Create the structure for a mesh whose arrays are not traced."""
        mesh = on_host(mesh)
        cells, nodes_per_cell = np.asarray(mesh.cells), mesh.cells.shape[1]
        pattern = SparsityPattern.from_elements([cells], size=mesh.num_points)
        fronts = find_fronts(pattern, np.asarray(mesh.points))
        row_starts = np.arange(0, cells.size + 1, nodes_per_cell)
        matrix_shape = mesh.num_cells, mesh.num_points
        mean_matrix = scipy.sparse.csr_array(
            (np.full(cells.size, 1 / nodes_per_cell), cells.ravel(), row_starts), shape=matrix_shape
        )
        return cls(mesh, on_host(pattern), fronts, mean_matrix)

    def assemble(
        self, elements: Float[np.ndarray, "..."], diagonal: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " e"]:
        """Assemble a matrix from the element matrices `elements` (m, k, k) and add `diagonal` (n,). Returns the entries
        (e,) in the pattern's order."""
        element_matrices: Any = elements
        matrix_values = np.array(self.pattern.assemble(element_matrices))
        matrix_values[: self.pattern.size] += diagonal
        return matrix_values

    def inverse(self, values: Any) -> Solve:
        """Factorise the matrix A whose entries in the pattern's order are `values`, and return a function that solves A
        X = B for columns B (n, k)."""
        front_factor = factorise_fronts(self.fronts, values)
        return lambda right_sides: apply_to_columns(front_factor.solve, right_sides, len(right_sides))


class FactorisedMatrix(NamedTuple):
    """A factorised matrix A = L Lᵀ. **Fields**: `solve`: function that returns A⁻¹ times columns (n, k); `half_solve`:
    function that returns L⁻¹ times columns, with the rows in the order of the factorisation."""

    solve: Solve
    half_solve: Solve


def factorise_matrix(plan: FactorisationPlan, fronts: Fronts, values: Any) -> FactorisedMatrix:
    """Factorise the matrix whose entries in the pattern's order are `values`: in NumPy, with the order `fronts`, or
    inside `jax.jit`, `jax.grad` and `jax.vmap`, with the compiled `plan`."""
    if not isinstance(values, np.ndarray):
        plan_factor = factorise(plan, values)
        return FactorisedMatrix(
            lambda right_sides: solve(plan, plan_factor, right_sides),
            lambda right_sides: half_solve(plan, plan_factor, right_sides),
        )
    host_factor = factorise_fronts(fronts, values)
    return FactorisedMatrix(
        lambda right_sides: apply_to_columns(host_factor.solve, right_sides, len(right_sides)),
        lambda right_sides: apply_to_columns(host_factor.half_solve, right_sides, len(right_sides)),
    )


def solve_columns(plan: FactorisationPlan, factor: Factor, columns: Any) -> Any:
    """Solutions of a factorised system for right-hand sides `columns` (n, k). NumPy arrays are split over all cores."""
    if not isinstance(columns, np.ndarray):
        return solve(plan, factor, columns)
    return apply_to_columns(functools.partial(solve, plan, factor), columns, plan.size, _COLUMNS_BY_PLAN)


def apply_to_columns(
    function: Callable[[Any], Any], columns: Any, rows: int, chunk_size: int = _COLUMNS_BY_FRONTS
) -> Any:
    """Apply `function` to blocks of `chunk_size` columns of a NumPy array (n, k), in parallel on all cores; returns
    (rows, k). `function` may itself call `apply_to_columns` with all its columns."""
    num_columns = columns.shape[1]
    result_columns = np.empty((rows, num_columns), columns.dtype)

    def apply_to_block(first_column: int) -> None:
        column_block = np.ascontiguousarray(columns[:, first_column : first_column + chunk_size])
        result_columns[:, first_column : first_column + chunk_size] = function(column_block)

    on_cores(apply_to_block, range(0, num_columns, chunk_size))
    return result_columns


# Diagonal entries of at least this fraction of the largest entry count as equal to it, as occurs in symmetric meshes.
# The first of these entries is the pivot, so that rounding errors do not decide.
_EQUAL_DIAGONAL_FRACTION = 1 - 1e-4


def pivoted_cholesky(
    diagonal: np.ndarray, column: Callable[[int], np.ndarray], *, tolerance: float, max_rank: int
) -> np.ndarray:
    """Low-rank factor S (m, n) with Γ ≈ S Sᵀ, for a covariance Γ with the `diagonal` (m,), of which the function
    `column` returns a column.

    `tolerance`: fraction of the trace of Γ that may be left out.
    """
    residual_diagonal = np.array(diagonal, float)
    allowed_residual = tolerance * residual_diagonal.sum()
    cholesky_rows = np.zeros((min(max_rank, residual_diagonal.size), residual_diagonal.size))
    for row_index in range(cholesky_rows.shape[0]):
        if residual_diagonal.sum() <= allowed_residual:
            return cholesky_rows[:row_index].T
        pivot_index = int(np.argmax(residual_diagonal >= _EQUAL_DIAGONAL_FRACTION * residual_diagonal.max()))
        row = column(pivot_index) - cholesky_rows[:row_index, pivot_index] @ cholesky_rows[:row_index]
        cholesky_rows[row_index] = row / np.sqrt(residual_diagonal[pivot_index])
        residual_diagonal = np.maximum(residual_diagonal - cholesky_rows[row_index] ** 2, 0)
        residual_diagonal[pivot_index] = 0
    return cholesky_rows.T


def traced_pivoted_cholesky(scaled: Float[Array, "m d"], *, tolerance: float, max_rank: int) -> Float[Array, "m k"]:
    """Low-rank factor, as from `pivoted_cholesky`, of Γ = exp(-|x_i - x_j|²) for traced points x = `scaled`. Returns k
    = min(m, max_rank) columns; columns that are not needed are zero.

    The derivative is that of Γ[:, P] L⁻ᵀ with Γ[P, P] = L Lᵀ for fixed pivots P. This derivative is exact except where
    the pivots change.
    """
    num_columns = min(max_rank, len(scaled))
    pivot_indices, num_pivots = _select_pivots(jax.lax.stop_gradient(scaled), tolerance, num_columns)
    is_within_rank = jnp.arange(num_columns) < num_pivots
    pivot_points = scaled[pivot_indices]
    pivot_columns = jnp.where(is_within_rank, jnp.exp(-_squared_distances(scaled, pivot_points)), 0)
    pivot_covariance = jnp.exp(-_squared_distances(pivot_points, pivot_points))
    lower_factor = jnp.linalg.cholesky(
        jnp.where(is_within_rank & is_within_rank[:, None], pivot_covariance, jnp.eye(num_columns))
    )
    return jax.scipy.linalg.solve_triangular(lower_factor, pivot_columns.T, lower=True).T


def _squared_distances(points, other_points):
    return ((points[:, None] - other_points) ** 2).sum(axis=-1)


def _select_pivots(scaled, tolerance: float, max_rank: int):
    """Indices (max_rank,) of the pivots of the Cholesky factorisation, and the number of pivots with which the
    tolerance is reached."""
    allowed_residual = tolerance * len(scaled)

    def is_incomplete(pivoting_state):
        num_pivots, _, _, residual_diagonal = pivoting_state
        return (num_pivots < max_rank) & (residual_diagonal.sum() > allowed_residual)

    def add_pivot(pivoting_state):
        num_pivots, pivot_indices, cholesky_rows, residual_diagonal = pivoting_state
        pivot_index = jnp.argmax(residual_diagonal >= _EQUAL_DIAGONAL_FRACTION * residual_diagonal.max())
        row = (
            jnp.exp(-((scaled - scaled[pivot_index]) ** 2).sum(axis=1)) - cholesky_rows[:, pivot_index] @ cholesky_rows
        )
        row = row / jnp.sqrt(residual_diagonal[pivot_index])
        residual_diagonal = jnp.maximum(residual_diagonal - row**2, 0).at[pivot_index].set(0)
        return (
            num_pivots + 1,
            pivot_indices.at[num_pivots].set(pivot_index),
            cholesky_rows.at[num_pivots].set(row),
            residual_diagonal,
        )

    initial_state = 0, jnp.zeros(max_rank, int), jnp.zeros((max_rank, len(scaled))), jnp.ones(len(scaled))
    num_pivots, pivot_indices, _, _ = jax.lax.while_loop(is_incomplete, add_pivot, initial_state)
    return pivot_indices, num_pivots


# Grid points per correlation length.
_GRID_POINTS_PER_LENGTH = 3
# Number of grid points along an axis from which the cubic interpolates.
_NUM_INTERPOLATION_POINTS = 4
# Maximum number of grid points, per point of the field and in total, up to which a grid saves time.
_MAX_GRID_RATIO, _MAX_GRID_POINTS = 8, 500_000
# Number of columns processed at a time, which limits the memory for values on the grid.
_COLUMNS_AT_ONCE = 64


class GriddedGaussian:
    """Covariance Γ_ij = exp(-|x_i - x_j|² / 2 length²) between points `positions` (m, d), approximated on a grid.

    `positions` and `length` in metres. `variance` (m,): diagonal of the approximated covariance, 1 except for
    interpolation errors.
    """

    def __init__(self, positions: Float[np.ndarray, "m d"], length: float):
        grid_spacing = length / _GRID_POINTS_PER_LENGTH
        lower_corner = positions.min(axis=0) - 1.5 * grid_spacing
        self._shape = tuple(
            int(num_axis_points)
            for num_axis_points in np.ceil((positions.max(axis=0) - lower_corner) / grid_spacing) + 2
        )
        grid_indices = [np.arange(num_axis_points) for num_axis_points in self._shape]
        self._axis_covariances = [
            np.exp(-((indices[:, None] - indices) ** 2) / (2 * _GRID_POINTS_PER_LENGTH**2)) for indices in grid_indices
        ]
        grid_positions = (positions - lower_corner) / grid_spacing
        self._interpolation_matrix = _cubic_interpolation(grid_positions, self._shape)
        cubic_weights, nodes = _cubic_weights(grid_positions), np.arange(_NUM_INTERPOLATION_POINTS)
        grid_covariance = np.exp(-((nodes[:, None] - nodes) ** 2) / (2 * _GRID_POINTS_PER_LENGTH**2))
        self.variance = np.prod(np.einsum("mdi,ij,mdj->md", cubic_weights, grid_covariance, cubic_weights), axis=1)

    @staticmethod
    def is_efficient(positions: Float[np.ndarray, "m d"], length: float) -> bool:
        """Whether the grid for points `positions` has few enough points to save time."""
        num_grid_points = np.ptp(positions, axis=0) / length * _GRID_POINTS_PER_LENGTH + 5
        return bool(np.prod(num_grid_points) < min(_MAX_GRID_RATIO * len(positions), _MAX_GRID_POINTS))

    def product(self, columns: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m k"]:
        """Product of the approximated covariance Γ with `columns`."""

        def product_of_block(column_block: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
            grid_values = (self._interpolation_matrix.T @ column_block).reshape(*self._shape, -1)
            for axis, axis_covariance in enumerate(self._axis_covariances):
                grid_values = np.moveaxis(np.tensordot(axis_covariance, grid_values, axes=(1, axis)), 0, axis)
            return self._interpolation_matrix @ grid_values.reshape(int(np.prod(self._shape)), -1)

        return apply_to_columns(product_of_block, columns, len(columns), _COLUMNS_AT_ONCE)


def _cubic_weights(positions: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d 4"]:
    """Weights of cubic Lagrange interpolation from the two grid points on either side, along every axis."""
    offset_from_node = positions - np.floor(positions) + 1
    nodes = np.arange(_NUM_INTERPOLATION_POINTS)
    return np.stack(
        [np.prod([(offset_from_node - j) / (i - j) for j in nodes if j != i], axis=0) for i in nodes], axis=-1
    )


def _cubic_interpolation(positions: Float[np.ndarray, "m d"], shape: tuple[int, ...]) -> scipy.sparse.csr_array:
    """Sparse matrix (m, grid points) that interpolates from a grid of the given `shape` to points `positions` (m, d),
    in units of the grid spacing."""
    first_nodes, nodes, axis_weights = (
        np.floor(positions).astype(int) - 1,
        np.arange(_NUM_INTERPOLATION_POINTS),
        _cubic_weights(positions),
    )
    product_weights, grid_indices = np.ones((len(positions), 1)), np.zeros((len(positions), 1), int)
    for axis, axis_size in enumerate(shape):
        product_weights = (product_weights[:, :, None] * axis_weights[:, axis, None, :]).reshape(len(positions), -1)
        grid_indices = (
            grid_indices[:, :, None] * axis_size + (first_nodes[:, axis, None] + nodes)[:, None, :]
        ).reshape(len(positions), -1)
    row_starts = np.arange(0, product_weights.size + 1, product_weights.shape[1])
    return scipy.sparse.csr_array(
        (product_weights.ravel(), grid_indices.ravel(), row_starts), shape=(len(positions), int(np.prod(shape)))
    )
