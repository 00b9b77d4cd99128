"""What is known of the errors of intensities, and the statistic that is fitted: the logarithm of received power.

Of a microphone that should receive S, the power above the floor is S with variance

    var = τ² S² + κ S + s²,

τ the relative error of the decay model and of coupling, s what remains of the floor after its subtraction, κ S the
product of signal and floor in the power of their sum. With ν degrees of freedom of a window and floor power N the last
two are s² = 2 N² / ν and κ = 4 N / ν (noncentral chi-square). What is fitted is y = log(power + N): where S ≫ N it is
the logarithm of intensity, whose errors are those of gains; where S ≪ N it says no more than that little was heard, and
it is nearly normal in both.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit_solvers.engines import as_array, namespace

# Of the decay model: no microphone's is known better.
LEAST_RELATIVE = 1e-3
# Where no floor is known, one of so many standard deviations keeps the logarithm's argument positive.
_FLOOR_DEVIATIONS = 4.0


class IntensityNoise(eqx.Module):
    """Errors of the intensities of M microphones, in the intensity's own unit."""

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
        """From the `floor` that was subtracted and the degrees of `freedom` of a window; or from the standard
        `deviation` of what is received of nothing, where that is known instead. Each a number or (M,)."""
        wide = [np.broadcast_to(np.asarray(value, float), (num_microphones,)) for value in (floor, freedom, relative)]
        base, degrees, scatter = wide
        rest = base * np.sqrt(2 / degrees)
        if deviation is not None:
            rest = np.maximum(rest, np.broadcast_to(np.asarray(deviation, float), (num_microphones,)))
        floor, least = np.maximum(base, _FLOOR_DEVIATIONS * rest), np.maximum(scatter, LEAST_RELATIVE)
        return cls(*(as_array(values) for values in (floor, rest, 4 * base / degrees, least)))

    def variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Of the power above the floor, where `received` is expected."""
        relative, cross, deviation = (column(x, received) for x in (self.relative, self.cross, self.deviation))
        return (relative**2 * received + cross) * received + deviation**2

    def level(self, power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """y = log(power + floor); −∞ where there is neither."""
        floor, xp = column(self.floor, power), namespace(self, power)
        return xp.log(xp.maximum(power + floor, 0.05 * floor))

    def level_variance(self, received: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Of y, where `received` is expected."""
        return self.variance(received) / (received + column(self.floor, received)) ** 2


def column(values: Float[Array, " M"], like: Array) -> Array:
    """One value for each microphone, along the first axis of `like`."""
    return values.reshape((-1,) + (1,) * (like.ndim - 1))


def below_nothing(power: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """The deviation that negative intensities (F, M) betray, (M,): what is below nothing can only be noise."""
    below = np.where(usable & (power < 0), power, 0.0)
    number = (below < 0).sum(axis=0)
    return np.sqrt((below**2).sum(axis=0) / np.maximum(number, 1))
