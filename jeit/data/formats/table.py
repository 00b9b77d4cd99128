"""Reader of plain tables in CSV, text, NPY and NPZ files, with a TOML description."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Inexact

from jeit.arguments import listed
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.description import Description, TableLayout, load_description
from jeit.data.formats.text import (
    Frames,
    frames_in_table,
    frames_in_text,
    read_text,
    rectangle,
    without_cut_line,
)
from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.data.unstated import driven_zeros, fitting_protocol, with_signs
from jeit.files import npy_array, npz_arrays
from jeit.protocol import Protocol

DESCRIPTION = "table (.csv, .txt, .npy, .npz) with a TOML description beside it"
SUFFIXES = (".csv", ".txt", ".dat", ".npy", ".npz")
# Arrays that `write_table` stores in addition to the voltages and the protocol.
_WORDS = ("mask", "protocol_name", "frame_names", "notes", "times")

AXES = ("electrodes", "patterns", "frames")
"""Names of the axes of an array of voltages, in their default order; a description can state another order."""
# Maximum mean of the potentials of a pattern that counts as removed, relative to the largest potential.
_MOST_MEAN = 0.01


def recognises(path: Path) -> bool:
    """True for the suffix of a table."""
    return path.suffix.lower() in SUFFIXES


def find_description(path: Path) -> str | Path | None:
    """The description that belongs to a file: a TOML file of the same name, else `description.toml` in the same folder.

    A CSV table named like the files of the 6 cm tank, with current and frequency (`…_55uA_1000Hz.csv`), is described by
    the bundled "tank6cm" if neither exists. None if there is no description.
    """
    for candidate in (path.with_suffix(".toml"), path.parent / "description.toml"):
        if candidate.is_file():
            return candidate
    if path.suffix.lower() == ".csv" and re.search(r"_[0-9.]+uA_[0-9.]+Hz$", path.stem):
        return "tank6cm"
    return None


def read(
    path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
) -> Measurement:
    """Read a table with the given `description` (path or bundled name), else with the one found beside it, else with
    that of `like`. `key`: name of the array of voltages in an NPZ file.

    `like`: a measurement of the same sensor. For a table without a description, its protocol, electrodes and outline
    are used, and, if it was read from a table, the units and columns in its description. Raises `ValueError` if there
    is no description, or if file and description disagree.
    """
    which = find_description(path) if description is None else description
    if which is not None:
        described = load_description(which)
    elif like is not None:
        described = description_like(like)
    else:
        # A damaged file is named as such: no description helps it.
        _ = _from_numpy(path, ()) if path.suffix.lower() in (".npz", ".npy") else read_text(path)
        raise ValueError(
            f"description: {path.name} is a table of numbers, and nothing says what they mean. Put a description "
            f"beside it, {path.with_suffix('.toml').name} (geometry, electrodes, protocol), or name one; "
            f"`jeit describe {path.name}` finds out what it can, and writes one."
        )
    if key is not None and path.suffix.lower() != ".npz":
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")
    if key is not None:
        described = replace(described, layout=replace(described.layout, keys=(key,)))
    protocols = described.protocols(path) or ([] if like is None else [(like.protocol, "")])
    mask = own = times = None
    if path.suffix.lower() in (".npz", ".npy"):
        arrays = _from_numpy(path, described.layout.keys)
        table, mask = _voltages(arrays, described.layout, path), arrays.get("mask")
        if table.ndim == 3 or described.patterns_measured:
            table = frames_of(table, described.layout.axes, path.name)
        if described.protocol_section is None:
            own = _own_protocol(arrays)
        protocols = protocols if own is None else [(own, "")]
        found = frames_in_table(np.atleast_2d(table), channel_counts(protocols), described.layout)
        described, times = _with_words(described, arrays), _times(arrays, path.name)
    else:
        layout = described.layout
        text = read_text(path, layout.delimiter, layout.skip_rows)
        found = frames_in_text(text, channel_counts(protocols), layout, path.name)
    measurement = measurement_in(path, described, found, protocols, mask, like)
    if times is None or described.layout.averaged or described.layout.frame_rate is not None:
        return measurement
    return replace(measurement, times=times)


Protocols = Sequence[tuple[Protocol, str]]
"""Protocols that may be meant, the described one first, each with what a description would have to say of it."""


def channel_counts(protocols: Protocols) -> list[int]:
    """Numbers of channels of the protocols, the described one's first."""
    return [*dict.fromkeys(one.num_measurements for one, _ in protocols)]


