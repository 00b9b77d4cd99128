"""Linearised problem of difference imaging: checks of its arguments, whitening and decomposition.

Without derivatives the problem is solved with the eigendecomposition of `jeit.inverse.spectrum`. For traced arguments
the problem is solved for one hyperparameter without an eigendecomposition (`DirectProblem`), because eigenvectors of
equal eigenvalues, which occur for symmetric bodies, have no derivatives, unlike the images. In the notation of
`jeit.inverse.spectrum`,

    R_λ = ΓJᵀK⁻¹(I - BGᵀ) + NGᵀ,   G = K⁻¹B(BᵀK⁻¹B)⁻¹,   K = JΓJᵀ + λ²I,   B = JN.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Inexact, Int

from jeit.arguments import check_has_values, describe
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, evaluate, field_products, fields_and_impedance_of, jacobian_blocks
from jeit.forward.system import check_conductivity
from jeit.inverse.prior.matern import DEFAULT_PRIOR
from jeit.inverse.prior.priors import AbstractPrior, check_prior
from jeit.inverse.spectrum import Spectrum
from jeit.protocol import Protocol
from jeit_solvers import symmetric_inverse
from jeit_solvers.engines import adjoint, as_array, has_values, namespace, on_host
from jeit_solvers.module import Module


class DirectProblem(Module):
    """Whitened linear problem without an eigendecomposition. The class has the methods of a `Spectrum` that compute
    images, but not its other methods.

    **Fields**: `directions` (M, r): orthonormal combinations of the channels; `jacobian` (r, m): Jacobian J of the
    combinations; `product` (m, r): ΓJᵀ; `null_space` (m, p): basis N of the prior's null space.
    """

    directions: Float[Array, "M r"]
    jacobian: Float[Array, "r m"]
    product: Float[Array, "m r"]
    null_space: Float[Array, "m p"]

    def image(self, data: Inexact[Array, " M"], hyperparameter) -> Inexact[Array, " m"]:
        """Image R_λ v (m,) of whitened data v."""
        return self.reconstruction(hyperparameter) @ data

    def reconstruction(self, hyperparameter) -> Float[Array, "m M"]:
        """Reconstruction matrix R_λ (m, M) for whitened data."""
        data_covariance = self.jacobian @ self.product
        regularised_covariance = (data_covariance + adjoint(data_covariance)) / 2 + hyperparameter**2 * jnp.eye(
            len(data_covariance)
        )
        inverse = (
            jnp.linalg.inv(regularised_covariance)
            if jnp.iscomplexobj(regularised_covariance)
            else symmetric_inverse(regularised_covariance)
        )
        reconstruction_matrix = self.product @ inverse
        if self.null_space.shape[1]:
            null_space_data = self.jacobian @ self.null_space
            weighted_null_space_data = inverse @ null_space_data
            null_space_weights = weighted_null_space_data @ jnp.linalg.pinv(
                adjoint(null_space_data) @ weighted_null_space_data
            )
            reconstruction_matrix = reconstruction_matrix + (
                self.null_space - reconstruction_matrix @ null_space_data
            ) @ adjoint(null_space_weights)
        return reconstruction_matrix @ self.directions.T


# Singular values below this fraction of the largest singular value are rounding errors.
_RANK_TOLERANCE = 1e-12


class Linearisation(Module):
    """Linearised problem v = J x at a background conductivity, for the K channels in use, with rows divided by the
    noise of their channels.

    **Fields**: `spectrum`: the `Spectrum` of the problem, or a `DirectProblem` if the problem is traced (by a
    derivative, `jax.jit` or `jax.vmap`), with which rules for λ do not work; `prior`; `channels` (K,): indices of the
    channels in use; `root_weight` (K,): 1 / standard deviation of the noise of these channels, 1 / volts;
    `num_channels`: number of channels M of the protocol.
    """

    spectrum: Spectrum | DirectProblem
    prior: AbstractPrior
    channels: Int[np.ndarray, " K"]
    root_weight: Float[Array, " K"]
    num_channels: int = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        model: ForwardModel,
        conductivity,
        *,
        prior: AbstractPrior | None = None,
        noise: Float[Array, " M"] | float = 1.0,
        mask: Bool[Array, " M"] | None = None,
    ) -> "Linearisation":
        """Linearise the problem at `conductivity`, S/m (2-D: S); arguments as in `one_step`. Raises `ValueError` for
        invalid or inconsistent arguments."""
        prior = DEFAULT_PRIOR if prior is None else prior
        check_model(model)
        check_prior(prior)
        if not prior.is_quadratic:
            raise ValueError(
                f"prior: {type(prior).__name__} is not quadratic, so there is no linear image with it, nor a rule for "
                "its weight; take Noser(), Gaussian(length), Laplace() or Tikhonov(), or reconstruct with this one."
            )
        if np.shape(conductivity) not in ((), (model.mesh.num_cells,)):
            raise ValueError("conductivity: give one number, or one value per cell: the image has a value per cell.")
        used_channel_indices, inverse_noise = used_channels(model, noise, mask)
        if has_values(model, conductivity, inverse_noise, prior):
            data_basis = data_directions(model.protocol, used_channel_indices, inverse_noise)
            reduced_jacobian: Any = combined_jacobian(
                model, conductivity, used_channel_indices, (inverse_noise[:, None] * data_basis).T
            )
            covariance_times_jacobian = prior.covariance_product(model.mesh, reduced_jacobian.conj())
            num_redundant_channels = model.protocol.repeated_facts(used_channel_indices)
            null_space = prior.null_space(model.mesh)
            spectrum = Spectrum.create(
                reduced_jacobian,
                covariance_times_jacobian,
                null_space,
                as_array(data_basis),
                num_redundant_channels,
            )
        else:
            jacobian = model.jacobian(conductivity)
            data_basis = _traced_directions(model.protocol, used_channel_indices, inverse_noise)
            reduced_jacobian = data_basis.T @ (inverse_noise[:, None] * jacobian[used_channel_indices])
            covariance_times_jacobian = prior.covariance_product(model.mesh, reduced_jacobian.conj())
            spectrum = DirectProblem(
                data_basis, reduced_jacobian, covariance_times_jacobian, prior.null_space(model.mesh)
            )
        return cls(spectrum, prior, used_channel_indices, inverse_noise, model.protocol.num_measurements)

    def whiten(self, difference: ArrayLike) -> Float[Array, " K"]:
        """Change of voltages `difference` (M,) divided by the standard deviations of the channels, for the channels in
        use (K,).

        Raises `ValueError` for the wrong number of channels and, unless traced, for NaN or infinite values in channels
        in use.
        """
        if np.shape(difference) != (self.num_channels,):
            raise ValueError(
                f"difference has shape {np.shape(difference)}; give {self.num_channels} voltages, one frame."
            )
        if not has_values(difference, self.root_weight):
            return self.root_weight * jnp.asarray(difference)[self.channels]
        weighted_difference = self.root_weight * np.asarray(difference)[self.channels]
        if not np.isfinite(weighted_difference).all():
            raise ValueError("difference has NaN or infinite voltages in channels in use; mask them.")
        return as_array(weighted_difference)

    def matrix(self, hyperparameter) -> Float[Array, "m M"]:
        """Reconstruction matrix (m, M) for hyperparameter λ: change of conductivity per volt, zero for channels not in
        use."""
        if not has_values(self.spectrum, self.root_weight, hyperparameter):
            channel_matrix = jnp.asarray(self.spectrum.reconstruction(hyperparameter)) * self.root_weight
            return (
                jnp.zeros((channel_matrix.shape[0], self.num_channels), channel_matrix.dtype)
                .at[:, self.channels]
                .set(channel_matrix)
            )
        images, channel_weights = self.factors(hyperparameter)
        return as_array(images @ channel_weights)

    def factors(self, hyperparameter) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "k M"]]:
        """Factors of the reconstruction matrix: images (m, k), and weights of the images (k, M) in 1 / volts. Not
        available for traced problems."""
        assert isinstance(self.spectrum, Spectrum)
        spectrum, host_hyperparameter = on_host((self.spectrum, hyperparameter))  # NumPy arrays are not copied
        images, whitened_weights = (
            np.asarray(matrix_factor) for matrix_factor in spectrum.factors(host_hyperparameter)
        )
        channel_weights: Any = np.zeros((whitened_weights.shape[0], self.num_channels), whitened_weights.dtype)
        channel_weights[:, self.channels] = whitened_weights * self.root_weight
        return images, channel_weights


def combined_blocks(
    model: ForwardModel, conductivity, channels: Int[np.ndarray, " K"], weights: Float[Any, "r K"]
) -> Iterator[tuple[slice, Any]]:
    """Iterate over blocks of b cells, to limit memory. Yields the cells of the block and r weighted sums (r, b) of the
    channels' Jacobians in these cells, in NumPy.

    `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
    """
    fields = evaluate(model, fields_and_impedance_of, check_conductivity(model.mesh, conductivity))[0]
    mesh, protocol, fields = on_host((model.mesh, model.protocol.subset(channels), fields))
    num_electrodes = protocol.num_electrodes
    if num_electrodes * (num_electrodes + 1) // 2 < len(channels):
        # There are fewer products of fields than channels, so the products are computed: ∂v = -Σ_ab d_a m_b ∫ ∇u_a ·
        # ∇u_b.
        weights, field_product_blocks = -weights @ _linear_forms(model.protocol, channels), field_products(mesh, fields)
    else:
        field_product_blocks = jacobian_blocks(mesh, protocol, fields)
    for cells, field_product_block in field_product_blocks:
        yield cells, weights @ np.asarray(field_product_block)


def combined_jacobian(
    model: ForwardModel, conductivity, channels: Int[np.ndarray, " K"], weights: Float[Any, "r K"]
) -> Inexact[Any, "r m"]:
    """Weighted sums (r, m) of the Jacobians of `channels` (K,), with `weights` (r, K); `conductivity` in S/m (2-D:
    S)."""
    number_type = complex if np.iscomplexobj(conductivity) else float
    jacobian = np.empty((len(weights), model.mesh.num_cells), number_type)
    for cells, jacobian_block in combined_blocks(model, conductivity, channels, weights):
        jacobian[:, cells] = jacobian_block
    return jacobian


def used_channels(model: ForwardModel, noise, mask) -> tuple[np.ndarray, Float[Array, " K"]]:
    """Indices (K,) of the channels in use, and the reciprocals (K,) of the standard deviations of their noise, 1 /
    volts. Raises `ValueError` for an invalid mask or noise."""
    num_channels = model.protocol.num_measurements
    is_used_channel = channel_mask(mask, num_channels)
    noise_deviation = np.asarray(noise) if has_values(noise) else jnp.asarray(noise)
    if noise_deviation.shape not in ((), (num_channels,)) or noise_deviation.dtype.kind not in "iuf":
        raise ValueError(
            f"noise: give one real number of volts, or one for each channel, ({num_channels},); got {describe(noise)}."
        )
    noise_deviation = namespace(noise_deviation).broadcast_to(noise_deviation, (num_channels,)).astype(float)
    check_positive_noise(noise_deviation, is_used_channel)
    return np.flatnonzero(is_used_channel), 1 / noise_deviation[is_used_channel]


def channel_mask(mask, num_channels: int) -> Bool[np.ndarray, " M"]:
    """True (M,) for the channels in use; all if `mask` is None. Raises `ValueError` unless the mask has a boolean
    for each channel and at least one True."""
    check_mask(mask)
    is_used_channel = np.ones(num_channels, bool) if mask is None else np.asarray(mask)
    if is_used_channel.shape != (num_channels,) or is_used_channel.dtype != bool or not is_used_channel.any():
        raise ValueError(
            f"mask must be ({num_channels},) booleans with at least one True: one for each channel; got "
            f"{describe(mask)}."
        )
    return is_used_channel


def check_positive_noise(noise_deviation: Float[Array, " M"], is_used_channel: Bool[np.ndarray, " M"]) -> None:
    """Raise `ValueError` if the standard deviation of a channel in use is not positive and finite."""
    if not has_values(noise_deviation):
        return
    noise_values = np.asarray(noise_deviation)
    is_invalid = is_used_channel & ~(np.isfinite(noise_values) & (noise_values > 0))
    if is_invalid.any():
        channel = int(np.argmax(is_invalid))
        raise ValueError(
            "noise must be positive and finite for every channel in use, in volts; channel "
            f"{channel} (numbered from 0) has {noise_values[channel]:g}."
        )


def check_mask(mask) -> None:
    """Raise `ValueError` for a traced mask, because the number of channels in use must be known."""
    advice_to_user = "give it as an array of NumPy, outside; to weigh channels by what is traced, give noise"
    check_has_values("mask", mask, "which channels are used depends on", advice_to_user)


def data_directions(protocol: Protocol, channels, root_weight) -> Float[np.ndarray, "K r"]:
    """Orthonormal basis (K, r) of the changes of whitened data that changes of conductivity can cause. The dimension r
    is at most L(L - 1)/2 for L electrodes, because all channels are combinations of L(L - 1)/2 transfer impedances.

    For a drive d and a measurement m, which sum to zero, and a symmetric matrix G (the transfer impedance or its
    derivative), Σ_ab d_a m_b G_ab = Σ_a<b (d_a m_b + d_b m_a)(G_ab - (G_aa + G_bb)/2).
    """
    right_singular_vectors, singular_values, _ = np.linalg.svd(
        root_weight[:, None] * _pair_coefficients(protocol, channels), full_matrices=False
    )
    return right_singular_vectors[:, singular_values > _RANK_TOLERANCE * singular_values[0]]


def _traced_directions(protocol: Protocol, channels, root_weight) -> Float[Array, "K r"]:
    """Basis of `data_directions`, differentiable with respect to the weights; the identity if the protocol is
    traced."""
    if not has_values(protocol):
        return jnp.eye(len(channels))
    directions, singular_values, _ = np.linalg.svd(_pair_coefficients(protocol, channels), full_matrices=False)
    return jnp.linalg.qr(root_weight[:, None] * directions[:, singular_values > _RANK_TOLERANCE * singular_values[0]])[
        0
    ]


def _pair_coefficients(protocol: Protocol, channels) -> Float[np.ndarray, "K e"]:
    """Coefficients (K, e) by which the voltages of K channels depend on the transfer impedances of e pairs of
    electrodes."""
    row_electrodes, column_electrodes = np.triu_indices(protocol.num_electrodes)
    return _linear_forms(protocol, channels)[:, row_electrodes < column_electrodes]


def _linear_forms(protocol: Protocol, channels) -> Float[np.ndarray, "K f"]:
    """Coefficients (K, f) by which the voltages of K channels depend linearly on the symmetric matrix of transfer
    impedances between electrodes, of which f entries are in the upper triangle and on the diagonal."""
    drive = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)[channels]]
    measurement_patterns = np.asarray(protocol.measurement)[np.asarray(protocol.measurement_index)[channels]]
    row_electrodes, column_electrodes = np.triu_indices(protocol.num_electrodes)
    symmetric_sums = (
        drive[:, row_electrodes] * measurement_patterns[:, column_electrodes]
        + drive[:, column_electrodes] * measurement_patterns[:, row_electrodes]
    )
    return np.where(row_electrodes < column_electrodes, symmetric_sums, symmetric_sums / 2)
