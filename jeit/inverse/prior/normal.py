"""Normal distributions of coefficients, as penalties are near them: what samples, and variances before the data, need.

A penalty that is, or from above touches, ½ cᵀQc up to what is linear in c stands for a normal distribution of precision
Q. Its covariance Q⁻¹ is never there as a matrix.
"""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jeit.inverse.prior.bases import AbstractBasis, DiagonalBasis, NodalBasis
from jeit.inverse.prior.nodal import in_columns
from jeit_solvers import Factor, FactorisationPlan, SparsityPattern, inverse_entries, inverse_root, solve
from jeit_solvers.engines import host, namespace


class AbstractNormal(eqx.Module):
    """Base of normal distributions of coefficients c (n,), those of further unknowns last."""

    @abc.abstractmethod
    def covariance_product(self, columns: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """Q⁻¹ times columns."""

    @abc.abstractmethod
    def variance(self, basis: AbstractBasis) -> Float[Array, " m"]:
        """Of the image's cells: the diagonal of S Q⁻¹ Sᵀ, and of what the shapes leave out."""

    @abc.abstractmethod
    def num_draws(self, num_coefficients: int) -> int:
        """How many independent standard normal numbers a sample of n coefficients is made of."""

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
        """One for each coefficient."""
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
        """By sparse solves."""
        size = self.plan.size
        solved = in_columns(solve, self.plan, self.factor, columns[:size])
        return namespace(columns, solved).concatenate([solved, columns[size:]])

    def variance(self, basis):
        """From the entries of Q⁻¹ between neighbours, which are all that cells, and means over their nodes, take."""
        entries = inverse_entries(self.plan, self.factor)
        if isinstance(basis, DiagonalBasis):
            return basis.deviation**2 * entries[: self.plan.size]
        assert isinstance(basis, NodalBasis)
        between, (row, column) = self.pattern.entries_between(entries), np.tril_indices(basis.cells.shape[1])
        return host.where(row == column, 1.0, 2.0) @ between / basis.cells.shape[1] ** 2

    def num_draws(self, num_coefficients):
        """One for each pivot of the factor, padding included, and for each of the rest."""
        return num_coefficients - self.plan.size + self.plan.num_pivots

    def drawn(self, numbers):
        """By half a solve."""
        number = self.plan.num_pivots
        image = inverse_root(self.plan, self.factor, numbers[:number])
        return namespace(numbers, image).concatenate([image, numbers[number:]])
