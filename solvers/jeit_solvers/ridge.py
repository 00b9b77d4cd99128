"""Nonlinear least squares with a unit ridge: the c that minimises ½‖r(c)‖² + ½‖c‖², behind optimistix's interface.

Inverse problems come in this form once noise and prior are whitened. Then every step is one linear system that may be
solved in the space of the parameters or of the data, whichever is smaller, where a general least-squares solver would
factorise residual and ridge stacked on each other: 50 times the work for 200 data and 2,000 parameters.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .dense_cholesky import symmetric_inverse

_LEAST_SCALE = 2.0**-20
_SUFFICIENT = 1e-4


class RidgeState(eqx.Module):
    """Where a `RidgeSolver` stands: the point it is about to try, on a line from the last one accepted."""

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
    stuck: Bool[Array, ""]


class RidgeSolver(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton with a backtracking line search, or Levenberg-Marquardt, for min ½‖r(c)‖² + ½‖c‖².

    For `optimistix.least_squares(residual, RidgeSolver(), c, arguments, options={"linearise": linearise})`, where
    `residual(c, arguments)` is the pair (r, c), and `linearise(c, arguments)` is r and its Jacobian (M, n) as a matrix.

    **Arguments:**

    - `rtol`: stop when the next step promises to lower the cost by less than this share of it.
    - `damping`: 0 for Gauss-Newton; above, the first damping of Levenberg-Marquardt, in units of the ridge.
    - `history`: how many costs to keep, one for every accepted point; the rest of the array is NaN.
    """

    rtol: float = 1e-6
    atol: float = 0.0
    damping: float = 0.0
    history: int = 50
    norm: Callable[..., Any] = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The first point to try is the start."""
        if "linearise" not in options:
            raise ValueError("RidgeSolver needs options={'linearise': function}; see its documentation.")
        zero, number = jnp.zeros((), y.dtype), jnp.zeros((), int)
        return RidgeState(
            trial=y,
            direction=jnp.zeros_like(y),
            scale=zero + 1,
            slope=zero,
            curvature=zero,
            cost=zero + jnp.inf,
            damping=zero + self.damping,
            num_steps=number,
            num_accepted=number,
            history=jnp.full(self.history, jnp.nan, y.dtype),
            converged=jnp.zeros((), bool),
            stuck=jnp.zeros((), bool),
        )

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the trial point; go on from it if it is good enough, else try a shorter step."""
        residual, jacobian = options["linearise"](state.trial, args)
        cost = 0.5 * (residual @ residual + state.trial @ state.trial)
        predicted = -(state.scale * state.slope + 0.5 * state.scale**2 * state.curvature)
        good = jnp.isfinite(cost) & (cost <= state.cost - _SUFFICIENT * predicted)

        def accepted():
            gain = jnp.where(jnp.isfinite(state.cost), (state.cost - cost) / predicted, 0.5)
            damping = state.damping * jnp.select([gain > 0.75, gain < 0.25], [0.25, 4.0], 1.0)
            gradient = jacobian.T @ residual + state.trial
            direction = ridge_step(jacobian, residual, state.trial, 1 + damping)
            across = jacobian @ direction
            slope, curvature = gradient @ direction, across @ across + direction @ direction
            return RidgeState(
                trial=state.trial + direction,
                direction=direction,
                scale=jnp.ones_like(state.scale),
                slope=slope,
                curvature=curvature,
                cost=cost,
                damping=damping,
                num_steps=state.num_steps + 1,
                num_accepted=state.num_accepted + 1,
                history=state.history.at[state.num_accepted].set(cost, mode="drop"),
                converged=jnp.abs(slope + 0.5 * curvature) <= self.rtol * cost + self.atol,
                stuck=jnp.zeros((), bool),
            )

        def rejected():
            scale = state.scale / 2
            shorter = eqx.tree_at(
                lambda s: (s.trial, s.scale, s.damping, s.num_steps, s.stuck),
                state,
                (y + scale * state.direction, scale, 4 * state.damping, state.num_steps + 1, scale < _LEAST_SCALE),
            )
            # A start that cannot be evaluated has no line to go back on.
            return eqx.tree_at(lambda s: s.stuck, shorter, shorter.stuck | ~jnp.isfinite(state.cost))

        new = jax.lax.cond(good, accepted, rejected)
        return jnp.where(good, state.trial, y), new, None

    def terminate(self, fn, y, args, options, state, tags):
        """Converged, or stuck where no shorter step helps."""
        failed = optx.RESULTS.where(state.stuck, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.converged | state.stuck, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing to do."""
        return y, aux, {}


def ridge_step(
    jacobian: Float[Array, "M n"],
    residual: Float[Array, " M"],
    point: Float[Array, " n"],
    ridge: Float[Array, ""] | float = 1.0,
) -> Float[Array, " n"]:
    """The δ of (JᵀJ + ridge · 1) δ = -(Jᵀr + c), by a system of min(M, n) unknowns.

    With fewer data than unknowns, δ = -c / ridge - Jᵀ (JJᵀ + ridge · 1)⁻¹ (r - J c / ridge), by Woodbury's identity,
    arranged so that no large terms cancel however small the ridge is beside J.
    """
    rows, columns = jacobian.shape
    if columns <= rows:
        normal = jacobian.T @ jacobian + ridge * jnp.eye(columns)
        return -symmetric_inverse(normal) @ (jacobian.T @ residual + point)
    inner = symmetric_inverse(jacobian @ jacobian.T + ridge * jnp.eye(rows))
    return -point / ridge - jacobian.T @ (inner @ (residual - jacobian @ point / ridge))
