"""Result of choosing a hyperparameter: λ, the rule, and the rule's curves; and the default values.

GREIT and filtered back-projection scale λ differently and have default values of their own.
"""

from __future__ import annotations

from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jeit_solvers.engines import as_array
from jeit_solvers.module import Module

DEFAULT_RULE = "noise-figure"
"""Default rule that chooses λ, for linear images and for nonlinear problems linearised at the background."""
GAUSS_NEWTON_HYPERPARAMETER = 5.0
"""Default λ of Gauss-Newton images of a tank relative to a reference frame, with a smooth prior; the prior standard
deviation of log σ is then 1/5."""
EDGE_HYPERPARAMETER_PENALTY = 300.0
"""Default λ of total variation: penalty of an edge as long as the body is wide, per unit of jump of log σ across the
edge."""


class Choice(Module):
    """A hyperparameter λ that was chosen by a rule from a grid of candidates, or specified by the user.

    **Fields**: `hyperparameter`: λ; `candidates` (K,): values of λ evaluated, ascending; `criterion` (K,): value of the
    rule's criterion for every candidate (see the rules in `jeit.inverse.hyperparameter`); `residual` (K,): norm ‖w (v -
    Jx)‖ of the residual of the image x for every candidate, in standard deviations, with data v, Jacobian J and weights
    w; `penalty` (K,): √(xᵀQx) of the same images for the prior's precision Q; penalty and residual form the L-curve;
    `rule`: name of the rule, or "given"; `target`: value of the criterion that the rule seeks, None if the rule seeks
    the minimum or maximum; `edge`: "smallest" or "largest" if λ is the first or last candidate, so that the rule's
    optimum may lie outside the grid, else empty.

    If λ was specified by the user, it is the only candidate, and the curves are empty, (0,). Without data, residual and
    penalty are empty.

    **Example:**

    ```python
    choice = choose_hyperparameter(model, 1.0, rule="gcv", difference=change, noise=1e-6)
    choice.hyperparameter, choice.note
    ```
    """

    hyperparameter: Float[Array, ""]
    candidates: Float[Array, " K"]
    criterion: Float[Array, " _"]
    residual: Float[Array, " _"]
    penalty: Float[Array, " _"]
    rule: str = eqx.field(static=True)
    target: float | None = eqx.field(static=True, default=None)
    edge: str = eqx.field(static=True, default="")

    @classmethod
    def given(cls, hyperparameter: ArrayLike) -> "Choice":
        """Create a choice from a value of λ that the user specified."""
        hyperparameter_array = as_array(hyperparameter, float)
        empty_curve = as_array(np.zeros(0))
        return cls(
            hyperparameter_array,
            as_array(np.reshape(hyperparameter_array, 1)),
            empty_curve,
            empty_curve,
            empty_curve,
            "given",
        )

    @classmethod
    def among(
        cls,
        rule: str,
        candidates: Float[np.ndarray, " K"],
        index: int,
        criterion: Float[np.ndarray, " K"],
        curves: Iterable[ArrayLike],
        *,
        target: float | None = None,
        between: float | None = None,
    ) -> "Choice":
        """Create a choice from the result of a `rule`: candidate number `index`, or `between`, a value of λ between
        this candidate and the next.

        `curves`: residual and penalty at every candidate, or empty arrays.
        """
        end_of_range = {0: "smallest", len(candidates) - 1: "largest"}.get(int(index), "") if between is None else ""
        chosen_hyperparameter = candidates[index] if between is None else between
        residual, penalty = (as_array(curve_values, float) for curve_values in curves)
        return cls(
            as_array(chosen_hyperparameter),
            as_array(candidates),
            as_array(criterion),
            residual,
            penalty,
            rule,
            target,
            end_of_range,
        )

    @property
    def note(self) -> str:
        """Sentence that gives a reason to doubt the choice of λ; empty if there is no reason."""
        if not self.edge:
            return ""
        return (
            f"The rule '{self.rule}' ran to the {self.edge} hyperparameter of its grid without finding what it looks "
            "for: the choice is not to be trusted."
        )

    def read(self, curve: ArrayLike, hyperparameter: ArrayLike | None = None) -> float:
        """Interpolate a `curve` (K,), such as the residual, at `hyperparameter`, by default the chosen λ.

        Raises `ValueError` if the curve is empty.
        """
        if np.size(curve) == 0:
            raise ValueError(f"curve: this choice ('{self.rule}') has none; let a rule choose, and give it data.")
        shown_hyperparameter = self.hyperparameter if hyperparameter is None else hyperparameter
        return float(np.interp(np.log(shown_hyperparameter), np.log(np.asarray(self.candidates)), np.asarray(curve)))
