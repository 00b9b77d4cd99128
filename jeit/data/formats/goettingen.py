"""Reader of Göttingen's MCEIT recordings (.get), written by Goe-MF II, Viasys, Carefusion, and Dräger's systems before
2007.

A file consists of frames of 256 little-endian numbers of four bytes, without a header: 208 adjacent voltages, then 16
currents, 16 voltages of the drives and 16 auxiliary inputs. Dräger's systems write a text before the frames, which ends
with two empty lines. Systems that do not measure channels which reciprocity makes redundant write zeros there. The
frame rate is stated in the record of the measurement, a text file of the same name with the suffix .prl, as "Framerate
= 13 per second".
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

DESCRIPTION = "Göttingen MCEIT (.get): 208 adjacent voltages a frame"
# Bytes per frame; the beginning and the end of Dräger's text, and its maximum length in bytes.
_FRAME, _MARK, _END, _LONGEST = 1024, b"---Draeger EIT-Software", b"\r\n\r\n\r\n", 65536
# Bytes of text; share of numbers that are finite, and the largest of a frame.
_READABLE, _MOST, _LARGEST = frozenset(b"\t\r\n" + bytes(range(32, 127))), 0.9, 1e9
_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_NO_RATE = "the file says no rate, nor a record beside it (.prl); give it by [data] frame_rate."
_RATE = re.compile(rb"Framerate\s*=\s*(\d+(?:\.\d+)?)\s*per second", re.IGNORECASE)


def recognises(path: Path) -> bool:
    """True for a .get file that begins with Dräger's text, or whose first frame may be voltages: neither text nor
    numbers beyond any instrument."""
    if path.suffix.lower() != ".get":
        return False
    with path.open("rb") as file:
        head = file.read(_FRAME)
    if head.startswith(_MARK) or len(head) < _FRAME:
        return True
    if all(byte in _READABLE for byte in head):
        return False
    first = np.frombuffer(head, "<f4")
    known = first[np.isfinite(first)]
    return len(known) > _MOST * len(first) and bool((np.abs(known) < _LARGEST).all())


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames. Raises `ValueError` for a file without a complete frame or without any voltage."""
    content, start = content_of(path), 0
    if content.startswith(_MARK):
        end = content.find(_END, 0, _LONGEST)
        if end < 0:
            raise ValueError(f"{path.name}: its text does not end with two empty lines before the frames; is it whole?")
        start = end + len(_END)
    number, left = frame_at(content, start, _FRAME, path)
    values = np.frombuffer(content, "<f4", number * _FRAME // 4, start).reshape(number, -1)[:, :CHANNELS]
    described, rate = description_of(path, description), _recorded_rate(path)
    no_rate = (_NO_RATE,) if rate is None and described.layout.frame_rate is None else ()
    times = None if rate is None else np.arange(number) / rate
    return measurement_of(path, adjacent_recording(values, times, (_NOTE, *no_rate, *cut_off(left))), described)


def _recorded_rate(path: Path) -> float | None:
    """Frame rate in frames per second from the record beside a file; None if there is no record, or no rate in it."""
    for ending in (".prl", ".PRL"):
        record = path.with_suffix(ending)
        if record.is_file():
            with record.open("rb") as file:
                said = _RATE.search(file.read(_LONGEST))
            if said and float(said[1]) > 0:
                return float(said[1])
    return None
