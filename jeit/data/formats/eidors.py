"""Reader of EIDORS-style voltage vectors in a .mat file.

The protocol is stored in the file (`stim`, `meas`, `meas_stim`), or described by the section `[protocol]` of a
description. EIDORS drives -I at the first electrode of a pair and +I at the second, and measures first minus second, so
that voltages of the adjacent protocol are positive: a description must state `polarity = "reversed"`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from jeit.arguments import names_text
from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats.table import channel_counts, create_measurement_of_frames, description_like, frames_of
from jeit.data.formats.text import frames_in_table
from jeit.data.measurement import Measurement
from jeit.files import matlab
from jeit.protocol import Protocol, from_channels

DESCRIPTION = "EIDORS-style vectors (.mat with stim, meas, meas_stim, or any with a TOML description)"
PATTERN_NAMES = ("stim", "meas", "meas_stim")
# Usual names of homogeneous (reference) voltage vectors and of inhomogeneous voltage vectors.
REFERENCE_NAMES = ("v_h", "vh")
OBJECT_NAMES = ("v_i", "vi")


def recognises(path: Path) -> bool:
    """Whether a file is a .mat file that contains stimulation and measurement patterns of EIDORS."""
    return path.suffix.lower() == ".mat" and set(PATTERN_NAMES) <= matlab.variable_names(path)


def find_description(path: Path) -> Path | None:
    """The description beside a file: a TOML file of the same name, or `description.toml` in the same folder if the file
    contains no patterns; None if there is none."""
    sibling_path, folder_path = path.with_suffix(".toml"), path.parent / "description.toml"
    if sibling_path.is_file():
        return sibling_path
    return folder_path if folder_path.is_file() and not recognises(path) else None


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read voltages from a .mat file: the array `key`, else the arrays named by `[data] keys` of the description, else
    the variables vh, vi, v_h, v_i, else the only array whose size fits the number of channels of the protocol.

    A file with `stim` (electrodes, drives) in amperes, `meas` (channels, electrodes) and `meas_stim` (channels,), the
    drive of each channel counted from 1, defines its own protocol. `like`: see `jeit.data.formats.table.read`.

    Raises `ValueError` if neither the file nor a description defines the protocol, or if no voltages are found.
    """
    description_source = description if description is not None else find_description(path)
    if description_source is None and like is not None and not recognises(path):
        sensor_description = description_like(like)
    else:
        sensor_description = (
            parse_description({}, path.name) if description_source is None else load_description(description_source)
        )
    sensor_description = (
        sensor_description
        if key is None
        else replace(sensor_description, layout=replace(sensor_description.layout, keys=(key,)))
    )
    stored_patterns = (
        {}
        if sensor_description.protocol_section is not None or (description_source is None and like)
        else matlab.load(path, *PATTERN_NAMES)
    )
    candidate_protocols = sensor_description.protocols(path) or (
        [(_stored_protocol(stored_patterns, path), "")] if stored_patterns else []
    )
    if not candidate_protocols and like is not None:
        candidate_protocols = [(like.protocol, "")]
    array_keys, frame_names, key_notes = _keys_to_read(
        matlab.shapes(path), sensor_description, channel_counts(candidate_protocols), path
    )
    file_variables = matlab.load(path, *array_keys)
    voltage_vectors = [matlab.numbers(file_variables, array_key, path) for array_key in array_keys]
    if voltage_vectors[0].ndim == 3 or sensor_description.patterns_measured:
        if len(voltage_vectors) > 1:
            raise ValueError(f"{path.name}: [data] keys names {len(voltage_vectors)} arrays; give one, of all frames.")
        frame_table = frames_of(voltage_vectors[0], sensor_description.layout.axes, path.name)
        sensor_description = replace(sensor_description, layout=replace(sensor_description.layout, frames_in="rows"))
    elif len(voltage_vectors) == 1:
        frame_table = voltage_vectors[0]
        if 1 in frame_table.shape and frame_table.size in channel_counts(candidate_protocols):  # a vector is one frame
            frame_table = frame_table.reshape(-1, 1)
    else:
        vector_lengths = {voltage_vector.size for voltage_vector in voltage_vectors}
        if len(vector_lengths) > 1:
            raise ValueError(
                f"{path.name}: variables {', '.join(array_keys)} differ in length ({sorted(vector_lengths)})."
            )
        frame_table = np.stack([voltage_vector.ravel() for voltage_vector in voltage_vectors], axis=1)
    # A matrix contains one frame per column, as in EIDORS, unless the number of channels shows that rows are frames.
    frames = frames_in_table(
        frame_table, channel_counts(candidate_protocols), sensor_description.layout, default_axis="columns"
    )
    frames = frames._replace(notes=(*key_notes, *frames.notes))
    measurement = create_measurement_of_frames(path, sensor_description, frames, candidate_protocols, like=like)
    return measurement if measurement.frame_names or not frame_names else replace(measurement, frame_names=frame_names)


