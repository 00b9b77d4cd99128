"""The linearised problem of difference imaging: checked, whitened and decomposed, ready for any hyperparameter."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.prior.checks import check_prior
from jeit.inverse.prior.defaults import PRIOR
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.spectrum import Spectrum
from jeit.protocol import Protocol
from jeit_solvers.engines import as_array, host

# Singular values so small, beside the largest, are rounding.
_NOTHING = 1e-12


class Linearisation(eqx.Module):
    """v = J x at a background conductivity, divided by the noise, for the channels in use.

    **Fields**: `spectrum` of the problem; `prior`; `channels` (K,) in use; `root_weight` (K,), 1 / their standard
    deviation; `num_channels` M of the protocol.
    """

    spectrum: Spectrum
    prior: AbstractPrior
    channels: Int[np.ndarray, " K"]
    root_weight: Float[np.ndarray, " K"]
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
        """At `conductivity`; arguments as in `one_step`. Raises `ValueError` for those that do not fit."""
        prior = PRIOR if prior is None else prior
        check_model(model)
        check_prior(prior)
        if not prior.is_quadratic:
            raise ValueError(
                f"prior: {type(prior).__name__} is not quadratic, so there is no linear image with it, nor a rule for "
                "its weight; take Noser(), Gaussian(length), Laplace() or Tikhonov(), or reconstruct with this one."
            )
        if jnp.iscomplexobj(conductivity):
            raise ValueError("conductivity is complex; linear images are of real ones: give its real part.")
        if np.shape(conductivity) not in ((), (model.mesh.num_cells,)):
            raise ValueError("conductivity: give one number, or one value per cell: the image has a value per cell.")
        channels, root_weight = used_channels(model, noise, mask)
        whitened = root_weight[:, None] * host.asarray(model.jacobian(conductivity))[channels]
        directions = _directions(model.protocol, channels, root_weight)
        product = prior.covariance_product(model.mesh, directions.T @ whitened) @ directions.T
        spectrum = Spectrum.create(whitened, product, prior.null_space(model.mesh))
        return cls(spectrum, prior, channels, root_weight, model.protocol.num_measurements)

    def whiten(self, difference: ArrayLike) -> Float[Array, " K"]:
        """A change of voltages (M,) in standard deviations, channels in use only.

        Raises `ValueError` for another number of channels, and for NaN in channels in use.
        """
        if np.shape(difference) != (self.num_channels,) or np.iscomplexobj(difference):
            raise ValueError(
                f"difference has shape {np.shape(difference)}; give {self.num_channels} real voltages, one frame."
            )
        data = self.root_weight * np.asarray(difference)[self.channels]
        if not np.isfinite(data).all():
            raise ValueError("difference has NaN or infinite voltages in channels in use; mask them.")
        return as_array(data)

    def matrix(self, hyperparameter) -> Float[np.ndarray, "m M"]:
        """The reconstruction matrix: change of conductivity per volt, zero for channels not in use."""
        whitened = np.asarray(self.spectrum.reconstruction(hyperparameter))
        matrix = np.zeros((whitened.shape[0], self.num_channels))
        matrix[:, self.channels] = whitened * self.root_weight
        return matrix


def used_channels(model: ForwardModel, noise, mask) -> tuple[np.ndarray, np.ndarray]:
    """Indices (K,) of the channels in use, and 1 / their noise (K,), 1 / volts; raises `ValueError`."""
    num_channels = model.protocol.num_measurements
    used = np.ones(num_channels, bool) if mask is None else np.asarray(mask, bool)
    if used.shape != (num_channels,) or not used.any():
        raise ValueError(f"mask must be ({num_channels},) booleans with at least one True: one for each channel.")
    deviation = np.asarray(noise, float)
    if deviation.shape not in ((), (num_channels,)):
        raise ValueError(
            f"noise has shape {deviation.shape}; give one number, or one for each channel: ({num_channels},)."
        )
    deviation = np.broadcast_to(deviation, (num_channels,))[used]
    if not (np.isfinite(deviation) & (deviation > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    return np.flatnonzero(used), 1 / deviation


def _directions(protocol: Protocol, channels, root_weight) -> Float[np.ndarray, "K r"]:
    """An orthonormal basis of all that changes of conductivity can do to whitened data: L electrodes have L(L - 1)/2
    transfer impedances, of which all channels are combinations, however many.

    Drive d and measurement m, which sum to zero, see Σ_ab d_a m_b G_ab = Σ_a<b (d_a m_b + d_b m_a)(G_ab - (G_aa +
    G_bb)/2) of a symmetric G, be it the transfer impedance or its derivative.
    """
    drive = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)[channels]]
    measurement = np.asarray(protocol.measurement)[np.asarray(protocol.measurement_index)[channels]]
    first, second = np.triu_indices(protocol.num_electrodes, 1)
    seen = drive[:, first] * measurement[:, second] + drive[:, second] * measurement[:, first]
    directions, size, _ = np.linalg.svd(root_weight[:, None] * seen, full_matrices=False)
    return directions[:, size > _NOTHING * size[0]]
