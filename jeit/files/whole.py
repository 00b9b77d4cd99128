"""Files that are written whole or not at all: beside what was there, and put in its place when all is on the disk."""

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def written_whole(path: str | Path) -> Iterator[BinaryIO]:
    """A file that takes the place of `path` when all of it is on the disk: one killed before leaves what was there.

    A link at `path` is replaced, not followed. Raises `OSError` where it cannot be written.
    """
    path = Path(path)
    other = path.with_name(f".{path.name[:80]}.{secrets.token_hex(4)}.part")
    try:
        with other.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        other.replace(path)
    finally:
        other.unlink(missing_ok=True)


@contextmanager
def whole_files(folder: Path) -> Iterator[Path]:
    """A folder to write several files to, which take their places in `folder` when all are written: all or none.

    Links at their places are replaced, not followed. Raises `OSError` where they cannot be written.
    """
    beside = Path(tempfile.mkdtemp(prefix=".jeit-", suffix=".part", dir=folder))
    try:
        yield beside
        for one in sorted(beside.iterdir()):
            with one.open("rb") as file:
                os.fsync(file.fileno())
        for one in sorted(beside.iterdir()):
            one.replace(folder / one.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
