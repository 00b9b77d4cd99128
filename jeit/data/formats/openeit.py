"""Reader of lines of an OpenEIT device: the word "magnitudes" and the numbers of a frame, as the firmware sends them
and the dashboard records them, with or without line ends.

The number of numbers states the protocol of the firmware: 32, 192 or 896 of 8, 16 or 32 electrodes, driven in opposite
pairs from every electrode; 928 of 32, driven in adjacent pairs; 28 of all pairs of 8, of the first device. Measurements
are adjacent, in the order of the electrodes. The numbers are magnitudes of impedances, ohms; zero where the device
reports an open circuit.
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
_WORD = re.compile(rb"\s{0,40}magnitudes\s{0,40}:", re.IGNORECASE)
_NUMBER = re.compile(rb"\d{1,30}(?:\.\d{0,30})?(?:[eE][-+]?\d{1,3})?")
# Bytes in which the first word stands, and from which a file is recognised.
_START, _HEAD = 4096, 2_000_000
_CURRENT = 1e-3
# Tables [protocol] of the firmware by their number of channels.
_PROTOCOLS: dict[int, dict[str, Any]] = {
    **{
        channels: {"kind": "opposite", "number": count, "drives": "all", "order": "fixed"}
        for channels, count in ((32, 8), (192, 16), (896, 32))
    },
    928: {"kind": "adjacent", "number": 32, "order": "fixed"},
    28: {"kind": "two_terminal", "number": 8},
}


def recognises(path: Path) -> bool:
    """True for a file that begins with the word "magnitudes", or has it after a few lines, and states the protocol by
    the number of its numbers."""
    with path.open("rb") as file:
        head = file.read(_START)
        first = _WORD.search(head)
        if first is None:
            return False
        head += file.read(_HEAD - len(head))
    return _usual([len(one) for one in frames_in(head)]) in _PROTOCOLS


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames. A `[protocol]` in the description takes precedence over that of the firmware, which completes
    what it does not state; without a description, the body is that of `like`, a measurement of the same sensor.

    Raises `ValueError` as `numbers`, and for a `key`, for there are no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    values, notes = numbers(path)
    if like is not None and description is None and find_description(path) is None:
        described = description_like(like)
    else:
        described = description_of(path, description)
    table = {**_PROTOCOLS[values.shape[1]], "current": _CURRENT}
    protocol = parse_description({"protocol": table}, path.name).protocol(path)
    assert protocol is not None
    for stated, said in described.protocols(path):
        if _alike(stated, protocol):
            protocol, described = stated, replace(described, protocol_section=None)
            notes = (*notes, f"[protocol] {said} is taken, as the firmware sends.") if said else notes
            break
    if described.protocol_section is None and described.layout.scale == 1:
        current = float(np.abs(np.asarray(protocol.drive)).max())
        values = current * values
        notes = (f"the numbers are taken for ohms, as of a calibrated device, times {1e3 * current:g} mA.", *notes)
    recording = Recording(values, protocol, notes=notes)
    return with_signs(measurement_of(path, recording, described), like)


def _alike(one: Protocol, other: Protocol) -> bool:
    """Whether two protocols have the same channels, apart from the current."""
    if one.num_electrodes != other.num_electrodes or one.num_measurements != other.num_measurements:
        return False
    drives = (np.sign(np.asarray(each.channel_drive)) for each in (one, other))
    reads = (np.asarray(each.channel_measurement) for each in (one, other))
    return all((first == second).all() for first, second in (drives, reads))


def numbers(path: Path) -> tuple[Float[np.ndarray, "F M"], tuple[str, ...]]:
    """The numbers of each frame, and notes. NaN where there is none: of a reading of zero, as of an open circuit, of a
    cell that is no number, of a last number that may be cut off, and of whole frames that are longer or shorter than
    most, for characters were lost.

    Raises `ValueError` if frames are of no protocol of the firmware, or of two.
    """
    content = content_of(path)
    frames = list(frames_in(content))
    lengths = [len(one) for one in frames]
    count = _usual(lengths)
    if not frames:
        raise ValueError(f"{path.name}: no frame begins with 'magnitudes:', as those of an OpenEIT device do.")
    if count not in _PROTOCOLS:
        known = listed([f"{channels} ({one['number']} electrodes)" for channels, one in _PROTOCOLS.items()])
        raise ValueError(
            f"{path.name}: most frames have {counted(count, 'number')}; the firmware sends {known}. Read it as a table."
        )
    if mixed := [one for one in _PROTOCOLS if one != count and lengths.count(one) > 1]:
        raise ValueError(
            f"{path.name}: {lengths.count(count)} frames have {count} numbers, and {lengths.count(mixed[0])} have "
            f"{mixed[0]}: give the recordings of different devices in a file each."
        )
    notes = []
    first = _WORD.search(content)
    before = content[: first.start()].strip(b"\xef\xbb\xbf \r\n\t") if first is not None else b""
    if before:
        notes.append(f"{counted(len(before), 'character')} before the first 'magnitudes:' are left out.")
    if len(frames) > 1 and lengths[-1] < count:
        notes.append(f"the last frame is cut off after {counted(lengths[-1], 'number')}, and left out.")
        del frames[-1], lengths[-1]
    elif content[-1:].isdigit() and lengths[-1] == count:
        frames[-1][-1] = np.nan
        notes.append("nothing follows the last number, which may be cut off: masked.")
    # Frames between which a word is lost are one, of as many numbers as they had: each keeps its place in time.
    places = np.cumsum([0, *(max(1, round(length / count)) for length in lengths)])
    whole = np.zeros(places[-1], bool)
    whole[[place for place, length in zip(places[:-1], lengths, strict=True) if length == count]] = True
    lost = [str(number) for number in np.flatnonzero(~whole)]
    values = np.full((len(whole), count), np.nan)
    values[whole] = [one for one in frames if len(one) == count]
    if lost:
        notes.append(f"characters are lost in frame{'s' * (len(lost) > 1)} {listed(lost)}: masked.")
    values = np.where(values == 0, np.nan, values)
    if gone := int(np.isnan(values[whole]).sum()):
        notes.append(f"{counted(gone, 'reading')} of zero, as of an open circuit, or illegible: masked.")
    return values, tuple(notes)


def frames_in(content: bytes) -> Iterator[array]:
    """Numbers of each frame: NaN for a cell that is none. Empty cells, and words after the last number, are left
    out."""
    words = [(one.start(), one.end()) for one in _WORD.finditer(content)]
    for (_, start), (stop, _) in itertools.pairwise([*words, (len(content), 0)]):
        cells = [cell.split() for cell in content[start:stop].split(b",")]
        cells = [cell for cell in cells if cell]
        while cells and not cells[-1][0][:1].isdigit():
            cells.pop()
        yield array("d", (_number(cell, last=cell is cells[-1]) for cell in cells))


def _usual(lengths: list[int]) -> int:
    """Length of most frames, of which the last may be cut off."""
    return Counter(lengths[:-1] or lengths).most_common(1)[0][0] if lengths else 0


def _number(parts: list[bytes], *, last: bool) -> float:
    """The number in a cell, NaN if there is none; words may follow the last of a frame."""
    alone = _NUMBER.fullmatch(parts[0]) and (last or len(parts) == 1)
    value = float(parts[0]) if alone else np.nan
    return value if np.isfinite(value) else np.nan


def protocol_table(path: Path) -> dict[str, Any]:
    """The table `[protocol]`, without the current, of a file that `recognises` accepts."""
    return _PROTOCOLS[numbers(path)[0].shape[1]]
