"""Machine learning methods for skins: regressors that predict places and forces, and classifiers that predict labels.

A regressor here is a function of features (presses, features) and standardised targets (presses, targets) that returns
a model with `predict(features)`. A classifier is a function of features and labels that returns a model, which
`log_odds` evaluates.
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
from jeit.touch.learnt.neural_networks import Network
from jeit.touch.learnt.resource_limits import apply_in_parts
from jeit_solvers import number_of_cores

# Number of presses from which kernel length and noise are estimated; maximum number of kernel centres. If there are no
# more presses than this maximum, all presses are centres.
_NUM_TUNING_PRESSES, _MAX_CENTRES = 400, 640
_CHUNK_SIZE = 512


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process regression with a Matérn kernel.

    A prediction is the sum of kernels at `centres` (centres, features) with `weights` (centres, targets). The kernel is
    the Matérn kernel of order 3/2, (1 + √3 r) e^(−√3 r), of the distance r from a centre divided by `length`. Kernel
    length and noise maximise the marginal likelihood (Rasmussen and Williams 2006, eq. 5.8). If there are fewer centres
    than presses, the method is the subset of regressors (section 8.3.1 there).
    """

    centres: Float[np.ndarray, "m k"]
    weights: Float[np.ndarray, "m d"]
    length: float

    @classmethod
    def fit(cls, features, targets) -> "GaussianProcess":
        """Fit a Gaussian process to features (presses, features) and standardised targets (presses, targets)."""
        random_order = np.random.default_rng(0).permutation(len(features))
        tuning_presses = random_order[:_NUM_TUNING_PRESSES]
        kernel_length, noise_ratio = _estimate_length_and_noise(features[tuning_presses], targets[tuning_presses])
        centre_indices = np.sort(random_order[:_MAX_CENTRES])
        centres = features[centre_indices]
        centre_kernel = _matern_kernel(cdist(centres, centres) / kernel_length)
        if len(centres) == len(features):
            system_matrix, right_hand_side = (
                centre_kernel + noise_ratio * np.eye(len(centre_kernel)),
                targets[centre_indices],
            )
        else:
            press_kernel = _matern_kernel(cdist(features, centres) / kernel_length)
            system_matrix, right_hand_side = (
                press_kernel.T @ press_kernel + noise_ratio * centre_kernel,
                press_kernel.T @ targets,
            )
            system_matrix += 1e-8 * np.trace(system_matrix) / len(system_matrix) * np.eye(len(system_matrix))
        return cls(centres, cho_solve(cho_factor(system_matrix), right_hand_side), kernel_length)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict standardised targets (frames, targets) from features (frames, features)."""
        scaled_centres = self.centres / self.length
        squared_norms = np.sum(scaled_centres**2, axis=1)

        def predict_rows(feature_rows: np.ndarray) -> np.ndarray:
            feature_rows = feature_rows / self.length
            squared_distances = (
                np.sum(feature_rows**2, axis=1)[:, None] + squared_norms - 2 * feature_rows @ scaled_centres.T
            )
            return _matern_kernel(np.sqrt(np.maximum(squared_distances, 0.0))) @ self.weights

        return apply_in_parts(predict_rows, features, _CHUNK_SIZE)


def _matern_kernel(relative_distance: np.ndarray) -> np.ndarray:
    """Evaluate the Matérn kernel of order 3/2 at distances divided by the kernel length."""
    scaled_distance = np.sqrt(3.0) * relative_distance
    return (1 + scaled_distance) * np.exp(-scaled_distance)


def _estimate_length_and_noise(features: np.ndarray, targets: np.ndarray) -> tuple[float, float]:
    """Estimate the kernel length, and the ratio of the noise variance to the variance of the Gaussian process.

    The variance of the process follows from the length and the ratio in closed form.
    """
    feature_distances = cdist(features, features)
    mean_distance = float(np.sqrt(np.mean(feature_distances**2))) or 1.0

    def negative_log_likelihood(log_parameters: np.ndarray) -> float:
        covariance_matrix = _matern_kernel(feature_distances / (mean_distance * np.exp(log_parameters[0]))) + np.exp(
            log_parameters[1]
        ) * np.eye(len(feature_distances))
        try:
            cholesky_factor = cho_factor(covariance_matrix, lower=True)
        except np.linalg.LinAlgError:
            return 1e12
        process_variance = np.mean(np.sum(targets * cho_solve(cholesky_factor, targets), axis=0) / len(targets))
        return float(
            2 * np.sum(np.log(np.diag(cholesky_factor[0]))) + len(targets) * np.log(max(process_variance, 1e-300))
        )

    parameter_bounds = [(np.log(0.05), np.log(50.0)), (np.log(1e-6), np.log(1e3))]
    initial_guesses = [(0.5, np.log(0.05)), (2.0, np.log(0.3))]
    best_minimum = min(
        (
            minimize(
                negative_log_likelihood,
                initial_guess,
                method="Nelder-Mead",
                bounds=parameter_bounds,
                options={"maxfev": 60},
            )
            for initial_guess in initial_guesses
        ),
        key=lambda minimum: minimum.fun,
    )
    return mean_distance * float(np.exp(best_minimum.x[0])), float(np.exp(best_minimum.x[1]))


_RIDGE_PENALTIES = np.logspace(-2, 5, 15)
_NUM_TREES = 100
# Maximum number of times that each press is presented to a self-organising map, in each phase of its training.
_MAX_PRESENTATIONS_PER_PRESS = 50


def fit_ridge(features, targets) -> Any:
    """Fit ridge regression; generalised cross-validation chooses its penalty."""
    from sklearn.linear_model import RidgeCV

    return RidgeCV(_RIDGE_PENALTIES).fit(features, targets)


def fit_gradient_boosting(features, targets) -> Any:
    """Fit gradient-boosted regression trees, one ensemble of trees for each target."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    boosting_options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    boosted_models = [
        HistGradientBoostingRegressor(random_state=0, **boosting_options).fit(features, target_column)
        for target_column in targets.T
    ]
    return Forest.from_boosted_regressors(boosted_models)


