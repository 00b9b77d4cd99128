"""The Cramér-Rao bound: how well any unbiased localiser can do."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.microphones import MicrophoneArray, check_array
from jeit.acoustic.surface import in_space
from jeit_solvers import inverse_small


def cramer_rao(
    microphone_array: MicrophoneArray,
    position: Float[Array, "N d"],
    strength: Float[Array, " N"] | float = 1.0,
    *,
    use=None,
) -> Float[Array, "N d d"]:
    """Least covariance (m²) with which sources of unknown `strength` at `position` (m) can be located.

    The inverse of Fisher's matrix of place and log strength, under the noise model of `microphone_array`. `use`: (M,)
    which microphones there are, all unless given. Raises `ValueError` for what is no array.
    """
    check_array(microphone_array)
    position = jnp.asarray(position, float)
    chart = microphone_array.surface.project(position.T)
    number = chart.shape[1]
    unknowns = jnp.concatenate([chart, jnp.log(jnp.broadcast_to(jnp.asarray(strength, float), (number,)))[None]])
    present = jnp.ones(len(microphone_array.microphones), bool) if use is None else jnp.asarray(use, bool)
    there = jnp.broadcast_to(present[:, None], (len(present), number))
    # Fisher's matrix does not depend on what was measured.
    _, _, matrix = Likelihood.create(jnp.ones(there.shape), there, microphone_array).expand(unknowns)
    return in_space(microphone_array.surface, chart, inverse_small(matrix)[:2, :2])[1]
