"""Batched inverse Cholesky factors of small dense matrices, in elementwise operations and matrix products only.

Why not LAPACK through `jax.lax.linalg`: its small-matrix routines are several times slower than a matrix product of
the same size; a triangular solve may start BLAS threads that fight with XLA's own; and in jaxlib 0.10 two batched
LAPACK calls that run side by side in one program can wait for each other for ever when the thread pool is as small
as two. Matrix products have none of these troubles, and the same code serves complex symmetric matrices.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

_BLOCK = 8
_LARGEST_IN_HALVES = 128
_LARGE_BATCH = 16


def inverse_cholesky(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """W = L^-1 for the lower triangular L with A = L L^T, so that W A W^T = 1.

    Real matrices must be positive definite. Complex ones must be symmetric (not Hermitian) with a positive definite
    real part, which makes the elimination stable without pivoting (Higham, Math. Comp. 67, 1998). What cannot be
    factorised comes back as NaN.
    """
    if matrices.shape[-1] > _LARGEST_IN_HALVES:
        return _by_block_rows(matrices)
    return _by_halves(matrices)


@jax.custom_jvp
def symmetric_inverse(matrix: Inexact[Array, "s s"]) -> Inexact[Array, "s s"]:
    """A^-1 of one matrix that `inverse_cholesky` takes."""
    inverse = inverse_cholesky(matrix[None])[0]
    return inverse.T @ inverse


@symmetric_inverse.defjvp
def _symmetric_inverse_jvp(primals, tangents):
    inverse = symmetric_inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def _transposed(matrices: Inexact[Array, "batch a b"]) -> Inexact[Array, "batch b a"]:
    return jnp.swapaxes(matrices, -1, -2)


def _inverse_square_root(pivot: Inexact[Array, "batch 1"]) -> Inexact[Array, "batch 1"]:
    if not jnp.issubdtype(pivot.dtype, jnp.complexfloating):
        return jax.lax.rsqrt(pivot)
    # A positive definite real part keeps the real part of every pivot positive; others are refused.
    return jnp.where(pivot.real > 0, jax.lax.rsqrt(pivot), jnp.nan)


def _by_halves(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """Two by two blocks, each half in the same way. Large batches of the smallest blocks are worth unrolled code; few
    are better off with a loop of short vectors, which may be longer the fewer there are."""
    batch, size, _ = matrices.shape
    block = _BLOCK if batch > 4 else 2 * _BLOCK
    if size <= block:
        return _unrolled(matrices) if batch > _LARGE_BATCH else _row_by_row(matrices)
    half = block * -(-size // (2 * block))
    first = _by_halves(matrices[:, :half, :half])
    lower = matrices[:, half:, :half] @ _transposed(first)
    second = _by_halves(matrices[:, half:, half:] - lower @ _transposed(lower))
    corner = -(second @ (lower @ first))
    top = jnp.concatenate([first, jnp.zeros((*first.shape[:-1], size - half), matrices.dtype)], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([corner, second], axis=-1)], axis=-2)


def _unrolled(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """[A | 1] becomes [L^T | W] row by row."""
    size = matrices.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(size, dtype=matrices.dtype), matrices.shape)
    augmented = jnp.concatenate([matrices, identity], axis=-1)
    rows = []
    for k in range(size):
        row = augmented[:, k]
        for previous in rows:
            row = row - previous[:, k : k + 1] * previous
        rows.append(row * _inverse_square_root(row[:, k : k + 1]))
    return jnp.stack(rows, axis=1)[..., size:]


def _row_by_row(matrices: Inexact[Array, "batch s s"]) -> Inexact[Array, "batch s s"]:
    """The same in a loop, and in place: row j holds W up to the diagonal and L^T right of it."""
    column = jnp.arange(matrices.shape[-1])
    lower = column <= column[:, None]

    def next_row(done, k):
        weights = jax.lax.dynamic_index_in_dim(done, k, axis=2)
        row = jax.lax.dynamic_index_in_dim(matrices, k, axis=1, keepdims=False)
        right = column >= k
        row = jnp.where(right, row, 0) - jnp.sum(jnp.where(lower | right, weights * done, 0), axis=1)
        scale = _inverse_square_root(jax.lax.dynamic_slice_in_dim(row, k, 1, axis=1))
        row = jnp.where(column == k, scale, row * scale)
        return jax.lax.dynamic_update_index_in_dim(done, row, k, axis=1), None

    done, _ = jax.lax.scan(next_row, jnp.zeros_like(matrices), column)
    return jnp.where(lower, done, 0)


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
