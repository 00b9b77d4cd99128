"""Reader of numeric variables in MATLAB files, with error messages that say what to do.

Numeric arrays of format 5 ("MAT-File Format" by The MathWorks) are decoded here instead of by SciPy, whose reader can
be crashed by crafted files. Nothing is decompressed beyond the size that the file declares.
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

from jeit.arguments import listed
from jeit.files.limits import check_memory, read_as

# Length in bytes of the file header, and of the beginning of an element, which holds flags, shape and name; type
# numbers of elements.
_HEADER, _BEGINNING = 128, 4096
_MATRIX, _COMPRESSED = 14, 15
# Class numbers of arrays in the file: of sparse arrays, and of numeric arrays with their NumPy types.
_SPARSE = 5
_NUMERIC = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
# NumPy types of stored numbers by their type number in the file; flag of complex arrays.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX = 0x800
# Maximum number of bytes of one number in memory, and of everything else in an element.
_BYTES, _BESIDE = 16, 2**16


class _Variable(NamedTuple):
    name: str
    shape: tuple[int, ...]
    kind: int
    complex: bool
    begin: int  # where the numbers begin in the uncompressed element
    content: bytes  # the element as stored in the file, without its tag
    packed: bool
    order: str  # byte order: "<" or ">"

    @property
    def size(self) -> int:
        """Maximum memory of the variable in bytes, from its declared shape."""
        return _BYTES * math.prod(self.shape)


def variable_names(path: Path) -> set[str]:
    """Names of the variables in a .mat file. Raises `ValueError` when it is not a readable .mat file."""
    if _is_format_4(path):
        with read_as(_unreadable(path)):
            return {name for name, _, _ in scipy.io.whosmat(str(path))}
    return {one.name for one in _variables(path)}


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the numeric variables in a .mat file, by name. Raises `ValueError` as `variable_names`."""
    if _is_format_4(path):
        with read_as(_unreadable(path)):
            return {name: shape for name, shape, kind in scipy.io.whosmat(str(path)) if kind != "char"}
    return {one.name: one.shape for one in _variables(path) if one.kind in (_SPARSE, *_NUMERIC)}


def load(path: Path, *wanted: str) -> dict[str, np.ndarray]:
    """Read the numeric ones of the variables `wanted`, by name. Sparse matrices are converted to dense arrays; the key
    "" holds the names of all variables in the file. Other variables are not unpacked.

    Raises `ValueError` if the file cannot be read, and if the variables would not fit in memory (`check_memory`).
    """
    if _is_format_4(path):
        with read_as(_unreadable(path)):  # format 4 is never compressed, so it holds fewer numbers than bytes
            read = scipy.io.loadmat(str(path), variable_names=list(wanted), spmatrix=False)
        return {"": np.array(sorted(variable_names(path)), dtype=str)} | _plain(read, wanted)
    held = _variables(path)
    asked = [one for one in held if one.name in wanted and one.kind in (_SPARSE, *_NUMERIC)]
    check_memory(path.name, sum(one.size for one in asked))
    with read_as(_unreadable(path)):
        values = {one.name: _values(one) for one in asked}
    return {"": np.array(sorted({one.name for one in held}), dtype=str)} | values


def numbers(content: dict[str, np.ndarray], key: str, path: Path) -> np.ndarray:
    """The numeric variable `key`. Raises `ValueError` if it is missing or not numeric."""
    if key not in content and key in content[""]:
        raise ValueError(f"{path.name}: variable '{key}' holds other things, not numbers.")
    if key not in content:
        raise ValueError(f"{path.name}: there is no variable '{key}'; the file has {listed(content[''])}.")
    value = content[key]
    if value.dtype.kind not in "fiuc" or value.size == 0:
        raise ValueError(f"{path.name}: variable '{key}' holds {value.dtype} of shape {value.shape}, not numbers.")
    return value


