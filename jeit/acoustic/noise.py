"""Error model of intensities, and the fitted statistic: the logarithm of the received power.

For expected power S at a microphone, the power above the floor has mean S and variance

    var = τ² S² + κ S + s²,

with τ the relative error of the decay model and of coupling, s the residual of the floor after its subtraction, and κ S
the product of signal and floor in the power of their sum. With ν degrees of freedom of a window and floor power N, the
last two are s² = 2 N² / ν and κ = 4 N / ν (noncentral chi-square). The fitted statistic is y = log(power + N). Where S
≫ N it is the logarithm of intensity, whose errors are those of gains; where S ≪ N it only bounds the intensity from
above. It is nearly normal in both cases.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers.engines import as_array, namespace

# Least relative error of a decay model.
LEAST_RELATIVE = 1e-3
# Where no floor is known, a floor of so many standard deviations keeps the argument of the logarithm positive.
_FLOOR_DEVIATIONS = 4.0


class IntensityNoise(eqx.Module):
    """Noise parameters of the intensities of M microphones, in the unit of intensity."""

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
        relative: ArrayLike = LEAST_RELATIVE,
    ) -> "IntensityNoise":
        """Create from the subtracted `floor` and the degrees of `freedom` of a window, or from the standard `deviation`
        of the intensity without a source. Each a number or (M,)."""
        wide = [np.broadcast_to(np.asarray(value, float), (num_microphones,)) for value in (floor, freedom, relative)]
        base, degrees, scatter = wide
        rest = base * np.sqrt(2 / degrees)
        if deviation is not None:
            rest = np.maximum(rest, np.broadcast_to(np.asarray(deviation, float), (num_microphones,)))
        floor, least = np.maximum(base, _FLOOR_DEVIATIONS * rest), np.maximum(scatter, LEAST_RELATIVE)
        return cls(*(as_array(values) for values in (floor, rest, 4 * base / degrees, least)))

    def variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance of the power above the floor, for expected power `received`."""
        relative, cross, deviation = (column(x, received) for x in (self.relative, self.cross, self.deviation))
        return (relative**2 * received + cross) * received + deviation**2

    def level(self, power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Level y = log(power + floor); −∞ where the sum is not positive."""
        floor, xp = column(self.floor, power), namespace(self, power)
        return xp.log(xp.maximum(power + floor, 0.05 * floor))

    def level_variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance of the level y, for expected power `received`."""
        return self.variance(received) / (received + column(self.floor, received)) ** 2


def column(values: Float[Array, " M"], like: Array) -> Array:
    """Broadcast one value per microphone along the first axis of `like`."""
    return values.reshape((-1,) + (1,) * (like.ndim - 1))


def below_nothing(power: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Standard deviation (M,) of the noise, estimated from negative intensities (F, M), which are due to noise only."""
    below = np.where(usable & (power < 0), power, 0.0)
    number = (below < 0).sum(axis=0)
    return np.sqrt((below**2).sum(axis=0) / np.maximum(number, 1))
