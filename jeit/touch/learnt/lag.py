"""Detect whether frames were recorded some rows before or after the presses that they belong to."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from jeit.touch.learnt.features import Features

_MOST, _NEIGHBOURS, _COMPONENTS = 2, 8, 12
# A lag is found if the error of places estimated without one is at least this share of that of a guess, that with the
# lag is less, and that with any other lag is greater by this many standard errors.
_GUESS, _STANDARD_ERRORS = 0.95, 4.0


def lag_of(changes: np.ndarray, positions: np.ndarray, folds: np.ndarray) -> tuple[int, float, float]:
    """Estimate by how many rows frames come after their presses, 0 unless there is clear evidence.

    Also returns the mean error of places estimated from the nearest frames without a lag and with it, metres.
    """
    features = Features.learn("normalised", changes, np.zeros_like(changes))
    scores = features(changes, np.zeros_like(changes))[:, :_COMPONENTS]
    errors = {lag: _errors(scores, positions, folds, lag) for lag in range(-_MOST, _MOST + 1)}
    guess = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    means = {lag: float(off.mean()) for lag, off in errors.items()}
    best, second = sorted(means, key=lambda lag: means[lag])[:2]
    enough = _STANDARD_ERRORS * float(errors[best].std()) / np.sqrt(len(positions))
    plain = means[0] > _GUESS * guess > means[best] and means[second] - means[best] > enough
    best = best if plain else 0
    return best, means[0], means[best]


def shifted(number: int, lag: int) -> tuple[slice, slice]:
    """Rows of frames, and of their presses, among `number` rows that were recorded with a lag."""
    return slice(max(lag, 0), number + min(lag, 0)), slice(max(-lag, 0), number - max(lag, 0))


def _errors(scores: np.ndarray, positions: np.ndarray, folds: np.ndarray, lag: int) -> np.ndarray:
    frames, presses = shifted(len(scores), lag)
    scores, positions, folds = scores[frames], positions[presses], folds[presses]
    off = np.empty(len(scores))
    for fold in np.unique(folds):
        out = folds == fold
        learnt = positions[~out]
        near = KDTree(scores[~out]).query(scores[out], min(_NEIGHBOURS, len(learnt)))[1].reshape(out.sum(), -1)
        off[out] = np.linalg.norm(learnt[near].mean(axis=1) - positions[out], axis=1)
    return off
