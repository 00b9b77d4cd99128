"""Conversion of the bytes that a device sends to lines, and of the numbers in a line to the volts that a reader of
files would return."""

from __future__ import annotations

import itertools
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.data import Measurement, load_description, read
from jeit.data.description import Description
from jeit.data.formats.boards import OpenEit
from jeit.data.formats.separated import WrappedLines
from jeit.data.formats.table import description_like
from jeit.data.formats.text import LineNumbers

MAX_LINE_BYTES = 2**18
"""Maximum length of a line in bytes. Longer lines are truncated."""
_LINE_END_PATTERN = re.compile(rb"[\r\n]")
# Some OpenEIT devices send no line ends, so a frame begins at the word "magnitudes".
_FRAME_WORD_PATTERN = re.compile(rb"magnitudes\s{0,40}:", re.IGNORECASE)
_COMMENT_PREFIXES = ("#", "%", "//")
# Maximum number of characters that are stored of a line that is not a frame.
_MAX_TEXT_LENGTH = 400
# Maximum relative difference between the first number of a line and the reference; a larger difference shows that the
# beginning of the line was lost. Maximum relative difference of a frame that is used to determine the factors from
# numbers to volts.
_MAX_FIRST_NUMBER_DIFFERENCE = 0.5
# Maximum number of frames from which the factors are determined.
_MAX_FRAMES_FOR_FACTORS = 20


class LineBuffer:
    """Splits bytes, which arrive in chunks of any length, into lines.

    A line longer than `max_bytes` bytes is truncated, and an ellipsis is appended, so that memory is bounded.
    """

    def __init__(self, max_bytes: int = MAX_LINE_BYTES):
        self.max_bytes = max_bytes
        self._incomplete_line = bytearray()
        self._is_truncated = False

    def add_bytes(self, data: bytes) -> list[bytes]:
        """Append a chunk of bytes to the buffer, and return the lines that are now complete, without line ends and
        empty lines."""
        complete_lines = []
        *complete_parts, incomplete_line = _LINE_END_PATTERN.split(data)
        for complete_part in complete_parts:
            self._append_data(complete_part)
            complete_lines += _split_at_words(self.take_incomplete_line())
        self._append_data(incomplete_line)
        word_starts = [word_match.start() for word_match in _FRAME_WORD_PATTERN.finditer(self._incomplete_line)]
        if word_starts and word_starts[-1] > 0:
            complete_lines += _split_at_words(bytes(self._incomplete_line[: word_starts[-1]]))
            del self._incomplete_line[: word_starts[-1]]
        return complete_lines

    def take_incomplete_line(self) -> bytes:
        """Remove the incomplete line at the end of the buffer, and return it."""
        line = bytes(self._incomplete_line) + ("…".encode() if self._is_truncated else b"")
        self._incomplete_line.clear()
        self._is_truncated = False
        return line

    def _append_data(self, new_bytes: bytes) -> None:
        num_free = self.max_bytes - len(self._incomplete_line)
        self._is_truncated = self._is_truncated or len(new_bytes) > num_free
        self._incomplete_line += new_bytes[: max(num_free, 0)]


def _split_at_words(line: bytes) -> list[bytes]:
    """Split a line at each word "magnitudes" within it, because the word begins a new frame. Empty lines are left
    out."""
    part_starts = [
        0,
        *(word_match.start() for word_match in _FRAME_WORD_PATTERN.finditer(line) if word_match.start() > 0),
        len(line),
    ]
    line_parts = (line[part_start:part_end] for part_start, part_end in itertools.pairwise(part_starts))
    return [line_part for line_part in line_parts if line_part.strip()]


