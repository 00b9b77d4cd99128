"""Lines of a device, cut from its bytes, and their numbers turned into volts as the readers of files do."""

from __future__ import annotations

import itertools
import re
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.data import Measurement, load_description, read
from jeit.data.description import Description
from jeit.data.formats.openeit import frames_in
from jeit.data.formats.table import description_like
from jeit.data.formats.text import LineNumbers

MOST_BYTES = 2**18
"""Maximum length of a line, bytes: a frame of 1,024 electrodes would be no line. Longer ones are cut."""
_ENDS = re.compile(rb"[\r\n]")
# A device of OpenEIT may leave out line ends: the word begins a frame.
_WORD = re.compile(rb"magnitudes\s{0,40}:", re.IGNORECASE)
_COMMENTS = ("#", "%", "//")
# Characters of a line that is no frame, which are kept.
_KEPT = 400
# Relative difference from the reference within which a number is whole, and a frame shows how numbers are turned into
# volts; frames that are tried for that.
_LIKE, _TRIES = 0.5, 20


class LineBuffer:
    """Cuts bytes, which come in pieces of any length, into lines; memory is bounded.

    A line longer than `most` bytes is cut there, and gets an ellipsis at its end.
    """

    def __init__(self, most: int = MOST_BYTES):
        self.most = most
        self._line = bytearray()
        self._over = False

    def feed(self, piece: bytes) -> list[bytes]:
        """The lines that are complete with a piece, without their ends; empty ones are left out."""
        lines = []
        *whole, rest = _ENDS.split(piece)
        for part in whole:
            self._add(part)
            lines += _parted(self.rest())
        self._add(rest)
        words = [one.start() for one in _WORD.finditer(self._line)]
        if words and words[-1] > 0:
            lines += _parted(bytes(self._line[: words[-1]]))
            del self._line[: words[-1]]
        return lines

    def rest(self) -> bytes:
        """The line that has begun, which is removed."""
        line = bytes(self._line) + ("…".encode() if self._over else b"")
        self._line.clear()
        self._over = False
        return line

    def _add(self, part: bytes) -> None:
        room = self.most - len(self._line)
        self._over = self._over or len(part) > room
        self._line += part[: max(room, 0)]


def _parted(line: bytes) -> list[bytes]:
    """A line, parted where a word begins a frame within it; nothing of an empty one."""
    starts = [0, *(one.start() for one in _WORD.finditer(line) if one.start() > 0), len(line)]
    parts = (line[start:stop] for start, stop in itertools.pairwise(starts))
    return [part for part in parts if part.strip()]


