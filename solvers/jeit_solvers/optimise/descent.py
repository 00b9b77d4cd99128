"""Descent along minima of local quadratic models, with a line search, behind optimistix's interface.

A Gauss-Newton or Levenberg-Marquardt step is the minimum of a quadratic model of the cost; what that minimum costs to
find depends on the problem's structure, which the caller knows and a general least-squares solver does not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jeit_solvers.engines import namespace, replace_at

_LEAST_SCALE = 2.0**-20
_SUFFICIENT = 1e-4


class DescentState(eqx.Module):
    """State of a `Descent`: the next trial point, on a line from the last one accepted."""

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


class Descent(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton with a backtracking line search, or Levenberg-Marquardt, on quadratic models that the caller makes.

    For `optimistix.least_squares(residual, Descent(), c, arguments, options={"expand": expand})`, where
    `expand(c, arguments)` is the pair of the cost at c and a function `step(damping)`. That gives the direction to the
    minimum of the model there, and the model's slope and curvature along it: cost(c + s·direction) ≈ cost + s·slope +
    s²·curvature / 2. With 1 + `damping` the model's penalty is weighted, see `ridge_step`.

    **Arguments:**

    - `rtol`, `atol`: stop when the next step promises to lower the cost by less than rtol·cost + atol.
    - `damping`: 0 for Gauss-Newton; above, the first damping of Levenberg-Marquardt.
    - `history`: how many costs to keep, one for every accepted point; the rest of the array is NaN.
    """

    rtol: float = 1e-6
    atol: float = 0.0
    damping: float = 0.0
    history: int = 50
    norm: Callable[..., Any] = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The first point to try is the start. Raises `ValueError` if the options lack `expand`."""
        if "expand" not in options:
            raise ValueError("Descent needs options={'expand': function}; see its documentation.")
        xp = namespace(y)
        zero, number = xp.zeros((), y.dtype), xp.zeros((), int)
        return DescentState(
            trial=y,
            direction=xp.zeros_like(y),
            scale=zero + 1,
            slope=zero,
            curvature=zero,
            cost=zero + np.inf,
            damping=zero + self.damping,
            num_steps=number,
            num_accepted=number,
            history=xp.full(self.history, np.nan, y.dtype),
            converged=xp.zeros((), bool),
            stuck=xp.zeros((), bool),
        )

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the trial point; go on from it if it is good enough, else try a shorter step."""
        xp = namespace(y)
        cost, step = options["expand"](state.trial, args)
        predicted = -(state.scale * state.slope + 0.5 * state.scale**2 * state.curvature)
        good = xp.isfinite(cost) & (cost <= state.cost - _SUFFICIENT * predicted)

        def accepted():
            gain = xp.where(xp.isfinite(state.cost), (state.cost - cost) / predicted, 0.5)
            damping = state.damping * xp.select([gain > 0.75, gain < 0.25], [0.25, 4.0], 1.0)
            direction, slope, curvature = step(damping)
            return DescentState(
                trial=state.trial + direction,
                direction=direction,
                scale=xp.ones_like(state.scale),
                slope=slope,
                curvature=curvature,
                cost=cost,
                damping=damping,
                num_steps=state.num_steps + 1,
                num_accepted=state.num_accepted + 1,
                history=replace_at(state.history, state.num_accepted, cost),
                converged=abs(slope + 0.5 * curvature) <= self.rtol * cost + self.atol,
                stuck=xp.zeros((), bool),
            )

        def rejected():
            scale = state.scale / 2
            shorter = eqx.tree_at(
                lambda s: (s.trial, s.scale, s.damping, s.num_steps, s.stuck),
                state,
                (y + scale * state.direction, scale, 4 * state.damping, state.num_steps + 1, scale < _LEAST_SCALE),
            )
            # A start that cannot be evaluated has no line to go back on.
            return eqx.tree_at(lambda s: s.stuck, shorter, shorter.stuck | ~xp.isfinite(state.cost))

        if xp is np:
            return (state.trial, accepted(), None) if good else (y, rejected(), None)
        new = jax.lax.cond(good, accepted, rejected)
        return jnp.where(good, state.trial, y), new, None

    def at_once(
        self, expand: Callable[..., Any], start: Float[np.ndarray, " n"], arguments: Any, max_steps: int
    ) -> tuple[Any, DescentState]:
        """The same steps in NumPy, as `optimistix.least_squares` takes them in a compiled program: where it ended."""
        options, point = {"expand": expand}, start
        nothing: Any = None  # what optimistix hands over besides, and these steps do not look at
        state = self.init(nothing, point, arguments, options, nothing, nothing, nothing)
        with np.errstate(all="ignore"):
            while state.num_steps < max_steps and not (state.converged or state.stuck):
                point, state, _ = self.step(nothing, point, arguments, options, state, nothing)
        return point, state

    def terminate(self, fn, y, args, options, state, tags):
        """Converged, or stuck where no shorter step helps."""
        failed = optx.RESULTS.where(state.stuck, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.converged | state.stuck, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing to do."""
        return y, aux, {}
