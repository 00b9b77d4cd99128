"""How well taps are located that a fit has not seen: the evidence by which one decay model is preferred to another.

The places that were tapped are dealt to a few parts; where the taps of each part were is told by models fitted to the
taps of the others. Taps at one place stay together, or the model would have seen them.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jeit.acoustic.calibration.decay_fit import fit_within
from jeit.acoustic.calibration.robust_least_squares import TapFit
from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import AbstractSurface
from jeit_solvers.engines import as_array, host, on_device

_PARTS = 4
# Taps that must have been located for their errors to widen anything; χ² of two degrees that 90 % stay under.
_FEWEST, _MOST_OF_THEM = 10, 0.9
_CHI_SQUARE = -2 * math.log(1 - _MOST_OF_THEM)


class LeftOutTaps(NamedTuple):
    """Of T taps, NaN for those that were not heard or are outliers: `off` (T,) metres from where they were said to be;
    `square` (T,), that in units of the covariance, squared. `guess`: how far off the middle of all places is, median.
    """

    off: Float[np.ndarray, " T"]
    square: Float[np.ndarray, " T"]
    guess: float

    @property
    def median(self) -> float:
        """Half of them are located better, metres; infinite where none is."""
        known = self.off[np.isfinite(self.off)]
        return float(np.median(known)) if known.size else np.inf

    @property
    def widening(self) -> float:
        """What covariances must be multiplied by for ellipses to hold the taps, but for the tenth that is farthest off;
        1 at least, for what errors of models look like from here may look worse from elsewhere."""
        known = self.square[np.isfinite(self.square)]
        if known.size < _FEWEST:
            return 1.0
        return max(float(np.quantile(known, _MOST_OF_THEM)) / _CHI_SQUARE, 1.0)

    @property
    def located(self) -> bool:
        """Whether places are told any better than by the middle of them all: twice as well."""
        return self.median < 0.5 * self.guess


def locate_left_out(
    fit: TapFit, microphones: Float[np.ndarray, "M d"], surface: AbstractSurface, places: Float[np.ndarray, "T d"]
) -> LeftOutTaps:
    """Every tap, by models that were fitted to taps at other places, with the noise of the whole fit.

    All at once: as by an array in which each microphone is as often as there are parts, each time with the model of one
    part, of which a tap is heard by those of its own.
    """
    part = _deal(places)
    number = int(part.max()) + 1
    values, use = [], np.zeros((number, *fit.usable.shape), bool)
    for k in range(number):
        kept = replace(fit, outlier=fit.outlier | (part == k))
        heard = np.asarray(kept.use.any(axis=1))
        values.append(fit_within(kept.problem(), fit.values, fit.strength, heard, fit.bounds)[0])
        use[k] = fit.usable & heard[:, None] & (part == k) & ~fit.outlier
    every = np.concatenate(values, axis=1), np.tile(microphones, (number, 1))
    decay = on_device(fit.kind.from_logarithms(host.asarray(every[0])))
    noise = jax.tree.map(lambda each: np.tile(each, number), fit.noise)
    array = MicrophoneArray(as_array(every[1]), surface, decay, on_device(noise))
    power, use = np.tile(np.nan_to_num(fit.power), (number, 1)), use.reshape(-1, len(places))
    found = Localiser.create(array, compiled=False)(power.T, use.T)
    offset, covariance = np.asarray(found.position) - places, np.asarray(found.covariance)
    # On a curved surface a covariance is flat.
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(offset).all(axis=1))
    inverse = np.linalg.pinv(np.where(known[:, None, None], covariance, 0.0), hermitian=True, rcond=1e-9)
    square = np.where(known, np.einsum("ni,nij,nj->n", np.nan_to_num(offset), inverse, offset), np.nan)
    guess = float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    return LeftOutTaps(np.where(known, np.linalg.norm(offset, axis=1), np.nan), square, guess)


def _deal(places: Float[np.ndarray, "T d"]) -> Int[np.ndarray, " T"]:
    """Which part each tap is in: places in a fixed random order, one part after the other."""
    step = 1e-4 * max(float(np.ptp(places, axis=0).max()), 1e-300)
    _, which = np.unique(np.round(places / step), axis=0, return_inverse=True)
    order = np.random.default_rng(0).permutation(which.max() + 1)
    return (order % _PARTS)[which.ravel()]
