"""Text with a separator line before each frame or each part of a frame, as devices on a serial port send it.

In files, parts with missing, superfluous or unreadable numbers are replaced by NaN, so that the other frames keep their
places. Of a device, the lines of a frame are joined.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Inexact, Int

from jeit.arguments import counted

# A separator occurs at least so many times in the first lines of a file.
_MIN_SEPARATOR_REPETITIONS = 2
# A file is read if it has at least this many complete frames and at most this share of damaged ones.
_MIN_COMPLETE_FRAMES, _MAX_DAMAGED_FRAME_SHARE = 2, 0.1
# Maximum number of characters of a separator in a note.
_MAX_SHOWN_SEPARATOR_LENGTH = 20


def line_pattern(line: str) -> str:
    """A line with # in place of each number, so that "Frame 1" and "Frame 2" have the same pattern."""
    return re.sub(r"\d+", "#", line.strip())


def separator_patterns(lines: Sequence[str], holds_numbers: Callable[[str], bool]) -> set[str]:
    """Patterns of the lines without numbers that begin with a letter and occur about as often as the most frequent of
    them; none if no line holds numbers."""
    text_patterns = [line_pattern(line) for line in lines if not holds_numbers(line)]
    pattern_counts = Counter(text_pattern for text_pattern in text_patterns if text_pattern[:1].isalpha())
    min_count = max(_MIN_SEPARATOR_REPETITIONS, 0.5 * max(pattern_counts.values(), default=0))
    repeated_patterns = {
        text_pattern for text_pattern, pattern_count in pattern_counts.items() if pattern_count >= min_count
    }
    return repeated_patterns if len(text_patterns) < len(lines) else set()


class RepairedNumbers(NamedTuple):
    """Numbers of a file, with every damaged part replaced by NaN. **Fields**: `numbers`: all numbers; `lengths`: number
    of numbers in each line; `size`: number of numbers in a part; `note`: how many parts are damaged, empty if none
    is."""

    numbers: Inexact[np.ndarray, " n"]
    lengths: Int[np.ndarray, " lines"]
    size: int
    note: str = ""


class _Partition(NamedTuple):
    """Division of a file into parts. **Fields**: `part_separators`: separator before each part;
    `part_starts`: first line of each part; `part_sizes`: number of numbers in each part; `usual_size`: most frequent
    one."""

    part_separators: list[Separator]
    part_starts: list[int]
    part_sizes: Int[np.ndarray, " parts"]
    usual_size: int

    @classmethod
    def create(cls, part_separators: list[Separator], number_ends: Int[np.ndarray, " lines"]) -> _Partition:
        """Divide a file; `number_ends`: number of numbers before each line, and in all."""
        part_starts = [part_separator.line for part_separator in part_separators]
        part_sizes = np.diff(number_ends[[*part_starts, len(number_ends) - 1]])
        return cls(
            part_separators, part_starts, part_sizes, Counter(part_sizes[part_sizes > 0].tolist()).most_common(1)[0][0]
        )


class Separator(NamedTuple):
    """A separator. **Fields**: `line`: the line of numbers that follows, counted among the lines of numbers;
    `position`: line number in the file; `text`: text."""

    line: int
    position: int
    text: str


