"""Linear image reconstruction: one Gauss-Newton step with a prior, and back-projection."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact, Int
from numpy.typing import ArrayLike

from jeit.arguments import brief, check_has_values
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.hyperparameter.choice import RULE, Choice
from jeit.inverse.hyperparameter.rules import Rule, choose
from jeit.inverse.linearisation import Linearisation
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.spectrum import Spectrum
from jeit.mesh import Mesh
from jeit_solvers.engines import as_array, has_values, is_forked, on_device, on_host, product_for_jax

# Approximate number of cells used to find which channels have proportional columns.
_NUM_SAMPLED_CELLS = 4000


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["mesh", "first", "second", "ratio", "weights", "hyperparameter", "choice", "mixing"],
    meta_fields=["num_measurements", "rule", "method"],
)
@dataclass(frozen=True, eq=False)
class LinearReconstruction:
    """A linear image reconstruction: change of conductivity = matrix · change of voltages.

    Two reciprocal channels (v_b = r v_a) have proportional columns in the matrix, so they are added before the product,
    which halves the arithmetic. If the matrix has a lower rank r than there are combined channels, these are first
    reduced to r combinations.

    **Fields**: `mesh`; `first`, `second` (K,): channels added to form each combined channel; `ratio` (K,): weight of
    the second; `weights` (K, m): S/m (2-D: S) per volt of combined channel, or (r, m) if there is a `mixing`; `mixing`
    (K, r): matrix that reduces the combined channels, or None; `hyperparameter`: λ; `rule`: how λ was chosen;
    `method`: name of the reconstruction; `choice`: curves used in choosing λ and a note on their reliability
    (`choice.note`), or None if the method chooses λ differently; `num_measurements`: number of channels M.

    **Example:**

    ```python
    reconstruction = one_step(model, 1.0, hyperparameter=0.1)
    reconstruction.matrix.shape, reconstruction.image(change)
    ```
    """

    mesh: Mesh
    first: Int[Array, " K"]
    second: Int[Array, " K"]
    ratio: Float[Array, " K"]
    weights: Inexact[Array, "K m"]
    hyperparameter: Float[Array, ""]
    num_measurements: int
    rule: str
    method: str
    choice: Choice | None = None
    mixing: Inexact[Array, "K r"] | None = None

    def __repr__(self) -> str:
        return brief(
            lambda: (
                f"LinearReconstruction({self.method}: {self.num_measurements} channels to {self.mesh.num_cells} cells, "
                f"hyperparameter {float(self.hyperparameter):.3g} ({self.rule}))"
            ),
            self,
        )

    @classmethod
    def of_factors(
        cls,
        model: ForwardModel,
        factors: tuple[Inexact[np.ndarray, "m r"], Inexact[np.ndarray, "r M"]],
        hyperparameter: ArrayLike,
        rule: str,
        method: str,
        choice: Choice | None = None,
    ):
        """Create from images (m, r) and weights (r, M), whose product is the reconstruction matrix. The product is
        formed only if it is smaller than the factors."""
        images, weights = factors
        some = images[
            :: max(1, len(images) // _NUM_SAMPLED_CELLS)
        ]  # channels are proportional in every cell or in none
        first, second, ratio = _proportional_channels(model, some @ weights)
        tied = (weights.T[first] + ratio[:, None] * weights.T[second]) / (1 + ratio**2)[:, None]
        rows, mixing = (images.T, tied) if len(first) > images.shape[1] else (tied @ images.T, None)
        places = as_array(first), as_array(second), as_array(ratio)
        number = weights.shape[1]
        mixed = None if mixing is None else as_array(mixing)
        given = as_array(rows), as_array(hyperparameter, float), number, rule, method, choice, mixed
        return cls(model.mesh, *places, *given)

    @classmethod
    def create(
        cls,
        model: ForwardModel,
        matrix: Inexact[Array | np.ndarray, "m M"],
        hyperparameter: ArrayLike,
        rule: str,
        method: str,
        choice: Choice | None = None,
    ):
        """Create from a full reconstruction matrix (m, M)."""
        if not has_values(model.protocol, matrix, hyperparameter):
            # It is unknown which columns of a traced matrix are proportional, so no channels are combined.
            every, nothing = jnp.arange(matrix.shape[1]), jnp.zeros(matrix.shape[1])
            given = every, every, nothing, jnp.asarray(matrix).T, jnp.asarray(hyperparameter, float)
            return cls(model.mesh, *given, matrix.shape[1], rule, method, choice)
        matrix = np.asarray(matrix)
        first, second, ratio = _proportional_channels(model, matrix)
        # The weighted mean of two proportional columns is used: for small λ their rounding errors are large and
        # opposite.
        tied = matrix.T[first] + ratio[:, None] * matrix.T[second]
        weights = tied / (1 + ratio**2)[:, None]
        return cls(
            model.mesh,
            as_array(first),
            as_array(second),
            as_array(ratio),
            as_array(weights),
            as_array(hyperparameter, float),
            matrix.shape[1],
            rule,
            method,
            choice,
        )

    @property
    def matrix(self) -> Inexact[Array, "m M"]:
        """Full reconstruction matrix (m, M), zero in the columns of masked channels."""
        weights = self.weights if self.mixing is None else self.mixing @ self.weights
        full = jnp.zeros((self.num_measurements, weights.shape[1]), weights.dtype)
        full = full.at[self.second].add(self.ratio[:, None] * weights)
        return full.at[self.first].add(weights).T

    def image(self, difference: Inexact[Array | np.ndarray, "*frames M"]) -> Inexact[Array, "*frames m"]:
        """Change of conductivity in every cell, for one difference of frames (M,) or several (F, M), in volts.

        Raises `ValueError` for another number of channels, and for NaN or infinite voltages.
        """
        shape = np.shape(difference)
        if len(shape) not in (1, 2) or shape[-1] != self.num_measurements:
            raise ValueError(
                f"difference has shape {shape}; this reconstruction takes ({self.num_measurements},) volts, or "
                f"(frames, {self.num_measurements})."
            )
        if not has_values(difference, self._parts):
            return jax.jit(_image_product)(self._parts, difference)
        voltages = np.asarray(difference)
        if voltages.dtype.kind not in "iufc":
            raise ValueError(f"difference is {voltages.dtype}; give numbers, in volts.")
        if not np.isfinite(voltages).all():
            raise ValueError("difference has NaN or infinite voltages; put zeros in masked channels.")
        first, second, ratio, mixing, weights = self._parts
        combined = _combine_channels(voltages, first, second, ratio, mixing)
        return on_device(combined @ weights) if is_forked() else product_for_jax(combined, weights)

    @functools.cached_property
    def _parts(self) -> tuple[Any, ...]:
        """Arrays used by `image`, converted to NumPy once, because a conversion takes as long as the product."""
        parts = (self.first, self.second, self.ratio, self.mixing, self.weights)
        return on_host(parts) if has_values(parts) else parts


def _image_product(parts, difference) -> Any:
    *channels, weights = parts
    return _combine_channels(difference, *channels) @ weights


def _combine_channels(difference, first, second, ratio, mixing) -> Any:
    combined = difference[..., first] + ratio * difference[..., second]
    return combined if mixing is None else combined @ mixing


def _proportional_channels(model: ForwardModel, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Channels `first` and `second` to add before the product, and the `ratio` of their columns: reciprocal pairs with
    proportional columns, and all other channels alone, with ratio 0."""
    size = np.linalg.norm(matrix, axis=0)
    alone = size > 0
    pairs, _ = model.protocol.reciprocal_pairs()
    pairs = np.asarray(pairs).reshape(-1, 2)
    first, second = pairs[(size[pairs] > 0).all(axis=1)].T
    ratio = np.einsum("ij,ij->j", matrix[:, first].conj(), matrix[:, second]).real / size[first] ** 2
    tied = np.abs(matrix[:, second] - ratio * matrix[:, first]).max(axis=0) < 1e-9 * np.abs(matrix).max()
    first, second, ratio = first[tied], second[tied], ratio[tied]
    alone[first] = alone[second] = False
    single = np.flatnonzero(alone)
    return (
        np.concatenate([first, single]),
        np.concatenate([second, single]),
        np.concatenate([ratio, np.zeros(len(single))]),
    )


