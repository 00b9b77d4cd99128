"""Reader of Swisstom BB2 and Pioneer recordings (.eit, format 4): 32 electrodes, four left out between those of a pair.

Little-endian: bytes 0-3 the format, 4-7 where frames begin. Each begins with its time in milliseconds (eight bytes),
its kind and its length (four each); kind 0 then holds 15 integers of four bytes, of which the fifth is a time in
microseconds, 12 bytes, 64 integers of the electrodes' impedances, and 2,048: real and imaginary parts of 32 × 32
voltages, drive by drive. Other kinds are events. Formats 1 to 3 differ, and are not known well enough.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jeit.data.formats.recording import Recording, content_of, cut_off, description_of, measurement_of
from jeit.data.measurement import Measurement
from jeit.protocol import skip

DESCRIPTION = "Swisstom BB2, Pioneer (.eit, format 4): 32 electrodes, skip 4, complex"
_ELECTRODES, _SKIPPED, _FORMAT = 32, 4, 4
# Bytes before a frame's content, and in it before the voltages; numbers of these; where the time is.
_HEAD, _BEFORE, _NUMBERS, _TIME = 16, 60 + 12 + 256, 2 * _ELECTRODES**2, 16
# Range of a counter of microseconds of four bytes.
_ROUND = 2**32
# Volts for the number 1, by those who have read these files: a guess.
_SCALE = 2.048 / (2**20 * 360 * 1000)
_NOTES = (
    "neither the scale of the voltages nor the current is published (5 mA is assumed): trust relative changes alone.",
    "the electrodes are taken to be read in the sense that makes voltages positive.",
    "voltages of driven electrodes are left out: they were not measured with care.",
)


def recognises(path: Path) -> bool:
    """True for an .eit file that begins with the number of its format."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        begin = file.read(4)
    return begin in (bytes([_FORMAT, 0, 0, 0]), *(bytes([0, 0, 0, number]) for number in (1, 2, 3, _FORMAT)))


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames. Raises `ValueError` for other formats, for no whole frame, and for a damaged one."""
    content = content_of(path)
    if content[:4] != bytes([_FORMAT, 0, 0, 0]):
        raise ValueError(f"{path.name} is of a Swisstom format that is not known; format 4 is. Export it as a table.")
    start = int.from_bytes(content[4:8], "little", signed=True)
    if not 8 <= start <= len(content):
        raise ValueError(f"{path.name}: its header says that frames begin at byte {start}, beyond its end.")
    values, times, left = _frames(content, start, path)
    if not values:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    pairs = np.stack(values).astype(float) * _SCALE
    protocol = skip(_ELECTRODES, _SKIPPED, current=5e-3, driven_electrodes=True, order="fixed")
    recording = Recording(
        -(pairs[:, 0::2] + 1j * pairs[:, 1::2]),
        protocol,
        ~protocol.channels_on_driven_electrodes(),
        np.unwrap(times, period=_ROUND) * 1e-6,
        notes=(*_NOTES, *cut_off(left)),
    )
    return measurement_of(path, recording, description_of(path, description))


def _frames(content: bytes, start: int, path: Path) -> tuple[list[np.ndarray], np.ndarray, int]:
    """The numbers and the times (microseconds) of every frame, and how many bytes a last one has without its end."""
    values, times, place = [], [], start
    while place + _HEAD <= len(content):
        kind, length = (int(one) for one in np.frombuffer(content, "<i4", 2, place + 8))
        begin = place + _HEAD
        if length < 0 or (kind == 0 and length < _BEFORE + 4 * _NUMBERS):
            raise ValueError(f"{path.name}: the frame at byte {place} says a length of {length}; it is damaged.")
        if begin + length > len(content):
            break
        if kind == 0:
            values.append(np.frombuffer(content, "<i4", _NUMBERS, begin + _BEFORE))
            times.append(int.from_bytes(content[begin + _TIME : begin + _TIME + 4], "little"))
        place = begin + length
    return values, np.array(times, float), len(content) - place
