"""Iteratively reweighted least squares: decay models of all microphones, strengths of all taps, the noise of both.

First each microphone alone, the strengths given, and the strengths, the models given, in turn. Then all together, what
the residuals say of the noise, and new weights, until nothing changes. Every step takes a `TapFit` and returns another.
"""

from dataclasses import replace
from operator import itemgetter

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jeit.acoustic.calibration.decay_fit import (
    DecayProblem,
    fit_between,
    fit_each,
    fit_strengths,
    fit_together,
    log_covariance,
)
from jeit.acoustic.calibration.tap_noise import additive_deviations, relative_errors
from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.noise import LEAST_RELATIVE, IntensityNoise, below_nothing
from jeit_solvers.engines import host, on_host, slopes

_ALTERNATIONS, _REWEIGHTINGS = 6, 12
# Student's t with so many degrees of freedom weighs residuals.
_TAIL = 5.0
# A tap whose mean square residual is so many times the median tap's is left out.
_OUTLIER = 12.0
# A shape known no better than to this relative error is not determined by its taps.
_LOOSE = 0.5
# Microphones whose shapes are determined, from which on the others can share theirs.
_ENOUGH = 3

# What holds a microphone's parameters: nothing; a bound on them; or, all but the first, the median of the others.
FREE, BELOW, ABOVE, SHARED = range(4)


class TapFit(eqx.Module):
    """Where the fit of M microphones to T taps stands.

    - `squared`: squared distances (M, T), m²; `power`: (M, T) above the floor, NaN where there is none to use.
    - `noise`; `known_noise`: whether its floor was measured.
    - `values`: logarithms of the decay model's parameters, (K, M), held by `held` (M,); `strength`: (T,) logarithms.
    - `weight`: (M, T) inverse variances of levels, less for what is far off.
    - `outlier`: (T,) taps left out; `dropped`: (M,) microphones left out.
    - `start`: (K, M) first guess; `bounds`: least and greatest of each parameter, two of (K,).
    """

    kind: type[AbstractDecay] = eqx.field(static=True)
    squared: Float[np.ndarray, "M T"]
    power: Float[np.ndarray, "M T"]
    noise: IntensityNoise
    known_noise: bool
    values: Float[np.ndarray, "K M"]
    held: Int[np.ndarray, " M"]
    strength: Float[np.ndarray, " T"]
    weight: Float[np.ndarray, "M T"]
    outlier: Bool[np.ndarray, " T"]
    dropped: Bool[np.ndarray, " M"]
    start: Float[np.ndarray, "K M"]
    bounds: tuple[np.ndarray, np.ndarray]

    @property
    def usable(self) -> Bool[np.ndarray, "M T"]:
        """Readings whose level is a number, of microphones that are not left out."""
        above = np.nan_to_num(self.power, nan=-np.inf) + self.noise.floor[:, None] > 0
        return above & ~self.dropped[:, None]

    @property
    def use(self) -> Bool[np.ndarray, "M T"]:
        """Readings that are fitted."""
        return self.usable & ~self.outlier

    @property
    def heard(self) -> Bool[np.ndarray, " T"]:
        """Taps that any microphone has heard."""
        return np.asarray(self.use.any(axis=0))

    @property
    def free(self) -> Bool[np.ndarray, "K M"]:
        """Parameters that data determine."""
        free = np.tile((self.held == FREE) & self.usable.any(axis=1), (len(self.kind.parameters), 1))
        free[0] |= (self.held == SHARED) & self.usable.any(axis=1)
        return free

    @property
    def level(self) -> Float[np.ndarray, "M T"]:
        """y = log(power + floor), anything where that is not usable."""
        return np.asarray(self.noise.level(host.where(self.usable, self.power, 1.0)))

    def problem(self, *, with_outliers: bool = False) -> DecayProblem:
        """The least-squares problem with the weights as they are."""
        weight = np.where(self.usable if with_outliers else self.use, self.weight, 0.0)
        return DecayProblem(self.level, self.squared, weight, np.asarray(self.noise.floor), self.kind)

    def expected(self) -> Float[np.ndarray, "M T"]:
        """Levels that the models say."""
        return self.problem().expected(self.values, self.strength)[0]


