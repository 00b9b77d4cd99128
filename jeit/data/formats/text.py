"""Numbers in text files, of which separators, headings and the words before a line are found out; and frames in tables
whose arrangement is found out: rows or columns, a column of times, frames wrapped over lines.

Understood are cells separated by commas, semicolons, tabs or spaces, also several of these at once; decimal commas;
complex numbers ("1+2j", "(1-2j)"); brackets around lines, as Python and NumPy print lists and arrays; comments (# or
%), headings, and lines like those of the heading between frames; a word before the numbers of each line ("magnitudes :
1.2, 3.4"); separators at the end of lines; and lines of unequal length, of frames that are wrapped over several lines.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact

from jeit.arguments import counted
from jeit.data.description import TableLayout
from jeit.files import check_memory

# Bytes of memory per byte of text: a number may take two characters, and is held twice.
_IN_MEMORY = 8
# Lines from which separators are found out, and the greatest number of lines of a heading.
_SAMPLE, _MOST_HEADING = 40, 100
# A word before the numbers of a line; the end of a number that is cut off.
_LABEL = re.compile(r"\s{0,40}([A-Za-z_][\w ()/\[\].-]{0,60})[:=]\s{0,40}(?=[-+.\d])")
_CUT_NUMBER = re.compile(r"[-+]?(\d*[.,]?\d*([eE][-+]?)?|na?)")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_COMPLEX = re.compile(r"\(?[-+]?[\d.]+(?:[eE][-+]?\d+)?[-+]{1,2}[\d.]+(?:[eE][-+]?\d+)?[ijIJ]\)?")
# Fewest columns of which a first line of their numbers is no frame.
_COLUMNS = 8
_COMMENTS = ("#", "%", "//")
_SET = "Set [data] delimiter and skip_rows in the description, if it is a heading or cells are separated otherwise."

# Whole numbers that rise by as much as this may be milliseconds as well as seconds.
_STEP = 5


class Text(NamedTuple):
    """**Fields**: `values`: all numbers; `lengths`: how many stand in each line; `heading`: cells of the last line of a
    heading; `notes`: what was found out."""

    values: Inexact[np.ndarray, " n"]
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
        line = line.strip(" \r\n").lstrip("[ ")
        line = line.rstrip(",; ]") if line.rstrip(",; ").endswith("]") else line
        cells = [cell.strip(' \t"') for cell in line.split(self.delimiter)]
        while cells and not cells[-1]:
            cells.pop()
        return cells

    def numbers(self, line: str) -> list[complex] | None:
        """The numbers of a line, or None if it holds anything else."""
        try:
            return [_number(cell) for cell in self.cells(line)]
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
    values, imaginary, lengths, label = array("d"), array("d"), array("q"), ""
    rest, line, cells, ended = islice(_content(path, skipped), heading, None), "\n", [], False
    titles, repeated = {_form(one) for one in lines[:heading]}, 0
    for place, line in rest:
        if lengths and _form(line) in titles:
            repeated += 1
            continue
        cells = way.cells(line)
        try:
            row = [_number(cell) for cell in cells]
        except ValueError:
            cut = lengths and all(map(_is_number, cells[:-1])) and _CUT_NUMBER.fullmatch(cells[-1])
            if not cut or next(rest, None) is not None:
                raise ValueError(f"{path.name}, line {place}{_no_number(cells, way, first=not lengths)}") from None
            row, ended = [_number(cell) for cell in cells[:-1]], True
        if not lengths and (named := _LABEL.match(line)):
            label = named[1].strip()
        values.extend([one.real for one in row])
        if imaginary or any(isinstance(one, complex) for one in row):
            imaginary.extend([0.0] * (len(values) - len(row) - len(imaginary)) + [one.imag for one in row])
        lengths.append(len(row))
    if not values:
        raise ValueError(f"{path.name} holds no numbers.")
    notes = [f"numbers are separated by {way}."] if delimiter is None and way != _PLAIN else []
    notes += [f"the first {heading} line{'s are' if heading > 1 else ' is'} a heading, skipped."] if heading else []
    notes += [f"{repeated} more such lines stand between the numbers, and are left out."] if repeated else []
    notes += [f"{label!r} stands before each line, and is left out."] if label else []
    if ended:
        notes.append(f"the last number, {cells[-1][:20]!r}, is cut off, and left out.")
    elif not line.endswith("\n") and len(cells) > 1 and len(cells[-1]) < min(map(len, cells[:-1])):
        notes.append(f"no line end follows the last number, {cells[-1][:20]}: is it cut off?")
    named = tuple(way.cells(lines[heading - 1])) if heading else ()
    numbers = np.array(values) + 1j * np.array(imaginary) if imaginary else np.array(values)
    return Text(numbers, np.array(lengths), named, tuple(notes))


def rectangle(text: Text, name: str) -> Inexact[np.ndarray, "R C"]:
    """The numbers as rows of equal length. Raises `ValueError` if a row has another length."""
    length = int(text.lengths[0])
    if (other := np.flatnonzero(text.lengths != length)).size:
        raise ValueError(
            f"{name}: row {other[0] + 1} has length {text.lengths[other[0]]}, the first {length}. Is the file cut off?"
        )
    return text.values.reshape(-1, length)


def _form(line: str) -> str:
    """A line with # in place of numbers, so that "Frame 1" is of the form of "Frame 2"."""
    return re.sub(r"\d+", "#", line.strip())


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
    """Number of lines at the start that are a heading: half words or more, as long as no line of numbers, or the
    numbers of the columns, as data frames are saved."""
    usual = {len(row) for line in lines if (row := way.numbers(line))}
    for number, line in enumerate(lines):
        cells = way.cells(line)
        named = cells[1:] if cells and not cells[0] else cells
        first = 1 if named[:1] == ["1"] else 0
        if len(named) >= _COLUMNS and named == [str(first + k) for k in range(len(named))]:
            continue
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
    if first and cells[0].startswith("{"):
        return ": this is JSON; write its numbers as CSV, a frame in each line."
    said = f"{cell[:40]!r} is no number" if cell else "nothing stands there"
    if len(cells) == 1:
        return f": {said}, nor numbers separated by {way}. {_SET}"
    # A heading consists mostly of words.
    other = f" {_SET}" if first and 2 * len(wrong) > len(cells) else ""
    return f", column {wrong[0] + 1}: {said}; where a value is missing write nan.{other}"


