"""Preconditioned conjugate gradients, for systems whose direct factor would be too large."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
from jaxtyping import Array, Bool, Inexact, Int

from jeit_solvers.engines import has_values
from jeit_solvers.sparse.operator import SparseSymmetric, require_sparse_symmetric


class ConjugateGradient(lineax.AbstractLinearSolver[SparseSymmetric]):
    """Conjugate gradients, preconditioned with the diagonal, for `SparseSymmetric` operators.

    Stops when |M^-1 (b - A x)| <= `tolerance` |M^-1 b|, M being the diagonal: where loads enter by large entries, as
    through good contacts, a residual that is small beside them is large elsewhere. `max_steps` defaults to ten steps
    for each unknown, at most 10,000.
    Reports `RESULTS.max_steps_reached` if it runs out of steps, `RESULTS.breakdown` if it meets a direction p with
    p^T A p <= 0, which a positive definite matrix does not have. Complex symmetric systems are solved by the conjugate
    orthogonal variant, with p^T in place of p^* (van der Vorst and Melissen, IEEE Trans. Magn. 26, 1990).

    Raises `ValueError` for a tolerance that is not between 0 and 1, and for less than one step.
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
        """The matrix itself: there is nothing to prepare."""
        del options
        return require_sparse_symmetric(operator, "ConjugateGradient")

    def compute(
        self, state: SparseSymmetric, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Iterate to the tolerance. The number of steps is returned as `stats["num_steps"]`."""
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
        """Yes: a positive definite matrix has full rank."""
        return True


class Iterate(NamedTuple):
    """State of conjugate gradients: r = b - A x, search direction p, and r^T M^-1 r."""

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
    """The last iterate of conjugate gradients from x = 0, preconditioned with the matrix's diagonal M."""
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
