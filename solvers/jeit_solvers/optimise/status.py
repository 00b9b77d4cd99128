"""Status of a minimisation, in one word: the same words for every solver."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Int

from jeit_solvers.engines import has_values


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
