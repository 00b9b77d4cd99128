"""Many small minimisation problems at once: functions of a few unknowns, by damped Newton steps with bounds.

The batch is the last axis of every array, so that each operation runs along it. With two to six unknowns the linear
systems are solved by explicit formulas.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit_solvers.engines import complex_slope, host, namespace, set_at, slopes, while_loop
from jeit_solvers.module import Module

# Signature of a function of x (n, F) and of data whose last axis is F. It returns the values (F,), the gradients (n,
# F), and positive definite approximations (n, n, F) of the Hessians, for instance Gauss-Newton or Fisher matrices.
QuadraticExpansion = Callable[[Array, Any], tuple[Array, Array, Array]]

_MAX_DAMPING = 1e12
# Minimum number of gathered functions; below this number gathering the unfinished functions saves no time.
_MIN_GATHERED_FUNCTIONS = 32
# Number of steps that the whole batch takes before the unfinished functions are gathered.
_WHOLE_BATCH_STEPS = 8
# Distance between the points in the finite differences of derivatives that approximate a Hessian.
_DIFFERENCE_STEP = 1e-6


class Minimum(Module):
    """Minima of a batch of F functions. **Fields**: `x`: (n, F) positions of the minima; `value`: (F,) values at the
    minima; `converged`: (F,) whether each minimisation converged; `steps`: maximum number of steps over all functions.

    **Example:**

    ```python
    found = minimise_small(
        lambda x, _: (jnp.sum(x**2, axis=0) / 2, x, jnp.repeat(jnp.eye(3)[:, :, None], x.shape[1], axis=2)),
        jnp.ones((3, 100)), lower=-jnp.ones((3, 1)), upper=jnp.ones((3, 1)), largest_step=jnp.ones((3, 1)),
    )
    found.x, found.converged
    ```
    """

    x: Float[Array, "n F"]
    value: Float[Array, " F"]
    converged: Bool[Array, " F"]
    steps: Int[Array, ""]


def solve_small(matrix: Float[Array, "n n F"], right_hand_sides: Float[Array, "n F"]) -> Float[Array, "n F"]:
    """Solve F symmetric positive definite systems of n unknowns by Cholesky's method in explicit formulas.

    **Arguments:**

    - `matrix` (n, n, F): the matrices.
    - `right_hand_sides` (n, F): one vector for each matrix.

    **Example:**

    ```python
    solve_small(small, jnp.ones((3, 100)))
    ```
    """
    num_unknowns, lower_factor = matrix.shape[0], _small_cholesky(matrix)
    forward_solution: list[Array] = []
    for i in range(num_unknowns):
        row_residual = right_hand_sides[i] - sum(lower_factor[i, k] * forward_solution[k] for k in range(i))
        forward_solution.append(row_residual / lower_factor[i, i])
    solution_rows: dict[int, Array] = {}
    for i in reversed(range(num_unknowns)):
        row_residual = forward_solution[i] - sum(
            lower_factor[k, i] * solution_rows[k] for k in range(i + 1, num_unknowns)
        )
        solution_rows[i] = row_residual / lower_factor[i, i]
    return namespace(matrix, right_hand_sides).stack([solution_rows[i] for i in range(num_unknowns)])


def gradient_small(value: Callable[[Array], Array], x: Float[Array, "n F"]) -> Float[Array, "n F"]:
    """Gradients (n, F) at x of F functions, one per column.

    **Arguments:**

    - `value`: analytic function that maps an array (n, F) to the values (F,).
    - `x` (n, F): the points.

    **Example:**

    ```python
    gradient_small(lambda x: (x**2).sum(axis=0), jnp.ones((3, 100)))
    ```
    """
    if isinstance(x, np.ndarray):
        return host.stack(slopes(value, x)[1])
    return jax.grad(lambda points: jnp.sum(value(points)))(x)


def hessian_small(value: Callable[[Array], Array], x: Float[Array, "n F"]) -> Float[Array, "n n F"]:
    """Hessians (n, n, F) at x of F functions, one per column. In NumPy they are computed by central differences of
    complex-step derivatives, accurate to about eight digits.

    **Arguments:**

    - `value`, `x`: as for `gradient_small`.

    **Example:**

    ```python
    hessian_small(lambda x: (x**2).sum(axis=0), jnp.ones((3, 100)))
    ```
    """
    if isinstance(x, np.ndarray):
        difference_steps = _DIFFERENCE_STEP * np.eye(len(x))[:, :, None]

        def second_derivative(k: int, m: int) -> Any:
            forward_gradient, backward_gradient = (
                complex_slope(value, points, m) for points in (x + difference_steps[k], x - difference_steps[k])
            )
            return (forward_gradient - backward_gradient) / (2 * _DIFFERENCE_STEP)

        return symmetric_small([[second_derivative(k, m) for m in range(k + 1)] for k in range(len(x))])
    unit_directions = jnp.eye(len(x))[:, :, None] * jnp.ones_like(x)
    return jnp.stack(
        [jax.jvp(partial(gradient_small, value), (x,), (unit_direction,))[1] for unit_direction in unit_directions]
    )


def definite_small(matrix: Float[Array, "n n F"]) -> Bool[Array, " F"]:
    """Whether each of F symmetric matrices is positive definite.

    **Arguments:**

    - `matrix` (n, n, F): symmetric matrices.

    **Example:**

    ```python
    definite_small(small)
    ```
    """
    lower_factor, xp = _small_cholesky(matrix), namespace(matrix)
    factor_diagonal = xp.stack([lower_factor[i, i] for i in range(len(matrix))])
    return xp.all(xp.isfinite(factor_diagonal) & (factor_diagonal > 0), axis=0)


def _small_cholesky(matrix: Float[Array, "n n F"]) -> dict[tuple[int, int], Array]:
    lower_factor: dict[tuple[int, int], Array] = {}
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            schur_entry = matrix[i, j] - sum(lower_factor[i, k] * lower_factor[j, k] for k in range(j))
            lower_factor[i, j] = namespace(matrix).sqrt(schur_entry) if i == j else schur_entry / lower_factor[j, j]
    return lower_factor


def symmetric_small(rows: Sequence[Sequence[Array]]) -> Float[Array, "n n F"]:
    """Symmetric matrices (n, n, F) with given lower triangles.

    **Arguments:**

    - `rows`: rows of the lower triangles; each entry has shape (F,).

    **Example:**

    ```python
    one = jnp.ones(100)
    matrices = symmetric_small([[2 * one], [one, 2 * one]])
    ```
    """
    num_rows, xp = len(rows), namespace(rows)
    return xp.stack([xp.stack([rows[max(i, j)][min(i, j)] for j in range(num_rows)]) for i in range(num_rows)])


def inverse_small(matrix: Float[Array, "n n F"]) -> Float[Array, "n n F"]:
    """Inverses (n, n, F) of F symmetric positive definite matrices.

    **Arguments:**

    - `matrix` (n, n, F): symmetric positive definite matrices.

    **Example:**

    ```python
    inverse_small(small)
    ```
    """
    xp = namespace(matrix)
    identity_matrices = xp.eye(len(matrix))[:, :, None] * xp.ones_like(matrix[0])
    return xp.stack([solve_small(matrix, identity_column) for identity_column in identity_matrices])


class _BatchState(Module):
    """State of the minimisation of each function in a batch."""

    x: Array
    function_value: Array
    gradient: Array
    hessian_matrix: Array
    damping: Array
    num_steps_taken: Array
    is_done: Array
    is_converged: Array


class _StepLimits(NamedTuple):
    """Bounds of the unknowns, maximum size and number of steps, and tolerance."""

    lower_bounds: Array
    upper_bounds: Array
    largest_step: Array
    max_steps: int
    step_tolerance: float


def minimise_small(
    expand: QuadraticExpansion,
    start: Float[Array, "n F"],
    data: Any = None,
    *,
    finish: QuadraticExpansion | None = None,
    lower: Float[Array, "n 1"],
    upper: Float[Array, "n 1"],
    largest_step: Float[Array, "n 1"],
    max_steps: int = 30,
    tolerance: float = 1e-10,
    skip: Bool[Array, " F"] | None = None,
) -> Minimum:
    """Minimise F functions of n unknowns with bounds by projected, damped Newton steps (Bertsekas 1982).

    An unknown at a bound stays there if the function decreases outwards; all other unknowns change in each step. Steps
    are damped as in the Levenberg-Marquardt method, scaled by the Hessian's diagonal. Functions that are not finite at
    their start, and functions marked in `skip`, stay there: they have not converged, and their value is infinite.

    All functions take eight steps together. The unfinished functions, usually few, are then gathered and continue. In a
    compiled program, where arrays have fixed sizes, a quarter of the batch is gathered at a time.

    **Arguments:**

    - `expand`: function of (x, data) that returns values (F,), gradients (n, F) and positive definite Hessians (n, n,
      F), or approximations of the Hessians.
    - `start` (n, F): starting points.
    - `data`: arrays whose last axis is F.
    - `finish`: function used in place of `expand` for the gathered functions, for example with the exact, costlier
      Hessian; by default `expand`.
    - `lower`, `upper` (n, 1): bounds.
    - `largest_step` (n, 1): maximum step of each unknown.
    - `max_steps`: maximum number of steps.
    - `tolerance`: a function has converged when the predicted decrease of its value in the next step is less than
      tolerance · (1 + |value|).
    - `skip` (F,): True for functions that are not minimised.

    **Example:**

    ```python
    bowls = lambda x, _: (jnp.sum(x**2, axis=0) / 2, x, jnp.repeat(jnp.eye(3)[:, :, None], x.shape[1], axis=2))
    ones = jnp.ones((3, 1))
    minimise_small(bowls, jnp.ones((3, 100)), lower=-ones, upper=ones, largest_step=ones).x
    ```
    """
    descent_limits = _StepLimits(lower, upper, largest_step, max_steps, tolerance)
    xp = namespace(start, data, lower, upper)
    clipped_start = xp.clip(start, lower, upper)
    num_functions = clipped_start.shape[1]
    is_done = xp.zeros(num_functions, bool)
    descent_state = _BatchState(
        x=clipped_start,
        function_value=xp.full(num_functions, xp.inf),
        gradient=xp.zeros_like(clipped_start),
        hessian_matrix=xp.eye(len(clipped_start))[:, :, None] * xp.ones_like(clipped_start),
        damping=xp.full(num_functions, 1e-2),
        num_steps_taken=xp.zeros(num_functions, int),
        is_done=is_done if skip is None else skip,
        is_converged=is_done,
    )
    num_gathered = num_functions if xp is np else num_functions // 4
    if num_gathered < _MIN_GATHERED_FUNCTIONS:
        descent_state = _take_steps(descent_state, data, max_steps + 1, finish or expand, descent_limits)
    else:
        if skip is None:
            descent_state = _take_steps(descent_state, data, _WHOLE_BATCH_STEPS + 1, expand, descent_limits)

        def continue_unfinished(descent_state: _BatchState) -> _BatchState:
            unfinished_indices = _first_true_indices(~descent_state.is_done, num_gathered)
            gathered_state, gathered_data = jax.tree.map(
                lambda state_array: xp.take(state_array, unfinished_indices, axis=-1, mode="clip"),
                (descent_state, data),
            )
            gathered_state = replace(
                gathered_state, is_done=gathered_state.is_done | (unfinished_indices == num_functions)
            )
            new_state = _take_steps(gathered_state, gathered_data, max_steps + 1, finish or expand, descent_limits)
            return jax.tree.map(
                lambda state_array, new_values: set_at(state_array, (..., unfinished_indices), new_values),
                descent_state,
                new_state,
            )

        descent_state = while_loop(
            lambda descent_state: ~xp.all(descent_state.is_done), continue_unfinished, descent_state
        )
    return Minimum(
        descent_state.x,
        descent_state.function_value,
        descent_state.is_converged,
        xp.max(descent_state.num_steps_taken, initial=0),
    )


def _first_true_indices(boolean_flags: Bool[Array, " F"], max_count: int) -> Int[Array, " i"]:
    """Indices of the first true entries of `boolean_flags`: in NumPy at most `max_count` indices; in JAX exactly
    `max_count`, filled up with F, the number of flags."""
    if isinstance(boolean_flags, np.ndarray):
        return host.flatnonzero(boolean_flags)[:max_count]
    return jnp.nonzero(boolean_flags, size=max_count, fill_value=boolean_flags.size)[0]


def _next_step(descent_state: _BatchState, descent_limits: _StepLimits) -> tuple[Array, Array]:
    """End point of the next step, and the first-order prediction of the decrease of the value."""
    x, gradient, matrix, xp = (
        descent_state.x,
        descent_state.gradient,
        descent_state.hessian_matrix,
        namespace(descent_state),
    )
    is_fixed = ((x <= descent_limits.lower_bounds) & (gradient > 0)) | (
        (x >= descent_limits.upper_bounds) & (gradient < 0)
    )
    diagonal_mask = xp.eye(x.shape[0], dtype=bool)[:, :, None]
    damped_matrix = matrix + diagonal_mask * (descent_state.damping * matrix + 1e-300)
    damped_matrix = xp.where(is_fixed[:, None] | is_fixed[None], xp.where(diagonal_mask, 1.0, 0.0), damped_matrix)
    newton_step = -solve_small(damped_matrix, xp.where(is_fixed, 0.0, gradient))
    newton_step = xp.where(xp.isfinite(newton_step), newton_step, 0.0)
    newton_step = newton_step / xp.maximum(1.0, xp.max(xp.abs(newton_step) / descent_limits.largest_step, axis=0))
    end_point = xp.clip(x + newton_step, descent_limits.lower_bounds, descent_limits.upper_bounds)
    return end_point, -xp.sum((end_point - x) * gradient, axis=0)


def _take_steps(
    descent_state: _BatchState,
    problem_data,
    num_steps: int,
    expand_quadratically: QuadraticExpansion,
    descent_limits: _StepLimits,
) -> _BatchState:
    """Take up to `num_steps` steps of the minimisation of all functions, fewer if all functions are done."""
    xp = namespace(descent_state, problem_data)

    def loop_body(loop_state):
        num_iterations, descent_state = loop_state
        # The first iteration only evaluates the start, from which no step has been computed yet.
        is_first_evaluation = xp.isinf(descent_state.function_value)
        trial_point, predicted_decrease = _next_step(descent_state, descent_limits)
        trial_value, trial_gradient, trial_matrix = expand_quadratically(trial_point, problem_data)
        is_lower = (trial_value <= descent_state.function_value) & ~descent_state.is_done
        # A step that is clipped at a bound may increase the value; then a more damped step, closer to the negative
        # gradient, is tried.
        is_settled = (
            (predicted_decrease >= 0)
            & (predicted_decrease <= descent_limits.step_tolerance * (1 + xp.abs(descent_state.function_value)))
            & ~is_first_evaluation
        )
        new_damping = xp.where(
            is_lower, xp.maximum(descent_state.damping / 10, 1e-12), 8 * xp.maximum(descent_state.damping, 1e-4)
        )
        num_taken = descent_state.num_steps_taken + ~(descent_state.is_done | is_first_evaluation)
        # The search also ends when steps become too small to change the value.
        is_converged_now = descent_state.is_converged | (
            ~descent_state.is_done & (is_settled | (new_damping > _MAX_DAMPING))
        )
        is_invalid = is_first_evaluation & ~xp.isfinite(trial_value)
        return num_iterations + 1, _BatchState(
            x=xp.where(is_lower, trial_point, descent_state.x),
            function_value=xp.where(is_lower, trial_value, descent_state.function_value),
            gradient=xp.where(is_lower, trial_gradient, descent_state.gradient),
            hessian_matrix=xp.where(is_lower, trial_matrix, descent_state.hessian_matrix),
            damping=new_damping,
            num_steps_taken=num_taken,
            is_done=descent_state.is_done | is_converged_now | is_invalid | (num_taken >= descent_limits.max_steps),
            is_converged=is_converged_now,
        )

    def is_unfinished(loop_state):
        return (loop_state[0] < num_steps) & ~xp.all(loop_state[1].is_done)

    return while_loop(is_unfinished, loop_body, (xp.zeros((), int), descent_state))[1]
