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

_METRES_PER_UNIT = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_PLANE_COLUMNS = ("x", "y", "diameter")
_LENGTH_COLUMNS = ("x", "y", "z", "diameter")
# Title of a column of lengths with its unit: "x_mm", "x [mm]", "x (mm)" or "xmm".
_LENGTH_TITLE = re.compile(rf"({'|'.join(_LENGTH_COLUMNS)})[ _]*[\[(]?({'|'.join(_METRES_PER_UNIT)})[\])]?")
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
    length_matrix = np.column_stack([layout.centres, layout.diameters])
    column_names = _PLANE_COLUMNS if length_matrix.shape[1] == 3 else _LENGTH_COLUMNS
    header_row = [*(f"{column_name}_mm" for column_name in column_names), _LABEL_COLUMN]
    table_columns: list[Iterable] = [
        *(map(millimetres, length_column) for length_column in length_matrix.T),
        layout.labels,
    ]
    if layout.contact_impedance is not None:
        header_row.append(_IMPEDANCE_COLUMN)
        table_columns.append(np.asarray(layout.contact_impedance).tolist())
    text_buffer = io.StringIO(newline="")
    csv_writer = csv.writer(text_buffer)
    csv_writer.writerow(header_row)
    csv_writer.writerows(zip(*table_columns, strict=True))
    file.write(text_buffer.getvalue().encode())


def read_csv(path: Path, outline: Domain | None) -> Layout:
    """Read an electrode layout of a flat skin from a CSV table, written by `write_csv` or by hand. Raises `ValueError`
    for an invalid table, naming the line."""
    layout_table = read_table(path, _PLANE_COLUMNS)
    centres, diameters = (
        np.column_stack([layout_table.lengths["x"], layout_table.lengths["y"]]),
        layout_table.lengths["diameter"],
    )
    _check_unit(centres, diameters, layout_table.titles)
    check_discs_fit(
        centres, diameters, outline, [f"the electrode of line {line_number}" for line_number in layout_table.lines]
    )
    return Layout(
        centres,
        diameters,
        contact_impedance=layout_table.contact_impedance,
        outline=outline,
        labels=layout_table.labels,
        name=path.stem,
    )


def read_table(path: Path, length_columns: Sequence[str]) -> LayoutTable:
    """Read a table of electrodes. `length_columns`: the columns of lengths that the table must have, from "x", "y", "z"
    and "diameter"; the title of each column states its unit. Raises `ValueError` for a table with other columns or
    invalid values."""
    numbered_lines = _read_lines(path, length_columns)
    delimiter = next((separator for separator in ";\t" if separator in numbered_lines[0][1]), ",")
    (_, header_cells), *table_rows = [
        (row_line, _split_cells(text_line, delimiter)) for row_line, text_line in numbered_lines
    ]
    columns_by_name = _find_columns(header_cells, length_columns)
    check_electrodes("the table", len(table_rows))
    if not table_rows:
        raise ValueError("there is no electrode below the names of the columns.")
    for row_line, table_row in table_rows:
        if len(table_row) != len(header_cells):
            decimal_hint = (
                " Write decimals with a point, or separate columns by semicolons." if delimiter == "," else ""
            )
            raise ValueError(
                f"line {row_line} has {len(table_row)} values for {len(header_cells)} columns.{decimal_hint}"
            )

    def parse_column(column_name: str) -> np.ndarray:
        column_index, metres_per_unit = columns_by_name[column_name]
        return metres_per_unit * np.array(
            [
                _parse_number(table_row[column_index], delimiter, f"line {line_number}: {header_cells[column_index]}")
                for line_number, table_row in table_rows
            ]
        )

    lengths = {column_name: parse_column(column_name) for column_name in length_columns}
    contact_impedance = parse_column(_IMPEDANCE_COLUMN) if _IMPEDANCE_COLUMN in columns_by_name else None
    for column_name, column_values in (("diameter", lengths["diameter"]), (_IMPEDANCE_COLUMN, contact_impedance)):
        if column_values is not None and column_values.min() <= 0:
            raise ValueError(f"line {table_rows[int(column_values.argmin())][0]}: {column_name} is not positive.")
    labels = (
        [
            table_row[columns_by_name[_LABEL_COLUMN][0]] or str(row_index + 1)
            for row_index, (_, table_row) in enumerate(table_rows)
        ]
        if _LABEL_COLUMN in columns_by_name
        else None
    )
    column_titles = [header_cells[columns_by_name[column_name][0]] for column_name in length_columns]
    return LayoutTable(lengths, contact_impedance, labels, [row_line for row_line, _ in table_rows], column_titles)


