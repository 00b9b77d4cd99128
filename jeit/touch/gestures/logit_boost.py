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

# Maximum magnitude of the responses z (Friedman et al. 2000, section 4.2; the value of WEKA); minimum weight of a
# sample; maximum number of times that a step is halved.
_MAX_RESPONSE, _MIN_WEIGHT, _MAX_STEP_HALVINGS = 3.0, 1e-12, 30


class LogitBoostClassifier(ClassifierMixin, BaseEstimator):
    """Multi-class LogitBoost with regression stumps and the defaults of WEKA: 10 rounds, full steps.

    Let p be the current estimate of the probability of a class, and y = 1 for samples of the class, otherwise 0. In
    every round, a stump f_j is fitted for each of the J classes to the responses z = (y − p) / (p (1 − p)), clipped at
    ±3, with the weights w = (y − p) / z, at least 1e-12; without clipping, w = p (1 − p). Then the score F_j grows by
    (J − 1) / J (f_j − mean f), multiplied by the learning rate, and p becomes the softmax of F. Friedman, Hastie and
    Tibshirani, Annals of Statistics 28 (2000) 337, algorithm 6; weights as in WEKA's LogitBoost.

    A small step increases the likelihood of the training set; a full step may be too long and decrease it, but clipping
    makes this rare. A step is therefore halved until the likelihood is not less than before the step. For two classes,
    the method equals the two-class LogitBoost of Friedman et al.

    **Arguments:**

    - `n_estimators`: number of rounds.
    - `learning_rate`: factor by which every step is multiplied.

    **Fields** after `fit`: `classes_` (J,): the classes; `feature_` (rounds, J): feature that each stump compares with
    its threshold; `threshold_` (rounds, J): these thresholds; `below_`, `above_` (rounds, J): values of each stump at
    or below the threshold, and above the threshold, multiplied by the step and by (J − 1) / J, without subtraction of
    their mean over the classes; `step_` (rounds,): factor of the full step of each round; `log_likelihood_` (rounds +
    1,): mean log-likelihood of a sample before the first round and after each round.

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
        self.classes_, class_indices = np.unique(y, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"y has one class only, {describe(self.classes_[0])}; give samples of two or more.")
        class_indicators = np.eye(len(self.classes_))[class_indices]
        class_scores = np.zeros(class_indicators.shape)
        fitted_stumps, boosting_steps, log_likelihoods = [], [], [_log_likelihood(class_scores, class_indices)]
        for _ in range(self.n_estimators):
            round_stumps = _fit_stumps(X, class_indicators, _softmax(class_scores))
            score_increments = _stump_values(X, *round_stumps)
            boosting_step, new_log_likelihood = _largest_step(
                class_scores, score_increments, class_indices, float(self.learning_rate), log_likelihoods[-1]
            )
            class_scores = class_scores + boosting_step * score_increments
            fitted_stumps.append(round_stumps)
            boosting_steps.append(boosting_step)
            log_likelihoods.append(new_log_likelihood)
        split_features, split_thresholds, values_below, values_above = map(np.array, zip(*fitted_stumps, strict=True))
        self.feature_, self.threshold_, self.step_ = (
            split_features.astype(int),
            split_thresholds,
            np.array(boosting_steps),
        )
        self.below_, self.above_ = (self.step_[:, None] * stump_values for stump_values in (values_below, values_above))
        self.log_likelihood_ = np.array(log_likelihoods)
        return self

    def _staged_scores(self, X: Any) -> Iterator[Float[np.ndarray, "n J"]]:
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float32, reset=False)
        class_scores = np.zeros((len(X), len(self.classes_)))
        for split_features, split_thresholds, values_below, values_above in zip(
            self.feature_, self.threshold_, self.below_, self.above_, strict=True
        ):
            class_scores = class_scores + _stump_values(X, split_features, split_thresholds, values_below, values_above)
            yield class_scores

    def staged_decision_function(self, X: Any) -> Iterator[np.ndarray]:
        """Yield the result of `decision_function` after each boosting round."""
        for class_scores in self._staged_scores(X):
            yield class_scores[:, 1] - class_scores[:, 0] if len(self.classes_) == 2 else class_scores

    def staged_predict_proba(self, X: Any) -> Iterator[Float[np.ndarray, "n J"]]:
        """Yield the probabilities (n, J) of `predict_proba` after each boosting round."""
        for class_scores in self._staged_scores(X):
            yield _softmax(class_scores)

    def staged_predict(self, X: Any) -> Iterator[np.ndarray]:
        """Yield the classes (n,) of `predict` after each boosting round."""
        for class_scores in self._staged_scores(X):
            yield self.classes_[class_scores.argmax(axis=1)]

    def decision_function(self, X: Any) -> np.ndarray:
        """Return the scores F (n, J), whose softmax gives the probabilities, for features (n, k); for two classes,
        log-odds F_1 − F_0 (n,)."""
        *_, last_scores = self.staged_decision_function(X)
        return last_scores

    def predict_proba(self, X: Any) -> Float[np.ndarray, "n J"]:
        """Predict the probabilities (n, J) of the classes, in the order of `classes_`."""
        *_, last_probabilities = self.staged_predict_proba(X)
        return last_probabilities

    def predict(self, X: Any) -> np.ndarray:
        """Predict the most probable class (n,) for features (n, k)."""
        *_, last_classes = self.staged_predict(X)
        return last_classes


def _fit_stumps(X: np.ndarray, class_indicators: np.ndarray, class_probabilities: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fit a stump for each class; return features, thresholds, and values below and above the thresholds, each (J,).

    A stump that finds no split is constant, with an infinite threshold.
    """
    class_residuals = class_indicators - class_probabilities
    class_variances = class_probabilities * (1 - class_probabilities)
    working_response = np.clip(
        class_residuals / np.maximum(class_variances, _MIN_WEIGHT), -_MAX_RESPONSE, _MAX_RESPONSE
    )
    working_weights = np.maximum(
        np.where(working_response == 0, 0.0, class_residuals / np.where(working_response == 0, 1.0, working_response)),
        _MIN_WEIGHT,
    )
    working_response = (
        class_residuals / working_weights
    )  # smaller where the weight was raised, so that the gradient is unchanged
    num_classes = class_indicators.shape[1]
    class_stumps = []
    for class_index in range(num_classes):
        stump_tree = (
            DecisionTreeRegressor(max_depth=1, random_state=0)
            .fit(X, working_response[:, class_index], working_weights[:, class_index])
            .tree_
        )
        has_split = stump_tree.node_count > 1
        value_below, value_above = (
            float(stump_tree.value[leaf_node, 0, 0]) for leaf_node in ((1, 2) if has_split else (0, 0))
        )
        feature_and_threshold = (
            (int(stump_tree.feature[0]), float(stump_tree.threshold[0])) if has_split else (0, np.inf)
        )
        class_stumps.append(
            (
                *feature_and_threshold,
                (num_classes - 1) / num_classes * value_below,
                (num_classes - 1) / num_classes * value_above,
            )
        )
    split_features, split_thresholds, value_below, value_above = (
        np.array(stump_column) for stump_column in zip(*class_stumps, strict=True)
    )
    return split_features, split_thresholds, value_below, value_above


