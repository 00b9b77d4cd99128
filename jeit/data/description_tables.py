"""The sections of a description file as tables: type, range and unit of each key."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import FailFast, Field, model_validator

from jeit.files import MAX_ELECTRODES
from jeit.files.schema import Number, Numbers, Table, TableOfKind, Word, Words, fault
from jeit.inverse import Uncertainty

# Maximum numbers of vertices of a polygon and of its holes: each side is compared with every other side, and each hole
# with every other hole.
_MAX_VERTICES, _MAX_HOLES = 4096, 64
_ELECTRODE_COUNT = Number(2, MAX_ELECTRODES, beyond="Channels grow with its square; in Python there is no such limit.")
_ELECTRODE_INDEX = Number(0, MAX_ELECTRODES)

Length = Annotated[float, Number(1e-9, 1e3, "m")]
Sizes = Annotated[np.ndarray, Numbers(((1, MAX_ELECTRODES),), 1e-9, 1e3, "m", single=True)]
PlanePoint = Annotated[np.ndarray, Numbers(((2, 2),), -1e3, 1e3, "m")]
PolygonVertices = Annotated[np.ndarray, Numbers(((3, _MAX_VERTICES), (2, 2)), -1e3, 1e3, "m")]
Positions = Annotated[np.ndarray, Numbers(((1, MAX_ELECTRODES), (2, 3)), -1e3, 1e3, "m")]
# A single number means one ring of electrodes; likewise, a single size applies to all electrodes.
Levels = Annotated[np.ndarray, Numbers(((1, MAX_ELECTRODES),), 0, 1e3, "m", single=True)]
# For electrodes on the edge of a sheet the contact impedance is in ohm·m.
Impedances = Annotated[np.ndarray, Numbers(((1, MAX_ELECTRODES),), 1e-15, 1e12, "ohm·m²", single=True)]
Patterns = Annotated[np.ndarray, Numbers(((1, math.inf), (2, MAX_ELECTRODES)), -1e12, 1e12)]
Pairs = Annotated[np.ndarray, Numbers(((1, math.inf), (2, 2)), 0, MAX_ELECTRODES, kind=int)]
Indices = Annotated[np.ndarray, Numbers(((1, math.inf),), 0, 2**31 - 1, kind=int)]
Gains = Annotated[np.ndarray, Numbers(((1, math.inf),), 1e-6, 1e6)]
Reading = Literal["adjacent", "mean", "mean-removed", "against"]
SelectionMask = Annotated[np.ndarray, Numbers(((1, math.inf), (1, math.inf)), kind=bool)]


_UNKNOWN_IMPEDANCE = "; if it is not known, write {}, which the reference frame corrects"


class DiskTable(Table):
    """Section `[geometry]` of a disk or, with a thickness, of a cylinder."""

    name_in_messages = "a disk"
    shape: Literal["disk"]
    radius: Length
    centre: PlanePoint = np.zeros(2)
    thickness: Length | None = None


class RectangleTable(Table):
    """Section `[geometry]` of a rectangle or, with a thickness, of a box."""

    name_in_messages = "a rectangle"
    shape: Literal["rectangle"]
    width: Length
    height: Length
    centre: PlanePoint = np.zeros(2)
    thickness: Length | None = None


class PolygonTable(Table):
    """Section `[geometry]` of a polygon or, with a thickness, of an upright prism over the polygon."""

    name_in_messages = "a polygon"
    shape: Literal["polygon"]
    vertices: PolygonVertices
    holes: Annotated[list[PolygonVertices], FailFast()] = Field(default=[], max_length=_MAX_HOLES)
    thickness: Length | None = None

    @model_validator(mode="after")
    def _check_size(self) -> "PolygonTable":
        num_points = len(self.vertices) + sum(map(len, self.holes))
        if num_points > _MAX_VERTICES:
            raise fault(
                f"and holes are {num_points} points, and each side is compared with every other: give {_MAX_VERTICES} "
                "at most, or a mesh.",
                "vertices",
            )
        return self


class BoxTable(Table):
    """Section `[geometry]` of a box."""

    name_in_messages = "a box"
    shape: Literal["box"]
    width: Length
    depth: Length
    height: Length


class CylinderTable(Table):
    """Section `[geometry]` of a cylinder."""

    name_in_messages = "a cylinder"
    shape: Literal["cylinder"]
    radius: Length
    height: Length


class MeshTable(Table):
    """Section `[geometry]` of a mesh in a file beside the description. `scale`: length of the mesh's unit in metres."""

    name_in_messages = "a mesh"
    mesh: Word
    scale: Annotated[float, Number(1e-9, 1e3, "m")] = 1.0


