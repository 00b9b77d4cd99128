"""Reader of text files with one line per measurement: the numbers of the four electrodes, and the measured values.

Loggers write a table whose heading names the columns: electrodes `a, b, m, n` (current enters at a and leaves at b; the
voltage is the potential at m minus that at n), or `f_plus, f_minus, s_plus, s_minus` and similar names; `real` and
`imag`, `u`, or `r` and `i`; `frame` and `time` if there are several frames. Geoelectric programs (pyGIMLi, BERT,
ResIPy) write the unified data format (.ohm, .shm, .dat): the number of electrodes, a line with the coordinates of each
electrode, the number of measurements, a comment with the names of the columns, and a line for each measurement, with
electrodes counted from 1. A unit follows the name of a column: `u/mV`, `i [mA]`.

Channels are sorted by their electrodes; the order of the lines has no effect. If a reference of the same sensor is
specified, frames have the channels of the reference; channels without a line are masked.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Inexact, Int

from jeit.arguments import counted, names_text
from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats.recording import Recording, create_measurement, read_file_bytes
from jeit.data.formats.table import description_like, find_description
from jeit.data.inferred_properties import correct_signs
from jeit.data.measurement import Measurement
from jeit.files import check_electrodes, read_toml
from jeit.protocol import from_channels

DESCRIPTION = "text with a line for each measurement: electrodes a, b, m, n and the voltage or resistance"
_HEAD_BYTES, _MAX_HEADING_LINES = 65536, 400
# Column names, reduced to letters and digits, of the four electrodes: current enters at the first and leaves at the
# second; the voltage is the potential of the third minus the potential of the fourth.
_ELECTRODE_NAMES = (
    ("a", "b", "m", "n"),
    ("c1", "c2", "p1", "p2"),
    *(
        tuple(f"{quantity}{sign}" for quantity in pair for sign in ("plus", "minus"))
        for pair in (("f", "s"), ("i", "v"), ("drive", "sense"), ("drive", "measure"), ("force", "sense"))
    ),
)
# Column names of the measured quantities, and of other columns that are read.
_COLUMN_NAMES = {
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
_UNIT_VALUES = {"v": 1.0, "mv": 1e-3, "uv": 1e-6, "µv": 1e-6, "a": 1.0, "ma": 1e-3, "ua": 1e-6, "µa": 1e-6,
          "ohm": 1.0, "ω": 1.0, "kohm": 1e3, "kω": 1e3, "ohmm": 1.0, "m": 1.0, "s": 1.0, "ms": 1e-3}  # fmt: skip
_UNIT_PATTERN = re.compile(r"^(.+?)\s*(?:/\s*([A-Za-zµΩ*]+)|[(\[]\s*([A-Za-zµΩ*]+)\s*[)\]])$")
_ASSUMED_CURRENT = 1e-3


class _QuadrupoleTable(NamedTuple):
    """Content of a file: `names` of the columns, and `scales`, their units in SI units; `rows` of numbers; `positions`
    of the electrodes, or None; `is_unified`, whether the file has the unified data format; and `notes`."""

    names: list[str]
    scales: list[float]
    rows: Float[np.ndarray, "R C"]
    positions: np.ndarray | None
    is_unified: bool
    notes: tuple[str, ...]

    def column(self, name: str) -> Float[np.ndarray, " R"] | None:
        """The values of the column `name`, a key of `_COLUMN_NAMES`, in SI units; None if there is no such column."""
        column_index = next((k for k, column_name in enumerate(self.names) if column_name in _COLUMN_NAMES[name]), None)
        return None if column_index is None else self.scales[column_index] * self.rows[:, column_index]


def recognises(path: Path) -> bool:
    """Whether a file is text whose heading names four electrodes and a voltage or resistance."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
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
    """Read all frames of a file of four-electrode measurements. A `description`, or a description beside the file,
    states the body; its section `[electrodes]` may leave out positions that the file contains. The section `[protocol]`
    states the current if the file does not.

    Raises `ValueError`, with the line, for lines that do not match the heading, and if a `key` is specified, because
    the file contains no arrays.
    """
    if key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    table = _read_table(path)
    if like is not None and description is None and find_description(path) is None:
        sensor_description = description_like(like)
    else:
        sensor_description = _describe_body(path, description, table.positions)
    num_described = None if sensor_description.electrodes is None else sensor_description.electrodes.num_electrodes
    electrodes, notes = _electrode_indices(path, table, num_described)
    num_electrodes = num_described or max(
        int(electrodes.max()) + 1, 0 if table.positions is None else len(table.positions)
    )
    check_electrodes(path.name, num_electrodes)
    amplitude, current_notes = _current_amplitude(path, sensor_description, table, like)
    values = _channel_voltages(table, amplitude)
    channels, frames, times, channel_notes = _arrange_frames(path, table, electrodes, values, like)
    drives, drive_index = np.unique(channels[:, :2], axis=0, return_inverse=True)
    protocol = from_channels(
        amplitude * _pair_patterns(drives, num_electrodes),
        _pair_patterns(channels[:, 2:], num_electrodes),
        drive_index.ravel(),
        name=f"{len(drives)} drives, {len(channels)} channels, {num_electrodes} electrodes",
    )
    recording = Recording(frames, protocol, times=times, notes=(*table.notes, *notes, *current_notes, *channel_notes))
    return correct_signs(create_measurement(path, recording, replace(sensor_description, protocol_section=None)), like)


