"""Reader of EIDORS-style voltage vectors in a .mat file.

The protocol is stored in the file (`stim`, `meas`, `meas_stim`), or given by `[protocol]` of a description. For a
description, note that EIDORS drives -I at the first electrode of a pair and +I at the second, and measures first minus
second, so that adjacent data are positive: set `polarity = "reversed"`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from jeit.arguments import listed
from jeit.data.description import Description, load_description, parse_description
from jeit.data.formats import _matlab
from jeit.data.formats.table import frames_from, measurement_from, part_of
from jeit.data.measured_patterns import frames_of
from jeit.data.measurement import Measurement
from jeit.protocol import Protocol, from_channels

DESCRIPTION = "EIDORS-style vectors (.mat with stim, meas, meas_stim, or any with a TOML description)"
PATTERN = ("stim", "meas", "meas_stim")
# Usual names of the homogeneous (reference) vectors and of the inhomogeneous vectors.
REFERENCE_NAMES = ("v_h", "vh")
OBJECT_NAMES = ("v_i", "vi")


def recognises(path: Path) -> bool:
    """True for a .mat file that holds stimulation and measurement patterns."""
    return path.suffix.lower() == ".mat" and set(PATTERN) <= _matlab.variable_names(path)


def find_description(path: Path) -> Path | None:
    """The description beside a file, or None: a TOML file of the same name, or `description.toml` in the same folder if
    the file holds no patterns of its own."""
    beside, common = path.with_suffix(".toml"), path.parent / "description.toml"
    if beside.is_file():
        return beside
    return common if common.is_file() and not recognises(path) else None


def read(path: Path, description: str | Path | None = None) -> Measurement:
    """Read the vectors named by `[data] keys` of the description, or by default the variables vh, vi, v_h, v_i.

    A file with `stim` (L, S) in amperes, `meas` (M, L) and `meas_stim` (M,), counted from 1, defines its own protocol.

    Raises `ValueError` if neither the file nor a description defines the protocol, or if no vector is found.
    """
    which = description if description is not None else find_description(path)
    described = parse_description({}, path.name) if which is None else load_description(which)
    keys, names = _keys(_matlab.variable_names(path), described, path)
    content = _matlab.load(path, *keys, *PATTERN)
    vectors = [_matlab.numbers(content, key, path) for key in keys]
    if vectors[0].ndim == 3 or described.patterns_measured:
        if len(vectors) > 1:
            raise ValueError(f"{path.name}: [data] keys names {len(vectors)} arrays; give one, of all frames.")
        table = frames_of(vectors[0], described.layout.axes, path.name)
    elif len(vectors) == 1:
        # A vector is one frame, whether a row or a column; a matrix holds one frame per column, as in EIDORS.
        table = vectors[0].reshape(1, -1) if 1 in vectors[0].shape else vectors[0].T
    else:
        lengths = {vector.size for vector in vectors}
        if len(lengths) > 1:
            raise ValueError(f"{path.name}: variables {', '.join(keys)} differ in length ({sorted(lengths)}).")
        table = np.stack([vector.ravel() for vector in vectors])
    protocol = None
    if described.protocol_section is None:
        protocol = _own_protocol(content, path)
    frames = frames_from(table, described.layout, path.name)
    described = replace(described, notes=(*described.notes, *part_of(table, described.layout)))
    measurement = measurement_from(path, described, frames, protocol, None)
    return measurement if measurement.frame_names or not names else replace(measurement, frame_names=names)


def _keys(content: set[str], described: Description, path: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if described.layout.keys:
        return described.layout.keys, ()
    reference = [name for name in REFERENCE_NAMES if name in content]
    objects = [name for name in OBJECT_NAMES if name in content]
    if reference and objects:
        return (reference[0], objects[0]), ("reference", "object")
    if reference or objects:
        return ((reference + objects)[0],), ()
    raise ValueError(
        f"{path.name}: none of {', '.join(REFERENCE_NAMES + OBJECT_NAMES)} is there; the file has "
        f'{listed(sorted(content))}. Name the voltages in a description: [data] keys = ["..."].'
    )


def _own_protocol(content: dict, path: Path) -> Protocol:
    missing = [key for key in PATTERN if key not in content]
    if missing:
        raise ValueError(
            f"{path.name} does not say what was driven and measured: '{missing[0]}' is missing, and no "
            "description gives a [protocol]. Save stim (L, S), meas (M, L) and meas_stim (M) with the data, "
            "or write a description."
        )
    stim, meas, index = (_matlab.numbers(content, key, path) for key in PATTERN)
    index = index.ravel()
    if np.any(index != np.round(index)):
        raise ValueError(f"{path.name}: meas_stim must hold whole numbers, the drive of each measurement, from 1.")
    try:
        return from_channels(stim.T, meas, index.astype(int) - 1, name=f"{path.stem}, {len(index)} channels")
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
