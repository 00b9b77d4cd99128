"""`MicrophoneArray`: positions of the microphones, the expected intensities of a source, and their variances."""

from __future__ import annotations

import functools
import operator

import equinox as eqx
from jaxtyping import Array, Float

from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.surface import AbstractSurface
from jeit.arguments import check_kind
from jeit_solvers.engines import namespace


class MicrophoneArray(eqx.Module):
    """All that a source's intensities depend on: microphones (M, d) in metres, surface, decay models, noise."""

    microphones: Float[Array, "M d"]
    surface: AbstractSurface
    decay: AbstractDecay
    noise: IntensityNoise

    def response(self, chart: Float[Array, "2 ..."]) -> Float[Array, "M ..."]:
        """Responses f_i to sources at chart coordinates."""
        place = self.surface.place(chart)
        mine = self.microphones.reshape(self.microphones.shape + (1,) * (place.ndim - 1))
        squares = [(place[k] - mine[:, k]) ** 2 for k in range(place.shape[0])]
        return self.decay.response(sum(squares[1:], squares[0]))

    def expected(self, unknowns: Float[Array, "n F"]) -> tuple[Float[Array, "M F"], Float[Array, "M F"]]:
        """Expected levels m and their variances v."""
        each = [unknowns[k : k + 3] for k in range(0, len(unknowns), 3)]
        xp = namespace(self, unknowns)
        sent = [xp.exp(one[2]) * self.response(one[:2]) for one in each]
        received = functools.reduce(operator.add, sent)
        return xp.log(received + self.noise.floor[:, None]), self.noise.level_variance(received)


def check_array(microphone_array: MicrophoneArray) -> None:
    """Check the type of an array. Raises `ValueError` for what is no `MicrophoneArray`."""
    wanted = "a MicrophoneArray, such as calibration.microphone_array"
    check_kind("microphone_array", microphone_array, MicrophoneArray, wanted)
