"""The direct solver from a thousand nodes up, in the plane and in space, beside PARDISO.

Tasks for one matrix A of a forward model, with newly assembled values, and the loads b of 32 electrodes: factorise and
solve, as for fields; and factorise and multiply (bᵀA⁻¹b), which suffices for voltages. The analysis of the sparsity
pattern is timed separately. Every repeat has another matrix. A second table has larger solids, solved by multigrid.
"""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.harness import environment
from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.contest import Contestant, Figures, GaveUpError, compete, results_in
from benchmarks.harness.tables import cell, duration, markdown, megabytes, ratio
from benchmarks.harness.timing import say
from benchmarks.problems import matrices

MINE, OTHER, ITERATIVE = "jeit's fronts", "PARDISO", "jeit's multigrid"
SOLVED, MULTIPLIED = "factorise and solve", "factorise and multiply"
SIZES = {"disk": (1_000, 5_000, 20_000, 100_000), "cylinder": (1_000, 10_000, 20_000, 50_000, 100_000, 280_000)}
# Maximum ratio of jeit's time to PARDISO's for voltages, and maximum residual of a solution relative to its load.
ASKED, ACCURATE = 1.2, 1e-12
# Numbers of nodes of the cylinders that multigrid solves. Limits of seconds and megabytes for the voltages of the
# largest cylinder, including meshing, and of the residual of a solution.
LARGE, SECONDS, MEGABYTES, CLOSE = (50_000, 280_000, 1_000_000), 300.0, 12_000, 1e-10
LARGE_HEADER = ["nodes", "mesh and matrices", "32 solutions", "residual", "peak memory of the solutions"]
HEADER = ["body", "nodes", "plan", "operations", "voltages: factor, multiply", "fields: factor, 32 solves"]
HEADER += ["PARDISO: factor, 32 solves", "voltages against PARDISO", "fields against PARDISO", "residual"]
HEADER += ["peak memory: jeit / PARDISO"]


def run(options: Options) -> Result:
    """Measure every body and size, one after the other."""
    python = environment.python("pardiso", create=not options.quick)
    interpreters = {MINE: sys.executable, OTHER: python}
    sizes = {"disk": (500,), "cylinder": (800,)} if options.quick else SIZES
    rows, asked, notes, wrong = [], [], [], []
    seconds: dict[str, list[tuple[int, float, float]]] = {}
    for body, counts in sizes.items():
        for count in options.nodes or counts:
            problem = _problem(body, count)
            nodes = len(problem["load"])
            say(f"{body}, {nodes} nodes …")
            found, residual, plan, remarks = _play(problem, interpreters, options)
            notes += remarks
            mine, fields, other = (found.get(key) for key in ((MINE, MULTIPLIED), (MINE, SOLVED), (OTHER, SOLVED)))
            assert mine is not None
            assert fields is not None
            row = [body, f"{nodes:,}", duration(plan["plan"]), f"{plan['operations']:.1e}", cell(mine), cell(fields)]
            row += [cell(other), ratio(mine, other) if other else "", ratio(fields, other) if other else ""]
            rows.append([*row, f"{residual:.0e}", megabytes(fields, other)])
            say(markdown(HEADER, rows[-1:]))
            seconds.setdefault(body, []).append((nodes, mine.median, other.median if other else np.nan))
            if not residual < ACCURATE:
                wrong.append(f"{body}, {nodes} nodes: {residual:.0e} of the load is left")
            if other is not None and body == "cylinder" and nodes > 9_000:
                against = mine.median / other.median
                asked.append(judged(f"{nodes:,} nodes ≤ {ASKED} × PARDISO", f"{against:.2f} ×", against <= ASKED))
    large = _large(options, asked, wrong)
    notes += [f"{body}: {_growth(points)}" for body, points in seconds.items() if len(points) > 2]
    if options.output is not None:
        _draw(options.output / "scaling.png", seconds)
    return Result([Table(HEADER, rows), large], asked, list(dict.fromkeys(notes)), wrong=wrong)


def _problem(body: str, count: int) -> dict[str, np.ndarray]:
    """Matrices of a forward model of about `count` nodes with random conductivities, and the loads of its
    electrodes."""
    from jeit.electrodes import BoundaryElectrodes, FacePatches
    from jeit.electrodes.face_patches import body_mesh
    from jeit.forward.system import System
    from jeit.layout import ring
    from jeit.mesh import Disk, Solid
    from jeit_solvers.engines import on_host

    if body == "disk":
        domain, electrodes = Disk(0.1), BoundaryElectrodes(ring(0.1, 32), 0.01, 0.01)
    else:
        domain = Solid(Disk(0.1), 0.1)
        round_it = np.tile(ring(0.1, 16), (2, 1))
        places = np.column_stack([round_it, np.repeat([0.033, 0.067], 16)])
        electrodes = FacePatches(places, 0.015, 0.015, 0.01)
    mesh = body_mesh(domain, electrodes, count)
    system = System.create(mesh, electrodes, "cg")
    rng, contact = np.random.default_rng(0), on_host(electrodes.contact(mesh))
    made = [
        on_host(system.grounded_system(on_host(mesh), 10.0 ** rng.uniform(-1, 1, mesh.num_cells), electrodes, contact))
        for _ in range(2)
    ]
    return {
        "points": np.asarray(mesh.points),
        "rows": np.asarray(system.pattern.rows),
        "columns": np.asarray(system.pattern.columns),
        "values": np.stack([np.asarray(operator.values) for operator, _ in made]),
        "load": np.asarray(made[0][1])[:, :32],
    }


