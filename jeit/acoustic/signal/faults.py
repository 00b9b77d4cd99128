"""Detection of faulty microphones and faulty stretches of sound, from the samples alone.

Four faults are distinguished: the samples of a channel never change (dead), do not change for a while (stuck), are cut
off at an end of the channel's range (clipping), or are not finite. Similar signals without a fault are accepted: a
converter that holds each value for several samples, a quiet channel with an amplitude of a few converter steps, and a
single loud peak.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

# Fault codes of samples, as returned by `sample_faults`. Descriptions list the faults in this order.
SOUND, NOT_FINITE, STUCK, CLIPPING = range(4)
_WORDS = {NOT_FINITE: "NaN or infinite", STUCK: "stuck", CLIPPING: "clipping"}

# Minimum duration of a stuck stretch: in seconds, and in samples.
_STUCK_TIME, _STUCK_SAMPLES = 0.02, 64
# A constant stretch is silence, not a fault, if the signal elsewhere decays to a range of at most this many converter
# steps, or at most this fraction of the channel's range.
_REST_STEPS, _REST_RANGE = 3.0, 1e-4
# Samples are at an end of the range if they are closer to it than this fraction of the channel's range, or, where the
# full scale is known, closer to it than this fraction of the full scale.
_TOP_RANGE, _TOP_FULL_SCALE = 3e-4, 1e-3
# Minimum number of converted values at the top of a clipped peak, and minimum ratio of the fall beside it to the fall
# of a parabola.
_FLAT, _SHARP = 3, 3.0


def sample_faults(
    samples: Float[np.ndarray, " S"], rate: float, full_scale: float | None = None
) -> tuple[UInt8[np.ndarray, " S"], str]:
    """Return the fault code of each sample of one channel, and the reason why the channel is dead ("" if it is not).

    The code is 0 (`SOUND`) for a good sample, otherwise `NOT_FINITE`, `STUCK` or `CLIPPING`. `rate`: sampling rate in
    Hz. `full_scale`: largest possible magnitude of a sample, or None if unknown.
    """
    kind = np.zeros(samples.shape, np.uint8)
    finite = np.isfinite(samples)
    whole = bool(finite.all())
    if not whole:
        kind[~finite] = NOT_FINITE
        if not finite.any():
            return kind, "dead: every sample is NaN or infinite"
        samples = np.where(finite, samples, np.nan)
    lowest, highest = np.fmin.reduce(samples), np.fmax.reduce(samples)
    if lowest == highest:
        return kind, f"dead: every {'' if whole else 'finite '}sample is {lowest:g}"
    stuck = _stuck_samples(samples, rate, float(highest - lowest))
    # A channel that stays at one end of its range is stuck, not clipping.
    live = samples if stuck is None else np.where(stuck, np.nan, samples)
    clipping = _clipped_samples(live, full_scale)
    if clipping is not None:
        kind[clipping] = CLIPPING
    if stuck is not None:
        kind[stuck] = STUCK
    return kind, ""


def window_faults(
    kind: UInt8[np.ndarray, "*batch S"], dead: str, length: int, hop: int
) -> tuple[Bool[np.ndarray, "*batch F"], str]:
    """Return the mask of the usable windows of one channel, and a description of the channel's faults ("" for none).

    `kind`, `dead`: as returned by `sample_faults`. Windows of `length` samples begin every `hop` samples along the last
    axis. A window with at least one faulty sample is not usable.
    """
    number = 1 + (kind.shape[-1] - length) // hop
    usable = np.ones((*kind.shape[:-1], number), bool)
    if dead:
        return np.zeros_like(usable), dead
    if not kind.any():
        return usable, ""
    start = hop * np.arange(number)
    reasons = []
    for which, word in _WORDS.items():
        total = np.cumsum(kind == which, axis=-1)
        total = np.concatenate([np.zeros((*kind.shape[:-1], 1), int), total], axis=-1)
        hit = total[..., start + length] > total[..., start]
        if hit.any():
            usable &= ~hit
            reasons.append(f"{word} in {_format_share(hit)} windows")
    return usable, "; ".join(reasons)


def intensity_faults(power: Float[np.ndarray, "F M"]) -> tuple[Bool[np.ndarray, "F M"], tuple[str, ...]]:
    """Return the mask of the usable intensities and a description of each channel's fault, for intensities given
    without samples. Faults are NaN, infinity, and channels that contain only zeros."""
    finite = np.isfinite(power)
    dead = ~(finite & (power != 0)).any(axis=0)
    reasons = []
    for channel, none in zip(finite.T, dead, strict=True):
        if none and channel.any():
            reasons.append(f"dead: every {'' if channel.all() else 'finite '}intensity is 0")
        elif none:
            reasons.append("dead: every intensity is NaN or infinite")
        else:
            reasons.append("" if channel.all() else f"NaN or infinite in {_format_share(~channel)} windows")
    return finite & ~dead, tuple(reasons)


def describe_faults(reasons: Sequence[str]) -> str:
    """Summarise the fault of each microphone ("" for none) in a line such as "microphones 0-2, 5: dead; microphone 3:
    …"."""
    groups: dict[str, list[int]] = {}
    for k, reason in enumerate(reasons):
        if reason:
            groups.setdefault(reason, []).append(k)
    return "; ".join(
        f"{'microphone' if len(which) == 1 else 'microphones'} {_ranges(np.array(which))}: {reason}"
        for reason, which in groups.items()
    )