def _check_unit(centres: np.ndarray, diameters: np.ndarray, column_titles: list[str]) -> None:
    """Raise `ValueError` for lengths that are implausible in the unit that the titles of the columns state."""
    x_min, x_max, y_min, y_max = bounds(centres, diameters)
    skin_extent = max(x_max - x_min, y_max - y_min)
    if skin_extent < MIN_SKIN_SIZE:
        raise ValueError(
            f"the electrodes would span {1e3 * skin_extent:.3g} mm under the columns {names_text(column_titles)}; if "
            "the values are in metres, multiply them by 1000 and call the columns x_mm, y_mm, diameter_mm."
        )
    if skin_extent > MAX_SKIN_SIZE:
        raise ValueError(
            f"the electrodes would span {skin_extent:.3g} m under the columns {names_text(column_titles)}; if the "
            "values are in millimetres, call the columns x_mm, y_mm, diameter_mm."
        )


def _read_lines(path: Path, length_columns: Sequence[str]) -> list[tuple[int, str]]:
    """Read the lines that are neither empty nor comments, with their numbers from 1."""
    try:
        file_text = read_text(path, encoding="utf-8-sig", max_bytes=MAX_FILE_BYTES)
    except UnicodeError:
        raise ValueError("this is not a text file in UTF-8; in the spreadsheet, save it as 'CSV UTF-8'.") from None
    numbered_lines = [(line_number, text_line) for line_number, text_line in enumerate(file_text.splitlines(), start=1)]
    numbered_lines = [
        (line_number, text_line)
        for line_number, text_line in numbered_lines
        if text_line.strip(" \t,;") and not text_line.lstrip().startswith("#")
    ]
    if not numbered_lines:
        raise ValueError(f"the file is empty; the first line names the columns: {_header_example(length_columns)}.")
    return numbered_lines


def _split_cells(text_line: str, delimiter: str) -> list[str]:
    with read_as("a line is no row of a table"):
        return [
            cell_text.strip() for cell_text in next(csv.reader([text_line], delimiter=delimiter, skipinitialspace=True))
        ]


def _find_columns(header_cells: list[str], length_columns: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Index and unit (in metres) of every column of a table, by name. Raises `ValueError` for columns that are missing,
    unknown, repeated, or do not state their unit."""
    columns_by_name: dict[str, tuple[int, float]] = {}
    for column_index, column_title in enumerate(header_cells):
        length_match = _LENGTH_TITLE.fullmatch(column_title.lower())
        column_name = length_match[1] if length_match else column_title.lower()
        if column_name in length_columns and not length_match:
            raise ValueError(
                f"the title of the column {describe(column_title)} does not state a unit; call it {column_name}_mm (or "
                f"{column_name}_cm, {column_name}_m)."
            )
        if column_name not in (*length_columns, _LABEL_COLUMN, _IMPEDANCE_COLUMN):
            raise ValueError(
                f"there is no column {describe(column_title)} in a layout; the first line names columns: "
                f"{_header_example(length_columns)}."
            )
        if column_name in columns_by_name:
            raise ValueError(f"there are two columns for {column_name}; keep one.")
        columns_by_name[column_name] = (column_index, _METRES_PER_UNIT[length_match[2]] if length_match else 1.0)
    missing_columns = [column_name for column_name in length_columns if column_name not in columns_by_name]
    if missing_columns:
        raise ValueError(
            f"there is no column {missing_columns[0]}_mm; the first line names the columns: "
            f"{_header_example(length_columns)}."
        )
    return columns_by_name


def _header_example(length_columns: Sequence[str]) -> str:
    first_columns = ", ".join(f"{column_name}_mm" for column_name in length_columns)
    return f"{first_columns} and, if wanted, {_LABEL_COLUMN} and {_IMPEDANCE_COLUMN}"


def _parse_number(cell_text: str, delimiter: str, cell_name: str) -> float:
    try:
        parsed_number = float(cell_text if delimiter == "," else cell_text.replace(",", "."))
    except ValueError:
        parsed_number = math.nan
    if not math.isfinite(parsed_number):
        raise ValueError(f"{cell_name} is {describe(cell_text)}; give a finite number, such as 12.5.")
    return parsed_number


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
        layout_table = read_table(path, ("x", "y", "z", "diameter"))
        return SurfaceLayout(
            np.column_stack([layout_table.lengths[axis_name] for axis_name in "xyz"]),
            layout_table.lengths["diameter"],
            surface,
            contact_impedance=layout_table.contact_impedance,
            outward=outward,
            labels=layout_table.labels,
            name=path.stem,
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
