"""Reader of Sciospec EIT recordings (.eit): text files, one per frame.

The first line states the number of header lines. The following lines give, one value per line: the version of the
format (in headers of at least 11 lines), the name of the setup, date and time, the lowest and the highest frequency
(hertz), their spacing (1: logarithmic, 0: linear), the number of frequencies, the current (amperes), and the frame
rate. Later lines may list channels, as "MeasurementChannels: 1,2,3". After the header, every injection has a line with
its two electrodes, and one line per frequency with the real and imaginary part of the potential at every channel. The
file does not state whether currents are peak or root mean square values.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from jeit.arguments import describe
from jeit.data.description import Description
from jeit.data.formats.recording import Recording, content_of, description_of, measurement_of
from jeit.data.gesture_set import join
from jeit.data.measurement import Measurement
from jeit.files import check_electrodes
from jeit.protocol import from_matrices, measurement_patterns

DESCRIPTION = "Sciospec EIT (.eit, text): potentials of all channels, for every injection and frequency"
_FEWEST, _MOST = 9, 64
_LISTS = ("MeasurementChannelsIndependentFromInjectionPattern:", "MeasurementChannels:")
_NOTES = ("the current in the file is taken as it stands; whether it is peak or root mean square it does not say.",)


@dataclass(frozen=True)
class _Header:
    lines: int
    date: str
    frequencies: np.ndarray
    current: float
    channels: dict[str, list[int]]


def recognises(path: Path) -> bool:
    """True for an .eit text file that begins with the number of its header lines."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        first = file.read(24).removeprefix(b"\xef\xbb\xbf").split(b"\n")[0].strip()
    return first.isdigit() and _FEWEST <= int(first) <= _MOST


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read one file: one frame per frequency, named by the frequency, of potentials minus their mean.

    With `[protocol] kind = "measured"` in a description, its `measurement` selects another reading of the potentials,
    such as "adjacent" differences. Channels that the header does not list are left out.

    Raises `ValueError` with the line at fault.
    """
    try:
        lines = content_of(path).decode("utf-8-sig", "strict").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not text, as Sciospec's files are; is it damaged?") from None
    header = _header(lines, path)
    pairs, potentials = _injections(lines, header, path)
    numbers, columns = _channels(header, potentials.shape[2], path)
    check_electrodes(path.name, len(numbers))
    described = description_of(path, description)
    recording = _recording(header, pairs, potentials[:, :, columns], numbers, described, path)
    return measurement_of(path, recording, described)


def read_all(paths: Sequence[Path], description: str | Path | None = None) -> Measurement:
    """Read several files of the same set-up and join their frames in the given order.

    If each file holds one frame, `[data] frame_rate` of a description sets the times; otherwise the dates in the files
    do. Raises as `read` and `jeit.data.gesture_set.join`.
    """
    joined = join([read(path, description) for path in paths])
    rate = description_of(paths[0], description).layout.frame_rate
    return joined if rate is None or joined.num_frames != len(paths) else joined.at_rate(rate)


def _header(lines: list[str], path: Path) -> _Header:
    count = int(_number(lines, 0, path, whole=True))
    if not _FEWEST <= count <= _MOST or count >= len(lines):
        raise ValueError(f"{path.name}, line 1: a header of {count} lines, and the file has {len(lines)}.")
    at = 1 if count < 11 else 2  # line of the name of the setup
    low, high = (_number(lines, at + one, path) for one in (2, 3))
    number = int(_number(lines, at + 5, path, whole=True))
    if not (0 < low <= high and 1 <= number <= len(lines)):
        raise ValueError(f"{path.name}, line {at + 3}: {number} frequencies from {low:g} to {high:g} Hz are none.")
    spaced = np.geomspace if _number(lines, at + 4, path) == 1 else np.linspace
    channels = {name: _list(line, name) for line in lines[:count] for name in _LISTS if line.startswith(name)}
    return _Header(count, lines[at + 1], spaced(low, high, number), _number(lines, at + 6, path), channels)


def _number(lines: list[str], at: int, path: Path, *, whole: bool = False) -> float:
    text = lines[at].strip() if at < len(lines) else ""
    with suppress(ValueError):
        value = float(text)
        if np.isfinite(value) and (not whole or (value == int(value) and abs(value) < 1e9)):
            return value
    raise ValueError(
        f"{path.name}, line {at + 1}: must be a {'whole ' if whole else ''}number; it is {describe(text)}."
    )


def _list(line: str, name: str) -> list[int]:
    """Channel numbers, counted from 1."""
    parts = line.removeprefix(name).replace(",", " ").split()
    return [int(one) for one in parts if one.isdecimal() and len(one) < 6]


def _injections(lines: list[str], header: _Header, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Electrode pairs (S, 2), counted from 1, and complex potentials (S, frequencies, columns) as stored in the
    file."""
    pairs, rows, frequencies = [], [], len(header.frequencies)
    for at, line in _nonempty_lines(lines, header.lines):
        values = _values(line, at, path)
        if len(rows) == frequencies * len(pairs):
            if len(values) != 2 or (values != values.round()).any() or not (values > 0).all() or values.max() > 1e5:
                raise ValueError(f"{path.name}, line {at + 1}: must be the two electrodes of an injection.")
            if values[0] == values[1]:
                raise ValueError(
                    f"{path.name}, line {at + 1}: current enters and leaves at electrode {values[0]:g}; an injection "
                    "has two different electrodes."
                )
            pairs.append(values.astype(int))
            continue
        if len(values) < 4 or len(values) % 2 or (rows and len(values) != 2 * len(rows[0])):
            raise ValueError(
                f"{path.name}, line {at + 1}: has {len(values)} numbers; give a real and an imaginary part for each "
                "channel, as many as before. Is the file cut off?"
            )
        rows.append(values[0::2] + 1j * values[1::2])
    if not pairs or len(rows) != frequencies * len(pairs):
        raise ValueError(f"{path.name}: {len(pairs)} injections have {len(rows)} lines of potentials; is it cut off?")
    return np.array(pairs), np.array(rows).reshape(len(pairs), frequencies, -1)