def electrode_positions(path: Path) -> Float[np.ndarray, "L d"] | None:
    """Positions (electrodes, dimensions) of the electrodes in metres, from a file of four-electrode measurements; None
    if the file states none. Raises `ValueError` for lines that do not match the heading."""
    return _read_table(path).positions


def _heading(lines: Sequence[str]) -> tuple[int, list[str], list[float]] | None:
    """Index of the line that names the columns, names of the columns, and their units in SI units; None if there is no
    such line."""
    for line_index, line in enumerate(lines[:_MAX_HEADING_LINES]):
        cells = _split_cells(re.sub(r"\s+([(\[])", r"\1", line.lstrip("#% \t")))
        if not 5 <= len(cells) <= 60:
            continue
        names, scales = zip(*map(_parse_column_name, cells), strict=True)
        if _electrode_columns(names) is None:
            continue
        found_names = {name for name, known_spellings in _COLUMN_NAMES.items() if set(known_spellings) & set(names)}
        if found_names & {"real", "u", "r"} or {"rhoa", "k"} <= found_names:
            return line_index, list(names), list(scales)
    return None


def _split_cells(line: str) -> list[str]:
    """Cells of a line, separated by commas, semicolons or tabs, or else by spaces."""
    separator = next((character for character in ";\t," if character in line), None)
    return [cell.strip(' \t"') for cell in line.strip(" \r\n").split(separator)]


def _parse_column_name(cell: str) -> tuple[str, float]:
    """The letters and digits of a column's name, and the value of the column's unit in SI units."""
    unit_match = _UNIT_PATTERN.match(cell)
    unit = "" if unit_match is None else (unit_match[2] or unit_match[3]).lower()
    text = (unit_match[1] if unit_match is not None and unit in _UNIT_VALUES else cell).lower()
    text = re.sub(r"\+$", "plus", re.sub(r"-$", "minus", text))
    text = re.sub(r"[^0-9a-z]", "", text)
    return re.sub(r"(?<=plus|inus)(index|electrode|el)$", "", text), _UNIT_VALUES.get(unit, 1.0)


def _electrode_columns(names: Sequence[str]) -> list[int] | None:
    """Indices of the columns with the four electrodes of each measurement, or None."""
    return next(
        (
            [names.index(name) for name in electrode_names]
            for electrode_names in _ELECTRODE_NAMES
            if set(electrode_names) <= set(names)
        ),
        None,
    )