@dataclass
class Separators:
    """The separators between the lines of numbers of a file. **Fields**: `found_separators`: all separators;
    `unreadable`: lines that contain anything but numbers, counted among the lines of numbers; `fault`: what the first
    of them contains."""

    found_separators: list[Separator] = field(default_factory=list)
    unreadable: list[int] = field(default_factory=list)
    fault: str = ""

    @property
    def examples(self) -> list[str]:
        """Text lines between the lines of numbers, shortened for messages."""
        return [
            found_separator.text[:_MAX_SHOWN_SEPARATOR_LENGTH]
            for found_separator in self.found_separators
            if found_separator.line
        ]

    def complete(
        self, numbers: Inexact[np.ndarray, " n"], lengths: Int[np.ndarray, " lines"], counts: Sequence[int], name: str
    ) -> RepairedNumbers:
        """Replace damaged parts of the file `name` by NaN. Parts are what is between any two separators, or between
        those of one kind, if these are as far apart as one of the `counts`.

        A part is damaged if its size is not that of most parts, or a multiple of it where separators are missing, or if
        it contains an unreadable line. A last part that is shorter than the others is not changed. Raises `ValueError`
        if too many parts are damaged.
        """
        number_ends = np.concatenate([[0], np.cumsum(lengths)])
        candidate_partitions = [
            _Partition.create(self._find_part_separators(separator_kind), number_ends)
            for separator_kind in (
                None,
                *dict.fromkeys(line_pattern(found_separator.text) for found_separator in self.found_separators),
            )
        ]
        parts_of_file, part_starts, part_sizes, part_size = next(
            (
                candidate_partition
                for candidate_partition in candidate_partitions
                if candidate_partition.usual_size in counts
            ),
            candidate_partitions[0],
        )
        line_ends = [*part_starts[1:], len(lengths)]
        is_unreadable = np.zeros(len(part_sizes), bool)
        is_unreadable[np.searchsorted(part_starts, self.unreadable, side="right") - 1] = True
        is_damaged = (part_sizes % part_size != 0) | (part_sizes == 0) | is_unreadable
        is_damaged[-1] &= part_sizes[-1] > part_size or is_unreadable[-1]
        damaged_parts = np.flatnonzero(is_damaged)
        if not damaged_parts.size:
            return RepairedNumbers(numbers, lengths, part_size)
        complete_parts = np.flatnonzero((part_sizes == part_size) & ~is_damaged)
        damage_note = (
            f"{len(damaged_parts)} of {counted(len(part_sizes), 'part')} between lines such as {self.examples[0]!r} "
            f"lack numbers or contain something else, the first from line {parts_of_file[damaged_parts[0]].position} on"
        )
        if len(complete_parts) < _MIN_COMPLETE_FRAMES or len(damaged_parts) > max(
            1, _MAX_DAMAGED_FRAME_SHARE * len(part_sizes)
        ):
            fault_hint = f" {self.fault}" if self.fault else ""
            raise ValueError(f"{name}: {damage_note}: too many to be left out.{fault_hint}")
        complete_lengths = lengths[part_starts[complete_parts[0]] : line_ends[complete_parts[0]]]
        number_parts, length_parts = [], []
        for part_start, part_end, is_part_damaged in zip(part_starts, line_ends, is_damaged, strict=True):
            number_parts.append(
                np.full(part_size, np.nan)
                if is_part_damaged
                else numbers[number_ends[part_start] : number_ends[part_end]]
            )
            length_parts.append(complete_lengths if is_part_damaged else lengths[part_start:part_end])
        damage_note = f"{damage_note}: they are left empty (NaN)."
        return RepairedNumbers(np.concatenate(number_parts), np.concatenate(length_parts), part_size, damage_note)

    def _find_part_separators(self, requested_kind: str | None) -> list[Separator]:
        """The separators that begin a part: those of one kind, or all. Different separators without numbers between
        them count as one; between equal ones, a part is empty."""
        part_separators, previous_separator_kind = [Separator(0, 1, "")], ""
        for found_separator in self.found_separators:
            separator_kind = line_pattern(found_separator.text)
            if requested_kind not in (None, separator_kind):
                continue
            is_on_later_line = found_separator.line > part_separators[-1].line
            if is_on_later_line or (found_separator.line and separator_kind == previous_separator_kind):
                part_separators.append(found_separator)
            if is_on_later_line or not found_separator.line or not previous_separator_kind:
                previous_separator_kind = separator_kind
        return part_separators


class WrappedLines:
    """Joins the lines of a frame that a device sends as several lines of numbers after a separator line.

    `channels`: number of channels of a frame. Lines that are frames themselves, and text that is not a separator, are
    returned as they are. A separator is recognised once a frame has followed it; before, it is returned as text.
    """

    def __init__(self, channels: int):
        self.channels = channels
        self._separators: set[str] = set()
        self._last_text = ""
        self._pending_numbers: list[float] | None = None  # of the frame that arrives, None outside of frames
        self._is_damaged = False  # the frame that arrives has been reported already

    def __call__(self, line: list[float] | str) -> list[float] | str | None:
        """Add a line, as its numbers or as text. Returns a frame, or text or numbers that are not a frame; None if the
        line belongs to a frame that is not complete."""
        if isinstance(line, str):
            return self._add_text(line)
        if self._is_damaged and len(line) < self.channels:
            return None
        is_first_line = self._pending_numbers == []
        if self._pending_numbers is None or len(line) >= self.channels or (is_first_line and self.channels % len(line)):
            self._pending_numbers = None
            return line
        self._pending_numbers += line
        if len(self._pending_numbers) < self.channels:
            return None
        pending_numbers, self._pending_numbers = self._pending_numbers, None
        if len(pending_numbers) == self.channels:
            self._separators.add(self._last_text)
        return pending_numbers

    def _add_text(self, text: str) -> list[float] | str | None:
        incomplete_numbers, text_pattern = self._pending_numbers, line_pattern(text)
        is_separator = text_pattern in self._separators
        self._is_damaged = (
            bool(self._separators) and not is_separator and (self._is_damaged or bool(incomplete_numbers))
        )
        if self._is_damaged:
            self._pending_numbers = None
            return text
        self._last_text, self._pending_numbers = text_pattern, []
        return (incomplete_numbers or None) if is_separator else text
