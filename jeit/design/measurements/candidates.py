"""`Candidates`: information on the conductivity in each candidate measurement.

The conductivity is x = x₀ + S c with independent coefficients c of unit variance, so that its prior covariance is Γ =
SSᵀ. Measurement i reads J_i x with noise of standard deviation σ_i, which is f_iᵀc with f_i = SᵀJ_iᵀ / σ_i at unit
noise.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers.engines import has_values


class Candidates(eqx.Module):
    """Sensitivity of each of M candidate measurements, whitened by its noise and by the prior.

    **Fields**: `rows` (M, r), f_i of every candidate; `weight` (r, r), the matrix V that sums up a covariance.
    """

    rows: Float[Array, "M r"]
    weight: Float[Array, "r r"]

    @classmethod
    def create(
        cls, jacobian: ArrayLike, product: ArrayLike, noise: ArrayLike, *, weights: ArrayLike | None = None
    ) -> "Candidates":
        """Candidates with these `jacobian` and `noise` under a prior with covariance Γ.

        - `jacobian`: J (M, m) of all candidate measurements, as of `ForwardModel.jacobian`.
        - `product`: ΓJᵀ (m, M), a prior's `covariance_product` times the variance of the conductivity.
        - `noise`: standard deviation of each measurement, (M,) or one for all, in volts.
        - `weights`: W (m,) of the cells in "A"; their areas make it an integral. All 1 unless given.

        Exact for any prior, and meant for up to a few thousand candidates: it takes O(M³) operations. Works under
        `jit` and `vmap`. Raises `ValueError` for shapes that do not fit, values that are not finite, noise that is
        not positive and negative weights.
        """
        jacobian, product, noise, weights = _check(jacobian, product, noise, weights, ("cells", "measurements"))
        if product.shape != jacobian.shape[::-1]:
            raise ValueError(f"product has shape {product.shape}; ΓJᵀ has one column for each of {len(jacobian)} rows.")
        return _from_product(jacobian, product, noise, weights)

    @classmethod
    def from_factor(
        cls, jacobian: ArrayLike, factor: ArrayLike, noise: ArrayLike, *, weights: ArrayLike | None = None
    ) -> "Candidates":
        """Candidates under a prior with covariance SSᵀ, `factor` S (m, r); the rest as in `create`.

        For any number of candidates, such as all drives with all measurements. Where S omits small parts of the
        variance (a prior's `basis`), the information of precise measurements on these parts is omitted too, which
        overrates the share of few measurements. Raises `ValueError` for shapes or values that do not go together.
        """
        jacobian, factor, noise, weights = _check(jacobian, factor, noise, weights, ("cells", "coefficients"))
        return cls(jacobian @ factor / noise[:, None], factor.T @ (weights[:, None] * factor))

    @property
    def num_candidates(self) -> int:
        """Number of candidates, M."""
        return self.rows.shape[0]


def _check(jacobian, prior, noise, weights, shape: tuple[str, str]) -> tuple[Array, Array, Array, Array]:
    """Check the arguments of `Candidates` and return them as arrays of matching shapes; `prior` has this `shape`."""
    jacobian, prior = jnp.asarray(jacobian, float), jnp.asarray(prior, float)
    noise = jnp.asarray(noise, float)
    if jacobian.ndim != 2 or prior.ndim != 2 or jacobian.shape[1] != prior.shape[0]:
        raise ValueError(
            f"jacobian has shape {jacobian.shape} and the prior's matrix {prior.shape}; give (measurements, cells) and "
            f"({', '.join(shape)})."
        )
    weights = jnp.ones(len(prior)) if weights is None else jnp.asarray(weights, float)
    if noise.shape not in ((), jacobian.shape[:1]):
        raise ValueError(f"noise has shape {noise.shape}; give one number, or one for each of {len(jacobian)} rows.")
    if weights.shape != prior.shape[:1]:
        raise ValueError(f"weights has shape {weights.shape}; give one for each of the {len(prior)} cells.")
    named = {"jacobian": jacobian, "the prior's matrix": prior, "noise": noise, "weights": weights}
    for name, values in named.items():
        if not has_values(values):
            continue
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has NaN or infinite values; leave out measurements that have none.")
        if name == "noise" and np.min(values) <= 0:
            raise ValueError("noise must be positive: the standard deviation of each measurement, in volts.")
        if name == "weights" and np.min(values) < 0:
            raise ValueError("weights must not be negative.")
    return jacobian, prior, jnp.broadcast_to(noise, jacobian.shape[:1]), weights


@jax.jit
def _from_product(jacobian, product, noise, weights) -> Candidates:
    """Whitened rows from ΓJᵀ, in coefficients for which the data are independent: S = ΓJᵀ N^-½ U Λ^-½ where N^-½ JΓJᵀ
    N^-½ = UΛUᵀ, N the noise.

    SSᵀ is the part of Γ that the measurements depend on; they are independent of the rest.
    """
    kernel = jacobian @ product / (noise[:, None] * noise)
    values, vectors = jnp.linalg.eigh((kernel + kernel.T) / 2)
    seen = values > len(values) * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.sqrt(jnp.where(seen, values, 1))
    factor = product @ (vectors / noise[:, None] * jnp.where(seen, 1 / root, 0))
    return Candidates(vectors * jnp.where(seen, root, 0), factor.T @ (weights[:, None] * factor))
