"""Reading of numbers from text files, with detection of separators, headings and words before the numbers of a line;
and reading of frames from tables, with detection of the arrangement: rows or columns, a column of times, frames wrapped
over lines.

The readers accept cells separated by commas, semicolons, tabs or spaces, also by several of these at once; decimal
commas; complex numbers ("1+2j", "(1-2j)"); brackets around lines, as Python and NumPy print lists and arrays; comments
(# or %), headings, and repeated heading lines between frames; a word before the numbers of each line ("magnitudes :
1.2, 3.4"); separators at the end of lines; and lines of unequal length if frames are wrapped over several lines.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice, takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact

from jeit.arguments import counted
from jeit.data.description import TableLayout
from jeit.data.formats.separated import Separator, Separators, line_pattern, separator_patterns
from jeit.files import check_memory

# Bytes of memory per byte of text: a number may take only two characters, and is stored twice, in eight bytes each.
_MEMORY_PER_FILE_BYTE = 8
# Number of lines from which separators are detected, and maximum number of lines of a heading.
_NUM_SAMPLE_LINES, _MAX_HEADING_LINES = 40, 100
# A word before the numbers of a line; a word that is a line; the end of a number that is cut off.
_LINE_LABEL_PATTERN = re.compile(r"\s{0,40}([A-Za-z_][\w ()/\[\].-]{0,60})[:=]\s{0,40}(?=[-+.\d])")
_LABEL_ONLY_LINE_PATTERN = re.compile(r"\s*[A-Za-z_][\w ]{0,60}:\s*")
_TRUNCATED_NUMBER_PATTERN = re.compile(r"[-+]?(\d*[.,]?\d*([eE][-+]?)?|na?)")
_DECIMAL_COMMA_PATTERN = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_COMPLEX_NUMBER_PATTERN = re.compile(r"\(?[-+]?[\d.]+(?:[eE][-+]?\d+)?[-+]{1,2}[\d.]+(?:[eE][-+]?\d+)?[ijIJ]\)?")
# Minimum number of columns for which a first line 0, 1, 2, … counts as column numbers instead of a frame.
_MIN_NUMBERED_COLUMNS = 8
_COMMENT_MARKS = ("#", "%", "//")
_DELIMITER_HINT = (
    "Set [data] delimiter and skip_rows in the description, if it is a heading or cells are separated otherwise."
)

# Integer times that increase by at least this step may be seconds or milliseconds.
_MIN_AMBIGUOUS_TIME_STEP = 5


class Text(NamedTuple):
    """The numbers of a text file. **Fields**: `values`: all numbers; `lengths`: number of values in each line;
    `heading`: cells of the last line of the heading; `notes`: detected properties; `separators`: lines between
    the numbers, and lines that contain anything else."""

    values: Inexact[np.ndarray, " n"]
    lengths: np.ndarray
    heading: tuple[str, ...]
    notes: tuple[str, ...]
    separators: Separators = Separators()


class _NumberFormat(NamedTuple):
    """Format of lines of numbers: the `delimiter` between numbers (None: white space) and whether commas are decimal
    points."""

    delimiter: str | None
    has_decimal_comma: bool

    def cells(self, line: str) -> list[str]:
        """Cells of a line, without a word before the first cell and without a separator after the last cell."""
        line = _remove_label(line)
        if self.has_decimal_comma:
            line = line.replace(",", ".")
        line = line.strip(" \r\n").lstrip("[ ")
        line = line.rstrip(",; ]") if line.rstrip(",; ").endswith("]") else line
        cells = [cell.strip(' \t"') for cell in line.split(self.delimiter)]
        while cells and not cells[-1]:
            cells.pop()
        return cells

    def numbers(self, line: str) -> list[complex] | None:
        """The numbers of a line, or None if the line contains anything else."""
        try:
            return [_parse_number(cell) for cell in self.cells(line)]
        except ValueError:
            return None

    def __str__(self) -> str:
        names = {None: "spaces", ",": "commas", ";": "semicolons", "\t": "tabs"}
        return names.get(self.delimiter, repr(self.delimiter)) + (", decimal commas" if self.has_decimal_comma else "")


_CSV_FORMAT = _NumberFormat(",", False)
_NUMBER_FORMATS = (
    _CSV_FORMAT,
    *(_NumberFormat(delimiter, comma) for delimiter in (";", "\t", None) for comma in (False, True)),
)


class LineNumbers:
    """Parser of successive lines of numbers. The separators are detected in the first line, and again in each later
    line that cannot be read with them."""

    def __init__(self):
        self._number_format: _NumberFormat | None = None

    def __call__(self, line: str) -> list[float] | None:
        """The numbers of a line, with NaN for an empty cell between numbers; None if the line contains anything
        else."""
        line_numbers = None if self._number_format is None else self._parse(self._number_format, line)
        if line_numbers is None:
            number_format = _detect_format([line])
            line_numbers = self._parse(number_format, line)
            self._number_format = self._number_format if line_numbers is None else number_format
        return line_numbers

    @staticmethod
    def _parse(number_format: _NumberFormat, line: str) -> list[float] | None:
        try:
            return [float(cell or "nan") for cell in number_format.cells(line)] or None
        except ValueError:
            return None


def read_text(path: Path, delimiter: str | None = None, skip_rows: int | None = None) -> Text:
    """Read the numbers of a text file. The `delimiter` between numbers and `skip_rows`, the number of heading lines,
    are detected if they are None.

    Raises `ValueError`, with the line, for a file that contains anything but numbers or that was cut off. Unreadable
    lines between separator lines are allowed, and refused later unless they can be left out.
    """
    check_memory(path.name, _MEMORY_PER_FILE_BYTE * path.stat().st_size)
    num_skipped = skip_rows or 0
    lines = [line for _, line in islice(_content_lines(path, num_skipped), _MAX_HEADING_LINES + _NUM_SAMPLE_LINES)]
    number_format = (
        _NumberFormat(_delimiter_for_split(delimiter), False) if delimiter is not None else _detect_format(lines)
    )
    num_heading = 0 if skip_rows is not None else _heading_length(number_format, lines)
    patterns = {line_pattern(heading_line) for heading_line in lines[:num_heading]}
    patterns |= separator_patterns(lines, lambda line: any(map(_is_number, number_format.cells(line))))
    values, imaginary, lengths, label = array("d"), array("d"), array("q"), ""
    separators = Separators()
    line, cells, row = "\n", [], []
    for line_number, line in islice(_content_lines(path, num_skipped), num_heading, None):
        if separators.fault and not patterns:  # it is not in the last line, which may be cut off
            raise ValueError(separators.fault)
        if line_pattern(line) in patterns or _LABEL_ONLY_LINE_PATTERN.fullmatch(line):
            separators.found_separators.append(Separator(len(lengths), line_number, line.strip()))
            continue
        cells = number_format.cells(line)
        row = _numbers_until_a_fault(cells)
        if len(row) < len(cells):
            message = _not_a_number_message(cells, number_format, is_first_line=not lengths)
            separators.fault = separators.fault or f"{path.name}, line {line_number}{message}"
            separators.unreadable.append(len(lengths))
        if not lengths and (label_match := _LINE_LABEL_PATTERN.match(line)):
            label = label_match[1].strip()
        values.extend([number.real for number in row])
        if imaginary or any(isinstance(number, complex) for number in row):
            imaginary.extend([0.0] * (len(values) - len(row) - len(imaginary)) + [number.imag for number in row])
        lengths.append(len(row))
    is_cut_off = separators.unreadable[-1:] == [len(lengths) - 1] and len(lengths) > 1
    is_cut_off = (
        is_cut_off and len(row) == len(cells) - 1 and _TRUNCATED_NUMBER_PATTERN.fullmatch(cells[-1]) is not None
    )
    if is_cut_off:
        separators.unreadable.pop()
    numbers = np.array(values) + 1j * np.array(imaginary) if imaginary else np.array(values)
    if separators.unreadable and not (separators.examples and values):
        raise ValueError(separators.fault)
    if not values:
        raise ValueError(f"{path.name} holds no numbers.")
    notes = [f"numbers are separated by {number_format}."] if delimiter is None and number_format != _CSV_FORMAT else []
    if num_heading:
        notes.append(f"the first {f'{num_heading} lines are' if num_heading > 1 else 'line is'} a heading, skipped.")
    if separators.examples:
        number_text = counted(len(separators.examples), "line")
        notes.append(f"between the numbers, {number_text} such as {separators.examples[0]!r} are left out.")
    notes += [f"{label!r} stands before each line, and is left out."] if label else []
    if is_cut_off:
        notes.append(f"the last number, {cells[-1][:20]!r}, is cut off, and left out.")
    elif not line.endswith("\n") and len(cells) > 1 and len(cells[-1]) < min(map(len, cells[:-1])):
        notes.append(f"no line end follows the last number, {cells[-1][:20]}: is it cut off?")
    heading_cells = tuple(number_format.cells(lines[num_heading - 1])) if num_heading else ()
    return Text(numbers, np.array(lengths), heading_cells, tuple(notes), separators)


def complete_parts(text: Text, counts: Sequence[int], name: str) -> Text:
    """Replace damaged parts between separator lines by NaN, if frames are wrapped over several lines. `counts`: numbers
    of channels that a frame may have. Raises `ValueError` if too many parts are damaged, or if frames do not begin at
    separators."""
    line_length = int(np.bincount(text.lengths).argmax())
    if not text.separators.examples or any(line_length in (count, count + 1) for count in counts):
        return text
    parts = text.separators.complete(text.values, text.lengths, counts, name)
    if not any(count % parts.size == 0 or parts.size % count == 0 for count in counts):
        raise ValueError(
            f"{name}: between lines such as {text.separators.examples[0]!r} are {counted(parts.size, 'number')}, and a "
            f"frame has {counts[0]}: are lines missing, or is the protocol another?"
        )
    return Text(parts.numbers, parts.lengths, text.heading, (*text.notes, *([parts.note] if parts.note else [])))


def rectangle(text: Text, name: str) -> Inexact[np.ndarray, "R C"]:
    """The numbers of a text file as a matrix. Raises `ValueError` if lines have different lengths or are
    unreadable."""
    if text.separators.unreadable:
        raise ValueError(text.separators.fault)
    length = int(text.lengths[0])
    if (unequal_rows := np.flatnonzero(text.lengths != length)).size:
        raise ValueError(
            f"{name}: row {unequal_rows[0] + 1} has length {text.lengths[unequal_rows[0]]}, the first {length}. Is the "
            "file cut off?"
        )
    return text.values.reshape(-1, length)


def _remove_label(line: str) -> str:
    """A line without the word before its numbers."""
    label_match = _LINE_LABEL_PATTERN.match(line)
    return line if label_match is None else line[label_match.end() :]


def _delimiter_for_split(delimiter: str) -> str | None:
    return None if delimiter.strip() == "" and delimiter != "\t" else delimiter


def _detect_format(lines: Sequence[str]) -> _NumberFormat:
    """Return the format in which the most lines are numbers; among equally good formats, the format that finds the most
    numbers."""

    def count_numbers(number_format: _NumberFormat) -> tuple[int, int]:
        number_rows = [line_numbers for line in lines if (line_numbers := number_format.numbers(line))]
        return len(number_rows), sum(map(len, number_rows))

    number_formats = [
        number_format
        for number_format in _NUMBER_FORMATS
        if not number_format.has_decimal_comma or _has_decimal_commas(number_format, lines)
    ]
    return max(number_formats, key=count_numbers)


def _has_decimal_commas(number_format: _NumberFormat, lines: Sequence[str]) -> bool:
    """Whether commas are decimal points: in most cells that contain a comma, the comma is between two digits."""
    cells = [cell for line in lines for cell in _remove_label(line).split(number_format.delimiter) if "," in cell]
    decimal_cells = [cell for cell in cells if _DECIMAL_COMMA_PATTERN.fullmatch(cell.strip(' \t\r\n"'))]
    return len(decimal_cells) > 0.9 * len(cells)


def _heading_length(number_format: _NumberFormat, lines: Sequence[str]) -> int:
    """Return the number of heading lines at the start of a file. A line belongs to the heading if at least half of its
    cells are words, if its number of cells differs from that of all lines of numbers, or if it numbers the columns, as
    in saved data frames."""
    row_lengths = {len(row) for line in lines if (row := number_format.numbers(line))}
    for line_index, line in enumerate(lines):
        cells = number_format.cells(line)
        column_names = cells[1:] if cells and not cells[0] else cells
        first_number = 1 if column_names[:1] == ["1"] else 0
        if len(column_names) >= _MIN_NUMBERED_COLUMNS and column_names == [
            str(first_number + k) for k in range(len(column_names))
        ]:
            continue
        num_numeric = sum(map(_is_number, cells))
        if num_numeric == len(cells) or (2 * num_numeric > len(cells) and len(cells) in row_lengths):
            return line_index
    return 0


def _content_lines(path: Path, num_skipped: int) -> Iterator[tuple[int, str]]:
    """Lines of a text file that are neither empty nor comments, after `num_skipped` lines, with their line numbers from
    1."""
    with path.open("rb") as file:
        is_utf16 = file.read(2) in (b"\xff\xfe", b"\xfe\xff")  # as spreadsheets write "Unicode text"
    num_lines = 0
    try:
        # A byte that is no character may be one that a serial port has disturbed; a file that is not text begins so.
        with path.open(encoding="utf-16" if is_utf16 else "utf-8-sig", errors="replace") as file:
            for line_number, line in enumerate(file, start=1):
                if "\0" in line or ("\ufffd" in line and not num_lines):
                    raise UnicodeError
                num_lines += 1
                if line_number > num_skipped and line.strip() and not line.lstrip().startswith(_COMMENT_MARKS):
                    yield line_number, line
    except UnicodeError:
        raise ValueError(f"{path.name} is not a text file. If it is a spreadsheet, export it as CSV.") from None


def _not_a_number_message(cells: list[str], number_format: _NumberFormat, *, is_first_line: bool) -> str:
    """Error message for a line whose cells are not all numbers; `is_first_line`: no line of numbers precedes it."""
    wrong_columns = [k for k, cell in enumerate(cells) if not _is_number(cell)]
    wrong_cell = cells[wrong_columns[0]]
    if is_first_line and cells[0].startswith("{"):
        return ": this is JSON; write its numbers as CSV, a frame in each line."
    problem_text = f"{wrong_cell[:40]!r} is no number" if wrong_cell else "nothing stands there"
    if len(cells) == 1:
        return f": {problem_text}, nor numbers separated by {number_format}. {_DELIMITER_HINT}"
    # A heading consists mostly of words.
    delimiter_hint = f" {_DELIMITER_HINT}" if is_first_line and 2 * len(wrong_columns) > len(cells) else ""
    return f", column {wrong_columns[0] + 1}: {problem_text}; where a value is missing write nan.{delimiter_hint}"


def _parse_number(cell: str) -> complex:
    """The real or complex number in a cell. Raises `ValueError` for anything else."""
    if "_" in cell:  # Python's float accepts 1_0
        raise ValueError(cell)
    try:
        return float(cell)
    except ValueError:
        if not _COMPLEX_NUMBER_PATTERN.fullmatch(cell):
            raise
        return complex(cell.strip("()").replace("+-", "-").replace("i", "j").replace("I", "j"))


def _numbers_until_a_fault(cells: list[str]) -> list[float | complex]:
    """The numbers in cells, up to the first cell that contains anything else."""
    try:
        return [_parse_number(cell) for cell in cells]
    except ValueError:
        return [_parse_number(cell) for cell in takewhile(_is_number, cells)]


def _is_number(cell: str) -> bool:
    try:
        _parse_number(cell)
    except ValueError:
        return False
    return True


class TableFrames(NamedTuple):
    """Frames read from a table. **Fields**: `table`: one frame per row; `times`: times of the rows in seconds, or None;
    `notes`: detected properties."""

    table: Inexact[np.ndarray, "F M"]
    times: Float[np.ndarray, " F"] | None = None
    notes: tuple[str, ...] = ()


def frames_in_text(text: Text, counts: Sequence[int], layout: TableLayout, name: str) -> TableFrames:
    """Return the frames of a text file. `counts`: numbers of channels that a frame may have; the first is the number of
    channels of the described protocol.

    A last line or frame that is cut off is left out. Raises `ValueError` for lines of unequal length that are not
    frames wrapped over several lines.
    """
    if layout.frames_in is None:
        text = complete_parts(text, counts, name)
    if layout.frames_in is None and (wrapped_counts := _wrapped_frames(text, counts)) is not None:
        frame_length, num_excess_numbers = wrapped_counts
        num_frames = len(text.values) // frame_length
        notes = (
            f"each frame is wrapped over lines: {counted(frame_length, 'number')} are a frame.",
            *_truncation_notes(num_excess_numbers),
        )
        return TableFrames(
            text.values[: num_frames * frame_length].reshape(num_frames, frame_length), None, (*text.notes, *notes)
        )
    text = remove_cut_line(text)
    frames = frames_in_table(rectangle(text, name), counts, layout, text.heading)
    return frames._replace(notes=(*text.notes, *frames.notes))


def remove_cut_line(text: Text) -> Text:
    """Return the text without its last line, and with a note, if the last line is shorter than the first line, i.e. cut
    off."""
    if len(text.lengths) < 2 or text.lengths[-1] >= text.lengths[0]:
        return text
    num_removed_numbers = int(text.lengths[-1])
    kept_values = text.values[: len(text.values) - num_removed_numbers]
    return text._replace(
        values=kept_values, lengths=text.lengths[:-1], notes=(*text.notes, *_truncation_notes(num_removed_numbers))
    )


def _wrapped_frames(text: Text, channel_counts: Sequence[int]) -> tuple[int, int] | None:
    """For frames that are wrapped over several lines, return the number of values per frame, and the number of values
    after the last complete frame; None if each line or each column is a frame."""
    line_ends = np.cumsum(text.lengths)
    if (text.lengths == text.lengths[0]).all():
        shape = len(text.lengths), int(text.lengths[0])
        if any(count in shape or count + 1 in shape for count in channel_counts):
            return None
    frame_candidates = []
    for count_index, count in enumerate(channel_counts):
        num_frames, num_excess_numbers = divmod(int(line_ends[-1]), count)
        # For a number of channels other than the described number, values after the last complete frame mean that a
        # line is missing.
        if count_index and num_excess_numbers:
            continue
        if num_frames and text.lengths[0] < count and np.isin(count * np.arange(1, num_frames + 1), line_ends).all():
            frame_candidates.append((count, num_excess_numbers))
    # Prefer a number of channels for which all frames are complete.
    return min(frame_candidates, key=lambda frame_candidate: frame_candidate[1] > 0, default=None)


def _truncation_notes(num_values: int) -> tuple[str, ...]:
    return (f"the last line is cut off after {counted(num_values, 'number')}, and left out.",) if num_values else ()


def frames_in_table(
    table: Inexact[np.ndarray, "R C"],
    counts: Sequence[int],
    layout: TableLayout,
    heading: Sequence[str] = (),
    default_axis: str = "rows",
) -> TableFrames:
    """Frames of a two-dimensional array. `counts`: see `frames_in_text`; `heading`: names of the columns;
    `default_axis`: "rows" or "columns", whichever are frames if the numbers of channels do not determine this."""
    described_axis = layout.frames_in
    any_axis_fits = any(count <= length <= count + 1 for count in counts for length in table.shape)
    if described_axis is None and min(table.shape) > 1 and table.size in counts and not any_axis_fits:
        drive_rows = table if len(table) >= table.shape[1] else table.T
        return TableFrames(drive_rows.reshape(1, -1), None, ("its longer side is taken for the drives of one frame.",))
    is_transposed = (
        described_axis == "columns" if described_axis else _are_columns_frames(table.shape, counts, default_axis)
    )
    rows = table.T if is_transposed else table
    notes: tuple[str, ...] = ()
    if described_axis is None and is_transposed and default_axis == "rows":
        notes = ("frames are taken from its columns.",)
    if described_axis is None and not is_transposed and default_axis == "columns" and min(table.shape) > 1:
        notes = ("frames are taken from its rows.",)
    frame_times = None
    if rows.shape[1] - 1 in counts and rows.shape[1] not in counts and layout.time_column is not False:
        frame_times, time_note = _frame_times(np.real(rows[:, 0]), "" if is_transposed or not heading else heading[0])
        rows, notes = (rows[:, 1:], (*notes, time_note)) if time_note else (rows, notes)
    return TableFrames(rows, frame_times, notes)


def _are_columns_frames(shape: tuple[int, int], channel_counts: Sequence[int], default_axis: str) -> bool:
    """Whether columns, not rows, are frames: the first of the `channel_counts` that equals the length of a column or
    row decides."""
    for num_extra_columns in (0, 1):
        for count in channel_counts:
            is_frame_length = [shape[1] == count + num_extra_columns, shape[0] == count + num_extra_columns]
            if any(is_frame_length):
                return is_frame_length[1] and (default_axis == "columns" or not is_frame_length[0])
    return default_axis == "columns"


def _frame_times(column: Float[np.ndarray, " F"], column_name: str) -> tuple[Float[np.ndarray, " F"] | None, str]:
    """Times in seconds from the first number of each frame, or None if these numbers are not times, and a note. The
    note is empty if the numbers do not increase."""
    if not (np.isfinite(column).all() and (np.diff(column) > 0).all()):
        return None, ""
    if (column == column[0] + np.arange(len(column))).all():
        return None, "the first number of each frame counts frames, and is left out."
    if (
        not column_name
        and (column == np.round(column)).all()
        and np.median(np.diff(column)) >= _MIN_AMBIGUOUS_TIME_STEP
    ):
        median_step = float(np.median(np.diff(column)))
        return (
            None,
            f"the first number of each frame rises by {median_step:g}; its unit is not known, and it is left out.",
        )
    unit_note = (
        1e-3
        if "ms" in column_name.lower()
        else 1e-6
        if "us" in column_name.lower() or "µs" in column_name.lower()
        else 1.0
    )
    unit_name = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds"}[unit_note]
    return unit_note * column, f"the first number of each frame is taken for its time, in {unit_name}."
