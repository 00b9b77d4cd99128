"""Learn to predict the places or forces of touches, with calibrated standard deviations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jeit.touch.learnt.features import Features, Forms, ImageReconstruction
from jeit.touch.learnt.methods import CHANNEL_METHODS, QUICK_METHODS, REGRESSORS
from jeit.touch.learnt.resource_limits import apply_over_folds

_NUM_SIMILAR_PRESSES, _TARGET_COVERAGES = 40, ((1.0, 0.6827), (1.96, 0.95))
# Number of similar presses from which the variance of a prediction is estimated; for calibration, pairs of a multiple
# of the standard deviation and the share of normally distributed errors within this multiple. Weight of the logarithm
# of the size of the changes, relative to the predicted values, in the distance between presses; weight of the mean
# squared error of all presses in an estimated variance. The remaining weight is that of the mean squared error of
# similar presses.
_PREDICTION_SIZE_WEIGHT, _GLOBAL_VARIANCE_FRACTION = 0.3, 0.15
# Minimum number of presses from which the coverage of standard deviations is estimated.
_MIN_CALIBRATION_PRESSES = 30
# Minimum predicted standard deviation, relative to the standard deviation of the predictions for the training set.
_MIN_RELATIVE_DEVIATION = 1e-4


@dataclass(frozen=True)
class DeviationModel:
    """Model that estimates the standard deviations of predictions from the errors of similar held-out presses.

    `where` (presses, targets + 1): predicted targets of the held-out presses and logarithm of the root mean square of
    their voltage changes, after subtraction of `low` and division by `unit` (targets + 1,); `squares` (presses,
    targets): squared errors of these predictions; `factor`: calibration factor of the standard deviation of each
    target.
    """

    where: Float[np.ndarray, "N e"]
    squares: Float[np.ndarray, "N d"]
    low: Float[np.ndarray, " e"]
    unit: Float[np.ndarray, " e"]
    factor: Float[np.ndarray, " d"]

    @classmethod
    def learn(
        cls, predictions: np.ndarray, changes: np.ndarray, errors: np.ndarray, last_presses: np.ndarray
    ) -> "DeviationModel":
        """Fit to predictions for held-out presses, the voltage changes of these presses, and the errors of the
        predictions.

        `last_presses`: whether each press was recorded before or after all presses from which its prediction was
        learnt. If there are enough such presses, standard deviations are calibrated on them alone, since future
        presses, too, are recorded after the training set.
        """
        features = np.column_stack([predictions, _log_size(changes)])
        feature_means, feature_units = features.mean(axis=0), features.std(axis=0)
        feature_units = np.where(feature_units > 0, feature_units, 1.0)
        feature_units[-1] /= _PREDICTION_SIZE_WEIGHT
        max_errors = np.quantile(
            np.abs(errors), 0.99, axis=0
        )  # a single large error is not representative of similar presses
        squared_errors = np.minimum(np.abs(errors), max_errors) ** 2
        uncalibrated_model = cls(
            (features - feature_means) / feature_units,
            squared_errors,
            feature_means,
            feature_units,
            np.ones(errors.shape[1]),
        )
        local_deviations = uncalibrated_model._local_deviations(uncalibrated_model.where, leave_one_out=True)
        last_presses = last_presses if last_presses.sum() >= _MIN_CALIBRATION_PRESSES else np.ones_like(last_presses)
        deviation_factors = [
            _calibration_factor(np.abs(errors_of_target) / deviations)
            for errors_of_target, deviations in zip(
                errors[last_presses].T, local_deviations[last_presses].T, strict=True
            )
        ]
        return cls(uncalibrated_model.where, squared_errors, feature_means, feature_units, np.array(deviation_factors))

    def __call__(self, predictions: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "n d"]:
        """Compute the standard deviations of predictions (frames, targets) from the voltage changes of the frames."""
        features = (np.column_stack([predictions, _log_size(changes)]) - self.low) / self.unit
        return self.factor * self._local_deviations(features)

    def held_out(self, predictions: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "N d"]:
        """Compute the standard deviations of the predictions for held-out presses, each estimated without the press's
        own error."""
        features = (np.column_stack([predictions, _log_size(changes)]) - self.low) / self.unit
        return self.factor * self._local_deviations(features, leave_one_out=True)

    def _local_deviations(self, features: np.ndarray, *, leave_one_out: bool = False) -> np.ndarray:
        """Estimate standard deviations (frames, targets) from the errors of the held-out presses nearest to
        `features`."""
        num_neighbours = min(_NUM_SIMILAR_PRESSES, len(self.where) - 1)
        nearest_presses = np.asarray(self._search_tree.query(features, num_neighbours + leave_one_out)[1])[
            :, int(leave_one_out) :
        ]
        similar_variance = self.squares[nearest_presses].mean(axis=1)
        mean_variance = self.squares.mean(axis=0)
        return np.maximum(
            np.sqrt((1 - _GLOBAL_VARIANCE_FRACTION) * similar_variance + _GLOBAL_VARIANCE_FRACTION * mean_variance),
            _MIN_RELATIVE_DEVIATION * self.unit[: similar_variance.shape[1]],
        )

    @cached_property
    def _search_tree(self) -> KDTree:
        return KDTree(self.where)


def _log_size(changes: np.ndarray) -> np.ndarray:
    return np.log(np.sqrt(np.mean(changes**2, axis=1)) + 1e-300)


def _calibration_factor(error_ratios: np.ndarray) -> float:
    """Compute the calibration factor of standard deviations from the ratios of errors to standard deviations.

    The factor is chosen such that the shares of errors within 1 and 1.96 standard deviations are closest to those of a
    normal distribution.
    """
    candidate_factors = np.geomspace(0.2, 5, 200)
    coverage_deviations = [
        max(
            abs(np.mean(error_ratios <= num_deviations * candidate_factor) - target_coverage)
            for num_deviations, target_coverage in _TARGET_COVERAGES
        )
        for candidate_factor in candidate_factors
    ]
    return float(candidate_factors[int(np.argmin(coverage_deviations))])


BLEND = "blend"
METHODS = ("auto", *REGRESSORS, BLEND)
# Maximum number of methods in a blend, which averages their predictions.
_MAX_BLENDED_METHODS = 3
# Maximum error of a chosen blend, relative to the error of the best single method.
_MAX_BLEND_ERROR_RATIO = 0.98


@dataclass(frozen=True)
class MethodResult:
    """Cross-validation result of a regression `method` with one `form` of features.

    `held_out` (presses, targets): predictions for held-out presses; `error`: mean distance of predictions from targets.
    """

    method: str
    form: str
    held_out: Float[np.ndarray, "N d"]
    error: float

    @property
    def name(self) -> str:
        """Name of the regression method and the form of features; for a blend, the names of its members."""
        return f"{self.method}: {self.form}" if self.method == BLEND else f"{self.method} on {self.form}"


@dataclass(frozen=True)
class LearntNumbers:
    """The average of one or several regressors of places or forces, with standard deviations of the predictions.

    `members`: pairs of features and a regressor of standardised targets; a prediction is `mean` + `scale` × the average
    of the members' predictions. `spread`: model of the standard deviations of predictions.
    """

    members: list[tuple[Features, Any]]
    mean: Float[np.ndarray, " d"]
    scale: float
    spread: DeviationModel

    def predict(
        self, changes: Float[np.ndarray, "n m"], reference: Float[np.ndarray, "n m"]
    ) -> Float[np.ndarray, "n d"]:
        """Predict targets (frames, targets) from voltage changes and reference voltages (frames, channels)."""
        prediction_sum = 0.0
        for features, model in self.members:
            prediction_sum = prediction_sum + np.asarray(model.predict(features(changes, reference))).reshape(
                len(changes), -1
            )
        return self.mean + self.scale * prediction_sum / len(self.members)


def learn_numbers(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    targets: Float[np.ndarray, "N d"],
    folds: np.ndarray,
    *,
    method: str = "auto",
    imaged: ImageReconstruction | None = None,
    progress: Callable[[str], None] = lambda message: None,
) -> tuple[LearntNumbers, list[MethodResult]]:
    """Learn to predict places or forces (presses, targets) from voltage changes (presses, channels).

    `reference`: reference voltages of the changes; `imaged`: optional reconstruction of images, which are then used as
    features too; `method`: one of `METHODS`; "auto" chooses the best method, or a blend of methods if its error is
    lower. Quick methods are tried with all forms of features, other methods only with the one or two forms for which a
    quick method has the lowest error. Also returns the results of cross-validation on `folds`, in order of increasing
    error, but with a chosen blend first; for a single `method`, only the results of this method.
    """
    has_reference = reference is not None
    reference = np.zeros_like(changes) if reference is None else reference
    forms = Forms.available(targets, imaged, has_reference=has_reference)
    cross_validation = _CrossValidation(changes, reference, targets, folds, forms)
    method_results = []
    for form in forms.names:
        for quick_method in QUICK_METHODS:
            progress(f"{quick_method} on {form}")
            method_results.append(cross_validation.evaluate_method(quick_method, form))
    best_forms = list(dict.fromkeys(method_result.form for method_result in sorted(method_results, key=_mean_error)))[
        :2
    ]
    slower_methods = [
        method_name
        for method_name in REGRESSORS
        if method_name not in QUICK_METHODS and method in ("auto", BLEND, method_name)
    ]
    for slower_method in slower_methods:
        for form in best_forms if slower_method in ("gaussian-process", "forest") else best_forms[:1]:
            progress(f"{slower_method} on {form}")
            method_results.append(cross_validation.evaluate_method(slower_method, form))
    method_results.sort(key=_mean_error)
    if method not in ("auto", BLEND):
        method_results = [method_result for method_result in method_results if method_result.method == method]
    chosen_results = (
        _choose_methods(method_results, targets, is_blend_wanted=method == BLEND)
        if method in ("auto", BLEND)
        else method_results[:1]
    )
    predictions = np.mean([method_result.held_out for method_result in chosen_results], axis=0)
    if len(chosen_results) > 1:
        method_results.insert(
            0,
            MethodResult(
                BLEND,
                " + ".join(method_result.name for method_result in chosen_results),
                predictions,
                _mean_distance(predictions, targets),
            ),
        )
    ensemble_members = []
    for method_result in chosen_results:
        progress(f"{method_result.method}, all presses")
        fitted_features = forms.learn(
            method_result.form, changes, reference, targets, rotated=method_result.method not in CHANNEL_METHODS
        )
        fitted_regressor = REGRESSORS[method_result.method](
            fitted_features(changes, reference), (targets - cross_validation.mean) / cross_validation.scale
        )
        ensemble_members.append((fitted_features, fitted_regressor))
    is_in_end_fold = (folds == 0) | (folds == folds.max())
    deviation_model = DeviationModel.learn(predictions, changes, predictions - targets, is_in_end_fold)
    return LearntNumbers(
        ensemble_members, cross_validation.mean, cross_validation.scale, deviation_model
    ), method_results


def _choose_methods(
    method_results: list[MethodResult], targets: np.ndarray, *, is_blend_wanted: bool
) -> list[MethodResult]:
    """Choose the regression method with the lowest error, or a blend of methods if its error is lower or
    `is_blend_wanted` is true."""
    best_of_each_method = list(
        {method_result.method: method_result for method_result in reversed(method_results)}.values()
    )
    best_of_each_method = sorted(best_of_each_method, key=_mean_error)[:_MAX_BLENDED_METHODS]
    method_combinations = [best_of_each_method[:num_members] for num_members in range(2, len(best_of_each_method) + 1)]
    best_method_combination = min(
        method_combinations,
        key=lambda blend_results: _mean_distance(
            np.mean([method_result.held_out for method_result in blend_results], axis=0), targets
        ),
    )
    blend_error = _mean_distance(
        np.mean([method_result.held_out for method_result in best_method_combination], axis=0), targets
    )
    return (
        best_method_combination
        if is_blend_wanted or blend_error < _MAX_BLEND_ERROR_RATIO * best_of_each_method[0].error
        else best_of_each_method[:1]
    )


def _mean_error(method_result: MethodResult) -> float:
    return method_result.error


def _mean_distance(predictions: np.ndarray, targets: np.ndarray) -> float:
    """Compute the mean Euclidean distance of predictions from targets."""
    return float(np.linalg.norm(predictions - targets, axis=1).mean())


class _CrossValidation:
    """Cross-validation of regression methods; the features of each form and fold are computed once for all methods."""

    def __init__(self, changes, reference, targets, folds, forms: Forms):
        self.changes, self.reference, self.targets, self.folds = changes, reference, targets, folds
        self.forms = forms
        self.mean = targets.mean(axis=0)
        self.scale = float(np.sqrt(np.mean((targets - self.mean) ** 2)))
        self.features = {}

    def evaluate_method(self, method: str, form: str) -> MethodResult:
        predictions = np.empty_like(self.targets)

        def predict_fold(fold_index: int) -> None:
            is_held_out = self.folds == fold_index
            training_features, held_out_features = self._fold_features(
                form, fold_index, is_held_out, rotated_data=method not in CHANNEL_METHODS
            )
            fitted_regressor = REGRESSORS[method](
                training_features, (self.targets[~is_held_out] - self.mean) / self.scale
            )
            predictions[is_held_out] = self.mean + self.scale * np.asarray(
                fitted_regressor.predict(held_out_features)
            ).reshape(int(is_held_out.sum()), -1)

        apply_over_folds(predict_fold, self.folds.max() + 1)
        return MethodResult(method, form, predictions, _mean_distance(predictions, self.targets))

    def _fold_features(
        self, form: str, fold_index: int, is_held_out: np.ndarray, *, rotated_data: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        if (form, fold_index, rotated_data) not in self.features:
            training_data = self.changes[~is_held_out], self.reference[~is_held_out], self.targets[~is_held_out]
            fitted_features = self.forms.learn(form, *training_data, rotated=rotated_data)
            self.features[form, fold_index, rotated_data] = tuple(
                fitted_features(self.changes[is_selected_press], self.reference[is_selected_press])
                for is_selected_press in (~is_held_out, is_held_out)
            )
        return self.features[form, fold_index, rotated_data]
