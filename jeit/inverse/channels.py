"""Independent channels of a protocol, and the noise of channels.

The transfer impedance Z (L, L) of a body is symmetric with rows that sum to zero, so it has L (L - 1) / 2 independent
values. A protocol often has more channels, which repeat or combine these values: 208 adjacent channels have 104
independent values, 2356 channels of a tank have 376. The voltages v of all M channels are combinations of the voltages
of r independent channels, v = T v[index] with T (M, r). For measured voltages y with weights W = 1 / noise², the
weighted least-squares estimates ŷ of the independent voltages contain the same information as y,

    ‖W^½ (T u - y)‖² = (u - ŷ)ᵀ G (u - ŷ) + c,   G = TᵀWT,   ŷ = G⁻¹TᵀWy,

where u are predicted independent voltages and c does not depend on u. Least squares with ŷ is much cheaper, because the
work grows with the square of the number of channels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from jeit.protocol import Protocol
from jeit_solvers import lower_cholesky, symmetric_inverse
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled
from jeit_solvers.module import Module

_RANK_TOLERANCE = 1e-9


class Data(Module):
    """Voltages of r independent channels and their noise.

    **Fields**: `voltages` (r,): estimated voltages ŷ, volts; `weight` (r,): weights of the voltages, 1 / volts;
    `covariance`, `precision` (r, r): covariance of weight · ŷ, and its inverse, which has a unit diagonal; `rest`: the
    constant c of `jeit.inverse.channels`, the sum of squared residuals that no conductivity can explain.
    """

    voltages: Float[Array, " r"]
    weight: Float[Array, " r"]
    covariance: Float[Array, "r r"]
    precision: Float[Array, "r r"]
    rest: Float[Array, ""]

    def whiten(self, rows: Float[Array, "r *n"]) -> Float[Array, "r *n"]:
        """Transform values of weighted channels, (r,) or (r, n), so that their noise is independent with unit
        variance."""
        return lower_cholesky(self.precision).T @ rows


class IndependentChannels(Module):
    """Independent channels of a protocol, which determine all other channels: the voltages of any body satisfy v =
    `combination` (M, r) · v[`index` (r,)]."""

    index: Int[Array, " r"]
    combination: Float[Array, "M r"]

    @classmethod
    def create(cls, protocol: Protocol) -> "IndependentChannels":
        """Choose independent channels by a pivoted QR factorisation of the linear map from the transfer impedance Z to
        the voltages of the channels. If the protocol is traced, all channels are used."""
        if not has_values(protocol):
            num_channels = protocol.num_measurements
            return cls(as_array(np.arange(num_channels)), as_array(np.eye(num_channels)))
        drive_patterns, measurement_patterns = (
            np.asarray(protocol.channel_drive),
            np.asarray(protocol.channel_measurement),
        )
        bilinear_forms = drive_patterns[:, :, None] * measurement_patterns[:, None, :]
        row_electrodes, column_electrodes = np.triu_indices(protocol.num_electrodes)
        bilinear_forms = (bilinear_forms + np.swapaxes(bilinear_forms, 1, 2))[:, row_electrodes, column_electrodes]
        form_norms = np.linalg.norm(bilinear_forms, axis=1)
        qr_factorisation: Any = scipy.linalg.qr((bilinear_forms / form_norms[:, None]).T, mode="r", pivoting=True)
        triangular_factor, pivot_order = qr_factorisation[-2:]
        num_independent = int(np.sum(np.abs(np.diag(triangular_factor)) > _RANK_TOLERANCE))
        dependent_coefficients = scipy.linalg.solve_triangular(
            triangular_factor[:num_independent, :num_independent], triangular_factor[:num_independent, num_independent:]
        )
        combination_matrix = np.empty((len(bilinear_forms), num_independent))
        combination_matrix[pivot_order] = (
            np.concatenate([np.eye(num_independent), dependent_coefficients.T])
            / form_norms[pivot_order[:num_independent]]
        )
        combination_matrix *= form_norms[:, None]
        combination_matrix[np.abs(combination_matrix) < _RANK_TOLERANCE * np.abs(combination_matrix).max()] = 0
        ascending_order = np.argsort(pivot_order[:num_independent])
        return cls(
            as_array(pivot_order[:num_independent][ascending_order]), as_array(combination_matrix[:, ascending_order])
        )

    def weigh(self, noise: Float[Array, " M"]) -> "ChannelWeighting":
        """Compute the map from voltages to `Data`; `noise` (M,): standard deviation of the voltages, volts."""
        return _compute_weighing(self.combination, noise)


class ChannelWeighting(Module):
    """Map from voltages (M,) to `Data`, which is the same for all frames of equal noise.

    **Fields**: `noise` (M,): standard deviations, volts; `estimator` (r, M): matrix with ŷ = estimator · y; `weight`,
    `covariance`, `precision`: as in `Data`.
    """

    noise: Float[Array, " M"]
    estimator: Float[Array, "r M"]
    weight: Float[Array, " r"]
    covariance: Float[Array, "r r"]
    precision: Float[Array, "r r"]

    def combine(self, voltages: Float[Array, " M"]) -> Data:
        """Combine voltages (M,) into the estimates ŷ of the independent channels."""
        return _combine_voltages(self, voltages)


@numpy_or_compiled
def _combine_voltages(weighing: ChannelWeighting, voltages) -> Data:
    estimate = weighing.estimator @ voltages
    weighted_estimate = weighing.weight * estimate
    unexplained_sum = (
        (voltages / weighing.noise) ** 2
    ).sum() - weighted_estimate @ weighing.precision @ weighted_estimate
    weights_and_covariances = weighing.weight, weighing.covariance, weighing.precision
    return Data(estimate, *weights_and_covariances, namespace(weighing, voltages).maximum(unexplained_sum, 0))


@numpy_or_compiled
def _compute_weighing(combination, noise) -> ChannelWeighting:
    whitened_combination = combination / noise[:, None]
    precision = whitened_combination.T @ whitened_combination
    inverse_deviations = namespace(precision).sqrt(precision.diagonal())
    precision = precision / (inverse_deviations * inverse_deviations[:, None])
    covariance = symmetric_inverse(precision)
    estimator = (covariance / inverse_deviations[:, None]) @ (
        whitened_combination / inverse_deviations / noise[:, None]
    ).T
    return ChannelWeighting(noise, estimator, inverse_deviations, covariance, precision)


@numpy_or_compiled
def relative_noise(
    voltages: Float[Array, " M"], mask: Bool[Array, " M"] | None = None, *, relative: float = 0.01, floor: float = 0.3
) -> Float[Array, " M"]:
    """Standard deviation of channels whose errors grow with their voltages: relative · √(v² + (floor · median|v|)²).

    In real tanks most errors of difference data are proportional to the voltage, because the model does not describe
    gains, electrode shapes and depth exactly. The errors are largest for channels that read driven electrodes.

    **Arguments:**

    - `voltages` (M,): reference frame, volts.
    - `mask` (M,): True for usable channels; other channels are left out of the median and get the value 1.
    - `relative`: error as a fraction of the voltage.
    - `floor`: voltage, as a fraction of the median voltage, below which errors do not decrease further.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0, noise=relative_noise(reference))
    ```
    """
    xp = namespace(voltages, mask)
    voltage_magnitudes = abs(xp.asarray(voltages))
    is_used_channel = (
        xp.isfinite(voltage_magnitudes) if mask is None else xp.asarray(mask) & xp.isfinite(voltage_magnitudes)
    )
    median_magnitude = xp.nanmedian(xp.where(is_used_channel, voltage_magnitudes, xp.nan))
    return xp.where(
        is_used_channel,
        relative * xp.sqrt(xp.where(is_used_channel, voltage_magnitudes, 0) ** 2 + (floor * median_magnitude) ** 2),
        1.0,
    )


def electrode_misfits(
    protocol: Protocol, residual: Float[Array, " M"], noise: Float[Array, " M"], mask: Bool[Array, " M"]
) -> Float[np.ndarray, " L"]:
    """Misfit of the channels that read each of L electrodes, (L,), divided by the median misfit over all electrodes.

    `residual` (M,): predicted - measured voltages, volts; `noise` (M,): standard deviation of the channels in volts,
    see `relative_noise`; `mask`: True for usable channels. The ratio is 1 for electrodes that no usable channel uses. A
    misfit far above 1 indicates an electrode whose gain, offset or position differs from the model's.
    """
    is_used_channel = np.asarray(mask)
    reads_electrode = (np.asarray(protocol.channel_measurement) != 0) & is_used_channel[:, None]
    squared_sums = np.where(is_used_channel, np.abs(np.asarray(residual) / np.asarray(noise)) ** 2, 0) @ reads_electrode
    num_readings = reads_electrode.sum(axis=0)
    root_mean_squares = np.sqrt(squared_sums / np.maximum(num_readings, 1))
    median_misfit = np.median(root_mean_squares[num_readings > 0])
    return np.where((num_readings > 0) & (median_misfit > 0), root_mean_squares / max(median_misfit, 1e-300), 1.0)


def repeated_noise(
    frames: Float[Array | np.ndarray, "F M"],
    mask: Bool[Array | np.ndarray, "*F M"] | None = None,
    *,
    prior_frames: float = 4.0,
) -> Float[np.ndarray, " M"]:
    """Standard deviation (M,) of the channels of a single frame, in volts, estimated from repeated frames of an
    unchanged body.

    Estimates from few frames are uncertain, so the variances of the channels are shrunk towards their median.

    **Arguments:**

    - `frames` (F, M): voltages of F frames in volts, F at least 2.
    - `mask` (F, M) or (M,): True for usable voltages; a channel with fewer than two usable voltages gets 1.
    - `prior_frames`: weight of the median, as a number of frames.

    Raises `ValueError` for arrays of the wrong shape, for identical frames, and for NaN in usable voltages.

    **Example:**

    ```python
    frames = reference + 1e-6 * np.random.default_rng(0).normal(size=(10, len(reference)))
    noise = repeated_noise(frames)
    ```
    """
    if np.iscomplexobj(frames):
        raise ValueError("frames are complex; give their real part or magnitude.")
    if not (np.isfinite(prior_frames) and prior_frames >= 0):
        raise ValueError(f"prior_frames must be a number from 0; it is {prior_frames}.")
    voltages_of_frames = np.asarray(frames, float)
    if voltages_of_frames.ndim != 2 or len(voltages_of_frames) < 2:
        raise ValueError(
            f"frames has shape {voltages_of_frames.shape}; give at least two repeated frames, (frames, channels)."
        )
    is_used_value = np.ones(voltages_of_frames.shape, bool) if mask is None else np.asarray(mask)
    if is_used_value.dtype != bool or is_used_value.shape not in (
        voltages_of_frames.shape,
        voltages_of_frames.shape[1:],
    ):
        raise ValueError(
            f"mask must be booleans of shape {voltages_of_frames.shape} or {voltages_of_frames.shape[1:]}."
        )
    is_used_value = np.broadcast_to(is_used_value, voltages_of_frames.shape)
    if not np.isfinite(voltages_of_frames[is_used_value]).all():
        raise ValueError("frames: some voltages in use are NaN or infinite; mask them.")
    num_frames = is_used_value.sum(axis=0)
    mean = np.where(is_used_value, voltages_of_frames, 0).sum(axis=0) / np.maximum(num_frames, 1)
    sums_of_squares = np.where(is_used_value, (voltages_of_frames - mean) ** 2, 0).sum(axis=0)
    has_variance = num_frames >= 2
    if not has_variance.any():
        raise ValueError("mask: it leaves no channel with two frames.")
    if not sums_of_squares[has_variance].any():
        raise ValueError("frames: all are alike, so the noise cannot be estimated; is one frame repeated?")
    median_variance = np.median(
        (sums_of_squares[has_variance] / (num_frames[has_variance] - 1))[sums_of_squares[has_variance] > 0]
    )
    degrees_of_freedom = np.where(has_variance, num_frames - 1, 1) + prior_frames
    return np.where(has_variance, np.sqrt((sums_of_squares + prior_frames * median_variance) / degrees_of_freedom), 1.0)
