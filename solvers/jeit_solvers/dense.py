"""Small dense systems in elementwise operations and matrix products, which batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Inexact

from jeit_solvers.engines import host, namespace

_BLOCK, _BLOCK_OF_LAPACK = 8, 128
_LARGEST_IN_HALVES = 128
_LARGE_BATCH = 16


def inverse_cholesky(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """W = L^-1 for the lower triangular L with A = L L^T, so that W A W^T = 1.

    Real matrices must be positive definite. Complex ones must be symmetric (not Hermitian) with a positive definite
    real part, which makes the elimination stable without pivoting (Higham, Math. Comp. 67, 1998). What cannot be
    factorised comes back as NaN.
    """
    if isinstance(matrices, np.ndarray):
        return _by_halves(matrices)
    if matrices.shape[-1] > _LARGEST_IN_HALVES:
        return _by_block_rows(matrices)
    return _by_halves(matrices)


def lower_cholesky(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    """L with A = L Lᵀ; NaN where there is none."""
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.cholesky(matrix)
    try:
        return host.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return host.full_like(matrix, np.nan)


def symmetric_eigen(matrix: Inexact[Array, "s s"]) -> tuple[Inexact[Array, " s"], Inexact[Array, "s s"]]:
    """Eigenvalues, ascending, and eigenvectors in columns; NaN where the matrix is not finite."""
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.eigh(matrix)
    if not np.isfinite(matrix).all():
        return host.full(len(matrix), np.nan), host.full_like(matrix, np.nan)
    return host.linalg.eigh(matrix)


def symmetric_inverse(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    """A^-1 of one matrix that `inverse_cholesky` takes; NaN where it is singular or not finite."""
    if not isinstance(matrix, np.ndarray):
        return _symmetric_inverse(matrix)
    if not np.isfinite(matrix).all():
        return host.full_like(matrix, np.nan)
    try:
        inverse = host.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return host.full_like(matrix, np.nan)
    return (inverse + inverse.T) / 2


@jax.custom_jvp
def _symmetric_inverse(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    inverse = inverse_cholesky(matrix[None])[0]
    return inverse.T @ inverse


@_symmetric_inverse.defjvp
def _symmetric_inverse_jvp(primals, tangents):
    inverse = _symmetric_inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def _by_lapack(matrices: Any) -> Any:
    """`inverse_cholesky` by LAPACK, of NumPy's arrays."""
    # Scaled to a diagonal of order one, by powers of two: LAPACK's inverse loses accuracy for rows of other orders.
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    scale = np.ldexp(1.0, -(np.frexp(diagonal)[1] // 2)).astype(matrices.dtype)
    try:
        lower = np.linalg.cholesky(matrices * scale[:, None] * scale[..., None])
        return np.tril(np.linalg.inv(lower)) * scale[:, None]
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)


def _transposed(matrices: Inexact[Array, "batch a b"]) -> Inexact[Array, "batch b a"]:
    return namespace(matrices).swapaxes(matrices, -1, -2)


def _inverse_square_root(pivot: Inexact[Array, "batch 1"]) -> Inexact[Array, "batch 1"]:
    xp = namespace(pivot)
    root = 1 / xp.sqrt(pivot) if xp is np else jax.lax.rsqrt(pivot)
    if not jnp.issubdtype(pivot.dtype, jnp.complexfloating):
        return root
    # A positive definite real part keeps the real part of every pivot positive; others are refused.
    return xp.where(pivot.real > 0, root, xp.nan)


def _by_halves(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Two by two blocks, each half in the same way: nearly all is matrix products, which LAPACK's inverse of a triangle
    is three to four times slower than. Large batches of the smallest blocks are worth unrolled code; few are better off
    with a loop of short vectors, which may be longer the fewer there are."""
    batch, size, _ = matrices.shape
    on_host = isinstance(matrices, np.ndarray)
    by_lapack = on_host and not np.iscomplexobj(matrices)
    block = _BLOCK_OF_LAPACK if by_lapack else _BLOCK if batch > 4 else 2 * _BLOCK
    if size <= block:
        if by_lapack:
            return _by_lapack(matrices)
        return _unrolled(matrices) if batch > _LARGE_BATCH or on_host else _row_by_row(matrices)
    half = block * -(-size // (2 * block))
    first = _by_halves(matrices[:, :half, :half])
    lower = matrices[:, half:, :half] @ _transposed(first)
    second = _by_halves(matrices[:, half:, half:] - lower @ _transposed(lower))
    corner = -(second @ (lower @ first))
    xp = namespace(matrices)
    top = xp.concatenate([first, xp.zeros((*first.shape[:-1], size - half), matrices.dtype)], axis=-1)
    return xp.concatenate([top, xp.concatenate([corner, second], axis=-1)], axis=-2)


def _unrolled(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """[A | 1] becomes [L^T | W] row by row."""
    size, xp = matrices.shape[-1], namespace(matrices)
    identity = xp.broadcast_to(xp.eye(size, dtype=matrices.dtype), matrices.shape)
    augmented = xp.concatenate([matrices, identity], axis=-1)
    rows = []
    for k in range(size):
        row = augmented[:, k]
        for previous in rows:
            row = row - previous[:, k : k + 1] * previous
        rows.append(row * _inverse_square_root(row[:, k : k + 1]))
    return xp.stack(rows, axis=1)[..., size:]


def _row_by_row(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """The same in a loop, each row less its products with all rows done."""
    size = matrices.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(size, dtype=matrices.dtype), matrices.shape)
    augmented = jnp.concatenate([matrices, identity], axis=-1)

    def next_row(done, k):
        weights = _transposed(jax.lax.dynamic_index_in_dim(done, k, axis=2))
        row = jax.lax.dynamic_index_in_dim(augmented, k, axis=1) - weights @ done
        row = row * _inverse_square_root(jax.lax.dynamic_slice_in_dim(row, k, 1, axis=2))
        return jax.lax.dynamic_update_slice_in_dim(done, row, k, axis=1), None

    done, _ = jax.lax.scan(next_row, jnp.zeros_like(augmented), jnp.arange(size))
    return done[..., size:]


def _by_block_rows(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """A loop over blocks of rows, W one block at a time: with G = A_k W^T, the new diagonal block is
    A_kk - G G^T = (W_kk^T W_kk)^-1 and the new rows are W_kk (E_k - G W). One compiled body, whatever the size."""
    size, dtype = matrices.shape[-1], matrices.dtype
    block = 32 if size <= 256 else 64
    padding = -size % block
    if padding:
        matrices = jnp.pad(matrices, [(0, 0), (0, padding), (0, padding)])
        matrices = matrices + jnp.asarray(np.diag(np.arange(size + padding) >= size), dtype)
    identity = jnp.eye(size + padding, dtype=dtype)

    def next_rows(inverse, number):
        start = number * block
        rows = jax.lax.dynamic_slice_in_dim(matrices, start, block, axis=1)
        lower = rows @ _transposed(inverse)
        pivot = jax.lax.dynamic_slice_in_dim(rows, start, block, axis=2) - lower @ _transposed(lower)
        remainder = jax.lax.dynamic_slice_in_dim(identity, start, block, axis=0) - lower @ inverse
        new = _by_halves(pivot) @ remainder
        return jax.lax.dynamic_update_slice_in_dim(inverse, new, start, axis=1), None

    inverse, _ = jax.lax.scan(next_rows, jnp.zeros_like(matrices), jnp.arange((size + padding) // block))
    return inverse[:, :size, :size]


# The cost at a point, and a function of the damping that gives a step from there with its slope and curvature.
QuadraticModel = tuple[Float[Array, ""], Callable[[Any], tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]]]]


def ridge_model(
    residual: Float[Array, " M"],
    jacobian: Float[Array, "M n"],
    point: Float[Array, " n"],
    covariance: Float[Array, "M M"],
    precision: Float[Array, "M M"],
) -> QuadraticModel:
    """The cost ½ rᵀ C⁻¹ r + ½ ‖c‖² and its `step`, for `Descent`; `covariance` C of the data, and its inverse."""
    if not isinstance(jacobian, np.ndarray):
        jacobian = jax.lax.optimization_barrier(jacobian)
    weighted = precision @ residual
    cost = 0.5 * (residual @ weighted + point @ point)

    def step(damping):
        direction = ridge_step(jacobian, residual, point, covariance, precision, 1 + damping)
        across = jacobian @ direction
        slope = weighted @ across + point @ direction
        return direction, slope, across @ precision @ across + direction @ direction

    return cost, step


def ridge_step(
    jacobian: Float[Array, "M n"],
    residual: Float[Array, " M"],
    point: Float[Array, " n"],
    covariance: Float[Array, "M M"],
    precision: Float[Array, "M M"],
    ridge: Float[Array, ""] | float = 1.0,
) -> Float[Array, " n"]:
    """The δ of (JᵀC⁻¹J + ridge · 1) δ = -(JᵀC⁻¹r + c), by a system of min(M, n) unknowns.

    With fewer data than unknowns, δ = -c / ridge - Jᵀ (JJᵀ + ridge · C)⁻¹ (r - J c / ridge), by Woodbury's identity,
    arranged so that no large terms cancel however small the ridge is beside J.
    """
    rows, columns = jacobian.shape
    if columns <= rows:
        weighted = jacobian.T @ precision
        identity = np.eye(columns, dtype=jacobian.dtype)
        return -solve_definite(weighted @ jacobian + ridge * identity, weighted @ residual + point)
    inner = solve_definite(jacobian @ jacobian.T + ridge * covariance, residual - jacobian @ point / ridge)
    return -point / ridge - inner @ jacobian


def solve_definite(matrix: Float[Array, "n n"], vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """A⁻¹ b for a dense symmetric positive definite A; NaN for one that is not."""
    if isinstance(matrix, np.ndarray):
        try:
            return scipy.linalg.cho_solve(
                scipy.linalg.cho_factor(matrix, check_finite=False), vector, check_finite=False
            )
        except np.linalg.LinAlgError:
            return np.full_like(vector, np.nan)  # pyright: ignore[reportReturnType]
    inverse = inverse_cholesky(matrix[None])[0]
    return inverse.T @ (inverse @ vector)
