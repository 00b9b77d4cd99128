"""PARDISO, the direct solver of Intel's oneMKL, for sparse symmetric systems on a CPU.

Users select PARDISO where jeit's own factorisation takes too much memory or time (Schenk and Gärtner, Future Gener.
Comput. Syst. 20, 2004). Complex symmetric systems are solved as real symmetric systems of twice the size, because the
binding, pypardiso, passes real matrices only.
"""

from __future__ import annotations

import importlib
import weakref
from importlib.util import find_spec
from threading import Lock

import equinox as eqx
import numpy as np
from scipy.sparse import block_array, csr_array, csr_matrix, triu

from jeit_solvers.sparse.operator import LastMatrix, NumpySolver, pattern_key
from jeit_solvers.sparse.pattern import SparsityPattern

# Numbers by which oneMKL denotes matrix types: real symmetric positive definite, and real symmetric indefinite.
_DEFINITE, _INDEFINITE = 2, -2


class Pardiso(NumpySolver):
    """Direct solver for real or complex `SparseSymmetric` operators by PARDISO (oneMKL).

    The last factorisation is kept, and used again when the same matrix is solved, for example for derivatives. All
    solutions are NaN if a real matrix is not positive definite, or if PARDISO fails. PARDISO runs on the CPU; compiled
    programs call it.

    **Arguments:**

    - `reason`: why this solver is used, in words.

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
        factor = _LAST_FACTOR.get_or_compute(
            pattern_key(pattern), values, lambda: _Factor(csr_array(pattern.to_scipy(values)))
        )
        return factor.solve(columns)


class _Factor:
    """Factorisation of a symmetric matrix (n, n) by PARDISO."""

    def __init__(self, matrix: csr_array):
        self.is_complex = np.iscomplexobj(matrix)
        if self.is_complex:
            # The equations (A + iB)(x + iy) = f + ig in real form, with the second row negated.
            real, imaginary = matrix.real, matrix.imag
            matrix = csr_array(block_array([[real, -imaginary], [-imaginary, -real]]))
        upper = csr_matrix(triu(matrix, format="csr"), dtype=np.float64)
        upper.sort_indices()
        package = importlib.import_module("pypardiso")
        self.upper = upper
        self.solver = package.PyPardisoSolver(mtype=_INDEFINITE if self.is_complex else _DEFINITE)
        self.failure: type[Exception] = package.pardiso_wrapper.PyPardisoError
        self.lock = Lock()  # a solver serves one thread at a time
        weakref.finalize(self, self.solver.free_memory, everything=True)
        try:
            self.solver.factorize(upper)
            self.failed = not np.isfinite(upper.data).all()
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
            return self.solver.solve(self.upper, np.asfortranarray(columns, np.float64))


_LAST_FACTOR = LastMatrix()
