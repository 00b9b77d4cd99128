"""Selection of usable microphones, and cross-validation of decay models.

Microphones that received too few taps, or whose levels disagree with their decay model, are excluded from a
calibration.

Decay models are compared by their localisation errors for taps left out of the fit. The tapped positions are divided
into four folds, and the taps of each fold are located with models fitted to the other folds. All taps at one position
are in the same fold, so that the models were not fitted to any tap at that position.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.acoustic.calibration.decay_fit import fit_with_bounds
from jeit.acoustic.calibration.robust_least_squares import TapFit, refit_without
from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.localisation.pixels import Pixels, find_two_lowest_minima
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.surface import AbstractSurface, bounding_box, longer_side, to_three_dimensions
from jeit_solvers import inverse_small, minimise_small
from jeit_solvers.engines import as_array, evaluate_in_numpy, host, namespace, on_device

# Minimum fraction of the variance of a microphone's levels that its decay model must explain.
_MIN_EXPLAINED_VARIANCE = 0.3
# Maximum ratio of a microphone's relative error to the median error over all microphones, and lower bound of this
# median.
_MAX_ERROR_RATIO, _MIN_MEDIAN_ERROR = 2.5, 0.1
# Minimum decrease of the logarithm of a microphone's response from the nearest to the farthest tap.
_MIN_RESPONSE_DECREASE = 0.1


def check_received(
    decay_class: type[AbstractDecay], distance: Float[np.ndarray, "M T"], power: Float[np.ndarray, "M T"], faults
) -> tuple[Bool[np.ndarray, " M"], str]:
    """Return the mask of the microphones that received taps from enough different distances, and a reason. If there are
    fewer than three such microphones, the reason says why the decay model cannot be fitted; otherwise it is empty."""
    min_distances = len(decay_class.parameters) + 2
    distance_resolution = 1e-4 * distance.max()
    is_received_intensity = np.isfinite(power)
    num_distances = np.array(
        [
            np.unique(np.round(tap_distances[is_received_tap] / distance_resolution)).size
            for tap_distances, is_received_tap in zip(distance, is_received_intensity, strict=True)
        ]
    )
    has_enough_distances = num_distances >= min_distances
    if has_enough_distances.sum() >= 3:
        return has_enough_distances, ""
    return has_enough_distances, (
        f"only {has_enough_distances.sum()} of {len(has_enough_distances)} microphones received taps from "
        f"{min_distances} distances or more, and three are needed to calibrate a decay model of "
        f"{len(decay_class.parameters)} parameters: tap all over the skin. {describe_faults(faults)}"
    ).strip()


def exclude_unusable(
    fit: TapFit, faults
) -> tuple[TapFit, Bool[np.ndarray, " M"], tuple[str, ...], Float[np.ndarray, " M"]]:
    """Repeat the fit of the decay models without the unusable microphones.

    Returns the new fit, the mask of the usable microphones, the reasons why microphones are unusable ("" for usable
    microphones), and the fraction of the variance of each microphone's levels that its model explains.
    """
    exclusion_reasons, explained_variance = _exclusions_and_explained_variance(fit, faults)
    is_unusable_microphone = np.array([bool(exclusion_reason) for exclusion_reason in exclusion_reasons])
    # The disagreement of some microphones with their models may become apparent only after other microphones are
    # excluded.
    while is_unusable_microphone.any() and (~fit.dropped & ~is_unusable_microphone).sum() >= 3:
        fit = refit_without(fit, is_unusable_microphone)
        new_reasons, explained_variance = _exclusions_and_explained_variance(
            fit, ("",) * len(is_unusable_microphone), explained_variance
        )
        is_unusable_microphone = np.array([bool(exclusion_reason) for exclusion_reason in new_reasons]) & ~fit.dropped
        exclusion_reasons = tuple(
            new_reason if is_newly_unusable else old_reason
            for new_reason, old_reason, is_newly_unusable in zip(
                new_reasons, exclusion_reasons, is_unusable_microphone, strict=True
            )
        )
    return fit, ~fit.dropped & ~is_unusable_microphone, exclusion_reasons, explained_variance


def _exclusions_and_explained_variance(
    fit: TapFit, faults, previous_explained_variance=None
) -> tuple[tuple[str, ...], Float[np.ndarray, " M"]]:
    """Return the reason why each microphone is unusable ("" if usable), and the fraction of the variance of its levels
    that its decay model explains. For excluded microphones this fraction is taken from `explained`."""
    expected_levels, measured_levels, is_used_reading = fit.predicted_level(), fit.level, fit.use
    response_decreases = _response_decrease(fit)
    min_readings = len(fit.kind.parameters) + 2
    additive_deviation, relative_error = fit.noise.deviation, fit.noise.relative
    median_error = float(np.median(relative_error[is_used_reading.any(axis=1)])) if is_used_reading.any() else 0.0
    explained_variance = (
        np.zeros(len(faults)) if previous_explained_variance is None else previous_explained_variance.copy()
    )
    exclusion_reasons = []
    for k, microphone_fault in enumerate(faults):
        is_used_tap = is_used_reading[k]
        num_received = (is_used_tap & (fit.power[k] > 3 * additive_deviation[k])).sum()
        if not is_used_tap.any():
            exclusion_reasons.append(microphone_fault)
            continue
        level_variance = np.var(measured_levels[k, is_used_tap])
        explained_variance[k] = (
            1 - np.mean((measured_levels - expected_levels)[k, is_used_tap] ** 2) / level_variance
            if level_variance > 0
            else 0.0
        )
        if response_decreases[k] < _MIN_RESPONSE_DECREASE:
            exclusion_reasons.append("its intensity does not fall with distance")
        elif is_used_tap.sum() >= min_readings and not explained_variance[k] >= _MIN_EXPLAINED_VARIANCE:
            exclusion_reasons.append(
                f"its model explains {100 * max(explained_variance[k], 0):.0f} % of what it received"
            )
        elif num_received < min_readings:
            exclusion_reasons.append(f"it received {num_received} of the taps only, and {min_readings} are needed")
        elif relative_error[k] > _MAX_ERROR_RATIO * max(median_error, _MIN_MEDIAN_ERROR):
            exclusion_reasons.append(
                f"its model is off by {100 * relative_error[k]:.0f} %, and those of others by {100 * median_error:.0f} "
                "%: is it where it is said to be, and was its gain the same throughout?"
            )
        else:
            exclusion_reasons.append("")
    return tuple(exclusion_reasons), explained_variance


def _response_decrease(fit: TapFit) -> Float[np.ndarray, " M"]:
    """Decrease (M,) of the logarithm of each microphone's response from the nearest tap to the farthest."""
    log_responses, is_used_reading = fit.problem().log_response(fit.values), fit.use
    max_response, min_response = (
        extremum_function(log_responses, axis=1, where=is_used_reading, initial=initial_value)
        for extremum_function, initial_value in ((np.max, -np.inf), (np.min, np.inf))
    )
    return np.where(is_used_reading.any(axis=1), max_response - min_response, np.inf)


