"""Calibration: fit the decay model and noise of each microphone to taps at known positions with unknown strengths.

The models are fitted by robust least squares. The decay model that best locates taps left out of the fit is selected.
Outlying taps are excluded from the fit and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.calibration.robust_least_squares import TapFit, fit_taps, standard_errors
from jeit.acoustic.calibration.usable_microphones import LeftOutTaps, check_received, leave_out, locate_left_out
from jeit.acoustic.decay import DECAYS, AbstractDecay, find_decay
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.noise import IntensityNoise, noise_from_negative_powers
from jeit.acoustic.signal.faults import describe_faults, intensity_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, tap_intensities
from jeit.acoustic.signal.recording import Taps
from jeit.acoustic.surface import AbstractSurface, make_surface
from jeit.arguments import check_kind, describe, is_number
from jeit_solvers.engines import as_array, host, on_device
from jeit_solvers.module import Module

# Value of `decay` that selects the decay model by cross-validation.
AUTO = "auto"
# Minimum relative improvement of the localisation error of left-out taps for which a model with more parameters is
# preferred.
_LEAST_IMPROVEMENT = 0.05
# Relative error of the intensities above which a note is given. On simulated skins with uneven coupling and exact
# positions, the relative error is 18 to 21 %.
_LARGE_ERROR = 0.23
# Minimum fraction of the microphones with enough taps that must agree with the model, unless left-out taps are located
# well. Otherwise the given positions are rejected.
_LEAST_SHARE = 0.5
# Default standard deviation of each coordinate of the microphones' given positions, in metres.
PLACE_ERROR = 2e-3


class CalibrationFit(Module):
    """A calibration, with the T taps to which it was fitted.

    - `calibration`: the fitted calibration.
    - `distance`: (T, M) distance of each tap from the estimated position of each microphone in metres.
    - `power`: (T, M) intensities minus the noise floor.
    - `usable`: (T, M) mask of the intensities to which the models were fitted before unusable microphones were
      excluded.
    - `strength`: (T,) strengths of the taps; NaN if no microphone received the tap or the tap was excluded.
    - `outlier`: (T,) mask of taps that were excluded because no single source at the given position explains them.
    - `explained`: (M,) fraction of the variance of a microphone's levels that its model explains.
    - `shared`: (M,) mask of microphones whose own taps do not determine the decay of the response with distance, which
      is then taken from the other microphones.
    - `displacement`: (M, d) estimated displacement of each microphone from its given position in metres. The
      `calibration` has the estimated positions.
    - `left_out`: name of each decay model with its median localisation error in metres for taps left out of the fit;
      infinite if it located none. The selected model is first.
    """

    calibration: Calibration
    distance: Float[np.ndarray, "T M"]
    power: Float[np.ndarray, "T M"]
    usable: Bool[np.ndarray, "T M"]
    strength: Float[np.ndarray, " T"]
    outlier: Bool[np.ndarray, " T"]
    explained: Float[np.ndarray, " M"]
    shared: Bool[np.ndarray, " M"]
    displacement: Float[np.ndarray, "M d"]
    left_out: tuple[tuple[str, float], ...] = ()

    @property
    def error(self) -> float:
        """Median over the usable microphones of the relative error of the predicted intensities."""
        calibration = self.calibration
        return float(np.median(np.asarray(calibration.microphone_array.noise.relative)[calibration.usable]))

    @property
    def evidence(self) -> str:
        """Text that compares the localisation errors of the decay models for left-out taps; empty if unknown."""
        if not self.left_out:
            return ""
        mine, *others = (_distance_text(off) for _, off in self.left_out)
        names = [name for name, _ in self.left_out[1:]]
        beside = ", ".join(f"{name} {off}" for name, off in zip(names, others, strict=True))
        return f"locates taps left out of the fit to {mine}, median" + (f" ({beside})" if beside else "")

    @property
    def note(self) -> str:
        """Text that suggests reasons for a large `error`; empty if the error is not large."""
        if self.error <= _LARGE_ERROR:
            return ""
        return (
            f"the models miss the recorded levels by {100 * self.error:.0f} %, and places are less certain. "
            "On simulated skins taps at their places leave 20 %, taps 3 mm off them 25 %, and 5 mm off 30 %: are all "
            "where they are said to be? Or sound falls off in another way here"
            + (": try another decay=, or auto." if len(self.left_out) == 1 else " than in any decay model.")
        )


def _distance_text(distance: float) -> str:
    return f"{1e3 * distance:.1f} mm" if np.isfinite(distance) else "refused"


def calibrate_microphones(
    taps: Taps,
    *,
    decay: str | type[AbstractDecay] = AUTO,
    place_error: float = PLACE_ERROR,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibrationFit:
    """Fit the decay model of each microphone to taps at known positions, like the command `jeit calibrate-microphones`.

    **Arguments:**

    - `taps`: the taps, their positions and those of the microphones.
    - `decay`: "inverse-square", a / (r² + b) as in Park 2022; "exponential", a exp(−r / l); "attenuated", a exp(−r / l)
      / (r² + b); a subclass of `AbstractDecay`; or "auto", which selects among the three the model with the smallest
      median localisation error of left-out taps (four-fold cross-validation over the positions).
    - `place_error`: standard deviation of each coordinate of the given positions of the microphones, metres, whose
      displacements are estimated too; 0 if the positions are exact.
    - `intensity`: band and windows, for taps given as samples.
    - `progress`: called with the name of each step when it begins.

    Raises `ValueError` if fewer than three microphones can be calibrated, if most microphones disagree with the given
    positions, for an unknown `decay`, a `place_error` that is negative or not finite, for `intensity` given with taps
    that are intensities, and for arguments of the wrong type.

    **Example:**

    ```python
    fit = calibrate_microphones(taps, decay="inverse-square")
    calibration = fit.calibration
    ```
    """
    every = isinstance(decay, str) and decay == AUTO
    kinds = () if every else (find_decay(decay),)
    fits, refused = fit_each_decay(taps, kinds, place_error=place_error, intensity=intensity, progress=progress)
    return select_fit(fits, refused)


def select_fit(fits: dict[str, CalibrationFit], refused: dict[str, str]) -> CalibrationFit:
    """Select the fit that locates left-out taps best. Among fits with nearly equal errors, the one with the fewest
    parameters is selected. Raises `ValueError` if `fits` is empty; its message is the first reason in `refused`."""
    if not fits:
        raise ValueError(next(iter(refused.values())))
    # The fits are in order of their number of parameters.
    least = min(fit.left_out[0][1] for fit in fits.values())
    return next(fit for fit in fits.values() if not fit.left_out[0][1] > (1 + _LEAST_IMPROVEMENT) * least)


@np.errstate(all="ignore")  # models that do not fit are reported with a reason
def fit_each_decay(
    taps: Taps,
    decays: Sequence[type[AbstractDecay]] = (),
    *,
    place_error: float = PLACE_ERROR,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, CalibrationFit], dict[str, str]]:
    """Fit each of the given decay models; by default all. Returns a dictionary of the fits by name, and a dictionary of
    the reasons why the other models could not be fitted.

    `progress` is called with the name of each step when it begins. Raises `ValueError` as `calibrate_microphones` does,
    but not if no model can be fitted.
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("intensity", intensity)
    if not (is_number(place_error) and place_error >= 0):
        raise ValueError(f"place_error must be zero or positive, in metres; it is {describe(place_error)}.")
    if intensity is not None and taps.samples is None:
        raise ValueError("intensity: band and window are for taps that come as samples; these are intensities.")
    report = progress or (lambda step: None)
    if taps.samples is not None:
        report("measure intensities")
    readings = _read_taps(taps, intensity, place_error)
    found, refused = {}, {}
    for kind in decays or DECAYS.values():
        report(f"fit {kind.name}")
        try:
            found[kind.name] = _fit_decay_model(kind, readings)
        except _NoFitError as error:
            refused[kind.name] = str(error)
    left_out = {name: fitted.left.median for name, fitted in found.items()} | dict.fromkeys(refused, np.inf)
    fits = {}
    for name, fitted in found.items():
        others = tuple(item for item in left_out.items() if item[0] != name)
        fits[name] = _calibration_fit(taps, readings, fitted, ((name, left_out[name]), *others))
    return fits, refused


