"""Reading and writing of electrode layouts in CSV files, for flat and for curved skins."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import describe, names_text
from jeit.files import check_electrodes, read_as, read_text
from jeit.layout.layout import MAX_SKIN_SIZE, MIN_SKIN_SIZE, Layout, bounds, check_discs_fit
from jeit.layout.surface_layout import SurfaceLayout
from jeit.mesh import Domain, Mesh

_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_PLANE_COLUMNS = ("x", "y", "diameter")
_LENGTH_COLUMNS = ("x", "y", "z", "diameter")
# Title of a column of lengths with its unit: "x_mm", "x [mm]", "x (mm)" or "xmm".
_LENGTH_TITLE = re.compile(rf"({'|'.join(_LENGTH_COLUMNS)})[ _]*[\[(]?({'|'.join(_UNITS)})[\])]?")
_LABEL_COLUMN, _IMPEDANCE_COLUMN = "label", "contact_impedance_ohm_m2"
MAX_FILE_BYTES = 2**24
"""Maximum size of a layout file in bytes: reading a larger file would take more than a minute."""


class LayoutTable(NamedTuple):
    """Table of L electrodes, read from a file.

    **Fields**: `lengths`: coordinates and diameters (L,) by name, metres; `contact_impedance`: (L,) ohm·m², or None;
    `labels`: labels, or None; `lines`: number of the line of each electrode in the file; `titles`: titles of the
    columns of lengths.
    """

    lengths: dict[str, Float[np.ndarray, " L"]]
    contact_impedance: Float[np.ndarray, " L"] | None
    labels: list[str] | None
    lines: list[int]
    titles: list[str]


def millimetres(metres: float) -> float:
    """Convert metres to millimetres for a text file, rounded so that 12.500000000000002 becomes 12.5, and -0.0 becomes
    0.0."""
    return round(1e3 * float(metres), 9) + 0.0


def write_csv(layout: Layout | SurfaceLayout, file: BinaryIO) -> None:
    """Write the electrodes of a layout as a CSV table, without the outline or the surface."""
    lengths = np.column_stack([layout.centres, layout.diameters])
    names = _PLANE_COLUMNS if lengths.shape[1] == 3 else _LENGTH_COLUMNS
    header = [*(f"{name}_mm" for name in names), _LABEL_COLUMN]
    columns: list[Iterable] = [*(map(millimetres, column) for column in lengths.T), layout.labels]
    if layout.contact_impedance is not None:
        header.append(_IMPEDANCE_COLUMN)
        columns.append(np.asarray(layout.contact_impedance).tolist())
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    file.write(text.getvalue().encode())


def read_csv(path: Path, outline: Domain | None) -> Layout:
    """Read an electrode layout of a flat skin from a CSV table, written by `write_csv` or by hand. Raises `ValueError`
    for an invalid table, naming the line."""
    table = read_table(path, _PLANE_COLUMNS)
    centres, diameters = np.column_stack([table.lengths["x"], table.lengths["y"]]), table.lengths["diameter"]
    _check_unit(centres, diameters, table.titles)
    check_discs_fit(centres, diameters, outline, [f"the electrode of line {number}" for number in table.lines])
    return Layout(
        centres,
        diameters,
        contact_impedance=table.contact_impedance,
        outline=outline,
        labels=table.labels,
        name=path.stem,
    )


def read_table(path: Path, length_columns: Sequence[str]) -> LayoutTable:
    """Read a table of electrodes. `length_columns`: the columns of lengths that the table must have, from "x", "y", "z"
    and "diameter"; the title of each column states its unit. Raises `ValueError` for a table with other columns or
    invalid values."""
    lines = _read_lines(path, length_columns)
    delimiter = next((separator for separator in ";\t" if separator in lines[0][1]), ",")
    (_, header), *rows = [(number, _split_cells(line, delimiter)) for number, line in lines]
    columns = _find_columns(header, length_columns)
    check_electrodes("the table", len(rows))
    if not rows:
        raise ValueError("there is no electrode below the names of the columns.")
    for number, row in rows:
        if len(row) != len(header):
            decimal_hint = (
                " Write decimals with a point, or separate columns by semicolons." if delimiter == "," else ""
            )
            raise ValueError(f"line {number} has {len(row)} values for {len(header)} columns.{decimal_hint}")

    def numbers(name: str) -> np.ndarray:
        column_index, unit = columns[name]
        return unit * np.array(
            [
                _parse_number(row[column_index], delimiter, f"line {line_number}: {header[column_index]}")
                for line_number, row in rows
            ]
        )

    lengths = {name: numbers(name) for name in length_columns}
    contact_impedance = numbers(_IMPEDANCE_COLUMN) if _IMPEDANCE_COLUMN in columns else None
    for name, values in (("diameter", lengths["diameter"]), (_IMPEDANCE_COLUMN, contact_impedance)):
        if values is not None and values.min() <= 0:
            raise ValueError(f"line {rows[int(values.argmin())][0]}: {name} is not positive.")
    labels = (
        [row[columns[_LABEL_COLUMN][0]] or str(row_index + 1) for row_index, (_, row) in enumerate(rows)]
        if _LABEL_COLUMN in columns
        else None
    )
    titles = [header[columns[name][0]] for name in length_columns]
    return LayoutTable(lengths, contact_impedance, labels, [number for number, _ in rows], titles)


def _check_unit(centres: np.ndarray, diameters: np.ndarray, titles: list[str]) -> None:
    """Raise `ValueError` for lengths that are implausible in the unit that the titles of the columns state."""
    x_min, x_max, y_min, y_max = bounds(centres, diameters)
    size = max(x_max - x_min, y_max - y_min)
    if size < MIN_SKIN_SIZE:
        raise ValueError(
            f"the electrodes would span {1e3 * size:.3g} mm under the columns {names_text(titles)}; if the values are "
            "in metres, multiply them by 1000 and call the columns x_mm, y_mm, diameter_mm."
        )
    if size > MAX_SKIN_SIZE:
        raise ValueError(
            f"the electrodes would span {size:.3g} m under the columns {names_text(titles)}; if the values are in "
            "millimetres, call the columns x_mm, y_mm, diameter_mm."
        )


def _read_lines(path: Path, length_columns: Sequence[str]) -> list[tuple[int, str]]:
    """Read the lines that are neither empty nor comments, with their numbers from 1."""
    try:
        text = read_text(path, encoding="utf-8-sig", max_bytes=MAX_FILE_BYTES)
    except UnicodeError:
        raise ValueError("this is not a text file in UTF-8; in the spreadsheet, save it as 'CSV UTF-8'.") from None
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip(" \t,;") and not line.lstrip().startswith("#")]
    if not lines:
        raise ValueError(f"the file is empty; the first line names the columns: {_header_example(length_columns)}.")
    return lines


def _split_cells(line: str, delimiter: str) -> list[str]:
    with read_as("a line is no row of a table"):
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _find_columns(header: list[str], length_columns: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Index and unit (in metres) of every column of a table, by name. Raises `ValueError` for columns that are missing,
    unknown, repeated, or do not state their unit."""
    columns: dict[str, tuple[int, float]] = {}
    for column_index, title in enumerate(header):
        length = _LENGTH_TITLE.fullmatch(title.lower())
        name = length[1] if length else title.lower()
        if name in length_columns and not length:
            raise ValueError(
                f"the title of the column {describe(title)} does not state a unit; call it {name}_mm (or {name}_cm, "
                f"{name}_m)."
            )
        if name not in (*length_columns, _LABEL_COLUMN, _IMPEDANCE_COLUMN):
            raise ValueError(
                f"there is no column {describe(title)} in a layout; the first line names columns: "
                f"{_header_example(length_columns)}."
            )
        if name in columns:
            raise ValueError(f"there are two columns for {name}; keep one.")
        columns[name] = (column_index, _UNITS[length[2]] if length else 1.0)
    missing_columns = [name for name in length_columns if name not in columns]
    if missing_columns:
        raise ValueError(
            f"there is no column {missing_columns[0]}_mm; the first line names the columns: "
            f"{_header_example(length_columns)}."
        )
    return columns