# Number of folds in the cross-validation.
_NUM_FOLDS = 4
# Minimum relative error of the decay models that is assumed when the likelihood is evaluated on a raster of
# positions.
_MIN_SCREENING_RELATIVE_ERROR = 0.2
# Maximum number of steps of a minimisation.
_MAX_LOCATION_STEPS = 30
# Minimum number of located taps for an estimate of `widening`; fraction of the taps that the error ellipses must
# contain; quantile of χ² with two degrees of freedom for this fraction.
_MIN_LOCATED_TAPS, _ERROR_ELLIPSE_COVERAGE = 10, 0.9
_CHI_SQUARE_QUANTILE = -2 * math.log(1 - _ERROR_ELLIPSE_COVERAGE)


class LeftOutTaps(NamedTuple):
    """Localisation errors of T taps that were left out of the fit.

    **Fields**: `errors`: distance (T,) of each estimated position from the given position in metres;
    `squared_mahalanobis`: squared Mahalanobis distance (T,), the squared error in units of the covariance;
    `mean_guess_error`: median distance in metres of the given positions from their mean. `errors` and
    `squared_mahalanobis` are NaN for outliers and for taps that could not be located.
    """

    errors: Float[np.ndarray, " T"]
    squared_mahalanobis: Float[np.ndarray, " T"]
    mean_guess_error: float

    @property
    def median(self) -> float:
        """Median localisation error of the left-out taps in metres; infinite if no tap was located."""
        finite_errors = self.errors[np.isfinite(self.errors)]
        return float(np.median(finite_errors)) if finite_errors.size else np.inf

    @property
    def widening(self) -> float:
        """Factor on covariances for which the 90 % error ellipses contain 90 % of the left-out taps. The factor is at
        least 1, since the errors of the decay models may be larger at other positions."""
        finite_squared_distances = self.squared_mahalanobis[np.isfinite(self.squared_mahalanobis)]
        if finite_squared_distances.size < _MIN_LOCATED_TAPS:
            return 1.0
        return max(float(np.quantile(finite_squared_distances, _ERROR_ELLIPSE_COVERAGE)) / _CHI_SQUARE_QUANTILE, 1.0)

    @property
    def is_better_than_mean(self) -> bool:
        """Whether the median localisation error is less than half of the error of always guessing the mean position."""
        return self.median < 0.5 * self.mean_guess_error