class _FitInput(NamedTuple):
    """Input of a fit: positions and intensities of the taps, and the noise of the microphones.

    **Fields**: `microphones`, `places`: positions of microphones and taps in metres; `surface`: the surface;
    `place_error`: standard deviation of the microphones' coordinates in metres; `power`: intensities minus the floor,
    NaN where unusable; `noise`: noise of the microphones; `known_noise`: whether its floor was measured; `faults`:
    fault of each microphone; `settings`: band and windows, for taps given as samples.
    """

    microphones: Float[np.ndarray, "M d"]
    surface: AbstractSurface
    places: Float[np.ndarray, "T d"]
    place_error: float
    power: Float[np.ndarray, "M T"]
    noise: IntensityNoise
    known_noise: bool
    faults: tuple[str, ...]
    settings: IntensitySettings | None


class _FittedModel(NamedTuple):
    """Result of the fit of one decay model.

    **Fields**: `fit`: the fit; `tried`: mask of the readings used in the first fit, of all microphones; `good`: mask of
    the usable microphones; `reasons`: reasons why microphones are unusable; `explained`: fraction of variance that each
    model explains; `left`: localisation errors of left-out taps.
    """

    fit: TapFit
    tried: Bool[np.ndarray, "T M"]
    good: Bool[np.ndarray, " M"]
    reasons: tuple[str, ...]
    explained: Float[np.ndarray, " M"]
    left: LeftOutTaps


