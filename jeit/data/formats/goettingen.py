"""Reader of Göttingen's MCEIT recordings (.get), written by Goe-MF II, Viasys, Carefusion, and Dräger's systems before
2007.

A file consists of frames of 256 little-endian numbers of four bytes, without a header: 208 voltages of the adjacent
protocol, then 16 currents, 16 voltages of the drives and 16 auxiliary inputs. Dräger's systems write a text before the
frames, which ends with two empty lines. Some systems do not measure channels that are redundant by reciprocity, and
write zeros for them. A text file of the same name with the suffix .prl states the frame rate, as "Framerate = 13 per
second".
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

DESCRIPTION = "Göttingen MCEIT (.get): 208 adjacent voltages a frame"
# Bytes per frame; the beginning and the end of Dräger's text, and its maximum length in bytes.
_FRAME_BYTES, _HEADER_MARK, _HEADER_END, _MAX_TEXT_BYTES = 1024, b"---Draeger EIT-Software", b"\r\n\r\n\r\n", 65536
# Bytes that occur in text; minimum fraction of finite numbers in a frame, and maximum magnitude of these numbers.
_TEXT_BYTES, _MIN_FINITE_SHARE, _MAX_VALUE = frozenset(b"\t\r\n" + bytes(range(32, 127))), 0.9, 1e9
_SCALE_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_NO_RATE_NOTE = "the file says no rate, nor a record beside it (.prl); give it by [data] frame_rate."
_RATE = re.compile(rb"Framerate\s*=\s*(\d+(?:\.\d+)?)\s*per second", re.IGNORECASE)


def recognises(path: Path) -> bool:
    """Whether a file is a .get file that begins with Dräger's text, or whose first frame may be voltages: neither text
    nor numbers too large for any instrument."""
    if path.suffix.lower() != ".get":
        return False
    with path.open("rb") as file:
        head = file.read(_FRAME_BYTES)
    if head.startswith(_HEADER_MARK) or len(head) < _FRAME_BYTES:
        return True
    if all(byte in _TEXT_BYTES for byte in head):
        return False
    first_frame = np.frombuffer(head, "<f4")
    finite_values = first_frame[np.isfinite(first_frame)]
    return len(finite_values) > _MIN_FINITE_SHARE * len(first_frame) and bool(
        (np.abs(finite_values) < _MAX_VALUE).all()
    )


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames of a .get recording. Raises `ValueError` for a file without a complete frame or without any
    voltage."""
    content, frames_start = content_of(path), 0
    if content.startswith(_HEADER_MARK):
        header_end = content.find(_HEADER_END, 0, _MAX_TEXT_BYTES)
        if header_end < 0:
            raise ValueError(f"{path.name}: its text does not end with two empty lines before the frames; is it whole?")
        frames_start = header_end + len(_HEADER_END)
    num_frames, num_leftover_bytes = count_frames(content, frames_start, _FRAME_BYTES, path)
    values = np.frombuffer(content, "<f4", num_frames * _FRAME_BYTES // 4, frames_start).reshape(num_frames, -1)[
        :, :CHANNELS
    ]
    sensor_description, rate = description_of(path, description), _recorded_rate(path)
    rate_notes = (_NO_RATE_NOTE,) if rate is None and sensor_description.layout.frame_rate is None else ()
    times = None if rate is None else np.arange(num_frames) / rate
    return measurement_of(
        path,
        adjacent_recording(values, times, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))),
        sensor_description,
    )


def _recorded_rate(path: Path) -> float | None:
    """Frame rate in frames per second from the .prl file beside a recording; None if there is no such file, or no rate
    in it."""
    for suffix in (".prl", ".PRL"):
        record_path = path.with_suffix(suffix)
        if record_path.is_file():
            with record_path.open("rb") as file:
                match = _RATE.search(file.read(_MAX_TEXT_BYTES))
            if match and float(match[1]) > 0:
                return float(match[1])
    return None
