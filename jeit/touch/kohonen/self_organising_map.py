"""`SelfOrganisingMap`: neurons on a grid, each with a frame of its own, so that neighbours have similar frames."""

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
from jeit.touch.kohonen.training import Schedule, train

# Fewer frames define no order.
_FEWEST = 3
# Weights at the start, over the frames' root mean square.
_SMALL = 1e-3
# A radius, grid steps, within which only the winner moves: for its neighbours exp(−1/2ρ²) underflows.
_ALONE = 0.01
# The number of frames whose distances to all neurons are computed at once.
_AT_ONCE = 1024


@dataclass(frozen=True)
class SelfOrganisingMap:
    """Kohonen's map of frames of M channels; make it with `SelfOrganisingMap.fit`.

    **Fields**: `weights` (R, C, M), the frame of every neuron on a grid of R by C, in the unit of frames; `scale`, the
    distance of a frame from a neuron at which its activity is a half, the same unit.
    """

    weights: Float[np.ndarray, "R C M"]
    scale: float

    def __post_init__(self):
        """Raises `ValueError` for weights that are no finite (R, C, M), and a scale that is not positive."""
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
        schedule: Schedule | None = None,
        scale: float | None = None,
    ) -> "SelfOrganisingMap":
        """Learn a map of frames (N, M): volts, or changes, all of one unit.

        `key` (`jax.random.key`) orders the frames: all once, then all again in another order, until the `schedule` has
        had as many as it shows. `shape`: rows and columns. `scale`: unless given the median distance of the frames from
        their winners. Weights are small at the start, and random. Raises `ValueError` for frames that are not numbers,
        NaN, fewer than three or all the same, and what is no key, shape, schedule or scale.
        """
        schedule = Schedule() if schedule is None else schedule
        return fit_maps(frames, [key], shape=shape, schedules=[schedule], scale=scale)[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.weights.shape[0], self.weights.shape[1]

    def distances(self, frames: ArrayLike) -> Float[np.ndarray, "n R C"]:
        """Euclidean distances of frames (n, M), or one (M,), from every neuron, in their unit. Raises `ValueError` for
        frames of another number of channels, and NaN."""
        return np.sqrt(self._squared(self.checked(frames))).reshape(-1, *self.shape)

    def activity(self, frames: ArrayLike) -> Float[np.ndarray, "n R C"]:
        """Activity of neurons for frames (n, M), or one (M,): 1 / (1 + distance / scale), 1 for a neuron's own frame.

        Raises as `distances` does.
        """
        return 1 / (1 + self.distances(frames) / self.scale)

    def winners(self, frames: ArrayLike) -> Int[np.ndarray, "n 2"]:
        """Row and column (n, 2) of the neuron nearest to each of frames (n, M), or one (M,). Raises as `distances`
        does."""
        nearest = self._squared(self.checked(frames)).argmin(axis=1)
        return np.stack(np.unravel_index(nearest, self.shape), axis=1)

    def nearest(self, frames: Float[np.ndarray, "n M"], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n, count), row by row of the grid, of the neurons nearest to checked frames, the nearest first, and
        their distances (n, count)."""
        squared = self._squared(frames)
        some = np.argpartition(squared, count - 1, axis=1)[:, :count]
        near = np.take_along_axis(squared, some, axis=1)
        order = np.argsort(near, axis=1)
        return np.take_along_axis(some, order, axis=1), np.sqrt(np.take_along_axis(near, order, axis=1))

    def checked(self, frames: ArrayLike) -> Float[np.ndarray, "n M"]:
        """Convert frames (n, M) to numbers. Raises `ValueError` for other shapes, and NaN."""
        return checked_frames(frames, self.weights.shape[2])

    def _squared(self, frames: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n k"]:
        """Squared distances: |w − m|² − 2 (w − m)·(x − m) + |x − m|², m being the weights' mean."""
        middle, weights, squares = self._about_middle
        found = np.empty((len(frames), len(weights)))
        for first in range(0, len(frames), _AT_ONCE):
            own = frames[first : first + _AT_ONCE] - middle
            part = found[first : first + _AT_ONCE]
            np.matmul(own, weights.T, out=part)
            part *= -2
            part += squares
            part += np.sum(own**2, axis=1)[:, None]
        return np.maximum(found, 0.0, out=found)

    @cached_property
    def _about_middle(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        flat = self.weights.reshape(-1, self.weights.shape[2])
        middle = flat.mean(axis=0)
        return middle, flat - middle, np.sum((flat - middle) ** 2, axis=1)


def fit_maps(
    frames: ArrayLike,
    keys: Sequence[Array],
    *,
    shape: tuple[int, int] = (32, 32),
    schedules: Sequence[Schedule] = (Schedule(),),
    scale: float | None = None,
) -> list[SelfOrganisingMap]:
    """Learn several maps of the same frames at once: for each key with each schedule, those of the first key first.

    All schedules show as many frames. The other arguments, and what is raised, are as in `SelfOrganisingMap.fit`.
    """
    frames = checked_frames(frames)
    learnt, _ = learn_weights(frames, keys, shape, schedules)
    return [_scaled(one, frames, scale) for one in learnt]


def learn_weights(
    frames: Float[np.ndarray, "N M"],
    keys: Sequence[Array],
    shape: tuple[int, int],
    schedules: Sequence[Schedule],
) -> tuple[Float[np.ndarray, "k R C M"], Float[np.ndarray, "k T"]]:
    """Learn the weights of the maps that `fit_maps` makes, and the mean of their weights after each frame.

    Raises `ValueError` as `fit_maps` does.
    """
    if len(frames) < _FEWEST or (frames == frames[0]).all():
        raise ValueError(f"frames: {counted(len(frames), 'frame')}, all the same or too few to learn a map from.")
    check_kind("keys", keys, (list, tuple), "a list of them, such as [jax.random.key(0)]")
    for key in keys:
        check_key(key)
    for one in schedules:
        check_kind("schedule", one, Schedule, "a Schedule, such as Schedule()")
    if not keys or len({one.steps for one in schedules}) != 1:
        raise ValueError("keys and schedules: give one at least of each, and schedules that show as many frames.")
    shape = _check_shape(shape)
    pairs = [(key, schedule) for key in keys for schedule in schedules]
    starts = np.stack([_started(frames, key, shape) for key, _ in pairs])
    orders = np.stack([_order(key, len(frames), schedule.steps) for key, schedule in pairs])
    rates = np.stack([schedule.rates() for _, schedule in pairs])
    longest = max(schedule.ordering for schedule in schedules)
    radii = np.stack([_filled(schedule.radii(shape), longest) for _, schedule in pairs])
    many = jax.vmap(train, in_axes=(0, None, 0, 0, 0)) if len(pairs) > 1 else _alone
    weights, curves = many(jnp.asarray(starts), jnp.asarray(frames), orders, rates, radii)
    return np.asarray(weights), np.asarray(curves)


def checked_frames(given, channels: int | None = None) -> Float[np.ndarray, "n M"]:
    """Convert frames (n, M), or one (M,), to numbers. Raises `ValueError` for other shapes and numbers of channels, and
    NaN."""
    frames = real_array("frames", given, "numbers (n, channels)")
    frames = frames[None] if frames.ndim == 1 else frames
    if frames.ndim != 2 or not frames.shape[1]:
        raise ValueError(f"frames has shape {frames.shape}; give (n, channels), a row for each frame.")
    if channels is not None and frames.shape[1] != channels:
        raise ValueError(f"frames has {frames.shape[1]} channels, and the map was learnt from {channels}.")
    if not np.isfinite(frames).all():
        rows = int((~np.isfinite(frames).all(axis=1)).sum())
        raise ValueError(
            f"frames: {counted(rows, 'frame')} of {len(frames)} have NaN or infinite readings; leave those frames out, "
            "or those channels."
        )
    return frames


def _filled(radii: Float[np.ndarray, " O"], longest: int) -> Float[np.ndarray, " L"]:
    """Radii of as many frames as the longest ordering phase of some schedules has: the tuning phase's are next to 0."""
    return np.concatenate([radii, np.full(longest - len(radii), _ALONE)])


def _alone(starts, frames, orders, rates, radii):
    return tuple(one[None] for one in train(starts[0], frames, orders[0], rates[0], radii[0]))


def _scaled(weights: np.ndarray, frames: np.ndarray, scale: float | None) -> SelfOrganisingMap:
    learnt = SelfOrganisingMap(weights, 1.0 if scale is None else scale)
    if scale is not None:
        return learnt
    usual = float(np.median(np.sqrt(learnt._squared(frames).min(axis=1))))
    return SelfOrganisingMap(weights, usual or float(np.std(frames)))


def _started(frames: np.ndarray, key: Array, shape: tuple[int, int]) -> Float[np.ndarray, "R C M"]:
    """Initial weights: small, and random."""
    size = _SMALL * float(np.sqrt(np.mean(frames**2)))
    return size * np.asarray(jax.random.normal(key, (*shape, frames.shape[1])))


def _order(key: Array, number: int, steps: int) -> Int[np.ndarray, " T"]:
    """Order of `number` frames, reordered after all were shown, for `steps` steps."""
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    rounds = [random.permutation(number) for _ in range(-(-steps // number))]
    return np.concatenate(rounds)[:steps]


def _check_shape(shape) -> tuple[int, int]:
    wanted = "two whole numbers, rows and columns, such as (32, 32)"
    check_kind("shape", shape, (tuple, list), wanted)
    if len(shape) != 2 or not all(is_number(one) and int(one) == one and one >= 1 for one in shape):
        raise ValueError(f"shape must be {wanted}; it is {shape!r}.")
    rows, columns = int(shape[0]), int(shape[1])
    if rows * columns < 2:
        raise ValueError("shape: one neuron alone is no map.")
    return rows, columns
