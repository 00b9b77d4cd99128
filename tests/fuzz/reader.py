"""The register of every kind of file that jeit reads, to which `readers.py` and `application_readers.py` add."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from thread_limits import libraries_found_once


@dataclass(frozen=True)
class Reader:
    """How one kind of file is written and read; `main` is its file in the folder that `make` fills."""

    name: str
    main: str
    make: Callable[[Path], None]
    use: Callable[[Path], object]

    @property
    def files(self) -> dict[str, bytes]:
        """A valid file of the kind and the files beside it, by their names in a folder."""
        return _files(self.name)


READERS: dict[str, Reader] = {}


@cache
def _files(name: str) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder, libraries_found_once():
        READERS[name].make(Path(folder))
        found = sorted(one for one in Path(folder).rglob("*") if one.is_file())
        return {str(one.relative_to(folder)): one.read_bytes() for one in found}


def reader(name: str, main: str, use: Callable[[Path], object]):
    """Register a kind of file: the decorated function writes a valid one, `main`, to a folder; `use` reads it."""

    def register(make: Callable[[Path], None]) -> Callable[[Path], None]:
        READERS[name] = Reader(name, main, make, lambda folder: use(folder / main))
        return make

    return register
