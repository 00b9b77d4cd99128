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
    protocols = sensor_description.protocols(path) or (
        [(_stored_protocol(stored_patterns, path), "")] if stored_patterns else []
    )
    if not protocols and like is not None:
        protocols = [(like.protocol, "")]
    keys, frame_names, key_notes = _keys(matlab.shapes(path), sensor_description, channel_counts(protocols), path)
    variables = matlab.load(path, *keys)
    vectors = [matlab.numbers(variables, key, path) for key in keys]
    if vectors[0].ndim == 3 or sensor_description.patterns_measured:
        if len(vectors) > 1:
            raise ValueError(f"{path.name}: [data] keys names {len(vectors)} arrays; give one, of all frames.")
        table = frames_of(vectors[0], sensor_description.layout.axes, path.name)
        sensor_description = replace(sensor_description, layout=replace(sensor_description.layout, frames_in="rows"))
    elif len(vectors) == 1:
        table = vectors[0]
        if 1 in table.shape and table.size in channel_counts(protocols):  # a vector is one frame
            table = table.reshape(-1, 1)
    else:
        lengths = {vector.size for vector in vectors}
        if len(lengths) > 1:
            raise ValueError(f"{path.name}: variables {', '.join(keys)} differ in length ({sorted(lengths)}).")
        table = np.stack([vector.ravel() for vector in vectors], axis=1)
    # A matrix contains one frame per column, as in EIDORS, unless the number of channels shows that rows are frames.
    frames = frames_in_table(table, channel_counts(protocols), sensor_description.layout, default_axis="columns")
    frames = frames._replace(notes=(*key_notes, *frames.notes))
    measurement = create_measurement_of_frames(path, sensor_description, frames, protocols, like=like)
    return measurement if measurement.frame_names or not frame_names else replace(measurement, frame_names=frame_names)


def _keys(
    shapes: dict[str, tuple[int, ...]], sensor_description: Description, counts: list[int], path: Path
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the names of the arrays to read, the names of their frames, and a note if an array was selected by its
    shape."""
    if sensor_description.layout.keys:
        return sensor_description.layout.keys, (), ()
    reference_names = [name for name in REFERENCE_NAMES if name in shapes]
    object_names = [name for name in OBJECT_NAMES if name in shapes]
    if reference_names and object_names:
        return (reference_names[0], object_names[0]), ("reference", "object"), ()
    if reference_names or object_names:
        return ((reference_names + object_names)[0],), (), ()
    shapes = {name: shape for name, shape in shapes.items() if name not in PATTERN_NAMES}
    fitting_shapes = {
        name: shape for name, shape in shapes.items() if set(shape) & set(counts) or math.prod(shape) in counts
    }
    if len(fitting_shapes) == 1:
        (name,) = fitting_shapes
        return (name,), (), (f"the frames are those of {name!r}.",)
    refusal_beginning = "as many numbers as a frame's are in" if fitting_shapes else "there are"
    usual_names = ", ".join(REFERENCE_NAMES + OBJECT_NAMES)
    raise ValueError(
        f"{path.name}: none of {usual_names} is there; {refusal_beginning} {_shapes_text(fitting_shapes or shapes)}. "
        "Name the array of frames by key=, or by [data] keys in the description; --reference-key names that of the "
        "reference."
    )


def _shapes_text(shapes: dict[str, tuple[int, ...]]) -> str:
    return (
        names_text([f"{name} ({' × '.join(map(str, shape))})" for name, shape in shapes.items()])
        if shapes
        else "no numbers"
    )


def _stored_protocol(variables: dict, path: Path) -> Protocol:
    missing_keys = [key for key in PATTERN_NAMES if key not in variables]
    if missing_keys:
        raise ValueError(
            f"{path.name} does not say what was driven and measured: '{missing_keys[0]}' is missing, and no "
            "description gives a [protocol]. Save stim (L, S), meas (M, L) and meas_stim (M) with the data, "
            "or write a description."
        )
    stim, meas, stimulation_index = (matlab.numbers(variables, key, path) for key in PATTERN_NAMES)
    stimulation_index = stimulation_index.ravel()
    if np.any(stimulation_index != np.round(stimulation_index)):
        raise ValueError(f"{path.name}: meas_stim must hold whole numbers, the drive of each measurement, from 1.")
    try:
        return from_channels(
            stim.T, meas, stimulation_index.astype(int) - 1, name=f"{path.stem}, {len(stimulation_index)} channels"
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
