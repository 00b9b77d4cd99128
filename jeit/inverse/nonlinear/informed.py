"""Informed shapes: the combinations of a prior's shapes that data tell of, some dozens, instead of all of them.

They are the right singular vectors of the whitened Jacobian at the background, kept in single precision, which alters
an image by a millionth.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jeit.inverse.nonlinear.problem import Inversion
from jeit.inverse.prior.bases import DenseBasis
from jeit_solvers import symmetric_eigen
from jeit_solvers.engines import either_engine, host, namespace, on_device


def informed(inversion: Inversion, least: float, persistence: float = 0.0) -> Inversion:
    """The problem on shapes that its data tell more of than `least`, in standard deviations of the noise for one of the
    prior; as large as expected of a frame when the last one's share of `persistence` is known already.

    The rest of the image stays at the reference. For penalties that are standard normal.
    """
    squares, rows = (np.asarray(values) for values in _singular_values(inversion))
    kept = squares > max(least**2, 1e-12 * squares[-1])
    size = np.sqrt(_expected_variance(squares[kept], persistence) / squares[kept])
    shapes = host.asarray(jax.vmap(inversion.basis.expand)(jnp.asarray(size[:, None] * rows[kept])).T, np.float32)
    chosen = eqx.tree_at(lambda i: i.basis, inversion, DenseBasis(shapes))
    return chosen if namespace(inversion) is np else on_device(chosen)


@either_engine
def _singular_values(inversion: Inversion):
    """Of the image's whitened Jacobian at the background: squared singular values, right vectors times their roots."""
    xp = namespace(inversion)
    start = xp.zeros(inversion.num_coefficients)
    rows = inversion.data.whiten(inversion.linearise(start)[1])[:, : inversion.basis.num_coefficients]
    squares, left = symmetric_eigen(rows @ rows.T)
    return squares, left.T @ rows


def _expected_variance(strength, persistence: float):
    """Variance of a coefficient before its frame comes, p = a² p / (1 + s p) + 1 - a², for data of `strength` s."""
    fresh = 1 - persistence**2
    half = fresh * (1 - strength) / 2
    root = np.sqrt(half**2 + strength * fresh)
    return np.where(half > 0, fresh / (half + root), (root - half) / strength)
