"""Reader of lines of an OpenEIT device: the word "magnitudes" and the numbers of a frame, as the firmware sends them
and the dashboard records them, with or without line ends.

The number of numbers states the protocol of the firmware: 32, 192 or 896 of 8, 16 or 32 electrodes, driven in opposite
pairs from every electrode; 928 of 32, driven in adjacent pairs; 28 of all pairs of 8, of the first device. Measurements
are adjacent, in the order of the electrodes. The numbers are magnitudes of impedances, ohms; zero where the device
reports an open circuit.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted, listed
from jeit.data.description import parse_description
from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of
from jeit.data.formats.table import description_like, find_description
from jeit.data.formats.unstated import with_signs
from jeit.data.measurement import Measurement

DESCRIPTION = "lines of an OpenEIT device ('magnitudes: …'), of 8, 16 or 32 electrodes"
_WORD = re.compile(rb"\s{0,40}magnitudes\s{0,40}:", re.IGNORECASE)
# Bytes in which the first word stands.
_START = 4096
_CURRENT = 1e-3
# Tables [protocol] of the firmware by their number of channels.
_PROTOCOLS: dict[int, dict[str, Any]] = {
    **{
        channels: {"kind": "opposite", "number": count, "drives": "all", "order": "fixed"}
        for channels, count in ((32, 8), (192, 16), (896, 32))
    },
    928: {"kind": "adjacent", "number": 32, "order": "fixed"},
    28: {"kind": "two_terminal", "number": 8},
}
_NOTE = "the numbers are taken for ohms, as of a calibrated device, and given as voltages of 1 mA."


def recognises(path: Path) -> bool:
    """True for a file that begins with the word "magnitudes", and states the protocol by the number of its numbers."""
    with path.open("rb") as file:
        if _WORD.match(file.read(_START)) is None:
            return False
    return _usual(_frames(path)) in _PROTOCOLS


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames. A `[protocol]` in the description takes precedence; without a description, the body is that of
    `like`, a measurement of the same sensor.

    A frame that is cut off at the end is left out. Raises `ValueError` for frames of unequal length, numbers that are
    of no protocol of the firmware, anything but numbers, and a `key`, for there are no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    lines = _frames(path)
    count = _usual(lines)
    if count not in _PROTOCOLS:
        known = listed([f"{channels} ({one['number']} electrodes)" for channels, one in _PROTOCOLS.items()])
        raise ValueError(
            f"{path.name}: a frame has {counted(count, 'number')}; the firmware sends {known}. Read it as a table."
        )
    notes: tuple[str, ...] = ()
    if len(lines) > 1 and len(lines[-1]) < count:
        notes = (*notes, f"the last frame is cut off after {counted(len(lines.pop()), 'number')}, and left out.")
    if other := [k for k, line in enumerate(lines, start=1) if len(line) != count]:
        raise ValueError(f"{path.name}: frame {other[0]} has length {len(lines[other[0] - 1])}, most have {count}.")
    values = np.array([[_number(cell, frame, path) for cell in line] for frame, line in enumerate(lines, start=1)])
    if zeros := int((values == 0).sum()):
        notes = (*notes, f"{counted(zeros, 'reading')} of zero, as of an open circuit: left out.")
    if like is not None and description is None and find_description(path) is None:
        described = description_like(like)
    else:
        described = description_of(path, description)
    protocol = parse_description({"protocol": {**_PROTOCOLS[count], "current": _CURRENT}}, path.name).protocol(path)
    assert protocol is not None
    values = np.where(values == 0, np.nan, values)
    if described.protocol_section is None:
        values, notes = _CURRENT * values, (_NOTE, *notes)
    recording = Recording(values, protocol, notes=notes)
    return with_signs(measurement_of(path, recording, described), like)


def _frames(path: Path) -> list[list[bytes]]:
    """Cells of each frame; empty ones, as after the last number, are left out."""
    frames = [part.split(b",") for part in _WORD.split(content_of(path))[1:]]
    return [[cell.strip() for cell in cells if cell.strip()] for cells in frames]


def _usual(frames: list[list[bytes]]) -> int:
    """Length of most frames."""
    return Counter(map(len, frames)).most_common(1)[0][0] if frames else 0


def _number(cell: bytes, frame: int, path: Path) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"{path.name}, frame {frame}: {cell.decode(errors='replace')[:40]!r} is no number.") from None


def protocol_table(path: Path) -> dict[str, Any]:
    """The table `[protocol]`, without the current, of a file that `recognises` accepts."""
    return _PROTOCOLS[_usual(_frames(path))]
