"""TOML files that describe a skin: the tables and keys of a skin file, and reading of the file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from jeit.design import defaults
from jeit.design.skin.described_surface import described_surface
from jeit.design.skin.names import ProtocolName, curved_layout, skin_protocol, study_layout
from jeit.design.skin.skin import Skin
from jeit.design.skin.surface_tables import SURFACE, SurfaceTable, check_keys_of_surface
from jeit.files import MAX_ELECTRODES, check_memory, read_toml
from jeit.files.schema import Number, Table, Word
from jeit.mesh import Rectangle

SIDE = Number(5, 5000, "mm")
THICKNESS = Number(0.05, 200, "mm")
CONDUCTIVITY = Number(1e-6, 1e8, "S/m")
DIAMETER = Number(0.1, 200, "mm")
IMPEDANCE = Number(1e-9, 1e3, "ohm·m²")
PAIRS = Number(0, MAX_ELECTRODES * (MAX_ELECTRODES - 1) // 2)
CURRENT = Number(1e-4, 1e3, "mA")
CELL = Number(0.1, 200, "mm")
LAYERS = Number(1, 50)


class MaterialTable(Table):
    """Table "skin": model, size and material of the skin."""

    name_in_messages = "a skin"
    model: Literal["sheet", "layer"] = "sheet"
    width_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    height_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    thickness_mm: Annotated[float, THICKNESS] = 1e3 * defaults.THICKNESS
    conductivity_S_per_m: Annotated[float, CONDUCTIVITY] = defaults.CONDUCTIVITY


class LayoutTable(Table):
    """Table "electrodes": layout, diameter and contact impedance. If a diameter or impedance is NaN, the value of the
    layout is used."""

    name_in_messages = "a skin"
    layout: Word
    diameter_mm: Annotated[float, DIAMETER] = math.nan
    contact_impedance_ohm_m2: Annotated[float, IMPEDANCE] = math.nan


class MeasurementTable(Table):
    """Table "measurement": the measurement protocol."""

    name_in_messages = "a skin"
    protocol: ProtocolName = defaults.PROTOCOL
    pairs: Annotated[int, PAIRS] | None = None
    current_mA: Annotated[float, CURRENT] = 1e3 * defaults.CURRENT


class CellsTable(Table):
    """Table "mesh": cell size, and number of layers of cells."""

    name_in_messages = "a skin"
    cell_mm: Annotated[float, CELL] = 1e3 * defaults.CELL_SIZE
    layers: Annotated[int, LAYERS] = defaults.NUM_LAYERS


class SkinTable(Table):
    """All tables of a skin file."""

    name_in_messages = "a skin"
    skin: MaterialTable = MaterialTable()
    surface: Annotated[SurfaceTable | None, SURFACE] = None
    electrodes: LayoutTable = Field(default_factory=dict, validate_default=True)
    measurement: MeasurementTable = MeasurementTable()
    mesh: CellsTable = CellsTable()

    @model_validator(mode="after")
    def _check_keys_of_surface(self) -> "SkinTable":
        check_keys_of_surface(self.surface, self.skin, self.mesh)
        return self


def describes_skin(path: str | Path) -> bool:
    """Whether a file is a TOML file with a table "skin", even if the rest of the file is invalid.

    **Arguments:**

    - `path`: path of the file.

    **Example:**

    ```python
    if describes_skin("skin.toml"):
        skin = read_described_skin("skin.toml")
    ```
    """
    try:
        return isinstance(read_toml(path).get("skin"), dict)
    except (OSError, ValueError):
        return False


def read_described_skin(path: str | Path) -> Skin:
    """Read the skin that a TOML file describes.

    The file has the tables skin, electrodes, measurement and mesh of a study file, and for a curved skin the table
    surface. Unlike in a study file, every key has a single value. Only the key `layout` in the table electrodes is
    required: the name of a layout, or of a file in the same folder. All other keys have defaults.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError` if the file does not exist. Raises `ValueError` for a file that is not TOML, for unknown
    keys and invalid values, and in the cases of `Skin.create`.

    **Example:**

    ```python
    skin = read_described_skin("skin.toml")
    print(skin.layout.name, skin.model.protocol.num_measurements)
    ```
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    # Imported here, since the import of pydantic takes longer than most operations on a skin file.
    from jeit.files.limits import faults_message
    from jeit.files.schema import validated

    skin_table = validated(SkinTable, read_toml(path), path.name)
    try:
        return _create_skin(skin_table, path.parent)
    except ValueError as error:
        raise ValueError(faults_message(path.name, [str(error)])) from None


def _create_skin(skin_table: SkinTable, skin_folder: Path) -> Skin:
    material_table, layout_table, measurement_table = skin_table.skin, skin_table.electrodes, skin_table.measurement
    electrode_diameter, contact_impedance, cell_size = (
        1e-3 * layout_table.diameter_mm,
        layout_table.contact_impedance_ohm_m2,
        1e-3 * skin_table.mesh.cell_mm,
    )
    if skin_table.surface is None:
        skin_outline = Rectangle(1e-3 * material_table.width_mm, 1e-3 * material_table.height_mm)
        layout = study_layout(
            layout_table.layout, skin_folder, skin_outline, electrode_diameter, contact_impedance, 0.0
        )
    else:
        surface, is_outward = described_surface(skin_table.surface, skin_folder, cell_size), skin_table.surface.outward
        layout = curved_layout(
            layout_table.layout, skin_folder, surface, is_outward, electrode_diameter, contact_impedance, 0.0
        )
    if measurement_table.protocol == "two-terminal" and measurement_table.pairs is not None:
        num_electrodes = layout.num_electrodes
        num_pairs = measurement_table.pairs or num_electrodes * (num_electrodes - 1) // 2
        check_memory(f"measurement.pairs: {num_pairs:,} of {layout.name!r}", 32.0 * num_pairs * num_electrodes)
    drive_current = 1e-3 * measurement_table.current_mA
    return Skin.create(
        layout,
        thickness=1e-3 * material_table.thickness_mm,
        conductivity=material_table.conductivity_S_per_m,
        num_layers=skin_table.mesh.layers if material_table.model == "layer" else 0,
        cell_size=cell_size if skin_table.surface is None else None,
        protocol=skin_protocol(
            layout, measurement_table.protocol, num_pairs=measurement_table.pairs, current=drive_current
        ),
    )
