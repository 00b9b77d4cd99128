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
# its upper bound and the bound. `_WEIGHTS` are the reciprocals of the polynomial's roots.
_MIDDLE, _HALF = (1 + 1 / 8) / 2, (1 - 1 / 8) / 2
_WEIGHTS = tuple(1 / (_MIDDLE + sign * _HALF * np.sqrt(0.5)) for sign in (1, -1))


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
        key = pattern_key(pattern)
        matrix_hierarchy = _LAST_HIERARCHY.get_or_compute(key, values, lambda: hierarchy(pattern.to_scipy(values)))
        dtype = np.result_type(values, columns, float)
        right_hand_sides = np.ascontiguousarray(columns, dtype)
        if matrix_hierarchy.levels is None:
            return np.full(right_hand_sides.shape, np.nan, dtype)
        if np.iscomplexobj(right_hand_sides) and not np.iscomplexobj(values):
            right_hand_sides = right_hand_sides.view(float)  # real and imaginary parts are columns of their own
        solution = np.empty_like(right_hand_sides)

        def solve(column_slice: slice) -> None:
            group = np.ascontiguousarray(right_hand_sides[:, column_slice])
            solution[:, column_slice] = _conjugate_gradients(matrix_hierarchy, group, self.tolerance, self.max_steps)

        num_columns_at_once = max(1, min(_MAX_COLUMNS, -(-right_hand_sides.shape[1] // number_of_cores())))
        on_cores(
            solve,
            [
                slice(start, start + num_columns_at_once)
                for start in range(0, right_hand_sides.shape[1], num_columns_at_once)
            ],
        )
        return solution.view(dtype)


def multigrid_is_installed() -> bool:
    """Whether PyAMG is installed."""
    return find_spec("pyamg") is not None


def hierarchy(matrix: csr_array) -> MultigridHierarchy:
    """Build the multigrid levels for a symmetric matrix (n, n) with positive definite real part."""
    diagonal = matrix.diagonal()
    if not (np.isfinite(matrix.data).all() and (diagonal.real > 0).all()):
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
    return MultigridHierarchy(matrix, [_build_level(level) for level in pyamg_solver.levels])


def _build_level(pyamg_level: Any) -> MultigridLevel:
    matrix = csr_array(pyamg_level.A)
    row_sums = abs(matrix).sum(axis=1).reshape(-1, 1)
    scale = (1 / np.where(row_sums > 0, row_sums, 1)).astype(
        np.float32
    )  # for rows of zeros, which PyAMG creates for isolated nodes
    if not hasattr(pyamg_level, "P"):
        return MultigridLevel(
            matrix, scale, inverse=np.linalg.pinv(matrix.toarray(), hermitian=True).astype(np.float32)
        )
    prolongation = csr_array(pyamg_level.P).astype(np.float32)
    return MultigridLevel(matrix.astype(np.float32), scale, prolongation, csr_array(prolongation.T))


def _v_cycle(levels: list[MultigridLevel], right_hand_side: np.ndarray) -> np.ndarray:
    """Apply one multigrid V-cycle, started at zero, to right-hand sides (n, k)."""
    level, *coarser = levels
    if level.inverse is not None:
        return level.inverse @ right_hand_side
    first_weight, second_weight = _WEIGHTS
    solution = np.float32(first_weight) * level.scale * right_hand_side
    _relax(level, solution, right_hand_side, second_weight)
    residual = level.matrix @ solution
    np.subtract(right_hand_side, residual, out=residual)
    solution += level.prolongation @ _v_cycle(coarser, level.restriction @ residual)
    for weight in (second_weight, first_weight):
        _relax(level, solution, right_hand_side, weight)
    return solution


def _relax(level: MultigridLevel, solution: np.ndarray, right_hand_side: np.ndarray, weight: float) -> None:
    """Smooth a solution (n, k): add the residual, scaled by `weight` and the inverse row sums of the matrix."""
    change = level.matrix @ solution
    np.subtract(right_hand_side, change, out=change)
    change *= np.float32(weight) * level.scale
    solution += change


def _precondition(levels: list[MultigridLevel], residual: np.ndarray, column_norms: np.ndarray) -> np.ndarray:
    """Apply a multigrid V-cycle to residuals (n, k). The residuals are first divided by their `column_norms` (k,),
    because single precision has a limited range."""
    scale = np.where(column_norms > 0, column_norms, 1) / np.sqrt(len(residual))
    single_precision = np.complex64 if np.iscomplexobj(residual) else np.float32
    scaled = np.multiply(residual, 1 / scale, out=np.empty(residual.shape, single_precision), casting="unsafe")
    return _v_cycle(levels, scaled.view(np.float32)).view(single_precision) * scale


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
    preconditioned = _precondition(hierarchy.levels, residual, column_norms)
    direction, weight = preconditioned.copy(), _column_products(residual, preconditioned)
    max_norm, max_error = tolerance * column_norms, tolerance * _column_norms(preconditioned)
    is_converged = column_norms == 0
    for _ in range(max_steps):
        product = hierarchy.matrix @ direction
        curvature = _column_products(direction, product)
        if not (np.iscomplexobj(curvature) or (curvature[~is_converged] > 0).all()):  # not positive definite
            break
        length = np.divide(weight, curvature, out=np.zeros_like(weight), where=~is_converged)
        product *= length
        residual -= product
        solution += np.multiply(direction, length, out=product)
        column_norms = _column_norms(residual)
        preconditioned = _precondition(hierarchy.levels, residual, column_norms)
        last_weight, weight = weight, _column_products(residual, preconditioned)
        is_converged |= (column_norms <= max_norm) & (_column_norms(preconditioned) <= max_error)
        if is_converged.all() or not np.isfinite(weight).all():
            break
        direction *= np.divide(weight, last_weight, out=np.zeros_like(weight), where=~is_converged)
        direction += preconditioned
    solution[:, ~is_converged] = np.nan
    return solution


def _column_products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->k", left, right)


def _column_norms(columns: Any) -> np.ndarray:
    squares = _column_products(columns.real, columns.real)
    return np.sqrt(squares + _column_products(columns.imag, columns.imag) if np.iscomplexobj(columns) else squares)


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
        factor = _LAST_PARDISO_FACTOR.get_or_compute(
            pattern_key(pattern), values, lambda: _PardisoFactor(csr_array(pattern.to_scipy(values)))
        )
        return factor.solve(columns)


class _PardisoFactor:
    """Factorisation of a symmetric matrix (n, n) by PARDISO."""

    def __init__(self, matrix: csr_array):
        self.is_complex = np.iscomplexobj(matrix)
        if self.is_complex:
            # The equations (A + iB)(x + iy) = f + ig in real form, with the second row negated.
            real, imaginary = matrix.real, matrix.imag
            matrix = csr_array(block_array([[real, -imaginary], [-imaginary, -real]]))
        upper_triangle = csr_matrix(triu(matrix, format="csr"), dtype=np.float64)
        upper_triangle.sort_indices()
        package = importlib.import_module("pypardiso")
        self.upper_triangle = upper_triangle
        self.solver = package.PyPardisoSolver(
            mtype=_INDEFINITE_MATRIX_TYPE if self.is_complex else _DEFINITE_MATRIX_TYPE
        )
        self.failure: type[Exception] = package.pardiso_wrapper.PyPardisoError
        self.lock = Lock()  # a solver serves one thread at a time
        weakref.finalize(self, self.solver.free_memory, everything=True)
        try:
            self.solver.factorize(upper_triangle)
            self.failed = not np.isfinite(upper_triangle.data).all()
        except self.failure:
            self.failed = True

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """Solutions (n, k) for right-hand sides `columns`; NaN if the matrix could not be factorised."""
        is_complex_input = np.iscomplexobj(columns)
        if self.failed:
            return np.full(columns.shape, np.nan, complex if self.is_complex or is_complex_input else float)
        if not self.is_complex:
            column_blocks = [np.real(columns), np.imag(columns)] if is_complex_input else [columns]
            solution = self._solve(np.hstack(column_blocks))
            num_columns = columns.shape[1]
            return solution[:, :num_columns] + 1j * solution[:, num_columns:] if is_complex_input else solution
        solution = self._solve(np.vstack([np.real(columns), -np.imag(columns)]))
        num_rows = len(solution) // 2
        return solution[:num_rows] + 1j * solution[num_rows:]

    def _solve(self, columns: np.ndarray) -> np.ndarray:
        with self.lock:
            return self.solver.solve(self.upper_triangle, np.asfortranarray(columns, np.float64))


_LAST_PARDISO_FACTOR = LastMatrixCache()
