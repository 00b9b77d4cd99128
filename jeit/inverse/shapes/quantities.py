"""Place, contrast, area or volume, and strength of bodies, with credible intervals.

To first order the voltages due to a small body depend on the body's strength alone: its area times (ρ - 1) / (ρ + 1),
or in a solid its volume times (ρ - 1) / (ρ + 2), where ρ is the body's conductivity relative to the background.
Contrast and size are determined separately only by the second order, so errors of the model affect them most. Each
body's contrast is therefore explored: the contrast is fixed at several values in turn, all other coefficients are
fitted again, and the evidence gives the posterior of the contrast (Laplace's approximation for the other coefficients).
The prior of the contrast is log-normal. Tierney and Kadane, Journal of the American Statistical Association 81 (1986)
82; Ammari and Kang, Polarization and Moment Tensors (2007), chapter 4, for the strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.special import chdtri, ndtri

from jeit.arguments.checks import Interval
from jeit.inverse.placement import ModelError, Uncertainty
from jeit.inverse.shapes.bodies import MIN_POSITIVE_VALUE, Bodies, Quantities, polarisation, results_of_parts
from jeit.inverse.shapes.ellipsoid import Ellipsoid
from jeit.inverse.shapes.problem import ShapeFit, ShapeProblem

# Prior median of the contrast, and standard deviation and bounds of its logarithm; a contrast of 4.5 is a factor of 90.
_MEDIAN_LOG_CONTRAST, _LOG_CONTRAST_DEVIATION, _LOG_CONTRAST_BOUNDS = (
    0.9,
    1.2,
    (float(np.log(0.03)), float(np.log(4.5))),
)
# Maximum number of steps of the first fit.
_MAX_FIT_STEPS = 8
# Minimum and maximum of the first step along the logarithm of the contrast.
_LOG_CONTRAST_STEP_LIMITS = (0.02, 0.35)
# Factor by which each step along the logarithm of the contrast is longer than the last.
_STEP_GROWTH = 1.6
# By dimension of the mesh: maximum number of steps of each fit and its tolerance, and the drop of the log posterior at
# which the exploration ends. A step of a fit in a solid takes a second.
_MAX_STEPS_AND_TOLERANCE, _LOG_POSTERIOR_DROP = {2: (8, 1e-2), 3: (2, 5e-2)}, {2: 5.0, 3: 3.0}
# The data do not determine a limit of the contrast if the -log likelihood at that bound of the contrast exceeds its
# minimum by less than this number.
_MIN_LIKELIHOOD_DROP_AT_BOUND = 1.0
# Probabilities at the limits of a credible interval; number of values of the contrast, and number of standard normal
# deviates for each of them, at which the posterior is evaluated.
_INTERVAL_PROBABILITIES, _NUM_CONTRASTS, _NUM_NORMAL_DEVIATES = (0.16, 0.84), 240, 31
# Probability that the circle about a centroid contains the true centroid.
_CENTROID_PROBABILITY = 0.68
# Standard deviation of a body's place due to an error of the fields, as a share of half the width of the domain times
# the relative error: a body's voltages change by a factor of about e² over half the width, and a fifth of the error is
# assumed to resemble a displacement.
_RELATIVE_CENTROID_DEVIATION = 0.1


class Accuracy(NamedTuple):
    """Accuracy of a difference of two frames. **Fields**: `noise` (M,): standard deviation of the channels, volts, of
    all errors except `model_error`; `model_error`: errors due to unknown electrode positions and contact impedances, or
    None; `size`: relative standard deviation of the lengths of the described domain; `strength`: relative standard
    deviation of all strengths due to errors of the background and the fields; `movement`: maximum standard deviation of
    displacements, metres, of electrodes on the edge of a sheet between the two frames; 0: they are at rest.

    **Example:**

    ```python
    accuracy = Accuracy(relative_noise(reference, relative=1e-3), size=0.01, strength=0.02)
    ```
    """

    noise: Float[Array, " M"]
    model_error: ModelError | None = None
    size: float = Uncertainty().size
    strength: float = 0.0
    movement: float = 0.0


def with_quantities(
    problem: ShapeProblem, fit: ShapeFit, accuracy: Accuracy, unmodelled: Any, order: Any
) -> list[Quantities]:
    """Compute the quantities of the bodies of a `fit`, in the `order` of indices. `unmodelled` (k,): standard
    deviations of the contrasts of all k bodies due to errors that the problem does not contain.

    `problem` has the noise of `accuracy` alone; the model error is added for the conductivity of the fit.
    """
    if accuracy.model_error is not None:
        conductivity = problem.background * np.exp(fit.bodies.image(fit.coefficients).image)
        model_error_rows = accuracy.model_error.voltages(problem.model, conductivity, problem.background)
        problem = problem.with_errors(np.asarray(problem.data.weight)[:, None] * model_error_rows)
    shown_centroids = [fit.bodies.body(int(k), fit.coefficients).centroid for k in order]
    fit = problem.fit(fit.bodies, fit.coefficients, _MAX_FIT_STEPS)
    if (misfit := problem.misfit(fit)) > 1:  # the errors are larger than assumed, whatever their cause
        problem = problem.with_scaled_errors(misfit)
        fit = problem.fit(fit.bodies, fit.coefficients, _MAX_FIT_STEPS)
    material_indices = np.unique(fit.bodies.first).tolist()
    explored_by_material = dict(
        zip(
            material_indices,
            results_of_parts(fit.bodies, lambda k: explore_contrast(problem, fit, k), material_indices),
            strict=True,
        )
    )
    return [
        replace(
            quantify(problem, explored_by_material[int(fit.bodies.first[k])], int(k), float(unmodelled[k]), accuracy),
            centroid_radius=centroid_radius(problem, fit, int(k), centroid, accuracy),
        )
        for k, centroid in zip(order, shown_centroids, strict=True)
    ]


def centroid_radius(
    problem: ShapeProblem, fit: ShapeFit, k: int, shown_centroid: Float[np.ndarray, " d"], accuracy: Accuracy
) -> float:
    """Radius, metres, of the circle or ball about the `shown_centroid` of body k that contains the true centroid with a
    probability of 68 %.

    The posterior of the centroid follows from that of the coefficients of a `fit` by linearisation. Errors of the
    described lengths and of the fields are added. The distribution of the squared distance is approximated by a scaled
    χ² distribution with the same mean and variance (Satterthwaite, Biometrics Bulletin 2 (1946) 110).
    """
    bodies, prior_size = fit.bodies, fit.bodies.prior.size
    indices = np.arange(1 + k * prior_size, 1 + (k + 1) * prior_size)
    coefficient_covariance = problem.covariance(fit)[np.ix_(indices, indices)]
    centroid = bodies.body(k, fit.coefficients).centroid
    centroid_slope = bodies.centroid_slope(k, fit.coefficients, np.sqrt(np.diag(coefficient_covariance)))
    mesh_points = np.asarray(problem.model.mesh.points)
    scaling_error = accuracy.size * (centroid - (mesh_points.min(axis=0) + mesh_points.max(axis=0)) / 2)
    field_error = _RELATIVE_CENTROID_DEVIATION * accuracy.strength * bodies.span / 2
    covariance = centroid_slope @ coefficient_covariance @ centroid_slope.T
    covariance += np.outer(scaling_error, scaling_error) + field_error**2 * np.eye(len(centroid))
    variance = np.trace(covariance)
    squared_radius = np.sum((centroid - shown_centroid) ** 2)
    if variance > 0:
        chi_square_scale = np.sum(covariance**2) / variance
        squared_radius += chi_square_scale * chdtri(variance / chi_square_scale, 1 - _CENTROID_PROBABILITY)
    return float(np.sqrt(squared_radius))


def include_deviation(
    quantities: Quantities, body: Ellipsoid, other_body: Ellipsoid | None, deviation: float
) -> Quantities:
    """Widen the intervals of the `quantities` of a `body` so that they include the properties of `other_body`, the
    body's other description, if there is one. `deviation`: standard deviation of the contrast of the other
    description."""
    if other_body is None:
        return quantities
    conductivity_changes = np.expm1(other_body.sign * (other_body.contrast + deviation * np.array([-1, 1]))).tolist()
    body_strength = float(
        other_body.volume * polarisation(other_body.sign * other_body.contrast, other_body.bounded_axes)
    )
    return replace(
        quantities,
        change_interval=_interval_hull(quantities.change_interval, conductivity_changes),
        measure_interval=_interval_hull(quantities.measure_interval, [other_body.volume]),
        strength_interval=_interval_hull(quantities.strength_interval, [body_strength]),
        centroid_radius=max(quantities.centroid_radius, float(np.linalg.norm(other_body.centroid - body.centroid))),
    )


def _interval_hull(interval: Interval, values: Sequence[float]) -> Interval:
    low, high = interval
    return None if low is None else min(low, *values), None if high is None else max(high, *values)


class ExploredContrast(NamedTuple):
    """A fit in which the contrast of one material is fixed. **Fields**: `log_contrast`: logarithm of the fixed
    contrast; `negative_log_likelihood`: -log likelihood, with all other coefficients integrated out; `fit`: the fit."""

    log_contrast: float
    negative_log_likelihood: float
    fit: ShapeFit

    @property
    def negative_log_evidence(self) -> float:
        """Negative log posterior density of the logarithm of the contrast, up to a constant."""
        return self.negative_log_likelihood + _contrast_prior(self.log_contrast)


class _FixedContrastFit(NamedTuple):
    """A body in a fit in which its contrast is fixed. **Fields**: `log_contrast`: logarithm of the fixed contrast;
    `negative_log_likelihood`: -log likelihood, with all other coefficients integrated out; `log_measure`: logarithm of
    the body's area or volume; `deviation`: standard deviation of `log_measure`."""

    log_contrast: float
    negative_log_likelihood: float
    log_measure: float
    deviation: float