def _read_table(path: Path) -> _QuadrupoleTable:
    """Read the columns, electrode positions and notes of a file. Raises `ValueError`, with the line, for a line that
    does not match the heading."""
    try:
        text = read_file_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not text; is it damaged?") from None
    heading = _heading(text)
    if heading is None:
        raise ValueError(
            f"{path.name}: no line names the columns of four electrodes, such as a, b, m, n, and of a voltage u or a "
            "resistance r."
        )
    heading_index, names, scales = heading
    preceding_lines = [
        (line_number, line.split("#")[0].split()) for line_number, line in enumerate(text[:heading_index], 1)
    ]
    preceding_lines = [(line_number, cells) for line_number, cells in preceding_lines if cells]
    is_unified = (
        len(preceding_lines) > 1 and preceding_lines[-1][1][0].isdecimal() and preceding_lines[0][1][0].isdecimal()
    )
    positions, num_stated = _header_positions(path, preceding_lines) if is_unified else (None, None)
    electrode_columns = _electrode_columns(names)
    known_names = set().union(*_COLUMN_NAMES.values())
    used_columns = [k for k, name in enumerate(names) if name in known_names or k in (electrode_columns or ())]
    rows: list[list[float]] = []
    notes: tuple[str, ...] = ()
    for line_number, line in enumerate(text[heading_index + 1 :], heading_index + 2):
        if not (line.split("#")[0].strip() and (num_stated is None or len(rows) < num_stated)):
            continue
        cells = _split_cells(line.split("#")[0])
        try:
            row = np.full(len(names), np.nan)
            row[used_columns] = [float(cells[k].replace(",", ".") or "nan") for k in used_columns]
        except (ValueError, IndexError):
            if line_number == len(text) and rows:
                notes = (f"line {line_number}, the last, is cut off, and left out.",)
                break
            raise ValueError(
                f"{path.name}, line {line_number}: {line.strip()[:40]!r} is not {counted(len(names), 'column')} of "
                "numbers, as the heading says; where a value is missing write nan."
            ) from None
        rows.append(row.tolist())
    if not rows:
        raise ValueError(f"{path.name} holds no measurement.")
    if num_stated is not None and len(rows) < num_stated:
        notes = (*notes, f"it states {counted(num_stated, 'measurement')}, and holds {len(rows)}: is it cut off?")
    return _QuadrupoleTable(names, scales, np.array(rows), positions, is_unified, notes)


def _header_positions(path: Path, preceding_lines: Sequence[tuple[int, list[str]]]) -> tuple[np.ndarray, int]:
    """Coordinates of the electrodes, and number of measurements, from the lines above the names of the columns."""
    num_electrodes, num_stated = int(preceding_lines[0][1][0]), int(preceding_lines[-1][1][0])
    try:
        positions = np.array([[float(cell) for cell in cells] for _, cells in preceding_lines[1:-1]])
        assert positions.shape[0] == num_electrodes
        assert positions.shape[1] in (2, 3)
    except (ValueError, IndexError, AssertionError):
        raise ValueError(
            f"{path.name}: line {preceding_lines[0][0]} states {counted(num_electrodes, 'electrode')}; as many lines "
            "of two or three coordinates must follow it, and then the number of measurements."
        ) from None
    is_constant = np.ptp(positions, axis=0) == 0
    return (positions[:, ~is_constant] if positions.shape[1] == 3 and is_constant.sum() == 1 else positions), num_stated


def _describe_body(path: Path, description: str | Path | None, positions: np.ndarray | None) -> Description:
    """Return the `description`, else the description beside the file, else an empty description. If the description
    states no positions of electrodes, the `positions` from the file are added."""
    description_source = find_description(path) if description is None else description
    if description_source is None:
        return parse_description({}, path.name)
    if positions is None or not Path(description_source).is_file():
        return load_description(description_source)
    tables: dict[str, Any] = read_toml(description_source)
    electrode_section = tables.get("electrodes")
    if isinstance(electrode_section, dict) and "positions" not in electrode_section:
        added_keys = (
            {"positions": positions.tolist()} if "layout" not in electrode_section else {"number": len(positions)}
        )
        tables = {**tables, "electrodes": {**added_keys, **electrode_section}}
    return parse_description(tables, Path(description_source).name, Path(description_source).parent)


