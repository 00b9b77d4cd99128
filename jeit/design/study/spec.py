"""`Study`: a sweep over electrode layouts and skin parameters, read from a TOML file and checked."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jeit.design import defaults
from jeit.design.defaults import SHEET_ONLY_SCORES
from jeit.design.skin.described_surface import described_surface, surface_identity, typical_cell_size
from jeit.design.skin.names import ProtocolName, curved_layout, is_layout_file, skin_protocol, study_layout
from jeit.design.skin.skin import check_cell_size, longer_side, skin_electrodes
from jeit.design.skin.touch_shapes import AbstractIndentation, Bell, Hemisphere
from jeit.electrodes import FaceDiscs, SheetDiscs, SurfaceDiscs
from jeit.files import check_memory, read_text
from jeit.files.limits import parsed_toml
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh import Mesh, Rectangle
from jeit.mesh.geodesic import Triangles
from jeit.protocol import Protocol

if TYPE_CHECKING:
    from jeit.design.study.study_tables import StudyTable

LayoutFactory = Callable[[str, float, float, float], Layout | SurfaceLayout]
"""Function that creates a layout from name, diameter, contact impedance and minimum gap, as `study_layout` does."""

# Version of the results of studies: to be increased if the same study would give different results.
_FINGERPRINT_VERSION = 2
# Minimum number of electrodes for each measurement protocol.
_MIN_ELECTRODES = {"adjacent": 4, "opposite": 4, "two-terminal": 2}
# Maximum size of a study file, and of the study's store of results, bytes.
_MAX_STUDY_BYTES, _MAX_STORE_BYTES = 2**22, 20e9


class PointShape(NamedTuple):
    """Parameters that points must have in common to share a mesh and a batch; fields as in `StudyPoint`. `thickness` is
    0 for sheets, whose mesh does not depend on the thickness."""

    electrodes: int
    protocol: str
    pairs: int
    cell_size: float
    layers: int
    thickness: float


@dataclass(frozen=True, eq=False)
class StudyPoint:
    """One skin of a study: its `layout` (with diameters and contact impedances) and other parameters, in SI units.

    `pairs`: number of pairs of nearest electrodes that a two-terminal `protocol` measures, 0 for all pairs. `layers`:
    number of layers of cells, 0 for a sheet.
    """

    layout: Layout | SurfaceLayout
    thickness: float
    conductivity: float
    protocol: ProtocolName
    pairs: int
    noise: float
    cell_size: float
    layers: int

    @property
    def shape(self) -> PointShape:
        """Parameters that the points of a batch have in common."""
        thickness = self.thickness if self.layers else 0.0
        return PointShape(self.layout.num_electrodes, self.protocol, self.pairs, self.cell_size, self.layers, thickness)

    @property
    def electrodes(self) -> SheetDiscs | SurfaceDiscs | FaceDiscs:
        """Electrodes of the point's forward model, in the sheet or on the bottom of the layer."""
        return skin_electrodes(self.layout, self.layers)

    def measurement_protocol(self, current: float) -> Protocol:
        """Measurement protocol of the point, with an injected `current` in amperes."""
        return skin_protocol(self.layout, self.protocol, num_pairs=self.pairs, current=current)

    @property
    def coordinates(self) -> dict[str, str | int | float]:
        """The point's values of the swept parameters, by their names in the study file; mean values if the electrodes
        differ."""
        return {
            "layout": self.layout.name,
            "electrodes": self.layout.num_electrodes,
            "diameter_mm": _remove_rounding_error(1e3 * np.mean(self.layout.diameters)),
            "contact_impedance_ohm_m2": _remove_rounding_error(np.mean(np.asarray(self.layout.contact_impedance))),
            "thickness_mm": _remove_rounding_error(1e3 * self.thickness),
            "conductivity_S_per_m": self.conductivity,
            "protocol": self.protocol,
            "pairs": self.pairs,
            "noise_V": self.noise,
            "cell_mm": _remove_rounding_error(1e3 * self.cell_size),
        }


