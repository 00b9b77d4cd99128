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
_ELECTRODE_INDEX_KEYS = ("common", "reference", "pairs", "drive_pairs", "measurement_pairs")
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
            _check_protocol_size(len(table.drive), len(table.measurement), table.drive.shape[1], num_channels, origin)
            return protocols.from_matrices(table.drive, table.measurement, table.select, name=table.name)
        if table.kind == "channels":
            return Protocol(**{name: getattr(table, name) for name in PROTOCOL_ARRAYS}, name=table.name)
        if table.kind == "measured":
            return protocol_of_file(table, path)
        if table.kind == "optimal":
            return _optimal_protocol(table, origin)
        return _construct_protocol(table, num_electrodes, path, origin)
    except ValueError as error:
        raise error_with_location(error, origin, "protocol") from None


# Options of protocols that a description may omit, and their possible values; the constructor's default is first.
_OPTION_VALUES = {"driven_electrodes": (False, True), "order": ("rotating", "fixed"), "reciprocal": ("all", "half"),
         "drives": ("distinct", "all")}  # fmt: skip


def protocol_table_variants(table: ProtocolTable) -> list[tuple[ProtocolTable, str]]:
    """Return `table`, then copies of it with different values of the options that `table` does not state. Each table is
    paired with the text that states these options in a description."""
    table_fields = type(table).model_fields
    unspecified_options = [
        name for name in _OPTION_VALUES if name in table_fields and name not in table.model_fields_set
    ]
    unspecified_options = [name for name in unspecified_options if table_fields[name].default in _OPTION_VALUES[name]]
    table_variants = []
    for option_values in product(*(_OPTION_VALUES[name] for name in unspecified_options)):
        changed_options = {
            name: option_value
            for name, option_value in zip(unspecified_options, option_values, strict=True)
            if option_value != table_fields[name].default
        }
        option_assignments = [
            f"{name} = " + ("true" if option_value is True else f'"{option_value}"')
            for name, option_value in changed_options.items()
        ]
        table_variants.append((table.model_copy(update=changed_options), ", ".join(option_assignments)))
    return table_variants


def _construct_protocol(
    protocol_table: ConstructedTable, num_electrodes: int | None, path: Path, file_name: str
) -> Protocol:
    """Call the protocol constructor that the key `kind` of `[protocol]` names."""
    # For a protocol with a reference electrode, `num_boundary` counts only the electrodes on the boundary.
    num_references = 1 if protocol_table.kind == "reference_electrode" else 0
    num_boundary = (
        protocol_table.number
        if num_electrodes is None or protocol_table.number is not None
        else num_electrodes - num_references
    )
    if num_boundary is None:
        raise ValueError("protocol needs 'number' (of electrodes), or a table [electrodes].")
    constructor_options = {
        name: getattr(protocol_table, name) for name in protocol_table.model_fields_set - _NON_OPTION_KEYS
    }
    for name in _ELECTRODE_INDEX_KEYS:
        electrode_indices_of_option = constructor_options.get(name)
        largest_index = None if electrode_indices_of_option is None else int(np.max(electrode_indices_of_option))
        if largest_index is not None and largest_index >= num_boundary + num_references:
            raise ValueError(
                f"protocol.{name} has electrode {largest_index}, and there are {num_boundary + num_references}, "
                f"numbered from 0 to {num_boundary + num_references - 1}."
            )
    _check_protocol_size(*_max_pattern_counts(protocol_table.kind, num_boundary, constructor_options), file_name)
    protocol = getattr(protocols, protocol_table.kind)(
        num_boundary, current=_current_amplitude(protocol_table, path), **constructor_options
    )
    return protocol if protocol_table.name is None else replace(protocol, name=protocol_table.name)


def _optimal_protocol(protocol_table: OptimalTable, file_name: str) -> Protocol:
    num_electrodes = len(protocol_table.transfer)
    _check_protocol_size(num_electrodes, num_electrodes, num_electrodes, num_electrodes**2, file_name)
    current_amplitude = (
        1e-3 if protocol_table.current is None else protocol_table.current * _CURRENT_UNITS[protocol_table.current_unit]
    )
    protocol = protocols.optimal(
        protocol_table.transfer,
        protocol_table.other,
        number=protocol_table.drives,
        power=protocol_table.power,
        measurement=protocol_table.measurement,
        reference=protocol_table.reference,
        current=current_amplitude,
    )
    return protocol if protocol_table.name is None else replace(protocol, name=protocol_table.name)


