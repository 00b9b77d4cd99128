"""Layouts as DXF drawings, through ezdxf."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jeit.layout.layout import Layout
from jeit.mesh import Disk, Domain, Polygon

_OUTLINE, _ELECTRODES, _LABELS = "OUTLINE", "ELECTRODES", "LABELS"
# AutoCAD's colour numbers: laser cutters tell lines to cut from lines to engrave by their colour.
_COLOURS = {_OUTLINE: 1, _ELECTRODES: 5, _LABELS: 8}


def write_dxf(layout: Layout, path: Path) -> None:
    """Write a drawing in millimetres, of the format of AutoCAD 2007: the first that holds labels in any script.

    Raises `ImportError` where the extra `cad` is not installed.
    """
    ezdxf = _import()
    drawing = ezdxf.new("R2007")
    drawing.units = ezdxf.units.MM
    for name, colour in _COLOURS.items():
        drawing.layers.add(name, color=colour)
    space = drawing.modelspace()

    if layout.outline is not None:
        layout.outline.draw(_Pen(space, _OUTLINE))
    discs = _Pen(space, _ELECTRODES)
    centred = ezdxf.enums.TextEntityAlignment.MIDDLE_CENTER
    for centre, diameter, label in zip(layout.centres, layout.diameters, layout.labels, strict=True):
        discs.circle(centre, float(diameter) / 2)
        text = space.add_text(label, height=1e3 * float(diameter) / 3, dxfattribs={"layer": _LABELS})
        text.set_placement(1e3 * np.asarray(centre), align=centred)
    drawing.saveas(path)


class _Pen:
    """Draws on one of a drawing's layers."""

    def __init__(self, space: Any, layer: str):
        self.space, self.on = space, {"layer": layer}

    def circle(self, centre: Any, radius: float) -> None:
        self.space.add_circle(1e3 * np.asarray(centre), 1e3 * radius, dxfattribs=self.on)

    def loop(self, vertices: np.ndarray) -> None:
        self.space.add_lwpolyline(1e3 * vertices, close=True, dxfattribs=self.on)


def read_dxf(path: Path, outline: Domain | None) -> Layout:
    """Read what `write_dxf` wrote, or a CAD program with the same layers. Raises `ValueError`."""
    ezdxf = _import()
    try:
        drawing = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError, UnicodeError, ValueError) as error:
        raise ValueError(f"this is not a DXF drawing: {error}") from None
    units = ezdxf.units
    unit = units.conversion_factor(units.InsertUnits(drawing.units or units.MM), units.InsertUnits.Meters)
    entities: dict[str, list[Any]] = {name: [] for name in _COLOURS}
    for entity in drawing.modelspace():
        entities.get(entity.dxf.layer.upper(), []).append(entity)
    if not entities[_ELECTRODES]:
        used = sorted({entity.dxf.layer for entity in drawing.modelspace()})
        raise ValueError(
            f"nothing is drawn on the layer {_ELECTRODES}, where electrodes are circles; "
            f"the layers in use are {', '.join(used) or 'none'}."
        )
    circles = np.array([_circle(entity) for entity in entities[_ELECTRODES]]) * unit
    centres, radii = circles[:, :2], circles[:, 2]
    texts = [entity for entity in entities[_LABELS] if entity.dxftype() == "TEXT"]
    places = np.array([_point(text, text.get_placement()[1]) for text in texts]).reshape(-1, 2) * unit
    inside = np.linalg.norm(centres[:, None] - places, axis=-1) <= radii[:, None]
    decode, labels = ezdxf.lldxf.encoding.decode_dxf_unicode, []
    for electrode, held in enumerate(inside, start=1):
        # Older formats than 2007 write letters beyond Latin as \U+0162.
        written = [decode(texts[index].dxf.text).strip() for index in np.flatnonzero(held)]
        if len(written) > 1:
            raise ValueError(f"electrode {electrode} has several labels: {', '.join(map(repr, written))}.")
        labels += written or [str(electrode)]
    drawn = _outline(entities[_OUTLINE], unit)
    return Layout(centres, 2 * radii, outline=drawn or outline, labels=labels, name=path.stem)


def _point(entity, place) -> tuple[float, float]:
    """A point of an entity in the plane: mirrored entities have axes of their own."""
    x, y, _ = entity.ocs().to_wcs(place)
    return x, y


def _circle(entity) -> tuple[float, float, float]:
    if entity.dxftype() != "CIRCLE":
        raise ValueError(
            f"there is a {entity.dxftype()} on the layer {_ELECTRODES}; electrodes are circles, and blocks must be "
            "exploded to circles."
        )
    return *_point(entity, entity.dxf.center), entity.dxf.radius


def _outline(entities: list[Any], unit: float) -> Domain | None:
    if not entities:
        return None
    if len(entities) == 1 and entities[0].dxftype() == "CIRCLE":
        x, y, radius = _circle(entities[0])
        return Disk(unit * radius, (unit * x, unit * y))
    loops = sorted((unit * _loop(entity) for entity in entities), key=lambda loop: -np.prod(np.ptp(loop, axis=0)))
    return Polygon(loops[0], loops[1:])


def _loop(entity) -> np.ndarray:
    """Vertices (k, 2) of a closed polyline of straight sides, in the drawing's unit; `ValueError` if it is none."""
    advice = f"on the layer {_OUTLINE}; draw closed polylines of straight sides, or one circle."
    if entity.dxftype() not in ("LWPOLYLINE", "POLYLINE"):
        raise ValueError(f"there is a {entity.dxftype()} {advice}")
    if entity.has_arc:
        raise ValueError(f"there is a polyline with arcs {advice}")
    points = entity.vertices_in_wcs() if entity.dxftype() == "LWPOLYLINE" else entity.points_in_wcs()
    loop = np.array([(x, y) for x, y, _ in points])
    closes = len(loop) > 3 and np.allclose(loop[0], loop[-1], rtol=0, atol=1e-9 * np.ptp(loop))
    if not (entity.is_closed or closes):
        raise ValueError(f"there is an open polyline {advice}")
    return loop[:-1] if closes else loop


def _import() -> ModuleType:
    try:
        return importlib.import_module("ezdxf")
    except ImportError as error:
        raise ImportError(
            'DXF drawings need the ezdxf package: pip install "jeit[cad]". CSV and SVG files need nothing more.'
        ) from error
