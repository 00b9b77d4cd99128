"""Minimisation by descent, without or with bounds, and the status with which a minimisation ends.

`Descent` is a solver for optimistix with a line search. Its Gauss-Newton or Levenberg-Marquardt steps lead to the
minimum of a quadratic model of the cost. The caller provides this minimum, because the cheapest way to find it depends
on the structure of the problem, which a general least-squares solver does not know.

Problems with bounds are solved by jaxopt, which is no longer developed. It is imported only in this module, so that it
can be replaced in one place.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from enum import StrEnum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit_solvers.engines import has_values, namespace, replace_at
from jeit_solvers.module import Module


class Status(StrEnum):
    """Status with which a minimisation ended. Each member equals its string, so `status == "converged"` works; details
    such as the number of steps are reported in a separate sentence.

    **Example:**

    ```python
    scipy_lbfgsb(jax.value_and_grad(bowl), np.zeros(3), 0.0, 1.0, tolerance=1e-8)[2] == Status.CONVERGED
    ```
    """

    CONVERGED = "converged"
    """The next step would change the result by less than the tolerance."""
    STEP_LIMIT = "step limit"
    """The maximum number of steps was reached."""
    STALLED = "stalled"
    """The objective did not decrease, however short the step."""
    FAILED = "failed"
    """The result is not finite, or the solver broke down."""
    INFEASIBLE = "infeasible"
    """No point was found that satisfies the constraints."""

    @property
    def number(self) -> int:
        """Position of the status in `list(Status)`, which represents it in arrays, because JAX has no arrays of
        strings."""
        return list(Status).index(self)

    @classmethod
    def of_number(cls, number: Any) -> "Status":
        """Return the status with the given `number`. Raises `ValueError` inside `jax.jit`, `jax.grad` and `jax.vmap`,
        where the number has no value yet, and for an array of several numbers."""
        if not has_values(number) or np.shape(number) != ():
            raise ValueError(
                "status: inside jax.jit, jax.grad or jax.vmap the status has no value yet. Return the result from "
                "there, and read its status outside; for a batch, compare `outcome`, an array of integers, with "
                "Status.CONVERGED.number."
            )
        return list(Status)[int(number)]


def ended(result: optx.RESULTS) -> Status:
    """Convert an optimistix result to a `Status`, outside `jax.jit` only; see `ended_number`.

    **Arguments:**

    - `result`: the `result` of an optimistix solution.

    **Example:**

    ```python
    ended(optx.RESULTS.successful)
    ```
    """
    return Status.of_number(ended_number(result))


def ended_number(result: optx.RESULTS) -> Int[Array, ""]:
    """Convert an optimistix result to the number of a `Status`; works inside `jax.jit`, too.

    **Arguments:**

    - `result`: the `result` of an optimistix solution.

    **Example:**

    ```python
    Status.of_number(ended_number(optx.RESULTS.successful))
    ```
    """
    has_reached_limit = result == optx.RESULTS.nonlinear_max_steps_reached
    other_status_number = jnp.where(has_reached_limit, Status.STEP_LIMIT.number, Status.STALLED.number)
    return jnp.where(result == optx.RESULTS.successful, Status.CONVERGED.number, other_status_number)


Objective = Callable[[Float[Array, " n"]], Float[Array, ""]]


class BoundedMinimum(Module):
    """Result of a minimisation with bounds. **Fields**: `x`: (n,) position of the minimum; `steps`: number of steps;
    `converged`: whether a step along the projected gradient would change no coordinate by more than the tolerance.

    **Example:**

    ```python
    found = lbfgsb(bowl, jnp.zeros(3), 0.0, 1.0, max_steps=100, tolerance=1e-8)
    found.x, found.converged
    ```
    """

    x: Float[Array, " n"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def _import_jaxopt() -> Any:
    """The module jaxopt, imported only when needed, with its deprecation warning suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    return jaxopt