def _electrode_indices(
    path: Path, table: _QuadrupoleTable, num_described: int | None
) -> tuple[Int[np.ndarray, "R 4"], tuple[str, ...]]:
    """Return the four electrodes of each line, counted from 0, and notes. Raises `ValueError` for invalid electrode
    numbers."""
    numbers = table.rows[:, _electrode_columns(table.names) or []]
    if not (np.isfinite(numbers).all() and (numbers == numbers.round()).all() and np.abs(numbers).max() < 1e6):
        raise ValueError(f"{path.name}: electrodes must be whole numbers.")
    electrodes, notes = numbers.astype(int), ()
    num_electrodes = num_described if table.positions is None else len(table.positions)
    if not table.is_unified and electrodes.min() == 0:
        notes = ("electrodes are counted from 0.",)
    else:
        electrodes = electrodes - 1
    if electrodes.min() < 0:
        raise ValueError(
            f"{path.name}: {_measurement_name(electrodes.min(axis=1).argmin())} has electrode {numbers.min():g}, which "
            "stands for one far away, and a body has none. Leave such lines out."
        )
    if num_electrodes is not None and electrodes.max() >= num_electrodes:
        raise ValueError(
            f"{path.name}: {_measurement_name(electrodes.max(axis=1).argmax())} has electrode {numbers.max():g}, and "
            f"there are {num_electrodes}."
        )
    has_repeated_electrode = (electrodes[:, 0] == electrodes[:, 1]) | (electrodes[:, 2] == electrodes[:, 3])
    if has_repeated_electrode.any():
        raise ValueError(
            f"{path.name}: {_measurement_name(has_repeated_electrode.argmax())} has an electrode twice in a pair; a "
            "pair has two different ones."
        )
    return electrodes, notes


def _measurement_name(row: int | np.integer) -> str:
    return f"measurement {int(row) + 1}"


def _current_amplitude(
    path: Path, sensor_description: Description, table: _QuadrupoleTable, like: Measurement | None
) -> tuple[float, tuple[str, ...]]:
    """Amplitude of the drive current in amperes, and a note if the amplitude is assumed."""
    if like is not None:
        return float(np.abs(np.asarray(like.protocol.drive)).max()), ()
    protocol = sensor_description.protocol(path)
    if protocol is not None:
        return float(np.abs(np.asarray(protocol.drive)).max()), ()
    current = table.column("i")
    known_currents = np.zeros(0) if current is None else np.abs(current[np.isfinite(current) & (current != 0)])
    if known_currents.size:
        return float(np.median(known_currents)), ()
    has_voltages = table.column("u") is not None or table.column("real") is not None
    assumption_text = "is assumed" if has_voltages else "multiplies the resistances"
    return _ASSUMED_CURRENT, (f"the file states no current: {1e3 * _ASSUMED_CURRENT:g} mA {assumption_text}.",)


def _channel_voltages(table: _QuadrupoleTable, amplitude: float) -> Inexact[np.ndarray, " R"]:
    """Voltage of each line of the table, scaled to the current `amplitude`; NaN for a line whose current is zero."""
    resistances, currents, apparent_resistivities, geometric_factors = (
        table.column(name) for name in ("r", "i", "rhoa", "k")
    )
    real, imag = (table.column(name) for name in ("real", "imag"))
    voltages = table.column("u")
    voltages = real if voltages is None else voltages
    with np.errstate(divide="ignore", invalid="ignore"):
        if voltages is not None:
            complex_voltages = voltages if imag is None else voltages + 1j * imag
            return (
                complex_voltages
                if currents is None
                else np.where(currents == 0, np.nan, amplitude * complex_voltages / currents)
            )
        if resistances is None:
            assert apparent_resistivities is not None
            assert geometric_factors is not None
            resistances = np.where(geometric_factors == 0, np.nan, apparent_resistivities / geometric_factors)
        return amplitude * resistances


