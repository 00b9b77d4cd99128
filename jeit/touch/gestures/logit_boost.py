"""LogitBoost: additive logistic regression with decision stumps, as an estimator of scikit-learn."""

from __future__ import annotations

from collections.abc import Iterator
from numbers import Integral, Real
from typing import Any

import numpy as np
from jaxtyping import Float
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.tree import DecisionTreeRegressor
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from jeit.arguments import describe

# Maximum magnitude of responses (Friedman et al. 2000, section 4.2; the value of WEKA); minimum weight; maximum number
# of times that a step is halved.
_MOST_RESPONSE, _LEAST_WEIGHT, _MOST_HALVINGS = 3.0, 1e-12, 30


class LogitBoostClassifier(ClassifierMixin, BaseEstimator):
    """Multi-class LogitBoost with regression stumps and the defaults of WEKA: 10 rounds, full steps.

    Let p be the current probability of a class, and y = 1 for samples of the class, otherwise 0. In every round, a
    stump f_j is fitted for each of the J classes to the responses z = (y − p) / (p (1 − p)), clipped at ±3, with the
    weights w = (y − p) / z, at least 1e-12; without clipping, w = p (1 − p). Then the score F_j grows by (J − 1) / J
    (f_j − mean f), multiplied by the learning rate, and p becomes the softmax of F. Friedman, Hastie and Tibshirani,
    Annals of Statistics 28 (2000) 337, algorithm 6; weights as in WEKA's LogitBoost.

    A small step increases the likelihood of the training set, but a full step may be too long, although clipping makes
    this rare. A step is therefore halved until the likelihood is at least that before it. For two classes, the method
    equals the two-class LogitBoost of that paper.

    **Arguments:**

    - `n_estimators`: number of rounds.
    - `learning_rate`: factor of every step.

    **Fields** after `fit`: `classes_` (J,): the classes; `feature_` (rounds, J): feature that each stump compares;
    `threshold_`: threshold of each stump; `below_`, `above_` (rounds, J): values at or below the threshold and above
    it, multiplied by the step and by (J − 1) / J, before their mean over the classes is subtracted; `step_` (rounds,):
    step of each round; `log_likelihood_` (rounds + 1,): mean log-likelihood of a sample before the first round and
    after each round.

    **Example:**

    ```python
    features, classes = np.random.default_rng(0).normal(size=(40, 3)), np.arange(40) % 2
    classifier = LogitBoostClassifier(20, learning_rate=0.5).fit(features, classes)
    ```
    """

    def __init__(self, n_estimators: int = 10, *, learning_rate: float = 1.0):
        self.n_estimators = n_estimators
        self.learning_rate = learning_rate

    def fit(self, X: Any, y: Any) -> "LogitBoostClassifier":
        """Fit the classifier to features X (n, k) and classes y (n,).

        Raises `ValueError` for a single class, values that are not finite, different numbers of samples in X and y, and
        invalid `n_estimators` or `learning_rate`.
        """
        if not (isinstance(self.n_estimators, Integral) and self.n_estimators >= 1):
            raise ValueError(
                f"n_estimators must be a number of rounds, 1 or more; it is {describe(self.n_estimators)}."
            )
        if not (isinstance(self.learning_rate, Real) and 0 < self.learning_rate <= 1):
            raise ValueError(f"learning_rate must be above 0, and 1 at most; it is {describe(self.learning_rate)}.")
        # scikit-learn's trees split samples in single precision.
        X, y = validate_data(self, X, y, dtype=np.float32)
        check_classification_targets(y)
        self.classes_, number = np.unique(y, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"y has one class only, {describe(self.classes_[0])}; give samples of two or more.")
        right = np.eye(len(self.classes_))[number]
        score = np.zeros(right.shape)
        stumps, steps, likelihood = [], [], [_log_likelihood(score, number)]
        for _ in range(self.n_estimators):
            stump = _fit_stumps(X, right, _softmax(score))
            gained = _stump_values(X, *stump)
            step, found = _largest_step(score, gained, number, float(self.learning_rate), likelihood[-1])
            score = score + step * gained
            stumps.append(stump)
            steps.append(step)
            likelihood.append(found)
        feature, threshold, below, above = map(np.array, zip(*stumps, strict=True))
        self.feature_, self.threshold_, self.step_ = feature.astype(int), threshold, np.array(steps)
        self.below_, self.above_ = (self.step_[:, None] * one for one in (below, above))
        self.log_likelihood_ = np.array(likelihood)
        return self

    def _staged_scores(self, X: Any) -> Iterator[Float[np.ndarray, "n J"]]:
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float32, reset=False)
        score = np.zeros((len(X), len(self.classes_)))
        for feature, threshold, below, above in zip(
            self.feature_, self.threshold_, self.below_, self.above_, strict=True
        ):
            score = score + _stump_values(X, feature, threshold, below, above)
            yield score

    def staged_decision_function(self, X: Any) -> Iterator[np.ndarray]:
        """Yield `decision_function` after each round."""
        for score in self._staged_scores(X):
            yield score[:, 1] - score[:, 0] if len(self.classes_) == 2 else score

    def staged_predict_proba(self, X: Any) -> Iterator[Float[np.ndarray, "n J"]]:
        """Yield `predict_proba` after each round."""
        for score in self._staged_scores(X):
            yield _softmax(score)

    def staged_predict(self, X: Any) -> Iterator[np.ndarray]:
        """Yield `predict` after each round."""
        for score in self._staged_scores(X):
            yield self.classes_[score.argmax(axis=1)]

    def decision_function(self, X: Any) -> np.ndarray:
        """Scores F (n, J), whose softmax gives the probabilities, for features (n, k); for two classes, log-odds F_1 −
        F_0 (n,)."""
        *_, last = self.staged_decision_function(X)
        return last

    def predict_proba(self, X: Any) -> Float[np.ndarray, "n J"]:
        """Probabilities (n, J) of the classes, in the order of `classes_`."""
        *_, last = self.staged_predict_proba(X)
        return last

    def predict(self, X: Any) -> np.ndarray:
        """Most probable class (n,) for features (n, k)."""
        *_, last = self.staged_predict(X)
        return last


