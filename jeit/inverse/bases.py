"""Bases: images as combinations of shapes, x = x₀ + S c, that a prior makes independent and of unit variance.

With covariance Γ = S Sᵀ the prior energy (x - x₀)ᵀ Γ⁻¹ (x - x₀) is ‖c‖². A diagonal S keeps every cell on its own; a
narrow one (a covariance of low rank) keeps what the prior holds possible and leaves out the rest.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float


class AbstractBasis(eqx.Module):
    """Base of all bases S (m, n)."""

    @property
    @abc.abstractmethod
    def num_coefficients(self) -> int:
        """Number of coefficients n."""

    @abc.abstractmethod
    def expand(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """S c."""

    @abc.abstractmethod
    def restrict(self, rows: Float[Array, "M m"]) -> Float[Array, "M n"]:
        """Rows times S."""

    @abc.abstractmethod
    def scaled(self, factor) -> "AbstractBasis":
        """S times a number."""


class DiagonalBasis(AbstractBasis):
    """Every cell on its own: S = diag(`deviation`), (m,)."""

    deviation: Float[Array, " m"]

    @property
    def num_coefficients(self) -> int:
        """One for each cell."""
        return self.deviation.shape[0]

    def expand(self, coefficients):
        """Each coefficient times its cell's deviation."""
        return self.deviation * coefficients

    def restrict(self, rows):
        """Columns times the deviations."""
        return rows * self.deviation

    def scaled(self, factor):
        """Deviations times a number."""
        return DiagonalBasis(self.deviation * factor)


class DenseBasis(AbstractBasis):
    """Shapes in the columns of a matrix: S = `shapes` (m, n)."""

    shapes: Float[Array, "m n"]

    @property
    def num_coefficients(self) -> int:
        """One for each shape."""
        return self.shapes.shape[1]

    def expand(self, coefficients):
        """The shapes, weighted and added."""
        return self.shapes @ coefficients

    def restrict(self, rows):
        """Rows times the matrix."""
        return rows @ self.shapes

    def scaled(self, factor):
        """The matrix times a number."""
        return DenseBasis(self.shapes * factor)


def pivoted_cholesky(
    diagonal: np.ndarray, column: Callable[[int], np.ndarray], *, tolerance: float, max_rank: int
) -> np.ndarray:
    """S (m, n) with Γ ≈ S Sᵀ, for a covariance Γ given by its diagonal (m,) and a function that returns a column.

    One column after the other, where the diagonal of Γ - S Sᵀ is largest, until its sum is below `tolerance` times
    that of Γ. Harbrecht, Peters and Schneider, Appl. Numer. Math. 62 (2012) 428-440.
    """
    left = np.array(diagonal, float)
    enough = tolerance * left.sum()
    shapes = np.zeros((min(max_rank, left.size), left.size))
    for rank in range(shapes.shape[0]):
        if left.sum() <= enough:
            return shapes[:rank].T
        pivot = int(np.argmax(left))
        row = column(pivot) - shapes[:rank, pivot] @ shapes[:rank]
        shapes[rank] = row / np.sqrt(left[pivot])
        left = np.maximum(left - shapes[rank] ** 2, 0)
        left[pivot] = 0
    return shapes.T
