"""How fine the mesh of a skin can be."""

import math

from jeit.mesh.generate.unstructured import MOST_POINTS

# Nodes of a plane mesh, times cell size squared over area: 1.155 for equilateral cells, and some for the edge.
_NODES = 1.2


def check_cell_size(name: str, cell_size: float, area: float, num_layers: int = 0) -> None:
    """Raise `ValueError`, which speaks of `name` in millimetres, where cells of so many metres are too many.

    `area` of the skin in m²; `num_layers` of cells, 0 for a sheet.
    """
    plane = _NODES * area * (num_layers + 1)
    number = plane / cell_size**2
    if number > MOST_POINTS:
        least = 1.05e3 * math.sqrt(plane / MOST_POINTS)
        raise ValueError(
            f"{name} is {1e3 * cell_size:g} mm, which makes about {number:.2g} nodes; give {least:.2g} mm or more."
        )
