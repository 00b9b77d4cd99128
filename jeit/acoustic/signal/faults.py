"""Detection of faulty microphones and faulty stretches of sound, from the microphones' samples alone.

Four faults are distinguished: the samples of a channel never change (dead), do not change for a while (stuck), are cut
off at an end of the channel's range (clipping), or are not finite. Three kinds of similar signals are not faults: the
signal of a converter that holds each value for several samples, the signal of a quiet channel with an amplitude of a
few converter steps, and a signal with a single loud peak.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

# Fault codes of samples, as returned by `sample_faults`. Descriptions of faults are in this order.
SOUND, NOT_FINITE, STUCK, CLIPPING = range(4)
_FAULT_DESCRIPTIONS = {NOT_FINITE: "NaN or infinite", STUCK: "stuck", CLIPPING: "clipping"}

# Minimum duration of a stretch of constant samples that counts as stuck: in seconds, and in samples.
_MIN_STUCK_DURATION, _MIN_STUCK_SAMPLES = 0.02, 64
# A constant stretch is silence, not a fault, if the signal elsewhere decays to a range of at most this many converter
# steps, or at most this fraction of the channel's range.
_MAX_SILENCE_CONVERTER_STEPS, _MAX_RELATIVE_SILENCE_RANGE = 3.0, 1e-4
# Samples are at an end of the range if their distance from this end is at most the first fraction of the channel's
# range, or, if the full scale is known, their distance from the full scale is at most the second fraction of the full
# scale.
_RELATIVE_DISTANCE_FROM_TOP, _FULL_SCALE_DISTANCE_FROM_TOP = 3e-4, 1e-3
# Minimum number of converted values at the top of a clipped peak, and minimum ratio of the fall beside the peak to the
# fall of a parabola.
_MIN_CLIPPED_PEAK_VALUES, _MIN_CLIPPED_PEAK_FALL_RATIO = 3, 3.0


def sample_faults(
    samples: Float[np.ndarray, " S"], rate: float, full_scale: float | None = None
) -> tuple[UInt8[np.ndarray, " S"], str]:
    """Return the fault code of each sample of one channel, and the reason why the channel is dead ("" if the channel is
    not dead).

    The fault code is 0 (`SOUND`) for a good sample, otherwise `NOT_FINITE`, `STUCK` or `CLIPPING`. `rate`: sampling
    rate in Hz. `full_scale`: largest possible magnitude of a sample, or None if unknown.
    """
    fault_codes = np.zeros(samples.shape, np.uint8)
    is_finite_sample = np.isfinite(samples)
    has_only_finite_samples = bool(is_finite_sample.all())
    if not has_only_finite_samples:
        fault_codes[~is_finite_sample] = NOT_FINITE
        if not is_finite_sample.any():
            return fault_codes, "dead: every sample is NaN or infinite"
        samples = np.where(is_finite_sample, samples, np.nan)
    min_sample, max_sample = np.fmin.reduce(samples), np.fmax.reduce(samples)
    if min_sample == max_sample:
        return fault_codes, f"dead: every {'' if has_only_finite_samples else 'finite '}sample is {min_sample:g}"
    is_stuck = _stuck_samples(samples, rate, float(max_sample - min_sample))
    # A channel that stays at one end of its range is stuck, and does not clip.
    moving_samples = samples if is_stuck is None else np.where(is_stuck, np.nan, samples)
    is_clipped = _clipped_samples(moving_samples, full_scale)
    if is_clipped is not None:
        fault_codes[is_clipped] = CLIPPING
    if is_stuck is not None:
        fault_codes[is_stuck] = STUCK
    return fault_codes, ""


def window_faults(
    fault_codes: UInt8[np.ndarray, "*batch S"], dead_reason: str, length: int, hop: int
) -> tuple[Bool[np.ndarray, "*batch F"], str]:
    """Return the mask of the usable windows of one channel, and a description of the channel's faults ("" for none).

    `fault_codes`, `dead_reason`: as returned by `sample_faults`. Windows of `length` samples begin every `hop` samples
    along the last axis. A window with at least one faulty sample is not usable.
    """
    num_windows = 1 + (fault_codes.shape[-1] - length) // hop
    is_usable_window = np.ones((*fault_codes.shape[:-1], num_windows), bool)
    if dead_reason:
        return np.zeros_like(is_usable_window), dead_reason
    if not fault_codes.any():
        return is_usable_window, ""
    window_starts = hop * np.arange(num_windows)
    fault_texts = []
    for fault_code, fault_name in _FAULT_DESCRIPTIONS.items():
        fault_counts = np.cumsum(fault_codes == fault_code, axis=-1)
        fault_counts = np.concatenate([np.zeros((*fault_codes.shape[:-1], 1), int), fault_counts], axis=-1)
        is_faulty_window = fault_counts[..., window_starts + length] > fault_counts[..., window_starts]
        if is_faulty_window.any():
            is_usable_window &= ~is_faulty_window
            fault_texts.append(f"{fault_name} in {_format_share(is_faulty_window)} windows")
    return is_usable_window, "; ".join(fault_texts)


def intensity_faults(power: Float[np.ndarray, "F M"]) -> tuple[Bool[np.ndarray, "F M"], tuple[str, ...]]:
    """Return the mask of the usable intensities and a description of each channel's fault, for intensities `power`
    given without samples. Faults are NaN, infinity, and channels that contain only zeros."""
    is_finite_power = np.isfinite(power)
    is_dead_channel = ~(is_finite_power & (power != 0)).any(axis=0)
    fault_texts = []
    for is_finite_channel, is_dead in zip(is_finite_power.T, is_dead_channel, strict=True):
        if is_dead and is_finite_channel.any():
            fault_texts.append(f"dead: every {'' if is_finite_channel.all() else 'finite '}intensity is 0")
        elif is_dead:
            fault_texts.append("dead: every intensity is NaN or infinite")
        else:
            fault_texts.append(
                "" if is_finite_channel.all() else f"NaN or infinite in {_format_share(~is_finite_channel)} windows"
            )
    return is_finite_power & ~is_dead_channel, tuple(fault_texts)


def describe_faults(reasons: Sequence[str]) -> str:
    """Summarise the fault of each microphone ("" for none) in a line such as "microphones 0-2, 5: dead; microphone 3:
    …"."""
    microphones_by_reason: dict[str, list[int]] = {}
    for k, fault_reason in enumerate(reasons):
        if fault_reason:
            microphones_by_reason.setdefault(fault_reason, []).append(k)
    return "; ".join(
        f"{'microphone' if len(microphone_indices) == 1 else 'microphones'} "
        f"{_format_ranges(np.array(microphone_indices))}: {fault_reason}"
        for fault_reason, microphone_indices in microphones_by_reason.items()
    )