def _plain(read: dict, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays that SciPy read from a file of format 4, with sparse matrices converted to dense arrays."""
    found = {name: read[name] for name in wanted if name in read}
    return {name: value.toarray() if hasattr(value, "toarray") else value for name, value in found.items()}


def _unreadable(path: Path) -> str:
    return f"{path.name} is not a readable .mat file; is it complete?"


def _is_format_4(path: Path) -> bool:
    """Whether a file is of format 4, which begins with a number below 5,000, where other formats begin with text.
    Raises `TooLarge`."""
    check_memory(path.name, path.stat().st_size)
    with path.open("rb") as file:
        return 0 in file.read(4)


def _variables(path: Path) -> list[_Variable]:
    """Headers of the variables in a file of format 5. Raises `ValueError` for other formats."""
    content = path.read_bytes()
    if len(content) >= _HEADER and (content[:8] == b"\x89HDF\r\n\x1a\n" or 2 in content[124:126]):
        raise ValueError(
            f"{path.name} was saved in MATLAB's version 7.3 (HDF5). Save it again with `save(name, '-v7')`."
        )
    with read_as(_unreadable(path)):
        return [*_elements(content)]


def _elements(content: bytes) -> Iterator[_Variable]:
    """Headers of the arrays in the file, in their order; of compressed arrays only the beginning is decompressed."""
    if len(content) < _HEADER or content[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is of another kind")
    order = "<" if content[126:128] == b"IM" else ">"
    place = _HEADER
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        start, packed = place + 8, kind == _COMPRESSED
        if start + size > len(content):
            raise ValueError("it is cut short")
        element = content[start : start + size]
        if packed:
            beginning = zlib.decompressobj().decompress(element, _BEGINNING)
            kind, beginning = struct.unpack_from(f"{order}I", beginning)[0], beginning[8:]
        else:
            beginning = element[:_BEGINNING]
        if kind == _MATRIX:
            yield _Variable(*_header(beginning, order), element, packed, order)
        place = start + size


def _header(beginning: bytes, order: str) -> tuple[str, tuple[int, ...], int, bool, int]:
    """Name, shape, class, whether complex, and offset of the numbers, read from the first three sub-elements of an
    array."""
    _, flags, place = _part(beginning, 0, order)
    _, shape, place = _part(beginning, place, order)
    _, name, place = _part(beginning, place, order)
    flag = struct.unpack_from(f"{order}I", flags)[0]
    lengths = struct.unpack(f"{order}{len(shape) // 4}i", shape)
    if len(lengths) < 2 or any(length < 0 for length in lengths):
        raise ValueError("an array of it has no length, or a negative one")
    return name.decode("latin-1"), lengths, flag & 0xFF, bool(flag & _COMPLEX), place


def _part(content: bytes, place: int, order: str) -> tuple[int, bytes, int]:
    """Type and bytes of a sub-element, and the offset of the next one. Sub-elements of four bytes or less are stored
    inside their own tag."""
    kind = struct.unpack_from(f"{order}I", content, place)[0]
    if kind >> 16:
        kind, size, start, after = kind & 0xFFFF, kind >> 16, place + 4, place + 8
    else:
        size, start = struct.unpack_from(f"{order}I", content, place + 4)[0], place + 8
        after = start + -(-size // 8) * 8
    if start + size > len(content):
        raise ValueError("what it says of an array is cut short, or too long")
    return kind, content[start : start + size], after


def _numbers(content: bytes, place: int, order: str) -> tuple[np.ndarray, int]:
    """Numbers of a sub-element, and the offset of the next one."""
    kind, stored, place = _part(content, place, order)
    if kind not in _STORED:
        raise ValueError(f"an array of it is stored as type {kind}")
    return np.frombuffer(stored, np.dtype(order + _STORED[kind])), place


def _values(variable: _Variable) -> np.ndarray:
    """The numbers of a variable as an array of its shape; sparse matrices are converted to dense arrays."""
    content, place, order = _unpacked(variable), variable.begin, variable.order
    rows = starts = None
    if variable.kind == _SPARSE:
        rows, place = _numbers(content, place, order)
        starts, place = _numbers(content, place, order)
    values, place = _numbers(content, place, order)
    if variable.complex:
        values = values + 1j * _numbers(content, place, order)[0]
    if rows is None or starts is None:
        values = values.reshape(variable.shape, order="F")
        return values if variable.complex else values.astype(_NUMERIC[variable.kind])
    columns = np.repeat(np.arange(variable.shape[1]), np.diff(starts))
    dense = np.zeros(variable.shape, complex if variable.complex else float)
    dense[rows[: len(columns)], columns] = values[: len(columns)]
    return dense


def _unpacked(variable: _Variable) -> bytes:
    """Content of an element without its tag, decompressed. Raises `ValueError` if it is larger than its shape
    implies."""
    if not variable.packed:
        return variable.content
    most = variable.size + _BESIDE
    element = zlib.decompressobj().decompress(variable.content, most + 1)
    if len(element) > most:
        raise ValueError(f"'{variable.name[:40]}' is larger than its shape {variable.shape} says")
    return element[8:]
