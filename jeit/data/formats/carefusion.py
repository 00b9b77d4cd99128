"""Reader of Carefusion's Goe-MF II recordings (.eit): XML in UTF-16, then segments.

`<Header>N bytes</Header>` says where segments begin. Each has six integers of four bytes (little-endian): its type, a
channel, the number of its frame from 0, the bytes of an item, how many items, and one that is not known; then the
items. Type 3 holds a frame of 256 numbers of four bytes, of which those from the 48th on are the 208 adjacent voltages;
type 7 an image of 912; others are waves.
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
# Integers before the items of a segment; types, and how many numbers of four bytes those of fixed length have.
_HEAD, _VOLTAGES, _IMAGE = 6, 3, 7
_NUMBERS = {_VOLTAGES: 256, _IMAGE: 912}
_FIRST = 47
_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_NO_RATE = "the file says no rate that is known; give it by [data] frame_rate."


def recognises(path: Path) -> bool:
    """True for an .eit file that begins as this XML does."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        return _MARK in _text(file.read(_LOOKED_AT))


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames. Raises `ValueError` for a header that does not say its length, and for no whole frame."""
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
    """The voltages of every frame, and how many bytes of a last segment are there without its end."""
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
