"""Eigendecomposition of the linear problem in data space, from which images for any hyperparameter are computed at low
cost.

With the whitened Jacobian J (M, m), the prior covariance Γ and a basis N of the prior's null space, the reconstruction
matrix is

    R_λ = ΓJᵀP_λ + N(BᵀK⁻¹B)⁻¹BᵀK⁻¹,   K = JΓJᵀ + λ²I,   B = JN,   P_λ = Q(QᵀKQ)⁻¹Qᵀ,

where Q is an orthonormal basis of the orthogonal complement of B (Q = I if N is empty). With the eigendecomposition
QᵀJΓJᵀQ = UΛUᵀ, which does not depend on λ, the residual of data v is v - JR_λv = λ²P_λv = QU diag(λ²/(Λ + λ²)) UᵀQᵀv,
and

    R_λ = (I - NB⁺J) ΓJᵀQU diag(1/(Λ + λ²)) UᵀQᵀ + NB⁺.

The space of the changes of data that a body can cause often has a dimension r far below the number of channels: J = DG
with orthonormal columns of D (M, r). Only G (r, m) and ΓGᵀ are stored at the size of the image. For complex
admittivities J and the data are complex and ᵀ denotes the conjugate transpose.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers import symmetric_eigen
from jeit_solvers.engines import adjoint, evaluate_in_numpy, has_values, host, namespace, numpy_or_compiled
from jeit_solvers.module import Module

# Approximate number of cells over which an image is averaged.
_NUM_MEAN_CELLS = 10_000


class Spectrum(Module):
    """Eigendecomposition of the data-space system, in the notation of `jeit.inverse.spectrum`.

    **Fields**: `basis` (M, k): QU; `eigenvalues` (k,): Λ; `directions` (M, r): D; `reduced` (r, m): G; `images` (m, r):
    ΓGᵀ; `null_space` (m, p): N; `observed_null_space` (M, p): B = JN; `outer` (M, M): JΓJᵀ; `repeated`: number of data
    components without information because readings are repeated, see `Protocol.repeated_facts`.
    """

    basis: Float[Array, "M k"]
    eigenvalues: Float[Array, " k"]
    directions: Float[Array, "M r"]
    reduced: Float[Array, "r m"]
    images: Float[Array, "m r"]
    null_space: Float[Array, "m p"]
    observed_null_space: Float[Array, "M p"]
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
        """Create a spectrum from the whitened Jacobian of all channels, or of their orthonormal combinations
        `directions`; the `product` of the prior covariance with the transpose of this Jacobian; and a basis of the
        prior's null space."""
        data_basis = host.asarray(np.eye(len(jacobian))) if directions is None else directions
        basis, eigenvalues, null_space_data, data_covariance = _decompose(jacobian, product, null_space, data_basis)
        return cls(
            basis, eigenvalues, data_basis, jacobian, product, null_space, null_space_data, data_covariance, repeated
        )

    @property
    def freedom(self) -> int:
        """Number of independent components of the data, not counting repeated readings."""
        return self.eigenvalues.shape[0] - self.repeated

    @property
    def jacobian(self) -> Float[Array, "M m"]:
        """Whitened Jacobian J (M, m)."""
        return self.directions @ self.reduced

    @property
    def product(self) -> Float[Array, "m M"]:
        """Product ΓJᵀ (m, M) of the prior covariance with the transposed whitened Jacobian."""
        return self.images @ self.directions.T

    def reconstruction(self, hyperparameter) -> Float[Array, "m M"]:
        """Reconstruction matrix R_λ (m, M) for whitened data."""
        images, data_weights = self.factors(hyperparameter)
        return images @ data_weights

    def factors(self, hyperparameter) -> tuple[Float[Array, "m k"], Float[Array, "k M"]]:
        """Factors of R_λ = images · weights: images (m, k) and weights (k, M), k at most the dimension of the data plus
        that of the null space."""
        return _reconstruction_factors(self, hyperparameter)

    def image(self, data: ArrayLike, hyperparameter) -> Float[Array, " m"]:
        """Image R_λ v (m,) of whitened data v, computed without forming R_λ."""
        return _spectrum_image(self, data, hyperparameter)

    def filter(self, hyperparameter) -> Float[Array, " r"]:
        """Filter λ²/(Λ + λ²): the fraction of each data component that remains in the residual."""
        return hyperparameter**2 / (self.eigenvalues + hyperparameter**2)

    def modes(self) -> Float[Array, "m k"]:
        """Images (I - NB⁺J) ΓJᵀQU; mode i times 1/(Λᵢ + λ²) is the contribution of data component i to the image."""
        return _modes(self)

    def squared_modes(self) -> Float[np.ndarray, " k"]:
        """Squared absolute value of each of the `modes`, averaged over all cells, or on large meshes over a subset of
        about `_NUM_MEAN_CELLS` cells."""
        images, data_weights = evaluate_in_numpy(_mode_factors, self)
        sampled_images = images[:: max(1, len(images) // _NUM_MEAN_CELLS)]
        return np.mean(np.abs(sampled_images @ data_weights) ** 2, axis=0)

    def candidates(self, size: int = 200) -> Float[np.ndarray, " K"]:
        """Candidate λ (K,), logarithmically spaced from 1e-6 to 10 times the square root of the largest eigenvalue."""
        max_singular_value = np.sqrt(np.asarray(self.eigenvalues).max())
        return max_singular_value * np.logspace(-6, 1, size)

    def curves(self, data: ArrayLike | None, candidates: Float[np.ndarray, " K"]) -> tuple[np.ndarray, np.ndarray]:
        """Residual ‖v - JR_λv‖ and penalty √(xᵀQx), each (K,), for every candidate λ; empty arrays without data or for
        traced data."""
        if data is None or not has_values(data):
            return np.zeros(0), np.zeros(0)
        eigenvalues = np.asarray(self.eigenvalues)
        data_components = abs(adjoint(np.asarray(self.basis)) @ np.asarray(data))
        damped_components = (data_components / (eigenvalues + candidates[:, None] ** 2)) ** 2
        return candidates**2 * np.sqrt(damped_components.sum(axis=1)), np.sqrt(damped_components @ eigenvalues)


@numpy_or_compiled
def _decompose(jacobian, product, null_space, directions):
    xp = namespace(jacobian, product, null_space)
    data_covariance = directions @ (jacobian @ product) @ directions.T
    null_space_data = directions @ (jacobian @ null_space)
    if null_space.shape[1] == 0:
        eigenvalues, projected_eigenvectors = symmetric_eigen((data_covariance + adjoint(data_covariance)) / 2)
        return projected_eigenvectors, xp.maximum(eigenvalues, 0), null_space_data, data_covariance
    null_space_complement = xp.linalg.qr(null_space_data, mode="complete")[0][:, null_space.shape[1] :]
    projected_covariance = adjoint(null_space_complement) @ data_covariance @ null_space_complement
    eigenvalues, projected_eigenvectors = symmetric_eigen((projected_covariance + adjoint(projected_covariance)) / 2)
    return null_space_complement @ projected_eigenvectors, xp.maximum(eigenvalues, 0), null_space_data, data_covariance


@numpy_or_compiled
def _reconstruction_factors(spectrum: Spectrum, hyperparameter):
    basis, xp = spectrum.basis, namespace(spectrum)
    inverse = (basis / (spectrum.eigenvalues + hyperparameter**2)) @ adjoint(basis)
    data_weights = spectrum.directions.T @ inverse
    if spectrum.null_space.shape[1] == 0:
        return spectrum.images, data_weights
    # Coefficients of the null space, fitted by least squares to the data that the penalised part does not explain.
    coefficients = xp.linalg.pinv(spectrum.observed_null_space)
    unexplained_projector = np.eye(basis.shape[0]) - spectrum.outer @ inverse
    images = xp.concatenate([spectrum.images, spectrum.null_space], axis=1)
    return images, xp.concatenate([data_weights, coefficients @ unexplained_projector])


@numpy_or_compiled
def _spectrum_image(spectrum: Spectrum, data, hyperparameter):
    dual_image = spectrum.basis @ ((adjoint(spectrum.basis) @ data) / (spectrum.eigenvalues + hyperparameter**2))
    image = spectrum.images @ (spectrum.directions.T @ dual_image)
    if spectrum.null_space.shape[1] == 0:
        return image
    null_space_weights = namespace(spectrum).linalg.pinv(spectrum.observed_null_space)
    return image + spectrum.null_space @ (null_space_weights @ (data - spectrum.outer @ dual_image))


@numpy_or_compiled
def _modes(spectrum: Spectrum):
    images, data_weights = _mode_factors(spectrum)
    return images @ data_weights


def _mode_factors(spectrum: Spectrum):
    data_weights, xp = spectrum.directions.T @ spectrum.basis, namespace(spectrum)
    if spectrum.null_space.shape[1] == 0:
        return spectrum.images, data_weights
    null_space_weights = xp.linalg.pinv(spectrum.observed_null_space) @ (spectrum.outer @ spectrum.basis)
    return xp.concatenate([spectrum.images, -spectrum.null_space], axis=1), xp.concatenate(
        [data_weights, null_space_weights]
    )
