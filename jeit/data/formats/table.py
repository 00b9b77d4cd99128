"""Reader of plain tables in CSV, text, NPY and NPZ files, with a TOML description."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Inexact

from jeit.arguments import names_text
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.description import Description, TableLayout, load_description
from jeit.data.formats.text import (
    TableFrames,
    frames_in_table,
    frames_in_text,
    read_text,
    rectangle,
    remove_cut_line,
)
from jeit.data.inferred_properties import correct_signs, fitting_protocol, unmeasured_driven_channels
from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.files import npy_array, npz_arrays, npz_shapes
from jeit.protocol import Protocol

DESCRIPTION = "table (.csv, .txt, .npy, .npz) with a TOML description beside it"
SUFFIXES = (".csv", ".txt", ".dat", ".npy", ".npz")
# Arrays that `write_table` stores in addition to the voltages and the protocol.
_TEXT_ARRAYS = ("mask", "protocol_name", "frame_names", "notes", "times")
_STORED_ARRAYS = (*PROTOCOL_ARRAYS, *_TEXT_ARRAYS)

AXES = ("electrodes", "patterns", "frames")
"""Names of the axes of an array of voltages, in their default order; a description can state a different order."""
# Maximum mean of the potentials of a current pattern, relative to the largest potential, that counts as zero.
_MAX_RELATIVE_MEAN_POTENTIAL = 0.01


def recognises(path: Path) -> bool:
    """Whether a file has the suffix of a table of numbers, such as .csv."""
    return path.suffix.lower() in SUFFIXES


def find_description(path: Path) -> str | Path | None:
    """The description that belongs to a data file: a TOML file of the same name, else `description.toml` in the same
    folder.

    If neither file exists, the bundled description "tank6cm" is used for a CSV table named like the files of the 6 cm
    tank, with current and frequency (`…_55uA_1000Hz.csv`). None if there is no description.
    """
    for candidate_path in (path.with_suffix(".toml"), path.parent / "description.toml"):
        if candidate_path.is_file():
            return candidate_path
    if path.suffix.lower() == ".csv" and re.search(r"_[0-9.]+uA_[0-9.]+Hz$", path.stem):
        return "tank6cm"
    return None


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read a measurement from a table, with the `description` (a path or the name of a bundled description), else with
    the description beside the table, else with the description of `like`. `key`: name of the array of voltages in an
    NPZ file.

    `like`: a measurement of the same sensor. For a table without a description, the protocol, electrodes and body of
    `like` are used, and, if `like` was read from a table, the units and columns in the description of that table.
    Raises `ValueError` if there is no description, or if file and description disagree.
    """
    description_source = find_description(path) if description is None else description
    if description_source is not None:
        sensor_description = load_description(description_source)
    elif like is not None:
        sensor_description = description_like(like)
    else:
        # A damaged file raises its own error here, because a description would not help.
        _ = _read_numpy_arrays(path, ()) if path.suffix.lower() in (".npz", ".npy") else read_text(path)
        raise ValueError(
            f"description: {path.name} is a table of numbers, and nothing says what they mean. Put a description "
            f"beside it, {path.with_suffix('.toml').name} (geometry, electrodes, protocol), or name one; "
            f"`jeit describe {path.name}` finds out what it can, and writes one."
        )
    if key is not None and path.suffix.lower() != ".npz":
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    if key is not None:
        sensor_description = replace(sensor_description, layout=replace(sensor_description.layout, keys=(key,)))
    candidate_protocols = sensor_description.protocols(path) or ([] if like is None else [(like.protocol, "")])
    stored_mask = stored_protocol = stored_times = None
    if path.suffix.lower() in (".npz", ".npy"):
        stored_arrays = _read_numpy_arrays(path, sensor_description.layout.keys)
        voltage_table, stored_mask = (
            _voltages_of_arrays(stored_arrays, sensor_description.layout, path),
            stored_arrays.get("mask"),
        )
        if voltage_table.ndim == 3 or sensor_description.patterns_measured:
            voltage_table = frames_of(voltage_table, sensor_description.layout.axes, path.name)
        if sensor_description.protocol_section is None:
            stored_protocol = _stored_protocol(stored_arrays)
        candidate_protocols = candidate_protocols if stored_protocol is None else [(stored_protocol, "")]
        file_frames = frames_in_table(
            np.atleast_2d(voltage_table), channel_counts(candidate_protocols), sensor_description.layout
        )
        sensor_description, stored_times = (
            _with_stored_texts(sensor_description, stored_arrays),
            _stored_times(stored_arrays, path.name),
        )
    else:
        described_layout = sensor_description.layout
        text = read_text(path, described_layout.delimiter, described_layout.skip_rows)
        file_frames = frames_in_text(text, channel_counts(candidate_protocols), described_layout, path.name)
    measurement = create_measurement_of_frames(
        path, sensor_description, file_frames, candidate_protocols, stored_mask, like
    )
    if stored_times is None or sensor_description.layout.averaged or sensor_description.layout.frame_rate is not None:
        return measurement
    return replace(measurement, times=stored_times)


