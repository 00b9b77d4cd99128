"""Reader of text with a line for each measurement: the numbers of its four electrodes, and what was read.

Loggers write them as a table, of which the heading names the columns: electrodes `a, b, m, n` (current enters at a and
leaves at b, the voltage is that of m less that of n), or `f_plus, f_minus, s_plus, s_minus` and similar names; `real`
and `imag`, `u`, or `r` and `i`; `frame`, `time` if there are several. So does geoelectrics in its unified data format
(pyGIMLi, BERT, ResIPy; .ohm, .shm, .dat): the number of electrodes, a line with the coordinates of each, the number of
measurements, a comment with the names of the columns, and a line for each measurement, electrodes counted from 1. Units
follow a name: `u/mV`, `i [mA]`.

Channels are in the order of their electrodes, whatever that of the lines. Channels of a reference of the same sensor
are those of the frames, too: a line that is missing is masked.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Inexact, Int

from jeit.arguments import counted, listed
from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats.recording import Recording, content_of, measurement_of
from jeit.data.formats.table import description_like, find_description
from jeit.data.measurement import Measurement
from jeit.data.unstated import with_signs
from jeit.files import check_electrodes, read_toml
from jeit.protocol import from_channels

DESCRIPTION = "text with a line for each measurement: electrodes a, b, m, n and the voltage or resistance"
_HEAD, _MOST_HEADING = 65536, 400
# Names of the four electrodes, of which letters and digits count: current enters, leaves; voltage of the one less the
# other.
_ELECTRODES = (
    ("a", "b", "m", "n"),
    ("c1", "c2", "p1", "p2"),
    *(
        tuple(f"{who}{sign}" for who in pair for sign in ("plus", "minus"))
        for pair in (("f", "s"), ("i", "v"), ("drive", "sense"), ("drive", "measure"), ("force", "sense"))
    ),
)
# Names of what was read, and of other columns that matter.
_NAMES = {
    "real": ("real", "re", "realraw", "vreal", "ureal"),
    "imag": ("imag", "im", "imagraw", "vimag", "uimag"),
    "u": ("u", "v", "voltage", "volt", "volts"),
    "i": ("i", "current"),
    "r": ("r", "resistance", "impedance", "z"),
    "rhoa": ("rhoa",),
    "k": ("k",),
    "frame": ("frame", "frameid", "frameno", "framenumber", "scan", "cycle"),
    "time": ("t", "time", "seconds"),
}
_UNITS = {"v": 1.0, "mv": 1e-3, "uv": 1e-6, "µv": 1e-6, "a": 1.0, "ma": 1e-3, "ua": 1e-6, "µa": 1e-6,
          "ohm": 1.0, "ω": 1.0, "kohm": 1e3, "kω": 1e3, "ohmm": 1.0, "m": 1.0, "s": 1.0, "ms": 1e-3}  # fmt: skip
_UNIT = re.compile(r"^(.+?)\s*(?:/\s*([A-Za-zµΩ*]+)|[(\[]\s*([A-Za-zµΩ*]+)\s*[)\]])$")
_CURRENT = 1e-3


class _Lines(NamedTuple):
    """Content of a file: names of the columns, `scale` of each, the numbers in rows, coordinates of the electrodes, if
    it has them, whether it is of the unified data format, and notes."""

    names: list[str]
    scale: list[float]
    rows: Float[np.ndarray, "R C"]
    places: np.ndarray | None
    unified: bool
    notes: tuple[str, ...]

    def column(self, name: str) -> Float[np.ndarray, " R"] | None:
        """The column of a name in `_NAMES`, in SI units, or None."""
        index = next((k for k, one in enumerate(self.names) if one in _NAMES[name]), None)
        return None if index is None else self.scale[index] * self.rows[:, index]


def recognises(path: Path) -> bool:
    """True for text whose heading names four electrodes and a voltage or resistance."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4:
            return False
        text = head[: error.start].decode("utf-8-sig")
    return _heading(text.splitlines()[:-1] or text.splitlines()) is not None


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read all frames. A description, given or beside the file, states the body; its `[electrodes]` may leave out
    positions that the file has. `[protocol]` states the current, where the file does not.

    Raises `ValueError`, with the line, for lines that are not as the heading says, and for a `key`, for there are no
    arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    lines = _lines(path)
    if like is not None and description is None and find_description(path) is None:
        described = description_like(like)
    else:
        described = _described(path, description, lines.places)
    placed = None if described.electrodes is None else described.electrodes.num_electrodes
    electrodes, notes = _numbered(path, lines, placed)
    number = placed or max(int(electrodes.max()) + 1, 0 if lines.places is None else len(lines.places))
    check_electrodes(path.name, number)
    amplitude, assumed = _current(path, described, lines, like)
    values = _values(lines, amplitude)
    channels, frames, times, said = _arranged(path, lines, electrodes, values, like)
    drives, index = np.unique(channels[:, :2], axis=0, return_inverse=True)
    protocol = from_channels(
        amplitude * _pairs(drives, number),
        _pairs(channels[:, 2:], number),
        index.ravel(),
        name=f"{len(drives)} drives, {len(channels)} channels, {number} electrodes",
    )
    recording = Recording(frames, protocol, times=times, notes=(*lines.notes, *notes, *assumed, *said))
    return with_signs(measurement_of(path, recording, replace(described, protocol_section=None)), like)


