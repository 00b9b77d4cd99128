"""How a minimisation ended, in one word: the same words for every solver."""

from enum import StrEnum

import optimistix as optx


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


def ended(result: optx.RESULTS) -> Status:
    """The status that a result of optimistix stands for; seen outside `jax.jit`, where it has a value."""
    if result == optx.RESULTS.successful:
        return Status.CONVERGED
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        return Status.STEP_LIMIT
    return Status.STALLED
