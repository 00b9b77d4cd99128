"""Reader of Sciospec EIT recordings (.eit): text files, one per frame.

The first line states the number of header lines. The following lines contain, one value per line: the version of the
format (in headers of at least 11 lines), the name of the setup, date and time, the lowest and the highest frequency
(hertz), the spacing of frequencies (1: logarithmic, 0: linear), the number of frequencies, the current (amperes), and
the frame rate. Later lines may list channels, as "MeasurementChannels: 1,2,3". After the header, every injection has a
line with the two driven electrodes, and one line per frequency with the real and imaginary parts of the potentials at
all channels. The file does not state whether currents are peak or root mean square values.
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
from jeit.data.formats.recording import Recording, create_measurement, find_or_load_description, read_file_bytes
from jeit.data.gesture_set import join
from jeit.data.measurement import Measurement
from jeit.files import check_electrodes
from jeit.protocol import from_matrices, measurement_patterns

DESCRIPTION = "Sciospec EIT (.eit, text): potentials of all channels, for every injection and frequency"
_MIN_HEADER_LINES, _MAX_HEADER_LINES = 9, 64
_CHANNEL_LISTS = ("MeasurementChannelsIndependentFromInjectionPattern:", "MeasurementChannels:")
_CURRENT_NOTES = (
    "the current in the file is taken as it stands; whether it is peak or root mean square it does not say.",
)


@dataclass(frozen=True)
class _FileHeader:
    num_lines: int
    date_text: str
    frequencies: np.ndarray
    drive_current: float
    channel_lists: dict[str, list[int]]


def recognises(path: Path) -> bool:
    """Whether a file is an .eit text file that begins with the number of its header lines."""
    if path.suffix.lower() != ".eit":
        return False
    with path.open("rb") as file:
        first_line = file.read(24).removeprefix(b"\xef\xbb\xbf").split(b"\n")[0].strip()
    return first_line.isdigit() and _MIN_HEADER_LINES <= int(first_line) <= _MAX_HEADER_LINES


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read one Sciospec file: one frame per frequency, named by the frequency, of potentials minus their mean over the
    electrodes.

    With `[protocol] kind = "measured"` in a description, its `measurement` selects a different way of reading the
    potentials, such as "adjacent" differences. Channels that the header does not list are left out.

    Raises `ValueError`, with the faulty line, for an invalid file.
    """
    try:
        file_lines = read_file_bytes(path).decode("utf-8-sig", "strict").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not text, as Sciospec's files are; is it damaged?") from None
    file_header = _parse_header(file_lines, path)
    drive_pairs, electrode_potentials = _read_injections(file_lines, file_header, path)
    electrode_numbers, column_indices = _electrode_channels(file_header, electrode_potentials.shape[2], path)
    check_electrodes(path.name, len(electrode_numbers))
    sensor_description = find_or_load_description(path, description)
    file_recording = _create_recording(
        file_header,
        drive_pairs,
        electrode_potentials[:, :, column_indices],
        electrode_numbers,
        sensor_description,
        path,
    )
    return create_measurement(path, file_recording, sensor_description)


def read_recordings(paths: Sequence[Path], description: str | Path | None = None) -> Measurement:
    """Read several Sciospec files of the same set-up and join their frames in the order of `paths`.

    If each file contains one frame, `[data] frame_rate` of a description determines the times; otherwise the times are
    the dates in the files. Raises `ValueError` as `read` and `jeit.data.gesture_set.join` do.
    """
    joined_measurement = join([read(path, description) for path in paths])
    frame_rate = find_or_load_description(paths[0], description).layout.frame_rate
    return (
        joined_measurement
        if frame_rate is None or joined_measurement.num_frames != len(paths)
        else joined_measurement.at_rate(frame_rate)
    )


