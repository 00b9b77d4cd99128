"""Solvers of sparse symmetric systems that call optional packages: multigrid (PyAMG) and PARDISO (pypardiso).

`Multigrid`: conjugate gradients for several right-hand sides at once, preconditioned by smoothed-aggregation multigrid,
in NumPy. Time and memory grow in proportion to the number of unknowns, so multigrid suits systems that are too large to
factorise. PyAMG computes the levels from the matrix alone (Vanek, Mandel and Brezina, Computing 56, 1996). A multigrid
cycle works on several right-hand sides at once and in single precision, which halves the memory traffic; the conjugate
gradients are computed in double precision. The smoother is a Chebyshev polynomial of the matrix, scaled by the sums of
the absolute values of its rows, which bound the spectrum (Baker, Falgout, Kolev and Yang, SIAM J. Sci. Comput. 33,
2011).

`Pardiso`: the direct solver of Intel's oneMKL, on a CPU. Users select PARDISO where jeit's own factorisation takes too
much memory or time (Schenk and Gärtner, Future Gener. Comput. Syst. 20, 2004). Complex symmetric systems are solved as
real symmetric systems of twice the size, because the Python interface, pypardiso, supports only real matrices.
"""

from __future__ import annotations

import importlib
import weakref
from importlib.util import find_spec
from threading import Lock
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from scipy.sparse import block_array, csr_array, csr_matrix, triu

from jeit_solvers.cores import number_of_cores, on_cores
from jeit_solvers.sparse.operator import LastMatrixCache, NumpySolver, pattern_key
from jeit_solvers.sparse.pattern import SparsityPattern

# Maximum number of right-hand sides that are iterated together. With more right-hand sides the matrix is read less
# often; with fewer, they fit in the cache.
_MAX_COLUMNS = 16
# Maximum number of unknowns of the coarsest level; the matrix of this level is inverted.
_MAX_COARSEST_SIZE = 500
# The smoother is a Chebyshev polynomial of degree 2, which damps the spectrum of the scaled matrix between an eighth of
# its upper bound and the bound. `_RELAXATION_WEIGHTS` are the reciprocals of the polynomial's roots.
_SPECTRUM_MIDDLE, _SPECTRUM_HALF_WIDTH = (1 + 1 / 8) / 2, (1 - 1 / 8) / 2
_RELAXATION_WEIGHTS = tuple(1 / (_SPECTRUM_MIDDLE + sign * _SPECTRUM_HALF_WIDTH * np.sqrt(0.5)) for sign in (1, -1))


class MultigridLevel(NamedTuple):
    """A level of a multigrid hierarchy, in single precision. **Fields**: `matrix`: (n, n); `scale`: (n, 1), reciprocals
    of the sums of absolute values of the matrix's rows; `prolongation`, `restriction`: matrices (n, c) from the next
    coarser level and (c, n) to it, None on the coarsest level; `inverse`: (n, n) inverse of the matrix on the coarsest
    level, else None."""

    matrix: Any
    scale: np.ndarray
    prolongation: Any = None
    restriction: Any = None
    inverse: np.ndarray | None = None


class MultigridHierarchy(NamedTuple):
    """A matrix and the multigrid levels of its preconditioner. **Fields**: `matrix`: (n, n); `levels`: levels of the
    matrix's real part, from the finest to the coarsest; None if the diagonal is not positive or values are not
    finite."""

    matrix: csr_array
    levels: list[MultigridLevel] | None


