"""Weighted least-squares fit of decay models to taps of unknown strength.

Microphones are the first axis of arrays, and taps the last. For M microphones with P values (parameters and
displacements) each, and T taps of one strength each, there are P M + T unknowns. The strengths of the taps are
eliminated by a Schur complement, which leaves a system with P M unknowns. Since the microphones of an array are usually
of the same kind, a penalty acts on the deviation of each parameter from its mean over the array, relative to a standard
deviation `spread`. The first parameter, the gain, has no penalty. Microphones may be displaced from their given
positions; the displacements are further unknowns, with a penalty on their deviation from 0. The code uses NumPy, since
a microphone array is calibrated only once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.decay import AbstractDecay
from jeit_solvers import Descent, minimise_small, solve_definite
from jeit_solvers.engines import host, slopes

# Maximum number of steps of a least-squares minimisation.
_MAX_DESCENT_STEPS = 100
# Maximum change of the logarithm of a tap's strength in a step.
_MAX_LOG_STEP = 3.0
# Maximum number of iterations in which parameters are fixed at their bounds or released from a bound.
_MAX_ACTIVE_SET_STEPS = 6
# The tolerance `atol`, in the unit of the cost, ends the fit once the levels are fitted to rounding error.
_DESCENT_SOLVER = Descent(rtol=1e-10, atol=1e-20, damping=1e-2, history=1)


class DecayProblem(NamedTuple):
    """Least-squares problem of the calibration of M microphones from T taps.

    **Fields**: `level`: levels y (M, T), logarithms of received power; `offset`: vectors (M, T, d) from the taps to the
    given positions of the microphones in metres; `weight`: weights (M, T) of the levels, 0 for unused levels; `floor`:
    noise floors N (M,); `decay`: class of the decay model; `spread`: standard deviation (P,) of each value over the
    microphones that the penalty assumes, infinite for values without a penalty; `place_error`: length in metres that is
    the unit of the displacements.

    The values (P, M) of the microphones are the logarithms of the K parameters of each decay model and, for P = K + d,
    the d coordinates of each microphone's displacement divided by `place_error`.
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
        scaled_displacement = values[len(self.decay.parameters) :].T
        return self.place_error * scaled_displacement if scaled_displacement.size else np.zeros(self.offset.shape[::2])

    def log_response(self, values: Any) -> Float[np.ndarray, "M T"]:
        """Logarithm of the responses f (M, T) to the taps for the decay models with the given `values` (P, M)."""
        squared_distances = ((self.offset + self.displacement(values)[:, None]) ** 2).sum(axis=-1)
        decay_model = self.decay.from_logarithms(values[: len(self.decay.parameters)])
        return np.asarray(decay_model.log_response(host.asarray(squared_distances)))

    def expected_levels(
        self, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """Expected levels m = log(e^s f + N) (M, T), where f is the response and N the noise floor, and the derivatives
        of m with respect to s, which equal the derivatives with respect to log f. `strength` (T,): logarithms s of the
        taps' strengths."""
        return self.levels(strength + self.log_response(values))

    def levels(
        self, log_received: Float[np.ndarray, "M T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"]]:
        """Levels log(S + N) for the received power S and the noise floor N, and their derivatives with respect to log
        S; `log_received` is log S."""
        received_power = np.exp(log_received)
        total_power = received_power + self.floor[:, None]
        return np.log(total_power), received_power / total_power

    def expand(
        self, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T"], Float[np.ndarray, "P M T"]]:
        """Residuals y − m of the levels y, the derivatives of the expected levels m with respect to the logarithmic
        strengths s, and the derivatives with respect to the values. Residuals with weight 0 are 0."""
        log_response, response_derivatives = slopes(self.log_response, values)
        expected_levels, signal_share = self.levels(strength + log_response)
        return self.residual(expected_levels), signal_share, signal_share * np.stack(response_derivatives)

    def residual(self, mean: Float[np.ndarray, "M T"]) -> Float[np.ndarray, "M T"]:
        """Residuals y − m of the levels for the expected levels m = `mean`; 0 where the weight is 0."""
        return np.where(self.weight > 0, self.level - mean, 0.0)


def fit_strengths(
    problem: DecayProblem, values: Float[np.ndarray, "P M"], start: Float[np.ndarray, " T"]
) -> Float[np.ndarray, " T"]:
    """Fit the logarithms of the strengths of all taps for given decay models."""

    def expand_tap(log_strength, tap_data):
        tap_level, log_response, tap_weight = tap_data
        tap_problem = problem._replace(level=tap_level, weight=tap_weight)
        expected_levels, signal_share = tap_problem.levels(log_strength[0] + log_response)
        level_residual = tap_problem.residual(expected_levels)
        weighted_cost = 0.5 * np.sum(tap_weight * level_residual**2, axis=0)
        cost_gradient = -np.sum(tap_weight * signal_share * level_residual, axis=0)
        cost_curvature = np.sum(tap_weight * signal_share**2, axis=0)
        return weighted_cost, cost_gradient[None], np.maximum(cost_curvature, 1e-30)[None, None]

    tap_data = problem.level, problem.log_response(values), problem.weight
    return _minimise_cost(expand_tap, start[None], tap_data, (np.full(1, -np.inf), np.full(1, np.inf)))[0]


def _minimise_cost(expand_cost, initial_values, tap_data, bounds) -> np.ndarray:
    lower_bounds, upper_bounds = (bound_values[:, None] for bound_values in bounds)
    max_log_steps = np.full_like(lower_bounds, _MAX_LOG_STEP)
    cost_minimum = minimise_small(
        expand_cost,
        initial_values,
        tap_data,
        lower=lower_bounds,
        upper=upper_bounds,
        largest_step=max_log_steps,
        max_steps=_MAX_DESCENT_STEPS,
    )
    return np.asarray(cost_minimum.x)


def fit_jointly(
    problem: DecayProblem,
    start: Float[np.ndarray, "P M"],
    strength: Float[np.ndarray, " T"],
    is_fitted: Bool[np.ndarray, "P M"],
) -> tuple[Float[np.ndarray, "P M"], Float[np.ndarray, " T"]]:
    """Fit the microphones' values in the mask `is_fitted` and the strengths of all taps jointly. Returns the values and
    the logarithms of the strengths."""

    def unpack_unknowns(unknowns):
        return unknowns[: start.size].reshape(start.shape), unknowns[start.size :]

    def expand_cost(unknowns, _):
        cost, normal_equations = _normal_equations(problem, *unpack_unknowns(unknowns), is_fitted)

        def solve_step(damping):
            step_of_values, step_of_strengths = _solve_step(normal_equations, damping)
            directional_slope = (
                np.sum(normal_equations.microphone_gradient * step_of_values)
                + normal_equations.tap_gradient @ step_of_strengths
            )
            quadratic_term = np.einsum(
                "km,lm,mkl->", step_of_values, step_of_values, normal_equations.microphone_matrices
            )
            quadratic_term += np.einsum(
                "km,kmn,kn->", step_of_values, normal_equations.penalty_matrices, step_of_values
            )
            cross_term = 2 * np.einsum(
                "km,kmt,t->", step_of_values, normal_equations.tap_coupling, step_of_strengths, optimize=True
            )
            return (
                np.concatenate([step_of_values.ravel(), step_of_strengths]),
                directional_slope,
                quadratic_term + cross_term + np.sum(normal_equations.tap_matrix * step_of_strengths**2),
            )

        return cost, solve_step

    return unpack_unknowns(
        _DESCENT_SOLVER.at_once(expand_cost, np.concatenate([start.ravel(), strength]), None, _MAX_DESCENT_STEPS)[0]
    )


def fit_with_bounds(
    problem: DecayProblem,
    start: Float[np.ndarray, "P M"],
    strength: Float[np.ndarray, " T"],
    is_usable: Bool[np.ndarray, " M"],
    bounds: tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]],
) -> tuple[Float[np.ndarray, "P M"], Float[np.ndarray, " T"], Bool[np.ndarray, "P M"]]:
    """Fit the microphones' values and the taps' strengths as `fit_jointly` does, with `bounds` on the values.

    `is_usable`: mask of the microphones with usable readings, whose parameters are fitted. Also returns the mask of
    the parameters that are fixed at a bound. A fixed parameter is released if the cost decreases from the bound towards
    the interior.
    """
    lower_bounds, upper_bounds = (bound_values[:, None] for bound_values in bounds)
    is_fixed_value = ((start <= lower_bounds) | (start >= upper_bounds)) & is_usable
    values = start
    for _ in range(_MAX_ACTIVE_SET_STEPS):
        cost_slope = _normal_equations(problem, values, strength, is_usable & np.ones_like(is_fixed_value))[
            1
        ].microphone_gradient
        descends_inwards = np.where(values <= lower_bounds, cost_slope < 0, cost_slope > 0)
        is_fixed_value &= ~descends_inwards
        fitted_values, strength = fit_jointly(problem, values, strength, ~is_fixed_value & is_usable)
        values = np.clip(np.where(np.isfinite(fitted_values), fitted_values, values), lower_bounds, upper_bounds)
        is_outside_bounds = (values != fitted_values) & ~is_fixed_value & is_usable
        is_fixed_value |= is_outside_bounds
        if not is_outside_bounds.any():
            break
    return values, strength, is_fixed_value


