"""Calibration: decay models and noise of every microphone, from taps at known places and of unknown strength.

Robust least squares fit them. Of the decay models there are, that one is taken which locates best taps that it was not
fitted to. Taps that no microphone agrees with are left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.calibration.left_out import LeftOutTaps, locate_left_out
from jeit.acoustic.calibration.robust_least_squares import TapFit, fit_taps, standard_errors
from jeit.acoustic.calibration.usable_microphones import check_heard, leave_out
from jeit.acoustic.decay import DECAYS, AbstractDecay, find_decay
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.noise import IntensityNoise, below_nothing
from jeit.acoustic.signal.faults import describe_faults, intensity_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, tap_intensities
from jeit.acoustic.signal.recording import Taps
from jeit.acoustic.surface import AbstractSurface, make_surface
from jeit.arguments import check_kind
from jeit_solvers.engines import as_array, host, on_device

# The decay model that predicts best.
AUTO = "auto"
# A model that locates left-out taps better by less than this part is no better than one of fewer parameters.
_NO_BETTER = 0.05
# A relative error that is more than exact places leave: 18 to 21 % on simulated skins, whose coupling is uneven.
_MUCH = 0.23
# Where less than this part of the microphones that heard enough follow the model, and taps that were left out are
# located no better than by a guess, the places given are not those.
_LEAST_SHARE = 0.5


class CalibrationFit(eqx.Module):
    """A `calibration`, and the T taps it comes from.

    - `distance`: (T, M) metres; `power`: (T, M) intensities above the floor; `usable`: (T, M) which were fitted.
    - `strength`: (T,) of the taps; NaN where none was heard, or the tap left out.
    - `outlier`: (T,), taps left out because no single source at the place given explains them.
    - `explained`: (M,) share of the variance of a microphone's levels that its model explains.
    - `shared`: (M,) microphones whose own taps do not say how their response falls off: it is that of the others.
    - `left_out`: names of the decay models that were fitted, the chosen one first, each with the median distance, m, of
      taps it was not fitted to from where it locates them; infinite where it located none.
    """

    calibration: Calibration
    distance: Float[np.ndarray, "T M"]
    power: Float[np.ndarray, "T M"]
    usable: Bool[np.ndarray, "T M"]
    strength: Float[np.ndarray, " T"]
    outlier: Bool[np.ndarray, " T"]
    explained: Float[np.ndarray, " M"]
    shared: Bool[np.ndarray, " M"]
    left_out: tuple[tuple[str, float], ...] = ()

    @property
    def error(self) -> float:
        """Relative error of an intensity that the decay models predict, in the median of the usable microphones."""
        calibration = self.calibration
        return float(np.median(np.asarray(calibration.microphone_array.noise.relative)[calibration.usable]))

    @property
    def evidence(self) -> str:
        """How well the decay model locates taps that it was not fitted to, beside the others, in words."""
        if not self.left_out:
            return ""
        mine, *others = (_millimetres(off) for _, off in self.left_out)
        names = [name for name, _ in self.left_out[1:]]
        beside = ", ".join(f"{name} {off}" for name, off in zip(names, others, strict=True))
        return f"locates taps left out of the fit to {mine}, median" + (f" ({beside})" if beside else "")

    @property
    def note(self) -> str:
        """What a large error means, in a sentence; empty where it is not large."""
        if self.error <= _MUCH:
            return ""
        return (
            f"the models miss what was heard by {100 * self.error:.0f} %, and what is located is the less certain. On "
            "simulated skins taps at their places leave 20 %, taps 3 mm off them 25 %, and 5 mm off 30 %: are all "
            "where they are said to be? Or sound falls off in another way here"
            + (": try another decay=, or auto." if len(self.left_out) == 1 else " than in any decay model.")
        )


def _millimetres(off: float) -> str:
    return f"{1e3 * off:.1f} mm" if np.isfinite(off) else "refused"


def calibrate_microphones(
    taps: Taps,
    *,
    decay: str | type[AbstractDecay] = AUTO,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibrationFit:
    """Fit the decay model of every microphone to `taps`.

    `decay`: "inverse-square", a / (r² + b), the paper's; "exponential", a exp(−r / l); "attenuated",
    a exp(−r / l) / (r² + b); or "auto", that of these which best locates taps that it was not fitted to (by the median
    distance, four parts of the places left out in turn). `intensity`: band and window, for taps that come as samples.
    `progress` is called with the name of each step as it begins.

    What `jeit calibrate-microphones` does; `jeit.acoustic.reports.write_calibration` writes what it writes. Raises
    `ValueError` where fewer than three microphones can be calibrated, where most do not hear what is said to be tapped,
    for another `decay`, for `intensity` where the taps are intensities, and for things of another kind.
    """
    every = isinstance(decay, str) and decay == AUTO
    kinds = () if every else (find_decay(decay),)
    fits, refused = calibrate_each(taps, kinds, intensity=intensity, progress=progress)
    return choose(fits, refused)


def choose(fits: dict[str, CalibrationFit], refused: dict[str, str]) -> CalibrationFit:
    """Of some decay models' fits, that which locates left-out taps best; the simpler one of two that do so as well.
    Raises `ValueError`, and says why, where there is none."""
    if not fits:
        raise ValueError(next(iter(refused.values())))
    # Simpler models come first: they are listed by the number of their parameters.
    least = min(fit.left_out[0][1] for fit in fits.values())
    return next(fit for fit in fits.values() if not fit.left_out[0][1] > (1 + _NO_BETTER) * least)


@np.errstate(all="ignore")  # of what fits nothing, reasons are given
def calibrate_each(
    taps: Taps,
    decays: Sequence[type[AbstractDecay]] = (),
    *,
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, CalibrationFit], dict[str, str]]:
    """The fit of each of some decay models, all unless given, by its name; and why others are refused.

    `progress` is called with the name of each step as it begins. Raises `ValueError` as `calibrate_microphones` does,
    but for what no model fits.
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("intensity", intensity)
    if intensity is not None and taps.samples is None:
        raise ValueError("intensity: band and window are for taps that come as samples; these are intensities.")
    report = progress or (lambda step: None)
    if taps.samples is not None:
        report("measure intensities")
    heard = _listen(taps, intensity)
    found, refused = {}, {}
    for kind in decays or DECAYS.values():
        report(f"fit {kind.name}")
        try:
            found[kind.name] = _fit(kind, heard)
        except _NoFitError as error:
            refused[kind.name] = str(error)
    left_out = {name: fitted.left.median for name, fitted in found.items()} | dict.fromkeys(refused, np.inf)
    fits = {}
    for name, fitted in found.items():
        others = tuple(item for item in left_out.items() if item[0] != name)
        fits[name] = _calibration_fit(taps, heard, fitted, ((name, left_out[name]), *others))
    return fits, refused


