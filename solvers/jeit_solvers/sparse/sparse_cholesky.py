"""The direct solver, behind lineax's interface."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import lineax
from jaxtyping import Array, Inexact

from jeit_solvers.sparse.multifrontal import Factor, factorise, solve
from jeit_solvers.sparse.operator import require_sparse_symmetric
from jeit_solvers.sparse.plan import FactorisationPlan


class SparseCholesky(lineax.AbstractLinearSolver[Factor]):
    """Direct solver for `SparseSymmetric` operators, by the plan that `analyse` made for their pattern.

    `init` factorises, `compute` solves; the same factor serves the adjoint, so that `lineax.linear_solve` is
    differentiated without factorising again. A matrix that is not positive definite gives `RESULTS.singular`.
    """

    plan: FactorisationPlan
    reason: str = eqx.field(static=True, default="chosen by the user")

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> Factor:
        """Factorise the operator's matrix. Raises `ValueError` if its pattern is not the plan's."""
        del options
        operator = require_sparse_symmetric(operator, "SparseCholesky")
        if (operator.pattern.size, operator.pattern.num_entries) != (self.plan.size, self.plan.num_entries):
            raise ValueError(
                f"SparseCholesky: the plan is for a pattern of {self.plan.size} rows and {self.plan.num_entries} "
                f"entries, the operator has {operator.pattern.size} rows and {operator.pattern.num_entries} entries. "
                "Make the plan with `analyse(operator.pattern)`."
            )
        return factorise(self.plan, operator.values)

    def compute(
        self, state: Factor, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Solve with the factor. A failed factor is NaN, which `lineax.linear_solve` reports as singular."""
        del options
        return solve(self.plan, state, vector), lineax.RESULTS.successful, {}

    def transpose(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The matrix is its own transpose."""
        return state, options

    def conj(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The conjugate matrix has the conjugate factor."""
        return jax.tree.map(lambda block: block.conj(), state), options

    def assume_full_rank(self) -> bool:
        """Yes: a positive definite matrix has full rank."""
        return True