def _parse_header(file_lines: list[str], path: Path) -> _FileHeader:
    num_lines = int(_header_number(file_lines, 0, path, is_integer=True))
    if not _MIN_HEADER_LINES <= num_lines <= _MAX_HEADER_LINES or num_lines >= len(file_lines):
        raise ValueError(f"{path.name}, line 1: a header of {num_lines} lines, and the file has {len(file_lines)}.")
    index_of_name_line = 1 if num_lines < 11 else 2  # line of the name of the setup
    min_frequency, max_frequency = (
        _header_number(file_lines, index_of_name_line + line_offset, path) for line_offset in (2, 3)
    )
    num_frequencies = int(_header_number(file_lines, index_of_name_line + 5, path, is_integer=True))
    if not (0 < min_frequency <= max_frequency and 1 <= num_frequencies <= len(file_lines)):
        raise ValueError(
            f"{path.name}, line {index_of_name_line + 3}: {num_frequencies} frequencies from {min_frequency:g} to "
            f"{max_frequency:g} Hz are none."
        )
    spacing_function = np.geomspace if _header_number(file_lines, index_of_name_line + 4, path) == 1 else np.linspace
    channel_lists = {
        name: _channel_list(line, name)
        for line in file_lines[:num_lines]
        for name in _CHANNEL_LISTS
        if line.startswith(name)
    }
    return _FileHeader(
        num_lines,
        file_lines[index_of_name_line + 1],
        spacing_function(min_frequency, max_frequency, num_frequencies),
        _header_number(file_lines, index_of_name_line + 6, path),
        channel_lists,
    )


def _header_number(file_lines: list[str], line_index: int, path: Path, *, is_integer: bool = False) -> float:
    text = file_lines[line_index].strip() if line_index < len(file_lines) else ""
    with suppress(ValueError):
        parsed_number = float(text)
        if np.isfinite(parsed_number) and (
            not is_integer or (parsed_number == int(parsed_number) and abs(parsed_number) < 1e9)
        ):
            return parsed_number
    raise ValueError(
        f"{path.name}, line {line_index + 1}: must be a {'whole ' if is_integer else ''}number; it is {describe(text)}."
    )


def _channel_list(line: str, name: str) -> list[int]:
    """Channel numbers, counted from 1, in the header line that begins with `name`."""
    line_words = line.removeprefix(name).replace(",", " ").split()
    return [int(line_word) for line_word in line_words if line_word.isdecimal() and len(line_word) < 6]


