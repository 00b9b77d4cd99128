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
_NUM_HEAD_BYTES, _MAX_HEADING_LINES = 65536, 400
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
    """Content of a file: `column_names`, and `column_units` in SI units; `table_rows` of numbers;
    `electrode_positions`, or None; `is_unified`, whether the file has the unified data format; and `table_notes`."""

    column_names: list[str]
    column_units: list[float]
    table_rows: Float[np.ndarray, "R C"]
    electrode_positions: np.ndarray | None
    is_unified: bool
    table_notes: tuple[str, ...]

    def column(self, name: str) -> Float[np.ndarray, " R"] | None:
        """The values of the column `name`, a key of `_COLUMN_NAMES`, in SI units; None if there is no such column."""
        column_index = next((k for k, heading in enumerate(self.column_names) if heading in _COLUMN_NAMES[name]), None)
        return None if column_index is None else self.column_units[column_index] * self.table_rows[:, column_index]


def recognises(path: Path) -> bool:
    """Whether a file is text whose heading names four electrodes and a voltage or resistance."""
    with path.open("rb") as file:
        head_bytes = file.read(_NUM_HEAD_BYTES)
    try:
        text = head_bytes.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(head_bytes) - 4:
            return False
        text = head_bytes[: error.start].decode("utf-8-sig")
    return _find_heading(text.splitlines()[:-1] or text.splitlines()) is not None


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
        sensor_description = _describe_body(path, description, table.electrode_positions)
    num_described = None if sensor_description.electrodes is None else sensor_description.electrodes.num_electrodes
    electrodes, notes = _electrode_indices(path, table, num_described)
    num_electrodes = num_described or max(
        int(electrodes.max()) + 1, 0 if table.electrode_positions is None else len(table.electrode_positions)
    )
    check_electrodes(path.name, num_electrodes)
    current_amplitude, current_notes = _current_amplitude(path, sensor_description, table, like)
    line_voltages = _channel_voltages(table, current_amplitude)
    quadrupoles, frames, frame_times, channel_notes = _arrange_frames(path, table, electrodes, line_voltages, like)
    drive_pairs, drive_index = np.unique(quadrupoles[:, :2], axis=0, return_inverse=True)
    protocol = from_channels(
        current_amplitude * _pair_patterns(drive_pairs, num_electrodes),
        _pair_patterns(quadrupoles[:, 2:], num_electrodes),
        drive_index.ravel(),
        name=f"{len(drive_pairs)} drives, {len(quadrupoles)} channels, {num_electrodes} electrodes",
    )
    recording = Recording(
        frames, protocol, times=frame_times, notes=(*table.table_notes, *notes, *current_notes, *channel_notes)
    )
    return correct_signs(create_measurement(path, recording, replace(sensor_description, protocol_section=None)), like)


def electrode_positions(path: Path) -> Float[np.ndarray, "L d"] | None:
    """Positions (electrodes, dimensions) of the electrodes in metres, from a file of four-electrode measurements; None
    if the file states none. Raises `ValueError` for lines that do not match the heading."""
    return _read_table(path).electrode_positions


def _find_heading(lines: Sequence[str]) -> tuple[int, list[str], list[float]] | None:
    """Index of the line that names the columns, names of the columns, and their units in SI units; None if there is no
    such line."""
    for line_index, line in enumerate(lines[:_MAX_HEADING_LINES]):
        cells = _split_cells(re.sub(r"\s+([(\[])", r"\1", line.lstrip("#% \t")))
        if not 5 <= len(cells) <= 60:
            continue
        names, units = zip(*map(_parse_column_name, cells), strict=True)
        if _electrode_columns(names) is None:
            continue
        found_names = {name for name, known_spellings in _COLUMN_NAMES.items() if set(known_spellings) & set(names)}
        if found_names & {"real", "u", "r"} or {"rhoa", "k"} <= found_names:
            return line_index, list(names), list(units)
    return None


