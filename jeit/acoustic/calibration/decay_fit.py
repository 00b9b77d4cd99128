"""Weighted least-squares fit of decay models to taps of unknown strength.

Microphones are the first axis of arrays, and taps the last. For M microphones with P values each, and T taps, there
are P M + T unknowns. The strengths of the taps are eliminated by a Schur complement, which leaves a system with P M
unknowns. Since the microphones of an array are usually of the same kind, a penalty acts on the deviation of each
parameter except the first from its common value over the array, relative to a `spread`. The common value is eliminated
too: it is the mean, which minimises the penalty. Microphones may be displaced from their given positions; the
displacements are further unknowns, with a penalty on their deviation from 0. The code uses NumPy, since an array is
calibrated only once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.decay import AbstractDecay
from jeit_solvers import Descent, minimise_small, solve_definite
from jeit_solvers.engines import host, slopes

# Maximum number of steps of a minimisation.
_MOST_STEPS = 100
# Maximum change of the logarithm of a strength in a step.
_LONGEST_STEP = 3.0
# Maximum number of iterations in which parameters are fixed at their bounds or released.
_MOST_ACTIVE_SET_STEPS = 6
# The tolerance `atol`, in the unit of the cost, ends the fit once the data are fitted to rounding error.
_SOLVER = Descent(rtol=1e-10, atol=1e-20, damping=1e-2, history=1)


class DecayProblem(NamedTuple):
    """Least-squares problem of a calibration.

    **Fields**: `level`: levels y (M, T); `offset`: vectors (M, T, d) from the taps to the given positions of the
    microphones in metres; `weight`: weights (M, T) of the levels, 0 for unused ones; `floor`: noise floors N (M,);
    `decay`: class of the decay model; `spread`: standard deviation (P,) of each value over the microphones, infinite
    for no penalty; `place_error`: unit of the displacements in metres.

    The values (P, M) of the microphones are the logarithms of the K parameters of their decay models and, for P = K +
    d, the coordinates of their displacements divided by `place_error`.
    """

    level: Float[np.ndarray, "M T"]
    offset: Float[np.ndarray, "M T d"]
    weight: Float[np.ndarray, "M T"]
    floor: Float[np.ndarray, " M"]
    decay: type[AbstractDecay]
    spread: Float[np.ndarray, " P"]
    place_error: float

    def displacement(self, values: Any) -> Float[np.ndarray, "M d"]:
        """Displacements of the microphones from their given positions in metres."""
        moved = values[len(self.decay.parameters) :].T
        return self.place_error * moved if moved.size else np.zeros(self.offset.shape[::2])

    def log_response(self, values: Any) -> Float[np.ndarray, "M T"]:
        """Logarithm of the responses f (M, T) of the models that have the given `values` (P, M)."""
        squared = ((self.offset + self.displacement(values)[:, None]) ** 2).sum(axis=-1)
        decay = self.decay.from_logarithms(values[: len(self.decay.parameters)])
        return np.asarray(decay.log_response(host.asarray(squared)))

    def expected(
        self, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """Expected levels m = log(e^s f + N) (M, T), and their derivatives with respect to s, which equal those with
        respect to log f. `strength` (T,): logarithms s of the strengths."""
        return self.levels(strength + self.log_response(values))

    def levels(
        self, log_received: Float[np.ndarray, "M T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """Levels log(S + N) from the logarithm of the received power S, and their derivatives with respect to log S."""
        received = np.exp(log_received)
        total = received + self.floor[:, None]
        return np.log(total), received / total

    def expand(
        self, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"], Float[np.ndarray, "P M T"]]:
        """Residuals y − m, the derivatives of m with respect to s, and those with respect to the values. Residuals with
        weight 0 are 0."""
        log_response, along = slopes(self.log_response, values)
        mean, share = self.levels(strength + log_response)
        return self.residual(mean), share, share * np.stack(along)

    def residual(self, mean: Float[np.ndarray, "M T"]) -> Float[np.ndarray, "M T"]:
        """Residuals y − m for the expected levels `mean`; 0 where the weight is 0."""
        return np.where(self.weight > 0, self.level - mean, 0.0)


def fit_strengths(
    problem: DecayProblem, values: Float[np.ndarray, "P M"], start: Float[np.ndarray, " T"]
) -> Float[np.ndarray, " T"]:
    """Fit the logarithms of the strengths of all taps for given decay models."""

    def expand(unknown, taps):
        level, log_response, weight = taps
        some = problem._replace(level=level, weight=weight)
        mean, share = some.levels(unknown[0] + log_response)
        off = some.residual(mean)
        value = 0.5 * np.sum(weight * off**2, axis=0)
        gradient = -np.sum(weight * share * off, axis=0)
        curvature = np.sum(weight * share**2, axis=0)
        return value, gradient[None], np.maximum(curvature, 1e-30)[None, None]

    taps = problem.level, problem.log_response(values), problem.weight
    return _minimise(expand, start[None], taps, (np.full(1, -np.inf), np.full(1, np.inf)))[0]


def _minimise(expand, start, data, bounds) -> np.ndarray:
    lower, upper = (bound[:, None] for bound in bounds)
    longest = np.full_like(lower, _LONGEST_STEP)
    found = minimise_small(expand, start, data, lower=lower, upper=upper, largest_step=longest, max_steps=_MOST_STEPS)
    return np.asarray(found.x)


def fit_together(
    problem: DecayProblem,
    start: Float[np.ndarray, "P M"],
    strength: Float[np.ndarray, " T"],
    free: Bool[np.ndarray, "P M"],
) -> tuple[Float[np.ndarray, "P M"], Float[np.ndarray, " T"]]:
    """Fit the values in the mask `free` and the strengths of all taps jointly. Returns the values and the logarithms of
    the strengths."""

    def unpack(unknowns):
        return unknowns[: start.size].reshape(start.shape), unknowns[start.size :]

    def expand(unknowns, _):
        cost, system = _normal_equations(problem, *unpack(unknowns), free)

        def solve_step(damping):
            change, shift = _solve_step(system, damping)
            slope = np.sum(system.gradient * change) + system.tap_gradient @ shift
            inner = np.einsum("km,lm,mkl->", change, change, system.matrix)
            inner += np.einsum("km,kmn,kn->", change, system.penalty, change)
            across = 2 * np.einsum("km,kmt,t->", change, system.coupling, shift, optimize=True)
            return (
                np.concatenate([change.ravel(), shift]),
                slope,
                inner + across + np.sum(system.tap_matrix * shift**2),
            )

        return cost, solve_step

    return unpack(_SOLVER.at_once(expand, np.concatenate([start.ravel(), strength]), None, _MOST_STEPS)[0])


def fit_within(
    problem: DecayProblem,
    start: Float[np.ndarray, "P M"],
    strength: Float[np.ndarray, " T"],
    received: Bool[np.ndarray, " M"],
    bounds: tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]],
) -> tuple[Float[np.ndarray, "P M"], Float[np.ndarray, " T"], Bool[np.ndarray, "P M"]]:
    """Fit values and strengths as `fit_together` does, with `bounds` on the values.

    `received`: mask of the microphones with usable readings, whose parameters are fitted. Also returns the mask of the
    parameters that are held at a bound. A held parameter is released if the cost decreases towards the interior.
    """
    lower, upper = (bound[:, None] for bound in bounds)
    held = ((start <= lower) | (start >= upper)) & received
    values = start
    for _ in range(_MOST_ACTIVE_SET_STEPS):
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
    problem: DecayProblem, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"], free, scale
) -> np.ndarray:
    """Covariance (P M, P M) of the values, ordered by parameter and then by microphone.

    The weights of the problem must be inverse variances. The undetermined common factor of gains and strengths is fixed
    by the condition `scale` · values = constant, with `scale` (P M,). Entries of values that are not `free` (P, M) are
    NaN.
    """
    schur = _schur_complement(_normal_equations(problem, values, strength, free)[1], 0.0)
    number, count = values.shape
    kept = np.asarray(free).ravel()
    shift = np.concatenate([np.ones(count), np.zeros((number - 1) * count)])[kept]
    normal = np.asarray(scale)[kept]
    result = np.full((number * count, number * count), np.nan)
    # The data do not determine the direction in which all gains increase and all strengths decrease. It is projected
    # out according to the condition.
    inverse = np.linalg.pinv(schur[np.ix_(kept, kept)], rcond=1e-12, hermitian=True)
    project = np.eye(len(shift)) - np.outer(shift, normal) / (normal @ shift)
    result[np.ix_(kept, kept)] = project @ inverse @ project.T
    return result


class _NormalEquations(NamedTuple):
    """Normal equations of the least-squares problem.

    **Fields**: `matrix`: block (M, P, P) of each microphone; `penalty`: matrices (P, M, M) of the penalty, which couple
    the microphones; `coupling`: block (P, M, T) between values and strengths; `tap_matrix`: diagonal (T,) of the
    strengths; `gradient`, `tap_gradient`: gradients with respect to values (P, M) and strengths (T,); `free`: mask
    (P, M) of the fitted values.
    """

    matrix: np.ndarray
    penalty: np.ndarray
    coupling: np.ndarray
    tap_matrix: np.ndarray
    gradient: np.ndarray
    tap_gradient: np.ndarray
    free: np.ndarray


def _normal_equations(problem: DecayProblem, values, strengths, free) -> tuple[np.ndarray, _NormalEquations]:
    off, share, jacobian = problem.expand(values, strengths)
    weight = problem.weight
    ties = _penalty_matrices(problem)
    pulled = np.einsum("kmn,kn->km", ties, values)
    jacobian = np.where(free[:, :, None], jacobian, 0.0)
    weighted = weight * jacobian
    system = _NormalEquations(
        matrix=np.einsum("kmt,lmt->mkl", weighted, jacobian),
        penalty=ties * (free[:, :, None] & free[:, None]),
        coupling=weighted * share,
        tap_matrix=np.sum(weight * share**2, axis=0),
        gradient=np.where(free, pulled, 0.0) - np.sum(weighted * off, axis=-1),
        tap_gradient=-np.sum(weight * share * off, axis=0),
        free=free,
    )
    return 0.5 * np.sum(weight * off**2) + 0.5 * np.sum(values * pulled), system


def _penalty_matrices(problem: DecayProblem) -> Float[np.ndarray, "P M M"]:
    """Matrices (P, M, M) of the penalties Σ_m (v_m − v̄)² / spread², where v̄ is the mean over the microphones with at
    least one reading of nonzero weight, or 0 for displacements."""
    received = (problem.weight > 0).any(axis=1).astype(float)
    mean = np.outer(received, received) / max(received.sum(), 1.0)
    tied = np.arange(len(problem.spread)) < len(problem.decay.parameters)
    return (np.diag(received) - tied[:, None, None] * mean) / problem.spread[:, None, None] ** 2


def _solve_step(system: _NormalEquations, damping):
    number, count = system.gradient.shape
    diagonal = _tap_diagonal(system, damping)
    schur = _schur_complement(system, damping)
    # Two things are held fixed: the undetermined direction, in which all gains increase and all strengths decrease; and
    # parameters that are not free.
    shift = np.concatenate([np.where(system.free[0], 1.0, 0.0), np.zeros((number - 1) * count)])
    typical = np.trace(schur) / schur.shape[0] + 1e-300
    held = ~system.free.ravel()
    schur = schur + typical * (np.outer(shift, shift) / count + np.diag(np.where(held, 1.0, 1e-14)))
    right = -system.gradient + np.einsum("kmt,t->km", system.coupling, system.tap_gradient / diagonal)
    change = solve_definite(schur, right.ravel()).reshape(number, count)
    shifts = -(system.tap_gradient + np.einsum("kmt,km->t", system.coupling, change)) / diagonal
    return change, shifts


def _tap_diagonal(system: _NormalEquations, damping):
    return np.where(system.tap_matrix > 0, system.tap_matrix * (1 + damping), 1.0)


def _schur_complement(system: _NormalEquations, damping):
    number, count = system.gradient.shape
    size = number * count
    blocks = system.matrix * (1 + damping * np.eye(number))
    index, full = np.arange(count), np.zeros((number, count, number, count))
    full[:, index, :, index] = blocks
    parameter = np.arange(number)
    full[parameter, :, parameter] += system.penalty
    coupling = system.coupling.reshape(size, -1)
    return full.reshape(size, size) - (coupling / _tap_diagonal(system, damping)) @ coupling.T
