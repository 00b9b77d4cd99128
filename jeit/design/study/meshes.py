"""Outline or surfaces of the skins of a study for each cell size, and functions that create layouts on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jeit.design.skin.described_surface import described_surface, typical_cell
from jeit.design.study.layouts import curved_layout, study_layout
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh import Mesh, Rectangle
from jeit.mesh.geodesic import Triangles

if TYPE_CHECKING:
    from jeit.design.study.study_tables import StudyTable

Maker = Callable[[str, float, float, float], Layout | SurfaceLayout]
"""Function that creates a layout from name, diameter, contact impedance and minimum gap, as `study_layout` does."""


def meshes_of(table: StudyTable, folder: Path) -> tuple[list[float], Rectangle | Triangles, Sequence[Maker]]:
    """Returns the cell sizes, metres; the outline, or for curved skins the surface for the first cell size; and the
    functions that create layouts: a single one for flat skins, and one for each cell size for curved skins."""
    from jeit.design.skin.surface_tables import ScanTable  # imported already when the table was read

    cells = [1e-3 * size for size in table.mesh.cell_mm]
    described = table.surface
    if described is None:
        outline = Rectangle(1e-3 * table.skin.width_mm, 1e-3 * table.skin.height_mm)
        return cells, outline, [lambda name, *sizes: study_layout(name, folder, outline, *sizes)]
    surfaces = [described_surface(described, folder, size) for size in cells]
    if isinstance(described, ScanTable) and described.has_cells:
        cells = [typical_cell(surfaces[0])]

    def on(surface: Mesh) -> Maker:
        return lambda name, *sizes: curved_layout(name, folder, surface, described.outward, *sizes)

    return cells, Triangles.of(surfaces[0]), [on(surface) for surface in surfaces]
