"""Contrast, area or volume, and strength of bodies, with credible intervals.

To first order a small body's voltages depend on its strength alone: its area times (ρ - 1) / (ρ + 1), ρ being its
conductivity relative to the background, or in a solid its volume times (ρ - 1) / (ρ + 2). Contrast and size are
determined separately by the second order alone, so errors of the model overrule them first. Each body's contrast is
therefore explored: with the contrast held at several values everything else is fitted again, and the evidence gives the
posterior (Laplace's approximation for the other coefficients). The prior of the contrast is log-normal. Tierney and
Kadane, Journal of the American Statistical Association 81 (1986) 82; Ammari and Kang, Polarization and Moment Tensors
(2007), chapter 4, strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtri

from jeit.arguments.checks import Interval
from jeit.inverse.placement import ModelError, Uncertainty
from jeit.inverse.shapes.bodies import TINY, Bodies, Quantities, polarisation
from jeit.inverse.shapes.ellipsoid import Ellipsoid
from jeit.inverse.shapes.problem import Fit, ShapeProblem

# Median and spread of the logarithm of the contrast before the data, and bounds of that logarithm: 4.5 is 90 times.
_MEDIAN_LOG_CONTRAST, _LOG_CONTRAST_DEVIATION, _LOG_CONTRAST_BOUNDS = (
    0.9,
    1.2,
    (float(np.log(0.03)), float(np.log(4.5))),
)
# Steps of the first fit; first step along the logarithm of the contrast, at least and at most; and the factor by which
# the next is longer.
_STEPS, _STEP, _STEP_GROWTH = 8, (0.02, 0.35), 1.6
# In sheets and in solids, where each step takes a second: steps of each fit and its tolerance; and the drop of the log
# posterior at which the exploration ends.
_EFFORT, _LOG_POSTERIOR_DROP = {2: (8, 1e-2), 3: (2, 5e-2)}, {2: 5.0, 3: 3.0}
# Rise of the -log likelihood at an end of the grid below which the data leave that end open.
_OPEN_END_RISE = 1.0
# Probabilities of the ends of an interval, and numbers of contrasts and of normal deviates of the posterior's sample.
_INTERVAL_PROBABILITIES, _NUM_CONTRASTS, _NUM_NORMAL_DEVIATES = (0.16, 0.84), 240, 31


class Accuracy(NamedTuple):
    """How accurately a difference of two frames is known. **Fields**: `noise` (M,): standard deviation of the channels,
    volts, of all errors but those of `model_error`, the unknown part of electrode positions and contact impedances,
    if any; relative standard deviations `size`, of the lengths of the described domain, and `strength`, of all
    strengths, from errors of the background and the fields.

    **Example:**

    ```python
    accuracy = Accuracy(relative_noise(reference, relative=1e-3), size=0.01, strength=0.02)
    ```
    """

    noise: Float[Array, " M"]
    model_error: ModelError | None = None
    size: float = Uncertainty().size
    strength: float = 0.0


def with_quantities(
    problem: ShapeProblem, fit: Fit, accuracy: Accuracy, unmodelled: Any, order: Any
) -> list[Quantities]:
    """The quantities of bodies `order` of a `fit`; `unmodelled` (k,): standard deviations of the contrasts of all its
    bodies due to errors that the problem does not contain.

    `problem` has the noise of `accuracy` alone; its model error is that at the conductivity of the fit.
    """
    if accuracy.model_error is not None:
        conductivity = problem.background * np.exp(fit.bodies.image(fit.coefficients).image)
        rows = accuracy.model_error.voltages(problem.model, conductivity, problem.background)
        problem = problem.with_errors(np.asarray(problem.data.weight)[:, None] * rows)
    fit = problem.fit(fit.bodies, fit.coefficients, _STEPS)
    return [quantify(problem, fit, int(k), float(unmodelled[k]), accuracy) for k in order]


def include_deviation(quantities: Quantities, other: Ellipsoid | None, deviation: float) -> Quantities:
    """Widen the intervals of the `quantities` so that they include those of the `other` description of the body, if
    there is one, whose contrast has this standard deviation."""
    if other is None:
        return quantities
    changes = np.expm1(other.sign * (other.contrast + deviation * np.array([-1, 1]))).tolist()
    strength = float(other.volume * polarisation(other.sign * other.contrast, other.bounded_axes))
    return replace(
        quantities,
        change_interval=_interval_hull(quantities.change_interval, changes),
        measure_interval=_interval_hull(quantities.measure_interval, [other.volume]),
        strength_interval=_interval_hull(quantities.strength_interval, [strength]),
    )


def _interval_hull(interval: Interval, values: Sequence[float]) -> Interval:
    low, high = interval
    return None if low is None else min(low, *values), None if high is None else max(high, *values)


class _HeldFits(NamedTuple):
    """A fit with a contrast held: `log_contrast`; `unlikely`: -log likelihood, with all other coefficients integrated
    out; `log_measure` and its standard `deviation`."""

    log_contrast: float
    unlikely: float
    log_measure: float
    deviation: float


def quantify(problem: ShapeProblem, fit: Fit, k: int, unmodelled: float, accuracy: Accuracy) -> Quantities:
    """Explore the contrast of body k of a `fit` in both directions, until it is improbable or at a bound.

    `unmodelled`: standard deviation of the contrast due to errors that the problem does not contain, which leave the
    strength as it is.
    """
    bodies = fit.bodies
    contrast, slope = bodies.contrast(k, bodies.rows(fit.coefficients)[k])
    first = float(np.clip(np.log(contrast), *_LOG_CONTRAST_BOUNDS))
    deviation = problem.deviations(fit)[_size_coefficient(bodies, k)[1]] * abs(slope) / contrast
    middle, start = _fits_with_held_quantity(problem, bodies, fit.coefficients, k, np.log(contrast), first, accuracy)
    known, enough = [middle], _LOG_POSTERIOR_DROP[bodies.dimension]
    for way in (-1, 1):
        at, coefficients, step = first, start, float(np.clip(deviation, *_STEP))
        while (
            known[-1 if way > 0 else 0].unlikely + _contrast_prior(at)
            < min(map(_negative_log_evidence, known)) + enough
        ):
            before, at = at, float(np.clip(at + way * step, *_LOG_CONTRAST_BOUNDS))
            if at == before:
                break
            one, coefficients = _fits_with_held_quantity(problem, bodies, coefficients, k, before, at, accuracy)
            known.insert(len(known) if way > 0 else 0, one)
            step *= _STEP_GROWTH
    return _summary(int(bodies.sign[k]), bodies.bounded_axes(k), unmodelled, known)


def _size_coefficient(bodies: Bodies, k: int) -> tuple[int, int]:
    """Indices of the log radius of body k, and of its contrast, among the coefficients."""
    d, size = bodies.dimension, bodies.prior.size
    return 1 + k * size + d, 1 + int(bodies.first[k]) * size + d + 1


def _fits_with_held_quantity(
    problem: ShapeProblem, bodies: Bodies, coefficients, k: int, before: float, at: float, accuracy: Accuracy
):
    """The fit with the log contrast of body k, and of all others of its material, held at `at`, started from one of
    `before` with equal strengths; and its coefficients."""
    start, alike, sign = coefficients.copy(), bodies.first == bodies.first[k], bodies.sign[k]
    for one in np.flatnonzero(alike).tolist():
        axes = bodies.bounded_axes(one)
        ratio = polarisation(sign * np.exp(before), axes) / polarisation(sign * np.exp(at), axes)
        start[_size_coefficient(bodies, one)[0]] += np.log(ratio) / axes / bodies.prior.radius_spread
    start[_size_coefficient(bodies, k)[1]] = 0.0
    held = np.where(alike, np.exp(at), bodies.held)
    found = problem.fit(replace(bodies, held=held), start, *_EFFORT[bodies.dimension])
    deviation = bodies.prior.radius_spread * float(problem.deviations(found)[_size_coefficient(bodies, k)[0]])
    deviation = float(np.hypot(bodies.bounded_axes(k) * np.hypot(deviation, accuracy.size), accuracy.strength))
    measure = found.bodies.body(k, found.coefficients).measure
    return _HeldFits(at, problem.surprise(found), float(np.log(max(measure, TINY))), deviation), found.coefficients


def _negative_log_evidence(one: _HeldFits) -> float:
    """-log posterior of a held contrast, per unit of its logarithm, up to a constant."""
    return one.unlikely + _contrast_prior(one.log_contrast)


def _contrast_prior(log_contrast):
    """-log density of a contrast, per unit of its logarithm, up to a constant."""
    return 0.5 * ((log_contrast - np.log(_MEDIAN_LOG_CONTRAST)) / _LOG_CONTRAST_DEVIATION) ** 2


def _summary(sign: int, axes: int, unmodelled: float, known: Sequence[_HeldFits]) -> Quantities:
    """Medians and intervals of the posterior, interpolated between the contrasts that were held and convolved with a
    normal distribution of the deviation `unmodelled`; `axes`: number of axes along which the body is bounded."""
    place, unlikely, log_measure, spread = np.array(known).T
    dense = np.linspace(place[0], place[-1], _NUM_CONTRASTS)
    likely, measure, deviation = (PchipInterpolator(place, one)(dense) for one in (unlikely, log_measure, spread))
    surprise = likely + _contrast_prior(dense)
    weight = np.exp(surprise.min() - surprise)
    normal = ndtri((np.arange(_NUM_NORMAL_DEVIATES) + 0.5) / _NUM_NORMAL_DEVIATES)
    strength = polarisation(sign * np.exp(dense), axes)[:, None] * np.exp(
        measure[:, None] + deviation[:, None] * normal
    )
    contrast = np.clip(np.exp(dense)[:, None] + unmodelled * normal, *np.exp(_LOG_CONTRAST_BOUNDS))
    measures = strength[:, None] / polarisation(sign * contrast, axes)[..., None]
    least = unlikely.min()
    strong = place[-1] == _LOG_CONTRAST_BOUNDS[1] and unlikely[-1] < least + _OPEN_END_RISE
    weak = place[0] == _LOG_CONTRAST_BOUNDS[0] and unlikely[0] < least + _OPEN_END_RISE
    # The contrast decides which end of the measure is open: the stronger, the smaller.
    changes = [float(np.expm1(sign * one)) for one in _quantiles(contrast, weight)]
    ends: list[float | None] = [None if weak else changes[0], None if strong else changes[2]]
    least_measure, middle_measure, most_measure = _quantiles(measures, weight)
    weakest, middle_strength, strongest = _quantiles(strength, weight)
    return Quantities(
        changes[1],
        (ends[0], ends[1]) if sign > 0 else (ends[1], ends[0]),
        middle_measure,
        (None if strong else least_measure, None if weak else most_measure),
        middle_strength,
        (weakest, strongest),
    )


def _quantiles(values: Float[np.ndarray, "g *s"], weight: Float[np.ndarray, " g"]) -> tuple[float, float, float]:
    """Quantiles at the ends of an interval and the median, in ascending order: low, median, high. All values along the
    first axis have its `weight`."""
    weight = np.repeat(weight, values[0].size)
    values, order = values.ravel(), np.argsort(values, axis=None)
    share = np.cumsum(weight[order])
    share = (share - weight[order] / 2) / share[-1]
    low, middle, high = np.interp([_INTERVAL_PROBABILITIES[0], 0.5, _INTERVAL_PROBABILITIES[1]], share, values[order])
    return float(low), float(middle), float(high)
