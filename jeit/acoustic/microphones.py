"""`MicrophoneArray`: a model of an array of microphones, which gives the expected levels of a source and their
variances."""

from __future__ import annotations

import functools
import operator

from jaxtyping import Array, Float

from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.surface import AbstractSurface
from jeit.arguments import check_kind
from jeit_solvers.engines import namespace
from jeit_solvers.module import Module


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
        position = self.surface.place(chart)
        microphones = self.microphones.reshape(self.microphones.shape + (1,) * (position.ndim - 1))
        squares = [(position[k] - microphones[:, k]) ** 2 for k in range(position.shape[0])]
        return self.decay.response(sum(squares[1:], squares[0]))

    def expected(self, unknowns: Float[Array, "n F"]) -> tuple[Float[Array, "M F"], Float[Array, "M F"]]:
        """Expected levels m (M, F) of M microphones in F frames, and their variances v (M, F). `unknowns` (n, F): chart
        coordinates and logarithm of the strength of one or more sources."""
        sources = [unknowns[k : k + 3] for k in range(0, len(unknowns), 3)]
        xp = namespace(self, unknowns)
        powers = [xp.exp(source[2]) * self.response(source[:2]) for source in sources]
        received = functools.reduce(operator.add, powers)
        return xp.log(received + self.noise.floor[:, None]), self.noise.level_variance(received)


def check_array(microphone_array: MicrophoneArray) -> None:
    """Raises `ValueError` if `microphone_array` is not a `MicrophoneArray`."""
    description = "a MicrophoneArray, such as calibration.microphone_array"
    check_kind("microphone_array", microphone_array, MicrophoneArray, description)