def places(path: Path) -> Float[np.ndarray, "L d"] | None:
    """Positions of the electrodes (L, d), metres, that a file states; or None. Raises `ValueError` as `read`."""
    return _lines(path).places


def _heading(lines: Sequence[str]) -> tuple[int, list[str], list[float]] | None:
    """Index of the line that names the columns, names and scales of these; None if there is none."""
    for number, line in enumerate(lines[:_MOST_HEADING]):
        cells = _cells(re.sub(r"\s+([(\[])", r"\1", line.lstrip("#% \t")))
        if not 5 <= len(cells) <= 60:
            continue
        names, scales = zip(*map(_name, cells), strict=True)
        if _electrodes(names) is None:
            continue
        held = {name for name, known in _NAMES.items() if set(known) & set(names)}
        if held & {"real", "u", "r"} or {"rhoa", "k"} <= held:
            return number, list(names), list(scales)
    return None


def _cells(line: str) -> list[str]:
    """Cells of a line, separated by commas, semicolons or tabs, or else by spaces."""
    separator = next((one for one in ";\t," if one in line), None)
    return [cell.strip(' \t"') for cell in line.strip(" \r\n").split(separator)]


def _name(cell: str) -> tuple[str, float]:
    """The letters and digits of a column's name, and the value of its unit in SI units."""
    united = _UNIT.match(cell)
    unit = "" if united is None else (united[2] or united[3]).lower()
    text = (united[1] if united is not None and unit in _UNITS else cell).lower()
    text = re.sub(r"\+$", "plus", re.sub(r"-$", "minus", text))
    text = re.sub(r"[^0-9a-z]", "", text)
    return re.sub(r"(?<=plus|inus)(index|electrode|el)$", "", text), _UNITS.get(unit, 1.0)


def _electrodes(names: Sequence[str]) -> list[int] | None:
    """Indices of the columns with the four electrodes, or None."""
    return next(([names.index(one) for one in four] for four in _ELECTRODES if set(four) <= set(names)), None)


