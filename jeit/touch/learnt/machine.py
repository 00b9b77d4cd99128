"""Support vector machines as arrays, with one decision boundary for each pair of classes.

The sums are taken class by class: with thousands of pairs scikit-learn would take a hundredth of a second for one
frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Machine:
    """A support vector machine.

    `support` (S, k): the support vectors sorted by class, those of class c from `start` (C + 1,) c to c + 1; `weights`
    (C - 1, S): their weights for the boundaries with every other class; `intercepts` (P,) of the pairs (0, 1), (0, 2),
    …; and the kernel, (gain x·y + offset)^degree. A linear machine has the boundaries' own `slopes` (P, k).
    """

    support: Float[np.ndarray, "S k"]
    weights: Float[np.ndarray, "D S"]
    start: Int[np.ndarray, " E"]
    intercepts: Float[np.ndarray, " P"]
    gain: float
    offset: float
    degree: int
    slopes: Float[np.ndarray, "P k"] | None
    classes_: np.ndarray

    @classmethod
    def of(cls, machine) -> "Machine":
        """Convert scikit-learn's machine, with a linear or a polynomial kernel."""
        linear = machine.kernel == "linear"
        start = np.concatenate([[0], np.cumsum(machine.n_support_)])
        # Of two classes, positive values mean the second in scikit-learn; of more, the first of each pair.
        sign = -1.0 if len(machine.classes_) == 2 else 1.0
        return cls(
            machine.support_vectors_,
            sign * machine.dual_coef_,
            start,
            sign * machine.intercept_,
            1.0 if linear else float(machine._gamma),
            0.0 if linear else float(machine.coef0),
            1 if linear else int(machine.degree),
            sign * machine.coef_ if linear else None,
            machine.classes_,
        )

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Number of pairwise decisions won by each class (n, C), plus less than a half from the distances."""
        pairs, side = self._borders(features)
        votes = (pairs > 0) @ (side > 0).astype(float) + (pairs <= 0) @ (side < 0).astype(float)
        sure = pairs @ side
        return votes + sure / (3 * (np.abs(sure) + 1))

    def pair_odds(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Sums of the log-probabilities of each class relative to every other (n, C).

        Relative to one other, the probability is 1 / (1 + exp(-2 d)) at a distance d from their boundary, in units of
        its margin. Unlike votes, it is a measure of confidence.
        """
        pairs, side = self._borders(features)
        won, lost = -np.logaddexp(0.0, -2 * pairs), -np.logaddexp(0.0, 2 * pairs)
        return won @ (side > 0).astype(float) + lost @ (side < 0).astype(float)

    def _borders(self, features: np.ndarray) -> tuple[Float[np.ndarray, "n P"], Float[np.ndarray, "P C"]]:
        """Distances from the boundaries of all pairs of classes, and which class is on which side."""
        count = len(self.classes_)
        first, second = np.triu_indices(count, 1)
        if self.slopes is not None:
            pairs = features @ self.slopes.T + self.intercepts
        else:
            kernel = (self.gain * features @ self.support.T + self.offset) ** self.degree
            sums = np.empty((len(features), count - 1, count))
            for one in range(count):
                own = slice(self.start[one], self.start[one + 1])
                sums[:, :, one] = kernel[:, own] @ self.weights[:, own].T
            pairs = sums[:, second - 1, first] + sums[:, first, second] + self.intercepts
        side = np.zeros((len(first), count))
        side[np.arange(len(first)), first], side[np.arange(len(first)), second] = 1.0, -1.0
        return pairs, side
