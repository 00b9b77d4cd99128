"""Uncertainty: what the data leave open about an image, by the Laplace approximation.

At the solution ĉ of ½ rᵀGr + ½‖c‖² the posterior is taken for the Gaussian of the linearised problem, with covariance

    Σ = (1 + JᵀGJ)⁻¹ = 1 - Jᵀ(JJᵀ + C)⁻¹J,

exact where voltages are linear in c, and computed in the space of the data. Tarantola, Inverse Problem Theory (SIAM
2005), ch. 3; Kaipio and Somersalo, Statistical and Computational Inverse Problems (Springer 2005), ch. 3.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float, PRNGKeyArray

from jeit.arguments import check_has_values, check_key, check_kind
from jeit.inverse.nonlinear.problem import Inversion
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.mesh import measures
from jeit_solvers import Status
from jeit_solvers.engines import either_engine, has_values, namespace, on_host

# Rows of an image's size at a time.
_ROWS = 32


class Posterior(eqx.Module):
    """What is known of an image after the data: a Gaussian of its coefficients, with mean ĉ. Made by `posterior`.

    **Fields**: `inversion`; `coefficients` ĉ (n,); `jacobian` J (r, n) there; `root` W (r, r) with WᵀW = (JJᵀ + C)⁻¹.
    """

    inversion: Inversion
    coefficients: Float[Array, " n"]
    jacobian: Float[Array, "r n"]
    root: Float[Array, "r r"]

    def standard_deviation(self) -> Float[Array, " m"]:
        """Of the conductivity of every cell, S/m (2-D: S), to first order in the link."""
        estimate, deviation = _estimate(self)
        return self.inversion.link.slope(estimate) * deviation

    def credible_interval(self, probability: float = 0.95) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Lower and upper conductivity of every cell that hold it with this probability, one cell at a time.

        Gaussian on the link's scale, so that bounds and positivity are kept. Raises `ValueError` for a probability that
        is not between 0 and 1.
        """
        if not 0 < probability < 1:
            raise ValueError(f"probability must lie between 0 and 1; it is {probability}.")
        reach = scipy.special.ndtri(0.5 + probability / 2)
        estimate, deviation = _estimate(self)
        link = self.inversion.link
        return link.conductivity(estimate - reach * deviation), link.conductivity(estimate + reach * deviation)

    def region(self, cells) -> tuple[float | Float[Array, ""], float | Float[Array, ""]]:
        """Mean conductivity of some cells, weighted by area, and its standard deviation, S/m (2-D: S).

        `cells`: booleans (m,) or indices. Raises `ValueError` for none, or cells that are not there, or traced.
        """
        measure = on_host(measures(self.inversion.model.mesh))
        chosen = np.zeros(measure.size, bool)
        check_has_values("cells", cells, "the region is made of", "choose them outside")
        indices = np.asarray(cells)
        if (indices.dtype == bool and indices.shape != chosen.shape) or indices.dtype.kind not in "iub":
            raise ValueError(f"cells must be booleans ({measure.size},), or indices of cells.")
        if indices.dtype != bool and indices.size and (indices.min() < 0 or indices.max() >= measure.size):
            raise ValueError(f"cells must be indices from 0 to {measure.size - 1}.")
        chosen[indices] = True
        if not chosen.any():
            raise ValueError("cells: none is chosen; give at least one.")
        weight = jnp.where(chosen, measure, 0) / measure[chosen].sum()
        mean, deviation = _weighted(self, weight)
        return (float(mean), float(deviation)) if has_values(mean) else (mean, deviation)

    def unknowns(self) -> dict[str, Float[Array, " k"]]:
        """Standard deviations of what was estimated along with the conductivity, in the units of
        `Reconstruction.unknowns`; to first order where a logarithm was estimated."""
        model, values = self.inversion.model, self.inversion.values(self.coefficients)
        start = self.inversion.basis.num_coefficients
        deviation = jnp.sqrt(1 - jnp.sum((self.root @ self.jacobian) ** 2, axis=0))
        found = {}
        for unknown, value in zip(self.inversion.unknowns, values, strict=True):
            ones = jnp.ones_like(value)
            _, slope = jax.jvp(lambda values, one=unknown: one.quantity(model, values), (value,), (ones,))
            found[type(unknown).__name__] = slope * unknown.deviation * deviation[start : start + unknown.size]
            start += unknown.size
        return found

    def sample(self, key: PRNGKeyArray, number: int) -> Float[Array, "number m"]:
        """Conductivities (number, m) drawn from the posterior, S/m (2-D: S). Raises `ValueError` for what is
        no key."""
        check_key(key)
        return _sample(self, key, number)


