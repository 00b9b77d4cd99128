"""Two sources at once: where both are, for frames that one source does not explain."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.pixels import Pixels
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import bounding_box, in_space, longer_side
from jeit_solvers import inverse_small, minimise_small

# Places of which all pairs are screened, and pairs that are tried.
_PLACES, _STARTS = 150, 3


class TwoSources(eqx.Module):
    """`position` (F, 2, d) metres, the stronger source first; `covariance` (F, 2, d, d) m²; `strength` (F, 2); `misfit`
    (F,), chi-square with `freedom` (F,); `converged` (F,)."""

    position: Float[Array, "F 2 d"]
    covariance: Float[Array, "F 2 d d"]
    strength: Float[Array, "F 2"]
    misfit: Float[Array, " F"]
    freedom: Int[Array, " F"]
    converged: Bool[Array, " F"]


def locate_two(microphone_array: MicrophoneArray, power: ArrayLike, use: ArrayLike | None = None) -> TwoSources:
    """The most probable pair of sources of each frame: all pairs of a coarse grid are screened, the best three refined.

    `power` (F, M): intensities above the floor; `use`: which to look at, all that are finite unless given. Six unknowns
    need six microphones or more: frames with fewer give NaN. Both are found inside the outline's box.
    """
    power = jnp.asarray(power, float)
    use = jnp.isfinite(power) if use is None else jnp.isfinite(power) & jnp.asarray(use, bool)
    low, high = (np.asarray(corner) for corner in bounding_box(microphone_array.surface))
    spacing = np.sqrt(np.prod(high - low) / _PLACES)
    columns, rows = (max(3, round(side / spacing)) for side in high - low)
    pixels = Pixels.create(microphone_array.surface, columns, rows)
    return _locate_two(microphone_array, pixels, power.T, use.T)


@eqx.filter_jit
def _locate_two(microphone_array: MicrophoneArray, pixels: Pixels, power, use) -> TwoSources:
    use = use & (power + microphone_array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power, use, microphone_array)
    response = microphone_array.response(pixels.chart)
    starts = jax.lax.map(
        lambda frame: _best_pairs(frame[0], frame[1], response, pixels, microphone_array), (power.T, use.T)
    )
    start = starts.transpose(2, 1, 0).reshape(6, -1)  # (6, starts · F)
    low, high = bounding_box(microphone_array.surface)
    reach = longer_side(microphone_array.surface)
    far = jnp.full(1, jnp.inf)
    found = minimise_small(
        lambda x, data: Likelihood(data[0], data[1], data[2], microphone_array).expand(x),
        start,
        jax.tree.map(lambda array: jnp.tile(array, _STARTS), likelihood.frames),
        lower=jnp.concatenate([low, -far, low, -far])[:, None],
        upper=jnp.concatenate([high, far, high, far])[:, None],
        largest_step=jnp.tile(jnp.array([0.1, 0.1, 2.3]) * jnp.array([reach, reach, 1.0]), 2)[:, None],
        max_steps=60,
        tolerance=1e-10,
    )
    frames = power.shape[1]
    value = jnp.where(jnp.isfinite(found.value), found.value, jnp.inf).reshape(_STARTS, frames)
    best = jnp.argmin(value, axis=0) * frames + jnp.arange(frames)
    x, converged = found.x[:, best], found.converged[best]
    x = jnp.where(x[5] > x[2], jnp.roll(x, 3, axis=0), x)
    _, _, matrix = likelihood.expand(x)
    spread = inverse_small(matrix)
    number = jnp.sum(use, axis=0)
    known = (number >= 6) & jnp.isfinite(jnp.min(value, axis=0))
    each = [in_space(microphone_array.surface, x[k : k + 2], spread[k : k + 2, k : k + 2]) for k in (0, 3)]

    def shown(array):
        return jnp.where(known.reshape(-1, *(1,) * (array.ndim - 1)), array, jnp.nan)

    return TwoSources(
        position=shown(jnp.stack([place for place, _ in each], axis=1)),
        covariance=shown(jnp.stack([covariance for _, covariance in each], axis=1)),
        strength=shown(jnp.exp(x[2::3]).T),
        misfit=shown(likelihood.misfit(x)),
        freedom=jnp.maximum(number - 6, 0),
        converged=converged & known,
    )


def _best_pairs(power, use, response, pixels: Pixels, microphone_array: MicrophoneArray) -> Float[Array, "starts 6"]:
    """Of all pairs of places, those whose best two strengths leave least of the frame unexplained, apart from each
    other."""
    weight = jnp.where(use, 1 / microphone_array.noise.variance(jnp.maximum(power, 0.0)), 0.0)
    # All numbers near one: intensities may be of any unit.
    scale = jnp.max(jnp.where(use, power, 0.0))
    weight = weight * scale**2
    seen = jnp.where(use, power, 0.0) / scale
    gram = (weight[:, None] * response).T @ response
    moment = (weight * seen) @ response
    own = jnp.diag(gram)
    determinant = own[:, None] * own - gram**2
    first = (own * moment[:, None] - gram * moment) / determinant
    second = first.T
    both = (first > 0) & (second > 0) & (determinant > 1e-9 * own[:, None] * own)
    both = both & pixels.inside[:, None] & pixels.inside
    gained = jnp.where(both, first * moment[:, None] + second * moment, -jnp.inf)
    chart = pixels.chart
    apart = jnp.linalg.norm(chart[:, :, None] - chart[:, None], axis=0)
    near = apart < 1.6 * jnp.sort(apart[0])[1]
    pairs = []
    for _ in range(_STARTS):
        one, other = jnp.unravel_index(jnp.argmax(gained), gained.shape)
        strengths = jnp.log(jnp.maximum(scale * jnp.stack([first[one, other], second[one, other]]), 1e-300))
        pairs.append(jnp.stack([*chart[:, one], strengths[0], *chart[:, other], strengths[1]]))
        same = near[one][:, None] & near[other]
        gained = jnp.where(same | same.T, -jnp.inf, gained)
    return jnp.stack(pairs)
