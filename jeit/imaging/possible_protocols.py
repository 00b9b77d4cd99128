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
# Minimum number of channels for each electrode.
_MIN_CHANNELS_PER_ELECTRODE = 2
# Maximum number of frames of a file with which protocols are compared; of more frames, some at regular intervals.
_MAX_FRAMES = 32
# The order of the channels matters if voltages in a different order would leave so many times as much unexplained.
_MIN_MISFIT_RATIO_OF_OTHER_ORDER = 2.0
# Layout of a table of numbers about which nothing is known.
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
        values = np.asarray(self.measurement.voltages)[np.asarray(self.measurement.mask)]
        mean_ratio = abs(values.mean()) ** 2 / np.mean(np.abs(values) ** 2)
        return bool(_MIN_MISFIT_RATIO_OF_OTHER_ORDER * self.unexplained < np.sqrt(1 - mean_ratio**2))

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
        options = {key: value for key, value in self.protocol.items() if key not in ("kind", "number")}
        option_text = ", ".join(f"{key} {str(value).lower()}" for key, value in options.items())
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
            table, axis = _read_array(path, key, excluded)
            shape = " × ".join(map(str, table.shape))
            sizes = tuple(sorted({*table.shape, table.size}, reverse=True))
            return cls(
                path, lambda counts: frames_in_table(table, counts, _UNKNOWN_LAYOUT, default_axis=axis), shape, sizes
            )
        if key is not None:
            raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
        if OpenEit.recognises(path):
            table = OpenEit.numbers(path)[0]
            shape, sizes = f"{counted(len(table), 'line')} of {table.shape[1]}", table.shape[1:]
            return cls(path, lambda counts: frames_in_table(table, counts, _UNKNOWN_LAYOUT), shape, sizes)
        text = read_text(path)
        length, lines = int(text.lengths[0]), len(text.lengths)
        total, shape = len(text.values), f"{counted(lines, 'line')} of {length}"
        # A frame that is wrapped over several lines ends with a line.
        part_lengths = {total // k for k in range(1, 1 + total // max(length, 1)) if length < total // k}
        part_lengths.intersection_update(np.cumsum(text.lengths).tolist())
        table = text.values.reshape(lines, length) if total == lines * length else np.zeros((0, 0))
        if text.separators.examples:  # a separator begins a frame or a part of one
            try:
                num_values_per_part = text.separators.complete(text.values, text.lengths, (), path.name).size
            except ValueError:
                if text.separators.unreadable:
                    raise
                # Parts have different sizes: lines are frames, or too many are missing.
                part_lengths, num_values_per_part = set(), 1
            part_lengths = {size for size in part_lengths if size % num_values_per_part == 0}
        sizes = tuple({length, length - 1, lines, *part_lengths})
        # Of one frame of reciprocal voltages, a symmetric matrix, rows and columns resemble each other alike.
        if lines == length == len(table) and 2 * relative_deviation(table.T) < relative_deviation(table):
            data = {"frames_in": "columns"}
            return cls(path, lambda counts: frames_in_table(table.T, counts, _UNKNOWN_LAYOUT), shape, sizes, data)
        return cls(path, lambda counts: frames_in_text(text, counts, _UNKNOWN_LAYOUT, path.name), shape, sizes)


def relative_deviation(rows: np.ndarray) -> float:
    """Norm of the deviations of rows from their mean, divided by the norm of the rows."""
    values = np.where(np.isfinite(rows), rows, 0)
    values_norm = float(np.linalg.norm(values))
    return float(np.linalg.norm(values - values.mean(axis=0))) / values_norm if values_norm else 0.0


def _read_array(path: Path, key: str | None, excluded: str | None) -> tuple[np.ndarray, str]:
    """The array of frames in a file, and whether its frames are usually its "rows" or its "columns"."""
    if path.suffix.lower() == ".npy":
        return np.atleast_2d(npy_array(path)), "rows"
    if path.suffix.lower() == ".mat":
        sizes, axis = matlab.shapes(path), "columns"
    else:
        sizes, axis = npz_shapes(path), "rows"
    name = "voltages" if key is None and excluded != "voltages" and "voltages" in sizes else key  # as jeit writes
    if name is None:
        tables = [item for item, shape in sizes.items() if item != excluded and int(np.prod(shape)) > 3]
        if not tables:
            raise ValueError(f"{path.name} holds no array of numbers{f' besides {excluded!r}' if excluded else ''}.")
        if len(tables) > 1:
            names = names_text([f"{item} ({' × '.join(map(str, sizes[item]))})" for item in tables])
            raise ValueError(f"{path.name}: arrays of numbers are {names}. Name that of the frames by key=.")
        name = tables[0]
    if name not in sizes:
        raise ValueError(
            f"key: {path.name} has no array {name!r}{did_you_mean(name, sizes)}; it has {names_text(sizes)}."
        )
    if path.suffix.lower() == ".npz":
        return np.atleast_2d(npz_arrays(path, name)[name]), axis
    table = matlab.numbers(matlab.load(path, name), name, path)
    return table.reshape(-1, 1) if 1 in table.shape else table, axis


def _protocols(number: int) -> Iterator[dict[str, Any]]:
    """Yield the table `[protocol]` of every common protocol for `number` electrodes."""
    shared_options = {"driven_electrodes": (False, True), "order": ("rotating", "fixed")}
    for kind, options in (
        ("adjacent", {**shared_options, "reciprocal": ("all", "half")}),
        ("two_terminal", {}),
        ("opposite", {**shared_options, "drives": ("distinct", "all")}),
        *(("skip", {"skipped": (skipped,), **shared_options}) for skipped in range(1, number // 2)),
    ):
        for values in product(*options.values()):
            defaults = {"driven_electrodes": False, "reciprocal": "all", "drives": "distinct"}
            table_entries = {
                key: value for key, value in zip(options, values, strict=True) if defaults.get(key) != value
            }
            yield {"kind": kind, "number": number, **table_entries}


def fitting_candidates(
    numbers: FileNumbers,
    reference_numbers: FileNumbers,
    geometry: dict,
    electrodes: dict,
    known_options: dict,
    current: float,
) -> Iterator[Candidate]:
    """Yield candidates whose number of channels fits the file and its reference; of equal protocols, only the first."""
    counts, yielded_protocols = set(numbers.sizes), set()
    for number in [known_options["number"]] if "number" in known_options else range(MIN_ELECTRODES, MAX_ELECTRODES + 1):
        if not any(number * (number - 4) / 4 <= count <= number**2 for count in counts):
            continue
        description, unsuitable_counts = None, set()
        for table in _protocols(number):
            if any(table.get(key, value) != value for key, value in known_options.items()):
                continue
            options_of_count = tuple((key, value) for key, value in table.items() if key != "order")
            if options_of_count in unsuitable_counts:
                continue
            protocol = _protocol({**table, "current": current}, numbers.path)
            count = 0 if protocol is None else protocol.num_measurements
            if protocol is None or count not in counts or count < _MIN_CHANNELS_PER_ELECTRODE * number:
                unsuitable_counts.add(options_of_count)
                continue
            patterns = (np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement))
            protocol_key = number, *(pattern.tobytes() for pattern in patterns)
            if protocol_key in yielded_protocols:
                continue
            yielded_protocols.add(protocol_key)
            description = description or _describe_body(geometry, electrodes, table, current)
            num_frames, measurement = _create_measurement(numbers, description, protocol)
            reference_measurement = (
                measurement
                if reference_numbers is numbers
                else _create_measurement(reference_numbers, description, protocol)[1]
            )
            if measurement is not None and reference_measurement is not None:
                empty_frame = reference_measurement.mean_frame()
                deviation_of_rows = relative_deviation(np.asarray(reference_measurement.filled()))
                yield Candidate(table, num_frames, deviation_of_rows, reciprocity_error(empty_frame), empty_frame)


def channel_counts(known_options: dict) -> list[int]:
    """Numbers of channels of protocols that have the `known_options` entries; empty without the number of
    electrodes."""
    tables = _protocols(known_options["number"]) if "number" in known_options else ()
    fitting_tables = [
        table for table in tables if all(table.get(key, value) == value for key, value in known_options.items())
    ]
    protocols = [_protocol({**table, "current": 1.0}, Path("a")) for table in fitting_tables]
    return sorted({protocol.num_measurements for protocol in protocols if protocol is not None})


def _describe_body(geometry: dict, electrodes: dict, protocol: dict, current: float) -> Description:
    places = {"contact_impedance": 1.0, **electrodes, "number": protocol["number"]}
    tables = {"geometry": geometry, "electrodes": places, "protocol": {**protocol, "current": current}}
    return parse_description(tables, "the description")


def _protocol(table: dict, path: Path) -> Protocol | None:
    """The protocol of a description's table `[protocol]`; None if the protocol has no channels."""
    try:
        return parse_description({"protocol": table}, "the description").protocol(path)
    except ValueError:  # none of its channels is left, or there are too few electrodes
        return None


def _create_measurement(
    numbers: FileNumbers, description: Description, protocol: Protocol
) -> tuple[int, Measurement | None]:
    """Number of frames of a file with `protocol`, and at most `_MAX_FRAMES` of them as a measurement; None if the
    numbers do not fit the protocol."""
    try:
        frames = numbers.frames([protocol.num_measurements])
        if frames.table.shape[1] != protocol.num_measurements:
            return 0, None
        num_frames = len(frames.table)
        chosen = np.unique(np.linspace(0, num_frames - 1, _MAX_FRAMES).round().astype(int))
        selected_frames = frames._replace(table=frames.table[chosen], times=None)
        return num_frames, create_measurement_of_frames(numbers.path, description, selected_frames, [(protocol, "")])
    except ValueError:
        return 0, None