def posterior(reconstruction: Reconstruction) -> Posterior:
    """The posterior round a reconstruction with a smooth prior, by the Laplace approximation.

    Its standard deviations are as honest as the noise, the prior and the forward model are: with λ = 1 and a prior of
    the right variance they hold at their nominal rate; λ = 2 says that the image varies half as much. Raises
    `ValueError` for total variation and bounded solvers, whose posterior is not near a Gaussian, and for a
    reconstruction that has failed, or is none.
    """
    check_kind("reconstruction", reconstruction, Reconstruction, "what reconstruct has returned")
    if not reconstruction.inversion.penalty.is_standard_normal:
        raise ValueError(
            "posterior: only for smooth priors (Tikhonov, Noser, Laplace, Gaussian) and unbounded solvers; total "
            "variation and bounds have no Gaussian posterior."
        )
    if has_values(reconstruction.outcome) and Status.FAILED.number in np.ravel(reconstruction.outcome):
        raise ValueError(f"posterior: the reconstruction failed. {reconstruction.reason}")
    inversion, coefficients = reconstruction.inversion, reconstruction.coefficients
    if not (has_values(inversion, coefficients) and inversion.model.mesh.dimension == 3):
        return _posterior(inversion, coefficients)
    # Of a solid body compiled programs would hold the Jacobian several times over.
    with np.errstate(all="ignore"):
        known, ended = on_host((inversion, coefficients))
        _, jacobian = known.linearise(ended)
        root = scipy.linalg.inv(np.linalg.cholesky(jacobian @ jacobian.T + known.data.covariance))
    return Posterior(known, ended, jacobian, root)


@eqx.filter_jit
def _posterior(inversion: Inversion, coefficients) -> Posterior:
    _, jacobian = inversion.linearise(coefficients)
    lower = jnp.linalg.cholesky(jacobian @ jacobian.T + inversion.data.covariance)
    root = jax.scipy.linalg.solve_triangular(lower, jnp.eye(len(lower)), lower=True)
    return Posterior(inversion, coefficients, jacobian, root)


@either_engine
def _estimate(posterior: Posterior):
    """x at the solution, background unknowns included, and its standard deviation, per cell, on the link's scale.

    With S the shapes and what unknowns add to the image, the variance is diag(S Sᵀ) - diag(S Jᵀ WᵀW J Sᵀ), of which the
    rows W J Sᵀ are made some at a time.
    """
    inversion, coefficients = posterior.inversion, posterior.coefficients
    basis, xp = inversion.basis, namespace(posterior)
    estimate, count = inversion.estimate(coefficients), basis.num_coefficients
    # Unknowns change the image linearly, if at all.
    further = [np.arange(len(coefficients)) == number for number in range(count, len(coefficients))]
    added = [inversion.estimate(coefficients + one) - estimate for one in further]
    variance = basis.variance() + sum(one**2 for one in added)
    rows = len(posterior.root)
    for start in range(0, rows, _ROWS):
        gain = posterior.root[start : start + _ROWS] @ posterior.jacobian
        seen = xp.stack([basis.expand(row[:count]) for row in gain])
        for number, one in enumerate(added):
            seen = seen + gain[:, count + number, None] * one
        variance = variance - (seen**2).sum(axis=0)
    return estimate, xp.sqrt(xp.maximum(variance, 0))


@eqx.filter_jit
def _weighted(posterior: Posterior, weight):
    mean, gradient = jax.value_and_grad(lambda c: weight @ posterior.inversion.conductivity(c))(posterior.coefficients)
    variance = gradient @ gradient - jnp.sum((posterior.root @ (posterior.jacobian @ gradient)) ** 2)
    return mean, jnp.sqrt(variance)


@eqx.filter_jit
def _sample(posterior: Posterior, key, number: int):
    """c = ĉ + z - Jᵀ(JJᵀ + C)⁻¹(Jz + e), with z from the prior and e from the noise."""
    prior, noise = jax.random.split(key)
    jacobian, root = posterior.jacobian, posterior.root
    drawn = jax.random.normal(prior, (number, jacobian.shape[1]))
    errors = jax.random.normal(noise, (number, len(root))) @ jnp.linalg.cholesky(posterior.inversion.data.covariance).T
    seen = drawn @ jacobian.T + errors
    change = drawn - (seen @ root.T @ root) @ jacobian
    return jax.vmap(posterior.inversion.conductivity)(posterior.coefficients + change)