@dataclass(frozen=True, eq=False)
class Study:
    """A sweep over every combination of the lists in a study file; create a study with `read_study`.

    **Fields**

    - `name`: name of the study; `points`: the skins, in the order of the file's lists, where the last list varies
      fastest.
    - `outline`: outline of the skins; for curved skins, the surface meshed with the first cell size.
    - `indentation`, `contrast`: the touch, as in `touched_cells`; `exact`: whether voltage changes are exact instead of
      linearised; `columns`, `rows`: size of the grid of touched positions.
    - `current`: injected current, amperes; `scores`: names of the scores that are computed.
    - `num_taxels`, `threshold`, `seed`: as in `find_taxels`; `correlation`: as in `TouchPrior.create`, metres.
    - `chunk_points`: maximum number of points in a chunk; `text`: content of the study file; `surface`: text that
      identifies the surface of curved skins, empty for flat skins.

    Two studies compare equal if they have the same results.
    """

    name: str
    points: tuple[StudyPoint, ...]
    outline: Rectangle | Triangles
    indentation: AbstractIndentation
    contrast: float
    exact: bool
    columns: int
    rows: int
    current: float
    scores: tuple[str, ...]
    num_taxels: int
    threshold: float
    correlation: float
    seed: int
    chunk_points: int
    text: str
    surface: str = ""

    @cached_property
    def chunks(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the points of each chunk: at most `chunk_points` points, all with the same shape."""
        points_by_shape: dict[tuple, list[int]] = {}
        for point_number, point in enumerate(self.points):
            points_by_shape.setdefault(point.shape, []).append(point_number)
        max_points = self.chunk_points
        return tuple(
            tuple(point_numbers[first_point : first_point + max_points])
            for point_numbers in points_by_shape.values()
            for first_point in range(0, len(point_numbers), max_points)
        )

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 hash of everything that determines the results, without comments and the study's name."""
        outline_values = [self.surface] if isinstance(self.outline, Triangles) else [*map(float, self.outline.extent)]
        hashed_values = [_FINGERPRINT_VERSION, *outline_values, type(self.indentation).__name__]
        hashed_values += [*map(float, vars(self.indentation).values()), self.columns, self.rows, self.current]
        hashed_values += [self.contrast, self.exact, *self.scores, self.num_taxels, self.threshold, self.correlation]
        hashed_values += [self.seed, self.chunk_points]
        for point in self.points:
            hashed_values += [point.coordinates, point.layers]
            # The hash omits positions of built-in layouts, since their last digits depend on the compilation.
            if is_layout_file(point.layout.name):
                arrays = (point.layout.centres, point.layout.diameters, point.layout.contact_impedance)
                hashed_values += [(np.round(array, 12) + 0.0).tolist() for array in map(np.asarray, arrays)]
        return hashlib.sha256(json.dumps(hashed_values).encode()).hexdigest()

    def __eq__(self, other) -> bool:
        return isinstance(other, Study) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)