def explore_contrast(problem: ShapeProblem, fit: ShapeFit, k: int) -> list[ExploredContrast]:
    """Explore the contrast of body k of a `fit`, and of all bodies of its material, in both directions until it is
    improbable or at a bound. Returns the fits in ascending order of contrast."""
    bodies = fit.bodies
    fitted_contrast, contrast_slope = bodies.contrast(k, bodies.rows(fit.coefficients)[k])
    # Of a body fitted with the other sign, it is negative.
    fitted_contrast = max(fitted_contrast, np.exp(_LOG_CONTRAST_BOUNDS[0]))
    first_log_contrast = float(np.clip(np.log(fitted_contrast), *_LOG_CONTRAST_BOUNDS))
    log_contrast_deviation = (
        problem.deviations(fit)[_radius_and_contrast_index(bodies, k)[1]] * abs(contrast_slope) / fitted_contrast
    )
    middle_fit = _fit_with_fixed_contrast(
        problem, bodies, fit.coefficients, k, np.log(fitted_contrast), first_log_contrast
    )
    max_drop = _LOG_POSTERIOR_DROP[bodies.dimension]

    def explore_in_direction(direction: int) -> list[ExploredContrast]:
        explored_fits, log_contrast_step = (
            [middle_fit],
            float(np.clip(log_contrast_deviation, *_LOG_CONTRAST_STEP_LIMITS)),
        )
        while (
            explored_fits[-1].negative_log_evidence
            < min(explored_fit.negative_log_evidence for explored_fit in explored_fits) + max_drop
        ):
            last_fit = explored_fits[-1]
            log_contrast = float(np.clip(last_fit.log_contrast + direction * log_contrast_step, *_LOG_CONTRAST_BOUNDS))
            if log_contrast == last_fit.log_contrast:
                break
            explored_fits.append(
                _fit_with_fixed_contrast(
                    problem, bodies, last_fit.fit.coefficients, k, last_fit.log_contrast, log_contrast
                )
            )
            log_contrast_step *= _STEP_GROWTH
        return explored_fits

    fits_at_lower_contrast, fits_at_higher_contrast = results_of_parts(bodies, explore_in_direction, [-1, 1])
    return [*fits_at_lower_contrast[:0:-1], *fits_at_higher_contrast]


