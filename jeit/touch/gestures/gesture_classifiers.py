"""Classifiers of gestures: functions that fit classifiers, by name, and cross-validation of classifiers."""

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
from jeit.touch.learnt.methods import CLASSIFIERS, log_odds
from jeit.touch.learnt.neural_networks import TemporalNetwork
from jeit.touch.learnt.resource_limits import apply_over_folds


def fit_logit_boost(features: Float[np.ndarray, "n k"], label: np.ndarray) -> Forest:
    """Fit LogitBoost to touch features (n, k), as Silvera Tawil et al. (2011) do, and convert the classifier to a
    forest, which predicts faster."""
    from jeit.touch.gestures.logit_boost import LogitBoostClassifier

    return Forest.from_stumps(LogitBoostClassifier().fit(features, label))


def fit_temporal_network(features: Float[np.ndarray, "n k"], label: np.ndarray) -> TemporalNetwork:
    """Fit a small neural network to features computed by `sequence_features`."""
    return TemporalNetwork.fit(features, label, whole=len(COURSE_FEATURES), values=len(SEQUENCE_VALUES))


GESTURE_CLASSIFIERS: dict[str, Callable[..., Any]] = {
    "logit-boost": fit_logit_boost,
    **CLASSIFIERS,
    "temporal-network": fit_temporal_network,
}
"""Functions that fit classifiers, by name: LogitBoost, the nine classifiers of learnt skins, and a network for the time
course."""

FEATURE_FORMS: dict[str, Callable[..., Any]] = {
    "seven": touch_features,
    "course": course_features,
    "sequence": sequence_features,
}
"""Functions that compute features of touches, by name: the seven features; these and features of the time course; both
and the sampled time course."""


def feature_forms(method: str) -> tuple[str, ...]:
    """Return the names in `FEATURE_FORMS` of the sets of features that the classifier `method` can be fitted to."""
    return ("sequence",) if method == "temporal-network" else ("seven", "course")


@dataclass(frozen=True)
class Scale:
    """Transform of features x to a common scale: (sign(x) log(1 + |x| / size) − mean) / deviation.

    **Fields**: `size` (k,): scale of each feature; `mean` (k,), `deviation` (k,): mean and standard deviation of
    sign(x) log(1 + |x| / size).
    """

    size: Float[np.ndarray, " k"]
    mean: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]

    @classmethod
    def from_features(cls, values: Float[np.ndarray, "n k"]) -> "Scale":
        """Estimate the transform from features (n, k); `size` is the median of |x|. Constant features become zero."""
        median_magnitudes = np.median(np.abs(values), axis=0)
        median_magnitudes = np.where(
            median_magnitudes > 0, median_magnitudes, np.maximum(np.abs(values).max(axis=0), 1e-300)
        )
        log_values = np.sign(values) * np.log1p(np.abs(values) / median_magnitudes)
        log_deviations = log_values.std(axis=0)
        return cls(median_magnitudes, log_values.mean(axis=0), np.where(log_deviations > 1e-12, log_deviations, 1.0))

    def __call__(self, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Transform features (n, k) to the common scale."""
        return (np.sign(values) * np.log1p(np.abs(values) / self.size) - self.mean) / self.deviation


def held_out_odds(
    method: str, features: Float[np.ndarray, "n k"], true_classes: Int[np.ndarray, " n"], folds: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n C"]:
    """Compute log-odds (n, C) of the classes of n touches by cross-validation.

    The touches of each fold are classified by the classifier `method`, fitted to all other folds. `features` (n, k): k
    features of each touch; `true_classes` (n,): true classes, 0 … C − 1; `folds` (n,): number of the fold of each
    touch. The log-odds are computed by `log_odds`; they are −1000 for a class that occurs in no other fold. Raises
    `ValueError` if the other folds contain only one class.
    """
    class_log_odds = np.full((len(true_classes), true_classes.max() + 1), -1e3)

    def predict_fold(fold: int) -> None:
        is_held_out = folds == fold
        if len(np.unique(true_classes[~is_held_out])) < 2:
            raise ValueError(
                "labels: without the touches of one fold, or person, only one gesture remains; give touches of more."
            )
        feature_scale = Scale.from_features(features[~is_held_out])
        fold_classifier = GESTURE_CLASSIFIERS[method](feature_scale(features[~is_held_out]), true_classes[~is_held_out])
        class_log_odds[np.ix_(is_held_out, fold_classifier.classes_)] = log_odds(
            fold_classifier, feature_scale(features[is_held_out])
        )

    apply_over_folds(predict_fold, int(folds.max()) + 1)
    return class_log_odds


def random_folds(true_classes: np.ndarray, num_folds: int, seed: int = 0) -> Int[np.ndarray, " n"]:
    """Assign touches to `num_folds` folds at random, with the touches of each class spread evenly.

    Returns the number of the fold of each touch (n,). If there are fewer touches than `num_folds`, each touch is a
    fold.
    """
    rng = np.random.default_rng(seed)
    folds, num_assigned_rows = np.empty(len(true_classes), int), 0
    for class_index in np.unique(true_classes):
        rows_of_class = rng.permutation(np.flatnonzero(true_classes == class_index))
        folds[rows_of_class] = (num_assigned_rows + np.arange(len(rows_of_class))) % num_folds
        num_assigned_rows += len(rows_of_class)
    return np.unique(folds, return_inverse=True)[1]


def person_folds(people: np.ndarray, max_folds: int | None = None) -> Int[np.ndarray, " n"]:
    """Assign touches to folds (n,): one fold for each person, or at most `max_folds` folds with equally many people
    each."""
    person_indices = np.unique(people, return_inverse=True)[1].ravel()
    return person_indices if max_folds is None else person_indices % max_folds
