"""Intel's PARDISO (oneMKL, through pypardiso) as a contestant at the sparse solver's task, in a separate environment.

The sparsity pattern is analysed once. Every repeat factorises another matrix of this pattern, with oneMKL's default
settings.
"""

from __future__ import annotations

import numpy as np
import pypardiso
from scipy.sparse import csr_matrix, triu

from benchmarks.problems.matrices import symmetric


class Pardiso:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        load, count = np.asfortranarray(problem["load"]), len(problem["values"])
        upper = [csr_matrix(triu(symmetric(problem, number), format="csr")) for number in range(count)]
        for one in upper:
            one.indices, one.indptr = one.indices.astype(np.int32), one.indptr.astype(np.int32)
        solver = pypardiso.PyPardisoSolver(mtype=2)
        nothing = np.zeros((len(load), 1), order="F")

        def call(phase: int, matrix: csr_matrix, right: np.ndarray) -> np.ndarray:
            solver.set_phase(phase)
            return solver._call_pardiso(matrix, right)

        call(11, upper[0], nothing)

        def both(number: int) -> np.ndarray:
            call(22, upper[number % count], nothing)
            return call(33, upper[number % count], load)

        self.description = f"PARDISO (oneMKL), pypardiso {pypardiso.__version__}"
        self.tasks = {"factorise and solve": both, "factorise": lambda k: call(22, upper[k % count], nothing)}
