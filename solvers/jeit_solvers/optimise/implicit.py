"""Derivatives of a minimum with respect to the problem's data, by the implicit function theorem, for any solver.

At a minimum x̂(p) of a cost with gradient g(x, p), the gradient stays zero when the problem p changes, so that

    H dx̂ = -∂g/∂p dp,   H = ∂g/∂x,

with the full Hessian H, not its Gauss-Newton approximation. The linear system is solved by conjugate gradients, which
need only products with H, preconditioned by an approximation of H such as the Gauss-Newton matrix. Krantz and Parks,
The Implicit Function Theorem (2002); Blondel et al., NeurIPS 35 (2022) 5230-5242.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit_solvers.engines import undifferentiated

# Relative tolerance of the linear system.
_RELATIVE_ENERGY_TOLERANCE = 1e-11
# Maximum number of conjugate-gradient steps; with a good preconditioner about a dozen are taken.
_MAX_STEPS = 500
# The Newton step to the minimum is the last if its length, measured as the square root of the decrease of the cost, is
# below the first value, because the remaining error is of the order of the squared length. The second value is the
# maximum number of Newton steps.
_LAST_STEP_LENGTH, _MAX_NEWTON_STEPS = 1e-6, 8

Gradient = Callable[[Float[Array, " n"], Any], Float[Array, " n"]]
LinearMap = Callable[[Float[Array, " n"]], Float[Array, " n"]]
Preconditioner = Callable[[Float[Array, " n"], Any], LinearMap]


def as_minimum(
    point: Float[Array, " n"], problem: Any, gradient: Gradient, precondition: Preconditioner
) -> Float[Array, " n"]:
    """Return `point`, a minimum found by a solver, with unchanged values and with derivatives with respect to the
    problem.

    The computation of `point` is not differentiated. Derivatives are evaluated at the minimum itself, which is found by
    a few Newton steps from `point`. The derivatives are therefore as accurate as the gradient even if the solver
    stopped early. If the Newton steps fail, derivatives are evaluated at `point`. The result is differentiable any
    number of times, in forward and reverse mode, and under `jax.vmap`.

    **Arguments:**

    - `point` (n,): point near the minimum, the result of a solver.
    - `problem`: a pytree; the minimum is differentiated with respect to its arrays.
    - `gradient`: function of (x, problem) that returns the gradient (n,) of the cost, which is zero at the minimum. Its
      derivative with respect to x, the Hessian, must be symmetric and positive definite at the minimum.
    - `precondition`: function of (x, problem) that returns a function; this function multiplies a vector by the inverse
      of an approximation of the Hessian.

    **Example:**

    ```python
    gradient = lambda x, target: 2 * (x - target)
    minimum = lambda target: as_minimum(jnp.full(3, 2.0), target, gradient, lambda x, target: lambda vector: vector / 2)
    jax.jacobian(minimum)(2.0)
    ```
    """
    return _differentiable_minimum(jax.lax.stop_gradient(point), problem, gradient, precondition)


@eqx.filter_custom_jvp
def _differentiable_minimum(point, problem_data, gradient_function, make_preconditioner):
    return point


@_differentiable_minimum.def_jvp
def _minimum_jvp(primals, tangents):
    solver_point, problem_data, gradient_function, make_preconditioner = primals
    minimum_point = _differentiable_minimum(solver_point, problem_data, gradient_function, make_preconditioner)
    problem_tangent = tangents[1]
    if not jax.tree.leaves(problem_tangent):
        return minimum_point, jnp.zeros_like(minimum_point)
    # Point and problem are constants here: only the minimum is differentiated, not the Newton steps that lead to it.
    start_point, constant_problem = undifferentiated((solver_point, problem_data))
    model = make_preconditioner(start_point, constant_problem)
    refined_point = minimum_point + jax.lax.stop_gradient(
        _refine_by_newton(start_point, constant_problem, gradient_function, model) - start_point
    )
    _, gradient_change = eqx.filter_jvp(
        lambda problem_data: gradient_function(refined_point, problem_data), (problem_data,), (problem_tangent,)
    )
    _, hessian_product = jax.linearize(lambda x: gradient_function(x, problem_data), refined_point)
    return minimum_point, _solve_with_hessian(hessian_product, -gradient_change, model)


def _solve_with_hessian(
    hessian_product: LinearMap, right_hand_side: Float[Array, " n"], preconditioner: LinearMap
) -> Float[Array, " n"]:
    """Solve H x = `right_hand_side` by preconditioned conjugate gradients. `hessian_product`: returns H v for a vector
    v; `preconditioner`: returns an approximation of H⁻¹ v."""

    def solve_linear_system(multiply_by_hessian, right_hand_vector):
        return _conjugate_gradients(multiply_by_hessian, right_hand_vector, preconditioner)

    return jax.lax.custom_linear_solve(hessian_product, right_hand_side, solve_linear_system, symmetric=True)


def _conjugate_gradients(
    hessian_product: LinearMap, right_hand_side: Float[Array, " n"], preconditioner: LinearMap
) -> Float[Array, " n"]:
    """Solve H x = `right_hand_side` by preconditioned conjugate gradients, started at zero (Golub and Van Loan, Matrix
    Computations, 2013, 11.5). `hessian_product`: returns H v for a vector v; `preconditioner`: returns an approximation
    of H⁻¹ v."""

    def is_unfinished(iteration_state):
        _, _, _, residual_energy, num_steps = iteration_state
        return (residual_energy > energy_tolerance) & (num_steps < _MAX_STEPS)

    def conjugate_step(iteration_state):
        x, residual, search_direction, residual_energy, num_steps = iteration_state
        hessian_direction = hessian_product(search_direction)
        step_length = residual_energy / (search_direction @ hessian_direction)
        residual = residual - step_length * hessian_direction
        preconditioned_residual = preconditioner(residual)
        new_energy = residual @ preconditioned_residual
        return (
            x + step_length * search_direction,
            residual,
            preconditioned_residual + (new_energy / residual_energy) * search_direction,
            new_energy,
            num_steps + 1,
        )

    start_direction = preconditioner(right_hand_side)
    start_energy = right_hand_side @ start_direction
    energy_tolerance = _RELATIVE_ENERGY_TOLERANCE**2 * start_energy
    return jax.lax.while_loop(
        is_unfinished,
        conjugate_step,
        (jnp.zeros_like(right_hand_side), right_hand_side, start_direction, start_energy, 0),
    )[0]


def _refine_by_newton(
    point: Float[Array, " n"], problem_data: Any, gradient_function: Gradient, preconditioner: LinearMap
) -> Float[Array, " n"]:
    """Find the minimum by Newton's method, started at a nearby `point`. The iteration continues as long as the steps
    become shorter in the norm of the Hessian."""

    def newton_step(iteration_state):
        trial_point, last_point, last_length, num_steps, _ = iteration_state
        trial_gradient, hessian_product = jax.linearize(lambda x: gradient_function(x, problem_data), trial_point)
        newton_direction = _conjugate_gradients(hessian_product, -trial_gradient, preconditioner)
        new_length = jnp.sqrt(jnp.abs(trial_gradient @ newton_direction))
        is_shorter = new_length < last_length
        return (
            jnp.where(is_shorter, trial_point + newton_direction, last_point),
            trial_point,
            new_length,
            num_steps + 1,
            is_shorter,
        )

    def is_unfinished(iteration_state):
        _, _, last_length, num_steps, is_shorter = iteration_state
        return is_shorter & (num_steps < _MAX_NEWTON_STEPS) & (last_length > _LAST_STEP_LENGTH)

    start_state = point, point, jnp.asarray(jnp.inf, point.dtype), 0, jnp.bool_(True)
    return jax.lax.while_loop(is_unfinished, newton_step, start_state)[0]