def quantify(
    problem: ShapeProblem, explored: Sequence[ExploredContrast], k: int, unmodelled: float, accuracy: Accuracy
) -> Quantities:
    """Compute the quantities of body k from the `explored` contrasts of its material.

    `unmodelled`: standard deviation of the contrast due to errors that the problem does not contain; these errors do
    not change the strength.
    """
    bodies, fixed_fits = explored[0].fit.bodies, []
    for log_contrast, negative_log_likelihood, fit in explored:
        log_radius_deviation = bodies.prior.radius_spread * float(
            problem.deviations(fit)[_radius_and_contrast_index(bodies, k)[0]]
        )
        log_radius_deviation = float(
            np.hypot(bodies.bounded_axes(k) * np.hypot(log_radius_deviation, accuracy.size), accuracy.strength)
        )
        body_measure = fit.bodies.body(k, fit.coefficients).measure
        log_measure = float(np.log(max(body_measure, MIN_POSITIVE_VALUE)))
        fixed_fits.append(_FixedContrastFit(log_contrast, negative_log_likelihood, log_measure, log_radius_deviation))
    return _summary(int(bodies.sign[k]), bodies.bounded_axes(k), unmodelled, fixed_fits)


def _radius_and_contrast_index(bodies: Bodies, k: int) -> tuple[int, int]:
    """Indices of the log radius of body k, and of its contrast, among the coefficients."""
    dimension, num_coefficients = bodies.dimension, bodies.prior.size
    return 1 + k * num_coefficients + dimension, 1 + int(bodies.first[k]) * num_coefficients + dimension + 1


