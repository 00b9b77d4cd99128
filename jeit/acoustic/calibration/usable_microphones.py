"""Selection of the microphones that a fit describes well, and the reasons why others are unusable."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.calibration.robust_least_squares import TapFit, refit_without
from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.signal.faults import describe_faults

# A microphone is unusable if its model explains less than this share of the variance of its levels.
_LEAST_EXPLAINED = 0.3
# Also if its relative error is so many times the median of all, where the median counts as this much at least.
_UNLIKE, _WELL = 2.5, 0.1
# Least decrease of the logarithm of a response over the tapped distances.
_FLAT = 0.1


def check_received(
    kind: type[AbstractDecay], distance: Float[np.ndarray, "M T"], power: Float[np.ndarray, "M T"], faults
) -> tuple[Bool[np.ndarray, " M"], str]:
    """Which microphones received taps from enough distances, and the reason if too few did to fit a model, else ""."""
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
    """Refit without the unusable microphones. Returns the fit, the mask of usable microphones, the reasons for the
    others, and the share of variance that each model explains."""
    reasons, explained = _judge(fit, faults)
    bad = np.array([bool(reason) for reason in reasons])
    # Faults of some microphones may show only once others are excluded.
    while bad.any() and (~fit.dropped & ~bad).sum() >= 3:
        fit = refit_without(fit, bad)
        again, explained = _judge(fit, ("",) * len(bad), explained)
        bad = np.array([bool(reason) for reason in again]) & ~fit.dropped
        reasons = tuple(new if worse else old for new, old, worse in zip(again, reasons, bad, strict=True))
    return fit, ~fit.dropped & ~bad, reasons, explained


def _judge(fit: TapFit, faults, explained=None) -> tuple[tuple[str, ...], Float[np.ndarray, " M"]]:
    """The reason why each microphone is unusable, "" where it is usable; and the share of the variance of its levels
    that its model explains, taken from `explained` for excluded microphones."""
    expected, level, use = fit.expected(), fit.level, fit.use
    falls = _falls(fit)
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
        if falls[k] < _FLAT:
            reasons.append("what it hears does not fall with distance")
        elif used.sum() >= needed and not share[k] >= _LEAST_EXPLAINED:
            reasons.append(f"its model explains {100 * max(share[k], 0):.0f} % of what it received")
        elif received < needed:
            reasons.append(f"it received {received} of the taps only, and {needed} are needed")
        elif relative[k] > _UNLIKE * max(typical, _WELL):
            reasons.append(
                f"its model is off by {100 * relative[k]:.0f} %, and those of others by {100 * typical:.0f} %: is it "
                "where it is said to be, and was its gain the same throughout?"
            )
        else:
            reasons.append("")
    return tuple(reasons), share


def _falls(fit: TapFit) -> Float[np.ndarray, " M"]:
    """Decrease of the logarithm of each microphone's response from the nearest tap to the farthest."""
    response, use = fit.problem().log_response(fit.values), fit.use
    most, least = (
        pick(response, axis=1, where=use, initial=far) for pick, far in ((np.max, -np.inf), (np.min, np.inf))
    )
    return np.where(use.any(axis=1), most - least, np.inf)
