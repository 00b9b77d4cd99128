"""Derivatives of a minimum with respect to the problem, by the implicit function theorem, whichever solver found it.

At a minimum x̂(p) of a cost with gradient g(x, p) the gradient stays zero whatever the problem p does, so that

    H dx̂ = -∂g/∂p dp,   H = ∂g/∂x,

with the full Hessian H, not Gauss-Newton's. The system is solved by conjugate gradients, of products with H alone, and
a model of it, such as Gauss-Newton's, for a preconditioner. Krantz and Parks, The Implicit Function Theorem (2002);
Blondel et al., NeurIPS 35 (2022) 5230-5242.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit_solvers.engines import undifferentiated

# Relative tolerance of the linear system, and its greatest number of steps: with a good model of the Hessian a dozen
# are taken.
_TOLERANCE, _MOST_STEPS = 1e-11, 500
# The length of a step of Newton's method to the minimum, in the root of what it lowers the cost by, that needs no other
# after it, for what is left is its square; and the most of them.
_AT_THE_MINIMUM, _MOST_NEWTON_STEPS = 1e-6, 8

Gradient = Callable[[Float[Array, " n"], Any], Float[Array, " n"]]
Linear = Callable[[Float[Array, " n"]], Float[Array, " n"]]
Preconditioner = Callable[[Float[Array, " n"], Any], Linear]


def as_minimum(
    found: Float[Array, " n"], problem: Any, gradient: Gradient, precondition: Preconditioner
) -> Float[Array, " n"]:
    """`found` (n,) itself, with the derivatives that the minimum near it has in the arrays of the pytree `problem`.

    `gradient(x, problem)`: of the cost, (n,), zero at the minimum, with a symmetric derivative in x that is positive
    definite there. `precondition(x, problem)`: a function of a vector that applies the inverse of a model of it. No
    derivative goes through how the point was found. They are taken at the minimum itself, a few steps of Newton's
    method from `found`, so they are as exact as the gradient is however early the solver stopped; where those steps
    lead nowhere, at `found`. Differentiable any number of times, in both modes, and under `jax.vmap`.
    """
    return _minimum(jax.lax.stop_gradient(found), problem, gradient, precondition)


@eqx.filter_custom_jvp
def _minimum(found, problem, gradient, precondition):
    return found


@_minimum.def_jvp
def _minimum_jvp(primals, tangents):
    found, problem, gradient, precondition = primals
    point = _minimum(found, problem, gradient, precondition)
    along = tangents[1]
    if not jax.tree.leaves(along):
        return point, jnp.zeros_like(point)
    # Constants: no derivative goes through the way to the minimum, only through the minimum.
    start, constant = undifferentiated((found, problem))
    model = precondition(start, constant)
    at = point + jax.lax.stop_gradient(_polished(start, constant, gradient, model) - start)
    _, slope = eqx.filter_jvp(lambda problem: gradient(at, problem), (problem,), (along,))
    _, hessian = jax.linearize(lambda x: gradient(x, problem), at)
    return point, _solve(hessian, -slope, model)


def _solve(hessian: Linear, right: Float[Array, " n"], model: Linear) -> Float[Array, " n"]:
    """H⁻¹ right."""

    def solve(multiply, vector):
        return _conjugate_gradients(multiply, vector, model)

    return jax.lax.custom_linear_solve(hessian, right, solve, symmetric=True)


def _conjugate_gradients(multiply: Linear, right: Float[Array, " n"], model: Linear) -> Float[Array, " n"]:
    """Preconditioned conjugate gradients from zero; Golub and Van Loan, Matrix Computations (2013), 11.5."""

    def go_on(state):
        _, _, _, left, number = state
        return (left > enough) & (number < _MOST_STEPS)

    def step(state):
        x, rest, direction, left, number = state
        image = multiply(direction)
        length = left / (direction @ image)
        rest = rest - length * image
        new = model(rest)
        ahead = rest @ new
        return x + length * direction, rest, new + (ahead / left) * direction, ahead, number + 1

    first = model(right)
    size = right @ first
    enough = _TOLERANCE**2 * size
    return jax.lax.while_loop(go_on, step, (jnp.zeros_like(right), right, first, size, 0))[0]


def _polished(point: Float[Array, " n"], problem: Any, gradient: Gradient, model: Linear) -> Float[Array, " n"]:
    """The minimum, by Newton's method from nearby: as long as steps get shorter, in the Hessian's norm."""

    def step(state):
        at, before, length, number, _ = state
        slope, hessian = jax.linearize(lambda x: gradient(x, problem), at)
        direction = _conjugate_gradients(hessian, -slope, model)
        now = jnp.sqrt(jnp.abs(slope @ direction))
        better = now < length
        return jnp.where(better, at + direction, before), at, now, number + 1, better

    def go_on(state):
        _, _, length, number, better = state
        return better & (number < _MOST_NEWTON_STEPS) & (length > _AT_THE_MINIMUM)

    start = point, point, jnp.asarray(jnp.inf, point.dtype), 0, jnp.bool_(True)
    return jax.lax.while_loop(go_on, step, start)[0]
