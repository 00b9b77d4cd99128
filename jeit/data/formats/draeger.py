"""Reader of recordings by Dräger's PulmoVista 500 (.eit): a text header, followed by frames of equal size.

Numbers are little-endian. Bytes 0-3 are the version of the format and bytes 4-7 the length of the header text; frames
begin at byte 16 + this length. The text states the frame rate as "Framerate [Hz]:". A frame has 5,495 bytes in version
50 and later, and 5,200 bytes in version 32. A frame begins with 600 numbers of eight bytes. The first 208 numbers, and
the 208 numbers from number 322 on, are two parts whose weighted sum gives the voltages of the adjacent protocol. The
maker has not published the weights; the weights used here are estimates by users.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jeit.data.formats.recording import (
    CHANNELS,
    adjacent_recording,
    content_of,
    count_frames,
    description_of,
    measurement_of,
    truncation_notes,
)
from jeit.data.measurement import Measurement

DESCRIPTION = "Dräger PulmoVista (.eit): 208 adjacent voltages a frame, with their rate"
# Bytes per frame for each version of the format. Frames of version 31 are too short for the known layout.
_FRAME_BYTES = {0x20: 5200, 0x33: 5495}
_HEADER_MARK, _PREFIX_BYTES = b"---Draeger EIT-Software", 16
# Index of the first number of the second part of the voltages, and the weights of both parts.
_SECOND_PART, _WEIGHTS = 322, (9.8242e-4, 1.9607e-4)
_SCALE_NOTES = (
    "the scale of the voltages is an estimate, not published: trust relative changes, not volts.",
    "electrode pairs are assumed to have the polarity that makes voltages positive.",
)


def recognises(path: Path) -> bool:
    """Whether a file is an .eit file whose first bytes name Dräger's software."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        return _HEADER_MARK in file.read(80)


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames of a Dräger recording. Raises `ValueError` for an unknown version, a file without a complete
    frame, and a header without a frame rate."""
    content = content_of(path)
    version, length = (int(number) for number in np.frombuffer(content[:8].ljust(8, b"\0"), "<i4"))
    if version not in _FRAME_BYTES:
        known_versions = ", ".join(str(known_version) for known_version in _FRAME_BYTES)
        raise ValueError(
            f"{path.name} is of Dräger's format {version}; only {known_versions} are known. Export it as a table."
        )
    frames_start, frame_size = length + _PREFIX_BYTES, _FRAME_BYTES[version]
    num_frames, num_leftover_bytes = count_frames(content, frames_start, frame_size, path)
    rate = _rate(content[:frames_start], path)
    frames = np.frombuffer(content, np.uint8, num_frames * frame_size, frames_start).reshape(num_frames, frame_size)
    values = frames[:, : 8 * (_SECOND_PART + CHANNELS)].copy().view("<f8")
    first_part, second_part = values[:, :CHANNELS], values[:, _SECOND_PART:]
    with np.errstate(invalid="ignore", over="ignore"):
        voltages = _WEIGHTS[0] * first_part - _WEIGHTS[1] * second_part
    recording = adjacent_recording(
        voltages, np.arange(num_frames) / rate, (*_SCALE_NOTES, *truncation_notes(num_leftover_bytes))
    )
    return measurement_of(path, recording, description_of(path, description))


def _rate(header: bytes, path: Path) -> float:
    """Frame rate in frames per second, from the header."""
    match = re.search(rb"Framerate \[Hz\]:[ \t]{0,40}([0-9]{1,6}(?:[.,][0-9]{1,6})?)", header)
    rate = 0.0 if match is None else float(match[1].replace(b",", b"."))
    if not rate > 0:
        raise ValueError(f"{path.name}: its header says no 'Framerate [Hz]:'; is it damaged?")
    return rate
