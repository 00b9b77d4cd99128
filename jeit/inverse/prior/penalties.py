"""Penalties of coefficients, which nonlinear images minimise together with the misfit, and their normal distributions.

A penalty that is, or from above touches, ½ cᵀQc up to what is linear in c stands for a normal distribution of precision
Q. Its covariance Q⁻¹ is never there as a matrix.
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
from jeit.inverse.prior.nodal import in_columns
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    QuadraticModel,
    SparsityPattern,
    inverse_entries,
    inverse_root,
    ridge_model,
    solve,
)
from jeit_solvers.engines import host, namespace

# Added to a precision with a null space, relative to its largest entry, where an inverse need not be exact.
_LITTLE = 1e-6


class AbstractPenalty(eqx.Module):
    """Base of all penalties of coefficients c, those of further unknowns last."""

    @property
    def is_standard_normal(self) -> bool:
        """Whether the coefficients are independent and of unit variance, ½‖c‖²: then the objective is a sum of squares,
        and the posterior is nearly Gaussian."""
        return False

    @property
    def tolerance(self) -> float:
        """Relative change of the objective that ends a descent, unless another is given."""
        return 1e-6

    @abc.abstractmethod
    def cost(self, coefficients: Float[Array, " n"]) -> Float[Array, ""]:
        """The penalty, dimensionless."""

    @abc.abstractmethod
    def diagonal(self, coefficients: Float[Array, " n"]) -> Float[Array, " n"]:
        """Diagonal of the penalty's quadratic form at c, which scales a gradient method."""

    @abc.abstractmethod
    def inverse_hessian(self, coefficients: Float[Array, " n"], free, columns: Float[Array, "n k"]) -> Array:
        """Approximate inverse of the penalty's Hessian at c, of the coefficients that are `free` (n,), times columns
        that are zero for the others. It preconditions the derivatives of a minimum, and need not be exact."""

    def normal(self, coefficients: Float[Array, " n"]) -> AbstractNormal | None:
        """The normal distribution that the penalty stands for near c; None where the posterior is not nearly
        Gaussian."""
        return None

    @abc.abstractmethod
    def model(self, residual, jacobian, coefficients, data: Data) -> QuadraticModel:
        """The whole cost at c and its `step`, for `jeit_solvers.Descent`."""


class Ridge(AbstractPenalty):
    """½ ‖c‖²: coefficients of unit variance."""

    @property
    def is_standard_normal(self) -> bool:
        """True."""
        return True

    def cost(self, coefficients):
        """½ ‖c‖²."""
        return 0.5 * coefficients @ coefficients

    def diagonal(self, coefficients):
        """Ones."""
        return namespace(coefficients).ones_like(coefficients)

    def inverse_hessian(self, coefficients, free, columns):
        """The columns themselves."""
        return columns

    def normal(self, coefficients):
        """The standard one."""
        return StandardNormal()

    def model(self, residual, jacobian, coefficients, data):
        """Gauss-Newton's, in the space of data or of coefficients."""
        return ridge_model(residual, jacobian, coefficients, data.covariance, data.precision)