def _number(cell: str) -> complex:
    """A number, real or complex. Raises `ValueError` for anything else."""
    try:
        return float(cell)
    except ValueError:
        if not _COMPLEX.fullmatch(cell):
            raise
        return complex(cell.strip("()").replace("+-", "-").replace("i", "j").replace("I", "j"))


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


class Frames(NamedTuple):
    """**Fields**: `table`: frames in rows; `times`: of the rows, seconds, if a column has them; `notes`: what was found
    out."""

    table: Inexact[np.ndarray, "F M"]
    times: Float[np.ndarray, " F"] | None = None
    notes: tuple[str, ...] = ()


def frames_in_text(text: Text, counts: Sequence[int], layout: TableLayout, name: str) -> Frames:
    """Frames of a text file. `counts`: numbers of channels that a frame may have, the described one first.

    A last line or frame that is cut off is left out. Raises `ValueError` for lines of unequal length that are not
    frames wrapped over several lines.
    """
    if layout.frames_in is None and (wrapped := _wrapped(text, counts)) is not None:
        count, left = wrapped
        whole = len(text.values) // count
        notes = (f"each frame is wrapped over lines: {counted(count, 'number')} are a frame.", *_cut(left))
        return Frames(text.values[: whole * count].reshape(whole, count), None, (*text.notes, *notes))
    text = without_cut_line(text)
    found = frames_in_table(rectangle(text, name), counts, layout, text.heading)
    return found._replace(notes=(*text.notes, *found.notes))