class _NoFitError(Exception):
    """Raised if a decay model cannot be fitted to the taps. The message gives the reason."""


def _read_taps(taps: Taps, intensity: IntensitySettings | None, place_error: float) -> _FitInput:
    surface = make_surface(taps.outline, taps.positions)
    settings = None
    if taps.samples is None:
        assert taps.power is not None
        power, (usable, faults) = taps.power, intensity_faults(taps.power)
        noise = IntensityNoise.create(power.shape[1], deviation=noise_from_negative_powers(power, usable))
    else:
        settings = intensity if intensity is not None else IntensitySettings()
        power, floor, freedom, usable, faults = tap_intensities(taps, settings)
        noise = IntensityNoise.create(power.shape[1], floor=floor, freedom=np.median(freedom))
    known = np.where(usable, power, np.nan).T
    noisy = noise, settings is not None, tuple(faults), settings
    return _FitInput(taps.microphones, surface, taps.positions, float(place_error), known, *noisy)


def _fit_decay_model(kind: type[AbstractDecay], readings: _FitInput) -> _FittedModel:
    """Fit one decay model to all microphones. Raises `_NoFitError` if too few microphones received the taps or agree
    with the model."""
    distance = np.linalg.norm(readings.microphones[:, None] - readings.places, axis=-1)
    enough, why = check_received(kind, distance, readings.power, readings.faults)
    if why:
        raise _NoFitError(why)
    noise = readings.noise, readings.known_noise
    fit = fit_taps(kind, readings.microphones, readings.places, readings.power, *noise, readings.place_error)
    tried = fit.use.T
    fit, good, reasons, explained = leave_out(fit, readings.faults)
    left = locate_left_out(fit, readings.microphones, readings.surface, readings.places)
    if good.sum() < 3 or (good.sum() < _LEAST_SHARE * enough.sum() and not left.is_better_than_mean):
        raise _NoFitError(
            f"only {good.sum()} of the {enough.sum()} microphones that received the taps follow a decay model, and "
            "three are needed, or half: are the rows of positions in the order of the taps, those of microphones in "
            f"the order of the channels? {describe_faults(reasons)}."
        )
    return _FittedModel(fit, tried, good, reasons, explained, left)


def _calibration_fit(taps: Taps, readings: _FitInput, fitted: _FittedModel, notes) -> CalibrationFit:
    fit, good = fitted.fit, fitted.good
    # Logarithm of the common factor of gains and strengths, according to the convention of `Calibration`.
    gain = np.log(np.asarray(fit.kind.from_logarithms(host.asarray(fit.logarithms)).gain))[good].mean()
    strength = np.where(fit.received, np.exp(fit.strength + gain), np.nan)
    shared, errors = fit.shared & good, standard_errors(fit)[: len(fit.logarithms)]
    errors[1:, shared] = np.nan
    decay = on_device(fit.kind.from_logarithms(host.concatenate([fit.logarithms[:1] - gain, fit.logarithms[1:]])))
    loud = (fit.use & (readings.power > 3 * fit.noise.deviation[:, None])).any(axis=0)
    microphones = readings.microphones + fit.displacement
    calibration = Calibration(
        MicrophoneArray(as_array(microphones), readings.surface, decay, on_device(fit.noise)),
        good,
        fitted.reasons,
        errors,
        readings.settings,
        taps.name,
        _strength_range(strength[loud]),
        fitted.left.widening,
    )
    rest = strength, fit.outlier, fitted.explained, shared, fit.displacement, notes
    distance = np.linalg.norm(readings.places[:, None] - microphones, axis=-1)
    return CalibrationFit(calibration, distance, readings.power.T, fitted.tried, *rest)


def _strength_range(strength: np.ndarray) -> tuple[float, float] | None:
    """Strengths of the weakest and the strongest tap; None if no strength is known."""
    known = strength[strength > 0]
    return (float(known.min()), float(known.max())) if known.size else None