class PlacedTable(Table):
    """Base class of the sections `[electrodes]` with positions, i.e. of all kinds except facets."""

    layout: Literal["ring", "perimeter"] | None = None
    number: Annotated[int, _ELECTRODE_COUNT] | None = None
    start_angle_degrees: Annotated[float, Number(-3600, 3600, "degrees")] = 90.0
    clockwise: bool = False
    start: Annotated[float, Number(-1e3, 1e3, "m")] = 0.0
    levels: Levels | None = None
    positions: Positions | None = None

    @model_validator(mode="after")
    def _check_positions(self) -> "PlacedTable":
        layout_keys = ("layout", "number", "start_angle_degrees", "clockwise", "start", "levels")
        if self.positions is not None:
            unused_keys = [layout_key for layout_key in layout_keys if layout_key in self.model_fields_set]
            if unused_keys:
                raise fault("has no effect beside positions; leave out one or the other.", unused_keys[0])
        elif self.layout is None:
            raise fault("is missing; give it, or positions.", "layout")
        elif self.number is None:
            raise fault("is missing; give it: how many electrodes.", "number")
        elif self.layout == "ring" and "start" in self.model_fields_set:
            raise fault('has no effect on layout = "ring"; give start_angle_degrees.', "start")
        elif self.layout == "perimeter" and "start_angle_degrees" in self.model_fields_set:
            raise fault('has no effect on layout = "perimeter"; give start, in metres.', "start_angle_degrees")
        return self


class BoundaryTable(PlacedTable):
    """Section `[electrodes]` of electrodes that are arcs on the edge of a sheet. `contact_impedance` in ohm·m."""

    name_in_messages = "electrodes of kind 'boundary'"
    hints: ClassVar[dict[str, str]] = {"contact_impedance": _UNKNOWN_IMPEDANCE.format("0.01 (ohm·m)")}
    kind: Literal["boundary"] = "boundary"
    width: Sizes
    contact_impedance: Impedances


class DiscTable(PlacedTable):
    """Section `[electrodes]` of electrodes that are discs."""

    name_in_messages = "electrodes of kind 'disc'"
    hints: ClassVar[dict[str, str]] = {"contact_impedance": _UNKNOWN_IMPEDANCE.format("1e-3 (ohm·m²)")}
    kind: Literal["disc"]
    radius: Sizes
    contact_impedance: Impedances


class PatchTable(PlacedTable):
    """Section `[electrodes]` of electrodes that are rectangles on a solid."""

    name_in_messages = "electrodes of kind 'patch'"
    hints: ClassVar[dict[str, str]] = {"contact_impedance": _UNKNOWN_IMPEDANCE.format("1e-3 (ohm·m²)")}
    kind: Literal["patch"]
    width: Sizes
    height: Sizes
    contact_impedance: Impedances


class PointTable(PlacedTable):
    """Section `[electrodes]` of electrodes that are points."""

    name_in_messages = "electrodes of kind 'point'"
    kind: Literal["point"]


class FacetsTable(Table):
    """Section `[electrodes]` of electrodes that are named groups of boundary facets of a mesh."""

    name_in_messages = "electrodes of kind 'facets'"
    hints: ClassVar[dict[str, str]] = {"contact_impedance": _UNKNOWN_IMPEDANCE.format("1e-3 (ohm·m²)")}
    kind: Literal["facets"]
    tags: Annotated[list[Word], Field(min_length=1, max_length=MAX_ELECTRODES), FailFast()]
    contact_impedance: Impedances


