"""What channels do together, so that one that has died is noticed, and what it would have read is known.

Changes of a skin's M channels are scores of a few patterns and noise, d = s (V z + n), with z and n normal. The scores
of a frame of which some channels are missing are those most likely; a channel is dead where the others foretell it to
be within so many deviations, and it is not.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.learnt.neighbourhood import Neighbourhood

# Share of the variance that patterns leave to noise; patterns at most, and presses for each.
_LEFT, _MOST, _PRESSES_EACH = 1e-3, 60, 4
# A channel is dead beyond so many times what all but a thousandth of the presses that taught had.
_BEYOND, _QUANTILE = 2.0, 0.999
# Of the greatest change: what varies less is rounding.
_ROUNDING = 1e-13
# Of channels, before a frame is given up instead.
_MOST_DEAD = 0.34
# Frames one after the other that lack channels as no other does, before all are taken one by one.
_ALONE = 8
# Of the distance to the nearest press, in novelty.
_NEAR = 2 / 1.75


@dataclass(frozen=True)
class Channels:
    """M channels, of which some are `used` (M,): neither constant nor without readings.

    For those: `scale` (m,) of changes, `patterns` (m, k), `spread` (k,) of scores, `noise` (m,) in scales; `farthest`
    (m,): residuals that are still those of a channel alive; `usual`: novelty of all but a hundredth of the presses;
    `neighbourhood`: how near presses are to each other.
    """

    used: Bool[np.ndarray, " M"]
    scale: Float[np.ndarray, " m"]
    patterns: Float[np.ndarray, "m k"]
    spread: Float[np.ndarray, " k"]
    noise: Float[np.ndarray, " m"]
    farthest: Float[np.ndarray, " m"]
    usual: float
    neighbourhood: Neighbourhood

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N M"]) -> "Channels":
        """From changes (N, M), NaN where there was no reading. Raises `ValueError` where no channel changes."""
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
        half = len(scaled) // 2
        patterns, spread, noise = _factors(scaled)
        # What frames not learnt from leave, which is more than those learnt from do: each half by the other's patterns.
        left, apart = [], []
        for learnt, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
            other_patterns, other_spread, other_noise = _factors(scaled[learnt])
            there = ~missing[other][:, used]
            scores, residual = _explain(scaled[other], there, other_patterns, other_spread, other_noise)
            left.append(np.where(there, np.abs(residual), np.nan))
            apart.append(_novelty(scores, residual, there, other_spread))
        left, apart = np.concatenate(left), np.concatenate(apart)
        farthest = _BEYOND * np.nanquantile(left, _QUANTILE, axis=0)
        farthest = np.maximum(farthest, max(6.0, float(np.nanquantile(left, 0.99))))
        every, _ = _explain(scaled, ~missing[:, used], patterns, spread, noise)
        usual = float(np.quantile(apart, 0.99))
        return cls(used, scale, patterns, spread, noise, farthest, usual, Neighbourhood.learn(every))

    def complete(self, changes: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Changes (n, m) of the channels used, as foretold by the others where one is dead or has no reading; which
        are alive (n, m); and novelty (n,), 1 where a frame is as far from those learnt from as the farthest of them."""
        whole = changes[:, self.used] / self.scale
        given = ~np.isnan(whole)
        whole, alive = np.where(given, whole, 0.0), given.copy()
        scores, residual = self._explain_all(whole)
        left, alone = np.flatnonzero((np.abs(residual) > self.farthest).any(axis=1) | ~given.all(axis=1)), 0
        while left.size:
            # Frames mostly lack the same channels: what one lacks is tried on all that are left.
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
            whole[rows] = np.where(pattern, whole[rows], scores[rows] @ self.patterns.T)
            left = np.setdiff1d(left, rows, assume_unique=True)
        novelty = _novelty(scores, residual, alive, self.spread) / self.usual
        return whole * self.scale, alive, np.maximum(novelty, _NEAR * self.neighbourhood(scores))

    def _alive(self, frame: np.ndarray, given: np.ndarray) -> np.ndarray:
        """Which channels of a frame the others bear out: those borne out least are left out, time and again, and those
        that what is left bears out taken back."""
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
        """How far channels of frames (n, m) are from what those `alive` (m,) foretell, 1 where no farther than ever,
        infinite where not `given` (n, m); the frames' scores (n, k) and residuals (n, m)."""
        weighted = self.patterns * (alive / self.noise**2)[:, None]
        gain = weighted @ np.linalg.inv(weighted.T @ self.patterns + np.diag(1 / self.spread**2))
        scores = whole @ gain
        residual = (whole - scores @ self.patterns.T) / self.noise
        own = 1 - np.einsum("ij,ij->i", self.patterns, gain)  # a channel's say in what foretells it
        beyond = np.where(given, np.abs(residual) / np.maximum(own, 1e-3) / self.farthest, np.inf)
        return beyond, scores, residual

    def _explain_all(self, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scores and residuals of frames (n, m) of which all channels are alive."""
        scores = whole @ self._gain
        return scores, (whole - scores @ self.patterns.T) / self.noise

    @cached_property
    def _gain(self) -> Float[np.ndarray, "m k"]:
        """From channels, all of them alive, to scores."""
        weighted = self.patterns / self.noise[:, None] ** 2
        return np.linalg.solve(weighted.T @ self.patterns + np.diag(1 / self.spread**2), weighted.T).T


def _factors(scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patterns (m, k), deviations of their scores, and of the noise that they leave each channel."""
    _, values, rows = np.linalg.svd(scaled, full_matrices=False)
    explained = np.cumsum(values**2) / np.sum(values**2)
    number = min(int(np.searchsorted(explained, 1 - _LEFT)) + 1, _MOST, max(1, len(scaled) // _PRESSES_EACH))
    number = min(number, max(1, scaled.shape[1] // 2))
    patterns = rows[:number].T
    left = scaled - scaled @ patterns @ patterns.T
    noise = np.sqrt(np.mean(left**2, axis=0) * len(scaled) / max(1, len(scaled) - number))
    return patterns, values[:number] / np.sqrt(len(scaled)), np.maximum(noise, 1e-6)


def _explain(whole, alive, patterns, spread, noise) -> tuple[np.ndarray, np.ndarray]:
    """Most likely scores (n, k) of frames (n, m), and what they leave, in deviations of the noise; 0 for channels that
    are not `alive` (n, m)."""
    weighted = patterns / noise[:, None] ** 2
    prior = np.diag(1 / spread**2)
    scores = np.linalg.solve(weighted.T @ patterns + prior, weighted.T @ whole.T).T
    for frame in np.flatnonzero(~alive.all(axis=1)):
        own = weighted * alive[frame, :, None]
        scores[frame] = np.linalg.solve(own.T @ patterns + prior, own.T @ whole[frame])
    return scores, np.where(alive, (whole - scores @ patterns.T) / noise, 0.0)


def _novelty(scores, residual, alive, spread) -> np.ndarray:
    """Root mean square of residuals and of scores, each in its own deviations: the larger of the two."""
    left = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(alive.sum(axis=1), 1))
    return np.maximum(left, np.sqrt(np.mean((scores / spread) ** 2, axis=1)))