NamedProtocols = Sequence[tuple[Protocol, str]]
"""Candidate protocols, the described protocol first, each with the options that a description would have to state for
it."""


def channel_counts(protocols: NamedProtocols) -> list[int]:
    """Numbers of channels of the candidate protocols; the first is the number of channels of the described protocol."""
    return [*dict.fromkeys(protocol.num_measurements for protocol, _ in protocols)]


def create_measurement_of_frames(
    path: Path,
    sensor_description: Description,
    file_frames: TableFrames,
    protocols: NamedProtocols,
    mask: np.ndarray | None = None,
    like: Measurement | None = None,
) -> Measurement:
    """Create a measurement from the frames of a file, with notes on detected properties; see `scale_to_volts` and
    `read` for the arguments."""
    described_layout = replace(sensor_description.layout, frames_in="rows")
    frames = arrange_frames(file_frames.table, described_layout, path.name)
    measurement_notes = (
        *sensor_description.notes,
        *file_frames.notes,
        *component_notes(file_frames.table, described_layout),
    )
    protocol, protocol_notes = fitting_protocol(frames, protocols, like)
    sensor_description = replace(
        sensor_description, layout=described_layout, notes=(*measurement_notes, *protocol_notes)
    )
    exclusion_reason = ""
    if protocol is not None and frames.shape[-1] == protocol.num_measurements:
        unread_channels = unmeasured_driven_channels(frames, protocol)
        if unread_channels.any():
            mask = ~unread_channels if mask is None else np.asarray(mask) & ~unread_channels
            exclusion_reason = "they read driven electrodes, and are zero in every frame."
    measurement = scale_to_volts(path, sensor_description, frames, protocol, mask)
    if exclusion_reason:
        measurement_notes = [
            measurement_note.replace("excluded by the mask given.", exclusion_reason)
            for measurement_note in measurement.notes
        ]
        measurement = replace(measurement, notes=tuple(measurement_notes))
    if described_layout.polarity is None:
        measurement = correct_signs(measurement, like)
    if file_frames.times is None or described_layout.averaged or described_layout.frame_rate is not None:
        return measurement
    return replace(measurement, times=file_frames.times[:: 2 if described_layout.complex_pairs else 1])


def _divide_by_gains(frames: np.ndarray, protocol: Protocol, sensor_description: Description) -> np.ndarray:
    """Frames divided by the described gains of their measurement patterns. Raises `ValueError` unless there is one gain
    for each measurement pattern."""
    pattern_gains, num_patterns = np.array(sensor_description.layout.gains), len(protocol.measurement)
    if pattern_gains.size not in (0, num_patterns):
        raise ValueError(
            f"{sensor_description.origin}: [data] gains must be one for each of the {num_patterns} measurement "
            f"patterns of '{protocol.name}'; they are {pattern_gains.size}."
        )
    if not pattern_gains.size or frames.shape[-1] != protocol.num_measurements:
        return frames
    return frames / pattern_gains[np.asarray(protocol.measurement_index)]


def description_like(like: Measurement) -> Description:
    """Description that consists of the properties of `like`, a measurement of the same sensor, without the protocol and
    the frame names."""
    source_path = Path(like.source)
    description_path = (
        find_description(source_path)
        if like.source and (recognises(source_path) or source_path.suffix == ".mat")
        else None
    )
    table_layout = (
        TableLayout()
        if description_path is None
        else replace(load_description(description_path).layout, frame_names=(), keys=())
    )
    return Description(
        origin=f"the description of '{like.name}'",
        title="",
        domain=like.domain,
        electrodes=like.electrodes,
        layout=table_layout,
        notes=(f"described as '{like.name}' is, for it has no description of its own.",),
        protocol_section=None,
        uncertainty=like.uncertainty,
    )