def fit_extra_trees(features, targets) -> Any:
    """Fit extremely randomised regression trees, whose predictions are averaged (Geurts et al. 2006)."""
    from sklearn.ensemble import ExtraTreesRegressor

    targets = targets[:, 0] if targets.shape[1] == 1 else targets
    tree_regressor = ExtraTreesRegressor(_NUM_TREES, max_features=0.3, min_samples_leaf=2, random_state=0).fit(
        features, targets
    )
    return Forest.from_averaged_trees(tree_regressor.estimators_)


def fit_self_organising_map(features, targets) -> Any:
    """Fit a self-organising map, which interpolates between the neurons' targets; a neuron's target is the mean target
    of the presses nearest to the neuron."""
    import jax

    num_steps = min(MapSchedule().ordering, _MAX_PRESENTATIONS_PER_PRESS * len(features))
    fitted_map = SelfOrganisingMap.fit(features, jax.random.key(0), schedule=MapSchedule(num_steps, num_steps))
    return PlacedMap.learn(fitted_map, features, targets)


REGRESSORS: dict[str, Callable[..., Any]] = {
    "ridge": fit_ridge,
    "neighbours": NearestNeighbours.fit_regressor,
    "gaussian-process": GaussianProcess.fit,
    "trees": fit_gradient_boosting,
    "forest": fit_extra_trees,
    "network": Network.train,
    "som": fit_self_organising_map,
}
# Regression methods that are quick enough to be tried on every form of features.
QUICK_METHODS = ("ridge", "neighbours")
# Regression methods that select a few informative channels themselves, and so use channels instead of principal
# components.
CHANNEL_METHODS = ("forest",)


