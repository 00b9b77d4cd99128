"""Minimisation between bounds, which optimistix does not do: in JAX by jaxopt, step by step on record by SciPy.

jaxopt is not developed further. It is imported here and nowhere else, so that what replaces it has one place to go.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit_solvers.optimise.status import Status

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
