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

from jeit.arguments import check_has_values, object_text
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.hyperparameter.choice import DEFAULT_RULE, Choice
from jeit.inverse.hyperparameter.rules import Rule, choose
from jeit.inverse.linearisation import Linearisation, channel_mask
from jeit.inverse.prior.priors import AbstractPrior
from jeit.inverse.spectrum import Spectrum
from jeit.mesh import Mesh
from jeit_solvers.engines import (
    add_into,
    as_array,
    has_values,
    is_forked,
    on_device,
    on_host,
    product_for_jax,
    sum_into,
    values_at_once,
)

# Approximate number of cells used to find the channels with proportional columns in the reconstruction matrix.
_NUM_SAMPLED_CELLS = 4000
# Number of rows of the matrix for which the noise of the image is computed at once.
_ROWS_AT_ONCE = 32


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["mesh", "first", "second", "ratio", "weights", "hyperparameter", "choice", "mixing"],
    meta_fields=["num_measurements", "rule", "method"],
)
@dataclass(frozen=True, eq=False)
class LinearReconstruction:
    """A linear image reconstruction: change of conductivity = matrix · change of voltages.

    Two reciprocal channels (v_b = ratio · v_a) have proportional columns in the matrix. The voltages of the two
    channels are added before the product, the second with a weight, which halves the arithmetic. If the rank r of the
    matrix is lower than the number K of combined channels, the combined channels are first reduced to r combinations.

    **Fields**: `mesh`; `first`, `second` (K,): channels added to form each combined channel; `ratio` (K,): weight of
    the second channel; `weights` (K, m): change of conductivity in S/m (2-D: S) per volt of each combined channel, or
    (r, m) if there is a `mixing`; `mixing` (K, r): matrix that reduces the combined channels, or None;
    `hyperparameter`: λ; `rule`: how λ was chosen; `method`: name of the reconstruction; `choice`: curves from which λ
    was chosen and a note on the reliability of the choice (`choice.note`), or None if the method chooses λ differently;
    `num_measurements`: number of channels M.

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
        return object_text(
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
        """Create a linear reconstruction from two `factors`, images (m, r) and weights (r, M), whose product is the
        reconstruction matrix. The product is formed only if it is smaller than the factors."""
        images, channel_weights = factors
        # Columns of two channels are proportional in every cell or in none, so a sample of the cells suffices.
        sampled_images = images[:: max(1, len(images) // _NUM_SAMPLED_CELLS)]
        first_channels, second_channels, channel_ratios = _find_proportional_channels(
            model, sampled_images @ channel_weights
        )
        combined_weights = (
            channel_weights.T[first_channels] + channel_ratios[:, None] * channel_weights.T[second_channels]
        ) / (1 + channel_ratios**2)[:, None]
        image_factor, mixing_matrix = (
            (images.T, combined_weights)
            if len(first_channels) > images.shape[1]
            else (combined_weights @ images.T, None)
        )
        channel_pairs = as_array(first_channels), as_array(second_channels), as_array(channel_ratios)
        num_measurements = channel_weights.shape[1]
        device_mixing = None if mixing_matrix is None else as_array(mixing_matrix)
        reconstruction_fields = (
            as_array(image_factor),
            as_array(hyperparameter, float),
            num_measurements,
            rule,
            method,
            choice,
            device_mixing,
        )
        return cls(model.mesh, *channel_pairs, *reconstruction_fields)

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
        """Create a linear reconstruction from a full reconstruction matrix (m, M)."""
        if not has_values(model.protocol, matrix, hyperparameter):
            # It is unknown which columns of a traced matrix are proportional, so no channels are combined.
            all_channels, zero_ratios = jnp.arange(matrix.shape[1]), jnp.zeros(matrix.shape[1])
            traced_fields = (
                all_channels,
                all_channels,
                zero_ratios,
                jnp.asarray(matrix).T,
                jnp.asarray(hyperparameter, float),
            )
            return cls(model.mesh, *traced_fields, matrix.shape[1], rule, method, choice)
        matrix = np.asarray(matrix)
        first_channels, second_channels, channel_ratios = _find_proportional_channels(model, matrix)
        # Both columns of reciprocal channels are replaced by a weighted mean: for small λ their rounding errors are
        # large and opposite.
        summed_columns = matrix.T[first_channels] + channel_ratios[:, None] * matrix.T[second_channels]
        pair_weights = summed_columns / (1 + channel_ratios**2)[:, None]
        return cls(
            model.mesh,
            as_array(first_channels),
            as_array(second_channels),
            as_array(channel_ratios),
            as_array(pair_weights),
            as_array(hyperparameter, float),
            matrix.shape[1],
            rule,
            method,
            choice,
        )

    @property
    def matrix(self) -> Inexact[Array, "m M"]:
        """Full reconstruction matrix (m, M), zero in the columns of masked channels."""
        return _full_matrix(self)

    def image(self, difference: Inexact[Array | np.ndarray, "*frames M"]) -> Inexact[Array, "*frames m"]:
        """Change of conductivity in every cell, (m,) or (F, m), for one difference of frames (M,) or several (F, M), in
        volts.

        Raises `ValueError` for the wrong number of channels, and for NaN or infinite voltages.
        """
        difference_shape = np.shape(difference)
        if len(difference_shape) not in (1, 2) or difference_shape[-1] != self.num_measurements:
            raise ValueError(
                f"difference has shape {difference_shape}; this reconstruction takes ({self.num_measurements},) volts, "
                f"or (frames, {self.num_measurements})."
            )
        if not has_values(difference, self._numpy_arrays):
            return jax.jit(_image_product)(self._numpy_arrays, difference)
        voltages = np.asarray(difference)
        if voltages.dtype.kind not in "iufc":
            raise ValueError(f"difference is {voltages.dtype}; give numbers, in volts.")
        if not np.isfinite(voltages).all():
            raise ValueError("difference has NaN or infinite voltages; put zeros in masked channels.")
        first_channels, second_channels, channel_ratios, mixing_matrix, pair_weights = self._numpy_arrays
        combined_difference = _combine_channels(
            voltages, first_channels, second_channels, channel_ratios, mixing_matrix
        )
        return (
            on_device(combined_difference @ pair_weights)
            if is_forked()
            else product_for_jax(combined_difference, pair_weights)
        )

    def image_noise(self, noise: Float[Array | np.ndarray, " M"]) -> Float[np.ndarray, " m"]:
        """Standard deviation (m,) of the image in every cell, S/m (2-D: S), due to independent errors of the channels
        with the standard deviations `noise` (M,), volts. Raises `ValueError` for the wrong number of channels."""
        noise_deviations = np.asarray(noise)
        if noise_deviations.shape != (self.num_measurements,):
            raise ValueError(
                f"noise has shape {noise_deviations.shape}; give a voltage for each of {self.num_measurements}."
            )
        first_channels, second_channels, channel_ratios, mixing_matrix, pair_weights = self._numpy_arrays
        combined_noise = np.hypot(noise_deviations[first_channels], channel_ratios * noise_deviations[second_channels])
        variance = np.zeros(pair_weights.shape[1])
        for first_row in range(0, len(combined_noise), _ROWS_AT_ONCE):
            row_slice = slice(first_row, first_row + _ROWS_AT_ONCE)
            gain_rows = pair_weights[row_slice] if mixing_matrix is None else mixing_matrix[row_slice] @ pair_weights
            variance += combined_noise[row_slice] ** 2 @ np.abs(gain_rows) ** 2
        return np.sqrt(variance)

    @functools.cached_property
    def _numpy_arrays(self) -> tuple[Any, ...]:
        """Arrays used by `image`, converted to NumPy only once, because a conversion takes as long as the product."""
        factor_arrays = (self.first, self.second, self.ratio, self.mixing, self.weights)
        return on_host(factor_arrays) if has_values(factor_arrays) else factor_arrays


@values_at_once
def _full_matrix(reconstruction: LinearReconstruction) -> Inexact[Array, "m M"]:
    pair_weights = (
        reconstruction.weights if reconstruction.mixing is None else reconstruction.mixing @ reconstruction.weights
    )
    full_matrix = sum_into(
        (reconstruction.num_measurements, pair_weights.shape[1]),
        reconstruction.second,
        reconstruction.ratio[:, None] * pair_weights,
    )
    return add_into(full_matrix, reconstruction.first, pair_weights).T


def _image_product(factor_arrays, difference) -> Any:
    *channel_arrays, pair_weights = factor_arrays
    return _combine_channels(difference, *channel_arrays) @ pair_weights


def _combine_channels(difference, first_channels, second_channels, channel_ratios, mixing_matrix) -> Any:
    combined_difference = difference[..., first_channels] + channel_ratios * difference[..., second_channels]
    return combined_difference if mixing_matrix is None else combined_difference @ mixing_matrix


def _find_proportional_channels(model: ForwardModel, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Channels `first_channels` and `second_channels` that are added before the product with the matrix, and the
    `column_ratios`. The pairs are reciprocal channels with proportional columns; every other channel is used
    alone, with ratio 0."""
    column_norms = np.linalg.norm(matrix, axis=0)
    is_unpaired_channel = column_norms > 0
    reciprocal_pairs, _ = model.protocol.reciprocal_pairs()
    reciprocal_pairs = np.asarray(reciprocal_pairs).reshape(-1, 2)
    first_channels, second_channels = reciprocal_pairs[(column_norms[reciprocal_pairs] > 0).all(axis=1)].T
    column_ratios = (
        np.einsum("ij,ij->j", matrix[:, first_channels].conj(), matrix[:, second_channels]).real
        / column_norms[first_channels] ** 2
    )
    is_proportional = (
        np.abs(matrix[:, second_channels] - column_ratios * matrix[:, first_channels]).max(axis=0)
        < 1e-9 * np.abs(matrix).max()
    )
    first_channels, second_channels, column_ratios = (
        first_channels[is_proportional],
        second_channels[is_proportional],
        column_ratios[is_proportional],
    )
    is_unpaired_channel[first_channels] = is_unpaired_channel[second_channels] = False
    unpaired_channels = np.flatnonzero(is_unpaired_channel)
    return (
        np.concatenate([first_channels, unpaired_channels]),
        np.concatenate([second_channels, unpaired_channels]),
        np.concatenate([column_ratios, np.zeros(len(unpaired_channels))]),
    )


