"""`SelfOrganisingMap`: neurons on a grid, each with its own frame of voltages, such that neighbours have similar
frames. The quality of a map: quantisation and topographic errors, and how fast the map's weights converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, counted, describe, is_number, real_array
from jeit.arguments.extras import import_optional
from jeit.touch.kohonen.training import MapSchedule, train

# Minimum number of frames from which a map is learnt: fewer frames define no order.
_MIN_FRAMES = 3
# Standard deviation of a map's initial weights, relative to the frames' root mean square.
_RELATIVE_INITIAL_DEVIATION = 1e-3
# Neighbourhood radius ρ, in grid steps, at which only the winner moves: for its neighbours, exp(−1/2ρ²) underflows.
_WINNER_ONLY_RADIUS = 0.01
# Number of frames whose distances to all neurons are computed at once.
_CHUNK_SIZE = 1024
# Maximum number of frames of which all pairs are compared to compute the trustworthiness of a map.
_MAX_COMPARED_FRAMES = 2000
# Number of neighbours of each frame, for the trustworthiness of a map.
_NUM_NEIGHBOURS = 12


@dataclass(frozen=True)
class SelfOrganisingMap:
    """Kohonen's self-organising map of frames, created by `SelfOrganisingMap.fit`.

    **Fields**: `weights` (rows, columns, channels): the frame of every neuron on a grid, in the unit of frames;
    `scale`: distance between a frame and a neuron's frame at which the neuron's activity is 1/2, in the same unit.

    **Example:**

    ```python
    learnt_map = SelfOrganisingMap.fit(map_frames, key, shape=(6, 6), schedule=MapSchedule(500, 500))
    print(learnt_map.winners(map_frames[:3]))
    ```
    """

    weights: Float[np.ndarray, "R C M"]
    scale: float

    def __post_init__(self):
        """Check the fields. Raises `ValueError` for weights that are not finite or not (rows, columns, channels), and
        for a scale that is not positive."""
        weights = real_array("weights", self.weights, "an array (R, C, M), a frame for every neuron")
        if weights.ndim != 3 or not weights.size or not np.isfinite(weights).all():
            raise ValueError(f"weights must be finite, (R, C, M), a frame for every neuron; they are {weights.shape}.")
        if not (is_number(self.scale) and self.scale > 0):
            raise ValueError(f"scale must be positive, in the unit of frames; it is {describe(self.scale)}.")

    @classmethod
    def fit(
        cls,
        frames: ArrayLike,
        key: Array,
        *,
        shape: tuple[int, int] = (32, 32),
        schedule: MapSchedule | None = None,
        scale: float | None = None,
    ) -> "SelfOrganisingMap":
        """Train a map on frames (frames, channels) of voltages or voltage changes, all in one unit.

        `key` (`jax.random.key`): determines the initial weights, which are small and random, and the order of the
        frames: all frames are shown once, then again in a different order, until the `schedule` ends. `shape`: rows and
        columns of the grid. `scale`: see the field of this name; by default the median distance of the frames from
        their nearest neurons. Raises `ValueError` for frames that are not numbers, contain NaN, are fewer than three or
        all the same, and for an invalid key, shape, schedule or scale.
        """
        schedule = MapSchedule() if schedule is None else schedule
        return fit_maps(frames, [key], shape=shape, schedules=[schedule], scale=scale)[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of the grid of neurons."""
        return self.weights.shape[0], self.weights.shape[1]

    def distances(self, frames: ArrayLike) -> Float[np.ndarray, "n R C"]:
        """Compute the Euclidean distances (frames, rows, columns) of frames (frames, channels) from every neuron's
        frame.

        Distances are in the unit of the frames. Raises `ValueError` for frames whose number of channels is not that of
        the map, and for NaN.
        """
        return np.sqrt(self._squared_distances(self.checked(frames))).reshape(-1, *self.shape)

    def activity(self, frames: ArrayLike) -> Float[np.ndarray, "n R C"]:
        """Compute the activity (frames, rows, columns) of every neuron for frames (frames, channels).

        The activity is 1 / (1 + distance / scale), which is 1 if the frame is the neuron's own frame. Raises
        `ValueError` as `distances` does.
        """
        return 1 / (1 + self.distances(frames) / self.scale)

    def winners(self, frames: ArrayLike) -> Int[np.ndarray, "n 2"]:
        """Find the row and the column on the grid of the neuron nearest to each frame (frames, channels), its winner.

        Raises `ValueError` as `distances` does.
        """
        nearest_neurons = self._squared_distances(self.checked(frames)).argmin(axis=1)
        return np.stack(np.unravel_index(nearest_neurons, self.shape), axis=1)

    def nearest(self, frames: Float[np.ndarray, "n M"], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Find the `count` neurons nearest to each frame, the nearest first; `frames` must be an array from `checked`.

        Returns the indices of the neurons, counted row by row on the grid, and their distances, both (frames, count).
        """
        squared_distances = self._squared_distances(frames)
        nearest_neurons = np.argpartition(squared_distances, count - 1, axis=1)[:, :count]
        nearest_squared_distances = np.take_along_axis(squared_distances, nearest_neurons, axis=1)
        sort_order = np.argsort(nearest_squared_distances, axis=1)
        return np.take_along_axis(nearest_neurons, sort_order, axis=1), np.sqrt(
            np.take_along_axis(nearest_squared_distances, sort_order, axis=1)
        )

    def checked(self, frames: ArrayLike) -> Float[np.ndarray, "n M"]:
        """Convert frames to an array (frames, channels). Raises `ValueError` for frames of a different shape, and for
        NaN."""
        return checked_frames(frames, self.weights.shape[2])

    def _squared_distances(self, frames: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n k"]:
        """Compute squared distances of frames x from weights w as |w − m|² − 2 (w − m)·(x − m) + |x − m|², with the
        mean weights m."""
        mean_weights, centred_weights, squared_norms = self._centred_weights
        squared_distances = np.empty((len(frames), len(centred_weights)))
        for chunk_start in range(0, len(frames), _CHUNK_SIZE):
            centred_frames = frames[chunk_start : chunk_start + _CHUNK_SIZE] - mean_weights
            distances_of_chunk = squared_distances[chunk_start : chunk_start + _CHUNK_SIZE]
            np.matmul(centred_frames, centred_weights.T, out=distances_of_chunk)
            distances_of_chunk *= -2
            distances_of_chunk += squared_norms
            distances_of_chunk += np.sum(centred_frames**2, axis=1)[:, None]
        return np.maximum(squared_distances, 0.0, out=squared_distances)

    @cached_property
    def _centred_weights(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        weight_rows = self.weights.reshape(-1, self.weights.shape[2])
        mean_weights = weight_rows.mean(axis=0)
        return mean_weights, weight_rows - mean_weights, np.sum((weight_rows - mean_weights) ** 2, axis=1)


def fit_maps(
    frames: ArrayLike,
    keys: Sequence[Array],
    *,
    shape: tuple[int, int] = (32, 32),
    schedules: Sequence[MapSchedule] = (MapSchedule(),),
    scale: float | None = None,
) -> list[SelfOrganisingMap]:
    """Train several maps on the same frames at once, one for each pair of a key and a schedule.

    The maps of the first key come first in the list. All schedules must show the same number of frames. The other
    arguments, and the errors raised, are as in `SelfOrganisingMap.fit`.
    """
    frames = checked_frames(frames)
    weights, _ = learn_weights(frames, keys, shape, schedules)
    return [_create_map(map_weights, frames, scale) for map_weights in weights]


def learn_weights(
    frames: Float[np.ndarray, "N M"],
    keys: Sequence[Array],
    shape: tuple[int, int],
    schedules: Sequence[MapSchedule],
) -> tuple[Float[np.ndarray, "k R C M"], Float[np.ndarray, "k T"]]:
    """Train the weights of several maps, as for `fit_maps`; also returns the mean of each map's weights after each
    frame.

    Raises `ValueError` as `fit_maps` does.
    """
    if len(frames) < _MIN_FRAMES or (frames == frames[0]).all():
        raise ValueError(f"frames: {counted(len(frames), 'frame')}, all the same or too few to learn a map from.")
    check_kind("keys", keys, (list, tuple), "a list of them, such as [jax.random.key(0)]")
    for key in keys:
        check_key(key)
    for schedule in schedules:
        check_kind("schedule", schedule, MapSchedule, "a MapSchedule, such as MapSchedule()")
    if not keys or len({schedule.steps for schedule in schedules}) != 1:
        raise ValueError("keys and schedules: give one at least of each, and schedules that show as many frames.")
    shape = _check_shape(shape)
    key_schedule_pairs = [(key, schedule) for key in keys for schedule in schedules]
    initial_weights = np.stack([_draw_initial_weights(frames, key, shape) for key, _ in key_schedule_pairs])
    frame_orders = np.stack([_draw_order(key, len(frames), schedule.steps) for key, schedule in key_schedule_pairs])
    learning_rates = np.stack([schedule.rates() for _, schedule in key_schedule_pairs])
    max_ordering = max(schedule.ordering for schedule in schedules)
    neighbourhood_radii = np.stack(
        [_extend_radii(schedule.radii(shape), max_ordering) for _, schedule in key_schedule_pairs]
    )
    train_maps = jax.vmap(train, in_axes=(0, None, 0, 0, 0)) if len(key_schedule_pairs) > 1 else _train_single_map
    weights, mean_weight_curves = train_maps(
        jnp.asarray(initial_weights), jnp.asarray(frames), frame_orders, learning_rates, neighbourhood_radii
    )
    return np.asarray(weights), np.asarray(mean_weight_curves)


def checked_frames(values, num_channels: int | None = None) -> Float[np.ndarray, "n M"]:
    """Convert frames, or one frame (channels,), to an array (frames, channels).

    Raises `ValueError` for frames of a different shape, for a number of channels other than `num_channels`, and for
    NaN.
    """
    frames = real_array("frames", values, "numbers (n, channels)")
    frames = frames[None] if frames.ndim == 1 else frames
    if frames.ndim != 2 or not frames.shape[1]:
        raise ValueError(f"frames has shape {frames.shape}; give (n, channels), a row for each frame.")
    if num_channels is not None and frames.shape[1] != num_channels:
        raise ValueError(f"frames has {frames.shape[1]} channels, and the map was learnt from {num_channels}.")
    if not np.isfinite(frames).all():
        num_invalid_frames = int((~np.isfinite(frames).all(axis=1)).sum())
        raise ValueError(
            f"frames: {counted(num_invalid_frames, 'frame')} of {len(frames)} have NaN or infinite readings; leave "
            "those frames out, or those channels."
        )
    return frames


def _extend_radii(radii: Float[np.ndarray, " O"], max_ordering: int) -> Float[np.ndarray, " L"]:
    """Extend the radii of a map's ordering phase to the longest ordering phase of several schedules.

    The added radii, which belong to the map's tuning phase, are almost 0.
    """
    return np.concatenate([radii, np.full(max_ordering - len(radii), _WINNER_ONLY_RADIUS)])


def _train_single_map(initial_weights, frames, frame_orders, learning_rates, radii):
    return tuple(
        map_result[None]
        for map_result in train(initial_weights[0], frames, frame_orders[0], learning_rates[0], radii[0])
    )


def _create_map(weights: np.ndarray, frames: np.ndarray, scale: float | None) -> SelfOrganisingMap:
    """Create a map from weights; if `scale` is None, the scale is the median distance of the frames from their nearest
    neurons."""
    fitted_map = SelfOrganisingMap(weights, 1.0 if scale is None else scale)
    if scale is not None:
        return fitted_map
    median_distance = float(np.median(np.sqrt(fitted_map._squared_distances(frames).min(axis=1))))
    return SelfOrganisingMap(weights, median_distance or float(np.std(frames)))


def _draw_initial_weights(frames: np.ndarray, key: Array, shape: tuple[int, int]) -> Float[np.ndarray, "R C M"]:
    """Draw small random numbers as the initial weights of a map."""
    initial_deviation = _RELATIVE_INITIAL_DEVIATION * float(np.sqrt(np.mean(frames**2)))
    return initial_deviation * np.asarray(jax.random.normal(key, (*shape, frames.shape[1])))


def _draw_order(key: Array, num_frames: int, num_steps: int) -> Int[np.ndarray, " T"]:
    """Draw the order in which frames are shown in training: a new permutation each time that all frames have been
    shown."""
    generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    frame_permutations = [generator.permutation(num_frames) for _ in range(-(-num_steps // num_frames))]
    return np.concatenate(frame_permutations)[:num_steps]


def _check_shape(grid_shape) -> tuple[int, int]:
    requirement_text = "two whole numbers, rows and columns, such as (32, 32)"
    check_kind("shape", grid_shape, (tuple, list), requirement_text)
    if len(grid_shape) != 2 or not all(
        is_number(grid_length) and int(grid_length) == grid_length and grid_length >= 1 for grid_length in grid_shape
    ):
        raise ValueError(f"shape must be {requirement_text}; it is {grid_shape!r}.")
    num_rows, num_columns = int(grid_shape[0]), int(grid_shape[1])
    if num_rows * num_columns < 2:
        raise ValueError("shape: a map needs two neurons or more.")
    return num_rows, num_columns


@dataclass(frozen=True)
class MapQuality:
    """Measures of how well a self-organising map preserves the neighbourhoods of frames.

    `quantisation_error`: mean distance of frames from their nearest neurons, in the unit of frames;
    `topographic_error`: share of the frames whose two nearest neurons are not neighbours on the grid, where each neuron
    has eight neighbours (Kiviluoto 1996); `trustworthiness`: 1 if all frames that are neighbours on the map are
    neighbours by the distance between frames (Venna and Kaski 2001).
    """

    quantisation_error: float
    topographic_error: float
    trustworthiness: float


def map_quality(learnt: SelfOrganisingMap, frames: ArrayLike) -> MapQuality:
    """Compute the quantisation error, the topographic error and the trustworthiness of a self-organising map.

    Trustworthiness is computed for at most 2,000 evenly spaced frames, with 12 neighbours of each frame.

    **Arguments:**

    - `learnt`: the self-organising map.
    - `frames`: frames (frames, channels), such as those that the map was learnt from, in the same unit as these.

    Raises `ValueError` if `learnt` is no map, and for fewer than 25 frames, frames whose number of channels is not that
    of the map, and NaN.

    **Example:**

    ```python
    quality = map_quality(learnt_map, map_frames)
    print(quality)
    ```
    """
    trustworthiness = import_optional("sklearn.manifold", "the trustworthiness of a map").trustworthiness

    check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
    frames = learnt.checked(frames)
    if len(frames) <= 2 * _NUM_NEIGHBOURS:
        raise ValueError(f"frames: {len(frames)} are too few to compare; give {2 * _NUM_NEIGHBOURS + 1} or more.")
    nearest_neurons, neuron_distances = learnt.nearest(frames, 2)
    winner_rows, winner_columns = np.unravel_index(nearest_neurons, learnt.shape)
    grid_distances = np.maximum(
        np.abs(winner_rows[:, 0] - winner_rows[:, 1]), np.abs(winner_columns[:, 0] - winner_columns[:, 1])
    )
    compared_frames = np.unique(np.linspace(0, len(frames) - 1, _MAX_COMPARED_FRAMES).astype(int))
    grid_positions = np.stack([winner_rows[compared_frames, 0], winner_columns[compared_frames, 0]], axis=1).astype(
        float
    )
    trustworthiness_score = trustworthiness(frames[compared_frames], grid_positions, n_neighbors=_NUM_NEIGHBOURS)
    return MapQuality(
        float(neuron_distances[:, 0].mean()), float(np.mean(grid_distances > 1)), float(trustworthiness_score)
    )


def learning_curves(
    frames: ArrayLike,
    key: Array,
    rates: Sequence[float],
    *,
    steps: int = 10_000,
    shape: tuple[int, int] = (32, 32),
) -> Float[np.ndarray, "r T"]:
    """Compute how the mean weight of self-organising maps changes in training, for several constant learning rates.

    Returns the mean of all weights after each training step (rates, steps), in the unit of frames. `frames`: (frames,
    channels). The initial weights of the maps are small. The neighbourhood radius is constant, half the map's longer
    side. Raises `ValueError` as `SelfOrganisingMap.fit` does.
    """
    constant_radius = max(shape) / 2
    constant_schedules = [
        MapSchedule(steps, 0, (float(constant_rate), float(constant_rate)), (constant_radius, constant_radius))
        for constant_rate in rates
    ]
    return learn_weights(checked_frames(frames), [key], shape, constant_schedules)[1]


def time_constant(curve: ArrayLike) -> float:
    """Compute the number of steps after which a learning curve (steps,) has risen from zero to 1 − 1/e of its final
    value.

    The final value is the mean of the last tenth of the curve. Raises `ValueError` for a curve that is not
    one-dimensional, not finite, or shorter than ten steps.
    """
    curve_values = real_array("curve", curve, "the means (T,) of a map's weights")
    if curve_values.ndim != 1 or len(curve_values) < 10 or not np.isfinite(curve_values).all():
        raise ValueError(f"curve must be finite, (T,), of ten steps or more; it has shape {curve_values.shape}.")
    final_value = curve_values[-len(curve_values) // 10 :].mean()
    return float(1 + np.argmax(curve_values / final_value >= 1 - np.exp(-1)))