def _stump_values(
    X: np.ndarray, split_features, split_thresholds, values_below, values_above
) -> Float[np.ndarray, "n J"]:
    """Return the values (n, J) that the stumps of a round add to the scores F."""
    stump_values = np.where(X[:, split_features] <= split_thresholds, values_below, values_above)
    return stump_values - stump_values.mean(axis=1, keepdims=True)


def _largest_step(
    class_scores, score_increments, class_indices, boosting_step: float, min_log_likelihood: float
) -> tuple[float, float]:
    """Find the largest step of `boosting_step`, `boosting_step` / 2, `boosting_step` / 4 … that keeps the
    log-likelihood at `min_log_likelihood` or above.

    Returns the step, and the log-likelihood of the classes `class_indices` (n,) after it. The step is 0 if the
    remaining gain is below rounding errors.
    """
    for _ in range(_MAX_STEP_HALVINGS):
        log_likelihood = _log_likelihood(class_scores + boosting_step * score_increments, class_indices)
        if log_likelihood >= min_log_likelihood:
            return boosting_step, log_likelihood
        boosting_step /= 2
    return 0.0, min_log_likelihood


def _log_likelihood(class_scores: np.ndarray, class_indices: np.ndarray) -> float:
    """Compute the mean natural log-likelihood of the classes `class_indices` (n,) for the scores (n, J)."""
    shifted_scores = class_scores - class_scores.max(axis=1, keepdims=True)
    return float(
        np.mean(
            shifted_scores[np.arange(len(class_indices)), class_indices] - np.log(np.exp(shifted_scores).sum(axis=1))
        )
    )


def _softmax(class_scores: np.ndarray) -> Float[np.ndarray, "n J"]:
    exponential_scores = np.exp(class_scores - class_scores.max(axis=1, keepdims=True))
    return exponential_scores / exponential_scores.sum(axis=1, keepdims=True)