def _format_ranges(increasing_numbers: np.ndarray) -> str:
    """Format increasing integers as ranges: 0, 1, 2, 5 as "0-2, 5"."""
    number_runs = np.split(increasing_numbers, np.flatnonzero(np.diff(increasing_numbers) > 1) + 1)
    return ", ".join(
        f"{number_run[0]}-{number_run[-1]}" if len(number_run) > 1 else f"{number_run[0]}" for number_run in number_runs
    )


def _format_share(has_fault: np.ndarray) -> str:
    return f"all {has_fault.size}" if has_fault.all() else f"{int(has_fault.sum())} of {has_fault.size}"


def _true_runs(is_in_run: Bool[np.ndarray, " S"]) -> Shaped[np.ndarray, "2 R"]:
    """Start and end indices (2, R) of the R runs of True in `is_in_run`; the end is exclusive."""
    change_indices = np.flatnonzero(np.diff(is_in_run, prepend=False, append=False))
    return np.stack([change_indices[::2], change_indices[1::2]])


def _converter_step(samples: np.ndarray) -> float:
    """Step of the analogue-to-digital converter: the smallest nonzero difference between successive samples."""
    sample_changes = np.abs(np.diff(samples))
    return float(np.fmin.reduce(np.where(sample_changes > 0, sample_changes, np.inf)))


