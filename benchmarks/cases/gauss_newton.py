"""Five Gauss-Newton iterations: jeit beside pyEIT and SciPy.

The iterations start from the homogeneous background and fit noisy voltages of a disk with 16 electrodes. With the
complete electrode model, jeit and SciPy minimise the same function, so their images must be equal. pyEIT has point
electrodes and a different regularisation, so only the misfit is compared. See the folder's `README.md` for the
contestants and the timing.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import environment
from benchmarks.harness.case import NOT_MEASURED, Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.contest import Contestant, Figures, GaveUpError, compete, results_in
from benchmarks.harness.tables import cell, duration, markdown, megabytes, ratio
from benchmarks.harness.timing import say
from benchmarks.opponents.jeit_forward import JeitContestant
from benchmarks.problems import disk as problem
from benchmarks.problems.accuracy import difference

HEADER = ["nodes", "electrodes", "contestant", "one image", "times jeit's", "compile", "misfit", "error of image"]
HEADER += ["peak memory"]
NODES, ROUNDS, BUDGET, LIMIT = (1150, 5000), 15, 6.0, 600.0
# Required ratios of pyEIT's time to jeit's, each up to a number of nodes, and of SciPy's time to jeit's.
AGAINST_PYEIT, AGAINST_SCIPY = ((2000, 100.0), (np.inf, 500.0)), 4.0
# Maximum relative difference of images after five steps of minimising the same function.
AGREEMENT = 1e-6


def pose(num_points: int, model: str):
    """The arrays of a problem, and a function of jeit's model that simulates the voltages and computes every misfit."""
    arrays = problem.make(num_points, 16, model)
    simulator = JeitContestant(arrays)
    voltages, rest = (np.asarray(simulator.tasks[task](0)) for task in ("64 conductivities", "homogeneous"))
    problem.measure(arrays, voltages, rest)
    return arrays, simulator.voltages


def run(options: Options) -> Result:
    """Run both electrode models on every mesh."""
    pyeit = None if options.without_pyeit else environment.python("pyeit", create=not options.quick)
    scipy = dict.fromkeys(("scipy plain", "scipy tuned"), sys.executable)
    matches = {"complete": scipy, "point": {} if pyeit is None else {"pyeit": pyeit}}
    rows, asked, notes, wrong, headline = [], [], [], [], None
    for num_points in options.nodes or ((200,) if options.quick else NODES):
        for model, opponents in matches.items():
            if not opponents:
                asked += _left_out(num_points)
                continue
            say(f"{num_points} nodes, {', '.join(opponents)} …")
            match = play(num_points, model, opponents, options)
            say(markdown(HEADER, match.rows))
            rows += match.rows
            asked += match.asked
            notes += match.notes
            wrong += match.wrong
            headline = match.headline or headline
    return Result([Table(HEADER, rows)], asked, list(dict.fromkeys(notes)), headline, wrong)


