"""Channels of a learnt skin: noise, missing channels filled in, and how unlike all presses a frame is.

Measure how far a frame is from all presses of the training set.

Two touches at once, or one of the opposite sign, are made of the same patterns, but are unlike any recorded press.

Model the joint variation of channels, to detect dead channels and to predict what they would have read.

Changes of a skin's M channels are modelled by the scores of a few patterns and noise, d = s (V z + n), with z and n
normal. The scores of a frame with missing channels are the most likely ones; a channel is dead if it differs from the
others' prediction by more than so many deviations. Its reading is predicted from the covariance of all channels, which
contains more than the patterns do: for example, that reciprocal channels read the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

# The number of scores used, the greatest number of presses kept, and the share of the usual size that is added to the
# size that distances are relative to.
_SCORES, _MOST_KEPT, _SMALL = 8, 4000, 0.5
_USUAL_QUANTILE = 0.99


@dataclass(frozen=True)
class Neighbourhood:
    """Leading `scores` (N, k) of presses, their usual `size`, and the `usual` distance between neighbours.

    Distances are relative to the size; all but a hundredth of the presses are nearer to their neighbour than `usual`.
    """

    scores: Float[np.ndarray, "N k"]
    size: float
    usual: float

    @classmethod
    def learn(cls, scores: Float[np.ndarray, "N K"]) -> "Neighbourhood":
        """Learn from scores of presses (N, K)."""
        kept = scores[:: -(-len(scores) // _MOST_KEPT), :_SCORES]
        size = float(np.median(np.linalg.norm(kept, axis=1))) or 1.0
        found = cls(kept, size, 1.0)
        apart = found._relative(kept, second=True)
        return cls(kept, size, max(float(np.quantile(apart, _USUAL_QUANTILE)), 1e-6))

    def __call__(self, scores: Float[np.ndarray, "n K"]) -> Float[np.ndarray, " n"]:
        """Relative distances (n,) of frames with these scores, 1 at the `usual` distance."""
        return self._relative(scores[:, :_SCORES]) / self.usual

    def _relative(self, scores: np.ndarray, *, second: bool = False) -> np.ndarray:
        distance = np.asarray(self._tree.query(scores, 2)[0])[:, int(second)]
        return distance / (np.linalg.norm(scores, axis=1) + _SMALL * self.size)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.scores)


# Share of the variance that patterns leave to noise; the greatest number of patterns; presses required for each.
_LEFT, _MOST, _PRESSES_EACH = 1e-3, 60, 4
# A channel is dead beyond this multiple of the given quantile of the residuals of training presses.
_BEYOND, _QUANTILE = 2.0, 0.999
# A channel that is alive does not read beyond its training range by more than this multiple of its span; the greatest
# share of channels that may do so before the frame counts as unusual instead.
_SPANS, _FEW = 2.0, 0.1
# Variation below this share of the greatest change is rounding.
_ROUNDING = 1e-13
# Values added to the diagonal of the covariance, of channels whose variance is 1.
_DIAGONALS = np.logspace(-6, 0, 13)
# The greatest share of dead channels; beyond it, the search for dead channels stops.
_MOST_DEAD = 0.34
# The number of consecutive frames with unique sets of missing channels, before all are processed one by one.
_ALONE = 8
# The novelty of a frame at the usual distance between presses from the nearest one.
_NEAR = 2 / 1.75


@dataclass(frozen=True)
class Channels:
    """Joint model of M channels, of which some are `used` (M,): those with readings that are not constant.

    Of the channels used: `scale` (m,) of changes; `range` (2, m), in scales, beyond which no channel reads that is
    alive; `patterns` (m, k), `spread` (k,) of scores, `noise` (m,) in scales; `farthest` (m,): the greatest residuals
    of a channel that is alive; `directions` (m, r) of the covariance, the `weight` (r,) of each relative to a diagonal,
    and the variance (m,) of channels that all others do not predict, `unpredicted`; `usual`: the novelty that all but a
    hundredth of the presses do not exceed; `neighbourhood`: how near presses are to each other.
    """

    used: Bool[np.ndarray, " M"]
    scale: Float[np.ndarray, " m"]
    range: Float[np.ndarray, "2 m"]
    patterns: Float[np.ndarray, "m k"]
    spread: Float[np.ndarray, " k"]
    noise: Float[np.ndarray, " m"]
    farthest: Float[np.ndarray, " m"]
    directions: Float[np.ndarray, "m r"]
    weight: Float[np.ndarray, " r"]
    unpredicted: Float[np.ndarray, " m"]
    usual: float
    neighbourhood: Neighbourhood

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N M"]) -> "Channels":
        """Learn from changes (N, M), NaN where there was no reading. Raises `ValueError` where no channel changes."""
        missing = np.isnan(changes)
        used = missing.mean(axis=0) < 0.5
        deviation = np.zeros(changes.shape[1])
        deviation[used] = np.nanstd(changes[:, used], axis=0)
        size = np.nanmax(np.abs(changes[:, used]), initial=0.0)
        used &= deviation > max(1e-9 * deviation.max(initial=0.0), _ROUNDING * size)
        if not used.any():
            raise ValueError("frames: no channel changes; are these frames, and the skin connected?")
        scale = deviation[used]
        scaled = np.where(missing[:, used], 0.0, changes[:, used]) / scale
        there, half = ~missing[:, used], len(scaled) // 2
        # Residuals of frames outside the training set are greater than of those in it: each half is evaluated with the
        # patterns of the other.
        left, apart, misses = [], [], np.zeros((2, len(_DIAGONALS), int(used.sum())))
        for learnt, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
            variance, directions = _variances(scaled[learnt])
            misses += _missed(scaled[other], variance, directions)
            model = _factors(scaled[learnt], variance, directions)
            scores, residual = _explain(scaled[other], there[other], *model)
            left.append(np.where(there[other], np.abs(residual), np.nan))
            apart.append(_novelty(scores, residual, there[other], model[1]))
        left, apart = np.concatenate(left), np.concatenate(apart)
        farthest = _BEYOND * np.nanquantile(left, _QUANTILE, axis=0)
        farthest = np.maximum(farthest, max(6.0, float(np.nanquantile(left, 0.99))))
        variance, directions = _variances(scaled)
        best = int(misses[0].sum(axis=1).argmin())
        weight, unpredicted = variance / (variance + _DIAGONALS[best]), misses[1, best] / 2
        patterns, spread, noise = _factors(scaled, variance, directions)
        every, _ = _explain(scaled, there, patterns, spread, noise)
        usual = float(np.quantile(apart, 0.99))
        least, most = np.nanmin(changes[:, used], axis=0) / scale, np.nanmax(changes[:, used], axis=0) / scale
        far = np.stack([least - _SPANS * (most - least), most + _SPANS * (most - least)])
        near = Neighbourhood.learn(every)
        return cls(used, scale, far, patterns, spread, noise, farthest, directions, weight, unpredicted, usual, near)

    def complete(self, changes: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Replace changes of dead or missing channels by their prediction from the other channels.

        Returns changes (n, m) of the channels used; which are alive (n, m); and novelty (n,), 1 where a frame is as far
        from the training set as the farthest frame in it.
        """
        whole = changes[:, self.used] / self.scale
        given, far = ~np.isnan(whole), (whole < self.range[0]) | (whole > self.range[1])
        # Where many channels are out of range, the frame is unusual, not the channels.
        given &= ~far | (far.sum(axis=1, keepdims=True) > max(1, _FEW * whole.shape[1]))
        whole, alive = np.where(given, whole, 0.0), given.copy()
        scores, residual = self._explain_all(whole)
        left, alone = np.flatnonzero((np.abs(residual) > self.farthest).any(axis=1) | ~given.all(axis=1)), 0
        while left.size:
            # Most frames lack the same channels: the pattern found for one frame is tried on all that remain.
            pattern = self._alive(whole[left[0]], given[left[0]])
            some = left if alone < _ALONE else left[:1]
            beyond, some_scores, some_residual = self._beyond(whole[some], given[some], pattern)
            same = (beyond <= 1) == pattern
            borne = same.all(axis=1)
            borne[0] = True
            alone = alone + 1 if borne.sum() == 1 else 0
            rows = some[borne]
            alive[rows], scores[rows] = pattern, some_scores[borne]
            residual[rows] = np.where(pattern, some_residual[borne], 0.0)
            whole[np.ix_(rows, ~pattern)] = self._predicted(whole[np.ix_(rows, pattern)], pattern)
            left = np.setdiff1d(left, rows, assume_unique=True)
        novelty = _novelty(scores, residual, alive, self.spread) / self.usual
        return whole * self.scale, alive, np.maximum(novelty, _NEAR * self.neighbourhood(scores))

    def _alive(self, frame: np.ndarray, given: np.ndarray) -> np.ndarray:
        """Which channels of a frame agree with the prediction from the others.

        Those that agree least are removed repeatedly; then those that agree with the remaining ones are restored.
        """
        alive, fewest, back = given.copy(), (1 - _MOST_DEAD) * len(frame), False
        while alive.sum() > fewest:
            (beyond,) = self._beyond(frame[None], given[None], alive)[0]
            worst = np.max(beyond, where=alive, initial=0.0)
            if worst <= 1 and back:
                break
            if worst <= 1:
                alive, back = beyond <= 1, True
            else:
                alive &= beyond < (worst if back else max(1.0, worst / 2))
        return alive

    def _beyond(self, whole, given, alive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Deviations of channels in frames (n, m) from the prediction by those `alive` (m,).

        1 is the greatest deviation of a channel that is alive; infinite where not `given` (n, m). Also returns the
        frames' scores (n, k) and residuals (n, m).
        """
        weighted = self.patterns * (alive / self.noise**2)[:, None]
        gain = weighted @ np.linalg.inv(weighted.T @ self.patterns + np.diag(1 / self.spread**2))
        scores = whole @ gain
        residual = (whole - scores @ self.patterns.T) / self.noise
        free = 1 - np.einsum(
            "ij,ij->i", self.patterns, gain
        )  # variance of the residual; the channel itself explains the rest
        beyond = np.where(given, np.abs(residual) / np.sqrt(np.maximum(free, 1e-6)) / self.farthest, np.inf)
        return beyond, scores, residual

    def _predicted(self, alive_readings: Float[np.ndarray, "n a"], alive: np.ndarray) -> Float[np.ndarray, "n m-a"]:
        """Predict the most likely readings of channels that are not `alive` (m,)."""
        dead = self.directions[~alive] * self.weight
        predicted = dead @ (alive_readings @ self.directions[alive]).T
        return np.linalg.solve(np.eye(len(dead)) - dead @ self.directions[~alive].T, predicted).T

    def unsure(self, alive: Bool[np.ndarray, "n m"], number: int) -> Float[np.ndarray, "q n m"]:
        """Errors of predicted readings, of frames with some channels `alive`.

        They are the q ≤ `number` greatest independent deviations, in the unit of changes.
        """
        found = np.zeros((min(number, int((~alive).sum(axis=1).max(initial=0))), *alive.shape))
        patterns, kind = np.unique(alive, axis=0, return_inverse=True)
        for one, pattern in enumerate(patterns):
            dead, doubt = self.directions[~pattern], np.sqrt(self.unpredicted[~pattern])
            inverse = np.linalg.inv(np.eye(len(dead)) - (dead * self.weight) @ dead.T)
            variance, vectors = np.linalg.eigh(doubt[:, None] * inverse * doubt)
            columns = vectors[:, ::-1] * np.sqrt(np.maximum(variance[::-1], 0.0))
            frames, channels = np.flatnonzero(kind.ravel() == one), np.flatnonzero(~pattern)
            for way in range(min(len(found), len(channels))):
                found[np.ix_(np.array([way]), frames, channels)] = columns[:, way] * self.scale[channels]
        return found

    def _explain_all(self, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scores and residuals of frames (n, m) of which all channels are alive."""
        scores = whole @ self._gain
        return scores, (whole - scores @ self.patterns.T) / self.noise

    @cached_property
    def _gain(self) -> Float[np.ndarray, "m k"]:
        """Matrix from channels, all of them alive, to scores."""
        weighted = self.patterns / self.noise[:, None] ** 2
        return np.linalg.solve(weighted.T @ self.patterns + np.diag(1 / self.spread**2), weighted.T).T


def _variances(scaled: Float[np.ndarray, "N m"]) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "m r"]]:
    """Principal directions of frames, and the variance along each, the greatest first."""
    number, channels = scaled.shape
    if channels <= number:
        squares, directions = np.linalg.eigh(scaled.T @ scaled)
    else:  # fewer products
        squares, combined = np.linalg.eigh(scaled @ scaled.T)
        directions = scaled.T @ combined / np.sqrt(np.maximum(squares, 1e-300))
    kept = np.flatnonzero(squares > _ROUNDING * squares[-1])[::-1]
    return squares[kept] / number, directions[:, kept]


