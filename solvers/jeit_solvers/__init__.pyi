from .clustering import KMeans, kmeans
from .cores import check_not_abandoned, number_of_cores, on_cores, one_thread_of_blas, over_cores, results_on_cores
from .dense import (
    QuadraticModel,
    lower_cholesky,
    ridge_model,
    ridge_step,
    solve_definite,
    symmetric_eigen,
    symmetric_inverse,
)
from .engines import in_turn
from .optimise.descent import (
    BoundedMinimum,
    Descent,
    Status,
    ended,
    ended_number,
    lbfgsb,
    projected_gradient,
    scipy_lbfgsb,
)
from .optimise.implicit import as_minimum
from .optimise.small_problems import (
    Minimum,
    definite_small,
    gradient_small,
    hessian_small,
    inverse_small,
    minimise_small,
    solve_small,
    symmetric_small,
)
from .sparse.choose import ColumnSolver, ConjugateGradient, DirectSolver, FrontalCholesky, SparseCholesky, choose_solver
from .sparse.exact_fronts import Fronts, find_fronts
from .sparse.exact_fronts_numpy import FrontalFactor, factorise_fronts
from .sparse.inverse_entries import NearInverse, Strips, near_inverse
from .sparse.operator import NumpySolver, SparseSymmetric
from .sparse.optional_packages import Multigrid, Pardiso
from .sparse.padded_fronts import FactorisationPlan, analyse
from .sparse.padded_fronts_jax import (
    Factor,
    factorise,
    half_solve,
    inverse_entries,
    inverse_root,
    quadratic_form,
    solve,
)
from .sparse.pattern import SparsityPattern

__all__ = [
    "BoundedMinimum",
    "ColumnSolver",
    "ConjugateGradient",
    "Descent",
    "DirectSolver",
    "Factor",
    "FactorisationPlan",
    "FrontalCholesky",
    "FrontalFactor",
    "Fronts",
    "KMeans",
    "Minimum",
    "Multigrid",
    "NearInverse",
    "NumpySolver",
    "Pardiso",
    "QuadraticModel",
    "SparseCholesky",
    "SparseSymmetric",
    "SparsityPattern",
    "Status",
    "Strips",
    "analyse",
    "as_minimum",
    "check_not_abandoned",
    "choose_solver",
    "definite_small",
    "ended",
    "ended_number",
    "factorise",
    "factorise_fronts",
    "find_fronts",
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
    "one_thread_of_blas",
    "over_cores",
    "projected_gradient",
    "quadratic_form",
    "results_on_cores",
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