@dataclass
class Match:
    """Results of one problem: the time, image, misfit and distance from the truth of each contestant."""

    nodes: int
    electrodes: str
    figures: dict[str, Figures]
    images: dict[str, np.ndarray]
    misfit: dict[str, float]
    error: dict[str, float]
    notes: list[str]

    @property
    def rows(self) -> list[list[str]]:
        """The rows of the table for this match."""
        mine, rows = self.figures["jeit"], []
        for name, one in self.figures.items():
            row = [str(self.nodes), self.electrodes, name, cell(one), ratio(one, mine), duration(one.compile)]
            known = name in self.images
            row += [f"{self.misfit[name]:.3f}", f"{100 * self.error[name]:.2g} %"] if known else ["", ""]
            rows.append([*row, megabytes(one)])
        return rows

    @property
    def asked(self) -> list[Asked]:
        """The required figures, compared with the measured figures. Nothing is required in comparison with the tuned
        baseline."""
        return [_asked(self, name) for name in self.figures if name not in ("jeit", "scipy tuned")]

    @property
    def wrong(self) -> list[str]:
        """Messages about contestants whose images differ although they minimise the same function."""
        mine, wrong = self.images["jeit"], []
        for name, image in self.images.items():
            if name.startswith("scipy") and difference(image, mine) > AGREEMENT:
                wrong.append(f"{self.nodes} nodes: {name} and jeit disagree by {difference(image, mine):.0e}")
        return wrong

    @property
    def headline(self) -> Headline | None:
        """The headline: jeit compared with the faster SciPy contestant."""
        others = {name: self.figures[name] for name in self.images if name.startswith("scipy")}
        if not others:
            return None
        name, best = min(others.items(), key=lambda pair: pair[1].median)
        mine = self.figures["jeit"]
        label = {"scipy plain": "SciPy", "scipy tuned": "SciPy, tuned"}[name]
        job = f"five Gauss-Newton iterations, {self.nodes:,} nodes, 16 electrodes"
        same = f"same image to {difference(self.images[name], self.images['jeit']):.0e}"
        return Headline(job, cell(mine), f"{label}: {cell(best)}", ratio(best, mine), same)


def play(num_points: int, model: str, opponents: dict[str, str], options: Options) -> Match:
    """Run one problem. `opponents`: Python interpreter of each opponent by name. An opponent that does not run is left
    out, and a note states why."""
    arrays, predict = pose(num_points, model)
    rounds, budget = options.rounds or (2 if options.quick else ROUNDS), 0.5 if options.quick else BUDGET
    nodes, contestants, notes = len(arrays["points"]), [], []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = folder / "problem.npz"
        problem.save(arrays, path)
        for name, python in {"jeit": sys.executable, **opponents}.items():
            try:
                one = stack.enter_context(Contestant(name, path, options.time_limit or LIMIT, python))
            except GaveUpError as reason:
                notes.append(f"{name}, {nodes} nodes, left out: {reason}")
                continue
            contestants.append(one)
            notes.append(f"{name}, {nodes} nodes: {one.description}")
        figures = compete(contestants, problem.GAUSS_NEWTON, rounds=rounds, budget=budget, folder=folder)
        images = {name: results_in(folder / f"{name}.npz")[0] for name, one in figures.items() if not one.remark}
    truth, frame, noise = arrays["conductivities"][0], arrays["measured"][0], arrays["noise"]
    misfit = {name: _root_mean_square((predict(image) - frame) / noise) for name, image in images.items()}
    error = {name: difference(image, truth) for name, image in images.items()}
    electrodes = "points" if model == "point" else "arcs"
    return Match(nodes, electrodes, figures, images, misfit, error, notes)


def _asked(match: Match, name: str) -> Asked:
    """The requirement on jeit beside an opponent, the measured figure, and whether it is met."""
    most = AGAINST_SCIPY if name != "pyeit" else next(t for most, t in AGAINST_PYEIT if match.nodes < most)
    asked = f"{match.nodes} nodes: ≥ {most:g}× {name}, misfit no greater"
    if name not in match.images or "jeit" not in match.images:
        return Asked(asked, match.figures[name].remark, NOT_MEASURED)
    faster = match.figures[name].median / match.figures["jeit"].median
    met = faster >= most and match.misfit["jeit"] <= match.misfit[name] * (1 + 1e-6)
    return judged(asked, f"{faster:.1f}×, {match.misfit['jeit']:.3f} against {match.misfit[name]:.3f}", met)


def _left_out(num_points: int) -> list[Asked]:
    most = next(t for most, t in AGAINST_PYEIT if num_points < most)
    return [Asked(f"{num_points} nodes: ≥ {most:g}× pyeit, misfit no greater", "pyEIT left out", NOT_MEASURED)]


def _root_mean_square(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


CASE = Case("gauss_newton", "five Gauss-Newton iterations: jeit beside pyEIT and SciPy on one objective", run, 5)
