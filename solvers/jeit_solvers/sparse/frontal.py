"""Factorisation and solution in NumPy, front by front, of real and of complex symmetric matrices.

Fronts that do not depend on each other are distributed over the cores.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from jeit_solvers.blas import eliminate, solve_triangle
from jeit_solvers.cores import on_cores, one_thread_of_blas
from jeit_solvers.engines import call_numpy, has_values, host
from jeit_solvers.sparse.fronts import Fronts
from jeit_solvers.sparse.operator import LastMatrix

# Number of operations from which fronts are distributed over the cores; a product with k vectors takes k operations for
# each entry of the factor.
_WORTH_A_THREAD = 5e9
# Rows of a child's Schur complement that are added to its parent together; what lies below the diagonal is added in
# vain.
_ROWS = 64
# Entries of a factor that is kept for the next call, at most.
_MOST_KEPT = 100_000_000


class FrontalFactor(NamedTuple):
    """A factorised matrix A = L Lᵀ. **Fields**: `fronts`: of its pattern; `panels`: for each front the rows (p, p + b)
    of Lᵀ of its pivots; None if A (of complex symmetric matrices, the real part) is not positive definite, so that
    solutions are NaN."""

    fronts: Fronts
    panels: list[Any] | None

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix was positive definite."""
        return self.panels is not None

    def solve(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "n k"]:
        """Solution x of A x = b. Raises `ValueError` for another shape."""
        if self._needs_parts(right_hand_sides):
            return self.solve(np.real(right_hand_sides)) + 1j * self.solve(np.imag(right_hand_sides))
        vectors = self.half_solve(right_hand_sides)
        if self.panels is not None:
            for slices in reversed(self.fronts.steps):
                _for_each(lambda some: self._back(vectors, some), slices, self._cost(vectors))
        solution = np.empty_like(vectors)
        solution[self.fronts.order] = vectors
        return solution

    def quadratic_form(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "k k"]:
        """bᵀ A⁻¹ b (for complex values not conjugated), by the first half of a solution."""
        half = self.half_solve(right_hand_sides)
        return half.T @ half

    def half_solve(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "n k"]:
        """Y = L⁻¹ P b, rows in the order of elimination, so that Yᵀ Y = bᵀ A⁻¹ b. Raises `ValueError` for another
        shape."""
        shape, size = np.shape(right_hand_sides), self.fronts.size
        if len(shape) != 2 or shape[0] != size:
            raise ValueError(f"right-hand sides must have shape (n, k) with n = {size}; got {shape}.")
        if self.panels is None:
            return np.full(right_hand_sides.shape, np.nan, np.result_type(right_hand_sides, np.float32))
        if self._needs_parts(right_hand_sides):
            return self.half_solve(np.real(right_hand_sides)) + 1j * self.half_solve(np.imag(right_hand_sides))
        vectors = right_hand_sides[self.fronts.order].astype(self.panels[0].dtype)
        subtrees, *levels = self.fronts.steps
        later = vectors[self.fronts.top :]
        # Each subtree collects what it adds to later rows apart from the others.
        apart = [np.zeros_like(later) for _ in subtrees]
        numbers = {some.start: number for number, some in enumerate(subtrees)}

        def forward(some: slice) -> None:
            self._forward(vectors, apart[numbers[some.start]], some)

        _for_each(forward, subtrees, self._cost(vectors))
        for one in apart:
            later += one
        for level in levels:  # one after the other, for their borders overlap
            _for_each(lambda some: self._forward(vectors, later, some), level, 0.0)
        return vectors

    def _needs_parts(self, right_hand_sides: np.ndarray) -> bool:
        """Whether a real factor is to solve for complex numbers: their real and imaginary parts, one by one."""
        return self.panels is not None and np.iscomplexobj(right_hand_sides) and not np.iscomplexobj(self.panels[0])

    def _cost(self, vectors: np.ndarray) -> float:
        return float(vectors.shape[1] * self.fronts.num_factor_entries)

    def _forward(self, vectors: np.ndarray, later: np.ndarray, some: slice) -> None:
        """Replace the rows of the pivots of fronts by those of L⁻¹ P b, and subtract from the rows of their borders,
        which are in `later` if they are above the subtrees."""
        assert self.panels is not None
        top = self.fronts.top
        for front, panel in zip(self.fronts.fronts[some], self.panels[some], strict=True):
            own = vectors[front.first : front.first + front.pivots]
            if not own.any():  # as in a part of the body without electrodes
                continue
            solve_triangle(panel, own, transposed=False)
            if front.border:
                passed_on, inside = panel[:, front.pivots :].T @ own, front.in_subtree
                vectors[front.rows[:inside]] -= passed_on[:inside]
                later[front.rows[inside:] - top] -= passed_on[inside:]

    def _back(self, vectors: np.ndarray, some: slice) -> None:
        """Replace the rows of the pivots of fronts by those of the solution, of which later rows are known."""
        assert self.panels is not None
        for front, panel in zip(reversed(self.fronts.fronts[some]), reversed(self.panels[some]), strict=True):
            own = vectors[front.first : front.first + front.pivots]
            if front.border:
                own -= panel[:, front.pivots :] @ vectors[front.rows]
            solve_triangle(panel, own, transposed=True)


