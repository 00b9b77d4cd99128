"""Numerics with no physics in it: sparse symmetric positive definite systems, solved in pure JAX.

A direct solver (nested dissection, multifrontal Cholesky in batches of dense fronts) and conjugate gradients, both for
`SparseSymmetric` operators and behind `lineax.linear_solve`; and the functions beneath it, for when every microsecond
counts. See `analyse`, `factorise` and `solve`.
"""

from .batching import in_turn
from .choose import choose_solver
from .conjugate_gradient import ConjugateGradient
from .dense_cholesky import symmetric_inverse
from .descent import Descent
from .few_unknowns import Minimum, definite_few, hessian_few, inverse_few, minimise_few, solve_few, symmetric_few
from .kmeans import KMeans, kmeans
from .multifrontal import Factor, factorise, half_solve, quadratic_form, solve
from .near_inverse import NearInverse, Strips, near_inverse
from .operator import SparseSymmetric
from .over_cores import over_cores
from .pattern import SparsityPattern
from .plan import FactorisationPlan, analyse
from .ridge import Model, ridge_model, ridge_step, solve_definite
from .sparse_cholesky import SparseCholesky

__all__ = [
    "ConjugateGradient",
    "Descent",
    "Factor",
    "FactorisationPlan",
    "KMeans",
    "Minimum",
    "Model",
    "NearInverse",
    "SparseCholesky",
    "SparseSymmetric",
    "SparsityPattern",
    "Strips",
    "analyse",
    "choose_solver",
    "definite_few",
    "factorise",
    "half_solve",
    "hessian_few",
    "in_turn",
    "inverse_few",
    "kmeans",
    "minimise_few",
    "near_inverse",
    "over_cores",
    "quadratic_form",
    "ridge_model",
    "ridge_step",
    "solve",
    "solve_definite",
    "solve_few",
    "symmetric_few",
    "symmetric_inverse",
]
