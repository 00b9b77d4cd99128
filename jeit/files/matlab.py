"""Reader of numeric variables in MATLAB files, with error messages that say what the user can do.

This module decodes numeric arrays of format 5 ("MAT-File Format" by The MathWorks) without SciPy, because crafted files
can crash SciPy's reader. Compressed data are decompressed only up to the size that the file declares.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io

from jeit.arguments import names_text
from jeit.files.limits import check_memory, read_as

# Length of the file header, bytes.
_NUM_HEADER_BYTES = 128
# Length of the beginning of an element, which contains flags, shape and name, bytes.
_NUM_PREFIX_BYTES = 4096
_MATRIX_TYPE, _COMPRESSED_TYPE = 14, 15
# Numbers that identify classes of arrays in the file: the class number of sparse arrays, and, for each class number of
# numeric arrays, the NumPy type.
_SPARSE_CLASS = 5
_NUMERIC_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
# For each type number of stored numbers in the file, the NumPy type; and the flag of complex arrays.
_STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX_FLAG = 0x800
# Maximum size in bytes of one number in memory, and of the parts of an element other than its numbers.
_MAX_BYTES_PER_NUMBER, _MAX_METADATA_BYTES = 16, 2**16


class _Variable(NamedTuple):
    name: str
    shape: tuple[int, ...]
    class_number: int
    is_complex: bool
    numbers_offset: int  # where the numbers begin in the uncompressed element
    element_bytes: bytes  # the element as stored in the file, without its tag
    is_compressed: bool
    byte_order: str  # byte order: "<" or ">"

    @property
    def max_memory_bytes(self) -> int:
        """Maximum memory of the variable in bytes, from its declared shape."""
        return _MAX_BYTES_PER_NUMBER * math.prod(self.shape)


def variable_names(path: Path) -> set[str]:
    """Names of the variables in a .mat file. Raises `ValueError` if the file is not a readable .mat file."""
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):
            return {name for name, _, _ in scipy.io.whosmat(str(path))}
    return {variable.name for variable in _read_variables(path)}


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the numeric variables in a .mat file, by name. Raises `ValueError` if the file is not a readable .mat
    file."""
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):
            return {name: shape for name, shape, matlab_class in scipy.io.whosmat(str(path)) if matlab_class != "char"}
    return {
        variable.name: variable.shape
        for variable in _read_variables(path)
        if variable.class_number in (_SPARSE_CLASS, *_NUMERIC_CLASSES)
    }


