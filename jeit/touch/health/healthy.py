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
_BRIEF_RECORDING_FACTOR = 2.0
# Minimum fraction of a lasting step of the voltages that remains one window later.
_MIN_REMAINING_FRACTION = 0.4
# Limit of the change of voltages from the healthy recording to another recording, as a multiple of the maximum between
# healthy windows.
_LEVEL_LIMIT_FACTOR = 3.0
# Minimum ratio of the change in a touched frame to the change in quiet frames.
_MIN_TOUCH_RATIO = 3.0
# Quantile of the changes of all frames that estimates the change in quiet frames.
_UNTOUCHED_QUANTILE = 0.3
# Maximum number of principal directions of touches.
_MAX_NUM_DIRECTIONS = 40
# Fraction of the touches' energy that the directions explain.
_EXPLAINED_ENERGY_FRACTION = 0.98
# A change is unlike touches if its fraction of energy outside of the directions of touches exceeds this quantile over
# healthy touches.
_OUTSIDE_FRACTION_QUANTILE = 0.99
# Minimum energy of the healthy touches, relative to that of a strong touch.
_MIN_TOUCH_ENERGY_RATIO = 0.2
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
        is_used_channel = np.isfinite(frames).mean(axis=0) > 0.5
        median_frame = channel_medians(frames)
        noise = _estimate_noise(frames)
        is_used_channel &= noise > 1e-12 * np.nanmax(np.abs(median_frame), initial=0.0)
        is_used_channel &= noise > 0
        if not is_used_channel.any():
            raise ValueError("healthy: every channel lacks readings or is constant; is this a recording of the skin?")
        noise = np.where(is_used_channel, noise, np.inf)
        frames = np.where(is_used_channel, frames, np.nan)
        window_length, wanted_window_length = _window_length(frames, noise, period, window_duration)
        is_brief = wanted_window_length > _SHORT_WINDOW_FACTOR * window_length
        limit_factor = _BRIEF_RECORDING_FACTOR if is_brief else 1.0
        averaging_stride = max(1, -(-window_length // _MAX_WINDOW_STEPS))
        averaged_frames = average_frames(frames, averaging_stride)
        window_length = max(_MIN_WINDOW_STEPS, window_length // averaging_stride)
        change_scale, change_limit, sudden_limit = _step_limits(
            _window_triples(averaged_frames, window_length),
            window_length,
            _median_noise(noise, averaging_stride * window_length),
        )
        level_scale, level_limit = _level_limit(_window_levels(averaged_frames, window_length), change_scale)
        touch_directions, max_fraction_outside = _touch_directions(frames, noise, averaging_stride * window_length)
        frame_deviations = frames - median_frame
        deviation_span = np.stack(
            [np.nanmin(frame_deviations, axis=0, initial=0.0), np.nanmax(frame_deviations, axis=0, initial=0.0)]
        )
        reference = np.where(is_used_channel, np.nan_to_num(median_frame), 0.0)
        steadiness = Steadiness.learn(averaged_frames, window_length, noise)
        return cls(
            reference=reference,
            used=is_used_channel,
            noise=noise,
            span=deviation_span,
            stride=averaging_stride,
            window=window_length,
            scale=change_scale,
            limit=limit_factor * change_limit,
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
        return float(_fraction_outside_directions((np.nan_to_num(change) / self.noise)[None], self.touch_directions)[0])


def average_frames(frames: Float[np.ndarray, "F M"], stride: int) -> Float[np.ndarray, "n M"]:
    """Average every `stride` consecutive frames; the mean of each channel is over the frames with a reading."""
    if stride == 1:
        return frames
    frame_groups = frames[: len(frames) // stride * stride].reshape(-1, stride, frames.shape[1])
    has_reading = np.isfinite(frame_groups)
    num_readings = has_reading.sum(axis=1)
    return np.where(
        num_readings > 0, np.where(has_reading, frame_groups, 0.0).sum(axis=1) / np.maximum(num_readings, 1), np.nan
    )


def _estimate_noise(frames: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of every channel's noise from frame to frame from the smaller changes."""
    frame_differences = np.diff(frames, axis=0)
    has_differences = np.isfinite(frame_differences).any(axis=0)
    noise_deviations, trimmed_deviations, total_deviations = np.zeros((3, frames.shape[1]))
    difference_magnitudes = np.sort(np.abs(frame_differences[:, has_differences]), axis=0)  # NaN last
    num_readings = np.isfinite(difference_magnitudes).sum(axis=0)
    noise_deviations[has_differences] = 1.4826 * np.nanmedian(difference_magnitudes, axis=0) / np.sqrt(2)
    total_deviations[has_differences] = np.nanstd(frame_differences[:, has_differences], axis=0) / np.sqrt(2)
    # With a coarse analogue-to-digital converter, the median change is zero or one step of the converter; the mean
    # change is more informative.
    num_smallest_differences = np.maximum((_UNTOUCHED_FRACTION * num_readings).astype(int), 1)
    trimmed_deviations[has_differences] = (
        np.cumsum(np.nan_to_num(difference_magnitudes), axis=0)[
            num_smallest_differences - 1, np.arange(len(num_smallest_differences))
        ]
        / num_smallest_differences
        / _NORMAL_MEAN_MAGNITUDE
        / np.sqrt(2)
    )
    noise_deviations = np.where(
        (noise_deviations > 0.05 * total_deviations) & (noise_deviations < 2 * trimmed_deviations),
        noise_deviations,
        trimmed_deviations,
    )
    return np.where(noise_deviations > 0.05 * total_deviations, noise_deviations, total_deviations)


def _window_length(
    frames: np.ndarray, noise: np.ndarray, period: float, window_duration: float | None
) -> tuple[int, float]:
    """Return the length of a window, and the length that touches require, for which the recording may be too short;
    both in frames."""
    max_window_length = max(_MIN_WINDOW_STEPS, len(frames) // _MIN_NUM_WINDOWS)
    if window_duration is not None:
        return int(
            np.clip(np.ceil(window_duration / period), _MIN_WINDOW_STEPS, max_window_length)
        ), window_duration / period
    change_sizes = change_size((frames - channel_medians(frames)) / noise)
    untouched_change_size = np.quantile(change_sizes, _UNTOUCHED_QUANTILE)
    is_touched = change_sizes > _MIN_TOUCH_RATIO * untouched_change_size
    touch_edge_indices = np.flatnonzero(np.diff(np.concatenate([[0], is_touched.astype(int), [0]])))
    touch_lengths = touch_edge_indices[1::2] - touch_edge_indices[::2]
    min_window_length = min(max(_MIN_WINDOW_FRAMES, int(_MIN_WINDOW_FRACTION * len(frames))), max_window_length)
    wanted_window_length = _WINDOW_PER_TOUCH * float(touch_lengths.max(initial=0))
    if touch_lengths.size and touch_lengths.max() > max_window_length:
        return int(
            np.clip(max_window_length // 2, min_window_length, max(min_window_length, _MAX_WINDOW_FRAMES))
        ), wanted_window_length
    return int(np.clip(wanted_window_length, min_window_length, max_window_length)), wanted_window_length


def _median_noise(noise: np.ndarray, num_frames: int) -> np.ndarray:
    """Compute the standard deviation of each channel's difference between the medians of two windows of frames that
    contain only noise."""
    return noise * np.sqrt(np.pi / max(num_frames, 2))


def _window_triples(averaged_frames: np.ndarray, window_length: int) -> np.ndarray:
    """Return the triples of consecutive windows in a recording (triples, 3 `window_length`, channels), with
    `window_length` steps in each window."""
    window_starts = range(0, max(1, len(averaged_frames) - 3 * window_length + 1), max(1, window_length // 4))
    return np.array(
        [averaged_frames[window_start : window_start + 3 * window_length] for window_start in window_starts]
    )


def _window_levels(averaged_frames: np.ndarray, window_length: int) -> np.ndarray:
    """Compute the differences (windows, channels) of the medians of windows from the median of the whole recording."""
    window_starts = range(0, max(1, len(averaged_frames) - window_length + 1), max(1, window_length // 2))
    return np.array(
        [
            channel_medians(averaged_frames[window_start : window_start + window_length])
            for window_start in window_starts
        ]
    ) - channel_medians(averaged_frames)


def _step_limits(
    window_triples: np.ndarray, window_length: int, min_change_scale: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Estimate the scale of each channel's change between windows, and two limits of voltage steps relative to this
    scale.

    The first limit is for voltage steps that are still present one window later; the second limit is for all steps,
    including touches. The steps in each half of the recording are relative to the scale of the other half, which is
    independent of them.
    """
    window_pairs = window_triples[:, : 2 * window_length]
    window_changes = np.nan_to_num(np.array([window_change(window_pair) for window_pair in window_pairs]))
    middle_index, lasting_step_sizes, step_sizes = len(window_changes) // 2, [0.0], [0.0]
    untouched_medians = channel_medians(
        np.concatenate(list(window_triples[:: max(1, len(window_triples) // _MIN_NUM_WINDOWS)]))
    )
    for training_windows, test_windows in (
        (slice(None, middle_index), slice(middle_index, None)),
        (slice(middle_index, None), slice(None, middle_index)),
    ):
        change_scale = _deviation_of_changes(window_changes[training_windows], min_change_scale)
        for window_triple, window_pair in zip(window_triples[test_windows], window_pairs[test_windows], strict=True):
            lasting_window_step = lasting_step(window_pair, change_scale, 0.0)
            if lasting_window_step is None:
                continue
            step_sizes.append(lasting_window_step.size)
            step_direction = np.nan_to_num(lasting_window_step.change / change_scale**2)
            medians_after = channel_medians(window_triple[2 * window_length :])
            # A step back to the voltages of the untouched skin is the end of a touch.
            if (
                change_size((medians_after - untouched_medians) / change_scale)
                < _MIN_REMAINING_FRACTION * lasting_window_step.size
            ):
                continue
            lasting_change = np.nan_to_num(medians_after - channel_medians(window_pair[:window_length]))
            if lasting_change @ step_direction > _MIN_REMAINING_FRACTION * (
                np.nan_to_num(lasting_window_step.change) @ step_direction
            ):
                lasting_step_sizes.append(lasting_window_step.size)
        lasting_step_sizes.append(
            float(np.median(change_size(window_changes[test_windows] / change_scale)))
            if len(window_changes[test_windows])
            else 0.0
        )
    limit_factor = _CHANGE_LIMIT_FACTOR + _CHANGE_LIMIT_FACTOR_INCREASE / max(len(window_changes), 1)
    lasting_limit = max(_MIN_CHANGE_SIZE, limit_factor * max(lasting_step_sizes))
    return (
        _deviation_of_changes(window_changes, min_change_scale),
        lasting_limit,
        max(lasting_limit, limit_factor * max(step_sizes)),
    )


def _level_limit(level_changes: np.ndarray, min_change_scale: np.ndarray) -> tuple[np.ndarray, float]:
    """Estimate the scale of each channel's differences between windows and the whole recording, and the limit of these
    differences. Differences in each half of the recording are divided by the scale of the other half."""
    level_changes = np.nan_to_num(level_changes)
    middle_index = len(level_changes) // 2
    level_change_sizes = [
        change_size(
            level_changes[middle_index:] / _deviation_of_changes(level_changes[:middle_index], min_change_scale)
        ),
        change_size(
            level_changes[:middle_index] / _deviation_of_changes(level_changes[middle_index:], min_change_scale)
        ),
    ]
    max_level_change_size = float(np.concatenate(level_change_sizes).max(initial=0.0))
    return _deviation_of_changes(level_changes, min_change_scale), max(
        _MIN_CHANGE_SIZE,
        (_LEVEL_LIMIT_FACTOR + _CHANGE_LIMIT_FACTOR_INCREASE / max(len(level_changes), 1)) * max_level_change_size,
    )


def _deviation_of_changes(changes: np.ndarray, min_deviations: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of each channel's changes from their mean magnitude, as for a normal variable."""
    deviations = (
        _DEVIATION_PER_MEAN_MAGNITUDE * np.mean(np.abs(changes), axis=0) if len(changes) else np.zeros(changes.shape[1])
    )
    # A channel may have hardly changed by chance while others did change.
    median_deviation_ratio = np.median(
        deviations[np.isfinite(min_deviations)] / min_deviations[np.isfinite(min_deviations)]
    )
    return np.maximum(deviations, np.maximum(1.0, 0.5 * median_deviation_ratio) * min_deviations)


def _touch_directions(frames: np.ndarray, noise: np.ndarray, window_length: int) -> tuple[np.ndarray, float]:
    """Compute the principal directions (channels, directions) of healthy touches, in units of noise, and the 99 %
    quantile of the fraction of touches' energy outside of these directions."""
    complete_frames = np.where(np.isfinite(frames), frames, channel_medians(frames))
    window_medians = np.concatenate(
        [
            np.tile(channel_medians(window_frames), (len(window_frames), 1))
            for window_frames in np.array_split(complete_frames, max(1, len(complete_frames) // (2 * window_length)))
        ]
    )
    noise_scaled_frames = np.nan_to_num((complete_frames - window_medians) / noise)
    frame_energies = np.sum(noise_scaled_frames**2, axis=1)
    frames_of_touches = noise_scaled_frames[
        frame_energies > max(4 * np.median(frame_energies), _MIN_TOUCH_ENERGY_RATIO * np.quantile(frame_energies, 0.95))
    ]
    frames_of_touches = frames_of_touches if len(frames_of_touches) >= _MIN_WINDOW_STEPS else noise_scaled_frames
    frames_of_touches = frames_of_touches[:: max(1, len(frames_of_touches) // 2000)]
    middle_index, fractions_outside = len(frames_of_touches) // 2, []
    for training_frames, test_frames in (
        (frames_of_touches[:middle_index], frames_of_touches[middle_index:]),
        (frames_of_touches[middle_index:], frames_of_touches[:middle_index]),
    ):
        if len(training_frames) and len(test_frames):
            fractions_outside.append(_fraction_outside_directions(test_frames, _principal_directions(training_frames)))
    max_fraction_outside = (
        float(np.quantile(np.concatenate(fractions_outside), _OUTSIDE_FRACTION_QUANTILE)) if fractions_outside else 1.0
    )
    return _principal_directions(frames_of_touches), max_fraction_outside


def _principal_directions(frames: np.ndarray) -> np.ndarray:
    """Compute the leading principal directions (channels, directions) of frames, which explain up to 98 % of the
    frames' energy."""
    _, singular_values, right_singular_vectors = np.linalg.svd(frames, full_matrices=False)
    explained_fractions = np.cumsum(singular_values**2) / max(np.sum(singular_values**2), 1e-300)
    num_directions = min(
        int(np.searchsorted(explained_fractions, _EXPLAINED_ENERGY_FRACTION)) + 1,
        _MAX_NUM_DIRECTIONS,
        max(1, len(frames) // 4),
    )
    return right_singular_vectors[: min(num_directions, max(1, frames.shape[1] // 2))].T


def _fraction_outside_directions(scaled_changes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Compute the fraction of the energy (sum of squares) of each voltage change that is outside of the
    `directions`."""
    change_energies = np.sum(scaled_changes**2, axis=1)
    energies_outside = change_energies - np.sum((scaled_changes @ directions) ** 2, axis=1)
    return np.clip(energies_outside / np.maximum(change_energies, 1e-300), 0.0, 1.0)


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
