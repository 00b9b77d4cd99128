"""The Cramér-Rao bound: how well any unbiased localiser can do."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.acoustic.likelihood import Likelihood, Listeners
from jeit.acoustic.surface import in_space
from jeit_solvers import inverse_few


def cramer_rao(
    listeners: Listeners, position: Float[Array, "N d"], strength: Float[Array, " N"] | float = 1.0, *, use=None
) -> Float[Array, "N d d"]:
    """Least covariance (m²) with which sources of unknown `strength` at `position` (m) can be located.

    The inverse of Fisher's matrix of place and log strength, under the noise model of `listeners`. `use`: (M,) which
    microphones there are, all unless given.
    """
    position = jnp.asarray(position, float)
    chart = listeners.surface.project(position.T)
    number = chart.shape[1]
    unknowns = jnp.concatenate([chart, jnp.log(jnp.broadcast_to(jnp.asarray(strength, float), (number,)))[None]])
    present = jnp.ones(len(listeners.microphones), bool) if use is None else jnp.asarray(use, bool)
    there = jnp.broadcast_to(present[:, None], (len(present), number))
    # Fisher's matrix does not depend on what was measured.
    _, _, matrix = Likelihood.create(jnp.ones(there.shape), there, listeners).expand(unknowns)
    return in_space(listeners.surface, chart, inverse_few(matrix)[:2, :2])[1]
