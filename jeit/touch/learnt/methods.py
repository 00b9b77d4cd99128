"""Methods of learnt skins: regressors of places and forces, and classifiers of labels.

A regressor is a function of features (N, k) and standardised targets (N, d) that returns an object with
`predict(features)`. A classifier is a function of features and labels (N,); `log_odds` evaluates what it returns.
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
from jeit.touch.kohonen.training import MapSchedule
from jeit.touch.learnt.array_models import Forest, NearestNeighbours, SupportVectorMachine
from jeit.touch.learnt.extras import apply_in_parts
from jeit.touch.learnt.network import Network
from jeit_solvers import number_of_cores

# Number of presses from which length and noise are estimated; maximum number of centres. If there are no more presses
# than this, all are centres.
_TUNED_ON, _CENTRES = 400, 640
_AT_ONCE = 512


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process regression: the sum of kernels at `centres` (m, k) with `weights` (m, d).

    The kernel is the Matérn kernel of order 3/2, (1 + √3 r) e^(−√3 r), of the distance r from a centre divided by
    `length`. Length and noise maximise the marginal likelihood, Rasmussen and Williams (2006), eq. 5.8; if there are
    fewer centres than presses, the method is the subset of regressors, section 8.3.1.
    """

    centres: Float[np.ndarray, "m k"]
    weights: Float[np.ndarray, "m d"]
    length: float

    @classmethod
    def fit(cls, features, targets) -> "GaussianProcess":
        """Fit standardised `targets` (N, d) to `features` (N, k)."""
        order = np.random.default_rng(0).permutation(len(features))
        some = order[:_TUNED_ON]
        length, noise = _estimate_length_and_noise(features[some], targets[some])
        chosen = np.sort(order[:_CENTRES])
        centres = features[chosen]
        among = _matern_kernel(cdist(centres, centres) / length)
        if len(centres) == len(features):
            matrix, load = among + noise * np.eye(len(among)), targets[chosen]
        else:
            across = _matern_kernel(cdist(features, centres) / length)
            matrix, load = across.T @ across + noise * among, across.T @ targets
            matrix += 1e-8 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
        return cls(centres, cho_solve(cho_factor(matrix), load), length)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (n, d)."""
        scaled = self.centres / self.length
        squares = np.sum(scaled**2, axis=1)

        def predict_rows(rows: np.ndarray) -> np.ndarray:
            rows = rows / self.length
            squared = np.sum(rows**2, axis=1)[:, None] + squares - 2 * rows @ scaled.T
            return _matern_kernel(np.sqrt(np.maximum(squared, 0.0))) @ self.weights

        return apply_in_parts(predict_rows, features, _AT_ONCE)


def _matern_kernel(distance: np.ndarray) -> np.ndarray:
    scaled = np.sqrt(3.0) * distance
    return (1 + scaled) * np.exp(-scaled)


def _estimate_length_and_noise(features: np.ndarray, targets: np.ndarray) -> tuple[float, float]:
    """Estimate the length, and the ratio of the variance of the noise to that of the function.

    The variance of the function follows from these two in closed form.
    """
    apart = cdist(features, features)
    usual = float(np.sqrt(np.mean(apart**2))) or 1.0

    def negative_log_likelihood(logs: np.ndarray) -> float:
        matrix = _matern_kernel(apart / (usual * np.exp(logs[0]))) + np.exp(logs[1]) * np.eye(len(apart))
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
            minimize(negative_log_likelihood, start, method="Nelder-Mead", bounds=bounds, options={"maxfev": 60})
            for start in starts
        ),
        key=lambda found: found.fun,
    )
    return usual * float(np.exp(tuned.x[0])), float(np.exp(tuned.x[1]))


_ALPHAS = np.logspace(-2, 5, 15)
_TREES = 100
# Maximum number of times that each press is presented to a map, in each phase.
_SHOWN = 50


def ridge(features, targets) -> Any:
    """Fit ridge regression, with the penalty that generalised cross-validation chooses."""
    from sklearn.linear_model import RidgeCV

    return RidgeCV(_ALPHAS).fit(features, targets)


def trees(features, targets) -> Any:
    """Fit gradient-boosted regression trees, one model for each target."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    models = [HistGradientBoostingRegressor(random_state=0, **options).fit(features, one) for one in targets.T]
    return Forest.from_boosted_regressors(models)


def forest(features, targets) -> Any:
    """Fit trees with random splits, whose predictions are averaged (Geurts et al. 2006)."""
    from sklearn.ensemble import ExtraTreesRegressor

    targets = targets[:, 0] if targets.shape[1] == 1 else targets
    found = ExtraTreesRegressor(_TREES, max_features=0.3, min_samples_leaf=2, random_state=0).fit(features, targets)
    return Forest.from_averaged_trees(found.estimators_)