# Number of members of the ensembles of classifiers of Russo et al. (2017).
_NUM_ENSEMBLE_MEMBERS = 30
# Maximum number of leaves of a boosted tree in these ensembles.
_MAX_TREE_LEAVES = 21
# Shrinkage of class covariances if a class has fewer presses than twice the number of features.
_COVARIANCE_SHRINKAGE = 0.1
# Minimum variance of a class along a principal axis, relative to the maximum.
_MIN_VARIANCE_RATIO = 1e-4


def fit_decision_tree(features, label) -> Any:
    """Fit a decision tree that classifies presses by label."""
    from sklearn.tree import DecisionTreeClassifier

    fitted_tree = DecisionTreeClassifier(min_samples_leaf=2, random_state=0).fit(features, label)
    return Forest.from_classification_trees(
        [_number_classes(fitted_tree)], np.ones(1), np.unique(label), is_voting=False
    )


def fit_linear_discriminant(features, label) -> Any:
    """Fit a linear discriminant: normally distributed classes with a common covariance and Ledoit-Wolf shrinkage."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    try:
        return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(features, label)
    except np.linalg.LinAlgError:
        # LAPACK's least squares fails for some singular covariances, although their elements are finite.
        return LinearDiscriminantAnalysis(solver="eigen", shrinkage="auto").fit(features, label)


@dataclass(frozen=True)
class QuadraticDiscriminant:
    """A quadratic discriminant: normally distributed classes, each with its own mean and covariance.

    `mean` (classes, features); `whiten` (classes, features, features): factor of each inverse covariance; `offset`:
    logarithm of each class's density at its mean times its share of the presses, up to a constant (Russo et al. 2017,
    eq. 1).
    """

    mean: Float[np.ndarray, "C k"]
    whiten: Float[np.ndarray, "C k k"]
    offset: Float[np.ndarray, " C"]
    classes_: np.ndarray

    @classmethod
    def fit(cls, features, label) -> "QuadraticDiscriminant":
        """Fit the mean and the covariance of the features of each class.

        If a class has too few presses to estimate a covariance, all covariances are shrunk towards multiples of the
        identity.
        """
        classes, class_indices = np.unique(label, return_inverse=True)
        shrinkage, num_features = covariance_shrinkage(features, label), features.shape[1]
        mean_variance = np.mean(np.var(features, axis=0))
        class_means, whitening_matrices, class_offsets = [], [], []
        for class_index in range(len(classes)):
            class_features = features[class_indices == class_index]
            class_covariance = np.cov(class_features.T, bias=len(class_features) < 2).reshape(
                num_features, num_features
            )
            class_covariance = (1 - shrinkage) * class_covariance + shrinkage * np.trace(
                class_covariance
            ) / num_features * np.eye(num_features)
            eigenvalues, eigenvectors = np.linalg.eigh(class_covariance)
            eigenvalues = np.maximum(
                eigenvalues, _MIN_VARIANCE_RATIO * max(eigenvalues.max(), _MIN_VARIANCE_RATIO * mean_variance)
            )
            class_means.append(class_features.mean(axis=0))
            whitening_matrices.append(eigenvectors / np.sqrt(eigenvalues))
            class_offsets.append(np.log(len(class_features) / len(features)) - 0.5 * np.sum(np.log(eigenvalues)))
        return cls(np.array(class_means), np.array(whitening_matrices), np.array(class_offsets), classes)

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Compute the logarithm (frames, classes) of each class's density times its share of the presses, up to a
        constant."""
        class_scores = np.empty((len(features), len(self.offset)))
        for class_index, (class_mean, whitening_matrix, class_offset) in enumerate(
            zip(self.mean, self.whiten, self.offset, strict=True)
        ):
            class_scores[:, class_index] = class_offset - 0.5 * np.sum(
                ((features - class_mean) @ whitening_matrix) ** 2, axis=1
            )
        return class_scores


