"""Limits of the cell size of a skin's mesh."""

from __future__ import annotations

import math

import numpy as np

from jeit.arguments import IN_MILLIMETRES, check_metres
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh.generate.unstructured import MOST_POINTS

# Number of nodes of a plane mesh, multiplied by (cell size)² / area: 1.155 for equilateral cells, and slightly more due
# to the nodes on the edge.
_NODES = 1.2
# Maximum cell size, relative to the smallest diameter of the electrodes.
_COARSEST = 1.5


def check_cell_size(
    name: str, cell_size: float, layout: Layout | SurfaceLayout, area: float, num_layers: int = 0
) -> None:
    """Raise `ValueError` if cells of size `cell_size` (metres) are too large for the electrodes of `layout`, or if
    there would be too many cells.

    `name`: name of the size in the error message; `area`: area of the skin, m²; `num_layers`: number of layers of
    cells, 0 for a sheet.
    """
    check_metres(name, cell_size)
    smallest = smallest_diameter(layout)
    most = _COARSEST * smallest
    if cell_size > (1 + 1e-9) * most:
        end = f"; {IN_MILLIMETRES}" if cell_size**2 > area else "."
        raise ValueError(
            f"{name} is {1e3 * cell_size:g} mm; give no more than {1e3 * most:.3g} mm, as electrodes of "
            f"'{layout.name}' are {1e3 * smallest:.3g} mm across{end}"
        )
    plane = _NODES * area * (num_layers + 1)
    number = plane / cell_size**2
    if number > MOST_POINTS:
        least = 1.05e3 * math.sqrt(plane / MOST_POINTS)
        raise ValueError(
            f"{name} is {1e3 * cell_size:g} mm, which makes about {number:.2g} nodes; give {least:.2g} mm or more."
        )


def smallest_diameter(layout: Layout | SurfaceLayout) -> float:
    """Smallest diameter of the electrodes, metres."""
    return float(np.asarray(layout.diameters).min())