def _fit_with_fixed_contrast(
    problem: ShapeProblem, bodies: Bodies, coefficients, k: int, last_log_contrast: float, log_contrast: float
) -> ExploredContrast:
    """Fit the bodies with the log contrast of body k, and of all other bodies of its material, fixed at `log_contrast`.
    The fit starts from `coefficients` of a fit at `last_log_contrast`, with radii changed so that the strengths stay
    the same."""
    start_coefficients, is_same_material, sign = coefficients.copy(), bodies.first == bodies.first[k], bodies.sign[k]
    for body_index in np.flatnonzero(is_same_material).tolist():
        axes = bodies.bounded_axes(body_index)
        polarisation_ratio = polarisation(sign * np.exp(last_log_contrast), axes) / polarisation(
            sign * np.exp(log_contrast), axes
        )
        start_coefficients[_radius_and_contrast_index(bodies, body_index)[0]] += (
            np.log(polarisation_ratio) / axes / bodies.prior.radius_spread
        )
    start_coefficients[_radius_and_contrast_index(bodies, k)[1]] = 0.0
    fixed_contrast = np.where(is_same_material, np.exp(log_contrast), bodies.fixed_contrast)
    fixed_fit = problem.fit(
        replace(bodies, fixed_contrast=fixed_contrast), start_coefficients, *_MAX_STEPS_AND_TOLERANCE[bodies.dimension]
    )
    return ExploredContrast(log_contrast, problem.negative_log_evidence(fixed_fit), fixed_fit)


def _contrast_prior(log_contrast):
    """Negative log prior density of the logarithm of a contrast, up to a constant."""
    return 0.5 * ((log_contrast - np.log(_MEDIAN_LOG_CONTRAST)) / _LOG_CONTRAST_DEVIATION) ** 2


