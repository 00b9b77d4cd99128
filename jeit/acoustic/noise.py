"""Error model of intensities, and of levels: the logarithms of the received power, to which decay models are fitted.

If a microphone receives the expected power S from a source, the measured power minus the noise floor has the mean S and
the variance

    var = τ² S² + κ S + s².

Here τ is the relative error of the decay model and of the coupling between skin and microphone, s² is the variance of
the power of noise alone, and κ S is due to the product of signal and noise. For a noise power N and ν degrees of
freedom of a window, s² = 2 N² / ν and κ = 4 N / ν (noncentral chi-square distribution). Models are fitted to the levels
y = log(power + N). For S ≫ N, the level is the logarithm of intensity, with the errors of gains; for S ≪ N, the level
is only an upper bound of the intensity. The level is nearly normally distributed in both cases.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers.engines import as_array, namespace
from jeit_solvers.module import Module

# Minimum relative error of a decay model.
MIN_RELATIVE_ERROR = 1e-3
# Minimum noise floor in standard deviations of the noise, which keeps the argument of the logarithm positive if no
# floor is known.
_FLOOR_DEVIATIONS = 4.0


class IntensityNoise(Module):
    """Noise parameters of the intensities of M microphones; see `jeit.acoustic.noise` for the error model.

    **Fields**, each (M,): `floor`: noise floor N; `deviation`: standard deviation s of the power of noise; `cross`:
    coefficient κ. These three fields are in the unit of intensity. `relative`: relative error τ of the decay model.
    """

    floor: Float[Array, " M"]
    deviation: Float[Array, " M"]
    cross: Float[Array, " M"]
    relative: Float[Array, " M"]

    @classmethod
    def create(
        cls,
        num_microphones: int,
        *,
        floor: ArrayLike = 0.0,
        freedom: ArrayLike = np.inf,
        deviation: ArrayLike | None = None,
        relative: ArrayLike = MIN_RELATIVE_ERROR,
    ) -> "IntensityNoise":
        """Create the noise parameters from the subtracted noise `floor` and the degrees of freedom ν of a window
        (`freedom`), or from the standard deviation s of the intensity without a source (`deviation`). `relative`:
        relative error τ. All parameters are numbers or (M,)."""
        arrays = [np.broadcast_to(np.asarray(value, float), (num_microphones,)) for value in (floor, freedom, relative)]
        floors, degrees, errors = arrays
        deviations = floors * np.sqrt(2 / degrees)
        if deviation is not None:
            deviations = np.maximum(deviations, np.broadcast_to(np.asarray(deviation, float), (num_microphones,)))
        floor, bounded_errors = (
            np.maximum(floors, _FLOOR_DEVIATIONS * deviations),
            np.maximum(errors, MIN_RELATIVE_ERROR),
        )
        return cls(*(as_array(values) for values in (floor, deviations, 4 * floors / degrees, bounded_errors)))

    def variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance (M, …) of the power minus the noise floor, for the expected power `received` (M, …)."""
        relative, cross, deviation = (column(x, received) for x in (self.relative, self.cross, self.deviation))
        return (relative**2 * received + cross) * received + deviation**2

    def level(self, power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Level y = log(power + floor) for the `power` (M, …) minus the noise floor. The sum is bounded below by 0.05
        floor."""
        floor, xp = column(self.floor, power), namespace(self, power)
        return xp.log(xp.maximum(power + floor, 0.05 * floor))

    def level_variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance (M, …) of the level y, for the expected power `received` (M, …)."""
        return self.variance(received) / (received + column(self.floor, received)) ** 2


def column(values: Float[Array, " M"], broadcast_to: Array) -> Array:
    """Reshape `values` (M,), one per microphone, so that the values broadcast along the first axis of
    `broadcast_to`."""
    return values.reshape((-1,) + (1,) * (broadcast_to.ndim - 1))


def noise_from_negative_powers(power: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Standard deviation (M,) of the noise, estimated from the negative values among the intensities `power` (F, M).
    Only noise can make intensities negative."""
    negative_power = np.where(usable & (power < 0), power, 0.0)
    num_negative = (negative_power < 0).sum(axis=0)
    return np.sqrt((negative_power**2).sum(axis=0) / np.maximum(num_negative, 1))
