"""Calibration: fit the decay model and noise of each microphone to taps at known positions with unknown strengths.

The models are fitted by robust least squares. The kind of decay model that best locates taps left out of the fit is
selected. Outlying taps are excluded from the fit and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.calibration.robust_least_squares import TapFit, fit_taps, standard_errors
from jeit.acoustic.calibration.usable_microphones import (
    LeftOutTaps,
    check_received,
    exclude_unusable,
    locate_held_out_taps,
)
from jeit.acoustic.decay import DECAY_MODELS, AbstractDecay, find_decay
from jeit.acoustic.microphones import IntensityNoise, MicrophoneArray, noise_from_negative_powers
from jeit.acoustic.signal.faults import describe_faults, intensity_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, tap_intensities
from jeit.acoustic.signal.recording import Taps
from jeit.acoustic.surface import AbstractSurface, make_surface
from jeit.arguments import check_kind, describe, is_number
from jeit_solvers.engines import as_array, host, on_device
from jeit_solvers.module import Module

# Value of the argument `decay` for which the decay model is selected by cross-validation.
AUTO = "auto"
# Minimum relative improvement of the localisation error of left-out taps for which a decay model with more parameters
# is preferred.
_MIN_ERROR_DECREASE = 0.05
# Relative error of the predicted intensities above which the calibration gives a note. On simulated skins with uneven
# coupling and exact positions, the relative error is 18 to 21 %.
_LARGE_PREDICTION_ERROR = 0.23
# Of the microphones with enough taps, the minimum fraction that must agree with the decay model, unless left-out taps
# are located well. If fewer agree, the decay model is rejected.
_MIN_USABLE_MICROPHONE_SHARE = 0.5
# Default standard deviation of each coordinate of the microphones' given positions, in metres.
MICROPHONE_POSITION_ERROR = 2e-3


class CalibrationFit(Module):
    """A calibration of M microphones, with the T taps to which it was fitted.

    - `calibration`: the fitted calibration.
    - `distance`: (T, M) distance of each tap from the estimated position of each microphone in metres.
    - `power`: (T, M) intensities of the taps minus the noise floor.
    - `usable`: (T, M) mask of the intensities used in the first fit, before unusable microphones were excluded.
    - `strength`: (T,) strengths of the taps; NaN if no microphone received the tap or the tap was excluded.
    - `outlier`: (T,) mask of taps that were excluded because no single source at the given position explains their
      intensities.
    - `explained`: (M,) fraction of the variance of a microphone's levels that its decay model explains.
    - `shared`: (M,) mask of microphones whose own intensities do not determine the decay of the response with distance.
      Their decay follows from a prior, which is estimated from the other microphones.
    - `displacement`: (M, d) estimated displacement of each microphone from its given position in metres. The
      `calibration` has the positions after displacement.
    - `left_out`: pairs of the name of a decay model and its median localisation error in metres for taps left out of
      the fit; the error is infinite if the model located no tap. The selected model is first.
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
        """Median over the usable microphones of the relative error of the intensities that the decay models predict."""
        calibration = self.calibration
        return float(np.median(np.asarray(calibration.microphone_array.noise.relative)[calibration.usable]))

    @property
    def evidence(self) -> str:
        """Text that compares the localisation errors of the decay models for taps left out of the fit; empty if the
        errors are unknown."""
        if not self.left_out:
            return ""
        selected_error, *other_model_errors = (_distance_text(model_error) for _, model_error in self.left_out)
        model_names = [model_name for model_name, _ in self.left_out[1:]]
        comparison_text = ", ".join(
            f"{model_name} {model_error}"
            for model_name, model_error in zip(model_names, other_model_errors, strict=True)
        )
        return f"locates taps left out of the fit to {selected_error}, median" + (
            f" ({comparison_text})" if comparison_text else ""
        )

    @property
    def note(self) -> str:
        """Text that suggests reasons for a large `error`; empty if the error is not large."""
        if self.error <= _LARGE_PREDICTION_ERROR:
            return ""
        return (
            f"the models miss the recorded levels by {100 * self.error:.0f} %, and places are less certain. "
            "On simulated skins taps at their places leave 20 %, taps 3 mm off them 25 %, and 5 mm off 30 %: are all "
            "where they are said to be? Or sound falls off in another way here"
            + (": try another decay=, or auto." if len(self.left_out) == 1 else " than in any decay model.")
        )


