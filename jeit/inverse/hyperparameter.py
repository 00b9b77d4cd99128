"""The hyperparameter λ of a linear reconstruction, and rules that choose it when none is given.

All rules share one eigendecomposition. With whitened Jacobian J (M, m), prior covariance Γ and null space N, the
reconstruction is

    R_λ = ΓJᵀP_λ + N(BᵀK⁻¹B)⁻¹BᵀK⁻¹,   K = JΓJᵀ + λ²I,   B = JN,   P_λ = Q(QᵀKQ)⁻¹Qᵀ,

Q being an orthonormal basis of the complement of B (all of the data where N is empty). With QᵀJΓJᵀQ = UΛUᵀ the
residual is v - JR_λv = λ²P_λv = QU diag(λ²/(Λ + λ²)) UᵀQᵀv, whatever λ.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


class Spectrum(eqx.Module):
    """Eigendecomposition of the data-space system, from which the reconstruction for any λ is cheap.

    **Fields**: `basis` (M, r) = QU; `eigenvalues` Λ (r,); `product` ΓJᵀ (m, M); `null_space` N (m, p);
    `seen` B = JN (M, p); `outer` JΓJᵀ (M, M).
    """

    basis: Float[Array, "M r"]
    eigenvalues: Float[Array, " r"]
    product: Float[Array, "m M"]
    null_space: Float[Array, "m p"]
    seen: Float[Array, "M p"]
    outer: Float[Array, "M M"]

    @classmethod
    def create(cls, jacobian: Float[Array, "M m"], product: Float[Array, "m M"], null_space: Float[Array, "m p"]):
        """From the whitened Jacobian, its product with the prior covariance, and the prior's null space."""
        basis, eigenvalues = _decompose(jacobian, product, null_space)
        return cls(basis, eigenvalues, product, null_space, jacobian @ null_space, jacobian @ product)

    def reconstruction(self, hyperparameter) -> Float[Array, "m M"]:
        """R_λ (m, M) for whitened data."""
        return _reconstruction(self, hyperparameter)

    def filter(self, hyperparameter) -> Float[Array, " r"]:
        """λ²/(Λ + λ²): the share of each data component that stays in the residual."""
        return hyperparameter**2 / (self.eigenvalues + hyperparameter**2)


@jax.jit
def _decompose(jacobian, product, null_space):
    outer = jacobian @ product
    full, _ = jnp.linalg.qr(jacobian @ null_space, mode="complete")
    complement = full[:, null_space.shape[1] :]
    projected = complement.T @ outer @ complement
    eigenvalues, vectors = jnp.linalg.eigh((projected + projected.T) / 2)
    return complement @ vectors, jnp.maximum(eigenvalues, 0)


@jax.jit
def _reconstruction(spectrum: Spectrum, hyperparameter):
    basis = spectrum.basis
    inverse = (basis / (spectrum.eigenvalues + hyperparameter**2)) @ basis.T
    matrix = spectrum.product @ inverse
    if spectrum.null_space.shape[1] == 0:
        return matrix
    # What the penalised part leaves of the data, seen by the null space: its least-squares coefficients.
    coefficients = jnp.linalg.pinv(spectrum.seen)
    rest = jnp.eye(basis.shape[0]) - spectrum.outer @ inverse
    return matrix + spectrum.null_space @ (coefficients @ rest)


def generalised_cross_validation(spectrum: Spectrum, data) -> float:
    """λ that predicts each channel best from the others: least M‖r‖²/(tr(I - H))². Golub, Heath and Wahba 1979."""
    components = spectrum.basis.T @ _needed(data, "gcv")
    return _least(_gcv_score, spectrum, components)


def _gcv_score(hyperparameter, spectrum: Spectrum, components):
    left = spectrum.filter(hyperparameter)
    return jnp.sum((left * components) ** 2) / jnp.sum(left) ** 2


def discrepancy(spectrum: Spectrum, data) -> float:
    """Largest λ whose residual is no more than the noise: ‖r‖² = number of channels, for data in units of noise."""
    components = spectrum.basis.T @ _needed(data, "discrepancy")
    target = components.shape[0]
    grid = _grid(spectrum)
    residual = np.asarray(jax.vmap(lambda value: jnp.sum((spectrum.filter(value) * components) ** 2))(grid))
    inside = np.flatnonzero(residual <= target)
    if inside.size == 0:
        return float(grid[0])
    return float(grid[inside[-1]])


