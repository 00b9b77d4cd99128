"""Reading and writing of electrode layouts, in millimetres: CSV for spreadsheets, DXF and SVG for laser cutters.

Contents of each format:

| | electrodes | labels | contact impedance | outline |
|---|---|---|---|---|
| `.csv` | yes | yes | yes | no |
| `.dxf`, `.svg` | yes | yes | no | yes |
"""

from __future__ import annotations

from pathlib import Path

from jeit.files import atomically_written_file
from jeit.layout.csv_file import read_csv, write_csv
from jeit.layout.dxf_file import read_dxf, write_dxf
from jeit.layout.layout import Layout
from jeit.layout.surface_layout import SurfaceLayout
from jeit.layout.svg_file import read_svg, write_svg
from jeit.mesh import Domain

_READERS_BY_SUFFIX = {".csv": read_csv, ".dxf": read_dxf, ".svg": read_svg}
_WRITERS_BY_SUFFIX = {".csv": write_csv, ".dxf": write_dxf, ".svg": write_svg}


def read_layout(path: str | Path, *, outline: Domain | None = None) -> Layout:
    """Read an electrode layout from a file. The suffix of the file determines the format; the layout has the name of
    the file.

    - `.csv`: one line per electrode, with the columns `x_mm`, `y_mm`, `diameter_mm` and optionally `label` and
      `contact_impedance_ohm_m2`. Lengths may also be in `cm` or `m`. Columns are separated by commas, or by semicolons
      or tabs, in which case decimal commas are accepted. Lines that begin with # are comments.
    - `.dxf` (needs the extra `cad`): electrodes are circles on the layer ELECTRODES. The outline is on the layer
      OUTLINE: closed polylines with straight sides, of which the largest is the skin and others are holes, or a single
      circle. A text on the layer LABELS is the label of the circle in which it begins or is centred. Lengths are in the
      unit of the drawing, or in millimetres if the drawing states no unit.
    - `.svg`: electrodes are circles in the group ELECTRODES (id, class or Inkscape layer), or all circles if there is
      no such group. The outline is in the group OUTLINE: shapes with straight sides, of which the largest is the skin
      and others are holes, or a single circle; without this group, the outline is the only closed shape with straight
      sides. Texts in the group LABELS are labels in the order of the electrodes. Transforms are applied. The document
      must state its size with a unit (mm, cm, in, pt, or px of 1/96 inch). The y axis points up in the layout and down
      in the file.

    **Arguments:**

    - `path`: the file.
    - `outline`: outline of the skin, used if the file contains no outline.

    Raises `FileNotFoundError` if there is no such file, `ImportError` if the extra `cad` is missing, and `ValueError`
    for an invalid layout, naming the line or electrode.

    **Example:**

    ```python
    write_layout(named_layout("perimeter-16"), "skin.csv")
    layout = read_layout("skin.csv", outline=Rectangle(0.2, 0.2))
    ```
    """
    path = Path(path)
    read_function = _function_for_suffix(path, _READERS_BY_SUFFIX)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    try:
        return read_function(path, outline)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def write_layout(layout: Layout | SurfaceLayout, path: str | Path) -> None:
    """Write an electrode layout to a file, in millimetres. The suffix of the file determines the format, as in
    `read_layout`.

    A layout that is read back differs from the written layout by rounding only (below a millionth of a millimetre),
    except that a rectangle is read as a polygon. DXF and SVG files contain a drawing to scale, with x to the right and
    y up. The lines to be cut are on the layers (groups in SVG) `OUTLINE`, in red, and `ELECTRODES`, in blue; labels are
    on `LABELS`. The y coordinates in an SVG file are the negatives of the y coordinates in the layout, since the y axis
    of SVG points down. A `SurfaceLayout` is written to CSV only, with a column `z_mm`, and is read with
    `read_surface_layout`.

    **Arguments:**

    - `layout`: the layout.
    - `path`: the file, .csv, .dxf or .svg.

    Raises `ValueError` for any other suffix or a path that cannot be written; `ImportError` if the extra `cad` is
    missing.

    **Example:**

    ```python
    write_layout(named_layout("perimeter-16"), "skin.svg")
    ```
    """
    path = Path(path)
    write_function = _function_for_suffix(path, _WRITERS_BY_SUFFIX)
    if isinstance(layout, SurfaceLayout) and write_function is not write_csv:
        raise ValueError(f"path: drawings are flat, and '{layout.name}' is of a curved skin; give a name in .csv.")
    if not isinstance(layout, Layout | SurfaceLayout):
        raise ValueError(f"layout must be a Layout, not {type(layout).__name__}; see jeit.layout.Layout.")
    try:
        with atomically_written_file(path) as layout_file:
            write_function(layout, layout_file)
    except OSError as error:
        raise ValueError(f"path: {path} cannot be written: {error.strerror}. Is there such a folder?") from None


def _function_for_suffix(path: Path, functions_by_suffix: dict):
    file_suffix = path.suffix.lower()
    if file_suffix not in functions_by_suffix:
        raise ValueError(
            f"path: {path} ends with none of {', '.join(functions_by_suffix)}, which give the format of a layout."
        )
    return functions_by_suffix[file_suffix]
