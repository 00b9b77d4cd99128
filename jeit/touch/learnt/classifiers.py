"""The nine classifiers that Russo et al. (2017) compare, from scikit-learn, and their class probabilities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.touch.learnt.forest import Forest
from jeit.touch.learnt.machine import Machine
from jeit.touch.learnt.nearest import Nearest
from jeit_solvers import number_of_cores

# Of the paper's ensembles: numbers of members, and of leaves of a boosted tree.
_MEMBERS, _LEAVES = 30, 21
# Shrinkage of the covariances of classes with fewer presses than twice the features; and their least variance, relative
# to their greatest.
_SHRUNK, _LEAST = 0.1, 1e-4


def tree(features, label) -> Any:
    """Fit a decision tree."""
    from sklearn.tree import DecisionTreeClassifier

    found = DecisionTreeClassifier(min_samples_leaf=2, random_state=0).fit(features, label)
    return Forest.of_trees([_renumbered(found)], np.ones(1), np.unique(label), votes=False)


def linear_discriminant(features, label) -> Any:
    """Fit a linear discriminant: normal classes with one covariance, with Ledoit-Wolf shrinkage."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    try:
        return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(features, label)
    except np.linalg.LinAlgError:
        # LAPACK's least squares fail on some singular covariances, although they are finite.
        return LinearDiscriminantAnalysis(solver="eigen", shrinkage="auto").fit(features, label)


@dataclass(frozen=True)
class QuadraticDiscriminant:
    """A quadratic discriminant: normal classes with a mean (C, k) and a covariance each.

    `whiten` (C, k, k) is the inverse factor of the covariance, and `offset` (C,) the logarithm of the density at the
    mean and of the class's share (Russo et al. 2017, eq. 1).
    """

    mean: Float[np.ndarray, "C k"]
    whiten: Float[np.ndarray, "C k k"]
    offset: Float[np.ndarray, " C"]
    classes_: np.ndarray

    @classmethod
    def fit(cls, features, label) -> "QuadraticDiscriminant":
        """Fit the classes; covariances are shrunk towards their mean variance where presses are too few for one."""
        classes, number = np.unique(label, return_inverse=True)
        shrunk, size = shrinkage_of(features, label), features.shape[1]
        everywhere = np.mean(np.var(features, axis=0))
        means, whiten, offset = [], [], []
        for one in range(len(classes)):
            own = features[number == one]
            covariance = np.cov(own.T, bias=len(own) < 2).reshape(size, size)
            covariance = (1 - shrunk) * covariance + shrunk * np.trace(covariance) / size * np.eye(size)
            values, axes = np.linalg.eigh(covariance)
            values = np.maximum(values, _LEAST * max(values.max(), _LEAST * everywhere))
            means.append(own.mean(axis=0))
            whiten.append(axes / np.sqrt(values))
            offset.append(np.log(len(own) / len(features)) - 0.5 * np.sum(np.log(values)))
        return cls(np.array(means), np.array(whiten), np.array(offset), classes)

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Logarithms of the densities of the classes, times their shares."""
        found = np.empty((len(features), len(self.offset)))
        for one, (mean, whiten, offset) in enumerate(zip(self.mean, self.whiten, self.offset, strict=True)):
            found[:, one] = offset - 0.5 * np.sum(((features - mean) @ whiten) ** 2, axis=1)
        return found


def linear_svm(features, label) -> Any:
    """Fit a support vector machine with a linear kernel."""
    from sklearn.svm import SVC

    return Machine.of(SVC(kernel="linear").fit(features, label))


def quadratic_svm(features, label) -> Any:
    """Fit a support vector machine with a quadratic kernel."""
    from sklearn.svm import SVC

    return Machine.of(SVC(kernel="poly", degree=2, coef0=1.0).fit(features, label))


def boosted_trees(features, label) -> Any:
    """Fit trees boosted by AdaBoost, with one weighted vote each."""
    from sklearn.ensemble import AdaBoostClassifier
    from sklearn.tree import DecisionTreeClassifier

    one = DecisionTreeClassifier(max_leaf_nodes=_LEAVES, random_state=0)
    found = AdaBoostClassifier(one, n_estimators=_MEMBERS, random_state=0).fit(features, label)
    members, weights = found.estimators_, found.estimator_weights_[: len(found.estimators_)]
    return Forest.of_trees([_renumbered(one, found) for one in members], weights, np.unique(label), votes=True)


def bagged_trees(features, label) -> Any:
    """Fit trees to resampled presses, independently of each other."""
    from joblib import parallel_config
    from sklearn.ensemble import BaggingClassifier
    from sklearn.tree import DecisionTreeClassifier

    bagged = BaggingClassifier(
        DecisionTreeClassifier(random_state=0), _MEMBERS, n_jobs=number_of_cores(), random_state=0
    )
    with parallel_config("threading"):
        found = bagged.fit(features, label)
    weights = np.full(_MEMBERS, 1 / _MEMBERS)
    return Forest.of_trees([_renumbered(one) for one in found.estimators_], weights, np.unique(label), votes=False)


def subspace_discriminant(features, label) -> Any:
    """Fit linear discriminants, each to half of the features."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.ensemble import BaggingClassifier

    one = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    found = BaggingClassifier(one, _MEMBERS, bootstrap=False, max_features=0.5, random_state=0).fit(features, label)
    return LinearEnsemble.of(found, features.shape[1])


