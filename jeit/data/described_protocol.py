"""Construction of the protocol that the section `[protocol]` of a description specifies.

Systems that drive all electrodes at once publish a matrix of the measured currents, with one column per pattern, beside
voltages indexed by electrode, pattern and frame: `[protocol] kind = "measured"`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jeit import protocol as protocols
from jeit.arguments import listed
from jeit.data.described_body import located
from jeit.files import check_electrodes, check_memory, matlab, npz_arrays
from jeit.protocol import Protocol, from_matrices, measurement_patterns

if TYPE_CHECKING:
    from jeit.data.description_tables import ConstructedTable, DrivenTable, MeasuredTable, OptimalTable, ProtocolTable

PROTOCOL_ARRAYS = ("drive", "measurement", "drive_index", "measurement_index")
_CURRENT_UNITS = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6}
# Keys that are not passed to a constructor as options.
_COMMON = {"kind", "number", "name", "current", "current_from_name", "current_unit"}
# Keys whose values are indices of electrodes, from 0.
_NUMBERING = ("common", "reference", "pairs", "drive_pairs", "measurement_pairs")
# Estimated memory of a protocol in use: bytes for every channel in addition to its pattern, and number of copies of the
# patterns.
_CHANNEL, _COPIES = 64, 2


def described_protocol(table: ProtocolTable, num_electrodes: int | None, path: Path, origin: str) -> Protocol:
    """The protocol of a table `[protocol]` for the file at `path`. `num_electrodes`: number of electrodes, None if they
    are not described.

    Raises `ValueError` if the table is not a valid protocol, or if the protocol would not fit in memory.
    """
    try:
        if table.kind == "matrices":
            channels = len(table.drive) * len(table.measurement)
            _check_size(len(table.drive), len(table.measurement), table.drive.shape[1], channels, origin)
            return protocols.from_matrices(table.drive, table.measurement, table.select, name=table.name)
        if table.kind == "channels":
            return Protocol(**{part: getattr(table, part) for part in PROTOCOL_ARRAYS}, name=table.name)
        if table.kind == "measured":
            return protocol_of_file(table, path)
        if table.kind == "optimal":
            return _optimal(table, origin)
        return _construct(table, num_electrodes, path, origin)
    except ValueError as error:
        raise located(error, origin, "protocol") from None


# Options that a description may leave out, and their values: those of the constructors first.
_OPEN = {"driven_electrodes": (False, True), "order": ("rotating", "fixed"), "reciprocal": ("all", "half"),
         "drives": ("distinct", "all")}  # fmt: skip


def variants(table: ProtocolTable) -> list[tuple[ProtocolTable, str]]:
    """The table, and with other values of the options that it does not state, each with these in the words of a
    description."""
    fields = type(table).model_fields
    left = [name for name in _OPEN if name in fields and name not in table.model_fields_set]
    left = [name for name in left if fields[name].default in _OPEN[name]]
    found = []
    for values in product(*(_OPEN[name] for name in left)):
        changed = {name: one for name, one in zip(left, values, strict=True) if one != fields[name].default}
        said = [f"{name} = " + ("true" if one is True else f'"{one}"') for name, one in changed.items()]
        found.append((table.model_copy(update=changed), ", ".join(said)))
    return found


def _construct(table: ConstructedTable, num_electrodes: int | None, path: Path, origin: str) -> Protocol:
    """The protocol made by the constructor that `kind` names."""
    # For a protocol with a reference electrode, `number` counts only the electrodes on the boundary.
    apart = 1 if table.kind == "reference_electrode" else 0
    number = table.number if num_electrodes is None or table.number is not None else num_electrodes - apart
    if number is None:
        raise ValueError("protocol needs 'number' (of electrodes), or a table [electrodes].")
    options = {name: getattr(table, name) for name in table.model_fields_set - _COMMON}
    for name in _NUMBERING:
        given = options.get(name)
        largest = None if given is None else int(np.max(given))
        if largest is not None and largest >= number + apart:
            raise ValueError(
                f"protocol.{name} has electrode {largest}, and there are {number + apart}, numbered from 0 to "
                f"{number + apart - 1}."
            )
    _check_size(*_counts(table.kind, number, options), origin)
    made = getattr(protocols, table.kind)(number, current=_current(table, path), **options)
    return made if table.name is None else replace(made, name=table.name)


def _optimal(table: OptimalTable, origin: str) -> Protocol:
    count = len(table.transfer)
    _check_size(count, count, count, count**2, origin)
    current = 1e-3 if table.current is None else table.current * _CURRENT_UNITS[table.current_unit]
    made = protocols.optimal(
        table.transfer,
        table.other,
        number=table.drives,
        power=table.power,
        measurement=table.measurement,
        reference=table.reference,
        current=current,
    )
    return made if table.name is None else replace(made, name=table.name)


def _counts(kind: str, number: int, options: dict[str, Any]) -> tuple[int, int, int, int]:
    """Upper bounds of the numbers of drive patterns, measurement patterns, electrodes and channels of a protocol."""
    if kind == "two_terminal":
        pairs = number * (number - 1) // 2 if options.get("pairs") is None else len(options["pairs"])
        return pairs, pairs, number, pairs
    if kind == "bipolar":
        drives, measurements = len(options["drive_pairs"]), len(options["measurement_pairs"])
        return drives, measurements, number, drives * measurements
    return number, number, number, number**2


def _check_size(drives: int, measurements: int, number: int, channels: int, origin: str) -> None:
    patterns = number * (drives + measurements + channels)
    check_memory(f"{origin}: protocol", 8 * _COPIES * patterns + _CHANNEL * channels)


def _current(table: DrivenTable, path: Path) -> float:
    """Amplitude of the current in amperes."""
    unit = _CURRENT_UNITS[table.current_unit]
    if table.current_from_name is None:
        assert table.current is not None
        return table.current * unit
    found = number_in_name(table.current_from_name, path.name)
    if found is None:
        raise ValueError(
            f"protocol.current_from_name = {table.current_from_name[:60]!r} finds no current in the name "
            f"{path.name[:60]!r}. Give 'current' instead."
        )
    return found * unit


def number_in_name(pattern: str, name: str) -> float | None:
    """The first number, such as 30 or 0.5, in a file `name` at the place where the `pattern` has {current}; * in the
    pattern matches any text. None if the name does not match."""
    before, _, after = pattern.partition("{current}")
    start = 0
    while start < len(name):
        end = _number_end(name, start)
        if end > start and _matches(before, name[:start]) and _matches(after, name[end:]):
            return float(name[start:end])
        start = max(end, start + 1)
    return None


def _number_end(text: str, start: int) -> int:
    """Index after the last character of the number that begins at index `start`."""
    end = start
    while end < len(text) and text[end] in "0123456789":
        end += 1
    if start < end < len(text) - 1 and text[end] == "." and text[end + 1] in "0123456789":
        end += 1
        while end < len(text) and text[end] in "0123456789":
            end += 1
    return end


def _matches(pattern: str, text: str) -> bool:
    """Whether a text matches a pattern in which * stands for any text. Each part is matched at its earliest place, so
    no part is searched for twice."""
    first, *others = pattern.split("*")
    if not others:
        return pattern == text
    *middle, last = others
    if not (text.startswith(first) and text.endswith(last) and len(text) >= len(first) + len(last)):
        return False
    place, end = len(first), len(text) - len(last)
    for part in middle:
        found = text.find(part, place, end)
        if found < 0:
            return False
        place = found + len(part)
    return True


def protocol_of_file(table: MeasuredTable, path: Path) -> Protocol:
    """The protocol whose currents, and measurement patterns if named, are stored in the .mat or .npz file at `path`.

    Raises `ValueError` if the file or a variable does not exist, and if the matrices are not a valid protocol.
    """
    keys = (table.drive_key,) if table.measurement_key is None else (table.drive_key, table.measurement_key)
    drive, *own = (_matrix(one, key, path) for one, key in zip(_read(path, keys), keys, strict=True))
    turned = table.patterns_in == "columns"
    drive, own = (drive.T, [one.T for one in own]) if turned else (drive, own)
    check_electrodes(path.name, drive.shape[1])
    rows = own[0] if own else measurement_patterns(drive.shape[1], table.measurement, table.reference)
    check_memory(f"{path.name}: the protocol", 64 * len(drive) * len(rows))
    # Currents measured by an instrument sum to zero only within its errors.
    drive = _balanced(drive, table.drive_key, path) * _CURRENT_UNITS[table.current_unit]
    read = table.measurement_key or table.measurement
    name = table.name or f"{len(drive)} measured currents, {read}, {drive.shape[1]} electrodes"
    return from_matrices(drive, rows, name=name)


def _read(path: Path, keys: tuple[str, ...]) -> list[np.ndarray]:
    if not path.is_file() or path.suffix.lower() not in (".mat", ".npz"):
        raise ValueError(f"kind = 'measured' takes the currents from a .mat or .npz file; {path.name[:60]!r} is none.")
    if path.suffix.lower() == ".mat":
        content = matlab.load(path, *keys)
        return [matlab.numbers(content, key, path) for key in keys]
    arrays = npz_arrays(path, *keys)
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise ValueError(f"{path.name}: there is no array '{missing[0][:60]}'; the file has {listed(arrays[''])}.")
    return [arrays[key] for key in keys]


def _matrix(values: np.ndarray, key: str, path: Path) -> np.ndarray:
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError(
            f"{path.name}: '{key[:60]}' must be a matrix of real numbers, without NaN, a column for every pattern; it "
            f"is {values.dtype} of shape {values.shape}."
        )
    return values.astype(float)


def _balanced(drive: np.ndarray, key: str, path: Path) -> np.ndarray:
    """Currents minus their mean; raises `ValueError` if the mean is not small."""
    excess, size = np.abs(drive.sum(axis=1)), np.abs(drive).max(axis=1)
    worst = int(np.argmax(excess - 0.05 * size))
    if excess[worst] > 0.05 * size[worst]:
        raise ValueError(
            f"{path.name}: pattern {worst} of '{key[:60]}' sums to {excess[worst]:.3g}, and its largest current is "
            f"{size[worst]:.3g}: current that goes in must come out. Is there a pattern in every column? Else say "
            "patterns_in = 'rows'."
        )
    return drive - drive.mean(axis=1, keepdims=True)