def without_cut_line(text: Text) -> Text:
    """The text without a last line that is shorter than the first, for it is cut off; with a note about it."""
    if len(text.lengths) < 2 or text.lengths[-1] >= text.lengths[0]:
        return text
    last = int(text.lengths[-1])
    values = text.values[: len(text.values) - last]
    return text._replace(values=values, lengths=text.lengths[:-1], notes=(*text.notes, *_cut(last)))


def _wrapped(text: Text, counts: Sequence[int]) -> tuple[int, int] | None:
    """Numbers in a frame that is wrapped over several lines, and those left over at the end; None if lines or columns
    are frames."""
    ends = np.cumsum(text.lengths)
    if (text.lengths == text.lengths[0]).all():
        shape = len(text.lengths), int(text.lengths[0])
        if any(count in shape or count + 1 in shape for count in counts):
            return None
    fitting = []
    for number, count in enumerate(counts):
        whole, left = divmod(int(ends[-1]), count)
        # A remainder beside frames of another length than the described one: rather a line is missing.
        if number and left:
            continue
        if whole and text.lengths[0] < count and np.isin(count * np.arange(1, whole + 1), ends).all():
            fitting.append((count, left))
    return min(fitting, key=lambda one: one[1] > 0, default=None)  # rather one without a rest


def _cut(left: int) -> tuple[str, ...]:
    return (f"the last line is cut off after {counted(left, 'number')}, and left out.",) if left else ()


def frames_in_table(
    table: Inexact[np.ndarray, "R C"],
    counts: Sequence[int],
    layout: TableLayout,
    heading: Sequence[str] = (),
    usual: str = "rows",
) -> Frames:
    """Frames of an array. `counts` as for `frames_in_text`; `heading`: names of the columns; `usual`: where frames are
    if the numbers of channels do not decide, "rows" or "columns"."""
    stated = layout.frames_in
    turned = stated == "columns" if stated else _are_columns(table.shape, counts, usual)
    rows = table.T if turned else table
    notes: tuple[str, ...] = ()
    if stated is None and turned and usual == "rows":
        notes = ("frames are taken from its columns.",)
    if stated is None and not turned and usual == "columns" and min(table.shape) > 1:
        notes = ("frames are taken from its rows.",)
    times = None
    if rows.shape[1] - 1 in counts and rows.shape[1] not in counts and layout.time_column is not False:
        times, said = _times(np.real(rows[:, 0]), "" if turned or not heading else heading[0])
        rows, notes = (rows[:, 1:], (*notes, said)) if said else (rows, notes)
    return Frames(rows, times, notes)


def _are_columns(shape: tuple[int, int], counts: Sequence[int], usual: str) -> bool:
    """Whether columns, not rows, are frames: the first number of channels that one of the two has decides."""
    for more in (0, 1):
        for count in counts:
            fits = [shape[1] == count + more, shape[0] == count + more]
            if any(fits):
                return fits[1] and (usual == "columns" or not fits[0])
    return usual == "columns"


def _times(column: Float[np.ndarray, " F"], named: str) -> tuple[Float[np.ndarray, " F"] | None, str]:
    """Times in seconds from the first number of each frame, and a note; no note if these do not rise."""
    if not (np.isfinite(column).all() and (np.diff(column) > 0).all()):
        return None, ""
    if (column == column[0] + np.arange(len(column))).all():
        return None, "the first number of each frame counts frames, and is left out."
    if not named and (column == np.round(column)).all() and np.median(np.diff(column)) >= _STEP:
        step = float(np.median(np.diff(column)))
        return None, f"the first number of each frame rises by {step:g}; its unit is not known, and it is left out."
    unit = 1e-3 if "ms" in named.lower() else 1e-6 if "us" in named.lower() or "µs" in named.lower() else 1.0
    said = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds"}[unit]
    return unit * column, f"the first number of each frame is taken for its time, in {said}."
