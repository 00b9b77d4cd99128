"""Tables of a skin's file: type, range and unit of every key."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from jeit.design import defaults
from jeit.design.skin.protocol import ProtocolName
from jeit.design.skin.surface_tables import SURFACE, SurfaceTable, check_of_curved
from jeit.files import MOST_ELECTRODES
from jeit.files.schema import Number, Table, Word

SIDE = Number(5, 5000, "mm")
THICKNESS = Number(0.05, 200, "mm")
CONDUCTIVITY = Number(1e-6, 1e8, "S/m")
DIAMETER = Number(0.1, 200, "mm")
IMPEDANCE = Number(1e-9, 1e3, "ohm·m²")
PAIRS = Number(0, MOST_ELECTRODES * (MOST_ELECTRODES - 1) // 2)
CURRENT = Number(1e-4, 1e3, "mA")
CELL = Number(0.1, 200, "mm")
LAYERS = Number(1, 50)


class MaterialTable(Table):
    """The skin's model and material."""

    what = "a skin"
    model: Literal["sheet", "layer"] = "sheet"
    width_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    height_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    thickness_mm: Annotated[float, THICKNESS] = 1e3 * defaults.THICKNESS
    conductivity_S_per_m: Annotated[float, CONDUCTIVITY] = defaults.CONDUCTIVITY


class LayoutTable(Table):
    """The electrodes. NaN means the layout's own value."""

    what = "a skin"
    layout: Word
    diameter_mm: Annotated[float, DIAMETER] = math.nan
    contact_impedance_ohm_m2: Annotated[float, IMPEDANCE] = math.nan


class MeasurementTable(Table):
    """The measurement protocol."""

    what = "a skin"
    protocol: ProtocolName = defaults.PROTOCOL
    pairs: Annotated[int, PAIRS] | None = None
    current_mA: Annotated[float, CURRENT] = 1e3 * defaults.CURRENT


class CellsTable(Table):
    """The mesh."""

    what = "a skin"
    cell_mm: Annotated[float, CELL] = 1e3 * defaults.CELL_SIZE
    layers: Annotated[int, LAYERS] = defaults.NUM_LAYERS


class SkinTable(Table):
    """A complete skin file."""

    what = "a skin"
    skin: MaterialTable = MaterialTable()
    surface: Annotated[SurfaceTable | None, SURFACE] = None
    electrodes: LayoutTable = Field(default_factory=dict, validate_default=True)
    measurement: MeasurementTable = MeasurementTable()
    mesh: CellsTable = CellsTable()

    @model_validator(mode="after")
    def _of_curved(self) -> "SkinTable":
        check_of_curved(self.surface, self.skin, self.mesh)
        return self
