"""Factorisation and solution of sparse symmetric matrices in NumPy, front by front, in the order of `exact_fronts.py`.

Matrices are real, or complex symmetric. Fronts that do not depend on each other are distributed over the cores.

Each front is eliminated by BLAS and LAPACK, in place. SciPy exports its BLAS for other compiled code. Here BLAS is
called through ctypes, which lets other threads run and copies nothing: a matrix may consist of some rows of a larger
array. Arrays are in C order, which a Fortran routine reads as the transpose: a lower triangle for BLAS is the upper
triangle of the array.
"""

from __future__ import annotations

import ctypes
import functools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg.cython_blas
import scipy.linalg.cython_lapack
from jaxtyping import Array, Inexact

from jeit_solvers.cores import on_cores, one_thread_of_blas
from jeit_solvers.dense import inverse_cholesky
from jeit_solvers.engines import call_numpy, has_values, host
from jeit_solvers.sparse.exact_fronts import Fronts
from jeit_solvers.sparse.operator import LastMatrixCache

# Minimum number of operations at which fronts are distributed over the cores. A product with k vectors counts as k
# operations for each entry of the factor.
_MIN_PARALLEL_OPERATIONS = 5e9
# Number of rows of a child front's Schur complement that are added to the parent front together. Each such block
# includes some entries below the diagonal, which are not needed.
_NUM_ROWS_ADDED_AT_ONCE = 64
# Maximum number of entries of a factor that `solve_with_cached_factor` caches for the next call.
_MAX_CACHED_ENTRIES = 100_000_000


