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
_MIN_REPEATED = 2
# Minimum number of complete parts, and maximum share of damaged ones, with which a file is read.
_MIN_COMPLETE, _MAX_DAMAGED = 3, 0.1
# Maximum number of characters of a separator in a note.
_MAX_EXAMPLE = 20


def line_pattern(line: str) -> str:
    """A line with # in place of each number, so that "Frame 1" and "Frame 2" have the same pattern."""
    return re.sub(r"\d+", "#", line.strip())


def separator_patterns(lines: Sequence[str], holds_numbers: Callable[[str], bool]) -> set[str]:
    """Patterns of the lines without numbers that begin with a letter and occur about as often as the most frequent of
    them; none if no line holds numbers."""
    words = [line_pattern(line) for line in lines if not holds_numbers(line)]
    counts = Counter(pattern for pattern in words if pattern[:1].isalpha())
    least_count = max(_MIN_REPEATED, 0.5 * max(counts.values(), default=0))
    repeated = {pattern for pattern, count in counts.items() if count >= least_count}
    return repeated if len(words) < len(lines) else set()


class CompleteParts(NamedTuple):
    """Numbers of a file in which every part is complete. **Fields**: `numbers`: all numbers; `lengths`: number of
    numbers in each line; `size`: number of numbers in a part; `notes`: how many parts are damaged."""

    numbers: Inexact[np.ndarray, " n"]
    lengths: Int[np.ndarray, " lines"]
    size: int
    notes: tuple[str, ...] = ()


@dataclass
class Separators:
    """The separators between the lines of numbers of a file. **Fields**: `starts`: for each part, its first line,
    counted among the lines of numbers; `positions`: the same, as a line number of the file; `unreadable`: lines that
    contain anything but numbers, counted among the lines of numbers; `examples`: text of the separators between lines
    of numbers, shortened."""

    starts: list[int] = field(default_factory=lambda: [0])
    positions: list[int] = field(default_factory=lambda: [1])
    unreadable: list[int] = field(default_factory=list)
    examples: list[str] = field(default_factory=list)

    def add(self, line: int, position: int, text: str) -> None:
        """Begin a part at a `line` of numbers; the separator `text` is at the line number `position`. Separators
        without numbers between them count as one."""
        if line:
            self.examples.append(text.strip()[:_MAX_EXAMPLE])
        if line > self.starts[-1]:
            self.starts.append(line)
            self.positions.append(position)

    def complete(self, numbers: Inexact[np.ndarray, " n"], lengths: Int[np.ndarray, " lines"]) -> CompleteParts | None:
        """Replace damaged parts by NaN; None if too many parts are damaged, or if they have different sizes.

        A part is damaged if it is not as long as most parts, or contains an unreadable line. A last part that is
        shorter than the others is not changed.
        """
        starts = [start for start in self.starts if start < len(lengths)]
        if len(starts) < _MIN_COMPLETE:
            return None
        line_ends = [*starts[1:], len(lengths)]
        number_ends = np.concatenate([[0], np.cumsum(lengths)])
        sizes = np.diff(number_ends[[*starts, len(lengths)]])
        size = Counter(sizes.tolist()).most_common(1)[0][0]
        is_unreadable = np.zeros(len(starts), bool)
        is_unreadable[np.searchsorted(starts, self.unreadable, side="right") - 1] = True
        is_damaged = (sizes != size) | is_unreadable
        is_damaged[-1] &= sizes[-1] > size or is_unreadable[-1]
        damaged = np.flatnonzero(is_damaged)
        num_complete = int(((sizes == size) & ~is_damaged).sum())
        if num_complete < _MIN_COMPLETE or len(damaged) > max(1, _MAX_DAMAGED * len(starts)):
            return None
        if not damaged.size:
            return CompleteParts(numbers, lengths, size)
        first_complete = int(np.flatnonzero((sizes == size) & ~is_damaged)[0])
        complete_lengths = lengths[starts[first_complete] : line_ends[first_complete]]
        number_parts, length_parts = [], []
        for start, end, damage in zip(starts, line_ends, is_damaged, strict=True):
            number_parts.append(np.full(size, np.nan) if damage else numbers[number_ends[start] : number_ends[end]])
            length_parts.append(complete_lengths if damage else lengths[start:end])
        note = (
            f"{len(damaged)} of {counted(len(starts), 'part')} between such lines lack numbers or contain something "
            f"else, the first from line {self.positions[damaged[0]]} on: they are left empty (NaN)."
        )
        return CompleteParts(np.concatenate(number_parts), np.concatenate(length_parts), size, (note,))


class WrappedLines:
    """Joins the lines of a frame that a device sends as several lines of numbers after a separator line.

    `channels`: number of channels of a frame. Lines that are frames themselves, and text that is not a separator, are
    returned as they are. The first separator cannot be recognised, and is returned as text.
    """

    def __init__(self, channels: int):
        self.channels = channels
        self._separator = self._last_text = ""
        self._numbers: list[float] | None = None  # of the frame that arrives, None outside of frames
        self._is_damaged = False  # the frame that arrives has been reported already

    def __call__(self, line: list[float] | str) -> list[float] | str | None:
        """Add a line, as its numbers or as text. Returns a frame, or text or numbers that are not a frame; None if the
        line belongs to a frame that is not complete."""
        if isinstance(line, str):
            return self._add_text(line)
        if self._is_damaged and len(line) < self.channels:
            return None
        is_first = self._numbers == []
        if self._numbers is None or len(line) >= self.channels or (is_first and self.channels % len(line)):
            self._numbers = None
            return line
        self._numbers += line
        if len(self._numbers) < self.channels:
            return None
        numbers, self._numbers = self._numbers, None
        if len(numbers) == self.channels:
            self._separator = self._last_text
        return numbers

    def _add_text(self, text: str) -> list[float] | str | None:
        incomplete, pattern = self._numbers, line_pattern(text)
        self._is_damaged = bool(self._separator) and pattern != self._separator
        if self._is_damaged:
            self._numbers = None
            return text
        self._last_text, self._numbers = pattern, []
        return text if not self._separator else incomplete or None
