"""jeit's conjugate gradients with multigrid as a contestant, for concrete (not traced) matrices: the multigrid levels
are computed anew for each matrix."""

from __future__ import annotations

import jax
import numpy as np

from jeit_solvers import Multigrid, SparseSymmetric, SparsityPattern


class JeitMultigrid:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        jax.config.update("jax_enable_x64", True)
        pattern = SparsityPattern.from_entries(problem["rows"], problem["columns"], len(problem["load"]))
        every = [np.asarray(pattern.assemble(one)) for one in problem["values"]]
        solver, load = Multigrid(), problem["load"]
        self.description = "conjugate gradients, smoothed aggregation in single precision"
        self.details = {"entries": pattern.num_entries}
        self.tasks = {
            "factorise and solve": lambda k: solver.solve_columns(SparseSymmetric(every[k % len(every)], pattern), load)
        }
