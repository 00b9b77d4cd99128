"""Safe reading of NPZ and NPY files: only numbers and text are read, never objects that could be executed, and no more
data than the headers declare."""

from __future__ import annotations

import contextlib
import math
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from jeit.files.limits import FileTooLargeError, check_memory, error_text

_NUM_COPIES_IN_MEMORY = 2
# Maximum size in bytes of a file in an NPZ archive that is not an array, such as a JSON header.
_MAX_TEXT_BYTES = 2**24
_NPY_SIGNATURE, _ZIP_SIGNATURE = b"\x93NUM", b"PK\x03\x04"
# Errors that NumPy and zipfile raise for files that are damaged, encrypted, or compressed by an unknown method.
ARCHIVE_READ_ERRORS = (
    ValueError,
    EOFError,
    TypeError,
    SyntaxError,
    OverflowError,
    LookupError,
    RuntimeError,  # includes NotImplementedError and RecursionError
    MemoryError,
    tokenize.TokenError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


def npz_arrays(
    path: Path, *keys: str, otherwise: str = "not an NPZ file", read_all: bool = False
) -> dict[str, np.ndarray]:
    """Read the arrays `keys` of an NPZ file, or all arrays if `read_all`; missing arrays are omitted. The entry "" of
    the result contains the names of all arrays in the file.

    Raises `ValueError` for files that are not NPZ files (with the text `otherwise`), damaged files, arrays of objects,
    and arrays that exceed the memory limit (`check_memory`). Raises `OSError` if the file does not exist.
    """
    with _open_archive(path, otherwise) as archive:
        archive_members = _archive_members(archive)
        requested_members = {
            name: member_info for name, member_info in archive_members.items() if read_all or name in keys
        }
        array_headers = {
            name: _read_member_header(archive, name, member_info) for name, member_info in requested_members.items()
        }
        check_memory(path.name, sum(header.required_memory for header in array_headers.values()))
        arrays = {}
        for name, member_info in requested_members.items():
            with archive.open(member_info) as member_file:
                arrays[name] = _read_array(member_file)
    return {"": np.array([*archive_members], dtype=str), **arrays}


def npz_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of numbers in an NPZ file, read from their headers; arrays of text or objects are omitted.
    Raises the errors of `npz_arrays`."""
    array_shapes = {}
    with _open_archive(path) as archive:
        for name, member_info in _archive_members(archive).items():
            with contextlib.suppress(ValueError):  # of an array of objects, or of a file of another kind
                array_header = _read_member_header(archive, name, member_info)
                if array_header.dtype.kind in "biufc":
                    array_shapes[name] = array_header.shape
    return array_shapes


@contextlib.contextmanager
def _open_archive(path: Path, other_format_text: str = "not an NPZ file") -> Iterator[zipfile.ZipFile]:
    """Open an NPZ file, and convert the errors of reading it. Arguments and errors as in `npz_arrays`."""
    with path.open("rb") as file:
        file_signature = file.read(4)
        if file_signature == _NPY_SIGNATURE:
            raise ValueError(
                "it holds a single array without names; save it with numpy.savez and the names of its arrays."
            )
        if file_signature != _ZIP_SIGNATURE:
            raise ValueError(f"{other_format_text}; save the arrays with numpy.savez.")
        file.seek(0)
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except FileTooLargeError:
            raise
        except (*ARCHIVE_READ_ERRORS, OSError) as error:  # the archive may place a member before the start of the file
            raise _unreadable_error("NPZ file of plain arrays", error) from None


def _archive_members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    return {member_info.filename.removesuffix(".npy"): member_info for member_info in archive.infolist()}


def npy_array(path: Path) -> np.ndarray:
    """Read the array of an NPY file. Raises `ValueError` for the same faults as `npz_arrays`, and `OSError` if the file
    does not exist."""
    with path.open("rb") as file:
        try:
            array_header = _read_array_header(file)
            check_memory(path.name, array_header.required_memory)
            num_bytes_left = path.stat().st_size - file.tell()
            if array_header.num_data_bytes > num_bytes_left:
                raise ValueError(
                    f"it says {array_header.num_data_bytes} bytes of numbers, and has {num_bytes_left}; is it cut off?"
                )
            file.seek(0)
            return _read_array(file)
        except FileTooLargeError:
            raise
        except ARCHIVE_READ_ERRORS as error:
            raise _unreadable_error("NPY file of plain numbers", error) from None


def check_archive(path: Path) -> None:
    """Check an archive of arrays and text. Raises `ValueError` if the file is not a readable ZIP archive, if its
    content exceeds the memory limit (`check_memory`), and if an array is smaller than its header declares."""
    try:
        with zipfile.ZipFile(path) as archive:
            archive_members = archive.infolist()
            check_memory(path.name, sum(member.file_size for member in archive_members))
            for member in archive_members:
                if member.filename.endswith(".npy"):
                    _read_member_header(archive, member.filename, member)
                elif member.file_size > _MAX_TEXT_BYTES:
                    raise ValueError(f"'{member.filename[:40]}' in it has {member.file_size} bytes of text")
    except (FileTooLargeError, FileNotFoundError):
        raise
    except (*ARCHIVE_READ_ERRORS, OSError) as error:
        raise _unreadable_error("archive", error) from None


def require_arrays(arrays: dict[str, np.ndarray], *keys: str) -> None:
    """Raise `ValueError` if one of the arrays `keys` is missing in `arrays`; the message lists the arrays of the
    file."""
    missing_keys = [key for key in keys if key not in arrays]
    if missing_keys:
        array_names = ", ".join(str(name)[:40] for name in arrays[""][:12]) or "nothing"
        raise ValueError(f"there is no array '{missing_keys[0]}'; the file holds {array_names}.")


class _ArrayHeader(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def num_data_bytes(self) -> int:
        """Size of the array's data in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def required_memory(self) -> int:
        """Memory in bytes for two copies of the array in double precision."""
        return _NUM_COPIES_IN_MEMORY * math.prod(self.shape) * max(self.dtype.itemsize, 8)


def _read_array_header(file: IO[bytes]) -> _ArrayHeader:
    """Read the header of an array (shape and type) from an NPY file."""
    format_version = np.lib.format.read_magic(file)
    if format_version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"an array of it is in format {format_version}")
    read_header = (
        np.lib.format.read_array_header_1_0 if format_version == (1, 0) else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError("it holds objects, which would be executed")
    if any(axis_length < 0 for axis_length in shape) or math.prod(shape) > 2**62:
        raise ValueError(f"an array of it has shape {str(shape)[:60]}")
    return _ArrayHeader(shape, dtype)


def _read_member_header(archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> _ArrayHeader:
    """Read the header of an array in an NPZ archive, and check that the stored array is as large as the header
    declares."""
    if not member.filename.endswith(".npy"):
        raise ValueError(f"'{name[:40]}' in it is a file of another kind")
    with archive.open(member) as file:
        try:
            array_header = _read_array_header(file)
        except ARCHIVE_READ_ERRORS as error:
            raise ValueError(f"'{name[:40]}': {error}") from None
    if array_header.num_data_bytes > member.file_size:
        raise ValueError(
            f"'{name[:40]}' says {array_header.num_data_bytes} bytes of numbers, and has {member.file_size}"
        )
    return array_header


def _read_array(file: IO[bytes]) -> np.ndarray:
    array = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.kind == "U" and array.size and array.dtype.itemsize:
        code_points = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("=")).reshape(-1).view(np.uint32)
        if code_points.max() > sys.maxunicode:
            raise ValueError("a text in it holds what is no letter")
    return array


def _unreadable_error(file_kind: str, error: Exception) -> ValueError:
    object_hint = "" if "object" not in str(error).lower() else " as numbers and text, not objects"
    return ValueError(f"not a readable {file_kind} ({error_text(error)}); write it again{object_hint}.")