class QuadraticForm(AbstractPenalty):
    """½ cᵀQc with a sparse precision Q: entries `value` (k,) at (`row`, `column`); a unit ridge on further unknowns."""

    row: Int[Array, " k"]
    column: Int[Array, " k"]
    value: Float[Array, " k"]
    size: int = eqx.field(static=True)
    is_diagonal: bool = eqx.field(static=True)

    @classmethod
    def create(cls, row, column, value, hyperparameter, size: int) -> "QuadraticForm":
        """λ² times a matrix of these entries."""
        is_diagonal = len(row) == size and np.array_equal(row, column)
        return cls(row, column, hyperparameter**2 * value, size, bool(is_diagonal))

    def cost(self, coefficients):
        """½ cᵀQc."""
        image, rest = coefficients[: self.size], coefficients[self.size :]
        return 0.5 * (jnp.sum(self.value * image[self.row] * image[self.column]) + rest @ rest)

    def diagonal(self, coefficients):
        """Diagonal of Q."""
        own = jnp.zeros(self.size).at[self.row].add(jnp.where(self.row == self.column, self.value, 0))
        return jnp.concatenate([own, jnp.ones(coefficients.size - self.size)])

    def inverse_hessian(self, coefficients, free, columns):
        """(Q + a little)⁻¹, dense unless Q is diagonal."""
        image, rest = columns[: self.size], columns[self.size :]
        if self.is_diagonal:
            return jnp.concatenate([image / self.value[:, None], rest])
        mine = free[: self.size]
        entry = jnp.where(mine[self.row] & mine[self.column], self.value, 0)
        dense = jnp.zeros((self.size, self.size)).at[self.row, self.column].add(entry)
        scale = jnp.max(jnp.abs(self.value))
        dense = dense + jnp.diag(jnp.where(mine, _LITTLE * scale, scale))
        solved = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(dense), image)
        return jnp.concatenate([jnp.where(mine[:, None], solved, 0), rest])

    def model(self, residual, jacobian, coefficients, data):
        """Not available: the bounded solvers use gradients, not quadratic models. Raises `ValueError`."""
        raise ValueError("A QuadraticForm is minimised by bounded solvers only.")


class AbstractNormal(eqx.Module):
    """Base of normal distributions of coefficients c (n,), those of further unknowns last."""

    @abc.abstractmethod
    def covariance_product(self, columns: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """Q⁻¹ times columns."""

    @abc.abstractmethod
    def variance(self, basis: AbstractBasis) -> Float[Array, " m"]:
        """Variance of the image's cells: the diagonal of S Q⁻¹ Sᵀ, and the variance that the shapes leave out."""

    @abc.abstractmethod
    def num_draws(self, num_coefficients: int) -> int:
        """Number of independent standard normal numbers that make a sample of n coefficients."""

    @abc.abstractmethod
    def drawn(self, numbers: Float[Array, "d k"]) -> Float[Array, "n k"]:
        """Samples, less their mean, made of `num_draws` standard normal numbers each."""


class StandardNormal(AbstractNormal):
    """Independent coefficients of unit variance, Q = 1."""

    def covariance_product(self, columns):
        """The columns themselves."""
        return columns

    def variance(self, basis):
        """The basis'."""
        return basis.variance()

    def num_draws(self, num_coefficients):
        """Number of draws: one for each coefficient."""
        return num_coefficients

    def drawn(self, numbers):
        """The numbers themselves."""
        return numbers


class SparseNormal(AbstractNormal):
    """A sparse Q, factorised, of the first coefficients, those of cells or nodes; the rest are standard normal."""

    pattern: SparsityPattern
    plan: FactorisationPlan
    factor: Factor

    def covariance_product(self, columns):
        """Q⁻¹ times columns, by sparse solves."""
        size = self.plan.size
        solved = in_columns(solve, self.plan, self.factor, columns[:size])
        return namespace(columns, solved).concatenate([solved, columns[size:]])

    def variance(self, basis):
        """Variance from the entries of Q⁻¹ between neighbours, which suffice for cells, and for means over their
        nodes."""
        entries = inverse_entries(self.plan, self.factor)
        if isinstance(basis, DiagonalBasis):
            return basis.deviation**2 * entries[: self.plan.size]
        assert isinstance(basis, NodalBasis)
        between, (row, column) = self.pattern.entries_between(entries), np.tril_indices(basis.cells.shape[1])
        return host.where(row == column, 1.0, 2.0) @ between / basis.cells.shape[1] ** 2

    def num_draws(self, num_coefficients):
        """Number of draws: one for each pivot of the factor, padding included, and for each of the rest."""
        return num_coefficients - self.plan.size + self.plan.num_pivots

    def drawn(self, numbers):
        """Samples by half a solve."""
        number = self.plan.num_pivots
        image = inverse_root(self.plan, self.factor, numbers[:number])
        return namespace(numbers, image).concatenate([image, numbers[number:]])
