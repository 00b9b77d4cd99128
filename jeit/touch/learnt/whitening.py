"""Whiten changes by what varies between frames of the same press: noise, drift, and what is not to be learnt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# The least number of frames that repeat another.
_FEWEST = 20


@dataclass(frozen=True)
class Whitened:
    """Features: changes times `root` (m, m), so that the variation between repeated frames has unit covariance."""

    root: Float[np.ndarray, "m m"]

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N m"], answers: Float[np.ndarray, "N d"]) -> "Whitened":
        """Learn from frames of which some repeat others, that is, have the same answers; shrunk after Ledoit and Wolf
        (2004)."""
        from sklearn.covariance import ledoit_wolf

        scale = np.maximum(changes.std(axis=0), 1e-300)
        group, count = _groups(answers)
        means = np.zeros((len(count), changes.shape[1]))
        np.add.at(means, group, changes / count[group, None])
        left = ((changes - means[group]) / scale)[count[group] > 1]
        if not left.any():
            return cls(np.diag(1 / scale))
        freedom = len(left) - np.sum(count > 1)
        values, vectors = np.linalg.eigh(len(left) / freedom * ledoit_wolf(left, assume_centered=True)[0])
        values = np.maximum(values, 1e-12 * values.max())
        return cls((vectors / np.sqrt(values)) @ vectors.T / scale[:, None])

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Compute the features (n, m) of changes (n, m)."""
        return changes @ self.root

    def deviation(self, values: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
        """The unit of each feature, the same for all."""
        return np.full(values.shape[1], np.sqrt(np.mean(values.var(axis=0))))


def are_repeated(answers: Float[np.ndarray, "N d"]) -> bool:
    """Whether enough frames repeat others for their noise to be estimated."""
    return int(np.sum(_groups(answers)[1] - 1)) >= _FEWEST


def _groups(answers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group numbers (N,) of frames, one for each answer, and the size of each group."""
    group, count = np.unique(answers, axis=0, return_inverse=True, return_counts=True)[1:]
    return group.ravel(), count
