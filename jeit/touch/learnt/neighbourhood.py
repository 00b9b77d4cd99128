"""How far a frame is from all that were learnt from: two touches at once, or one of the other sign, are made of the
same patterns, but like no press that was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

# Scores looked at, presses kept, and of the usual size, below which distances are not relative to the frame's own.
_SCORES, _MOST, _SMALL = 8, 4000, 0.5
_QUANTILE = 0.99


@dataclass(frozen=True)
class Neighbourhood:
    """Leading `scores` (N, k) of presses, their usual `size`, and the distance from one to the next, relative to its
    size, that is `usual`: that of all but a hundredth is less."""

    scores: Float[np.ndarray, "N k"]
    size: float
    usual: float

    @classmethod
    def learn(cls, scores: Float[np.ndarray, "N K"]) -> "Neighbourhood":
        """From scores of presses (N, K)."""
        kept = scores[:: -(-len(scores) // _MOST), :_SCORES]
        size = float(np.median(np.linalg.norm(kept, axis=1))) or 1.0
        found = cls(kept, size, 1.0)
        apart = found._relative(kept, second=True)
        return cls(kept, size, max(float(np.quantile(apart, _QUANTILE)), 1e-6))

    def __call__(self, scores: Float[np.ndarray, "n K"]) -> Float[np.ndarray, " n"]:
        """Relative distances (n,) of frames with these scores, 1 for the farthest of those learnt from."""
        return self._relative(scores[:, :_SCORES]) / self.usual

    def _relative(self, scores: np.ndarray, *, second: bool = False) -> np.ndarray:
        distance = np.asarray(self._tree.query(scores, 2)[0])[:, int(second)]
        return distance / (np.linalg.norm(scores, axis=1) + _SMALL * self.size)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.scores)
