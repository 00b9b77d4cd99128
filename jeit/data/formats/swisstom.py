"""Reader of Swisstom BB2 and Pioneer recordings (.eit, format 4) with 32 electrodes, and pairs that skip four
electrodes.

All numbers are little-endian. Bytes 0-3 are the number of the format, bytes 4-7 the offset of the first frame. A frame
begins with its time in milliseconds (eight bytes), its kind and its length (four bytes each). Frames of kind 0 are
measurements: they continue with 15 integers of four bytes, of which the fifth is a time in microseconds, 12 further
bytes, 64 integers with impedances of the electrodes, and 2,048 integers with real and imaginary parts of 32 × 32
voltages, drive by drive. Frames of other kinds are events. Formats 1 to 3 are not supported, because too little is
known about them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of, truncation_notes
from jeit.data.measurement import Measurement
from jeit.protocol import skip

DESCRIPTION = "Swisstom BB2, Pioneer (.eit, format 4): 32 electrodes, skip 4, complex"
_ELECTRODES, _SKIPPED, _FORMAT = 32, 4, 4
# Number of bytes before the content of a frame, and in the content before the voltages; number of integers of the
# voltages; offset of the time in the content.
_HEADER_BYTES, _VOLTAGE_OFFSET, _NUM_INTEGERS, _TIME_OFFSET = 16, 60 + 12 + 256, 2 * _ELECTRODES**2, 16
# Range of the four-byte counter of microseconds, after which it restarts at 0.
_COUNTER_PERIOD = 2**32
# Volts per unit of the stored numbers: an estimate by users of these files.
_SCALE = 2.048 / (2**20 * 360 * 1000)
_SCALE_NOTES = (
    "neither the scale of the voltages nor the current is published (5 mA is assumed): trust relative changes alone.",
    "electrode pairs are assumed to have the polarity that makes voltages positive.",
    "voltages of driven electrodes are left out: they were not measured with care.",
)


def recognises(path: Path) -> bool:
    """Whether a file is an .eit file that begins with the number of a Swisstom format."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        first_bytes = file.read(4)
    return first_bytes in (bytes([_FORMAT, 0, 0, 0]), *(bytes([0, 0, 0, number]) for number in (1, 2, 3, _FORMAT)))


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read all frames of a Swisstom recording. Raises `ValueError` for formats other than 4, for a file without a
    complete frame, and for damaged frames."""
    content = content_of(path)
    if content[:4] != bytes([_FORMAT, 0, 0, 0]):
        raise ValueError(f"{path.name} is of a Swisstom format that is not known; format 4 is. Export it as a table.")
    frames_start = int.from_bytes(content[4:8], "little", signed=True)
    if not 8 <= frames_start <= len(content):
        raise ValueError(f"{path.name}: its header says that frames begin at byte {frames_start}, beyond its end.")
    values, times, num_leftover_bytes = _frames(content, frames_start, path)
    if not values:
        raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
    pairs = np.stack(values).astype(float) * _SCALE
    protocol = skip(_ELECTRODES, _SKIPPED, current=5e-3, driven_electrodes=True, order="fixed")
    recording = Recording(
        -(pairs[:, 0::2] + 1j * pairs[:, 1::2]),
        protocol,
        ~protocol.channels_on_driven_electrodes(),
        np.unwrap(times, period=_COUNTER_PERIOD) * 1e-6,
        notes=(*_SCALE_NOTES, *truncation_notes(num_leftover_bytes)),
    )
    return measurement_of(path, recording, description_of(path, description))


def _frames(content: bytes, frames_start: int, path: Path) -> tuple[list[np.ndarray], np.ndarray, int]:
    """Stored numbers and times (microseconds) of every complete frame, and number of remaining bytes of a truncated
    last frame."""
    values, times, offset = [], [], frames_start
    while offset + _HEADER_BYTES <= len(content):
        kind, length = (int(number) for number in np.frombuffer(content, "<i4", 2, offset + 8))
        content_start = offset + _HEADER_BYTES
        if length < 0 or (kind == 0 and length < _VOLTAGE_OFFSET + 4 * _NUM_INTEGERS):
            raise ValueError(f"{path.name}: the frame at byte {offset} says a length of {length}; it is damaged.")
        if content_start + length > len(content):
            break
        if kind == 0:
            values.append(np.frombuffer(content, "<i4", _NUM_INTEGERS, content_start + _VOLTAGE_OFFSET))
            times.append(
                int.from_bytes(content[content_start + _TIME_OFFSET : content_start + _TIME_OFFSET + 4], "little")
            )
        offset = content_start + length
    return values, np.array(times, float), len(content) - offset