def _lines(path: Path) -> _Lines:
    """The numbers of a file. Raises `ValueError`, with the line, for a line that is not as the heading says."""
    try:
        text = content_of(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not text; is it damaged?") from None
    found = _heading(text)
    if found is None:
        raise ValueError(
            f"{path.name}: no line names the columns of four electrodes, such as a, b, m, n, and of a voltage u or a "
            "resistance r."
        )
    start, names, scale = found
    before = [(number, line.split("#")[0].split()) for number, line in enumerate(text[:start], 1)]
    before = [(number, cells) for number, cells in before if cells]
    unified = len(before) > 1 and before[-1][1][0].isdecimal() and before[0][1][0].isdecimal()
    places, stated = _places(path, before) if unified else (None, None)
    four = _electrodes(names)
    known = set().union(*_NAMES.values())
    used = [k for k, one in enumerate(names) if one in known or k in (four or ())]
    rows: list[list[float]] = []
    notes: tuple[str, ...] = ()
    for number, line in enumerate(text[start + 1 :], start + 2):
        if not (line.split("#")[0].strip() and (stated is None or len(rows) < stated)):
            continue
        cells = _cells(line.split("#")[0])
        try:
            numbers = np.full(len(names), np.nan)
            numbers[used] = [float(cells[k].replace(",", ".") or "nan") for k in used]
        except (ValueError, IndexError):
            if number == len(text) and rows:
                notes = (f"line {number}, the last, is cut off, and left out.",)
                break
            raise ValueError(
                f"{path.name}, line {number}: {line.strip()[:40]!r} is not {counted(len(names), 'column')} of numbers, "
                "as the heading says; where a value is missing write nan."
            ) from None
        rows.append(numbers.tolist())
    if not rows:
        raise ValueError(f"{path.name} holds no measurement.")
    if stated is not None and len(rows) < stated:
        notes = (*notes, f"it states {counted(stated, 'measurement')}, and holds {len(rows)}: is it cut off?")
    return _Lines(names, scale, np.array(rows), places, unified, notes)


def _places(path: Path, before: Sequence[tuple[int, list[str]]]) -> tuple[np.ndarray, int]:
    """Coordinates of the electrodes, and the number of measurements, that precede the names of the columns."""
    number, stated = int(before[0][1][0]), int(before[-1][1][0])
    try:
        places = np.array([[float(cell) for cell in cells] for _, cells in before[1:-1]])
        assert places.shape[0] == number
        assert places.shape[1] in (2, 3)
    except (ValueError, IndexError, AssertionError):
        raise ValueError(
            f"{path.name}: line {before[0][0]} states {counted(number, 'electrode')}; as many lines of two or three "
            "coordinates must follow it, and then the number of measurements."
        ) from None
    flat = np.ptp(places, axis=0) == 0
    return (places[:, ~flat] if places.shape[1] == 3 and flat.sum() == 1 else places), stated


def _described(path: Path, description: str | Path | None, places: np.ndarray | None) -> Description:
    """The description given, or that beside the file, or an empty one; with the places of electrodes in the file where
    it states none."""
    which = find_description(path) if description is None else description
    if which is None:
        return parse_description({}, path.name)
    if places is None or not Path(which).is_file():
        return load_description(which)
    tables: dict[str, Any] = read_toml(which)
    own = tables.get("electrodes")
    if isinstance(own, dict) and "positions" not in own:
        more = {"positions": places.tolist()} if "layout" not in own else {"number": len(places)}
        tables = {**tables, "electrodes": {**more, **own}}
    return parse_description(tables, Path(which).name, Path(which).parent)


def _numbered(path: Path, lines: _Lines, placed: int | None) -> tuple[Int[np.ndarray, "R 4"], tuple[str, ...]]:
    """Electrodes of each line, counted from 0, and notes. Raises `ValueError` for what is no electrode."""
    given = lines.rows[:, _electrodes(lines.names) or []]
    if not (np.isfinite(given).all() and (given == given.round()).all() and np.abs(given).max() < 1e6):
        raise ValueError(f"{path.name}: electrodes must be whole numbers.")
    electrodes, notes = given.astype(int), ()
    number = placed if lines.places is None else len(lines.places)
    if not lines.unified and electrodes.min() == 0:
        notes = ("electrodes are counted from 0.",)
    else:
        electrodes = electrodes - 1
    if electrodes.min() < 0:
        raise ValueError(
            f"{path.name}: {_at(electrodes.min(axis=1).argmin())} has electrode {given.min():g}, which stands for one "
            "far away, and a body has none. Leave such lines out."
        )
    if number is not None and electrodes.max() >= number:
        raise ValueError(
            f"{path.name}: {_at(electrodes.max(axis=1).argmax())} has electrode {given.max():g}, and there are "
            f"{number}."
        )
    alike = (electrodes[:, 0] == electrodes[:, 1]) | (electrodes[:, 2] == electrodes[:, 3])
    if alike.any():
        raise ValueError(
            f"{path.name}: {_at(alike.argmax())} has an electrode twice in a pair; a pair has two different ones."
        )
    return electrodes, notes


def _at(row: int | np.integer) -> str:
    return f"measurement {int(row) + 1}"


def _current(
    path: Path, described: Description, lines: _Lines, like: Measurement | None
) -> tuple[float, tuple[str, ...]]:
    """Amplitude of the current, amperes, and a note if it is assumed."""
    if like is not None:
        return float(np.abs(np.asarray(like.protocol.drive)).max()), ()
    protocol = described.protocol(path)
    if protocol is not None:
        return float(np.abs(np.asarray(protocol.drive)).max()), ()
    current = lines.column("i")
    known = np.zeros(0) if current is None else np.abs(current[np.isfinite(current) & (current != 0)])
    if known.size:
        return float(np.median(known)), ()
    voltages = lines.column("u") is not None or lines.column("real") is not None
    taken = "is assumed" if voltages else "multiplies the resistances"
    return _CURRENT, (f"the file states no current: {1e3 * _CURRENT:g} mA {taken}.",)


def _values(lines: _Lines, amplitude: float) -> Inexact[np.ndarray, " R"]:
    """Voltages of the lines at one amplitude of the current; NaN where a current is zero."""
    r, current, rhoa, k = (lines.column(one) for one in ("r", "i", "rhoa", "k"))
    real, imag = (lines.column(one) for one in ("real", "imag"))
    u = lines.column("u")
    u = real if u is None else u
    with np.errstate(divide="ignore", invalid="ignore"):
        if u is not None:
            whole = u if imag is None else u + 1j * imag
            return whole if current is None else np.where(current == 0, np.nan, amplitude * whole / current)
        if r is None:
            assert rhoa is not None
            assert k is not None
            r = np.where(k == 0, np.nan, rhoa / k)
        return amplitude * r


def _arranged(
    path: Path,
    lines: _Lines,
    electrodes: Int[np.ndarray, "R 4"],
    values: Inexact[np.ndarray, " R"],
    like: Measurement | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Electrodes (M, 4) of the channels, frames (F, M), their times, and notes. NaN where a frame has no line."""
    channels, channel = np.unique(electrodes, axis=0, return_inverse=True)
    channel, notes = channel.ravel(), ()
    frame, said = _frame_of_lines(path, lines.column("frame"), channel, len(channels))
    frames = np.full((frame.max() + 1, len(channels)), np.nan, values.dtype)
    if len(np.unique(frame * len(channels) + channel)) < len(frame):
        raise ValueError(
            f"{path.name}: a frame measures the same electrodes twice; number its frames, or average them."
        )
    frames[frame, channel] = values
    first = np.unique(frame, return_index=True)[1]
    times = lines.column("time")
    times = None if times is None or len(first) < 2 or not np.isfinite(times[first]).all() else times[first]
    if like is not None:
        drive, read = (np.asarray(one) for one in (like.protocol.channel_drive, like.protocol.channel_measurement))
        theirs = np.stack([one(each, axis=1) for each in (drive, read) for one in (np.argmax, np.argmin)], axis=1)
        place = {tuple(one): k for k, one in enumerate(channels.tolist())}
        index = np.array([place.get(tuple(one), -1) for one in theirs.tolist()])
        if 2 * (index >= 0).sum() > len(index):
            left = len(channels) - int((index >= 0).sum())
            notes = (f"{counted(left, 'channel')} that '{like.name}' lacks are left out.",) if left else ()
            channels, frames = theirs, np.where(index >= 0, frames[:, index], np.nan)
    return channels, frames, times, (*said, *notes)


def _frame_of_lines(
    path: Path, stated: np.ndarray | None, channel: Int[np.ndarray, " R"], count: int
) -> tuple[Int[np.ndarray, " R"], tuple[str, ...]]:
    """Number of the frame of each line, from 0, and notes. Raises `ValueError` if nothing separates frames."""
    if stated is not None and np.isfinite(stated).all():
        return np.unique(stated, return_inverse=True)[1].ravel(), ()
    rows = np.arange(len(channel))
    if (channel == channel[rows % count]).all():
        number = -(-len(channel) // count)
        return rows // count, (f"its lines repeat: {counted(number, 'frame')}.",) if number > 1 else ()
    twice = listed([str(one + 1) for one in rows[1:][np.isin(channel[1:], channel[:1])][:3]])
    raise ValueError(
        f"{path.name}: some electrodes are measured twice, and no column numbers frames; add one named frame"
        f"{twice and f' (those of line 1 also in measurement {twice})'}."
    )


def _pairs(pairs: Int[np.ndarray, "n 2"], number: int) -> Float[np.ndarray, "n L"]:
    """Patterns of +1 and -1 at two electrodes."""
    every = np.eye(number)
    return every[pairs[:, 0]] - every[pairs[:, 1]]