class _Heard(NamedTuple):
    """What the taps of a calibration are, and what is known of the noise."""

    microphones: Float[np.ndarray, "M d"]
    surface: AbstractSurface
    places: Float[np.ndarray, "T d"]
    distance: Float[np.ndarray, "T M"]
    power: Float[np.ndarray, "M T"]
    noise: IntensityNoise
    known_noise: bool
    faults: tuple[str, ...]
    settings: IntensitySettings | None


class _Fitted(NamedTuple):
    """A fit, which taps it `tried`, which microphones are `good` and why others are not, what each model explains, and
    how taps are located that are left out."""

    fit: TapFit
    tried: Bool[np.ndarray, "T M"]
    good: Bool[np.ndarray, " M"]
    reasons: tuple[str, ...]
    explained: Float[np.ndarray, " M"]
    left: LeftOutTaps


class _NoFitError(Exception):
    """A decay model that these taps cannot be fitted by, and why."""


def _listen(taps: Taps, intensity: IntensitySettings | None) -> _Heard:
    surface = make_surface(taps.outline, taps.positions)
    settings = None
    if taps.samples is None:
        assert taps.power is not None
        power, (usable, faults) = taps.power, intensity_faults(taps.power)
        noise = IntensityNoise.create(power.shape[1], deviation=below_nothing(power, usable))
    else:
        settings = intensity if intensity is not None else IntensitySettings()
        power, floor, freedom, usable, faults = tap_intensities(taps, settings)
        noise = IntensityNoise.create(power.shape[1], floor=floor, freedom=np.median(freedom))
    distance = np.linalg.norm(taps.positions[:, None] - taps.microphones, axis=-1)
    known = np.where(usable, power, np.nan).T
    noisy = noise, settings is not None, tuple(faults), settings
    return _Heard(taps.microphones, surface, taps.positions, distance, known, *noisy)


def _fit(kind: type[AbstractDecay], heard: _Heard) -> _Fitted:
    """Raises `_NoFitError` where that says nothing of places."""
    enough, why = check_heard(kind, heard.distance.T, heard.power, heard.faults)
    if why:
        raise _NoFitError(why)
    squared = heard.distance.T**2
    fit = fit_taps(kind, heard.microphones, squared, heard.power, heard.noise, heard.known_noise)
    tried = fit.use.T
    fit, good, reasons, explained = leave_out(fit, heard.faults)
    left = locate_left_out(fit, heard.microphones, heard.surface, heard.places)
    if good.sum() < 3 or (good.sum() < _LEAST_SHARE * enough.sum() and not left.located):
        raise _NoFitError(
            f"only {good.sum()} of the {enough.sum()} microphones that heard the taps follow a decay model, and three "
            "are needed, or half: are the rows of positions in the order of the taps, and those of microphones in the "
            f"order of the channels? {describe_faults(reasons)}."
        )
    return _Fitted(fit, tried, good, reasons, explained, left)


def _calibration_fit(taps: Taps, heard: _Heard, fitted: _Fitted, notes) -> CalibrationFit:
    fit, good = fitted.fit, fitted.good
    # The factor between parameters and strengths, as `Calibration` has it.
    gain = np.log(np.asarray(fit.kind.from_logarithms(host.asarray(fit.values)).gain))[good].mean()
    strength = np.where(fit.heard, np.exp(fit.strength + gain), np.nan)
    shared, errors = fit.shared & good, standard_errors(fit)
    errors[1:, shared] = np.nan
    decay = on_device(fit.kind.from_logarithms(host.concatenate([fit.values[:1] - gain, fit.values[1:]])))
    loud = (fit.use & (heard.power > 3 * fit.noise.deviation[:, None])).any(axis=0)
    calibration = Calibration(
        MicrophoneArray(as_array(taps.microphones), heard.surface, decay, on_device(fit.noise)),
        good,
        fitted.reasons,
        errors,
        heard.settings,
        taps.name,
        _range(strength[loud]),
        fitted.left.widening,
    )
    rest = strength, fit.outlier, fitted.explained, shared, notes
    return CalibrationFit(calibration, heard.distance, heard.power.T, fitted.tried, *rest)


def _range(strength: np.ndarray) -> tuple[float, float] | None:
    """Of the weakest and the strongest tap."""
    known = strength[strength > 0]
    return (float(known.min()), float(known.max())) if known.size else None