def fit_taps(
    kind: type[AbstractDecay],
    microphones: Float[np.ndarray, "M d"],
    squared: Float[np.ndarray, "M T"],
    power: Float[np.ndarray, "M T"],
    noise: IntensityNoise,
    known_noise: bool,
) -> TapFit:
    """Alternate between microphones and strengths, then fit until nothing changes, shapes shared where need be."""
    extent = float(np.sqrt(squared.max()))
    spacing = float(np.median(KDTree(microphones).query(microphones, k=2)[0][:, 1])) if len(microphones) > 1 else 0.0
    lower, upper = (np.array(bound) for bound in kind.bounds(extent))
    start = kind.start(spacing if spacing > 0 else extent / 4, len(microphones)).logarithms()
    start, noise = np.asarray(start), on_host(noise)
    count, taps = squared.shape
    fit = TapFit(
        kind,
        squared,
        power,
        noise,
        known_noise,
        values=start,
        held=np.full(count, FREE),
        strength=np.zeros(taps),
        weight=np.zeros(squared.shape),
        outlier=np.zeros(taps, bool),
        dropped=np.zeros(count, bool),
        start=start,
        bounds=(lower, upper),
    )
    # The loudest microphone alone says how strong a tap was.
    seen = np.where(fit.use, power, -np.inf)
    loudest = seen.argmax(axis=0), np.arange(taps)
    response = fit.problem().log_response(start)
    strength = np.log(np.clip(seen[loudest], 1e-300, 1e300)) - response[loudest]
    fit = replace(
        fit,
        strength=np.where(fit.heard & np.isfinite(strength), strength, 0.0),
        # At first the model is good to 20 % at best.
        weight=1 / np.maximum(_level_variance(fit, np.nan_to_num(np.maximum(power, 0.0))), 0.04),
    )
    for _ in range(_ALTERNATIONS):
        values = fit_each(fit.problem(), fit.values, fit.strength, fit.bounds)
        strength = fit_strengths(fit.problem(with_outliers=True), values, fit.strength)
        fit = _reweighed(replace(fit, values=values, strength=strength))
    return _share_shapes(_refine(fit))


def refit_without(fit: TapFit, bad: Bool[np.ndarray, " M"]) -> TapFit:
    """Once more, without the microphones that were found to be of no use."""
    return _refine(replace(fit, dropped=fit.dropped | bad))


def standard_errors(fit: TapFit) -> Float[np.ndarray, "K M"]:
    """Deviations of the logarithms of parameters, the scale fixed as a calibration has it; NaN where they are held."""
    free = fit.free
    if free[0].sum() < 2:
        return np.full(free.shape, np.nan)

    def scale(values):
        return np.where(free[0], np.log(fit.kind.from_logarithms(values).gain), 0.0)

    normal = np.ravel(slopes(scale, fit.values)[1])
    covariance = log_covariance(fit.problem(), fit.values, fit.strength, free, normal)
    return np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(free.shape)


def _refine(fit: TapFit) -> TapFit:
    """All microphones together, and what their residuals say, until nothing changes."""
    for _ in range(_REWEIGHTINGS):
        before, free = fit.values, fit.free
        values, strength = fit_together(fit.problem(), before, fit.strength, free)
        fit = _keep_between(replace(fit, values=values, strength=strength))
        strength = fit_strengths(fit.problem(with_outliers=True), fit.values, fit.strength)
        fit = _reweighed(replace(fit, strength=strength))
        if np.abs(fit.values - before)[free].max(initial=0.0) < 1e-9:
            break
    return fit


def _share_shapes(fit: TapFit) -> TapFit:
    """Give the median shape to microphones whose taps do not determine theirs: they are of one kind, mostly.

    Where no tap was near a microphone, b may be anything from nothing up: the least value would have it draw all
    places to itself.
    """
    errors = standard_errors(fit)[1:].max(axis=0)
    determined = (fit.held == FREE) & (errors < _LOOSE)
    if determined.sum() < _ENOUGH:
        return fit
    shape = np.median(fit.values[1:, determined], axis=1)
    loose = (fit.held == FREE) & (errors >= _LOOSE)
    values = np.array(fit.values)
    pinned = [np.concatenate([limit[:1], shape]) for limit in fit.bounds]
    # A microphone at its bound has drawn the strengths of its taps along: the others say what they were.
    bound = fit.held == BELOW
    # So many deviations squared is the bound from the median, if one is a factor of e.
    unlikely = float(np.sum((shape - fit.bounds[0][1:]) ** 2))
    strength = fit_strengths(replace(fit, dropped=fit.dropped | bound).problem(), fit.values, fit.strength)
    problem = fit.problem()
    for k in np.flatnonzero(loose | bound):
        own, shared = (fit_between(problem, fit.values, strength, int(k), limits) for limits in (fit.bounds, pinned))
        if loose[k] or 2 * (shared[1] - own[1]) < unlikely:
            loose[k], values[:, k] = True, shared[0]
    if not loose.any():
        return fit
    return _refine(replace(fit, values=values, held=np.where(loose, SHARED, fit.held)))


