"""Reader of recorded output of Analog Devices' CN0565 kit, which sends text over a serial line.

A frame is a line that begins with "!V": integers of 32 bits in hexadecimal digits, separated by commas, alternately the
real and the imaginary part of a voltage. Drives begin at each electrode in turn; the current flows between this
electrode and the electrode that is the force distance away. For each drive, voltages are measured from each electrode
in turn to the electrode that is the sense distance away, without the pairs that contain a driven electrode. With 8, 16
or 32 electrodes and both distances 1, the default of the kit's programs, there are 40, 208 or 928 voltages. Other lines
are answers to commands and messages.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex

from jeit.arguments import counted, listed
from jeit.data.description import Description, parse_description
from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of
from jeit.data.formats.table import description_like, find_description
from jeit.data.measurement import Measurement
from jeit.data.unstated import with_signs
from jeit.protocol import Protocol

DESCRIPTION = "lines of Analog Devices' CN0565 kit ('!V' and hexadecimal numbers), of 8, 16 or 32 electrodes"
# A terminal program may write the time before a frame.
_FRAME_LINE = re.compile(rb"^[^!\r\n]{0,80}!V[ \t]{0,8}([0-9A-Fa-fxX, \t]*)(.*)$", re.MULTILINE)
_HEXADECIMAL = re.compile(rb"(?:0[xX])?([0-9A-Fa-f]{1,8})")
# Number of bytes read to recognise a file; minimum number of numbers in a frame.
_HEAD_BYTES, _MIN_NUMBERS = 65536, 8
_ELECTRODE_COUNTS = (8, 16, 32)
_ASSUMED_CURRENT = 1e-3
_SCALE_NOTES = (
    "the numbers are those of the converter: neither their unit nor the current is known (1 mA is assumed): trust "
    "relative changes, not volts.",
)
_DISTANCE_HINT = (
    'with force and sense distance F and S it is kind = "skip", skipped = F - 1, measurement_skipped = S - 1, '
    'order = "fixed"'
)


def recognises(path: Path) -> bool:
    """Whether a file contains a frame of a CN0565 kit near its start."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return any(len(words) >= _MIN_NUMBERS for words in _frames(head))


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames of a CN0565 recording. The section `[protocol]` of the description states the current, and
    distances other than 1; without a description, the body and the protocol are those of `like`, a measurement of the
    same sensor.

    Raises `ValueError` if `numbers` does, if no protocol is described and the number of voltages does not agree with
    distances of 1, and if a `key` is given, because the file contains no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    values, notes = numbers(path)
    borrows_description = like is not None and description is None and find_description(path) is None
    sensor_description = (
        description_like(like) if borrows_description and like is not None else description_of(path, description)
    )
    protocol, protocol_notes = _protocol(
        path, sensor_description, values.shape[1], like if borrows_description else None
    )
    sensor_description = replace(sensor_description, protocol_section=None)
    measurement = measurement_of(
        path, Recording(values, protocol, notes=(*_SCALE_NOTES, *protocol_notes, *notes)), sensor_description
    )
    return with_signs(measurement, like)


def _protocol(
    path: Path, sensor_description: Description, num_voltages: int, like: Measurement | None
) -> tuple[Protocol, tuple[str, ...]]:
    """The protocol of a recording with `num_voltages` voltages per frame, and notes on assumptions."""
    if like is not None and like.protocol.num_measurements == num_voltages:
        return like.protocol, ()
    candidates = [pair for pair in sensor_description.protocols(path) if pair[0].num_measurements == num_voltages]
    if candidates:
        # For every drive, the kit measures in the order of electrode numbers, unless the description states another
        # order.
        protocol, options = next(
            (candidate for candidate in candidates if 'order = "fixed"' in candidate[1]), candidates[0]
        )
        return protocol, (f"[protocol] {options} is taken, as the kit sends.",) if options else ()
    if sensor_description.protocol_section is not None:
        protocol = sensor_description.protocol(path)
        assert protocol is not None
        raise ValueError(
            f"{sensor_description.origin}: '{protocol.name}' has {protocol.num_measurements} channels, and a frame of "
            f"{path.name} {num_voltages}: {_DISTANCE_HINT}."
        )
    num_electrodes = next((count for count in _ELECTRODE_COUNTS if count * (count - 3) == num_voltages), None)
    if num_electrodes is None:
        usual_counts = listed([f"{count * (count - 3)} ({count} electrodes)" for count in _ELECTRODE_COUNTS])
        raise ValueError(
            f"{path.name}: {num_voltages} voltages in a frame; with force and sense distance 1 they are "
            f"{usual_counts}. Give a description with [protocol]: {_DISTANCE_HINT}."
        )
    table: dict[str, Any] = {
        "kind": "adjacent",
        "number": num_electrodes,
        "order": "fixed",
        "current": _ASSUMED_CURRENT,
    }
    protocol = parse_description({"protocol": table}, path.name).protocol(path)
    assert protocol is not None
    return protocol, ("force and sense distance are taken to be 1 (adjacent pairs); the file does not say them.",)


def numbers(path: Path) -> tuple[Complex[np.ndarray, "F M"], tuple[str, ...]]:
    """Read the voltages of each frame, in steps of the converter, and notes. Frames in which characters were lost, i.e.
    that are longer or shorter than most frames or have a cell that is not a number, are NaN.

    Raises `ValueError` if there is no frame, or if most frames have an odd number of numbers.
    """
    frames = list(_frames(content_of(path)))
    if not frames:
        raise ValueError(f"{path.name}: no line begins with '!V', as those of a CN0565 do.")
    lengths = [len(frame) for frame in frames]
    frame_length = Counter(lengths[:-1] or lengths).most_common(1)[0][0]
    if frame_length % 2 or not frame_length:
        raise ValueError(
            f"{path.name}: most lines have {counted(frame_length, 'number')}; give real and imaginary parts in turn, "
            "an even number. Are lines cut off?"
        )
    notes = []
    if len(frames) > 1 and lengths[-1] < frame_length:
        notes.append(f"the last frame is cut off after {counted(lengths[-1], 'number')}, and left out.")
        del frames[-1]
    values = np.full((len(frames), frame_length), np.nan)
    for frame_index, frame in enumerate(frames):
        if len(frame) == frame_length and None not in frame:
            values[frame_index] = frame
    damaged_frames = [str(frame_index) for frame_index in np.flatnonzero(np.isnan(values[:, 0]))]
    if damaged_frames:
        notes.append(f"characters are lost in frame{'s' * (len(damaged_frames) > 1)} {listed(damaged_frames)}: masked.")
    return values[:, 0::2] + 1j * values[:, 1::2], tuple(notes)


def _frames(content: bytes) -> Iterator[list[float | None]]:
    """Yield the numbers of each line that is a frame; None for a cell that is not a number, and for text after the
    numbers."""
    for line in _FRAME_LINE.finditer(content):
        cells = [cell.strip() for cell in line[1].split(b",")]
        while cells and not cells[-1]:
            cells.pop()
        values = [_number(cell) for cell in cells]
        yield [*values, None] if line[2].strip() else values
        for _ in range(line[2].count(b"!V")):  # a line end was lost; later frames keep their indices
            yield [None]


def _number(cell: bytes) -> float | None:
    """The signed 32-bit integer in a cell of hexadecimal digits; None if the cell is not a number."""
    match = _HEXADECIMAL.fullmatch(cell)
    if match is None:
        return None
    value = int(match[1], 16)
    return float(value - 2**32 if value >= 2**31 else value)
