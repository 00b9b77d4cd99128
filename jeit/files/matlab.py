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
_HEADER_BYTES = 128
# Length of the beginning of an element, which contains flags, shape and name, bytes.
_PREFIX_BYTES = 4096
_MATRIX_TYPE, _COMPRESSED_TYPE = 14, 15
# Numbers that identify classes of arrays in the file: the class number of sparse arrays, and, for each class number of
# numeric arrays, the NumPy type.
_SPARSE_CLASS = 5
_NUMERIC_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
# For each type number of stored numbers in the file, the NumPy type; and the flag of complex arrays.
_STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX_FLAG = 0x800
# Maximum size in bytes of one number in memory, and of the parts of an element other than its numbers.
_MAX_NUMBER_BYTES, _MAX_OTHER_BYTES = 16, 2**16


class _Variable(NamedTuple):
    name: str
    shape: tuple[int, ...]
    kind: int
    complex: bool
    numbers_start: int  # where the numbers begin in the uncompressed element
    content: bytes  # the element as stored in the file, without its tag
    is_compressed: bool
    byte_order: str  # byte order: "<" or ">"

    @property
    def size(self) -> int:
        """Maximum memory of the variable in bytes, from its declared shape."""
        return _MAX_NUMBER_BYTES * math.prod(self.shape)


def variable_names(path: Path) -> set[str]:
    """Names of the variables in a .mat file. Raises `ValueError` if the file is not a readable .mat file."""
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):
            return {name for name, _, _ in scipy.io.whosmat(str(path))}
    return {variable.name for variable in _variables(path)}


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the numeric variables in a .mat file, by name. Raises `ValueError` if the file is not a readable .mat
    file."""
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):
            return {name: shape for name, shape, kind in scipy.io.whosmat(str(path)) if kind != "char"}
    return {
        variable.name: variable.shape
        for variable in _variables(path)
        if variable.kind in (_SPARSE_CLASS, *_NUMERIC_CLASSES)
    }


def load(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Read the numeric variables among `names` from a .mat file. Sparse matrices are converted to dense arrays; the key
    "" contains the names of all variables in the file. Other variables are not decompressed.

    Raises `ValueError` if the file cannot be read, and if the variables would not fit in memory (`check_memory`).
    """
    if _is_format_4(path):
        with read_as(_unreadable_message(path)):  # format 4 is never compressed, so a file has fewer numbers than bytes
            content = scipy.io.loadmat(str(path), variable_names=list(names), spmatrix=False)
        return {"": np.array(sorted(variable_names(path)), dtype=str)} | _dense_arrays(content, names)
    variables = _variables(path)
    requested = [
        variable
        for variable in variables
        if variable.name in names and variable.kind in (_SPARSE_CLASS, *_NUMERIC_CLASSES)
    ]
    check_memory(path.name, sum(variable.size for variable in requested))
    with read_as(_unreadable_message(path)):
        values = {variable.name: _values(variable) for variable in requested}
    return {"": np.array(sorted({variable.name for variable in variables}), dtype=str)} | values


def numbers(variables: dict[str, np.ndarray], key: str, path: Path) -> np.ndarray:
    """The numeric variable `key` of a .mat file. Raises `ValueError` if the variable is missing or not numeric."""
    if key not in variables and key in variables[""]:
        raise ValueError(f"{path.name}: variable '{key}' holds other things, not numbers.")
    if key not in variables:
        raise ValueError(f"{path.name}: there is no variable '{key}'; the file has {names_text(variables[''])}.")
    value = variables[key]
    if value.dtype.kind not in "fiuc" or value.size == 0:
        raise ValueError(f"{path.name}: variable '{key}' holds {value.dtype} of shape {value.shape}, not numbers.")
    return value


