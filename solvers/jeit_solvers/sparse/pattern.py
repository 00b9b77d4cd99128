"""Sparsity patterns of symmetric matrices, and assembly of matrices from element matrices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, Int
from scipy.sparse import coo_array, csr_array, issparse

from jeit_solvers.engines import namespace
from jeit_solvers.module import Module
from jeit_solvers.sparse.index_store import IndexLayout, IndexSlot, IndexStore, PaddedSum


class SparsityPattern(Module):
    """Positions of the entries of a symmetric (n, n) matrix that may be non-zero: its lower triangle, diagonal
    included.

    A matrix with this pattern is represented by its `values` (nnz,): `values[k]` is the entry at
    `(rows[k], columns[k])` and at `(columns[k], rows[k])`. The diagonal comes first, `values[:n]`, then the entries
    below it, row by row.

    **Fields**: `indices` (total,): row and column of every entry, and the index maps of `assemble`; `layout`: position
    of each of these arrays in `indices`; `size`: number of rows n. Build a pattern with `from_elements`, `from_entries`
    or `from_matrix`. The indices are one leaf of the pattern's pytree, so they are not compiled into a jitted function
    to which the pattern is passed as an argument.

    **Example:**

    ```python
    pattern = SparsityPattern.from_elements([np.array([[0, 1, 2], [1, 2, 3]])], size=4)
    pattern.num_entries, pattern.rows
    ```
    """

    indices: Int[Array, " total"]
    layout: IndexLayout = eqx.field(static=True)
    size: int = eqx.field(static=True)

    @property
    def num_entries(self) -> int:
        """Number of stored entries, nnz: the diagonal and the entries below it."""
        return self._entry_slots.shape[1]

    @property
    def rows(self) -> Int[Array, " nnz"]:
        """Row of every stored entry, greater than or equal to its column."""
        return self._entry_slots.read(self.indices)[0]

    @property
    def columns(self) -> Int[Array, " nnz"]:
        """Column of every stored entry."""
        return self._entry_slots.read(self.indices)[1]

    @property
    def num_groups(self) -> int:
        """Number of groups of elements, each of which `assemble` takes as an argument."""
        return len(self._assembly_maps)

    @property
    def _entry_slots(self) -> IndexSlot:
        return self.layout.content[0]

    @property
    def _assembly_maps(self) -> tuple[AssemblyMap, ...]:
        return self.layout.content[1]

    @classmethod
    def from_elements(cls, groups: Sequence[Any], size: int) -> Self:
        """Pattern of a finite-element matrix, in which the nodes of each element are coupled.

        **Arguments:**

        - `groups`: groups of elements, each an integer array (m, k) of node numbers: cells (m, 3), boundary facets (b,
          2) … A group may add couplings that no other group has.
        - `size`: number of nodes, n.

        Raises `ValueError` for node numbers out of range, for elements that contain a node twice, and for nodes that
        belong to no element (their rows would be empty, and the matrix singular).
        """
        size = _checked_size(size)
        if len(groups) == 0:
            raise ValueError("from_elements: `groups` is empty; give at least one (m, k) array of node numbers.")
        row_lists, column_lists, group_shapes = [], [], []
        for group_number, group in enumerate(groups):
            group_elements = _checked_integers(group, f"from_elements: `groups[{group_number}]`")
            if group_elements.ndim != 2:
                raise ValueError(
                    f"from_elements: `groups[{group_number}]` must have shape (m, k), one row of node numbers to an "
                    f"element; got {group_elements.shape}."
                )
            _check_range(group_elements, size, f"from_elements: `groups[{group_number}]`")
            sorted_elements = np.sort(group_elements, axis=1)
            repeated_indices = np.flatnonzero((sorted_elements[:, 1:] == sorted_elements[:, :-1]).any(axis=1))
            if repeated_indices.size:
                raise ValueError(
                    f"from_elements: element {repeated_indices[0]} of `groups[{group_number}]` names a node twice: "
                    f"{group_elements[repeated_indices[0]].tolist()}. Remove degenerate elements from the mesh."
                )
            first_corners, second_corners = np.tril_indices(group_elements.shape[1])
            row_lists.append(group_elements[:, first_corners].T.ravel())
            column_lists.append(group_elements[:, second_corners].T.ravel())
            group_shapes.append(group_elements.shape)
        return cls._from_contributions(
            row_lists, column_lists, group_shapes, size, "from_elements", "belong to no element"
        )

    @classmethod
    def from_entries(cls, rows: Any, columns: Any, size: int) -> Self:
        """Pattern with the given entries, each specified as (row, column) or as (column, row).

        `assemble` then takes one array (entries,) in the order of `rows` and `columns`; values of repeated entries are
        added. Raises `ValueError` for indices out of range and for rows without a diagonal entry.
        """
        size = _checked_size(size)
        rows = _checked_integers(rows, "from_entries: `rows`")
        columns = _checked_integers(columns, "from_entries: `columns`")
        if rows.ndim != 1 or rows.shape != columns.shape:
            raise ValueError(
                "from_entries: `rows` and `columns` must be 1-D and equally long; "
                f"got shapes {rows.shape} and {columns.shape}."
            )
        _check_range(rows, size, "from_entries: `rows`")
        _check_range(columns, size, "from_entries: `columns`")
        return cls._from_contributions([rows], [columns], [rows.shape], size, "from_entries", "have no diagonal entry")

    @classmethod
    def from_matrix(cls, matrix: Any) -> tuple[Self, Array]:
        """Pattern and values (nnz,) of a symmetric SciPy sparse matrix or dense array, which must contain both
        triangles.

        Raises `ValueError` unless the matrix is square, symmetric (not Hermitian: complex values are not conjugated),
        finite and without missing diagonal entries.
        """
        if not issparse(matrix):
            matrix = np.asarray(matrix)
        if len(matrix.shape) != 2 or matrix.shape[0] != matrix.shape[1]:
            raise ValueError(f"from_matrix: `matrix` must be square; got shape {matrix.shape}.")
        full_matrix = csr_array(matrix)
        full_matrix.sum_duplicates()
        if not np.isfinite(full_matrix.data).all():
            raise ValueError("from_matrix: `matrix` has entries that are NaN or infinite; remove them first.")
        asymmetric_part = abs(full_matrix - full_matrix.T)
        max_magnitude = abs(full_matrix).max() if full_matrix.nnz else 0.0
        if asymmetric_part.nnz and asymmetric_part.max() > 1e-12 * max_magnitude:
            raise ValueError(
                f"from_matrix: `matrix` is not symmetric: |A - A^T| is up to {asymmetric_part.max():.3g}, "
                f"and its largest entry is {max_magnitude:.3g}. Give both triangles, or (matrix + matrix.T) / 2 if the "
                "difference is noise."
            )
        matrix_entries = coo_array(full_matrix)
        entry_rows, entry_columns = matrix_entries.coords
        is_lower = entry_rows >= entry_columns
        pattern = cls.from_entries(entry_rows[is_lower], entry_columns[is_lower], matrix.shape[0])
        return pattern, pattern.assemble(jnp.asarray(matrix_entries.data[is_lower]))

    @classmethod
    def _from_contributions(
        cls, row_lists, column_lists, group_shapes, matrix_size, caller_name, missing_row_reason
    ) -> Self:
        """Pattern of the unique entries of all groups of contributions; it also stores the index of the entry of each
        contribution."""
        entry_keys = []
        for rows, columns in zip(row_lists, column_lists, strict=True):
            larger_indices, smaller_indices = np.maximum(rows, columns), np.minimum(rows, columns)
            # Entries on the diagonal get negative keys, so that these entries come first, in the order of rows.
            entry_keys.append(
                np.where(
                    larger_indices == smaller_indices,
                    larger_indices - matrix_size,
                    larger_indices * matrix_size + smaller_indices,
                )
            )
        unique_keys, entry_of_value = np.unique(np.concatenate(entry_keys), return_inverse=True)
        has_diagonal_entry = np.zeros(matrix_size, dtype=bool)
        has_diagonal_entry[unique_keys[unique_keys < 0] + matrix_size] = True
        if not has_diagonal_entry.all():
            missing_rows = np.flatnonzero(~has_diagonal_entry)
            raise ValueError(
                f"{caller_name}: {missing_rows.size} of {matrix_size} rows {missing_row_reason}, the first are "
                f"{missing_rows[:5].tolist()}. A matrix with this pattern cannot be positive definite: leave these "
                "unknowns out, and number the rest 0..n-1."
            )
        smaller_indices = unique_keys[matrix_size:]
        rows = np.concatenate([np.arange(matrix_size), smaller_indices // matrix_size])
        columns = np.concatenate([np.arange(matrix_size), smaller_indices % matrix_size])
        ends_of_groups = np.cumsum([group_keys.size for group_keys in entry_keys])
        index_store = IndexStore()
        entry_slot = index_store.add(np.stack([rows, columns]))
        assembly_maps = tuple(
            AssemblyMap.create(index_store, entries_of_group, matrix_size, unique_keys.size, group_shape)
            for entries_of_group, group_shape in zip(
                np.split(entry_of_value, ends_of_groups[:-1]), group_shapes, strict=True
            )
        )
        return cls(index_store.pack(), IndexLayout(entry_slot, assembly_maps), matrix_size)

    def assemble(self, *element_matrices: Inexact[Array, "..."] | None) -> Inexact[Array, " nnz"]:
        """Add up element matrices to the values (nnz,) of the matrix.

        The method takes one argument for each group of elements of the pattern, in the order of the groups: symmetric
        matrices (m, k, k), of which only the lower triangles are read; packed lower triangles (k (k + 1) / 2, m), with
        rows in the order of `numpy.tril_indices(k)`; or None for a group that contributes nothing. Values are real or
        complex. Raises `ValueError` if the number of arguments differs from the number of groups, or if all arguments
        are None.
        """
        if len(element_matrices) != len(self._assembly_maps):
            raise ValueError(
                f"assemble: this pattern has {len(self._assembly_maps)} groups of elements, "
                f"and {len(element_matrices)} arrays were given; use None for a group that adds nothing."
            )
        group_contributions = [
            group.apply(self.indices, _convert_to_numeric(matrices), f"assemble: argument {argument_number}")
            for argument_number, (group, matrices) in enumerate(zip(self._assembly_maps, element_matrices, strict=True))
            if matrices is not None
        ]
        if not group_contributions:
            raise ValueError("assemble: every group is None, so there is nothing to assemble.")
        return sum(group_contributions[1:], start=group_contributions[0])

    def entries_between(self, values: Inexact[Array, " nnz"], group: int = 0) -> Inexact[Array, "pairs m"]:
        """Entries of the matrix between the nodes of each element of a group, packed as for `assemble`: (k (k + 1) / 2,
        m), rows in the order of `numpy.tril_indices(k)`."""
        return self._assembly_maps[group].read_back(self.indices, values)

    def diagonal(self, values: Inexact[Array, " nnz"]) -> Inexact[Array, " n"]:
        """Diagonal of the matrix (n,)."""
        return values[: self.size]

    def multiply(self, values: Inexact[Array, " nnz"], vectors: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        """The product A x for one vector (n,) or several (n, k)."""
        expanded_axes = (...,) + (None,) * (vectors.ndim - 1)
        lower_values = values[self.size :][expanded_axes]
        lower_rows, lower_columns = self.rows[self.size :], self.columns[self.size :]
        matrix_product = values[: self.size][expanded_axes] * vectors
        matrix_product = matrix_product.at[lower_rows].add(lower_values * vectors[lower_columns])
        return matrix_product.at[lower_columns].add(lower_values * vectors[lower_rows])

    def to_dense(self, values: Inexact[Array, " nnz"]) -> Inexact[Array, "n n"]:
        """The matrix as a dense array (n, n)."""
        dense_matrix = jnp.zeros((self.size, self.size), values.dtype)
        return dense_matrix.at[self.rows, self.columns].set(values).at[self.columns, self.rows].set(values)

    def quadratic_form(
        self, values: Inexact[np.ndarray, " nnz"], vectors: Inexact[np.ndarray, "n k"]
    ) -> Inexact[np.ndarray, "k k"]:
        """The product xᵀ A x for several vectors (n, k), in NumPy."""
        below_diagonal_slice = slice(self.size, None)
        # Rows are in order.
        row_ends = np.searchsorted(np.asarray(self.rows)[below_diagonal_slice], np.arange(self.size + 1))
        lower_columns = np.asarray(self.columns)[below_diagonal_slice]
        below_diagonal = csr_array(
            (values[below_diagonal_slice], lower_columns, row_ends), shape=(self.size, self.size)
        )
        product_with_lower_triangle = vectors.T @ (below_diagonal @ vectors + values[: self.size, None] / 2 * vectors)
        return product_with_lower_triangle + product_with_lower_triangle.T

    def to_scipy(self, values: Any) -> csr_array:
        """The matrix as a SciPy sparse array (n, n), both triangles."""
        values = np.asarray(values)
        rows, columns = np.asarray(self.rows), np.asarray(self.columns)
        below_diagonal_slice = slice(self.size, None)
        entry_coordinates = (
            np.concatenate([rows, columns[below_diagonal_slice]]),
            np.concatenate([columns, rows[below_diagonal_slice]]),
        )
        entry_values = np.concatenate([values, values[below_diagonal_slice]])
        return csr_array(coo_array((entry_values, entry_coordinates), shape=(self.size, self.size)))


def _convert_to_numeric(values: Any) -> Any:
    return values if isinstance(values, np.ndarray) else jnp.asarray(values)


def _checked_size(matrix_size: Any) -> int:
    if not isinstance(matrix_size, int | np.integer) or isinstance(matrix_size, bool) or matrix_size < 1:
        raise ValueError(f"`size` must be a positive integer, the number of rows; got {matrix_size!r}.")
    return int(matrix_size)


def _checked_integers(array: Any, name: str) -> np.ndarray:
    array = np.asarray(array)
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must hold integers, counted from 0; got dtype {array.dtype}.")
    return array.astype(np.int64)


def _check_range(indices: np.ndarray, num_unknowns: int, name: str) -> None:
    if indices.size and (indices.min() < 0 or indices.max() >= num_unknowns):
        raise ValueError(
            f"{name} holds indices from {indices.min()} to {indices.max()}, outside 0..{num_unknowns - 1} "
            f"for `size` = {num_unknowns}. Are they counted from 1?"
        )


class AssemblyMap(NamedTuple):
    """Map from the element matrices of one group to the entries (nnz,) of the matrix.

    `shape` is (m, k) for m elements of k nodes, or (m,) for m values that are themselves entries of the matrix.
    """

    diagonal: PaddedSum
    below: PaddedSum
    shape: tuple[int, ...]

    @classmethod
    def create(
        cls, store: IndexStore, entry: np.ndarray, size: int, num_entries: int, shape: tuple[int, ...]
    ) -> "AssemblyMap":
        """Create the map of a group. `entry`: index of the matrix entry of each packed value (pairs, m), row by row, or
        of each value (m,)."""
        packed_sources = np.arange(entry.size)
        is_on_diagonal = entry < size
        return cls(
            PaddedSum.create(store, entry[is_on_diagonal], packed_sources[is_on_diagonal], size, entry.size),
            PaddedSum.create(
                store, entry[~is_on_diagonal] - size, packed_sources[~is_on_diagonal], num_entries - size, entry.size
            ),
            shape,
        )

    def apply(
        self, indices: Int[Array, " total"], matrices: Inexact[Array, "..."], name: str
    ) -> Inexact[Array, " nnz"]:
        """Contribution of the group's element matrices to the entries of the matrix; see `SparsityPattern.assemble`."""
        packed_values = self._packed_matrices(matrices, name).reshape(-1)
        return namespace(packed_values).concatenate(
            [self.diagonal.apply(indices, packed_values), self.below.apply(indices, packed_values)]
        )

    def read_back(self, indices: Int[Array, " total"], values: Inexact[Array, " nnz"]) -> Inexact[Array, "..."]:
        """Read the matrix entry to which each packed value is added; see `SparsityPattern.entries_between`."""
        packed_shape = (len(np.tril_indices(self.shape[1])[0]), self.shape[0]) if len(self.shape) > 1 else self.shape
        num_entries = self.diagonal.gather.shape[1]
        packed_indices = namespace(values).zeros(math.prod(packed_shape) + 1, values.dtype)
        packed_indices = self.diagonal.replace_by_sums(indices, values[:num_entries], packed_indices)
        return self.below.replace_by_sums(indices, values[num_entries:], packed_indices)[:-1].reshape(packed_shape)

    def _packed_matrices(self, matrices: Inexact[Array, "..."], name: str) -> Inexact[Array, "..."]:
        """Element matrices as packed lower triangles, with one row of m values for each entry of a triangle."""
        if len(self.shape) == 1:
            if matrices.shape != self.shape:
                raise ValueError(f"{name} must be the entries' values, shape {self.shape}; got {matrices.shape}.")
            return matrices
        num_elements, nodes_per_element = self.shape
        first_corners, second_corners = np.tril_indices(nodes_per_element)
        if matrices.shape == (first_corners.size, num_elements):
            return matrices
        if matrices.shape != (num_elements, nodes_per_element, nodes_per_element):
            raise ValueError(
                f"{name} must hold {num_elements} symmetric matrices, shape "
                f"{(num_elements, nodes_per_element, nodes_per_element)}, or their packed lower "
                f"triangles, shape {(first_corners.size, num_elements)}; got {matrices.shape}."
            )
        return namespace(matrices).stack(
            [matrices[:, i, j] for i, j in zip(first_corners, second_corners, strict=True)]
        )
