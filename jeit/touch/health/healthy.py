"""The healthy state of a skin: principal directions of its touches, usual changes, and steadiness of its channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import real_array
from jeit.touch.health.event import change_size, channel_medians, lasting_step, window_change
from jeit.touch.health.steadiness import Steadiness

# Maximum number of steps of a window (with more frames, several frames are averaged to a step).
_MAX_WINDOW_STEPS = 48
# Minimum number of steps of a window.
_MIN_WINDOW_STEPS = 5
# Minimum number of windows of a healthy recording.
_MIN_NUM_WINDOWS = 8
# Minimum and maximum length of windows, in frames, for a healthy recording without a quiet interval.
_MIN_WINDOW_FRAMES, _MAX_WINDOW_FRAMES = 12, 64
# Default length of a window, as a multiple of the longest touch.
_WINDOW_PER_TOUCH = 3.0
# Minimum of the default length of a window, as a fraction of the recording.
_MIN_WINDOW_FRACTION = 1 / 40
# Limit of a change between windows, as a multiple of the maximum among healthy windows.
_CHANGE_LIMIT_FACTOR = 2.0
# Minimum limit of a change between windows, in standard deviations of healthy changes.
_MIN_CHANGE_SIZE = 4.0
# Increase of `_CHANGE_LIMIT_FACTOR`, to be divided by the number of windows.
_CHANGE_LIMIT_FACTOR_INCREASE = 20.0
# Factor by which windows may be shorter than touches require.
_SHORT_WINDOW_FACTOR = 1.5
# Factor on the limits of changes if windows are even shorter, because touches then appear to last.
_BRIEF_LIMIT_FACTOR = 2.0
# Minimum fraction of a lasting step of the voltages that remains one window later.
_MIN_REMAINING_FRACTION = 0.4
# Limit of the change of voltages from the healthy recording to another recording, as a multiple of the maximum between
# healthy windows.
_LEVEL_LIMIT_FACTOR = 3.0
# Minimum ratio of the change in a touched frame to the change in quiet frames.
_MIN_TOUCH_RATIO = 3.0
# Quantile of the changes of all frames that estimates the change in quiet frames.
_QUIET_QUANTILE = 0.3
# Maximum number of principal directions of touches.
_MAX_NUM_DIRECTIONS = 40
# Fraction of the touches' energy that the directions explain.
_EXPLAINED_FRACTION = 0.98
# A change is unlike touches if its fraction of energy outside of the directions of touches exceeds this quantile over
# healthy touches.
_OUTSIDE_QUANTILE = 0.99
# Minimum energy of the healthy touches, relative to that of a strong touch.
_MIN_STRONG_ENERGY = 0.2
_MIN_NUM_FRAMES = 20
# Fraction of the changes from frame to frame, those of smallest magnitude, that touches do not affect.
_UNTOUCHED_FRACTION = 0.8
# Mean magnitude of this fraction of the values of a standard normal variable, those of smallest magnitude.
_NORMAL_MEAN_MAGNITUDE = 0.5586
# Ratio of the standard deviation of a normal variable to its mean magnitude.
_DEVIATION_PER_MEAN_MAGNITUDE = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True)
class HealthyState:
    """Healthy state of a skin and its usual variation, learnt from a recording.

    **Fields**, where arrays without a stated shape contain one value for each channel: `reference`: voltage of the
    untouched skin, volts; `used`: whether the channel has readings; `noise`: noise from frame to frame, volts; `span`
    (2, channels): minimum and maximum change in the recording, volts; `stride`: number of frames averaged to a step in
    time; `window`: number of steps of a window; `scale`: usual change between consecutive windows, volts; `limit`:
    limit of the change between windows (`change_size`) for a change that lasts; `sudden_limit`: limit, not exceeded by
    touches either, above which a change may be reported at once; `level_scale`: usual change between any two windows,
    volts; `level_limit`: limit for a change from the healthy recording to another recording; `touch_directions`
    (channels, directions): principal directions of touches, orthonormal in units of noise; `max_fraction_outside`:
    maximum fraction of the energy of touches outside of these directions; `steadiness`: steadiness of single channels;
    `period`: seconds between frames, or 1; `is_brief`: whether the recording was too short for its touches, so that
    limits are twice as high.
    """

    reference: Float[np.ndarray, " M"]
    used: Bool[np.ndarray, " M"]
    noise: Float[np.ndarray, " M"]
    span: Float[np.ndarray, "2 M"]
    stride: int
    window: int
    scale: Float[np.ndarray, " M"]
    limit: float
    sudden_limit: float
    level_scale: Float[np.ndarray, " M"]
    level_limit: float
    touch_directions: Float[np.ndarray, "M k"]
    max_fraction_outside: float
    steadiness: Steadiness
    period: float
    is_brief: bool

    @classmethod
    def learn(
        cls, frames: Float[np.ndarray, "F M"], period: float = 1.0, window_duration: float | None = None
    ) -> "HealthyState":
        """Learn the healthy state from frames (frames, channels), with or without touches, `period` seconds apart.

        `window_duration`: length of a window, seconds, which must exceed the length of every touch; by default
        estimated from the touches in the frames. Raises `ValueError` for fewer than 20 frames, and if every channel
        lacks readings or is constant.
        """
        if len(frames) < _MIN_NUM_FRAMES:
            raise ValueError(
                f"healthy: {len(frames)} frames are too few to know what is healthy; give {_MIN_NUM_FRAMES} or more, a "
                "minute of them with touches at best."
            )
        frames = np.where(np.isfinite(frames), frames, np.nan)
        is_used = np.isfinite(frames).mean(axis=0) > 0.5
        medians = channel_medians(frames)
        noise = _estimate_noise(frames)
        is_used &= noise > 1e-12 * np.nanmax(np.abs(medians), initial=0.0)
        is_used &= noise > 0
        if not is_used.any():
            raise ValueError("healthy: every channel lacks readings or is constant; is this a recording of the skin?")
        noise = np.where(is_used, noise, np.inf)
        frames = np.where(is_used, frames, np.nan)
        window, wanted_length = _window_length(frames, noise, period, window_duration)
        is_brief = wanted_length > _SHORT_WINDOW_FACTOR * window
        limit_factor = _BRIEF_LIMIT_FACTOR if is_brief else 1.0
        stride = max(1, -(-window // _MAX_WINDOW_STEPS))
        steps = average_frames(frames, stride)
        window = max(_MIN_WINDOW_STEPS, window // stride)
        scale, limit, sudden_limit = _step_limits(
            _window_triples(steps, window), window, _median_noise(noise, stride * window)
        )
        level_scale, level_limit = _level_limit(_window_levels(steps, window), scale)
        touch_directions, max_fraction_outside = _touch_directions(frames, noise, stride * window)
        deviations = frames - medians
        span = np.stack([np.nanmin(deviations, axis=0, initial=0.0), np.nanmax(deviations, axis=0, initial=0.0)])
        reference = np.where(is_used, np.nan_to_num(medians), 0.0)
        steadiness = Steadiness.learn(steps, window, noise)
        return cls(
            reference=reference,
            used=is_used,
            noise=noise,
            span=span,
            stride=stride,
            window=window,
            scale=scale,
            limit=limit_factor * limit,
            sudden_limit=limit_factor * sudden_limit,
            level_scale=level_scale,
            level_limit=limit_factor * level_limit,
            touch_directions=touch_directions,
            max_fraction_outside=max_fraction_outside,
            steadiness=steadiness,
            period=period,
            is_brief=is_brief,
        )

    def fraction_outside(self, change: Float[np.ndarray, " M"]) -> float:
        """Compute the fraction of a voltage change's sum of squares, in units of noise, that is outside of the
        directions of touches."""
        return float(_fraction_outside((np.nan_to_num(change) / self.noise)[None], self.touch_directions)[0])


def average_frames(frames: Float[np.ndarray, "F M"], stride: int) -> Float[np.ndarray, "n M"]:
    """Average every `stride` consecutive frames; the mean of each channel is over the frames with a reading."""
    if stride == 1:
        return frames
    groups = frames[: len(frames) // stride * stride].reshape(-1, stride, frames.shape[1])
    has_reading = np.isfinite(groups)
    num_readings = has_reading.sum(axis=1)
    return np.where(
        num_readings > 0, np.where(has_reading, groups, 0.0).sum(axis=1) / np.maximum(num_readings, 1), np.nan
    )


def _estimate_noise(frames: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of every channel's noise from frame to frame from the smaller changes."""
    steps = np.diff(frames, axis=0)
    has_steps = np.isfinite(steps).any(axis=0)
    deviations, trimmed_deviations, total_deviations = np.zeros((3, frames.shape[1]))
    magnitudes = np.sort(np.abs(steps[:, has_steps]), axis=0)  # NaN last
    num_readings = np.isfinite(magnitudes).sum(axis=0)
    deviations[has_steps] = 1.4826 * np.nanmedian(magnitudes, axis=0) / np.sqrt(2)
    total_deviations[has_steps] = np.nanstd(steps[:, has_steps], axis=0) / np.sqrt(2)
    # With a coarse analogue-to-digital converter, the median change is zero or one step of the converter; the mean
    # change is more informative.
    num_smallest_changes = np.maximum((_UNTOUCHED_FRACTION * num_readings).astype(int), 1)
    trimmed_deviations[has_steps] = (
        np.cumsum(np.nan_to_num(magnitudes), axis=0)[num_smallest_changes - 1, np.arange(len(num_smallest_changes))]
        / num_smallest_changes
        / _NORMAL_MEAN_MAGNITUDE
        / np.sqrt(2)
    )
    deviations = np.where(
        (deviations > 0.05 * total_deviations) & (deviations < 2 * trimmed_deviations), deviations, trimmed_deviations
    )
    return np.where(deviations > 0.05 * total_deviations, deviations, total_deviations)


