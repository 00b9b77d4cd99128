"""`Healthy`: what a recording of a healthy skin says of how frames differ that mean no harm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.health.lasting import lasting_step, median, size_of, window_change
from jeit.touch.health.unsteady import Steadiness

# Steps of a window at most, more frames are averaged; at least; and windows that a healthy recording has at least.
_MOST, _FEWEST, _WINDOWS = 48, 5, 8
# Windows of a healthy recording that has no quiet in it, in frames.
_LEAST_ALWAYS, _MOST_ALWAYS = 12, 64
# A window is so many times the longest touch, where no time is given, and no less than this share of the frames.
_LONGEST, _LEAST_SHARE = 3.0, 1 / 40
# Of what healthy windows did at most, and in deviations of normal ones: a change below is none. Few windows say less.
_BEYOND, _LEAST_SIZE, _FEW = 2.0, 4.0, 20.0
# Where windows are so many times shorter than touches ask for, touches look as if they stayed: limits are so much
# higher.
_SHORT, _DOUBT = 1.5, 2.0
# A step is still there when so much of it is.
_STILL = 0.4
# The same from the healthy recording to another.
_BEYOND_LEVEL = 3.0
# A touch stands out so far from what quiet frames do; of the frames, the quietest are this share.
_STANDS_OUT, _QUIET = 3.0, 0.3
# Touches' directions at most, and the share of their energy that directions have.
_DIRECTIONS, _EXPLAINED = 40, 0.98
# Of healthy touches, how many are as unlike the others; those count that have this share of a strong one's energy.
_UNLIKE, _STRONG = 0.99, 0.2
_LEAST_FRAMES = 20
# Of steps from frame to frame, those that touches have no part in; the mean magnitude of as many of a normal number.
_QUIETER, _OF_NORMAL = 0.8, 0.5586
# Deviation of a normal number over its mean magnitude.
_MEAN = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True)
class Healthy:
    """What is known of a healthy skin with M channels.

    **Fields**: `reference` (M,), untouched, volts; `used` (M,): channels that read anything; `noise` (M,), volts, from
    frame to frame; `span` (2, M): least and greatest change in it; `stride`: frames averaged to a step; `window`: steps
    of a window; `scale` (M,), volts: how far windows that follow each other are apart; `limit` of
    `size_of` a step that stays, and `sudden` of one that may be a touch; `level`
    (M,), volts, how far any two are apart, and its `level_limit`; `touches` (M, k): directions of touches, orthonormal
    in units of noise; `unlike`: the share of a change that no touch has outside of those; `steadiness` of single
    channels; `period`, seconds a frame, or 1; whether the recording was too `brief` for its touches, with limits
    twice as high for it.
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
        """From healthy frames (F, M), touches among them or not, `period` seconds apart. `longest`: seconds that
        windows take, what a touch is shorter than; from the touches in the frames unless given.

        Raises `ValueError` for fewer than 20 frames, and where no channel reads anything.
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
        """The share of a change that is in no direction that touches have, of its energy in units of noise."""
        return float(_outside((np.nan_to_num(change) / self.noise)[None], self.touches)[0])


def averaged(frames: Float[np.ndarray, "F M"], stride: int) -> Float[np.ndarray, "n M"]:
    """Means of every `stride` frames, of the readings there are."""
    if stride == 1:
        return frames
    groups = frames[: len(frames) // stride * stride].reshape(-1, stride, frames.shape[1])
    there = np.isfinite(groups)
    number = there.sum(axis=1)
    return np.where(number > 0, np.where(there, groups, 0.0).sum(axis=1) / np.maximum(number, 1), np.nan)


def _noise(frames: np.ndarray) -> np.ndarray:
    """Of every channel from frame to frame; what moves only now and then has the deviation that this makes."""
    steps = np.diff(frames, axis=0)
    some = np.isfinite(steps).any(axis=0)
    quiet, most, whole = np.zeros((3, frames.shape[1]))
    sizes = np.sort(np.abs(steps[:, some]), axis=0)  # NaN last
    there = np.isfinite(sizes).sum(axis=0)
    quiet[some] = 1.4826 * np.nanmedian(sizes, axis=0) / np.sqrt(2)
    whole[some] = np.nanstd(steps[:, some], axis=0) / np.sqrt(2)
    # Coarse steps of a converter have a median of zero, or of one of them; their mean tells more.
    small = np.maximum((_QUIETER * there).astype(int), 1)
    most[some] = (
        np.cumsum(np.nan_to_num(sizes), axis=0)[small - 1, np.arange(len(small))] / small / _OF_NORMAL / np.sqrt(2)
    )
    quiet = np.where((quiet > 0.05 * whole) & (quiet < 2 * most), quiet, most)
    return np.where(quiet > 0.05 * whole, quiet, whole)


def _window(frames: np.ndarray, noise: np.ndarray, period: float, longest: float | None) -> tuple[int, float]:
    """Frames of a window, and as many as it would have were the recording long enough."""
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
    """By what medians of two windows of so many frames of nothing but noise differ, at least."""
    return noise * np.sqrt(np.pi / max(frames, 2))


def _triples(steps: np.ndarray, window: int) -> np.ndarray:
    """Three windows (n, 3w, M) that follow each other, all over a recording."""
    starts = range(0, max(1, len(steps) - 3 * window + 1), max(1, window // 4))
    return np.array([steps[start : start + 3 * window] for start in starts])


def _levels(steps: np.ndarray, window: int) -> np.ndarray:
    """Changes (n, M) of windows from the median of all."""
    starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
    return np.array([median(steps[start : start + window]) for start in starts]) - median(steps)


def _step_limits(triples: np.ndarray, window: int, floor: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The scale (M,) of changes between windows; how large a step may be in it that is still there a window later; and
    one that need not be, such as a touch.

    Steps are of each half in the scale of the other, which they had no part in.
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
    """The same of how far windows are from the median of all, each half of them."""
    changes = np.nan_to_num(changes)
    half = len(changes) // 2
    sizes = [
        size_of(changes[half:] / _scale(changes[:half], floor)),
        size_of(changes[:half] / _scale(changes[half:], floor)),
    ]
    most = float(np.concatenate(sizes).max(initial=0.0))
    return _scale(changes, floor), max(_LEAST_SIZE, (_BEYOND_LEVEL + _FEW / max(len(changes), 1)) * most)


def _scale(changes: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Of changes (n, M): what a normal number would have for a deviation."""
    own = _MEAN * np.mean(np.abs(changes), axis=0) if len(changes) else np.zeros(changes.shape[1])
    # A channel that hardly moved among others that did was lucky.
    typical = np.median(own[np.isfinite(floor)] / floor[np.isfinite(floor)])
    return np.maximum(own, np.maximum(1.0, 0.5 * typical) * floor)


def _touches(frames: np.ndarray, noise: np.ndarray, window: int) -> tuple[np.ndarray, float]:
    """Directions (M, k) of what healthy frames do, in units of noise, and the share outside of them that is common."""
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
    """Principal directions (M, k)."""
    _, values, rows = np.linalg.svd(frames, full_matrices=False)
    explained = np.cumsum(values**2) / max(np.sum(values**2), 1e-300)
    number = min(int(np.searchsorted(explained, _EXPLAINED)) + 1, _DIRECTIONS, max(1, len(frames) // 4))
    return rows[: min(number, max(1, frames.shape[1] // 2))].T


def _outside(scaled: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Of changes (n, M), the share of their energy that is in none of the directions."""
    energy = np.sum(scaled**2, axis=1)
    left = energy - np.sum((scaled @ directions) ** 2, axis=1)
    return np.clip(left / np.maximum(energy, 1e-300), 0.0, 1.0)
