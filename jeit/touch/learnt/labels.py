"""Learn to predict the labels of touches, and which keys are pressed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jeit.touch.learnt.array_models import Forest
from jeit.touch.learnt.features import FORMS, Features, Forms, ImageReconstruction, standardisation
from jeit.touch.learnt.methods import CLASSIFIERS, covariance_shrinkage, fit_sharpness, log_odds, probabilities
from jeit.touch.learnt.resource_limits import apply_over_folds

METHODS = ("auto", *CLASSIFIERS)
_QUICK_METHOD = "linear-discriminant"


@dataclass(frozen=True)
class LabelMethodResult:
    """Cross-validation result of a classification `method` with one `form` of features.

    `held_out`: index of the label predicted for each press when held out; `odds` (presses, classes): predicted log-odds
    of the classes; `error`: share of wrong labels.
    """

    method: str
    form: str
    held_out: np.ndarray
    odds: Float[np.ndarray, "N C"]
    error: float


@dataclass(frozen=True)
class LearntLabels:
    """A classifier that predicts the label of a touch from features of voltage changes.

    `classes`: the labels; `sharpness`: factor by which log-odds are multiplied for conversion to probabilities;
    `notes`: remarks on the fit as text.
    """

    features: Features
    model: Any
    classes: np.ndarray
    sharpness: float
    notes: list[str]

    def predict(self, changes, reference) -> tuple[np.ndarray, Float[np.ndarray, " n"]]:
        """Predict the label of each frame and its probability."""
        class_log_odds = log_odds(self.model, self.features(changes, reference))
        return self.classes[class_log_odds.argmax(axis=1)], probabilities(class_log_odds, self.sharpness).max(axis=1)


def learn_labels(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    label: np.ndarray,
    folds: np.ndarray,
    *,
    method: str = "auto",
    imaged: ImageReconstruction | None = None,
    progress: Callable[[str], None] = lambda message: None,
) -> tuple[LearntLabels, list[LabelMethodResult]]:
    """Learn a classifier of labels from voltage changes of presses (presses, channels).

    `reference`: reference voltages of the changes; `imaged`: optional reconstruction of images, which are then used as
    features too; `method`: one of the nine classifiers, or "auto" for the classifier with the lowest error. All methods
    use the form of features for which the linear discriminant has the lowest error. Also returns the results of
    `method`, or of all methods for "auto", in cross-validation on `folds`, in order of increasing error.
    """
    has_reference = reference is not None
    reference = np.zeros_like(changes) if reference is None else reference
    classes, true_classes = np.unique(label, return_inverse=True)
    forms = Forms.available(true_classes[:, None], imaged, has_reference=has_reference)
    method_results = []
    for form in forms.names:
        progress(f"{_QUICK_METHOD} on {form}")
        method_results.append(_cross_validate(_QUICK_METHOD, form, forms, changes, reference, true_classes, folds))
    form = min(method_results, key=_error_rate).form
    for method_name in [
        method_name for method_name in CLASSIFIERS if method_name != _QUICK_METHOD and method in ("auto", method_name)
    ]:
        progress(f"{method_name} on {form}")
        method_results.append(_cross_validate(method_name, form, forms, changes, reference, true_classes, folds))
    method_results.sort(key=_error_rate)
    method_results = [method_result for method_result in method_results if method in ("auto", method_result.method)]
    best_result = method_results[0]
    fitted_features = forms.learn(best_result.form, changes, reference, true_classes[:, None])
    feature_values = fitted_features(changes, reference)
    notes = []
    if best_result.method == "quadratic-discriminant" and covariance_shrinkage(feature_values, true_classes):
        min_presses = np.bincount(true_classes).min()
        notes.append(
            f"quadratic discriminant: a class has only {min_presses} presses for {feature_values.shape[1]} features; "
            f"covariances are shrunk by {covariance_shrinkage(feature_values, true_classes):g}."
        )
    fitted_classifier = CLASSIFIERS[best_result.method](feature_values, true_classes)
    return LearntLabels(
        fitted_features, fitted_classifier, classes, fit_sharpness(best_result.odds, true_classes), notes
    ), method_results


def _error_rate(method_result: LabelMethodResult) -> float:
    return method_result.error


def _cross_validate(method, form, forms: Forms, changes, reference, true_classes, folds) -> LabelMethodResult:
    """Predict the classes of all presses by cross-validation of one method with one form of features."""
    num_classes = true_classes.max() + 1
    class_log_odds = np.full((len(true_classes), num_classes), -1e3)

    def predict_fold(fold_index: int) -> None:
        is_held_out = folds == fold_index
        fitted_features = forms.learn(
            form, changes[~is_held_out], reference[~is_held_out], true_classes[~is_held_out, None]
        )
        fitted_classifier = CLASSIFIERS[method](
            fitted_features(changes[~is_held_out], reference[~is_held_out]), true_classes[~is_held_out]
        )
        class_log_odds[np.ix_(is_held_out, fitted_classifier.classes_)] = log_odds(
            fitted_classifier, fitted_features(changes[is_held_out], reference[is_held_out])
        )

    apply_over_folds(predict_fold, folds.max() + 1)
    predicted_classes = class_log_odds.argmax(axis=1)
    return LabelMethodResult(
        method, form, predicted_classes, class_log_odds, float(np.mean(predicted_classes != true_classes))
    )


_INVERSE_PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
_KEY_FORMS = ("differences", "compressed")
# Number of channels that the discriminant and the trees use for a key, selected for the best separation of the key's
# presses from other presses.
_NUM_SELECTED_CHANNELS = 200
# Number of trees.
_NUM_TREES = 150
_TREE_OPTIONS: dict[str, Any] = {"max_features": 0.3, "min_samples_leaf": 2, "random_state": 0}


@dataclass(frozen=True)
class StandardisedFeatures:
    """Standardised features of voltage changes in one `form`: all features, or only those with the indices `chosen`."""

    form: str
    unit: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " p"]
    deviation: Float[np.ndarray, " p"]
    chosen: np.ndarray | None = None

    @classmethod
    def learn(cls, form: str, changes: np.ndarray, reference: np.ndarray) -> "StandardisedFeatures":
        """Fit the standardisation of features to voltage changes (presses, channels) and reference voltages."""
        channel_units, _, feature_means, feature_deviations = standardisation(form, changes, reference)
        return cls(form, channel_units, feature_means, feature_deviations)

    def __call__(self, changes: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Compute the features (frames, features) of voltage changes (frames, channels)."""
        feature_values = (FORMS[self.form](changes, reference, self.unit) - self.mean) / self.deviation
        return feature_values if self.chosen is None else feature_values[:, self.chosen]