def _window_length(
    frames: np.ndarray, noise: np.ndarray, period: float, window_duration: float | None
) -> tuple[int, float]:
    """Return the length of a window, and the length that touches require, for which the recording may be too short;
    both in frames."""
    max_length = max(_MIN_WINDOW_STEPS, len(frames) // _MIN_NUM_WINDOWS)
    if window_duration is not None:
        return int(np.clip(np.ceil(window_duration / period), _MIN_WINDOW_STEPS, max_length)), window_duration / period
    change_sizes = change_size((frames - channel_medians(frames)) / noise)
    quiet_size = np.quantile(change_sizes, _QUIET_QUANTILE)
    is_touched = change_sizes > _MIN_TOUCH_RATIO * quiet_size
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_touched.astype(int), [0]])))
    touch_lengths = edges[1::2] - edges[::2]
    min_length = min(max(_MIN_WINDOW_FRAMES, int(_MIN_WINDOW_FRACTION * len(frames))), max_length)
    wanted_length = _WINDOW_PER_TOUCH * float(touch_lengths.max(initial=0))
    if touch_lengths.size and touch_lengths.max() > max_length:
        return int(np.clip(max_length // 2, min_length, max(min_length, _MAX_WINDOW_FRAMES))), wanted_length
    return int(np.clip(wanted_length, min_length, max_length)), wanted_length


def _median_noise(noise: np.ndarray, num_frames: int) -> np.ndarray:
    """Compute the standard deviation of each channel's difference between the medians of two windows of frames that
    contain only noise."""
    return noise * np.sqrt(np.pi / max(num_frames, 2))


def _window_triples(steps: np.ndarray, window: int) -> np.ndarray:
    """Return the triples of consecutive windows in a recording (triples, 3 `window`, channels), with `window` steps in
    each window."""
    starts = range(0, max(1, len(steps) - 3 * window + 1), max(1, window // 4))
    return np.array([steps[start : start + 3 * window] for start in starts])


def _window_levels(steps: np.ndarray, window: int) -> np.ndarray:
    """Compute the differences (windows, channels) of the medians of windows from the median of the whole recording."""
    starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
    return np.array([channel_medians(steps[start : start + window]) for start in starts]) - channel_medians(steps)


def _step_limits(window_triples: np.ndarray, window: int, floor: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Estimate the scale of each channel's change between windows, and two limits of voltage steps relative to this
    scale.

    The first limit is for voltage steps that are still present one window later; the second limit is for all steps,
    including touches. The steps in each half of the recording are relative to the scale of the other half, which is
    independent of them.
    """
    pairs = window_triples[:, : 2 * window]
    changes = np.nan_to_num(np.array([window_change(pair) for pair in pairs]))
    middle_index, lasting_sizes, sizes = len(changes) // 2, [0.0], [0.0]
    untouched_medians = channel_medians(
        np.concatenate(list(window_triples[:: max(1, len(window_triples) // _MIN_NUM_WINDOWS)]))
    )
    for is_training_part, test in (
        (slice(None, middle_index), slice(middle_index, None)),
        (slice(middle_index, None), slice(None, middle_index)),
    ):
        scale = _deviation_of_changes(changes[is_training_part], floor)
        for triple, pair in zip(window_triples[test], pairs[test], strict=True):
            step = lasting_step(pair, scale, 0.0)
            if step is None:
                continue
            sizes.append(step.size)
            direction = np.nan_to_num(step.change / scale**2)
            medians_after = channel_medians(triple[2 * window :])
            # A step back to the voltages of the untouched skin is the end of a touch.
            if change_size((medians_after - untouched_medians) / scale) < _MIN_REMAINING_FRACTION * step.size:
                continue
            lasting_change = np.nan_to_num(medians_after - channel_medians(pair[:window]))
            if lasting_change @ direction > _MIN_REMAINING_FRACTION * (np.nan_to_num(step.change) @ direction):
                lasting_sizes.append(step.size)
        lasting_sizes.append(float(np.median(change_size(changes[test] / scale))) if len(changes[test]) else 0.0)
    factor = _CHANGE_LIMIT_FACTOR + _CHANGE_LIMIT_FACTOR_INCREASE / max(len(changes), 1)
    lasting_limit = max(_MIN_CHANGE_SIZE, factor * max(lasting_sizes))
    return _deviation_of_changes(changes, floor), lasting_limit, max(lasting_limit, factor * max(sizes))


def _level_limit(changes: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, float]:
    """Estimate the scale of each channel's differences between windows and the whole recording, and the limit of these
    differences. Differences in each half of the recording are divided by the scale of the other half."""
    changes = np.nan_to_num(changes)
    middle_index = len(changes) // 2
    sizes = [
        change_size(changes[middle_index:] / _deviation_of_changes(changes[:middle_index], floor)),
        change_size(changes[:middle_index] / _deviation_of_changes(changes[middle_index:], floor)),
    ]
    max_size = float(np.concatenate(sizes).max(initial=0.0))
    return _deviation_of_changes(changes, floor), max(
        _MIN_CHANGE_SIZE, (_LEVEL_LIMIT_FACTOR + _CHANGE_LIMIT_FACTOR_INCREASE / max(len(changes), 1)) * max_size
    )


def _deviation_of_changes(changes: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of each channel's changes from their mean magnitude, as for a normal variable."""
    deviations = (
        _DEVIATION_PER_MEAN_MAGNITUDE * np.mean(np.abs(changes), axis=0) if len(changes) else np.zeros(changes.shape[1])
    )
    # A channel may have hardly changed by chance while others did change.
    median_deviation_ratio = np.median(deviations[np.isfinite(floor)] / floor[np.isfinite(floor)])
    return np.maximum(deviations, np.maximum(1.0, 0.5 * median_deviation_ratio) * floor)


def _touch_directions(frames: np.ndarray, noise: np.ndarray, window: int) -> tuple[np.ndarray, float]:
    """Compute the principal directions (channels, directions) of healthy touches, in units of noise, and the 99 %
    quantile of the fraction of touches' energy outside of these directions."""
    readings = np.where(np.isfinite(frames), frames, channel_medians(frames))
    centres = np.concatenate(
        [
            np.tile(channel_medians(window_frames), (len(window_frames), 1))
            for window_frames in np.array_split(readings, max(1, len(readings) // (2 * window)))
        ]
    )
    scaled_frames = np.nan_to_num((readings - centres) / noise)
    energies = np.sum(scaled_frames**2, axis=1)
    frames_of_touches = scaled_frames[
        energies > max(4 * np.median(energies), _MIN_STRONG_ENERGY * np.quantile(energies, 0.95))
    ]
    frames_of_touches = frames_of_touches if len(frames_of_touches) >= _MIN_WINDOW_STEPS else scaled_frames
    frames_of_touches = frames_of_touches[:: max(1, len(frames_of_touches) // 2000)]
    middle_index, fractions = len(frames_of_touches) // 2, []
    for training, test in (
        (frames_of_touches[:middle_index], frames_of_touches[middle_index:]),
        (frames_of_touches[middle_index:], frames_of_touches[:middle_index]),
    ):
        if len(training) and len(test):
            fractions.append(_fraction_outside(test, _principal_directions(training)))
    max_fraction_outside = float(np.quantile(np.concatenate(fractions), _OUTSIDE_QUANTILE)) if fractions else 1.0
    return _principal_directions(frames_of_touches), max_fraction_outside


def _principal_directions(frames: np.ndarray) -> np.ndarray:
    """Compute the leading principal directions (channels, directions) of frames, which explain up to 98 % of the
    frames' energy."""
    _, singular_values, rows = np.linalg.svd(frames, full_matrices=False)
    fractions = np.cumsum(singular_values**2) / max(np.sum(singular_values**2), 1e-300)
    num_directions = min(
        int(np.searchsorted(fractions, _EXPLAINED_FRACTION)) + 1, _MAX_NUM_DIRECTIONS, max(1, len(frames) // 4)
    )
    return rows[: min(num_directions, max(1, frames.shape[1] // 2))].T


def _fraction_outside(scaled_changes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Compute the fraction of the energy (sum of squares) of each voltage change that is outside of the
    `directions`."""
    energies = np.sum(scaled_changes**2, axis=1)
    energies_outside = energies - np.sum((scaled_changes @ directions) ** 2, axis=1)
    return np.clip(energies_outside / np.maximum(energies, 1e-300), 0.0, 1.0)


def check_frames(name: str, values) -> Float[np.ndarray, "F M"]:
    """Frames (F, M), volts, as an array. Raises `ValueError` for another number of dimensions, and without frames."""
    frames = real_array(name, values, "frames (F, M), volts")
    if frames.ndim != 2 or not frames.size:
        raise ValueError(f"{name} must be frames (F, M), volts, one row each; it has shape {frames.shape}.")
    return frames


def check_times(values, num_frames: int) -> Float[np.ndarray, " F"]:
    """Times (F,) of frames, seconds, as an array. Raises `ValueError` unless there is a finite time for each frame."""
    seconds = real_array("times", values, "seconds (F,), one for each frame")
    if seconds.shape != (num_frames,) or not np.isfinite(seconds).all():
        raise ValueError(f"times: give one for each of the {num_frames} frames; they have shape {seconds.shape}.")
    return seconds