class Multigrid(NumpySolver):
    """Conjugate gradients preconditioned by multigrid, for large real or complex `SparseSymmetric` operators.

    Iteration ends when the relative residual and the relative preconditioned residual are both at most the tolerance.
    The first is the norm of the residual divided by the norm of the right-hand side; the second, which is about the
    relative error, is the same ratio after preconditioning. The second condition is needed because rows with large
    entries, such as those of electrodes with low contact impedance, dominate the residual. A solution is NaN if it does
    not converge within the maximum number of steps, or before a step shows that the matrix is not positive definite.
    The solver runs in NumPy; compiled programs call it. Complex symmetric systems are solved by the conjugate
    orthogonal variant, preconditioned with the real part of the matrix.

    **Arguments:**

    - `tolerance`: tolerance of both residuals.
    - `max_steps`: maximum number of steps.
    - `reason`: text that explains why this solver is used.

    Raises `ValueError` for a tolerance that is not between 0 and 1, and for a maximum of less than one step;
    `ImportError` if PyAMG (the extra `large`) is not installed.

    **Example:**

    ```python
    solver = Multigrid(tolerance=1e-8)  # with pyamg
    solution = lineax.linear_solve(operator, loads[:, 0], solver)
    ```
    """

    tolerance: float = eqx.field(static=True, default=1e-10)
    max_steps: int = eqx.field(static=True, default=500)
    reason: str = eqx.field(static=True, default="chosen by the user")

    def __check_init__(self):
        if not 0 < self.tolerance < 1:
            raise ValueError(f"Multigrid: `tolerance` must be between 0 and 1; got {self.tolerance}.")
        if self.max_steps < 1:
            raise ValueError(f"Multigrid: `max_steps` must be positive; got {self.max_steps}.")
        if not multigrid_is_installed():
            raise ImportError("Multigrid needs pyamg: pip install 'jeit[large]', or in a clone '.[large]'.")

    def solve_in_numpy(self, pattern: SparsityPattern, values: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Solutions (n, k) for right-hand sides `columns` (n, k); NaN where the iteration failed."""
        hierarchy_key = pattern_key(pattern)
        matrix_hierarchy = _LAST_HIERARCHY.get_or_compute(
            hierarchy_key, values, lambda: hierarchy(pattern.to_scipy(values))
        )
        result_dtype = np.result_type(values, columns, float)
        right_hand_sides = np.ascontiguousarray(columns, result_dtype)
        if matrix_hierarchy.levels is None:
            return np.full(right_hand_sides.shape, np.nan, result_dtype)
        if np.iscomplexobj(right_hand_sides) and not np.iscomplexobj(values):
            right_hand_sides = right_hand_sides.view(float)  # real and imaginary parts are columns of their own
        column_solutions = np.empty_like(right_hand_sides)

        def solve_column_group(column_slice: slice) -> None:
            column_group = np.ascontiguousarray(right_hand_sides[:, column_slice])
            column_solutions[:, column_slice] = _conjugate_gradients(
                matrix_hierarchy, column_group, self.tolerance, self.max_steps
            )

        num_columns_at_once = max(1, min(_MAX_COLUMNS, -(-right_hand_sides.shape[1] // number_of_cores())))
        on_cores(
            solve_column_group,
            [
                slice(first_column, first_column + num_columns_at_once)
                for first_column in range(0, right_hand_sides.shape[1], num_columns_at_once)
            ],
        )
        return column_solutions.view(result_dtype)


def multigrid_is_installed() -> bool:
    """Whether PyAMG is installed."""
    return find_spec("pyamg") is not None


def hierarchy(matrix: csr_array) -> MultigridHierarchy:
    """Build the multigrid levels for a symmetric matrix (n, n) with positive definite real part."""
    matrix_diagonal = matrix.diagonal()
    if not (np.isfinite(matrix.data).all() and (matrix_diagonal.real > 0).all()):
        return MultigridHierarchy(matrix, None)
    pyamg_solver = importlib.import_module("pyamg").smoothed_aggregation_solver(
        matrix.real.tocsr(),
        symmetry="symmetric",
        strength=("symmetric", {"theta": 0.0}),
        improve_candidates=None,
        presmoother=None,
        postsmoother=None,
        max_coarse=_MAX_COARSEST_SIZE,
    )
    return MultigridHierarchy(matrix, [_build_level(pyamg_level) for pyamg_level in pyamg_solver.levels])


def _build_level(pyamg_level: Any) -> MultigridLevel:
    level_matrix = csr_array(pyamg_level.A)
    row_sums = abs(level_matrix).sum(axis=1).reshape(-1, 1)
    inverse_row_sums = (1 / np.where(row_sums > 0, row_sums, 1)).astype(
        np.float32
    )  # for rows of zeros, which PyAMG creates for isolated nodes
    if not hasattr(pyamg_level, "P"):
        return MultigridLevel(
            level_matrix,
            inverse_row_sums,
            inverse=np.linalg.pinv(level_matrix.toarray(), hermitian=True).astype(np.float32),
        )
    prolongation_matrix = csr_array(pyamg_level.P).astype(np.float32)
    return MultigridLevel(
        level_matrix.astype(np.float32), inverse_row_sums, prolongation_matrix, csr_array(prolongation_matrix.T)
    )


def _v_cycle(multigrid_levels: list[MultigridLevel], right_hand_side: np.ndarray) -> np.ndarray:
    """Apply one multigrid V-cycle, started at zero, to right-hand sides (n, k)."""
    finest_level, *coarser_levels = multigrid_levels
    if finest_level.inverse is not None:
        return finest_level.inverse @ right_hand_side
    first_weight, second_weight = _RELAXATION_WEIGHTS
    cycle_solution = np.float32(first_weight) * finest_level.scale * right_hand_side
    _relax_once(finest_level, cycle_solution, right_hand_side, second_weight)
    residual = finest_level.matrix @ cycle_solution
    np.subtract(right_hand_side, residual, out=residual)
    cycle_solution += finest_level.prolongation @ _v_cycle(coarser_levels, finest_level.restriction @ residual)
    for relaxation_weight in (second_weight, first_weight):
        _relax_once(finest_level, cycle_solution, right_hand_side, relaxation_weight)
    return cycle_solution


def _relax_once(
    multigrid_level: MultigridLevel, solution: np.ndarray, right_hand_side: np.ndarray, relaxation_weight: float
) -> None:
    """Smooth a solution (n, k): add the residual, scaled by `relaxation_weight` and the inverse row sums of the
    matrix."""
    solution_change = multigrid_level.matrix @ solution
    np.subtract(right_hand_side, solution_change, out=solution_change)
    solution_change *= np.float32(relaxation_weight) * multigrid_level.scale
    solution += solution_change


def _apply_v_cycle(
    multigrid_levels: list[MultigridLevel], residual: np.ndarray, column_norms: np.ndarray
) -> np.ndarray:
    """Apply a multigrid V-cycle to residuals (n, k). The residuals are first divided by their `column_norms` (k,),
    because single precision has a limited range."""
    residual_scales = np.where(column_norms > 0, column_norms, 1) / np.sqrt(len(residual))
    single_precision = np.complex64 if np.iscomplexobj(residual) else np.float32
    scaled_residual = np.multiply(
        residual, 1 / residual_scales, out=np.empty(residual.shape, single_precision), casting="unsafe"
    )
    return _v_cycle(multigrid_levels, scaled_residual.view(np.float32)).view(single_precision) * residual_scales


def _conjugate_gradients(
    hierarchy: MultigridHierarchy, right_hand_side: np.ndarray, tolerance: float, max_steps: int
) -> np.ndarray:
    """Solve for right-hand sides (n, k) by preconditioned conjugate gradients. Solutions that do not converge are
    NaN."""
    assert hierarchy.levels is not None
    solution, residual, column_norms = (
        np.zeros_like(right_hand_side),
        right_hand_side.copy(),
        _column_norms(right_hand_side),
    )
    preconditioned_residual = _apply_v_cycle(hierarchy.levels, residual, column_norms)
    search_direction, residual_weights = (
        preconditioned_residual.copy(),
        _column_products(residual, preconditioned_residual),
    )
    max_norm, max_error = tolerance * column_norms, tolerance * _column_norms(preconditioned_residual)
    is_converged = column_norms == 0
    for _ in range(max_steps):
        direction_product = hierarchy.matrix @ search_direction
        direction_curvatures = _column_products(search_direction, direction_product)
        # The matrix is not positive definite.
        if not (np.iscomplexobj(direction_curvatures) or (direction_curvatures[~is_converged] > 0).all()):
            break
        step_lengths = np.divide(
            residual_weights, direction_curvatures, out=np.zeros_like(residual_weights), where=~is_converged
        )
        direction_product *= step_lengths
        residual -= direction_product
        solution += np.multiply(search_direction, step_lengths, out=direction_product)
        column_norms = _column_norms(residual)
        preconditioned_residual = _apply_v_cycle(hierarchy.levels, residual, column_norms)
        last_weight, residual_weights = residual_weights, _column_products(residual, preconditioned_residual)
        is_converged |= (column_norms <= max_norm) & (_column_norms(preconditioned_residual) <= max_error)
        if is_converged.all() or not np.isfinite(residual_weights).all():
            break
        search_direction *= np.divide(
            residual_weights, last_weight, out=np.zeros_like(residual_weights), where=~is_converged
        )
        search_direction += preconditioned_residual
    solution[:, ~is_converged] = np.nan
    return solution


def _column_products(left_columns: np.ndarray, right_columns: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->k", left_columns, right_columns)


def _column_norms(columns: Any) -> np.ndarray:
    squared_norms = _column_products(columns.real, columns.real)
    return np.sqrt(
        squared_norms + _column_products(columns.imag, columns.imag) if np.iscomplexobj(columns) else squared_norms
    )


_LAST_HIERARCHY = LastMatrixCache()


# oneMKL's numbers of matrix types: real symmetric positive definite, and real symmetric indefinite.
_DEFINITE_MATRIX_TYPE, _INDEFINITE_MATRIX_TYPE = 2, -2


class Pardiso(NumpySolver):
    """Direct solver for real or complex `SparseSymmetric` operators by PARDISO (oneMKL).

    The last factorisation is stored, and reused for the next solution with the same matrix, for example for
    derivatives. All solutions are NaN if a real matrix is not positive definite, or if PARDISO fails. PARDISO runs on
    the CPU; compiled programs call it.

    **Arguments:**

    - `reason`: text that explains why this solver is used.

    Raises `ImportError` if pypardiso (the extra `mkl`) is not installed.

    **Example:**

    ```python
    solution = lineax.linear_solve(operator, loads[:, 0], Pardiso())  # with pypardiso
    ```
    """

    reason: str = eqx.field(static=True, default="chosen by the user")

    def __check_init__(self):
        if find_spec("pypardiso") is None:
            raise ImportError("Pardiso needs pypardiso: pip install 'jeit[mkl]', or in a clone '.[mkl]'.")

    def solve_in_numpy(self, pattern: SparsityPattern, values: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Solutions (n, k) for the right-hand sides `columns` (n, k)."""
        pardiso_factor = _LAST_PARDISO_FACTOR.get_or_compute(
            pattern_key(pattern), values, lambda: _PardisoFactor(csr_array(pattern.to_scipy(values)))
        )
        return pardiso_factor.solve(columns)


class _PardisoFactor:
    """Factorisation of a symmetric matrix (n, n) by PARDISO."""

    def __init__(self, matrix: csr_array):
        self.is_complex = np.iscomplexobj(matrix)
        if self.is_complex:
            # The equations (A + iB)(x + iy) = f + ig in real form, with the second row negated.
            real_part, imaginary_part = matrix.real, matrix.imag
            matrix = csr_array(block_array([[real_part, -imaginary_part], [-imaginary_part, -real_part]]))
        upper_triangle = csr_matrix(triu(matrix, format="csr"), dtype=np.float64)
        upper_triangle.sort_indices()
        pypardiso_package = importlib.import_module("pypardiso")
        self.upper_triangle = upper_triangle
        self.solver = pypardiso_package.PyPardisoSolver(
            mtype=_INDEFINITE_MATRIX_TYPE if self.is_complex else _DEFINITE_MATRIX_TYPE
        )
        self.failure: type[Exception] = pypardiso_package.pardiso_wrapper.PyPardisoError
        self.solver_lock = Lock()  # a solver serves one thread at a time
        weakref.finalize(self, self.solver.free_memory, everything=True)
        try:
            self.solver.factorize(upper_triangle)
            self.has_failed = not np.isfinite(upper_triangle.data).all()
        except self.failure:
            self.has_failed = True

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """Solutions (n, k) for right-hand sides `columns`; NaN if the matrix could not be factorised."""
        is_complex_input = np.iscomplexobj(columns)
        if self.has_failed:
            return np.full(columns.shape, np.nan, complex if self.is_complex or is_complex_input else float)
        if not self.is_complex:
            column_blocks = [np.real(columns), np.imag(columns)] if is_complex_input else [columns]
            real_solution = self._solve(np.hstack(column_blocks))
            num_columns = columns.shape[1]
            return (
                real_solution[:, :num_columns] + 1j * real_solution[:, num_columns:]
                if is_complex_input
                else real_solution
            )
        real_solution = self._solve(np.vstack([np.real(columns), -np.imag(columns)]))
        num_rows = len(real_solution) // 2
        return real_solution[:num_rows] + 1j * real_solution[num_rows:]

    def _solve(self, columns: np.ndarray) -> np.ndarray:
        with self.solver_lock:
            return self.solver.solve(self.upper_triangle, np.asfortranarray(columns, np.float64))


_LAST_PARDISO_FACTOR = LastMatrixCache()
