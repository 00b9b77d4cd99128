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
    resolution = 1e-4 * distance.max()
    is_received = np.isfinite(power)
    num_distances = np.array(
        [
            np.unique(np.round(tap_distances[row_mask] / resolution)).size
            for tap_distances, row_mask in zip(distance, is_received, strict=True)
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
    reasons, explained_variance = _exclusions_and_explained_variance(fit, faults)
    is_unusable = np.array([bool(reason) for reason in reasons])
    # The disagreement of some microphones with their models may become apparent only after other microphones are
    # excluded.
    while is_unusable.any() and (~fit.dropped & ~is_unusable).sum() >= 3:
        fit = refit_without(fit, is_unusable)
        new_reasons, explained_variance = _exclusions_and_explained_variance(
            fit, ("",) * len(is_unusable), explained_variance
        )
        is_unusable = np.array([bool(reason) for reason in new_reasons]) & ~fit.dropped
        reasons = tuple(
            new_reason if is_newly_unusable else old_reason
            for new_reason, old_reason, is_newly_unusable in zip(new_reasons, reasons, is_unusable, strict=True)
        )
    return fit, ~fit.dropped & ~is_unusable, reasons, explained_variance


def _exclusions_and_explained_variance(
    fit: TapFit, faults, previous_explained_variance=None
) -> tuple[tuple[str, ...], Float[np.ndarray, " M"]]:
    """Return the reason why each microphone is unusable ("" if usable), and the fraction of the variance of its levels
    that its decay model explains. For excluded microphones this fraction is taken from `explained`."""
    expected_levels, level, use = fit.predicted_level(), fit.level, fit.use
    response_decreases = _response_decrease(fit)
    min_readings = len(fit.kind.parameters) + 2
    deviation, relative = fit.noise.deviation, fit.noise.relative
    median_error = float(np.median(relative[use.any(axis=1)])) if use.any() else 0.0
    explained_variance = (
        np.zeros(len(faults)) if previous_explained_variance is None else previous_explained_variance.copy()
    )
    reasons = []
    for k, fault in enumerate(faults):
        is_used = use[k]
        num_received = (is_used & (fit.power[k] > 3 * deviation[k])).sum()
        if not is_used.any():
            reasons.append(fault)
            continue
        variance = np.var(level[k, is_used])
        explained_variance[k] = (
            1 - np.mean((level - expected_levels)[k, is_used] ** 2) / variance if variance > 0 else 0.0
        )
        if response_decreases[k] < _MIN_RESPONSE_DECREASE:
            reasons.append("its intensity does not fall with distance")
        elif is_used.sum() >= min_readings and not explained_variance[k] >= _MIN_EXPLAINED_VARIANCE:
            reasons.append(f"its model explains {100 * max(explained_variance[k], 0):.0f} % of what it received")
        elif num_received < min_readings:
            reasons.append(f"it received {num_received} of the taps only, and {min_readings} are needed")
        elif relative[k] > _MAX_ERROR_RATIO * max(median_error, _MIN_MEDIAN_ERROR):
            reasons.append(
                f"its model is off by {100 * relative[k]:.0f} %, and those of others by {100 * median_error:.0f} %: is "
                "it where it is said to be, and was its gain the same throughout?"
            )
        else:
            reasons.append("")
    return tuple(reasons), explained_variance


def _response_decrease(fit: TapFit) -> Float[np.ndarray, " M"]:
    """Decrease (M,) of the logarithm of each microphone's response from the nearest tap to the farthest."""
    response, use = fit.problem().log_response(fit.values), fit.use
    max_response, min_response = (
        response_decrease(response, axis=1, where=use, initial=initial_value)
        for response_decrease, initial_value in ((np.max, -np.inf), (np.min, np.inf))
    )
    return np.where(use.any(axis=1), max_response - min_response, np.inf)


# Number of folds in the cross-validation.
_NUM_FOLDS = 4
# Minimum relative error of the decay models that is assumed when the likelihood is evaluated on a raster of
# positions.
_MIN_SCREENING_RELATIVE_ERROR = 0.2
# Maximum number of steps of a minimisation.
_MAX_STEPS = 30
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
        finite_distances = self.squared_mahalanobis[np.isfinite(self.squared_mahalanobis)]
        if finite_distances.size < _MIN_LOCATED_TAPS:
            return 1.0
        return max(float(np.quantile(finite_distances, _ERROR_ELLIPSE_COVERAGE)) / _CHI_SQUARE_QUANTILE, 1.0)

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
    errors, squared_mahalanobis = np.full((2, len(tap_positions)), np.nan)
    raster = Localiser.create(_microphone_array(fit, fit.values, microphones, surface)).coarse
    for k in range(int(fold_indices.max()) + 1):
        is_held_out = (fold_indices == k) & ~fit.outlier
        training_fit = replace(fit, outlier=fit.outlier | (fold_indices == k))
        has_readings = np.asarray(training_fit.use.any(axis=1))
        use = fit.usable[:, is_held_out] & has_readings[:, None]
        if not is_held_out.any() or not (use.sum(axis=0) >= 3).any():
            continue
        values, _, _ = fit_with_bounds(training_fit.problem(), fit.values, fit.strength, has_readings, fit.bounds)
        array = _microphone_array(fit, values, microphones, surface)
        estimated_positions, covariance = evaluate_in_numpy(
            _locate_most_likely, array, raster, np.nan_to_num(fit.power[:, is_held_out]), use
        )
        error_vectors = estimated_positions - tap_positions[is_held_out]
        # The pseudoinverse is used, since the covariance on a curved surface is singular.
        is_located = (
            np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(error_vectors).all(axis=1) & (use.sum(axis=0) >= 3)
        )
        inverse = np.linalg.pinv(np.where(is_located[:, None, None], covariance, 0.0), hermitian=True, rcond=1e-9)
        errors[is_held_out] = np.where(is_located, np.linalg.norm(error_vectors, axis=1), np.nan)
        squared_mahalanobis[is_held_out] = np.where(
            is_located, np.einsum("ni,nij,nj->n", np.nan_to_num(error_vectors), inverse, error_vectors), np.nan
        )
    mean_guess_error = float(np.median(np.linalg.norm(tap_positions - tap_positions.mean(axis=0), axis=1)))
    return LeftOutTaps(errors, squared_mahalanobis, mean_guess_error)


def _microphone_array(fit: TapFit, values, microphones, surface: AbstractSurface) -> MicrophoneArray:
    decay = on_device(fit.kind.from_logarithms(host.asarray(values[: len(fit.kind.parameters)])))
    displaced_positions = microphones + fit.problem().displacement(values)
    return MicrophoneArray(as_array(displaced_positions), surface, decay, on_device(fit.noise))


def _locate_most_likely(array: MicrophoneArray, raster: Pixels, power, use):
    """Locate the sources of F frames by Fisher scoring within the bounding box of the outline, starting from the two
    deepest valleys (local minima) on a raster. For a rectangular outline, the returned positions (F, d) and covariances
    (F, d, d) equal those of a `Localiser` up to rounding."""
    xp = namespace(array, power)
    screening_array = eqx.tree_at(
        lambda tree: tree.noise.relative, array, xp.maximum(array.noise.relative, _MIN_SCREENING_RELATIVE_ERROR)
    )
    maps = Likelihood.create(power, use, screening_array).screen(Likelihood.features(screening_array, raster.chart))
    first_positions, second_positions, _ = find_two_lowest_minima(maps, raster)
    pair_likelihood = Likelihood.create(xp.tile(power, 2), xp.tile(use, 2), array)
    low, high = bounding_box(array.surface)
    surface_length, infinite_bound = longer_side(array.surface), xp.full(1, xp.inf)
    minimum = minimise_small(
        lambda unknowns, frames: Likelihood(frames[0], frames[1], frames[2], array).expand(unknowns),
        pair_likelihood.start(xp.concatenate([first_positions, second_positions], axis=1)),
        pair_likelihood.frames,
        lower=xp.concatenate([low, -infinite_bound])[:, None],
        upper=xp.concatenate([high, infinite_bound])[:, None],
        largest_step=xp.array([[surface_length / 4], [surface_length / 4], [2.3]]),
        max_steps=_MAX_STEPS,
        tolerance=1e-8,
    )
    value = xp.where(xp.isfinite(minimum.value), minimum.value, xp.inf).reshape(2, -1)
    best_index = value.argmin(axis=0) * power.shape[1] + xp.arange(power.shape[1])
    unknowns = minimum.x[:, best_index]
    covariance = inverse_small(Likelihood.create(power, use, array).expand(unknowns)[2])[:2, :2]
    return to_three_dimensions(array.surface, unknowns[:2], covariance)


def _assign_folds(tap_positions: Float[np.ndarray, "T d"]) -> Int[np.ndarray, " T"]:
    """Index (T,) of the fold of each tap in the cross-validation. Distinct positions are assigned to the folds in turn,
    in a fixed random order."""
    resolution = 1e-4 * max(float(np.ptp(tap_positions, axis=0).max()), 1e-300)
    _, position_indices = np.unique(np.round(tap_positions / resolution), axis=0, return_inverse=True)
    random_order = np.random.default_rng(0).permutation(position_indices.max() + 1)
    return (random_order % _NUM_FOLDS)[position_indices.ravel()]
