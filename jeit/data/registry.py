"""Registry of file formats. `read` recognises the format from the content of a file, unless the format is given."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jeit.arguments import check_name, listed
from jeit.data.measurement import Measurement
from jeit.files import check_memory

# Maximum bytes of memory per byte of text.
_IN_MEMORY = 4


@dataclass(frozen=True)
class Format:
    """A file format. **Fields**: `module`: name of the module that reads it; `endings`: suffixes of its files;
    `described`: whether a description may accompany a file; `borrows`: whether a file may use the description of
    another measurement; `bundled`: name of the bundled description that always applies, or None.

    The module is imported only when a file has one of the suffixes.
    """

    module: str
    endings: tuple[str, ...]
    described: bool = False
    borrows: bool = False
    bundled: str | None = None

    @property
    def reader(self) -> Any:
        """The module that reads the format, with `DESCRIPTION`, `recognises(path)` and `read(path)`."""
        return importlib.import_module(f"jeit.data.formats.{self.module}")

    def recognises(self, path: Path) -> bool:
        """Whether a file is of this format, judged by its suffix and its content."""
        return path.suffix.lower() in self.endings and self.reader.recognises(path)


_TABLES = (".csv", ".txt", ".dat", ".npy", ".npz")
# The first format that recognises a file reads it. To add a format, write a module like kit4.py and list it here.
FORMATS: dict[str, Format] = {
    "kit4": Format("kit4", (".mat",)),
    "ktc2023": Format("ktc2023", (".mat",)),
    "eidors": Format("eidors", (".mat",), described=True, borrows=True),
    "sciospec": Format("sciospec", (".eit",), described=True),
    "draeger": Format("draeger", (".eit",), described=True),
    "carefusion": Format("carefusion", (".eit",), described=True),
    "swisstom": Format("swisstom", (".eit",), described=True),
    "goettingen": Format("goettingen", (".get",), described=True),
    "cn0565": Format("cn0565", (".txt", ".csv", ".dat", ".log"), described=True, borrows=True),
    "quadrupoles": Format(
        "quadrupoles", (".txt", ".csv", ".dat", ".data", ".ohm", ".shm"), described=True, borrows=True
    ),
    "openeit": Format("openeit", (".txt", ".csv", ".dat", ".log", ".bin"), described=True, borrows=True),
    "table": Format("table", _TABLES, described=True, borrows=True),
    # A table of 208 rows of real and imaginary pairs, with the bundled description; used only if named explicitly.
    "tank6cm": Format("table", (), bundled="tank6cm"),
}


def read(
    path: str | Path,
    format: str | None = None,
    description: str | Path | None = None,
    *,
    like: Measurement | None = None,
    key: str | None = None,
) -> Measurement:
    """Read a measurement from a file.

    - `path`: the data file; or a folder of Sciospec files, one per frame, which are read in the order of their names.
    - `format`: a name in `FORMATS` ("kit4", "ktc2023", "eidors", "sciospec", "draeger", "carefusion", "swisstom",
      "goettingen", "cn0565", "quadrupoles", "openeit", "table", "tank6cm"); by default it is recognised from the
      content.
    - `description`: a TOML file, or the name of a bundled one, that states the meaning of the numbers (tables, EIDORS
      files) or the body measured (files of instruments). By default it is looked for beside the data.
    - `like`: a measurement of the same sensor, such as the reference, whose description applies to a table that has
      none.
    - `key`: name of the array of voltages in a .mat or .npz file, in place of `[data] keys`.

    Raises `ValueError` if the file does not exist, is of no known format, or violates its format.
    """
    file = Path(path)
    if file.is_dir():
        sciospec = FORMATS["sciospec"]
        members = sorted(one for one in file.iterdir() if one.is_file() and sciospec.recognises(one))
        if not members or format not in (None, "sciospec"):
            raise ValueError(f"{file} is a folder. Give one data file in it.")
        check_memory(file.name, _IN_MEMORY * sum(one.stat().st_size for one in members))
        return replace(sciospec.reader.read_all(members, description), name=file.name, source=str(file))
    if not file.is_file():
        raise ValueError(f"path: there is no file {file}. Check the name and the working directory.")
    if file.stat().st_size == 0:
        raise ValueError(f"{file.name} is empty.")
    name = _recognise(file, description or like) if format is None else format
    check_name("format", name, FORMATS)
    chosen = FORMATS[name]
    reader = chosen.reader
    if chosen.borrows:
        return reader.read(file, description=description, like=like, key=key)
    if key is not None:
        raise ValueError(f"key: files of format '{name}' have no choice of arrays; leave it out.")
    if chosen.described:
        return reader.read(file, description=description)
    if description is not None:
        raise ValueError(f"Format '{name}' describes itself; tables and files of instruments take a description.")
    return reader.read(file, description=chosen.bundled) if chosen.bundled else reader.read(file)


def _recognise(file: Path, description: object) -> str:
    for name, candidate in FORMATS.items():
        if candidate.recognises(file):
            return name
    if file.suffix.lower() == ".mat":
        from jeit.data.formats import eidors, kit4, ktc2023
        from jeit.files import matlab

        if description is not None or eidors.find_description(file) is not None:
            return "eidors"
        raise ValueError(
            f"{file.name} is a .mat file of no known kind; it holds "
            f"{listed(sorted(matlab.variable_names(file)))}. `jeit describe {file.name}` finds out what it can, and "
            f"writes a description. Known: {kit4.DESCRIPTION}; {ktc2023.DESCRIPTION}; {eidors.DESCRIPTION}."
        )
    raise ValueError(
        f"{file.name}: files ending in '{file.suffix}' are of no known format. Known: " + f"{', '.join(FORMATS)}."
    )
