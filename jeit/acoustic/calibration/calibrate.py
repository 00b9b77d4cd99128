"""Calibration: decay models and noise of every microphone, from taps at known places and of unknown strength.

Robust least squares fit them; here it is judged which microphones they are good for. Taps that no microphone agrees
with are left out, and said.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.calibration.robust_least_squares import (
    ABOVE,
    BELOW,
    FREE,
    SHARED,
    TapFit,
    fit_taps,
    refit_without,
    standard_errors,
)
from jeit.acoustic.decay import AbstractDecay, find_decay
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.noise import IntensityNoise, below_nothing
from jeit.acoustic.signal.faults import describe_faults, intensity_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, tap_intensities
from jeit.acoustic.signal.recording import Taps
from jeit.acoustic.surface import make_surface
from jeit.arguments import check_kind
from jeit_solvers.engines import as_array, host, on_device

# A microphone is of no use whose model explains less of its levels' variance, or is known no better (relative error).
_LEAST_EXPLAINED, _MOST_ERROR = 0.3, 1.0
# A relative error that is more than exact places leave: 18 to 21 % on simulated skins, whose coupling is uneven.
_MUCH = 0.23
# Nor one whose relative error is so many times the median of all, which counts as this much at least.
_UNLIKE, _WELL = 2.5, 0.1
# Where less than this part of the microphones that heard enough follow the model, the places given are not those.
_LEAST_SHARE = 0.5


class CalibrationFit(eqx.Module):
    """A `calibration`, and the T taps it comes from.

    - `distance`: (T, M) metres; `power`: (T, M) intensities above the floor; `usable`: (T, M) which were fitted.
    - `strength`: (T,) of the taps; NaN where none was heard, or the tap left out.
    - `outlier`: (T,), taps left out because no single source at the place given explains them.
    - `explained`: (M,) share of the variance of a microphone's levels that its model explains.
    - `shared`: (M,) microphones whose own taps do not say how their response falls off: it is that of the others.
    """

    calibration: Calibration
    distance: Float[np.ndarray, "T M"]
    power: Float[np.ndarray, "T M"]
    usable: Bool[np.ndarray, "T M"]
    strength: Float[np.ndarray, " T"]
    outlier: Bool[np.ndarray, " T"]
    explained: Float[np.ndarray, " M"]
    shared: Bool[np.ndarray, " M"]

    @property
    def error(self) -> float:
        """Relative error of an intensity that the decay models predict, in the median of the usable microphones."""
        calibration = self.calibration
        return float(np.median(np.asarray(calibration.microphone_array.noise.relative)[calibration.usable]))

    @property
    def note(self) -> str:
        """What a large error means, in a sentence; empty where it is not large."""
        if self.error <= _MUCH:
            return ""
        return (
            f"the models miss what was heard by {100 * self.error:.0f} %, and what is located is the less certain. On "
            "simulated skins taps at their places leave 20 %, taps 3 mm off them 25 %, and 5 mm off 30 %: are all "
            "where they are said to be? Or sound falls off in another way here: try another decay=."
        )


@np.errstate(all="ignore")  # of what fits nothing, reasons are given
def calibrate_microphones(
    taps: Taps,
    *,
    decay: str | type[AbstractDecay] = "inverse-square",
    intensity: IntensitySettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibrationFit:
    """Fit the decay model of every microphone to `taps`.

    `decay`: "inverse-square", a / (r² + b), the paper's; "exponential", a exp(−r / l); or "attenuated",
    a exp(−r / l) / (r² + b). `intensity`: band and window, for taps that come as samples. `progress` is called with the
    name of each step as it begins.

    What `jeit calibrate-microphones` does; `jeit.report.write_calibration` writes what it writes. Raises `ValueError`
    where fewer than three microphones can be calibrated, where most do not hear what is said to be tapped, for another
    `decay`, for `intensity` where the taps are intensities, and for things of another kind.
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("intensity", intensity)
    kind, tell = find_decay(decay), progress or (lambda step: None)
    if intensity is not None and taps.samples is None:
        raise ValueError("intensity: band and window are for taps that come as samples; these are intensities.")
    surface = make_surface(taps.outline, taps.positions)
    settings = None
    if taps.samples is None:
        assert taps.power is not None
        power, (usable, faults) = taps.power, intensity_faults(taps.power)
        noise = IntensityNoise.create(power.shape[1], deviation=below_nothing(power, usable))
        known_noise = False
    else:
        settings = intensity if intensity is not None else IntensitySettings()
        tell("measure intensities")
        power, floor, freedom, usable, faults = tap_intensities(taps, settings)
        noise = IntensityNoise.create(power.shape[1], floor=floor, freedom=np.median(freedom))
        known_noise = True
    difference = taps.positions[:, None] - taps.microphones
    distance = np.linalg.norm(difference, axis=-1)
    enough = _check(kind, distance.T, np.where(usable, power, np.nan).T, faults)
    squared, power = np.sum(difference**2, axis=-1).T, np.where(usable, power, np.nan).T
    tell("fit")
    fit = fit_taps(kind, taps.microphones, squared, power, noise, known_noise)
    tried = fit.use.T
    tell("leave out")
    fit, good, reasons, explained = _leave_out(fit, faults)
    told = describe_faults(reasons)
    if good.sum() < max(3, _LEAST_SHARE * enough.sum()):
        raise ValueError(
            f"only {good.sum()} of the {enough.sum()} microphones that heard the taps follow a decay model, and three "
            "are needed, or half: are the rows of positions in the order of the taps, and those of microphones in the "
            f"order of the channels? {told}."
        )
    # The factor between parameters and strengths, as `Calibration` has it.
    gain = np.log(np.asarray(kind.from_logarithms(host.asarray(fit.values)).gain))[good].mean()
    strength = np.where(fit.heard, np.exp(fit.strength + gain), np.nan)
    values = host.concatenate([fit.values[:1] - gain, fit.values[1:]])
    calibration = Calibration(
        MicrophoneArray(
            as_array(taps.microphones), surface, on_device(kind.from_logarithms(values)), on_device(fit.noise)
        ),
        good,
        reasons,
        standard_errors(fit),
        settings,
        taps.name,
        _range(strength[(fit.use & (power > 3 * fit.noise.deviation[:, None])).any(axis=0)]),
    )
    return CalibrationFit(
        calibration, distance, power.T, tried, strength, fit.outlier, explained, (fit.held == SHARED) & good
    )


