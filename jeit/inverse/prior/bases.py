"""Bases S of images x = x₀ + S c, whose coefficients c are independent with unit variance under a prior.

With prior covariance Γ = S Sᵀ, the prior energy (x - x₀)ᵀ Γ⁻¹ (x - x₀) is ‖c‖². The columns of S are called shapes. A
diagonal S has one independent coefficient per cell; an S with few columns approximates Γ by a low-rank matrix.
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
from jeit_solvers.module import Module


class AbstractBasis(Module):
    """Base of all bases S (m, n) of images."""

    @property
    @abc.abstractmethod
    def num_coefficients(self) -> int:
        """Number of coefficients n."""

    @abc.abstractmethod
    def expand(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """Image change S c (m,) for coefficients c."""

    @abc.abstractmethod
    def restrict(self, rows: Float[Array, "M m"]) -> Float[Array, "M n"]:
        """Product of `rows`, such as a Jacobian (M, m), with S."""

    def restrict_blocks(self, blocks: Iterable[tuple[slice, Any]]) -> Any:
        """Product with S, as a new NumPy array (M, n), of rows (M, m) that are passed as blocks of consecutive
        cells."""
        cell_slices, column_blocks = zip(*blocks, strict=True)
        restricted_rows: Any = np.empty((len(column_blocks[0]), cell_slices[-1].stop), column_blocks[0].dtype)
        for block_cells, column_block in zip(cell_slices, column_blocks, strict=True):
            restricted_rows[:, block_cells] = column_block
        return np.array(self.restrict(restricted_rows))

    @abc.abstractmethod
    def variance(self) -> Float[Array, " m"]:
        """Prior variance of every cell: the diagonal of S Sᵀ plus the variance that the shapes leave out."""

    @abc.abstractmethod
    def scaled(self, factor) -> "AbstractBasis":
        """Basis in which S is multiplied by the number `factor`."""

    @abc.abstractmethod
    def pooled(self, regions: "Regions") -> "AbstractBasis":
        """Basis in which the rows of S are replaced by their mean over each region, and by zero in cells that are fixed
        at the background."""


class DiagonalBasis(AbstractBasis):
    """Diagonal basis S = diag(`deviation`), with one coefficient per cell and `deviation` (m,)."""

    deviation: Float[Array, " m"]

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each cell."""
        return self.deviation.shape[0]

    def expand(self, coefficients):
        """S c: each coefficient multiplied by the prior standard deviation of its cell."""
        return self.deviation * coefficients

    def restrict(self, rows):
        """Rows times S: each column multiplied by the prior standard deviation of its cell."""
        return rows * self.deviation

    def restrict_blocks(self, blocks):
        """Rows times S: each column multiplied by the prior standard deviation of its cell."""
        scaled_blocks: list[np.ndarray] = []
        for cells, column_block in blocks:
            if not scaled_blocks:
                scaled_blocks.append(np.empty((len(column_block), len(self.deviation)), column_block.dtype))
            np.multiply(column_block, self.deviation[cells], out=scaled_blocks[0][:, cells])
        return scaled_blocks[0]

    def variance(self):
        """Variance of the cells: squared prior standard deviations."""
        return self.deviation**2

    def scaled(self, factor):
        """Basis with the deviations multiplied by `factor`."""
        return DiagonalBasis(self.deviation * factor)

    def pooled(self, regions):
        """Basis with one coefficient per region, whose variance is the mean variance of the cells of the region."""
        return RegionBasis(regions, namespace(regions).sqrt(regions.mean(self.deviation**2)))


