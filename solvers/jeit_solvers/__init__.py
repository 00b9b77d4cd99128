"""Numerics with no physics in it, in pure JAX.

- `sparse`: symmetric systems by a direct solver (nested dissection, multifrontal Cholesky in batches of dense fronts)
  or conjugate gradients, for `SparseSymmetric` operators and behind `lineax.linear_solve`; and the functions beneath,
  for when every microsecond counts: `analyse`, `factorise`, `solve`;
- `dense`: small systems that batch;
- `optimise`: descent along quadratic models, many small problems at once, problems between bounds, derivatives of a
  minimum, and `Status`;
- `kmeans`; `over_cores`, `on_cores` and `in_turn`, which share work out.
"""

from __future__ import annotations

from jeit_solvers.batching import in_turn
from jeit_solvers.clustering import KMeans, kmeans
from jeit_solvers.cores import number_of_cores, on_cores, over_cores
from jeit_solvers.dense.cholesky import lower_cholesky, symmetric_eigen, symmetric_inverse
from jeit_solvers.dense.ridge import QuadraticModel, ridge_model, ridge_step, solve_definite
from jeit_solvers.optimise.bounded import BoundedMinimum, lbfgsb, projected_gradient, scipy_lbfgsb
from jeit_solvers.optimise.descent import Descent
from jeit_solvers.optimise.implicit import as_minimum
from jeit_solvers.optimise.small_problems import (
    Minimum,
    definite_small,
    gradient_small,
    hessian_small,
    inverse_small,
    minimise_small,
    solve_small,
    symmetric_small,
)
from jeit_solvers.optimise.status import Status, ended, ended_number
from jeit_solvers.sparse.choose import choose_solver
from jeit_solvers.sparse.conjugate_gradient import ConjugateGradient
from jeit_solvers.sparse.multifrontal import (
    Factor,
    factorise,
    half_solve,
    inverse_entries,
    inverse_root,
    quadratic_form,
    solve,
)
from jeit_solvers.sparse.near_inverse import NearInverse, Strips, near_inverse
from jeit_solvers.sparse.operator import SparseSymmetric
from jeit_solvers.sparse.pattern import SparsityPattern
from jeit_solvers.sparse.plan import FactorisationPlan, analyse
from jeit_solvers.sparse.sparse_cholesky import SparseCholesky

__all__ = [
    "BoundedMinimum",
    "ConjugateGradient",
    "Descent",
    "Factor",
    "FactorisationPlan",
    "KMeans",
    "Minimum",
    "NearInverse",
    "QuadraticModel",
    "SparseCholesky",
    "SparseSymmetric",
    "SparsityPattern",
    "Status",
    "Strips",
    "analyse",
    "as_minimum",
    "choose_solver",
    "definite_small",
    "ended",
    "ended_number",
    "factorise",
    "gradient_small",
    "half_solve",
    "hessian_small",
    "in_turn",
    "inverse_entries",
    "inverse_root",
    "inverse_small",
    "kmeans",
    "lbfgsb",
    "lower_cholesky",
    "minimise_small",
    "near_inverse",
    "number_of_cores",
    "on_cores",
    "over_cores",
    "projected_gradient",
    "quadratic_form",
    "ridge_model",
    "ridge_step",
    "scipy_lbfgsb",
    "solve",
    "solve_definite",
    "solve_small",
    "symmetric_eigen",
    "symmetric_inverse",
    "symmetric_small",
]
