"""Classifiers of gestures by name, and their cross-validation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jeit.touch.gestures.features import (
    COURSE_FEATURES,
    SEQUENCE_VALUES,
    course_features,
    sequence_features,
    touch_features,
)
from jeit.touch.learnt.array_models import Forest
from jeit.touch.learnt.extras import over_folds
from jeit.touch.learnt.methods import CLASSIFIERS, log_odds
from jeit.touch.learnt.temporal_network import TemporalNetwork


def logit_boost(features: Float[np.ndarray, "n k"], label: np.ndarray) -> Forest:
    """Fit LogitBoost as in the paper, `LogitBoostClassifier()`, converted to a forest, which is faster to evaluate."""
    from jeit.touch.gestures.logit_boost import LogitBoostClassifier

    return Forest.of_stumps(LogitBoostClassifier().fit(features, label))


def temporal_network(features: Float[np.ndarray, "n k"], label: np.ndarray) -> TemporalNetwork:
    """Fit a small network to the course of touches, with features from `sequence_features`."""
    return TemporalNetwork.fit(features, label, whole=len(COURSE_FEATURES), values=len(SEQUENCE_VALUES))


GESTURE_CLASSIFIERS: dict[str, Callable[..., Any]] = {
    "logit-boost": logit_boost,
    **CLASSIFIERS,
    "temporal-network": temporal_network,
}
"""Classifiers by name: the paper's, the nine of learnt skins, and a network on the course."""

FORMS: dict[str, Callable[..., Any]] = {
    "seven": touch_features,
    "course": course_features,
    "sequence": sequence_features,
}
"""Forms of features of a touch: the paper's seven, those and more of its course, or all of the course."""


def forms_of(method: str) -> tuple[str, ...]:
    """The forms of features that a classifier takes, of those in `FORMS`."""
    return ("sequence",) if method == "temporal-network" else ("seven", "course")


@dataclass(frozen=True)
class Scale:
    """A common scale of features: sign(x) log(1 + |x| / size), less its `mean`, over its `deviation`, all (k,)."""

    size: Float[np.ndarray, " k"]
    mean: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n k"]) -> "Scale":
        """Learn the scale from features (n, k), with `size` the median of |x|; constant features become zero."""
        size = np.median(np.abs(values), axis=0)
        size = np.where(size > 0, size, np.maximum(np.abs(values).max(axis=0), 1e-300))
        logs = np.sign(values) * np.log1p(np.abs(values) / size)
        deviation = logs.std(axis=0)
        return cls(size, logs.mean(axis=0), np.where(deviation > 1e-12, deviation, 1.0))

    def __call__(self, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Scale features."""
        return (np.sign(values) * np.log1p(np.abs(values) / self.size) - self.mean) / self.deviation


def held_out_odds(
    method: str, values: Float[np.ndarray, "n k"], right: Int[np.ndarray, " n"], folds: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n C"]:
    """Log-odds of each class (n, C) of touches, from a classifier that is fitted to all other folds.

    As `log_odds`, of features (n, k) of classes `right` (n,), 0 … C − 1; a class that the other folds lack has next to
    none. Raises `ValueError` where they have one class alone.
    """
    odds = np.full((len(right), right.max() + 1), -1e3)

    def predict(fold: int) -> None:
        out = folds == fold
        if len(np.unique(right[~out])) < 2:
            raise ValueError("labels: but for one fold, or person, there is one gesture only; give touches of more.")
        scale = Scale.of(values[~out])
        model = GESTURE_CLASSIFIERS[method](scale(values[~out]), right[~out])
        odds[np.ix_(out, model.classes_)] = log_odds(model, scale(values[out]))

    over_folds(predict, int(folds.max()) + 1)
    return odds


def random_folds(right: np.ndarray, number: int, seed: int = 0) -> Int[np.ndarray, " n"]:
    """Assign touches to folds (n,) at random, each class evenly; fewer than `number` folds where there are fewer
    touches."""
    rng = np.random.default_rng(seed)
    fold, first = np.empty(len(right), int), 0
    for one in np.unique(right):
        own = rng.permutation(np.flatnonzero(right == one))
        fold[own] = (first + np.arange(len(own))) % number
        first += len(own)
    return np.unique(fold, return_inverse=True)[1]


def person_folds(people: np.ndarray, most: int | None = None) -> Int[np.ndarray, " n"]:
    """Assign touches to folds (n,): one for each person, or `most`, each of as many people."""
    number = np.unique(people, return_inverse=True)[1].ravel()
    return number if most is None else number % most