def _split_cells(line: str) -> list[str]:
    """Cells of a line, separated by commas, semicolons or tabs, or else by spaces."""
    cell_separator = next((line_character for line_character in ";\t," if line_character in line), None)
    return [cell_text.strip(' \t"') for cell_text in line.strip(" \r\n").split(cell_separator)]


def _parse_column_name(cell_text: str) -> tuple[str, float]:
    """The letters and digits of a column's name, and the value of the column's unit in SI units."""
    unit_match = _UNIT_PATTERN.match(cell_text)
    unit_text = "" if unit_match is None else (unit_match[2] or unit_match[3]).lower()
    text = (unit_match[1] if unit_match is not None and unit_text in _UNIT_VALUES else cell_text).lower()
    text = re.sub(r"\+$", "plus", re.sub(r"-$", "minus", text))
    text = re.sub(r"[^0-9a-z]", "", text)
    return re.sub(r"(?<=plus|inus)(index|electrode|el)$", "", text), _UNIT_VALUES.get(unit_text, 1.0)


def _electrode_columns(column_names: Sequence[str]) -> list[int] | None:
    """Indices of the columns with the four electrodes of each measurement, or None."""
    return next(
        (
            [column_names.index(name) for name in electrode_names]
            for electrode_names in _ELECTRODE_NAMES
            if set(electrode_names) <= set(column_names)
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
    column_heading = _find_heading(text)
    if column_heading is None:
        raise ValueError(
            f"{path.name}: no line names the columns of four electrodes, such as a, b, m, n, and of a voltage u or a "
            "resistance r."
        )
    heading_index, column_names, column_units = column_heading
    preceding_lines = [
        (line_number, line.split("#")[0].split()) for line_number, line in enumerate(text[:heading_index], 1)
    ]
    preceding_lines = [(line_number, cells) for line_number, cells in preceding_lines if cells]
    is_unified = (
        len(preceding_lines) > 1 and preceding_lines[-1][1][0].isdecimal() and preceding_lines[0][1][0].isdecimal()
    )
    positions, num_stated = _header_positions(path, preceding_lines) if is_unified else (None, None)
    electrode_columns = _electrode_columns(column_names)
    known_names = set().union(*_COLUMN_NAMES.values())
    used_columns = [k for k, name in enumerate(column_names) if name in known_names or k in (electrode_columns or ())]
    table_rows: list[list[float]] = []
    notes: tuple[str, ...] = ()
    for line_number, line in enumerate(text[heading_index + 1 :], heading_index + 2):
        if not (line.split("#")[0].strip() and (num_stated is None or len(table_rows) < num_stated)):
            continue
        cells = _split_cells(line.split("#")[0])
        try:
            table_row = np.full(len(column_names), np.nan)
            table_row[used_columns] = [float(cells[k].replace(",", ".") or "nan") for k in used_columns]
        except (ValueError, IndexError):
            if line_number == len(text) and table_rows:
                notes = (f"line {line_number}, the last, is cut off, and left out.",)
                break
            raise ValueError(
                f"{path.name}, line {line_number}: {line.strip()[:40]!r} is not {counted(len(column_names), 'column')} "
                "of numbers, as the heading says; where a value is missing write nan."
            ) from None
        table_rows.append(table_row.tolist())
    if not table_rows:
        raise ValueError(f"{path.name} holds no measurement.")
    if num_stated is not None and len(table_rows) < num_stated:
        notes = (*notes, f"it states {counted(num_stated, 'measurement')}, and holds {len(table_rows)}: is it cut off?")
    return _QuadrupoleTable(column_names, column_units, np.array(table_rows), positions, is_unified, notes)


def _header_positions(path: Path, preceding_lines: Sequence[tuple[int, list[str]]]) -> tuple[np.ndarray, int]:
    """Coordinates of the electrodes, and number of measurements, from the lines above the names of the columns."""
    num_electrodes, num_stated = int(preceding_lines[0][1][0]), int(preceding_lines[-1][1][0])
    try:
        positions = np.array([[float(cell_text) for cell_text in cells] for _, cells in preceding_lines[1:-1]])
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
    description_sections: dict[str, Any] = read_toml(description_source)
    electrode_section = description_sections.get("electrodes")
    if isinstance(electrode_section, dict) and "positions" not in electrode_section:
        added_keys = (
            {"positions": positions.tolist()} if "layout" not in electrode_section else {"number": len(positions)}
        )
        description_sections = {**description_sections, "electrodes": {**added_keys, **electrode_section}}
    return parse_description(description_sections, Path(description_source).name, Path(description_source).parent)


def _electrode_indices(
    path: Path, table: _QuadrupoleTable, num_described: int | None
) -> tuple[Int[np.ndarray, "R 4"], tuple[str, ...]]:
    """Return the four electrodes of each line, counted from 0, and notes. Raises `ValueError` for invalid electrode
    numbers."""
    numbers = table.table_rows[:, _electrode_columns(table.column_names) or []]
    if not (np.isfinite(numbers).all() and (numbers == numbers.round()).all() and np.abs(numbers).max() < 1e6):
        raise ValueError(f"{path.name}: electrodes must be whole numbers.")
    electrodes, notes = numbers.astype(int), ()
    num_electrodes = num_described if table.electrode_positions is None else len(table.electrode_positions)
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


def _measurement_name(electrode_row: int | np.integer) -> str:
    return f"measurement {int(electrode_row) + 1}"


def _current_amplitude(
    path: Path, sensor_description: Description, table: _QuadrupoleTable, template: Measurement | None
) -> tuple[float, tuple[str, ...]]:
    """Amplitude of the drive current in amperes, and a note if the amplitude is assumed."""
    if template is not None:
        return float(np.abs(np.asarray(template.protocol.drive)).max()), ()
    protocol = sensor_description.protocol(path)
    if protocol is not None:
        return float(np.abs(np.asarray(protocol.drive)).max()), ()
    currents = table.column("i")
    known_currents = np.zeros(0) if currents is None else np.abs(currents[np.isfinite(currents) & (currents != 0)])
    if known_currents.size:
        return float(np.median(known_currents)), ()
    has_voltages = table.column("u") is not None or table.column("real") is not None
    assumption_text = "is assumed" if has_voltages else "multiplies the resistances"
    return _ASSUMED_CURRENT, (f"the file states no current: {1e3 * _ASSUMED_CURRENT:g} mA {assumption_text}.",)


def _channel_voltages(table: _QuadrupoleTable, current_amplitude: float) -> Inexact[np.ndarray, " R"]:
    """Voltage of each line of the table, scaled to the current `current_amplitude`; NaN for a line whose current is
    zero."""
    line_resistances, currents, apparent_resistivities, geometric_factors = (
        table.column(name) for name in ("r", "i", "rhoa", "k")
    )
    real_part, imaginary_part = (table.column(name) for name in ("real", "imag"))
    voltages = table.column("u")
    voltages = real_part if voltages is None else voltages
    with np.errstate(divide="ignore", invalid="ignore"):
        if voltages is not None:
            complex_voltages = voltages if imaginary_part is None else voltages + 1j * imaginary_part
            return (
                complex_voltages
                if currents is None
                else np.where(currents == 0, np.nan, current_amplitude * complex_voltages / currents)
            )
        if line_resistances is None:
            assert apparent_resistivities is not None
            assert geometric_factors is not None
            line_resistances = np.where(geometric_factors == 0, np.nan, apparent_resistivities / geometric_factors)
        return current_amplitude * line_resistances


def _arrange_frames(
    path: Path,
    table: _QuadrupoleTable,
    electrodes: Int[np.ndarray, "R 4"],
    line_voltages: Inexact[np.ndarray, " R"],
    template: Measurement | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Group the values of a file's lines into frames. Returns the electrodes (channels, 4), voltages (frames,
    channels), times of the frames, and notes. Voltages are NaN for channels that have no line in a frame."""
    quadrupoles, channel_of_line = np.unique(electrodes, axis=0, return_inverse=True)
    channel_of_line, notes = channel_of_line.ravel(), ()
    frame_of_line, frame_notes = _frame_of_lines(path, table.column("frame"), channel_of_line, len(quadrupoles))
    frames = np.full((frame_of_line.max() + 1, len(quadrupoles)), np.nan, line_voltages.dtype)
    if len(np.unique(frame_of_line * len(quadrupoles) + channel_of_line)) < len(frame_of_line):
        raise ValueError(
            f"{path.name}: a frame measures the same electrodes twice; number its frames, or average them."
        )
    frames[frame_of_line, channel_of_line] = line_voltages
    first_lines = np.unique(frame_of_line, return_index=True)[1]
    line_times = table.column("time")
    line_times = (
        None
        if line_times is None or len(first_lines) < 2 or not np.isfinite(line_times[first_lines]).all()
        else line_times[first_lines]
    )
    if template is not None:
        drive_patterns, measurement_patterns = (
            np.asarray(patterns)
            for patterns in (template.protocol.channel_drive, template.protocol.channel_measurement)
        )
        electrodes_of_channels = np.stack(
            [
                find_extreme(patterns, axis=1)
                for patterns in (drive_patterns, measurement_patterns)
                for find_extreme in (np.argmax, np.argmin)
            ],
            axis=1,
        )
        channel_numbers = {tuple(quadrupole): k for k, quadrupole in enumerate(quadrupoles.tolist())}
        channel_indices = np.array(
            [channel_numbers.get(tuple(quadrupole), -1) for quadrupole in electrodes_of_channels.tolist()]
        )
        if 2 * (channel_indices >= 0).sum() > len(channel_indices):
            num_excluded = len(quadrupoles) - int((channel_indices >= 0).sum())
            notes = (
                (f"{counted(num_excluded, 'channel')} that '{template.name}' lacks are left out.",)
                if num_excluded
                else ()
            )
            quadrupoles, frames = (
                electrodes_of_channels,
                np.where(channel_indices >= 0, frames[:, channel_indices], np.nan),
            )
    return quadrupoles, frames, line_times, (*frame_notes, *notes)


def _frame_of_lines(
    path: Path, stated_frames: np.ndarray | None, channel_of_line: Int[np.ndarray, " R"], num_channels: int
) -> tuple[Int[np.ndarray, " R"], tuple[str, ...]]:
    """Return the index of the frame to which each line belongs, and notes. Raises `ValueError` if frames cannot be
    separated."""
    if stated_frames is not None and np.isfinite(stated_frames).all():
        return np.unique(stated_frames, return_inverse=True)[1].ravel(), ()
    line_indices = np.arange(len(channel_of_line))
    if (channel_of_line == channel_of_line[line_indices % num_channels]).all():
        num_frames = -(-len(channel_of_line) // num_channels)
        return line_indices // num_channels, (
            f"its lines repeat: {counted(num_frames, 'frame')}.",
        ) if num_frames > 1 else ()
    repeated_measurements = names_text(
        [str(line_index + 1) for line_index in line_indices[1:][np.isin(channel_of_line[1:], channel_of_line[:1])][:3]]
    )
    raise ValueError(
        f"{path.name}: some electrodes are measured twice, and no column numbers frames; add one named frame"
        f"{repeated_measurements and f' (those of line 1 also in measurement {repeated_measurements})'}."
    )


def _pair_patterns(electrode_pairs: Int[np.ndarray, "n 2"], num_electrodes: int) -> Float[np.ndarray, "n L"]:
    """Patterns (pairs, electrodes) with +1 and -1 at the two electrodes of each pair."""
    identity_matrix = np.eye(num_electrodes)
    return identity_matrix[electrode_pairs[:, 0]] - identity_matrix[electrode_pairs[:, 1]]
