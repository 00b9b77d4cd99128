"""Small dense systems, solved by elementwise operations and matrix products, which support batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Inexact

from jeit_solvers.engines import host, namespace

# Sizes of the smallest blocks of recursive inversion, without and with LAPACK.
_BLOCK_SIZE, _LAPACK_BLOCK_SIZE = 8, 128
# Number of smallest blocks that a compiled loop over rows may span. It runs about as fast as recursion down to one
# block, and compiles in half the time.
_MAX_BLOCKS_OF_LOOP = 4
# Maximum size of compiled matrices that are inverted by recursion.
_MAX_RECURSIVE_SIZE = 128
# Number of matrices in a batch above which unrolled code is used.
_MIN_UNROLLED_BATCH = 32


def inverse_cholesky(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Inverse Cholesky factor W = L^-1 of each matrix A, for the lower triangular L with A = L L^T, so that W A W^T =
    1.

    Real matrices must be positive definite. Complex matrices must be symmetric (not Hermitian) with a positive definite
    real part, which makes elimination without pivoting stable (Higham, Math. Comp. 67, 1998). The result is NaN for
    matrices that cannot be factorised.
    """
    if isinstance(matrices, np.ndarray):
        return _inverse_cholesky_recursive(matrices)
    if matrices.shape[-1] > _MAX_RECURSIVE_SIZE:
        return _inverse_cholesky_by_block_rows(matrices)
    return _inverse_cholesky_recursive(matrices)