def _range(strength: np.ndarray) -> tuple[float, float] | None:
    """Of the weakest and the strongest tap."""
    known = strength[strength > 0]
    return (float(known.min()), float(known.max())) if known.size else None


def _check(kind: type[AbstractDecay], distance, power, faults) -> Bool[np.ndarray, " M"]:
    """Which microphones heard taps from enough places; `ValueError` where there is too little to fit anything to."""
    needed = len(kind.parameters) + 2
    step = 1e-4 * distance.max()
    heard = np.isfinite(power)
    places = np.array([np.unique(np.round(far[one] / step)).size for far, one in zip(distance, heard, strict=True)])
    enough = places >= needed
    if enough.sum() < 3:
        raise ValueError(
            f"only {enough.sum()} of {len(enough)} microphones heard taps from {needed} distances or more, and three "
            f"are needed to calibrate a decay model of {len(kind.parameters)} parameters: tap all over the skin. "
            f"{describe_faults(faults)}".strip()
        )
    return enough


def _leave_out(fit: TapFit, faults) -> tuple[TapFit, Bool[np.ndarray, " M"], tuple[str, ...], Float[np.ndarray, " M"]]:
    """The fit to microphones that are of use, which these are, why others are not, and what each model explains."""
    reasons, explained = _judge(fit, faults)
    bad = np.array([bool(reason) for reason in reasons])
    # What some are left out for may show in others only without them.
    while bad.any() and (~fit.dropped & ~bad).sum() >= 3:
        fit = refit_without(fit, bad)
        again, explained = _judge(fit, ("",) * len(bad), explained)
        bad = np.array([bool(reason) for reason in again]) & ~fit.dropped
        reasons = tuple(new if worse else old for new, old, worse in zip(again, reasons, bad, strict=True))
    return fit, ~fit.dropped & ~bad, reasons, explained


def _judge(fit: TapFit, faults, explained=None) -> tuple[tuple[str, ...], Float[np.ndarray, " M"]]:
    """Why each microphone is of no use, "" where it is; and the share of its levels' variance that its model explains,
    as it was `explained` before for those that are left out."""
    expected, level, use = fit.expected(), fit.level, fit.use
    errors = standard_errors(fit)
    well = np.max(errors[1:], axis=0) < _MOST_ERROR
    needed = len(fit.kind.parameters) + 2
    deviation, relative = fit.noise.deviation, fit.noise.relative
    typical = float(np.median(relative[use.any(axis=1)])) if use.any() else 0.0
    share = np.zeros(len(faults)) if explained is None else explained.copy()
    reasons = []
    for k, fault in enumerate(faults):
        used = use[k]
        heard = (used & (fit.power[k] > 3 * deviation[k])).sum()
        if not used.any():
            reasons.append(fault)
            continue
        spread = np.var(level[k, used])
        share[k] = 1 - np.mean((level - expected)[k, used] ** 2) / spread if spread > 0 else 0.0
        undetermined = (fit.held[k] == FREE and not well[k]) or (fit.held[k] == BELOW and well.sum() < 3)
        if fit.held[k] == ABOVE:
            reasons.append("what it hears does not fall with distance")
        elif heard < needed:
            reasons.append(f"it heard {heard} of the taps only, and {needed} are needed")
        elif not share[k] >= _LEAST_EXPLAINED:
            reasons.append(f"its model explains {100 * max(share[k], 0):.0f} % of what it heard")
        elif relative[k] > _UNLIKE * max(typical, _WELL):
            reasons.append(
                f"its model is off by {100 * relative[k]:.0f} %, and those of others by {100 * typical:.0f} %: is it "
                "where it is said to be, and was its gain the same throughout?"
            )
        elif undetermined:
            reasons.append("its taps do not determine its model (relative error above 100 %): tap nearer to it")
        else:
            reasons.append("")
    return tuple(reasons), share