def scale_to_volts(
    path: Path, sensor_description: Description, frames: np.ndarray, protocol: Protocol | None, mask: np.ndarray | None
) -> Measurement:
    """Scale frames (frames, channels) in the unit of the file to volts as the description states, and mask unusable
    voltages. `protocol`: the protocol stored in the file, or None.

    Raises `ValueError` if there is no protocol, if the number of frame names is not the number of frames, and as
    `screen` does.
    """
    protocol = protocol or sensor_description.protocol(path)
    if protocol is None:
        raise ValueError(
            f'{sensor_description.origin}: no protocol: add a [protocol] section with kind = "adjacent" or another.'
        )
    scale_notes, frames = sensor_description.notes, _divide_by_gains(frames, protocol, sensor_description)
    if sensor_description.mean_removed and frames.shape[-1] == protocol.num_measurements:
        frames, mean = subtract_mean(np.atleast_2d(frames), protocol.num_electrodes)
        mean_note = (
            f"the potentials had a mean, {mean * sensor_description.layout.scale:.3g} V at most; it is subtracted."
        )
        scale_notes = (*scale_notes, mean_note) if mean else scale_notes
    frame_names, num_frames = sensor_description.layout.frame_names, len(np.atleast_2d(frames))
    if frame_names and len(frame_names) != num_frames:
        raise ValueError(
            f"{sensor_description.origin}: [data] frame_names must be as many as the frames of {path.name}, "
            f"{num_frames}; they are {len(frame_names)}."
        )
    measurement = screen(
        frames * sensor_description.layout.scale,
        protocol,
        electrodes=sensor_description.electrodes,
        domain=sensor_description.domain,
        mask=mask,
        saturation=sensor_description.layout.saturation,
        name=path.stem,
        source=str(path),
        frame_names=frame_names,
        notes=scale_notes,
    )
    measurement = replace(measurement, uncertainty=sensor_description.uncertainty)
    if sensor_description.layout.averaged:
        frame_note = f"the mean of {measurement.num_frames} frames."
        return replace(measurement.mean_frame(), notes=(*measurement.notes, frame_note))
    frame_rate = sensor_description.layout.frame_rate
    return measurement if frame_rate is None else measurement.at_rate(frame_rate)


def numbers(path: Path, layout: TableLayout) -> tuple[np.ndarray, tuple[str, ...]]:
    """The numbers of a text or NPY file, arranged as in the file, and the names of its columns from the last line of
    the heading, if there is a heading. A last line that is cut off is left out.

    Raises `ValueError` if the file contains anything but numbers.
    """
    if path.suffix.lower() == ".npy":
        return _voltages_of_arrays(_read_numpy_arrays(path, ()), layout, path), ()
    text = remove_cut_line(read_text(path, layout.delimiter, layout.skip_rows))
    return rectangle(text, path.name), text.heading


def arrange_frames(table: np.ndarray, layout: TableLayout, name: str) -> np.ndarray:
    """Frames (frames, channels), in the unit of the file, of a table with the arrangement `layout`. Raises `ValueError`
    if rows are pairs of real and imaginary parts and the number of rows is odd."""
    frames = table.T if table.ndim == 2 and layout.frames_in == "columns" else np.atleast_2d(table)
    if layout.complex_pairs:
        if len(frames) % 2:
            raise ValueError(
                f"{name}: complex_pairs needs real and imaginary {layout.frames_in} in turn, an even number; "
                f"there are {len(frames)}."
            )
        frames = frames[0::2] + 1j * frames[1::2]
    if not np.iscomplexobj(frames):
        return frames
    if layout.component == "imaginary":
        return np.imag(frames)
    if layout.component == "magnitude":
        # The magnitude receives the sign of the real part, because a magnitude alone has no sign.
        return np.abs(frames) * np.where(np.real(frames) < 0, -1.0, 1.0)
    return frames if layout.component == "complex" else np.real(frames)


def component_notes(values: np.ndarray, layout: TableLayout) -> tuple[str, ...]:
    """A note that states which part (such as the real part) of complex voltages is read."""
    if not np.iscomplexobj(values) or layout.component == "complex":
        return ()
    return (f"of complex voltages this is the {layout.component} part; see [data] component.",)


