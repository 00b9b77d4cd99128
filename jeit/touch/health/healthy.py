"""The healthy state of a skin: directions of its touches, usual changes, and steadiness of its channels.

Single channels that are noisy, jump, or are stuck are detected from their changes from step to step. Two measures are
computed for every channel in a window: the mean of the smaller half of the magnitudes of these changes, which touches
hardly affect, and the mean of all of them, which responds to jumps. Both are compared with those of healthy windows, in
two consecutive windows, and with those of the other channels. If many channels exceed their limits at once, the cause
is a touch, not the channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.health.event import change_size, channel_medians, lasting_step, window_change

# Fraction of a window's changes, the smallest ones, that measure noise; minimum fraction of changes with a reading.
_SMALL, _READ = 0.5, 0.5
# Minimum limit, as a multiple of the usual value; limit as a multiple of the maximum among healthy windows; increase of
# the latter multiple, to be divided by the number of windows.
_LEAST, _BEYOND_UNSTEADY, _FEW_UNSTEADY = 3.0, 2.0, 12.0
# Minimum fraction of steps in which a healthy channel changes; otherwise, it never counts as stuck.
_MOVES = 0.6
# Maximum fraction of channels that may be unsteady at once.
_AT_ONCE = 0.1


@dataclass(frozen=True)
class Steadiness:
    """Usual variation of channels from step to step, and its limits.

    **Fields**: `usual` (2, M): usual values of the two measures, volts; `limits` (2,): limits of the measures, as
    multiples of the usual values; `still` (M,): whether a channel that does not change at all is stuck.
    """

    usual: Float[np.ndarray, "2 M"]
    limits: Float[np.ndarray, " 2"]
    still: Bool[np.ndarray, " M"]

    @classmethod
    def learn(cls, steps: Float[np.ndarray, "n M"], window: int, noise: Float[np.ndarray, " M"]) -> "Steadiness":
        """Learn from healthy steps (n, M) and the length of a window.

        `noise` (M,): noise of the channels, volts; infinite for channels without readings.
        """
        starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
        found = np.array([_variation_measures(steps[start : start + window]) for start in starts])  # (n, 2, M)
        half, ratios = len(found) // 2, [np.zeros((1, *found.shape[1:]))]
        for learnt, other in ((found[:half], found[half:]), (found[half:], found[:half])):
            if len(learnt) and len(other):
                ratios.append(_relative_to_others(np.nan_to_num(other / _usual_variation(learnt, noise))))
        most = np.concatenate(ratios).max(axis=(0, 2))
        limits = np.maximum(_LEAST, (_BEYOND_UNSTEADY + _FEW_UNSTEADY / max(len(found), 1)) * most)
        # With a coarse analogue-to-digital converter, a channel may read the same value throughout a window.
        moves = np.diff(steps, axis=0)
        still = np.isfinite(noise) & (np.sum(np.abs(moves) > 0, axis=0) > _MOVES * np.isfinite(moves).sum(axis=0))
        return cls(_usual_variation(found, noise), limits, still)

    def noisy_channels(
        self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]
    ) -> Bool[np.ndarray, " M"]:
        """Whether each channel (M,) is noisy, or jumps, in both of two windows, far more than nearly all other
        channels.

        `steps` (2w, M): changes from step to step in both windows, volts; `trusted` (M,): channels that may be used.
        """
        half, found = len(steps) // 2, []
        for part in (steps[:half], steps[half:]):
            over = np.where(trusted, np.nan_to_num(_variation_measures(part) / self.usual), 0.0)
            found.append((_relative_to_others(over) > self.limits[:, None]).any(axis=0))
        return self._unless_many_channels(found, trusted)

    def stuck_channels(
        self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]
    ) -> Bool[np.ndarray, " M"]:
        """Whether each channel (M,) is constant in both of two windows while other channels change; arguments as for
        `noisy_channels`."""
        half = len(steps) // 2
        return self._unless_many_channels(
            [(_variation_measures(part)[1] == 0) & self.still for part in (steps[:half], steps[half:])], trusted
        )

    @staticmethod
    def _unless_many_channels(exceeds_by_window: list[np.ndarray], trusted: np.ndarray) -> Bool[np.ndarray, " M"]:
        found = exceeds_by_window[0] & exceeds_by_window[1] & trusted
        # A channel that was steady in the first window is detected later; if too many channels are unsteady at once,
        # none is.
        at_once = max(1, _AT_ONCE * trusted.sum())
        return (
            found
            if 0 < found.sum() <= at_once and (exceeds_by_window[1] & trusted).sum() <= 2 * at_once
            else np.zeros_like(found)
        )


def _relative_to_others(ratios: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "... M"]:
    """Divide the `ratios` of the measures to their usual values by a high quantile of the ratios over the channels, if
    that is above 1: a change common to nearly all channels is then not attributed to single ones."""
    few = max(1, int(_AT_ONCE * ratios.shape[-1]))
    if few >= ratios.shape[-1]:
        return ratios
    return ratios / np.maximum(np.sort(ratios, axis=-1)[..., -(few + 1), None], 1.0)


def _variation_measures(window_steps: Float[np.ndarray, "w M"]) -> Float[np.ndarray, "2 M"]:
    """Compute, for each channel, the two measures (2, M) of variation in a window from its changes `window_steps` (w,
    M).

    They are the mean of the smaller half of the magnitudes of the changes, and the mean of all; NaN for channels with
    too few readings.
    """
    sizes = np.sort(np.abs(np.diff(window_steps, axis=0)), axis=0)  # NaN last
    there = np.isfinite(sizes).sum(axis=0)
    sizes, sums = np.nan_to_num(sizes), np.cumsum(np.nan_to_num(sizes), axis=0)
    small = np.maximum((_SMALL * there).astype(int), 1)
    channels = np.arange(sizes.shape[1])
    found = np.stack([sums[small - 1, channels] / small, sums[-1] / np.maximum(there, 1)])
    return np.where(there >= max(2, _READ * len(sizes)), found, np.nan)


def _usual_variation(measures: Float[np.ndarray, "n 2 M"], noise: Float[np.ndarray, " M"]) -> Float[np.ndarray, "2 M"]:
    """Mean (2, M) of the `measures` (n, 2, M) over n healthy windows, but at least a tenth of the `noise` (M,): a
    coarse analogue-to-digital converter hides noise."""
    usual = np.nan_to_num(measures).mean(axis=0)
    return np.where(np.isfinite(noise), np.maximum(usual, 0.1 * np.where(np.isfinite(noise), noise, 1.0)), np.inf)


# Maximum number of steps of a window (with more frames, several are averaged to a step); minimum number; minimum number
# of windows of a healthy recording.
_MOST, _FEWEST, _WINDOWS = 48, 5, 8
# Minimum and maximum length of windows, in frames, for a healthy recording without a quiet interval.
_LEAST_ALWAYS, _MOST_ALWAYS = 12, 64
# If no time is given: length of a window as a multiple of the longest touch; its minimum as a fraction of the
# recording.
_LONGEST, _LEAST_SHARE = 3.0, 1 / 40
# Limit of a change: multiple of the maximum among healthy windows; minimum, in standard deviations of healthy changes;
# increase of the multiple, to be divided by the number of windows.
_BEYOND, _LEAST_SIZE, _FEW = 2.0, 4.0, 20.0
# Factor by which windows may be shorter than touches require; if they are even shorter, touches appear to last, and
# limits are multiplied by the second factor.
_SHORT, _DOUBT = 1.5, 2.0
# Minimum fraction of a step that is left a window later if the step lasts.
_STILL = 0.4
# Limit of a change of level from the healthy recording to another one, as a multiple of the maximum among its windows.
_BEYOND_LEVEL = 3.0
# Minimum ratio of the change in a touched frame to that in quiet frames; quantile of the changes of all frames that is
# used as the change in quiet frames.
_STANDS_OUT, _QUIET = 3.0, 0.3
# Maximum number of directions of touches; fraction of the touches' energy that the directions explain.
_DIRECTIONS, _EXPLAINED = 40, 0.98
# Quantile, among healthy touches, of the energy outside of these directions, above which a change is unlike touches;
# minimum energy of these touches, relative to that of a strong touch.
_UNLIKE, _STRONG = 0.99, 0.2
_LEAST_FRAMES = 20
# Fraction of the changes from frame to frame, the smallest ones, that touches do not affect; mean magnitude of the same
# fraction of a standard normal variable.
_QUIETER, _OF_NORMAL = 0.8, 0.5586
# Ratio of the standard deviation of a normal variable to its mean magnitude.
_MEAN = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True)
class HealthyState:
    """Healthy state of a skin with M channels, and its variation.

    **Fields**: `reference` (M,): voltages of the untouched skin, volts; `used` (M,): whether channels have readings;
    `noise` (M,): noise from frame to frame, volts; `span` (2, M): minimum and maximum change in the recording, volts;
    `stride`: number of frames averaged to a step; `window`: number of steps of a window; `scale` (M,): change between
    consecutive windows, volts; `limit`: limit of `change_size` for a step that lasts; `sudden`: its limit for a step
    that may be a touch; `level` (M,): change between any two windows, volts; `level_limit`: limit of `change_size` for
    a change of level; `touches` (M, k): directions of touches, orthonormal in units of noise; `unlike`: fraction of a
    change's energy outside of these directions that touches do not exceed; `steadiness`: steadiness of single channels;
    `period`: seconds between frames, or 1; `brief`: whether the recording was too short for its touches, so that limits
    are twice as high.
    """

    reference: Float[np.ndarray, " M"]
    used: Bool[np.ndarray, " M"]
    noise: Float[np.ndarray, " M"]
    span: Float[np.ndarray, "2 M"]
    stride: int
    window: int
    scale: Float[np.ndarray, " M"]
    limit: float
    sudden: float
    level: Float[np.ndarray, " M"]
    level_limit: float
    touches: Float[np.ndarray, "M k"]
    unlike: float
    steadiness: Steadiness
    period: float
    brief: bool

    @classmethod
    def learn(
        cls, frames: Float[np.ndarray, "F M"], period: float = 1.0, longest: float | None = None
    ) -> "HealthyState":
        """Learn from healthy frames (F, M), with or without touches, `period` seconds apart.

        `longest`: length of a window, seconds, which must exceed that of every touch; by default estimated from the
        touches in the frames. Raises `ValueError` for fewer than 20 frames, and if all channels lack readings or are
        constant.
        """
        if len(frames) < _LEAST_FRAMES:
            raise ValueError(
                f"healthy: {len(frames)} frames are too few to know what is healthy; give {_LEAST_FRAMES} or more, a "
                "minute of them with touches at best."
            )
        frames = np.where(np.isfinite(frames), frames, np.nan)
        used = np.isfinite(frames).mean(axis=0) > 0.5
        centre = channel_medians(frames)
        noise = _estimate_noise(frames)
        used &= noise > 1e-12 * np.nanmax(np.abs(centre), initial=0.0)
        used &= noise > 0
        if not used.any():
            raise ValueError("healthy: every channel lacks readings or is constant; is this a recording of the skin?")
        noise = np.where(used, noise, np.inf)
        frames = np.where(used, frames, np.nan)
        window, wanted = _window_length(frames, noise, period, longest)
        brief = wanted > _SHORT * window
        doubt = _DOUBT if brief else 1.0
        stride = max(1, -(-window // _MOST))
        steps = average_frames(frames, stride)
        window = max(_FEWEST, window // stride)
        scale, limit, sudden = _step_limits(
            _window_triples(steps, window), window, _median_noise(noise, stride * window)
        )
        level, level_limit = _level_limit(_window_levels(steps, window), scale)
        touches, unlike = _touch_directions(frames, noise, stride * window)
        local = frames - centre
        span = np.stack([np.nanmin(local, axis=0, initial=0.0), np.nanmax(local, axis=0, initial=0.0)])
        fixed = np.where(used, np.nan_to_num(centre), 0.0)
        steadiness = Steadiness.learn(steps, window, noise)
        return cls(
            reference=fixed,
            used=used,
            noise=noise,
            span=span,
            stride=stride,
            window=window,
            scale=scale,
            limit=doubt * limit,
            sudden=doubt * sudden,
            level=level,
            level_limit=doubt * level_limit,
            touches=touches,
            unlike=unlike,
            steadiness=steadiness,
            period=period,
            brief=brief,
        )

    def fraction_outside(self, change: Float[np.ndarray, " M"]) -> float:
        """Fraction of a change's energy, in units of noise, that is outside of the directions of touches."""
        return float(_fraction_outside((np.nan_to_num(change) / self.noise)[None], self.touches)[0])


