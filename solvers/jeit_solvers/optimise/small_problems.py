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
    num_unknowns, lower_factor = matrix.shape[0], _cholesky(matrix)
    forward: list[Array] = []
    for i in range(num_unknowns):
        residual = right_hand_sides[i] - sum(lower_factor[i, k] * forward[k] for k in range(i))
        forward.append(residual / lower_factor[i, i])
    solution: dict[int, Array] = {}
    for i in reversed(range(num_unknowns)):
        residual = forward[i] - sum(lower_factor[k, i] * solution[k] for k in range(i + 1, num_unknowns))
        solution[i] = residual / lower_factor[i, i]
    return namespace(matrix, right_hand_sides).stack([solution[i] for i in range(num_unknowns)])


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
        differences = _DIFFERENCE_STEP * np.eye(len(x))[:, :, None]

        def second_derivative(k: int, m: int) -> Any:
            forward_gradient, backward_gradient = (
                complex_slope(value, points, m) for points in (x + differences[k], x - differences[k])
            )
            return (forward_gradient - backward_gradient) / (2 * _DIFFERENCE_STEP)

        return symmetric_small([[second_derivative(k, m) for m in range(k + 1)] for k in range(len(x))])
    directions = jnp.eye(len(x))[:, :, None] * jnp.ones_like(x)
    return jnp.stack([jax.jvp(partial(gradient_small, value), (x,), (direction,))[1] for direction in directions])


def definite_small(matrix: Float[Array, "n n F"]) -> Bool[Array, " F"]:
    """Whether each of F symmetric matrices is positive definite.

    **Arguments:**

    - `matrix` (n, n, F): symmetric matrices.

    **Example:**

    ```python
    definite_small(small)
    ```
    """
    lower_factor, xp = _cholesky(matrix), namespace(matrix)
    diagonal = xp.stack([lower_factor[i, i] for i in range(len(matrix))])
    return xp.all(xp.isfinite(diagonal) & (diagonal > 0), axis=0)


def _cholesky(matrix: Float[Array, "n n F"]) -> dict[tuple[int, int], Array]:
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
    identity = xp.eye(len(matrix))[:, :, None] * xp.ones_like(matrix[0])
    return xp.stack([solve_small(matrix, column) for column in identity])


class _State(Module):
    """State of the minimisation of each function in a batch."""

    x: Array
    value: Array
    gradient: Array
    matrix: Array
    damping: Array
    num_taken: Array
    is_done: Array
    converged: Array


class _Limits(NamedTuple):
    """Bounds of the unknowns, maximum size and number of steps, and tolerance."""

    lower: Array
    upper: Array
    largest_step: Array
    max_steps: int
    tolerance: float


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
    limits = _Limits(lower, upper, largest_step, max_steps, tolerance)
    xp = namespace(start, data, lower, upper)
    clipped_start = xp.clip(start, lower, upper)
    num_functions = clipped_start.shape[1]
    is_done = xp.zeros(num_functions, bool)
    state = _State(
        x=clipped_start,
        value=xp.full(num_functions, xp.inf),
        gradient=xp.zeros_like(clipped_start),
        matrix=xp.eye(len(clipped_start))[:, :, None] * xp.ones_like(clipped_start),
        damping=xp.full(num_functions, 1e-2),
        num_taken=xp.zeros(num_functions, int),
        is_done=is_done if skip is None else skip,
        converged=is_done,
    )
    num_gathered = num_functions if xp is np else num_functions // 4
    if num_gathered < _MIN_GATHERED_FUNCTIONS:
        state = _take_steps(state, data, max_steps + 1, finish or expand, limits)
    else:
        if skip is None:
            state = _take_steps(state, data, _WHOLE_BATCH_STEPS + 1, expand, limits)

        def continue_unfinished(state: _State) -> _State:
            unfinished_indices = _first_true_indices(~state.is_done, num_gathered)
            gathered_state, gathered_data = jax.tree.map(
                lambda array: xp.take(array, unfinished_indices, axis=-1, mode="clip"), (state, data)
            )
            gathered_state = replace(
                gathered_state, is_done=gathered_state.is_done | (unfinished_indices == num_functions)
            )
            new_state = _take_steps(gathered_state, gathered_data, max_steps + 1, finish or expand, limits)
            return jax.tree.map(
                lambda array, new_values: set_at(array, (..., unfinished_indices), new_values), state, new_state
            )

        state = while_loop(lambda state: ~xp.all(state.is_done), continue_unfinished, state)
    return Minimum(state.x, state.value, state.converged, xp.max(state.num_taken, initial=0))


