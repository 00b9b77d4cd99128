"""Reader of what Analog Devices' CN0565 kit sends over its serial line, as terminals and programs record it.

A frame is a line that begins with "!V": whole numbers of 32 bits in hexadecimal digits, separated by commas, the real
and the imaginary part of each voltage in turn. Each electrode drives in turn, against the one at the force distance;
for each drive the electrodes sense in the order of their numbers, each against the one at the sense distance, without
the pairs that touch a driven electrode. With 8, 16 or 32 electrodes and both distances 1, which the kit's programs take
unless asked otherwise, that is 40, 208 or 928 voltages. Other lines are answers to commands and messages.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex

from jeit.arguments import counted, listed
from jeit.data.description import Description, parse_description
from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of
from jeit.data.formats.table import description_like, find_description
from jeit.data.measurement import Measurement
from jeit.data.unstated import with_signs
from jeit.protocol import Protocol

DESCRIPTION = "lines of Analog Devices' CN0565 kit ('!V' and hexadecimal numbers), of 8, 16 or 32 electrodes"
# A frame may follow the time that a terminal puts before it.
_LINE = re.compile(rb"^[^!\r\n]{0,80}!V[ \t]{0,8}([0-9A-Fa-fxX, \t]*)(.*)$", re.MULTILINE)
_WORD = re.compile(rb"(?:0[xX])?([0-9A-Fa-f]{1,8})")
# Number of bytes read to recognise a file; minimum count of numbers in a line of data.
_HEAD, _FEWEST = 65536, 8
_COUNTS = (8, 16, 32)
_CURRENT = 1e-3
_NOTES = (
    "the numbers are those of the converter: neither their unit nor the current is known (1 mA is assumed): trust "
    "relative changes, not volts.",
)
_DISTANCES = (
    'with force and sense distance F and S it is kind = "skip", skipped = F - 1, measurement_skipped = S - 1, '
    'order = "fixed"'
)


def recognises(path: Path) -> bool:
    """True for a file with a line of the kit near its start."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return any(len(words) >= _FEWEST for words in _frames(head))


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames. A `[protocol]` in the description states other distances than 1, or the current; without a
    description, the body and the protocol are those of `like`, a measurement of the same sensor.

    Raises `ValueError` as `numbers`, for a number of voltages that distances of 1 do not give unless a protocol is
    described, and for a `key`, for there are no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    values, notes = numbers(path)
    borrowed = like is not None and description is None and find_description(path) is None
    described = description_like(like) if borrowed and like is not None else description_of(path, description)
    protocol, said = _protocol(path, described, values.shape[1], like if borrowed else None)
    described = replace(described, protocol_section=None)
    measurement = measurement_of(path, Recording(values, protocol, notes=(*_NOTES, *said, *notes)), described)
    return with_signs(measurement, like)


def _protocol(
    path: Path, described: Description, count: int, like: Measurement | None
) -> tuple[Protocol, tuple[str, ...]]:
    """The protocol of `count` voltages, and notes on what is assumed."""
    if like is not None and like.protocol.num_measurements == count:
        return like.protocol, ()
    stated = [one for one in described.protocols(path) if one[0].num_measurements == count]
    if stated:
        # The kit counts from electrode 1, unless the description says otherwise.
        protocol, said = next((one for one in stated if 'order = "fixed"' in one[1]), stated[0])
        return protocol, (f"[protocol] {said} is taken, as the kit sends.",) if said else ()
    if described.protocol_section is not None:
        protocol = described.protocol(path)
        assert protocol is not None
        raise ValueError(
            f"{described.origin}: '{protocol.name}' has {protocol.num_measurements} channels, and a frame of "
            f"{path.name} {count}: {_DISTANCES}."
        )
    number = next((one for one in _COUNTS if one * (one - 3) == count), None)
    if number is None:
        usual = listed([f"{one * (one - 3)} ({one} electrodes)" for one in _COUNTS])
        raise ValueError(
            f"{path.name}: {count} voltages in a frame; with force and sense distance 1 they are {usual}. Give a "
            f"description with [protocol]: {_DISTANCES}."
        )
    table: dict[str, Any] = {"kind": "adjacent", "number": number, "order": "fixed", "current": _CURRENT}
    protocol = parse_description({"protocol": table}, path.name).protocol(path)
    assert protocol is not None
    return protocol, ("force and sense distance are taken to be 1 (adjacent pairs); the file does not say them.",)


def numbers(path: Path) -> tuple[Complex[np.ndarray, "F M"], tuple[str, ...]]:
    """The voltages of each frame, in steps of the converter, and notes. NaN for a frame that is longer or shorter than
    most, or holds what is no number, for characters were lost.

    Raises `ValueError` if there is no frame, or if most have an odd number of numbers.
    """
    frames = list(_frames(content_of(path)))
    if not frames:
        raise ValueError(f"{path.name}: no line begins with '!V', as those of a CN0565 do.")
    lengths = [len(one) for one in frames]
    usual = Counter(lengths[:-1] or lengths).most_common(1)[0][0]
    if usual % 2 or not usual:
        raise ValueError(
            f"{path.name}: most lines have {counted(usual, 'number')}; give real and imaginary parts in turn, an even "
            "number. Are lines cut off?"
        )
    notes = []
    if len(frames) > 1 and lengths[-1] < usual:
        notes.append(f"the last frame is cut off after {counted(lengths[-1], 'number')}, and left out.")
        del frames[-1]
    values = np.full((len(frames), usual), np.nan)
    for number, frame in enumerate(frames):
        if len(frame) == usual and None not in frame:
            values[number] = frame
    lost = [str(number) for number in np.flatnonzero(np.isnan(values[:, 0]))]
    if lost:
        notes.append(f"characters are lost in frame{'s' * (len(lost) > 1)} {listed(lost)}: masked.")
    return values[:, 0::2] + 1j * values[:, 1::2], tuple(notes)


def _frames(content: bytes) -> Iterator[list[float | None]]:
    """Numbers of each line that is a frame; None for a cell that is none, and for what follows the numbers."""
    for line in _LINE.finditer(content):
        cells = [cell.strip() for cell in line[1].split(b",")]
        while cells and not cells[-1]:
            cells.pop()
        found = [_number(cell) for cell in cells]
        yield [*found, None] if line[2].strip() else found
        for _ in range(line[2].count(b"!V")):  # a line end is lost; the frames keep their places in time
            yield [None]


def _number(cell: bytes) -> float | None:
    """A whole number of 32 bits with its sign, or None."""
    word = _WORD.fullmatch(cell)
    if word is None:
        return None
    value = int(word[1], 16)
    return float(value - 2**32 if value >= 2**31 else value)
