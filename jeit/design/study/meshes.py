"""Outlines or surfaces of a study's skins for each cell size, and the functions that create layouts on them."""

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
"""A layout by name, with a diameter, contact impedance and least gap, as in `study_layout`."""


def meshes_of(table: StudyTable, folder: Path) -> tuple[list[float], Rectangle | Triangles, Sequence[Maker]]:
    """Cell sizes, metres; the outline, for curved skins the surface of the first size; and the functions that create
    layouts: one for all sizes, or for curved skins one for each."""
    from jeit.design.skin.surface_tables import ScanTable  # it was imported when the table was read

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