def locate_held_out_taps(
    fit: TapFit,
    microphones: Float[np.ndarray, "M d"],
    surface: AbstractSurface,
    tap_positions: Float[np.ndarray, "T d"],
) -> LeftOutTaps:
    """Locate each tap with decay models and displacements fitted to taps in other folds, and with the noise of the fit
    to all taps. `microphones`: given positions."""
    fold_indices = _assign_folds(tap_positions)
    localisation_errors, squared_mahalanobis = np.full((2, len(tap_positions)), np.nan)
    coarse_pixels = Localiser.create(_microphone_array(fit, fit.values, microphones, surface)).coarse
    for k in range(int(fold_indices.max()) + 1):
        is_held_out = (fold_indices == k) & ~fit.outlier
        training_fit = replace(fit, outlier=fit.outlier | (fold_indices == k))
        has_readings = np.asarray(training_fit.use.any(axis=1))
        is_used_reading = fit.usable[:, is_held_out] & has_readings[:, None]
        if not is_held_out.any() or not (is_used_reading.sum(axis=0) >= 3).any():
            continue
        training_values, _, _ = fit_with_bounds(
            training_fit.problem(), fit.values, fit.strength, has_readings, fit.bounds
        )
        microphone_array = _microphone_array(fit, training_values, microphones, surface)
        estimated_positions, position_covariance = evaluate_in_numpy(
            _locate_most_likely,
            microphone_array,
            coarse_pixels,
            np.nan_to_num(fit.power[:, is_held_out]),
            is_used_reading,
        )
        error_vectors = estimated_positions - tap_positions[is_held_out]
        # The pseudoinverse is used, since the covariance on a curved surface is singular.
        is_located_tap = (
            np.isfinite(position_covariance).all(axis=(1, 2))
            & np.isfinite(error_vectors).all(axis=1)
            & (is_used_reading.sum(axis=0) >= 3)
        )
        inverse_covariance = np.linalg.pinv(
            np.where(is_located_tap[:, None, None], position_covariance, 0.0), hermitian=True, rcond=1e-9
        )
        localisation_errors[is_held_out] = np.where(is_located_tap, np.linalg.norm(error_vectors, axis=1), np.nan)
        squared_mahalanobis[is_held_out] = np.where(
            is_located_tap,
            np.einsum("ni,nij,nj->n", np.nan_to_num(error_vectors), inverse_covariance, error_vectors),
            np.nan,
        )
    mean_guess_error = float(np.median(np.linalg.norm(tap_positions - tap_positions.mean(axis=0), axis=1)))
    return LeftOutTaps(localisation_errors, squared_mahalanobis, mean_guess_error)


