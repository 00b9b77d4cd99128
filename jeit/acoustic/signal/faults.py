"""Detection of faulty microphones and faulty stretches of their sound, from the samples alone.

Four faults are distinguished: a channel that never changes (dead), one that stops changing (stuck), one that reaches
the end of its range (clipping), and samples that are not finite. Similar signals without a fault are accepted: a
converter that holds each value for several samples, a quiet channel of a few converter steps, one loud peak.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

# Codes that `sample_faults` returns for each sample, in the order in which reasons list them.
SOUND, NOT_FINITE, STUCK, CLIPPING = range(4)
_WORDS = {NOT_FINITE: "NaN or infinite", STUCK: "stuck", CLIPPING: "clipping"}

# Least duration of a stuck stretch: seconds, and number of samples.
_STUCK_TIME, _STUCK_SAMPLES = 0.02, 64
# A channel whose signal decays to within so many converter steps, or this fraction of its range, is silent, not stuck.
_REST_STEPS, _REST_RANGE = 3.0, 1e-4
# Samples within this fraction of the range count as extreme; the same as a fraction of the full scale, if known.
_TOP_RANGE, _TOP_FULL_SCALE = 3e-4, 1e-3
# A peak of three conversions or more is clipped if the sound beside it falls this many times as far as a parabola.
_FLAT, _SHARP = 3, 3.0


def sample_faults(
    samples: Float[np.ndarray, " S"], rate: float, full_scale: float | None = None
) -> tuple[UInt8[np.ndarray, " S"], str]:
    """Fault code of each sample of one channel, and the reason why the whole channel is dead ("" if it is not).

    The code is 0 for a good sample, else `NOT_FINITE`, `STUCK` or `CLIPPING`. `rate` is in Hz; `full_scale` is the
    largest |sample| possible, None when not known.
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
    stuck = _stuck(samples, rate, float(highest - lowest))
    # A channel that stays at one end of its range is stuck, not clipping.
    live = samples if stuck is None else np.where(stuck, np.nan, samples)
    clipping = _clipping(live, full_scale)
    if clipping is not None:
        kind[clipping] = CLIPPING
    if stuck is not None:
        kind[stuck] = STUCK
    return kind, ""


def window_faults(
    kind: UInt8[np.ndarray, "*batch S"], dead: str, length: int, hop: int
) -> tuple[Bool[np.ndarray, "*batch F"], str]:
    """Mask of the usable windows of one channel, and a description of the channel's fault ("" for none).

    `kind` and `dead` come from `sample_faults`; windows of `length` samples begin every `hop` samples along the last
    axis. A window with one bad sample is not usable.
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
            reasons.append(f"{word} in {_share(hit)} windows")
    return usable, "; ".join(reasons)


def intensity_faults(power: Float[np.ndarray, "F M"]) -> tuple[Bool[np.ndarray, "F M"], tuple[str, ...]]:
    """Usable values and faults of intensities given without samples: NaN, infinity, and channels of zeros only."""
    finite = np.isfinite(power)
    dead = ~(finite & (power != 0)).any(axis=0)
    reasons = []
    for channel, none in zip(finite.T, dead, strict=True):
        if none and channel.any():
            reasons.append(f"dead: every {'' if channel.all() else 'finite '}intensity is 0")
        elif none:
            reasons.append("dead: every intensity is NaN or infinite")
        else:
            reasons.append("" if channel.all() else f"NaN or infinite in {_share(~channel)} windows")
    return finite & ~dead, tuple(reasons)


def describe_faults(reasons: Sequence[str]) -> str:
    """One line of text from the fault of each microphone ("" for none): "microphones 0-2, 5: dead; microphone 3: …"."""
    groups: dict[str, list[int]] = {}
    for k, reason in enumerate(reasons):
        if reason:
            groups.setdefault(reason, []).append(k)
    return "; ".join(
        f"{'microphone' if len(which) == 1 else 'microphones'} {_ranges(np.array(which))}: {reason}"
        for reason, which in groups.items()
    )


def _ranges(numbers: np.ndarray) -> str:
    """Rising whole numbers as text: 0, 1, 2, 5 are "0-2, 5"."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts)


def _share(hit: np.ndarray) -> str:
    return f"all {hit.size}" if hit.all() else f"{int(hit.sum())} of {hit.size}"


