"""Result of choosing a hyperparameter: the λ chosen, the rule, and the rule's curve."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jeit_solvers.engines import as_array


class Choice(eqx.Module):
    """A hyperparameter λ and how it came about: chosen by a rule on a grid of candidates, or given.

    **Fields**: `hyperparameter` λ; `candidates` (K,), the λ evaluated, ascending; `criterion` (K,), the rule's
    criterion at every candidate (see the rules in `jeit.inverse.hyperparameter`); `residual` (K,), ‖w (v - Jx)‖ in
    standard deviations, and `penalty` (K,), √(xᵀQx), of the image x at every candidate: the coordinates of the L-curve;
    `rule`, its name, or "given"; `target`, the required value of the criterion, None where the rule takes its minimum
    or maximum; `edge`, "smallest" or "largest" where λ is that candidate, so that the rule's own would lie beyond it,
    else empty.

    A given number is its own only candidate, and its curves are empty, (0,); so are residual and penalty without data.
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
    def given(cls, hyperparameter) -> "Choice":
        """Choice of a number that was given."""
        value = as_array(hyperparameter, float)
        nothing = as_array(np.zeros(0))
        return cls(value, as_array(np.reshape(value, 1)), nothing, nothing, nothing, "given")

    @classmethod
    def among(
        cls, rule: str, candidates, index: int, criterion, curves, *, target: float | None = None, between=None
    ) -> "Choice":
        """Choice of candidate number `index`, or of `between`, a λ found between that candidate and the next.

        `curves`: residual and penalty at every candidate, or empty ones.
        """
        edge = {0: "smallest", len(candidates) - 1: "largest"}.get(int(index), "") if between is None else ""
        value = candidates[index] if between is None else between
        residual, penalty = (as_array(curve, float) for curve in curves)
        return cls(as_array(value), as_array(candidates), as_array(criterion), residual, penalty, rule, target, edge)

    @property
    def note(self) -> str:
        """Reason to doubt the choice, in a sentence; empty when there is none."""
        if not self.edge:
            return ""
        return (
            f"The rule '{self.rule}' ran to the {self.edge} hyperparameter of its grid without finding what it looks "
            "for: the choice is not to be trusted."
        )

    def read(self, curve: ArrayLike, hyperparameter=None) -> float:
        """Value of one of its curves (K,) at any λ, the one chosen unless given; interpolated between candidates.

        Raises `ValueError` for a curve that it does not have.
        """
        if np.size(curve) == 0:
            raise ValueError(f"curve: this choice ('{self.rule}') has none; let a rule choose, and give it data.")
        value = self.hyperparameter if hyperparameter is None else hyperparameter
        return float(np.interp(np.log(value), np.log(np.asarray(self.candidates)), np.asarray(curve)))
