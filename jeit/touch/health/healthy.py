"""The healthy skin: directions of its touches, usual changes, and channels that are unsteady.

Detect single channels that are noisy, jump, or are stuck, from their changes from step to step.

Two measures of every channel in a window: the mean of the smaller half of its steps' magnitudes, which touches hardly
affect, and the mean of all, which responds to jumps. Each is compared with that of healthy windows, in two consecutive
windows, and with the other channels now: where many do it at once, it is a touch, not they.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.health.event import lasting_step, median, size_of, window_change

# The share of a window's steps, the smallest, that measure noise; the least share that has a reading.
_SMALL, _READ = 0.5, 0.5
# The least limit, as a multiple of the usual; the multiple of the greatest among healthy windows; and how much this
# grows where windows are few.
_LEAST, _BEYOND_UNSTEADY, _FEW_UNSTEADY = 3.0, 2.0, 12.0
# The least share of steps in which a healthy channel changes, for a channel without changes to count as stuck.
_MOVES = 0.6
# The greatest share of channels that may be unsteady at once.
_AT_ONCE = 0.1


@dataclass(frozen=True)
class Steadiness:
    """The usual step-to-step variation of channels, and its limits.

    **Fields**: `usual` (2, M), of the two measures, volts; `limits` (2,), as multiples of the usual; `still` (M,),
    whether a channel that does not change at all is stuck.
    """

    usual: Float[np.ndarray, "2 M"]
    limits: Float[np.ndarray, " 2"]
    still: Bool[np.ndarray, " M"]

    @classmethod
    def learn(cls, steps: Float[np.ndarray, "n M"], window: int, noise: Float[np.ndarray, " M"]) -> "Steadiness":
        """Learn from healthy steps and the length of a window; `noise` (M,), volts, infinite where nothing is read."""
        starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
        found = np.array([_measures(steps[start : start + window]) for start in starts])  # (n, 2, M)
        half, ratios = len(found) // 2, [np.zeros((1, *found.shape[1:]))]
        for learnt, other in ((found[:half], found[half:]), (found[half:], found[:half])):
            if len(learnt) and len(other):
                ratios.append(_above_others(np.nan_to_num(other / _usual(learnt, noise))))
        most = np.concatenate(ratios).max(axis=(0, 2))
        limits = np.maximum(_LEAST, (_BEYOND_UNSTEADY + _FEW_UNSTEADY / max(len(found), 1)) * most)
        # A coarse converter may read the same throughout a window.
        moves = np.diff(steps, axis=0)
        still = np.isfinite(noise) & (np.sum(np.abs(moves) > 0, axis=0) > _MOVES * np.isfinite(moves).sum(axis=0))
        return cls(_usual(found, noise), limits, still)

    def noisy(self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
        """Which channels (M,) are noisy, or jump, in both of two windows, far more than any other."""
        half, found = len(steps) // 2, []
        for part in (steps[:half], steps[half:]):
            over = np.where(trusted, np.nan_to_num(_measures(part) / self.usual), 0.0)
            found.append((_above_others(over) > self.limits[:, None]).any(axis=0))
        return self._few(found, trusted)

    def stuck(self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
        """Which channels (M,) do not change at all in both of two windows, while others do."""
        half = len(steps) // 2
        return self._few([(_measures(part)[1] == 0) & self.still for part in (steps[:half], steps[half:])], trusted)

    @staticmethod
    def _few(each: list[np.ndarray], trusted: np.ndarray) -> Bool[np.ndarray, " M"]:
        found = each[0] & each[1] & trusted
        # A channel that has just begun is detected in the next window; but if too many do so at once, none is.
        at_once = max(1, _AT_ONCE * trusted.sum())
        return (
            found if 0 < found.sum() <= at_once and (each[1] & trusted).sum() <= 2 * at_once else np.zeros_like(found)
        )


def _above_others(over: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "... M"]:
    """Ratios to the usual, divided by the highest ratio of the other channels, except a few, where that is above 1."""
    few = max(1, int(_AT_ONCE * over.shape[-1]))
    if few >= over.shape[-1]:
        return over
    return over / np.maximum(np.sort(over, axis=-1)[..., -(few + 1), None], 1.0)


def _measures(steps: Float[np.ndarray, "w M"]) -> Float[np.ndarray, "2 M"]:
    """The two measures of a window; NaN where there are too few readings."""
    sizes = np.sort(np.abs(np.diff(steps, axis=0)), axis=0)  # NaN last
    there = np.isfinite(sizes).sum(axis=0)
    sizes, sums = np.nan_to_num(sizes), np.cumsum(np.nan_to_num(sizes), axis=0)
    small = np.maximum((_SMALL * there).astype(int), 1)
    channels = np.arange(sizes.shape[1])
    found = np.stack([sums[small - 1, channels] / small, sums[-1] / np.maximum(there, 1)])
    return np.where(there >= max(2, _READ * len(sizes)), found, np.nan)


def _usual(found: Float[np.ndarray, "n 2 M"], noise: Float[np.ndarray, " M"]) -> Float[np.ndarray, "2 M"]:
    """Mean of the measures over healthy windows, and at least a tenth of the noise, which a coarse converter hides."""
    usual = np.nan_to_num(found).mean(axis=0)
    return np.where(np.isfinite(noise), np.maximum(usual, 0.1 * np.where(np.isfinite(noise), noise, 1.0)), np.inf)


# The greatest number of steps of a window (with more frames, several are averaged to a step), and the least; and the
# number of windows that a healthy recording has at least.
_MOST, _FEWEST, _WINDOWS = 48, 5, 8
# Least and greatest length of windows, in frames, of a healthy recording without a quiet interval.
_LEAST_ALWAYS, _MOST_ALWAYS = 12, 64
# Length of a window, as a multiple of the longest touch, where no time is given; and its least share of the frames.
_LONGEST, _LEAST_SHARE = 3.0, 1 / 40
# Limit of a change, as a multiple of the greatest among healthy windows; its least value, in deviations of healthy
# ones; and how much the multiple grows where windows are few.
_BEYOND, _LEAST_SIZE, _FEW = 2.0, 4.0, 20.0
# If windows are shorter by this factor than touches require, touches appear to last: limits are raised by the second
# factor.
_SHORT, _DOUBT = 1.5, 2.0
# The share of a step that has to be left for it to count as lasting.
_STILL = 0.4
# The multiple for a change of level, from the healthy recording to another.
_BEYOND_LEVEL = 3.0
# A touch exceeds the variation of quiet frames by this factor; the share of frames that are taken as quiet.
_STANDS_OUT, _QUIET = 3.0, 0.3
# The greatest number of directions of touches, and the share of their energy that the directions explain.
_DIRECTIONS, _EXPLAINED = 40, 0.98
# Quantile of healthy touches that defines what is unlike them; the least energy of the touches counted, as a share of
# that of a strong one.
_UNLIKE, _STRONG = 0.99, 0.2
_LEAST_FRAMES = 20
# The share of steps from frame to frame, the smallest, that touches do not affect; the mean magnitude of the same share
# of a normal variable.
_QUIETER, _OF_NORMAL = 0.8, 0.5586
# Standard deviation of a normal variable over its mean magnitude.
_MEAN = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True)
class Healthy:
    """The healthy state of a skin with M channels, and its variation.

    **Fields**: `reference` (M,), untouched, volts; `used` (M,): channels that have readings; `noise` (M,), volts, from
    frame to frame; `span` (2, M): least and greatest change in the recording; `stride`: frames averaged to a step;
    `window`: steps of a window; `scale` (M,), volts: the change between consecutive windows; `limit`: of `size_of` for
    a step that stays, and `sudden`: for one that may be a touch; `level` (M,), volts: the change between any two
    windows, and its `level_limit`; `touches` (M, k): directions of touches, orthonormal in units of noise; `unlike`:
    the share of a change outside of these directions that no touch exceeds; `steadiness` of single channels; `period`,
    seconds a frame, or 1; `brief`: whether the recording was too short for its touches, so that limits are twice as
    high.
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
    def learn(cls, frames: Float[np.ndarray, "F M"], period: float = 1.0, longest: float | None = None) -> "Healthy":
        """Learn from healthy frames (F, M), with or without touches, `period` seconds apart.

        `longest`: the length of windows in seconds, which every touch is shorter than; estimated from the touches in
        the frames unless given. Raises `ValueError` for fewer than 20 frames, and where no channel reads anything.
        """
        if len(frames) < _LEAST_FRAMES:
            raise ValueError(
                f"healthy: {len(frames)} frames are too few to know what is healthy; give {_LEAST_FRAMES} or more, a "
                "minute of them with touches at best."
            )
        frames = np.where(np.isfinite(frames), frames, np.nan)
        used = np.isfinite(frames).mean(axis=0) > 0.5
        centre = median(frames)
        noise = _noise(frames)
        used &= noise > 1e-12 * np.nanmax(np.abs(centre), initial=0.0)
        used &= noise > 0
        if not used.any():
            raise ValueError(
                "healthy: no channel reads anything, or all are constant; is this a recording of the skin?"
            )
        noise = np.where(used, noise, np.inf)
        frames = np.where(used, frames, np.nan)
        window, wanted = _window(frames, noise, period, longest)
        brief = wanted > _SHORT * window
        doubt = _DOUBT if brief else 1.0
        stride = max(1, -(-window // _MOST))
        steps = averaged(frames, stride)
        window = max(_FEWEST, window // stride)
        scale, limit, sudden = _step_limits(_triples(steps, window), window, _floor(noise, stride * window))
        level, level_limit = _level_limit(_levels(steps, window), scale)
        touches, unlike = _touches(frames, noise, stride * window)
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

    def outside(self, change: Float[np.ndarray, " M"]) -> float:
        """Share of a change's energy, in units of noise, that is outside of the directions of touches."""
        return float(_outside((np.nan_to_num(change) / self.noise)[None], self.touches)[0])


def averaged(frames: Float[np.ndarray, "F M"], stride: int) -> Float[np.ndarray, "n M"]:
    """Means of every `stride` frames, over the channels that have readings."""
    if stride == 1:
        return frames
    groups = frames[: len(frames) // stride * stride].reshape(-1, stride, frames.shape[1])
    there = np.isfinite(groups)
    number = there.sum(axis=1)
    return np.where(number > 0, np.where(there, groups, 0.0).sum(axis=1) / np.maximum(number, 1), np.nan)


def _noise(frames: np.ndarray) -> np.ndarray:
    """Noise of every channel from frame to frame: the standard deviation estimated from the smaller steps."""
    steps = np.diff(frames, axis=0)
    some = np.isfinite(steps).any(axis=0)
    quiet, most, whole = np.zeros((3, frames.shape[1]))
    sizes = np.sort(np.abs(steps[:, some]), axis=0)  # NaN last
    there = np.isfinite(sizes).sum(axis=0)
    quiet[some] = 1.4826 * np.nanmedian(sizes, axis=0) / np.sqrt(2)
    whole[some] = np.nanstd(steps[:, some], axis=0) / np.sqrt(2)
    # Coarse steps of a converter have a median of zero, or of one of them; the mean is more informative.
    small = np.maximum((_QUIETER * there).astype(int), 1)
    most[some] = (
        np.cumsum(np.nan_to_num(sizes), axis=0)[small - 1, np.arange(len(small))] / small / _OF_NORMAL / np.sqrt(2)
    )
    quiet = np.where((quiet > 0.05 * whole) & (quiet < 2 * most), quiet, most)
    return np.where(quiet > 0.05 * whole, quiet, whole)


def _window(frames: np.ndarray, noise: np.ndarray, period: float, longest: float | None) -> tuple[int, float]:
    """Number of frames of a window, and the number that it would have if the recording were long enough."""
    most = max(_FEWEST, len(frames) // _WINDOWS)
    if longest is not None:
        return int(np.clip(np.ceil(longest / period), _FEWEST, most)), longest / period
    off = size_of((frames - median(frames)) / noise)
    quiet = np.quantile(off, _QUIET)
    touched = off > _STANDS_OUT * quiet
    edges = np.flatnonzero(np.diff(np.concatenate([[0], touched.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    least = min(max(_LEAST_ALWAYS, int(_LEAST_SHARE * len(frames))), most)
    wanted = _LONGEST * float(runs.max(initial=0))
    if runs.size and runs.max() > most:
        return int(np.clip(most // 2, least, max(least, _MOST_ALWAYS))), wanted
    return int(np.clip(wanted, least, most)), wanted


def _floor(noise: np.ndarray, frames: int) -> np.ndarray:
    """Least difference between the medians of two windows of `frames` frames that contain only noise."""
    return noise * np.sqrt(np.pi / max(frames, 2))


def _triples(steps: np.ndarray, window: int) -> np.ndarray:
    """Triples of consecutive windows (n, 3w, M) throughout a recording."""
    starts = range(0, max(1, len(steps) - 3 * window + 1), max(1, window // 4))
    return np.array([steps[start : start + 3 * window] for start in starts])


def _levels(steps: np.ndarray, window: int) -> np.ndarray:
    """Changes (n, M) of windows from the median of all."""
    starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
    return np.array([median(steps[start : start + window]) for start in starts]) - median(steps)


def _step_limits(triples: np.ndarray, window: int, floor: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Estimate the scale (M,) of changes between windows, and the limits of steps in that scale.

    The first limit is for steps that are still there a window later; the second for any step, such as a touch. The
    steps of each half of the recording are scaled by the other half, which is independent of them.
    """
    pairs = triples[:, : 2 * window]
    changes = np.nan_to_num(np.array([window_change(one) for one in pairs]))
    half, stayed, sizes = len(changes) // 2, [0.0], [0.0]
    rest = median(np.concatenate(list(triples[:: max(1, len(triples) // _WINDOWS)])))
    for learnt, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
        scale = _scale(changes[learnt], floor)
        for triple, pair in zip(triples[other], pairs[other], strict=True):
            step = lasting_step(pair, scale, 0.0)
            if step is None:
                continue
            sizes.append(step.size)
            direction = np.nan_to_num(step.change / scale**2)
            now = median(triple[2 * window :])
            if size_of((now - rest) / scale) < _STILL * step.size:  # back from a touch
                continue
            later = np.nan_to_num(now - median(pair[:window]))
            if later @ direction > _STILL * (np.nan_to_num(step.change) @ direction):
                stayed.append(step.size)
        stayed.append(float(np.median(size_of(changes[other] / scale))) if len(changes[other]) else 0.0)
    beyond = _BEYOND + _FEW / max(len(changes), 1)
    lasting = max(_LEAST_SIZE, beyond * max(stayed))
    return _scale(changes, floor), lasting, max(lasting, beyond * max(sizes))


def _level_limit(changes: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, float]:
    """Estimate the scale and the limit of changes of windows from the median of all, each half scaled by the other."""
    changes = np.nan_to_num(changes)
    half = len(changes) // 2
    sizes = [
        size_of(changes[half:] / _scale(changes[:half], floor)),
        size_of(changes[:half] / _scale(changes[half:], floor)),
    ]
    most = float(np.concatenate(sizes).max(initial=0.0))
    return _scale(changes, floor), max(_LEAST_SIZE, (_BEYOND_LEVEL + _FEW / max(len(changes), 1)) * most)


def _scale(changes: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Standard deviation of changes (n, M), estimated from their mean magnitude as for a normal variable."""
    own = _MEAN * np.mean(np.abs(changes), axis=0) if len(changes) else np.zeros(changes.shape[1])
    # A channel that hardly changed, while others did, may have done so by chance.
    typical = np.median(own[np.isfinite(floor)] / floor[np.isfinite(floor)])
    return np.maximum(own, np.maximum(1.0, 0.5 * typical) * floor)


def _touches(frames: np.ndarray, noise: np.ndarray, window: int) -> tuple[np.ndarray, float]:
    """Directions (M, k) of healthy changes, in units of noise, and the usual share of energy outside of them."""
    there = np.where(np.isfinite(frames), frames, median(frames))
    centres = np.concatenate(
        [np.tile(median(part), (len(part), 1)) for part in np.array_split(there, max(1, len(there) // (2 * window)))]
    )
    scaled = np.nan_to_num((there - centres) / noise)
    energy = np.sum(scaled**2, axis=1)
    strong = scaled[energy > max(4 * np.median(energy), _STRONG * np.quantile(energy, 0.95))]
    strong = strong if len(strong) >= _FEWEST else scaled
    strong = strong[:: max(1, len(strong) // 2000)]
    half, shares = len(strong) // 2, []
    for learnt, other in ((strong[:half], strong[half:]), (strong[half:], strong[:half])):
        if len(learnt) and len(other):
            shares.append(_outside(other, _directions(learnt)))
    unlike = float(np.quantile(np.concatenate(shares), _UNLIKE)) if shares else 1.0
    return _directions(strong), unlike


def _directions(frames: np.ndarray) -> np.ndarray:
    """Principal directions (M, k) of frames."""
    _, values, rows = np.linalg.svd(frames, full_matrices=False)
    explained = np.cumsum(values**2) / max(np.sum(values**2), 1e-300)
    number = min(int(np.searchsorted(explained, _EXPLAINED)) + 1, _DIRECTIONS, max(1, len(frames) // 4))
    return rows[: min(number, max(1, frames.shape[1] // 2))].T


def _outside(scaled: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Share of the energy of changes (n, M) that is outside of the directions."""
    energy = np.sum(scaled**2, axis=1)
    left = energy - np.sum((scaled @ directions) ** 2, axis=1)
    return np.clip(left / np.maximum(energy, 1e-300), 0.0, 1.0)
