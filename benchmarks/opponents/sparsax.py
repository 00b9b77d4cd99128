"""sparsax (CHOLMOD through XLA's foreign functions) as a contestant at the sparse solver's task, in a separate
environment.

sparsax analyses a sparsity pattern once, keeps the last factor, and factorises anew when the values change; every
repeat has another matrix. The three kinds of factorisation of sparsax are timed, and the fastest on this matrix is
kept.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import sparsax  # noqa: E402

from benchmarks.harness.timing import least_times  # noqa: E402

KINDS = ("auto", "simplicial", "supernodal")


class Sparsax:
    """`tasks` maps a task's name to a function of the number of the repeat, which selects the matrix."""

    def __init__(self, problem: dict[str, np.ndarray]):
        # sparsax reads the upper triangle of a matrix, problems contain the lower triangle.
        row, column = jnp.asarray(problem["columns"], jnp.int32), jnp.asarray(problem["rows"], jnp.int32)
        every, load = jnp.asarray(problem["values"]), jnp.asarray(problem["load"])
        each, count, size = list(every), len(every), len(problem["load"])
        ready = jax.block_until_ready
        both = jax.jit(lambda values: sparsax.solve(row, column, values, load))
        batch = jax.jit(jax.vmap(lambda values: sparsax.solve(row, column, values, load)))
        turn = iter(range(10**9))

        def next_one() -> None:
            ready(both(each[next(turn) % count]))

        spent = {}
        for kind in KINDS:
            sparsax.set_options(supernodal=kind)
            next_one()
            spent |= least_times({kind: next_one}, budget=1.0)
        best = min(spent, key=spent.__getitem__)
        sparsax.set_options(supernodal=best)
        jax.clear_caches()  # the first call compiles
        self._factor = None

        def solve(_):
            if self._factor is None:
                self._factor = ready(sparsax.factor(row, column, each[0], size))
            return ready(solve_only(self._factor, load))

        solve_only = jax.jit(sparsax.solve_factor)
        self.description = f"sparsax {sparsax.__version__}, JAX {jax.__version__}, {best}"
        self.details = {"ordering": best}
        self.tasks = {
            "factorise and solve": lambda k: ready(both(each[k % count])),
            "solve": solve,
            "batch": lambda _: ready(batch(every)),
        }
