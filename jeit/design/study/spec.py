"""`Study`: a sweep over layouts and what surrounds them, as a TOML file says; checked before anything runs."""

import hashlib
import json
import math
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jeit.design import defaults
from jeit.design.skin.cell_size import check_cell_size
from jeit.design.skin.indentation import AbstractIndentation, Bell, Hemisphere
from jeit.design.skin.protocol import ProtocolName, skin_protocol
from jeit.design.skin.skin import longer_side, skin_electrodes
from jeit.design.study.keys import OPTIMALITY, read_keys
from jeit.design.study.layouts import is_file, study_layout
from jeit.electrodes import FaceDiscs, SheetDiscs
from jeit.layout import Layout
from jeit.mesh import Rectangle
from jeit.protocol import Protocol

# Bump when the same study would give other numbers.
_VERSION = 2
# Fewest electrodes of a protocol.
_FEWEST = {"adjacent": 4, "opposite": 4, "two-terminal": 2}


class Shape(NamedTuple):
    """What points must share to share a mesh and a batch: see `Point`. `thickness` is 0 for sheets, which differ in it
    without another mesh."""

    electrodes: int
    protocol: str
    pairs: int
    cell_size: float
    layers: int
    thickness: float


@dataclass(frozen=True, eq=False)
class Point:
    """One skin of a study: its `layout` (with diameters and contact impedances) and what surrounds it, in SI units.

    `pairs`: of the nearest electrodes, that a two-terminal `protocol` measures, 0 for all. `layers`: of cells of a
    solid skin's mesh, 0 for a sheet.
    """

    layout: Layout
    thickness: float
    conductivity: float
    protocol: ProtocolName
    pairs: int
    noise: float
    cell_size: float
    layers: int

    @property
    def shape(self) -> Shape:
        """Points of one shape can share a batch."""
        thickness = self.thickness if self.layers else 0.0
        return Shape(self.layout.num_electrodes, self.protocol, self.pairs, self.cell_size, self.layers, thickness)

    @property
    def electrodes(self) -> SheetDiscs | FaceDiscs:
        """In the sheet, or on the bottom of the layer."""
        return skin_electrodes(self.layout, self.layers)

    def measured(self, current: float) -> Protocol:
        """What is measured at a `current` in amperes."""
        return skin_protocol(self.layout, self.protocol, num_pairs=self.pairs, current=current)

    @property
    def coordinates(self) -> dict[str, str | int | float]:
        """The swept values, by their names in the study file; means where electrodes differ."""
        return {
            "layout": self.layout.name,
            "electrodes": self.layout.num_electrodes,
            "diameter_mm": _tidy(1e3 * np.mean(self.layout.diameters)),
            "contact_impedance_ohm_m2": _tidy(np.mean(np.asarray(self.layout.contact_impedance))),
            "thickness_mm": _tidy(1e3 * self.thickness),
            "conductivity_S_per_m": self.conductivity,
            "protocol": self.protocol,
            "pairs": self.pairs,
            "noise_V": self.noise,
            "cell_mm": _tidy(1e3 * self.cell_size),
        }


@dataclass(frozen=True, eq=False)
class Study:
    """A sweep: every combination of the lists in a study file. Make it with `read_study`.

    - `points`: the skins, in the order of the lists, the last list fastest.
    - `outline`: theirs; `indentation`, `contrast`: the touch, as in `touched_cells`; `exact`: whether its changes
      are, or linear; `columns`, `rows`: of the grid of touches.
    - `current`: amperes. `scores`: those wanted; `num_taxels`, `threshold`, `seed`: of `find_taxels`; `correlation`: of
      `TouchPrior`, metres.
    - `chunk_points`: most points in a chunk. `text`: the study file.

    Studies are equal if their results would be.
    """

    name: str
    points: tuple[Point, ...]
    outline: Rectangle
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

    @cached_property
    def chunks(self) -> tuple[tuple[int, ...], ...]:
        """Points (by number) of each chunk: of one shape, at most `chunk_points`."""
        shapes: dict[tuple, list[int]] = {}
        for number, point in enumerate(self.points):
            shapes.setdefault(point.shape, []).append(number)
        most = self.chunk_points
        return tuple(
            tuple(same[start : start + most]) for same in shapes.values() for start in range(0, len(same), most)
        )

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that decides the results: not of comments or the study's name."""
        content = [_VERSION, *map(float, self.outline.extent), type(self.indentation).__name__]
        content += [*map(float, vars(self.indentation).values()), self.columns, self.rows, self.current]
        content += [self.contrast, self.exact, *self.scores, self.num_taxels, self.threshold, self.correlation]
        content += [self.seed, self.chunk_points]
        for point in self.points:
            content += [point.coordinates, point.layers]
            if is_file(point.layout.name):  # the last digits of others depend on how they were compiled
                arrays = (point.layout.centres, point.layout.diameters, point.layout.contact_impedance)
                content += [(np.round(array, 12) + 0.0).tolist() for array in map(np.asarray, arrays)]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def __eq__(self, other) -> bool:
        return isinstance(other, Study) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)