def _keys_to_read(
    array_shapes: dict[str, tuple[int, ...]],
    sensor_description: Description,
    allowed_channel_counts: list[int],
    path: Path,
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the names of the arrays to read, the names of their frames, and a note if an array was selected by its
    shape."""
    if sensor_description.layout.keys:
        return sensor_description.layout.keys, (), ()
    reference_names = [name for name in REFERENCE_NAMES if name in array_shapes]
    object_names = [name for name in OBJECT_NAMES if name in array_shapes]
    if reference_names and object_names:
        return (reference_names[0], object_names[0]), ("reference", "object"), ()
    if reference_names or object_names:
        return ((reference_names + object_names)[0],), (), ()
    array_shapes = {name: array_shape for name, array_shape in array_shapes.items() if name not in PATTERN_NAMES}
    fitting_shapes = {
        name: array_shape
        for name, array_shape in array_shapes.items()
        if set(array_shape) & set(allowed_channel_counts) or math.prod(array_shape) in allowed_channel_counts
    }
    if len(fitting_shapes) == 1:
        (name,) = fitting_shapes
        return (name,), (), (f"the frames are those of {name!r}.",)
    refusal_beginning = "as many numbers as a frame's are in" if fitting_shapes else "there are"
    usual_names = ", ".join(REFERENCE_NAMES + OBJECT_NAMES)
    raise ValueError(
        f"{path.name}: none of {usual_names} is there; {refusal_beginning} "
        f"{_shapes_text(fitting_shapes or array_shapes)}. Name the array of frames by key=, or by [data] keys in the "
        "description; --reference-key names that of the reference."
    )


def _shapes_text(array_shapes: dict[str, tuple[int, ...]]) -> str:
    return (
        names_text([f"{name} ({' × '.join(map(str, array_shape))})" for name, array_shape in array_shapes.items()])
        if array_shapes
        else "no numbers"
    )


def _stored_protocol(file_variables: dict, path: Path) -> Protocol:
    missing_keys = [pattern_key for pattern_key in PATTERN_NAMES if pattern_key not in file_variables]
    if missing_keys:
        raise ValueError(
            f"{path.name} does not say what was driven and measured: '{missing_keys[0]}' is missing, and no "
            "description gives a [protocol]. Save stim (L, S), meas (M, L) and meas_stim (M) with the data, "
            "or write a description."
        )
    drive_patterns, measurement_patterns, stimulation_index = (
        matlab.numbers(file_variables, pattern_key, path) for pattern_key in PATTERN_NAMES
    )
    stimulation_index = stimulation_index.ravel()
    if np.any(stimulation_index != np.round(stimulation_index)):
        raise ValueError(f"{path.name}: meas_stim must hold whole numbers, the drive of each measurement, from 1.")
    try:
        return from_channels(
            drive_patterns.T,
            measurement_patterns,
            stimulation_index.astype(int) - 1,
            name=f"{path.stem}, {len(stimulation_index)} channels",
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
