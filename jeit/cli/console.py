"""Output of commands: progress of their steps, and tables of results."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jeit.arguments import interval_text, percent
from jeit.arguments.checks import Interval

if TYPE_CHECKING:
    from jeit.image import Inclusion


# Maximum width of a table, in characters.
_WIDTH = 80
# Seconds from which a step shows how long it has taken.
_SOME_SECONDS = 2.0
# Parts done of a step, and their share from which the time left is estimated. "12 of at most 60" states none.
_PARTS, _SOME_PARTS = re.compile(r"(\d[\d,]*) of (\d[\d,]*)"), 0.05
_PREFIXES = ((0, ""), (-3, "m"), (-6, "µ"), (-9, "n"))


def plain_console() -> Console:
    """Console for standard output without highlighting and markup, so that the content of files is printed
    unchanged."""
    return Console(highlight=False, markup=False)


class Steps:
    """Progress on standard output: the current step with a spinner, and completed steps with their duration.

    Call it with the name of each step when the step begins; `report` shows the progress within the step. Prints nothing
    if `quiet`.
    """

    def __init__(self, console: Console, *, quiet: bool):
        self.console = console
        self.quiet = quiet
        self._status = None
        self._step = ""
        self._start = 0.0

    def __call__(self, step: str) -> None:
        self._finish()
        self._step, self._start = step, time.perf_counter()
        if not self.quiet:
            self._status = self.console.status(_UnderWay(f"{step} …", self._start))
            self._status.start()

    @property
    def under_way(self) -> str:
        """Name of the current step; empty before the first."""
        return self._step

    def report(self, detail: str) -> None:
        """Show the progress within the current step beside its spinner; of a `detail` such as "frame 12 of 100" the
        time that is left, too."""
        if self._status is not None:
            parts = _PARTS.search(detail)
            done, number = (int(one.replace(",", "")) for one in parts.groups()) if parts else (0, 0)
            now = time.perf_counter()
            self._status.update(_UnderWay(f"{self._step} … {detail}", self._start, done, number, now))

    def __enter__(self) -> "Steps":
        return self

    def __exit__(self, kind, error, traceback) -> None:
        if kind is None:
            self._finish()
        elif self._status is not None:
            self._status.stop()

    def _finish(self) -> None:
        if self._status is None:
            return
        self._status.stop()
        self._status = None
        self.console.print(f"  {self._step:<24}{time.perf_counter() - self._start:6.1f} s", highlight=False)


@dataclass(frozen=True)
class _UnderWay:
    """Line beside the spinner: a step, and the seconds since its `start`, once it takes some; and those that are left
    at the same pace, where `done` and `number` of its parts are known and some are done."""

    step: str
    start: float
    done: int = 0
    number: int = 0
    reported: float = 0.0

    def __rich__(self) -> Text:
        seconds = time.perf_counter() - self.start
        said = f"{self.step}  {seconds:.0f} s" if seconds >= _SOME_SECONDS else self.step
        if seconds >= _SOME_SECONDS and _SOME_PARTS * self.number <= self.done < self.number:
            taken = self.reported - self.start
            left = max(taken * self.number / self.done - seconds, 0)
            said += f", about {_rounded(left)} left"
        return Text(said)


def _rounded(seconds: float) -> str:
    """A duration to one or two digits: an estimate has no more."""
    if seconds < 100:
        return f"{seconds:.0f} s" if seconds < 10 else f"{5 * round(seconds / 5)} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def pairs(title: str, rows: list[tuple[str, str]]) -> Table:
    """Create a table of names and values."""
    table = Table(title=title, title_justify="left", title_style="bold", show_header=False, box=None, padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    return table


def say_written(console: Console, first: Path, *others: str) -> None:
    """Print the names of the files written: the `first` with its folder, the others by name alone."""
    console.print(Text("Written:", "dim"), ", ".join([str(first), *others]), soft_wrap=True)


def scaled(value: float | None, unit: str) -> str:
    """Format a value with three digits and an SI prefix, such as "1.32 mS" for 0.00132 S."""
    if value is None:
        return "not known"
    value = float(f"{value:.3g}")  # 999.6 µS is 1 mS
    for exponent, prefix in _PREFIXES:
        if abs(value) >= 10.0**exponent:
            return f"{value / 10.0**exponent:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def in_one_unit(values: list[float], unit: str) -> tuple[str, list[str]]:
    """Format the values of a table column in one unit, with the SI prefix that suits the largest value; return the unit
    and the formatted values."""
    largest = float(f"{max((abs(value) for value in values), default=0.0):.3g}")
    exponent, prefix = next((pair for pair in _PREFIXES if largest >= 10.0 ** pair[0]), _PREFIXES[0])
    return f"{prefix}{unit}", [f"{value / 10.0**exponent:.3g}" for value in values]


def inclusion_table(inclusions: "Sequence[Inclusion]", unit: str, *, background: float | None = None) -> Table:
    """Create a table with a row for each inclusion: kind, place, size, and peak change of conductivity.

    `unit`: unit of conductivity. `background`: conductivity of the reference, if known.
    """
    unit, peaks = in_one_unit([one.peak for one in inclusions], unit)
    noun, size_unit, digits = _size(inclusions)
    more = ["of back-\nground"] if background else []
    rows = []
    for inclusion, peak in zip(inclusions, peaks, strict=True):
        share = [percent(inclusion.peak / background)] if background else []
        rows.append([f"{1e6 * inclusion.area:.{digits}f}", peak, *share])
    return _with_places(inclusions, [f"{noun}\n/ {size_unit}", f"peak change\n/ {unit}", *more], rows)


def quantity_table(inclusions: "Sequence[Inclusion]", background: float) -> Table:
    """Create a table of fitted bodies with 68 % intervals of their size, change of conductivity and strength.

    `background`: conductivity of the reference, S/m (2-D: S). If the data leave an end of an interval open, only the
    other end is given.
    """
    noun, unit, _ = _size(inclusions)
    rows = []
    for one in inclusions:
        measure = with_interval(one.area, one.area_interval, lambda value: _three_digits(1e6 * value))
        share = one.peak / background
        change = with_interval(share, one.contrast_interval, lambda value: _three_digits(100 * value, "+"))
        strength = with_interval(one.strength, one.strength_interval, lambda value: _three_digits(1e6 * value))
        rows.append([measure, change, strength])
    table = _with_places(inclusions, [f"{noun}\n/ {unit}", "change\n/ %", f"strength\n/ {unit}"], rows)
    table.caption, table.caption_justify = (
        "below size, change and strength their 68 % intervals; places have none",
        "left",
    )
    return table


def _three_digits(value: float, sign: str = "") -> str:
    """A number with three significant digits, and no exponent below a million."""
    return f"{float(f'{value:.3g}'):{sign}g}"


def with_interval(value: float | None, interval: Interval | None, written: Callable[[float], str]) -> str:
    """A value above its interval, as text; only the interval where one of its ends is open."""
    if value is None or interval is None:
        return "not known" if value is None else written(value)
    text = interval_text(interval, written)
    return text if None in interval else f"{written(value)}\n{text}"


def _size(inclusions: "Sequence[Inclusion]") -> tuple[str, str, int]:
    """What sizes are, their unit, and their number of decimals. The same factor 1e6 converts square metres to mm² and
    cubic metres to cm³."""
    return ("volume", "cm³", 2) if any(one.is_solid for one in inclusions) else ("area", "mm²", 0)


def _with_places(inclusions: "Sequence[Inclusion]", columns: list[str], rows: list[list[str]]) -> Table:
    """Create a table of inclusions by kind and place, with more `columns`, in 80 characters."""
    dimension = max((len(one.centroid) for one in inclusions), default=2)
    close = {"box": None, "padding": (0, 2), "collapse_padding": True}

    def table_of(parted: str) -> Table:
        """Create the table; `parted` separates the kind of a body from the word "column"."""
        table = Table("inclusion", *(f"{axis} / mm" for axis in "xyz"[:dimension]), *columns, **close)
        table.columns[0].min_width = max((len(one.kind) for one in inclusions), default=0)
        for column in table.columns[1:]:
            column.justify = "right"
        for inclusion, row in zip(inclusions, rows, strict=True):
            kind = f"{inclusion.kind}{parted}column" if inclusion.is_column else inclusion.kind
            table.add_row(kind, *(f"{1e3 * value:.1f}" for value in inclusion.centroid), *row)
        return table

    whole = table_of(" ")
    return whole if Console(width=_WIDTH + 1).measure(whole).maximum <= _WIDTH else table_of("\n")
