"""Cross-validation of decay models: localisation errors of taps left out of the fit, by which models are compared.

The tapped positions are divided into a few folds; the taps of each fold are located by models fitted to the taps of the
other folds. Taps at one position stay in one fold, so that the model has not been fitted to that position.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jeit.acoustic.calibration.decay_fit import fit_within
from jeit.acoustic.calibration.robust_least_squares import TapFit
from jeit.acoustic.localisation.likelihood import Likelihood
from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.localisation.pixels import Pixels, valleys
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import AbstractSurface, bounding_box, in_space, longer_side
from jeit_solvers import inverse_small, minimise_small
from jeit_solvers.engines import as_array, at_once, host, namespace, on_device

_PARTS = 4
# Least relative error assumed in screening rasters; steps of a descent.
_SCREENED_AT, _MOST_STEPS = 0.2, 30
# Located taps required before their errors widen covariances; 90 % quantile of χ² with two degrees of freedom.
_FEWEST, _MOST_OF_THEM = 10, 0.9
_CHI_SQUARE = -2 * math.log(1 - _MOST_OF_THEM)


class LeftOutTaps(NamedTuple):
    """Localisation errors of T left-out taps; NaN for taps that were not detected or are outliers.

    `off` (T,): distance from the given position, metres; `square` (T,): squared error in units of the covariance;
    `guess`: median distance of the positions from their mean.
    """

    off: Float[np.ndarray, " T"]
    square: Float[np.ndarray, " T"]
    guess: float

    @property
    def median(self) -> float:
        """Median localisation error, metres; infinite where no tap is located."""
        known = self.off[np.isfinite(self.off)]
        return float(np.median(known)) if known.size else np.inf

    @property
    def widening(self) -> float:
        """Factor on the covariances for which the ellipses contain 90 % of the taps; at least 1, since errors of the
        models may be larger elsewhere."""
        known = self.square[np.isfinite(self.square)]
        if known.size < _FEWEST:
            return 1.0
        return max(float(np.quantile(known, _MOST_OF_THEM)) / _CHI_SQUARE, 1.0)

    @property
    def located(self) -> bool:
        """Whether the median error is at most half that of guessing the mean of all positions."""
        return self.median < 0.5 * self.guess


def locate_left_out(
    fit: TapFit, microphones: Float[np.ndarray, "M d"], surface: AbstractSurface, places: Float[np.ndarray, "T d"]
) -> LeftOutTaps:
    """Locate every tap with models fitted to taps at other positions, and the noise of the whole fit."""
    part = _deal(places)
    off, square = np.full((2, len(places)), np.nan)
    coarse = Localiser.create(_array(fit, fit.values, microphones, surface)).coarse
    for k in range(int(part.max()) + 1):
        out = (part == k) & ~fit.outlier
        kept = replace(fit, outlier=fit.outlier | (part == k))
        received = np.asarray(kept.use.any(axis=1))
        use = fit.usable[:, out] & received[:, None]
        if not out.any() or not (use.sum(axis=0) >= 3).any():
            continue
        values, _, _ = fit_within(kept.problem(), fit.values, fit.strength, received, fit.bounds)
        array = _array(fit, values, microphones, surface)
        found, covariance = at_once(_most_likely, array, coarse, np.nan_to_num(fit.power[:, out]), use)
        offset = found - places[out]
        # On a curved surface the covariance is singular.
        known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(offset).all(axis=1) & (use.sum(axis=0) >= 3)
        inverse = np.linalg.pinv(np.where(known[:, None, None], covariance, 0.0), hermitian=True, rcond=1e-9)
        off[out] = np.where(known, np.linalg.norm(offset, axis=1), np.nan)
        square[out] = np.where(known, np.einsum("ni,nij,nj->n", np.nan_to_num(offset), inverse, offset), np.nan)
    guess = float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    return LeftOutTaps(off, square, guess)


def _array(fit: TapFit, values, microphones, surface: AbstractSurface) -> MicrophoneArray:
    decay = on_device(fit.kind.from_logarithms(host.asarray(values)))
    return MicrophoneArray(as_array(microphones), surface, decay, on_device(fit.noise))


def _most_likely(array: MicrophoneArray, coarse: Pixels, power, use):
    """Positions (F, d) and covariances (F, d, d) by Fisher scoring from the best two valleys of a raster, within the
    outline's bounding box: the result of a `Localiser`, except for the last digits and for non-rectangular outlines."""
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
    return in_space(array.surface, x[:2], spread)


def _deal(places: Float[np.ndarray, "T d"]) -> Int[np.ndarray, " T"]:
    """Fold of each tap: positions are assigned to the folds in turn, in a fixed random order."""
    step = 1e-4 * max(float(np.ptp(places, axis=0).max()), 1e-300)
    _, which = np.unique(np.round(places / step), axis=0, return_inverse=True)
    order = np.random.default_rng(0).permutation(which.max() + 1)
    return (order % _PARTS)[which.ravel()]