class FrontalFactor(NamedTuple):
    """A factorised sparse matrix A = L Lᵀ. **Fields**: `fronts`: the fronts of the sparsity pattern of A; `panels`: for
    each front the rows (p, p + b) of Lᵀ that belong to its p pivots, with b border rows. `panels` is None if A (for a
    complex matrix, its real part) is not positive definite; solutions are then NaN.

    **Example:**

    ```python
    factor = factorise_fronts(find_fronts(pattern), values)
    factor.solve(np.eye(50)[:, :2]), factor.positive_definite
    ```
    """

    fronts: Fronts
    panels: list[Any] | None

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix is positive definite."""
        return self.panels is not None

    def solve(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "n k"]:
        """Solution x of A x = b for `right_hand_sides` b (n, k). Raises `ValueError` for right-hand sides of a wrong
        shape."""
        if self._splits_complex(right_hand_sides):
            return self.solve(np.real(right_hand_sides)) + 1j * self.solve(np.imag(right_hand_sides))
        solution_vectors = self.half_solve(right_hand_sides)
        if self.panels is not None:
            for front_slices in reversed(self.fronts.steps):
                _for_each_slice(
                    lambda front_slice: self._substitute_back(solution_vectors, front_slice),
                    front_slices,
                    self._num_operations(solution_vectors),
                )
        ordered_solution = np.empty_like(solution_vectors)
        ordered_solution[self.fronts.order] = solution_vectors
        return ordered_solution

    def quadratic_form(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "k k"]:
        """Quadratic form bᵀ A⁻¹ b of `right_hand_sides` b (complex values are not conjugated), computed from
        `half_solve` alone."""
        half_solution = self.half_solve(right_hand_sides)
        return half_solution.T @ half_solution

    def half_solve(self, right_hand_sides: Inexact[np.ndarray, "n k"]) -> Inexact[np.ndarray, "n k"]:
        """Forward half of a solve: Y = L⁻¹ P b for `right_hand_sides` b, where P sorts rows into the order of
        elimination, so that Yᵀ Y = bᵀ A⁻¹ b. Raises `ValueError` for right-hand sides of a wrong shape."""
        sides_shape, matrix_size = np.shape(right_hand_sides), self.fronts.size
        if len(sides_shape) != 2 or sides_shape[0] != matrix_size:
            raise ValueError(f"right-hand sides must have shape (n, k) with n = {matrix_size}; got {sides_shape}.")
        if self.panels is None:
            return np.full(right_hand_sides.shape, np.nan, np.result_type(right_hand_sides, np.float32))
        if self._splits_complex(right_hand_sides):
            return self.half_solve(np.real(right_hand_sides)) + 1j * self.half_solve(np.imag(right_hand_sides))
        ordered_vectors = right_hand_sides[self.fronts.order].astype(self.panels[0].dtype)
        subtree_slices, *level_slices = self.fronts.steps
        later_rows = ordered_vectors[self.fronts.top :]
        # Subtrees run in parallel, so each collects its contributions to the rows above the subtrees in an array of its
        # own.
        subtree_updates = [np.zeros_like(later_rows) for _ in subtree_slices]
        subtree_numbers = {
            front_slice.start: subtree_number for subtree_number, front_slice in enumerate(subtree_slices)
        }

        def eliminate_subtree(front_slice: slice) -> None:
            self._eliminate_forward(ordered_vectors, subtree_updates[subtree_numbers[front_slice.start]], front_slice)

        _for_each_slice(eliminate_subtree, subtree_slices, self._num_operations(ordered_vectors))
        for subtree_update in subtree_updates:
            later_rows += subtree_update
        for slices_of_level in level_slices:  # levels run one after the other, because borders of their fronts overlap
            _for_each_slice(
                lambda front_slice: self._eliminate_forward(ordered_vectors, later_rows, front_slice),
                slices_of_level,
                0.0,
            )
        return ordered_vectors

    def _splits_complex(self, right_hand_sides: np.ndarray) -> bool:
        """Whether the factor is real and the right-hand sides are complex, so that their real and imaginary parts are
        solved for separately."""
        return self.panels is not None and np.iscomplexobj(right_hand_sides) and not np.iscomplexobj(self.panels[0])

    def _num_operations(self, ordered_vectors: np.ndarray) -> float:
        return float(ordered_vectors.shape[1] * self.fronts.num_factor_entries)

    def _eliminate_forward(self, ordered_vectors: np.ndarray, later_values: np.ndarray, front_slice: slice) -> None:
        """Forward elimination for the fronts `front_slice`: replace the rows of `ordered_vectors` at the pivots by the
        same rows of L⁻¹ P b, and subtract the contributions of the pivots from the rows of the borders. Border rows
        above the subtrees are in `later_values`."""
        assert self.panels is not None
        first_top_row = self.fronts.top
        for front, panel in zip(self.fronts.fronts[front_slice], self.panels[front_slice], strict=True):
            pivot_rows = ordered_vectors[front.first : front.first + front.pivots]
            if not pivot_rows.any():  # e.g. in a part of the body without electrodes
                continue
            solve_triangle(panel, pivot_rows, transposed=False)
            if front.border:
                border_contributions, num_inside = panel[:, front.pivots :].T @ pivot_rows, front.num_subtree_rows
                ordered_vectors[front.rows[:num_inside]] -= border_contributions[:num_inside]
                later_values[front.rows[num_inside:] - first_top_row] -= border_contributions[num_inside:]

    def _substitute_back(self, ordered_vectors: np.ndarray, front_slice: slice) -> None:
        """Back substitution for the fronts `front_slice`: replace the rows of `ordered_vectors` at the pivots by the
        rows of the solution. Later rows of the solution are already known."""
        assert self.panels is not None
        for front, panel in zip(
            reversed(self.fronts.fronts[front_slice]), reversed(self.panels[front_slice]), strict=True
        ):
            pivot_rows = ordered_vectors[front.first : front.first + front.pivots]
            if front.border:
                pivot_rows -= panel[:, front.pivots :] @ ordered_vectors[front.rows]
            solve_triangle(panel, pivot_rows, transposed=True)


def factorise_fronts(fronts: Fronts, values: Inexact[np.ndarray, " nnz"]) -> FrontalFactor:
    """Factorise a sparse symmetric matrix in NumPy.

    **Arguments:**

    - `fronts`: from `find_fronts`.
    - `values` (nnz,): entries of the matrix, in the order of the pattern from which the fronts were computed.

    Raises `ValueError` for values of a wrong shape.

    **Example:**

    ```python
    factor = factorise_fronts(find_fronts(pattern), values)
    factor.solve(np.eye(50)[:, :2])
    ```
    """
    if np.shape(values) != (fronts.num_entries,):
        raise ValueError(
            f"values must have shape {(fronts.num_entries,)}, the entries of the pattern; got {np.shape(values)}."
        )
    ordered_values = values[fronts.entry_order].astype(complex if np.iscomplexobj(values) else float)
    front_panels: list[Any] = [None] * len(fronts.fronts)
    schur_complements: list[Any] = [None] * len(fronts.fronts)

    def eliminate_slice(front_slice: slice) -> None:
        for front_number in range(front_slice.start, front_slice.stop):
            if not _eliminate_front(fronts, ordered_values, front_panels, schur_complements, front_number):
                return

    for front_slices in fronts.steps:
        _for_each_slice(eliminate_slice, front_slices, fronts.num_operations)
        if any(
            front_panels[front_number] is None
            for front_slice in front_slices
            for front_number in range(front_slice.start, front_slice.stop)
        ):
            return FrontalFactor(fronts, None)
    return FrontalFactor(fronts, front_panels)


def solve_with_cached_factor(
    fronts: Fronts, values: Inexact[Array, " nnz"], columns: Inexact[Array, "n k"]
) -> Inexact[Array, "n k"]:
    """Solve for k right-hand sides `columns` (n, k), also inside `jax.jit`, where the compiled program calls NumPy. The
    last factor is cached, because derivatives solve with the same matrix again."""
    result_dtype = jnp.result_type(values, columns)
    if has_values(values, columns):
        return host.asarray(_solve_in_numpy(fronts, result_dtype, values, columns))
    result_shape = jax.ShapeDtypeStruct(columns.shape, result_dtype)
    return call_numpy(partial(_solve_in_numpy, fronts, result_dtype), result_shape, values, columns)


def _solve_in_numpy(fronts: Fronts, result_dtype: Any, values: Any, columns: Any) -> np.ndarray:
    with np.errstate(all="ignore"):
        values, is_kept = np.asarray(values), fronts.num_factor_entries < _MAX_CACHED_ENTRIES
        cached_factor = _LAST_FACTOR.get_or_compute(
            fronts.key, values, lambda: factorise_fronts(fronts, values), keeps_result=is_kept
        )
        return cached_factor.solve(np.asarray(columns)).astype(result_dtype)


_LAST_FACTOR = LastMatrixCache()


def _eliminate_front(
    fronts: Fronts, ordered_values: np.ndarray, front_panels: list[Any], schur_complements: list[Any], front_index: int
) -> bool:
    """Assemble and eliminate one front, and store its panel and its Schur complement, which is later added to the
    parent front. Returns False if the front is not positive definite."""
    eliminated_front = fronts.fronts[front_index]
    num_pivots, num_border = eliminated_front.pivots, eliminated_front.border
    front_panel = np.zeros((num_pivots, num_pivots + num_border), ordered_values.dtype)
    front_panel.reshape(-1)[eliminated_front.panel_indices] = ordered_values[eliminated_front.entries]
    schur_corner = np.zeros((num_border, num_border), ordered_values.dtype)
    for child_index in eliminated_front.children:
        child_schur, schur_complements[child_index] = schur_complements[child_index], None
        parent_rows, num_parent_pivots = (
            fronts.fronts[child_index].rows_in_parent,
            fronts.fronts[child_index].num_parent_pivots,
        )
        if num_parent_pivots:
            _add_rows(front_panel, parent_rows[:num_parent_pivots], parent_rows, child_schur[:num_parent_pivots])
        parent_rows = parent_rows[num_parent_pivots:] - num_pivots
        for first_row in range(0, len(parent_rows), _NUM_ROWS_ADDED_AT_ONCE):
            last_row, first_parent_row = (
                min(first_row + _NUM_ROWS_ADDED_AT_ONCE, len(parent_rows)),
                parent_rows[first_row],
            )
            lower_rows = child_schur[
                num_parent_pivots + first_row : num_parent_pivots + last_row, num_parent_pivots + first_row :
            ]
            _add_rows(
                schur_corner[:, first_parent_row:],
                parent_rows[first_row:last_row],
                parent_rows[first_row:] - first_parent_row,
                lower_rows,
            )
    if not eliminate(front_panel, schur_corner):
        return False
    front_panels[front_index] = front_panel
    schur_complements[front_index] = schur_corner
    return True


def _add_rows(matrix: np.ndarray, row_indices: np.ndarray, column_indices: np.ndarray, added_block: np.ndarray) -> None:
    """Add an `added_block` (r, c) to the given rows (r,) and columns (c,) of a matrix, both in ascending order."""
    first_row, last_row = int(row_indices[0]), int(row_indices[-1]) + 1
    column_start, column_stop = int(column_indices[0]), int(column_indices[-1]) + 1
    if column_stop - column_start > len(column_indices):
        expanded_rows = np.zeros((len(row_indices), column_stop - column_start), matrix.dtype)
        expanded_rows[:, column_indices - column_start] = added_block
        added_block = expanded_rows
    if last_row - first_row == len(row_indices):
        matrix[first_row:last_row, column_start:column_stop] += added_block
    else:
        matrix[row_indices, column_start:column_stop] += added_block


def _for_each_slice(function: Any, front_slices: tuple[slice, ...], num_operations: float) -> None:
    """Apply `function` to each slice of fronts, on several cores if there are enough operations. BLAS is limited to one
    thread, because its own threads are ten times slower when another program occupies a core."""
    if num_operations > _MIN_PARALLEL_OPERATIONS and len(front_slices) > 1:
        on_cores(function, front_slices)
        return
    with one_thread_of_blas(), np.errstate(all="ignore"):
        for front_slice in front_slices:
            function(front_slice)


def _routine_from_capsule(scipy_module: Any, name: str, num_arguments: int) -> Any:
    """Return a routine of SciPy's BLAS or LAPACK, callable through ctypes with pointers as its `num_arguments`
    arguments."""
    function_capsule = scipy_module.__pyx_capi__[name]
    get_capsule_name, get_capsule_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    get_capsule_name.restype, get_capsule_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_capsule_pointer.restype, get_capsule_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    c_signature = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * num_arguments)
    return c_signature(get_capsule_pointer(function_capsule, get_capsule_name(function_capsule)))


class _BlasRoutines(NamedTuple):
    """BLAS routines and constants for one number type. **Fields**: `solve_triangle_routine`: triangular solve
    (trsm); `symmetric_product_routine`: symmetric product (syrk); `plus_one`, `minus_one`: arrays that hold the number
    1 or -1."""

    solve_triangle_routine: Any
    symmetric_product_routine: Any
    plus_one: np.ndarray
    minus_one: np.ndarray


def _load_routines(type_letter: str, dtype: type) -> _BlasRoutines:
    cython_blas = scipy.linalg.cython_blas
    blas_routines = (
        _routine_from_capsule(cython_blas, type_letter + "trsm", 11),
        _routine_from_capsule(cython_blas, type_letter + "syrk", 10),
    )
    return _BlasRoutines(*blas_routines, np.ones(1, dtype), -np.ones(1, dtype))


_ROUTINES_OF_DTYPE = {np.dtype(float): _load_routines("d", float), np.dtype(complex): _load_routines("z", complex)}
_cholesky_routine = _routine_from_capsule(scipy.linalg.cython_lapack, "dpotrf", 5)


@functools.lru_cache(4096)
def _c_integer(integer_value: int) -> Any:
    return ctypes.byref(ctypes.c_int(integer_value))


def _row_stride(matrix: np.ndarray) -> Any:
    """Distance in memory between successive rows of a matrix, in elements."""
    return _c_integer(matrix.strides[0] // matrix.itemsize)


def eliminate(panel: np.ndarray, schur: np.ndarray) -> bool:
    """Eliminate the pivots of a front (a dense matrix of p pivot rows and b border rows), in place. Returns False if
    the pivot block is not positive definite.

    `panel` (p, p + b): on entry the rows [A, B] of the pivots; only the upper triangle of A is read, and all of B. On
    return the panel contains [Lᵀ, L⁻¹ B] with A = L Lᵀ. `schur` (b, b): Schur complement; Bᵀ A⁻¹ B is subtracted from
    its upper triangle. Complex matrices are symmetric, and transposes are not conjugated.
    """
    num_pivots, num_border = len(panel), panel.shape[1] - len(panel)
    blas_routines, row_stride = _ROUTINES_OF_DTYPE[panel.dtype], _row_stride(panel)
    if panel.dtype == complex:
        pivot_square: Any = np.triu(panel[:, :num_pivots])
        pivot_square += np.triu(pivot_square, 1).T
        panel[:, :num_pivots] = inverse_cholesky(pivot_square[None])[0] @ pivot_square
    else:
        lapack_info = ctypes.c_int(0)
        _cholesky_routine(b"L", _c_integer(num_pivots), panel.ctypes.data, row_stride, ctypes.byref(lapack_info))
        if lapack_info.value:
            return False
    if not np.isfinite(np.diagonal(panel)).all():
        return False
    if num_border:
        border_address, plus_one = (
            panel.ctypes.data + num_pivots * panel.itemsize,
            blas_routines.plus_one.ctypes.data,
        )
        pivot_count, border_count = _c_integer(num_pivots), _c_integer(num_border)
        blas_routines.solve_triangle_routine(
            b"R",
            b"L",
            b"T",
            b"N",
            border_count,
            pivot_count,
            plus_one,
            panel.ctypes.data,
            row_stride,
            border_address,
            row_stride,
        )
        minus_one = blas_routines.minus_one.ctypes.data
        blas_routines.symmetric_product_routine(
            b"L",
            b"N",
            border_count,
            pivot_count,
            minus_one,
            border_address,
            row_stride,
            plus_one,
            schur.ctypes.data,
            _row_stride(schur),
        )
    return True


def solve_triangle(panel: np.ndarray, vectors: np.ndarray, *, transposed: bool) -> None:
    """Overwrite the `vectors` V (p, k) with L⁻¹ V, or with L⁻ᵀ V if `transposed`. `panel`: [Lᵀ, …], as overwritten by
    `eliminate`."""
    if not vectors.size:
        return
    blas_routines, transposition_letter = _ROUTINES_OF_DTYPE[panel.dtype], b"N" if transposed else b"T"
    pivot_count, num_vectors = _c_integer(len(panel)), _c_integer(vectors.shape[1])
    plus_one, panel_address, row_stride = blas_routines.plus_one.ctypes.data, panel.ctypes.data, _row_stride(panel)
    blas_routines.solve_triangle_routine(
        b"R",
        b"L",
        transposition_letter,
        b"N",
        num_vectors,
        pivot_count,
        plus_one,
        panel_address,
        row_stride,
        vectors.ctypes.data,
        _row_stride(vectors),
    )
