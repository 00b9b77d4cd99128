"""Penalties: what an image costs apart from its misfit, as a function of the coefficients it is made of."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.channels import Data
from jeit.inverse.prior.normal import AbstractNormal, StandardNormal
from jeit_solvers import QuadraticModel, ridge_model
from jeit_solvers.engines import namespace

# Added to a precision with a null space, relative to its largest entry, where an inverse need not be exact.
_LITTLE = 1e-6


class AbstractPenalty(eqx.Module):
    """Base of all penalties of coefficients c, those of further unknowns last."""

    @property
    def is_standard_normal(self) -> bool:
        """Whether it takes the coefficients for independent and of unit variance, ½‖c‖²: then the misfit with it is a
        sum of squares, and what the data leave open is near a Gaussian."""
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
        """Diagonal of the penalty's quadratic form at c: what scales a gradient method."""

    @abc.abstractmethod
    def inverse_hessian(self, coefficients: Float[Array, " n"], free, columns: Float[Array, "n k"]) -> Array:
        """About the inverse of the penalty's Hessian at c, of the coefficients that are `free` (n,), times columns that
        are zero for the others: what makes derivatives of a minimum cheap, and need not be exact."""

    def normal(self, coefficients: Float[Array, " n"]) -> AbstractNormal | None:
        """The normal distribution that the penalty stands for near c; None where what data leave open is near none."""
        return None

    @abc.abstractmethod
    def model(self, residual, jacobian, coefficients, data: Data) -> QuadraticModel:
        """The whole cost at c and its `step`, for `jeit_solvers.Descent`."""


class Ridge(AbstractPenalty):
    """½ ‖c‖²: coefficients of unit variance."""

    @property
    def is_standard_normal(self) -> bool:
        """It does."""
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
        """Of Q."""
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
        """Not for descent along quadratic models: the bounded solvers take gradients. Raises `ValueError`."""
        raise ValueError("A QuadraticForm is minimised by bounded solvers only.")
