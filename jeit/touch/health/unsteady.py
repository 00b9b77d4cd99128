"""Detect single channels that are noisy, jump, or are stuck, from their changes from step to step.

Two measures of every channel in a window: the mean of the smaller half of its steps' magnitudes, which touches hardly
affect, and the mean of all, which responds to jumps. Each is compared with that of healthy windows, in two consecutive
windows, and with the other channels now: where many do it at once, it is a touch, not they.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

# The share of a window's steps, the smallest, that measure noise; the least share that has a reading.
_SMALL, _READ = 0.5, 0.5
# The least limit, as a multiple of the usual; the multiple of the greatest among healthy windows; and how much this
# grows where windows are few.
_LEAST, _BEYOND, _FEW = 3.0, 2.0, 12.0
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
        limits = np.maximum(_LEAST, (_BEYOND + _FEW / max(len(found), 1)) * most)
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
