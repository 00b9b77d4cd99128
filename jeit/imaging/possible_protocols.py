"""Protocols of common kinds that fit the numbers in a file of voltages without a description, each with the evidence
for it: reciprocity, and the resemblance of the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted, did_you_mean, names_text
from jeit.data import Measurement
from jeit.data.description import Description, TableLayout, parse_description
from jeit.data.formats.boards import OpenEit
from jeit.data.formats.table import create_measurement_of_frames
from jeit.data.formats.text import TableFrames, frames_in_table, frames_in_text, read_text
from jeit.data.quality import reciprocity_error
from jeit.files import matlab, npy_array, npz_arrays, npz_shapes
from jeit.imaging.wiring import Wiring
from jeit.protocol import Protocol

# Minimum and maximum number of electrodes of the protocols that are tried.
MIN_ELECTRODES, MAX_ELECTRODES = 4, 64
# Minimum number of channels per electrode of a candidate protocol.
_MIN_CHANNELS_PER_ELECTRODE = 2
# Maximum number of frames of a file with which protocols are compared. If a file has more frames, frames at regular
# intervals are used.
_MAX_COMPARED_FRAMES = 32
# The order of the channels matters if the share that voltages in a different order would leave unexplained is at least
# this many times larger.
_MIN_MISFIT_RATIO_OF_OTHER_ORDER = 2.0
# Layout of a table of numbers without a description.
_UNKNOWN_LAYOUT = TableLayout()


@dataclass(frozen=True)
class Candidate:
    """Candidate for the protocol of a file. **Fields**: `protocol`: table `[protocol]` of a description, without the
    current; `frames`: number of frames; `spread`: relative deviation of the empty body's frames from their mean;
    `reciprocity`: reciprocity error of the mean frame, None if no two channels are reciprocal; `measurement`: the mean
    frame, read with this protocol; `wiring`: the wiring with which a uniform body explains this frame; `gains`: gains
    of the measurement patterns, if they explain the reciprocity error."""

    protocol: dict[str, Any]
    frames: int
    spread: float
    reciprocity: float | None
    measurement: Measurement
    wiring: Wiring | None = None
    gains: np.ndarray | None = None

    @property
    def is_cut_off(self) -> bool:
        """Whether the last frame of the file, or of its reference, is incomplete."""
        return any("is cut off after" in note for note in self.measurement.notes)

    @property
    def misfit(self) -> float:
        """Relative misfit of a uniform body to the mean frame; infinite if the misfit was not computed."""
        if self.wiring is None:
            return np.inf
        return self.wiring.misfit if self.reversed_signs else self.wiring.described

    @property
    def reversed_signs(self) -> bool:
        """Whether a uniform body explains the voltages with the opposite sign and an otherwise unchanged wiring."""
        return self.wiring is not None and self.wiring == Wiring(tuple(range(len(self.wiring.places))), "", True)

    @property
    def least_unexplained(self) -> float:
        """Relative error of all frames without the misfit: root of the sum of squares of spread and 1/√2 of the
        reciprocity error, which has twice the variance of the noise."""
        return float(np.hypot(self.spread, (self.reciprocity or 0) / np.sqrt(2)))

    @property
    def unexplained(self) -> float:
        """Relative error with which this protocol explains all frames: root of the sum of squares of misfit and
        `least_unexplained`."""
        return float(np.hypot(self.misfit, self.least_unexplained))

    @property
    def depends_on_channel_order(self) -> bool:
        """Whether a uniform body would explain the voltages far worse if the channels were in a different order. On
        average, a share √(1 - r²) would then be unexplained, where r is the squared mean of the voltages divided by
        their mean square."""
        usable_voltages = np.asarray(self.measurement.voltages)[np.asarray(self.measurement.mask)]
        squared_mean_ratio = abs(usable_voltages.mean()) ** 2 / np.mean(np.abs(usable_voltages) ** 2)
        return bool(_MIN_MISFIT_RATIO_OF_OTHER_ORDER * self.unexplained < np.sqrt(1 - squared_mean_ratio**2))

    @property
    def num_unread_channels(self) -> int:
        """Number of channels that are zero in every frame or masked, apart from channels on driven electrodes."""
        is_on_driven_electrodes = np.asarray(self.measurement.protocol.channels_on_driven_electrodes())
        voltages, mask = np.asarray(self.measurement.voltages), np.asarray(self.measurement.mask)
        return int((~mask | (voltages == 0))[..., ~is_on_driven_electrodes].sum())

    @property
    def explains_zeros(self) -> bool:
        """Whether all channels on driven electrodes, and no others, are zero in every frame or masked: the device does
        not measure there, and fills in zeros."""
        is_on_driven_electrodes = np.asarray(self.measurement.protocol.channels_on_driven_electrodes())
        is_measured = np.asarray(self.measurement.mask)[..., is_on_driven_electrodes]
        return bool(is_on_driven_electrodes.any()) and not is_measured.any() and self.num_unread_channels == 0

    @property
    def name(self) -> str:
        """Kind, number of electrodes and options of the protocol, in words."""
        protocol_options = {
            option_name: option_value
            for option_name, option_value in self.protocol.items()
            if option_name not in ("kind", "number")
        }
        option_text = ", ".join(
            f"{option_name} {str(option_value).lower()}" for option_name, option_value in protocol_options.items()
        )
        return f"{self.protocol['kind']}, {self.protocol['number']} electrodes{option_text and ', ' + option_text}"


@dataclass(frozen=True)
class FileNumbers:
    """The numbers in a file. **Fields**: `frames`: function that arranges the numbers in frames, for given possible
    numbers of channels; `shape`: their shape in words; `sizes`: possible numbers of values in a frame; `data`: entries
    of a description's table `[data]` for this arrangement."""

    path: Path
    frames: Callable[[Sequence[int]], TableFrames]
    shape: str
    sizes: tuple[int, ...]
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, key: str | None, excluded: str | None = None) -> FileNumbers:
        """Read the numbers in a file; `key`: name of the array of frames; `excluded`: an array without frames. Raises
        `ValueError` for a file that cannot be read, or if the array of frames is not determined."""
        if path.suffix.lower() in (".mat", ".npz", ".npy"):
            number_table, usual_frame_axis = _read_frame_array(path, key, excluded)
            shape_text = " × ".join(map(str, number_table.shape))
            frame_sizes = tuple(sorted({*number_table.shape, number_table.size}, reverse=True))
            return cls(
                path,
                lambda possible_counts: frames_in_table(
                    number_table, possible_counts, _UNKNOWN_LAYOUT, default_axis=usual_frame_axis
                ),
                shape_text,
                frame_sizes,
            )
        if key is not None:
            raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
        if OpenEit.recognises(path):
            number_table = OpenEit.numbers(path)[0]
            shape_text, frame_sizes = (
                f"{counted(len(number_table), 'line')} of {number_table.shape[1]}",
                number_table.shape[1:],
            )
            return cls(
                path,
                lambda possible_counts: frames_in_table(number_table, possible_counts, _UNKNOWN_LAYOUT),
                shape_text,
                frame_sizes,
            )
        file_text = read_text(path)
        values_per_line, num_lines = int(file_text.lengths[0]), len(file_text.lengths)
        num_values, shape_text = len(file_text.values), f"{counted(num_lines, 'line')} of {values_per_line}"
        # A frame that is wrapped over several lines ends with a line.
        part_sizes = {
            num_values // num_parts
            for num_parts in range(1, 1 + num_values // max(values_per_line, 1))
            if values_per_line < num_values // num_parts
        }
        part_sizes.intersection_update(np.cumsum(file_text.lengths).tolist())
        number_table = (
            file_text.values.reshape(num_lines, values_per_line)
            if num_values == num_lines * values_per_line
            else np.zeros((0, 0))
        )
        if file_text.separators.examples:  # a separator begins a frame or a part of one
            try:
                num_values_per_part = file_text.separators.complete(
                    file_text.values, file_text.lengths, (), path.name
                ).size
            except ValueError:
                if file_text.separators.unreadable:
                    raise
                # Parts have different sizes: lines are frames, or too many are missing.
                part_sizes, num_values_per_part = set(), 1
            part_sizes = {part_size for part_size in part_sizes if part_size % num_values_per_part == 0}
        frame_sizes = tuple({values_per_line, values_per_line - 1, num_lines, *part_sizes})
        # One frame of reciprocal voltages is a symmetric matrix, whose rows resemble each other as much as its columns.
        if num_lines == values_per_line == len(number_table) and 2 * relative_deviation(
            number_table.T
        ) < relative_deviation(number_table):
            data_entries = {"frames_in": "columns"}
            return cls(
                path,
                lambda possible_counts: frames_in_table(number_table.T, possible_counts, _UNKNOWN_LAYOUT),
                shape_text,
                frame_sizes,
                data_entries,
            )
        return cls(
            path,
            lambda possible_counts: frames_in_text(file_text, possible_counts, _UNKNOWN_LAYOUT, path.name),
            shape_text,
            frame_sizes,
        )


def relative_deviation(rows: np.ndarray) -> float:
    """Norm of the deviations of rows from their mean, divided by the norm of the rows."""
    finite_values = np.where(np.isfinite(rows), rows, 0)
    values_norm = float(np.linalg.norm(finite_values))
    return float(np.linalg.norm(finite_values - finite_values.mean(axis=0))) / values_norm if values_norm else 0.0


def _read_frame_array(path: Path, requested_name: str | None, excluded_name: str | None) -> tuple[np.ndarray, str]:
    """Return the array of frames in a file, and whether frames are usually "rows" or "columns" in files of this
    format."""
    if path.suffix.lower() == ".npy":
        return np.atleast_2d(npy_array(path)), "rows"
    if path.suffix.lower() == ".mat":
        shapes_by_name, usual_frame_axis = matlab.shapes(path), "columns"
    else:
        shapes_by_name, usual_frame_axis = npz_shapes(path), "rows"
    array_name = (
        "voltages"
        if requested_name is None and excluded_name != "voltages" and "voltages" in shapes_by_name
        else requested_name
    )  # as jeit writes
    if array_name is None:
        array_names = [
            listed_name
            for listed_name, array_shape in shapes_by_name.items()
            if listed_name != excluded_name and int(np.prod(array_shape)) > 3
        ]
        if not array_names:
            raise ValueError(
                f"{path.name} holds no array of numbers{f' besides {excluded_name!r}' if excluded_name else ''}."
            )
        if len(array_names) > 1:
            names_with_shapes = names_text(
                [f"{listed_name} ({' × '.join(map(str, shapes_by_name[listed_name]))})" for listed_name in array_names]
            )
            raise ValueError(
                f"{path.name}: arrays of numbers are {names_with_shapes}. Name that of the frames by key=."
            )
        array_name = array_names[0]
    if array_name not in shapes_by_name:
        raise ValueError(
            f"key: {path.name} has no array {array_name!r}{did_you_mean(array_name, shapes_by_name)}; it has "
            f"{names_text(shapes_by_name)}."
        )
    if path.suffix.lower() == ".npz":
        return np.atleast_2d(npz_arrays(path, array_name)[array_name]), usual_frame_axis
    number_array = matlab.numbers(matlab.load(path, array_name), array_name, path)
    return number_array.reshape(-1, 1) if 1 in number_array.shape else number_array, usual_frame_axis


def _common_protocol_tables(num_electrodes: int) -> Iterator[dict[str, Any]]:
    """Yield the table `[protocol]` of every common protocol for `num_electrodes` electrodes."""
    shared_options = {"driven_electrodes": (False, True), "order": ("rotating", "fixed")}
    for protocol_kind, option_choices in (
        ("adjacent", {**shared_options, "reciprocal": ("all", "half")}),
        ("two_terminal", {}),
        ("opposite", {**shared_options, "drives": ("distinct", "all")}),
        *(("skip", {"skipped": (num_skipped,), **shared_options}) for num_skipped in range(1, num_electrodes // 2)),
    ):
        for option_values in product(*option_choices.values()):
            default_options = {"driven_electrodes": False, "reciprocal": "all", "drives": "distinct"}
            option_entries = {
                option_name: option_value
                for option_name, option_value in zip(option_choices, option_values, strict=True)
                if default_options.get(option_name) != option_value
            }
            yield {"kind": protocol_kind, "number": num_electrodes, **option_entries}


def fitting_candidates(
    numbers: FileNumbers,
    reference_numbers: FileNumbers,
    geometry: dict,
    electrodes: dict,
    known_options: dict,
    current: float,
) -> Iterator[Candidate]:
    """Yield candidates whose number of channels fits the file and its reference; of equal protocols, only the first."""
    possible_counts, yielded_protocols = set(numbers.sizes), set()
    for num_electrodes in (
        [known_options["number"]] if "number" in known_options else range(MIN_ELECTRODES, MAX_ELECTRODES + 1)
    ):
        if not any(
            num_electrodes * (num_electrodes - 4) / 4 <= num_channels <= num_electrodes**2
            for num_channels in possible_counts
        ):
            continue
        description, unsuitable_options = None, set()
        for protocol_table in _common_protocol_tables(num_electrodes):
            if any(
                protocol_table.get(option_name, option_value) != option_value
                for option_name, option_value in known_options.items()
            ):
                continue
            options_without_order = tuple(
                (option_name, option_value)
                for option_name, option_value in protocol_table.items()
                if option_name != "order"
            )
            if options_without_order in unsuitable_options:
                continue
            protocol = _parse_protocol({**protocol_table, "current": current}, numbers.path)
            num_channels = 0 if protocol is None else protocol.num_measurements
            if (
                protocol is None
                or num_channels not in possible_counts
                or num_channels < _MIN_CHANNELS_PER_ELECTRODE * num_electrodes
            ):
                unsuitable_options.add(options_without_order)
                continue
            channel_patterns = (np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement))
            protocol_key = num_electrodes, *(channel_pattern.tobytes() for channel_pattern in channel_patterns)
            if protocol_key in yielded_protocols:
                continue
            yielded_protocols.add(protocol_key)
            description = description or _description_of_body(geometry, electrodes, protocol_table, current)
            num_frames, measurement = _measurement_of_file(numbers, description, protocol)
            reference_measurement = (
                measurement
                if reference_numbers is numbers
                else _measurement_of_file(reference_numbers, description, protocol)[1]
            )
            if measurement is not None and reference_measurement is not None:
                empty_frame = reference_measurement.mean_frame()
                deviation_of_rows = relative_deviation(np.asarray(reference_measurement.filled()))
                yield Candidate(
                    protocol_table, num_frames, deviation_of_rows, reciprocity_error(empty_frame), empty_frame
                )


def channel_counts(known_options: dict) -> list[int]:
    """Numbers of channels of protocols that have the `known_options` entries; empty without the number of
    electrodes."""
    protocol_tables = _common_protocol_tables(known_options["number"]) if "number" in known_options else ()
    fitting_tables = [
        protocol_table
        for protocol_table in protocol_tables
        if all(
            protocol_table.get(option_name, option_value) == option_value
            for option_name, option_value in known_options.items()
        )
    ]
    protocols = [_parse_protocol({**protocol_table, "current": 1.0}, Path("a")) for protocol_table in fitting_tables]
    return sorted({protocol.num_measurements for protocol in protocols if protocol is not None})


def _description_of_body(geometry: dict, electrodes: dict, protocol_table: dict, current: float) -> Description:
    electrode_entries = {"contact_impedance": 1.0, **electrodes, "number": protocol_table["number"]}
    description_tables = {
        "geometry": geometry,
        "electrodes": electrode_entries,
        "protocol": {**protocol_table, "current": current},
    }
    return parse_description(description_tables, "the description")


def _parse_protocol(protocol_table: dict, path: Path) -> Protocol | None:
    """Create the protocol of a table `[protocol]` of a description; return None if the protocol has no channels."""
    try:
        return parse_description({"protocol": protocol_table}, "the description").protocol(path)
    except ValueError:  # none of its channels is left, or there are too few electrodes
        return None


def _measurement_of_file(
    file_numbers: FileNumbers, description: Description, protocol: Protocol
) -> tuple[int, Measurement | None]:
    """Return the number of frames of a file read with `protocol`, and at most `_MAX_COMPARED_FRAMES` of them as a
    measurement; None if the numbers do not fit the protocol."""
    try:
        frame_table = file_numbers.frames([protocol.num_measurements])
        if frame_table.table.shape[1] != protocol.num_measurements:
            return 0, None
        num_frames = len(frame_table.table)
        chosen_frames = np.unique(np.linspace(0, num_frames - 1, _MAX_COMPARED_FRAMES).round().astype(int))
        selected_frames = frame_table._replace(table=frame_table.table[chosen_frames], times=None)
        return num_frames, create_measurement_of_frames(
            file_numbers.path, description, selected_frames, [(protocol, "")]
        )
    except ValueError:
        return 0, None