class LineParser:
    """Converts lines of numbers to frames (channels,) in volts, as `jeit.data.read` converts a file of the same lines.

    `description`, `reference`: as `description` and `like` of `jeit.data.read`. The factor from number to volts of each
    channel (unit, gain, sign) is determined from the first frame that resembles the reference. Without a description
    and a reference, numbers are volts. Raises `ValueError` for an invalid description, or if a frame of the described
    file is not a single line.
    """

    def __init__(self, description: str | Path | None = None, reference: Measurement | None = None):
        self.description, self.reference = description, reference
        loaded_description = _load_description(description, reference)
        self.channels = _num_channels(loaded_description, reference)
        described_layout = None if loaded_description is None else loaded_description.layout
        if described_layout is not None and described_layout.complex_pairs:
            raise ValueError(
                f"{loaded_description.origin if loaded_description else ''}: [data] complex_pairs makes a frame of two "
                "lines, and a live frame is one line: let the device send real voltages, or their magnitudes."
            )
        self.has_times = described_layout is None or described_layout.time_column is not False
        self.note = ""
        self._parse_numbers = LineNumbers()
        self._join_lines = None if self.channels is None else WrappedLines(self.channels)
        self._channel_factors, self._num_factor_frames = np.ones(self.channels or 1), 0
        self._known_factors: np.ndarray | None = None

    def starts_with_complete_number(self, values: np.ndarray) -> bool:
        """Whether the first number of a frame may be complete. If the connection began within a line, the first number
        may be a part of a number; it then differs much from the first number of the reference. True without a
        reference."""
        reference_frame = self._reference_frame()
        if values.shape != reference_frame.shape or not np.isfinite(reference_frame[0]):
            return True
        return bool(abs(values[0] - reference_frame[0]) <= _MAX_FIRST_NUMBER_DIFFERENCE * abs(reference_frame[0]))

    @np.errstate(all="ignore")  # numbers that are not voltages may overflow
    def __call__(self, line: bytes) -> Float[np.ndarray, " M"] | str | None:
        """Return the frame in a line, or in this and the lines before it; the text of the line, shortened, if it is not
        a frame; None for a comment, and for a part of a frame."""
        text = line.decode("utf-8", "replace").replace("\x00", "\ufffd").strip()
        if text.startswith(_COMMENT_PREFIXES):
            self.note = text[:_MAX_TEXT_LENGTH]
            return None
        frame_word = _FRAME_WORD_PATTERN.match(line.strip())
        parsed_numbers = next(OpenEit.parse_frames(line), None) if frame_word else self._parse_numbers(text)
        if not frame_word and self._join_lines is not None:
            parsed_numbers = self._join_lines(list(parsed_numbers) if parsed_numbers else text)
            if parsed_numbers is None:
                return None
        if parsed_numbers is None or isinstance(parsed_numbers, str) or not len(parsed_numbers):
            return text if len(text) <= _MAX_TEXT_LENGTH else f"{text[: _MAX_TEXT_LENGTH - 1]}…"
        frame_row = np.array(parsed_numbers, float)
        if self.channels is not None and len(frame_row) == self.channels + 1 and self.has_times:
            frame_row = frame_row[1:]
        if frame_word:
            frame_row[frame_row == 0] = np.nan
        if self.channels is None or len(frame_row) != self.channels:
            return frame_row
        return frame_row * self._volts_per_number(frame_row, "magnitudes: " if frame_word else "")

    def _volts_per_number(self, frame_row: np.ndarray, frame_word: str) -> Float[np.ndarray, " M"]:
        """Return the factor from number to volts of each channel. Each frame `frame_row` determines the factors of the
        channels that the reader of files does not mask, until all factors are known."""
        if self._num_factor_frames >= _MAX_FRAMES_FOR_FACTORS:
            return self._channel_factors
        self._num_factor_frames += 1
        is_nonzero, voltages = np.isfinite(frame_row) & (frame_row != 0), frame_row
        if not is_nonzero.any():
            return self._channel_factors
        try:
            voltages = self._read_volts(frame_row, frame_word)
        except (ValueError, OSError) as error:  # for example a full disk
            self.note = f"The numbers of a line are taken for volts, for as a file they cannot be read: {error}"
            self._num_factor_frames = _MAX_FRAMES_FOR_FACTORS
        volts_per_number = np.where(is_nonzero, voltages / np.where(is_nonzero, frame_row, 1.0), np.nan)
        if self._resembles_reference(voltages) or self._num_factor_frames >= _MAX_FRAMES_FOR_FACTORS:
            self._known_factors = (
                volts_per_number
                if self._known_factors is None
                else np.where(np.isfinite(self._known_factors), self._known_factors, volts_per_number)
            )
            volts_per_number = self._known_factors
        if np.isfinite(volts_per_number).all() and self._known_factors is not None:
            self._num_factor_frames = _MAX_FRAMES_FOR_FACTORS
        self._channel_factors = self._fill_factors(volts_per_number, frame_row)
        return self._channel_factors

    def _fill_factors(self, volts_per_number: np.ndarray, frame_row: np.ndarray) -> Float[np.ndarray, " M"]:
        """Replace unknown factors from numbers to volts by the median magnitude of the known factors, with the sign
        given by the reference."""
        is_known = np.isfinite(volts_per_number)
        if is_known.all() or not is_known.any():
            return np.where(is_known, volts_per_number, 1.0)
        factor_sign = np.sign(volts_per_number[is_known][0])
        if (np.sign(volts_per_number[is_known]) != factor_sign).any() and self.reference is not None:
            factor_sign = np.sign(np.nan_to_num(self._reference_frame() * frame_row))
        return np.where(is_known, volts_per_number, factor_sign * np.median(np.abs(volts_per_number[is_known])))

    def _read_volts(self, frame_row: np.ndarray, frame_word: str) -> Float[np.ndarray, " M"]:
        """Convert the numbers of a line to volts with the reader of files."""
        reference_source = "" if self.reference is None else self.reference.source
        name = (
            f"{Path(reference_source).stem if reference_source else 'line'}.txt"  # the file name may state the current
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            cells = ", ".join(
                "0" if frame_word and not np.isfinite(row_number) else repr(row_number)
                for row_number in frame_row.tolist()
            )
            path.write_text(f"{frame_word}{cells}\n", "utf-8")
            read_measurement = read(path, description=self.description, like=self.reference)
        voltages = np.real(np.asarray(read_measurement.voltages))[0]
        if voltages.shape != frame_row.shape:
            raise ValueError(f"{len(voltages)} channels are read of {len(frame_row)} numbers.")
        return voltages

    def _resembles_reference(self, voltages: np.ndarray) -> bool:
        """Whether a frame resembles the reference. True without a reference."""
        if self.reference is None:
            return True
        reference_frame = self._reference_frame()
        is_finite = np.isfinite(reference_frame) & np.isfinite(voltages)
        return bool(
            np.linalg.norm((voltages - reference_frame)[is_finite])
            < _MAX_FIRST_NUMBER_DIFFERENCE * np.linalg.norm(reference_frame[is_finite])
        )

    def _reference_frame(self) -> Float[np.ndarray, " M"]:
        """Mean frame of the reference, NaN for masked channels; empty without a reference."""
        if self.reference is None:
            return np.zeros(0)
        usable_channels = np.asarray(self.reference.mask).all(axis=0)
        return np.where(usable_channels, np.real(np.asarray(self.reference.voltages)).mean(axis=0), np.nan)


def read_lines(lines: Iterable[str | bytes], reading: LineParser) -> Iterator[Float[np.ndarray, " M"] | str]:
    """Yield the frames of lines of text as they arrive, in volts, and the text of lines that are not frames."""
    for line in lines:
        frame = reading(line if isinstance(line, bytes) else line.encode()) if line.strip() else None
        if frame is not None:
            yield frame


def _load_description(description: str | Path | None, reference: Measurement | None) -> Description | None:
    if description is not None:
        return load_description(description)
    return None if reference is None else description_like(reference)


def _num_channels(loaded_description: Description | None, reference: Measurement | None) -> int | None:
    """Number of channels of a frame; None if unknown."""
    if reference is not None:
        return reference.num_channels
    if loaded_description is None or loaded_description.protocol_section is None:
        return None
    try:
        protocol = loaded_description.protocol("line.txt")
    except ValueError:  # for example, if only the name of a file states the current
        return None
    return None if protocol is None else protocol.num_measurements
