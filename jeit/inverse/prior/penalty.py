"""Penalties: what an image costs apart from its misfit, as a function of the coefficients it is made of."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jeit.inverse.channels import Data
from jeit_solvers import QuadraticModel, ridge_model
from jeit_solvers.engines import namespace


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

    def model(self, residual, jacobian, coefficients, data):
        """Gauss-Newton's, in the space of data or of coefficients."""
        return ridge_model(residual, jacobian, coefficients, data.covariance, data.precision)


class QuadraticForm(AbstractPenalty):
    """½ cᵀQc with a sparse precision Q: entries `value` (k,) at (`row`, `column`); a unit ridge on further unknowns."""

    row: Int[Array, " k"]
    column: Int[Array, " k"]
    value: Float[Array, " k"]
    size: int = eqx.field(static=True)

    @classmethod
    def create(cls, precision, hyperparameter) -> "QuadraticForm":
        """λ² times a SciPy sparse matrix."""
        entries = precision.tocoo()
        return cls(
            entries.row,
            entries.col,
            float(hyperparameter) ** 2 * entries.data,
            precision.shape[0],
        )

    def cost(self, coefficients):
        """½ cᵀQc."""
        image, rest = coefficients[: self.size], coefficients[self.size :]
        return 0.5 * (jnp.sum(self.value * image[self.row] * image[self.column]) + rest @ rest)

    def diagonal(self, coefficients):
        """Of Q."""
        own = jnp.zeros(self.size).at[self.row].add(jnp.where(self.row == self.column, self.value, 0))
        return jnp.concatenate([own, jnp.ones(coefficients.size - self.size)])

    def model(self, residual, jacobian, coefficients, data):
        """Not for descent along quadratic models: the bounded solvers take gradients. Raises `ValueError`."""
        raise ValueError("A QuadraticForm is minimised by bounded solvers only.")
