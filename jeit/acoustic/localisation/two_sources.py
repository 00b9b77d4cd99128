"""Localisation of two simultaneous sound sources, for frames that a single source does not explain."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.pixels import Pixels
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import bounding_box, longer_side, to_three_dimensions
from jeit_solvers import inverse_small, minimise_small
from jeit_solvers.engines import evaluate_in_numpy, has_values, namespace, on_device, on_host, scan
from jeit_solvers.module import Module

# Approximate number of grid positions, all pairs of which are screened.
_NUM_PIXELS = 150
# Number of pairs of positions that are refined.
_NUM_STARTS = 3


class TwoSources(Module):
    """Estimated pairs of sources of F frames.

    **Fields**: `position`: (F, 2, d) positions in metres, the stronger source first; `covariance`: (F, 2, d, d)
    covariances of the positions in m²; `strength`: (F, 2) strengths in the unit of intensity; `misfit`: (F,) chi-square
    of the residuals of the levels; `freedom`: (F,) degrees of freedom of the misfit; `converged`: (F,) whether the
    minimisation converged.
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
    """Locate the most probable pair of simultaneous sources of each frame. All pairs of positions on a coarse grid are
    screened, and the best three pairs are refined.

    Since two sources have six unknowns, frames with fewer than six usable microphones give NaN. Both sources are
    searched for within the bounding box of the skin's outline.

    **Arguments:**

    - `microphone_array`: model of the array, such as that of a `Calibration`.
    - `power`: intensities (F, M) minus the noise floor.
    - `use`: mask (F, M) of the intensities to use; by default all finite intensities.
    - `compiled`: whether to compile the computation, for repeated calls; calls within a JAX transformation are always
      compiled.

    **Example:**

    ```python
    pair = locate_two(calibration.microphone_array, power)
    print(pair.position.shape)
    ```
    """
    use_numpy = not compiled and np.size(power) > 0 and has_values(microphone_array, power, use)
    xp = np if use_numpy else jnp
    power = xp.asarray(power, float)
    use = xp.isfinite(power) if use is None else xp.isfinite(power) & xp.asarray(use, bool)
    low, high = bounding_box(on_host(microphone_array.surface))
    spacing = np.sqrt(np.prod(high - low) / _NUM_PIXELS)
    columns, rows = (max(3, round(side / spacing)) for side in high - low)
    pixels = Pixels.create(microphone_array.surface, columns, rows)
    arguments = microphone_array, pixels, power.T, use.T
    return (
        on_device(evaluate_in_numpy(_locate_two_sources, *arguments))
        if use_numpy
        else jax.jit(_locate_two_sources)(*arguments)
    )