def average_frames(frames: Float[np.ndarray, "F M"], stride: int) -> Float[np.ndarray, "n M"]:
    """Average every `stride` frames, for each channel over its readings."""
    if stride == 1:
        return frames
    groups = frames[: len(frames) // stride * stride].reshape(-1, stride, frames.shape[1])
    there = np.isfinite(groups)
    number = there.sum(axis=1)
    return np.where(number > 0, np.where(there, groups, 0.0).sum(axis=1) / np.maximum(number, 1), np.nan)


def _estimate_noise(frames: np.ndarray) -> np.ndarray:
    """Noise of every channel from frame to frame: its standard deviation, estimated from the smaller changes."""
    steps = np.diff(frames, axis=0)
    some = np.isfinite(steps).any(axis=0)
    quiet, most, whole = np.zeros((3, frames.shape[1]))
    sizes = np.sort(np.abs(steps[:, some]), axis=0)  # NaN last
    there = np.isfinite(sizes).sum(axis=0)
    quiet[some] = 1.4826 * np.nanmedian(sizes, axis=0) / np.sqrt(2)
    whole[some] = np.nanstd(steps[:, some], axis=0) / np.sqrt(2)
    # With a coarse converter, the median change is zero or one step of the converter; the mean is more informative.
    small = np.maximum((_QUIETER * there).astype(int), 1)
    most[some] = (
        np.cumsum(np.nan_to_num(sizes), axis=0)[small - 1, np.arange(len(small))] / small / _OF_NORMAL / np.sqrt(2)
    )
    quiet = np.where((quiet > 0.05 * whole) & (quiet < 2 * most), quiet, most)
    return np.where(quiet > 0.05 * whole, quiet, whole)


def _window_length(frames: np.ndarray, noise: np.ndarray, period: float, longest: float | None) -> tuple[int, float]:
    """Number of frames of a window, and the number that a sufficiently long recording would allow."""
    most = max(_FEWEST, len(frames) // _WINDOWS)
    if longest is not None:
        return int(np.clip(np.ceil(longest / period), _FEWEST, most)), longest / period
    off = change_size((frames - channel_medians(frames)) / noise)
    quiet = np.quantile(off, _QUIET)
    touched = off > _STANDS_OUT * quiet
    edges = np.flatnonzero(np.diff(np.concatenate([[0], touched.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    least = min(max(_LEAST_ALWAYS, int(_LEAST_SHARE * len(frames))), most)
    wanted = _LONGEST * float(runs.max(initial=0))
    if runs.size and runs.max() > most:
        return int(np.clip(most // 2, least, max(least, _MOST_ALWAYS))), wanted
    return int(np.clip(wanted, least, most)), wanted


def _median_noise(noise: np.ndarray, num_frames: int) -> np.ndarray:
    """Minimum difference between the medians of two windows of `num_frames` frames that contain only noise."""
    return noise * np.sqrt(np.pi / max(num_frames, 2))


def _window_triples(steps: np.ndarray, window: int) -> np.ndarray:
    """Triples (n, 3w, M) of consecutive windows of `window` = w steps each, throughout a recording."""
    starts = range(0, max(1, len(steps) - 3 * window + 1), max(1, window // 4))
    return np.array([steps[start : start + 3 * window] for start in starts])


def _window_levels(steps: np.ndarray, window: int) -> np.ndarray:
    """Differences (n, M) of the medians of windows from the median of all steps."""
    starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
    return np.array([channel_medians(steps[start : start + window]) for start in starts]) - channel_medians(steps)


def _step_limits(triples: np.ndarray, window: int, floor: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Estimate the scale (M,) of changes between windows, and the limits of steps relative to that scale.

    The first limit is for steps that are still present a window later; the second is for all steps, including touches.
    The steps of each half of the recording are scaled by the other half, which is independent of them.
    """
    pairs = triples[:, : 2 * window]
    changes = np.nan_to_num(np.array([window_change(one) for one in pairs]))
    half, stayed, sizes = len(changes) // 2, [0.0], [0.0]
    rest = channel_medians(np.concatenate(list(triples[:: max(1, len(triples) // _WINDOWS)])))
    for learnt, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
        scale = _deviation_of_changes(changes[learnt], floor)
        for triple, pair in zip(triples[other], pairs[other], strict=True):
            step = lasting_step(pair, scale, 0.0)
            if step is None:
                continue
            sizes.append(step.size)
            direction = np.nan_to_num(step.change / scale**2)
            now = channel_medians(triple[2 * window :])
            if change_size((now - rest) / scale) < _STILL * step.size:  # the end of a touch
                continue
            later = np.nan_to_num(now - channel_medians(pair[:window]))
            if later @ direction > _STILL * (np.nan_to_num(step.change) @ direction):
                stayed.append(step.size)
        stayed.append(float(np.median(change_size(changes[other] / scale))) if len(changes[other]) else 0.0)
    beyond = _BEYOND + _FEW / max(len(changes), 1)
    lasting = max(_LEAST_SIZE, beyond * max(stayed))
    return _deviation_of_changes(changes, floor), lasting, max(lasting, beyond * max(sizes))


def _level_limit(changes: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, float]:
    """Estimate the scale (M,) and the limit of the windows' differences from the median; each half is scaled by the
    other."""
    changes = np.nan_to_num(changes)
    half = len(changes) // 2
    sizes = [
        change_size(changes[half:] / _deviation_of_changes(changes[:half], floor)),
        change_size(changes[:half] / _deviation_of_changes(changes[half:], floor)),
    ]
    most = float(np.concatenate(sizes).max(initial=0.0))
    return _deviation_of_changes(changes, floor), max(_LEAST_SIZE, (_BEYOND_LEVEL + _FEW / max(len(changes), 1)) * most)


def _deviation_of_changes(changes: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Standard deviation of changes (n, M), estimated from their mean magnitude as for a normal variable."""
    own = _MEAN * np.mean(np.abs(changes), axis=0) if len(changes) else np.zeros(changes.shape[1])
    # A channel that hardly changed while others did may have done so by chance.
    typical = np.median(own[np.isfinite(floor)] / floor[np.isfinite(floor)])
    return np.maximum(own, np.maximum(1.0, 0.5 * typical) * floor)


def _touch_directions(frames: np.ndarray, noise: np.ndarray, window: int) -> tuple[np.ndarray, float]:
    """Directions (M, k) of healthy changes, in units of noise, and 99 % quantile of the fraction of energy outside of
    them."""
    there = np.where(np.isfinite(frames), frames, channel_medians(frames))
    centres = np.concatenate(
        [
            np.tile(channel_medians(part), (len(part), 1))
            for part in np.array_split(there, max(1, len(there) // (2 * window)))
        ]
    )
    scaled = np.nan_to_num((there - centres) / noise)
    energy = np.sum(scaled**2, axis=1)
    strong = scaled[energy > max(4 * np.median(energy), _STRONG * np.quantile(energy, 0.95))]
    strong = strong if len(strong) >= _FEWEST else scaled
    strong = strong[:: max(1, len(strong) // 2000)]
    half, shares = len(strong) // 2, []
    for learnt, other in ((strong[:half], strong[half:]), (strong[half:], strong[:half])):
        if len(learnt) and len(other):
            shares.append(_fraction_outside(other, _principal_directions(learnt)))
    unlike = float(np.quantile(np.concatenate(shares), _UNLIKE)) if shares else 1.0
    return _principal_directions(strong), unlike


def _principal_directions(frames: np.ndarray) -> np.ndarray:
    """Principal directions (M, k) of frames."""
    _, values, rows = np.linalg.svd(frames, full_matrices=False)
    explained = np.cumsum(values**2) / max(np.sum(values**2), 1e-300)
    number = min(int(np.searchsorted(explained, _EXPLAINED)) + 1, _DIRECTIONS, max(1, len(frames) // 4))
    return rows[: min(number, max(1, frames.shape[1] // 2))].T


def _fraction_outside(scaled: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Fraction of the energy of changes (n, M) that is outside of the directions."""
    energy = np.sum(scaled**2, axis=1)
    left = energy - np.sum((scaled @ directions) ** 2, axis=1)
    return np.clip(left / np.maximum(energy, 1e-300), 0.0, 1.0)
