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
_TOLERANCE = 1e-11
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
    return _minimum(jax.lax.stop_gradient(point), problem, gradient, precondition)


@eqx.filter_custom_jvp
def _minimum(point, problem, gradient, precondition):
    return point


@_minimum.def_jvp
def _minimum_jvp(primals, tangents):
    solver_point, problem, gradient, precondition = primals
    point = _minimum(solver_point, problem, gradient, precondition)
    problem_tangent = tangents[1]
    if not jax.tree.leaves(problem_tangent):
        return point, jnp.zeros_like(point)
    # Point and problem are constants here: only the minimum is differentiated, not the Newton steps that lead to it.
    start_point, constant_problem = undifferentiated((solver_point, problem))
    model = precondition(start_point, constant_problem)
    refined_point = point + jax.lax.stop_gradient(_refine(start_point, constant_problem, gradient, model) - start_point)
    _, gradient_change = eqx.filter_jvp(
        lambda problem: gradient(refined_point, problem), (problem,), (problem_tangent,)
    )
    _, hessian = jax.linearize(lambda x: gradient(x, problem), refined_point)
    return point, _solve(hessian, -gradient_change, model)


def _solve(hessian: LinearMap, right_hand_side: Float[Array, " n"], preconditioner: LinearMap) -> Float[Array, " n"]:
    """Solve H x = `right_hand_side` by preconditioned conjugate gradients. `hessian`: returns H v for a vector v;
    `preconditioner`: returns an approximation of H⁻¹ v."""

    def solve(multiply, vector):
        return _conjugate_gradients(multiply, vector, preconditioner)

    return jax.lax.custom_linear_solve(hessian, right_hand_side, solve, symmetric=True)


def _conjugate_gradients(
    hessian_product: LinearMap, right_hand_side: Float[Array, " n"], preconditioner: LinearMap
) -> Float[Array, " n"]:
    """Solve H x = `right_hand_side` by preconditioned conjugate gradients, started at zero (Golub and Van Loan, Matrix
    Computations, 2013, 11.5). `hessian_product`: returns H v for a vector v; `preconditioner`: returns an approximation
    of H⁻¹ v."""

    def is_unfinished(state):
        _, _, _, energy, num_steps = state
        return (energy > tolerance) & (num_steps < _MAX_STEPS)

    def step(state):
        x, residual, direction, energy, num_steps = state
        hessian_direction = hessian_product(direction)
        step_length = energy / (direction @ hessian_direction)
        residual = residual - step_length * hessian_direction
        preconditioned = preconditioner(residual)
        new_energy = residual @ preconditioned
        return (
            x + step_length * direction,
            residual,
            preconditioned + (new_energy / energy) * direction,
            new_energy,
            num_steps + 1,
        )

    start = preconditioner(right_hand_side)
    start_energy = right_hand_side @ start
    tolerance = _TOLERANCE**2 * start_energy
    return jax.lax.while_loop(
        is_unfinished, step, (jnp.zeros_like(right_hand_side), right_hand_side, start, start_energy, 0)
    )[0]


def _refine(
    point: Float[Array, " n"], problem: Any, gradient: Gradient, preconditioner: LinearMap
) -> Float[Array, " n"]:
    """Find the minimum by Newton's method, started at a nearby `point`. The iteration continues as long as the steps
    become shorter in the norm of the Hessian."""

    def step(state):
        trial_point, last_point, length, num_steps, _ = state
        trial_gradient, hessian = jax.linearize(lambda x: gradient(x, problem), trial_point)
        direction = _conjugate_gradients(hessian, -trial_gradient, preconditioner)
        new_length = jnp.sqrt(jnp.abs(trial_gradient @ direction))
        is_shorter = new_length < length
        return (
            jnp.where(is_shorter, trial_point + direction, last_point),
            trial_point,
            new_length,
            num_steps + 1,
            is_shorter,
        )

    def is_unfinished(state):
        _, _, length, num_steps, is_shorter = state
        return is_shorter & (num_steps < _MAX_NEWTON_STEPS) & (length > _LAST_STEP_LENGTH)

    start = point, point, jnp.asarray(jnp.inf, point.dtype), 0, jnp.bool_(True)
    return jax.lax.while_loop(is_unfinished, step, start)[0]
