"""Bases: images as combinations of shapes, x = x₀ + S c, that a prior makes independent and of unit variance.

With covariance Γ = S Sᵀ the prior energy (x - x₀)ᵀ Γ⁻¹ (x - x₀) is ‖c‖². A diagonal S keeps every cell on its own; a
narrow one (a covariance of low rank) keeps the images that the prior allows and leaves out the rest.
"""

from __future__ import annotations

import abc
import functools
import operator
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, Int

from jeit.mesh import Mesh, centroids, measures
from jeit_solvers.engines import gather, host, namespace, sum_into


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

    def restrict_blocks(self, blocks: Iterable[tuple[slice, Any]]) -> Any:
        """Rows (M, m) times S, given some cells after others, in NumPy: an array (M, n) of its own."""
        cells, columns = zip(*blocks, strict=True)
        whole: Any = np.empty((len(columns[0]), cells[-1].stop), columns[0].dtype)
        for where, block in zip(cells, columns, strict=True):
            whole[:, where] = block
        return np.array(self.restrict(whole))

    @abc.abstractmethod
    def variance(self) -> Float[Array, " m"]:
        """Prior variance of every cell: the diagonal of S Sᵀ, and the variance that the shapes leave out."""

    @abc.abstractmethod
    def scaled(self, factor) -> "AbstractBasis":
        """S times a number."""

    @abc.abstractmethod
    def pooled(self, regions: "Regions") -> "AbstractBasis":
        """S with the rows of every region replaced by their mean, and by zero where the image is held fixed."""


class DiagonalBasis(AbstractBasis):
    """Every cell on its own: S = diag(`deviation`), (m,)."""

    deviation: Float[Array, " m"]

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each cell."""
        return self.deviation.shape[0]

    def expand(self, coefficients):
        """Each coefficient times its cell's deviation."""
        return self.deviation * coefficients

    def restrict(self, rows):
        """Columns times the deviations."""
        return rows * self.deviation

    def restrict_blocks(self, blocks):
        """Columns times the deviations."""
        found: list[np.ndarray] = []
        for cells, block in blocks:
            if not found:
                found.append(np.empty((len(block), len(self.deviation)), block.dtype))
            np.multiply(block, self.deviation[cells], out=found[0][:, cells])
        return found[0]

    def variance(self):
        """Squares of the deviations."""
        return self.deviation**2

    def scaled(self, factor):
        """Deviations times a number."""
        return DiagonalBasis(self.deviation * factor)

    def pooled(self, regions):
        """One coefficient for each region, with the mean variance of its cells."""
        return RegionBasis(regions, namespace(regions).sqrt(regions.mean(self.deviation**2)))


class DenseBasis(AbstractBasis):
    """Shapes in the columns of a matrix: S = `shapes` (m, n).

    Products are taken in the shapes' own precision: single, where a millionth does not matter and time does.
    `left_out` (m,): variance of cells that the shapes are known to leave out; none unless given.
    """

    shapes: Float[Array, "m n"]
    left_out: Float[Array, " m"] | None = None

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each shape."""
        return self.shapes.shape[1]

    def expand(self, coefficients):
        """The shapes, weighted and added."""
        return (self.shapes @ coefficients.astype(self.shapes.dtype)).astype(coefficients.dtype)

    def restrict(self, rows):
        """Rows times the matrix."""
        return (rows.astype(self.shapes.dtype) @ self.shapes).astype(rows.dtype)

    def restrict_blocks(self, blocks):
        """Rows times the matrix, added up."""
        total = sum(block.astype(self.shapes.dtype) @ self.shapes[cells] for cells, block in blocks)
        return np.asarray(total, float)

    def variance(self):
        """Sums of the shapes' squares, and what they leave out."""
        xp = namespace(self)
        within = xp.einsum("mn,mn->m", self.shapes, self.shapes)
        return within if self.left_out is None else within + self.left_out

    def scaled(self, factor):
        """The matrix times a number."""
        kind = self.shapes.dtype
        left_out = None if self.left_out is None else self.left_out * factor**2
        return DenseBasis((self.shapes * factor).astype(kind), left_out)

    def pooled(self, regions):
        """Shapes that are constant in every region."""
        return DenseBasis(regions.spread(regions.mean(self.shapes)))