@np.errstate(all="ignore")  # numbers that overflow are reported below
def one_step(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    prior: AbstractPrior | None = None,
    hyperparameter: float | str | Rule | Choice = DEFAULT_RULE,
    difference: Inexact[Array, " M"] | None = None,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Reconstruction matrix of the linearised problem, R = (JᵀWJ + λ²Q)⁻¹JᵀW, at a background conductivity.

    A complex `conductivity` is an admittivity σ + iωε; voltages and image are then complex. Real and imaginary part
    have the same prior, and `noise` is the standard deviation of each part. With a real background, real and imaginary
    part of complex voltages are imaged separately.

    If λ is a number, the function and the image are differentiable and work inside `jax.grad`, `jax.vmap` and
    `jax.jit`. A rule for λ or a mask depends on values and must be evaluated outside these transformations.

    The matrix is computed in data space: R = ΓJᵀ(JΓJᵀ + λ²W⁻¹)⁻¹ with the Jacobian J, the prior precision Q = Γ⁻¹ and
    the weights W; see `jeit.inverse.prior.priors` for a Q with a null space. Adler and Guardo, IEEE Trans. Med. Imaging
    15 (1996) 170-179.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `prior`: default `Noser()`.
    - `hyperparameter`: λ, a rule in `jeit.inverse.RULES` that chooses λ, or a `Choice`.
    - `difference` (M,): change of voltages to be imaged, volts, required by rules that use data.
    - `noise`: standard deviation of the channels, W = noise⁻²; one number or (M,), in volts, or up to a common factor.
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for invalid or inconsistent arguments.

    **Example:**

    ```python
    image = one_step(model, 1.0, hyperparameter=0.1).image(change)
    ```
    """
    linearisation = Linearisation.create(model, conductivity, prior=prior, noise=noise, mask=mask)
    whitened_data = None if difference is None else linearisation.whiten(difference)
    choice = choose(linearisation.spectrum, hyperparameter, whitened_data, model.mesh)
    if has_values(choice) and not (np.isfinite(choice.hyperparameter) and choice.hyperparameter > 0):
        raise ValueError(
            f"hyperparameter: the rule '{choice.rule}' finds none, for numbers overflow; are noise and conductivity in "
            "volts and S/m (2-D: S)?"
        )
    method_name = f"one-step, {type(linearisation.prior).__name__} prior"
    result_fields = choice.hyperparameter, choice.rule, method_name, choice
    if isinstance(linearisation.spectrum, Spectrum) and has_values(choice.hyperparameter):
        reconstruction_factors = linearisation.factors(choice.hyperparameter)
        del (
            linearisation
        )  # frees memory, because the problem and the factors of a large body do not fit in memory together
        return LinearReconstruction.of_factors(model, reconstruction_factors, *result_fields)
    return LinearReconstruction.create(model, linearisation.matrix(choice.hyperparameter), *result_fields)


def back_projection(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    filtered: bool = False,
    hyperparameter: float = 0.05,
    mask: Bool[Array, " M"] | None = None,
) -> LinearReconstruction:
    """Reconstruction matrix of back-projection: voltage differences are projected along the bands between equipotential
    lines of every drive.

    The relative change of a channel is assigned to the cells whose potential, under the channel's drive, lies between
    the potentials of its two measuring electrodes. The image of a cell is the mean of the changes assigned to it
    (Barber and Brown, J. Phys. E 17 (1984) 723-733), scaled so that a uniform change of conductivity is imaged exactly.
    A filtered image is sharper but noisier. Its matrix is B F, where B is the unfiltered matrix and F minimises ‖JBFv -
    v‖² + λ²‖JB‖²‖Fv‖², so that the Jacobian J maps the image BFv approximately to the data v.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `filtered`: whether to filter the data before they are projected.
    - `hyperparameter`: λ of the filter.
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for protocols whose measurements use more than two electrodes, for which no band is defined.

    **Example:**

    ```python
    image = back_projection(model, 1.0).image(change)
    ```
    """
    check_model(model)
    advice_to_user = (
        "work it out once outside: its image() is what JAX transforms; or take one_step, which can be differentiated"
    )
    check_has_values("model or conductivity", (model, conductivity), "its bands are drawn from", advice_to_user)
    protocol = model.protocol
    is_used_channel = channel_mask(mask, protocol.num_measurements)
    measurement_patterns = np.asarray(protocol.measurement)
    if (np.count_nonzero(measurement_patterns, axis=1) != 2).any():
        raise ValueError(
            f"Back-projection needs measurements between two electrodes each; protocol '{protocol.name}' has others. "
            "Use one_step, which takes any protocol."
        )
    voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
    node_potentials = np.asarray(model.potentials(conductivity))
    cells = np.asarray(model.mesh.cells)
    cell_potentials = node_potentials[:, cells].mean(axis=2)  # (S, m)
    electrode_potentials = np.asarray(protocol.drive @ model.transfer_impedance(conductivity))  # (S, L)
    first_electrodes, second_electrodes = (
        (measurement_patterns > 0).argmax(axis=1),
        (measurement_patterns < 0).argmax(axis=1),
    )
    drive, electrode_pair = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    band_limits = np.stack(
        [
            electrode_potentials[drive, first_electrodes[electrode_pair]],
            electrode_potentials[drive, second_electrodes[electrode_pair]],
        ]
    )
    is_in_band = (cell_potentials[drive] >= band_limits.min(axis=0)[:, None]) & (
        cell_potentials[drive] < band_limits.max(axis=0)[:, None]
    )
    is_in_band = (is_in_band & is_used_channel[:, None]).T.astype(float)  # (m, M)
    num_bands = np.maximum(is_in_band.sum(axis=1), 1)
    # Scale: a uniform relative change δ of conductivity changes every voltage by the relative amount -δ.
    cell_conductivity = np.broadcast_to(np.asarray(conductivity, float), (model.mesh.num_cells,))
    projection = (
        -(cell_conductivity / num_bands)[:, None]
        * is_in_band
        / np.where(is_used_channel & (voltages != 0), voltages, np.inf)
    )
    if not filtered:
        return LinearReconstruction.create(model, projection, np.nan, "none", "back-projection")
    used_channels = np.flatnonzero(is_used_channel)
    projected_jacobian = jacobian[used_channels] @ projection[:, used_channels]
    damping_term = (hyperparameter * np.linalg.norm(projected_jacobian, 2)) ** 2
    reconstruction_matrix = np.zeros_like(projection)
    filter_matrix = np.linalg.solve(
        projected_jacobian.T @ projected_jacobian + damping_term * np.eye(len(used_channels)), projected_jacobian.T
    )
    reconstruction_matrix[:, used_channels] = projection[:, used_channels] @ filter_matrix
    return LinearReconstruction.create(
        model, reconstruction_matrix, hyperparameter, "given", "filtered back-projection"
    )
