"""Reader of plain tables in CSV, text, NPY and NPZ files, with a TOML description."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from jeit.arguments import listed
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.description import Description, TableLayout, load_description
from jeit.data.measured_patterns import frames_of, less_their_mean
from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.files import check_memory, npy_array, npz_arrays
from jeit.protocol import Protocol

DESCRIPTION = "table (.csv, .txt, .npy, .npz) with a TOML description beside it"
SUFFIXES = (".csv", ".txt", ".dat", ".npy", ".npz")
# Arrays that `write_table` stores in addition to the voltages and the protocol.
_WORDS = ("mask", "protocol_name", "frame_names", "notes", "times")
# Bytes of memory per byte of text: a number may take two characters, and is held twice, as rows and as the table.
_IN_MEMORY = 8
_SET = "Set [data] delimiter and skip_rows in the description, if it is a heading or cells are separated otherwise."


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


def read(path: Path, description: str | Path | None = None, like: Measurement | None = None) -> Measurement:
    """Read a table with the given `description` (path or bundled name), else with the one found beside it, else with
    that of `like`.

    `like`: a measurement of the same sensor. For a table without a description, its protocol, electrodes and outline
    are used, and, if it was read from a table, the units and columns in its description. Raises `ValueError` if there
    is no description, or if file and description disagree.
    """
    which = find_description(path) if description is None else description
    if which is not None:
        described = load_description(which)
    elif like is not None:
        described = _description_like(like)
    else:
        raise ValueError(
            f"description: {path.name} is a table of numbers, and nothing says what they mean. Put a description "
            f"beside it, {path.with_suffix('.toml').name} (geometry, electrodes, protocol), or name one."
        )
    if path.suffix.lower() in (".npz", ".npy"):
        arrays = _from_numpy(path, described.layout.keys)
        table, mask, protocol = _voltages(arrays, described.layout, path), arrays.get("mask"), None
        if table.ndim == 3 or described.patterns_measured:
            table = frames_of(table, described.layout.axes, path.name)
        if described.protocol_section is None:
            protocol = _own_protocol(arrays)
        described, times = _with_words(described, arrays), _times(arrays, path.name)
    else:
        table, mask, protocol, times = _from_text(path, described.layout), None, None, None
    if which is None and like is not None:
        protocol = protocol or like.protocol
    frames = frames_from(table, described.layout, path.name)
    described = replace(described, notes=(*described.notes, *part_of(table, described.layout)))
    measurement = measurement_from(path, described, frames, protocol, mask)
    if times is None or described.layout.averaged or described.layout.frame_rate is not None:
        return measurement
    return replace(measurement, times=times)


def _description_like(like: Measurement) -> Description:
    """Description that consists of the properties of another measurement of the same sensor, without its protocol and
    frame names."""
    beside = find_description(Path(like.source)) if like.source and recognises(Path(like.source)) else None
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
    notes = described.notes
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


def numbers(path: Path, layout: TableLayout) -> np.ndarray:
    """The numbers of a text or NPY file, arranged as in the file. Raises `ValueError` if it holds anything but
    numbers."""
    if path.suffix.lower() == ".npy":
        return _voltages(_from_numpy(path, ()), layout, path)
    return _from_text(path, layout)


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


def _from_text(path: Path, layout: TableLayout) -> np.ndarray:
    delimiter = None if layout.delimiter.strip() == "" and layout.delimiter != "\t" else layout.delimiter
    check_memory(path.name, _IN_MEMORY * path.stat().st_size)
    numbers, length = array("d"), 0
    for number, line in enumerate(_lines(path), start=1):
        if number <= layout.skip_rows or not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = line.split(delimiter)
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            raise ValueError(f"{path.name}, line {number}{_no_number(cells, delimiter, first=not length)}") from None
        length = length or len(row)
        if len(row) != length:
            raise ValueError(
                f"{path.name}, line {number} has length {len(row)}, the first {length}. Is the file cut off?"
            )
        numbers.extend(row)
    if not numbers:
        raise ValueError(f"{path.name} holds no numbers.")
    return np.array(numbers).reshape(-1, length)


def _no_number(cells: list[str], delimiter: str | None, *, first: bool) -> str:
    """Error message for a line whose cells are not all numbers. `first`: whether no line of numbers precedes it."""
    wrong = [k for k, cell in enumerate(cells) if not _is_number(cell)]
    cell = cells[wrong[0]].strip()
    said = f"{cell[:40]!r} is no number" if cell else "nothing stands there"
    if len(cells) == 1:
        return f": {said}, nor numbers separated by {delimiter or 'spaces'!r}. {_SET}"
    # A heading consists mostly of words.
    other = f" {_SET}" if first and 2 * len(wrong) > len(cells) else ""
    return f", column {wrong[0] + 1}: {said}; where a value is missing write nan.{other}"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _lines(path: Path) -> Iterator[str]:
    """Lines of a text file."""
    try:
        with path.open(encoding="utf-8") as file:
            yield from file
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not a text file. If it is a spreadsheet, export it as CSV.") from None


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