def _fit_stumps(X: np.ndarray, class_indicators: np.ndarray, probability: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fit a stump for each class; returns features, thresholds, and values below and above the thresholds, each (J,).

    A stump that finds no split is constant, with an infinite threshold.
    """
    off = class_indicators - probability
    variance = probability * (1 - probability)
    response = np.clip(off / np.maximum(variance, _LEAST_WEIGHT), -_MOST_RESPONSE, _MOST_RESPONSE)
    weight = np.maximum(np.where(response == 0, 0.0, off / np.where(response == 0, 1.0, response)), _LEAST_WEIGHT)
    response = off / weight  # smaller where the weight was raised, to keep the gradient
    number = class_indicators.shape[1]
    found = []
    for one in range(number):
        tree = DecisionTreeRegressor(max_depth=1, random_state=0).fit(X, response[:, one], weight[:, one]).tree_
        parted = tree.node_count > 1
        below, above = (float(tree.value[node, 0, 0]) for node in ((1, 2) if parted else (0, 0)))
        place = (int(tree.feature[0]), float(tree.threshold[0])) if parted else (0, np.inf)
        found.append((*place, (number - 1) / number * below, (number - 1) / number * above))
    feature, threshold, below, above = (np.array(one) for one in zip(*found, strict=True))
    return feature, threshold, below, above


def _stump_values(X: np.ndarray, feature, threshold, below, above) -> Float[np.ndarray, "n J"]:
    """Values (n, J) that the stumps of a round add to F."""
    said = np.where(X[:, feature] <= threshold, below, above)
    return said - said.mean(axis=1, keepdims=True)


def _largest_step(score, increments, class_indices, step: float, least_likelihood: float) -> tuple[float, float]:
    """Find the largest step of `step`, `step` / 2, `step` / 4 … that keeps the log-likelihood at `least_likelihood` or
    above.

    Returns the step, and the log-likelihood of the classes `class_indices` (n,) after it. The step is 0 if the
    remaining gain is below rounding errors.
    """
    for _ in range(_MOST_HALVINGS):
        found = _log_likelihood(score + step * increments, class_indices)
        if found >= least_likelihood:
            return step, found
        step /= 2
    return 0.0, least_likelihood


def _log_likelihood(score: np.ndarray, class_indices: np.ndarray) -> float:
    """Mean natural log-likelihood of the classes `class_indices` (n,) for the scores (n, J)."""
    shifted = score - score.max(axis=1, keepdims=True)
    return float(np.mean(shifted[np.arange(len(class_indices)), class_indices] - np.log(np.exp(shifted).sum(axis=1))))


def _softmax(score: np.ndarray) -> Float[np.ndarray, "n J"]:
    powers = np.exp(score - score.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)
