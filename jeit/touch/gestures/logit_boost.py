"""LogitBoost: additive logistic regression by stumps, with the interface of scikit-learn's estimators."""

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

# The bound of responses (Friedman et al. 2000, section 4.2; WEKA's); the least weight; the greatest number of times
# that a step is halved.
_MOST_RESPONSE, _LEAST_WEIGHT, _MOST_HALVINGS = 3.0, 1e-12, 30


class LogitBoostClassifier(ClassifierMixin, BaseEstimator):
    """Multi-class LogitBoost by regression stumps, with the defaults of WEKA: 10 rounds, full steps.

    In every round, for each class j of J, with p the probabilities so far and y 1 for what is of the class, else 0, a
    stump f is fitted to the responses z = (y − p) / (p (1 − p)), clipped at ±3, with weights w = (y − p) / z, which are
    p (1 − p) where nothing was clipped, and no less than 1e-12. Then F_j grows by (J − 1) / J (f_j − mean f), times
    `learning_rate`, and p is the softmax of F. Friedman, Hastie and Tibshirani, Annals of Statistics 28 (2000) 337,
    algorithm 6; weights as in WEKA's LogitBoost.

    A step goes uphill in the likelihood of what is learnt, but a full one may go too far, which clipping all but rules
    out: it is halved until the likelihood is no less than before, so that this never falls. For two classes this is
    their own LogitBoost.

    **Fields** once it is learnt: `classes_` (J,); of the stumps (rounds, J) each one's `feature_`, `threshold_`, where
    it parts, and `below_` and `above_`, its answers at or below that and above, times the step and (J − 1) / J, from
    which their mean over the classes is yet to be taken; `step_` (rounds,), of each round; `log_likelihood_`
    (rounds + 1,), of a sample, on average, before and after each.
    """

    def __init__(self, n_estimators: int = 10, *, learning_rate: float = 1.0):
        self.n_estimators = n_estimators
        self.learning_rate = learning_rate

    def fit(self, X: Any, y: Any) -> "LogitBoostClassifier":
        """Learn the classes y (n,) of features X (n, k).

        Raises `ValueError` for one class alone, values that are not finite, numbers of samples that do not match, and
        rounds and rates that are none.
        """
        if not (isinstance(self.n_estimators, Integral) and self.n_estimators >= 1):
            raise ValueError(
                f"n_estimators must be a number of rounds, 1 or more; it is {describe(self.n_estimators)}."
            )
        if not (isinstance(self.learning_rate, Real) and 0 < self.learning_rate <= 1):
            raise ValueError(f"learning_rate must be above 0, and 1 at most; it is {describe(self.learning_rate)}.")
        # Single precision, in which scikit-learn's trees part samples.
        X, y = validate_data(self, X, y, dtype=np.float32)
        check_classification_targets(y)
        self.classes_, number = np.unique(y, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"y has one class only, {describe(self.classes_[0])}; give samples of two or more.")
        right = np.eye(len(self.classes_))[number]
        score = np.zeros(right.shape)
        stumps, steps, likelihood = [], [], [_log_likelihood(score, number)]
        for _ in range(self.n_estimators):
            stump = _stumps(X, right, _softmax(score))
            gained = _answers(X, *stump)
            step, found = _uphill(score, gained, number, float(self.learning_rate), likelihood[-1])
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
            score = score + _answers(X, feature, threshold, below, above)
            yield score

    def staged_decision_function(self, X: Any) -> Iterator[np.ndarray]:
        """`decision_function` after each round in turn."""
        for score in self._staged_scores(X):
            yield score[:, 1] - score[:, 0] if len(self.classes_) == 2 else score

    def staged_predict_proba(self, X: Any) -> Iterator[Float[np.ndarray, "n J"]]:
        """`predict_proba` after each round in turn."""
        for score in self._staged_scores(X):
            yield _softmax(score)

    def staged_predict(self, X: Any) -> Iterator[np.ndarray]:
        """`predict` after each round in turn."""
        for score in self._staged_scores(X):
            yield self.classes_[score.argmax(axis=1)]

    def decision_function(self, X: Any) -> np.ndarray:
        """F (n, J) of features (n, k), whose softmax are the probabilities; of two classes F_1 − F_0 (n,), the
        logarithm of their odds."""
        *_, last = self.staged_decision_function(X)
        return last

    def predict_proba(self, X: Any) -> Float[np.ndarray, "n J"]:
        """Probabilities (n, J) of the classes, in the order of `classes_`."""
        *_, last = self.staged_predict_proba(X)
        return last

    def predict(self, X: Any) -> np.ndarray:
        """The likeliest class (n,) of features (n, k)."""
        *_, last = self.staged_predict(X)
        return last


def _stumps(X: np.ndarray, right: np.ndarray, probability: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fit a stump for each class: feature, threshold, and answers below and above it (J,); constant without a split."""
    off = right - probability
    variance = probability * (1 - probability)
    response = np.clip(off / np.maximum(variance, _LEAST_WEIGHT), -_MOST_RESPONSE, _MOST_RESPONSE)
    weight = np.maximum(np.where(response == 0, 0.0, off / np.where(response == 0, 1.0, response)), _LEAST_WEIGHT)
    response = off / weight  # where the weight is the least one, less: the likelihood's slope stays what it is
    number = right.shape[1]
    found = []
    for one in range(number):
        tree = DecisionTreeRegressor(max_depth=1, random_state=0).fit(X, response[:, one], weight[:, one]).tree_
        parted = tree.node_count > 1
        below, above = (float(tree.value[node, 0, 0]) for node in ((1, 2) if parted else (0, 0)))
        place = (int(tree.feature[0]), float(tree.threshold[0])) if parted else (0, np.inf)
        found.append((*place, (number - 1) / number * below, (number - 1) / number * above))
    feature, threshold, below, above = (np.array(one) for one in zip(*found, strict=True))
    return feature, threshold, below, above


def _answers(X: np.ndarray, feature, threshold, below, above) -> Float[np.ndarray, "n J"]:
    """Values that the stumps of a round add to F."""
    said = np.where(X[:, feature] <= threshold, below, above)
    return said - said.mean(axis=1, keepdims=True)


def _uphill(score, gained, number, step: float, before: float) -> tuple[float, float]:
    """The largest step of full, half, quarter … ones that does not lower the log-likelihood below `before`.

    Returns the step, and the log-likelihood of the classes `number` (n,) after it; 0 where all that remains to gain is
    rounding.
    """
    for _ in range(_MOST_HALVINGS):
        found = _log_likelihood(score + step * gained, number)
        if found >= before:
            return step, found
        step /= 2
    return 0.0, before


def _log_likelihood(score: np.ndarray, number: np.ndarray) -> float:
    """Mean log-likelihood of a sample, natural."""
    shifted = score - score.max(axis=1, keepdims=True)
    return float(np.mean(shifted[np.arange(len(number)), number] - np.log(np.exp(shifted).sum(axis=1))))


def _softmax(score: np.ndarray) -> Float[np.ndarray, "n J"]:
    powers = np.exp(score - score.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)
