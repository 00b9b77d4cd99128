"""The Cramér-Rao bound: least covariance of any unbiased localiser."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.microphones import MicrophoneArray, check_array
from jeit.acoustic.surface import in_space
from jeit_solvers import inverse_small
from jeit_solvers.engines import either_engine, namespace


def cramer_rao(
    microphone_array: MicrophoneArray,
    position: ArrayLike,
    strength: ArrayLike = 1.0,
    *,
    use: ArrayLike | None = None,
) -> Float[Array, "N d d"]:
    """Cramér-Rao bound (N, d, d), m², of the positions of sources at `position` (N, d), metres, with `strength` (N,) or
    one for all, which the localiser does not know.

    The inverse of the Fisher matrix of position and log strength, under the noise model of `microphone_array`. `use`:
    (M,) mask of the microphones used, all unless given. Raises `ValueError` for what is no `MicrophoneArray`.
    """
    check_array(microphone_array)
    present = np.ones(len(microphone_array.microphones), bool) if use is None else use
    return _least_covariance(microphone_array, position, strength, present)


@either_engine
def _least_covariance(microphone_array: MicrophoneArray, position, strength, present) -> Float[Array, "N d d"]:
    xp = namespace(microphone_array, position, strength, present)
    position = xp.asarray(position, float)
    chart = microphone_array.surface.project(position.T)
    number = chart.shape[1]
    unknowns = xp.concatenate([chart, xp.log(xp.broadcast_to(xp.asarray(strength, float), (number,)))[None]])
    there = xp.broadcast_to(xp.asarray(present, bool)[:, None], (len(present), number))
    # The Fisher matrix does not depend on the measured values.
    _, _, matrix = Likelihood.create(xp.ones(there.shape), there, microphone_array).expand(unknowns)
    return in_space(microphone_array.surface, chart, inverse_small(matrix)[:2, :2])[1]
