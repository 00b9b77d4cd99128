"""jeit's sparse direct solver of concrete (not traced) matrices as a contestant: factorisation in NumPy, with solutions
or only with products bᵀA⁻¹b."""

from __future__ import annotations

import time

import numpy as np

from jeit_solvers import SparsityPattern, factorise_fronts, find_fronts


class JeitFronts:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        pattern = SparsityPattern.from_entries(problem["rows"], problem["columns"], len(problem["load"]))
        start = time.perf_counter()
        fronts = find_fronts(pattern, problem["points"])
        seconds = time.perf_counter() - start
        every, load = [np.asarray(pattern.assemble(one)) for one in problem["values"]], problem["load"]

        def factor(number: int):
            return factorise_fronts(fronts, every[number % len(every)])

        self.description = "nested dissection, multifrontal Cholesky in NumPy and SciPy's BLAS"
        self.details = {
            "plan": seconds,
            "factor MB": 8 * fronts.num_factor_entries / 1e6,
            "operations": fronts.num_operations,
        }
        self.tasks = {
            "factorise and solve": lambda k: factor(k).solve(load),
            "factorise and multiply": lambda k: factor(k).quadratic_form(load),
            "factorise": factor,
        }