def _keep_between(fit: TapFit) -> TapFit:
    """Fit microphones that left the bounds again between them, also from the first guess, and hold them there until
    they have come back inside."""
    lower, upper = fit.bounds
    values, held = np.array(fit.values), fit.held.copy()
    beyond = ((values <= lower[:, None]) | (values >= upper[:, None]) | ~np.isfinite(values)).any(axis=0)
    problem = fit.problem()
    for k in np.flatnonzero(fit.use.any(axis=1) & (held != SHARED) & (beyond | (held != FREE))):
        starts = (np.nan_to_num(values), fit.start)
        found = (fit_between(problem, first, fit.strength, int(k), fit.bounds) for first in starts)
        values[:, k] = min(found, key=itemgetter(1))[0]
        if (values[1:, k] >= upper[1:] - 1e-6).any():
            held[k] = ABOVE
        else:
            held[k] = FREE if (values[:, k] > lower + 1e-6).all() else BELOW
    return replace(fit, values=values, held=held)


def _reweighed(fit: TapFit) -> TapFit:
    """The noise, the outliers and the weights that the residuals say."""
    expected = fit.expected()
    received = np.maximum(np.exp(expected) - fit.noise.floor[:, None], 0.0)
    # What unknown strengths and parameters take out of the residuals.
    count = fit.use.sum()
    spent = fit.heard.sum() + fit.free.sum()
    inflation = count / max(count - spent, 0.1 * count)
    if not fit.known_noise:
        use = np.isfinite(fit.power) & ~fit.outlier
        deviation = additive_deviations(fit.power, received, use, inflation)
        betrayed = below_nothing(fit.power.T, np.isfinite(fit.power.T))
        fit = replace(
            fit, noise=on_host(IntensityNoise.create(len(received), deviation=np.maximum(deviation, betrayed)))
        )
    relative = relative_errors(fit.noise, received, _residual_of_equals(fit, received), fit.use, inflation)
    fit = replace(fit, noise=replace(fit.noise, relative=relative))
    residual = np.where(fit.usable, fit.level - expected, 0.0)
    square = residual**2 / np.maximum(_variance(fit, np.maximum(received, 1e-150)), LEAST_RELATIVE**2)
    usable = fit.usable
    level = np.minimum(square, 100.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    typical = max(float(np.median(level[usable.any(axis=0)])), 1e-6)
    fit = replace(fit, outlier=level > _OUTLIER * max(typical, 0.2))
    variance = _level_variance(fit, received)
    return replace(fit, weight=(_TAIL + 1) / (_TAIL + residual**2 / variance) / variance)


def _residual_of_equals(fit: TapFit, received: np.ndarray) -> Float[np.ndarray, "M T"]:
    """Residuals where all microphones say alike how strong a tap was.

    With weights of their own one could be believed ever more for agreeing with strengths that it alone decides.
    """
    relative = fit.noise.relative
    alike = replace(fit, noise=replace(fit.noise, relative=np.full(len(relative), np.median(relative))))
    alike = replace(alike, weight=1 / _level_variance(alike, received))
    strength = fit_strengths(alike.problem(with_outliers=True), fit.values, fit.strength)
    return np.where(fit.usable, fit.level - replace(alike, strength=strength).expected(), 0.0)


def _level_variance(fit: TapFit, received: np.ndarray) -> np.ndarray:
    """Of levels where `received` is expected, which no weight of which may be boundless."""
    floor = 1e-6 * np.nanmax(np.where(fit.use, fit.power, np.nan), axis=1, initial=1e-300)[:, None]
    return _variance(fit, np.maximum(received, floor))


def _variance(fit: TapFit, received: np.ndarray) -> np.ndarray:
    return np.asarray(fit.noise.level_variance(host.asarray(received)))