def som(features, targets) -> Any:
    """Fit a self-organising map, which interpolates between the mean targets of the presses that each neuron won."""
    import jax

    shown = min(MapSchedule().ordering, _SHOWN * len(features))
    learnt = SelfOrganisingMap.fit(features, jax.random.key(0), schedule=MapSchedule(shown, shown))
    return PlacedMap.learn(learnt, features, targets)


REGRESSORS: dict[str, Callable[..., Any]] = {
    "ridge": ridge,
    "neighbours": NearestNeighbours.fit_regressor,
    "gaussian-process": GaussianProcess.fit,
    "trees": trees,
    "forest": forest,
    "network": Network.train,
    "som": som,
}
# Methods that are quick enough to be tried on every form of the features.
QUICK = ("ridge", "neighbours")
# Methods that select few informative channels: they use the channels instead of principal components.
OF_CHANNELS = ("forest",)


# For the ensembles of Russo et al. (2017): number of members; number of leaves of a boosted tree.
_MEMBERS, _LEAVES = 30, 21
# Shrinkage of covariances if a class has fewer presses than twice the number of features; minimum variance of a class
# along any axis, relative to the maximum.
_SHRUNK, _LEAST = 0.1, 1e-4


def tree(features, label) -> Any:
    """Fit a decision tree."""
    from sklearn.tree import DecisionTreeClassifier

    found = DecisionTreeClassifier(min_samples_leaf=2, random_state=0).fit(features, label)
    return Forest.from_classification_trees([_with_numbered_classes(found)], np.ones(1), np.unique(label), votes=False)


def linear_discriminant(features, label) -> Any:
    """Fit a linear discriminant: normal classes with a common covariance, with Ledoit-Wolf shrinkage."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    try:
        return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(features, label)
    except np.linalg.LinAlgError:
        # LAPACK's least squares fails for some singular covariances, although their elements are finite.
        return LinearDiscriminantAnalysis(solver="eigen", shrinkage="auto").fit(features, label)


@dataclass(frozen=True)
class QuadraticDiscriminant:
    """A quadratic discriminant: normal classes, each with its own `mean` (C, k) and covariance.

    `whiten` (C, k, k): factor of the inverse covariance; `offset` (C,): logarithm of the density at the mean times the
    class's share of the presses, up to a constant (Russo et al. 2017, eq. 1).
    """

    mean: Float[np.ndarray, "C k"]
    whiten: Float[np.ndarray, "C k k"]
    offset: Float[np.ndarray, " C"]
    classes_: np.ndarray

    @classmethod
    def fit(cls, features, label) -> "QuadraticDiscriminant":
        """Fit the classes.

        If a class has too few presses for a covariance, all covariances are shrunk towards multiples of the identity.
        """
        classes, number = np.unique(label, return_inverse=True)
        shrunk, size = covariance_shrinkage(features, label), features.shape[1]
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
        """Compute the logarithms (n, C) of each class's density times its share of the presses, up to a constant."""
        found = np.empty((len(features), len(self.offset)))
        for one, (mean, whiten, offset) in enumerate(zip(self.mean, self.whiten, self.offset, strict=True)):
            found[:, one] = offset - 0.5 * np.sum(((features - mean) @ whiten) ** 2, axis=1)
        return found


def linear_svm(features, label) -> Any:
    """Fit a support vector machine with a linear kernel."""
    from sklearn.svm import SVC

    return SupportVectorMachine.from_scikit_learn(SVC(kernel="linear").fit(features, label))


def quadratic_svm(features, label) -> Any:
    """Fit a support vector machine with a quadratic kernel."""
    from sklearn.svm import SVC

    return SupportVectorMachine.from_scikit_learn(SVC(kernel="poly", degree=2, coef0=1.0).fit(features, label))


def boosted_trees(features, label) -> Any:
    """Fit decision trees by AdaBoost, in which each tree has one weighted vote."""
    from sklearn.ensemble import AdaBoostClassifier
    from sklearn.tree import DecisionTreeClassifier

    one = DecisionTreeClassifier(max_leaf_nodes=_LEAVES, random_state=0)
    found = AdaBoostClassifier(one, n_estimators=_MEMBERS, random_state=0).fit(features, label)
    members, weights = found.estimators_, found.estimator_weights_[: len(found.estimators_)]
    return Forest.from_classification_trees(
        [_with_numbered_classes(one, found) for one in members], weights, np.unique(label), votes=True
    )