def _first_true_indices(flags: Bool[Array, " F"], max_count: int) -> Int[Array, " i"]:
    """Indices of the first true entries of `flags`: in NumPy at most `max_count` indices; in JAX exactly `max_count`,
    filled up with F, the number of flags."""
    if isinstance(flags, np.ndarray):
        return host.flatnonzero(flags)[:max_count]
    return jnp.nonzero(flags, size=max_count, fill_value=flags.size)[0]


def _next_step(state: _State, limits: _Limits) -> tuple[Array, Array]:
    """End point of the next step, and the first-order prediction of the decrease of the value."""
    x, gradient, matrix, xp = state.x, state.gradient, state.matrix, namespace(state)
    is_fixed = ((x <= limits.lower) & (gradient > 0)) | ((x >= limits.upper) & (gradient < 0))
    diagonal = xp.eye(x.shape[0], dtype=bool)[:, :, None]
    damped_matrix = matrix + diagonal * (state.damping * matrix + 1e-300)
    damped_matrix = xp.where(is_fixed[:, None] | is_fixed[None], xp.where(diagonal, 1.0, 0.0), damped_matrix)
    step = -solve_small(damped_matrix, xp.where(is_fixed, 0.0, gradient))
    step = xp.where(xp.isfinite(step), step, 0.0)
    step = step / xp.maximum(1.0, xp.max(xp.abs(step) / limits.largest_step, axis=0))
    end_point = xp.clip(x + step, limits.lower, limits.upper)
    return end_point, -xp.sum((end_point - x) * gradient, axis=0)


def _take_steps(state: _State, data, steps: int, expand: QuadraticExpansion, limits: _Limits) -> _State:
    """Take up to `steps` steps of the minimisation of all functions, fewer if all functions are done."""
    xp = namespace(state, data)

    def body(loop):
        num_iterations, state = loop
        # The first iteration only evaluates the start, from which no step has been computed yet.
        is_first_evaluation = xp.isinf(state.value)
        trial_point, predicted_decrease = _next_step(state, limits)
        value, gradient, matrix = expand(trial_point, data)
        is_lower = (value <= state.value) & ~state.is_done
        # A step that is clipped at a bound may increase the value; then a more damped step, closer to the negative
        # gradient, is tried.
        is_settled = (
            (predicted_decrease >= 0)
            & (predicted_decrease <= limits.tolerance * (1 + xp.abs(state.value)))
            & ~is_first_evaluation
        )
        damping = xp.where(is_lower, xp.maximum(state.damping / 10, 1e-12), 8 * xp.maximum(state.damping, 1e-4))
        num_taken = state.num_taken + ~(state.is_done | is_first_evaluation)
        # The search also ends when steps become too small to change the value.
        converged = state.converged | (~state.is_done & (is_settled | (damping > _MAX_DAMPING)))
        is_invalid = is_first_evaluation & ~xp.isfinite(value)
        return num_iterations + 1, _State(
            x=xp.where(is_lower, trial_point, state.x),
            value=xp.where(is_lower, value, state.value),
            gradient=xp.where(is_lower, gradient, state.gradient),
            matrix=xp.where(is_lower, matrix, state.matrix),
            damping=damping,
            num_taken=num_taken,
            is_done=state.is_done | converged | is_invalid | (num_taken >= limits.max_steps),
            converged=converged,
        )

    def is_unfinished(loop):
        return (loop[0] < steps) & ~xp.all(loop[1].is_done)

    return while_loop(is_unfinished, body, (xp.zeros((), int), state))[1]
