"""Estimate standard deviations of predictions, from the errors of similar held-out presses, and calibrate them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

_LIKE, _SHARES = 40, ((1.0, 0.6827), (1.96, 0.95))
# The weight of a frame's size relative to its place, and of the mean of all errors relative to those of similar
# presses.
_SIZE, _ALL = 0.3, 0.15
# The least number of presses from which the coverage of a deviation is estimated.
_ENOUGH = 30
# The least standard deviation, as a share of the spread of the training set.
_LEAST = 1e-4


@dataclass(frozen=True)
class Spread:
    """Squared errors (N, d) of held-out presses, at their places `where` (N, d + 1); `unit` (d + 1,) of these."""

    where: Float[np.ndarray, "N e"]
    squares: Float[np.ndarray, "N d"]
    low: Float[np.ndarray, " e"]
    unit: Float[np.ndarray, " e"]
    factor: Float[np.ndarray, " d"]

    @classmethod
    def learn(cls, said: np.ndarray, changes: np.ndarray, errors: np.ndarray, last: np.ndarray) -> "Spread":
        """Learn from predictions (N, d) for held-out presses, their changes (N, m), and their errors (N, d).

        `last` (N,): presses that came before or after all others when they were held out, as future presses do:
        deviations are calibrated on those, if there are enough.
        """
        where = np.column_stack([said, _size(changes)])
        low, unit = where.mean(axis=0), where.std(axis=0)
        unit = np.where(unit > 0, unit, 1.0)
        unit[-1] /= _SIZE
        most = np.quantile(np.abs(errors), 0.99, axis=0)  # one large error is not representative of its neighbours
        squares = np.minimum(np.abs(errors), most) ** 2
        found = cls((where - low) / unit, squares, low, unit, np.ones(errors.shape[1]))
        local = found._local(found.where, own=True)
        last = last if last.sum() >= _ENOUGH else np.ones_like(last)
        factor = [_factor(np.abs(error) / one) for error, one in zip(errors[last].T, local[last].T, strict=True)]
        return cls(found.where, squares, low, unit, np.array(factor))

    def __call__(self, said: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "n d"]:
        """Standard deviations (n, d) of predictions (n, d) for frames with these changes."""
        where = (np.column_stack([said, _size(changes)]) - self.low) / self.unit
        return self.factor * self._local(where)

    def held_out(self, said: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "N d"]:
        """Standard deviations of the presses of the training set, each without its own error."""
        where = (np.column_stack([said, _size(changes)]) - self.low) / self.unit
        return self.factor * self._local(where, own=True)

    def _local(self, where: np.ndarray, *, own: bool = False) -> np.ndarray:
        number = min(_LIKE, len(self.where) - 1)
        near = np.asarray(self._tree.query(where, number + own)[1])[:, int(own) :]
        like = self.squares[near].mean(axis=1)
        everywhere = self.squares.mean(axis=0)
        return np.maximum(np.sqrt((1 - _ALL) * like + _ALL * everywhere), _LEAST * self.unit[: like.shape[1]])

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.where)


def _size(changes: np.ndarray) -> np.ndarray:
    return np.log(np.sqrt(np.mean(changes**2, axis=1)) + 1e-300)


def _factor(ratios: np.ndarray) -> float:
    """The factor by which the coverage of one deviation and of 1.96 is nearest to that of a normal variable."""
    candidates = np.geomspace(0.2, 5, 200)
    missed = [
        max(abs(np.mean(ratios <= times * candidate) - share) for times, share in _SHARES) for candidate in candidates
    ]
    return float(candidates[int(np.argmin(missed))])