def _nonempty_lines(lines: list[str], start: int) -> Iterator[tuple[int, str]]:
    return ((at, lines[at]) for at in range(start, len(lines)) if lines[at].strip())


def _values(line: str, at: int, path: Path) -> np.ndarray:
    try:
        return np.array([float(one) for one in line.split()])
    except ValueError:
        raise ValueError(f"{path.name}, line {at + 1}: {describe(line.strip())} is not numbers.") from None


def _channels(header: _Header, columns: int, path: Path) -> tuple[list[int], list[int]]:
    """Numbers of the electrodes, and indices of the columns that hold their potentials."""
    wide, measured = (header.channels.get(name, []) for name in _LISTS)
    held = next((one for one in (measured, wide) if len(one) == columns), list(range(1, columns + 1)))
    numbers = measured if set(measured) <= set(held) and len(measured) > 1 else held
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"{path.name}: its header lists a channel twice.")
    return numbers, [held.index(one) for one in numbers]


def _recording(
    header: _Header, pairs: np.ndarray, potentials: np.ndarray, numbers: list[int], described: Description, path: Path
) -> Recording:
    missing = sorted({*pairs.ravel().tolist()} - {*numbers})
    if missing:
        raise ValueError(f"{path.name}: current flows at electrode {missing[0]}, which is not among those measured.")
    index = np.array([[numbers.index(one) for one in pair] for pair in pairs.tolist()])
    if not 0 < header.current <= 1:
        raise ValueError(f"{path.name}: its current is {header.current:g} A; it must be positive, and at most 1.")
    drive, every = np.zeros((len(index), len(numbers))), np.arange(len(index))
    drive[every, index[:, 0]], drive[every, index[:, 1]] = header.current, -header.current
    # The sign of the power, which the body dissipates, shows at which electrode of a pair the current enters.
    notes: list[str] = [*_NOTES]
    if np.median(np.einsum("sl,sfl->sf", drive, np.nan_to_num(np.real(potentials)))) < 0:
        drive = -drive
        notes.append("current is taken to enter at the second electrode of a pair, whose potential is the higher.")
    reading, reference = described.reading
    rows = measurement_patterns(len(numbers), reading, reference)
    with np.errstate(invalid="ignore", over="ignore"):
        voltages = np.einsum("kl,sfl->fsk", rows, potentials).reshape(len(header.frequencies), -1)
    name = f"{len(index)} injections, {reading}, {len(numbers)} electrodes"
    single = len(header.frequencies) == 1
    return Recording(
        voltages,
        from_matrices(drive, rows, name=name),
        times=_times(header.date) if single else None,
        frame_names=() if single else tuple(f"{one:.6g} Hz" for one in header.frequencies),
        notes=tuple(notes),
    )


def _times(date: str) -> np.ndarray | None:
    """Time of the measurement in seconds since 1970, taking the date as UTC; None if the date has another form."""
    for form in ("%Y.%m.%d. %H:%M:%S.%f", "%Y.%m.%d. %H:%M:%S"):
        with suppress(ValueError):
            return np.array([datetime.strptime(date.strip(), form).replace(tzinfo=UTC).timestamp()])
    return None
