"""The table, as Markdown, and its place in the README."""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.cases.forward.match import Match
from benchmarks.harness.contest import Figures


def duration(seconds: float) -> str:
    """A time with three figures and a fitting unit."""
    if math.isnan(seconds):
        return "–"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            value = seconds / size
            return f"{value:.{max(0, 2 - math.floor(math.log10(value)))}f} {unit}"
    return "0 s"


def cell(figures: Figures | None) -> str:
    """Median time of a contestant, or why there is none."""
    if figures is None:
        return "–"
    return figures.remark if figures.remark or not figures.seconds else duration(figures.median)


def ratio(figures: Figures | None, reference: Figures) -> str:
    """How many times longer than the reference."""
    if figures is None or figures.remark or not figures.seconds or not reference.seconds:
        return ""
    value = figures.median / reference.median
    return f"{value:.0f}×" if value >= 20 else f"{value:.1f}×"


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


def table(matches: list[Match]) -> str:
    """All figures: one row for each task and problem."""
    tasks = list(dict.fromkeys(task for match in matches for task in match.figures))
    rows = []
    for task in tasks:
        for match in matches:
            if task in match.figures:
                rows.append(_row(task, match))
    return markdown(HEADER, rows)


def _row(task: str, match: Match) -> list[str]:
    figures = match.figures[task]
    mine = figures["jeit"]
    row = [task, str(match.num_points), str(match.num_electrodes), match.model, cell(mine)]
    for name in ("scipy plain", "scipy tuned", "pyeit"):
        row += [cell(figures.get(name)), ratio(figures.get(name), mine)]
    opponent = figures.get("scipy plain") or figures.get("pyeit")
    peaks = " / ".join("–" if one is None or one.peak is None else f"{one.peak:.0f} MB" for one in (mine, opponent))
    accuracy = [(key[len(task) :].strip(), value) for key, value in match.accuracy.items() if _belongs(key, task)]
    differences = ", ".join(f"{label} {value:.0e}".strip() for label, value in accuracy) or "–"
    error = f"{100 * match.error:.2g} %" if task == "voltages" else ""
    return [*row, duration(mine.compile), peaks, differences, error]


def _belongs(key: str, task: str) -> bool:
    return key in (task, f"{task} v", f"{task} J")


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table, padded so that it reads as plain text too."""
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def write_between_markers(path: Path, text: str, name: str = "benchmark") -> None:
    """Replace what stands between the markers of this name in a file. Raises `ValueError` if it has no markers."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    content = path.read_text(encoding="utf-8")
    if content.count(begin) != 1 or content.count(end) != 1:
        raise ValueError(f"{path.name} needs the lines {begin} and {end}, once each, where the table is to go.")
    before, rest = content.split(begin)
    _, after = rest.split(end)
    path.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")
