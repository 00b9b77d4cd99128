"""Output of the commands: progress of their steps, and tables of results."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jeit.arguments import percent

if TYPE_CHECKING:
    from jeit.image import Inclusion


# Number of columns that all properties of a body fit into.
_WIDTH = 80
_PREFIXES = ((0, ""), (-3, "m"), (-6, "µ"), (-9, "n"))


def plain_console() -> Console:
    """Standard output on which text is shown as it is: the content of files is never interpreted as rich's markup."""
    return Console(highlight=False, markup=False)


class Steps:
    """Progress on standard output: the step under way with a spinner, steps done with the seconds they took.

    Call it with the name of each step as it begins; `report` says how far it is. Prints nothing when `quiet`.
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
            self._status = self.console.status(Text(f"{step} …"))
            self._status.start()

    @property
    def under_way(self) -> str:
        """The name of the step that was begun last, empty before the first."""
        return self._step

    def report(self, detail: str) -> None:
        """Say how far the step under way is, beside its spinner."""
        if self._status is not None:
            self._status.update(Text(f"{self._step} … {detail}"))

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


def pairs(title: str, rows: list[tuple[str, str]]) -> Table:
    """A table of names and values."""
    table = Table(title=title, title_justify="left", title_style="bold", show_header=False, box=None, padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    return table


def say_written(console: Console, first: Path, *others: str) -> None:
    """Say which files there are now: the `first` with its folder, others by name."""
    console.print(Text("Written:", "dim"), ", ".join([str(first), *others]), soft_wrap=True)


def scaled(value: float | None, unit: str) -> str:
    """A value with three digits and an SI prefix: 0.00132 S is "1.32 mS"."""
    if value is None:
        return "not known"
    value = float(f"{value:.3g}")  # 999.6 µS is 1 mS
    for exponent, prefix in _PREFIXES:
        if abs(value) >= 10.0**exponent:
            return f"{value / 10.0**exponent:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def in_one_unit(values: list[float], unit: str) -> tuple[str, list[str]]:
    """A unit with the SI prefix that suits the largest of the values, and all of them in it, for a table's column."""
    largest = float(f"{max((abs(value) for value in values), default=0.0):.3g}")
    exponent, prefix = next((pair for pair in _PREFIXES if largest >= 10.0 ** pair[0]), _PREFIXES[0])
    return f"{prefix}{unit}", [f"{value / 10.0**exponent:.3g}" for value in values]


def inclusion_table(
    inclusions: "Sequence[Inclusion]",
    unit: str,
    ranges: Sequence[tuple[float, float]] = (),
    *,
    background: float | None = None,
) -> Table:
    """A row for each inclusion, of a sheet (or the slice through a solid) or of a solid: kind, place, size, and the
    change of conductivity at its peak; `unit` is that of conductivity. `ranges`: from where to where peaks may lie, if
    that is known. `background`: the conductivity that they are changes of, if it is known."""
    ends = [end for both in ranges for end in both]
    unit, said = in_one_unit([*(one.peak for one in inclusions), *ends], unit)
    peaks, ends = said[: len(inclusions)], said[len(inclusions) :]
    dimension = max((len(one.centroid) for one in inclusions), default=2)
    solid = any(one.is_solid for one in inclusions)
    places = [f"{axis} / mm" for axis in "xyz"[:dimension]]
    # A million times either: square metres in mm², cubic metres in cm³.
    size, digits = ("volume\n/ cm³", 2) if solid else ("area / mm²", 0)
    more = [*(["± 1 σ"] if ranges else []), *(["of back-\nground"] if background else [])]
    # All that a solid body has goes into 80 columns.
    close = {"box": None, "padding": (0, 1 if ranges else 2), "collapse_padding": True, "pad_edge": not ranges}

    rows = []
    for k, (inclusion, peak) in enumerate(zip(inclusions, peaks, strict=True)):
        place = [f"{1e3 * value:.1f}" for value in inclusion.centroid]
        after = [" to ".join(ends[2 * k : 2 * k + 2])] if ranges else []
        after += [percent(inclusion.peak / background)] if background else []
        rows.append([*place, f"{1e6 * inclusion.area:.{digits}f}", peak, *after])

    def table_of(parted: str) -> Table:
        """Table with this text between the kind of a body and "column"."""
        table = Table("inclusion", *places, size, f"peak change\n/ {unit}", *more, **close)
        table.columns[0].min_width = max((len(one.kind) for one in inclusions), default=0)
        for column in table.columns[1:]:
            column.justify = "right"
        for inclusion, row in zip(inclusions, rows, strict=True):
            table.add_row(f"{inclusion.kind}{parted}column" if inclusion.is_column else inclusion.kind, *row)
        return table

    whole = table_of(" ")
    return whole if Console(width=_WIDTH + 1).measure(whole).maximum <= _WIDTH else table_of("\n")
