"""Solvers of sparse systems for lineax, direct and by conjugate gradients, and the choice between them."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
from jaxtyping import Array, Bool, Inexact, Int

from jeit_solvers.engines import has_values
from jeit_solvers.sparse.multifrontal import Factor, factorise, solve
from jeit_solvers.sparse.operator import SparseSymmetric, require_sparse_symmetric
from jeit_solvers.sparse.pattern import SparsityPattern
from jeit_solvers.sparse.plan import FactorisationPlan, elimination_tree, plan_of_tree


class ConjugateGradient(lineax.AbstractLinearSolver[SparseSymmetric]):
    """Conjugate gradients, preconditioned with the diagonal, for `SparseSymmetric` operators.

    Iteration stops when |M^-1 (b - A x)| <= `tolerance` |M^-1 b|, where M is the diagonal. The criterion is scaled by M
    because the right-hand side may be dominated by rows with large entries, such as those of good contacts, and a
    residual that is small relative to these may be large elsewhere. `max_steps` defaults to ten steps per unknown, with
    a maximum of 10,000. The result is `RESULTS.max_steps_reached` after the last step, and `RESULTS.breakdown` for a
    direction p with p^T A p <= 0, which does not exist for a positive definite matrix. Complex symmetric systems are
    solved by the conjugate orthogonal variant, with p^T in place of p^* (van der Vorst and Melissen, IEEE Trans. Magn.
    26, 1990).

    Raises `ValueError` for a tolerance that is not between 0 and 1, and for a maximum of less than one step.
    """

    tolerance: float = 1e-10
    max_steps: int | None = eqx.field(static=True, default=None)
    reason: str = eqx.field(static=True, default="chosen by the user")

    def __check_init__(self):
        if has_values(self.tolerance) and not 0 < self.tolerance < 1:
            raise ValueError(
                f"ConjugateGradient: `tolerance` must be between 0 and 1, the residual relative to the "
                f"right-hand side; got {self.tolerance}."
            )
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"ConjugateGradient: `max_steps` must be positive; got {self.max_steps}.")

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> SparseSymmetric:
        """Return the matrix itself; no preparation is needed."""
        del options
        return require_sparse_symmetric(operator, "ConjugateGradient")

    def compute(
        self, state: SparseSymmetric, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Iterate until the tolerance is reached. The number of steps is returned as `stats["num_steps"]`."""
        del options
        max_steps = self.max_steps or min(10 * state.pattern.size, 10_000)
        last = conjugate_gradient(state, vector, self.tolerance, max_steps)
        results = lineax.RESULTS
        result = results.where(last.converged, results.successful, results.max_steps_reached)
        result = results.where(last.broken_down, results.breakdown, result)
        stats = {"num_steps": last.step, "max_steps": max_steps}
        return last.solution, result, stats

    def transpose(self, state: SparseSymmetric, options: dict[str, Any]) -> tuple[SparseSymmetric, dict[str, Any]]:
        """The matrix is its own transpose."""
        return state, options

    def conj(self, state: SparseSymmetric, options: dict[str, Any]) -> tuple[SparseSymmetric, dict[str, Any]]:
        """The conjugate matrix."""
        return SparseSymmetric(state.values.conj(), state.pattern), options

    def assume_full_rank(self) -> bool:
        """Always true, because a positive definite matrix has full rank."""
        return True


class Iterate(NamedTuple):
    """State of conjugate gradients. **Fields**: `solution`: x; `residual`: r = b - A x; `direction`: search direction
    p; `weight`: r^T M^-1 r; `step`: number of steps; `converged`, `broken_down`: why the iteration ends."""

    solution: Inexact[Array, " n"]
    residual: Inexact[Array, " n"]
    direction: Inexact[Array, " n"]
    weight: Inexact[Array, ""]
    step: Int[Array, ""]
    converged: Bool[Array, ""]
    broken_down: Bool[Array, ""]


