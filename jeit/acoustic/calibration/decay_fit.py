"""Least-squares problems of a calibration: decay models fitted to taps of unknown strength.

Microphones are the first axis, taps the last. With the taps' strengths given, each microphone is a problem of K
unknowns. All microphones together with the strengths have K M + T unknowns; the strengths are eliminated by a Schur
complement, which leaves a system of K M unknowns. Microphones of an array are mostly of one kind: all parameters but
the first are penalised for deviating from the array's common value, relative to a `spread`. The common value is
eliminated too, as the mean that minimises the penalty. The code uses NumPy, since a calibration is made once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.decay import AbstractDecay
from jeit_solvers import Descent, minimise_small, solve_definite
from jeit_solvers.engines import host, slopes

_MOST_STEPS = 100
# Largest change of the logarithm of a strength in a step.
_LONGEST_STEP = 3.0
# Rounds in which parameters are fixed at their bounds and released again.
_MOST_HELD = 6
# Smallest residual, in units of the weights (inverse variances), once the data are fitted to rounding error.
_SOLVER = Descent(rtol=1e-10, atol=1e-20, damping=1e-2, history=1)


class DecayProblem(NamedTuple):
    """Levels y (M, T) at squared distances r² (m²), with weights (0: not used), and the floors N (M,).

    `spread` (K,): standard deviation of the logarithm of each parameter over the microphones; infinite for no
    constraint.
    """

    level: Float[np.ndarray, "M T"]
    squared_distance: Float[np.ndarray, "M T"]
    weight: Float[np.ndarray, "M T"]
    floor: Float[np.ndarray, " M"]
    decay: type[AbstractDecay]
    spread: Float[np.ndarray, " K"]

    def log_response(self, logarithms: Any) -> Float[np.ndarray, "M T"]:
        """log f of the models whose parameters have these logarithms, (K, M)."""
        return np.asarray(self.decay.from_logarithms(logarithms).log_response(host.asarray(self.squared_distance)))

    def expected(
        self, logarithms: Float[np.ndarray, "K M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """log(e^s f + N), and its derivative with respect to s or log f."""
        return self.levels(strength + self.log_response(logarithms))

    def levels(
        self, log_received: Float[np.ndarray, "M T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """log(S + N) from log S, and its derivative."""
        received = np.exp(log_received)
        total = received + self.floor[:, None]
        return np.log(total), received / total

    def expand(
        self, logarithms: Float[np.ndarray, "K M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"], Float[np.ndarray, "K M T"]]:
        """Residual y − m, 0 where the weight is 0, and the derivatives of m with respect to s and the parameters."""
        log_response, along = slopes(self.log_response, logarithms)
        mean, share = self.levels(strength + log_response)
        return self.residual(mean), share, share * np.stack(along)

    def residual(self, mean: Float[np.ndarray, "M T"]) -> Float[np.ndarray, "M T"]:
        """Residual y − m; 0 where the weight is 0."""
        return np.where(self.weight > 0, self.level - mean, 0.0)


def fit_strengths(
    problem: DecayProblem, logarithms: Float[np.ndarray, "K M"], start: Float[np.ndarray, " T"]
) -> Float[np.ndarray, " T"]:
    """Fit the strengths of all taps for given models of the microphones."""

    def expand(unknown, taps):
        level, log_response, weight = taps
        some = problem._replace(level=level, weight=weight)
        mean, share = some.levels(unknown[0] + log_response)
        off = some.residual(mean)
        value = 0.5 * np.sum(weight * off**2, axis=0)
        gradient = -np.sum(weight * share * off, axis=0)
        curvature = np.sum(weight * share**2, axis=0)
        return value, gradient[None], np.maximum(curvature, 1e-30)[None, None]

    taps = problem.level, problem.log_response(logarithms), problem.weight
    return _minimise(expand, start[None], taps, (np.full(1, -np.inf), np.full(1, np.inf)))[0]


def _minimise(expand, start, data, bounds) -> np.ndarray:
    lower, upper = (bound[:, None] for bound in bounds)
    longest = np.full_like(lower, _LONGEST_STEP)
    found = minimise_small(expand, start, data, lower=lower, upper=upper, largest_step=longest, max_steps=_MOST_STEPS)
    return np.asarray(found.x)


def fit_together(
    problem: DecayProblem,
    start: Float[np.ndarray, "K M"],
    strength: Float[np.ndarray, " T"],
    free: Bool[np.ndarray, "K M"],
) -> tuple[Float[np.ndarray, "K M"], Float[np.ndarray, " T"]]:
    """Fit the `free` parameters and the strengths of all taps jointly."""

    def unpack(unknowns):
        return unknowns[: start.size].reshape(start.shape), unknowns[start.size :]

    def expand(unknowns, _):
        cost, system = _normal_equations(problem, *unpack(unknowns), free)

        def step(damping):
            change, shift = _step(system, damping)
            slope = np.sum(system.gradient * change) + system.tap_gradient @ shift
            inner = np.einsum("km,lm,mkl->", change, change, system.matrix)
            inner += np.einsum("km,kmn,kn->", change, system.ties, change)
            across = 2 * np.einsum("km,kmt,t->", change, system.coupling, shift, optimize=True)
            return (
                np.concatenate([change.ravel(), shift]),
                slope,
                inner + across + np.sum(system.tap_matrix * shift**2),
            )

        return cost, step

    return unpack(_SOLVER.at_once(expand, np.concatenate([start.ravel(), strength]), None, _MOST_STEPS)[0])


def fit_within(
    problem: DecayProblem,
    start: Float[np.ndarray, "K M"],
    strength: Float[np.ndarray, " T"],
    received: Bool[np.ndarray, " M"],
    bounds: tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]],
) -> tuple[Float[np.ndarray, "K M"], Float[np.ndarray, " T"], Bool[np.ndarray, "K M"]]:
    """As `fit_together`, with `bounds` on the logarithms, for the microphones in the mask `received` (those with usable
    readings). Also returns which parameters are held at a bound; one is released where the cost decreases inwards."""
    lower, upper = (bound[:, None] for bound in bounds)
    held = ((start <= lower) | (start >= upper)) & received
    values = start
    for _ in range(_MOST_HELD):
        slope = _normal_equations(problem, values, strength, received & np.ones_like(held))[1].gradient
        inwards = np.where(values <= lower, slope < 0, slope > 0)
        held &= ~inwards
        found, strength = fit_together(problem, values, strength, ~held & received)
        values = np.clip(np.where(np.isfinite(found), found, values), lower, upper)
        beyond = (values != found) & ~held & received
        held |= beyond
        if not beyond.any():
            break
    return values, strength, held


def log_covariance(
    problem: DecayProblem, logarithms: Float[np.ndarray, "K M"], strength: Float[np.ndarray, " T"], free, scale
) -> np.ndarray:
    """Covariance (K M, K M) of the logarithms of the parameters, parameter by parameter. Weights are inverse variances;
    the overall scale is fixed by `scale` · logarithms = constant, (K M,). NaN where not `free` (K, M)."""
    schur = _schur(_normal_equations(problem, logarithms, strength, free)[1], 0.0)
    number, count = logarithms.shape
    kept = np.asarray(free).ravel()
    shift = np.concatenate([np.ones(count), np.zeros((number - 1) * count)])[kept]
    normal = np.asarray(scale)[kept]
    result = np.full((number * count, number * count), np.nan)
    # The direction that the data do not determine (all responses up, all strengths down) is projected out by the
    # convention.
    inverse = np.linalg.pinv(schur[np.ix_(kept, kept)], rcond=1e-12, hermitian=True)
    project = np.eye(len(shift)) - np.outer(shift, normal) / (normal @ shift)
    result[np.ix_(kept, kept)] = project @ inverse @ project.T
    return result


class _System(NamedTuple):
    """Normal equations: blocks (M, K, K) of the microphones, coupling (K, M, T) to the strengths, diagonal (T,) of the
    strengths, and ties (K, M, M) between microphones."""

    matrix: np.ndarray
    ties: np.ndarray
    coupling: np.ndarray
    tap_matrix: np.ndarray
    gradient: np.ndarray
    tap_gradient: np.ndarray
    free: np.ndarray


def _normal_equations(problem: DecayProblem, values, strengths, free) -> tuple[np.ndarray, _System]:
    off, share, jacobian = problem.expand(values, strengths)
    weight = problem.weight
    ties = _ties(problem)
    pulled = np.einsum("kmn,kn->km", ties, values)
    jacobian = np.where(free[:, :, None], jacobian, 0.0)
    weighted = weight * jacobian
    system = _System(
        matrix=np.einsum("kmt,lmt->mkl", weighted, jacobian),
        ties=ties * (free[:, :, None] & free[:, None]),
        coupling=weighted * share,
        tap_matrix=np.sum(weight * share**2, axis=0),
        gradient=np.where(free, pulled, 0.0) - np.sum(weighted * off, axis=-1),
        tap_gradient=-np.sum(weight * share * off, axis=0),
        free=free,
    )
    return 0.5 * np.sum(weight * off**2) + 0.5 * np.sum(values * pulled), system


def _ties(problem: DecayProblem) -> Float[np.ndarray, "K M M"]:
    """Matrices of the quadratic forms Σ_m (v_m − v̄)² / spread², v̄ the mean over microphones with any weighted
    reading."""
    received = (problem.weight > 0).any(axis=1).astype(float)
    return (np.diag(received) - np.outer(received, received) / max(received.sum(), 1.0)) / problem.spread[
        :, None, None
    ] ** 2


def _step(system: _System, damping):
    number, count = system.gradient.shape
    diagonal = _tap_diagonal(system, damping)
    schur = _schur(system, damping)
    # The undetermined direction (all responses up, all strengths down) is held fixed; so are parameters that are not
    # free.
    shift = np.concatenate([np.where(system.free[0], 1.0, 0.0), np.zeros((number - 1) * count)])
    typical = np.trace(schur) / schur.shape[0] + 1e-300
    held = ~system.free.ravel()
    schur = schur + typical * (np.outer(shift, shift) / count + np.diag(np.where(held, 1.0, 1e-14)))
    right = -system.gradient + np.einsum("kmt,t->km", system.coupling, system.tap_gradient / diagonal)
    change = solve_definite(schur, right.ravel()).reshape(number, count)
    shifts = -(system.tap_gradient + np.einsum("kmt,km->t", system.coupling, change)) / diagonal
    return change, shifts


def _tap_diagonal(system: _System, damping):
    return np.where(system.tap_matrix > 0, system.tap_matrix * (1 + damping), 1.0)


def _schur(system: _System, damping):
    number, count = system.gradient.shape
    size = number * count
    blocks = system.matrix * (1 + damping * np.eye(number))
    index, full = np.arange(count), np.zeros((number, count, number, count))
    full[:, index, :, index] = blocks
    parameter = np.arange(number)
    full[parameter, :, parameter] += system.ties
    coupling = system.coupling.reshape(size, -1)
    return full.reshape(size, size) - (coupling / _tap_diagonal(system, damping)) @ coupling.T