def lbfgsb(
    objective: Objective,
    start: Float[Array, " n"],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    max_steps: int,
    tolerance: float,
) -> BoundedMinimum:
    """Minimise a function with bounds by L-BFGS-B, inside `jax.jit`.

    **Arguments:**

    - `objective`: function of an array (n,) that returns a number; coordinates should be of similar magnitude.
    - `start` (n,): starting point.
    - `lower`, `upper` (n,): bounds of the coordinates.
    - `max_steps`: maximum number of steps.
    - `tolerance`: maximum change of a coordinate in a step along the projected gradient at convergence.

    **Example:**

    ```python
    found = lbfgsb(bowl, jnp.zeros(3), 0.0, 1.0, max_steps=100, tolerance=1e-8)
    ```
    """
    lbfgsb_solver = _import_jaxopt().LBFGSB(objective, maxiter=max_steps, tol=tolerance, history_size=20)
    solver_solution = lbfgsb_solver.run(start, bounds=(lower, upper))
    return BoundedMinimum(
        solver_solution.params, solver_solution.state.iter_num, solver_solution.state.error <= tolerance
    )


def projected_gradient(
    objective: Objective,
    start: Float[Array, " n"],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    max_steps: int,
    tolerance: float,
) -> BoundedMinimum:
    """Minimise a function with bounds by accelerated projected gradients, which take more but cheaper steps than
    `lbfgsb`.

    **Arguments:**

    - `objective`, `start`, `lower`, `upper`, `max_steps`, `tolerance`: as for `lbfgsb`.

    **Example:**

    ```python
    found = projected_gradient(bowl, jnp.zeros(3), 0.0, 1.0, max_steps=100, tolerance=1e-8)
    ```
    """
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    jaxopt = _import_jaxopt()
    gradient_solver = jaxopt.ProjectedGradient(objective, jaxopt.projection.projection_box, acceleration=True)

    def is_unfinished(loop_state):
        _, solver_state = loop_state
        return (solver_state.iter_num < max_steps) & (solver_state.error > tolerance)

    def gradient_step(loop_state):
        point, solver_state = loop_state
        extrapolated_point = solver_state.velocity
        point, solver_state = gradient_solver.update(point, solver_state, hyperparams_proj=(lower, upper))
        # jaxopt extrapolates beyond the bounds, where the objective may not be defined, and takes two equal points in
        # succession for a minimum, although the gradient was computed elsewhere.
        error = jnp.linalg.norm(point - extrapolated_point) / solver_state.stepsize
        return point, solver_state._replace(velocity=jnp.clip(solver_state.velocity, lower, upper), error=error)

    current_point, solver_state = jax.lax.while_loop(
        is_unfinished, gradient_step, (start, gradient_solver.init_state(start))
    )
    return BoundedMinimum(current_point, solver_state.iter_num, solver_state.error <= tolerance)


def scipy_lbfgsb(
    value_and_gradient: Callable[[Array], tuple[Array, Array]],
    start: Float[Array, "*shape"],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    tolerance: float,
    max_steps: int = 500,
    callback: Callable[[Array], None] | None = None,
) -> tuple[Float[np.ndarray, "*shape"], float, Status]:
    """Minimise a function with bounds by SciPy's L-BFGS-B; returns the position of the minimum, the value at the
    minimum, and the status.

    Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16 (1995) 1190-1208.

    **Arguments:**

    - `value_and_gradient`: function of an array of the shape of `start` that returns value and gradient, compiled by
      the caller.
    - `start`: starting point.
    - `lower`, `upper`: bounds, which broadcast to the shape of `start`.
    - `tolerance`: given to SciPy as `ftol` and `gtol`.
    - `max_steps`: maximum number of steps.
    - `callback`: function called with every accepted point.

    **Example:**

    ```python
    x, value, status = scipy_lbfgsb(jax.value_and_grad(bowl), np.zeros(3), 0.0, 1.0, tolerance=1e-8)
    ```
    """
    start_shape = np.shape(start)
    bounds_per_entry = [
        np.broadcast_to(np.asarray(bound_value, float), start_shape).ravel() for bound_value in (lower, upper)
    ]

    def evaluate_vector(flat_vector):
        objective_value, objective_gradient = value_and_gradient(jnp.asarray(flat_vector).reshape(start_shape))
        return np.asarray(objective_value, float), np.asarray(objective_gradient, float).ravel()

    scipy_result = scipy.optimize.minimize(
        evaluate_vector,
        np.asarray(start, float).ravel(),
        jac=True,
        tol=tolerance,
        bounds=np.stack(bounds_per_entry, axis=1),
        method="L-BFGS-B",
        callback=None
        if callback is None
        else lambda flat_vector: callback(jnp.asarray(flat_vector).reshape(start_shape)),
        options={"maxiter": max_steps},
    )
    end_status = (
        Status.CONVERGED if scipy_result.success else Status.STEP_LIMIT if scipy_result.status == 1 else Status.STALLED
    )
    return scipy_result.x.reshape(start_shape), float(scipy_result.fun), end_status


