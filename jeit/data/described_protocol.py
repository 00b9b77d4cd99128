"""Construction of the protocol that the section `[protocol]` of a description specifies.

Files of systems that drive all electrodes at once contain a matrix of the measured currents, with one column per
current pattern, and voltages indexed by electrode, pattern and frame. They are described by `[protocol] kind =
"measured"`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jeit import protocol as protocols
from jeit.arguments import names_text
from jeit.data.described_body import error_with_location
from jeit.files import check_electrodes, check_memory, matlab, npz_arrays
from jeit.protocol import Protocol, from_matrices, measurement_patterns

if TYPE_CHECKING:
    from jeit.data.description_tables import ConstructedTable, DrivenTable, MeasuredTable, OptimalTable, ProtocolTable

PROTOCOL_ARRAYS = ("drive", "measurement", "drive_index", "measurement_index")
_CURRENT_UNITS = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6}
# Keys of `[protocol]` that are not passed to a constructor as options.
_NON_OPTION_KEYS = {"kind", "number", "name", "current", "current_from_name", "current_unit"}
# Keys of `[protocol]` whose values are indices of electrodes, counted from 0.
_ELECTRODE_KEYS = ("common", "reference", "pairs", "drive_pairs", "measurement_pairs")
# Estimated memory of a protocol: bytes for every channel in addition to its patterns, and number of copies of the
# patterns.
_BYTES_PER_CHANNEL, _NUM_MEMORY_COPIES = 64, 2


def described_protocol(table: ProtocolTable, num_electrodes: int | None, path: Path, origin: str) -> Protocol:
    """The protocol that the section `[protocol]` of a description specifies for the data file at `path`.
    `num_electrodes`: number of electrodes, None if the electrodes are not described.

    Raises `ValueError` if the section is not a valid protocol, or if the protocol would not fit in memory.
    """
    try:
        if table.kind == "matrices":
            num_channels = len(table.drive) * len(table.measurement)
            _check_size(len(table.drive), len(table.measurement), table.drive.shape[1], num_channels, origin)
            return protocols.from_matrices(table.drive, table.measurement, table.select, name=table.name)
        if table.kind == "channels":
            return Protocol(**{name: getattr(table, name) for name in PROTOCOL_ARRAYS}, name=table.name)
        if table.kind == "measured":
            return protocol_of_file(table, path)
        if table.kind == "optimal":
            return _optimal_protocol(table, origin)
        return _construct(table, num_electrodes, path, origin)
    except ValueError as error:
        raise error_with_location(error, origin, "protocol") from None


# Options of protocols that a description may omit, and their possible values; the constructor's default is first.
_OPTION_VALUES = {"driven_electrodes": (False, True), "order": ("rotating", "fixed"), "reciprocal": ("all", "half"),
         "drives": ("distinct", "all")}  # fmt: skip


def protocol_table_variants(table: ProtocolTable) -> list[tuple[ProtocolTable, str]]:
    """Return `table`, then copies of it with different values of the options that `table` does not state. Each table is
    paired with the text that states these options in a description."""
    fields = type(table).model_fields
    open_options = [name for name in _OPTION_VALUES if name in fields and name not in table.model_fields_set]
    open_options = [name for name in open_options if fields[name].default in _OPTION_VALUES[name]]
    table_variants = []
    for values in product(*(_OPTION_VALUES[name] for name in open_options)):
        changed_options = {
            name: value for name, value in zip(open_options, values, strict=True) if value != fields[name].default
        }
        assignments = [
            f"{name} = " + ("true" if value is True else f'"{value}"') for name, value in changed_options.items()
        ]
        table_variants.append((table.model_copy(update=changed_options), ", ".join(assignments)))
    return table_variants


def _construct(table: ConstructedTable, num_electrodes: int | None, path: Path, origin: str) -> Protocol:
    """Call the protocol constructor that the key `kind` of `[protocol]` names."""
    # For a protocol with a reference electrode, `num_boundary` counts only the electrodes on the boundary.
    num_references = 1 if table.kind == "reference_electrode" else 0
    num_boundary = (
        table.number if num_electrodes is None or table.number is not None else num_electrodes - num_references
    )
    if num_boundary is None:
        raise ValueError("protocol needs 'number' (of electrodes), or a table [electrodes].")
    options = {name: getattr(table, name) for name in table.model_fields_set - _NON_OPTION_KEYS}
    for name in _ELECTRODE_KEYS:
        indices = options.get(name)
        largest_index = None if indices is None else int(np.max(indices))
        if largest_index is not None and largest_index >= num_boundary + num_references:
            raise ValueError(
                f"protocol.{name} has electrode {largest_index}, and there are {num_boundary + num_references}, "
                f"numbered from 0 to {num_boundary + num_references - 1}."
            )
    _check_size(*_max_counts(table.kind, num_boundary, options), origin)
    protocol = getattr(protocols, table.kind)(num_boundary, current=_current_amplitude(table, path), **options)
    return protocol if table.name is None else replace(protocol, name=table.name)


def _optimal_protocol(table: OptimalTable, origin: str) -> Protocol:
    num_electrodes = len(table.transfer)
    _check_size(num_electrodes, num_electrodes, num_electrodes, num_electrodes**2, origin)
    current = 1e-3 if table.current is None else table.current * _CURRENT_UNITS[table.current_unit]
    protocol = protocols.optimal(
        table.transfer,
        table.other,
        number=table.drives,
        power=table.power,
        measurement=table.measurement,
        reference=table.reference,
        current=current,
    )
    return protocol if table.name is None else replace(protocol, name=table.name)


def _max_counts(kind: str, num_electrodes: int, options: dict[str, Any]) -> tuple[int, int, int, int]:
    """Upper bounds of the numbers of drive patterns, measurement patterns, electrodes and channels of a protocol."""
    if kind == "two_terminal":
        num_pairs = (
            num_electrodes * (num_electrodes - 1) // 2 if options.get("pairs") is None else len(options["pairs"])
        )
        return num_pairs, num_pairs, num_electrodes, num_pairs
    if kind == "bipolar":
        num_drives, num_measurements = len(options["drive_pairs"]), len(options["measurement_pairs"])
        return num_drives, num_measurements, num_electrodes, num_drives * num_measurements
    return num_electrodes, num_electrodes, num_electrodes, num_electrodes**2


def _check_size(num_drives: int, num_measurements: int, num_electrodes: int, num_channels: int, origin: str) -> None:
    num_entries = num_electrodes * (num_drives + num_measurements + num_channels)
    check_memory(f"{origin}: protocol", 8 * _NUM_MEMORY_COPIES * num_entries + _BYTES_PER_CHANNEL * num_channels)


def _current_amplitude(table: DrivenTable, path: Path) -> float:
    """Amplitude of the drive current in amperes, from `[protocol]` or from the name of the file at `path`."""
    unit = _CURRENT_UNITS[table.current_unit]
    if table.current_from_name is None:
        assert table.current is not None
        return table.current * unit
    amplitude = number_in_name(table.current_from_name, path.name)
    if amplitude is None:
        raise ValueError(
            f"protocol.current_from_name = {table.current_from_name[:60]!r} finds no current in the name "
            f"{path.name[:60]!r}. Give 'current' instead."
        )
    return amplitude * unit


def number_in_name(pattern: str, name: str) -> float | None:
    """Return the first number, such as 30 or 0.5, at the position of {current} in the `pattern`, from the file name
    `name`; * in the pattern matches any text. None if the name does not match the pattern."""
    text_before, _, text_after = pattern.partition("{current}")
    start = 0
    while start < len(name):
        end = _number_end(name, start)
        if end > start and _matches(text_before, name[:start]) and _matches(text_after, name[end:]):
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
    """Whether a text matches a pattern in which * matches any text. Each part between two * is matched at its first
    occurrence, so no part is searched for twice."""
    first_part, *later_parts = pattern.split("*")
    if not later_parts:
        return pattern == text
    *middle_parts, last_part = later_parts
    if not (text.startswith(first_part) and text.endswith(last_part) and len(text) >= len(first_part) + len(last_part)):
        return False
    position, end = len(first_part), len(text) - len(last_part)
    for part in middle_parts:
        match_start = text.find(part, position, end)
        if match_start < 0:
            return False
        position = match_start + len(part)
    return True


def protocol_of_file(table: MeasuredTable, path: Path) -> Protocol:
    """The protocol whose currents are stored in the .mat or .npz file at `path`; measurement patterns are also read if
    `table` names their variable.

    Raises `ValueError` if the file or a variable in it does not exist, and if the matrices are not a valid protocol.
    """
    keys = (table.drive_key,) if table.measurement_key is None else (table.drive_key, table.measurement_key)
    drive, *measurement_matrices = (
        _checked_matrix(matrix, key, path) for matrix, key in zip(_read_matrices(path, keys), keys, strict=True)
    )
    is_transposed = table.patterns_in == "columns"
    drive, measurement_matrices = (
        (drive.T, [matrix.T for matrix in measurement_matrices]) if is_transposed else (drive, measurement_matrices)
    )
    check_electrodes(path.name, drive.shape[1])
    measurement = (
        measurement_matrices[0]
        if measurement_matrices
        else measurement_patterns(drive.shape[1], table.measurement, table.reference)
    )
    check_memory(f"{path.name}: the protocol", 64 * len(drive) * len(measurement))
    # Currents measured by an instrument sum to zero only within measurement errors.
    drive = _subtract_mean_currents(drive, table.drive_key, path) * _CURRENT_UNITS[table.current_unit]
    measurement_name = table.measurement_key or table.measurement
    name = table.name or f"{len(drive)} measured currents, {measurement_name}, {drive.shape[1]} electrodes"
    return from_matrices(drive, measurement, name=name)


def _read_matrices(path: Path, keys: tuple[str, ...]) -> list[np.ndarray]:
    if not path.is_file() or path.suffix.lower() not in (".mat", ".npz"):
        raise ValueError(f"kind = 'measured' takes the currents from a .mat or .npz file; {path.name[:60]!r} is none.")
    if path.suffix.lower() == ".mat":
        matrices_by_name = matlab.load(path, *keys)
        return [matlab.numbers(matrices_by_name, key, path) for key in keys]
    arrays = npz_arrays(path, *keys)
    missing_keys = [key for key in keys if key not in arrays]
    if missing_keys:
        raise ValueError(
            f"{path.name}: there is no array '{missing_keys[0][:60]}'; the file has {names_text(arrays[''])}."
        )
    return [arrays[key] for key in keys]


def _checked_matrix(values: np.ndarray, key: str, path: Path) -> np.ndarray:
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError(
            f"{path.name}: '{key[:60]}' must be a matrix of real numbers, without NaN, a column for every pattern; it "
            f"is {values.dtype} of shape {values.shape}."
        )
    return values.astype(float)


def _subtract_mean_currents(drive: np.ndarray, key: str, path: Path) -> np.ndarray:
    """Currents of each drive minus their mean over the electrodes; raises `ValueError` if a mean is not small."""
    net_currents, largest_currents = np.abs(drive.sum(axis=1)), np.abs(drive).max(axis=1)
    worst_index = int(np.argmax(net_currents - 0.05 * largest_currents))
    if net_currents[worst_index] > 0.05 * largest_currents[worst_index]:
        raise ValueError(
            f"{path.name}: pattern {worst_index} of '{key[:60]}' sums to {net_currents[worst_index]:.3g}, and its "
            f"largest current is {largest_currents[worst_index]:.3g}: current that goes in must come out. Is there a "
            "pattern in every column? Else say patterns_in = 'rows'."
        )
    return drive - drive.mean(axis=1, keepdims=True)
