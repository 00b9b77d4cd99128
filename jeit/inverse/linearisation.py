"""The linearised problem of difference imaging: its arguments are checked, and it is whitened and decomposed.

Without derivatives the problem is solved with the eigendecomposition of `jeit.inverse.spectrum`. For traced arguments
it is solved for one hyperparameter without an eigendecomposition (`DirectProblem`), because eigenvectors of equal
eigenvalues, which occur for symmetric bodies, have no derivatives although the images have. In the notation of
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

from jeit.arguments import check_has_values
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, evaluate, field_products, fields_and_impedance_of, jacobian_blocks
from jeit.forward.system import check_conductivity
from jeit.inverse.prior.matern import PRIOR
from jeit.inverse.prior.priors import AbstractPrior, check_prior
from jeit.inverse.spectrum import Spectrum
from jeit.protocol import Protocol
from jeit_solvers import symmetric_inverse
from jeit_solvers.engines import adjoint, as_array, has_values, namespace, on_host
from jeit_solvers.module import Module


class DirectProblem(Module):
    """Whitened linear problem without an eigendecomposition; it has the methods of a `Spectrum` that compute images.

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
        outer = self.jacobian @ self.product
        damped = (outer + adjoint(outer)) / 2 + hyperparameter**2 * jnp.eye(len(outer))
        inverse = jnp.linalg.inv(damped) if jnp.iscomplexobj(damped) else symmetric_inverse(damped)
        matrix = self.product @ inverse
        if self.null_space.shape[1]:
            seen = self.jacobian @ self.null_space
            weighted = inverse @ seen
            free = weighted @ jnp.linalg.pinv(adjoint(seen) @ weighted)
            matrix = matrix + (self.null_space - matrix @ seen) @ adjoint(free)
        return matrix @ self.directions.T


# Singular values below this fraction of the largest are rounding errors.
_RANK_TOLERANCE = 1e-12


