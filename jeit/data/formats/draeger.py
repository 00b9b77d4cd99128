"""Reader of Dräger PulmoVista 500 recordings (.eit): a header of text, then frames of equal size.

Bytes 0-3 are the format's version, 4-7 the length of the header's text, after which frames begin at byte 16 + that
(little-endian). The text says "Framerate [Hz]:". A frame of version 50 and later has 5,495 bytes, of version 32 5,200:
it begins with 600 numbers of eight bytes, of which the first 208 and those from 322 on are the two parts of the
adjacent voltages. Their weights are no more than estimated, by users.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jeit.data.formats.recording import (
    CHANNELS,
    adjacent_recording,
    content_of,
    cut_off,
    description_of,
    frame_at,
    measurement_of,
)
from jeit.data.measurement import Measurement

DESCRIPTION = "Dräger PulmoVista (.eit): 208 adjacent voltages a frame, with their rate"
# Bytes of a frame by the format's version; those of version 31 are too short for what is known of the others.
_FRAME = {0x20: 5200, 0x33: 5495}
_MARK, _BEFORE = b"---Draeger EIT-Software", 16
# The first of the second parts, and the weights of both.
_SECOND, _WEIGHTS = 322, (9.8242e-4, 1.9607e-4)
_NOTES = (
    "the scale of the voltages is an estimate, not published: trust relative changes, not volts.",
    "the electrodes are taken to be read in the sense that makes voltages positive.",
)


def recognises(path: Path) -> bool:
    """True for an .eit file that names its software in the first bytes."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        return _MARK in file.read(80)


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames. Raises `ValueError` for an unknown version, no whole frame, and a header without a rate."""
    content = content_of(path)
    version, length = (int(one) for one in np.frombuffer(content[:8].ljust(8, b"\0"), "<i4"))
    if version not in _FRAME:
        known = ", ".join(str(one) for one in _FRAME)
        raise ValueError(f"{path.name} is of Dräger's format {version}; only {known} are known. Export it as a table.")
    start, size = length + _BEFORE, _FRAME[version]
    number, left = frame_at(content, start, size, path)
    rate = _rate(content[:start], path)
    frames = np.frombuffer(content, np.uint8, number * size, start).reshape(number, size)
    values = frames[:, : 8 * (_SECOND + CHANNELS)].copy().view("<f8")
    first, second = values[:, :CHANNELS], values[:, _SECOND:]
    with np.errstate(invalid="ignore", over="ignore"):
        voltages = _WEIGHTS[0] * first - _WEIGHTS[1] * second
    recording = adjacent_recording(voltages, np.arange(number) / rate, (*_NOTES, *cut_off(left)))
    return measurement_of(path, recording, description_of(path, description))


def _rate(header: bytes, path: Path) -> float:
    """Frames in a second."""
    found = re.search(rb"Framerate \[Hz\]:[ \t]{0,40}([0-9]{1,6}(?:[.,][0-9]{1,6})?)", header)
    rate = 0.0 if found is None else float(found[1].replace(b",", b"."))
    if not rate > 0:
        raise ValueError(f"{path.name}: its header says no 'Framerate [Hz]:'; is it damaged?")
    return rate