def _arrange_frames(
    path: Path,
    table: _QuadrupoleTable,
    electrodes: Int[np.ndarray, "R 4"],
    values: Inexact[np.ndarray, " R"],
    like: Measurement | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Group the values of a file's lines into frames. Returns the electrodes (channels, 4), voltages (frames,
    channels), times of the frames, and notes. Voltages are NaN for channels that have no line in a frame."""
    channels, channel_of_line = np.unique(electrodes, axis=0, return_inverse=True)
    channel_of_line, notes = channel_of_line.ravel(), ()
    frame_of_line, frame_notes = _frame_of_lines(path, table.column("frame"), channel_of_line, len(channels))
    frames = np.full((frame_of_line.max() + 1, len(channels)), np.nan, values.dtype)
    if len(np.unique(frame_of_line * len(channels) + channel_of_line)) < len(frame_of_line):
        raise ValueError(
            f"{path.name}: a frame measures the same electrodes twice; number its frames, or average them."
        )
    frames[frame_of_line, channel_of_line] = values
    first_lines = np.unique(frame_of_line, return_index=True)[1]
    times = table.column("time")
    times = (
        None
        if times is None or len(first_lines) < 2 or not np.isfinite(times[first_lines]).all()
        else times[first_lines]
    )
    if like is not None:
        drives, measurements = (
            np.asarray(patterns) for patterns in (like.protocol.channel_drive, like.protocol.channel_measurement)
        )
        electrodes_of_channels = np.stack(
            [find(patterns, axis=1) for patterns in (drives, measurements) for find in (np.argmax, np.argmin)], axis=1
        )
        channel_numbers = {tuple(channel): k for k, channel in enumerate(channels.tolist())}
        channel_indices = np.array(
            [channel_numbers.get(tuple(channel), -1) for channel in electrodes_of_channels.tolist()]
        )
        if 2 * (channel_indices >= 0).sum() > len(channel_indices):
            num_excluded = len(channels) - int((channel_indices >= 0).sum())
            notes = (
                (f"{counted(num_excluded, 'channel')} that '{like.name}' lacks are left out.",) if num_excluded else ()
            )
            channels, frames = (
                electrodes_of_channels,
                np.where(channel_indices >= 0, frames[:, channel_indices], np.nan),
            )
    return channels, frames, times, (*frame_notes, *notes)


def _frame_of_lines(
    path: Path, stated_frames: np.ndarray | None, channel_of_line: Int[np.ndarray, " R"], num_channels: int
) -> tuple[Int[np.ndarray, " R"], tuple[str, ...]]:
    """Return the index of the frame to which each line belongs, and notes. Raises `ValueError` if frames cannot be
    separated."""
    if stated_frames is not None and np.isfinite(stated_frames).all():
        return np.unique(stated_frames, return_inverse=True)[1].ravel(), ()
    rows = np.arange(len(channel_of_line))
    if (channel_of_line == channel_of_line[rows % num_channels]).all():
        num_frames = -(-len(channel_of_line) // num_channels)
        return rows // num_channels, (f"its lines repeat: {counted(num_frames, 'frame')}.",) if num_frames > 1 else ()
    repeated_measurements = names_text(
        [str(row + 1) for row in rows[1:][np.isin(channel_of_line[1:], channel_of_line[:1])][:3]]
    )
    raise ValueError(
        f"{path.name}: some electrodes are measured twice, and no column numbers frames; add one named frame"
        f"{repeated_measurements and f' (those of line 1 also in measurement {repeated_measurements})'}."
    )


def _pair_patterns(pairs: Int[np.ndarray, "n 2"], num_electrodes: int) -> Float[np.ndarray, "n L"]:
    """Patterns (pairs, electrodes) with +1 and -1 at the two electrodes of each pair."""
    identity = np.eye(num_electrodes)
    return identity[pairs[:, 0]] - identity[pairs[:, 1]]