def _play(
    problem: dict[str, np.ndarray],
    interpreters: dict[str, str | None],
    options: Options,
    tasks: tuple[str, ...] = (SOLVED, MULTIPLIED),
):
    """Figures of each contestant and task, the largest residual, details of the analysis, and the reasons why
    contestants did not run."""
    found: dict[tuple[str, str], Figures] = {}
    remarks, left = [], 0.0
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder, "problem.npz")
        np.savez(path, allow_pickle=False, **problem)
        playing = []
        for name, python in interpreters.items():
            try:
                if python is None:
                    raise GaveUpError("not installed")
                playing.append(stack.enter_context(Contestant(name, path, options.time_limit or 300.0, python)))
            except GaveUpError as reason:
                remarks.append(f"{name} left out: {reason}")
        rounds, budget = options.rounds or (1 if options.quick else 9), 0.3 if options.quick else 6.0
        for task in tasks:
            figures = compete(playing, task, rounds=rounds, budget=budget, folder=Path(folder))
            found |= {(name, task): one for name, one in figures.items() if not one.remark}
            if task == SOLVED:
                solved = [name for name, one in figures.items() if not one.remark]
                results = [results_in(Path(folder, f"{name}.npz"))[0] for name in solved]
                left = max(matrices.residual(problem, 0, one) for one in results)
        details = playing[0].details
    return found, left, details, remarks


def _large(options: Options, asked: list, wrong: list[str]) -> Table:
    """A table of cylinders that multigrid solves."""
    rows = []
    counts = (800,) if options.quick else tuple(one for one in options.nodes or LARGE if one >= min(LARGE))
    for count in counts:
        start = time.perf_counter()
        problem = _problem("cylinder", count)
        made, nodes = time.perf_counter() - start, len(problem["load"])
        say(f"cylinder by multigrid, {nodes} nodes …")
        found, residual, _, _ = _play(problem, {ITERATIVE: sys.executable}, options, (SOLVED,))
        one = found[ITERATIVE, SOLVED]
        rows.append([f"{nodes:,}", duration(made), cell(one), f"{residual:.0e}", megabytes(one)])
        say(markdown(LARGE_HEADER, rows[-1:]))
        if not residual < CLOSE:
            wrong.append(f"cylinder by multigrid, {nodes} nodes: {residual:.0e} of the load is left")
        if count == LARGE[-1]:
            met = made + one.median < SECONDS and (one.peak or 0) < MEGABYTES
            asked.append(judged(f"a million nodes ≤ {SECONDS:g} s and {MEGABYTES / 1e3:g} GB", cell(one), met))
    return Table(LARGE_HEADER, rows)


def _growth(points: list[tuple[int, float, float]]) -> str:
    """Text of the exponents with which time grows with the number of nodes, from the larger half of the sizes."""
    nodes, mine, other = np.array(points[len(points) // 2 - 1 :]).T
    terms = [f"{name} as nodes to the {np.polyfit(np.log(nodes), np.log(one), 1)[0]:.2f}"
            for name, one in (("jeit", mine), (OTHER, other)) if np.isfinite(one).all()]  # fmt: skip
    return "time grows " + ", ".join(terms)


def _draw(path: Path, seconds: dict[str, list[tuple[int, float, float]]]) -> None:
    """Draw seconds against nodes on logarithmic axes, with the theoretical growth of nested dissection."""
    from matplotlib.figure import Figure

    figure = Figure((7.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for (body, points), colour, power in zip(seconds.items(), ("#1f77b4", "#d95f02"), (1.5, 2.0), strict=False):
        nodes, mine, other = np.array(points).T
        axes.loglog(nodes, mine, "o-", color=colour, label=f"{body}: jeit")
        axes.loglog(nodes, other, "s--", color=colour, alpha=0.6, label=f"{body}: {OTHER}")
        axes.loglog(
            nodes, mine[-1] * (nodes / nodes[-1]) ** power, ":", color="0.6", label=f"{body}: nodes to the {power:g}"
        )
    axes.set(xlabel="nodes", ylabel="factorisation and 32 loads, s", title="Voltages of 32 electrodes")
    axes.grid(which="both", alpha=0.2)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=140)


CASE = Case("scaling", "the direct solver from a thousand nodes up, in the plane and in space: beside PARDISO", run, 8)