def _locate_two_sources(microphone_array: MicrophoneArray, pixels: Pixels, power, use) -> TwoSources:
    use = use & (power + microphone_array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power, use, microphone_array)
    response = microphone_array.response(pixels.chart)
    xp = namespace(response, power)

    def screen(_, frame):
        power, use = frame
        return None, _best_pairs(power, use, response, pixels, microphone_array)

    _, pair_unknowns = scan(screen, None, (power.T, use.T))
    start = pair_unknowns.transpose(2, 1, 0).reshape(6, -1)  # (6, starts · F)
    low, high = bounding_box(microphone_array.surface)
    skin_size = longer_side(microphone_array.surface)
    infinite_bound = xp.full(1, xp.inf)
    minimum = minimise_small(
        lambda unknowns, data: Likelihood(data[0], data[1], data[2], microphone_array).expand(unknowns),
        start,
        jax.tree.map(lambda array: xp.tile(array, _NUM_STARTS), likelihood.frames),
        lower=xp.concatenate([low, -infinite_bound, low, -infinite_bound])[:, None],
        upper=xp.concatenate([high, infinite_bound, high, infinite_bound])[:, None],
        largest_step=xp.tile(xp.array([0.1, 0.1, 2.3]) * xp.array([skin_size, skin_size, 1.0]), 2)[:, None],
        max_steps=60,
        tolerance=1e-10,
    )
    num_frames = power.shape[1]
    values = xp.where(xp.isfinite(minimum.value), minimum.value, xp.inf).reshape(_NUM_STARTS, num_frames)
    best_indices = xp.argmin(values, axis=0) * num_frames + xp.arange(num_frames)
    unknowns, converged = minimum.x[:, best_indices], minimum.converged[best_indices]
    unknowns = xp.where(unknowns[5] > unknowns[2], xp.roll(unknowns, 3, axis=0), unknowns)
    _, _, matrix = likelihood.expand(unknowns)
    unknowns_covariance = inverse_small(matrix)
    num_used = xp.sum(use, axis=0)
    has_positions = (num_used >= 6) & xp.isfinite(xp.min(values, axis=0))
    sources = [
        to_three_dimensions(microphone_array.surface, unknowns[k : k + 2], unknowns_covariance[k : k + 2, k : k + 2])
        for k in (0, 3)
    ]

    def mask_unlocated(array):
        return xp.where(has_positions.reshape(-1, *(1,) * (array.ndim - 1)), array, xp.nan)

    return TwoSources(
        position=mask_unlocated(xp.stack([position for position, _ in sources], axis=1)),
        covariance=mask_unlocated(xp.stack([covariance for _, covariance in sources], axis=1)),
        strength=mask_unlocated(xp.exp(unknowns[2::3]).T),
        misfit=mask_unlocated(likelihood.misfit(unknowns)),
        freedom=xp.maximum(num_used - 6, 0),
        converged=converged & has_positions,
    )


def _best_pairs(power, use, response, pixels: Pixels, microphone_array: MicrophoneArray) -> Float[Array, "starts 6"]:
    """Find the pairs of grid positions with the lowest weighted residuals of a frame, each pair with its best-fitting
    strengths. Pairs that are neighbours of a better pair are excluded. Returns the unknowns (starts, 6) of the best
    pairs."""
    xp = namespace(response, power)
    weight = xp.where(use, 1 / microphone_array.noise.variance(xp.maximum(power, 0.0)), 0.0)
    # The unit of intensities is arbitrary, so intensities are divided by the highest intensity of the frame.
    scale = xp.max(xp.where(use, power, 0.0))
    weight = weight * scale**2
    scaled_power = xp.where(use, power, 0.0) / scale
    gram_matrix = (weight[:, None] * response).T @ response
    weighted_moment = (weight * scaled_power) @ response
    diagonal = xp.diag(gram_matrix)
    determinant = diagonal[:, None] * diagonal - gram_matrix**2
    first_strengths = (diagonal * weighted_moment[:, None] - gram_matrix * weighted_moment) / determinant
    second_strengths = first_strengths.T
    is_valid = (first_strengths > 0) & (second_strengths > 0) & (determinant > 1e-9 * diagonal[:, None] * diagonal)
    is_valid = is_valid & pixels.inside[:, None] & pixels.inside
    residual_decrease = xp.where(
        is_valid, first_strengths * weighted_moment[:, None] + second_strengths * weighted_moment, -xp.inf
    )
    chart = pixels.chart
    distances = xp.linalg.norm(chart[:, :, None] - chart[:, None], axis=0)
    is_neighbour = distances < 1.6 * xp.sort(distances[0])[1]
    pairs = []
    for _ in range(_NUM_STARTS):
        first_index, second_index = xp.unravel_index(xp.argmax(residual_decrease), residual_decrease.shape)
        log_strengths = xp.log(
            xp.maximum(
                scale
                * xp.stack([first_strengths[first_index, second_index], second_strengths[first_index, second_index]]),
                1e-300,
            )
        )
        pairs.append(xp.stack([*chart[:, first_index], log_strengths[0], *chart[:, second_index], log_strengths[1]]))
        is_similar = is_neighbour[first_index][:, None] & is_neighbour[second_index]
        residual_decrease = xp.where(is_similar | is_similar.T, -xp.inf, residual_decrease)
    return xp.stack(pairs)