# Minimum scale of a shortened step, and fraction of the predicted decrease of the cost that an accepted step must
# achieve.
_MIN_STEP_SCALE = 2.0**-20
_SUFFICIENT_DECREASE = 1e-4
# Relative rounding error of a cost, which is a sum of many squares, divided by the machine precision.
_ROUNDING_FACTOR = 100.0


class DescentState(Module):
    """State of a `Descent`: the next trial point, on a line from the last accepted point."""

    trial: Float[Array, " n"]
    direction: Float[Array, " n"]
    scale: Float[Array, ""]
    slope: Float[Array, ""]
    curvature: Float[Array, ""]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    num_steps: Int[Array, ""]
    num_accepted: Int[Array, ""]
    history: Float[Array, " steps"]
    converged: Bool[Array, ""]
    is_stuck: Bool[Array, ""]


class Descent(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton method with a backtracking line search, or Levenberg-Marquardt method, on quadratic models that the
    caller provides.

    The solver is used in `optimistix.least_squares(residual, Descent(), c, arguments, options={"expand": expand})`,
    where `expand(c, arguments)` returns the cost at c and a function `step(damping)`. The function `step` returns the
    direction to the minimum of the model at c, and the slope and curvature of the model along this direction, with
    cost(c + s·direction) ≈ cost + s·slope + s²·curvature / 2. The penalty of the model is weighted with 1 + `damping`,
    see `ridge_step`.

    **Arguments:**

    - `rtol`, `atol`: stop when the predicted decrease of the cost in the next step is less than rtol·cost + atol.
    - `norm`: required by optimistix's interface, and not used.
    - `damping`: 0 for Gauss-Newton; a positive value is the initial damping of Levenberg-Marquardt.
    - `history`: number of costs to store, one for every accepted point; unused entries are NaN.

    **Example:**

    ```python
    expand = lambda x, _: ridge_model(2 * x - 3, 2 * jnp.eye(4), x, jnp.eye(4), jnp.eye(4))
    optx.least_squares(lambda x, _: (2 * x - 3, x), Descent(), jnp.zeros(4), options={"expand": expand})
    ```
    """

    rtol: float = 1e-6
    atol: float = 0.0
    damping: float = 0.0
    history: int = 50
    norm: Callable[..., Any] = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Return the initial state; the first trial point is the start. Raises `ValueError` if `options` does not
        contain `expand`."""
        if "expand" not in options:
            raise ValueError("Descent needs options={'expand': function}; see its documentation.")
        xp = namespace(y)
        zero_scalar, zero_step_count = xp.zeros((), y.dtype), xp.zeros((), int)
        return DescentState(
            trial=y,
            direction=xp.zeros_like(y),
            scale=zero_scalar + 1,
            slope=zero_scalar,
            curvature=zero_scalar,
            cost=zero_scalar + np.inf,
            damping=zero_scalar + self.damping,
            num_steps=zero_step_count,
            num_accepted=zero_step_count,
            history=xp.full(self.history, np.nan, y.dtype),
            converged=xp.zeros((), bool),
            is_stuck=xp.zeros((), bool),
        )

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the trial point. If its cost is low enough, continue from the trial point; otherwise try a shorter
        step."""
        xp = namespace(y)
        trial_cost, model_step = options["expand"](state.trial, args)
        predicted_decrease = -(state.scale * state.slope + 0.5 * state.scale**2 * state.curvature)
        # Close to the minimum, steps change the cost by less than its rounding error, but still approach the minimum.
        rounding_error = _ROUNDING_FACTOR * np.finfo(y.dtype).eps * state.cost
        is_accepted = xp.isfinite(trial_cost) & (
            trial_cost <= state.cost + rounding_error - _SUFFICIENT_DECREASE * predicted_decrease
        )

        def accept_trial():
            gain_ratio = xp.where(xp.isfinite(state.cost), (state.cost - trial_cost) / predicted_decrease, 0.5)
            new_damping = state.damping * xp.select([gain_ratio > 0.75, gain_ratio < 0.25], [0.25, 4.0], 1.0)
            step_direction, cost_slope, cost_curvature = model_step(new_damping)
            return DescentState(
                trial=state.trial + step_direction,
                direction=step_direction,
                scale=xp.ones_like(state.scale),
                slope=cost_slope,
                curvature=cost_curvature,
                cost=trial_cost,
                damping=new_damping,
                num_steps=state.num_steps + 1,
                num_accepted=state.num_accepted + 1,
                history=replace_at(state.history, state.num_accepted, trial_cost),
                converged=abs(cost_slope + 0.5 * cost_curvature) <= self.rtol * trial_cost + self.atol,
                is_stuck=xp.zeros((), bool),
            )

        def reject_trial():
            step_scale = state.scale / 2
            state_with_shorter_step = eqx.tree_at(
                lambda descent_state: (
                    descent_state.trial,
                    descent_state.scale,
                    descent_state.damping,
                    descent_state.num_steps,
                    descent_state.is_stuck,
                ),
                state,
                (
                    y + step_scale * state.direction,
                    step_scale,
                    4 * state.damping,
                    state.num_steps + 1,
                    step_scale < _MIN_STEP_SCALE,
                ),
            )
            # If the cost at the start is not finite, no shorter step is possible.
            return eqx.tree_at(
                lambda descent_state: descent_state.is_stuck,
                state_with_shorter_step,
                state_with_shorter_step.is_stuck | ~xp.isfinite(state.cost),
            )

        if xp is np:
            return (state.trial, accept_trial(), None) if is_accepted else (y, reject_trial(), None)
        next_state = jax.lax.cond(is_accepted, accept_trial, reject_trial)
        return jnp.where(is_accepted, state.trial, y), next_state, None

    def at_once(
        self, expand: Callable[..., Any], start: Float[np.ndarray, " n"], arguments: Any, max_steps: int
    ) -> tuple[Any, DescentState]:
        """Descend in NumPy with the same steps that `optimistix.least_squares` takes in a compiled program. Returns the
        final point and state."""
        descent_options, start_point = {"expand": expand}, start
        unused_argument: Any = None  # further arguments from optimistix, which are not used
        descent_state = self.init(
            unused_argument, start_point, arguments, descent_options, unused_argument, unused_argument, unused_argument
        )
        with np.errstate(all="ignore"):
            while descent_state.num_steps < max_steps and not (descent_state.converged or descent_state.is_stuck):
                start_point, descent_state, _ = self.step(
                    unused_argument, start_point, arguments, descent_options, descent_state, unused_argument
                )
        return start_point, descent_state

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the descent has converged, or is stuck because no shorter step lowers the cost."""
        failure_result = optx.RESULTS.where(state.is_stuck, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.converged | state.is_stuck, failure_result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the solution unchanged."""
        return y, aux, {}
