"""Contrast, area and strength of bodies in a sheet, with credible intervals.

To first order a small body's voltages depend on its area times tanh(c / 2), c being the contrast of log σ: its
strength. Contrast and area are determined separately by the second order alone, so errors of the model overrule them
first. Each body's contrast is therefore explored: with the contrast held at several values everything else is fitted
again, and the evidence gives the posterior (Laplace's approximation for the other coefficients). The prior of the
contrast is log-normal. Tierney and Kadane, Journal of the American Statistical Association 81 (1986) 82; Ammari and
Kang, Polarization and Moment Tensors (2007), chapter 4, strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtri

from jeit.inverse.placement import ModelError
from jeit.inverse.shapes.problem import Fit, ShapeProblem
from jeit.inverse.shapes.star import Quantities, Star, Stars

# Median and spread of the logarithm of the contrast before the data, and bounds of that logarithm: 4.5 is 90 times.
_MEDIAN, _SPREAD, _BOUNDS = 0.9, 1.2, (float(np.log(0.03)), float(np.log(4.5)))
# First step along the logarithm of the contrast, at least and at most, and the factor by which the next is longer.
_STEP, _LONGER = (0.02, 0.35), 1.6
# Steps of each fit, its tolerance, and the drop of the log posterior at which the exploration ends.
_STEPS, _RTOL, _ENOUGH = 8, 1e-2, 5.0
# Standard deviation of the logarithm of areas due to the described size of the whole body: 1 % of its width.
_SIZE = 0.02
# Area, m², of a body that has left the sheet.
_TINY = 1e-30
# Rise of the -log likelihood at an end of the grid below which the data leave that end open.
_OPEN = 1.0
# Probabilities of the ends of an interval, and numbers of contrasts and areas of the posterior's sample.
_ENDS, _CONTRASTS, _AREAS = (0.16, 0.84), 240, 31


class Accuracy(NamedTuple):
    """How accurately a difference is known. **Fields**: `noise` (M,): standard deviation of the channels, volts, of all
    errors but those of `model_error`, the unknown part of electrode positions and contact impedances, if any."""

    noise: Float[Array, " M"]
    model_error: ModelError | None = None


def quantified(problem: ShapeProblem, fit: Fit, accuracy: Accuracy, stars: Sequence[Any], order) -> list[Star]:
    """The `stars`, bodies `order` of a `fit`, with their quantities; contrasts and areas of outlines are the medians.

    `problem` has the noise of `accuracy` alone; its model error is that at the conductivity of the fit.
    """
    if accuracy.model_error is not None:
        conductivity = problem.background * np.exp(fit.bodies.image(fit.coefficients).image)
        rows = accuracy.model_error.voltages(problem.model, conductivity, problem.background)
        problem = problem.with_errors(np.asarray(problem.data.weight)[:, None] * rows)
    fit = problem.fit(fit.bodies, fit.coefficients, _STEPS)
    found = []
    for k, star in zip(order, stars, strict=True):
        quantities = quantify(problem, fit, int(k))
        outline = star.centroid + (star.outline - star.centroid) * np.sqrt(quantities.area / max(star.area, _TINY))
        contrast = float(np.abs(np.log1p(quantities.change)))
        found.append(replace(star, outline=outline, contrast=contrast, quantities=quantities))
    return found


class _Held(NamedTuple):
    """A fit with a contrast held: `log_contrast`; `unlikely`: -log likelihood, with all other coefficients integrated
    out; `log_area` and its standard `deviation`."""

    log_contrast: float
    unlikely: float
    log_area: float
    deviation: float


def quantify(problem: ShapeProblem, fit: Fit, k: int) -> Quantities:
    """Explore the contrast of body k of a `fit` in both directions, until it is improbable or at a bound."""
    bodies = fit.bodies
    assert isinstance(bodies, Stars)
    contrast, slope = bodies.contrast(k, bodies.rows(fit.coefficients)[k])
    first = float(np.clip(np.log(contrast), *_BOUNDS))
    deviation = problem.deviations(fit)[_place(bodies, k)[1]] * abs(slope) / contrast
    middle, start = _held_at(problem, bodies, fit.coefficients, k, np.log(contrast), first)
    known = [middle]
    for way in (-1, 1):
        at, coefficients, step = first, start, float(np.clip(deviation, *_STEP))
        while known[-1 if way > 0 else 0].unlikely + _prior(at) < min(map(_surprise, known)) + _ENOUGH:
            before, at = at, float(np.clip(at + way * step, *_BOUNDS))
            if at == before:
                break
            one, coefficients = _held_at(problem, bodies, coefficients, k, before, at)
            known.insert(len(known) if way > 0 else 0, one)
            step *= _LONGER
    return _summary(int(bodies.sign[k]), known)


def _place(bodies: Stars, k: int) -> tuple[int, int]:
    """Indices of the log radius and of the contrast of body k among the coefficients."""
    first = 1 + k * bodies.prior.size
    return first + 2, first + 3


def _held_at(problem: ShapeProblem, bodies: Stars, coefficients, k: int, before: float, at: float):
    """The fit with the log contrast of body k held at `at`, started from one of `before` with equal strength; and its
    coefficients."""
    log_radius, value = _place(bodies, k)
    ratio = np.tanh(np.exp(before) / 2) / np.tanh(np.exp(at) / 2)
    start = coefficients.copy()
    start[log_radius] += 0.5 * np.log(ratio) / bodies.prior.radius_spread
    start[value] = 0.0
    held = np.where(np.arange(len(bodies.sign)) == k, np.exp(at), bodies.held)
    found = problem.fit(replace(bodies, held=held), start, _STEPS, _RTOL)
    deviation = 2 * bodies.prior.radius_spread * float(problem.deviations(found)[log_radius])
    deviation = float(np.hypot(deviation, _SIZE))
    area = found.bodies.body(k, found.coefficients).area
    return _Held(at, problem.surprise(found), float(np.log(max(area, _TINY))), deviation), found.coefficients


def _surprise(one: _Held) -> float:
    """-log posterior of a held contrast, per unit of its logarithm, up to a constant."""
    return one.unlikely + _prior(one.log_contrast)


def _prior(log_contrast):
    """-log density of a contrast, per unit of its logarithm, up to a constant."""
    return 0.5 * ((log_contrast - np.log(_MEDIAN)) / _SPREAD) ** 2


def _summary(sign: int, known: Sequence[_Held]) -> Quantities:
    """Medians and intervals of the posterior, interpolated between the contrasts that were held."""
    place, unlikely, log_area, spread = np.array(known).T
    dense = np.linspace(place[0], place[-1], _CONTRASTS)
    likely, area, deviation = (PchipInterpolator(place, one)(dense) for one in (unlikely, log_area, spread))
    surprise = likely + _prior(dense)
    weight = np.exp(surprise.min() - surprise)
    normal = ndtri((np.arange(_AREAS) + 0.5) / _AREAS)
    areas = np.exp(area[:, None] + deviation[:, None] * normal)
    strength = np.tanh(np.exp(dense) / 2)[:, None] * areas
    weights = np.repeat(weight, _AREAS)
    least = unlikely.min()
    strong = place[-1] == _BOUNDS[1] and unlikely[-1] < least + _OPEN
    weak = place[0] == _BOUNDS[0] and unlikely[0] < least + _OPEN
    # The contrast decides which end of the area is open: the stronger, the smaller.
    low, middle, high = _quantiles(np.exp(dense), weight)
    changes = [float(np.expm1(sign * one)) for one in (low, middle, high)]
    ends: list[float | None] = [None if weak else changes[0], None if strong else changes[2]]
    area_low, area_middle, area_high = _quantiles(areas.ravel(), weights)
    strength_ends = _quantiles(strength.ravel(), weights)
    strengths = sorted(sign * one for one in strength_ends)
    return Quantities(
        changes[1],
        (ends[0], ends[1]) if sign > 0 else (ends[1], ends[0]),
        area_middle,
        (None if strong else area_low, None if weak else area_high),
        sign * strength_ends[1],
        (strengths[0], strengths[2]),
    )


def _quantiles(values: Float[np.ndarray, " s"], weight: Float[np.ndarray, " s"]) -> tuple[float, float, float]:
    """Quantiles at the ends of an interval and the median, in ascending order: low, median, high."""
    order = np.argsort(values)
    share = np.cumsum(weight[order])
    share = (share - weight[order] / 2) / share[-1]
    low, middle, high = np.interp([_ENDS[0], 0.5, _ENDS[1]], share, values[order])
    return float(low), float(middle), float(high)
