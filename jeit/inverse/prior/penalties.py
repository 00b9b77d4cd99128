"""Penalties of coefficients, minimised together with the data misfit, and the normal distributions they correspond to.

A penalty ½ cᵀQc, up to terms linear in c, corresponds to a normal distribution of precision Q. A penalty that is not
quadratic is replaced by the quadratic form that touches the penalty from above. The covariance Q⁻¹ is never formed as a
matrix.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.channels import Data
from jeit.inverse.prior.bases import AbstractBasis, DiagonalBasis, NodalBasis
from jeit.inverse.prior.linear_algebra import solve_columns
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    QuadraticModel,
    SparsityPattern,
    inverse_entries,
    inverse_root,
    ridge_model,
)
from jeit_solvers.engines import host, namespace
from jeit_solvers.module import Module

# Multiple of the identity, relative to the largest entry, added to a precision matrix with a null space before its
# approximate inversion.
_DIAGONAL_SHIFT = 1e-6


class AbstractPenalty(Module):
    """Base of all penalties of coefficients c; the coefficients of further unknowns come last."""

    @property
    def is_standard_normal(self) -> bool:
        """Whether the penalty is ½‖c‖², so that the coefficients are independent with unit variance, the objective is a
        sum of squares and the posterior is nearly Gaussian."""
        return False

    @property
    def descent_tolerance(self) -> float:
        """Default tolerance: relative change of the objective that ends a descent."""
        return 1e-6

    @abc.abstractmethod
    def cost(self, coefficients: Float[Array, " n"]) -> Float[Array, ""]:
        """Value of the penalty at c, dimensionless."""

    @abc.abstractmethod
    def diagonal(self, coefficients: Float[Array, " n"]) -> Float[Array, " n"]:
        """Diagonal of the penalty's quadratic form at c, which scales gradient methods."""

    @abc.abstractmethod
    def inverse_hessian(self, coefficients: Float[Array, " n"], free, columns: Float[Array, "n k"]) -> Array:
        """Approximate inverse of the penalty's Hessian at c, restricted to the coefficients marked in `free` (n,),
        times `columns` that are zero for all other coefficients. This inverse preconditions the computation of a
        minimum's derivatives."""

    def normal(self, coefficients: Float[Array, " n"]) -> AbstractNormal | None:
        """Normal distribution that corresponds to the penalty near c; None if the posterior is not nearly Gaussian."""
        return None

    @abc.abstractmethod
    def model(self, residual, jacobian, coefficients, data: Data) -> QuadraticModel:
        """Objective at c (data misfit plus penalty) and the function that computes a step, for
        `jeit_solvers.Descent`."""


class Ridge(AbstractPenalty):
    """Ridge penalty ½ ‖c‖², for independent coefficients of unit variance."""

    @property
    def is_standard_normal(self) -> bool:
        """True: the penalty is ½‖c‖²."""
        return True

    def cost(self, coefficients):
        """Value ½ ‖c‖² of the penalty."""
        return 0.5 * coefficients @ coefficients

    def diagonal(self, coefficients):
        """Ones, the diagonal of the identity."""
        return namespace(coefficients).ones_like(coefficients)

    def inverse_hessian(self, coefficients, free, columns):
        """The `columns` themselves, as the matrix is the identity."""
        return columns

    def normal(self, coefficients):
        """Standard normal distribution."""
        return StandardNormal()

    def model(self, residual, jacobian, coefficients, data):
        """Objective and the function that computes a Gauss-Newton step, in data space or coefficient space."""
        return ridge_model(residual, jacobian, coefficients, data.covariance, data.precision)