class Linearisation(Module):
    """Linear problem v = J x at a background conductivity for the channels in use, with rows divided by their noise.

    **Fields**: `spectrum`: the `Spectrum` of the problem, or a `DirectProblem` if it is traced (by a derivative,
    `jax.jit` or `jax.vmap`), with which rules for λ do not work; `prior`; `channels` (K,): channels in use;
    `root_weight` (K,): 1 / standard deviation of these, 1 / volts; `num_channels`: number of channels M of the
    protocol.
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
        """Linearise at `conductivity`, S/m (2-D: S); arguments as in `one_step`. Raises `ValueError` for arguments that
        do not fit together."""
        prior = PRIOR if prior is None else prior
        check_model(model)
        check_prior(prior)
        if not prior.is_quadratic:
            raise ValueError(
                f"prior: {type(prior).__name__} is not quadratic, so there is no linear image with it, nor a rule for "
                "its weight; take Noser(), Gaussian(length), Laplace() or Tikhonov(), or reconstruct with this one."
            )
        if np.shape(conductivity) not in ((), (model.mesh.num_cells,)):
            raise ValueError("conductivity: give one number, or one value per cell: the image has a value per cell.")
        channels, root_weight = used_channels(model, noise, mask)
        if has_values(model, conductivity, root_weight, prior):
            directions = data_directions(model.protocol, channels, root_weight)
            reduced: Any = combined_jacobian(model, conductivity, channels, (root_weight[:, None] * directions).T)
            product = prior.covariance_product(model.mesh, reduced.conj())
            repeated = model.protocol.repeated_facts(channels)
            null_space = prior.null_space(model.mesh)
            spectrum = Spectrum.create(reduced, product, null_space, as_array(directions), repeated)
        else:
            jacobian = model.jacobian(conductivity)
            directions = _traced_directions(model.protocol, channels, root_weight)
            reduced = directions.T @ (root_weight[:, None] * jacobian[channels])
            product = prior.covariance_product(model.mesh, reduced.conj())
            spectrum = DirectProblem(directions, reduced, product, prior.null_space(model.mesh))
        return cls(spectrum, prior, channels, root_weight, model.protocol.num_measurements)

    def whiten(self, difference: ArrayLike) -> Float[Array, " K"]:
        """Change of voltages (M,) divided by the standard deviations, for the channels in use (K,).

        Raises `ValueError` for another number of channels and, unless traced, for NaN or infinite values in channels in
        use.
        """
        if np.shape(difference) != (self.num_channels,):
            raise ValueError(
                f"difference has shape {np.shape(difference)}; give {self.num_channels} voltages, one frame."
            )
        if not has_values(difference, self.root_weight):
            return self.root_weight * jnp.asarray(difference)[self.channels]
        data = self.root_weight * np.asarray(difference)[self.channels]
        if not np.isfinite(data).all():
            raise ValueError("difference has NaN or infinite voltages in channels in use; mask them.")
        return as_array(data)

    def matrix(self, hyperparameter) -> Float[Array, "m M"]:
        """Reconstruction matrix: change of conductivity per volt, zero for channels not in use."""
        if not has_values(self.spectrum, self.root_weight, hyperparameter):
            used = jnp.asarray(self.spectrum.reconstruction(hyperparameter)) * self.root_weight
            return jnp.zeros((used.shape[0], self.num_channels), used.dtype).at[:, self.channels].set(used)
        images, weights = self.factors(hyperparameter)
        return as_array(images @ weights)

    def factors(self, hyperparameter) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "k M"]]:
        """Factors of the reconstruction matrix: images (m, k), and their weights (k, M) in 1 / volts. Not available for
        traced problems."""
        assert isinstance(self.spectrum, Spectrum)
        known, chosen = on_host((self.spectrum, hyperparameter))  # NumPy arrays are not copied
        images, whitened = (np.asarray(part) for part in known.factors(chosen))
        weights: Any = np.zeros((whitened.shape[0], self.num_channels), whitened.dtype)
        weights[:, self.channels] = whitened * self.root_weight
        return images, weights


def combined_blocks(
    model: ForwardModel, conductivity, channels: Int[np.ndarray, " K"], weights: Float[Any, "r K"]
) -> Iterator[tuple[slice, Any]]:
    """Iterate over blocks of b cells, to limit memory, and yield the cells and the weighted sums (r, b) of the
    channels' Jacobians there, in NumPy.

    `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
    """
    fields = evaluate(model, fields_and_impedance_of, check_conductivity(model.mesh, conductivity))[0]
    mesh, protocol, fields = on_host((model.mesh, model.protocol.subset(channels), fields))
    electrodes = protocol.num_electrodes
    if electrodes * (electrodes + 1) // 2 < len(channels):
        # There are fewer products of fields than channels: ∂v = -Σ_ab d_a m_b ∫ ∇u_a · ∇u_b.
        weights, blocks = -weights @ _linear_forms(model.protocol, channels), field_products(mesh, fields)
    else:
        blocks = jacobian_blocks(mesh, protocol, fields)
    for cells, block in blocks:
        yield cells, weights @ np.asarray(block)


def combined_jacobian(
    model: ForwardModel, conductivity, channels: Int[np.ndarray, " K"], weights: Float[Any, "r K"]
) -> Inexact[Any, "r m"]:
    """Weighted sums (r, m) of the channels' Jacobians; `conductivity` in S/m (2-D: S)."""
    kind = complex if np.iscomplexobj(conductivity) else float
    found = np.empty((len(weights), model.mesh.num_cells), kind)
    for cells, block in combined_blocks(model, conductivity, channels, weights):
        found[:, cells] = block
    return found


def used_channels(model: ForwardModel, noise, mask) -> tuple[np.ndarray, Float[Array, " K"]]:
    """Indices (K,) of the channels in use, and the reciprocals (K,) of their noise, 1 / volts. Raises `ValueError` for
    an invalid mask or noise."""
    check_mask(mask)
    num_channels = model.protocol.num_measurements
    used = np.ones(num_channels, bool) if mask is None else np.asarray(mask, bool)
    if used.shape != (num_channels,) or not used.any():
        raise ValueError(f"mask must be ({num_channels},) booleans with at least one True: one for each channel.")
    deviation = np.asarray(noise, float) if has_values(noise) else jnp.asarray(noise, float)
    if deviation.shape not in ((), (num_channels,)):
        raise ValueError(
            f"noise has shape {deviation.shape}; give one number, or one for each channel: ({num_channels},)."
        )
    deviation = namespace(deviation).broadcast_to(deviation, (num_channels,))[used]
    if has_values(deviation) and not (np.isfinite(deviation) & (deviation > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    return np.flatnonzero(used), 1 / deviation


def check_mask(mask) -> None:
    """Raise `ValueError` for a traced mask, because the number of channels in use must be known."""
    instead = "give it as an array of NumPy, outside; to weigh channels by what is traced, give noise"
    check_has_values("mask", mask, "which channels are used depends on", instead)


def data_directions(protocol: Protocol, channels, root_weight) -> Float[np.ndarray, "K r"]:
    """Orthonormal basis of the changes of whitened data that changes of conductivity can cause. Its dimension is at
    most L(L - 1)/2 for L electrodes, because all channels are combinations of that many transfer impedances.

    For a drive d and a measurement m, which sum to zero, and a symmetric matrix G (the transfer impedance or its
    derivative), Σ_ab d_a m_b G_ab = Σ_a<b (d_a m_b + d_b m_a)(G_ab - (G_aa + G_bb)/2).
    """
    directions, size, _ = np.linalg.svd(
        root_weight[:, None] * _pair_coefficients(protocol, channels), full_matrices=False
    )
    return directions[:, size > _RANK_TOLERANCE * size[0]]


def _traced_directions(protocol: Protocol, channels, root_weight) -> Float[Array, "K r"]:
    """`data_directions`, differentiable with respect to the weights; the identity if the protocol is traced."""
    if not has_values(protocol):
        return jnp.eye(len(channels))
    directions, size, _ = np.linalg.svd(_pair_coefficients(protocol, channels), full_matrices=False)
    return jnp.linalg.qr(root_weight[:, None] * directions[:, size > _RANK_TOLERANCE * size[0]])[0]


def _pair_coefficients(protocol: Protocol, channels) -> Float[np.ndarray, "K e"]:
    """Coefficients (K, e) of the channels for each of the e pairs of electrodes."""
    first, second = np.triu_indices(protocol.num_electrodes)
    return _linear_forms(protocol, channels)[:, first < second]


def _linear_forms(protocol: Protocol, channels) -> Float[np.ndarray, "K f"]:
    """Coefficients (K, f) of the channels as linear forms of the upper triangle, including the diagonal, of a symmetric
    matrix between electrodes."""
    drive = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)[channels]]
    measurement = np.asarray(protocol.measurement)[np.asarray(protocol.measurement_index)[channels]]
    first, second = np.triu_indices(protocol.num_electrodes)
    both = drive[:, first] * measurement[:, second] + drive[:, second] * measurement[:, first]
    return np.where(first < second, both, both / 2)
