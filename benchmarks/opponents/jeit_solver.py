"""jeit's sparse direct solver under `jax.jit` as a contestant: factorisation, solution, and both, for one matrix and
for a batch."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

import jeit  # noqa: F401  (double precision)
from jeit_solvers import SparsityPattern, analyse, factorise, in_turn, solve


def factorise_and_solve(plan, values, load):
    """Solve the task: from newly assembled `values` (nonzeros,) of an n × n matrix and a `load` (n, k) of k right-hand
    sides, compute the solution (n, k)."""
    return solve(plan, factorise(plan, values), load)


class JeitSolver:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        start = time.perf_counter()
        pattern = SparsityPattern.from_elements([problem["cells"], problem["facets"]], len(problem["points"]))
        plan = analyse(pattern, problem["points"])
        seconds = time.perf_counter() - start
        every, load = jnp.asarray(problem["values"]), jnp.asarray(problem["load"])
        each, count = list(every), len(every)
        factor_only, solve_only, both = jax.jit(factorise), jax.jit(solve), jax.jit(factorise_and_solve)
        batch = jax.jit(jax.vmap(in_turn(factorise_and_solve), in_axes=(None, 0, None)))
        ready = jax.block_until_ready
        self._factor = None

        def solve_again(_):
            if self._factor is None:
                self._factor = ready(factor_only(plan, each[0]))
            return ready(solve_only(plan, self._factor, load))

        self.description = f"JAX {jax.__version__}, nested dissection, multifrontal Cholesky"
        self.details = {"plan": seconds, "factor MB": 8 * plan.num_factor_entries / 1e6}
        self.tasks = {
            "factorise and solve": lambda k: ready(both(plan, each[k % count], load)),
            "factorise": lambda k: ready(factor_only(plan, each[k % count])),
            "solve": solve_again,
            "batch": lambda _: ready(batch(plan, every, load)),
        }