def _distance_text(distance_metres: float) -> str:
    return f"{1e3 * distance_metres:.1f} mm" if np.isfinite(distance_metres) else "refused"


def calibrate_microphones(
    taps: Taps,
    *,
    decay: str | type[AbstractDecay] = AUTO,
    place_error: float = MICROPHONE_POSITION_ERROR,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibrationFit:
    """Fit the decay model of each microphone to taps at known positions, as the command `jeit calibrate-microphones`
    does.

    **Arguments:**

    - `taps`: the taps, with the positions of taps and microphones.
    - `decay`: "inverse-square", a / (r² + b) as in Park 2022; "exponential", a exp(−r / l); "attenuated", a exp(−r / l)
      / (r² + b); a subclass of `AbstractDecay`; or "auto". With "auto", four-fold cross-validation over the positions
      gives the median localisation error of each model for left-out taps. Of the models within 5 % of the smallest
      error, the model with the fewest parameters is selected.
    - `place_error`: standard deviation of each coordinate of the given positions of the microphones, metres; the
      displacements from these positions are also estimated. Use 0 if the positions are exact.
    - `intensity`: band and windows, for taps given as samples.
    - `progress`: function called with the name of each step when the step begins.

    Raises `ValueError` if fewer than three microphones can be calibrated, or if most microphones disagree with the
    decay model and left-out taps are located badly. Also raises `ValueError` for an unknown `decay`, a `place_error`
    that is negative or not finite, `intensity` with taps given as intensities, and arguments of the wrong type.

    **Example:**

    ```python
    fit = calibrate_microphones(taps, decay="inverse-square")
    calibration = fit.calibration
    ```
    """
    is_automatic_choice = isinstance(decay, str) and decay == AUTO
    decay_classes = () if is_automatic_choice else (find_decay(decay),)
    fits, rejection_reasons = fit_each_decay(
        taps, decay_classes, place_error=place_error, intensity=intensity, progress=progress
    )
    return select_fit(fits, rejection_reasons)


def select_fit(fits: dict[str, CalibrationFit], rejection_reasons: dict[str, str]) -> CalibrationFit:
    """Select the fit whose decay model locates left-out taps best. Among fits with nearly equal errors, the fit with
    the fewest parameters is selected. Raises `ValueError` with the first of the `rejection_reasons` if `fits` is
    empty."""
    if not fits:
        raise ValueError(next(iter(rejection_reasons.values())))
    # The fits are in the order of the number of parameters of their decay models.
    smallest_error = min(candidate_fit.left_out[0][1] for candidate_fit in fits.values())
    return next(
        candidate_fit
        for candidate_fit in fits.values()
        if not candidate_fit.left_out[0][1] > (1 + _MIN_ERROR_DECREASE) * smallest_error
    )


@np.errstate(all="ignore")  # decay models that cannot be fitted are reported with a reason
def fit_each_decay(
    taps: Taps,
    decays: Sequence[type[AbstractDecay]] = (),
    *,
    place_error: float = MICROPHONE_POSITION_ERROR,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, CalibrationFit], dict[str, str]]:
    """Fit each of the given decay models, by default all decay models. Returns a dictionary of the fits, and a
    dictionary of the reasons why models could not be fitted; the keys are the names of the models.

    `progress` is called with the name of each step when the step begins. Raises `ValueError` as `calibrate_microphones`
    does, but not if no decay model can be fitted.
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("intensity", intensity)
    if not (is_number(place_error) and place_error >= 0):
        raise ValueError(f"place_error must be zero or positive, in metres; it is {describe(place_error)}.")
    if intensity is not None and taps.samples is None:
        raise ValueError("intensity: band and window are for taps that come as samples; these are intensities.")
    report_step = progress or (lambda step_name: None)
    if taps.samples is not None:
        report_step("measure intensities")
    fit_input = _read_taps(taps, intensity, place_error)
    fitted_models, rejection_reasons = {}, {}
    for decay_class in decays or DECAY_MODELS.values():
        report_step(f"fit {decay_class.name}")
        try:
            fitted_models[decay_class.name] = _fit_decay_model(decay_class, fit_input)
        except _NoFitError as error:
            rejection_reasons[decay_class.name] = str(error)
    localisation_errors = {
        decay_name: fitted_model.left_out_taps.median for decay_name, fitted_model in fitted_models.items()
    } | dict.fromkeys(rejection_reasons, np.inf)
    fits = {}
    for decay_name, fitted_model in fitted_models.items():
        other_model_errors = tuple(
            name_and_error for name_and_error in localisation_errors.items() if name_and_error[0] != decay_name
        )
        fits[decay_name] = _calibration_fit(
            taps, fit_input, fitted_model, ((decay_name, localisation_errors[decay_name]), *other_model_errors)
        )
    return fits, rejection_reasons


class _FitInput(NamedTuple):
    """Input of the fit of a decay model: positions and intensities of the taps, and the noise of the microphones.

    **Fields**: `microphones`, `positions`: positions of microphones and taps in metres; `surface`: the surface of the
    skin; `place_error`: standard deviation of the microphones' coordinates in metres; `power`: intensities minus the
    noise floor, NaN where unusable; `noise`: noise of the microphones; `is_noise_known`: whether the noise floor was
    measured; `faults`: fault of each microphone; `settings`: band and windows, for taps given as samples.
    """

    microphones: Float[np.ndarray, "M d"]
    surface: AbstractSurface
    positions: Float[np.ndarray, "T d"]
    place_error: float
    power: Float[np.ndarray, "M T"]
    noise: IntensityNoise
    is_noise_known: bool
    faults: tuple[str, ...]
    settings: IntensitySettings | None


class _FittedModel(NamedTuple):
    """Result of the fit of one decay model.

    **Fields**: `fit`: the fit; `initial_use`: mask of the intensities used in the first fit, with all microphones;
    `usable`: mask of the usable microphones; `reasons`: reasons why microphones are unusable; `explained`:
    fraction of the variance of each microphone's levels that its model explains; `left_out_taps`: localisation errors
    of left-out taps.
    """

    fit: TapFit
    initial_use: Bool[np.ndarray, "T M"]
    usable: Bool[np.ndarray, " M"]
    reasons: tuple[str, ...]
    explained: Float[np.ndarray, " M"]
    left_out_taps: LeftOutTaps


class _NoFitError(Exception):
    """Raised if a decay model cannot be fitted to the taps. The message gives the reason."""


def _read_taps(taps: Taps, intensity: IntensitySettings | None, place_error: float) -> _FitInput:
    surface = make_surface(taps.outline, taps.positions)
    intensity_settings = None
    if taps.samples is None:
        assert taps.power is not None
        tap_power, (is_usable_reading, microphone_faults) = taps.power, intensity_faults(taps.power)
        intensity_noise = IntensityNoise.create(
            tap_power.shape[1], deviation=noise_from_negative_powers(tap_power, is_usable_reading)
        )
    else:
        intensity_settings = intensity if intensity is not None else IntensitySettings()
        tap_power, noise_floor, degrees_of_freedom, is_usable_reading, microphone_faults = tap_intensities(
            taps, intensity_settings
        )
        intensity_noise = IntensityNoise.create(
            tap_power.shape[1], floor=noise_floor, freedom=np.median(degrees_of_freedom)
        )
    usable_power = np.where(is_usable_reading, tap_power, np.nan).T
    noise_fields = intensity_noise, intensity_settings is not None, tuple(microphone_faults), intensity_settings
    return _FitInput(taps.microphones, surface, taps.positions, float(place_error), usable_power, *noise_fields)


def _fit_decay_model(decay_class: type[AbstractDecay], fit_input: _FitInput) -> _FittedModel:
    """Fit one decay model to all microphones. Raises `_NoFitError` if too few microphones received the taps or agree
    with the model."""
    tap_distances = np.linalg.norm(fit_input.microphones[:, None] - fit_input.positions, axis=-1)
    has_enough_taps, rejection_reason = check_received(decay_class, tap_distances, fit_input.power, fit_input.faults)
    if rejection_reason:
        raise _NoFitError(rejection_reason)
    noise_arguments = fit_input.noise, fit_input.is_noise_known
    tap_fit = fit_taps(
        decay_class,
        fit_input.microphones,
        fit_input.positions,
        fit_input.power,
        *noise_arguments,
        fit_input.place_error,
    )
    initial_use = tap_fit.use.T
    tap_fit, is_usable, exclusion_reasons, explained_variance = exclude_unusable(tap_fit, fit_input.faults)
    left_out_taps = locate_held_out_taps(tap_fit, fit_input.microphones, fit_input.surface, fit_input.positions)
    if is_usable.sum() < 3 or (
        is_usable.sum() < _MIN_USABLE_MICROPHONE_SHARE * has_enough_taps.sum() and not left_out_taps.is_better_than_mean
    ):
        raise _NoFitError(
            f"only {is_usable.sum()} of the {has_enough_taps.sum()} microphones that received the taps follow a decay "
            "model, and three are needed, or half: are the rows of positions in the order of the taps, those of "
            f"microphones in the order of the channels? {describe_faults(exclusion_reasons)}."
        )
    return _FittedModel(tap_fit, initial_use, is_usable, exclusion_reasons, explained_variance, left_out_taps)


def _calibration_fit(
    taps: Taps, fit_input: _FitInput, fitted_model: _FittedModel, localisation_errors
) -> CalibrationFit:
    """Create the `CalibrationFit` of a fitted decay model. `localisation_errors`: name and localisation error of each
    decay model."""
    tap_fit, is_usable = fitted_model.fit, fitted_model.usable
    # Logarithm of the factor by which gains are divided and strengths are multiplied; see `Calibration`.
    mean_log_gain = np.log(np.asarray(tap_fit.kind.from_logarithms(host.asarray(tap_fit.logarithms)).gain))[
        is_usable
    ].mean()
    tap_strengths = np.where(tap_fit.received, np.exp(tap_fit.strength + mean_log_gain), np.nan)
    has_shared_decay, parameter_errors = tap_fit.shared & is_usable, standard_errors(tap_fit)[: len(tap_fit.logarithms)]
    parameter_errors[1:, has_shared_decay] = np.nan
    fitted_decay = on_device(
        tap_fit.kind.from_logarithms(host.concatenate([tap_fit.logarithms[:1] - mean_log_gain, tap_fit.logarithms[1:]]))
    )
    is_loud_microphone = (tap_fit.use & (fit_input.power > 3 * tap_fit.noise.deviation[:, None])).any(axis=0)
    microphone_positions = fit_input.microphones + tap_fit.displacement
    calibration = Calibration(
        MicrophoneArray(as_array(microphone_positions), fit_input.surface, fitted_decay, on_device(tap_fit.noise)),
        is_usable,
        fitted_model.reasons,
        parameter_errors,
        fit_input.settings,
        taps.name,
        _strength_range(tap_strengths[is_loud_microphone]),
        fitted_model.left_out_taps.widening,
    )
    remaining_fit_fields = (
        tap_strengths,
        tap_fit.outlier,
        fitted_model.explained,
        has_shared_decay,
        tap_fit.displacement,
        localisation_errors,
    )
    tap_distances = np.linalg.norm(fit_input.positions[:, None] - microphone_positions, axis=-1)
    return CalibrationFit(
        calibration, tap_distances, fit_input.power.T, fitted_model.initial_use, *remaining_fit_fields
    )


def _strength_range(tap_strengths: np.ndarray) -> tuple[float, float] | None:
    """Strengths of the weakest and the strongest tap; None if no strength is known."""
    positive_tap_strengths = tap_strengths[tap_strengths > 0]
    return (
        (float(positive_tap_strengths.min()), float(positive_tap_strengths.max()))
        if positive_tap_strengths.size
        else None
    )