def _ranges(numbers: np.ndarray) -> str:
    """Format increasing integers as ranges: 0, 1, 2, 5 as "0-2, 5"."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts)


def _format_share(hit: np.ndarray) -> str:
    return f"all {hit.size}" if hit.all() else f"{int(hit.sum())} of {hit.size}"


def _true_runs(flags: Bool[np.ndarray, " S"]) -> Shaped[np.ndarray, "2 R"]:
    """Start and end indices of the runs of True; the end is exclusive."""
    change = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return np.stack([change[::2], change[1::2]])


def _converter_step(samples: np.ndarray) -> float:
    """Step of the analogue-to-digital converter: the smallest nonzero difference between successive samples."""
    change = np.abs(np.diff(samples))
    return float(np.fmin.reduce(np.where(change > 0, change, np.inf)))


def _stuck_samples(samples: np.ndarray, rate: float, extent: float) -> Bool[np.ndarray, " S"] | None:
    """Mask of the samples in long constant stretches, unless the signal also comes to rest elsewhere; None if no sample
    is stuck. `extent`: range of the samples."""
    stretch = max(_STUCK_SAMPLES, round(_STUCK_TIME * rate))
    # A stuck stretch covers at least two whole blocks. Runs are searched for only if a block is constant, which saves
    # time.
    block = stretch // 4
    blocks = samples[: samples.size // block * block].reshape(-1, block)
    span = blocks.max(axis=1) - blocks.min(axis=1)
    if not (span == 0).any():
        return None
    # Each flag stands for a pair of equal neighbours, so a run of n flags is a stretch of n + 1 samples.
    start, stop = _true_runs(samples[1:] == samples[:-1])
    long = stop - start + 1 >= stretch
    if not long.any():
        return None
    stuck = np.zeros(samples.shape, bool)
    for first, last in zip(start[long], stop[long], strict=True):
        stuck[first : last + 1] = True
    # Silence can be constant too: with a coarse converter, or in a simulation without noise. The sound then fades into
    # silence, so that some other blocks are almost constant. In a stuck channel with noise no other block is.
    live = ~stuck[: blocks.size].reshape(blocks.shape).any(axis=1) & np.isfinite(span)
    rest = max(_REST_STEPS * _converter_step(samples), _REST_RANGE * extent)
    return None if live.any() and span[live].min() <= rest else stuck


def _clipped_samples(samples: np.ndarray, full_scale: float | None) -> Bool[np.ndarray, " S"] | None:
    """Mask of the samples at an end of the channel's range, if its peaks are cut off there; None if they are not."""
    lowest, highest = np.fmin.reduce(samples), np.fmax.reduce(samples)
    found = None
    step = hold = 0.0
    for sign, top in ((1.0, highest), (-1.0, -lowest)):
        heights = [_TOP_RANGE * (highest - lowest)]
        if full_scale is not None and top >= (1 - _TOP_FULL_SCALE) * full_scale:
            heights.append(top - (1 - _TOP_FULL_SCALE) * full_scale)
        fall = top - sign * samples
        # Most channels need no further test: they have too few samples near the end of the range to be clipped.
        if np.count_nonzero(fall <= max(heights)) < _FLAT:
            continue
        if not hold:
            step, hold = _converter_step(samples), _samples_per_value(samples)
        for height in heights:
            near = fall <= height + step
            if _has_clipped_peak(fall, near, height + 2 * step, hold):
                found = near if found is None else found | near
    return found


def _has_clipped_peak(
    distance_below_top: np.ndarray, near: Bool[np.ndarray, " S"], height: float, samples_per_value: float
) -> bool:
    """Whether any run of samples `near` the top is a clipped peak.

    `distance_below_top` (S,): distance of each sample below the top. `samples_per_value`: number of samples per
    converted value. An unclipped peak is nearly a parabola: if n successive converted values stay within `height` of
    the top, then k values later it has fallen by at most `height` · ((n - 1 + 2k) / (n - 1))². A clipped peak falls by
    much more, about the height that was cut off. Slow or loud peaks are thus accepted, however many samples they have
    near the top, and so is a single value that the converter holds for several samples.
    """
    start, stop = _true_runs(near)
    conversions = (stop - start) / samples_per_value
    for which in np.flatnonzero(conversions >= _FLAT):
        number, first, last = conversions[which], start[which], stop[which]
        beyond = max(1, int(number) // 2)
        reach = int(beyond * samples_per_value)
        sides = (distance_below_top[max(0, first - reach) : first], distance_below_top[last : last + reach])
        least = min(np.fmax.reduce(side) if side.size else np.inf for side in sides)
        if least > _SHARP * height * ((number - 1 + 2 * beyond) / (number - 1)) ** 2:
            return True
    return False


def _samples_per_value(samples: np.ndarray) -> float:
    """Number of samples for which the converter holds each value, estimated as the 5 % quantile of the lengths of
    constant runs."""
    lengths = np.diff(np.flatnonzero(samples[1:] != samples[:-1]))
    return float(np.partition(lengths, lengths.size // 20)[lengths.size // 20]) if lengths.size else 1.0