def fit_linear_svm(features, label) -> Any:
    """Fit a support vector classifier with a linear kernel."""
    from sklearn.svm import SVC

    return SupportVectorMachine.from_scikit_learn(SVC(kernel="linear").fit(features, label))


def fit_quadratic_svm(features, label) -> Any:
    """Fit a support vector classifier with a quadratic kernel."""
    from sklearn.svm import SVC

    return SupportVectorMachine.from_scikit_learn(SVC(kernel="poly", degree=2, coef0=1.0).fit(features, label))


def fit_boosted_trees(features, label) -> Any:
    """Fit an ensemble of decision trees by AdaBoost, in which each tree has one weighted vote."""
    from sklearn.ensemble import AdaBoostClassifier
    from sklearn.tree import DecisionTreeClassifier

    weak_classifier = DecisionTreeClassifier(max_leaf_nodes=_MAX_TREE_LEAVES, random_state=0)
    boosted_classifier = AdaBoostClassifier(weak_classifier, n_estimators=_NUM_ENSEMBLE_MEMBERS, random_state=0).fit(
        features, label
    )
    ensemble_members, tree_weights = (
        boosted_classifier.estimators_,
        boosted_classifier.estimator_weights_[: len(boosted_classifier.estimators_)],
    )
    return Forest.from_classification_trees(
        [_number_classes(ensemble_member, boosted_classifier) for ensemble_member in ensemble_members],
        tree_weights,
        np.unique(label),
        is_voting=True,
    )


def fit_bagged_trees(features, label) -> Any:
    """Fit an ensemble of decision trees, each to its own bootstrap sample of the presses."""
    from joblib import parallel_config
    from sklearn.ensemble import BaggingClassifier
    from sklearn.tree import DecisionTreeClassifier

    classifier = BaggingClassifier(
        DecisionTreeClassifier(random_state=0), _NUM_ENSEMBLE_MEMBERS, n_jobs=number_of_cores(), random_state=0
    )
    with parallel_config("threading"):
        bagged_classifier = classifier.fit(features, label)
    tree_weights = np.full(_NUM_ENSEMBLE_MEMBERS, 1 / _NUM_ENSEMBLE_MEMBERS)
    return Forest.from_classification_trees(
        [_number_classes(ensemble_member) for ensemble_member in bagged_classifier.estimators_],
        tree_weights,
        np.unique(label),
        is_voting=False,
    )


def fit_subspace_discriminant(features, label) -> Any:
    """Fit an ensemble of linear discriminants, each to a random half of the features."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.ensemble import BaggingClassifier

    discriminant = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    bagged_classifier = BaggingClassifier(
        discriminant, _NUM_ENSEMBLE_MEMBERS, bootstrap=False, max_features=0.5, random_state=0
    ).fit(features, label)
    return LinearEnsemble.from_bagged(bagged_classifier, features.shape[1])


@dataclass(frozen=True)
class LinearEnsemble:
    """An ensemble of linear classifiers, whose probabilities are averaged.

    `weights` (members, classes, features) and `intercepts` (members, classes) give each member's log-odds of the
    classes.
    """

    weights: Float[np.ndarray, "T C k"]
    intercepts: Float[np.ndarray, "T C"]
    classes_: np.ndarray

    @classmethod
    def from_bagged(cls, bagging_classifier, num_features: int) -> "LinearEnsemble":
        """Convert a scikit-learn ensemble of linear discriminants, each fitted to some of `num_features` features."""
        ensemble_members = bagging_classifier.estimators_
        weights = np.zeros((len(ensemble_members), len(bagging_classifier.classes_), num_features))
        intercepts = np.zeros(weights.shape[:2])
        for ensemble_member, feature_indices, member_weights, member_intercepts in zip(
            ensemble_members, bagging_classifier.estimators_features_, weights, intercepts, strict=True
        ):
            is_binary = (
                len(ensemble_member.coef_) == 1
            )  # with two classes, scikit-learn gives only the log-odds of the second
            member_weights[-1 if is_binary else slice(None), feature_indices] = (
                ensemble_member.coef_[0] if is_binary else ensemble_member.coef_
            )
            member_intercepts[-1 if is_binary else slice(None)] = (
                ensemble_member.intercept_[0] if is_binary else ensemble_member.intercept_
            )
        return cls(weights, intercepts, bagging_classifier.classes_)

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Compute the probabilities of the classes (frames, classes), averaged over the members of the ensemble."""
        summed_probabilities = np.zeros((len(features), len(self.classes_)))
        for member_weights, member_intercepts in zip(self.weights, self.intercepts, strict=True):
            summed_probabilities += probabilities(features @ member_weights.T + member_intercepts, 1.0)
        return summed_probabilities / len(self.weights)