@dataclass(frozen=True)
class LearntKeys:
    """Classifiers that predict which keys of a keyboard are pressed.

    `members`: features, classifier, and calibration factor of the log-odds (sharpness) for each key.
    """

    members: list[tuple[StandardisedFeatures, Any, float]]

    def predict(self, changes, reference) -> tuple[Bool[np.ndarray, "n K"], Float[np.ndarray, "n K"]]:
        """Predict which keys are pressed, and the probability that each key is pressed, both (frames, keys)."""
        odds_of_keys = [
            log_odds(key_classifier, key_features(changes, reference))
            for key_features, key_classifier, _ in self.members
        ]
        key_probabilities = [
            probabilities(key_odds, sharpness)[:, 1]
            for key_odds, (_, _, sharpness) in zip(odds_of_keys, self.members, strict=True)
        ]
        pressed_probability = np.column_stack(key_probabilities)
        return pressed_probability > 0.5, pressed_probability


@dataclass(frozen=True)
class KeyMethodResults:
    """Cross-validation results of the classification method that was chosen for each key.

    `methods`: name of each key's method; `held_out` (presses, keys): predictions for held-out presses; `errors`: share
    of errors for each key.
    """

    methods: list[str]
    held_out: Bool[np.ndarray, "N K"]
    errors: Float[np.ndarray, " K"]


