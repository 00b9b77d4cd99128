"""`Localiser`: source positions from the intensities of many frames, by maximum likelihood or intensity consistency.

The objective (negative log-likelihood or consistency loss) of each frame is evaluated on a coarse grid of positions,
and minimised from the two deepest valleys (local minima) of the grid. A minimum outside the outline is replaced by the
best position on the outline. The computation can be compiled. The positions are differentiable with respect to the
intensities, the positions of the microphones and the decay models, by the implicit function theorem.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.acoustic.localisation.consistency import Consistency, differentiable_minima, find_minima
from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.pixels import Pixels, find_two_lowest_minima
from jeit.acoustic.microphones import MicrophoneArray, check_array
from jeit.acoustic.surface import bounding_box, longer_side, to_three_dimensions
from jeit.arguments import check_name
from jeit_solvers import inverse_small
from jeit_solvers.engines import (
    evaluate_in_numpy,
    has_values,
    namespace,
    numpy_or_compiled,
    on_device,
    on_host,
    scan,
    undifferentiated,
)
from jeit_solvers.module import Module

METHODS = {"likelihood": Likelihood, "consistency": Consistency}
# Approximate number of positions of the coarse grid over the bounding box of the outline.
_NUM_COARSE_PIXELS = 400
# Maximum number of frames processed together, so that their arrays fit into the processor's cache: with the coarse
# grid, and with maps.
_MAX_CHUNK_FRAMES, _MAX_MAP_FRAMES = 1024, 32
# Minimum relative error of the decay models that is assumed when the objective is evaluated on a grid of positions.
_MIN_SCREENING_RELATIVE_ERROR = 0.2


class SourceEstimate(Module):
    """Estimated sound sources of F frames, one per frame.

    - `position`: (F, d) position in metres, on the surface of the skin and within its outline.
    - `covariance`: (F, d, d) covariance of the position in m².
    - `strength`: (F,) strength in the unit of intensity.
    - `misfit`: (F,) chi-square of the residuals of the levels. `freedom`: (F,) degrees of freedom of the misfit.
    - `excess`: (F,) decrease of twice the objective (for the likelihood, −2 log-likelihood) from `position` to the best
      position beyond the outline; 0 if no position beyond the outline is better.
    - `rival`: (F,) difference of twice the objective between the two deepest valleys; ∞ without a second valley.
    - `converged`: (F,) whether the minimisation converged.
    """

    position: Float[Array, "F d"]
    covariance: Float[Array, "F d d"]
    strength: Float[Array, " F"]
    misfit: Float[Array, " F"]
    freedom: Int[Array, " F"]
    excess: Float[Array, " F"]
    rival: Float[Array, " F"]
    converged: Bool[Array, " F"]


class Localiser(Module):
    """Estimator of source positions from intensities. Create a localiser with `Localiser.create`, and call it with
    intensities.

    **Fields**: `microphone_array`: model of the microphone array; `coarse`: coarse grid of positions; `pixels`: raster
    of the maps, if any; `features`: precomputed features of the raster's or grid's pixels; `method`: "likelihood" or
    "consistency"; `compiled`: whether calls are compiled.

    **Example:**

    ```python
    localiser = Localiser.create(calibration.microphone_array, map_shape=(50, 50))
    estimate, maps = localiser.with_maps(power)
    ```
    """

    microphone_array: MicrophoneArray
    coarse: Pixels
    pixels: Pixels | None
    features: Float[Array, "N P"] | None
    method: str = eqx.field(static=True)
    compiled: bool = eqx.field(static=True, default=True)

    @classmethod
    def create(
        cls,
        microphone_array: MicrophoneArray,
        *,
        method: str = "likelihood",
        map_shape: tuple[int, int] | None = None,
        compiled: bool = True,
    ) -> "Localiser":
        """Create a localiser for an array of microphones.

        `method`: "likelihood" (maximum likelihood), or "consistency" for the loss of Park 2022. `map_shape`: (rows,
        columns) of the raster on which the objective of each frame is evaluated, (200, 200) in Park 2022; required for
        `maps`. By default a coarse grid of about 400 positions is used. In both cases, the best position is then
        refined. `compiled`: whether to compile calls; False is faster for a single call. Raises `ValueError` for an
        unknown `method` or an invalid `map_shape`.
        """
        check_array(microphone_array)
        check_name("method", method, METHODS)
        lower_corner, upper_corner = bounding_box(on_host(microphone_array.surface))
        bounding_box_lengths = np.asarray(upper_corner - lower_corner)
        pixel_spacing = np.sqrt(np.prod(bounding_box_lengths) / _NUM_COARSE_PIXELS)
        pixel_counts = [max(3, round(side_length / pixel_spacing)) for side_length in bounding_box_lengths]
        coarse_pixels = Pixels.create(microphone_array.surface, *pixel_counts)
        if map_shape is None:
            return cls(microphone_array, coarse_pixels, None, None, method, compiled)
        if np.shape(map_shape) != (2,) or min(map_shape) < 2:
            raise ValueError(f"map_shape must be (rows, columns) of at least two each; it is {map_shape!r}.")
        pixels = Pixels.create(microphone_array.surface, int(map_shape[1]), int(map_shape[0]))
        features = _compute_features(METHODS[method], microphone_array, pixels.chart)
        return cls(microphone_array, coarse_pixels, pixels, features, method, compiled)

    def __call__(self, power: ArrayLike, use: ArrayLike | None = None) -> SourceEstimate:
        """Locate the source of each frame. `power` (F, M): intensities minus the noise floor. `use` (F, M): mask of the
        intensities to use; by default all finite intensities. Frames with fewer than three usable microphones give
        NaN."""
        return self._call_validated(_locate_sources, power, use)

    def maps(self, power: ArrayLike, use: ArrayLike | None = None) -> Float[Array, "F rows columns"]:
        """Compute the map of each frame: the negative log-likelihood with the best strength at each pixel, up to a
        constant; or the consistency loss divided by the square of the highest intensity.

        The bottom row is first; pixels outside the outline are NaN. `power`, `use`: as in a call of the localiser.
        Raises `ValueError` if the localiser was created without `map_shape`.
        """
        if self.pixels is None:
            raise ValueError("this Localiser has no maps; create it with map_shape=(rows, columns).")
        return self._call_validated(_compute_maps, power, use)

    def with_maps(
        self, power: ArrayLike, use: ArrayLike | None = None
    ) -> tuple[SourceEstimate, Float[Array, "F rows columns"]]:
        """Compute both the estimated source and the map of each frame. Raises `ValueError` as `maps` does."""
        return self(power, use), self.maps(power, use)

    def _call_validated(self, frame_function, power, use):
        """Validate the intensities `power` and the mask `use`, and call `frame_function` with the localiser and both
        arrays."""
        computes_in_numpy = not self.compiled and has_values(self, power, use)
        xp = np if computes_in_numpy else jnp
        power = xp.asarray(power, float)
        is_finite_power = xp.isfinite(power)
        use = is_finite_power if use is None else is_finite_power & xp.asarray(use, bool)
        if power.ndim != 2 or power.shape != use.shape or power.shape[1] != len(self.microphone_array.microphones):
            raise ValueError(
                f"power has shape {power.shape} and use {use.shape}; give (frames, microphones) with "
                f"{len(self.microphone_array.microphones)} microphones."
            )
        if not len(power):  # for no frames, the result of an unusable frame has the structure of the output
            padded_result = self._call_validated(frame_function, np.full((1, power.shape[1]), np.nan), None)
            return jax.tree.map(lambda result_array: result_array[:0], padded_result)
        return (
            on_device(evaluate_in_numpy(frame_function, self, power, use))
            if computes_in_numpy
            else _call_compiled(frame_function, self, power, use)
        )


@eqx.filter_jit
def _call_compiled(frame_function, localiser: Localiser, power, use):
    return frame_function(localiser, power, use)


def _apply_in_chunks(frame_function, max_frames: int, *frame_arrays):
    """Call `frame_function` for at most `max_frames` frames at a time. The `frame_arrays` (F, M) are split into chunks,
    padded, and transposed to (M, F). In the results, frames are the leading axis."""
    num_frames = frame_arrays[0].shape[0]
    chunk_size = min(max_frames, max(num_frames, 1))
    num_chunks = -(-num_frames // chunk_size)
    frame_padding = ((0, num_chunks * chunk_size - num_frames), (0, 0))

    xp = namespace(frame_arrays)

    def split_array(frame_array):
        return xp.pad(frame_array, frame_padding).reshape(num_chunks, chunk_size, -1).transpose(0, 2, 1)

    _, chunk_results = scan(
        lambda _, frame_chunk: (None, frame_function(*frame_chunk)),
        None,
        tuple(split_array(frame_array) for frame_array in frame_arrays),
    )
    return jax.tree.map(lambda frame_array: frame_array.reshape(-1, *frame_array.shape[2:])[:num_frames], chunk_results)


@numpy_or_compiled
def _compute_features(objective, microphone_array: MicrophoneArray, chart) -> Array:
    return objective.features(microphone_array, chart)


def _map_raster(localiser: Localiser, microphone_array: MicrophoneArray) -> tuple[Pixels, Array]:
    """Return the raster of the maps, or the coarse grid if there are no maps, and the features of the raster's
    pixels."""
    if localiser.pixels is not None and localiser.features is not None:
        return localiser.pixels, localiser.features
    return localiser.coarse, METHODS[localiser.method].features(microphone_array, localiser.coarse.chart)


def _compute_maps(localiser: Localiser, power, use) -> Array:
    """Compute the maps of all frames (F, rows, columns) at once by matrix products."""
    pixels, features = _map_raster(localiser, localiser.microphone_array)
    use = _usable_readings(localiser, power, use)
    objective_maps = METHODS[localiser.method].create(power.T, use.T, localiser.microphone_array).screen(features)
    return (
        objective_maps if pixels.full else namespace(objective_maps).where(pixels.inside, objective_maps, np.nan)
    ).reshape(-1, *pixels.shape)


def _starting_positions(localiser: Localiser, power, use):
    """Starting positions of the minimisation: positions of the first valley (F, 2) and the second valley (F, 2) of each
    frame, and the mask (F,) of the frames for which the objective is also minimised from the second valley."""
    constant_array = undifferentiated(localiser.microphone_array)
    pixels, features = _map_raster(localiser, constant_array)
    # The valleys of a very accurate decay model are narrower than the grid spacing, so a minimum relative error is
    # assumed.
    constant_array = eqx.tree_at(
        lambda array_to_change: array_to_change.noise.relative,
        constant_array,
        namespace(constant_array).maximum(constant_array.noise.relative, _MIN_SCREENING_RELATIVE_ERROR),
    )

    def screen_chunk(power, use):
        objective_maps = METHODS[localiser.method].create(power, use, constant_array).screen(features)
        first_start, second_start, has_second_start = find_two_lowest_minima(objective_maps, pixels)
        return first_start.T, second_start.T, has_second_start

    max_frames = _MAX_CHUNK_FRAMES if localiser.pixels is None else _MAX_MAP_FRAMES
    return _apply_in_chunks(screen_chunk, max_frames, undifferentiated(power), use)


def _usable_readings(localiser: Localiser, power, use):
    """Mask of the usable readings: intensities in `use` with a positive sum of power and noise floor, whose logarithm
    exists."""
    return use & (power + localiser.microphone_array.noise.floor > 0)


def _locate_sources(localiser: Localiser, power, use) -> SourceEstimate:
    use = _usable_readings(localiser, power, use)
    first_start, second_start, has_second_start = _starting_positions(localiser, power, use)

    def refine_chunk(power, use, first_start, second_start, has_second_start):
        return _refine_positions(localiser, power, use, first_start, second_start, has_second_start[0])

    return _apply_in_chunks(
        refine_chunk, _MAX_CHUNK_FRAMES, power, use, first_start, second_start, has_second_start[:, None]
    )


def _refine_positions(localiser: Localiser, power, use, first_start, second_start, has_second_start) -> SourceEstimate:
    """Minimise the objective of each frame from the starting positions `first_start` and `second_start` (2, F).
    `power`, `use`: (M, F)."""
    microphone_array = localiser.microphone_array
    constant_array = undifferentiated(microphone_array)
    constant_objective = METHODS[localiser.method].create(undifferentiated(power), use, constant_array)
    # If there are maps, the minimisation starts from the best pixel only.
    unknowns, excess_cost, cost_difference, converged, outline_side = find_minima(
        constant_objective, first_start, second_start, has_second_start if localiser.pixels is None else None
    )
    likelihood = Likelihood.create(power, use, microphone_array)
    objective = likelihood if localiser.method == "likelihood" else Consistency.create(power, use, microphone_array)
    unknowns = differentiable_minima(objective, unknowns, outline_side, longer_side(constant_array.surface))
    return _source_estimate(objective, likelihood, unknowns, excess_cost, cost_difference, converged)


def _source_estimate(
    objective, likelihood: Likelihood, unknowns, excess_cost, cost_difference, converged
) -> SourceEstimate:
    xp = namespace(likelihood, unknowns)
    surface, chart = likelihood.microphone_array.surface, unknowns[:2]
    if isinstance(objective, Likelihood):
        strength = xp.exp(unknowns[2])
        chart_covariance = inverse_small(likelihood.expand(unknowns)[2])[:2, :2]
    else:
        strength = likelihood.strength(likelihood.microphone_array.response(chart))
        chart_covariance = objective.covariance(chart, strength)
    misfit = likelihood.misfit(xp.concatenate([chart, xp.log(strength)[None]]))
    position, covariance = to_three_dimensions(surface, chart, chart_covariance)
    num_used_microphones = xp.sum(likelihood.use, axis=0)
    has_position = (num_used_microphones >= 3) & xp.all(xp.isfinite(unknowns), axis=0)
    return SourceEstimate(
        position=xp.where(has_position[:, None], position, xp.nan),
        covariance=xp.where(has_position[:, None, None], covariance, xp.nan),
        strength=xp.where(has_position, strength, xp.nan),
        misfit=xp.where(has_position, misfit, xp.nan),
        freedom=xp.maximum(num_used_microphones - 3, 0),
        excess=xp.where(has_position, 2 * excess_cost, xp.nan),
        rival=xp.where(has_position, 2 * cost_difference, xp.nan),
        converged=converged & has_position,
    )
