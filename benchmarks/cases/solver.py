"""jeit's sparse direct solver alone, compared with SuperLU and CHOLMOD (sparsax).

The task is to factorise a finite-element matrix with newly assembled values, and to solve for 16 right-hand sides, in
double precision, also for a batch of matrices with the same sparsity pattern. Every repeat has another matrix. The
analysis of a pattern (orderings, plans) is not timed, and compilation is timed separately.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.harness import environment
from benchmarks.harness.case import Case, Headline, Options, Result, Table
from benchmarks.harness.contest import Contestant, Figures, GaveUpError, compete, results_in
from benchmarks.harness.tables import cell, duration, markdown, megabytes, ratio
from benchmarks.harness.timing import say
from benchmarks.problems import matrices

MINE, BOTH = "jeit's solver", "factorise and solve"
OPPONENTS = ("SuperLU", "sparsax")
TASKS = (BOTH, "batch", "factorise", "solve")
DISKS = (1150, 5000, 20_000)
# Maximum residual of a direct solver, as a fraction of a right-hand side.
ACCURATE = 1e-10
HEADER = ["mesh", "nodes", "task", "jeit", "SuperLU", "", "sparsax", "", "compile: jeit / sparsax"]
HEADER += ["residual: jeit / SuperLU / sparsax", "peak memory: jeit / SuperLU / sparsax"]
PLANS = ["mesh", "nodes", "jeit's plan", "factor: jeit / SuperLU", "SuperLU's ordering", "CHOLMOD's kind"]


def run(options: Options) -> Result:
    """Measure the matrices of every mesh, one after the other."""
    jax = [f"{name}=={version(name)}" for name in ("jax", "jaxlib")]
    python = environment.python("sparsax", *jax, create=not options.quick)
    interpreters = {MINE: sys.executable, "SuperLU": sys.executable, "sparsax": python}
    disks = options.nodes or ((300,) if options.quick else DISKS)
    rows, plans, notes, wrong, headlines = [], [], [], [], {}
    for name, mesh in matrices.meshes(disks, solids=not (options.quick or options.nodes)).items():
        problem = matrices.make(mesh)
        say(f"{name}, {len(problem['points'])} nodes …")
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            path = Path(folder, "problem.npz")
            np.savez(path, allow_pickle=False, **problem)
            playing, reasons = _enter(stack, interpreters, path, options.time_limit or 120.0)
            rounds = options.rounds or (2 if options.quick else 15)
            found, bad, figures = _play(problem, playing, reasons, rounds, 0.5 if options.quick else 2.0, Path(folder))
        rows += [[name, str(len(problem["points"])), *row] for row in found]
        say(markdown(HEADER, rows[-len(found) :]))
        wrong += [f"{name}: {line}" for line in bad]
        plans.append([name, str(len(problem["points"])), *_plan({one.name: one.details for one in playing})])
        notes += [f"{one.name}: {one.description.split(', ')[0]}" for one in playing]
        notes += [f"{opponent} left out: {reason}" for opponent, reason in reasons.items()]
        headlines[len(problem["points"]), name] = _headline(name, len(problem["points"]), figures, found[0])
    near = min(headlines, key=lambda key: (not key[1].startswith("disk"), abs(key[0] - 5000)))
    tables = [Table(HEADER, rows), Table(PLANS, plans, "Made once for each pattern")]
    return Result(tables, [], list(dict.fromkeys(notes)), headlines[near], wrong)


def _enter(stack: ExitStack, interpreters: dict[str, str | None], path: Path, limit: float):
    """Start the contestants; return those that run, and the reasons why others do not."""
    playing, reasons = [], {}
    for name, python in interpreters.items():
        if python is None:
            reasons[name] = "not installed"
            continue
        try:
            playing.append(stack.enter_context(Contestant(name, path, limit, python)))
        except GaveUpError as reason:
            reasons[name] = str(reason)
    if MINE not in {one.name for one in playing}:
        raise RuntimeError(f"jeit itself does not run: {reasons[MINE]}")
    return playing, reasons


def _play(problem, playing: list[Contestant], reasons: dict[str, str], rounds: int, budget: float, folder: Path):
    """The table's rows for one problem, messages about inaccurate solutions, and the figures of a single matrix."""
    rows, wrong, alone = [], [], {}
    for task in TASKS:
        share = len(problem["values"]) if task == "batch" else 1
        solved = task != "factorise"
        figures = compete(playing, task, rounds=rounds, budget=budget, folder=folder if solved else None)
        figures |= {name: Figures(remark=reason) for name, reason in reasons.items()}
        able = [name for name, one in figures.items() if solved and not one.remark]
        left = {name: _residual(problem, folder / f"{name}.npz") for name in able}
        wrong += [f"{task}: {name} leaves {worst:.0e}" for name, worst in left.items() if not worst < ACCURATE]
        mine = figures[MINE]
        row = [f"{share} at once, each" if share > 1 else task, cell(mine, share)]
        for name in OPPONENTS:
            row += [cell(figures.get(name), share), ratio(figures.get(name), mine)]
        row.append(" / ".join(duration(figures[name].compile) for name in (MINE, "sparsax") if name in figures))
        row.append(" / ".join(f"{left[name]:.0e}" if name in left else "–" for name in (MINE, *OPPONENTS)))
        rows.append([*row, megabytes(*(figures.get(name) for name in (MINE, *OPPONENTS)))])
        alone = figures if task == BOTH else alone
    return rows, wrong, alone


def _residual(problem, path: Path) -> float:
    """The larger of the residuals of a contestant's first and last solution."""
    solutions = results_in(path)[0]
    if solutions.ndim == 2:
        return matrices.residual(problem, 0, solutions)
    return max(matrices.residual(problem, number, solutions[number]) for number in (0, len(solutions) - 1))


def _plan(details: dict[str, dict]) -> list[str]:
    """Text on the analysis of the sparsity pattern by each contestant."""
    superlu, cholmod = details.get("SuperLU", {}), details.get("sparsax", {})
    sizes = [f"{one['factor MB']:.1f} MB" if one else "–" for one in (details[MINE], superlu)]
    made = [duration(details[MINE]["plan"]), " / ".join(sizes)]
    return [*made, superlu.get("ordering", "–"), cholmod.get("ordering", "–")]


def _headline(mesh: str, nodes: int, figures: dict[str, Figures], row: list[str]) -> Headline:
    """The headline: jeit's time for a single matrix, compared with the fastest opponent."""
    others = {name: one for name, one in figures.items() if name in OPPONENTS and one.seconds and not one.remark}
    job = f"sparse factorisation and 16 solves, {mesh.split()[0]}, {nodes:,} nodes"
    if not others:
        return Headline(job, cell(figures[MINE]))
    name, best = min(others.items(), key=lambda pair: pair[1].median)
    residuals = dict(zip((MINE, *OPPONENTS), row[-2].split(" / "), strict=True))
    residual_text = f"residual {residuals[MINE]} against {residuals[name]}"
    label = "CHOLMOD (sparsax)" if name == "sparsax" else name
    return Headline(job, cell(figures[MINE]), f"{label}: {cell(best)}", ratio(best, figures[MINE]), residual_text)


CASE = Case("solver", "sparse factorisation and 16 solves, alone and in batches: beside SuperLU and CHOLMOD", run, 5)
