"""The dense inverse Cholesky factor, by every algorithm that it selects by size and batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit_solvers.dense import inverse_cholesky

# Row by row; in halves, unrolled; in halves, row by row; halves of halves; block rows of either width, with padding.
ROUTES = [(1, 1), (3, 7), (40, 13), (2, 70), (10, 70), (1, 130), (1, 300)]
QUICK = [*((route, np.float64) for route in ROUTES), ((2, 70), np.complex128)]
SLOW = [(route, dtype) for route in ROUTES for dtype in (np.float32, np.complex128) if (route, dtype) not in QUICK]


@pytest.mark.parametrize(("route", "dtype"), [*QUICK, *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)])
def test_inverse_factor(route, dtype):
    batch, size = route
    rng = np.random.default_rng(size)
    square = rng.standard_normal((batch, size, size))
    matrices = square @ square.transpose(0, 2, 1) + size * np.eye(size)
    if dtype == np.complex128:
        matrices = matrices + 0.5j * (square + square.transpose(0, 2, 1))
    matrices = matrices.astype(dtype)
    inverse = np.asarray(jax.jit(inverse_cholesky)(jnp.asarray(matrices)))
    assert inverse.dtype == dtype
    np.testing.assert_array_equal(inverse, np.tril(inverse))
    # The condition numbers are below 10, so that the error is a few units of roundoff for each row.
    tolerance = 10 * size * np.finfo(dtype).eps
    unity = inverse @ matrices @ inverse.transpose(0, 2, 1)
    np.testing.assert_allclose(unity, np.broadcast_to(np.eye(size), unity.shape), rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("batch", "size", "dtype"),
    [
        (40, 12, np.float64),
        (2, 13, np.complex128),
        pytest.param(40, 12, np.complex128, marks=pytest.mark.slow),
        pytest.param(2, 13, np.float64, marks=pytest.mark.slow),
    ],
)
def test_indefinite_matrices_give_nan_without_affecting_others(batch, size, dtype):
    matrices = np.broadcast_to(np.eye(size, dtype=dtype), (batch, size, size)).copy()
    matrices[1, -1, -1] = -1
    inverse = jax.jit(inverse_cholesky)(jnp.asarray(matrices))
    assert not np.isfinite(inverse[1]).all()
    np.testing.assert_array_equal(inverse[0], np.eye(size))