def factorise_fronts(fronts: Fronts, values: Inexact[np.ndarray, " nnz"]) -> FrontalFactor:
    """Factorise the matrix with the given values (nnz,), in the order of the pattern that `fronts` was made for.

    Raises `ValueError` for values of another shape.
    """
    if np.shape(values) != (fronts.num_entries,):
        raise ValueError(
            f"values must have shape {(fronts.num_entries,)}, the entries of the pattern; got {np.shape(values)}."
        )
    ordered = values[fronts.entry_order].astype(complex if np.iscomplexobj(values) else float)
    panels: list[Any] = [None] * len(fronts.fronts)
    waiting: list[Any] = [None] * len(fronts.fronts)

    def eliminated(some: slice) -> None:
        for number in range(some.start, some.stop):
            if not _one_front(fronts, ordered, panels, waiting, number):
                return

    for slices in fronts.steps:
        _for_each(eliminated, slices, fronts.num_operations)
        if any(panels[number] is None for some in slices for number in range(some.start, some.stop)):
            return FrontalFactor(fronts, None)
    return FrontalFactor(fronts, panels)


def solve_at_once(
    fronts: Fronts, values: Inexact[Array, " nnz"], columns: Inexact[Array, "n k"]
) -> Inexact[Array, "n k"]:
    """Solutions (n, k) for a matrix and right-hand sides of which the values need not be known: a compiled program
    calls NumPy. The last factor is kept, because derivatives solve with the same matrix again."""
    kind = jnp.result_type(values, columns)
    if has_values(values, columns):
        return host.asarray(_solve_in_numpy(fronts, kind, values, columns))
    shape = jax.ShapeDtypeStruct(columns.shape, kind)
    return call_numpy(partial(_solve_in_numpy, fronts, kind), shape, values, columns)


def _solve_in_numpy(fronts: Fronts, kind: Any, values: Any, columns: Any) -> np.ndarray:
    with np.errstate(all="ignore"):
        values, keep = np.asarray(values), fronts.num_factor_entries < _MOST_KEPT
        factor = _LAST.of(fronts.key, values, lambda: factorise_fronts(fronts, values), keep=keep)
        return factor.solve(np.asarray(columns)).astype(kind)


_LAST = LastMatrix()


def _one_front(fronts: Fronts, ordered: np.ndarray, panels: list[Any], waiting: list[Any], number: int) -> bool:
    """Assemble and eliminate a front: its panel, and the Schur complement that waits for its parent. False if it is not
    positive definite."""
    front = fronts.fronts[number]
    pivots, border = front.pivots, front.border
    panel = np.zeros((pivots, pivots + border), ordered.dtype)
    panel.reshape(-1)[front.place] = ordered[front.entries]
    corner = np.zeros((border, border), ordered.dtype)
    for child in front.children:
        schur, waiting[child] = waiting[child], None
        into, split = fronts.fronts[child].into, fronts.fronts[child].among_pivots
        if split:
            _add_rows(panel, into[:split], into, schur[:split])
        into = into[split:] - pivots
        for first in range(0, len(into), _ROWS):
            last, start = min(first + _ROWS, len(into)), into[first]
            lower = schur[split + first : split + last, split + first :]
            _add_rows(corner[:, start:], into[first:last], into[first:] - start, lower)
    if not eliminate(panel, corner):
        return False
    panels[number] = panel
    waiting[number] = corner
    return True


def _add_rows(matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray, added: np.ndarray) -> None:
    """Add a matrix (r, c) at rows and columns of another, both ascending."""
    first, last = int(rows[0]), int(rows[-1]) + 1
    start, stop = int(columns[0]), int(columns[-1]) + 1
    if stop - start > len(columns):
        spread = np.zeros((len(rows), stop - start), matrix.dtype)
        spread[:, columns - start] = added
        added = spread
    if last - first == len(rows):
        matrix[first:last, start:stop] += added
    else:
        matrix[rows, start:stop] += added


def _for_each(function: Any, slices: tuple[slice, ...], operations: float) -> None:
    """Apply `function` to each slice of fronts: on several cores if that is worth their start. BLAS has one thread: its
    own are slower by a factor of ten where another program takes a core."""
    if operations > _WORTH_A_THREAD and len(slices) > 1:
        on_cores(function, slices)
        return
    with one_thread_of_blas(), np.errstate(all="ignore"):
        for some in slices:
            function(some)