@np.errstate(all="ignore")  # numbers that overflow are reported below
def one_step(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    prior: AbstractPrior | None = None,
    hyperparameter: float | str | Rule | Choice = RULE,
    difference: Inexact[Array, " M"] | None = None,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Reconstruction matrix of the linearised problem, R = (JᵀWJ + λ²Q)⁻¹JᵀW, at a background conductivity.

    A complex `conductivity` is an admittivity σ + iωε; voltages and image are then complex. Both parts have the same
    prior, and `noise` is the standard deviation of each part. With a real background, real and imaginary part of
    complex voltages are imaged separately.

    If λ is a number, the function and the image are differentiable and work inside `jax.grad`, `jax.vmap` and
    `jax.jit`. A rule for λ or a mask depends on values and must be evaluated outside.

    Computed in data space: R = ΓJᵀ(JΓJᵀ + λ²W⁻¹)⁻¹ with Γ = Q⁻¹; see `jeit.inverse.prior.priors` for a Q with a null
    space. Adler and Guardo, IEEE Trans. Med. Imaging 15 (1996) 170-179.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `prior`: default `Noser()`.
    - `hyperparameter`: λ, a rule in `jeit.inverse.RULES` that chooses it, or a `Choice`.
    - `difference` (M,): change of voltages to be imaged, volts, required by rules that use data.
    - `noise`: standard deviation of the channels, W = noise⁻²; one number or (M,), in volts (or relative to each
      other).
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for arguments that do not fit together.

    **Example:**

    ```python
    image = one_step(model, 1.0, hyperparameter=0.1).image(change)
    ```
    """
    linear = Linearisation.create(model, conductivity, prior=prior, noise=noise, mask=mask)
    data = None if difference is None else linear.whiten(difference)
    choice = choose(linear.spectrum, hyperparameter, data, model.mesh)
    if has_values(choice) and not (np.isfinite(choice.hyperparameter) and choice.hyperparameter > 0):
        raise ValueError(
            f"hyperparameter: the rule '{choice.rule}' finds none, for numbers overflow; are noise and conductivity in "
            "volts and S/m (2-D: S)?"
        )
    method = f"one-step, {type(linear.prior).__name__} prior"
    found = choice.hyperparameter, choice.rule, method, choice
    if isinstance(linear.spectrum, Spectrum) and has_values(choice.hyperparameter):
        factors = linear.factors(choice.hyperparameter)
        del linear  # frees memory, which would not hold both for a large body
        return LinearReconstruction.of_factors(model, factors, *found)
    return LinearReconstruction.create(model, linear.matrix(choice.hyperparameter), *found)


def back_projection(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    filtered: bool = False,
    hyperparameter: float = 0.05,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Back-projection of voltage differences along the bands between equipotential lines of every drive.

    The relative change of a channel is assigned to the cells whose potential, under the channel's drive, lies between
    the potentials of its two measuring electrodes. The image of a cell is the mean over the channels that reach it
    (Barber and Brown, J. Phys. E 17 (1984) 723-733), scaled so that a uniform change of conductivity is imaged exactly.
    A filtered image is sharper but noisier: its matrix is B F, where B is the matrix above and F minimises ‖JBFv - v‖²
    + λ²‖JB‖²‖Fv‖², so that the Jacobian J maps the image to nearly the data.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `filtered`: whether to filter the data before they are projected.
    - `hyperparameter`: λ of the filter.
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for protocols whose measurements use more than two electrodes, where no band is defined.

    **Example:**

    ```python
    image = back_projection(model, 1.0).image(change)
    ```
    """
    check_model(model)
    instead = (
        "work it out once outside: its image() is what JAX transforms; or take one_step, which can be differentiated"
    )
    check_has_values("model or conductivity", (model, conductivity), "its bands are drawn from", instead)
    protocol = model.protocol
    used = np.ones(protocol.num_measurements, bool) if mask is None else np.asarray(mask, bool)
    if used.shape != (protocol.num_measurements,) or not used.any():
        raise ValueError(f"mask must be ({protocol.num_measurements},) booleans with at least one True.")
    measurement = np.asarray(protocol.measurement)
    if (np.count_nonzero(measurement, axis=1) != 2).any():
        raise ValueError(
            f"Back-projection needs measurements between two electrodes each; protocol '{protocol.name}' has others. "
            "Use one_step, which takes any protocol."
        )
    voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
    nodal = np.asarray(model.potentials(conductivity))
    cells = np.asarray(model.mesh.cells)
    potential = nodal[:, cells].mean(axis=2)  # (S, m)
    electrode = np.asarray(protocol.drive @ model.transfer_impedance(conductivity))  # (S, L)
    first, second = (measurement > 0).argmax(axis=1), (measurement < 0).argmax(axis=1)
    drive, pair = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    ends = np.stack([electrode[drive, first[pair]], electrode[drive, second[pair]]])
    band = (potential[drive] >= ends.min(axis=0)[:, None]) & (potential[drive] < ends.max(axis=0)[:, None])
    band = (band & used[:, None]).T.astype(float)  # (m, M)
    reached = np.maximum(band.sum(axis=1), 1)
    # Scale: a uniform relative change δ of conductivity changes every voltage by the relative amount -δ.
    scale = np.broadcast_to(np.asarray(conductivity, float), (model.mesh.num_cells,))
    smear = -(scale / reached)[:, None] * band / np.where(used & (voltages != 0), voltages, np.inf)
    if not filtered:
        return LinearReconstruction.create(model, smear, np.nan, "none", "back-projection")
    kept = np.flatnonzero(used)
    seen = jacobian[kept] @ smear[:, kept]
    damping = (hyperparameter * np.linalg.norm(seen, 2)) ** 2
    matrix = np.zeros_like(smear)
    filter_matrix = np.linalg.solve(seen.T @ seen + damping * np.eye(len(kept)), seen.T)
    matrix[:, kept] = smear[:, kept] @ filter_matrix
    return LinearReconstruction.create(model, matrix, hyperparameter, "given", "filtered back-projection")