def _header_example(length_columns: Sequence[str]) -> str:
    first_columns = ", ".join(f"{name}_mm" for name in length_columns)
    return f"{first_columns} and, if wanted, {_LABEL_COLUMN} and {_IMPEDANCE_COLUMN}"


def _parse_number(cell: str, delimiter: str, cell_name: str) -> float:
    try:
        value = float(cell if delimiter == "," else cell.replace(",", "."))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{cell_name} is {describe(cell)}; give a finite number, such as 12.5.")
    return value


def read_surface_layout(path: str | Path, surface: Mesh, *, outward: bool = True) -> SurfaceLayout:
    """Read the electrodes of a curved skin from a `.csv` file, such as `write_layout` writes.

    The columns are `x_mm`, `y_mm`, `z_mm`, `diameter_mm` and optionally `label` and `contact_impedance_ohm_m2`, in the
    format of `read_layout`. Positions are moved to the surface. Raises `FileNotFoundError` if there is no such file,
    and `ValueError` for an invalid table, naming the line, and as `SurfaceLayout` does.

    **Arguments:**

    - `path`: the file.
    - `surface`, `outward`: as in `SurfaceLayout`.

    **Example:**

    ```python
    write_layout(SurfaceLayout.spread(sleeve, 8, 0.01), "sleeve.csv")
    layout = read_surface_layout("sleeve.csv", sleeve)
    ```
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise ValueError(f"path: {path.name[:80]} is no .csv; layouts of curved skins are read from tables only.")
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    try:
        table = read_table(path, ("x", "y", "z", "diameter"))
        return SurfaceLayout(
            np.column_stack([table.lengths[axis] for axis in "xyz"]),
            table.lengths["diameter"],
            surface,
            contact_impedance=table.contact_impedance,
            outward=outward,
            labels=table.labels,
            name=path.stem,
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
