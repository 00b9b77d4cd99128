"""Matrices between the nodes of a mesh, solved by the direct solver, and images of cells as means over their nodes."""

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

# Columns solved for at a time: with more, fronts exceed the caches, and all at once take the memory of several images.
_AT_ONCE = 32

Solve = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n k"]]
"""What solves a system for columns."""


class NodalSystem(NamedTuple):
    """Places of the entries of a matrix between neighbouring nodes, and the plan of its factorisation.

    **Fields**: `mesh`, in NumPy; `pattern`; `plan`; `means` (m, n), of cells over their nodes.
    """

    mesh: Mesh
    pattern: SparsityPattern
    plan: FactorisationPlan
    means: scipy.sparse.csr_array

    @classmethod
    def create(cls, mesh: Mesh) -> "NodalSystem":
        """Create for a mesh that has values."""
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
        """Entries, in the pattern's order, of a matrix of the cells' `elements` (m, k, k) and a `diagonal` (n,)."""
        given: Any = elements
        values = np.array(self.pattern.assemble(given))
        values[: self.pattern.size] += diagonal
        return values

    def inverse(self, values: Any) -> Solve:
        """Function that solves A X = B for columns (n, k), A having these entries, in the pattern's order."""
        factor = factorise(self.plan, values)
        return lambda columns: in_columns(solve, self.plan, factor, columns)


def in_columns(
    how: Callable[[FactorisationPlan, Factor, Any], Any], plan: FactorisationPlan, factor: Factor, columns: Any
) -> Any:
    """`solve` or `half_solve` of columns (n, k); of NumPy's some at a time, on every core."""
    if not isinstance(columns, np.ndarray):
        return how(plan, factor, columns)
    return by_columns(functools.partial(how, plan, factor), columns, plan.size if how is solve else plan.num_pivots)


def by_columns(function: Callable[[Any], Any], columns: Any, rows: int) -> Any:
    """Apply `function` to columns (n, k) of a NumPy array, some at a time on every core; returns (rows, k). `function`
    may itself call `by_columns` with as many columns as it is given."""
    number = columns.shape[1]
    found = np.empty((rows, number), columns.dtype)

    def some(start: int) -> None:
        part = np.ascontiguousarray(columns[:, start : start + _AT_ONCE])
        found[:, start : start + _AT_ONCE] = function(part)

    on_cores(some, range(0, number, _AT_ONCE))
    return found
