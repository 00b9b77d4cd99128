"""Measure how far a frame is from all presses of the training set.

Two touches at once, or one of the opposite sign, are made of the same patterns, but are unlike any recorded press.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

# The number of scores used, the greatest number of presses kept, and the share of the usual size that is added to the
# size that distances are relative to.
_SCORES, _MOST, _SMALL = 8, 4000, 0.5
_QUANTILE = 0.99


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
        kept = scores[:: -(-len(scores) // _MOST), :_SCORES]
        size = float(np.median(np.linalg.norm(kept, axis=1))) or 1.0
        found = cls(kept, size, 1.0)
        apart = found._relative(kept, second=True)
        return cls(kept, size, max(float(np.quantile(apart, _QUANTILE)), 1e-6))

    def __call__(self, scores: Float[np.ndarray, "n K"]) -> Float[np.ndarray, " n"]:
        """Relative distances (n,) of frames with these scores, 1 at the `usual` distance."""
        return self._relative(scores[:, :_SCORES]) / self.usual

    def _relative(self, scores: np.ndarray, *, second: bool = False) -> np.ndarray:
        distance = np.asarray(self._tree.query(scores, 2)[0])[:, int(second)]
        return distance / (np.linalg.norm(scores, axis=1) + _SMALL * self.size)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.scores)
