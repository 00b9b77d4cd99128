"""Independent channels of a protocol, and the weight of each channel.

The transfer impedance Z (L, L) of any body is symmetric, with rows that sum to zero: L (L - 1) / 2 numbers. A protocol
often reads more, twice over or in combinations: 208 adjacent channels hold 104, a tank's 2356 hold 376. With T (M, r)
the combinations that make all channels from r independent ones, v = T v[index], data y with weights W = 1 / noise² are
as good as their r best estimates,

    ‖W^½ (T u - y)‖² = (u - ŷ)ᵀ G (u - ŷ) + rest,   G = TᵀWT,   ŷ = G⁻¹TᵀWy,

and least squares on those cost a fraction: the work grows with the square of the number of channels.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from jeit.protocol import Protocol
from jeit_solvers import lower_cholesky, symmetric_inverse
from jeit_solvers.engines import as_array, either_engine, has_values, namespace

_RANK = 1e-9


class Data(eqx.Module):
    """Voltages of independent channels, their noise, and the residual that no body explains.

    **Fields**: `voltages` ŷ (r,) volts; `weight` (r,), 1 / volts; `covariance` and `precision` (r, r) of weight · ŷ,
    inverse to each other, the precision with a unit diagonal; `rest`, the sum of squares that all conductivities leave.
    """

    voltages: Float[Array, " r"]
    weight: Float[Array, " r"]
    covariance: Float[Array, "r r"]
    precision: Float[Array, "r r"]
    rest: Float[Array, ""]

    def whiten(self, rows: Float[Array, "r *n"]) -> Float[Array, "r *n"]:
        """Values of weighted channels, (r,) or (r, n), made independent and of unit variance."""
        return lower_cholesky(self.precision).T @ rows


class IndependentChannels(eqx.Module):
    """Channels that determine all the others: v = `combination` (M, r) · v[`index` (r,)] for every body."""

    index: Int[Array, " r"]
    combination: Float[Array, "M r"]

    @classmethod
    def create(cls, protocol: Protocol) -> "IndependentChannels":
        """Choose channels by a pivoted QR factorisation of their linear forms of Z; all channels, where the protocol is
        traced and the forms have no values."""
        if not has_values(protocol):
            number = protocol.num_measurements
            return cls(as_array(np.arange(number)), as_array(np.eye(number)))
        drive, measurement = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
        forms = drive[:, :, None] * measurement[:, None, :]
        rows, columns = np.triu_indices(protocol.num_electrodes)
        forms = (forms + np.swapaxes(forms, 1, 2))[:, rows, columns]
        size = np.linalg.norm(forms, axis=1)
        factors: Any = scipy.linalg.qr((forms / size[:, None]).T, mode="r", pivoting=True)
        triangle, order = factors[-2:]
        rank = int(np.sum(np.abs(np.diag(triangle)) > _RANK))
        others = scipy.linalg.solve_triangular(triangle[:rank, :rank], triangle[:rank, rank:])
        combination = np.empty((len(forms), rank))
        combination[order] = np.concatenate([np.eye(rank), others.T]) / size[order[:rank]]
        combination *= size[:, None]
        combination[np.abs(combination) < _RANK * np.abs(combination).max()] = 0
        sort = np.argsort(order[:rank])
        return cls(as_array(order[:rank][sort]), as_array(combination[:, sort]))

    def weigh(self, noise: Float[Array, " M"]) -> "Weighing":
        """Weights that combine voltages of this standard deviation, (M,) volts; the same for all frames of equal
        noise."""
        return _weigh(self.combination, noise)


class Weighing(eqx.Module):
    """Map from voltages to `Data`: everything that depends on the noise alone.

    **Fields**: `noise` (M,) volts; `estimator` (r, M) with ŷ = estimator · y; the rest as in `Data`.
    """

    noise: Float[Array, " M"]
    estimator: Float[Array, "r M"]
    weight: Float[Array, " r"]
    covariance: Float[Array, "r r"]
    precision: Float[Array, "r r"]

    def combine(self, voltages: Float[Array, " M"]) -> Data:
        """Combine voltages (M,) into the data ŷ."""
        return _combine(self, voltages)


@either_engine
def _combine(weighing: Weighing, voltages) -> Data:
    estimate = weighing.estimator @ voltages
    scaled = weighing.weight * estimate
    rest = ((voltages / weighing.noise) ** 2).sum() - scaled @ weighing.precision @ scaled
    kept = weighing.weight, weighing.covariance, weighing.precision
    return Data(estimate, *kept, namespace(weighing, voltages).maximum(rest, 0))


@either_engine
def _weigh(combination, noise) -> Weighing:
    weighted = combination / noise[:, None]
    precision = weighted.T @ weighted
    weight = namespace(precision).sqrt(precision.diagonal())
    precision = precision / (weight * weight[:, None])
    covariance = symmetric_inverse(precision)
    estimator = (covariance / weight[:, None]) @ (weighted / weight / noise[:, None]).T
    return Weighing(noise, estimator, weight, covariance, precision)


@either_engine
def relative_noise(
    voltages: Float[Array, " M"], mask: Bool[Array, " M"] | None = None, *, relative: float = 0.01, floor: float = 0.3
) -> Float[Array, " M"]:
    """Standard deviation of channels whose errors grow with their voltages: relative · √(v² + (floor · median|v|)²).

    The errors of a difference image of a real tank rarely come from the voltmeter: gains, electrode shapes and depth
    that the model lacks leave errors in proportion to the voltage, largest where driven electrodes are read. `voltages`
    (M,) of the reference, volts; `mask`: True for usable channels, the others do not count in the median and come out
    as 1.
    """
    xp = namespace(voltages, mask)
    size = abs(xp.asarray(voltages))
    used = xp.isfinite(size) if mask is None else xp.asarray(mask) & xp.isfinite(size)
    typical = xp.nanmedian(xp.where(used, size, xp.nan))
    return xp.where(used, relative * xp.sqrt(xp.where(used, size, 0) ** 2 + (floor * typical) ** 2), 1.0)


def electrode_misfits(
    protocol: Protocol, residual: Float[Array, " M"], noise: Float[Array, " M"], mask: Bool[Array, " M"]
) -> Float[np.ndarray, " L"]:
    """Misfit (L,) of the channels that read each electrode, over the median of all electrodes.

    `residual` (M,): predicted less measured, volts; `noise` (M,) volts, see `relative_noise`; `mask`: True for usable
    channels. 1 for electrodes that none of those reads. An electrode far above 1 has another gain, offset or place than
    the model assumes.
    """
    used = np.asarray(mask)
    reads = (np.asarray(protocol.channel_measurement) != 0) & used[:, None]
    square = np.where(used, np.abs(np.asarray(residual) / np.asarray(noise)) ** 2, 0) @ reads
    count = reads.sum(axis=0)
    missed = np.sqrt(square / np.maximum(count, 1))
    typical = np.median(missed[count > 0])
    return np.where((count > 0) & (typical > 0), missed / max(typical, 1e-300), 1.0)


def repeated_noise(frames, mask=None, *, prior_frames: float = 4.0) -> Float[np.ndarray, " M"]:
    """Standard deviation of a single frame's channels (M,), volts, measured from repeated frames of a body at rest.

    `frames` (F, M) volts, F at least 2. `mask` (F, M) or (M,): True for usable voltages; a channel with fewer than two
    comes out as 1. A deviation of few frames is itself uncertain: variances are drawn towards the channels' median
    as if that had been seen in `prior_frames` frames more. Raises `ValueError` for other shapes, for frames that are
    all alike, and for NaN in what is used.
    """
    if np.iscomplexobj(frames):
        raise ValueError("frames are complex; give their real part or magnitude.")
    if not (np.isfinite(prior_frames) and prior_frames >= 0):
        raise ValueError(f"prior_frames must be a number from 0; it is {prior_frames}.")
    values = np.asarray(frames, float)
    if values.ndim != 2 or len(values) < 2:
        raise ValueError(f"frames has shape {values.shape}; give at least two repeated frames, (frames, channels).")
    used = np.ones(values.shape, bool) if mask is None else np.asarray(mask)
    if used.dtype != bool or used.shape not in (values.shape, values.shape[1:]):
        raise ValueError(f"mask must be booleans of shape {values.shape} or {values.shape[1:]}.")
    used = np.broadcast_to(used, values.shape)
    if not np.isfinite(values[used]).all():
        raise ValueError("frames: some voltages in use are NaN or infinite; mask them.")
    count = used.sum(axis=0)
    mean = np.where(used, values, 0).sum(axis=0) / np.maximum(count, 1)
    squares = np.where(used, (values - mean) ** 2, 0).sum(axis=0)
    known = count >= 2
    if not known.any():
        raise ValueError("mask: it leaves no channel with two frames.")
    if not squares[known].any():
        raise ValueError("frames: all are alike, so the noise cannot be estimated; is one frame repeated?")
    typical = np.median((squares[known] / (count[known] - 1))[squares[known] > 0])
    freedom = np.where(known, count - 1, 1) + prior_frames
    return np.where(known, np.sqrt((squares + prior_frames * typical) / freedom), 1.0)
