"""One-step (linear) difference imaging: a reconstruction matrix, computed once, times a difference of frames."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.hyperparameter import Spectrum, choose
from jeit.inverse.priors import AbstractPrior, Noser
from jeit.mesh import Mesh


class LinearReconstruction(eqx.Module):
    """A linear image reconstruction: change of conductivity = matrix · change of voltages.

    **Fields**: `mesh`; `matrix` (m, M), siemens per metre (2-D: siemens) per volt, zero in the columns of masked
    channels; `hyperparameter` λ, and `rule`, how it was chosen; `method`, the name of the reconstruction.
    """

    mesh: Mesh
    matrix: Float[Array, "m M"]
    hyperparameter: Float[Array, ""]
    rule: str = eqx.field(static=True)
    method: str = eqx.field(static=True)

    def image(self, difference: Float[Array, "*frames M"]) -> Float[Array, "*frames m"]:
        """Change of conductivity in every cell, for one difference of frames (M,) in volts or many (F, M)."""
        difference = jnp.asarray(difference)
        if difference.ndim not in (1, 2) or difference.shape[-1] != self.matrix.shape[1]:
            raise ValueError(
                f"difference has shape {difference.shape}; this reconstruction takes ({self.matrix.shape[1]},) volts, "
                f"or (frames, {self.matrix.shape[1]})."
            )
        return _apply(self.matrix, difference)


@jax.jit
def _apply(matrix, difference):
    return difference @ matrix.T


def one_step(
    model: ForwardModel,
    conductivity,
    *,
    prior: AbstractPrior | None = None,
    hyperparameter: float | str = "noise-figure",
    difference: Float[Array, " M"] | None = None,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Reconstruction matrix of the linearised problem, R = (JᵀWJ + λ²Q)⁻¹JᵀW, at a background conductivity.

    `prior`: `Noser()` unless given. `hyperparameter`: λ itself, or the rule that chooses it, one of
    `jeit.inverse.RULES`; rules that look at data need `difference`, the change of voltages (M,) to be imaged.
    `noise`: standard deviation of the channels, W = noise⁻²; one number or (M,), in volts (or relative to each
    other). `mask`: True for the channels to use. Raises `ValueError` for arguments that do not fit.

    Computed in data space: R = ΓJᵀ(JΓJᵀ + λ²W⁻¹)⁻¹ with Γ = Q⁻¹; see `jeit.inverse.priors` for a Q with a null
    space. Adler and Guardo, IEEE Trans. Med. Imaging 15 (1996) 170-179.
    """
    prior = Noser() if prior is None else prior
    jacobian = model.jacobian(conductivity)
    num_channels = jacobian.shape[0]
    used = np.ones(num_channels, bool) if mask is None else np.asarray(mask, bool)
    if used.shape != (num_channels,) or not used.any():
        raise ValueError(f"mask must be ({num_channels},) booleans with at least one True: one for each channel.")
    deviation = np.broadcast_to(np.asarray(noise, float), (num_channels,))
    if not (np.isfinite(deviation[used]) & (deviation[used] > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    root_weight = jnp.asarray(1 / deviation[used])
    whitened = root_weight[:, None] * jacobian[used]
    data = None if difference is None else root_weight * jnp.asarray(difference)[used]
    product = prior.covariance_product(model.mesh, whitened)
    null_space = prior.null_space(model.mesh)
    spectrum = Spectrum.create(whitened, product, null_space)
    chosen, rule = choose(spectrum, hyperparameter, data)
    narrow = spectrum.reconstruction(chosen) * root_weight
    matrix = jnp.zeros((model.mesh.num_cells, num_channels)).at[:, np.flatnonzero(used)].set(narrow)
    return LinearReconstruction(model.mesh, matrix, chosen, rule, f"one-step, {type(prior).__name__} prior")
