"""Registry of file formats. `read` recognises the format from the content of a file, unless the format is specified."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jeit.arguments import check_name, names_text
from jeit.data.measurement import Measurement
from jeit.files import check_memory

# Maximum bytes of memory per byte of a text file.
_MEMORY_PER_FILE_BYTE = 4


@dataclass(frozen=True)
class Format:
    """A file format. **Fields**: `reading`: name of the module that reads the format, or of a class in it, such as
    "kuopio.Kit4"; `endings`: suffixes of files in the format; `described`: whether a description may accompany a file;
    `borrows`: whether a file may use the description of another measurement (`like` of `read`); `own_protocol`: whether
    files state their protocol, so that a description states only the body; `bundled`: name of the bundled description
    that always applies, or None.

    The module is imported only when a file has one of the suffixes `endings`.
    """

    reading: str
    endings: tuple[str, ...]
    described: bool = False
    borrows: bool = False
    own_protocol: bool = False
    bundled: str | None = None

    @property
    def reader(self) -> Any:
        """The module or class that reads files of this format; it defines `DESCRIPTION`, `recognises(path)` and
        `read(path)`."""
        module_name, _, class_name = self.reading.partition(".")
        reader_module = importlib.import_module(f"jeit.data.formats.{module_name}")
        return getattr(reader_module, class_name) if class_name else reader_module

    def recognises(self, path: Path) -> bool:
        """Whether a file is of this format, judged by its suffix and its content."""
        return path.suffix.lower() in self.endings and self.reader.recognises(path)


_TABLE_SUFFIXES = (".csv", ".txt", ".dat", ".npy", ".npz")
# A file is read by the first format that recognises it. To add a format, write a class like Kit4 in kuopio.py, or a
# module like table.py, and list it here.
FORMATS: dict[str, Format] = {
    "kit4": Format("kuopio.Kit4", (".mat",)),
    "ktc2023": Format("kuopio.Ktc2023", (".mat",)),
    "eidors": Format("eidors", (".mat",), described=True, borrows=True),
    "sciospec": Format("sciospec", (".eit",), described=True, own_protocol=True),
    "draeger": Format("clinical.Draeger", (".eit",), described=True, own_protocol=True),
    "carefusion": Format("clinical.Carefusion", (".eit",), described=True, own_protocol=True),
    "swisstom": Format("clinical.Swisstom", (".eit",), described=True, own_protocol=True),
    "goettingen": Format("clinical.Goettingen", (".get",), described=True, own_protocol=True),
    "cn0565": Format(
        "boards.Cn0565", (".txt", ".csv", ".dat", ".log"), described=True, borrows=True, own_protocol=True
    ),
    "quadrupoles": Format(
        "quadrupoles",
        (".txt", ".csv", ".dat", ".data", ".ohm", ".shm"),
        described=True,
        borrows=True,
        own_protocol=True,
    ),
    "openeit": Format("boards.OpenEit", (".txt", ".csv", ".dat", ".log", ".bin"), described=True, borrows=True),
    "table": Format("table", _TABLE_SUFFIXES, described=True, borrows=True),
    # A table with 208 rows of pairs of real and imaginary parts and a bundled description; used only if named
    # explicitly.
    "tank6cm": Format("table", (), bundled="tank6cm"),
}


def format_with_protocol(path: Path) -> str | None:
    """Name of the format of a file if files of this format state their protocol, so that a description needs to state
    only the body; otherwise None."""
    if not path.is_file():
        return None
    return next(
        (
            name
            for name, candidate_format in FORMATS.items()
            if candidate_format.own_protocol and candidate_format.recognises(path)
        ),
        None,
    )


def read(
    path: str | Path,
    format: str | None = None,
    description: str | Path | None = None,
    *,
    like: Measurement | None = None,
    key: str | None = None,
) -> Measurement:
    """Read a measurement from a file.

    **Arguments:**

    - `path`: the data file; or a folder of Sciospec files, one per frame, which are read in the order of their names.
    - `format`: a name in `FORMATS` ("kit4", "ktc2023", "eidors", "sciospec", "draeger", "carefusion", "swisstom",
      "goettingen", "cn0565", "quadrupoles", "openeit", "table", "tank6cm"); by default the format is recognised from
      the content.
    - `description`: a TOML file, or the name of a bundled description, that states the meaning of the numbers (tables,
      EIDORS files) or the measured body (files of instruments). By default a description beside the data file is used.
    - `like`: a measurement of the same sensor, such as the reference; its description is used for a table without a
      description.
    - `key`: name of the array of voltages in a .mat or .npz file, in place of `[data] keys` of the description.

    Raises `ValueError` if the file does not exist, has no known format, or violates its format.

    **Example:**

    ```python
    write_table(pressed, "pressed.npz")
    measurement = read("pressed.npz")
    ```
    """
    file = Path(path)
    if file.is_dir():
        sciospec_format = FORMATS["sciospec"]
        sciospec_files = sorted(
            folder_member
            for folder_member in file.iterdir()
            if folder_member.is_file() and sciospec_format.recognises(folder_member)
        )
        if not sciospec_files or format not in (None, "sciospec"):
            raise ValueError(f"{file} is a folder. Give one data file in it.")
        check_memory(
            file.name, _MEMORY_PER_FILE_BYTE * sum(folder_member.stat().st_size for folder_member in sciospec_files)
        )
        return replace(
            sciospec_format.reader.read_recordings(sciospec_files, description), name=file.name, source=str(file)
        )
    if not file.is_file():
        raise ValueError(f"path: there is no file {file}. Check the name and the working directory.")
    if file.stat().st_size == 0:
        raise ValueError(f"{file.name} is empty.")
    name = _recognise_format(file, description, like) if format is None else format
    check_name("format", name, FORMATS)
    file_format = FORMATS[name]
    format_reader = file_format.reader
    if file_format.borrows:
        return format_reader.read(file, description=description, like=like, key=key)
    if key is not None:
        raise ValueError(f"key: files of format '{name}' have no choice of arrays; leave it out.")
    if file_format.described:
        return format_reader.read(file, description=description)
    if description is not None:
        raise ValueError(f"Format '{name}' describes itself; tables and files of instruments take a description.")
    return (
        format_reader.read(file, description=file_format.bundled) if file_format.bundled else format_reader.read(file)
    )


def _recognise_format(file: Path, description: str | Path | None, similar_measurement: Measurement | None) -> str:
    """Return the name of the format of a file. If the file has no known format, raises `ValueError` that states what
    the file probably is."""
    has_description = description is not None or similar_measurement is not None
    for name, candidate_format in FORMATS.items():
        if candidate_format.recognises(file):
            if name == "table" and not has_description and candidate_format.reader.find_description(file) is None:
                _check_signature(file)
            return name
    _check_signature(file)
    if file.suffix.lower() == ".mat":
        from jeit.data.formats import eidors
        from jeit.data.formats.kuopio import Kit4, Ktc2023
        from jeit.files import matlab

        if has_description or eidors.find_description(file) is not None:
            return "eidors"
        variable_names = matlab.variable_names(file)
        for kuopio_reader in (Kit4, Ktc2023):
            missing_variables = [
                min(variable_set - variable_names, key=len)
                for variable_set in kuopio_reader.VARIABLES
                if len(variable_set & variable_names) == len(variable_set) - 1
            ]
            if missing_variables:
                raise ValueError(
                    f"{file.name} looks like {kuopio_reader.DESCRIPTION}, but lacks the variable "
                    f"{missing_variables[0]}: add it, or put a description beside the file."
                )
        listed_names = names_text(sorted(variable_names))
        known_kinds = "; ".join(kind.DESCRIPTION.split(" (")[0] for kind in (Kit4, Ktc2023, eidors))
        raise ValueError(
            f"{file.name} is a .mat file of no known kind; it holds {listed_names}. `jeit describe {file.name}` finds "
            f"out what it can, and writes a description. Known: {known_kinds}."
        )
    file_suffix = file.suffix.lower()
    if known_formats := [name for name, candidate_format in FORMATS.items() if file_suffix in candidate_format.endings]:
        raise ValueError(
            f"{file.name}: its content is that of no known kind of file ending in '{file_suffix}' "
            f"({', '.join(known_formats)}). Is its start damaged, or is it of another program?"
        )
    with file.open("rb") as file_object:
        head_bytes = file_object.read(_NUM_HEAD_BYTES)
    program_hint = next(
        (
            f" It is {program_explanation}."
            for program_signature, program_explanation in _OTHER_PROGRAMS.items()
            if head_bytes.startswith(program_signature)
        ),
        "",
    )
    if not program_hint and _is_text(head_bytes):
        program_hint = f" It is text: if it is a table of numbers, name it {file.stem[:40]}.txt."
    raise ValueError(
        f"{file.name}: files ending in '{file.suffix}' are of no known format.{program_hint} Known: "
        f"{', '.join(FORMATS)}."
    )


_NUM_HEAD_BYTES = 65536
# For each format, a regular expression that recognises damaged files and files with a wrong suffix.
_FORMAT_SIGNATURES = {
    "draeger": rb"Draeger EIT-Software|Framerate \[Hz\]:",
    "carefusion": rb"E\0I\0T\0_\0F\0i\0l\0e",
    "sciospec": rb"(?m)^MeasurementChannels(?:IndependentFromInjectionPattern)?:",
    "cn0565": rb"(?m)^!V[ \t]*[0-9A-Fa-f]",
    "openeit": rb"(?mi)^\s{0,40}magnitudes\s{0,40}:",
}
# First bytes of files of other programs, and the advice to the user.
_OTHER_PROGRAMS = {
    b"PK\x03\x04": "a spreadsheet or another archive: export its numbers as CSV",
    b"\x89HDF": "HDF5: save the arrays as .npz, or by MATLAB with `save(name, '-v7')`",
    b"MATLAB": "a file of MATLAB: name it .mat",
    b"\x93NUMPY": "an array of NumPy: name it .npy",
    b"\x1f\x8b": "compressed: unpack it",
}


def _check_signature(file: Path) -> None:
    """Raise `ValueError` if a file that no format recognises has the signature (`_FORMAT_SIGNATURES`) of a format; the
    message states what is damaged, or that the suffix is wrong."""
    with file.open("rb") as file_object:
        head_bytes = file_object.read(_NUM_HEAD_BYTES)
    for name, format_signature in _FORMAT_SIGNATURES.items():
        if not re.search(format_signature, head_bytes):
            continue
        format_reader, known_suffixes = FORMATS[name].reader, FORMATS[name].endings
        try:
            format_reader.read(file)
        except ValueError as error:
            raise ValueError(
                f"{file.name} looks like a file of {name} ({format_reader.DESCRIPTION}), but is damaged or of a "
                f"version that is not known: {str(error).removeprefix(file.name).lstrip(':, ')}"
            ) from None
        if file.suffix.lower() not in known_suffixes:
            raise ValueError(
                f"{file.name} is a file of {name} ({format_reader.DESCRIPTION}), which end in "
                f"{names_text(known_suffixes)}: rename it, or give format='{name}' (--format {name})."
            )


def _is_text(first_bytes: bytes) -> bool:
    try:
        first_bytes.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start > len(first_bytes) - 4 and b"\0" not in first_bytes
    return b"\0" not in first_bytes