def log_covariance(
    problem: DecayProblem, values: Float[np.ndarray, "P M"], strength: Float[np.ndarray, " T"], is_fitted, scale
) -> np.ndarray:
    """Covariance (P M, P M) of the fitted values, ordered by parameter and then by microphone.

    The weights of the `problem` must be inverse variances. The undetermined common factor of gains and strengths is
    fixed by the condition `scale` · values = constant, with `scale` (P M,). Entries of values that are not `is_fitted`
    (P, M) are NaN.
    """
    schur_complement = _schur_complement(_normal_equations(problem, values, strength, is_fitted)[1], 0.0)
    num_parameters, num_microphones = values.shape
    is_free_parameter = np.asarray(is_fitted).ravel()
    null_direction = np.concatenate([np.ones(num_microphones), np.zeros((num_parameters - 1) * num_microphones)])[
        is_free_parameter
    ]
    constraint_matrix = np.asarray(scale)[is_free_parameter]
    full_covariance = np.full((num_parameters * num_microphones, num_parameters * num_microphones), np.nan)
    # The data do not determine the direction in which all gains increase and all strengths decrease. This direction is
    # projected out according to the condition on `scale`.
    pseudo_inverse = np.linalg.pinv(
        schur_complement[np.ix_(is_free_parameter, is_free_parameter)], rcond=1e-12, hermitian=True
    )
    scale_projector = np.eye(len(null_direction)) - np.outer(null_direction, constraint_matrix) / (
        constraint_matrix @ null_direction
    )
    full_covariance[np.ix_(is_free_parameter, is_free_parameter)] = scale_projector @ pseudo_inverse @ scale_projector.T
    return full_covariance


