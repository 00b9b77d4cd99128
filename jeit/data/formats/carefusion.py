"""Reader of recordings by Carefusion's Goe-MF II (.eit): XML in UTF-16, followed by binary segments.

`<Header>N bytes</Header>` gives the offset of the first segment. A segment begins with six little-endian integers of
four bytes: the type of the segment, a channel, the frame number counted from 0, the bytes per item, the number of
items, and an integer of unknown meaning; the items follow. Type 3 is a frame of 256 numbers of four bytes; the 208
numbers from the 48th on are the voltages of the adjacent protocol. Type 7 is an image of 912 numbers. Other types are
waveforms.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jeit.data.formats.recording import (
    CHANNELS,
    adjacent_recording,
    content_of,
    description_of,
    measurement_of,
    truncation_notes,
)
from jeit.data.measurement import Measurement

DESCRIPTION = "Carefusion Goe-MF II (.eit): 208 adjacent voltages a frame"
_BYTE_ORDER_MARK, _ROOT_TAG, _HEAD_BYTES = b"\xff\xfe", "<EIT_File>", 512
# Number of integers before the items of a segment; the two segment types of fixed length, and their lengths in numbers
# of four bytes.
_NUM_HEADER_INTEGERS, _VOLTAGE_SEGMENT, _IMAGE_SEGMENT = 6, 3, 7
_SEGMENT_LENGTHS = {_VOLTAGE_SEGMENT: 256, _IMAGE_SEGMENT: 912}
_FIRST_VOLTAGE = 47
_SCALE_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_NO_RATE_NOTE = "the file says no rate that is known; give it by [data] frame_rate."


def recognises(path: Path) -> bool:
    """Whether a file is an .eit file that begins with the XML header of Carefusion's format."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        return _ROOT_TAG in _decode_head(file.read(_HEAD_BYTES))


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames of a Carefusion recording. Raises `ValueError` if the header does not state its length, and if
    there is no complete frame."""
    content = content_of(path)
    match = re.search(r"<Header>\s{0,9}([0-9]{1,9}) bytes</Header>", _decode_head(content[:_HEAD_BYTES]))
    if match is None or not _HEAD_BYTES // 8 < int(match[1]) < len(content):
        raise ValueError(f"{path.name}: its header does not say where the frames begin; is it damaged?")
    frames, num_leftover_bytes = _frames(content, int(match[1]))
    if not frames:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    sensor_description = description_of(path, description)
    rate_notes = (_NO_RATE_NOTE,) if sensor_description.layout.frame_rate is None else ()
    recording = adjacent_recording(
        np.stack(frames), None, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))
    )
    return measurement_of(path, recording, sensor_description)


def _decode_head(content: bytes) -> str:
    return (
        content[len(_BYTE_ORDER_MARK) :].decode("utf-16-le", "ignore") if content.startswith(_BYTE_ORDER_MARK) else ""
    )


def _frames(content: bytes, start: int) -> tuple[list[np.ndarray], int]:
    """Voltages of every complete frame after byte `start`, and number of remaining bytes of a truncated last
    segment."""
    frames, offset = [], start
    while offset + 4 * _NUM_HEADER_INTEGERS <= len(content):
        kind, _, _, item_size, num_items, _ = (
            int(value) for value in np.frombuffer(content, "<i4", _NUM_HEADER_INTEGERS, offset)
        )
        length = 4 * _SEGMENT_LENGTHS[kind] if kind in _SEGMENT_LENGTHS else max(item_size, 0) * max(num_items, 0)
        content_start = offset + 4 * _NUM_HEADER_INTEGERS
        if content_start + length > len(content):
            return frames, len(content) - offset
        if kind == _VOLTAGE_SEGMENT:
            frames.append(np.frombuffer(content, "<f4", CHANNELS, content_start + 4 * _FIRST_VOLTAGE))
        offset = content_start + length
    return frames, len(content) - offset