class DrivenTable(Table):
    """Base class of the sections `[protocol]` with a current amplitude."""

    number: Annotated[int, _ELECTRODE_COUNT] | None = None
    name: Word | None = None
    current: Annotated[float, Number(1e-15, 1e12, "in current_unit")] | None = None
    current_from_name: Word | None = None
    current_unit: Literal["A", "mA", "uA", "µA"] = "A"

    @model_validator(mode="after")
    def _check_current(self) -> "DrivenTable":
        name_pattern = self.current_from_name
        if name_pattern is None and self.current is None:
            raise fault(
                "is missing; give it, or current_from_name. If it is not known, write 1e-3 (A): it scales "
                "conductivities alone, and relative changes not at all.",
                "current",
            )
        if name_pattern is not None and self.current is not None:
            raise fault("has no effect beside current_from_name; leave out one or the other.", "current")
        if name_pattern is not None and name_pattern.count("{current}") != 1:
            raise fault(
                "must be the file's name with {current} in place of the number, once, and * for anything, such as "
                f"'*_{{current}}uA_*' (older jeits took a regular expression); it is {name_pattern[:60]!r}.",
                "current_from_name",
            )
        return self


class AdjacentTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.adjacent`."""

    name_in_messages = "the protocol 'adjacent'"
    kind: Literal["adjacent"]
    driven_electrodes: bool = False
    reciprocal: Literal["all", "half"] = "all"
    order: Literal["rotating", "fixed"] = "rotating"


class SkipTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.skip`."""

    name_in_messages = "the protocol 'skip'"
    kind: Literal["skip"]
    skipped: Annotated[int, _ELECTRODE_INDEX]
    measurement_skipped: Annotated[int, _ELECTRODE_INDEX] | None = None
    driven_electrodes: bool = False
    reciprocal: Literal["all", "half"] = "all"
    order: Literal["rotating", "fixed"] = "rotating"


class OppositeTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.opposite`."""

    name_in_messages = "the protocol 'opposite'"
    kind: Literal["opposite"]
    drives: Literal["distinct", "all"] = "distinct"
    driven_electrodes: bool = False
    order: Literal["rotating", "fixed"] = "rotating"


class AgainstOneTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.all_against_one`."""

    name_in_messages = "the protocol 'all_against_one'"
    kind: Literal["all_against_one"]
    common: Annotated[int, _ELECTRODE_INDEX] = 0
    measurement: Literal["common", "adjacent"] = "common"
    driven_electrodes: bool | None = None
    reciprocal: Literal["all", "half"] = "all"


class ReferenceTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.reference_electrode`. `number`: boundary electrodes."""

    name_in_messages = "the protocol 'reference_electrode'"
    kind: Literal["reference_electrode"]
    skipped: Annotated[int, _ELECTRODE_INDEX] = 0
    reference: Annotated[int, _ELECTRODE_INDEX] | None = None
    driven_electrodes: bool = False
    order: Literal["rotating", "fixed"] = "rotating"


class TwoTerminalTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.two_terminal`."""

    name_in_messages = "the protocol 'two_terminal'"
    kind: Literal["two_terminal"]
    pairs: Pairs | None = None


class AllAtOnceTable(DrivenTable):
    """Base class of sections `[protocol]` that drive all electrodes at once and state how potentials are read."""

    measurement: Reading = "mean-removed"
    reference: Annotated[int, _ELECTRODE_INDEX] | None = None


