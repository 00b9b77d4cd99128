"""Selection of usable microphones, and cross-validation of decay models.

Microphones that received too few taps, or whose levels disagree with their model, are left out of a calibration.

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

from jeit.acoustic.calibration.decay_fit import fit_within
from jeit.acoustic.calibration.robust_least_squares import TapFit, refit_without
from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.localisation.pixels import Pixels, valleys
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.surface import AbstractSurface, bounding_box, longer_side, to_space
from jeit_solvers import inverse_small, minimise_small
from jeit_solvers.engines import as_array, at_once, host, namespace, on_device

# Minimum fraction of the variance of a microphone's levels that its model must explain.
_LEAST_EXPLAINED = 0.3
# Maximum ratio of a microphone's relative error to the median over all microphones, and lower bound of that median.
_MOST_ERROR_RATIO, _LEAST_MEDIAN_ERROR = 2.5, 0.1
# Minimum decrease of the logarithm of a response from the nearest to the farthest tap.
_LEAST_DECREASE = 0.1


def check_received(
    kind: type[AbstractDecay], distance: Float[np.ndarray, "M T"], power: Float[np.ndarray, "M T"], faults
) -> tuple[Bool[np.ndarray, " M"], str]:
    """Return the mask of the microphones that received taps from enough different distances, and the reason why no
    model can be fitted if fewer than three did, otherwise ""."""
    needed = len(kind.parameters) + 2
    step = 1e-4 * distance.max()
    received = np.isfinite(power)
    places = np.array([np.unique(np.round(far[one] / step)).size for far, one in zip(distance, received, strict=True)])
    enough = places >= needed
    if enough.sum() >= 3:
        return enough, ""
    return enough, (
        f"only {enough.sum()} of {len(enough)} microphones received taps from {needed} distances or more, and three "
        f"are needed to calibrate a decay model of {len(kind.parameters)} parameters: tap all over the skin. "
        f"{describe_faults(faults)}"
    ).strip()


def leave_out(fit: TapFit, faults) -> tuple[TapFit, Bool[np.ndarray, " M"], tuple[str, ...], Float[np.ndarray, " M"]]:
    """Repeat the fit without the unusable microphones.

    Returns the new fit, the mask of the usable microphones, the reasons why microphones are unusable ("" for usable
    ones), and the fraction of variance that each model explains.
    """
    reasons, explained = _reasons_and_explained(fit, faults)
    bad = np.array([bool(reason) for reason in reasons])
    # The disagreement of some microphones may become apparent only after others are excluded.
    while bad.any() and (~fit.dropped & ~bad).sum() >= 3:
        fit = refit_without(fit, bad)
        again, explained = _reasons_and_explained(fit, ("",) * len(bad), explained)
        bad = np.array([bool(reason) for reason in again]) & ~fit.dropped
        reasons = tuple(new if worse else old for new, old, worse in zip(again, reasons, bad, strict=True))
    return fit, ~fit.dropped & ~bad, reasons, explained


def _reasons_and_explained(fit: TapFit, faults, explained=None) -> tuple[tuple[str, ...], Float[np.ndarray, " M"]]:
    """Return the reason why each microphone is unusable ("" if usable), and the fraction of the variance of its levels
    that its model explains. For excluded microphones this fraction is taken from `explained`."""
    expected, level, use = fit.expected(), fit.level, fit.use
    falls = _response_decrease(fit)
    needed = len(fit.kind.parameters) + 2
    deviation, relative = fit.noise.deviation, fit.noise.relative
    typical = float(np.median(relative[use.any(axis=1)])) if use.any() else 0.0
    share = np.zeros(len(faults)) if explained is None else explained.copy()
    reasons = []
    for k, fault in enumerate(faults):
        used = use[k]
        received = (used & (fit.power[k] > 3 * deviation[k])).sum()
        if not used.any():
            reasons.append(fault)
            continue
        spread = np.var(level[k, used])
        share[k] = 1 - np.mean((level - expected)[k, used] ** 2) / spread if spread > 0 else 0.0
        if falls[k] < _LEAST_DECREASE:
            reasons.append("its intensity does not fall with distance")
        elif used.sum() >= needed and not share[k] >= _LEAST_EXPLAINED:
            reasons.append(f"its model explains {100 * max(share[k], 0):.0f} % of what it received")
        elif received < needed:
            reasons.append(f"it received {received} of the taps only, and {needed} are needed")
        elif relative[k] > _MOST_ERROR_RATIO * max(typical, _LEAST_MEDIAN_ERROR):
            reasons.append(
                f"its model is off by {100 * relative[k]:.0f} %, and those of others by {100 * typical:.0f} %: is it "
                "where it is said to be, and was its gain the same throughout?"
            )
        else:
            reasons.append("")
    return tuple(reasons), share


def _response_decrease(fit: TapFit) -> Float[np.ndarray, " M"]:
    """Decrease of the logarithm of each microphone's response from the nearest tap to the farthest."""
    response, use = fit.problem().log_response(fit.values), fit.use
    most, least = (
        pick(response, axis=1, where=use, initial=far) for pick, far in ((np.max, -np.inf), (np.min, np.inf))
    )
    return np.where(use.any(axis=1), most - least, np.inf)


# Number of folds in the cross-validation.
_NUM_FOLDS = 4
# Minimum relative error assumed when a raster is screened; maximum number of steps of a minimisation.
_SCREENED_AT, _MOST_STEPS = 0.2, 30
# Minimum number of located taps for an estimate of `widening`; fraction of the taps that the error ellipses must
# contain; quantile of χ² with two degrees of freedom for that fraction.
_FEWEST, _CONTAINED_SHARE = 10, 0.9
_CHI_SQUARE = -2 * math.log(1 - _CONTAINED_SHARE)


