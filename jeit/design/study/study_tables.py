"""Tables of a study file: type, range and unit of every key. Every combination of the values in lists is a point of the
study."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from jeit.design import defaults
from jeit.design.defaults import SHEET_ONLY_SCORES, ScoreName
from jeit.design.skin.names import ProtocolName
from jeit.design.skin.skin_file import (
    CELL,
    CONDUCTIVITY,
    CURRENT,
    DIAMETER,
    IMPEDANCE,
    LAYERS,
    PAIRS,
    SIDE,
    THICKNESS,
)
from jeit.design.skin.surface_tables import SURFACE, SurfaceTable, check_keys_of_surface
from jeit.files.schema import Number, SweptList, Table, Word, fault

# Maximum numbers of layouts and of points of a study, which are created before any computation and take milliseconds
# and kilobytes each.
_MAX_LAYOUTS, _MAX_POINTS = 2000, 100_000


class MaterialSweep(Table):
    """Table "skin": model, size and material of the skins."""

    name_in_messages = "a study"
    model: Literal["sheet", "layer"] = "sheet"
    width_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    height_mm: Annotated[float, SIDE] = 1e3 * defaults.SIDE
    thickness_mm: Annotated[list[float], THICKNESS] = Field(default=[1e3 * defaults.THICKNESS])
    conductivity_S_per_m: Annotated[list[float], CONDUCTIVITY] = Field(default=[defaults.CONDUCTIVITY])


class LayoutSweep(Table):
    """Table "electrodes": layouts, diameters and contact impedances. If a diameter or impedance is NaN, the values of
    the layout are used."""

    name_in_messages = "a study"
    layouts: SweptList[Word]
    diameter_mm: Annotated[list[float], DIAMETER] = Field(default=[math.nan])
    contact_impedance_ohm_m2: Annotated[list[float], IMPEDANCE] = Field(default=[math.nan])
    minimum_gap_mm: Annotated[float, Number(0, 1000, "mm")] = 0.0


class MeasurementSweep(Table):
    """Table "measurement": measurement protocols, current and noise."""

    name_in_messages = "a study"
    protocol: SweptList[ProtocolName] = Field(default=[defaults.PROTOCOL])
    pairs: Annotated[list[int], PAIRS] | None = None
    current_mA: Annotated[float, CURRENT] = 1e3 * defaults.CURRENT
    noise_V: Annotated[list[float], Number(1e-12, 1, "V")] = Field(default=[defaults.NOISE])


class TouchTable(Table):
    """Table "touch": shape of the touches, and grid of the touched positions."""

    name_in_messages = "a study"
    indentation: Literal["bell", "hemisphere"] = "bell"
    depth_mm: Annotated[float, Number(0.01, 100, "mm")] = 1e3 * defaults.DEPTH
    deviation_mm: Annotated[float, Number(0.1, 200, "mm")] = 1e3 * defaults.DEVIATION
    diameter_mm: Annotated[float, Number(0.1, 200, "mm")] = 1e3 * defaults.BALL_DIAMETER
    contrast: Annotated[float, Number(0, defaults.MAX_CONTRAST)] = defaults.CONTRAST
    exact: bool = False
    columns: Annotated[int, Number(1, 1000)] = defaults.NUM_STUDY_PLACES_PER_SIDE
    rows: Annotated[int, Number(1, 1000)] = defaults.NUM_STUDY_PLACES_PER_SIDE


class CellsSweep(Table):
    """Table "mesh": cell sizes, and number of layers of cells."""

    name_in_messages = "a study"
    cell_mm: Annotated[list[float], CELL] = Field(default=[1e3 * defaults.CELL_SIZE])
    layers: Annotated[int, LAYERS] = defaults.NUM_LAYERS


class ScoresTable(Table):
    """Table "scores": scores to be computed, and their parameters."""

    name_in_messages = "a study"
    wanted: SweptList[ScoreName] = Field(default=["minimum", "mean", "uniformity"])
    num_taxels: Annotated[int, Number(1, 10_000)] = defaults.NUM_TAXELS
    threshold: Annotated[float, Number(0.01, 0.99)] = defaults.THRESHOLD
    correlation_mm: Annotated[float, Number(0.1, 1000, "mm")] = 1e3 * defaults.CORRELATION
    seed: Annotated[int, Number(0, 2**31 - 1)] = 0


class StudyTable(Table):
    """All tables of a study file."""

    name_in_messages = "a study"
    name: Word = "study"
    chunk_points: Annotated[int, Number(1, 4096)] = 16
    skin: MaterialSweep = MaterialSweep()
    surface: Annotated[SurfaceTable | None, SURFACE] = None
    electrodes: LayoutSweep = Field(default_factory=dict, validate_default=True)
    measurement: MeasurementSweep = MeasurementSweep()
    touch: TouchTable = TouchTable()
    mesh: CellsSweep = CellsSweep()
    scores: ScoresTable = ScoresTable()

    @property
    def num_layouts(self) -> int:
        """Number of combinations of layouts, diameters and contact impedances."""
        layout_sweep = self.electrodes
        return math.prod(
            map(len, (layout_sweep.layouts, layout_sweep.diameter_mm, layout_sweep.contact_impedance_ohm_m2))
        )

    @property
    def num_points(self) -> int:
        """Number of points of the study, that is of all combinations of swept values."""
        material_sweep, measurement_sweep = self.skin, self.measurement
        other_value_lists = (
            measurement_sweep.protocol,
            measurement_sweep.pairs or [0],
            measurement_sweep.noise_V,
            self.mesh.cell_mm,
        )
        return self.num_layouts * math.prod(
            map(len, (material_sweep.thickness_mm, material_sweep.conductivity_S_per_m, *other_value_lists))
        )

    def value_of(self, key: str) -> Any:
        """Value of the key with the dotted name `key`, such as "mesh.layers"."""
        section_name, key_name = key.split(".")
        return getattr(getattr(self, section_name), key_name)

    @model_validator(mode="after")
    def _check_required_values(self) -> "StudyTable":
        for dependent_key, (required_key, required_values) in _REQUIRED_VALUES.items():
            section_name, key_name = dependent_key.split(".")
            required_key_value = self.value_of(required_key)
            values_of_required_key = (
                required_key_value if isinstance(required_key_value, list) else [required_key_value]
            )
            if key_name in getattr(self, section_name).model_fields_set and not set(required_values) & set(
                values_of_required_key
            ):
                raise fault(
                    f"has no effect: it applies where {required_key} is {' or '.join(map(repr, required_values))}, "
                    f"and that is {', '.join(map(repr, values_of_required_key))}; leave it out, or change the other.",
                    dependent_key,
                )
        return self

    @model_validator(mode="after")
    def _check_keys_of_surface(self) -> "StudyTable":
        check_keys_of_surface(self.surface, self.skin, self.mesh)
        given_sides = {"width_mm", "height_mm"} & self.skin.model_fields_set
        if len(given_sides) == 1:
            raise fault("is given alone; give both skin.width_mm and skin.height_mm.", f"skin.{given_sides.pop()}")
        return self

    @model_validator(mode="after")
    def _check_num_points(self) -> "StudyTable":
        num_layouts, num_points = self.num_layouts, self.num_points
        if num_layouts > _MAX_LAYOUTS:
            raise fault(
                f"makes {num_layouts:,} layouts with diameters and contact impedances, more than the {_MAX_LAYOUTS:,} "
                "of a study; split it into several.",
                "electrodes.layouts",
            )
        if num_points > _MAX_POINTS:
            raise fault(
                f"makes {num_points:,} points with the other lists, more than the {_MAX_POINTS:,} of a study; split it "
                "into several.",
                "electrodes.layouts",
            )
        return self


# Keys of a study file that have an effect only if a second key has one of the listed values.
_REQUIRED_VALUES: dict[str, tuple[str, tuple[str, ...]]] = {
    "mesh.layers": ("skin.model", ("layer",)),
    "touch.deviation_mm": ("touch.indentation", ("bell",)),
    "touch.diameter_mm": ("touch.indentation", ("hemisphere",)),
    "measurement.pairs": ("measurement.protocol", ("two-terminal",)),
    "measurement.noise_V": ("scores.wanted", ("blind_spot", *SHEET_ONLY_SCORES)),
    "scores.num_taxels": ("scores.wanted", ("taxels",)),
    "scores.threshold": ("scores.wanted", ("taxels",)),
    "scores.seed": ("scores.wanted", ("taxels",)),
    "scores.correlation_mm": ("scores.wanted", ("information", "mean_variance", "largest_variance")),
}