def _runs(flags: Bool[np.ndarray, " S"]) -> Shaped[np.ndarray, "2 R"]:
    """Start and end indices of the stretches of True."""
    change = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return np.stack([change[::2], change[1::2]])


def _step(samples: np.ndarray) -> float:
    """The converter's step: the least difference of successive samples that is not zero."""
    change = np.abs(np.diff(samples))
    return float(np.fmin.reduce(np.where(change > 0, change, np.inf)))


def _stuck(samples: np.ndarray, rate: float, extent: float) -> Bool[np.ndarray, " S"] | None:
    """Samples in long stretches of one value, of a channel that never comes to rest elsewhere; None for none."""
    stretch = max(_STUCK_SAMPLES, round(_STUCK_TIME * rate))
    # A stretch this long covers at least two whole blocks: runs are searched for only where there is one.
    block = stretch // 4
    blocks = samples[: samples.size // block * block].reshape(-1, block)
    span = blocks.max(axis=1) - blocks.min(axis=1)
    if not (span == 0).any():
        return None
    # One flag for each pair of equal neighbours, so that a run of n pairs is n + 1 samples.
    start, stop = _runs(samples[1:] == samples[:-1])
    long = stop - start + 1 >= stretch
    if not long.any():
        return None
    stuck = np.zeros(samples.shape, bool)
    for first, last in zip(start[long], stop[long], strict=True):
        stuck[first : last + 1] = True
    # The silence of a converter or of a noiseless simulation is constant too. But sound fades into silence, so that
    # some blocks hardly change. A channel with its own noise has no such blocks.
    live = ~stuck[: blocks.size].reshape(blocks.shape).any(axis=1) & np.isfinite(span)
    rest = max(_REST_STEPS * _step(samples), _REST_RANGE * extent)
    return None if live.any() and span[live].min() <= rest else stuck


def _clipping(samples: np.ndarray, full_scale: float | None) -> Bool[np.ndarray, " S"] | None:
    """Samples at an end of the channel's range, if its tops are cut off there; None if they are not."""
    lowest, highest = np.fmin.reduce(samples), np.fmax.reduce(samples)
    found = None
    step = hold = 0.0
    for sign, top in ((1.0, highest), (-1.0, -lowest)):
        heights = [_TOP_RANGE * (highest - lowest)]
        if full_scale is not None and top >= (1 - _TOP_FULL_SCALE) * full_scale:
            heights.append(top - (1 - _TOP_FULL_SCALE) * full_scale)
        fall = top - sign * samples
        # Most channels return here: too few samples at the top for clipping, even with a coarse converter.
        if np.count_nonzero(fall <= max(heights)) < _FLAT:
            continue
        if not hold:
            step, hold = _step(samples), _hold(samples)
        for height in heights:
            near = fall <= height + step
            if _flat(fall, near, height + 2 * step, hold):
                found = near if found is None else found | near
    return found


def _flat(fall: np.ndarray, near: Bool[np.ndarray, " S"], height: float, hold: float) -> bool:
    """Whether any stretch of samples `near` the top is a clipped peak; `fall` (S,) is the distance of each below the
    top.

    A whole peak is a parabola: if n samples in a row stay within `height`, they span n - 1 intervals at least, and k
    samples further on it has fallen by `height` ((n - 1 + 2k) / (n - 1))² at most. A clipped peak falls by about the
    clipped height in the same time. So slow and loud peaks are accepted, however many samples they have at the top, and
    so is one value that the converter holds, which is one sample here.
    """
    start, stop = _runs(near)
    conversions = (stop - start) / hold
    for which in np.flatnonzero(conversions >= _FLAT):
        number, first, last = conversions[which], start[which], stop[which]
        beyond = max(1, int(number) // 2)
        reach = int(beyond * hold)
        sides = (fall[max(0, first - reach) : first], fall[last : last + reach])
        least = min(np.fmax.reduce(side) if side.size else np.inf for side in sides)
        if least > _SHARP * height * ((number - 1 + 2 * beyond) / (number - 1)) ** 2:
            return True
    return False


def _hold(samples: np.ndarray) -> float:
    """Number of samples for which the channel holds each conversion: the length of its short runs."""
    lengths = np.diff(np.flatnonzero(samples[1:] != samples[:-1]))
    return float(np.partition(lengths, lengths.size // 20)[lengths.size // 20]) if lengths.size else 1.0