def _read_injections(file_lines: list[str], file_header: _FileHeader, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Driven electrode pairs (injections, 2), counted from 1, and complex potentials (injections, frequencies, columns)
    as stored in the file."""
    drive_pairs, potential_rows, num_frequencies = [], [], len(file_header.frequencies)
    for line_index, line in _nonempty_lines(file_lines, file_header.num_lines):
        line_numbers = _line_numbers(line, line_index, path)
        if len(potential_rows) == num_frequencies * len(drive_pairs):
            if (
                len(line_numbers) != 2
                or (line_numbers != line_numbers.round()).any()
                or not (line_numbers > 0).all()
                or line_numbers.max() > 1e5
            ):
                raise ValueError(f"{path.name}, line {line_index + 1}: must be the two electrodes of an injection.")
            if line_numbers[0] == line_numbers[1]:
                raise ValueError(
                    f"{path.name}, line {line_index + 1}: current enters and leaves at electrode {line_numbers[0]:g}; "
                    "an injection has two different electrodes."
                )
            drive_pairs.append(line_numbers.astype(int))
            continue
        if (
            len(line_numbers) < 4
            or len(line_numbers) % 2
            or (potential_rows and len(line_numbers) != 2 * len(potential_rows[0]))
        ):
            raise ValueError(
                f"{path.name}, line {line_index + 1}: has {len(line_numbers)} numbers; give a real and an imaginary "
                "part for each channel, as many as before. Is the file cut off?"
            )
        potential_rows.append(line_numbers[0::2] + 1j * line_numbers[1::2])
    if not drive_pairs or len(potential_rows) != num_frequencies * len(drive_pairs):
        raise ValueError(
            f"{path.name}: {len(drive_pairs)} injections have {len(potential_rows)} lines of potentials; is it cut off?"
        )
    return np.array(drive_pairs), np.array(potential_rows).reshape(len(drive_pairs), num_frequencies, -1)


def _nonempty_lines(file_lines: list[str], start_index: int) -> Iterator[tuple[int, str]]:
    return (
        (line_index, file_lines[line_index])
        for line_index in range(start_index, len(file_lines))
        if file_lines[line_index].strip()
    )


def _line_numbers(line: str, line_index: int, path: Path) -> np.ndarray:
    try:
        return np.array([float(number_text) for number_text in line.split()])
    except ValueError:
        raise ValueError(f"{path.name}, line {line_index + 1}: {describe(line.strip())} is not numbers.") from None


def _electrode_channels(file_header: _FileHeader, num_columns: int, path: Path) -> tuple[list[int], list[int]]:
    """Return the numbers of the electrodes, and the indices of the columns with the potentials of these electrodes."""
    all_channels, measured_channels = (file_header.channel_lists.get(name, []) for name in _CHANNEL_LISTS)
    column_channels = next(
        (channel_list for channel_list in (measured_channels, all_channels) if len(channel_list) == num_columns),
        list(range(1, num_columns + 1)),
    )
    electrode_numbers = (
        measured_channels
        if set(measured_channels) <= set(column_channels) and len(measured_channels) > 1
        else column_channels
    )
    if len(set(electrode_numbers)) < len(electrode_numbers):
        raise ValueError(f"{path.name}: its header lists a channel twice.")
    return electrode_numbers, [column_channels.index(electrode_number) for electrode_number in electrode_numbers]


def _create_recording(
    file_header: _FileHeader,
    drive_pairs: np.ndarray,
    electrode_potentials: np.ndarray,
    electrode_numbers: list[int],
    sensor_description: Description,
    path: Path,
) -> Recording:
    missing_electrodes = sorted({*drive_pairs.ravel().tolist()} - {*electrode_numbers})
    if missing_electrodes:
        raise ValueError(
            f"{path.name}: current flows at electrode {missing_electrodes[0]}, which is not among those measured."
        )
    electrode_indices = np.array(
        [[electrode_numbers.index(electrode) for electrode in drive_pair] for drive_pair in drive_pairs.tolist()]
    )
    if not 0 < file_header.drive_current <= 1:
        raise ValueError(
            f"{path.name}: its current is {file_header.drive_current:g} A; it must be positive, and at most 1."
        )
    drive_patterns, drive_indices = (
        np.zeros((len(electrode_indices), len(electrode_numbers))),
        np.arange(len(electrode_indices)),
    )
    drive_patterns[drive_indices, electrode_indices[:, 0]], drive_patterns[drive_indices, electrode_indices[:, 1]] = (
        file_header.drive_current,
        -file_header.drive_current,
    )
    # The power that the body dissipates is positive; its sign shows at which electrode of a pair the current enters.
    current_notes: list[str] = [*_CURRENT_NOTES]
    if np.median(np.einsum("sl,sfl->sf", drive_patterns, np.nan_to_num(np.real(electrode_potentials)))) < 0:
        drive_patterns = -drive_patterns
        current_notes.append(
            "current is taken to enter at the second electrode of a pair, whose potential is the higher."
        )
    reading_name, reference_electrode = sensor_description.reading
    measurement_rows = measurement_patterns(len(electrode_numbers), reading_name, reference_electrode)
    with np.errstate(invalid="ignore", over="ignore"):
        voltages = np.einsum("kl,sfl->fsk", measurement_rows, electrode_potentials).reshape(
            len(file_header.frequencies), -1
        )
    name = f"{len(electrode_indices)} injections, {reading_name}, {len(electrode_numbers)} electrodes"
    is_single_frequency = len(file_header.frequencies) == 1
    return Recording(
        voltages,
        from_matrices(drive_patterns, measurement_rows, name=name),
        times=_measurement_times(file_header.date_text) if is_single_frequency else None,
        frame_names=()
        if is_single_frequency
        else tuple(f"{frame_frequency:.6g} Hz" for frame_frequency in file_header.frequencies),
        notes=tuple(current_notes),
    )


def _measurement_times(date_text: str) -> np.ndarray | None:
    """Time of the measurement in seconds since 1970, if the date is in UTC; None if the date has an unknown form."""
    for date_format in ("%Y.%m.%d. %H:%M:%S.%f", "%Y.%m.%d. %H:%M:%S"):
        with suppress(ValueError):
            return np.array([datetime.strptime(date_text.strip(), date_format).replace(tzinfo=UTC).timestamp()])
    return None
