"""Files that grow with a stream of any length, written with constant memory."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import tempfile
import zipfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import counted
from jeit.files import written_whole

# Number of bytes read and compressed at once, and maximum number of values of a `Sample`.
_BLOCK_BYTES, _MAX_SAMPLE = 2**20, 2**16


class GrowingTable:
    """A CSV file that is written line by line. Each line is on the disk when `write` returns; if the process is killed
    or the disk is full, the line is missing, never incomplete. An existing file or link is replaced. Raises `OSError`
    if the file cannot be written."""

    def __init__(self, path: Path, columns: Sequence[str]):
        path.unlink(missing_ok=True)
        self._file = path.open("wb", buffering=0)
        self.write(columns)

    def write(self, row: Iterable[Any]) -> None:
        """Write one line, completely or not at all."""
        text = io.StringIO()
        csv.writer(text).writerow(row)
        line = text.getvalue().encode("utf-8", "backslashreplace")
        line_start, num_written = self._file.tell(), 0
        try:
            while num_written < len(line):
                num_written += self._file.write(line[num_written:])
        except OSError:
            self._file.truncate(line_start)
            raise

    def __enter__(self) -> "GrowingTable":
        return self

    def __exit__(self, *_) -> None:
        self._file.close()


class GrowingRows:
    """Array (n, *shape) of single precision, stored row by row in a temporary file in `folder`. The system deletes the
    file when the process ends. Raises `OSError` if the disk is full."""

    def __init__(self, folder: Path, shape: tuple[int, ...]):
        self.folder, self.shape, self.number = folder, shape, 0
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (closed in __exit__)

    def append(self, row: Float[np.ndarray, "*shape"]) -> None:
        """Append one row."""
        self._file.write(np.asarray(row, np.float32).tobytes())
        self.number += 1

    def read(self, row_indices: Iterable[int]) -> Float[np.ndarray, "k *shape"]:
        """Read the rows of the given `row_indices`; call it only after the last `append`."""
        size, rows = 4 * int(np.prod(self.shape)), []
        for row_index in row_indices:
            self._file.seek(size * row_index)
            rows.append(np.frombuffer(self._file.read(size), np.float32).reshape(self.shape))
        return np.stack(rows)

    def write_npz(
        self, path: Path, name: str, others: Mapping[str, ArrayLike], progress: Callable[[str], None] | None = None
    ) -> None:
        """Write an NPZ file, completely or not at all, with all rows as array `name`, and with the arrays `others`. The
        rows are copied block by block; for large files, `progress` is called with the percentage written."""
        header = {"descr": "<f4", "fortran_order": False, "shape": (self.number, *self.shape)}
        with written_whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for share_done, block in self._blocks():
                    if progress is not None and self._file.tell() > _BLOCK_BYTES:
                        progress(f"{100 * share_done:.0f} %")
                    member.write(block)
            for other_name, values in others.items():
                with archive.open(f"{other_name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)

    def _blocks(self) -> Iterator[tuple[float, bytes]]:
        """Yield the file of rows in blocks, each with the share of the file that has been read up to its end."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        while block := self._file.read(_BLOCK_BYTES):
            yield self._file.tell() / size, block

    def __enter__(self) -> "GrowingRows":
        return self

    def __exit__(self, *_) -> None:
        with contextlib.suppress(OSError):  # data not yet written are not needed any more
            self._file.close()


@contextlib.contextmanager
def reporting_partial_results(rows: GrowingRows) -> Iterator[None]:
    """Context manager that adds to the message of an `OSError`, such as for a full disk, which frames have been
    written, and raises this `OSError`."""
    try:
        yield
    except OSError as error:
        remaining_text = f"frames.csv has the {counted(rows.number, 'frame')} until then"
        message = f"{error.strerror or error}: what came of the stream could not all be written; {remaining_text}"
        raise OSError(error.errno, message, str(rows.folder)) from error


class Sample:
    """Evenly spaced sample of a series of numbers of any length: every number of a series of up to 65,536 numbers,
    every second number of a longer series, then every fourth, and so on, so that 32,768 to 65,536 numbers are
    stored."""

    def __init__(self) -> None:
        self._values, self._step, self._number = array("d"), 1, 0

    def append(self, value: float) -> None:
        """Add the next number of the series, and store it if it belongs to the sample."""
        if self._number % self._step == 0:
            if len(self._values) == _MAX_SAMPLE:
                self._values, self._step = self._values[::2], 2 * self._step
            self._values.append(value)
        self._number += 1

    def values(self) -> Float[np.ndarray, " k"]:
        """Return the stored numbers."""
        return np.array(self._values)
