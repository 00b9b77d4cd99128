"""Bounded minimisation from several starts at once, with a record of every step."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit_solvers import Status, scipy_lbfgsb

# Relative decrease of the cost in a step below which it has converged.
_TOLERANCE = 1e-5


class Record:
    """History of S starts: variables (S, v) and scores (S,) after every step."""

    def __init__(self, callback: Callable[[int, Float[np.ndarray, " S"]], None] | None = None):
        self.variables: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self._callback = callback

    def add(self, variables, values) -> None:
        """Add a step."""
        self.variables.append(np.array(variables))
        self.values.append(np.array(values))
        if self._callback is not None:
            self._callback(len(self.values) - 1, self.values[-1])


def descend(
    cost, variables: Float[Array, "S v"], steps: int, record: Record, *, tolerance: float = _TOLERANCE
) -> tuple[Float[Array, "S v"], Status]:
    """Minimise the sum of the starts' costs over variables between 0 and 1 by L-BFGS. Returns the final variables and
    the termination: converged, step limit, or stalled where no step along the gradient lowers the cost.

    `cost`: of variables (S, v) to costs (S,), scores (S,) for the record, and the gradient (S, v) of the costs.
    """
    last = {}

    def value_and_slope(variables):
        value, score, slope = cost(variables)
        last.update(variables=np.asarray(variables), score=np.asarray(score))
        return jnp.sum(value), slope

    def after_step(variables):
        same = np.array_equal(last["variables"], variables)
        record.add(variables, last["score"] if same else cost(variables)[1])

    found, _, status = scipy_lbfgsb(
        value_and_slope, variables, 0.0, 1.0, tolerance=tolerance, max_steps=steps, callback=after_step
    )
    return jnp.asarray(found), status