def _dense_arrays(variables: dict, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays `names` that SciPy read from a .mat file of format 4; sparse matrices are converted to dense arrays."""
    arrays = {name: variables[name] for name in names if name in variables}
    return {name: value.toarray() if hasattr(value, "toarray") else value for name, value in arrays.items()}


def _unreadable_message(path: Path) -> str:
    return f"{path.name} is not a readable .mat file; is it complete?"


def _is_format_4(path: Path) -> bool:
    """Whether a .mat file is of format 4, which begins with a number below 5,000; other formats begin with text. Raises
    `FileTooLargeError` if the file exceeds the memory limit."""
    check_memory(path.name, path.stat().st_size)
    with path.open("rb") as file:
        return 0 in file.read(4)


def _variables(path: Path) -> list[_Variable]:
    """Headers of the variables in a .mat file of format 5. Raises `ValueError` for other formats."""
    data = path.read_bytes()
    if len(data) >= _HEADER_BYTES and (data[:8] == b"\x89HDF\r\n\x1a\n" or 2 in data[124:126]):
        raise ValueError(
            f"{path.name} was saved in MATLAB's version 7.3 (HDF5). Save it again with `save(name, '-v7')`."
        )
    with read_as(_unreadable_message(path)):
        return [*_elements(data)]


def _elements(data: bytes) -> Iterator[_Variable]:
    """Headers of the arrays in a .mat file, in the order of the file; only the beginning of a compressed array is
    decompressed."""
    if len(data) < _HEADER_BYTES or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is of another kind")
    byte_order = "<" if data[126:128] == b"IM" else ">"
    offset = _HEADER_BYTES
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{byte_order}II", data, offset)
        start, is_compressed = offset + 8, kind == _COMPRESSED_TYPE
        if start + size > len(data):
            raise ValueError("it is cut short")
        element = data[start : start + size]
        if is_compressed:
            first_bytes = zlib.decompressobj().decompress(element, _PREFIX_BYTES)
            kind, first_bytes = struct.unpack_from(f"{byte_order}I", first_bytes)[0], first_bytes[8:]
        else:
            first_bytes = element[:_PREFIX_BYTES]
        if kind == _MATRIX_TYPE:
            yield _Variable(*_header(first_bytes, byte_order), element, is_compressed, byte_order)
        offset = start + size


def _header(first_bytes: bytes, byte_order: str) -> tuple[str, tuple[int, ...], int, bool, int]:
    """Read the name, the shape, the class number, whether the array is complex, and the offset of its numbers in bytes,
    from the first three sub-elements of an array in a .mat file."""
    _, flags, offset = _sub_element(first_bytes, 0, byte_order)
    _, shape, offset = _sub_element(first_bytes, offset, byte_order)
    _, name, offset = _sub_element(first_bytes, offset, byte_order)
    flag_bits = struct.unpack_from(f"{byte_order}I", flags)[0]
    lengths = struct.unpack(f"{byte_order}{len(shape) // 4}i", shape)
    if len(lengths) < 2 or any(length < 0 for length in lengths):
        raise ValueError("an array of it has no length, or a negative one")
    return name.decode("latin-1"), lengths, flag_bits & 0xFF, bool(flag_bits & _COMPLEX_FLAG), offset


def _sub_element(data: bytes, offset: int, byte_order: str) -> tuple[int, bytes, int]:
    """Type number and bytes of a sub-element of a .mat file, and the offset of the next sub-element. A sub-element of
    at most four bytes is stored inside its own tag."""
    kind = struct.unpack_from(f"{byte_order}I", data, offset)[0]
    if kind >> 16:
        kind, size, start, next_offset = kind & 0xFFFF, kind >> 16, offset + 4, offset + 8
    else:
        size, start = struct.unpack_from(f"{byte_order}I", data, offset + 4)[0], offset + 8
        next_offset = start + -(-size // 8) * 8
    if start + size > len(data):
        raise ValueError("what it says of an array is cut short, or too long")
    return kind, data[start : start + size], next_offset


def _numbers(data: bytes, offset: int, byte_order: str) -> tuple[np.ndarray, int]:
    """Numbers of a sub-element of a .mat file, and the offset of the next sub-element."""
    kind, raw_bytes, offset = _sub_element(data, offset, byte_order)
    if kind not in _STORED_TYPES:
        raise ValueError(f"an array of it is stored as type {kind}")
    return np.frombuffer(raw_bytes, np.dtype(byte_order + _STORED_TYPES[kind])), offset


def _values(variable: _Variable) -> np.ndarray:
    """The numbers of a variable of a .mat file as an array; a sparse matrix is converted to a dense array."""
    data, offset, byte_order = _decompressed(variable), variable.numbers_start, variable.byte_order
    rows = column_starts = None
    if variable.kind == _SPARSE_CLASS:
        rows, offset = _numbers(data, offset, byte_order)
        column_starts, offset = _numbers(data, offset, byte_order)
    values, offset = _numbers(data, offset, byte_order)
    if variable.complex:
        values = values + 1j * _numbers(data, offset, byte_order)[0]
    if rows is None or column_starts is None:
        values = values.reshape(variable.shape, order="F")
        return values if variable.complex else values.astype(_NUMERIC_CLASSES[variable.kind])
    columns = np.repeat(np.arange(variable.shape[1]), np.diff(column_starts))
    dense = np.zeros(variable.shape, complex if variable.complex else float)
    dense[rows[: len(columns)], columns] = values[: len(columns)]
    return dense


def _decompressed(compressed_element: _Variable) -> bytes:
    """Decompressed content of an element of a .mat file, without its tag. Raises `ValueError` if the content is larger
    than the declared shape implies."""
    if not compressed_element.is_compressed:
        return compressed_element.content
    max_bytes = compressed_element.size + _MAX_OTHER_BYTES
    element = zlib.decompressobj().decompress(compressed_element.content, max_bytes + 1)
    if len(element) > max_bytes:
        raise ValueError(f"'{compressed_element.name[:40]}' is larger than its shape {compressed_element.shape} says")
    return element[8:]
