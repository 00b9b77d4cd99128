"""Low-rank factors of a covariance: traced factors against those of NumPy, and both against the covariance."""

import jax
import numpy as np

from jeit.inverse.prior.linear_algebra import pivoted_cholesky, traced_pivoted_cholesky


def test_factors_reproduce_the_covariance_and_equal_traced_ones():
    places = np.random.default_rng(0).uniform(0, 2, (30, 2))
    covariance = np.exp(-((places[:, None] - places) ** 2).sum(axis=-1))
    known = pivoted_cholesky(np.ones(30), lambda one: covariance[one], tolerance=1e-10, max_rank=30)
    np.testing.assert_allclose(known @ known.T, covariance, atol=1e-8)
    traced = np.asarray(jax.jit(lambda x: traced_pivoted_cholesky(x, tolerance=1e-10, max_rank=30))(places))
    np.testing.assert_allclose(traced[:, : known.shape[1]], known, atol=1e-6)
    assert not traced[:, known.shape[1] :].any()