class _NormalEquations(NamedTuple):
    """Normal equations of the least-squares problem of a calibration, for microphones with values (P, M) and taps with
    strengths (T,).

    **Fields**: `microphone_matrices`: block (M, P, P) of each microphone; `penalty_matrices`: matrices (P, M, M) of the
    penalty, which couple the microphones; `tap_coupling`: block (P, M, T) between values and strengths; `tap_matrix`:
    diagonal (T,) of the strengths; `microphone_gradient`, `tap_gradient`: gradients with respect to values (P, M) and
    strengths (T,); `is_fitted`: mask (P, M) of the fitted values.
    """

    microphone_matrices: np.ndarray
    penalty_matrices: np.ndarray
    tap_coupling: np.ndarray
    tap_matrix: np.ndarray
    microphone_gradient: np.ndarray
    tap_gradient: np.ndarray
    is_fitted: np.ndarray


def _normal_equations(
    problem: DecayProblem, microphone_values, tap_strengths, is_fitted
) -> tuple[np.ndarray, _NormalEquations]:
    level_residual, signal_share, jacobian = problem.expand(microphone_values, tap_strengths)
    level_weights = problem.weight
    penalty_matrices = _penalty_matrices(problem)
    penalty_gradient = np.einsum("kmn,kn->km", penalty_matrices, microphone_values)
    jacobian = np.where(is_fitted[:, :, None], jacobian, 0.0)
    weighted_jacobian = level_weights * jacobian
    normal_equations = _NormalEquations(
        microphone_matrices=np.einsum("kmt,lmt->mkl", weighted_jacobian, jacobian),
        penalty_matrices=penalty_matrices * (is_fitted[:, :, None] & is_fitted[:, None]),
        tap_coupling=weighted_jacobian * signal_share,
        tap_matrix=np.sum(level_weights * signal_share**2, axis=0),
        microphone_gradient=np.where(is_fitted, penalty_gradient, 0.0)
        - np.sum(weighted_jacobian * level_residual, axis=-1),
        tap_gradient=-np.sum(level_weights * signal_share * level_residual, axis=0),
        is_fitted=is_fitted,
    )
    return 0.5 * np.sum(level_weights * level_residual**2) + 0.5 * np.sum(
        microphone_values * penalty_gradient
    ), normal_equations


