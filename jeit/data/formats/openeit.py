"""Reader of the text that OpenEIT devices send: the word "magnitudes" and the numbers of a frame, as OpenEIT's
dashboard records them, with or without line ends.

The number of numbers in a frame shows the protocol of the firmware: 32, 192 or 896 for 8, 16 or 32 electrodes driven in
opposite pairs, from every electrode; 928 for 32 electrodes driven in adjacent pairs; 28 for all pairs of 8 electrodes,
with the first device. Measurement pairs are adjacent, in the order of the electrodes. The numbers are magnitudes of
impedances in ohms, and zero for an open circuit.
"""

from __future__ import annotations

import itertools
import re
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted, listed
from jeit.data.description import parse_description
from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of
from jeit.data.formats.table import description_like, find_description
from jeit.data.measurement import Measurement
from jeit.data.unstated import with_signs
from jeit.protocol import Protocol

DESCRIPTION = "lines of an OpenEIT device ('magnitudes: …'), of 8, 16 or 32 electrodes"
_FRAME_WORD = re.compile(rb"\s{0,40}magnitudes\s{0,40}:", re.IGNORECASE)
_NUMBER = re.compile(rb"\d{1,30}(?:\.\d{0,30})?(?:[eE][-+]?\d{1,3})?")
# Number of bytes at the start that must contain the word "magnitudes", and number of bytes from which a file is
# recognised.
_WORD_SEARCH_BYTES, _HEAD_BYTES = 4096, 2_000_000
_ASSUMED_CURRENT = 1e-3
# Section [protocol] for each protocol of the firmware, by number of channels.
_PROTOCOL_TABLES: dict[int, dict[str, Any]] = {
    **{
        channels: {"kind": "opposite", "number": count, "drives": "all", "order": "fixed"}
        for channels, count in ((32, 8), (192, 16), (896, 32))
    },
    928: {"kind": "adjacent", "number": 32, "order": "fixed"},
    28: {"kind": "two_terminal", "number": 8},
}


def recognises(path: Path) -> bool:
    """Whether a file has the word "magnitudes" near its start, and frames whose length belongs to a protocol of the
    OpenEIT firmware."""
    with path.open("rb") as file:
        head = file.read(_WORD_SEARCH_BYTES)
        first_word = _FRAME_WORD.search(head)
        if first_word is None:
            return False
        head += file.read(_HEAD_BYTES - len(head))
    return _usual_length([len(frame) for frame in frames_in(head)]) in _PROTOCOL_TABLES


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames of an OpenEIT recording. The section `[protocol]` of the description takes precedence over the
    firmware's protocol, which only determines options that the section does not state; without a description, the body
    is that of `like`, a measurement of the same sensor.

    Raises `ValueError` if `numbers` does, and if a `key` is given, because the file contains no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    values, notes = numbers(path)
    if like is not None and description is None and find_description(path) is None:
        sensor_description = description_like(like)
    else:
        sensor_description = description_of(path, description)
    table = {**_PROTOCOL_TABLES[values.shape[1]], "current": _ASSUMED_CURRENT}
    protocol = parse_description({"protocol": table}, path.name).protocol(path)
    assert protocol is not None
    for candidate, options in sensor_description.protocols(path):
        if _have_same_channels(candidate, protocol):
            protocol, sensor_description = candidate, replace(sensor_description, protocol_section=None)
            notes = (*notes, f"[protocol] {options} is taken, as the firmware sends.") if options else notes
            break
    if sensor_description.protocol_section is None and sensor_description.layout.scale == 1:
        current = float(np.abs(np.asarray(protocol.drive)).max())
        values = current * values
        notes = (f"the numbers are taken for ohms, as of a calibrated device, times {1e3 * current:g} mA.", *notes)
    recording = Recording(values, protocol, notes=notes)
    return with_signs(measurement_of(path, recording, sensor_description), like)


def _have_same_channels(first: Protocol, second: Protocol) -> bool:
    """Whether two protocols have the same channels, apart from the current."""
    if first.num_electrodes != second.num_electrodes or first.num_measurements != second.num_measurements:
        return False
    drives = (np.sign(np.asarray(protocol.channel_drive)) for protocol in (first, second))
    measurements = (np.asarray(protocol.channel_measurement) for protocol in (first, second))
    return all((ours == theirs).all() for ours, theirs in (drives, measurements))