def learn_keys(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    touched: Bool[np.ndarray, "N K"],
    folds: np.ndarray,
    *,
    progress: Callable[[str], None] = lambda message: None,
) -> tuple[LearntKeys, KeyMethodResults]:
    """Learn to predict which keys are pressed from voltage changes (presses, channels).

    For each key, the classification method with the lowest loss in cross-validation on `folds` is chosen. Also returns
    the cross-validation results of the chosen methods.
    """
    reference = np.zeros_like(changes) if reference is None else reference
    num_presses, num_keys = touched.shape
    odds_of_methods = {method_name: np.empty((num_presses, num_keys)) for method_name in _key_methods()}

    def predict_fold(fold_index: int) -> None:
        is_held_out = folds == fold_index
        for form in _KEY_FORMS:
            fitted_features = StandardisedFeatures.learn(form, changes[~is_held_out], reference[~is_held_out])
            training_features, held_out_features = (
                fitted_features(changes[~is_held_out], reference[~is_held_out]),
                fitted_features(changes[is_held_out], reference[is_held_out]),
            )
            principal_axes = np.linalg.svd(training_features, full_matrices=False)[
                2
            ].T  # principal axes: faster, and equivalent for linear methods
            rotated_features = training_features @ principal_axes, held_out_features @ principal_axes
            for key_index in range(num_keys):
                training_answers = touched[~is_held_out, key_index].astype(int)
                if (
                    training_answers.min() == training_answers.max()
                ):  # the training set has no press of the key, or only presses of the key
                    for method_name in odds_of_methods:
                        odds_of_methods[method_name][is_held_out, key_index] = 2.0 * training_answers[0] - 1
                    continue
                for method_name, (classifier_kind, inverse_penalty) in _key_methods().items():
                    if method_name.partition(" on ")[2] != form:
                        continue
                    if classifier_kind == "linear":
                        fitted_classifier = _fit_logistic(rotated_features[0], training_answers, inverse_penalty)
                        odds_of_methods[method_name][is_held_out, key_index] = fitted_classifier.decision_function(
                            rotated_features[1]
                        )
                    else:
                        selected_features = _select_features(training_features, training_answers)
                        fitted_classifier = _CHANNEL_METHODS[classifier_kind](
                            training_features[:, selected_features], training_answers
                        )
                        class_odds = log_odds(fitted_classifier, held_out_features[:, selected_features])
                        odds_of_methods[method_name][is_held_out, key_index] = class_odds[:, 1] - class_odds[:, 0]
        progress(f"keys, fold {fold_index + 1} of {folds.max() + 1}")

    apply_over_folds(predict_fold, folds.max() + 1)
    key_members, methods_of_keys, held_out = [], [], np.empty((num_presses, num_keys), bool)
    for key_index in range(num_keys):
        is_pressed = touched[:, key_index]
        # Choose the method by error rate and likelihood, since many methods have the same number of errors.
        method_name = min(
            odds_of_methods,
            key=lambda method_name: _classification_loss(odds_of_methods[method_name][:, key_index], is_pressed),
        )
        methods_of_keys.append(method_name)
        held_out[:, key_index] = odds_of_methods[method_name][:, key_index] > 0
        key_members.append(
            _fit_key(
                method_name, changes, reference, is_pressed.astype(int), odds_of_methods[method_name][:, key_index]
            )
        )
        progress(f"key {key_index + 1} of {num_keys}")
    return LearntKeys(key_members), KeyMethodResults(methods_of_keys, held_out, np.mean(held_out != touched, axis=0))


def _key_methods() -> dict[str, tuple[str, float]]:
    """Return the candidate classification methods by name: kind of classifier, and inverse penalty C of logistic
    regression."""
    candidate_methods = {}
    for form in _KEY_FORMS:
        candidate_methods |= {
            f"logistic, C = {inverse_penalty:g} on {form}": ("linear", inverse_penalty)
            for inverse_penalty in _INVERSE_PENALTIES
        }
        candidate_methods |= {f"discriminant of {_NUM_SELECTED_CHANNELS} channels on {form}": ("discriminant", 0.0)}
        candidate_methods |= {f"trees of {_NUM_SELECTED_CHANNELS} channels on {form}": ("trees", 0.0)}
    return candidate_methods