class LeftOutTaps(NamedTuple):
    """Localisation errors of T left-out taps.

    **Fields**: `off`: distance (T,) of each estimate from the given position in metres; `square`: squared Mahalanobis
    distance (T,), the squared error in units of the covariance; `guess`: median distance in metres of the given
    positions from their mean. `off` and `square` are NaN for outliers and for taps that could not be located.
    """

    off: Float[np.ndarray, " T"]
    square: Float[np.ndarray, " T"]
    guess: float

    @property
    def median(self) -> float:
        """Median localisation error in metres; infinite if no tap was located."""
        known = self.off[np.isfinite(self.off)]
        return float(np.median(known)) if known.size else np.inf

    @property
    def widening(self) -> float:
        """Factor on covariances for which the 90 % error ellipses contain 90 % of the taps. It is at least 1, since the
        errors of the models may be larger at other positions."""
        known = self.square[np.isfinite(self.square)]
        if known.size < _FEWEST:
            return 1.0
        return max(float(np.quantile(known, _CONTAINED_SHARE)) / _CHI_SQUARE, 1.0)

    @property
    def is_better_than_mean(self) -> bool:
        """Whether the median error is less than half of `guess`, the error of always guessing the mean position."""
        return self.median < 0.5 * self.guess


def locate_left_out(
    fit: TapFit, microphones: Float[np.ndarray, "M d"], surface: AbstractSurface, places: Float[np.ndarray, "T d"]
) -> LeftOutTaps:
    """Locate each tap with decay models and displacements fitted to taps in other folds, and with the noise of the fit
    to all taps. `microphones`: given positions."""
    part = _assign_folds(places)
    off, square = np.full((2, len(places)), np.nan)
    coarse = Localiser.create(_microphone_array(fit, fit.values, microphones, surface)).coarse
    for k in range(int(part.max()) + 1):
        out = (part == k) & ~fit.outlier
        kept = replace(fit, outlier=fit.outlier | (part == k))
        received = np.asarray(kept.use.any(axis=1))
        use = fit.usable[:, out] & received[:, None]
        if not out.any() or not (use.sum(axis=0) >= 3).any():
            continue
        values, _, _ = fit_within(kept.problem(), fit.values, fit.strength, received, fit.bounds)
        array = _microphone_array(fit, values, microphones, surface)
        found, covariance = at_once(_locate_most_likely, array, coarse, np.nan_to_num(fit.power[:, out]), use)
        offset = found - places[out]
        # The pseudoinverse is used, since the covariance on a curved surface is singular.
        known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(offset).all(axis=1) & (use.sum(axis=0) >= 3)
        inverse = np.linalg.pinv(np.where(known[:, None, None], covariance, 0.0), hermitian=True, rcond=1e-9)
        off[out] = np.where(known, np.linalg.norm(offset, axis=1), np.nan)
        square[out] = np.where(known, np.einsum("ni,nij,nj->n", np.nan_to_num(offset), inverse, offset), np.nan)
    guess = float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    return LeftOutTaps(off, square, guess)


def _microphone_array(fit: TapFit, values, microphones, surface: AbstractSurface) -> MicrophoneArray:
    decay = on_device(fit.kind.from_logarithms(host.asarray(values[: len(fit.kind.parameters)])))
    displaced = microphones + fit.problem().displacement(values)
    return MicrophoneArray(as_array(displaced), surface, decay, on_device(fit.noise))


def _locate_most_likely(array: MicrophoneArray, coarse: Pixels, power, use):
    """Positions (F, d) and covariances (F, d, d) by Fisher scoring from the best two valleys of a raster, within the
    bounding box of the outline. For a rectangular outline, the result is that of a `Localiser` up to rounding."""
    xp = namespace(array, power)
    rough = eqx.tree_at(lambda one: one.noise.relative, array, xp.maximum(array.noise.relative, _SCREENED_AT))
    maps = Likelihood.create(power, use, rough).screen(Likelihood.features(rough, coarse.chart))
    first, second, _ = valleys(maps, coarse)
    twice = Likelihood.create(xp.tile(power, 2), xp.tile(use, 2), array)
    low, high = bounding_box(array.surface)
    reach, free = longer_side(array.surface), xp.full(1, xp.inf)
    found = minimise_small(
        lambda x, frames: Likelihood(frames[0], frames[1], frames[2], array).expand(x),
        twice.start(xp.concatenate([first, second], axis=1)),
        twice.frames,
        lower=xp.concatenate([low, -free])[:, None],
        upper=xp.concatenate([high, free])[:, None],
        largest_step=xp.array([[reach / 4], [reach / 4], [2.3]]),
        max_steps=_MOST_STEPS,
        tolerance=1e-8,
    )
    value = xp.where(xp.isfinite(found.value), found.value, xp.inf).reshape(2, -1)
    best = value.argmin(axis=0) * power.shape[1] + xp.arange(power.shape[1])
    x = found.x[:, best]
    spread = inverse_small(Likelihood.create(power, use, array).expand(x)[2])[:2, :2]
    return to_space(array.surface, x[:2], spread)


def _assign_folds(places: Float[np.ndarray, "T d"]) -> Int[np.ndarray, " T"]:
    """Index of the fold of each tap. Distinct positions are assigned to the folds in turn, in a fixed random order."""
    step = 1e-4 * max(float(np.ptp(places, axis=0).max()), 1e-300)
    _, which = np.unique(np.round(places / step), axis=0, return_inverse=True)
    order = np.random.default_rng(0).permutation(which.max() + 1)
    return (order % _NUM_FOLDS)[which.ravel()]
