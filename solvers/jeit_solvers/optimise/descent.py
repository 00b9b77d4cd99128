"""Minimisation by descent, free or between bounds, and how it ended.

Minimisation between bounds, and how a minimisation ended.

jaxopt is not developed further. It is imported here and nowhere else, so that what replaces it has one place to go.

Descent along minima of local quadratic models, with a line search, behind optimistix's interface.

A Gauss-Newton or Levenberg-Marquardt step is the minimum of a quadratic model of the cost; what that minimum costs to
find depends on the problem's structure, which the caller knows and a general least-squares solver does not.
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


class Status(StrEnum):
    """How a minimisation ended. Each is equal to its word, so `status == "converged"` may be written; details such as
    the number of steps belong in a sentence beside it."""

    CONVERGED = "converged"
    """The next step would change nothing that matters."""
    STEP_LIMIT = "step limit"
    """It took all the steps that it was given."""
    STALLED = "stalled"
    """No shorter step lowered the objective."""
    FAILED = "failed"
    """What came out is not finite, or the solver broke down."""
    INFEASIBLE = "infeasible"
    """Nothing that was found satisfies the constraints."""

    @property
    def number(self) -> int:
        """Index of the status, which stands for it in compiled code, where there are no words."""
        return list(Status).index(self)

    @classmethod
    def of_number(cls, number: Any) -> "Status":
        """The one in that place. Raises `ValueError` inside `jax.jit`, where that is not known yet, and for a batch."""
        if not has_values(number) or np.shape(number) != ():
            raise ValueError(
                "status: how a minimisation inside jax.jit or jax.vmap ends is known outside only, one by one; look at "
                "`outcome`, an array of Status.number, instead."
            )
        return list(Status)[int(number)]


def ended(result: optx.RESULTS) -> Status:
    """The status that a result of optimistix stands for; seen outside `jax.jit`, where it has a value."""
    return Status.of_number(ended_number(result))


def ended_number(result: optx.RESULTS) -> Int[Array, ""]:
    """`Status.number` of what a result of optimistix stands for, inside `jax.jit` too."""
    limit = result == optx.RESULTS.nonlinear_max_steps_reached
    other = jnp.where(limit, Status.STEP_LIMIT.number, Status.STALLED.number)
    return jnp.where(result == optx.RESULTS.successful, Status.CONVERGED.number, other)


Objective = Callable[[Float[Array, " n"]], Float[Array, ""]]


class BoundedMinimum(eqx.Module):
    """Result of a minimisation between bounds: `x` (n,), the number of `steps`, and whether it `converged`: a step
    along the projected gradient would have changed no coordinate by more than the tolerance."""

    x: Float[Array, " n"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def _jaxopt() -> Any:
    """jaxopt, imported when it is needed: it warns on import that it is not developed further."""
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
    """The least value between two bounds (n,) by L-BFGS-B, inside `jax.jit`; coordinates should be of one size."""
    solver = _jaxopt().LBFGSB(objective, maxiter=max_steps, tol=tolerance, history_size=20)
    solution = solver.run(start, bounds=(lower, upper))
    return BoundedMinimum(solution.params, solution.state.iter_num, solution.state.error <= tolerance)


def projected_gradient(
    objective: Objective,
    start: Float[Array, " n"],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    max_steps: int,
    tolerance: float,
) -> BoundedMinimum:
    """The least value between two bounds (n,) by accelerated projected gradients: more steps, each of them cheaper."""
    jaxopt = _jaxopt()
    solver = jaxopt.ProjectedGradient(
        objective, jaxopt.projection.projection_box, maxiter=max_steps, tol=tolerance, acceleration=True
    )
    solution = solver.run(start, hyperparams_proj=(lower, upper))
    return BoundedMinimum(solution.params, solution.state.iter_num, solution.state.error <= tolerance)


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
    """The least value between two bounds by SciPy's L-BFGS-B: where, the value there, and how it ended.

    `value_and_gradient`: compiled by the caller, of an array of `start`'s shape. `callback`: is given every accepted
    point.
    Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16 (1995) 1190-1208.
    """
    shape = np.shape(start)
    ends = [np.broadcast_to(np.asarray(end, float), shape).ravel() for end in (lower, upper)]

    def of_vector(vector):
        value, gradient = value_and_gradient(jnp.asarray(vector).reshape(shape))
        return np.asarray(value, float), np.asarray(gradient, float).ravel()

    found = scipy.optimize.minimize(
        of_vector,
        np.asarray(start, float).ravel(),
        jac=True,
        tol=tolerance,
        bounds=np.stack(ends, axis=1),
        method="L-BFGS-B",
        callback=None if callback is None else lambda vector: callback(jnp.asarray(vector).reshape(shape)),
        options={"maxiter": max_steps},
    )
    status = Status.CONVERGED if found.success else Status.STEP_LIMIT if found.status == 1 else Status.STALLED
    return found.x.reshape(shape), float(found.fun), status


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