def _stuck_samples(samples: np.ndarray, rate: float, sample_range: float) -> Bool[np.ndarray, " S"] | None:
    """Mask of the stuck samples, those in long constant stretches; None if no sample is stuck, or if the signal also
    comes to rest elsewhere. `sample_range`: difference between the largest and smallest sample."""
    min_stuck_length = max(_MIN_STUCK_SAMPLES, round(_MIN_STUCK_DURATION * rate))
    # A stuck stretch covers at least two whole blocks. Stretches are searched for only if a block is constant, which
    # saves time.
    block_length = min_stuck_length // 4
    sample_blocks = samples[: samples.size // block_length * block_length].reshape(-1, block_length)
    block_ranges = sample_blocks.max(axis=1) - sample_blocks.min(axis=1)
    if not (block_ranges == 0).any():
        return None
    # Each flag stands for a pair of equal successive samples, so a run of n flags is a stretch of n + 1 samples.
    run_starts, run_ends = _true_runs(samples[1:] == samples[:-1])
    is_long_run = run_ends - run_starts + 1 >= min_stuck_length
    if not is_long_run.any():
        return None
    is_stuck = np.zeros(samples.shape, bool)
    for first_stuck_sample, last_stuck_sample in zip(run_starts[is_long_run], run_ends[is_long_run], strict=True):
        is_stuck[first_stuck_sample : last_stuck_sample + 1] = True
    # Silence can be constant too: with a coarse converter, or in a simulation without noise. The sound then fades into
    # silence, so that some other blocks are almost constant. In a stuck channel with noise, no other block is almost
    # constant.
    is_varying_block = ~is_stuck[: sample_blocks.size].reshape(sample_blocks.shape).any(axis=1) & np.isfinite(
        block_ranges
    )
    max_resting_range = max(
        _MAX_SILENCE_CONVERTER_STEPS * _converter_step(samples), _MAX_RELATIVE_SILENCE_RANGE * sample_range
    )
    return None if is_varying_block.any() and block_ranges[is_varying_block].min() <= max_resting_range else is_stuck


def _clipped_samples(samples: np.ndarray, full_scale: float | None) -> Bool[np.ndarray, " S"] | None:
    """Mask of the samples at an end of the channel's range, if the channel's peaks are cut off there; None if no peak
    is cut off."""
    min_sample, max_sample = np.fmin.reduce(samples), np.fmax.reduce(samples)
    is_clipped = None
    converter_step = samples_per_value = 0.0
    for peak_sign, peak_magnitude in ((1.0, max_sample), (-1.0, -min_sample)):
        ranges_below_top = [_RELATIVE_DISTANCE_FROM_TOP * (max_sample - min_sample)]
        if full_scale is not None and peak_magnitude >= (1 - _FULL_SCALE_DISTANCE_FROM_TOP) * full_scale:
            ranges_below_top.append(peak_magnitude - (1 - _FULL_SCALE_DISTANCE_FROM_TOP) * full_scale)
        distance_below_top = peak_magnitude - peak_sign * samples
        # Most channels need no further test, since they have too few samples near the end of the range to be clipped.
        if np.count_nonzero(distance_below_top <= max(ranges_below_top)) < _MIN_CLIPPED_PEAK_VALUES:
            continue
        if not samples_per_value:
            converter_step, samples_per_value = _converter_step(samples), _samples_per_value(samples)
        for range_below_top in ranges_below_top:
            is_near_top = distance_below_top <= range_below_top + converter_step
            if _has_clipped_peak(
                distance_below_top, is_near_top, range_below_top + 2 * converter_step, samples_per_value
            ):
                is_clipped = is_near_top if is_clipped is None else is_clipped | is_near_top
    return is_clipped


def _has_clipped_peak(
    distance_below_top: np.ndarray, is_near_top: Bool[np.ndarray, " S"], peak_height: float, samples_per_value: float
) -> bool:
    """Whether any run of samples in the mask `is_near_top` is a clipped peak.

    `distance_below_top` (S,): distance of each sample below the top. `samples_per_value`: number of samples per
    converted value. An unclipped peak is nearly a parabola: if n successive converted values stay within `peak_height`
    of the top, then k values later the peak has fallen by at most `peak_height` · ((n - 1 + 2k) / (n - 1))². A clipped
    peak falls by much more, about the height that was cut off. Slow or loud peaks are thus accepted, however many
    samples are near the top, and so is a single value that the converter holds for several samples.
    """
    run_starts, run_ends = _true_runs(is_near_top)
    values_per_run = (run_ends - run_starts) / samples_per_value
    for run_index in np.flatnonzero(values_per_run >= _MIN_CLIPPED_PEAK_VALUES):
        num_peak_values, run_start, run_end = values_per_run[run_index], run_starts[run_index], run_ends[run_index]
        num_values_beyond = max(1, int(num_peak_values) // 2)
        num_samples_beyond = int(num_values_beyond * samples_per_value)
        samples_beside_run = (
            distance_below_top[max(0, run_start - num_samples_beyond) : run_start],
            distance_below_top[run_end : run_end + num_samples_beyond],
        )
        smallest_fall = min(
            np.fmax.reduce(samples_on_side) if samples_on_side.size else np.inf
            for samples_on_side in samples_beside_run
        )
        if (
            smallest_fall
            > _MIN_CLIPPED_PEAK_FALL_RATIO
            * peak_height
            * ((num_peak_values - 1 + 2 * num_values_beyond) / (num_peak_values - 1)) ** 2
        ):
            return True
    return False


def _samples_per_value(samples: np.ndarray) -> float:
    """Number of samples for which the converter holds each value, estimated as the 5 % quantile of the lengths of
    constant runs."""
    run_lengths = np.diff(np.flatnonzero(samples[1:] != samples[:-1]))
    return float(np.partition(run_lengths, run_lengths.size // 20)[run_lengths.size // 20]) if run_lengths.size else 1.0