def _number_classes(classification_tree, fitted_ensemble=None):
    """Replace the classes of a tree by their indices among the classes of the `fitted_ensemble`, or else of the tree
    itself."""
    classification_tree.classes_ = (
        np.arange(len(classification_tree.classes_))
        if fitted_ensemble is None
        else np.searchsorted(fitted_ensemble.classes_, classification_tree.classes_)
    )
    return classification_tree


CLASSIFIERS: dict[str, Callable[..., Any]] = {
    "tree": fit_decision_tree,
    "linear-discriminant": fit_linear_discriminant,
    "quadratic-discriminant": QuadraticDiscriminant.fit,
    "linear-svm": fit_linear_svm,
    "quadratic-svm": fit_quadratic_svm,
    "nearest": NearestNeighbours.fit_classifier,
    "boosted-trees": fit_boosted_trees,
    "bagged-trees": fit_bagged_trees,
    "subspace-discriminant": fit_subspace_discriminant,
}


def covariance_shrinkage(features, label) -> float:
    """Return the shrinkage of the class covariances; 0 if every class has at least twice as many presses as
    features."""
    min_presses = np.unique(label, return_counts=True)[1].min()
    return _COVARIANCE_SHRINKAGE if min_presses < 2 * features.shape[1] else 0.0


def log_odds(model, features) -> Float[np.ndarray, "n C"]:
    """Compute a classifier's score for each class (frames, classes).

    Depending on the classifier, scores are log-probabilities, sums of log-probabilities over pairs of classes, votes,
    or distances from decision boundaries.
    """
    if hasattr(model, "predict_proba"):
        return np.log(np.maximum(model.predict_proba(features), 1e-6))
    if hasattr(model, "pair_odds"):
        return model.pair_odds(features)
    class_scores = model.decision_function(features)
    return np.column_stack([-class_scores, class_scores]) if class_scores.ndim == 1 else class_scores


def probabilities(odds: np.ndarray, sharpness: float) -> Float[np.ndarray, "n C"]:
    """Compute the probability of each class (frames, classes) as the softmax of its log-odds times the `sharpness`."""
    scaled_log_odds = sharpness * odds
    exponential_odds = np.exp(scaled_log_odds - scaled_log_odds.max(axis=1, keepdims=True))
    return exponential_odds / exponential_odds.sum(axis=1, keepdims=True)


def fit_sharpness(odds: np.ndarray, true_classes: np.ndarray) -> float:
    """Choose the factor of log-odds, the sharpness, that maximises the likelihood of the `true_classes` of held-out
    presses."""
    candidate_factors = np.geomspace(0.02, 50, 60)
    press_indices = np.arange(len(true_classes))
    log_likelihoods = [
        np.mean(np.log(np.maximum(probabilities(odds, candidate_factor)[press_indices, true_classes], 1e-9)))
        for candidate_factor in candidate_factors
    ]
    return float(candidate_factors[int(np.argmax(log_likelihoods))])
