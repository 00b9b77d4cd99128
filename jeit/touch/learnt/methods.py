"""Methods of learnt skins: regressors of places and forces, and classifiers of labels.

Regressors of numbers, places or forces, from features, and the Gaussian process among them.

Each takes features (N, k) and standardised targets (N, d), and returns an object with `predict(features)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from jeit.touch.kohonen.placed_map import PlacedMap
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap
from jeit.touch.kohonen.training import Schedule
from jeit.touch.learnt.array_models import Forest, Machine, Nearest
from jeit.touch.learnt.extras import in_parts
from jeit.touch.learnt.network import Network
from jeit_solvers import number_of_cores

# The number of presses from which length and noise are estimated; the greatest number of centres (all presses, if there
# are no more).
_TUNED_ON, _CENTRES = 400, 640
_AT_ONCE = 512


@dataclass(frozen=True)
class GaussianProcess:
    """A Gaussian process: Σ `weights` (m, d) × kernel of the distance from `centres` (m, k), in `length`s.

    The kernel is Matérn's of order 3/2, (1 + √3 r) e^(−√3 r). Length and noise maximise the marginal likelihood,
    Rasmussen and Williams (2006), eq. 5.8; where there are fewer centres than presses, the method is the subset of
    regressors, section 8.3.1.
    """

    centres: Float[np.ndarray, "m k"]
    weights: Float[np.ndarray, "m d"]
    length: float

    @classmethod
    def fit(cls, features, targets) -> "GaussianProcess":
        """Fit standardised `targets` (N, d) to `features` (N, k)."""
        order = np.random.default_rng(0).permutation(len(features))
        some = order[:_TUNED_ON]
        length, noise = _tuned(features[some], targets[some])
        chosen = np.sort(order[:_CENTRES])
        centres = features[chosen]
        among = _kernel(cdist(centres, centres) / length)
        if len(centres) == len(features):
            matrix, load = among + noise * np.eye(len(among)), targets[chosen]
        else:
            across = _kernel(cdist(features, centres) / length)
            matrix, load = across.T @ across + noise * among, across.T @ targets
            matrix += 1e-8 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
        return cls(centres, cho_solve(cho_factor(matrix), load), length)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (n, d)."""
        scaled = self.centres / self.length
        squares = np.sum(scaled**2, axis=1)

        def means(some: np.ndarray) -> np.ndarray:
            some = some / self.length
            squared = np.sum(some**2, axis=1)[:, None] + squares - 2 * some @ scaled.T
            return _kernel(np.sqrt(np.maximum(squared, 0.0))) @ self.weights

        return in_parts(means, features, _AT_ONCE)


def _kernel(distance: np.ndarray) -> np.ndarray:
    scaled = np.sqrt(3.0) * distance
    return (1 + scaled) * np.exp(-scaled)


def _tuned(features: np.ndarray, targets: np.ndarray) -> tuple[float, float]:
    """Estimate the length, and the ratio of the noise's variance to that of the function, whose own variance is solved
    for."""
    apart = cdist(features, features)
    usual = float(np.sqrt(np.mean(apart**2))) or 1.0

    def unlikelihood(logs: np.ndarray) -> float:
        matrix = _kernel(apart / (usual * np.exp(logs[0]))) + np.exp(logs[1]) * np.eye(len(apart))
        try:
            factor = cho_factor(matrix, lower=True)
        except np.linalg.LinAlgError:
            return 1e12
        size = np.mean(np.sum(targets * cho_solve(factor, targets), axis=0) / len(targets))
        return float(2 * np.sum(np.log(np.diag(factor[0]))) + len(targets) * np.log(max(size, 1e-300)))

    bounds = [(np.log(0.05), np.log(50.0)), (np.log(1e-6), np.log(1e3))]
    starts = [(0.5, np.log(0.05)), (2.0, np.log(0.3))]
    tuned = min(
        (
            minimize(unlikelihood, start, method="Nelder-Mead", bounds=bounds, options={"maxfev": 60})
            for start in starts
        ),
        key=lambda found: found.fun,
    )
    return usual * float(np.exp(tuned.x[0])), float(np.exp(tuned.x[1]))


_ALPHAS = np.logspace(-2, 5, 15)
_TREES = 100
# The number of times that each of few presses is presented to a map, in each phase.
_SHOWN = 50


def ridge(features, targets) -> Any:
    """Fit ridge regression, with the penalty that generalised cross-validation chooses."""
    from sklearn.linear_model import RidgeCV

    return RidgeCV(_ALPHAS).fit(features, targets)


def trees(features, targets) -> Any:
    """Fit gradient-boosted trees, a sequence for each target."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    models = [HistGradientBoostingRegressor(random_state=0, **options).fit(features, one) for one in targets.T]
    return Forest.of_boosted(models)


def forest(features, targets) -> Any:
    """Fit trees with random splits, averaged (Geurts et al. 2006)."""
    from sklearn.ensemble import ExtraTreesRegressor

    targets = targets[:, 0] if targets.shape[1] == 1 else targets
    found = ExtraTreesRegressor(_TREES, max_features=0.3, min_samples_leaf=2, random_state=0).fit(features, targets)
    return Forest.of_averaged(found.estimators_)


def som(features, targets) -> Any:
    """Fit Kohonen's map, whose neurons have the targets of the presses that each won, and values between them."""
    import jax

    shown = min(Schedule().ordering, _SHOWN * len(features))
    learnt = SelfOrganisingMap.fit(features, jax.random.key(0), schedule=Schedule(shown, shown))
    return PlacedMap.learn(learnt, features, targets)


REGRESSORS: dict[str, Callable[..., Any]] = {
    "ridge": ridge,
    "neighbours": Nearest.of_numbers,
    "gaussian-process": GaussianProcess.fit,
    "trees": trees,
    "forest": forest,
    "network": Network.train,
    "som": som,
}
# Methods that are quick enough to be tried on every form of the features.
QUICK = ("ridge", "neighbours")
# Methods that select few informative channels: they are applied to channels, not to their principal components.
OF_CHANNELS = ("forest",)


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
