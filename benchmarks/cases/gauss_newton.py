"""Five Gauss-Newton iterations, jeit beside pyEIT and SciPy: `python -m benchmarks.cases.gauss_newton`.

From the homogeneous background to noisy voltages of a disk with 16 electrodes. With complete electrodes, jeit and SciPy
minimise the same function, so their images must be the same. pyEIT has point electrodes and a regularisation of its
own; there, what counts is the misfit. See `README.md` in this folder for the contestants and how time is taken.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.harness import environment as pyeit_environment
from benchmarks.harness import machine
from benchmarks.harness.contest import CORES, ROOT, Contestant, Figures, compete
from benchmarks.harness.report import cell, duration, markdown, ratio, write_between_markers
from benchmarks.problems import disk as problem
from benchmarks.problems.accuracy import difference

HEADER = ["nodes", "electrodes", "contestant", "one image", "times jeit's", "compile", "misfit", "error of image"]
# Times faster than pyEIT asked for, up to so many nodes; and than SciPy.
AGAINST_PYEIT, AGAINST_SCIPY = ((2000, 100.0), (np.inf, 500.0)), 4.0
# Images of one function's minimum, after five steps.
AGREEMENT = 1e-6


def pose(num_points: int, model: str):
    """The problem's arrays, and jeit's model, by which the voltages are simulated and every misfit is taken."""
    from benchmarks.opponents.jeit_forward import JeitContestant

    arrays = problem.make(num_points, 16, model)
    simulator = JeitContestant(arrays)
    voltages, rest = (np.asarray(simulator.tasks[task](0)) for task in ("64 conductivities", "homogeneous"))
    problem.measure(arrays, voltages, rest)
    return arrays, simulator.voltages


def play(num_points: int, model: str, opponents: dict[str, str], rounds: int, limit: float, folder: Path):
    """Table rows and checks of one problem. `opponents`: name: interpreter."""
    arrays, predict = pose(num_points, model)
    path = folder / "problem.npz"
    problem.save(arrays, path)
    nodes, electrodes = len(arrays["points"]), "points" if model == "point" else "arcs"
    with ExitStack() as stack:
        players = {"jeit": sys.executable, **opponents}
        contestants = [stack.enter_context(Contestant(name, path, limit, python)) for name, python in players.items()]
        figures = compete(contestants, problem.GAUSS_NEWTON, rounds=rounds, budget=20.0, folder=folder)
        notes = [f"{one.name}, {nodes} nodes: {one.description}" for one in contestants]
    images = {name: _image(folder, name) for name, one in figures.items() if not one.remark}
    rows, checks = [], []
    truth, frame, noise = arrays["conductivities"][0], arrays["measured"][0], arrays["noise"]
    misfit = {name: _root_mean_square((predict(image) - frame) / noise) for name, image in images.items()}
    for name, one in figures.items():
        row = [str(nodes), electrodes, name, cell(one), ratio(one, figures["jeit"]), duration(one.compile)]
        if name in images:
            row += [f"{misfit[name]:.3f}", f"{100 * difference(images[name], truth):.2g} %"]
        rows.append(row + [""] * (len(HEADER) - len(row)))
        if name != "jeit" and name in images:
            checks.append(_check(nodes, name, one, figures["jeit"], misfit))
            if name.startswith("scipy") and difference(images[name], images["jeit"]) > AGREEMENT:
                raise SystemExit(f"{name} and jeit disagree by {difference(images[name], images['jeit']):.0e}.")
    return rows, [check for check in checks if check], notes


def _check(nodes: int, name: str, other: Figures, mine: Figures, misfit) -> list[str]:
    """What is asked, what was measured, and whether it is met; nothing for the tuned baseline."""
    if name == "scipy tuned":
        return []
    times = AGAINST_SCIPY if name != "pyeit" else next(t for most, t in AGAINST_PYEIT if nodes < most)
    faster = other.median / mine.median
    asked = f"{nodes} nodes: ≥ {times:g}× {name}, misfit no greater"
    met = faster >= times and misfit["jeit"] <= misfit[name] * (1 + 1e-6)
    measured = f"{faster:.1f}×, {misfit['jeit']:.3f} against {misfit[name]:.3f}"
    return [asked, measured, "met" if met else "missed"]


def _image(folder: Path, name: str) -> np.ndarray:
    with np.load(folder / f"{name}.npz") as arrays:
        return arrays["arr_0"]


def _root_mean_square(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> int:
    """Run, print the table and the checks, and return 1 if a figure is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.gauss_newton", description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1150, 5000])
    parser.add_argument("--rounds", type=int, default=15, help="turns each contestant has")
    parser.add_argument("--time-limit", type=float, default=1200.0, help="seconds for one image, then it has given up")
    parser.add_argument("--without-pyeit", action="store_true")
    parser.add_argument("--quick", action="store_true", help="a smoke run: one small mesh, figures not judged")
    parser.add_argument("--write-readme", action="store_true", help="put the table into benchmarks/README.md")
    options = parser.parse_args()
    if options.quick:
        options.nodes, options.rounds = [200], 2
    machine.use_cores(CORES)
    heading = machine.heading()
    pyeit = None if options.without_pyeit else pyeit_environment.python()
    scipy = dict.fromkeys(("scipy plain", "scipy tuned"), sys.executable)
    matches = {"complete": scipy, "point": {} if pyeit is None else {"pyeit": str(pyeit)}}
    rows, checks, notes = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for num_points in options.nodes:
            for model, opponents in matches.items():
                if opponents:
                    print(f"{num_points} nodes, {', '.join(opponents)} …", file=sys.stderr, flush=True)
                    found = play(num_points, model, opponents, options.rounds, options.time_limit, Path(folder))
                    for everything, new in zip((rows, checks, notes), found, strict=True):
                        everything += new
    text = "\n\n".join(
        [
            "\n".join(f"- {line}" for line in dict.fromkeys([*heading, *notes])),
            markdown(HEADER, rows),
            markdown(["asked", "measured", ""], checks),
        ]
    )
    print(text)
    if options.write_readme:
        write_between_markers(ROOT / "benchmarks" / "README.md", text, "gauss-newton")
    return int(not options.quick and any(check[-1] == "missed" for check in checks))


if __name__ == "__main__":
    raise SystemExit(main())
