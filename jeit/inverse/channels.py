"""Independent channels: the voltages of a protocol without those that reciprocity gives for free.

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
from jaxtyping import Array, Float, Int

from jeit.protocol import Protocol
from jeit_solvers import lower_cholesky, symmetric_inverse
from jeit_solvers.engines import as_array, either_engine, has_values, namespace

_RANK = 1e-9


class Data(eqx.Module):
    """Voltages of independent channels, their noise, and what no body explains.

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
    """Which channels determine all the others: v = `combination` (M, r) · v[`index` (r,)] for every body."""

    index: Int[Array, " r"]
    combination: Float[Array, "M r"]

    @classmethod
    def create(cls, protocol: Protocol) -> "IndependentChannels":
        """By a pivoted QR factorisation of the channels as linear forms of Z; every channel, where the protocol is
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
        """How to combine voltages of this standard deviation, (M,) volts; the same for all frames of equal noise."""
        return _weigh(self.combination, noise)


class Weighing(eqx.Module):
    """From voltages to `Data`: all that depends on the noise alone.

    **Fields**: `noise` (M,) volts; `estimator` (r, M) with ŷ = estimator · y; the rest as in `Data`.
    """

    noise: Float[Array, " M"]
    estimator: Float[Array, "r M"]
    weight: Float[Array, " r"]
    covariance: Float[Array, "r r"]
    precision: Float[Array, "r r"]

    def combine(self, voltages: Float[Array, " M"]) -> Data:
        """The data ŷ that voltages (M,) amount to."""
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
