"""Model of an array of microphones: `MicrophoneArray` gives the expected levels of a source and their variances, and
`IntensityNoise` is the error model of the intensities.

If a microphone receives the expected power S from a source, the measured power minus the noise floor has the mean S and
the variance

    var = τ² S² + κ S + s².

Here τ is the relative error of the decay model and of the coupling between skin and microphone, s² is the variance of
the power of noise alone, and κ S is due to the product of signal and noise. For a noise power N and ν degrees of
freedom of a window, s² = 2 N² / ν and κ = 4 N / ν (noncentral chi-square distribution). Models are fitted to the levels
y = log(power + N). For S ≫ N, the level is the logarithm of the intensity, and its errors are those of the gains; for S
≪ N, the level gives only an upper bound of the intensity. The level is nearly normally distributed in both cases.
"""

from __future__ import annotations

import functools
import operator

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.decay import AbstractDecay, column
from jeit.acoustic.surface import AbstractSurface
from jeit.arguments import check_kind
from jeit_solvers.engines import as_array, namespace
from jeit_solvers.module import Module

# Minimum relative error of a decay model.
MIN_RELATIVE_ERROR = 1e-3
# Minimum noise floor in standard deviations of the noise, which keeps the argument of the logarithm positive if no
# floor is known.
_MIN_NOISE_FLOOR_DEVIATIONS = 4.0


class IntensityNoise(Module):
    """Noise parameters of the intensities of M microphones; see `jeit.acoustic.microphones` for the error model.

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
        relative error τ. All parameters are numbers or arrays (M,)."""
        noise_arrays = [
            np.broadcast_to(np.asarray(noise_value, float), (num_microphones,))
            for noise_value in (floor, freedom, relative)
        ]
        noise_floors, degrees_of_freedom, relative_errors = noise_arrays
        noise_deviations = noise_floors * np.sqrt(2 / degrees_of_freedom)
        if deviation is not None:
            noise_deviations = np.maximum(
                noise_deviations, np.broadcast_to(np.asarray(deviation, float), (num_microphones,))
            )
        floor, bounded_errors = (
            np.maximum(noise_floors, _MIN_NOISE_FLOOR_DEVIATIONS * noise_deviations),
            np.maximum(relative_errors, MIN_RELATIVE_ERROR),
        )
        return cls(
            *(
                as_array(parameter_values)
                for parameter_values in (floor, noise_deviations, 4 * noise_floors / degrees_of_freedom, bounded_errors)
            )
        )

    def variance(self, received_power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance (M, …) of the power minus the noise floor, for the expected power `received_power` (M, …)."""
        relative_error, cross_coefficients, additive_deviation = (
            column(x, received_power) for x in (self.relative, self.cross, self.deviation)
        )
        return (relative_error**2 * received_power + cross_coefficients) * received_power + additive_deviation**2

    def level(self, power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Level y = log(power + floor) for the `power` (M, …) minus the noise floor. The sum is bounded below by 0.05
        floor."""
        floor, xp = column(self.floor, power), namespace(self, power)
        return xp.log(xp.maximum(power + floor, 0.05 * floor))

    def level_variance(self, received_power: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Variance (M, …) of the level y, for the expected power `received_power` (M, …)."""
        return self.variance(received_power) / (received_power + column(self.floor, received_power)) ** 2


def noise_from_negative_powers(power: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Standard deviation (M,) of the noise, estimated from the negative values among the intensities `power` (F, M).
    Only noise can make intensities negative."""
    negative_power = np.where(usable & (power < 0), power, 0.0)
    num_negative = (negative_power < 0).sum(axis=0)
    return np.sqrt((negative_power**2).sum(axis=0) / np.maximum(num_negative, 1))


class MicrophoneArray(Module):
    """Model of an array of M microphones, from which the intensities of a source are computed.

    **Fields**: `microphones`: positions (M, d) in metres; `surface`: surface on which sources lie; `decay`: decay model
    of each microphone; `noise`: noise of the intensities.

    **Example:**

    ```python
    array = calibration.microphone_array
    response = array.response(np.array([0.03, 0.02]))
    ```
    """

    microphones: Float[Array, "M d"]
    surface: AbstractSurface
    decay: AbstractDecay
    noise: IntensityNoise

    def response(self, chart: Float[Array, "2 ..."]) -> Float[Array, "M ..."]:
        """Responses f_i (M, …) of the microphones to sources at chart coordinates (2, …), metres."""
        source_position = self.surface.place(chart)
        microphones = self.microphones.reshape(self.microphones.shape + (1,) * (source_position.ndim - 1))
        squared_differences = [(source_position[k] - microphones[:, k]) ** 2 for k in range(source_position.shape[0])]
        return self.decay.response(sum(squared_differences[1:], squared_differences[0]))

    def expected(self, unknowns: Float[Array, "n F"]) -> tuple[Float[Array, "M F"], Float[Array, "M F"]]:
        """Expected levels m (M, F) of M microphones in F frames, and their variances v (M, F). `unknowns` (n, F): chart
        coordinates and logarithm of the strength of one or more sources."""
        unknowns_of_sources = [unknowns[k : k + 3] for k in range(0, len(unknowns), 3)]
        xp = namespace(self, unknowns)
        source_powers = [
            xp.exp(unknowns_of_source[2]) * self.response(unknowns_of_source[:2])
            for unknowns_of_source in unknowns_of_sources
        ]
        received_power = functools.reduce(operator.add, source_powers)
        return xp.log(received_power + self.noise.floor[:, None]), self.noise.level_variance(received_power)


def check_array(microphone_array: MicrophoneArray) -> None:
    """Raises `ValueError` if `microphone_array` is not a `MicrophoneArray`."""
    array_description = "a MicrophoneArray, such as calibration.microphone_array"
    check_kind("microphone_array", microphone_array, MicrophoneArray, array_description)
