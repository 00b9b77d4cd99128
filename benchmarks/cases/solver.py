"""The sparse direct solver alone beside SuperLU: `python -m benchmarks.cases.solver` from the root of the repository.

One task: factorise a finite-element matrix whose values have just been assembled, and solve for 16 right-hand sides, in
double precision. Turns are interleaved, and the least time of all turns counts, because other work on the machine only
ever adds to it. SuperLU has every ordering SciPy offers, its symmetric mode, and its best ordering found once and kept,
with panels of one column; the best of all these counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.linalg import splu

import jeit
from benchmarks.harness import machine
from benchmarks.harness.report import markdown
from jeit.mesh import box, disk, gradients, layer, measures
from jeit_solvers import SparsityPattern, analyse, factorise, in_turn, solve

NUM_RIGHT_HAND_SIDES = 16
BATCH = 64
SYMMETRIC: dict[str, Any] = {"options": {"SymmetricMode": True}, "diag_pivot_thresh": 0.0}
HEADER = [
    "mesh",
    "nodes",
    "plan s",
    "compile s",
    "factor ms",
    "solve ms",
    "both ms",
    "SuperLU ms",
    "its ordering",
    "times faster",
    "residual",
    "SuperLU's",
    "factor MB",
    "SuperLU's MB",
    f"each of {BATCH} ms",
]


def main() -> None:
    """Measure every mesh and print the table."""
    options = _parse()
    machine.use_cores(2)
    meshes = {f"disk {count}": disk(1.0, num_points=count) for count in options.nodes}
    if not options.without_solids:
        meshes["box"] = box(1.0, 1.0, 1.0, num_points=10_000)
        meshes["layer"] = layer(disk(1.0, num_points=3000), 0.1, 4)
    print("\n".join(machine.heading()))
    print(markdown(HEADER, [measure(name, mesh, options.rounds) for name, mesh in meshes.items()]))


def measure(name: str, mesh: jeit.Mesh, rounds: int) -> list[str]:
    """One row of the table."""
    start = time.perf_counter()
    pattern = SparsityPattern.from_elements([mesh.cells, mesh.facets], mesh.num_points)
    plan = analyse(pattern, mesh.points)
    plan_seconds = time.perf_counter() - start
    values = assemble(mesh, pattern)
    load = jax.random.normal(jax.random.key(0), (mesh.num_points, NUM_RIGHT_HAND_SIDES))
    factor_only, solve_only, both = jax.jit(factorise), jax.jit(solve), jax.jit(factorise_and_solve)
    start = time.perf_counter()
    solution = np.asarray(both(plan, values, load))
    compile_seconds = time.perf_counter() - start
    factor = factor_only(plan, values)

    matrix = pattern.to_scipy(values).tocsc()
    right = np.asarray(load)
    opponents = superlu_variants(matrix)
    contestants: dict[str, Callable[[], Any]] = {
        "factor": lambda: factor_only(plan, values),
        "solve": lambda: solve_only(plan, factor, load),
        "both": lambda: both(plan, values, load),
        **{ordering: lambda f=f: f(right)[0] for ordering, f in opponents.items()},
    }
    small = mesh.num_points < 3000
    if small:
        batch = values * jnp.linspace(1.0, 2.0, BATCH)[:, None]
        many = jax.jit(jax.vmap(in_turn(factorise_and_solve), in_axes=(None, 0, None)))
        contestants["batch"] = lambda: many(plan, batch, load)
    least = interleaved(contestants, rounds)
    ordering = min(opponents, key=least.__getitem__)
    other_solution, other_entries = opponents[ordering](right)

    def residual(solution: np.ndarray) -> float:
        return float(np.linalg.norm(matrix @ solution - right) / np.linalg.norm(right))

    return [
        name,
        f"{mesh.num_points}",
        f"{plan_seconds:.2f}",
        f"{compile_seconds:.1f}",
        *(f"{1e3 * least[part]:.2f}" for part in ("factor", "solve", "both")),
        f"{1e3 * least[ordering]:.2f}",
        ordering,
        f"{least[ordering] / least['both']:.1f}",
        f"{residual(solution):.0e}",
        f"{residual(other_solution):.0e}",
        f"{8 * plan.num_factor_entries / 1e6:.1f}",
        f"{12 * other_entries / 1e6:.1f}",
        f"{1e3 * least['batch'] / BATCH:.2f}" if small else "",
    ]


def factorise_and_solve(plan, values, load):
    """The task."""
    return solve(plan, factorise(plan, values), load)


def assemble(mesh: jeit.Mesh, pattern: SparsityPattern) -> jax.Array:
    """Stiffness matrix of a random conductivity, from 0.1 to 10, and a resistive layer all over the boundary."""
    conductivity = 10.0 ** jax.random.uniform(jax.random.key(1), (mesh.num_cells,), minval=-1.0, maxval=1.0)
    slopes = gradients(mesh)
    stiffness = jnp.einsum("mid,mjd,m->mij", slopes, slopes, measures(mesh) * conductivity)
    nodes = mesh.facets.shape[1]
    boundary = jnp.ones((len(mesh.facets), nodes, nodes)) + jnp.eye(nodes)
    return pattern.assemble(stiffness, boundary / len(mesh.facets))


def superlu_variants(matrix) -> dict[str, Callable[[np.ndarray], tuple[np.ndarray, int]]]:
    """Ways to have SuperLU do the task; each returns the solution and the number of entries in its factors."""

    def run(right: np.ndarray, **options: Any) -> tuple[np.ndarray, int]:
        factor = splu(matrix, **options)
        return factor.solve(right), factor.nnz

    variants: dict[str, Callable[[np.ndarray], tuple[np.ndarray, int]]] = {
        "COLAMD": lambda right: run(right, permc_spec="COLAMD"),
        "MMD_ATA": lambda right: run(right, permc_spec="MMD_ATA"),
        "MMD_AT_PLUS_A": lambda right: run(right, permc_spec="MMD_AT_PLUS_A"),
        "symmetric": lambda right: run(right, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC),
    }
    order = np.argsort(splu(matrix, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).perm_c)
    # The values would arrive in this order, as they arrive in jeit's own.
    permuted = matrix[order][:, order].tocsc()

    def kept_order(right: np.ndarray) -> tuple[np.ndarray, int]:
        factor = splu(permuted, permc_spec="NATURAL", panel_size=1, **SYMMETRIC)
        solution = np.empty_like(right)
        solution[order] = factor.solve(right[order])
        return solution, factor.nnz

    variants["symmetric, kept"] = kept_order
    return variants


def interleaved(contestants: dict[str, Callable[[], Any]], rounds: int, budget: float = 20.0) -> dict[str, float]:
    """Least time in seconds of each contestant, one turn each in every round; slow ones sit out later rounds."""
    least, spent = dict.fromkeys(contestants, np.inf), dict.fromkeys(contestants, 0.0)
    for number in range(rounds + 1):
        for name, task in contestants.items():
            if number > 3 and spent[name] > budget / len(contestants):
                continue
            start = time.perf_counter()
            jax.block_until_ready(task())
            seconds = time.perf_counter() - start
            spent[name] += seconds
            if number:  # the first round compiles
                least[name] = min(least[name], seconds)
    return least


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.solver", description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1150, 5000, 20000], help="sizes of the disks")
    parser.add_argument("--rounds", type=int, default=200, help="turns of each contestant, time permitting")
    parser.add_argument("--without-solids", action="store_true", help="leave out the box and the layer")
    return parser.parse_args()


if __name__ == "__main__":
    main()
