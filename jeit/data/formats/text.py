"""Numbers in text files, of which separators, headings and the words before a line are found out.

Understood are cells separated by commas, semicolons, tabs or spaces, also several of these at once; decimal commas;
comments (# or %), headings; a word before the numbers of each line ("magnitudes : 1.2, 3.4"); separators at the end
of lines; and lines of unequal length, of frames that are wrapped over several lines.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.files import check_memory

# Bytes of memory per byte of text: a number may take two characters, and is held twice.
_IN_MEMORY = 8
# Lines from which separators are found out, and the greatest number of lines of a heading.
_SAMPLE, _MOST_HEADING = 40, 100
# A word before the numbers of a line; the end of a number that is cut off.
_LABEL = re.compile(r"\s{0,40}([A-Za-z_][\w ()/\[\].-]{0,60})[:=]\s{0,40}(?=[-+.\d])")
_CUT_NUMBER = re.compile(r"[-+]?(\d*[.,]?\d*([eE][-+]?)?|na?)")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_COMMENTS = ("#", "%", "//")
_SET = "Set [data] delimiter and skip_rows in the description, if it is a heading or cells are separated otherwise."


class Text(NamedTuple):
    """**Fields**: `values`: all numbers; `lengths`: how many stand in each line; `heading`: cells of the last line of a
    heading; `notes`: what was found out."""

    values: Float[np.ndarray, " n"]
    lengths: np.ndarray
    heading: tuple[str, ...]
    notes: tuple[str, ...]


class _Way(NamedTuple):
    """A way to read lines: `delimiter` (None: white space) and whether commas are decimal points."""

    delimiter: str | None
    decimal_comma: bool

    def cells(self, line: str) -> list[str]:
        """Cells of a line, without a label before them and without a separator after them."""
        line = _unlabelled(line)
        if self.decimal_comma:
            line = line.replace(",", ".")
        cells = [cell.strip(' \t"') for cell in line.strip(" \r\n").split(self.delimiter)]
        while cells and not cells[-1]:
            cells.pop()
        return cells

    def numbers(self, line: str) -> list[float] | None:
        """The numbers of a line, or None if it holds anything else."""
        try:
            return [float(cell) for cell in self.cells(line)]
        except ValueError:
            return None

    def __str__(self) -> str:
        names = {None: "spaces", ",": "commas", ";": "semicolons", "\t": "tabs"}
        return names.get(self.delimiter, repr(self.delimiter)) + (", decimal commas" if self.decimal_comma else "")


_PLAIN = _Way(",", False)
_WAYS = (_PLAIN, *(_Way(delimiter, comma) for delimiter in (";", "\t", None) for comma in (False, True)))


class LineNumbers:
    """Numbers of lines that come one after another. Separators are found from a line, and kept as long as they fit."""

    def __init__(self):
        self._way: _Way | None = None

    def __call__(self, line: str) -> list[float] | None:
        """The numbers of a line, NaN for an empty cell between others; None if the line holds anything else."""
        found = None if self._way is None else self._of(self._way, line)
        if found is None:
            way = _way_of([line])
            found = self._of(way, line)
            self._way = self._way if found is None else way
        return found

    @staticmethod
    def _of(way: _Way, line: str) -> list[float] | None:
        try:
            return [float(cell or "nan") for cell in way.cells(line)] or None
        except ValueError:
            return None


def read_text(path: Path, delimiter: str | None = None, skip_rows: int | None = None) -> Text:
    """The numbers of a text file. `delimiter` and `skip_rows`, the number of lines of a heading, are found out unless
    given.

    Raises `ValueError`, with the line, for a file that holds anything but numbers or was cut off.
    """
    check_memory(path.name, _IN_MEMORY * path.stat().st_size)
    skipped = skip_rows or 0
    lines = [line for _, line in islice(_content(path, skipped), _MOST_HEADING + _SAMPLE)]
    way = _Way(_given(delimiter), False) if delimiter is not None else _way_of(lines)
    heading = 0 if skip_rows is not None else _heading(way, lines)
    values, lengths, label = array("d"), array("q"), ""
    rest, line, cells, ended = islice(_content(path, skipped), heading, None), "\n", [], False
    for place, line in rest:
        cells = way.cells(line)
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            cut = lengths and all(map(_is_number, cells[:-1])) and _CUT_NUMBER.fullmatch(cells[-1])
            if not cut or next(rest, None) is not None:
                raise ValueError(f"{path.name}, line {place}{_no_number(cells, way, first=not lengths)}") from None
            row, ended = [float(cell) for cell in cells[:-1]], True
        if not lengths and (named := _LABEL.match(line)):
            label = named[1].strip()
        values.extend(row)
        lengths.append(len(row))
    if not values:
        raise ValueError(f"{path.name} holds no numbers.")
    notes = [f"numbers are separated by {way}."] if delimiter is None and way != _PLAIN else []
    notes += [f"the first {heading} line{'s are' if heading > 1 else ' is'} a heading, skipped."] if heading else []
    notes += [f"{label!r} stands before each line, and is left out."] if label else []
    if ended:
        notes.append(f"the last number, {cells[-1][:20]!r}, is cut off, and left out.")
    elif not line.endswith("\n") and len(cells) > 1 and len(cells[-1]) < min(map(len, cells[:-1])):
        notes.append(f"no line end follows the last number, {cells[-1][:20]}: is it cut off?")
    named = tuple(way.cells(lines[heading - 1])) if heading else ()
    return Text(np.array(values), np.array(lengths), named, tuple(notes))


def rectangle(text: Text, name: str) -> Float[np.ndarray, "R C"]:
    """The numbers as rows of equal length. Raises `ValueError` if a row has another length."""
    length = int(text.lengths[0])
    if (other := np.flatnonzero(text.lengths != length)).size:
        raise ValueError(
            f"{name}: row {other[0] + 1} has length {text.lengths[other[0]]}, the first {length}. Is the file cut off?"
        )
    return text.values.reshape(-1, length)


def _unlabelled(line: str) -> str:
    """A line without the word before its numbers."""
    label = _LABEL.match(line)
    return line if label is None else line[label.end() :]


def _given(delimiter: str) -> str | None:
    return None if delimiter.strip() == "" and delimiter != "\t" else delimiter


def _way_of(lines: Sequence[str]) -> _Way:
    """The way in which most lines are numbers; of equal ones that with the most numbers in a line."""

    def worth(way: _Way) -> tuple[int, int]:
        rows = [row for line in lines if (row := way.numbers(line))]
        return len(rows), sum(map(len, rows))

    ways = [way for way in _WAYS if not way.decimal_comma or _has_decimal_commas(way, lines)]
    return max(ways, key=worth)


def _has_decimal_commas(way: _Way, lines: Sequence[str]) -> bool:
    """Whether commas stand within numbers alone: in most cells that have one, between digits."""
    cells = [cell for line in lines for cell in _unlabelled(line).split(way.delimiter) if "," in cell]
    within = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell.strip(' \t\r\n"'))]
    return len(within) > 0.9 * len(cells)


def _heading(way: _Way, lines: Sequence[str]) -> int:
    """Number of lines at the start that are a heading: half words or more, or as long as no line of numbers."""
    usual = {len(row) for line in lines if (row := way.numbers(line))}
    for number, line in enumerate(lines):
        cells = way.cells(line)
        known = sum(map(_is_number, cells))
        if known == len(cells) or (2 * known > len(cells) and len(cells) in usual):
            return number
    return 0


def _content(path: Path, skipped: int) -> Iterator[tuple[int, str]]:
    """Lines of a text file that are neither empty nor comments, with their numbers from 1, after those skipped."""
    with path.open("rb") as file:
        wide = file.read(2) in (b"\xff\xfe", b"\xfe\xff")  # as spreadsheets write "Unicode text"
    try:
        with path.open(encoding="utf-16" if wide else "utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                if number > skipped and line.strip() and not line.lstrip().startswith(_COMMENTS):
                    yield number, line
    except UnicodeError:
        raise ValueError(f"{path.name} is not a text file. If it is a spreadsheet, export it as CSV.") from None


def _no_number(cells: list[str], way: _Way, *, first: bool) -> str:
    """Error message for a line whose cells are not all numbers. `first`: whether no line of numbers precedes it."""
    wrong = [k for k, cell in enumerate(cells) if not _is_number(cell)]
    cell = cells[wrong[0]]
    said = f"{cell[:40]!r} is no number" if cell else "nothing stands there"
    if len(cells) == 1:
        return f": {said}, nor numbers separated by {way}. {_SET}"
    # A heading consists mostly of words.
    other = f" {_SET}" if first and 2 * len(wrong) > len(cells) else ""
    return f", column {wrong[0] + 1}: {said}; where a value is missing write nan.{other}"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
