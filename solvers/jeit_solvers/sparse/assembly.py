"""Summing element matrices into matrix entries."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Inexact, Int

from jeit_solvers.engines import namespace
from jeit_solvers.sparse.index_store import IndexStore, PaddedSum


class AssemblyMap(NamedTuple):
    """The way from one group's element matrices to all the matrix's entries (nnz,).

    `shape` is (m, k) for m elements of k nodes, or (m,) for m values that are matrix entries themselves.
    """

    diagonal: PaddedSum
    below: PaddedSum
    shape: tuple[int, ...]

    @classmethod
    def create(
        cls, store: IndexStore, entry: np.ndarray, size: int, num_entries: int, shape: tuple[int, ...]
    ) -> "AssemblyMap":
        """`entry` names the matrix entry of each packed value (pairs, m), row by row, or of each value (m,)."""
        source = np.arange(entry.size)
        on_diagonal = entry < size
        return cls(
            PaddedSum.create(store, entry[on_diagonal], source[on_diagonal], size, entry.size),
            PaddedSum.create(store, entry[~on_diagonal] - size, source[~on_diagonal], num_entries - size, entry.size),
            shape,
        )

    def apply(
        self, indices: Int[Array, " total"], matrices: Inexact[Array, "..."], name: str
    ) -> Inexact[Array, " nnz"]:
        """The matrix entries that the group's element matrices add up to; see `SparsityPattern.assemble`."""
        flat = self._packed(matrices, name).reshape(-1)
        return namespace(flat).concatenate([self.diagonal.apply(indices, flat), self.below.apply(indices, flat)])

    def read_back(self, indices: Int[Array, " total"], values: Inexact[Array, " nnz"]) -> Inexact[Array, "..."]:
        """The matrix entry that each packed value is added to; see `SparsityPattern.entries_between`."""
        packed = (len(np.tril_indices(self.shape[1])[0]), self.shape[0]) if len(self.shape) > 1 else self.shape
        size = self.diagonal.gather.shape[1]
        into = namespace(values).zeros(math.prod(packed) + 1, values.dtype)
        into = self.diagonal.read_back(indices, values[:size], into)
        return self.below.read_back(indices, values[size:], into)[:-1].reshape(packed)

    def _packed(self, matrices: Inexact[Array, "..."], name: str) -> Inexact[Array, "..."]:
        """One row of m values for each entry of the elements' lower triangles."""
        if len(self.shape) == 1:
            if matrices.shape != self.shape:
                raise ValueError(f"{name} must be the entries' values, shape {self.shape}; got {matrices.shape}.")
            return matrices
        count, nodes = self.shape
        first, second = np.tril_indices(nodes)
        if matrices.shape == (first.size, count):
            return matrices
        if matrices.shape != (count, nodes, nodes):
            raise ValueError(
                f"{name} must hold {count} symmetric matrices, shape {(count, nodes, nodes)}, or their packed lower "
                f"triangles, shape {(first.size, count)}; got {matrices.shape}."
            )
        return namespace(matrices).stack([matrices[:, i, j] for i, j in zip(first, second, strict=True)])