class TrigonometricTable(AllAtOnceTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.trigonometric`."""

    name_in_messages = "the protocol 'trigonometric'"
    kind: Literal["trigonometric"]
    measurement: Reading = "adjacent"


class HaarTable(AllAtOnceTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.haar`."""

    name_in_messages = "the protocol 'haar'"
    kind: Literal["haar"]


class OptimalTable(Table):
    """Section `[protocol]` with the arguments of `jeit.protocol.optimal`. `transfer`, `other`: transfer impedances in
    ohm; `drives`: number of drive patterns; `power` in watts."""

    name_in_messages = "the protocol 'optimal'"
    kind: Literal["optimal"]
    name: Word | None = None
    transfer: Patterns
    other: Patterns | None = None
    drives: Annotated[int, Number(1, MAX_ELECTRODES)] | None = None
    power: Annotated[float, Number(1e-15, 1e3, "W")] | None = None
    measurement: Reading = "mean-removed"
    reference: Annotated[int, _ELECTRODE_INDEX] | None = None
    current: Annotated[float, Number(1e-15, 1e12, "in current_unit")] | None = None
    current_unit: Literal["A", "mA", "uA", "µA"] = "A"

    @model_validator(mode="after")
    def _check_bound(self) -> "OptimalTable":
        if (self.current is None) == (self.power is None):
            raise fault("or power: give one of them, the most of an electrode or of a pattern.", "current")
        return self


class MeasuredTable(Table):
    """Section `[protocol]` for currents that are stored in the data file. `drive_key`, `measurement_key`: names of the
    matrices in the data file."""

    name_in_messages = "a protocol of measured currents"
    kind: Literal["measured"]
    name: Word | None = None
    drive_key: Word = "current_patterns"
    measurement_key: Word | None = None
    patterns_in: Literal["columns", "rows"] = "columns"
    measurement: Reading = "mean-removed"
    reference: Annotated[int, _ELECTRODE_INDEX] | None = None
    current_unit: Literal["A", "mA", "uA", "µA"] = "A"


class BipolarTable(DrivenTable):
    """Section `[protocol]` with the arguments of `jeit.protocol.bipolar`."""

    name_in_messages = "the protocol 'bipolar'"
    kind: Literal["bipolar"]
    drive_pairs: Pairs
    measurement_pairs: Pairs
    driven_electrodes: bool = False
    reciprocal: Literal["all", "half"] = "all"


class MatricesTable(Table):
    """Section `[protocol]` that combines every drive pattern, in amperes, with the measurement patterns selected by
    `select`."""

    name_in_messages = "a protocol of matrices"
    kind: Literal["matrices"]
    name: Word = "matrices"
    drive: Patterns
    measurement: Patterns
    select: SelectionMask | None = None


class ChannelsTable(Table):
    """Section `[protocol]` that specifies for each channel the indices, counted from 0, of its drive pattern (in
    amperes) and of its measurement pattern."""

    name_in_messages = "a protocol of channels"
    kind: Literal["channels"]
    name: Word = "channels"
    drive: Patterns
    measurement: Patterns
    drive_index: Indices
    measurement_index: Indices


class DataTable(Table):
    """Section `[data]`: arrangement of the numbers in the data file."""

    name_in_messages = "[data]"
    frames_in: Literal["rows", "columns"] | None = None
    delimiter: Annotated[str, Field(max_length=10)] | None = None
    skip_rows: Annotated[int, Number(0, 10**9)] | None = None
    time_column: bool | None = None
    complex_pairs: bool = False
    component: Literal["real", "imaginary", "magnitude", "complex"] = "real"
    gain: Annotated[float, Number(1e-12, 1e12)] = 1.0
    gains: Gains | None = None
    polarity: Literal["normal", "reversed"] | None = None
    unit: Literal["V", "mV", "uV", "µV"] = "V"
    saturation: Annotated[float, Number(1e-12, 1e12, "in the file's unit")] | None = None
    frame_names: Words = Field(default=[])
    keys: Words = Field(default=[])
    axes: Annotated[list[Literal["electrodes", "patterns", "frames"]], Field(max_length=3)] = Field(default=[])
    frames: Literal["all", "mean"] = "all"
    frame_rate: Annotated[float, Number(1e-9, 1e9, "frames in a second")] | None = None

    @model_validator(mode="after")
    def _check_axes(self) -> "DataTable":
        if self.axes and sorted(self.axes) != ["electrodes", "frames", "patterns"]:
            raise fault("must be electrodes, patterns and frames, each once, in the order of the array.", "axes")
        if self.frames == "mean" and (self.frame_names or self.frame_rate is not None):
            unused_key = "frame_names" if self.frame_names else "frame_rate"
            raise fault("has no use where the frames are averaged; leave it out.", unused_key)
        return self


class NotesTable(Table):
    """Section `[notes]`: sentences that are copied to the notes of the measurement."""

    name_in_messages = "[notes]"
    text: Annotated[list[Annotated[str, Field(max_length=10_000)]], FailFast()] = Field(default=[])


class UncertaintyTable(Table):
    """Section `[uncertainty]`: standard deviations of the described properties of the sensor."""

    name_in_messages = "[uncertainty]"
    position: Annotated[float, Number(0, 1e3, "m")] | None = None
    position_degrees: Annotated[float, Number(0, 90, "degrees")] | None = None
    contact_drift_percent: Annotated[float, Number(0, 1000, "%")] = 100 * Uncertainty().drift
    size_percent: Annotated[float, Number(0, 100, "%")] = 100 * Uncertainty().size
    other_percent: Annotated[float, Number(0, 100, "%")] = 100 * Uncertainty().other

    @model_validator(mode="after")
    def _check_position(self) -> "UncertaintyTable":
        if self.position is not None and self.position_degrees is not None:
            raise fault("says the same as position; give one of the two.", "position_degrees")
        return self


GeometryTable = DiskTable | RectangleTable | PolygonTable | BoxTable | CylinderTable | MeshTable
ElectrodesTable = BoundaryTable | DiscTable | PatchTable | PointTable | FacetsTable
ConstructedTable = (
    AdjacentTable | SkipTable | OppositeTable | AgainstOneTable | ReferenceTable | TwoTerminalTable | TrigonometricTable
    | HaarTable | BipolarTable
)  # fmt: skip
ProtocolTable = ConstructedTable | OptimalTable | MatricesTable | ChannelsTable | MeasuredTable

_SHAPE_TABLES = TableOfKind(
    "shape", DiskTable, RectangleTable, PolygonTable, BoxTable, CylinderTable,
    alternative_key="mesh", alternative_table=MeshTable,
    synonyms={"circle": "disk", "tank": "cylinder", "tube": "cylinder", "cube": "box", "cuboid": "box",
              "square": "rectangle"},
)  # fmt: skip
_ELECTRODES_TABLES = TableOfKind(
    "kind", BoundaryTable, DiscTable, PatchTable, PointTable, FacetsTable,
    synonyms={"strip": "patch", "plate": "patch", "bar": "patch", "rectangle": "patch", "square": "patch",
              "circle": "disc", "round": "disc", "arc": "boundary", "edge": "boundary", "mesh": "facets"},
)  # fmt: skip
_PROTOCOL_TABLES = TableOfKind(
    "kind", AdjacentTable, SkipTable, OppositeTable, AgainstOneTable, ReferenceTable, TwoTerminalTable,
    TrigonometricTable, HaarTable, OptimalTable, BipolarTable, MatricesTable, ChannelsTable, MeasuredTable,
)  # fmt: skip


class DescriptionTable(Table):
    """All sections of a description file."""

    name_in_messages = "a description"
    title: Annotated[str, Field(max_length=1000)] = ""
    geometry: Annotated[GeometryTable, _SHAPE_TABLES] | None = None
    electrodes: Annotated[ElectrodesTable, _ELECTRODES_TABLES] | None = None
    protocol: Annotated[ProtocolTable, _PROTOCOL_TABLES] | None = None
    data: DataTable = DataTable()
    notes: NotesTable = NotesTable()
    uncertainty: UncertaintyTable | None = None