class DenseBasis(AbstractBasis):
    """Basis whose shapes are the columns of a dense matrix, S = `shapes` (m, n).

    Products are computed in the precision of `shapes`, which may be single.

    **Arguments:**

    - `shapes`: (m, n), a shape in each column, in the unit of the image.
    - `left_out`: (m,), the part of each cell's prior variance that the shapes do not represent, or None.

    **Example:**

    ```python
    basis = DenseBasis(np.linalg.cholesky(np.eye(40)))
    image = basis.expand(np.ones(40))
    ```
    """

    shapes: Float[Array, "m n"]
    left_out: Float[Array, " m"] | None = None

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each shape."""
        return self.shapes.shape[1]

    def expand(self, coefficients):
        """Sum of the shapes weighted with the coefficients."""
        return (self.shapes @ coefficients.astype(self.shapes.dtype)).astype(coefficients.dtype)

    def restrict(self, rows):
        """Product of `rows` with the shapes."""
        return (rows.astype(self.shapes.dtype) @ self.shapes).astype(rows.dtype)

    def restrict_blocks(self, blocks):
        """Product of rows with the shapes, summed over blocks of cells."""
        restricted_rows = sum(
            column_block.astype(self.shapes.dtype) @ self.shapes[cells] for cells, column_block in blocks
        )
        return np.asarray(restricted_rows, float)

    def variance(self):
        """Variance of the cells: sum of the squared shapes, plus the variance left out."""
        xp = namespace(self)
        shape_variance = xp.einsum("mn,mn->m", self.shapes, self.shapes)
        return shape_variance if self.left_out is None else shape_variance + self.left_out

    def scaled(self, factor):
        """Basis with the shapes multiplied by `factor`."""
        number_type = self.shapes.dtype
        scaled_left_out = None if self.left_out is None else self.left_out * factor**2
        return DenseBasis((self.shapes * factor).astype(number_type), scaled_left_out)

    def pooled(self, regions):
        """Basis of the shapes averaged over every region."""
        return DenseBasis(regions.spread(regions.mean(self.shapes)))


class NodalBasis(AbstractBasis):
    """Basis with one coefficient per node; a cell has the mean of its nodal values, which is the value at the cell's
    centre of the piecewise linear function with these nodal values.

    **Fields**: `cells` (m, k): nodes of the mesh's cells; `number`: number of nodes.
    """

    cells: Int[Array, "m k"]
    number: int = eqx.field(static=True)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each node."""
        return self.number

    def expand(self, coefficients):
        """Mean of the coefficients over the nodes of each cell."""
        return gather(coefficients, self.cells).mean(axis=1)

    def restrict(self, rows):
        """Rows times S: each column is distributed in equal parts over the nodes of its cell."""
        corner_values = rows.T / self.cells.shape[1]
        nodal_shape = self.number, len(rows)
        corner_sums = [
            sum_into(nodal_shape, self.cells[:, corner], corner_values) for corner in range(self.cells.shape[1])
        ]
        return functools.reduce(operator.add, corner_sums).T

    def restrict_blocks(self, blocks):
        """Rows times S, for rows that are passed as blocks of cells."""
        restricted_rows: Any = np.zeros(0)
        nodes_per_cell = self.cells.shape[1]
        for cells, column_block in blocks:
            restricted_rows = (
                restricted_rows
                if restricted_rows.size
                else np.zeros((self.number, len(column_block)), column_block.dtype)
            )
            nodes, corner_nodes = np.unique(np.asarray(self.cells[cells]), return_inverse=True)
            row_starts = np.arange(0, corner_nodes.size + 1, nodes_per_cell)
            matrix_shape = len(row_starts) - 1, len(nodes)
            mean_matrix = scipy.sparse.csr_array(
                (np.full(corner_nodes.size, 1 / nodes_per_cell), corner_nodes.ravel(), row_starts), shape=matrix_shape
            )
            restricted_rows[nodes] += mean_matrix.T @ column_block.T
        return np.ascontiguousarray(restricted_rows.T)

    def variance(self):
        """Variance of the cells, where each cell has the mean of independent nodal values of unit variance."""
        return namespace(self).full(len(self.cells), 1 / self.cells.shape[1])

    def scaled(self, factor):
        """Not available for nodal bases. Raises `ValueError`."""
        raise ValueError("A basis of nodes has no scale; weigh the penalty.")

    def pooled(self, regions):
        """Not available for nodal bases. Raises `ValueError`."""
        raise ValueError("regions: images of nodes have none; leave them out.")


