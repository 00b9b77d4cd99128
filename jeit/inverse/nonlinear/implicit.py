"""Implicit differentiation: derivatives of a nonlinear image's coefficients with respect to the problem's inputs.

At a minimum the gradient of the objective, Jᵀ G r + penalty'(c), is zero. With bounds, this holds for the free
coefficients. A coefficient at an active bound, where the objective decreases outwards, follows the bound as long as the
bound stays active. Where a bound is just reached, derivatives are one-sided.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.inverse.nonlinear.problem import Inversion
from jeit_solvers import as_minimum, symmetric_inverse

# Relative distance within which a coefficient counts as being at a bound; solvers scale coefficients and bounds, which
# causes rounding errors.
_ROUNDING = 1e-12


@eqx.filter_jit
def as_solution(found: Float[Array, " n"], inversion: Inversion, box: Any = None) -> Float[Array, " n"]:
    """`found` (n,), the result of a solver, with derivatives of the minimum attached: with respect to all fields of the
    inversion and, if there are bounds, the lower and upper bounds `box`, (n,) each."""
    if box is None:
        return as_minimum(found, (inversion, None, None), _gradient, _preconditioner)
    slope = jax.grad(inversion.cost)(found)
    # -1 at the lower bound, 1 at the upper one, 0 where a coefficient is free.
    near = [_ROUNDING * jnp.maximum(1, jnp.abs(end)) for end in box]
    side = 1 * ((found >= box[1] - near[1]) & (slope < 0)) - ((found <= box[0] + near[0]) & (slope > 0))
    point = as_minimum(jnp.where(side == 0, found, 0), (inversion, box, side), _gradient, _preconditioner)
    return _with_bounds(point, box, side)


def _with_bounds(point, box, side):
    """Coefficients with free values from `point` and the others at their bounds."""
    return point if box is None else jnp.where(side < 0, box[0], jnp.where(side > 0, box[1], point))


def _gradient(point, problem):
    """Gradient of the objective with respect to the free coefficients. The entries of the others equal `point`, so that
    a zero of this function has zeros there; `_with_bounds` inserts their bounds."""
    inversion, box, side = problem
    slope = jax.grad(inversion.cost)(_with_bounds(point, box, side))
    return slope if box is None else jnp.where(side == 0, slope, point)


def _preconditioner(point, problem):
    """Function that multiplies with the inverse of the Gauss-Newton matrix JᵀGJ + P of the free coefficients, where P
    is the penalty's Hessian. Woodbury's identity gives P⁻¹ - P⁻¹Jᵀ(JP⁻¹Jᵀ + G⁻¹)⁻¹JP⁻¹."""
    inversion, box, side = problem
    coefficients = _with_bounds(point, box, side)
    free = jnp.ones(point.shape, bool) if box is None else side == 0
    jacobian = jnp.where(free, inversion.linearise(coefficients)[1], 0)
    product = inversion.penalty.inverse_hessian(coefficients, free, jacobian.T)
    outer = jacobian @ product
    inner = symmetric_inverse((outer + outer.T) / 2 + inversion.data.covariance)

    def apply(vector):
        own = inversion.penalty.inverse_hessian(coefficients, free, jnp.where(free, vector, 0)[:, None])[:, 0]
        return jnp.where(free, own - product @ (inner @ (jacobian @ own)), vector)

    return apply
