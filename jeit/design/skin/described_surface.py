"""Creation of the surface of a curved skin from its table in a TOML file: a generated shape, or a file of triangles."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jeit.arguments import describe
from jeit.layout.layout import MAX_SKIN_SIZE, MIN_SKIN_SIZE
from jeit.mesh import Mesh, bend, cap, forearm, from_gmsh, measures, read, rectangle, sphere, tube
from jeit.mesh.checks import size_checked

if TYPE_CHECKING:
    from jeit.design.skin.surface_tables import SurfaceTable

_METRES_PER_UNIT = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
# Typical extent of a skin, metres, from which the likely unit of length of a file is determined.
_TYPICAL_EXTENT = 0.15
# Side of an equilateral triangle divided by the square root of the triangle's area.
_TRIANGLE_SIDE_PER_ROOT_AREA = 2 / 3**0.25


def described_surface(table: SurfaceTable, folder: Path, cell_size: float) -> Mesh:
    """Create the surface that `table` describes, with triangles of `cell_size` metres, or read the surface from the
    file that `table` names. Paths are relative to `folder`.

    Raises `ValueError` for a surface that cannot be created or read, or is invalid. Raises `ImportError` for a CAD file
    if Gmsh is not installed.
    """
    try:
        with size_checked():  # no warning about the size, since `_check_unit` rejects a surface that is too large
            surface = _create_surface(table, folder, cell_size)
    except (ValueError, OSError) as error:
        raise ValueError(f"surface: {error}") from None
    _check_unit(table, surface)
    return surface


def _check_unit(surface_table: SurfaceTable, surface: Mesh) -> None:
    """Raise `ValueError` if the surface of a file is implausibly large or small for a skin; the message gives the
    likely unit of length."""
    from jeit.design.skin.surface_tables import ScanTable

    largest_extent = float(np.ptp(np.asarray(surface.points), axis=0).max())
    if not isinstance(surface_table, ScanTable) or MIN_SKIN_SIZE <= largest_extent <= MAX_SKIN_SIZE:
        return
    extents_by_unit = {
        candidate_unit: largest_extent * metres_per_unit / _METRES_PER_UNIT[surface_table.unit]
        for candidate_unit, metres_per_unit in _METRES_PER_UNIT.items()
    }
    likely_unit = min(
        extents_by_unit, key=lambda candidate_unit: abs(np.log(extents_by_unit[candidate_unit] / _TYPICAL_EXTENT))
    )
    unit_hint = (
        f'give "{likely_unit}", in which it is {_length_text(extents_by_unit[likely_unit])}'
        if likely_unit != surface_table.unit
        else "is it the right file?"
    )
    raise ValueError(
        f'surface.unit: in "{surface_table.unit}" the skin would be {_length_text(largest_extent)} across; {unit_hint}.'
    )


def _length_text(length_metres: float) -> str:
    return f"{length_metres:.3g} m" if length_metres >= 1 else f"{1e3 * length_metres:.3g} mm"


def surface_identity(table: SurfaceTable, folder: Path) -> str:
    """Text that identifies the surface of a skin: its table, with a file replaced by the hash of its content."""
    table_values = table.model_dump()
    if "file" in table_values:
        table_values["file"] = hashlib.sha256((folder / table_values["file"]).read_bytes()).hexdigest()
    return json.dumps(table_values, default=np.ndarray.tolist)


def typical_cell_size(surface: Mesh) -> float:
    """Typical cell size of a surface, metres: side of an equilateral triangle with the mean area of the surface's
    triangles."""
    return _TRIANGLE_SIDE_PER_ROOT_AREA * float(np.sqrt(np.mean(np.asarray(measures(surface)))))


def _create_surface(surface_table: SurfaceTable, table_folder: Path, cell_size: float) -> Mesh:
    from jeit.design.skin import surface_tables as tables

    match surface_table:
        case tables.TubeTable():
            return tube(1e-3 * surface_table.radius_mm, 1e-3 * surface_table.height_mm, cell_size=cell_size)
        case tables.ForearmTable():
            wrist_radii, elbow_radii = (
                (1e-3 * np.broadcast_to(radii_mm, 2)).tolist()
                for radii_mm in (surface_table.wrist_mm, surface_table.elbow_mm)
            )
            return forearm(1e-3 * surface_table.length_mm, wrist_radii, elbow_radii, cell_size=cell_size)
        case tables.SphereTable():
            return sphere(1e-3 * surface_table.radius_mm, cell_size=cell_size)
        case tables.CapTable():
            return cap(
                1e-3 * surface_table.radius_mm, float(np.deg2rad(surface_table.angle_degrees)), cell_size=cell_size
            )
        case tables.BentSheetTable():
            flat_mesh = rectangle(1e-3 * surface_table.width_mm, 1e-3 * surface_table.height_mm, cell_size=cell_size)
            return bend(flat_mesh, 1e-3 * surface_table.radius_mm, axis=surface_table.axis)
    triangle_file, metres_per_unit = table_folder / surface_table.file, _METRES_PER_UNIT[surface_table.unit]
    if surface_table.has_cells:
        surface = read(triangle_file, scale=metres_per_unit)
    else:
        surface = from_gmsh(triangle_file, cell_size=cell_size / metres_per_unit, dimension=2, scale=metres_per_unit)
    if not surface.is_surface:
        raise ValueError(
            f"{describe(surface_table.file)} is flat or a solid; a curved skin needs triangles in space, such as those "
            "that jeit.mesh.surface_of takes off a solid."
        )
    return surface