def read_study(path: str | Path) -> Study:
    """Read the study that a TOML file describes. Lengths are in millimetres. Keys with lists are swept: every
    combination of their values is a point, that is a skin::

        name = "32 electrodes: inside or around"
        [skin]
        model = "sheet"                      # or "layer": solid, electrodes on its bottom; mesh.layers (default 5)
        width_mm = 200                       # with height_mm: a rectangle about the origin
        thickness_mm = [5, 10]
        conductivity_S_per_m = 1.0
        [surface]                            # for curved skins, without width and height; layouts: inner-N, .csv files
        kind = "tube"                        # or "forearm", "sphere", "cap", "bent sheet"; or file = "arm.stl" and unit
        radius_mm = 30
        height_mm = 120
        outward = true                       # false: the layer is inside the surface
        [electrodes]
        layouts = ["park-inner", "park-boundary", "grid-8x4", "perimeter-32", "inner-32", "mine.csv"]
        diameter_mm = [6, 8]                 # and contact_impedance_ohm_m2; default: as in the file, or 6 and 1e-4
        minimum_gap_mm = 2
        [measurement]
        protocol = "two-terminal"            # or "adjacent", "opposite"
        pairs = [0, 94]                      # number of nearest two-terminal pairs; 0: all; default: 94 or fewer
        current_mA = 1
        noise_V = 2e-5
        [touch]
        indentation = "bell"                 # depth_mm, deviation_mm; or "hemisphere": depth_mm, diameter_mm
        contrast = 0                         # factor for the conductivity where touched; above 1 for a conductor
        exact = false                        # true: exact voltage changes, computed one point after the other
        columns = 24                         # and rows, of the grid of touched positions
        [mesh]
        cell_mm = 4.5
        [scores]
        wanted = ["minimum", "mean", "uniformity", "blind_spot", "taxels"]    # num_taxels, threshold, seed
        # for sheets also "information", "mean_variance", "largest_variance", "localisation_error"; correlation_mm

    Only the key `electrodes.layouts` is required; the defaults of other keys are those of `jeit.design.defaults`. Paths
    of files are relative to the study file.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError` if the file does not exist. Raises `ValueError`, naming the keys and a remedy, for keys
    that are unknown or have no effect in combination with other keys, and for values of the wrong type or out of range
    (such as metres for millimetres). Also raises `ValueError` for electrodes that overlap, impossible spacings, layouts
    whose number of electrodes does not suit a protocol, and studies that would take too much memory or disk space.

    **Example:**

    ```python
    study = read_study("study.toml")
    print(study.name, len(study.points))
    ```
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    # Imported here, since the import of pydantic takes longer than most operations on a study file.
    from jeit.design.study.study_tables import StudyTable
    from jeit.files.limits import faults_message
    from jeit.files.schema import validated

    text = read_text(path, max_bytes=_MAX_STUDY_BYTES)
    table = validated(StudyTable, parsed_toml(text, path.name), path.name)
    try:
        return _study_from_table(text, table, path.parent)
    except ValueError as error:
        raise ValueError(faults_message(path.name, [str(error)])) from None


def _study_from_table(text: str, table: StudyTable, folder: Path) -> Study:
    skin, measurement, scores = table.skin, table.measurement, table.scores
    indentation = _create_indentation(table)
    _check_touches(table)
    layers = table.mesh.layers if skin.model == "layer" else 0
    electrodes = table.electrodes
    minimum_gap = 1e-3 * electrodes.minimum_gap_mm
    cell_sizes, outline, layout_factories = _surface_meshes(table, folder)
    # Every layout is created once for each mesh; on flat skins, a single layout serves all meshes.
    layouts = [
        [create_layout(name, diameter, contact_impedance, minimum_gap) for create_layout in layout_factories]
        for name, diameter, contact_impedance in itertools.product(
            electrodes.layouts, _to_metres(electrodes.diameter_mm), electrodes.contact_impedance_ohm_m2
        )
    ]
    for layouts_on_meshes in layouts:
        for layout in layouts_on_meshes:
            _check_layout(layout, outline, layers, table)
    points = tuple(
        StudyPoint(
            layouts_on_meshes[mesh_index % len(layouts_on_meshes)],
            thickness,
            conductivity,
            protocol,
            _num_pairs(layouts_on_meshes[0], protocol, pairs),
            noise,
            cell_sizes[mesh_index],
            layers,
        )
        for layouts_on_meshes, thickness, conductivity, protocol, pairs, noise, mesh_index in itertools.product(
            layouts,
            _to_metres(skin.thickness_mm),
            skin.conductivity_S_per_m,
            measurement.protocol,
            measurement.pairs or [None],
            measurement.noise_V,
            range(len(cell_sizes)),
        )
    )
    return Study(
        name=table.name,
        points=points,
        outline=outline,
        indentation=indentation,
        contrast=table.touch.contrast,
        exact=table.touch.exact,
        columns=table.touch.columns,
        rows=table.touch.rows,
        current=1e-3 * measurement.current_mA,
        scores=tuple(scores.wanted),
        num_taxels=scores.num_taxels,
        threshold=scores.threshold,
        correlation=1e-3 * scores.correlation_mm,
        seed=scores.seed,
        chunk_points=table.chunk_points,
        text=text,
        surface="" if table.surface is None else surface_identity(table.surface, folder),
    )


def _create_indentation(table: StudyTable) -> AbstractIndentation:
    touch, min_thickness_mm = table.touch, min(table.skin.thickness_mm)
    if touch.depth_mm >= min_thickness_mm:
        raise ValueError(
            f"touch.depth_mm is {touch.depth_mm:g}, and the skin {min_thickness_mm:g} mm thick; press less."
        )
    if touch.contrast == 1:
        raise ValueError(
            "touch.contrast is 1, which changes nothing; take 0 for an insulator, above 1 for a conductor."
        )
    if touch.indentation == "bell":
        return Bell(1e-3 * touch.depth_mm, 1e-3 * touch.deviation_mm)
    if touch.depth_mm > touch.diameter_mm / 2:
        raise ValueError(
            f"touch.depth_mm is {touch.depth_mm:g}, and a hemisphere {touch.diameter_mm:g} mm across goes in no deeper "
            f"than {touch.diameter_mm / 2:g}; press less, or give a larger touch.diameter_mm."
        )
    return Hemisphere(1e-3 * touch.depth_mm, 1e-3 * touch.diameter_mm)


def _check_touches(table: StudyTable) -> None:
    """Check that there are enough touches for the scores, and that disk space and memory suffice for the results and
    the computation."""
    scores, num_touches = table.scores, table.touch.columns * table.touch.rows
    sheet_scores = [score_name for score_name in SHEET_ONLY_SCORES if score_name in scores.wanted]
    num_bytes = 8.0 * table.num_points * num_touches
    if num_bytes > _MAX_STORE_BYTES:
        raise ValueError(
            f"touch.columns × touch.rows × {table.num_points:,} points are {num_bytes / 1e9:.3g} GB of results, more "
            f"than the {_MAX_STORE_BYTES / 1e9:g} GB of a study; ask for fewer, or split the study."
        )
    if "taxels" in scores.wanted:
        if scores.num_taxels > num_touches:
            raise ValueError(
                f"scores.num_taxels is {scores.num_taxels}, and there are {num_touches} touches; ask for fewer."
            )
        check_memory("scores.num_taxels × touch.columns × touch.rows", 8.0 * scores.num_taxels * num_touches)
    if not sheet_scores:
        return
    if table.skin.model == "layer":
        raise ValueError(
            f"scores.wanted has {', '.join(sheet_scores)}, known for sheets only, and skin.model is 'layer'; leave "
            "them out, or take 'sheet'."
        )
    # Memory for the covariance matrix of all touches and for its eigendecomposition.
    check_memory(
        f"scores.wanted = {sheet_scores[0]!r} of {num_touches:,} touches (columns × rows)", 24.0 * num_touches**2
    )


def _check_layout(
    layout: Layout | SurfaceLayout, outline: Rectangle | Triangles, layers: int, table: StudyTable
) -> None:
    """Check that an electrode layout can be measured and meshed for all values of the swept parameters."""
    side_mm, max_thickness_mm = 1e3 * longer_side(outline), max(table.skin.thickness_mm)
    if max_thickness_mm > side_mm:
        raise ValueError(f"skin.thickness_mm is {max_thickness_mm:g}, more than the skin is wide: {side_mm:g} mm.")
    num_touches = table.touch.columns * table.touch.rows
    for protocol in table.measurement.protocol:
        for pairs in table.measurement.pairs or [None]:
            num_pairs = _num_pairs(layout, protocol, pairs)
            _check_measurement(layout, protocol, num_pairs)
            if protocol == "two-terminal":
                num_measurements = num_pairs or _num_all_pairs(layout)
                num_bytes = 8.0 * num_measurements * (4 * layout.num_electrodes + num_touches)
                check_memory(
                    f"measurement.pairs: {num_measurements:,} of {layout.name!r}, touched at {num_touches:,} places,",
                    num_bytes,
                )
    if isinstance(outline, Triangles) and "cell_mm" not in table.mesh.model_fields_set:
        return
    skin_area = float(outline.areas.sum()) if isinstance(outline, Triangles) else outline.area
    for cell_size in _to_metres(table.mesh.cell_mm):
        check_cell_size("mesh.cell_mm", cell_size, layout, skin_area, layers)


def _num_pairs(layout: Layout | SurfaceLayout, protocol: str, pairs: int | None) -> int:
    """Number of measured pairs, 0 for all pairs: the number `pairs`, by default 94, or all pairs if fewer."""
    if pairs is not None:
        return pairs
    return defaults.NUM_PAIRS if protocol == "two-terminal" and _num_all_pairs(layout) > defaults.NUM_PAIRS else 0


def _num_all_pairs(layout: Layout | SurfaceLayout) -> int:
    return layout.num_electrodes * (layout.num_electrodes - 1) // 2


def _check_measurement(layout: Layout | SurfaceLayout, protocol: str, pairs: int) -> None:
    """Check that a layout has enough electrodes for its protocol and number of pairs."""
    name, num_electrodes, min_electrodes = layout.name, layout.num_electrodes, _MIN_ELECTRODES[protocol]
    if num_electrodes < min_electrodes:
        raise ValueError(
            f"measurement.protocol: {name!r} has {num_electrodes} electrodes, and {protocol!r} needs {min_electrodes} "
            "at least."
        )
    if protocol == "opposite" and num_electrodes % 2:
        raise ValueError(
            f"measurement.protocol: {name!r} has {num_electrodes} electrodes, and 'opposite' needs an even number."
        )
    if pairs and protocol != "two-terminal":
        raise ValueError(
            f"measurement.pairs is {pairs}, and measurement.protocol {protocol!r}: only 'two-terminal' has pairs; put "
            "other protocols into a study of their own."
        )
    if pairs > _num_all_pairs(layout):
        raise ValueError(
            f"measurement.pairs is {pairs}, and {name!r} has {_num_all_pairs(layout)} pairs of electrodes; ask for "
            "fewer, or for 0: all."
        )


def _to_metres(lengths_mm: list[float]) -> list[float]:
    """Convert millimetres to metres."""
    return [1e-3 * length_mm for length_mm in lengths_mm]


def _remove_rounding_error(converted_value) -> float:
    """Round `converted_value` to 12 digits, which removes rounding errors of unit conversion."""
    return float(f"{float(converted_value):.12g}")


def _surface_meshes(
    table: StudyTable, folder: Path
) -> tuple[list[float], Rectangle | Triangles, Sequence[LayoutFactory]]:
    """Returns the cell sizes, metres; the outline, or for curved skins the surface meshed with the first cell size; and
    the functions that create layouts: a single function for flat skins, one for each cell size for curved skins."""
    from jeit.design.skin.surface_tables import ScanTable  # imported already when the table was read

    cell_sizes = [1e-3 * cell_size for cell_size in table.mesh.cell_mm]
    surface_table = table.surface
    if surface_table is None:
        outline = Rectangle(1e-3 * table.skin.width_mm, 1e-3 * table.skin.height_mm)
        return cell_sizes, outline, [lambda name, *sizes: study_layout(name, folder, outline, *sizes)]
    surfaces = [described_surface(surface_table, folder, cell_size) for cell_size in cell_sizes]
    if isinstance(surface_table, ScanTable) and surface_table.has_cells:
        cell_sizes = [typical_cell_size(surfaces[0])]

    def layout_factory(surface: Mesh) -> LayoutFactory:
        return lambda name, *sizes: curved_layout(name, folder, surface, surface_table.outward, *sizes)

    return cell_sizes, Triangles.of(surfaces[0]), [layout_factory(surface) for surface in surfaces]