class QuadraticForm(AbstractPenalty):
    """Penalty ½ cᵀQc with sparse precision Q, whose entries at (`row`, `column`) are `value` (k,); further unknowns
    have the penalty ½ ‖c‖²."""

    row: Int[Array, " k"]
    column: Int[Array, " k"]
    value: Float[Array, " k"]
    size: int = eqx.field(static=True)
    is_diagonal: bool = eqx.field(static=True)

    @classmethod
    def create(cls, row, column, value, hyperparameter, size: int) -> "QuadraticForm":
        """Create the penalty with Q = λ² times the matrix with these entries, for λ = `hyperparameter`."""
        is_diagonal = len(row) == size and np.array_equal(row, column)
        return cls(row, column, hyperparameter**2 * value, size, bool(is_diagonal))

    def cost(self, coefficients):
        """Value ½ cᵀQc of the penalty."""
        image, unknowns = coefficients[: self.size], coefficients[self.size :]
        return 0.5 * (jnp.sum(self.value * image[self.row] * image[self.column]) + unknowns @ unknowns)

    def diagonal(self, coefficients):
        """Diagonal of the precision matrix Q."""
        diagonal = jnp.zeros(self.size).at[self.row].add(jnp.where(self.row == self.column, self.value, 0))
        return jnp.concatenate([diagonal, jnp.ones(coefficients.size - self.size)])

    def inverse_hessian(self, coefficients, free, columns):
        """Inverse of Q plus a small multiple of the identity, times `columns`; computed as a dense matrix unless Q is
        diagonal."""
        image_columns, unknown_columns = columns[: self.size], columns[self.size :]
        if self.is_diagonal:
            return jnp.concatenate([image_columns / self.value[:, None], unknown_columns])
        is_free_cell = free[: self.size]
        free_entries = jnp.where(is_free_cell[self.row] & is_free_cell[self.column], self.value, 0)
        dense_hessian = jnp.zeros((self.size, self.size)).at[self.row, self.column].add(free_entries)
        largest_entry = jnp.max(jnp.abs(self.value))
        dense_hessian = dense_hessian + jnp.diag(
            jnp.where(is_free_cell, _DIAGONAL_SHIFT * largest_entry, largest_entry)
        )
        solved_columns = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(dense_hessian), image_columns)
        return jnp.concatenate([jnp.where(is_free_cell[:, None], solved_columns, 0), unknown_columns])

    def model(self, residual, jacobian, coefficients, data):
        """Not available: the bounded solvers use gradients, not quadratic models. Raises `ValueError`."""
        raise ValueError("A QuadraticForm is minimised by bounded solvers only.")


class AbstractNormal(Module):
    """Base class of normal distributions, with precision Q, of coefficients c (n,); the coefficients of unknowns other
    than the image come last."""

    @abc.abstractmethod
    def covariance_product(self, columns: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """Covariance Q⁻¹ times `columns`."""

    @abc.abstractmethod
    def variance(self, basis: AbstractBasis) -> Float[Array, " m"]:
        """Variance of the image in every cell: the diagonal of S Q⁻¹ Sᵀ for the `basis` S, plus the variance that the
        basis leaves out."""

    @abc.abstractmethod
    def num_draws(self, num_coefficients: int) -> int:
        """Number of independent standard normal numbers needed to draw a sample of n coefficients."""

    @abc.abstractmethod
    def draw_samples(self, numbers: Float[Array, "d k"]) -> Float[Array, "n k"]:
        """Samples (n, k) of mean zero, computed from standard normal `numbers` with d = `num_draws`."""


class StandardNormal(AbstractNormal):
    """Standard normal distribution, Q = I."""

    def covariance_product(self, columns):
        """The `columns` themselves, as the matrix is the identity."""
        return columns

    def variance(self, basis):
        """Variance of the image: the prior variance of the basis."""
        return basis.variance()

    def num_draws(self, num_coefficients):
        """Number of random numbers per sample: one for each coefficient."""
        return num_coefficients

    def draw_samples(self, numbers):
        """Samples: the `numbers` themselves."""
        return numbers


class SparsePrecisionNormal(AbstractNormal):
    """Normal distribution with a sparse, factorised precision Q for the coefficients of cells or nodes, which come
    first; further unknowns are standard normal."""

    pattern: SparsityPattern
    plan: FactorisationPlan
    factor: Factor

    def covariance_product(self, columns):
        """Q⁻¹ times `columns`, by sparse solves."""
        num_image_coefficients = self.plan.size
        image_columns = solve_columns(self.plan, self.factor, columns[:num_image_coefficients])
        return namespace(columns, image_columns).concatenate([image_columns, columns[num_image_coefficients:]])

    def variance(self, basis):
        """Variance of the cells, from those entries of Q⁻¹ that lie in the sparsity pattern of Q."""
        covariance_entries = inverse_entries(self.plan, self.factor)
        if isinstance(basis, DiagonalBasis):
            return basis.deviation**2 * covariance_entries[: self.plan.size]
        assert isinstance(basis, NodalBasis)
        block_entries, (row, column) = (
            self.pattern.entries_between(covariance_entries),
            np.tril_indices(basis.cells.shape[1]),
        )
        return host.where(row == column, 1.0, 2.0) @ block_entries / basis.cells.shape[1] ** 2

    def num_draws(self, num_coefficients):
        """Number of random numbers per sample: one for each pivot of the factor, padding included, and one for each
        further unknown."""
        return num_coefficients - self.plan.size + self.plan.num_pivots

    def draw_samples(self, numbers):
        """Samples, computed with a triangular factor of Q."""
        num_pivots = self.plan.num_pivots
        image = inverse_root(self.plan, self.factor, numbers[:num_pivots])
        return namespace(numbers, image).concatenate([image, numbers[num_pivots:]])
