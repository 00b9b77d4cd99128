"""Figures as text, and tables of figures as Markdown."""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.harness.contest import Figures


def duration(seconds: float) -> str:
    """Text of a time with three digits and a suitable unit."""
    if math.isnan(seconds):
        return "–"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            value = seconds / size
            return f"{value:.{max(0, 2 - math.floor(math.log10(value)))}f} {unit}"
    return "0 s"


def times(value: float) -> str:
    """A ratio as text, with "×"."""
    return f"{value:.0f}×" if value >= 20 else f"{value:.1f}×" if value >= 0.95 else f"{value:.2f}×"


def cell(figures: Figures | None, share: int = 1) -> str:
    """Text of the median time of a contestant, divided by `share`, or of the reason why there is none."""
    if figures is None:
        return "–"
    return figures.remark if figures.remark or not figures.seconds else duration(figures.median / share)


def ratio(figures: Figures | None, reference: Figures) -> str:
    """Text of the ratio of a contestant's median time to that of the `reference`."""
    if figures is None or figures.remark or not figures.seconds or not reference.seconds:
        return ""
    return times(figures.median / reference.median)


def megabytes(*figures: Figures | None) -> str:
    """Text of the peak memory of each contestant, separated by slashes."""
    return " / ".join("–" if one is None or one.peak is None else f"{one.peak:.0f} MB" for one in figures)


def markdown(header: list[str], rows: list[list[str]], *, padded: bool = True) -> str:
    """A Markdown table. If `padded`, it is readable as plain text too."""
    shown = [header, *rows] if padded else [["---"] * len(header)]
    widths = [max(len(row[column]) for row in shown) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def write_between_markers(path: Path, text: str, name: str = "benchmark") -> None:
    """Replace the text between the markers called `name` in a file. Raises `ValueError` if the file has no such
    markers."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    content = path.read_text(encoding="utf-8")
    if content.count(begin) != 1 or content.count(end) != 1:
        raise ValueError(f"{path.name} needs the lines {begin} and {end}, once each, where the table is to go.")
    before, rest = content.split(begin)
    _, after = rest.split(end)
    path.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")
