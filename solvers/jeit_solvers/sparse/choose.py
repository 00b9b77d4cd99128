"""Direct or iterative: the choice, from what a factorisation would cost."""

from __future__ import annotations

from typing import Any

from jeit_solvers.sparse.conjugate_gradient import ConjugateGradient
from jeit_solvers.sparse.pattern import SparsityPattern
from jeit_solvers.sparse.plan import elimination_tree, plan_of_tree
from jeit_solvers.sparse.sparse_cholesky import SparseCholesky


def choose_solver(
    pattern: SparsityPattern,
    coordinates: Any = None,
    *,
    memory_limit: float = 2e9,
    operations_limit: float = 1e11,
    tolerance: float = 1e-10,
) -> SparseCholesky | ConjugateGradient:
    """The direct solver where its factor is affordable, conjugate gradients elsewhere; `solver.reason` says why.

    **Arguments:**

    - `pattern`: the sparsity pattern of the matrices to solve with.
    - `coordinates`: of the unknowns (n, d), as for `analyse`.
    - `memory_limit`: bytes that the direct solver may use for one matrix in double precision: its factor, its largest
      temporary arrays and its index maps.
    - `operations_limit`: floating-point operations that one factorisation may take; 1e11 are a few seconds.
    - `tolerance`: of the conjugate gradients.
    """
    tree = elimination_tree(pattern, coordinates)
    # Fronts live as long as their parents need them; indices are 4 bytes, and a front's entry may need two.
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
