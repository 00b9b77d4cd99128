"""Nearest-neighbour prediction by plain products: on busy cores scikit-learn's threads take 30 ms for some frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from jeit.touch.learnt.extras import in_parts

# The number of frames whose distances from all presses are computed at once.
_AT_ONCE = 128
_COUNTS = (3, 5, 8, 12)


@dataclass(frozen=True)
class Nearest:
    """Mean of the known values of the `count` presses whose `features` (N, k) are nearest, weighted by inverse
    distance.

    `known` (N, d): numbers, or 1 for the class of each; `classes_` (d,).
    """

    features: Float[np.ndarray, "N k"]
    known: Float[np.ndarray, "N d"]
    count: int
    classes_: np.ndarray

    @classmethod
    def of_numbers(cls, features, targets) -> "Nearest":
        """Learn targets (N, d), with the count that has the least leave-one-out error."""
        count = min(max(_COUNTS), len(features) - 1)
        every = cls(features, targets, count + 1, np.arange(targets.shape[1]))
        distance, number = (one[:, 1:] for one in every._near(features))
        weight = 1 / np.maximum(distance, 1e-12)[..., None]
        means = np.cumsum(weight * targets[number], axis=1) / np.cumsum(weight, axis=1)
        off = np.linalg.norm(means - targets[:, None], axis=-1).mean(axis=0)
        best = min([one for one in _COUNTS if one <= count] or [count], key=lambda one: off[one - 1])
        return cls(features, targets, best, every.classes_)

    @classmethod
    def of_classes(cls, features, label) -> "Nearest":
        """Learn classes, with the single nearest press."""
        classes = np.unique(label)
        return cls(features, (np.asarray(label)[:, None] == classes).astype(float), 1, classes)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict means (n, d)."""
        distance, number = self._near(features)
        weight = 1 / np.maximum(distance, 1e-12)
        return np.einsum("nc,ncd->nd", weight / weight.sum(axis=1, keepdims=True), self.known[number])

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Predict shares of the classes (n, C)."""
        return self.predict(features)

    def _near(self, features: np.ndarray) -> tuple[Float[np.ndarray, "n c"], Int[np.ndarray, "n c"]]:
        """Distances of the nearest presses, the nearest first, and their numbers."""

        def near(some: np.ndarray) -> np.ndarray:
            squared = (-2 * some) @ self.features.T
            squared += self._squares  # without the frame's own square, which is the same for all
            number = np.argpartition(squared, self.count - 1, axis=1)[:, : self.count]
            apart = np.linalg.norm(self.features[number] - some[:, None], axis=2)
            order = np.argsort(apart, axis=1, kind="stable")
            return np.stack([np.take_along_axis(one, order, axis=1) for one in (apart, number)], axis=-1)

        found = in_parts(near, features, _AT_ONCE)
        return found[..., 0], found[..., 1].astype(int)

    @cached_property
    def _squares(self) -> Float[np.ndarray, " N"]:
        """|x|² of every press's features."""
        return np.sum(self.features**2, axis=1)
