"""Calibration: decay models and noise of every microphone, from taps at known places and of unknown strength.

Rounds of robust least squares: all microphones together with the strengths of all taps; then what the residuals say of
the noise; then weights from it. Taps that no microphone agrees with are left out, and said.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import KDTree

from jeit.acoustic.calibration import Calibration
from jeit.acoustic.decay import AbstractDecay, find_decay
from jeit.acoustic.decay_fit import (
    DecayProblem,
    fit_between,
    fit_each,
    fit_strengths,
    fit_together,
    log_covariance,
)
from jeit.acoustic.faults import intensity_faults
from jeit.acoustic.intensity import IntensitySettings, tap_intensities
from jeit.acoustic.likelihood import Listeners
from jeit.acoustic.noise import LEAST_RELATIVE, IntensityNoise, below_nothing
from jeit.acoustic.recording import Taps
from jeit.acoustic.surface import make_surface

_ALTERNATIONS, _ROUNDS = 6, 12
# Student's t with so many degrees of freedom weighs residuals; beyond so many deviations they say nothing of the noise.
_TAIL, _BEYOND = 5.0, 4.0
# Taps that the median of all microphones counts for in the noise of each.
_DRAWN = 20.0
# A tap whose mean square residual is so many times the median tap's is left out.
_OUTLIER = 12.0
# A microphone is of no use whose model explains less of its levels' variance, or is known no better (relative error).
_LEAST_EXPLAINED, _MOST_ERROR = 0.3, 1.0


class CalibrationFit(eqx.Module):
    """A `calibration`, and the T taps it comes from.

    - `distance`: (T, M) metres; `power`: (T, M) intensities above the floor; `usable`: (T, M) which were fitted.
    - `strength`: (T,) of the taps; NaN where none was heard, or the tap left out.
    - `outlier`: (T,), taps left out because no single source at the place given explains them.
    - `explained`: (M,) share of the variance of a microphone's levels that its model explains.
    """

    calibration: Calibration
    distance: Float[np.ndarray, "T M"]
    power: Float[np.ndarray, "T M"]
    usable: Bool[np.ndarray, "T M"]
    strength: Float[np.ndarray, " T"]
    outlier: Bool[np.ndarray, " T"]
    explained: Float[np.ndarray, " M"]


def calibrate_microphones(
    taps: Taps,
    *,
    decay: str | type[AbstractDecay] = "inverse-square",
    intensity: IntensitySettings | None = None,
) -> CalibrationFit:
    """Fit the decay model of every microphone to `taps`.

    `decay`: "inverse-square", a / (r² + b), the paper's; "exponential", a exp(−r / l); or "attenuated",
    a exp(−r / l) / (r² + b). `intensity`: band and window, for taps that come as samples. Raises `ValueError` where
    fewer than three microphones can be calibrated.
    """
    kind = find_decay(decay)
    surface = make_surface(taps.outline, taps.positions)
    settings = None
    if taps.samples is None:
        assert taps.power is not None
        power, (usable, faults) = taps.power, intensity_faults(taps.power)
        noise = IntensityNoise.create(power.shape[1], deviation=below_nothing(power, usable))
        known_noise = False
    else:
        settings = intensity if intensity is not None else IntensitySettings()
        power, floor, freedom, usable, faults = tap_intensities(taps, settings)
        noise = IntensityNoise.create(power.shape[1], floor=floor, freedom=np.median(freedom))
        known_noise = True
    difference = taps.positions[:, None] - taps.microphones
    fit = _Fit(kind, np.sum(difference**2, axis=-1).T, np.asarray(power).T, np.asarray(usable).T, noise, known_noise)
    fit.check(faults)
    fit.run(taps.microphones)
    reasons = fit.judge(faults)
    good = np.array([not reason for reason in reasons])
    tried, bad = fit.use.T, ~good
    while good.sum() >= 3 and bad.any():
        fit.refine_without(bad)
        # What others were left out for may show in these only now.
        again = fit.judge(("",) * len(good))
        bad = np.array([ok and bool(reason) for ok, reason in zip(good, again, strict=True)])
        reasons = tuple(new if worse else old for new, old, worse in zip(again, reasons, bad, strict=True))
        good = good & ~bad
    if good.sum() < 3:
        told = "; ".join(f"microphone {k}: {reason}" for k, reason in enumerate(reasons) if reason)
        raise ValueError(
            f"only {good.sum()} of {len(good)} microphones can be calibrated, and three are needed. {told}."
        )
    logarithms, strength = fit.scaled(good)
    calibration = Calibration(
        Listeners(jnp.asarray(taps.microphones), surface, kind.from_logarithms(logarithms), fit.noise),
        good,
        reasons,
        fit.standard_errors(logarithms, strength, good),
        settings,
        taps.name,
    )
    return CalibrationFit(
        calibration,
        np.linalg.norm(difference, axis=-1),
        fit.power.T,
        tried,
        np.where(fit.heard, np.exp(strength), np.nan),
        fit.outlier,
        fit.explained,
    )


class _Fit:
    """The state of the rounds: arrays are (M, T), in NumPy; a worker of one call, not kept."""

    def __init__(self, kind: type[AbstractDecay], squared, power, usable, noise: IntensityNoise, known_noise: bool):
        self.kind, self.squared, self.noise, self.known_noise = kind, squared, noise, known_noise
        self.power = np.where(usable, power, np.nan)
        self.usable = usable & (np.nan_to_num(power, nan=-np.inf) + np.asarray(noise.floor)[:, None] > 0)
        self.outlier = np.zeros(power.shape[1], bool)
        self.free = self.usable.any(axis=1)
        self.at_bound: dict[int, str] = {}
        self.weight = np.zeros(power.shape)
        self.explained = np.zeros(len(power))

    @property
    def use(self) -> np.ndarray:  # (M, T)
        return self.usable & ~self.outlier

    @property
    def heard(self) -> np.ndarray:  # (T,)
        return np.asarray(self.use.any(axis=0))

    def check(self, faults) -> None:
        """Raise `ValueError` where there is too little to fit anything to."""
        number = len(self.kind.parameters)
        enough = (self.usable.sum(axis=1) >= number + 2).sum()
        if enough < 3:
            told = "; ".join(f"microphone {k}: {fault}" for k, fault in enumerate(faults) if fault)
            raise ValueError(
                f"only {enough} microphones heard {number + 2} taps or more, and three are needed to calibrate a decay "
                f"model of {number} parameters. {told}".strip()
            )

    def run(self, microphones: np.ndarray) -> None:
        """Fit, estimate the noise, weigh; again until nothing changes."""
        spacing = (
            float(np.median(KDTree(microphones).query(microphones, k=2)[0][:, 1])) if len(microphones) > 1 else 0.0
        )
        extent = float(np.sqrt(self.squared.max()))
        spacing = spacing if spacing > 0 else extent / 4
        lower, upper = (np.array(bound) for bound in self.kind.bounds(extent))
        start = self.kind.start(spacing, len(microphones)).logarithms()
        seen = np.where(self.use, self.power, -np.inf)
        loudest = seen.argmax(axis=0)
        taps = np.arange(self.power.shape[1])
        response = np.asarray(self.kind.from_logarithms(start).log_response(jnp.asarray(self.squared)))
        strength = np.where(self.heard, np.log(np.maximum(seen[loudest, taps], 1e-300)) - response[loudest, taps], 0.0)
        strength = np.where(np.isfinite(strength), strength, 0.0)
        self.weight = self._weights(np.nan_to_num(np.maximum(self.power, 0.0)), None)
        values, shift = start, jnp.asarray(strength)
        for _ in range(_ALTERNATIONS):
            values = jnp.clip(fit_each(self._problem(), values, shift), lower[:, None], upper[:, None])
            shift = fit_strengths(self._problem(with_outliers=True), values, shift)
            self.weight = self._reweighed(values, shift)
        self.start, self.values, self.strength, self.bounds = start, values, shift, (lower, upper)
        self._refine()

    def refine_without(self, bad: np.ndarray) -> None:
        """Once more, without the microphones that were found to be of no use."""
        self.usable = self.usable & ~bad[:, None]
        self.free = self.free & ~bad
        self._refine()

    def _refine(self) -> None:
        """All microphones together, and what their residuals say, until nothing changes."""
        for _ in range(_ROUNDS):
            before = self.values
            values, shift = fit_together(self._problem(), before, self.strength, jnp.asarray(self.free))
            self.values = self._keep_between(values, shift)
            self.strength = fit_strengths(self._problem(with_outliers=True), self.values, shift)
            self.weight = self._reweighed(self.values, self.strength)
            if float(jnp.max(jnp.abs(self.values - before)[:, self.free], initial=0.0)) < 1e-9:
                break

    def judge(self, faults) -> tuple[str, ...]:
        """Why each microphone is of no use, "" where it is."""
        mean = np.asarray(self._problem().expected(self.values, self.strength)[0])
        level = np.asarray(self._level())
        reasons = []
        errors = self.standard_errors(self.values, self.strength, self.free)
        for k, fault in enumerate(faults):
            used = self.use[k]
            heard = used & (self.power[k] > 3 * float(self.noise.deviation[k]))
            reason = fault if not used.any() else ""
            number = len(self.kind.parameters)
            if not reason and self.at_bound.get(k) == "above":
                reason = "what it hears does not fall with distance"
            if not reason and heard.sum() < number + 2:
                reason = f"it heard {heard.sum()} taps only, {number + 2} are needed"
            if not reason:
                left = np.mean((level - mean)[k, used] ** 2)
                spread = np.var(level[k, used])
                self.explained[k] = 1 - left / spread if spread > 0 else 0.0
                if not self.explained[k] >= _LEAST_EXPLAINED:
                    reason = f"its model explains {100 * max(self.explained[k], 0):.0f} % of what it heard"
                elif self.free[k] and not np.nanmax(errors[1:, k]) < _MOST_ERROR:
                    reason = "its taps do not determine its model (relative error above 100 %)"
            reasons.append(reason)
        return tuple(reasons)

    def scaled(self, good: np.ndarray) -> tuple[Array, np.ndarray]:
        """Parameters and strengths with the factor between them as `Calibration` has it."""
        gain = np.log(np.asarray(self.kind.from_logarithms(self.values).gain))
        shift = gain[good].mean()
        return self.values.at[0].add(-shift), np.asarray(self.strength) + shift

    def standard_errors(self, values, strength, good) -> np.ndarray:
        """(K, M): deviations of the logarithms of parameters."""
        free = np.asarray(self.free & good)
        if free.sum() < 2:
            return np.full(values.shape, np.nan)
        # The convention that fixes the scale, the sum of log f_i(0), as the parameters move it.
        scale = jax.grad(lambda v: jnp.sum(jnp.where(free, jnp.log(self.kind.from_logarithms(v).gain), 0.0)))(values)
        covariance = log_covariance(self._problem(), values, jnp.asarray(strength), free, np.asarray(scale).ravel())
        return np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(values.shape)

    def _level(self) -> Array:
        return self.noise.level(jnp.asarray(np.where(self.usable, self.power, 1.0)))

    def _problem(self, *, with_outliers: bool = False) -> DecayProblem:
        weight = jnp.asarray(np.where(self.usable if with_outliers else self.use, self.weight, 0.0))
        return DecayProblem(self._level(), jnp.asarray(self.squared), weight, self.noise.floor, self.kind)

    def _weights(self, received: np.ndarray, residual: np.ndarray | None) -> np.ndarray:
        """Inverse variances of levels where `received` is expected, less for what is far off."""
        floor = 1e-6 * np.nanmax(np.where(self.use, self.power, np.nan), axis=1, initial=1e-300)[:, None]
        variance = np.asarray(self.noise.level_variance(jnp.asarray(np.maximum(received, floor))))
        if residual is None:
            return 1 / np.maximum(variance, 0.04)  # at first the model is good to 20 % at best
        tail = (_TAIL + 1) / (_TAIL + residual**2 / variance)
        return tail / variance

    def _reweighed(self, values, strength) -> np.ndarray:
        """New weights; the noise and the outliers are worked out anew on the way."""
        problem = self._problem()
        mean = np.asarray(problem.expected(values, strength)[0])
        received = np.maximum(np.exp(mean) - np.asarray(self.noise.floor)[:, None], 0.0)
        # What an unknown strength and unknown parameters take out of the residuals.
        count = self.use.sum()
        spent = self.heard.sum() + len(self.kind.parameters) * self.free.sum()
        inflation = count / max(count - spent, 0.1 * count)
        if not self.known_noise:
            self._find_noise(received, inflation)
        residual = np.where(self.usable, np.asarray(self._level()) - mean, 0.0)
        self.noise = eqx.tree_at(
            lambda n: n.relative, self.noise, jnp.asarray(self._relative(received, residual, inflation))
        )
        variance = np.asarray(self.noise.level_variance(jnp.asarray(np.maximum(received, 1e-150))))
        variance = np.maximum(variance, LEAST_RELATIVE**2)
        square = residual**2 / variance
        number = np.maximum(self.usable.sum(axis=0), 1)
        level = np.minimum(square, 100.0).sum(axis=0) / number
        typical = max(float(np.median(level[self.usable.any(axis=0)])), 1e-6)
        self.outlier = level > _OUTLIER * max(typical, 0.2)
        return self._weights(received, residual)

    def _relative(self, received, residual, inflation) -> np.ndarray:
        """τ of each microphone: what its residuals show beyond the floor's noise (moments, without what is far off).

        Drawn towards the median of all, as much as if that had been seen in a few more taps: of few taps the moments
        may well come out as nothing, or less.
        """
        floor, rest, cross = (np.asarray(x) for x in (self.noise.floor, self.noise.deviation, self.noise.cross))
        seen, excess = np.zeros(len(received)), np.zeros(len(received))
        for k in range(len(received)):
            used = self.use[k] & (received[k] > 3 * rest[k])
            if used.sum() < 3:
                continue
            signal, off = received[k, used], residual[k, used]
            share = (signal / (signal + floor[k])) ** 2
            other = (cross[k] * signal + rest[k] ** 2) / (signal + floor[k]) ** 2
            near = np.abs(off) <= _BEYOND * max(1.4826 * np.median(np.abs(off)), 1e-15)
            for _ in range(3):
                near = np.abs(off) <= _BEYOND * np.sqrt(np.mean(off[near] ** 2))
            seen[k] = near.sum()
            excess[k] = (inflation * np.mean(off[near] ** 2) - np.mean(other[near])) / np.mean(share[near])
        if not seen.any():
            return np.full(len(received), 0.5)
        typical = max(float(np.median(excess[seen > 0])), 0.0)
        drawn = (seen * np.minimum(excess, 1.0) + _DRAWN * typical) / (seen + _DRAWN)
        return np.sqrt(np.maximum(drawn, LEAST_RELATIVE**2))

    def _find_noise(self, received, inflation) -> None:
        """What each microphone reads of nothing, where only intensities are known: the likeliest pair of relative and
        additive deviation, on a grid; none unless that is clearly better."""
        deviation = np.zeros(len(received))
        shares = np.concatenate([[0.0], np.geomspace(1e-6, 0.5, 50)])
        scatter = np.geomspace(LEAST_RELATIVE, 1.0, 30)
        for k in range(len(received)):
            used = ~self.outlier & np.isfinite(self.power[k])
            if used.sum() < 8:
                continue
            power, signal = self.power[k, used], received[k, used]
            top = np.abs(power).max()
            if top == 0:
                continue
            trial = (scatter[:, None, None] * signal) ** 2 + (top * shares[:, None]) ** 2 + 1e-30 * top**2
            ratio = np.minimum(inflation * (power - signal) ** 2 / trial, _BEYOND**2)
            score = np.sum(ratio + np.log(trial), axis=-1).min(axis=0)
            best = int(score.argmin())
            if score[best] < score[0] - 6:
                deviation[k] = top * shares[best]
        self.noise = IntensityNoise.create(
            len(received), deviation=np.maximum(deviation, below_nothing(self.power.T, np.isfinite(self.power.T)))
        )
        self.usable = np.isfinite(self.power) & (
            np.nan_to_num(self.power, nan=-np.inf) + np.asarray(self.noise.floor)[:, None] > 0
        )

    def _keep_between(self, values, shift):
        """Fit microphones that left the bounds again between them, also from the first guess, and hold them there until
        they have come back inside."""
        lower, upper = self.bounds
        array = np.array(values)
        beyond = ((array <= lower[:, None]) | (array >= upper[:, None]) | ~np.isfinite(array)).any(axis=0)
        for k in np.flatnonzero(self.use.any(axis=1) & (beyond | ~self.free)):
            problem = self._problem()
            array[:, k] = min(
                (
                    fit_between(problem, jnp.nan_to_num(first), shift, int(k), self.bounds)
                    for first in (values, self.start)
                ),
                key=lambda found, k=k, problem=problem: problem.cost_of(found, shift, int(k)),
            )
            self.free[k] = bool(((array[:, k] > lower + 1e-6) & (array[:, k] < upper - 1e-6)).all())
            self.at_bound[int(k)] = "above" if (array[1:, k] >= upper[1:] - 1e-6).any() else "below"
            if self.free[k]:
                del self.at_bound[int(k)]
        return jnp.asarray(array)