@dataclass(frozen=True)
class LinearEnsemble:
    """An ensemble of T linear classifiers, with `weights` (T, C, k) and `intercepts` (T, C), whose probabilities are
    averaged."""

    weights: Float[np.ndarray, "T C k"]
    intercepts: Float[np.ndarray, "T C"]
    classes_: np.ndarray

    @classmethod
    def of(cls, bagged, number: int) -> "LinearEnsemble":
        """Convert scikit-learn's linear discriminants, each on some of `number` features."""
        members = bagged.estimators_
        weights = np.zeros((len(members), len(bagged.classes_), number))
        intercepts = np.zeros(weights.shape[:2])
        for one, some, weight, intercept in zip(members, bagged.estimators_features_, weights, intercepts, strict=True):
            binary = len(one.coef_) == 1  # two classes: the odds of the second
            weight[-1 if binary else slice(None), some] = one.coef_[0] if binary else one.coef_
            intercept[-1 if binary else slice(None)] = one.intercept_[0] if binary else one.intercept_
        return cls(weights, intercepts, bagged.classes_)

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Probabilities of the classes."""
        found = np.zeros((len(features), len(self.classes_)))
        for weight, intercept in zip(self.weights, self.intercepts, strict=True):
            found += probabilities(features @ weight.T + intercept, 1.0)
        return found / len(self.weights)


def _renumbered(tree, among=None):
    """Convert a tree so that its classes are indices of its leaves' shares among all `classes_`."""
    tree.classes_ = np.arange(len(tree.classes_)) if among is None else np.searchsorted(among.classes_, tree.classes_)
    return tree


CLASSIFIERS: dict[str, Callable[..., Any]] = {
    "tree": tree,
    "linear-discriminant": linear_discriminant,
    "quadratic-discriminant": QuadraticDiscriminant.fit,
    "linear-svm": linear_svm,
    "quadratic-svm": quadratic_svm,
    "nearest": Nearest.of_classes,
    "boosted-trees": boosted_trees,
    "bagged-trees": bagged_trees,
    "subspace-discriminant": subspace_discriminant,
}


def shrinkage_of(features, label) -> float:
    """Shrinkage of the covariances of classes, 0 where every class has twice as many presses as features."""
    fewest = np.unique(label, return_counts=True)[1].min()
    return _SHRUNK if fewest < 2 * features.shape[1] else 0.0


def log_odds(model, features) -> Float[np.ndarray, "n C"]:
    """A classifier's scores for each class (n, C).

    They are logarithms of probabilities, alone or relative to every other class, or distances from decision boundaries.
    """
    if hasattr(model, "predict_proba"):
        return np.log(np.maximum(model.predict_proba(features), 1e-6))
    if hasattr(model, "pair_odds"):
        return model.pair_odds(features)
    said = model.decision_function(features)
    return np.column_stack([-said, said]) if said.ndim == 1 else said


def probabilities(odds: np.ndarray, sharpness: float) -> Float[np.ndarray, "n C"]:
    """Probabilities of each class (n, C), from its log-odds times the `sharpness`."""
    scaled = sharpness * odds
    powers = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def sharpness_of(odds: np.ndarray, right: np.ndarray) -> float:
    """The sharpness that maximises the likelihood of held-out presses, of classes `right` (N,)."""
    candidates = np.geomspace(0.02, 50, 60)
    rows = np.arange(len(right))
    likely = [np.mean(np.log(np.maximum(probabilities(odds, one)[rows, right], 1e-9))) for one in candidates]
    return float(candidates[int(np.argmax(likely))])
