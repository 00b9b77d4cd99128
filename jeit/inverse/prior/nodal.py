"""Sparse matrices over the nodes of a mesh, solved directly, and averages of nodal values over cells."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from jeit.mesh import Mesh
from jeit_solvers import Factor, FactorisationPlan, SparsityPattern, analyse, factorise, on_cores, solve
from jeit_solvers.engines import on_host

# Number of columns solved for at a time: with more, the fronts exceed the caches and memory grows.
_AT_ONCE = 32

Solve = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n k"]]
"""Function that solves a linear system for columns (n, k)."""


class NodalSystem(NamedTuple):
    """Structure of sparse matrices whose entries couple the nodes of a cell.

    **Fields**: `mesh`: mesh with NumPy arrays; `pattern`: sparsity pattern; `plan`: plan of the factorisation; `means`
    (m, n): matrix that averages nodal values over each cell.
    """

    mesh: Mesh
    pattern: SparsityPattern
    plan: FactorisationPlan
    means: scipy.sparse.csr_array

    @classmethod
    def create(cls, mesh: Mesh) -> "NodalSystem":
        """Create for a mesh whose arrays are not traced."""
        mesh = on_host(mesh)
        cells, count = np.asarray(mesh.cells), mesh.cells.shape[1]
        pattern = SparsityPattern.from_elements([cells], size=mesh.num_points)
        plan = analyse(pattern, np.asarray(mesh.points))
        ends = np.arange(0, cells.size + 1, count)
        shape = mesh.num_cells, mesh.num_points
        means = scipy.sparse.csr_array((np.full(cells.size, 1 / count), cells.ravel(), ends), shape=shape)
        pattern, plan = on_host((pattern, plan))
        return cls(mesh, pattern, plan, means)

    def assemble(
        self, elements: Float[np.ndarray, "..."], diagonal: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " e"]:
        """Assemble the element matrices `elements` (m, k, k) and add `diagonal` (n,); entries in the pattern's
        order."""
        given: Any = elements
        values = np.array(self.pattern.assemble(given))
        values[: self.pattern.size] += diagonal
        return values

    def inverse(self, values: Any) -> Solve:
        """Factorise the matrix A whose entries in the pattern's order are `values`; return a function that solves
        A X = B for columns B (n, k)."""
        factor = factorise(self.plan, values)
        return lambda columns: in_columns(solve, self.plan, factor, columns)


def in_columns(
    how: Callable[[FactorisationPlan, Factor, Any], Any], plan: FactorisationPlan, factor: Factor, columns: Any
) -> Any:
    """Apply `how`, which is `solve` or `half_solve`, to columns (n, k). NumPy arrays are split over all cores."""
    if not isinstance(columns, np.ndarray):
        return how(plan, factor, columns)
    return by_columns(functools.partial(how, plan, factor), columns, plan.size if how is solve else plan.num_pivots)


def by_columns(function: Callable[[Any], Any], columns: Any, rows: int) -> Any:
    """Apply `function` to blocks of the columns of a NumPy array (n, k), in parallel on all cores; returns (rows, k).
    `function` may itself call `by_columns` with all columns it is given."""
    number = columns.shape[1]
    found = np.empty((rows, number), columns.dtype)

    def some(start: int) -> None:
        part = np.ascontiguousarray(columns[:, start : start + _AT_ONCE])
        found[:, start : start + _AT_ONCE] = function(part)

    on_cores(some, range(0, number, _AT_ONCE))
    return found