def numbers(path: Path) -> tuple[Float[np.ndarray, "F M"], tuple[str, ...]]:
    """Read the numbers of each frame of an OpenEIT recording, and notes. NaN replaces zero (an open circuit), a cell
    that is not a number, a last number that may be cut off, and all numbers of frames that are longer or shorter than
    most frames because characters were lost.

    Raises `ValueError` if the frames belong to no protocol of the firmware, or to two protocols.
    """
    content = content_of(path)
    frames = list(frames_in(content))
    lengths = [len(frame) for frame in frames]
    frame_length = _usual_length(lengths)
    if not frames:
        raise ValueError(f"{path.name}: no frame begins with 'magnitudes:', as those of an OpenEIT device do.")
    if frame_length not in _PROTOCOL_TABLES:
        known_counts = listed(
            [f"{channels} ({table['number']} electrodes)" for channels, table in _PROTOCOL_TABLES.items()]
        )
        raise ValueError(
            f"{path.name}: most frames have {counted(frame_length, 'number')}; the firmware sends {known_counts}. Read "
            "it as a table."
        )
    if other_counts := [number for number in _PROTOCOL_TABLES if number != frame_length and lengths.count(number) > 1]:
        raise ValueError(
            f"{path.name}: {lengths.count(frame_length)} frames have {frame_length} numbers, and "
            f"{lengths.count(other_counts[0])} have {other_counts[0]}: give the recordings of different devices in a "
            "file each."
        )
    notes = []
    first_word = _FRAME_WORD.search(content)
    prefix = content[: first_word.start()].strip(b"\xef\xbb\xbf \r\n\t") if first_word is not None else b""
    if prefix:
        notes.append(f"{counted(len(prefix), 'character')} before the first 'magnitudes:' are left out.")
    if len(frames) > 1 and lengths[-1] < frame_length:
        notes.append(f"the last frame is cut off after {counted(lengths[-1], 'number')}, and left out.")
        del frames[-1], lengths[-1]
    elif content[-1:].isdigit() and lengths[-1] == frame_length:
        frames[-1][-1] = np.nan
        notes.append("nothing follows the last number, which may be cut off: masked.")
    # Frames between which the word "magnitudes" is lost appear as one long frame; its length shows the number of lost
    # frames, so that later frames keep their indices.
    frame_indices = np.cumsum([0, *(max(1, round(length / frame_length)) for length in lengths)])
    is_complete = np.zeros(frame_indices[-1], bool)
    is_complete[
        [frame_index for frame_index, length in zip(frame_indices[:-1], lengths, strict=True) if length == frame_length]
    ] = True
    damaged_frames = [str(number) for number in np.flatnonzero(~is_complete)]
    values = np.full((len(is_complete), frame_length), np.nan)
    values[is_complete] = [frame for frame in frames if len(frame) == frame_length]
    if damaged_frames:
        notes.append(f"characters are lost in frame{'s' * (len(damaged_frames) > 1)} {listed(damaged_frames)}: masked.")
    values = np.where(values == 0, np.nan, values)
    if num_missing := int(np.isnan(values[is_complete]).sum()):
        notes.append(f"{counted(num_missing, 'reading')} of zero, as of an open circuit, or illegible: masked.")
    return values, tuple(notes)


def frames_in(content: bytes) -> Iterator[array]:
    """Yield the numbers of each frame; NaN for a cell that is not a number. Empty cells, and words after the last
    number of a frame, are left out."""
    word_spans = [(match.start(), match.end()) for match in _FRAME_WORD.finditer(content)]
    for (_, start), (stop, _) in itertools.pairwise([*word_spans, (len(content), 0)]):
        cells = [cell.split() for cell in content[start:stop].split(b",")]
        cells = [cell for cell in cells if cell]
        while cells and not cells[-1][0][:1].isdigit():
            cells.pop()
        yield array("d", (_cell_value(cell, is_last=cell is cells[-1]) for cell in cells))


def _usual_length(lengths: list[int]) -> int:
    """Most common length of all frames except the last frame, which may be cut off."""
    return Counter(lengths[:-1] or lengths).most_common(1)[0][0] if lengths else 0


def _cell_value(words: list[bytes], *, is_last: bool) -> float:
    """The number in a cell of `words`, NaN if the cell is not a number; words may follow the last number of a frame."""
    is_number = _NUMBER.fullmatch(words[0]) and (is_last or len(words) == 1)
    value = float(words[0]) if is_number else np.nan
    return value if np.isfinite(value) else np.nan


def protocol_table(path: Path) -> dict[str, Any]:
    """The section `[protocol]` of a description, without the current, for a file of OpenEIT."""
    return _PROTOCOL_TABLES[numbers(path)[0].shape[1]]
