"""Sparse matrices over the nodes of a mesh, solved directly, and averages of nodal values over cells."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from jeit.mesh import Mesh
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    Fronts,
    SparsityPattern,
    factorise,
    factorise_fronts,
    find_fronts,
    half_solve,
    on_cores,
    solve,
)
from jeit_solvers.engines import on_host

# Number of right-hand sides solved at a time, with a plan's padded fronts and with fronts of exact size: more would
# exceed the caches.
_COLUMNS_BY_PLAN, _COLUMNS_BY_FRONTS = 32, 256

Solve = Callable[[Any], Any]
"""Function that solves a linear system for columns (n, k)."""


class NodalSystem(NamedTuple):
    """Structure of sparse matrices whose entries couple the nodes of a cell.

    **Fields**: `mesh`: mesh with NumPy arrays; `pattern`: sparsity pattern; `fronts`: order of the factorisation;
    `means` (m, n): matrix that averages nodal values over each cell.
    """

    mesh: Mesh
    pattern: SparsityPattern
    fronts: Fronts
    means: scipy.sparse.csr_array

    @classmethod
    def create(cls, mesh: Mesh) -> "NodalSystem":
        """Create for a mesh whose arrays are not traced."""
        mesh = on_host(mesh)
        cells, nodes_per_cell = np.asarray(mesh.cells), mesh.cells.shape[1]
        pattern = SparsityPattern.from_elements([cells], size=mesh.num_points)
        fronts = find_fronts(pattern, np.asarray(mesh.points))
        row_starts = np.arange(0, cells.size + 1, nodes_per_cell)
        shape = mesh.num_cells, mesh.num_points
        means = scipy.sparse.csr_array(
            (np.full(cells.size, 1 / nodes_per_cell), cells.ravel(), row_starts), shape=shape
        )
        return cls(mesh, on_host(pattern), fronts, means)

    def assemble(
        self, elements: Float[np.ndarray, "..."], diagonal: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " e"]:
        """Assemble a matrix from the element matrices `elements` (m, k, k) and add `diagonal` (n,). Returns the entries
        (e,) in the pattern's order."""
        element_matrices: Any = elements
        values = np.array(self.pattern.assemble(element_matrices))
        values[: self.pattern.size] += diagonal
        return values

    def inverse(self, values: Any) -> Solve:
        """Factorise the matrix A whose entries in the pattern's order are `values`, and return a function that solves A
        X = B for columns B (n, k)."""
        factor = factorise_fronts(self.fronts, values)
        return lambda columns: by_columns(factor.solve, columns, len(columns))


class FactorisedMatrix(NamedTuple):
    """A factorised matrix A = L Lᵀ. **Fields**: `solve`: function that returns A⁻¹ times columns (n, k); `half_solve`:
    function that returns L⁻¹ times columns, with the rows in the order of the factorisation."""

    solve: Solve
    half_solve: Solve


def factorise_matrix(plan: FactorisationPlan, fronts: Fronts, values: Any) -> FactorisedMatrix:
    """Factorise the matrix whose entries in the pattern's order are `values`: in NumPy, with the order `fronts`, or
    inside `jax.jit`, `jax.grad` and `jax.vmap`, with the compiled `plan`."""
    if not isinstance(values, np.ndarray):
        factor = factorise(plan, values)
        return FactorisedMatrix(
            lambda columns: solve(plan, factor, columns), lambda columns: half_solve(plan, factor, columns)
        )
    host_factor = factorise_fronts(fronts, values)
    return FactorisedMatrix(
        lambda columns: by_columns(host_factor.solve, columns, len(columns)),
        lambda columns: by_columns(host_factor.half_solve, columns, len(columns)),
    )


def solve_columns(plan: FactorisationPlan, factor: Factor, columns: Any) -> Any:
    """Solutions of a factorised system for right-hand sides `columns` (n, k). NumPy arrays are split over all cores."""
    if not isinstance(columns, np.ndarray):
        return solve(plan, factor, columns)
    return by_columns(functools.partial(solve, plan, factor), columns, plan.size, _COLUMNS_BY_PLAN)


def by_columns(function: Callable[[Any], Any], columns: Any, rows: int, at_once: int = _COLUMNS_BY_FRONTS) -> Any:
    """Apply `function` to blocks of `at_once` columns of a NumPy array (n, k), in parallel on all cores; returns (rows,
    k). `function` may itself call `by_columns` with all its columns."""
    num_columns = columns.shape[1]
    result = np.empty((rows, num_columns), columns.dtype)

    def apply_to_block(start: int) -> None:
        block = np.ascontiguousarray(columns[:, start : start + at_once])
        result[:, start : start + at_once] = function(block)

    on_cores(apply_to_block, range(0, num_columns, at_once))
    return result
