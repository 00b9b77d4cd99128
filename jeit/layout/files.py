"""Reading and writing of layouts, in millimetres: CSV for spreadsheets, DXF and SVG for laser cutters.

| | electrodes | labels | contact impedance | outline |
|---|---|---|---|---|
| `.csv` | yes | yes | yes | no |
| `.dxf`, `.svg` | yes | yes | no | yes |
"""

from __future__ import annotations

from pathlib import Path

from jeit.files import written_whole
from jeit.layout.csv_file import read_csv, write_csv
from jeit.layout.dxf_file import read_dxf, write_dxf
from jeit.layout.layout import Layout
from jeit.layout.surface_layout import SurfaceLayout
from jeit.layout.svg_file import read_svg, write_svg
from jeit.mesh import Domain

_READERS = {".csv": read_csv, ".dxf": read_dxf, ".svg": read_svg}
_WRITERS = {".csv": write_csv, ".dxf": write_dxf, ".svg": write_svg}


def read_layout(path: str | Path, *, outline: Domain | None = None) -> Layout:
    """Read a layout; the ending of the file's name says the format. It is called like the file.

    - `.csv`: one electrode a line under the columns `x_mm`, `y_mm`, `diameter_mm` and, if wanted, `label` and
      `contact_impedance_ohm_m2`. Lengths may also be in `cm` or `m`. Columns are separated by commas, or by semicolons
      or tabs, between which a decimal comma is understood. Lines that begin with # are comments.
    - `.dxf` (needs the extra `cad`): circles on the layer ELECTRODES; on OUTLINE closed polylines of straight sides,
      the largest the skin and others holes in it, or one circle; text on LABELS that begins or is centred in a circle
      is its label. In the unit that the drawing states, in millimetres if it states none.
    - `.svg`: circles in the group ELECTRODES (its id, class or Inkscape layer), or all circles; in the group OUTLINE
      shapes of straight sides, the largest the skin and others holes in it, or one circle; without that group the only
      closed shape of straight sides; text in LABELS, in the electrodes' order. Moved by any transforms. The document
      says its size with a unit (mm, cm, in, pt, or px of 1/96 inch); y is turned up, as `write_layout` turns it down.

    `outline`: of the skin, in metres, for a file that has none. Raises `FileNotFoundError` if there is no such file,
    `ImportError` if the extra is missing, and `ValueError` for what is no layout, naming the line or electrode.
    """
    path = Path(path)
    reader = _by_suffix(path, _READERS)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    try:
        return reader(path, outline)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def write_layout(layout: Layout | SurfaceLayout, path: str | Path) -> None:
    """Write a layout in millimetres; the ending of the file's name says the format, as in `read_layout`.

    What is read back differs by rounding only (below a millionth of a millimetre), except that a rectangle comes back
    as the polygon it is. DXF and SVG hold a drawing to scale, x to the right and y up: what is to be cut on layers
    (groups in SVG) `OUTLINE` in red and `ELECTRODES` in blue, labels apart from it on `LABELS`. Inside the SVG file
    y runs down, as in all SVG, so its y is minus the layout's. A `SurfaceLayout` goes into CSV, with a column `z_mm`,
    for `read_surface_layout`.

    Raises `ValueError` for another ending or a place that cannot be written; `ImportError` if the extra is missing.
    """
    path = Path(path)
    writer = _by_suffix(path, _WRITERS)
    if isinstance(layout, SurfaceLayout) and writer is not write_csv:
        raise ValueError(f"path: drawings are flat, and '{layout.name}' is of a curved skin; give a name in .csv.")
    if not isinstance(layout, Layout | SurfaceLayout):
        raise ValueError(f"layout must be a Layout, not {type(layout).__name__}; see jeit.layout.Layout.")
    try:
        with written_whole(path) as file:
            writer(layout, file)
    except OSError as error:
        raise ValueError(f"path: {path} cannot be written: {error.strerror}. Is there such a folder?") from None


def _by_suffix(path: Path, table: dict):
    suffix = path.suffix.lower()
    if suffix not in table:
        raise ValueError(f"path: {path} ends with none of {', '.join(table)}, which give the format of a layout.")
    return table[suffix]