def conjugate_gradient(
    operator: SparseSymmetric, vector: Inexact[Array, " n"], tolerance: float, max_steps: int
) -> Iterate:
    """The last iterate of conjugate gradients that start at x = 0, preconditioned with the diagonal M of the matrix."""
    inverse_diagonal = 1 / operator.pattern.diagonal(operator.values)
    direction = inverse_diagonal * vector
    target = tolerance * jnp.linalg.norm(direction)

    def keep_going(now: Iterate):
        return ~now.converged & ~now.broken_down & (now.step < max_steps)

    def one_step(now: Iterate) -> Iterate:
        image = operator.mv(now.direction)
        curvature = now.direction @ image
        length = now.weight / curvature
        residual = now.residual - length * image
        preconditioned = inverse_diagonal * residual
        weight = residual @ preconditioned
        return Iterate(
            now.solution + length * now.direction,
            residual,
            preconditioned + weight / now.weight * now.direction,
            weight,
            now.step + 1,
            jnp.linalg.norm(preconditioned) <= target,
            ~((jnp.vdot(now.direction, image).real > 0) & jnp.isfinite(curvature)),
        )

    start = Iterate(
        jnp.zeros_like(vector),
        vector,
        direction,
        vector @ direction,
        jnp.asarray(0),
        jnp.linalg.norm(vector) == 0,
        ~jnp.all(jnp.isfinite(vector)),
    )
    return jax.lax.while_loop(keep_going, one_step, start)


class SparseCholesky(lineax.AbstractLinearSolver[Factor]):
    """Direct solver for `SparseSymmetric` operators, with the plan that `analyse` makes for their pattern.

    `init` factorises the matrix and `compute` solves. The same factor serves the adjoint, so `lineax.linear_solve` is
    differentiated without another factorisation. A matrix that is not positive definite gives `RESULTS.singular`.
    """

    plan: FactorisationPlan
    reason: str = eqx.field(static=True, default="chosen by the user")

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> Factor:
        """Factorise the operator's matrix. Raises `ValueError` if its pattern is not that of the plan."""
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
        """Solve with the factor. A failed factorisation yields NaN, which `lineax.linear_solve` reports as singular."""
        del options
        return solve(self.plan, state, vector), lineax.RESULTS.successful, {}

    def transpose(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The matrix is its own transpose."""
        return state, options

    def conj(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The conjugate matrix has the conjugate factor."""
        return jax.tree.map(lambda block: block.conj(), state), options

    def assume_full_rank(self) -> bool:
        """Always true, because a positive definite matrix has full rank."""
        return True


def choose_solver(
    pattern: SparsityPattern,
    coordinates: Any = None,
    *,
    memory_limit: float = 2e9,
    operations_limit: float = 1e11,
    tolerance: float = 1e-10,
) -> SparseCholesky | ConjugateGradient:
    """Choose the direct solver if its factor is affordable, else conjugate gradients; `solver.reason` states why.

    **Arguments:**

    - `pattern`: sparsity pattern of the matrices.
    - `coordinates`: (n, d) of the unknowns, as for `analyse`.
    - `memory_limit`: maximum memory of the direct solver in bytes for one matrix in double precision: factor, largest
      temporary arrays and index maps.
    - `operations_limit`: maximum number of floating-point operations of one factorisation; 1e11 take a few seconds.
    - `tolerance`: tolerance of the conjugate gradients.
    """
    tree = elimination_tree(pattern, coordinates)
    # Fronts are kept until their parents have used them. An index takes 4 bytes, and an entry of a front may need two
    # indices.
    memory = 8.0 * (tree.num_factor_entries + tree.num_front_entries) + 8.0 * tree.num_front_entries
    cost = f"a factorisation takes {tree.num_operations:.1e} operations and {memory / 1e6:.0f} MB"
    if memory > memory_limit:
        return ConjugateGradient(
            tolerance, reason=f"iterative: {cost}, more than the {memory_limit / 1e6:.0f} MB allowed"
        )
    if tree.num_operations > operations_limit:
        return ConjugateGradient(
            tolerance, reason=f"iterative: {cost}, more than the {operations_limit:.1e} operations allowed"
        )
    return SparseCholesky(plan_of_tree(pattern, tree), reason=f"direct: {cost}")
