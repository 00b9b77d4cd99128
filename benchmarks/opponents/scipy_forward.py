"""The SciPy baseline as a contestant at every task of the case `forward`."""

from __future__ import annotations

import numpy as np
import scipy

from benchmarks.opponents.scipy_baseline import ScipyBaseline
from benchmarks.opponents.scipy_newton import ScipyNewton
from benchmarks.problems.disk import GAUSS_NEWTON, STEPS


class ScipyContestant:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the conductivity or frame."""

    def __init__(self, problem: dict[str, np.ndarray], strength):
        baseline = ScipyBaseline(problem, strength)
        conductivities, frames = problem["conductivities"], problem["frames"]
        count = len(conductivities)
        homogeneous = np.full(baseline.num_cells, problem["background"])
        self.description = f"SciPy {scipy.__version__}, NumPy {np.__version__}: {baseline.choices}"
        self.tasks = {
            "voltages": lambda k: baseline.voltages(conductivities[k % count]),
            "voltages and Jacobian": lambda k: baseline.voltages_and_jacobian(conductivities[k % count]),
            "homogeneous": lambda _: baseline.voltages(homogeneous),
            "64 conductivities": lambda _: np.stack([baseline.voltages(one) for one in conductivities]),
        }
        if "measured" in problem:
            newton, measured = ScipyNewton(baseline, problem, STEPS), problem["measured"]
            self.description += f"; {newton.choice}"
            self.tasks[GAUSS_NEWTON] = lambda k: newton.conductivity(measured[k % count])
        if "reconstruction" in problem:
            matrix = problem["reconstruction"]
            self.tasks["linear image"] = lambda k: matrix @ frames[k % len(frames)]
            self.tasks["1000 linear images"] = lambda _: frames @ matrix.T
