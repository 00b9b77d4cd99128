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
_NUM_GRID_PIXELS = 150
# Number of pairs of positions that are refined.
_NUM_STARTING_PAIRS = 3


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
    computes_in_numpy = not compiled and np.size(power) > 0 and has_values(microphone_array, power, use)
    xp = np if computes_in_numpy else jnp
    power = xp.asarray(power, float)
    use = xp.isfinite(power) if use is None else xp.isfinite(power) & xp.asarray(use, bool)
    lower_corner, upper_corner = bounding_box(on_host(microphone_array.surface))
    grid_spacing = np.sqrt(np.prod(upper_corner - lower_corner) / _NUM_GRID_PIXELS)
    num_columns, num_rows = (max(3, round(side_length / grid_spacing)) for side_length in upper_corner - lower_corner)
    pixels = Pixels.create(microphone_array.surface, num_columns, num_rows)
    source_arguments = microphone_array, pixels, power.T, use.T
    return (
        on_device(evaluate_in_numpy(_locate_two_sources, *source_arguments))
        if computes_in_numpy
        else jax.jit(_locate_two_sources)(*source_arguments)
    )


def _locate_two_sources(microphone_array: MicrophoneArray, pixels: Pixels, power, is_used_reading) -> TwoSources:
    is_used_reading = is_used_reading & (power + microphone_array.noise.floor[:, None] > 0)
    likelihood = Likelihood.create(power, is_used_reading, microphone_array)
    grid_response = microphone_array.response(pixels.chart)
    xp = namespace(grid_response, power)

    def screen_frame(_, frame_readings):
        power, is_used_reading = frame_readings
        return None, _best_pairs(power, is_used_reading, grid_response, pixels, microphone_array)

    _, pair_unknowns = scan(screen_frame, None, (power.T, is_used_reading.T))
    initial_unknowns = pair_unknowns.transpose(2, 1, 0).reshape(6, -1)  # (6, starts · F)
    lower_corner, upper_corner = bounding_box(microphone_array.surface)
    skin_size = longer_side(microphone_array.surface)
    infinite_bound = xp.full(1, xp.inf)
    pair_minimum = minimise_small(
        lambda unknowns, frame_data: Likelihood(frame_data[0], frame_data[1], frame_data[2], microphone_array).expand(
            unknowns
        ),
        initial_unknowns,
        jax.tree.map(lambda frame_array: xp.tile(frame_array, _NUM_STARTING_PAIRS), likelihood.frames),
        lower=xp.concatenate([lower_corner, -infinite_bound, lower_corner, -infinite_bound])[:, None],
        upper=xp.concatenate([upper_corner, infinite_bound, upper_corner, infinite_bound])[:, None],
        largest_step=xp.tile(xp.array([0.1, 0.1, 2.3]) * xp.array([skin_size, skin_size, 1.0]), 2)[:, None],
        max_steps=60,
        tolerance=1e-10,
    )
    num_frames = power.shape[1]
    lowest_costs = xp.where(xp.isfinite(pair_minimum.value), pair_minimum.value, xp.inf).reshape(
        _NUM_STARTING_PAIRS, num_frames
    )
    best_start_indices = xp.argmin(lowest_costs, axis=0) * num_frames + xp.arange(num_frames)
    unknowns, has_converged = pair_minimum.x[:, best_start_indices], pair_minimum.converged[best_start_indices]
    unknowns = xp.where(unknowns[5] > unknowns[2], xp.roll(unknowns, 3, axis=0), unknowns)
    _, _, fisher_matrix = likelihood.expand(unknowns)
    unknowns_covariance = inverse_small(fisher_matrix)
    num_used_microphones = xp.sum(is_used_reading, axis=0)
    has_positions = (num_used_microphones >= 6) & xp.isfinite(xp.min(lowest_costs, axis=0))
    source_estimates = [
        to_three_dimensions(microphone_array.surface, unknowns[k : k + 2], unknowns_covariance[k : k + 2, k : k + 2])
        for k in (0, 3)
    ]

    def mask_unlocated(frame_array):
        return xp.where(has_positions.reshape(-1, *(1,) * (frame_array.ndim - 1)), frame_array, xp.nan)

    return TwoSources(
        position=mask_unlocated(xp.stack([position for position, _ in source_estimates], axis=1)),
        covariance=mask_unlocated(xp.stack([covariance for _, covariance in source_estimates], axis=1)),
        strength=mask_unlocated(xp.exp(unknowns[2::3]).T),
        misfit=mask_unlocated(likelihood.misfit(unknowns)),
        freedom=xp.maximum(num_used_microphones - 6, 0),
        converged=has_converged & has_positions,
    )


def _best_pairs(
    power, is_used_reading, grid_response, pixels: Pixels, microphone_array: MicrophoneArray
) -> Float[Array, "starts 6"]:
    """Find the pairs of grid positions with the lowest weighted residuals of a frame, each pair with its best-fitting
    strengths. Pairs that are neighbours of a better pair are excluded. Returns the unknowns (starts, 6) of the best
    pairs."""
    xp = namespace(grid_response, power)
    power_weights = xp.where(is_used_reading, 1 / microphone_array.noise.variance(xp.maximum(power, 0.0)), 0.0)
    # The unit of intensities is arbitrary, so intensities are divided by the highest intensity of the frame.
    max_power = xp.max(xp.where(is_used_reading, power, 0.0))
    power_weights = power_weights * max_power**2
    scaled_power = xp.where(is_used_reading, power, 0.0) / max_power
    gram_matrix = (power_weights[:, None] * grid_response).T @ grid_response
    weighted_moment = (power_weights * scaled_power) @ grid_response
    gram_diagonal = xp.diag(gram_matrix)
    pair_determinants = gram_diagonal[:, None] * gram_diagonal - gram_matrix**2
    first_strengths = (gram_diagonal * weighted_moment[:, None] - gram_matrix * weighted_moment) / pair_determinants
    second_strengths = first_strengths.T
    is_valid_pair = (
        (first_strengths > 0)
        & (second_strengths > 0)
        & (pair_determinants > 1e-9 * gram_diagonal[:, None] * gram_diagonal)
    )
    is_valid_pair = is_valid_pair & pixels.inside[:, None] & pixels.inside
    residual_decrease = xp.where(
        is_valid_pair, first_strengths * weighted_moment[:, None] + second_strengths * weighted_moment, -xp.inf
    )
    grid_positions = pixels.chart
    grid_distances = xp.linalg.norm(grid_positions[:, :, None] - grid_positions[:, None], axis=0)
    is_neighbour = grid_distances < 1.6 * xp.sort(grid_distances[0])[1]
    best_pairs = []
    for _ in range(_NUM_STARTING_PAIRS):
        first_pixel, second_pixel = xp.unravel_index(xp.argmax(residual_decrease), residual_decrease.shape)
        log_strengths = xp.log(
            xp.maximum(
                max_power
                * xp.stack([first_strengths[first_pixel, second_pixel], second_strengths[first_pixel, second_pixel]]),
                1e-300,
            )
        )
        best_pairs.append(
            xp.stack(
                [*grid_positions[:, first_pixel], log_strengths[0], *grid_positions[:, second_pixel], log_strengths[1]]
            )
        )
        is_similar_pair = is_neighbour[first_pixel][:, None] & is_neighbour[second_pixel]
        residual_decrease = xp.where(is_similar_pair | is_similar_pair.T, -xp.inf, residual_decrease)
    return xp.stack(best_pairs)