def _penalty_matrices(problem: DecayProblem) -> Float[np.ndarray, "P M M"]:
    """Matrices (P, M, M) of the penalties Σ_m (v_m − v̄)² / spread², where v̄ is the mean over the microphones with at
    least one reading of nonzero weight, or 0 for displacements."""
    usable_weights = (problem.weight > 0).any(axis=1).astype(float)
    averaging_matrix = np.outer(usable_weights, usable_weights) / max(usable_weights.sum(), 1.0)
    has_common_value = np.arange(len(problem.spread)) < len(problem.decay.parameters)
    return (np.diag(usable_weights) - has_common_value[:, None, None] * averaging_matrix) / problem.spread[
        :, None, None
    ] ** 2


def _solve_step(normal_equations: _NormalEquations, damping):
    num_parameters, num_microphones = normal_equations.microphone_gradient.shape
    tap_diagonal = _tap_diagonal(normal_equations, damping)
    schur_complement = _schur_complement(normal_equations, damping)
    # The step has no component along the undetermined direction, in which all gains increase and all strengths
    # decrease, nor along fixed parameters.
    null_direction = np.concatenate(
        [np.where(normal_equations.is_fitted[0], 1.0, 0.0), np.zeros((num_parameters - 1) * num_microphones)]
    )
    mean_diagonal = np.trace(schur_complement) / schur_complement.shape[0] + 1e-300
    is_fixed_value = ~normal_equations.is_fitted.ravel()
    schur_complement = schur_complement + mean_diagonal * (
        np.outer(null_direction, null_direction) / num_microphones + np.diag(np.where(is_fixed_value, 1.0, 1e-14))
    )
    right_hand_side = -normal_equations.microphone_gradient + np.einsum(
        "kmt,t->km", normal_equations.tap_coupling, normal_equations.tap_gradient / tap_diagonal
    )
    step_of_values = solve_definite(schur_complement, right_hand_side.ravel()).reshape(num_parameters, num_microphones)
    step_of_strengths = (
        -(normal_equations.tap_gradient + np.einsum("kmt,km->t", normal_equations.tap_coupling, step_of_values))
        / tap_diagonal
    )
    return step_of_values, step_of_strengths


def _tap_diagonal(normal_equations: _NormalEquations, damping):
    return np.where(normal_equations.tap_matrix > 0, normal_equations.tap_matrix * (1 + damping), 1.0)


def _schur_complement(normal_equations: _NormalEquations, damping):
    num_parameters, num_microphones = normal_equations.microphone_gradient.shape
    num_microphone_values = num_parameters * num_microphones
    damped_blocks = normal_equations.microphone_matrices * (1 + damping * np.eye(num_parameters))
    microphone_index, full_matrix = (
        np.arange(num_microphones),
        np.zeros((num_parameters, num_microphones, num_parameters, num_microphones)),
    )
    full_matrix[:, microphone_index, :, microphone_index] = damped_blocks
    parameter_index = np.arange(num_parameters)
    full_matrix[parameter_index, :, parameter_index] += normal_equations.penalty_matrices
    flat_coupling = normal_equations.tap_coupling.reshape(num_microphone_values, -1)
    return (
        full_matrix.reshape(num_microphone_values, num_microphone_values)
        - (flat_coupling / _tap_diagonal(normal_equations, damping)) @ flat_coupling.T
    )
