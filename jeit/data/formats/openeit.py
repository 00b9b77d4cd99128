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
from jaxtyping import Float

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

    Raises `ValueError` as `numbers`, and for a `key`, for there are no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    values, notes = numbers(path)
    if like is not None and description is None and find_description(path) is None:
        described = description_like(like)
    else:
        described = description_of(path, description)
    table = {**_PROTOCOLS[values.shape[1]], "current": _CURRENT}
    protocol = parse_description({"protocol": table}, path.name).protocol(path)
    assert protocol is not None
    if described.protocol_section is None:
        values, notes = _CURRENT * values, (_NOTE, *notes)
    recording = Recording(values, protocol, notes=notes)
    return with_signs(measurement_of(path, recording, described), like)


def numbers(path: Path) -> tuple[Float[np.ndarray, "F M"], tuple[str, ...]]:
    """The numbers of each frame, and notes. NaN where there is none: of a reading of zero, as of an open circuit, of a
    cell that is no number, and of a whole frame that is longer or shorter than most, for characters were lost.

    Raises `ValueError` if most frames are of no protocol of the firmware.
    """
    frames = _frames(path)
    count = _usual(frames)
    if count not in _PROTOCOLS or 2 * sum(len(one) == count for one in frames) <= len(frames):
        known = listed([f"{channels} ({one['number']} electrodes)" for channels, one in _PROTOCOLS.items()])
        raise ValueError(
            f"{path.name}: most frames have {counted(count, 'number')}; the firmware sends {known}. Read it as a table."
        )
    notes = []
    if len(frames[-1]) < count:
        notes.append(f"the last frame is cut off after {counted(len(frames.pop()), 'number')}, and left out.")
    whole = [len(one) == count for one in frames]
    lost = [str(k) for k, one in enumerate(whole, start=1) if not one]
    values = np.full((len(frames), count), np.nan)
    values[whole] = [[_number(cell) for cell in one] for one, kept in zip(frames, whole, strict=True) if kept]
    if lost:
        notes.append(f"characters are lost in frame{'s' * (len(lost) > 1)} {listed(lost)}: masked.")
    if gone := int((values == 0).sum()) + int(np.isnan(values[whole]).sum()):
        notes.append(f"{counted(gone, 'reading')} of zero, as of an open circuit, or illegible: masked.")
    return np.where(values == 0, np.nan, values), tuple(notes)


def _frames(path: Path) -> list[list[bytes]]:
    """Cells of each frame; empty ones, as after the last number, are left out."""
    frames = [part.split(b",") for part in _WORD.split(content_of(path))[1:]]
    return [[cell.strip() for cell in cells if cell.strip()] for cells in frames]


def _usual(frames: list[list[bytes]]) -> int:
    """Length of most frames."""
    return Counter(map(len, frames)).most_common(1)[0][0] if frames else 0


def _number(cell: bytes) -> float:
    """The number in a cell, NaN if there is none."""
    try:
        return float(cell)
    except ValueError:
        return np.nan


def protocol_table(path: Path) -> dict[str, Any]:
    """The table `[protocol]`, without the current, of a file that `recognises` accepts."""
    return _PROTOCOLS[_usual(_frames(path))]
