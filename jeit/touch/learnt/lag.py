"""Whether frames were recorded some rows before or after the presses that they are of."""

import numpy as np
from scipy.spatial import KDTree

from jeit.touch.learnt.features import Features

_MOST, _NEIGHBOURS, _COMPONENTS = 2, 5, 12
# Places told from frames as they are must be no better than a guess, and by another lag so much better.
_GUESS, _BETTER = 0.93, 0.85


def lag_of(changes: np.ndarray, positions: np.ndarray, folds: np.ndarray) -> tuple[int, float, float]:
    """By how many rows frames come after their presses, 0 unless that is plain; and the mean error of places told by
    the nearest frames with none and with that lag, metres."""
    features = Features.learn("normalised", changes, np.zeros_like(changes))
    scores = features(changes, np.zeros_like(changes))[:, :_COMPONENTS]
    errors = {lag: _error(scores, positions, folds, lag) for lag in range(-_MOST, _MOST + 1)}
    guess = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    best = min(errors, key=lambda lag: errors[lag])
    plain = errors[0] > _GUESS * guess and errors[best] < _BETTER * min(errors[0], guess)
    best = best if plain else 0
    return best, errors[0], errors[best]


def shifted(number: int, lag: int) -> tuple[slice, slice]:
    """Rows of frames, and of what touched in them, of `number` that were recorded with a lag."""
    return slice(max(lag, 0), number + min(lag, 0)), slice(max(-lag, 0), number - max(lag, 0))


def _error(scores: np.ndarray, positions: np.ndarray, folds: np.ndarray, lag: int) -> float:
    frames, presses = shifted(len(scores), lag)
    scores, positions, folds = scores[frames], positions[presses], folds[presses]
    off = np.empty(len(scores))
    for fold in np.unique(folds):
        out = folds == fold
        learnt = positions[~out]
        near = KDTree(scores[~out]).query(scores[out], min(_NEIGHBOURS, len(learnt)))[1].reshape(out.sum(), -1)
        off[out] = np.linalg.norm(learnt[near].mean(axis=1) - positions[out], axis=1)
    return float(off.mean())
