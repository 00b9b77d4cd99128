"""One door for all files: `read` finds the format from the content, or takes it from you."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from jeit.arguments import check_name, listed
from jeit.data import _matlab, eidors, kit4, ktc2023, table
from jeit.data.instruments import carefusion, draeger, goettingen, sciospec, swisstom
from jeit.data.measurement import Measurement
from jeit.files import check_memory

# Bytes in memory for one of text, at most.
_IN_MEMORY = 4


@dataclass(frozen=True)
class Format:
    """A file format: how to know it, how to read it, whether a description may go with it, and whether it may borrow
    that of another measurement."""

    summary: str
    recognises: Callable[[Path], bool]
    read: Callable[..., Measurement]
    described: bool = False
    borrows: bool = False


# The first that recognises a file reads it. To add a format, write a module like kit4.py and list it here.
FORMATS: dict[str, Format] = {
    "kit4": Format(kit4.DESCRIPTION, kit4.recognises, kit4.read),
    "ktc2023": Format(ktc2023.DESCRIPTION, ktc2023.recognises, ktc2023.read),
    "eidors": Format(eidors.DESCRIPTION, eidors.recognises, eidors.read, described=True),
    "sciospec": Format(sciospec.DESCRIPTION, sciospec.recognises, sciospec.read, described=True),
    "draeger": Format(draeger.DESCRIPTION, draeger.recognises, draeger.read, described=True),
    "carefusion": Format(carefusion.DESCRIPTION, carefusion.recognises, carefusion.read, described=True),
    "swisstom": Format(swisstom.DESCRIPTION, swisstom.recognises, swisstom.read, described=True),
    "goettingen": Format(goettingen.DESCRIPTION, goettingen.recognises, goettingen.read, described=True),
    "table": Format(table.DESCRIPTION, table.recognises, table.read, described=True, borrows=True),
    "tank6cm": Format(
        "6 cm tank (.csv, 208 rows of real and imaginary pairs): a table with the bundled description",
        lambda path: False,
        partial(table.read, description="tank6cm"),
    ),
}


def read(
    path: str | Path,
    format: str | None = None,
    description: str | Path | None = None,
    *,
    like: Measurement | None = None,
) -> Measurement:
    """Read a measurement from a file.

    - `path`: the data file; or a folder of Sciospec's, which writes a file for every frame: all, in the order of
      their names.
    - `format`: a name in `FORMATS` ("kit4", "ktc2023", "eidors", "sciospec", "draeger", "carefusion", "swisstom",
      "goettingen", "table", "tank6cm"); found from the content if not given.
    - `description`: a TOML file (or the name of a bundled one) that says what the numbers mean, for a table or an
      EIDORS file, and what body was measured, for those of instruments; looked for beside the data if not given.
    - `like`: a measurement of the same sensor, its reference say, which describes a table that nothing else describes.

    Raises `ValueError` when the file is not there, of no known format, or not what its format demands.
    """
    file = Path(path)
    if file.is_dir():
        members = sorted(one for one in file.iterdir() if one.is_file() and sciospec.recognises(one))
        if not members or format not in (None, "sciospec"):
            raise ValueError(f"{file} is a folder. Give one data file in it.")
        check_memory(file.name, _IN_MEMORY * sum(one.stat().st_size for one in members))
        return replace(sciospec.read_all(members, description), name=file.name, source=str(file))
    if not file.is_file():
        raise ValueError(f"path: there is no file {file}. Check the name and the working directory.")
    if file.stat().st_size == 0:
        raise ValueError(f"{file.name} is empty.")
    name = _recognise(file, description) if format is None else format
    check_name("format", name, FORMATS)
    chosen = FORMATS[name]
    if chosen.borrows:
        return chosen.read(file, description=description, like=like)
    if chosen.described:
        return chosen.read(file, description=description)
    if description is not None:
        raise ValueError(f"Format '{name}' describes itself; tables and files of instruments take a description.")
    return chosen.read(file)


def _recognise(file: Path, description: str | Path | None) -> str:
    for name, candidate in FORMATS.items():
        if candidate.recognises(file):
            return name
    if file.suffix.lower() == ".mat":
        if description is not None or eidors.find_description(file) is not None:
            return "eidors"
        raise ValueError(
            f"{file.name} is a .mat file of no known kind; it holds "
            f"{listed(sorted(_matlab.variable_names(file)))}. Known: {kit4.DESCRIPTION}; {ktc2023.DESCRIPTION}; "
            f"{eidors.DESCRIPTION}."
        )
    raise ValueError(
        f"{file.name}: files ending in '{file.suffix}' are of no known format. Known: " + f"{', '.join(FORMATS)}."
    )