def lower_cholesky(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    """Cholesky factor of a matrix A: the lower triangular L with A = L Lᵀ; NaN if A is not positive definite.

    **Arguments:**

    - `matrix` (s, s): A, symmetric positive definite.

    **Example:**

    ```python
    lower = lower_cholesky(dense)
    ```
    """
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.cholesky(matrix)
    try:
        return host.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return host.full_like(matrix, np.nan)


def symmetric_eigen(matrix: Inexact[Array, "s s"]) -> tuple[Inexact[Array, " s"], Inexact[Array, "s s"]]:
    """Eigenvalues of a symmetric matrix in ascending order, and its eigenvectors in columns; NaN if the matrix is not
    finite.

    **Arguments:**

    - `matrix` (s, s): symmetric, or Hermitian.

    **Example:**

    ```python
    eigenvalues, eigenvectors = symmetric_eigen(dense)
    ```
    """
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.eigh(matrix)
    if not np.isfinite(matrix).all():
        return host.full(len(matrix), np.nan), host.full_like(matrix, np.nan)
    return host.linalg.eigh(matrix)


def symmetric_inverse(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    """Inverse of a single symmetric matrix; NaN if the matrix is singular or not finite.

    **Arguments:**

    - `matrix` (s, s): a matrix of the kind that `inverse_cholesky` accepts.

    **Example:**

    ```python
    symmetric_inverse(dense)
    ```
    """
    if not isinstance(matrix, np.ndarray):
        return _symmetric_inverse(matrix)
    if not np.isfinite(matrix).all():
        return host.full_like(matrix, np.nan)
    try:
        host_inverse = host.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return host.full_like(matrix, np.nan)
    return (host_inverse + host_inverse.T) / 2


@jax.custom_jvp
def _symmetric_inverse(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    inverse_factor = inverse_cholesky(matrix[None])[0]
    return inverse_factor.T @ inverse_factor


@_symmetric_inverse.defjvp
def _symmetric_inverse_jvp(primals, tangents):
    matrix_inverse = _symmetric_inverse(*primals)
    return matrix_inverse, -matrix_inverse @ tangents[0] @ matrix_inverse


def _inverse_cholesky_lapack(matrices: Any) -> Any:
    """Inverse Cholesky factors of NumPy arrays, as defined in `inverse_cholesky`, computed by LAPACK."""
    # Scale the diagonal to order one by powers of two: LAPACK's inverse is less accurate for rows of different orders
    # of magnitude.
    matrix_diagonals = np.diagonal(matrices, axis1=-2, axis2=-1)
    diagonal_scales = np.ldexp(1.0, -(np.frexp(matrix_diagonals)[1] // 2)).astype(matrices.dtype)
    try:
        lower_factor = np.linalg.cholesky(matrices * diagonal_scales[:, None] * diagonal_scales[..., None])
        return np.tril(np.linalg.inv(lower_factor)) * diagonal_scales[:, None]
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)


def _transpose(matrices: Inexact[Array, "batch a b"]) -> Inexact[Array, "batch b a"]:
    return namespace(matrices).swapaxes(matrices, -1, -2)


def _inverse_square_root(pivot: Inexact[Array, "batch 1"]) -> Inexact[Array, "batch 1"]:
    xp = namespace(pivot)
    inverse_root = 1 / xp.sqrt(pivot) if xp is np else jax.lax.rsqrt(pivot)
    if not jnp.issubdtype(pivot.dtype, jnp.complexfloating):
        return inverse_root
    # With a positive definite real part of the matrix, the real part of every pivot is positive; other matrices yield
    # NaN.
    return xp.where(pivot.real > 0, inverse_root, xp.nan)


def _inverse_cholesky_recursive(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Inverse Cholesky factors, as defined in `inverse_cholesky`, computed by recursion on two by two blocks. Nearly
    all operations are matrix products, which are three to four times faster than LAPACK's inverse of a triangular
    matrix. The smallest blocks are inverted by unrolled code in large batches. In small batches a loop over short
    vectors inverts larger blocks, the larger the fewer the matrices."""
    batch_size, matrix_size, _ = matrices.shape
    is_numpy_array = isinstance(matrices, np.ndarray)
    is_lapack_used = is_numpy_array and not np.iscomplexobj(matrices)
    block_size = _LAPACK_BLOCK_SIZE if is_lapack_used else _BLOCK_SIZE if batch_size > 4 else 2 * _BLOCK_SIZE
    is_loop_used = not is_numpy_array and batch_size <= _MIN_UNROLLED_BATCH
    if matrix_size <= (_MAX_BLOCKS_OF_LOOP * block_size if is_loop_used else block_size):
        if is_lapack_used:
            return _inverse_cholesky_lapack(matrices)
        return _inverse_cholesky_by_rows(matrices) if is_loop_used else _inverse_cholesky_unrolled(matrices)
    first_size = block_size * -(-matrix_size // (2 * block_size))
    first_inverse = _inverse_cholesky_recursive(matrices[:, :first_size, :first_size])
    lower_block = matrices[:, first_size:, :first_size] @ _transpose(first_inverse)
    second_inverse = _inverse_cholesky_recursive(
        matrices[:, first_size:, first_size:] - lower_block @ _transpose(lower_block)
    )
    lower_left = -(second_inverse @ (lower_block @ first_inverse))
    xp = namespace(matrices)
    upper_rows = xp.concatenate(
        [first_inverse, xp.zeros((*first_inverse.shape[:-1], matrix_size - first_size), matrices.dtype)], axis=-1
    )
    return xp.concatenate([upper_rows, xp.concatenate([lower_left, second_inverse], axis=-1)], axis=-2)


def _inverse_cholesky_unrolled(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Inverse Cholesky factors by elimination of [A | 1] to [L^T | W], row by row, in unrolled code."""
    matrix_size, xp = matrices.shape[-1], namespace(matrices)
    identity_matrices = xp.broadcast_to(xp.eye(matrix_size, dtype=matrices.dtype), matrices.shape)
    augmented_matrices = xp.concatenate([matrices, identity_matrices], axis=-1)
    finished_rows = []
    for k in range(matrix_size):
        current_row = augmented_matrices[:, k]
        for previous_row in finished_rows:
            current_row = current_row - previous_row[:, k : k + 1] * previous_row
        finished_rows.append(current_row * _inverse_square_root(current_row[:, k : k + 1]))
    return xp.stack(finished_rows, axis=1)[..., matrix_size:]


def _inverse_cholesky_by_rows(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Inverse Cholesky factors by the elimination of `_inverse_cholesky_unrolled` in a loop, in which each row is
    reduced by all previous rows in one product."""
    matrix_size = matrices.shape[-1]
    identity_matrices = jnp.broadcast_to(jnp.eye(matrix_size, dtype=matrices.dtype), matrices.shape)
    augmented_matrices = jnp.concatenate([matrices, identity_matrices], axis=-1)

    def next_row(finished_rows, k):
        row_weights = _transpose(jax.lax.dynamic_index_in_dim(finished_rows, k, axis=2))
        current_row = jax.lax.dynamic_index_in_dim(augmented_matrices, k, axis=1) - row_weights @ finished_rows
        current_row = current_row * _inverse_square_root(jax.lax.dynamic_slice_in_dim(current_row, k, 1, axis=2))
        return jax.lax.dynamic_update_slice_in_dim(finished_rows, current_row, k, axis=1), None

    finished_rows, _ = jax.lax.scan(next_row, jnp.zeros_like(augmented_matrices), jnp.arange(matrix_size))
    return finished_rows[..., matrix_size:]


def _inverse_cholesky_by_block_rows(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Inverse Cholesky factor W, as defined in `inverse_cholesky`, computed by a loop over blocks k of rows of W. Let
    A_k and E_k be the rows k of A and of the identity, and G = A_k W^T. The new diagonal block satisfies A_kk - G G^T =
    (W_kk^T W_kk)^-1, and the new rows are W_kk (E_k - G W). The compiled loop body does not depend on the size."""
    matrix_size, dtype = matrices.shape[-1], matrices.dtype
    block_size = 32 if matrix_size <= 256 else 64
    num_padding_rows = -matrix_size % block_size
    if num_padding_rows:
        matrices = jnp.pad(matrices, [(0, 0), (0, num_padding_rows), (0, num_padding_rows)])
        matrices = matrices + jnp.asarray(np.diag(np.arange(matrix_size + num_padding_rows) >= matrix_size), dtype)
    identity_matrix = jnp.eye(matrix_size + num_padding_rows, dtype=dtype)

    def next_rows(inverse_factors, block_index):
        first_row = block_index * block_size
        block_rows = jax.lax.dynamic_slice_in_dim(matrices, first_row, block_size, axis=1)
        lower_block = block_rows @ _transpose(inverse_factors)
        pivot_block = jax.lax.dynamic_slice_in_dim(
            block_rows, first_row, block_size, axis=2
        ) - lower_block @ _transpose(lower_block)
        identity_rows = (
            jax.lax.dynamic_slice_in_dim(identity_matrix, first_row, block_size, axis=0) - lower_block @ inverse_factors
        )
        new_rows = _inverse_cholesky_recursive(pivot_block) @ identity_rows
        return jax.lax.dynamic_update_slice_in_dim(inverse_factors, new_rows, first_row, axis=1), None

    inverse_factors, _ = jax.lax.scan(
        next_rows, jnp.zeros_like(matrices), jnp.arange((matrix_size + num_padding_rows) // block_size)
    )
    return inverse_factors[:, :matrix_size, :matrix_size]


# The cost at a point, and a function that returns, for a given damping, a step from this point with the slope and
# curvature of the cost along the step.
QuadraticModel = tuple[Float[Array, ""], Callable[[Any], tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]]]]


def ridge_model(
    residual: Float[Array, " M"],
    jacobian: Float[Array, "M n"],
    point: Float[Array, " n"],
    covariance: Float[Array, "M M"],
    precision: Float[Array, "M M"],
) -> QuadraticModel:
    """Quadratic model, for `Descent`, of the cost ½ rᵀ C⁻¹ r + ½ ‖c‖² with the residual r: returns the cost at a point
    c, and the function `step`.

    **Arguments:**

    - `residual` (M,): r at the point.
    - `jacobian` (M, n): derivative of r with respect to c.
    - `point` (n,): c.
    - `covariance` (M, M): covariance C of the data.
    - `precision` (M, M): C⁻¹.

    **Example:**

    ```python
    cost, step = ridge_model(jnp.ones(5), jnp.eye(5), jnp.zeros(5), jnp.eye(5), jnp.eye(5))
    direction, slope, curvature = step(0.0)
    ```
    """
    if not isinstance(jacobian, np.ndarray):
        jacobian = jax.lax.optimization_barrier(jacobian)
    weighted_residual = precision @ residual
    ridge_cost = 0.5 * (residual @ weighted_residual + point @ point)

    def step_for_damping(damping):
        step_direction = ridge_step(jacobian, residual, point, covariance, precision, 1 + damping)
        data_change = jacobian @ step_direction
        cost_slope = weighted_residual @ data_change + point @ step_direction
        return step_direction, cost_slope, data_change @ precision @ data_change + step_direction @ step_direction

    return ridge_cost, step_for_damping


def ridge_step(
    jacobian: Float[Array, "M n"],
    residual: Float[Array, " M"],
    point: Float[Array, " n"],
    covariance: Float[Array, "M M"],
    precision: Float[Array, "M M"],
    ridge: Float[Array, ""] | float = 1.0,
) -> Float[Array, " n"]:
    """Solve (JᵀC⁻¹J + ridge · 1) δ = -(JᵀC⁻¹r + c) for δ, by a linear system of min(M, n) unknowns.

    With fewer data than unknowns, δ = -c / ridge - Jᵀ (JJᵀ + ridge · C)⁻¹ (r - J c / ridge) by Woodbury's identity. The
    formula is evaluated without cancellation of large terms, even if the ridge is small relative to J.

    **Arguments:**

    - `jacobian` (M, n): J.
    - `residual` (M,): r.
    - `point` (n,): c.
    - `covariance` (M, M): covariance C of the data.
    - `precision` (M, M): C⁻¹.
    - `ridge`: weight of the penalty ½ ‖c‖².

    **Example:**

    ```python
    change = ridge_step(jnp.eye(5), jnp.ones(5), jnp.zeros(5), jnp.eye(5), jnp.eye(5))
    ```
    """
    num_data, num_unknowns = jacobian.shape
    if num_unknowns <= num_data:
        weighted_transpose = jacobian.T @ precision
        identity_matrix = np.eye(num_unknowns, dtype=jacobian.dtype)
        return -solve_definite(
            weighted_transpose @ jacobian + ridge * identity_matrix, weighted_transpose @ residual + point
        )
    dual_solution = solve_definite(jacobian @ jacobian.T + ridge * covariance, residual - jacobian @ point / ridge)
    return -point / ridge - dual_solution @ jacobian


def solve_definite(matrix: Float[Array, "n n"], vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution A⁻¹ b for a dense symmetric positive definite A; NaN if A is not positive definite.

    **Arguments:**

    - `matrix` (n, n): A.
    - `vector` (n,): b.

    **Example:**

    ```python
    solve_definite(dense, jnp.ones(5))
    ```
    """
    if isinstance(matrix, np.ndarray):
        try:
            return scipy.linalg.cho_solve(
                scipy.linalg.cho_factor(matrix, check_finite=False), vector, check_finite=False
            )
        except np.linalg.LinAlgError:
            return np.full_like(vector, np.nan)  # pyright: ignore[reportReturnType]
    inverse_factor = inverse_cholesky(matrix[None])[0]
    return inverse_factor.T @ (inverse_factor @ vector)