class LineReading:
    """Turns lines into frames (M,), volts, as `jeit.data.read` does with a file of such lines.

    `description`, `reference`: as `description` and `like` of `jeit.data.read`. What a reader does with a channel
    (unit, gain, sign) is found with the first frame that resembles the reference. Without both, numbers are volts.
    Raises `ValueError` for a description that is not valid, or whose frames are not single lines.
    """

    def __init__(self, description: str | Path | None = None, reference: Measurement | None = None):
        self.description, self.reference = description, reference
        described = _described(description, reference)
        self.channels = _channels(described, reference)
        layout = None if described is None else described.layout
        if layout is not None and layout.complex_pairs:
            raise ValueError(
                f"{described.origin if described else ''}: [data] complex_pairs makes a frame of two lines, and a live "
                "frame is one line: let the device send real voltages, or their magnitudes."
            )
        self.timed = layout is None or layout.time_column is not False
        self.note = ""
        self._numbers = LineNumbers()
        self._factor, self._tries = np.ones(self.channels or 1), 0
        self._known: np.ndarray | None = None

    def begins_whole(self, values: np.ndarray) -> bool:
        """Whether the first number of a frame may be whole: half of a number, with which a line begins if the device
        was in its middle, differs much from that of the reference. True without a reference."""
        usual = self._usual()
        if values.shape != usual.shape or not np.isfinite(usual[0]):
            return True
        return bool(abs(values[0] - usual[0]) <= _LIKE * abs(usual[0]))

    @np.errstate(all="ignore")  # numbers that are no voltages may overflow
    def __call__(self, line: bytes) -> Float[np.ndarray, " M"] | str | None:
        """The frame in a line; its text, shortened, if it is no frame; None for a comment."""
        text = line.decode("utf-8", "replace").replace("\x00", "\ufffd").strip()
        if text.startswith(_COMMENTS):
            self.note = text[:_KEPT]
            return None
        word = _WORD.match(line.strip())
        numbers = next(frames_in(line), None) if word else self._numbers(text)
        if numbers is None or not len(numbers):
            return text if len(text) <= _KEPT else f"{text[: _KEPT - 1]}…"
        row = np.array(numbers, float)
        if self.channels is not None and len(row) == self.channels + 1 and self.timed:
            row = row[1:]
        if word:
            row[row == 0] = np.nan
        if self.channels is None or len(row) != self.channels:
            return row
        return row * self._factors(row, "magnitudes: " if word else "")

    def _factors(self, row: np.ndarray, word: str) -> Float[np.ndarray, " M"]:
        """Volts per number of each channel. Each frame shows those of the channels that the reader does not mask, until
        all are known."""
        if self._tries >= _TRIES:
            return self._factor
        self._tries += 1
        used, volts = np.isfinite(row) & (row != 0), row
        if not used.any():
            return self._factor
        try:
            volts = self._read(row, word)
        except (ValueError, OSError) as error:  # such as of a full disk
            self.note = f"The numbers of a line are taken for volts, for as a file they cannot be read: {error}"
            self._tries = _TRIES
        found = np.where(used, volts / np.where(used, row, 1.0), np.nan)
        if self._resembles(volts) or self._tries >= _TRIES:
            self._known = found if self._known is None else np.where(np.isfinite(self._known), self._known, found)
            found = self._known
        if np.isfinite(found).all() and self._known is not None:
            self._tries = _TRIES
        self._factor = self._filled(found, row)
        return self._factor

    def _filled(self, factor: np.ndarray, row: np.ndarray) -> Float[np.ndarray, " M"]:
        """Factors, with those of the size of the others, and the sign of the reference, for channels not known."""
        known = np.isfinite(factor)
        if known.all() or not known.any():
            return np.where(known, factor, 1.0)
        sign = np.sign(factor[known][0])
        if (np.sign(factor[known]) != sign).any() and self.reference is not None:
            sign = np.sign(np.nan_to_num(self._usual() * row))
        return np.where(known, factor, sign * np.median(np.abs(factor[known])))

    def _read(self, row: np.ndarray, word: str) -> Float[np.ndarray, " M"]:
        """Volts that the reader of files finds in a line."""
        source = "" if self.reference is None else self.reference.source
        name = f"{Path(source).stem if source else 'line'}.txt"  # the name may state the current
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            cells = ", ".join("0" if word and not np.isfinite(one) else repr(one) for one in row.tolist())
            path.write_text(f"{word}{cells}\n", "utf-8")
            measured = read(path, description=self.description, like=self.reference)
        volts = np.real(np.asarray(measured.voltages))[0]
        if volts.shape != row.shape:
            raise ValueError(f"{len(volts)} channels are read of {len(row)} numbers.")
        return volts

    def _resembles(self, volts: np.ndarray) -> bool:
        """Whether a frame resembles the reference; True if there is none."""
        if self.reference is None:
            return True
        usual = self._usual()
        known = np.isfinite(usual) & np.isfinite(volts)
        return bool(np.linalg.norm((volts - usual)[known]) < _LIKE * np.linalg.norm(usual[known]))

    def _usual(self) -> Float[np.ndarray, " M"]:
        """The mean frame of the reference, NaN for masked channels; empty if there is none."""
        if self.reference is None:
            return np.zeros(0)
        usable = np.asarray(self.reference.mask).all(axis=0)
        return np.where(usable, np.real(np.asarray(self.reference.voltages)).mean(axis=0), np.nan)


def _described(description: str | Path | None, reference: Measurement | None) -> Description | None:
    if description is not None:
        return load_description(description)
    return None if reference is None else description_like(reference)


def _channels(described: Description | None, reference: Measurement | None) -> int | None:
    """Number of channels of a frame, if it is known."""
    if reference is not None:
        return reference.num_channels
    if described is None or described.protocol_section is None:
        return None
    try:
        protocol = described.protocol("line.txt")
    except ValueError:  # such as a current that only the name of a file states
        return None
    return None if protocol is None else protocol.num_measurements