def _max_pattern_counts(
    protocol_kind: str, num_electrodes: int, constructor_options: dict[str, Any]
) -> tuple[int, int, int, int]:
    """Upper bounds of the numbers of drive patterns, measurement patterns, electrodes and channels of a protocol."""
    if protocol_kind == "two_terminal":
        num_pairs = (
            num_electrodes * (num_electrodes - 1) // 2
            if constructor_options.get("pairs") is None
            else len(constructor_options["pairs"])
        )
        return num_pairs, num_pairs, num_electrodes, num_pairs
    if protocol_kind == "bipolar":
        num_drives, num_measurements = (
            len(constructor_options["drive_pairs"]),
            len(constructor_options["measurement_pairs"]),
        )
        return num_drives, num_measurements, num_electrodes, num_drives * num_measurements
    return num_electrodes, num_electrodes, num_electrodes, num_electrodes**2


def _check_protocol_size(
    num_drives: int, num_measurements: int, num_electrodes: int, num_channels: int, file_name: str
) -> None:
    num_entries = num_electrodes * (num_drives + num_measurements + num_channels)
    check_memory(f"{file_name}: protocol", 8 * _NUM_MEMORY_COPIES * num_entries + _BYTES_PER_CHANNEL * num_channels)


def _current_amplitude(protocol_table: DrivenTable, path: Path) -> float:
    """Amplitude of the drive current in amperes, from `[protocol]` or from the name of the file at `path`."""
    current_unit = _CURRENT_UNITS[protocol_table.current_unit]
    if protocol_table.current_from_name is None:
        assert protocol_table.current is not None
        return protocol_table.current * current_unit
    amplitude = number_in_name(protocol_table.current_from_name, path.name)
    if amplitude is None:
        raise ValueError(
            f"protocol.current_from_name = {protocol_table.current_from_name[:60]!r} finds no current in the name "
            f"{path.name[:60]!r}. Give 'current' instead."
        )
    return amplitude * current_unit


def number_in_name(pattern: str, name: str) -> float | None:
    """Return the first number, such as 30 or 0.5, at the position of {current} in the `pattern`, from the file name
    `name`; * in the pattern matches any text. None if the name does not match the pattern."""
    text_before_number, _, text_after_number = pattern.partition("{current}")
    number_start = 0
    while number_start < len(name):
        number_end = _number_end(name, number_start)
        if (
            number_end > number_start
            and _matches_star_pattern(text_before_number, name[:number_start])
            and _matches_star_pattern(text_after_number, name[number_end:])
        ):
            return float(name[number_start:number_end])
        number_start = max(number_end, number_start + 1)
    return None


def _number_end(text: str, number_start: int) -> int:
    """Index after the last character of the number that begins at index `number_start`."""
    number_end = number_start
    while number_end < len(text) and text[number_end] in "0123456789":
        number_end += 1
    if number_start < number_end < len(text) - 1 and text[number_end] == "." and text[number_end + 1] in "0123456789":
        number_end += 1
        while number_end < len(text) and text[number_end] in "0123456789":
            number_end += 1
    return number_end


def _matches_star_pattern(star_pattern: str, text: str) -> bool:
    """Whether a text matches a pattern in which * matches any text. Each part between two * is matched at its first
    occurrence, so no part is searched for twice."""
    first_pattern_part, *later_pattern_parts = star_pattern.split("*")
    if not later_pattern_parts:
        return star_pattern == text
    *middle_pattern_parts, last_pattern_part = later_pattern_parts
    if not (
        text.startswith(first_pattern_part)
        and text.endswith(last_pattern_part)
        and len(text) >= len(first_pattern_part) + len(last_pattern_part)
    ):
        return False
    search_position, search_end = len(first_pattern_part), len(text) - len(last_pattern_part)
    for middle_pattern_part in middle_pattern_parts:
        match_start = text.find(middle_pattern_part, search_position, search_end)
        if match_start < 0:
            return False
        search_position = match_start + len(middle_pattern_part)
    return True


