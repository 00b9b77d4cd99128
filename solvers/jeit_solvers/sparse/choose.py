"""Direct and iterative solvers of sparse systems for lineax, and the choice of a solver."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
from jaxtyping import Array, Bool, Inexact, Int

from jeit_solvers.cores import memory_of_machine
from jeit_solvers.engines import has_values
from jeit_solvers.sparse.exact_fronts import Fronts, find_fronts
from jeit_solvers.sparse.exact_fronts_numpy import solve_with_cached_factor
from jeit_solvers.sparse.operator import MatrixSolver, NumpySolver, SparseSymmetric, require_sparse_symmetric
from jeit_solvers.sparse.optional_packages import Multigrid, multigrid_is_installed
from jeit_solvers.sparse.padded_fronts import FactorisationPlan, analyse
from jeit_solvers.sparse.padded_fronts_jax import Factor, factorise, solve
from jeit_solvers.sparse.pattern import SparsityPattern

# Maximum number of floating-point operations of a factorisation that is compiled, on a CPU and on an accelerator. On a
# CPU, compiling a longer factorisation takes more time than it saves; on an accelerator, the padded index maps must fit
# in memory.
_MAX_COMPILED_OPERATIONS_CPU, _MAX_COMPILED_OPERATIONS = 5e7, 2e10
# Floating-point operations of a factorisation per second; then the time in seconds and the memory in bytes, per entry
# of the matrix, that multigrid takes for 32 right-hand sides. Measured on two cores with solids of 50,000 to 1,000,000
# nodes.
_OPERATIONS_PER_SECOND = 4e10
_MULTIGRID_SECONDS, _MULTIGRID_BYTES = 5e-6, 400.0
# A direct solver is chosen if it takes at most this many times as long as multigrid, which is less accurate.
_DIRECT_TIME_FACTOR = 1.5


class ConjugateGradient(MatrixSolver):
    """Conjugate gradient solver, preconditioned with the diagonal of the matrix, for `SparseSymmetric` operators.

    Iteration stops when |M^-1 (b - A x)| <= tolerance |M^-1 b|, where M is the diagonal of A. The criterion is scaled
    by M because rows with large entries, such as those of electrodes with low contact impedance, may dominate the
    right-hand side b. A residual that is small relative to these rows may be large for other rows. The result is
    `RESULTS.max_steps_reached` after `max_steps` steps, and `RESULTS.breakdown` for a direction p with p^T A p <= 0,
    which does not exist for a positive definite matrix. Complex symmetric systems are solved by the conjugate
    orthogonal variant, with p^T in place of p^* (van der Vorst and Melissen, IEEE Trans. Magn. 26, 1990).

    **Arguments:**

    - `tolerance`: tolerance of the scaled residual.
    - `max_steps`: maximum number of steps, by default ten per unknown, at most 10,000.
    - `reason`: text that explains why this solver is used.

    Raises `ValueError` for a tolerance that is not between 0 and 1, and for a maximum of less than one step.

    **Example:**

    ```python
    solution = lineax.linear_solve(operator, loads[:, 0], ConjugateGradient())
    ```
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

    def compute(
        self, state: SparseSymmetric, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Iterate until the tolerance is reached. The number of steps is returned as `stats["num_steps"]`."""
        del options
        max_steps = self.max_steps or min(10 * state.pattern.size, 10_000)
        last_iterate = conjugate_gradient(state, vector, self.tolerance, max_steps)
        result_kinds = lineax.RESULTS
        solver_result = result_kinds.where(
            last_iterate.converged, result_kinds.successful, result_kinds.max_steps_reached
        )
        solver_result = result_kinds.where(last_iterate.has_broken_down, result_kinds.breakdown, solver_result)
        solver_stats = {"num_steps": last_iterate.step, "max_steps": max_steps}
        return last_iterate.solution, solver_result, solver_stats


class Iterate(NamedTuple):
    """State of a conjugate gradient iteration for A x = b. **Fields**: `solution`: x; `residual`: r = b - A x;
    `direction`: search direction p; `weight`: r^T M^-1 r with the preconditioner M; `step`: number of steps;
    `converged`, `has_broken_down`: whether the iteration ended because it converged, or because of a breakdown."""

    solution: Inexact[Array, " n"]
    residual: Inexact[Array, " n"]
    direction: Inexact[Array, " n"]
    weight: Inexact[Array, ""]
    step: Int[Array, ""]
    converged: Bool[Array, ""]
    has_broken_down: Bool[Array, ""]


def conjugate_gradient(
    operator: SparseSymmetric, vector: Inexact[Array, " n"], tolerance: float, max_steps: int
) -> Iterate:
    """Run conjugate gradients, started at x = 0 and preconditioned with the diagonal M of the matrix, and return the
    last iterate."""
    inverse_diagonal = 1 / operator.pattern.diagonal(operator.values)
    start_direction = inverse_diagonal * vector
    target_norm = tolerance * jnp.linalg.norm(start_direction)

    def is_unfinished(iterate: Iterate):
        return ~iterate.converged & ~iterate.has_broken_down & (iterate.step < max_steps)

    def conjugate_gradient_step(last_iterate: Iterate) -> Iterate:
        direction_image = operator.mv(last_iterate.direction)
        direction_curvature = last_iterate.direction @ direction_image
        step_length = last_iterate.weight / direction_curvature
        new_residual = last_iterate.residual - step_length * direction_image
        preconditioned_residual = inverse_diagonal * new_residual
        new_weight = new_residual @ preconditioned_residual
        return Iterate(
            last_iterate.solution + step_length * last_iterate.direction,
            new_residual,
            preconditioned_residual + new_weight / last_iterate.weight * last_iterate.direction,
            new_weight,
            last_iterate.step + 1,
            jnp.linalg.norm(preconditioned_residual) <= target_norm,
            ~((jnp.vdot(last_iterate.direction, direction_image).real > 0) & jnp.isfinite(direction_curvature)),
        )

    start_iterate = Iterate(
        jnp.zeros_like(vector),
        vector,
        start_direction,
        vector @ start_direction,
        jnp.asarray(0),
        jnp.linalg.norm(vector) == 0,
        ~jnp.all(jnp.isfinite(vector)),
    )
    return jax.lax.while_loop(is_unfinished, conjugate_gradient_step, start_iterate)


class SparseCholesky(lineax.AbstractLinearSolver[Factor]):
    """Direct solver for `SparseSymmetric` operators, with the plan that `analyse` computes from the operators' pattern.

    `init` factorises the matrix and `compute` solves. The same factor also solves the adjoint system, so derivatives of
    `lineax.linear_solve` need no further factorisation. A matrix that is not positive definite gives
    `RESULTS.singular`.

    **Arguments:**

    - `plan`: from `analyse`.
    - `reason`: text that explains why this solver is used.

    **Example:**

    ```python
    solution = lineax.linear_solve(operator, loads[:, 0], SparseCholesky(plan))
    ```
    """

    plan: FactorisationPlan
    reason: str = eqx.field(static=True, default="chosen by the user")

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> Factor:
        """Factorise the operator's matrix. Raises `ValueError` if the matrix and the plan have different patterns."""
        del options
        operator = require_sparse_symmetric(operator, "SparseCholesky")
        if (operator.pattern.size, operator.pattern.num_entries) != (self.plan.size, self.plan.num_entries):
            raise ValueError(
                f"SparseCholesky: the plan is for a pattern of {self.plan.size} rows and {self.plan.num_entries} "
                f"entries, the operator has {operator.pattern.size} rows and {operator.pattern.num_entries} entries. "
                "Make the plan with `analyse(operator.pattern)`."
            )
        return factorise(self.plan, operator.values)

    def solve_columns(self, state: Factor, columns: Inexact[Array, "n k"]) -> Inexact[Array, "n k"]:
        """Solutions (n, k) for k right-hand sides `columns`."""
        return solve(self.plan, state, columns)

    def compute(
        self, state: Factor, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Solve with the factor. A failed factorisation yields NaN, which `lineax.linear_solve` reports as singular."""
        del options
        return solve(self.plan, state, vector), lineax.RESULTS.successful, {}

    def transpose(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """Return the factor, because the matrix equals its transpose."""
        return state, options

    def conj(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """Return the conjugate factor, which is the factor of the conjugate matrix."""
        return jax.tree.map(lambda factor_block: factor_block.conj(), state), options

    def assume_full_rank(self) -> bool:
        """Always true, because a positive definite matrix has full rank."""
        return True


class FrontalCholesky(MatrixSolver):
    """Direct solver for large real or complex `SparseSymmetric` operators, with exact (not padded) fronts from
    `find_fronts`. The solver runs in NumPy. Compiled programs call NumPy, which keeps their compilation short.

    A matrix that is not positive definite gives `RESULTS.singular`.

    **Arguments:**

    - `fronts`: from `find_fronts`.
    - `reason`: text that explains why this solver is used.

    **Example:**

    ```python
    solution = lineax.linear_solve(operator, loads[:, 0], FrontalCholesky(find_fronts(pattern)))
    ```
    """

    fronts: Fronts = eqx.field(static=True)
    reason: str = eqx.field(static=True, default="chosen by the user")

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> SparseSymmetric:
        """Return the matrix itself, which is factorised when a solution is needed. Raises `ValueError` if the matrix
        and the fronts have different patterns."""
        del options
        operator = require_sparse_symmetric(operator, "FrontalCholesky")
        if (operator.pattern.size, operator.pattern.num_entries) != (self.fronts.size, self.fronts.num_entries):
            raise ValueError(
                f"FrontalCholesky: the fronts are for a pattern of {self.fronts.size} rows and "
                f"{self.fronts.num_entries} entries, the operator has {operator.pattern.size} rows and "
                f"{operator.pattern.num_entries} entries. Find them with `find_fronts(operator.pattern)`."
            )
        return operator

    def solve_columns(self, state: SparseSymmetric, columns: Inexact[Array, "n k"]) -> Inexact[Array, "n k"]:
        """Solutions (n, k) for k right-hand sides `columns`."""
        return solve_with_cached_factor(self.fronts, state.values, columns)

    def compute(
        self, state: SparseSymmetric, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Solve for one right-hand side. A failed factorisation yields NaN, which `lineax.linear_solve` reports as
        singular."""
        del options
        return self.solve_columns(state, vector[:, None])[:, 0], lineax.RESULTS.successful, {}


DirectSolver = SparseCholesky | FrontalCholesky
"""The solvers that factorise."""

ColumnSolver = DirectSolver | NumpySolver
"""The solvers for several right-hand sides at once, which have the method `solve_columns`."""


def choose_solver(
    pattern: SparsityPattern,
    coordinates: Any = None,
    *,
    memory_limit: float | None = None,
    tolerance: float = 1e-10,
) -> ColumnSolver | ConjugateGradient:
    """Choose a solver for sparse systems: a direct solver if its factor fits in memory and multigrid is not much
    faster; `solver.reason` states why.

    Small matrices are factorised by compiled programs. Large matrices are factorised by NumPy, which compiled programs
    call, because compilation of a factorisation takes seconds. On accelerators all matrices that fit in memory are
    factorised by compiled programs. Without PyAMG (the extra `large`), conjugate gradients replace multigrid where a
    factor does not fit in memory.

    **Arguments:**

    - `pattern`: sparsity pattern of the matrices.
    - `coordinates` (n, d): coordinates of the unknowns, as for `analyse`.
    - `memory_limit`: maximum memory of a factorisation in bytes; default: half of the machine's memory.
    - `tolerance`: tolerance of iterative solvers.

    **Example:**

    ```python
    solver = choose_solver(pattern, coordinates)
    solver.reason
    ```
    """
    fronts = find_fronts(pattern, coordinates)
    allowed_memory = memory_of_machine() / 2 if memory_limit is None else memory_limit
    factor_memory = 8.0 * (fronts.num_factor_entries + fronts.num_waiting_entries)
    direct_seconds, multigrid_seconds = (
        fronts.num_operations / _OPERATIONS_PER_SECOND,
        pattern.num_entries * _MULTIGRID_SECONDS,
    )
    multigrid_memory = _format_bytes(pattern.num_entries * _MULTIGRID_BYTES)
    cost_text = (
        f"a factorisation takes {fronts.num_operations:.1e} operations, about {direct_seconds:.1g} s, and "
        f"{_format_bytes(factor_memory)}; multigrid takes about {multigrid_seconds:.1g} s and {multigrid_memory} for "
        "32 solutions"
    )
    if factor_memory > allowed_memory or direct_seconds > _DIRECT_TIME_FACTOR * multigrid_seconds:
        comparison_text = f"{cost_text}; {_format_bytes(allowed_memory)} are allowed"
        if multigrid_is_installed():
            return Multigrid(tolerance, reason=f"iterative: {comparison_text}")
        if factor_memory > allowed_memory:
            conjugate_gradient_note = (
                "; without pyamg (pip install 'jeit[large]') conjugate gradients take several times as long"
            )
            return ConjugateGradient(tolerance, reason=f"iterative: {comparison_text}{conjugate_gradient_note}")
    is_on_cpu = jax.default_backend() == "cpu"
    if fronts.num_operations > (_MAX_COMPILED_OPERATIONS_CPU if is_on_cpu else _MAX_COMPILED_OPERATIONS):
        return FrontalCholesky(fronts, f"direct: {cost_text}")
    return SparseCholesky(analyse(pattern, coordinates), reason=f"direct: {cost_text}")


def _format_bytes(num_bytes: float) -> str:
    return f"{num_bytes / 1e6:.0f} MB" if num_bytes < 1e9 else f"{num_bytes / 1e9:.1f} GB"