class Regions(Module):
    """Regions of cells that share one value, such as pixels of a grid or layers of a skin.

    **Fields**: `label` (m,): number of each cell's region, from 0, or -1 if the cell is fixed at the background;
    `measure` (m,): area (3-D: volume) of the cells; `number`: number of regions.
    """

    label: Int[Array, " m"]
    measure: Float[Array, " m"]
    number: int = eqx.field(static=True)

    @classmethod
    def create(cls, mesh: Mesh, label) -> "Regions":
        """Create the regions of a mesh from labels of the cells.

        Raises `ValueError` unless `label` has one integer per cell, from -1, and uses all numbers from 0 to the
        largest.
        """
        label = np.asarray(label)
        num_regions = int(label.max(initial=-1)) + 1
        if label.shape != (mesh.num_cells,) or label.dtype.kind not in "iu" or num_regions == 0 or label.min() < -1:
            raise ValueError(
                f"regions must be integers, one for each of the {mesh.num_cells} cells: from 0, or -1 for cells held "
                f"at the background; got {label.dtype} of shape {label.shape}."
            )
        if num_regions > len(label):
            raise ValueError(f"regions: the label {num_regions - 1} is more than there are cells; use all from 0.")
        empty_regions = np.setdiff1d(np.arange(num_regions), label)
        if empty_regions.size:
            raise ValueError(f"regions: no cell has the label {empty_regions[0]}; use all from 0 to {num_regions - 1}.")
        return cls(
            host.array(label), host.asarray(measures(mesh)), num_regions
        )  # copied, so that the user's array can change

    def total(self, values: Float[Array, "m *k"]) -> Float[Array, "p *k"]:
        """Sum of the cells' values over each region."""
        target_regions = namespace(self.label).where(self.label < 0, self.number, self.label)
        return sum_into((self.number + 1, *values.shape[1:]), target_regions, values)[:-1]

    def mean(self, values: Float[Array, "m *k"]) -> Float[Array, "p *k"]:
        """Mean of the cells' values over each region, weighted by area (3-D: volume)."""
        xp = namespace(self, values)
        region_measures = self.spread(self.total(self.measure))  # zero in cells that are fixed at the background
        cell_weights = xp.where(self.label < 0, 0, self.measure / xp.where(self.label < 0, 1, region_measures))
        return self.total(values * xp.expand_dims(cell_weights, tuple(range(1, values.ndim))))

    def spread(self, values: Float[Array, "p *k"]) -> Float[Array, "m *k"]:
        """Give each cell the value of its region; zero in cells that are fixed at the background."""
        xp = namespace(self, values)
        is_fixed_cell = xp.expand_dims(self.label < 0, tuple(range(1, values.ndim)))
        return xp.where(is_fixed_cell, 0, values[xp.maximum(self.label, 0)])


def pixels(mesh: Mesh, shape: tuple[int, int]) -> Int[np.ndarray, " m"]:
    """Labels (m,) for `Regions` that group the cells of a mesh into the pixels of a grid; empty pixels are not
    numbered.

    **Arguments:**

    - `mesh`: the mesh of the image.
    - `shape`: numbers of rows and columns of the grid.

    Raises `ValueError` for a shape that is not two positive integers.

    **Example:**

    ```python
    coarse = Parametrisation(regions=pixels(mesh, (16, 16)))
    ```
    """
    grid_shape = np.asarray(shape)
    if grid_shape.shape != (2,) or grid_shape.dtype.kind not in "iu" or grid_shape.min() < 1:
        raise ValueError(f"shape must be (rows, columns), both whole numbers from 1; it is {shape}.")
    centres = np.asarray(centroids(mesh))[:, :2]
    lower_corner, upper_corner = centres.min(axis=0), centres.max(axis=0)
    grid_positions = np.minimum(
        (centres - lower_corner) / (upper_corner - lower_corner) * [shape[1], shape[0]],
        np.array([shape[1], shape[0]]) - 1,
    )
    pixel_numbers = grid_positions.astype(int) @ [1, shape[1]]
    return np.unique(pixel_numbers, return_inverse=True)[1]


class RegionBasis(AbstractBasis):
    """Basis with one coefficient per region; all cells of a region have the value `deviation` (p,) times the
    coefficient of the region."""

    regions: Regions
    deviation: Float[Array, " p"]

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients: one for each region."""
        return self.regions.number

    def expand(self, coefficients):
        """S c: each cell has the value of its region."""
        return self.regions.spread(self.deviation * coefficients)

    def restrict(self, rows):
        """Rows times S: columns summed over each region and multiplied by its deviation."""
        return self.regions.total(rows.T).T * self.deviation

    def variance(self):
        """Variance of the cells: squared deviation of the region."""
        return self.regions.spread(self.deviation**2)

    def scaled(self, factor):
        """Basis with the deviations multiplied by `factor`."""
        return RegionBasis(self.regions, self.deviation * factor)

    def pooled(self, regions):
        """Not available, because the basis has regions already. Raises `ValueError`."""
        raise ValueError("This basis has regions already.")


def expand_rows(basis: AbstractBasis, rows: Float[Array, "k n"]) -> Float[Array, "k m"]:
    """Image changes S c for every row c. Dense shapes are read once for all rows, which takes most of the time."""
    if isinstance(basis, DenseBasis):
        return (rows.astype(basis.shapes.dtype) @ basis.shapes.T).astype(rows.dtype)
    return namespace(basis, rows).stack([basis.expand(row) for row in rows])