def _factors(scaled, variance, directions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patterns (m, k), the deviations of their scores, and of the noise that they leave in each channel."""
    explained = np.cumsum(variance) / np.sum(variance)
    number = min(int(np.searchsorted(explained, 1 - _LEFT)) + 1, _MOST, max(1, len(scaled) // _PRESSES_EACH))
    number = min(number, max(1, scaled.shape[1] // 2))
    patterns = directions[:, :number]
    left = scaled - scaled @ patterns @ patterns.T
    noise = np.sqrt(np.mean(left**2, axis=0) * len(scaled) / max(1, len(scaled) - number))
    return patterns, np.sqrt(variance[:number]), np.maximum(noise, 1e-6)


def _missed(scaled, variance, directions) -> Float[np.ndarray, "2 D m"]:
    """Mean squared prediction errors of channels, for covariances with each diagonal.

    First, of the error of each channel as predicted by the others; second, of that times the share `free` of the
    others, the variance that `unsure` uses.
    """
    scores, found = scaled @ directions, []
    for diagonal in _DIAGONALS:
        weight = variance / (variance + diagonal)
        free = 1 - np.sum(directions**2 * weight, axis=1)
        square = np.mean((scaled - (scores * weight) @ directions.T) ** 2, axis=0)
        found.append((square / free**2, square / free))
    return np.swapaxes(np.array(found), 0, 1)


def _explain(whole, alive, patterns, spread, noise) -> tuple[np.ndarray, np.ndarray]:
    """Most likely scores (n, k) of frames (n, m), and residuals in deviations of the noise.

    Residuals are 0 for channels that are not `alive` (n, m).
    """
    weighted = patterns / noise[:, None] ** 2
    prior = np.diag(1 / spread**2)
    scores = np.linalg.solve(weighted.T @ patterns + prior, weighted.T @ whole.T).T
    for frame in np.flatnonzero(~alive.all(axis=1)):
        own = weighted * alive[frame, :, None]
        scores[frame] = np.linalg.solve(own.T @ patterns + prior, own.T @ whole[frame])
    return scores, np.where(alive, (whole - scores @ patterns.T) / noise, 0.0)


def _novelty(scores, residual, alive, spread) -> np.ndarray:
    """The greater of the root mean squares of residuals and of scores, each in its own deviations."""
    left = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(alive.sum(axis=1), 1))
    return np.maximum(left, np.sqrt(np.mean((scores / spread) ** 2, axis=1)))


def choose_channels(
    scaled: Float[np.ndarray, "N m"], answers: Float[np.ndarray, "N q"], number: int
) -> Int[np.ndarray, " n"]:
    """Select channels by simultaneous orthogonal matching pursuit (Tropp et al. 2006), the most informative first.

    Each explains most of what the previous channels leave unexplained of the answers, by least squares. Products of the
    answers with one another are explained too, since places are not linear in voltages.
    """
    products = [answers[:, i] * answers[:, j] for i in range(answers.shape[1]) for j in range(i + 1)]
    left = np.column_stack([answers, *(one - one.mean() for one in products[:20])])
    left = left - left.mean(axis=0)
    candidates = scaled - scaled.mean(axis=0)
    first = np.sum(candidates**2, axis=0)
    chosen: list[int] = []
    for _ in range(min(number, scaled.shape[1])):
        size = np.sum(candidates**2, axis=0)
        gain = np.sum((candidates.T @ left) ** 2, axis=1) / np.where(size > 1e-8 * first, size, np.inf)
        gain[chosen] = -1
        best = int(gain.argmax())
        chosen.append(best)
        if size[best] > 1e-8 * first[best]:
            direction = candidates[:, best] / np.sqrt(size[best])
            left = left - np.outer(direction, direction @ left)
            candidates = candidates - np.outer(direction, direction @ candidates)
    return np.array(chosen)