def _fit_key(method_name: str, changes, reference, is_pressed, key_log_odds) -> tuple[StandardisedFeatures, Any, float]:
    """Fit the classification method `method_name` to one key; returns features, classifier, and sharpness (factor of
    log-odds).

    `is_pressed`: 1 for presses of the key, else 0; `key_log_odds`: log-odds of held-out presses, from which the
    sharpness is fitted.
    """
    classifier_kind, inverse_penalty = _key_methods()[method_name]
    fitted_features = StandardisedFeatures.learn(method_name.partition(" on ")[2], changes, reference)
    feature_values = fitted_features(changes, reference)
    sharpness = fit_sharpness(np.column_stack([np.zeros(len(key_log_odds)), key_log_odds]), is_pressed)
    if classifier_kind == "linear":
        return fitted_features, _fit_rotated(feature_values, is_pressed, inverse_penalty), sharpness
    feature_indices = _select_features(feature_values, is_pressed)
    key_features = StandardisedFeatures(
        fitted_features.form, fitted_features.unit, fitted_features.mean, fitted_features.deviation, feature_indices
    )
    return key_features, _CHANNEL_METHODS[classifier_kind](feature_values[:, feature_indices], is_pressed), sharpness


def _fit_rotated(feature_values, is_pressed, inverse_penalty):
    """Fit logistic regression to principal components of the features, and convert its coefficients to the features."""
    principal_axes = np.linalg.svd(feature_values, full_matrices=False)[2].T
    logistic_regression = _fit_logistic(feature_values @ principal_axes, is_pressed, inverse_penalty)
    logistic_regression.coef_ = logistic_regression.coef_ @ principal_axes.T
    logistic_regression.n_features_in_ = feature_values.shape[1]
    return logistic_regression


def _fit_logistic(feature_values, is_pressed, inverse_penalty):
    from sklearn.linear_model import LogisticRegression

    return LogisticRegression(C=inverse_penalty, max_iter=500).fit(feature_values, is_pressed)


def _fit_discriminant(feature_values, is_pressed):
    """Fit a linear discriminant to features (presses, features); `is_pressed` are true for the presses of a key."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(feature_values, is_pressed)


def _fit_trees(feature_values, is_pressed):
    from sklearn.ensemble import ExtraTreesClassifier

    tree_classifier = ExtraTreesClassifier(_NUM_TREES, **_TREE_OPTIONS).fit(feature_values, is_pressed)
    return Forest.from_classification_trees(
        tree_classifier.estimators_, np.full(_NUM_TREES, 1 / _NUM_TREES), tree_classifier.classes_, is_voting=False
    )


_CHANNEL_METHODS = {"discriminant": _fit_discriminant, "trees": _fit_trees}


def _select_features(feature_values: np.ndarray, is_pressed: np.ndarray) -> np.ndarray:
    """Select the features whose means differ most between presses with and without the key, relative to the spread
    within each class."""
    pressed_values, released_values = feature_values[is_pressed == 1], feature_values[is_pressed == 0]
    feature_deviations = np.sqrt(
        (pressed_values.var(axis=0) * len(pressed_values) + released_values.var(axis=0) * len(released_values))
        / len(feature_values)
    )
    return np.sort(
        np.argsort(
            -np.abs(pressed_values.mean(axis=0) - released_values.mean(axis=0)) / np.maximum(feature_deviations, 1e-12)
        )[:_NUM_SELECTED_CHANNELS]
    )


def _classification_loss(key_log_odds: np.ndarray, true_classes: np.ndarray) -> float:
    """Compute the loss of a classifier: the error rate plus 0.1 times the mean negative log-likelihood of the true
    classes, at the best sharpness (factor of the log-odds)."""
    class_log_odds = np.column_stack([np.zeros(len(key_log_odds)), key_log_odds])
    sharpness = fit_sharpness(class_log_odds, true_classes.astype(int))
    class_likelihoods = probabilities(class_log_odds, sharpness)[np.arange(len(true_classes)), true_classes.astype(int)]
    return float(
        np.mean((key_log_odds > 0) != true_classes) - 0.1 * np.mean(np.log(np.maximum(class_likelihoods, 1e-9)))
    )
