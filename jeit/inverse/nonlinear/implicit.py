"""Implicit differentiation: derivatives of a nonlinear image's coefficients in the problem that they solve.

At a minimum the gradient of the objective, Jᵀ G r + penalty'(c), is zero. Between bounds it is so for the coefficients
that are free; those at a bound which the objective pushes outwards go where the bound goes, and so they do as long as
the same bounds are active. Where one is just reached derivatives hold on one side only.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.inverse.nonlinear.problem import Inversion
from jeit_solvers import as_minimum, symmetric_inverse

# Relative distance from a bound within which a coefficient counts as at it: solvers scale coefficients, and bounds with
# them.
_ROUNDING = 1e-12


@eqx.filter_jit
def as_solution(found: Float[Array, " n"], inversion: Inversion, box: Any = None) -> Float[Array, " n"]:
    """`found` (n,), where a solver ended, with the derivatives of the minimum near it in everything that the inversion
    has, and in the ends of `box`, (n,) each, if there are bounds."""
    if box is None:
        return as_minimum(found, (inversion, None, None), _gradient, _preconditioner)
    slope = jax.grad(inversion.cost)(found)
    # -1 at the lower bound, 1 at the upper one, 0 where a coefficient is free.
    near = [_ROUNDING * jnp.maximum(1, jnp.abs(end)) for end in box]
    side = 1 * ((found >= box[1] - near[1]) & (slope < 0)) - ((found <= box[0] + near[0]) & (slope > 0))
    point = as_minimum(jnp.where(side == 0, found, 0), (inversion, box, side), _gradient, _preconditioner)
    return _placed(point, box, side)


def _placed(point, box, side):
    """Coefficients with the free values inserted, and bounds in place of the others."""
    return point if box is None else jnp.where(side < 0, box[0], jnp.where(side > 0, box[1], point))


def _gradient(point, problem):
    """Gradient of the objective in the free coefficients; the others are held at zero, and their bounds stand for
    them."""
    inversion, box, side = problem
    slope = jax.grad(inversion.cost)(_placed(point, box, side))
    return slope if box is None else jnp.where(side == 0, slope, point)


def _preconditioner(point, problem):
    """The inverse of Gauss-Newton's matrix JᵀGJ + P of the free coefficients, P the penalty's Hessian: by Woodbury's
    identity P⁻¹ - P⁻¹Jᵀ(JP⁻¹Jᵀ + G⁻¹)⁻¹JP⁻¹."""
    inversion, box, side = problem
    coefficients = _placed(point, box, side)
    free = jnp.ones(point.shape, bool) if box is None else side == 0
    jacobian = jnp.where(free, inversion.linearise(coefficients)[1], 0)
    product = inversion.penalty.inverse_hessian(coefficients, free, jacobian.T)
    outer = jacobian @ product
    inner = symmetric_inverse((outer + outer.T) / 2 + inversion.data.covariance)

    def apply(vector):
        own = inversion.penalty.inverse_hessian(coefficients, free, jnp.where(free, vector, 0)[:, None])[:, 0]
        return jnp.where(free, own - product @ (inner @ (jacobian @ own)), vector)

    return apply
