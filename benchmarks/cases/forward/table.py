"""The contest's table: one row for each task and problem."""

from __future__ import annotations

from benchmarks.cases.forward.match import Match
from benchmarks.harness.case import Table
from benchmarks.harness.tables import cell, duration, megabytes, ratio

HEADER = [
    "task",
    "nodes",
    "electrodes",
    "model",
    "jeit",
    "SciPy",
    "",
    "SciPy, tuned",
    "",
    "pyEIT",
    "",
    "jeit compile",
    "peak memory: jeit / SciPy or pyEIT",
    "difference from opponent",
    "error of voltages",
]


def table(matches: list[Match]) -> Table:
    """A table of all figures, ordered by task."""
    tasks = list(dict.fromkeys(task for match in matches for task in match.figures))
    return Table(HEADER, [_row(task, match) for task in tasks for match in matches if task in match.figures])


def _row(task: str, match: Match) -> list[str]:
    figures = match.figures[task]
    mine = figures["jeit"]
    row = [task, str(match.num_points), str(match.num_electrodes), match.model, cell(mine)]
    for name in ("scipy plain", "scipy tuned", "pyeit"):
        row += [cell(figures.get(name)), ratio(figures.get(name), mine)]
    opponent = figures.get("scipy plain") or figures.get("pyeit")
    accuracy = [(key[len(task) :].strip(), value) for key, value in match.accuracy.items() if _belongs(key, task)]
    differences = ", ".join(f"{label} {value:.0e}".strip() for label, value in accuracy) or "–"
    error = f"{100 * match.error:.2g} %" if task == "voltages" else ""
    return [*row, duration(mine.compile), megabytes(mine, opponent), differences, error]


def _belongs(key: str, task: str) -> bool:
    return key in (task, f"{task} v", f"{task} J")
