"""Eigendecomposition of the linear problem in the space of the data, from which images for any hyperparameter are
cheap.

For complex admittivities J and data are complex, ᵀ stands for the conjugate transpose, and the image is the minimum of
the same sum of squares. With whitened Jacobian J (M, m), prior covariance Γ and null space N, the reconstruction is

    R_λ = ΓJᵀP_λ + N(BᵀK⁻¹B)⁻¹BᵀK⁻¹,   K = JΓJᵀ + λ²I,   B = JN,   P_λ = Q(QᵀKQ)⁻¹Qᵀ,

Q being an orthonormal basis of the complement of B (all of the data where N is empty). With QᵀJΓJᵀQ = UΛUᵀ the
residual is v - JR_λv = λ²P_λv = QU diag(λ²/(Λ + λ²)) UᵀQᵀv, whatever λ, and

    R_λ = (I - NB⁺J) ΓJᵀQU diag(1/(Λ + λ²)) UᵀQᵀ + NB⁺.

What data can show of a body is often of far fewer dimensions than there are channels: J = DG with orthonormal columns
in D (M, r), and G (r, m) and its product ΓGᵀ are all that is kept of the size of the image.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers import symmetric_eigen
from jeit_solvers.engines import adjoint, either_engine, has_values, host, namespace

# Cells of which a mean over cells is taken, about.
_ENOUGH = 10_000


class Spectrum(eqx.Module):
    """Eigendecomposition of the data-space system, from which the reconstruction for any λ is cheap.

    **Fields**: `basis` (M, k) = QU; `eigenvalues` Λ (k,); `directions` D (M, r); `reduced` G (r, m); `images` ΓGᵀ
    (m, r); `null_space` N (m, p); `seen` B = JN (M, p); `outer` JΓJᵀ (M, M); `repeated`, how many of the components say
    nothing, whatever was measured, see `Protocol.repeated_facts`.
    """

    basis: Float[Array, "M k"]
    eigenvalues: Float[Array, " k"]
    directions: Float[Array, "M r"]
    reduced: Float[Array, "r m"]
    images: Float[Array, "m r"]
    null_space: Float[Array, "m p"]
    seen: Float[Array, "M p"]
    outer: Float[Array, "M M"]
    repeated: int = eqx.field(static=True, default=0)

    @classmethod
    def create(
        cls,
        jacobian: Float[Array, "r m"],
        product: Float[Array, "m r"],
        null_space: Float[Array, "m p"],
        directions: Float[Array, "M r"] | None = None,
        repeated: int = 0,
    ):
        """From the whitened Jacobian, its product with the prior covariance, and the prior's null space; of all
        channels, or in orthonormal `directions` of theirs."""
        given = host.asarray(np.eye(len(jacobian))) if directions is None else directions
        basis, eigenvalues, seen, outer = _decompose(jacobian, product, null_space, given)
        return cls(basis, eigenvalues, given, jacobian, product, null_space, seen, outer, repeated)

    @property
    def freedom(self) -> int:
        """Number of independent components of the data: all but those that are repeated."""
        return self.eigenvalues.shape[0] - self.repeated

    @property
    def jacobian(self) -> Float[Array, "M m"]:
        """The whitened Jacobian J (M, m)."""
        return self.directions @ self.reduced

    @property
    def product(self) -> Float[Array, "m M"]:
        """ΓJᵀ (m, M)."""
        return self.images @ self.directions.T

    def reconstruction(self, hyperparameter) -> Float[Array, "m M"]:
        """R_λ (m, M) for whitened data."""
        images, weights = self.factors(hyperparameter)
        return images @ weights

    def factors(self, hyperparameter) -> tuple[Float[Array, "m k"], Float[Array, "k M"]]:
        """Images (m, k), no more than the data can distinguish, and their weights: R_λ = images · weights."""
        return _factors(self, hyperparameter)

    def image(self, data: ArrayLike, hyperparameter) -> Float[Array, " m"]:
        """R_λ v (m,) for whitened data v, without R_λ."""
        return _image(self, data, hyperparameter)

    def filter(self, hyperparameter) -> Float[Array, " r"]:
        """λ²/(Λ + λ²): the share of each data component that stays in the residual."""
        return hyperparameter**2 / (self.eigenvalues + hyperparameter**2)

    def modes(self) -> Float[Array, "m k"]:
        """(I - NB⁺J) ΓJᵀQU: what each data component adds to the image, but for the factor 1/(Λ + λ²)."""
        return _modes(self)

    def squared_modes(self) -> Float[np.ndarray, " k"]:
        """The mean over cells of the square of each of the `modes`; over some thousands, where there are more."""
        images, weights = (np.asarray(part) for part in _mode_factors(self))
        some = images[:: max(1, len(images) // _ENOUGH)]
        return np.mean(np.abs(some @ weights) ** 2, axis=0)

    def candidates(self, size: int = 200) -> Float[np.ndarray, " K"]:
        """Candidate λ (K,), logarithmic over the range where any component is neither kept nor dropped."""
        largest = np.sqrt(np.asarray(self.eigenvalues).max())
        return largest * np.logspace(-6, 1, size)

    def curves(self, data: ArrayLike | None, candidates: Float[np.ndarray, " K"]) -> tuple[np.ndarray, np.ndarray]:
        """Residual ‖v - JR_λv‖ and penalty √(xᵀQx), each (K,), of every candidate λ; empty ones without data, or where
        they are traced."""
        if data is None or not has_values(data):
            return np.zeros(0), np.zeros(0)
        eigenvalues = np.asarray(self.eigenvalues)
        components = abs(adjoint(np.asarray(self.basis)) @ np.asarray(data))
        damped = (components / (eigenvalues + candidates[:, None] ** 2)) ** 2
        return candidates**2 * np.sqrt(damped.sum(axis=1)), np.sqrt(damped @ eigenvalues)


@either_engine
def _decompose(jacobian, product, null_space, directions):
    xp = namespace(jacobian, product, null_space)
    outer = directions @ (jacobian @ product) @ directions.T
    seen = directions @ (jacobian @ null_space)
    if null_space.shape[1] == 0:
        eigenvalues, vectors = symmetric_eigen((outer + adjoint(outer)) / 2)
        return vectors, xp.maximum(eigenvalues, 0), seen, outer
    complement = xp.linalg.qr(seen, mode="complete")[0][:, null_space.shape[1] :]
    projected = adjoint(complement) @ outer @ complement
    eigenvalues, vectors = symmetric_eigen((projected + adjoint(projected)) / 2)
    return complement @ vectors, xp.maximum(eigenvalues, 0), seen, outer


@either_engine
def _factors(spectrum: Spectrum, hyperparameter):
    basis, xp = spectrum.basis, namespace(spectrum)
    inverse = (basis / (spectrum.eigenvalues + hyperparameter**2)) @ adjoint(basis)
    weights = spectrum.directions.T @ inverse
    if spectrum.null_space.shape[1] == 0:
        return spectrum.images, weights
    # Least-squares coefficients of the null space for the data that the penalised part leaves.
    coefficients = xp.linalg.pinv(spectrum.seen)
    rest = np.eye(basis.shape[0]) - spectrum.outer @ inverse
    images = xp.concatenate([spectrum.images, spectrum.null_space], axis=1)
    return images, xp.concatenate([weights, coefficients @ rest])


@either_engine
def _image(spectrum: Spectrum, data, hyperparameter):
    inner = spectrum.basis @ ((adjoint(spectrum.basis) @ data) / (spectrum.eigenvalues + hyperparameter**2))
    image = spectrum.images @ (spectrum.directions.T @ inner)
    if spectrum.null_space.shape[1] == 0:
        return image
    free = namespace(spectrum).linalg.pinv(spectrum.seen)
    return image + spectrum.null_space @ (free @ (data - spectrum.outer @ inner))


@either_engine
def _modes(spectrum: Spectrum):
    images, weights = _mode_factors(spectrum)
    return images @ weights


def _mode_factors(spectrum: Spectrum):
    weights, xp = spectrum.directions.T @ spectrum.basis, namespace(spectrum)
    if spectrum.null_space.shape[1] == 0:
        return spectrum.images, weights
    free = xp.linalg.pinv(spectrum.seen) @ (spectrum.outer @ spectrum.basis)
    return xp.concatenate([spectrum.images, -spectrum.null_space], axis=1), xp.concatenate([weights, free])
