"""Files that grow with a stream of any length, in memory that does not grow with it."""

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

# Bytes that are read, and compressed, at once; and values of a sample at most.
_BLOCK, _MOST = 2**20, 2**16


class GrowingTable:
    """A CSV file of whole lines: each is on the disk when it has been written, or, killed or on a full disk, not at
    all. What is at its place, a link too, is replaced. Raises `OSError` where it cannot be written."""

    def __init__(self, path: Path, columns: Sequence[str]):
        path.unlink(missing_ok=True)
        self._file = path.open("wb", buffering=0)
        self.write(columns)

    def write(self, row: Iterable[Any]) -> None:
        """Write one line, in one piece."""
        text = io.StringIO()
        csv.writer(text).writerow(row)
        line = text.getvalue().encode("utf-8", "backslashreplace")
        good, written = self._file.tell(), 0
        try:
            while written < len(line):
                written += self._file.write(line[written:])
        except OSError:
            self._file.truncate(good)
            raise

    def __enter__(self) -> "GrowingTable":
        return self

    def __exit__(self, *_) -> None:
        self._file.close()


class GrowingRows:
    """Arrays (n, *shape) of single precision, row by row in a file without a name: the system takes it back, however
    this process ends. Raises `OSError` where the disk of `folder` is full."""

    def __init__(self, folder: Path, shape: tuple[int, ...]):
        self.folder, self.shape, self.number = folder, shape, 0
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (closed by the context that this is)

    def append(self, row: Float[np.ndarray, "*shape"]) -> None:
        """Append one more row."""
        self._file.write(np.asarray(row, np.float32).tobytes())
        self.number += 1

    def read(self, numbers: Iterable[int]) -> Float[np.ndarray, "k *shape"]:
        """Read some of the rows, after the last has been appended."""
        size, rows = 4 * int(np.prod(self.shape)), []
        for number in numbers:
            self._file.seek(size * number)
            rows.append(np.frombuffer(self._file.read(size), np.float32).reshape(self.shape))
        return np.stack(rows)

    def write_npz(
        self, path: Path, name: str, others: Mapping[str, ArrayLike], progress: Callable[[str], None] | None = None
    ) -> None:
        """An NPZ file with all rows under `name`, and `others`, whole or not at all; the rows never are in memory.
        `progress` is called with how far it is, where that takes a while."""
        header = {"descr": "<f4", "fortran_order": False, "shape": (self.number, *self.shape)}
        with written_whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for done, block in self._blocks():
                    if progress is not None and self._file.tell() > _BLOCK:
                        progress(f"{100 * done:.0f} %")
                    member.write(block)
            for other, values in others.items():
                with archive.open(f"{other}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)

    def _blocks(self) -> Iterator[tuple[float, bytes]]:
        """The file, with the share of it that each ends."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        while block := self._file.read(_BLOCK):
            yield self._file.tell() / size, block

    def __enter__(self) -> "GrowingRows":
        return self

    def __exit__(self, *_) -> None:
        with contextlib.suppress(OSError):  # what could not be written is not wanted any more
            self._file.close()


@contextlib.contextmanager
def saying_what_is_left(rows: GrowingRows) -> Iterator[None]:
    """Raise an `OSError` that comes within, of a full disk, as one that says what there is."""
    try:
        yield
    except OSError as error:
        left = f"frames.csv has the {counted(rows.number, 'frame')} until then"
        said = f"{error.strerror or error}: what came of the stream could not all be written; {left}"
        raise OSError(error.errno, said, str(rows.folder)) from error


class Sample:
    """Numbers as they come, all of them while they are few, then every second, every fourth …: some 30,000 to 65,000,
    evenly chosen."""

    def __init__(self) -> None:
        self._values, self._step, self._number = array("d"), 1, 0

    def append(self, value: float) -> None:
        """The next."""
        if self._number % self._step == 0:
            if len(self._values) == _MOST:
                self._values, self._step = self._values[::2], 2 * self._step
            self._values.append(value)
        self._number += 1

    def values(self) -> Float[np.ndarray, " k"]:
        """The values that are kept."""
        return np.array(self._values)