def _read_numpy_arrays(path: Path, array_keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read from an NPZ file, by name, the arrays `array_keys` and the arrays that `write_table` stores; or from an NPY
    file its array, as "voltages". Without `array_keys`, an array of another name is read as "voltages" if it is the
    only one."""
    try:
        if path.suffix.lower() == ".npy":
            return {"voltages": npy_array(path)}
        array_names = array_keys or (_name_of_voltages(path),)
        stored_arrays = npz_arrays(path, *array_names, *_STORED_ARRAYS)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    return (
        stored_arrays
        if array_keys or array_names[0] not in stored_arrays
        else {**stored_arrays, "voltages": stored_arrays[array_names[0]]}
    )


def _name_of_voltages(path: Path) -> str:
    """Name of the array of voltages in an NPZ file: "voltages", unless another array is the only one of more than three
    numbers."""
    array_shapes = npz_shapes(path)
    array_names = [
        name for name, array_shape in array_shapes.items() if name not in _STORED_ARRAYS and math.prod(array_shape) > 3
    ]
    return array_names[0] if "voltages" not in array_shapes and len(array_names) == 1 else "voltages"


def _voltages_of_arrays(stored_arrays: dict[str, np.ndarray], table_layout: TableLayout, path: Path) -> np.ndarray:
    voltage_keys = table_layout.keys if table_layout.keys and path.suffix.lower() == ".npz" else ("voltages",)
    missing_keys = [voltage_key for voltage_key in voltage_keys if voltage_key not in stored_arrays]
    if missing_keys:
        array_names = names_text(sorted(stored_arrays.get("", stored_arrays)))
        raise ValueError(
            f"{path.name}: there is no array '{missing_keys[0]}'; the file has {array_names}. Name the voltages with "
            "[data] keys in the description."
        )
    for voltage_key in voltage_keys:
        if stored_arrays[voltage_key].dtype.kind not in "biufc":
            raise ValueError(
                f"{path.name}: '{voltage_key}' holds {stored_arrays[voltage_key].dtype}; give numbers, in volts."
            )
    return (
        stored_arrays[voltage_keys[0]]
        if len(voltage_keys) == 1
        else np.stack([stored_arrays[voltage_key].ravel() for voltage_key in voltage_keys])
    )


def _stored_protocol(stored_arrays: dict[str, np.ndarray]) -> Protocol | None:
    """The protocol in a file written by `write_table`; None if the file contains no protocol."""
    if not all(array_name in stored_arrays for array_name in PROTOCOL_ARRAYS):
        return None
    name = str(stored_arrays.get("protocol_name", "custom"))
    return Protocol(**{array_name: stored_arrays[array_name] for array_name in PROTOCOL_ARRAYS}, name=name)


def _with_stored_texts(description: Description, stored_arrays: dict[str, np.ndarray]) -> Description:
    """The description with added frame names (if it has none) and notes from a file written by `write_table`."""
    frame_names = description.layout.frame_names or _stored_texts(stored_arrays, "frame_names")
    combined_notes = (*description.notes, *_stored_texts(stored_arrays, "notes"))
    return replace(description, layout=replace(description.layout, frame_names=frame_names), notes=combined_notes)


def _stored_times(stored_arrays: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    """Times of the frames from a file written by `write_table`, or None."""
    stored_times = stored_arrays.get("times")
    if stored_times is not None and stored_times.dtype.kind not in "iuf":
        raise ValueError(f"{name}: 'times' holds {stored_times.dtype}; give seconds.")
    return stored_times


def _stored_texts(stored_arrays: dict[str, np.ndarray], name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in np.ravel(stored_arrays.get(name, np.zeros(0))))


def frames_of(values: np.ndarray, axes: tuple[str, ...], name: str) -> Inexact[np.ndarray, "F M"]:
    """Frames (frames, channels) from an array of voltages with the given `axes`, with channels ordered drive by drive;
    an array of two axes is one frame.

    Raises `ValueError` for an array with a different number of axes.
    """
    axis_names = tuple(axes or AXES)
    if values.ndim == len(axis_names) - 1:
        values = np.expand_dims(values, axis_names.index("frames"))  # MATLAB omits a last axis of length one
    if values.ndim != len(axis_names):
        raise ValueError(
            f"{name}: the voltages have shape {values.shape}; {', '.join(axis_names)} are {len(axis_names)} axes."
        )
    transposed_values = np.transpose(
        values, [axis_names.index(axis_name) for axis_name in ("frames", "patterns", "electrodes")]
    )
    return transposed_values.reshape(len(transposed_values), -1)


def subtract_mean(frames: Inexact[np.ndarray, "F M"], num_electrodes: int) -> tuple[Inexact[np.ndarray, "F M"], float]:
    """Subtract from the potentials of each current pattern their mean over `num_electrodes` electrodes, if any mean
    exceeds noise, i.e. if potentials were measured against ground or against an electrode. Returns the frames and the
    largest mean, or 0 if nothing is subtracted. Patterns with NaN are not changed."""
    pattern_potentials = frames.reshape(len(frames), -1, num_electrodes)
    mean_potentials = pattern_potentials.mean(axis=2, keepdims=True)
    mean_potentials = np.where(np.isfinite(mean_potentials), mean_potentials, 0)
    centred_potentials = pattern_potentials - mean_potentials
    if not (
        np.abs(mean_potentials) > _MAX_RELATIVE_MEAN_POTENTIAL * np.abs(centred_potentials).max(axis=2, keepdims=True)
    ).any():
        return frames, 0.0
    return centred_potentials.reshape(frames.shape), float(np.abs(mean_potentials).max())