def bagged_trees(features, label) -> Any:
    """Fit decision trees, each independently to a bootstrap sample of the presses."""
    from joblib import parallel_config
    from sklearn.ensemble import BaggingClassifier
    from sklearn.tree import DecisionTreeClassifier

    bagged = BaggingClassifier(
        DecisionTreeClassifier(random_state=0), _MEMBERS, n_jobs=number_of_cores(), random_state=0
    )
    with parallel_config("threading"):
        found = bagged.fit(features, label)
    weights = np.full(_MEMBERS, 1 / _MEMBERS)
    return Forest.from_classification_trees(
        [_with_numbered_classes(one) for one in found.estimators_], weights, np.unique(label), votes=False
    )


def subspace_discriminant(features, label) -> Any:
    """Fit an ensemble of linear discriminants, each to a random half of the features."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.ensemble import BaggingClassifier

    one = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    found = BaggingClassifier(one, _MEMBERS, bootstrap=False, max_features=0.5, random_state=0).fit(features, label)
    return LinearEnsemble.from_bagged(found, features.shape[1])


@dataclass(frozen=True)
class LinearEnsemble:
    """An ensemble of T linear classifiers, whose probabilities are averaged.

    `weights` (T, C, k) and `intercepts` (T, C) give the log-odds of the classes.
    """

    weights: Float[np.ndarray, "T C k"]
    intercepts: Float[np.ndarray, "T C"]
    classes_: np.ndarray

    @classmethod
    def from_bagged(cls, bagged, num_features: int) -> "LinearEnsemble":
        """Convert a scikit-learn ensemble of linear discriminants, each fitted to some of `num_features` features."""
        members = bagged.estimators_
        weights = np.zeros((len(members), len(bagged.classes_), num_features))
        intercepts = np.zeros(weights.shape[:2])
        for one, some, weight, intercept in zip(members, bagged.estimators_features_, weights, intercepts, strict=True):
            binary = len(one.coef_) == 1  # two classes: only the log-odds of the second are given
            weight[-1 if binary else slice(None), some] = one.coef_[0] if binary else one.coef_
            intercept[-1 if binary else slice(None)] = one.intercept_[0] if binary else one.intercept_
        return cls(weights, intercepts, bagged.classes_)

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Compute the probabilities (n, C) of the classes, averaged over the ensemble."""
        found = np.zeros((len(features), len(self.classes_)))
        for weight, intercept in zip(self.weights, self.intercepts, strict=True):
            found += probabilities(features @ weight.T + intercept, 1.0)
        return found / len(self.weights)


def _with_numbered_classes(tree, among=None):
    """Replace the classes of a tree by their indices, among the classes of the ensemble `among` if it is given."""
    tree.classes_ = np.arange(len(tree.classes_)) if among is None else np.searchsorted(among.classes_, tree.classes_)
    return tree


CLASSIFIERS: dict[str, Callable[..., Any]] = {
    "tree": tree,
    "linear-discriminant": linear_discriminant,
    "quadratic-discriminant": QuadraticDiscriminant.fit,
    "linear-svm": linear_svm,
    "quadratic-svm": quadratic_svm,
    "nearest": NearestNeighbours.fit_classifier,
    "boosted-trees": boosted_trees,
    "bagged-trees": bagged_trees,
    "subspace-discriminant": subspace_discriminant,
}


def covariance_shrinkage(features, label) -> float:
    """Shrinkage of the covariances of classes; 0 if every class has at least twice as many presses as features."""
    fewest = np.unique(label, return_counts=True)[1].min()
    return _SHRUNK if fewest < 2 * features.shape[1] else 0.0


def log_odds(model, features) -> Float[np.ndarray, "n C"]:
    """Compute a classifier's scores for each class (n, C).

    Depending on the classifier, they are logarithms of probabilities, sums of these over pairs of classes, votes, or
    distances from decision boundaries.
    """
    if hasattr(model, "predict_proba"):
        return np.log(np.maximum(model.predict_proba(features), 1e-6))
    if hasattr(model, "pair_odds"):
        return model.pair_odds(features)
    said = model.decision_function(features)
    return np.column_stack([-said, said]) if said.ndim == 1 else said


def probabilities(odds: np.ndarray, sharpness: float) -> Float[np.ndarray, "n C"]:
    """Compute the probability of each class (n, C) from its log-odds times the `sharpness`."""
    scaled = sharpness * odds
    powers = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def fit_sharpness(odds: np.ndarray, true_classes: np.ndarray) -> float:
    """Choose the sharpness that maximises the likelihood of the true classes `true_classes` (N,) of held-out
    presses."""
    candidates = np.geomspace(0.02, 50, 60)
    rows = np.arange(len(true_classes))
    likely = [np.mean(np.log(np.maximum(probabilities(odds, one)[rows, true_classes], 1e-9))) for one in candidates]
    return float(candidates[int(np.argmax(likely))])