def l_curve(spectrum: Spectrum, data) -> float:
    """λ at the corner of greatest curvature of log ‖r‖ against log xᵀQx. Hansen, SIAM Review 34 (1992) 561-580."""
    components = spectrum.basis.T @ _needed(data, "l-curve")

    def curve(log_value):
        left = spectrum.filter(jnp.exp(log_value))
        residual = jnp.sum((left * components) ** 2)
        penalty = jnp.sum(spectrum.eigenvalues * ((1 - left) / (spectrum.eigenvalues + 1e-300) * components) ** 2)
        return jnp.stack([jnp.log(residual), jnp.log(penalty)]) / 2

    def curvature(log_value):
        first = jax.jacfwd(curve)(log_value)
        second = jax.jacfwd(jax.jacfwd(curve))(log_value)
        return (first[0] * second[1] - second[0] * first[1]) / (first @ first) ** 1.5

    grid = _grid(spectrum)
    bend = np.asarray(jax.vmap(curvature)(jnp.log(grid)))
    return float(grid[np.argmax(np.where(np.isfinite(bend), bend, -np.inf))])


def noise_figure(spectrum: Spectrum, data=None, *, target: float = 1.25) -> float:
    """λ at which the signal-to-noise ratio of the image is 1 / `target` times that of the data; looks at no data.

    Signals are drawn from the prior and the noise is white: the ratio of the data is trΛ / r, that of the image
    tr(RJΓJᵀRᵀ) / tr(RRᵀ). Adler and Guardo 1996, with the prior in place of their one central object.
    """
    gain = jnp.sum((spectrum.product @ spectrum.basis) ** 2, axis=0)  # diagonal of UᵀQᵀ JΓΓJᵀ QU
    return _least(_noise_figure_score, spectrum, (gain, target))


def _noise_figure_score(hyperparameter, spectrum: Spectrum, arguments):
    gain, target = arguments
    passed = gain / (spectrum.eigenvalues + hyperparameter**2) ** 2
    image = jnp.sum(passed * spectrum.eigenvalues) / jnp.sum(passed)
    return jnp.abs(jnp.log(jnp.sqrt(spectrum.eigenvalues.mean() / image) / target))


RULES: dict[str, Callable[[Spectrum, Float[Array, " M"] | None], float]] = {
    "gcv": generalised_cross_validation,
    "l-curve": l_curve,
    "discrepancy": discrepancy,
    "noise-figure": noise_figure,
}
"""Rules by name: each takes a `Spectrum` and the whitened data, and returns λ."""


def choose(spectrum: Spectrum, hyperparameter: float | str, data) -> tuple[Float[Array, ""], str]:
    """λ and a word on how it came about, from a number or the name of a rule."""
    if isinstance(hyperparameter, str):
        if hyperparameter not in RULES:
            raise ValueError(f"hyperparameter: no rule '{hyperparameter}'; give a number or one of {', '.join(RULES)}.")
        return jnp.asarray(RULES[hyperparameter](spectrum, data)), hyperparameter
    if not isinstance(hyperparameter, Tracer) and not (np.isfinite(hyperparameter) and hyperparameter > 0):
        raise ValueError(f"hyperparameter must be positive and finite; it is {hyperparameter}.")
    return jnp.asarray(hyperparameter, float), "given"


def _needed(data, rule: str):
    if data is None:
        raise ValueError(f"The rule '{rule}' looks at the data: give difference, the change of voltages to be imaged.")
    return data


@partial(jax.jit, static_argnames="size")
def _grid(spectrum: Spectrum, size: int = 200):
    """Candidate λ, logarithmic over the range where any component is neither kept nor dropped."""
    largest = jnp.sqrt(spectrum.eigenvalues.max())
    return largest * jnp.logspace(-6, 1, size)


def _least(score, spectrum: Spectrum, arguments) -> float:
    """The candidate λ of the least score(λ, spectrum, arguments)."""
    return float(_least_of_grid(score, spectrum, arguments))


@partial(jax.jit, static_argnums=0)
def _least_of_grid(score, spectrum: Spectrum, arguments):
    grid = _grid(spectrum)
    return grid[jnp.argmin(jax.vmap(lambda value: score(value, spectrum, arguments))(grid))]
