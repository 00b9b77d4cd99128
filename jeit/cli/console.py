"""Output of commands: progress of their steps, and tables of results."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jeit.arguments import interval_text, percent
from jeit.arguments.checks import Interval

if TYPE_CHECKING:
    from jeit.image import Inclusion


# Maximum width of a table, in characters.
_MAX_TABLE_WIDTH = 80
# Minimum duration of a step, in seconds, for which the elapsed time is shown.
_MIN_SHOWN_SECONDS = 2.0
# Pattern of a progress text such as "12 of 60", the numbers of completed parts and of all parts of a step, which does
# not match "12 of at most 60"; and minimum completed fraction of a step at which the remaining time is estimated.
_PROGRESS_PATTERN, _MIN_COMPLETED_FRACTION = re.compile(r"(\d[\d,]*) of (\d[\d,]*)"), 0.05
_SI_PREFIXES = ((0, ""), (-3, "m"), (-6, "µ"), (-9, "n"))


def plain_console() -> Console:
    """Console for standard output without highlighting and markup, so that the content of files is printed
    unchanged."""
    return Console(highlight=False, markup=False)


class Steps:
    """Progress on standard output: the current step with a spinner, and completed steps with their duration.

    Call the object with the name of each step when the step begins; `report` shows the progress within the step.
    Nothing is printed if `quiet`.
    """

    def __init__(self, console: Console, *, quiet: bool):
        self.console = console
        self.quiet = quiet
        self._spinner = None
        self._step_name = ""
        self._step_start_time = 0.0

    def __call__(self, step: str) -> None:
        self._finish_step()
        self._step_name, self._step_start_time = step, time.perf_counter()
        if not self.quiet:
            self._spinner = self.console.status(_StepLine(f"{step} …", self._step_start_time))
            self._spinner.start()

    @property
    def current_step_name(self) -> str:
        """Name of the current step; empty before the first step."""
        return self._step_name

    def report(self, detail: str) -> None:
        """Show the progress within the current step beside its spinner; for a `detail` such as "frame 12 of 100", also
        the remaining time."""
        if self._spinner is not None:
            progress_match = _PROGRESS_PATTERN.search(detail)
            num_completed_parts, num_parts = (
                (int(number_text.replace(",", "")) for number_text in progress_match.groups())
                if progress_match
                else (0, 0)
            )
            current_time = time.perf_counter()
            self._spinner.update(
                _StepLine(
                    f"{self._step_name} … {detail}", self._step_start_time, num_completed_parts, num_parts, current_time
                )
            )

    def __enter__(self) -> "Steps":
        return self

    def __exit__(self, kind, error, traceback) -> None:
        if kind is None:
            self._finish_step()
        elif self._spinner is not None:
            self._spinner.stop()

    def _finish_step(self) -> None:
        if self._spinner is None:
            return
        self._spinner.stop()
        self._spinner = None
        self.console.print(
            f"  {self._step_name:<24}{time.perf_counter() - self._step_start_time:6.1f} s", highlight=False
        )


@dataclass(frozen=True)
class _StepLine:
    """Line beside the spinner: name of the step, time since its `start_time` if at least `_MIN_SHOWN_SECONDS`, and, if
    `num_completed_parts` of its `num_parts` parts are completed, an estimate of the remaining time."""

    step_name: str
    start_time: float
    num_completed_parts: int = 0
    num_parts: int = 0
    latest_progress_time: float = 0.0

    def __rich__(self) -> Text:
        elapsed_seconds = time.perf_counter() - self.start_time
        line_text = (
            f"{self.step_name}  {elapsed_seconds:.0f} s" if elapsed_seconds >= _MIN_SHOWN_SECONDS else self.step_name
        )
        if (
            elapsed_seconds >= _MIN_SHOWN_SECONDS
            and _MIN_COMPLETED_FRACTION * self.num_parts <= self.num_completed_parts < self.num_parts
        ):
            duration_until_progress = self.latest_progress_time - self.start_time
            seconds_left = max(duration_until_progress * self.num_parts / self.num_completed_parts - elapsed_seconds, 0)
            line_text += f", about {_rounded_duration(seconds_left)} left"
        return Text(line_text)


def _rounded_duration(seconds: float) -> str:
    """Format an estimated duration with one or two digits, because the estimate is not more accurate."""
    if seconds < 100:
        return f"{seconds:.0f} s" if seconds < 10 else f"{5 * round(seconds / 5)} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def name_value_table(title: str, rows: list[tuple[str, str]]) -> Table:
    """Create a table with the `title`, and a name and a value in each row."""
    table = Table(title=title, title_justify="left", title_style="bold", show_header=False, box=None, padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    return table


def print_written_files(console: Console, first_path: Path, *other_names: str) -> None:
    """Print the names of the written files: `first_path` with its folder, and `other_names` without the folder."""
    console.print(Text("Written:", "dim"), ", ".join([str(first_path), *other_names]), soft_wrap=True)


def format_with_unit(value: float | None, unit: str) -> str:
    """Format a value with three digits and an SI prefix, such as "1.32 mS" for 0.00132 S."""
    if value is None:
        return "not known"
    value = float(f"{value:.3g}")  # 999.6 µS is 1 mS
    for exponent, si_prefix in _SI_PREFIXES:
        if abs(value) >= 10.0**exponent:
            return f"{value / 10.0**exponent:.3g} {si_prefix}{unit}"
    return f"{value:.3g} {unit}"


def smallest_body_text(report: dict[str, Any]) -> str:
    """Text on the smallest insulating bodies that can be detected, from their entry in a report."""
    if "not_known_because" in report:
        return f"not known: {report['not_known_because']}"
    diameters = report["diameter_almost_everywhere"], report["diameter_in_half_of_the_domain"]
    almost_everywhere, median = (diameter if diameter and math.isfinite(diameter) else None for diameter in diameters)
    if median is None:
        return "none: the noise exceeds the voltages of an insulating body in half of the domain"
    others = "none at most others" if almost_everywhere is None else f"one of {1e3 * almost_everywhere:.2g} mm at 95 %"
    return (
        f"an insulating body {1e3 * median:.2g} mm across is detected at half of all places, {others}; limited by "
        f"{report['limited_by']}"
    )


def format_in_one_unit(values: list[float], unit: str) -> tuple[str, list[str]]:
    """Format the values of a table column in one unit, with the SI prefix that suits the largest value; return the unit
    and the formatted values."""
    max_value = float(f"{max((abs(value) for value in values), default=0.0):.3g}")
    exponent, si_prefix = next((prefix for prefix in _SI_PREFIXES if max_value >= 10.0 ** prefix[0]), _SI_PREFIXES[0])
    return f"{si_prefix}{unit}", [f"{value / 10.0**exponent:.3g}" for value in values]


def inclusion_table(inclusions: "Sequence[Inclusion]", unit: str, *, background: float | None = None) -> Table:
    """Create a table with a row for each inclusion: kind, position, size, and peak change of conductivity.

    `unit`: unit of conductivity. `background`: conductivity of the reference, if known.
    """
    unit, peaks = format_in_one_unit([inclusion.peak for inclusion in inclusions], unit)
    size_name, size_unit, num_decimals = _size_format(inclusions)
    relative_columns = ["of back-\nground"] if background else []
    rows = []
    for inclusion, peak in zip(inclusions, peaks, strict=True):
        relative_cells = [percent(inclusion.peak / background)] if background else []
        rows.append([f"{1e6 * inclusion.area:.{num_decimals}f}", peak, *relative_cells])
    return _create_inclusion_table(
        inclusions, [f"{size_name}\n/ {size_unit}", f"peak change\n/ {unit}", *relative_columns], rows
    )


def quantity_table(inclusions: "Sequence[Inclusion]", background: float) -> Table:
    """Create a table of fitted bodies with 68 % intervals of their size, change of conductivity and strength, and the
    radius of the 68 % region of their position.

    `background`: conductivity of the reference, S/m (2-D: S). If the data determine only one limit of an interval, only
    this limit is shown.
    """
    size_name, size_unit, _ = _size_format(inclusions)
    rows = []
    for inclusion in inclusions:
        size_text = format_with_interval(
            inclusion.area, inclusion.area_interval, lambda value: _format_three_digits(1e6 * value)
        )
        relative_change = inclusion.peak / background
        change_text = format_with_interval(
            relative_change, inclusion.contrast_interval, lambda value: _format_three_digits(100 * value, "+")
        )
        strength_text = format_with_interval(
            inclusion.strength, inclusion.strength_interval, lambda value: _format_three_digits(1e6 * value)
        )
        rows.append([size_text, change_text, strength_text])
    table = _create_inclusion_table(
        inclusions, [f"{size_name}\n/ {size_unit}", "change\n/ %", f"strength\n/ {size_unit}"], rows
    )
    table.caption = "below: the 68 % radius of the place, and 68 % intervals"
    table.caption_justify = "left"
    return table


def _format_three_digits(value: float, sign_format: str = "") -> str:
    """Format a number with three significant digits, and without an exponent below a million."""
    return f"{float(f'{value:.3g}'):{sign_format}g}"


def format_with_interval(value: float | None, interval: Interval | None, format_value: Callable[[float], str]) -> str:
    """Text of a value with its interval on the next line. If the data do not determine both limits of the interval, the
    text is the interval alone."""
    if value is None or interval is None:
        return "not known" if value is None else format_value(value)
    text = interval_text(interval, format_value)
    return text if None in interval else f"{format_value(value)}\n{text}"


def _size_format(inclusions: "Sequence[Inclusion]") -> tuple[str, str, int]:
    """Return the name of the size of inclusions ("area" or "volume"), its unit, and its number of decimals. The same
    factor 1e6 converts square metres to mm² and cubic metres to cm³."""
    return ("volume", "cm³", 2) if any(inclusion.is_solid for inclusion in inclusions) else ("area", "mm²", 0)


def _create_inclusion_table(inclusions: "Sequence[Inclusion]", columns: list[str], rows: list[list[str]]) -> Table:
    """Create a table of inclusions with their kind and position, and further `columns`, at most 80 characters wide."""
    dimension = max((len(inclusion.centroid) for inclusion in inclusions), default=2)
    table_style = {"box": None, "padding": (0, 2), "collapse_padding": True}

    def create_table(separator: str) -> Table:
        """Create the table; `separator` separates the kind of a body from the word "column"."""
        table = Table("inclusion", *(f"{axis} / mm" for axis in "xyz"[:dimension]), *columns, **table_style)
        table.columns[0].min_width = max((len(inclusion.kind) for inclusion in inclusions), default=0)
        for column in table.columns[1:]:
            column.justify = "right"
        for inclusion, row in zip(inclusions, rows, strict=True):
            kind = f"{inclusion.kind}{separator}column" if inclusion.is_column else inclusion.kind
            position_cells = [f"{1e3 * value:.1f}" for value in inclusion.centroid]
            if inclusion.centroid_radius is not None:
                position_cells[-1] += f"\n±{1e3 * inclusion.centroid_radius:.2g}"
            table.add_row(kind, *position_cells, *row)
        return table

    table_on_one_line = create_table(" ")
    return (
        table_on_one_line
        if Console(width=_MAX_TABLE_WIDTH + 1).measure(table_on_one_line).maximum <= _MAX_TABLE_WIDTH
        else create_table("\n")
    )