class NodalBasis(AbstractBasis):
    """One coefficient for each node, of which a cell has the mean: S c of P1 functions c at the cells' centres.

    **Fields**: `cells` (m, k) of the mesh; `number` of its nodes.
    """

    cells: Int[Array, "m k"]
    number: int = eqx.field(static=True)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each node."""
        return self.number

    def expand(self, coefficients):
        """Means over the cells' nodes."""
        return gather(coefficients, self.cells).mean(axis=1)

    def restrict(self, rows):
        """Columns, in equal parts, to the cells' nodes."""
        parts = rows.T / self.cells.shape[1]
        shape = self.number, len(rows)
        corners = [sum_into(shape, self.cells[:, k], parts) for k in range(self.cells.shape[1])]
        return functools.reduce(operator.add, corners).T

    def restrict_blocks(self, blocks):
        """As `restrict`, for rows given block by block."""
        total: Any = np.zeros(0)
        count = self.cells.shape[1]
        for cells, block in blocks:
            total = total if total.size else np.zeros((self.number, len(block)), block.dtype)
            nodes, corners = np.unique(np.asarray(self.cells[cells]), return_inverse=True)
            ends = np.arange(0, corners.size + 1, count)
            shape = len(ends) - 1, len(nodes)
            means = scipy.sparse.csr_array((np.full(corners.size, 1 / count), corners.ravel(), ends), shape=shape)
            total[nodes] += means.T @ block.T
        return np.ascontiguousarray(total.T)

    def variance(self):
        """Variance of cells as means of independent nodes."""
        return namespace(self).full(len(self.cells), 1 / self.cells.shape[1])

    def scaled(self, factor):
        """Not available: nodes have no scale of their own. Raises `ValueError`."""
        raise ValueError("A basis of nodes has no scale; weigh the penalty.")

    def pooled(self, regions):
        """Not available. Raises `ValueError`."""
        raise ValueError("regions: images of nodes have none; leave them out.")


class Regions(eqx.Module):
    """Cells that share one value: pixels of a grid, the layers of a skin; and cells whose value is known.

    **Fields**: `label` (m,), the region of every cell from 0, or -1 where the image is held at the background;
    `measure` (m,), the cells' area (3-D: volume); `number` of regions.
    """

    label: Int[Array, " m"]
    measure: Float[Array, " m"]
    number: int = eqx.field(static=True)

    @classmethod
    def create(cls, mesh: Mesh, label) -> "Regions":
        """Raises `ValueError` for labels that are not one integer for each cell, from -1 with none left out."""
        label = np.asarray(label)
        number = int(label.max(initial=-1)) + 1
        if label.shape != (mesh.num_cells,) or label.dtype.kind not in "iu" or number == 0 or label.min() < -1:
            raise ValueError(
                f"regions must be integers, one for each of the {mesh.num_cells} cells: from 0, or -1 for cells held "
                f"at the background; got {label.dtype} of shape {label.shape}."
            )
        if number > len(label):
            raise ValueError(f"regions: the label {number - 1} is more than there are cells; use all from 0.")
        empty = np.setdiff1d(np.arange(number), label)
        if empty.size:
            raise ValueError(f"regions: no cell has the label {empty[0]}; use all from 0 to {number - 1}.")
        return cls(host.array(label), host.asarray(measures(mesh)), number)  # a copy: labels are the user's

    def total(self, values: Float[Array, "m *k"]) -> Float[Array, "p *k"]:
        """Sums of cells' values over every region."""
        where = namespace(self.label).where(self.label < 0, self.number, self.label)
        return sum_into((self.number + 1, *values.shape[1:]), where, values)[:-1]

    def mean(self, values: Float[Array, "m *k"]) -> Float[Array, "p *k"]:
        """Means over every region, weighted by area."""
        xp = namespace(self, values)
        total = self.spread(self.total(self.measure))  # zero where the image is held fixed
        weight = xp.where(self.label < 0, 0, self.measure / xp.where(self.label < 0, 1, total))
        return self.total(values * xp.expand_dims(weight, tuple(range(1, values.ndim))))

    def spread(self, values: Float[Array, "p *k"]) -> Float[Array, "m *k"]:
        """Regions' values at the cells, zero where the image is held fixed."""
        xp = namespace(self, values)
        fixed = xp.expand_dims(self.label < 0, tuple(range(1, values.ndim)))
        return xp.where(fixed, 0, values[xp.maximum(self.label, 0)])


def pixels(mesh: Mesh, shape: tuple[int, int]) -> Int[np.ndarray, " m"]:
    """Labels for `Regions`: the pixels of a grid (rows, columns) over the mesh that hold the centre of any cell.

    Raises `ValueError` for a shape that is not two whole numbers from 1.
    """
    sides = np.asarray(shape)
    if sides.shape != (2,) or sides.dtype.kind not in "iu" or sides.min() < 1:
        raise ValueError(f"shape must be (rows, columns), both whole numbers from 1; it is {shape}.")
    centre = np.asarray(centroids(mesh))[:, :2]
    low, high = centre.min(axis=0), centre.max(axis=0)
    place = np.minimum((centre - low) / (high - low) * [shape[1], shape[0]], np.array([shape[1], shape[0]]) - 1)
    number = place.astype(int) @ [1, shape[1]]
    return np.unique(number, return_inverse=True)[1]


class RegionBasis(AbstractBasis):
    """One value for each region: S c is `deviation` (p,) times c, at all cells of the region."""

    regions: Regions
    deviation: Float[Array, " p"]

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each region."""
        return self.regions.number

    def expand(self, coefficients):
        """Each region's value at its cells."""
        return self.regions.spread(self.deviation * coefficients)

    def restrict(self, rows):
        """Columns added up over every region."""
        return self.regions.total(rows.T).T * self.deviation

    def variance(self):
        """Squares of the regions' deviations."""
        return self.regions.spread(self.deviation**2)

    def scaled(self, factor):
        """Deviations times a number."""
        return RegionBasis(self.regions, self.deviation * factor)

    def pooled(self, regions):
        """Not available twice. Raises `ValueError`."""
        raise ValueError("This basis has regions already.")
