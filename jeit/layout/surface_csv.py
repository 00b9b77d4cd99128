"""Layouts of curved skins as CSV: one electrode a line, its place in space."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jeit.layout.csv_file import read_table
from jeit.layout.surface_layout import SurfaceLayout
from jeit.mesh import Mesh


def read_surface_layout(path: str | Path, surface: Mesh, *, outward: bool = True) -> SurfaceLayout:
    """Read the electrodes of a curved skin from a `.csv` file: columns `x_mm`, `y_mm`, `z_mm`, `diameter_mm` and, if
    wanted, `label` and `contact_impedance_ohm_m2`, as in `read_layout`, which wants no z. `write_layout` writes it.

    `surface` and `outward` as in `SurfaceLayout`, onto whose surface the places are moved. Raises `FileNotFoundError`
    if there is no such file, and `ValueError` for what is no such table, naming the line, and as `SurfaceLayout` does.
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
