"""One match: a mesh, a number of electrodes, an electrode model, and the contestants that can take part."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.harness.contest import Contestant, Figures, GaveUpError, compete, results_in
from benchmarks.harness.memory import available_memory
from benchmarks.problems import disk as problems
from benchmarks.problems.accuracy import difference, exact_voltages

TASKS = ("voltages", "voltages and Jacobian", "linear image", "1000 linear images", "64 conductivities", "64 Jacobians")
# Maximum fraction of the free memory for 64 Jacobians, or for pyEIT's dense inverse with its copies.
MEMORY_SHARE = 0.5
# Results of direct solvers on the same discretisation may differ by the condition number times rounding.
AGREEMENT = 1e-9


@dataclass
class Settings:
    """Settings of a match: limits of time, and the Python interpreter with pyEIT (None: pyEIT is left out)."""

    rounds: int
    budget: float
    limit: float
    pyeit_python: str | None
    tasks: tuple[str, ...] = TASKS


@dataclass
class Match:
    """Figures of all contestants for all tasks on one problem."""

    num_points: int
    num_cells: int
    num_electrodes: int
    num_channels: int
    model: str
    figures: dict[str, dict[str, Figures]] = field(default_factory=dict)
    accuracy: dict[str, float] = field(default_factory=dict)
    error: float = float("nan")
    descriptions: list[str] = field(default_factory=list)

    @property
    def agreed(self) -> bool:
        """Whether every result of jeit equals the opponent's result up to rounding errors."""
        return all(value < AGREEMENT for value in self.accuracy.values())


def play(
    num_points: int, num_electrodes: int, model: str, settings: Settings, before: list[Match], folder: Path
) -> Match:
    """Time all tasks on one problem. `before`: earlier matches, from which pyEIT's time is predicted."""
    problem = problems.make(num_points, num_electrodes, model)
    path = folder / "problem.npz"
    problems.save(problem, path)
    match = Match(len(problem["points"]), len(problem["cells"]), num_electrodes, len(problem["drive_index"]), model)
    if model == "complete":
        opponents = {"scipy plain": sys.executable, "scipy tuned": sys.executable}
    else:
        opponents = {} if settings.pyeit_python is None else {"pyeit": settings.pyeit_python}
    with ExitStack() as stack:

        def enter(name: str, python: str) -> Contestant | None:
            try:
                contestant = stack.enter_context(Contestant(name, path, settings.limit, python))
            except GaveUpError as reason:
                match.descriptions.append(f"{name} left out: {reason}")
                return None
            kind = f"{match.num_points} nodes, {num_electrodes} electrodes" if name.startswith("scipy") else ""
            match.descriptions.append(": ".join(filter(None, [name, kind, contestant.description])))
            return contestant

        jeit = enter("jeit", sys.executable)
        if jeit is None:
            raise RuntimeError("jeit itself does not run; see the messages above.")
        # The first calls are timed before other tasks compile the code that the tasks share.
        first = {task: jeit.ask(do="first", task=task)["seconds"] for task in TASKS[:2]}
        if model == "complete":
            problem["reconstruction"] = jeit.save("reconstruction matrix", folder / "matrix.npz")[0]
            problems.save(problem, path)
        others = [enter(name, python) for name, python in opponents.items()]
        _play_tasks(match, [jeit, *[other for other in others if other is not None]], settings, before, folder)
        for task, seconds in first.items():
            match.figures[task]["jeit"].first = seconds
        match.error = difference(jeit.save("homogeneous", folder / "result.npz")[0], exact_voltages(problem))
    return match


def _play_tasks(
    match: Match, contestants: list[Contestant], settings: Settings, before: list[Match], folder: Path
) -> None:
    """Measure every task that fits in memory, and the differences of jeit's results from those of the first
    opponent."""
    for task in settings.tasks:
        if (match.model == "point" and task not in TASKS[:2]) or not _fits(match, task):
            continue
        foreseen = _foresee(match, task, settings, before)
        playing = [one for one in contestants if one.name not in foreseen and task in one.tasks]
        left = folder if len(playing) > 1 else None
        figures = compete(playing, task, rounds=settings.rounds, budget=settings.budget, folder=left)
        match.figures[task] = figures | foreseen
        able = [one.name for one in playing if not figures[one.name].remark]
        if left is not None and len(able) > 1:
            _compare(match, task, [results_in(folder / f"{name}.npz") for name in able[:2]])


def _fits(match: Match, task: str) -> bool:
    """Whether the results of 64 Jacobians fit in memory beside their intermediate values."""
    size = 64 * match.num_channels * match.num_cells * 8
    return task != "64 Jacobians" or 3 * size < MEMORY_SHARE * available_memory()


def _foresee(match: Match, task: str, settings: Settings, before: list[Match]) -> dict[str, Figures]:
    """Figures of pyEIT with the predicted reason why it cannot finish, or an empty dictionary. For the Jacobian, pyEIT
    inverts the dense matrix of n nodes: n³ operations, three copies of n² numbers.
    """
    if match.model != "point" or task != "voltages and Jacobian" or settings.pyeit_python is None:
        return {}
    for earlier in reversed(before):
        known = earlier.figures.get(task, {}).get("pyeit")
        if earlier.num_electrodes == match.num_electrodes and known is not None and known.seconds:
            # Between the loop over cells (n) and the inverse (n³), n² is a prediction in pyEIT's favour.
            expected = known.median * (match.num_points / earlier.num_points) ** 2
            if expected > settings.limit:
                return {"pyeit": Figures(remark=f"> {expected:.0f} s expected, not run")}
    if 4 * 8 * match.num_points**2 > MEMORY_SHARE * available_memory():
        return {"pyeit": Figures(remark="no memory for a dense inverse")}
    return {}


def _compare(match: Match, task: str, results: list[list[np.ndarray]]) -> None:
    """Record the relative differences between jeit's results and those of the first opponent."""
    for name, mine, other in zip(("v", "J"), *results, strict=False):
        label = name if task in TASKS[:2] else ""
        match.accuracy[f"{task} {label}".strip()] = difference(np.asarray(mine), np.asarray(other))
