"""Tables that describe the surface of a curved skin in a TOML file: type, range and unit of every key."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from jeit.files.schema import Number, Numbers, Table, TableOfKind, Word, fault
from jeit.mesh.gmsh import CAD

_RADIUS_RANGE = Number(2, 5000, "mm")
_LENGTH_RANGE = Number(5, 5000, "mm")
_SECTION_RADII_RANGE = Numbers(((2, 2),), 2, 5000, "mm", single=True)


class TubeTable(Table):
    """Surface of a skin: the lateral surface of a cylinder."""

    name_in_messages = "a tube"
    kind: Literal["tube"]
    radius_mm: Annotated[float, _RADIUS_RANGE]
    height_mm: Annotated[float, _LENGTH_RANGE]
    outward: bool = True


class ForearmTable(Table):
    """Surface of a skin: a tapered sleeve. Each end is specified by a radius, or by the two half widths of an oval."""

    name_in_messages = "a forearm"
    kind: Literal["forearm"]
    length_mm: Annotated[float, _LENGTH_RANGE]
    wrist_mm: Annotated[Any, _SECTION_RADII_RANGE]
    elbow_mm: Annotated[Any, _SECTION_RADII_RANGE]
    outward: bool = True


class SphereTable(Table):
    """Surface of a skin: a sphere."""

    name_in_messages = "a sphere"
    kind: Literal["sphere"]
    radius_mm: Annotated[float, _RADIUS_RANGE]
    outward: bool = True


class CapTable(Table):
    """Surface of a skin: the cap of a sphere about its pole."""

    name_in_messages = "a cap"
    kind: Literal["cap"]
    radius_mm: Annotated[float, _RADIUS_RANGE]
    angle_degrees: Annotated[float, Number(5, 170, "degrees")]
    outward: bool = True


class BentSheetTable(Table):
    """Surface of a skin: a flat sheet bent around a cylinder along `axis`."""

    name_in_messages = "a bent sheet"
    kind: Literal["bent sheet"]
    width_mm: Annotated[float, _LENGTH_RANGE]
    height_mm: Annotated[float, _LENGTH_RANGE]
    radius_mm: Annotated[float, _RADIUS_RANGE]
    axis: Literal["x", "y"] = "y"
    outward: bool = True


class ScanTable(Table):
    """Surface of a skin: a file of triangles or a CAD file, with the file's unit of length."""

    name_in_messages = "a surface's file"
    file: Word
    unit: Literal["mm", "cm", "m", "inch"]
    outward: bool = True

    @property
    def has_cells(self) -> bool:
        """Whether the triangles of the file are used as cells; a CAD file is meshed by Gmsh instead."""
        return not self.file.lower().endswith(CAD)


SurfaceTable = TubeTable | ForearmTable | SphereTable | CapTable | BentSheetTable | ScanTable
SURFACE = TableOfKind(
    "kind",
    TubeTable,
    ForearmTable,
    SphereTable,
    CapTable,
    BentSheetTable,
    alternative_key="file",
    alternative_table=ScanTable,
)


def check_keys_of_surface(surface: SurfaceTable | None, skin: Table, mesh: Table) -> None:
    """Raise an error for keys of the tables `skin` and `mesh` that have no effect on a skin with this `surface`."""
    if surface is None:
        return
    if size_keys := {"width_mm", "height_mm"} & skin.model_fields_set:
        raise fault(
            "has no effect: the table surface says how large the skin is; leave it out.", f"skin.{min(size_keys)}"
        )
    if isinstance(surface, ScanTable) and surface.has_cells and "cell_mm" in mesh.model_fields_set:
        raise fault("has no effect: cells are the triangles of surface.file; leave it out.", "mesh.cell_mm")