def measurement_in(
    path: Path,
    described: Description,
    found: Frames,
    protocols: Protocols,
    mask: np.ndarray | None = None,
    like: Measurement | None = None,
) -> Measurement:
    """The measurement of frames that were found in a file, with notes on what was found out; arguments as for
    `measurement_from` and `read`."""
    layout = replace(described.layout, frames_in="rows")
    frames = frames_from(found.table, layout, path.name)
    notes = (*described.notes, *found.notes, *part_of(found.table, layout))
    protocol, said = fitting_protocol(frames, protocols, like)
    described = replace(described, layout=layout, notes=(*notes, *said))
    reason = ""
    if protocol is not None and frames.shape[-1] == protocol.num_measurements:
        unread = driven_zeros(frames, protocol)
        if unread.any():
            mask = ~unread if mask is None else np.asarray(mask) & ~unread
            reason = "they read driven electrodes, and are zero in every frame."
    measurement = measurement_from(path, described, frames, protocol, mask)
    if reason:
        notes = [note.replace("excluded by the mask given.", reason) for note in measurement.notes]
        measurement = replace(measurement, notes=tuple(notes))
    if layout.polarity is None:
        measurement = with_signs(measurement, like)
    if found.times is None or layout.averaged or layout.frame_rate is not None:
        return measurement
    return replace(measurement, times=found.times[:: 2 if layout.complex_pairs else 1])


def _without_gains(frames: np.ndarray, protocol: Protocol, described: Description) -> np.ndarray:
    """Frames divided by the gains of their measurement patterns. Raises `ValueError` for another number of these."""
    gains, number = np.array(described.layout.gains), len(protocol.measurement)
    if gains.size not in (0, number):
        raise ValueError(
            f"{described.origin}: [data] gains must be one for each of the {number} measurement patterns of "
            f"'{protocol.name}'; they are {gains.size}."
        )
    if not gains.size or frames.shape[-1] != protocol.num_measurements:
        return frames
    return frames / gains[np.asarray(protocol.measurement_index)]


def description_like(like: Measurement) -> Description:
    """Description that consists of the properties of another measurement of the same sensor, without its protocol and
    frame names."""
    source = Path(like.source)
    beside = find_description(source) if like.source and (recognises(source) or source.suffix == ".mat") else None
    layout = TableLayout() if beside is None else replace(load_description(beside).layout, frame_names=(), keys=())
    return Description(
        origin=f"the description of '{like.name}'",
        title="",
        domain=like.domain,
        electrodes=like.electrodes,
        layout=layout,
        notes=(f"described as '{like.name}' is, for it has no description of its own.",),
        protocol_section=None,
        uncertainty=like.uncertainty,
    )


def measurement_from(
    path: Path, described: Description, frames: np.ndarray, protocol: Protocol | None, mask: np.ndarray | None
) -> Measurement:
    """Screen frames (F, M), in the unit of the file, and scale them as the description states. `protocol`: the one
    stored in the file, or None.

    Raises `ValueError` if there is no protocol, if the number of frame names differs from that of the frames, and as
    `screen`.
    """
    protocol = protocol or described.protocol(path)
    if protocol is None:
        raise ValueError(
            f'{described.origin}: no protocol: add a [protocol] section with kind = "adjacent" or another.'
        )
    notes, frames = described.notes, _without_gains(frames, protocol, described)
    if described.mean_removed and frames.shape[-1] == protocol.num_measurements:
        frames, mean = less_their_mean(np.atleast_2d(frames), protocol.num_electrodes)
        said = f"the potentials had a mean, {mean * described.layout.scale:.3g} V at most; it is subtracted."
        notes = (*notes, said) if mean else notes
    names, number = described.layout.frame_names, len(np.atleast_2d(frames))
    if names and len(names) != number:
        raise ValueError(
            f"{described.origin}: [data] frame_names must be as many as the frames of {path.name}, {number}; they are "
            f"{len(names)}."
        )
    measurement = screen(
        frames * described.layout.scale,
        protocol,
        electrodes=described.electrodes,
        domain=described.domain,
        mask=mask,
        saturation=described.layout.saturation,
        name=path.stem,
        source=str(path),
        frame_names=names,
        notes=notes,
    )
    measurement = replace(measurement, uncertainty=described.uncertainty)
    if described.layout.averaged:
        note = f"the mean of {measurement.num_frames} frames."
        return replace(measurement.mean_frame(), notes=(*measurement.notes, note))
    rate = described.layout.frame_rate
    return measurement if rate is None else measurement.at_rate(rate)


def numbers(path: Path, layout: TableLayout) -> tuple[np.ndarray, tuple[str, ...]]:
    """The numbers of a text or NPY file, arranged as in the file, and the names of its columns in the last line of a
    heading, if it has one. A last line that is cut off is left out.

    Raises `ValueError` if it holds anything but numbers.
    """
    if path.suffix.lower() == ".npy":
        return _voltages(_from_numpy(path, ()), layout, path), ()
    text = without_cut_line(read_text(path, layout.delimiter, layout.skip_rows))
    return rectangle(text, path.name), text.heading


