"""Errors of touches located by an array of microphones, with different decay models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.opponents.plain_consistency import PlainConsistency
from benchmarks.problems.simulated_arrays import BURST, ONSET, RATE, SAMPLES, SILENT, SimulatedArray
from jeit.acoustic import Intensities, Recording, Taps, locate
from jeit.acoustic.calibration.calibrate import CalibrationFit, fit_each_decay, select_fit

# 68 % and 95 % quantiles of χ² with two degrees of freedom.
ELLIPSES = (-2 * np.log(1 - 0.68), -2 * np.log(1 - 0.95))


@dataclass(frozen=True)
class Located:
    """Results for N touches. `off` (N,): distances in metres of located from true positions, infinite for touches that
    were not located.

    `square` (N,): squared distances in units of the covariance. `status` of each touch. `message`: error message of the
    calibration, empty without an error. `decay`: fitted decay model. `silence`: fraction of silent intervals that were
    reported as a touch.
    """

    off: Float[np.ndarray, " N"]
    square: Float[np.ndarray, " N"]
    status: tuple[str, ...] = ()
    message: str = ""
    decay: str = ""
    silence: float = 0.0

    @property
    def median(self) -> float:
        """Median error, metres."""
        return float(np.median(self.off))

    def held(self, ellipse: int) -> float:
        """Fraction of the located touches whose true position lies in the 68 % ellipse (`ellipse` 0) or 95 % ellipse
        (1)."""
        found = np.isfinite(self.square)
        return float(np.mean(self.square[found] < ELLIPSES[ellipse])) if found.any() else np.nan


def taps_of(array: SimulatedArray) -> Taps:
    """Taps for the calibration of an array, in one of the forms in which users give them: samples or intensities."""
    if array.sampled:
        return Taps(array.microphones, array.outline, array.places, samples=array.taps, rate=RATE)
    return Taps(array.microphones, array.outline, array.places, power=array.intensity(array.taps)[0])


def touches_of(array: SimulatedArray) -> tuple[Recording | Intensities, np.ndarray]:
    """The recording of N touches and `SILENT` silent intervals, and the middle of each in time (N + SILENT,), in
    seconds."""
    middle = SAMPLES / RATE * np.arange(len(array.touches) + SILENT) + ONSET + BURST / 2
    if array.sampled:
        return Recording(array.sound, RATE), middle
    power, _ = array.intensity(array.stretches)
    return Intensities(middle, power), middle


def located_by_each(array: SimulatedArray) -> dict[str, Located]:
    """Results of jeit's defaults after calibration with every decay model, and with the model that "auto" chooses, by
    name of the model.
    """
    fits, refused = fit_each_decay(taps_of(array))
    far = np.full(len(array.touches), np.inf)
    found = {name: located(array, fit) for name, fit in fits.items()}
    found |= {name: Located(far, far, message=why) for name, why in refused.items()}
    try:
        chosen = select_fit(fits, refused).left_out[0][0]
    except ValueError as error:
        return found | {"auto": Located(far, far, message=str(error))}
    return found | {"auto": found[chosen]}


def located(array: SimulatedArray, fit: CalibrationFit) -> Located:
    """Results of jeit's defaults after the calibration `fit`."""
    recording, middle = touches_of(array)
    found = locate(recording, fit.calibration)
    nearest = np.abs(found.times[:, None] - middle[:-SILENT]).argmin(axis=0)
    offset = found.position[nearest] - array.touches
    off = np.linalg.norm(offset, axis=1)
    square = np.full(len(off), np.inf)
    known = np.isfinite(off)
    if known.any():
        covariance = found.covariance[nearest][known]
        square[known] = np.einsum("ni,nij,nj->n", offset[known], np.linalg.inv(covariance), offset[known])
    # The first silent interval is left out, because the last touch may reach into it.
    silence = float(np.mean(found.status[found.times >= middle[1 - SILENT]] != "no touch"))
    law = fit.calibration.microphone_array.decay.name
    return Located(np.where(known, off, np.inf), square, tuple(found.status[nearest]), "", law, silence)


def plainly_located(array: SimulatedArray) -> Located:
    """Results of the plain fit (`PlainConsistency`), from the same bursts."""
    plain = PlainConsistency(array.microphones, array.outline, array.places, array.intensity(array.taps)[0])
    off = np.linalg.norm(plain(array.intensity(array.stretches[:-SILENT])[0]) - array.touches, axis=1)
    return Located(off, np.full(len(off), np.nan))
