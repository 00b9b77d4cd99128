"""Reader of recordings by Carefusion's Goe-MF II (.eit): XML in UTF-16, followed by binary segments.

`<Header>N bytes</Header>` gives the offset of the first segment. A segment begins with six little-endian integers of
four bytes: its type, a channel, the number of its frame from 0, the bytes per item, the number of items, and one of
unknown meaning; the items follow. Type 3 is a frame of 256 numbers of four bytes, of which the 208 from the 48th on are
the adjacent voltages; type 7 is an image of 912 numbers; other types are waveforms.
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
    measurement_of,
)
from jeit.data.measurement import Measurement

DESCRIPTION = "Carefusion Goe-MF II (.eit): 208 adjacent voltages a frame"
_ORDER, _MARK, _LOOKED_AT = b"\xff\xfe", "<EIT_File>", 512
# Number of integers before the items of a segment; the two segment types of fixed length, and their lengths in numbers
# of four bytes.
_HEAD, _VOLTAGES, _IMAGE = 6, 3, 7
_NUMBERS = {_VOLTAGES: 256, _IMAGE: 912}
_FIRST = 47
_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_NO_RATE = "the file says no rate that is known; give it by [data] frame_rate."


def recognises(path: Path) -> bool:
    """True for an .eit file that begins with the XML of this format."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        return _MARK in _text(file.read(_LOOKED_AT))


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames. Raises `ValueError` if the header does not state its length, and if there is no complete
    frame."""
    content = content_of(path)
    found = re.search(r"<Header>\s{0,9}([0-9]{1,9}) bytes</Header>", _text(content[:_LOOKED_AT]))
    if found is None or not _LOOKED_AT // 8 < int(found[1]) < len(content):
        raise ValueError(f"{path.name}: its header does not say where the frames begin; is it damaged?")
    frames, left = _frames(content, int(found[1]))
    if not frames:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    described = description_of(path, description)
    no_rate = (_NO_RATE,) if described.layout.frame_rate is None else ()
    recording = adjacent_recording(np.stack(frames), None, (_NOTE, *no_rate, *cut_off(left)))
    return measurement_of(path, recording, described)


def _text(content: bytes) -> str:
    return content[len(_ORDER) :].decode("utf-16-le", "ignore") if content.startswith(_ORDER) else ""


def _frames(content: bytes, start: int) -> tuple[list[np.ndarray], int]:
    """Voltages of every complete frame, and number of bytes left over by a truncated last segment."""
    frames, place = [], start
    while place + 4 * _HEAD <= len(content):
        kind, _, _, size, number, _ = (int(one) for one in np.frombuffer(content, "<i4", _HEAD, place))
        length = 4 * _NUMBERS[kind] if kind in _NUMBERS else max(size, 0) * max(number, 0)
        begin = place + 4 * _HEAD
        if begin + length > len(content):
            return frames, len(content) - place
        if kind == _VOLTAGES:
            frames.append(np.frombuffer(content, "<f4", CHANNELS, begin + 4 * _FIRST))
        place = begin + length
    return frames, len(content) - place