def load(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Read the numeric variables among `names` from a .mat file. Sparse matrices are converted to dense arrays; the key
    "" contains the names of all variables in the file. Other variables are not decompressed.

    Raises `ValueError` if the file cannot be read, and if the variables would not fit in memory (`check_memory`).
    """
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):  # format 4 is never compressed, so a file has fewer numbers than bytes
            loaded_arrays = scipy.io.loadmat(str(path), variable_names=list(names), spmatrix=False)
        return {"": np.array(sorted(variable_names(path)), dtype=str)} | _dense_arrays(loaded_arrays, names)
    file_variables = _read_variables(path)
    requested_variables = [
        variable
        for variable in file_variables
        if variable.name in names and variable.class_number in (_SPARSE_CLASS, *_NUMERIC_CLASSES)
    ]
    check_memory(path.name, sum(variable.max_memory_bytes for variable in requested_variables))
    with read_as(_unreadable_message(path)):
        arrays_by_name = {variable.name: _variable_array(variable) for variable in requested_variables}
    return {"": np.array(sorted({variable.name for variable in file_variables}), dtype=str)} | arrays_by_name


def numbers(variables: dict[str, np.ndarray], key: str, path: Path) -> np.ndarray:
    """The numeric variable `key` of a .mat file. Raises `ValueError` if the variable is missing or not numeric."""
    if key not in variables and key in variables[""]:
        raise ValueError(f"{path.name}: variable '{key}' holds other things, not numbers.")
    if key not in variables:
        raise ValueError(f"{path.name}: there is no variable '{key}'; the file has {names_text(variables[''])}.")
    array = variables[key]
    if array.dtype.kind not in "fiuc" or array.size == 0:
        raise ValueError(f"{path.name}: variable '{key}' holds {array.dtype} of shape {array.shape}, not numbers.")
    return array


def _dense_arrays(loaded_arrays: dict, array_names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays `array_names` that SciPy read from a .mat file of format 4; sparse matrices are converted to dense
    arrays."""
    named_arrays = {name: loaded_arrays[name] for name in array_names if name in loaded_arrays}
    return {name: array.toarray() if hasattr(array, "toarray") else array for name, array in named_arrays.items()}


def _unreadable_message(path: Path) -> str:
    return f"{path.name} is not a readable .mat file; is it complete?"


def _is_format_4(path: Path) -> bool:
    """Whether a .mat file is of format 4, which begins with a number below 5,000; other formats begin with text. Raises
    `FileTooLargeError` if the file exceeds the memory limit."""
    check_memory(path.name, path.stat().st_size)
    with path.open("rb") as file:
        return 0 in file.read(4)


def _read_variables(path: Path) -> list[_Variable]:
    """Headers of the variables in a .mat file of format 5. Raises `ValueError` for other formats."""
    file_bytes = path.read_bytes()
    if len(file_bytes) >= _NUM_HEADER_BYTES and (file_bytes[:8] == b"\x89HDF\r\n\x1a\n" or 2 in file_bytes[124:126]):
        raise ValueError(
            f"{path.name} was saved in MATLAB's version 7.3 (HDF5). Save it again with `save(name, '-v7')`."
        )
    with read_as(_unreadable_message(path)):
        return [*_read_variable_headers(file_bytes)]


def _read_variable_headers(file_bytes: bytes) -> Iterator[_Variable]:
    """Headers of the arrays in a .mat file, in the order of the file; only the beginning of a compressed array is
    decompressed."""
    if len(file_bytes) < _NUM_HEADER_BYTES or file_bytes[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is of another kind")
    byte_order = "<" if file_bytes[126:128] == b"IM" else ">"
    byte_offset = _NUM_HEADER_BYTES
    while byte_offset + 8 <= len(file_bytes):
        type_number, num_bytes = struct.unpack_from(f"{byte_order}II", file_bytes, byte_offset)
        content_start, is_compressed = byte_offset + 8, type_number == _COMPRESSED_TYPE
        if content_start + num_bytes > len(file_bytes):
            raise ValueError("it is cut short")
        element_bytes = file_bytes[content_start : content_start + num_bytes]
        if is_compressed:
            first_bytes = zlib.decompressobj().decompress(element_bytes, _NUM_PREFIX_BYTES)
            type_number, first_bytes = struct.unpack_from(f"{byte_order}I", first_bytes)[0], first_bytes[8:]
        else:
            first_bytes = element_bytes[:_NUM_PREFIX_BYTES]
        if type_number == _MATRIX_TYPE:
            yield _Variable(*_parse_variable_header(first_bytes, byte_order), element_bytes, is_compressed, byte_order)
        byte_offset = content_start + num_bytes


def _parse_variable_header(first_bytes: bytes, byte_order: str) -> tuple[str, tuple[int, ...], int, bool, int]:
    """Read the name, the shape, the class number, whether the array is complex, and the offset of its numbers in bytes,
    from the first three sub-elements of an array in a .mat file."""
    _, flag_bytes, byte_offset = _read_sub_element(first_bytes, 0, byte_order)
    _, shape_bytes, byte_offset = _read_sub_element(first_bytes, byte_offset, byte_order)
    _, name_bytes, byte_offset = _read_sub_element(first_bytes, byte_offset, byte_order)
    flag_bits = struct.unpack_from(f"{byte_order}I", flag_bytes)[0]
    axis_lengths = struct.unpack(f"{byte_order}{len(shape_bytes) // 4}i", shape_bytes)
    if len(axis_lengths) < 2 or any(axis_length < 0 for axis_length in axis_lengths):
        raise ValueError("an array of it has no length, or a negative one")
    return name_bytes.decode("latin-1"), axis_lengths, flag_bits & 0xFF, bool(flag_bits & _COMPLEX_FLAG), byte_offset


def _read_sub_element(element_bytes: bytes, byte_offset: int, byte_order: str) -> tuple[int, bytes, int]:
    """Type number and bytes of a sub-element of a .mat file, and the offset of the next sub-element. A sub-element of
    at most four bytes is stored inside its own tag."""
    type_number = struct.unpack_from(f"{byte_order}I", element_bytes, byte_offset)[0]
    if type_number >> 16:
        type_number, num_bytes, content_start, next_offset = (
            type_number & 0xFFFF,
            type_number >> 16,
            byte_offset + 4,
            byte_offset + 8,
        )
    else:
        num_bytes, content_start = (
            struct.unpack_from(f"{byte_order}I", element_bytes, byte_offset + 4)[0],
            byte_offset + 8,
        )
        next_offset = content_start + -(-num_bytes // 8) * 8
    if content_start + num_bytes > len(element_bytes):
        raise ValueError("what it says of an array is cut short, or too long")
    return type_number, element_bytes[content_start : content_start + num_bytes], next_offset


def _read_numbers(element_bytes: bytes, byte_offset: int, byte_order: str) -> tuple[np.ndarray, int]:
    """Numbers of a sub-element of a .mat file, and the offset of the next sub-element."""
    type_number, raw_bytes, byte_offset = _read_sub_element(element_bytes, byte_offset, byte_order)
    if type_number not in _STORED_TYPES:
        raise ValueError(f"an array of it is stored as type {type_number}")
    return np.frombuffer(raw_bytes, np.dtype(byte_order + _STORED_TYPES[type_number])), byte_offset


def _variable_array(variable: _Variable) -> np.ndarray:
    """The numbers of a variable of a .mat file as an array; a sparse matrix is converted to a dense array."""
    element_bytes, byte_offset, byte_order = _decompress_element(variable), variable.numbers_offset, variable.byte_order
    row_indices = column_starts = None
    if variable.class_number == _SPARSE_CLASS:
        row_indices, byte_offset = _read_numbers(element_bytes, byte_offset, byte_order)
        column_starts, byte_offset = _read_numbers(element_bytes, byte_offset, byte_order)
    stored_numbers, byte_offset = _read_numbers(element_bytes, byte_offset, byte_order)
    if variable.is_complex:
        stored_numbers = stored_numbers + 1j * _read_numbers(element_bytes, byte_offset, byte_order)[0]
    if row_indices is None or column_starts is None:
        stored_numbers = stored_numbers.reshape(variable.shape, order="F")
        return stored_numbers if variable.is_complex else stored_numbers.astype(_NUMERIC_CLASSES[variable.class_number])
    column_indices = np.repeat(np.arange(variable.shape[1]), np.diff(column_starts))
    dense_matrix = np.zeros(variable.shape, complex if variable.is_complex else float)
    dense_matrix[row_indices[: len(column_indices)], column_indices] = stored_numbers[: len(column_indices)]
    return dense_matrix


def _decompress_element(compressed_variable: _Variable) -> bytes:
    """Decompressed content of an element of a .mat file, without its tag. Raises `ValueError` if the content is larger
    than the declared shape implies."""
    if not compressed_variable.is_compressed:
        return compressed_variable.element_bytes
    max_bytes = compressed_variable.max_memory_bytes + _MAX_METADATA_BYTES
    element_bytes = zlib.decompressobj().decompress(compressed_variable.element_bytes, max_bytes + 1)
    if len(element_bytes) > max_bytes:
        raise ValueError(f"'{compressed_variable.name[:40]}' is larger than its shape {compressed_variable.shape} says")
    return element_bytes[8:]
