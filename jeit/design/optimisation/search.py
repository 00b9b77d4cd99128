"""Bounded descent from several starts at once, step by step on record."""

import warnings
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# A cost that falls by less in a step, relative, has settled.
_TOLERANCE = 1e-5


class Record:
    """The way of S starts: variables (S, v) and scores (S,) after every step."""

    def __init__(self, callback: Callable[[int, Float[np.ndarray, " S"]], None] | None = None):
        self.variables: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self._callback = callback

    def add(self, variables, values) -> None:
        """One step more."""
        self.variables.append(np.array(variables))
        self.values.append(np.array(values))
        if self._callback is not None:
            self._callback(len(self.values) - 1, self.values[-1])


def descend(cost, variables: Float[Array, "S v"], steps: int, record: Record, *, tolerance: float = _TOLERANCE):
    """Minimise the sum of the starts' costs between 0 and 1 by L-BFGS; where it ends, and how: "converged",
    "step limit", or "stalled" where no step along the gradient lowers it.

    `cost`: of variables (S, v) to costs (S,), scores (S,) for the record, and the gradient (S, v) of the costs.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt says on import that it is not developed further
        import jaxopt
    last = {}

    def value_and_slope(variables):
        value, score, slope = cost(variables)
        last.update(variables=np.asarray(variables), score=np.asarray(score))
        return jnp.sum(value), slope

    def after_step(variables):
        same = np.array_equal(last["variables"], variables)
        record.add(variables, last["score"] if same else cost(variables)[1])

    solver = jaxopt.ScipyBoundedMinimize(
        fun=value_and_slope,
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        tol=tolerance,
        maxiter=steps,
        callback=after_step,
    )
    bounds = (jnp.zeros_like(variables), jnp.ones_like(variables))
    found, info = solver.run(variables, bounds)
    return found, "converged" if info.success else "step limit" if int(info.status) == 1 else "stalled"