def frames_from(table: np.ndarray, layout: TableLayout, name: str) -> np.ndarray:
    """Frames (F, M), in the unit of the file, of a table laid out as described. Raises `ValueError` for an odd number
    of rows in complex pairs."""
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
        # With the sign of the real part, because a magnitude alone has no direction.
        return np.abs(frames) * np.where(np.real(frames) < 0, -1.0, 1.0)
    return frames if layout.component == "complex" else np.real(frames)


def part_of(values: np.ndarray, layout: TableLayout) -> tuple[str, ...]:
    """A note that states which part of complex voltages is read."""
    if not np.iscomplexobj(values) or layout.component == "complex":
        return ()
    return (f"of complex voltages this is the {layout.component} part; see [data] component.",)


def _from_numpy(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The needed arrays of an NPZ file by name, or the array of an NPY file as "voltages"."""
    try:
        if path.suffix.lower() == ".npy":
            return {"voltages": npy_array(path)}
        return npz_arrays(path, *(keys or ("voltages",)), *PROTOCOL_ARRAYS, *_WORDS)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def _voltages(arrays: dict[str, np.ndarray], layout: TableLayout, path: Path) -> np.ndarray:
    keys = layout.keys if layout.keys and path.suffix.lower() == ".npz" else ("voltages",)
    missing = [key for key in keys if key not in arrays]
    if missing:
        held = listed(sorted(arrays.get("", arrays)))
        raise ValueError(
            f"{path.name}: there is no array '{missing[0]}'; the file has {held}. Name the voltages with [data] keys "
            "in the description."
        )
    for key in keys:
        if arrays[key].dtype.kind not in "biufc":
            raise ValueError(f"{path.name}: '{key}' holds {arrays[key].dtype}; give numbers, in volts.")
    return arrays[keys[0]] if len(keys) == 1 else np.stack([arrays[key].ravel() for key in keys])


def _own_protocol(arrays: dict[str, np.ndarray]) -> Protocol | None:
    """The protocol in a file written by `write_table`; None if the file holds no protocol."""
    if not all(part in arrays for part in PROTOCOL_ARRAYS):
        return None
    name = str(arrays.get("protocol_name", "custom"))
    return Protocol(**{part: arrays[part] for part in PROTOCOL_ARRAYS}, name=name)


def _with_words(described: Description, arrays: dict[str, np.ndarray]) -> Description:
    """The description, completed by frame names (if it has none) and notes from a file written by `write_table`."""
    names = described.layout.frame_names or _texts(arrays, "frame_names")
    notes = (*described.notes, *_texts(arrays, "notes"))
    return replace(described, layout=replace(described.layout, frame_names=names), notes=notes)


def _times(arrays: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    """Times from a file written by `write_table`, or None."""
    times = arrays.get("times")
    if times is not None and times.dtype.kind not in "iuf":
        raise ValueError(f"{name}: 'times' holds {times.dtype}; give seconds.")
    return times


def _texts(arrays: dict[str, np.ndarray], name: str) -> tuple[str, ...]:
    return tuple(str(one) for one in np.ravel(arrays.get(name, np.zeros(0))))


def frames_of(values: np.ndarray, axes: tuple[str, ...], name: str) -> Inexact[np.ndarray, "F M"]:
    """Frames (F, M) of voltages with the given axes, channels ordered drive by drive; an array of two axes is one
    frame.

    Raises `ValueError` for another number of axes.
    """
    named = tuple(axes or AXES)
    if values.ndim == len(named) - 1:
        values = np.expand_dims(values, named.index("frames"))  # MATLAB drops a last axis of length one
    if values.ndim != len(named):
        raise ValueError(f"{name}: the voltages have shape {values.shape}; {', '.join(named)} are {len(named)} axes.")
    ordered = np.transpose(values, [named.index(one) for one in ("frames", "patterns", "electrodes")])
    return ordered.reshape(len(ordered), -1)


def less_their_mean(frames: Inexact[np.ndarray, "F M"], count: int) -> tuple[Inexact[np.ndarray, "F M"], float]:
    """Subtract from the potentials of `count` electrodes the mean of each pattern, if any mean exceeds noise: the
    potentials were then measured against ground or an electrode. Returns the frames and the largest mean, 0 if nothing
    is subtracted. Patterns with NaN are not changed."""
    potentials = frames.reshape(len(frames), -1, count)
    mean = potentials.mean(axis=2, keepdims=True)
    mean = np.where(np.isfinite(mean), mean, 0)
    rest = potentials - mean
    if not (np.abs(mean) > _MOST_MEAN * np.abs(rest).max(axis=2, keepdims=True)).any():
        return frames, 0.0
    return rest.reshape(frames.shape), float(np.abs(mean).max())
