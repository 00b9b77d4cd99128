"""Robust fit of the decay models of all microphones, the strengths of all taps, and the noise of each microphone.

Arrays are (M, T) for M microphones and T taps. The fitted data are levels, log(power + noise floor).

The fit is an iteratively reweighted least-squares fit. First, all microphones share the shape of the response, that is,
all parameters of the decay model except the gain; almost any set of taps determines the shared shape. Then each
microphone has its own shape, with the variation of the shapes over the array as the prior, and its own displacement
from its given position. Between fits, the noise and the weights are re-estimated from the residuals, until convergence.
Each step takes a `TapFit` and returns a new `TapFit`.

The noise of a microphone consists of a relative error and an additive deviation; see `jeit.acoustic.microphones`.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jeit.acoustic.calibration.decay_fit import DecayProblem, fit_strengths, fit_with_bounds, log_covariance
from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.microphones import MIN_RELATIVE_ERROR, IntensityNoise, noise_from_negative_powers
from jeit_solvers.engines import host, on_host, slopes
from jeit_solvers.module import Module

# Residuals of levels larger than this number of standard deviations are excluded from the noise estimate.
_MAX_RESIDUAL_DEVIATIONS = 4.0
# Weight of the median over all microphones in the noise estimate of one microphone, as a number of taps.
_MEDIAN_WEIGHT_IN_TAPS = 20.0
# Minimum number of taps for an estimate of the additive noise.
_MIN_TAPS = 8


def relative_errors(
    noise: IntensityNoise,
    received_power: Float[np.ndarray, "M T"],
    residual: Float[np.ndarray, "M T"],
    use: Bool[np.ndarray, "M T"],
    fixed_parameter_inflation: float,
) -> Float[np.ndarray, " M"]:
    """Estimate the relative error τ of each microphone from the mean square of its level residuals in excess of the
    variance of additive noise. Outliers are excluded.

    `received_power`: expected power. `use`: mask of the residuals to use. `fixed_parameter_inflation`: factor on
    squared residuals that corrects for the number of fitted parameters. Since the excess variance may be zero or
    negative if there are few taps, each estimate is shrunk towards the median over all microphones, with the weight of
    20 taps.
    """
    floor, additive_deviation, cross_coefficients = (np.asarray(x) for x in (noise.floor, noise.deviation, noise.cross))
    num_inliers, excess_errors = np.zeros(len(received_power)), np.zeros(len(received_power))
    for k in range(len(received_power)):
        is_used = use[k] & (received_power[k] > 3 * additive_deviation[k])
        if is_used.sum() < 3:
            continue
        signal_power, usable_residual = received_power[k, is_used], residual[k, is_used]
        squared_signal_share = (signal_power / (signal_power + floor[k])) ** 2
        additive_variance = (cross_coefficients[k] * signal_power + additive_deviation[k] ** 2) / (
            signal_power + floor[k]
        ) ** 2
        is_inlier = np.abs(usable_residual) <= _MAX_RESIDUAL_DEVIATIONS * max(
            1.4826 * np.median(np.abs(usable_residual)), 1e-15
        )
        for _ in range(3):
            is_inlier = np.abs(usable_residual) <= _MAX_RESIDUAL_DEVIATIONS * np.sqrt(
                np.mean(usable_residual[is_inlier] ** 2)
            )
        num_inliers[k] = is_inlier.sum()
        excess_errors[k] = (
            fixed_parameter_inflation * np.mean(usable_residual[is_inlier] ** 2) - np.mean(additive_variance[is_inlier])
        ) / np.mean(squared_signal_share[is_inlier])
    if not num_inliers.any():
        return np.full(len(received_power), 0.5)
    median_excess = max(float(np.median(excess_errors[num_inliers > 0])), 0.0)
    shrunk_excess = (num_inliers * np.minimum(excess_errors, 1.0) + _MEDIAN_WEIGHT_IN_TAPS * median_excess) / (
        num_inliers + _MEDIAN_WEIGHT_IN_TAPS
    )
    return np.sqrt(np.maximum(shrunk_excess, MIN_RELATIVE_ERROR**2))


def additive_deviations(
    power: Float[np.ndarray, "M T"],
    received_power: Float[np.ndarray, "M T"],
    use: Bool[np.ndarray, "M T"],
    fixed_parameter_inflation: float,
) -> Float[np.ndarray, " M"]:
    """Estimate the additive deviation s of each microphone: the standard deviation of its intensity without a source.
    The estimate is needed if the noise was not measured.

    The relative error and the additive deviation are estimated together by maximum likelihood, on a grid and then on a
    finer grid near the maximum. The additive deviation is 0 unless additive noise clearly increases the likelihood. The
    estimate is at least half the median over all microphones, since few taps determine the noise poorly, and
    underestimated noise causes false detections.
    """
    additive_deviation = np.zeros(len(received_power))
    trial_additive_variance_shares = np.concatenate([[0.0], np.geomspace(1e-6, 0.5, 18)])
    trial_errors = np.geomspace(MIN_RELATIVE_ERROR, 1.0, 30)
    for k in range(len(received_power)):
        if use[k].sum() < _MIN_TAPS:
            continue
        tap_power, signal_power = power[k, use[k]], received_power[k, use[k]]
        max_power = np.abs(tap_power).max()
        if max_power == 0:
            continue

        def negative_log_likelihood(
            relative_deviations, tap_power=tap_power, signal_power=signal_power, max_power=max_power
        ):
            variance = (
                (trial_errors[:, None, None] * signal_power) ** 2
                + (max_power * relative_deviations[:, None]) ** 2
                + 1e-30 * max_power**2
            )
            squared_ratio = np.minimum(
                fixed_parameter_inflation * (tap_power - signal_power) ** 2 / variance, _MAX_RESIDUAL_DEVIATIONS**2
            )
            return np.sum(squared_ratio + np.log(variance), axis=-1).min(axis=0)

        trial_costs = negative_log_likelihood(trial_additive_variance_shares)
        best_index = int(trial_costs.argmin())
        if trial_costs[best_index] < trial_costs[0] - 6:
            refined_trial_shares = trial_additive_variance_shares[best_index] * np.geomspace(0.5, 2.0, 9)
            additive_deviation[k] = (
                max_power * refined_trial_shares[negative_log_likelihood(refined_trial_shares).argmin()]
            )
    has_enough_taps = use.sum(axis=1) >= _MIN_TAPS
    median_deviation = float(np.median(additive_deviation[has_enough_taps])) if has_enough_taps.any() else 0.0
    return np.where(has_enough_taps, np.maximum(additive_deviation, 0.5 * median_deviation), additive_deviation)


# Maximum number of iterations of the fit with a shared shape, and of the fit with individual shapes.
_MAX_SHARED_ITERATIONS, _MAX_INDIVIDUAL_ITERATIONS = 6, 12
# Degrees of freedom of Student's t distribution, from which the weights of the residuals are derived.
_STUDENT_DEGREES_OF_FREEDOM = 5.0
# Ratio of the mean square residual of a tap to the median over all taps, above which the tap is excluded as an outlier.
_MAX_TAP_RESIDUAL_RATIO = 12.0
# Standard deviation of the logarithms of the shape parameters over the array: in the fit with a shared shape.
_SHARED_SHAPE_DEVIATION = 0.03
# Standard deviation at the start of the fit with individual shapes, and its limits.
_INITIAL_SHAPE_DEVIATION = 0.5
_MIN_SHAPE_DEVIATION = 0.1
_MAX_SHAPE_DEVIATION = 1.0
# Maximum displacement of a microphone along each coordinate, in units of `place_error`.
_MAX_RELATIVE_DISPLACEMENT = 4.0
# Relative standard error of the shape at or above which a microphone's own taps are considered not to determine the
# shape.
_UNDETERMINED_SHAPE_ERROR = 0.5


class TapFit(Module):
    """State of the robust fit of M microphones to T taps.

    - `kind`: class of the decay model.
    - `offset`: (M, T, d) vectors from the taps to the given positions of the microphones in metres.
    - `place_error`: standard deviation of each coordinate of the given positions in metres; 0 if the positions are
      exact.
    - `power`: (M, T) intensities of the taps minus the noise floor; NaN where not usable.
    - `noise`: noise of the microphones. `known_noise`: whether the noise floor was measured.
    - `values`: (P, M) logarithms of the K parameters of the decay models and, if `place_error` is not 0, the d
      coordinates of the microphones' displacements divided by `place_error`: P is K or K + d.
    - `at_bound`: (P, M) mask of the parameters that are fixed at a bound.
    - `spread`: (P,) standard deviation of each of the values over the array, used as the prior.
    - `strength`: (T,) logarithms of the strengths of the taps.
    - `weight`: (M, T) inverse variances of the levels, reduced for large residuals.
    - `outlier`: (T,) mask of the taps excluded from the fit. `dropped`: (M,) mask of the microphones excluded from the
      fit.
    - `bounds`: lower and upper bounds (P,) of the values.
    """

    kind: type[AbstractDecay] = eqx.field(static=True)
    offset: Float[np.ndarray, "M T d"]
    place_error: float
    power: Float[np.ndarray, "M T"]
    noise: IntensityNoise
    known_noise: bool
    values: Float[np.ndarray, "P M"]
    at_bound: Bool[np.ndarray, "P M"]
    spread: Float[np.ndarray, " P"]
    strength: Float[np.ndarray, " T"]
    weight: Float[np.ndarray, "M T"]
    outlier: Bool[np.ndarray, " T"]
    dropped: Bool[np.ndarray, " M"]
    bounds: tuple[np.ndarray, np.ndarray]

    @property
    def logarithms(self) -> Float[np.ndarray, "K M"]:
        """Logarithms (K, M) of the K parameters of the decay models."""
        return self.values[: len(self.kind.parameters)]

    @property
    def displacement(self) -> Float[np.ndarray, "M d"]:
        """Estimated displacements of the microphones from their given positions in metres."""
        return self.problem().displacement(self.values)

    @property
    def usable(self) -> Bool[np.ndarray, "M T"]:
        """Mask of the readings (intensities of taps at microphones) with a finite level, of microphones that are not
        excluded."""
        is_positive_intensity = np.nan_to_num(self.power, nan=-np.inf) + self.noise.floor[:, None] > 0
        return is_positive_intensity & ~self.dropped[:, None]

    @property
    def use(self) -> Bool[np.ndarray, "M T"]:
        """Mask of the readings used in the fit: usable readings of taps that are not excluded."""
        return self.usable & ~self.outlier

    @property
    def received(self) -> Bool[np.ndarray, " T"]:
        """Mask of the taps with at least one reading used in the fit."""
        return np.asarray(self.use.any(axis=0))

    @property
    def is_fitted_parameter(self) -> Bool[np.ndarray, "P M"]:
        """Mask of the parameters that are fitted to data: those of microphones with usable readings, except parameters
        fixed at a bound."""
        return ~self.at_bound & self.usable.any(axis=1)

    @property
    def shared(self) -> Bool[np.ndarray, " M"]:
        """Mask of the microphones whose own readings do not determine the decay of the response with distance. The
        prior from the other microphones then determines the decay.

        If no tap was near a microphone, the data give only an upper bound of the parameter b of the decay model.
        Without the prior, b could be very small, and estimated positions would be drawn to that microphone.
        """
        unlimited_spread = np.where(np.arange(len(self.spread)) == 1, np.inf, self.spread)
        individual_errors = standard_errors(replace(self, spread=unlimited_spread))[1]
        return self.usable.any(axis=1) & ~self.at_bound[1] & ~(individual_errors < _UNDETERMINED_SHAPE_ERROR)

    @property
    def level(self) -> Float[np.ndarray, "M T"]:
        """Levels y = log(power + floor) of the readings, with an arbitrary value where a reading is not usable."""
        return np.asarray(self.noise.level(host.where(self.usable, self.power, 1.0)))

    def problem(self, *, with_outliers: bool = False) -> DecayProblem:
        """Create the least-squares problem of the fit with the current weights, optionally including the excluded
        taps."""
        weight = np.where(self.usable if with_outliers else self.use, self.weight, 0.0)
        floor = np.asarray(self.noise.floor)
        return DecayProblem(self.level, self.offset, weight, floor, self.kind, self.spread, self.place_error)

    def predicted_level(self) -> Float[np.ndarray, "M T"]:
        """Levels (M, T) predicted by the fitted decay models."""
        return self.problem().expected_levels(self.values, self.strength)[0]


def fit_taps(
    kind: type[AbstractDecay],
    microphones: Float[np.ndarray, "M d"],
    tap_positions: Float[np.ndarray, "T d"],
    power: Float[np.ndarray, "M T"],
    noise: IntensityNoise,
    known_noise: bool,
    place_error: float,
) -> TapFit:
    """Fit the decay model `kind` to all microphones: first with a shared shape, then with individual shapes and
    displacements. `microphones`, `tap_positions`: given positions in metres; the other arguments are fields of
    `TapFit`."""
    tap_offsets = microphones[:, None] - tap_positions
    array_size = float(np.linalg.norm(tap_offsets, axis=-1).max())
    microphone_spacing = (
        float(np.median(KDTree(microphones).query(microphones, k=2)[0][:, 1])) if len(microphones) > 1 else 0.0
    )
    num_displacements = tap_offsets.shape[2] if place_error > 0 else 0
    lower_limits, upper_limits = kind.bounds(array_size)
    lower_bounds, upper_bounds = (
        np.array([*lower_limits, *[-_MAX_RELATIVE_DISPLACEMENT] * num_displacements]),
        np.array([*upper_limits, *[_MAX_RELATIVE_DISPLACEMENT] * num_displacements]),
    )
    initial_values = np.asarray(
        kind.start(microphone_spacing if microphone_spacing > 0 else array_size / 4, len(microphones)).logarithms()
    )
    initial_values = np.concatenate([initial_values, np.zeros((num_displacements, len(microphones)))])
    num_shapes, num_taps = len(kind.parameters) - 1, len(tap_positions)
    fit = TapFit(
        kind,
        tap_offsets,
        place_error,
        power,
        on_host(noise),
        known_noise,
        values=np.clip(initial_values, lower_bounds[:, None], upper_bounds[:, None]),
        at_bound=np.zeros(initial_values.shape, bool),
        spread=_prior_spread(
            np.full(num_shapes, _SHARED_SHAPE_DEVIATION), np.full(num_displacements, _SHARED_SHAPE_DEVIATION)
        ),
        strength=np.zeros(num_taps),
        weight=np.zeros(power.shape),
        outlier=np.zeros(num_taps, bool),
        dropped=np.zeros(len(microphones), bool),
        bounds=(lower_bounds, upper_bounds),
    )
    # The initial strength of a tap is estimated from the loudest microphone only.
    used_power = np.where(fit.use, power, -np.inf)
    loudest_index = used_power.argmax(axis=0), np.arange(num_taps)
    log_responses = fit.problem().log_response(fit.values)
    strength = np.log(np.clip(used_power[loudest_index], 1e-300, 1e300)) - log_responses[loudest_index]
    fit = replace(
        fit,
        strength=np.where(fit.received & np.isfinite(strength), strength, 0.0),
        # The relative error of the initial model is assumed to be at least 20 %.
        weight=1 / np.maximum(_level_variance(fit, np.nan_to_num(np.maximum(power, 0.0))), 0.04),
    )
    fit = _alternate_fits(fit, _MAX_SHARED_ITERATIONS)
    return _alternate_fits(
        replace(fit, spread=_prior_spread(np.full(num_shapes, _INITIAL_SHAPE_DEVIATION), np.ones(num_displacements))),
        _MAX_INDIVIDUAL_ITERATIONS,
        updates_shape_deviation=True,
    )


def refit_without(fit: TapFit, is_excluded: Bool[np.ndarray, " M"]) -> TapFit:
    """Repeat the fit of the decay models without the microphones in the mask `is_excluded`."""
    return _alternate_fits(
        replace(fit, dropped=fit.dropped | is_excluded), _MAX_INDIVIDUAL_ITERATIONS, updates_shape_deviation=True
    )


def standard_errors(fit: TapFit) -> Float[np.ndarray, "P M"]:
    """Standard deviations (P, M) of the fitted values, for gains normalised as in a `Calibration`; NaN for values fixed
    at a bound."""
    is_fitted = fit.is_fitted_parameter
    if is_fitted[0].sum() < 2:
        return np.full(is_fitted.shape, np.nan)
    num_parameters = len(fit.kind.parameters)

    def log_gains(values):
        return np.where(is_fitted[0], np.log(fit.kind.from_logarithms(values[:num_parameters]).gain), 0.0)

    gain_gradient = np.ravel(slopes(log_gains, fit.values)[1])
    covariance = log_covariance(fit.problem(), fit.values, fit.strength, is_fitted, gain_gradient)
    return np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(is_fitted.shape)


def _alternate_fits(fit: TapFit, max_iterations: int, *, updates_shape_deviation: bool = False) -> TapFit:
    """Alternate between the fit of all microphones and the re-estimation of noise and weights, until convergence or for
    `max_iterations` iterations. If `updates_shape_deviation`, the `spread` of the parameters is also re-estimated."""
    for _ in range(max_iterations):
        previous_values, has_readings = fit.values, np.asarray(fit.usable.any(axis=1))
        values, strength, is_at_bound = fit_with_bounds(
            fit.problem(), previous_values, fit.strength, has_readings, fit.bounds
        )
        fit = replace(fit, values=values, strength=strength, at_bound=is_at_bound)
        strength = fit_strengths(fit.problem(with_outliers=True), fit.values, fit.strength)
        fit = _update_noise_and_weights(replace(fit, strength=strength))
        if updates_shape_deviation:
            fit = replace(fit, spread=_update_spread(fit))
        if np.abs(fit.values - previous_values)[fit.is_fitted_parameter].max(initial=0.0) < 1e-9:
            break
    return fit


def _prior_spread(shape_spreads, displacement_spreads) -> Float[np.ndarray, " P"]:
    """Concatenate the spreads (P,) of all values: of the gain (infinite, since the gain has no prior), of the shape
    parameters (`shape_spreads`) and of the displacements (`displacement_spreads`)."""
    return np.concatenate([[np.inf], shape_spreads, displacement_spreads])


def _update_spread(fit: TapFit) -> Float[np.ndarray, " P"]:
    """Update the spread of the shape parameters and of the displacements over the array by one step of expectation
    maximisation, from the estimates and their standard errors."""
    has_readings = fit.usable.any(axis=1)
    if has_readings.sum() < 2:
        return fit.spread
    num_parameters, value_errors = len(fit.kind.parameters), np.nan_to_num(standard_errors(fit)[:, has_readings])
    shape_values, displacements = fit.logarithms[1:, has_readings], fit.values[num_parameters:, has_readings]
    # Deviations from the median are limited, so that an outlying microphone does not dominate.
    deviations = np.abs(shape_values - np.median(shape_values, axis=1, keepdims=True))
    limited_deviations = np.minimum(deviations, 3 * fit.spread[1:num_parameters, None])
    shape_variance = (limited_deviations**2 + value_errors[1:num_parameters] ** 2).sum(axis=1) / (
        has_readings.sum() - 1
    )
    # All coordinates of the displacements have the same spread, which is at most `place_error`.
    displacement_variance = np.full(
        len(displacements),
        (displacements**2 + value_errors[num_parameters:] ** 2).mean() if displacements.size else 0.0,
    )
    return _prior_spread(
        *(
            np.clip(np.sqrt(value_variance), _MIN_SHAPE_DEVIATION, _MAX_SHAPE_DEVIATION)
            for value_variance in (shape_variance, displacement_variance)
        )
    )


def _update_noise_and_weights(fit: TapFit) -> TapFit:
    """Re-estimate the microphones' noise, the outlying taps and the weights from the residuals of the fit."""
    expected_levels = fit.predicted_level()
    received_power = np.maximum(np.exp(expected_levels) - fit.noise.floor[:, None], 0.0)
    # The residuals are smaller than the errors of the data, since strengths and parameters were fitted to the data;
    # `residual_inflation` corrects for the difference.
    num_readings = fit.use.sum()
    num_fitted = fit.received.sum() + fit.is_fitted_parameter.sum()
    residual_inflation = num_readings / max(num_readings - num_fitted, 0.1 * num_readings)
    if not fit.known_noise:
        is_used = np.isfinite(fit.power) & ~fit.outlier
        additive_deviation = additive_deviations(fit.power, received_power, is_used, residual_inflation)
        negative_power_deviation = noise_from_negative_powers(fit.power.T, np.isfinite(fit.power.T))
        fit = replace(
            fit,
            noise=on_host(
                IntensityNoise.create(
                    len(received_power), deviation=np.maximum(additive_deviation, negative_power_deviation)
                )
            ),
        )
    relative_error = relative_errors(
        fit.noise, received_power, _residual_for_equal_errors(fit, received_power), fit.use, residual_inflation
    )
    fit = replace(fit, noise=replace(fit.noise, relative=relative_error))
    residual = np.where(fit.usable, fit.level - expected_levels, 0.0)
    squared_residual = residual**2 / np.maximum(
        _power_variance(fit, np.maximum(received_power, 1e-150)), MIN_RELATIVE_ERROR**2
    )
    usable = fit.usable
    tap_mean_square = np.minimum(squared_residual, 100.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    median_mean_square = float(np.median(tap_mean_square[usable.any(axis=0)]))
    fit = replace(fit, outlier=tap_mean_square > _MAX_TAP_RESIDUAL_RATIO * max(median_mean_square, 0.2))
    variance = _level_variance(fit, received_power)
    return replace(
        fit,
        weight=(_STUDENT_DEGREES_OF_FREEDOM + 1) / (_STUDENT_DEGREES_OF_FREEDOM + residual**2 / variance) / variance,
    )


def _residual_for_equal_errors(fit: TapFit, received_power: np.ndarray) -> Float[np.ndarray, "M T"]:
    """Residuals (M, T) of the levels if the taps' strengths are estimated with the same relative error for all
    microphones.

    With individual relative errors, a single microphone could dominate the strengths: its residuals would become ever
    smaller, and its weight ever larger.
    """
    relative_error = fit.noise.relative
    equal_fit = replace(fit, noise=replace(fit.noise, relative=np.full(len(relative_error), np.median(relative_error))))
    equal_fit = replace(equal_fit, weight=1 / _level_variance(equal_fit, received_power))
    strength = fit_strengths(equal_fit.problem(with_outliers=True), fit.values, fit.strength)
    return np.where(fit.usable, fit.level - replace(equal_fit, strength=strength).predicted_level(), 0.0)


def _level_variance(fit: TapFit, received_power: np.ndarray) -> np.ndarray:
    """Variance (M, T) of the levels for the expected power `received_power`, which is bounded from below so that all
    weights are finite."""
    min_power = 1e-6 * np.nanmax(np.where(fit.use, fit.power, np.nan), axis=1, initial=1e-300)[:, None]
    return _power_variance(fit, np.maximum(received_power, min_power))


def _power_variance(fit: TapFit, received_power: np.ndarray) -> np.ndarray:
    return np.asarray(fit.noise.level_variance(host.asarray(received_power)))