def _microphone_array(fit: TapFit, parameter_values, microphones, surface: AbstractSurface) -> MicrophoneArray:
    decay_model = on_device(fit.kind.from_logarithms(host.asarray(parameter_values[: len(fit.kind.parameters)])))
    displaced_positions = microphones + fit.problem().displacement(parameter_values)
    return MicrophoneArray(as_array(displaced_positions), surface, decay_model, on_device(fit.noise))


def _locate_most_likely(microphone_array: MicrophoneArray, coarse_pixels: Pixels, tap_power, is_used_reading):
    """Locate the sources of F frames by Fisher scoring within the bounding box of the outline, starting from the two
    deepest valleys (local minima) on a raster. For a rectangular outline, the returned positions (F, d) and covariances
    (F, d, d) equal those of a `Localiser` up to rounding."""
    xp = namespace(microphone_array, tap_power)
    screening_array = eqx.tree_at(
        lambda array_to_change: array_to_change.noise.relative,
        microphone_array,
        xp.maximum(microphone_array.noise.relative, _MIN_SCREENING_RELATIVE_ERROR),
    )
    likelihood_maps = Likelihood.create(tap_power, is_used_reading, screening_array).screen(
        Likelihood.features(screening_array, coarse_pixels.chart)
    )
    first_positions, second_positions, _ = find_two_lowest_minima(likelihood_maps, coarse_pixels)
    pair_likelihood = Likelihood.create(xp.tile(tap_power, 2), xp.tile(is_used_reading, 2), microphone_array)
    lower_corner, upper_corner = bounding_box(microphone_array.surface)
    surface_length, infinite_bound = longer_side(microphone_array.surface), xp.full(1, xp.inf)
    cost_minimum = minimise_small(
        lambda source_unknowns, frame_data: Likelihood(
            frame_data[0], frame_data[1], frame_data[2], microphone_array
        ).expand(source_unknowns),
        pair_likelihood.start(xp.concatenate([first_positions, second_positions], axis=1)),
        pair_likelihood.frames,
        lower=xp.concatenate([lower_corner, -infinite_bound])[:, None],
        upper=xp.concatenate([upper_corner, infinite_bound])[:, None],
        largest_step=xp.array([[surface_length / 4], [surface_length / 4], [2.3]]),
        max_steps=_MAX_LOCATION_STEPS,
        tolerance=1e-8,
    )
    lowest_costs = xp.where(xp.isfinite(cost_minimum.value), cost_minimum.value, xp.inf).reshape(2, -1)
    best_start_indices = lowest_costs.argmin(axis=0) * tap_power.shape[1] + xp.arange(tap_power.shape[1])
    source_unknowns = cost_minimum.x[:, best_start_indices]
    position_covariance = inverse_small(
        Likelihood.create(tap_power, is_used_reading, microphone_array).expand(source_unknowns)[2]
    )[:2, :2]
    return to_three_dimensions(microphone_array.surface, source_unknowns[:2], position_covariance)


def _assign_folds(tap_positions: Float[np.ndarray, "T d"]) -> Int[np.ndarray, " T"]:
    """Index (T,) of the fold of each tap in the cross-validation. Distinct positions are assigned to the folds in turn,
    in a fixed random order."""
    position_resolution = 1e-4 * max(float(np.ptp(tap_positions, axis=0).max()), 1e-300)
    _, position_indices = np.unique(np.round(tap_positions / position_resolution), axis=0, return_inverse=True)
    random_order = np.random.default_rng(0).permutation(position_indices.max() + 1)
    return (random_order % _NUM_FOLDS)[position_indices.ravel()]