def _summary(sign: int, axes: int, unmodelled: float, fixed_fits: Sequence[_FixedContrastFit]) -> Quantities:
    """Medians and intervals of the posterior, interpolated between the fixed contrasts and convolved with a normal
    distribution of the standard deviation `unmodelled`; `axes`: number of axes along which the body is bounded."""
    log_contrasts, negative_log_likelihoods, log_measure, deviations = np.array(fixed_fits).T
    log_contrast_grid = np.linspace(log_contrasts[0], log_contrasts[-1], _NUM_CONTRASTS)
    grid_negative_log_likelihoods, grid_log_measures, grid_deviations = (
        PchipInterpolator(log_contrasts, fit_values)(log_contrast_grid)
        for fit_values in (negative_log_likelihoods, log_measure, deviations)
    )
    negative_log_posterior = grid_negative_log_likelihoods + _contrast_prior(log_contrast_grid)
    posterior_weight = np.exp(negative_log_posterior.min() - negative_log_posterior)
    normal_deviates = ndtri((np.arange(_NUM_NORMAL_DEVIATES) + 0.5) / _NUM_NORMAL_DEVIATES)
    body_strength = polarisation(sign * np.exp(log_contrast_grid), axes)[:, None] * np.exp(
        grid_log_measures[:, None] + grid_deviations[:, None] * normal_deviates
    )
    true_contrast = np.clip(
        np.exp(log_contrast_grid)[:, None] + unmodelled * normal_deviates, *np.exp(_LOG_CONTRAST_BOUNDS)
    )
    body_measures = body_strength[:, None] / polarisation(sign * true_contrast, axes)[..., None]
    min_negative_log_likelihood = negative_log_likelihoods.min()
    is_open_above = (
        log_contrasts[-1] == _LOG_CONTRAST_BOUNDS[1]
        and negative_log_likelihoods[-1] < min_negative_log_likelihood + _MIN_LIKELIHOOD_DROP_AT_BOUND
    )
    is_open_below = (
        log_contrasts[0] == _LOG_CONTRAST_BOUNDS[0]
        and negative_log_likelihoods[0] < min_negative_log_likelihood + _MIN_LIKELIHOOD_DROP_AT_BOUND
    )
    # If the data do not determine the upper limit of the contrast, they do not determine the lower limit of the area or
    # volume either, and vice versa: a stronger body is smaller.
    conductivity_changes = [
        float(np.expm1(sign * fit_values)) for fit_values in _weighted_quantiles(true_contrast, posterior_weight)
    ]
    change_limits: list[float | None] = [
        None if is_open_below else conductivity_changes[0],
        None if is_open_above else conductivity_changes[2],
    ]
    min_measure, median_measure, max_measure = _weighted_quantiles(body_measures, posterior_weight)
    min_strength, median_strength, max_strength = _weighted_quantiles(body_strength, posterior_weight)
    return Quantities(
        conductivity_changes[1],
        (change_limits[0], change_limits[1]) if sign > 0 else (change_limits[1], change_limits[0]),
        median_measure,
        (None if is_open_above else min_measure, None if is_open_below else max_measure),
        median_strength,
        (min_strength, max_strength),
    )


def _weighted_quantiles(
    values: Float[np.ndarray, "g *s"], weight: Float[np.ndarray, " g"]
) -> tuple[float, float, float]:
    """Weighted quantiles of `values` at the lower end of the interval, the median and the upper end. `weight` (g,):
    weight of all values at each index of the first axis."""
    weight = np.repeat(weight, values[0].size)
    values, order_by_value = values.ravel(), np.argsort(values, axis=None)
    cumulative_weights = np.cumsum(weight[order_by_value])
    cumulative_weights = (cumulative_weights - weight[order_by_value] / 2) / cumulative_weights[-1]
    lower_quantile, median_value, upper_quantile = np.interp(
        [_INTERVAL_PROBABILITIES[0], 0.5, _INTERVAL_PROBABILITIES[1]], cumulative_weights, values[order_by_value]
    )
    return float(lower_quantile), float(median_value), float(upper_quantile)
