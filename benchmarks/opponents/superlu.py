"""SciPy's SuperLU as a contestant at the sparse solver's task: all orderings of SuperLU are timed, and the fastest on
this matrix is kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from scipy.sparse.linalg import splu

from benchmarks.harness.timing import least_times
from benchmarks.problems.matrices import symmetric

SYMMETRIC: dict[str, Any] = {"options": {"SymmetricMode": True}, "diag_pivot_thresh": 0.0}
ORDERINGS: dict[str, dict[str, Any]] = {
    "COLAMD": {"permc_spec": "COLAMD"},
    "MMD_ATA": {"permc_spec": "MMD_ATA"},
    "MMD_AT_PLUS_A": {"permc_spec": "MMD_AT_PLUS_A"},
    "MMD_AT_PLUS_A, symmetric mode": {"permc_spec": "MMD_AT_PLUS_A", **SYMMETRIC},
}
KEPT = "MMD_AT_PLUS_A found once, symmetric mode, panels of 1"


class SuperLU:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        load, count = problem["load"], len(problem["values"])
        self._matrices = [symmetric(problem, number) for number in range(count)]
        order = np.argsort(splu(self._matrices[0], **ORDERINGS["MMD_AT_PLUS_A, symmetric mode"]).perm_c)
        # The matrices are permuted before timing, because values could be assembled in this order, as for jeit's
        # solver.
        permuted = [matrix[order][:, order].tocsc() for matrix in self._matrices]

        def kept(k: int) -> tuple[Any, Callable[[np.ndarray], np.ndarray]]:
            factor = splu(permuted[k], permc_spec="NATURAL", panel_size=1, **SYMMETRIC)

            def solve(right: np.ndarray) -> np.ndarray:
                solution = np.empty_like(right)
                solution[order] = factor.solve(right[order])
                return solution

            return factor, solve

        ways = {name: self._with(options) for name, options in ORDERINGS.items()} | {KEPT: kept}
        spent = least_times({name: (lambda way=way: way(0)[1](load)) for name, way in ways.items()}, budget=6.0)
        best = min(spent, key=spent.__getitem__)
        way = ways[best]
        first = way(0)
        self.description = f"SciPy {scipy.__version__}, {best}"
        self.details = {"ordering": best, "factor MB": 12 * first[0].nnz / 1e6}
        self.tasks = {
            "factorise and solve": lambda k: way(k % count)[1](load),
            "factorise": lambda k: way(k % count),
            "solve": lambda _: first[1](load),
            "batch": lambda _: np.stack([way(k)[1](load) for k in range(count)]),
        }

    def _with(self, options: dict[str, Any]):
        def factorise(k: int):
            factor = splu(self._matrices[k], **options)
            return factor, factor.solve

        return factorise
