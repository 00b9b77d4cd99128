"""Localisation of two simultaneous sources, for frames that a single source does not explain."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.pixels import Pixels
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import bounding_box, longer_side, to_space
from jeit_solvers import inverse_small, minimise_small
from jeit_solvers.engines import at_once, has_values, namespace, on_device, on_host, scan
from jeit_solvers.module import Module

# Approximate number of grid positions, all pairs of which are screened; number of pairs that are refined.
_PLACES, _STARTS = 150, 3


class TwoSources(Module):
    """Estimated pairs of sources of F frames.

    **Fields**: `position`: (F, 2, d) in metres, the stronger source first; `covariance`: (F, 2, d, d) in m²;
    `strength`: (F, 2) in the unit of intensity; `misfit`: (F,) chi-square of the residuals; `freedom`: (F,) its degrees
    of freedom; `converged`: (F,) whether the minimisation converged.
    """

    position: Float[Array, "F 2 d"]
    covariance: Float[Array, "F 2 d d"]
    strength: Float[Array, "F 2"]
    misfit: Float[Array, " F"]
    freedom: Int[Array, " F"]
    converged: Bool[Array, " F"]


def locate_two(
    microphone_array: MicrophoneArray, power: ArrayLike, use: ArrayLike | None = None, *, compiled: bool = False
) -> TwoSources:
    """Locate the most probable pair of sources of each frame. All pairs of positions on a coarse grid are screened, and
    the best three pairs are refined.

    Since there are six unknowns, frames with fewer than six usable microphones give NaN. Both sources are searched for
    within the bounding box of the outline.

    **Arguments:**

    - `microphone_array`: model of the array, such as that of a `Calibration`.
    - `power`: intensities (F, M) minus the floor.
    - `use`: mask (F, M) of the intensities to use; by default all finite ones.
    - `compiled`: whether to compile the computation, for repeated calls; calls within a JAX transformation are always
      compiled.

    **Example:**

    ```python
    pair = locate_two(calibration.microphone_array, power)
    print(pair.position.shape)
    ```
    """
    at_hand = not compiled and np.size(power) > 0 and has_values(microphone_array, power, use)
    xp = np if at_hand else jnp
    power = xp.asarray(power, float)
    use = xp.isfinite(power) if use is None else xp.isfinite(power) & xp.asarray(use, bool)
    low, high = bounding_box(on_host(microphone_array.surface))
    spacing = np.sqrt(np.prod(high - low) / _PLACES)
    columns, rows = (max(3, round(side / spacing)) for side in high - low)
    pixels = Pixels.create(microphone_array.surface, columns, rows)
    arguments = microphone_array, pixels, power.T, use.T
    return on_device(at_once(_locate_two, *arguments)) if at_hand else jax.jit(_locate_two)(*arguments)


def _locate_two(microphone_array: MicrophoneArray, pixels: Pixels, power, use) -> TwoSources:
    use = use & (power + microphone_array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power, use, microphone_array)
    response = microphone_array.response(pixels.chart)
    xp = namespace(response, power)

    def screen(_, frame):
        power, use = frame
        return None, _best_pairs(power, use, response, pixels, microphone_array)

    _, starts = scan(screen, None, (power.T, use.T))
    start = starts.transpose(2, 1, 0).reshape(6, -1)  # (6, starts · F)
    low, high = bounding_box(microphone_array.surface)
    reach = longer_side(microphone_array.surface)
    far = xp.full(1, xp.inf)
    found = minimise_small(
        lambda x, data: Likelihood(data[0], data[1], data[2], microphone_array).expand(x),
        start,
        jax.tree.map(lambda array: xp.tile(array, _STARTS), likelihood.frames),
        lower=xp.concatenate([low, -far, low, -far])[:, None],
        upper=xp.concatenate([high, far, high, far])[:, None],
        largest_step=xp.tile(xp.array([0.1, 0.1, 2.3]) * xp.array([reach, reach, 1.0]), 2)[:, None],
        max_steps=60,
        tolerance=1e-10,
    )
    frames = power.shape[1]
    value = xp.where(xp.isfinite(found.value), found.value, xp.inf).reshape(_STARTS, frames)
    best = xp.argmin(value, axis=0) * frames + xp.arange(frames)
    x, converged = found.x[:, best], found.converged[best]
    x = xp.where(x[5] > x[2], xp.roll(x, 3, axis=0), x)
    _, _, matrix = likelihood.expand(x)
    spread = inverse_small(matrix)
    number = xp.sum(use, axis=0)
    known = (number >= 6) & xp.isfinite(xp.min(value, axis=0))
    each = [to_space(microphone_array.surface, x[k : k + 2], spread[k : k + 2, k : k + 2]) for k in (0, 3)]

    def frames_first(array):
        return xp.where(known.reshape(-1, *(1,) * (array.ndim - 1)), array, xp.nan)

    return TwoSources(
        position=frames_first(xp.stack([place for place, _ in each], axis=1)),
        covariance=frames_first(xp.stack([covariance for _, covariance in each], axis=1)),
        strength=frames_first(xp.exp(x[2::3]).T),
        misfit=frames_first(likelihood.misfit(x)),
        freedom=xp.maximum(number - 6, 0),
        converged=converged & known,
    )


def _best_pairs(power, use, response, pixels: Pixels, microphone_array: MicrophoneArray) -> Float[Array, "starts 6"]:
    """Find the pairs of grid positions with the lowest weighted residuals of a frame, each with its best-fitting
    strengths. Pairs that are neighbours of a better pair are excluded. Returns the unknowns (starts, 6)."""
    xp = namespace(response, power)
    weight = xp.where(use, 1 / microphone_array.noise.variance(xp.maximum(power, 0.0)), 0.0)
    # The unit of intensities is arbitrary, so they are divided by the highest intensity of the frame.
    scale = xp.max(xp.where(use, power, 0.0))
    weight = weight * scale**2
    seen = xp.where(use, power, 0.0) / scale
    gram = (weight[:, None] * response).T @ response
    moment = (weight * seen) @ response
    own = xp.diag(gram)
    determinant = own[:, None] * own - gram**2
    first = (own * moment[:, None] - gram * moment) / determinant
    second = first.T
    both = (first > 0) & (second > 0) & (determinant > 1e-9 * own[:, None] * own)
    both = both & pixels.inside[:, None] & pixels.inside
    gained = xp.where(both, first * moment[:, None] + second * moment, -xp.inf)
    chart = pixels.chart
    apart = xp.linalg.norm(chart[:, :, None] - chart[:, None], axis=0)
    near = apart < 1.6 * xp.sort(apart[0])[1]
    pairs = []
    for _ in range(_STARTS):
        one, other = xp.unravel_index(xp.argmax(gained), gained.shape)
        strengths = xp.log(xp.maximum(scale * xp.stack([first[one, other], second[one, other]]), 1e-300))
        pairs.append(xp.stack([*chart[:, one], strengths[0], *chart[:, other], strengths[1]]))
        same = near[one][:, None] & near[other]
        gained = xp.where(same | same.T, -xp.inf, gained)
    return xp.stack(pairs)