def protocol_of_file(table: MeasuredTable, path: Path) -> Protocol:
    """The protocol whose currents are stored in the .mat or .npz file at `path`; measurement patterns are also read if
    `table` names their variable.

    Raises `ValueError` if the file or a variable in it does not exist, and if the matrices are not a valid protocol.
    """
    matrix_keys = (table.drive_key,) if table.measurement_key is None else (table.drive_key, table.measurement_key)
    drive_matrix, *measurement_matrices = (
        _checked_matrix(pattern_matrix, matrix_key, path)
        for pattern_matrix, matrix_key in zip(_read_matrices(path, matrix_keys), matrix_keys, strict=True)
    )
    is_transposed = table.patterns_in == "columns"
    drive_matrix, measurement_matrices = (
        (drive_matrix.T, [pattern_matrix.T for pattern_matrix in measurement_matrices])
        if is_transposed
        else (drive_matrix, measurement_matrices)
    )
    check_electrodes(path.name, drive_matrix.shape[1])
    measurement = (
        measurement_matrices[0]
        if measurement_matrices
        else measurement_patterns(drive_matrix.shape[1], table.measurement, table.reference)
    )
    check_memory(f"{path.name}: the protocol", 64 * len(drive_matrix) * len(measurement))
    # Currents measured by an instrument sum to zero only within measurement errors.
    drive_matrix = _subtract_mean_currents(drive_matrix, table.drive_key, path) * _CURRENT_UNITS[table.current_unit]
    measurement_name = table.measurement_key or table.measurement
    name = (
        table.name or f"{len(drive_matrix)} measured currents, {measurement_name}, {drive_matrix.shape[1]} electrodes"
    )
    return from_matrices(drive_matrix, measurement, name=name)


def _read_matrices(path: Path, matrix_keys: tuple[str, ...]) -> list[np.ndarray]:
    if not path.is_file() or path.suffix.lower() not in (".mat", ".npz"):
        raise ValueError(f"kind = 'measured' takes the currents from a .mat or .npz file; {path.name[:60]!r} is none.")
    if path.suffix.lower() == ".mat":
        matrices_by_name = matlab.load(path, *matrix_keys)
        return [matlab.numbers(matrices_by_name, matrix_key, path) for matrix_key in matrix_keys]
    stored_arrays = npz_arrays(path, *matrix_keys)
    missing_keys = [matrix_key for matrix_key in matrix_keys if matrix_key not in stored_arrays]
    if missing_keys:
        raise ValueError(
            f"{path.name}: there is no array '{missing_keys[0][:60]}'; the file has {names_text(stored_arrays[''])}."
        )
    return [stored_arrays[matrix_key] for matrix_key in matrix_keys]


def _checked_matrix(matrix_values: np.ndarray, matrix_key: str, path: Path) -> np.ndarray:
    if matrix_values.ndim != 2 or matrix_values.dtype.kind not in "fiu" or not np.isfinite(matrix_values).all():
        raise ValueError(
            f"{path.name}: '{matrix_key[:60]}' must be a matrix of real numbers, without NaN, a column for every "
            f"pattern; it is {matrix_values.dtype} of shape {matrix_values.shape}."
        )
    return matrix_values.astype(float)


def _subtract_mean_currents(drive_matrix: np.ndarray, matrix_key: str, path: Path) -> np.ndarray:
    """Currents of each drive minus their mean over the electrodes; raises `ValueError` if a mean is not small."""
    net_currents, largest_currents = np.abs(drive_matrix.sum(axis=1)), np.abs(drive_matrix).max(axis=1)
    worst_drive_index = int(np.argmax(net_currents - 0.05 * largest_currents))
    if net_currents[worst_drive_index] > 0.05 * largest_currents[worst_drive_index]:
        raise ValueError(
            f"{path.name}: pattern {worst_drive_index} of '{matrix_key[:60]}' sums to "
            f"{net_currents[worst_drive_index]:.3g}, and its largest current is "
            f"{largest_currents[worst_drive_index]:.3g}: current that goes in must come out. Is there a pattern in "
            "every column? Else say patterns_in = 'rows'."
        )
    return drive_matrix - drive_matrix.mean(axis=1, keepdims=True)