def read_study(path: str | Path) -> Study:
    """The study that a TOML file describes. Lengths are in millimetres; lists are swept, in every combination::

        name = "32 electrodes: inside or around"
        [skin]
        model = "sheet"                      # or "layer": solid, electrodes on its bottom, mesh.layers (5) of cells
        width_mm = 200                       # and height_mm, a rectangle about the origin
        thickness_mm = [5, 10]
        conductivity_S_per_m = 1.0
        [electrodes]
        layouts = ["park-inner", "park-boundary", "grid-8x4", "perimeter-32", "inner-32", "mine.csv"]
        diameter_mm = [6, 8]                 # and contact_impedance_ohm_m2: the file's own, or 6 and 1e-4, unless given
        minimum_gap_mm = 2
        [measurement]
        protocol = "two-terminal"            # or "adjacent", "opposite"
        pairs = [0, 94]                      # of two-terminal: so many of the nearest electrodes; 0: all; 94, or all
        current_mA = 1
        noise_V = 2e-5
        [touch]
        indentation = "bell"                 # depth_mm, deviation_mm; or "hemisphere": depth_mm, diameter_mm
        contrast = 0                         # of the touched part's conductivity; above 1 for a conductor
        exact = false                        # true: solved anew for every touch, one point after the other
        columns = 24                         # and rows
        [mesh]
        cell_mm = 4.5
        [scores]
        wanted = ["minimum", "mean", "uniformity", "blind_spot", "taxels"]    # num_taxels, threshold, seed
        # of sheets also "information", "mean_variance", "largest_variance", "localisation_error": correlation_mm

    Only `electrodes.layouts` must be there; defaults are those of `jeit.design.defaults`. Files are looked for
    beside the study's. Raises `FileNotFoundError` if there is no such file and `ValueError`, naming the key and what to
    do, for keys that are not known or have no effect beside the others, values out of range (such as metres for
    millimetres), electrodes that overlap, impossible spacings, and layouts that do not have the electrodes that a
    protocol needs.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    try:
        text = path.read_text("utf-8")
        return _study(text, read_keys(tomllib.loads(text)), path.parent)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name} is no TOML file: {error}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is no TOML file: it is not text in UTF-8.") from None
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def _study(text: str, values: dict, folder: Path) -> Study:
    outline = Rectangle(1e-3 * values["skin.width_mm"], 1e-3 * values["skin.height_mm"])
    depth, thinnest = values["touch.depth_mm"], min(values["skin.thickness_mm"])
    if depth >= thinnest:
        raise ValueError(f"touch.depth_mm is {depth:g}, and the skin {thinnest:g} mm thick; press less.")
    if values["touch.indentation"] == "bell":
        indentation = Bell(1e-3 * depth, 1e-3 * values["touch.deviation_mm"])
    else:
        across = values["touch.diameter_mm"]
        if depth > across / 2:
            raise ValueError(
                f"touch.depth_mm is {depth:g}, and a hemisphere {across:g} mm across goes in no deeper than "
                f"{across / 2:g}; press less, or give a larger touch.diameter_mm."
            )
        indentation = Hemisphere(1e-3 * depth, 1e-3 * across)
    if values["touch.contrast"] == 1:
        raise ValueError(
            "touch.contrast is 1, which changes nothing; take 0 for an insulator, above 1 for a conductor."
        )
    layers = values["mesh.layers"] if values["skin.model"] == "layer" else 0
    layouts = [
        study_layout(name, folder, outline, diameter, impedance, 1e-3 * values["electrodes.minimum_gap_mm"])
        for name in values["electrodes.layouts"]
        for diameter in _metres(values["electrodes.diameter_mm"])
        for impedance in values["electrodes.contact_impedance_ohm_m2"]
    ]
    points = (
        Point(
            layout, thickness, float(conductivity), protocol, _pairs(layout, protocol, pairs), noise, cell_size, layers
        )
        for layout in layouts
        for thickness in _metres(values["skin.thickness_mm"])
        for conductivity in map(float, values["skin.conductivity_S_per_m"])
        for protocol in values["measurement.protocol"]
        for pairs in values["measurement.pairs"]
        for noise in map(float, values["measurement.noise_V"])
        for cell_size in _metres(values["mesh.cell_mm"])
    )
    study = Study(
        name=values["name"],
        points=tuple(points),
        outline=outline,
        indentation=indentation,
        contrast=float(values["touch.contrast"]),
        exact=values["touch.exact"],
        columns=values["touch.columns"],
        rows=values["touch.rows"],
        current=1e-3 * values["measurement.current_mA"],
        scores=tuple(values["scores.wanted"]),
        num_taxels=values["scores.num_taxels"],
        threshold=float(values["scores.threshold"]),
        correlation=1e-3 * values["scores.correlation_mm"],
        seed=values["scores.seed"],
        chunk_points=values["chunk_points"],
        text=text,
    )
    _check(study)
    return study


def _pairs(layout: Layout, protocol: str, pairs: float) -> int:
    """As many as are asked for, 0 for all; where nobody says, as many as other skins have, or all."""
    if not math.isnan(pairs):
        return int(pairs)
    all_pairs = layout.num_electrodes * (layout.num_electrodes - 1) // 2
    return defaults.NUM_PAIRS if protocol == "two-terminal" and all_pairs > defaults.NUM_PAIRS else 0


def _check(study: Study) -> None:
    touches = study.columns * study.rows
    if "taxels" in study.scores and study.num_taxels > touches:
        raise ValueError(f"scores.num_taxels is {study.num_taxels}, and there are {touches} touches; ask for fewer.")
    of_sheets = [score for score in OPTIMALITY if score in study.scores]
    if of_sheets and study.points[0].layers:
        raise ValueError(
            f"scores.wanted has {', '.join(of_sheets)}, known for sheets only, and skin.model is 'layer'; leave them "
            "out, or take 'sheet'."
        )
    for point in study.points:
        _check_measurement(point)
        if point.thickness > longer_side(study.outline):
            wide = f"{1e3 * longer_side(study.outline):g}"
            raise ValueError(f"skin.thickness_mm is {1e3 * point.thickness:g}, more than the skin is wide: {wide} mm.")
        check_cell_size("mesh.cell_mm", point.cell_size, point.layout, study.outline.area, point.layers)


def _check_measurement(point: Point) -> None:
    """Whether the layout has electrodes enough for its protocol and pairs."""
    name, number = point.layout.name, point.layout.num_electrodes
    fewest = _FEWEST[point.protocol]
    if number < fewest:
        raise ValueError(
            f"measurement.protocol: {name!r} has {number} electrodes, and {point.protocol!r} needs {fewest} at least."
        )
    if point.protocol == "opposite" and number % 2:
        raise ValueError(
            f"measurement.protocol: {name!r} has {number} electrodes, and 'opposite' needs an even number."
        )
    if point.pairs and point.protocol != "two-terminal":
        raise ValueError(
            f"measurement.pairs is {point.pairs}, and measurement.protocol {point.protocol!r}: only 'two-terminal' has "
            "pairs; put other protocols into a study of their own."
        )
    all_pairs = number * (number - 1) // 2
    if point.pairs > all_pairs:
        raise ValueError(
            f"measurement.pairs is {point.pairs}, and {name!r} has {all_pairs} pairs of electrodes; ask for fewer, or "
            "for 0: all."
        )


def _metres(lengths: list[float]) -> list[float]:
    """From millimetres."""
    return [1e-3 * length for length in lengths]


def _tidy(value) -> float:
    """Without the digits that came with the conversion of units."""
    return float(f"{float(value):.12g}")
