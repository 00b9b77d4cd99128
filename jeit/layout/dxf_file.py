"""Reading and writing of electrode layouts as DXF drawings, with the package ezdxf."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from jeit.arguments import names_text
from jeit.arguments.extras import import_optional
from jeit.files import check_electrodes, check_size, read_as
from jeit.layout.csv_file import MAX_FILE_BYTES
from jeit.layout.layout import Layout
from jeit.mesh import Disk, Domain, Polygon

# Parts of the error message if the extra `cad` is missing: what needs `cad`, and which formats do not need it.
_EXTRA_TEXTS = ("a DXF drawing", "CSV and SVG files need nothing more.")
_OUTLINE_LAYER, _ELECTRODE_LAYER, _LABEL_LAYER = "OUTLINE", "ELECTRODES", "LABELS"
# AutoCAD's colour numbers: laser cutters distinguish lines to cut from lines to engrave by their colour.
_LAYER_COLOURS = {_OUTLINE_LAYER: 1, _ELECTRODE_LAYER: 5, _LABEL_LAYER: 8}


def write_dxf(layout: Layout, file: BinaryIO) -> None:
    """Write an electrode layout as a DXF drawing in millimetres, in the format of AutoCAD 2007, the first format that
    supports labels in any script.

    Raises `ImportError` if the extra `cad` is not installed.
    """
    ezdxf = import_optional("ezdxf", *_EXTRA_TEXTS)
    drawing = ezdxf.new("R2007")
    drawing.units = ezdxf.units.MM
    for layer_name, layer_colour in _LAYER_COLOURS.items():
        drawing.layers.add(layer_name, color=layer_colour)
    model_space = drawing.modelspace()

    if layout.outline is not None:
        layout.outline.draw(_DxfPen(model_space, _OUTLINE_LAYER))
    electrode_pen = _DxfPen(model_space, _ELECTRODE_LAYER)
    centred_alignment = ezdxf.enums.TextEntityAlignment.MIDDLE_CENTER
    for centre, diameter, label in zip(layout.centres, layout.diameters, layout.labels, strict=True):
        electrode_pen.circle(centre, float(diameter) / 2)
        text = model_space.add_text(label, height=1e3 * float(diameter) / 3, dxfattribs={"layer": _LABEL_LAYER})
        text.set_placement(1e3 * np.asarray(centre), align=centred_alignment)
    text = io.StringIO()
    drawing.write(text)
    file.write(text.getvalue().encode(drawing.output_encoding, errors="dxfreplace"))


class _DxfPen:
    """Pen that draws circles and polygons on one layer of a DXF drawing."""

    def __init__(self, model_space: Any, layer_name: str):
        self.model_space, self.layer_attributes = model_space, {"layer": layer_name}

    def circle(self, centre: Any, radius: float) -> None:
        self.model_space.add_circle(1e3 * np.asarray(centre), 1e3 * radius, dxfattribs=self.layer_attributes)

    def loop(self, vertices: np.ndarray) -> None:
        self.model_space.add_lwpolyline(1e3 * vertices, close=True, dxfattribs=self.layer_attributes)


class _DrawnEntity(NamedTuple):
    """An entity of a DXF drawing: its kind, and the values that are used for this kind, in the unit of the drawing."""

    kind: str
    circle: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position: tuple[float, float] = (0.0, 0.0)
    text: str = ""
    loop: Any = None
    has_arcs: bool = False
    is_closed: bool = False


def read_dxf(path: Path, outline: Domain | None) -> Layout:
    """Read an electrode layout from a DXF drawing with the layers that `write_dxf` writes. Raises `ValueError` for an
    invalid drawing, and `ImportError` if the extra `cad` is not installed."""
    ezdxf = import_optional("ezdxf", *_EXTRA_TEXTS)
    check_size(path, MAX_FILE_BYTES)
    with read_as("this is not a DXF drawing that is read"):
        drawing = ezdxf.readfile(path)
        ezdxf_units = ezdxf.units
        metres_per_unit = ezdxf_units.conversion_factor(
            ezdxf_units.InsertUnits(drawing.units or ezdxf_units.MM), ezdxf_units.InsertUnits.Meters
        )
        model_space = [(entity.dxf.layer, entity) for entity in drawing.modelspace()]
        layer_entities = {
            layer_name: [entity for entity_layer, entity in model_space if entity_layer.upper() == layer_name]
            for layer_name in _LAYER_COLOURS
        }
    if not layer_entities[_ELECTRODE_LAYER]:
        raise ValueError(
            f"nothing is drawn on the layer {_ELECTRODE_LAYER}, where electrodes are circles; "
            f"the layers in use are {names_text(sorted({entity_layer for entity_layer, _ in model_space}))}."
        )
    check_electrodes("the drawing", len(layer_entities[_ELECTRODE_LAYER]))
    with read_as("this is not a DXF drawing that is read"):
        decode_text = ezdxf.lldxf.encoding.decode_dxf_unicode
        entities_by_layer = {
            layer_name: [_convert_entity(entity, decode_text) for entity in drawn_entities]
            for layer_name, drawn_entities in layer_entities.items()
        }
    electrode_circles = (
        np.array([_circle_of_entity(entity) for entity in entities_by_layer[_ELECTRODE_LAYER]]) * metres_per_unit
    )
    electrode_centres, electrode_radii = electrode_circles[:, :2], electrode_circles[:, 2]
    label_texts = [entity for entity in entities_by_layer[_LABEL_LAYER] if entity.kind == "TEXT"]
    text_positions = np.array([entity.position for entity in label_texts]).reshape(-1, 2) * metres_per_unit
    labels = []
    for electrode_number, (electrode_centre, electrode_radius) in enumerate(
        zip(electrode_centres, electrode_radii, strict=True), start=1
    ):
        is_inside_electrode = np.linalg.norm(electrode_centre - text_positions, axis=-1) <= electrode_radius
        electrode_labels = [label_texts[text_index].text for text_index in np.flatnonzero(is_inside_electrode)]
        if len(electrode_labels) > 1:
            raise ValueError(
                f"electrode {electrode_number} has several labels: {names_text(map(repr, electrode_labels))}."
            )
        labels += electrode_labels or [str(electrode_number)]
    drawn_outline = _outline_of_entities(entities_by_layer[_OUTLINE_LAYER], metres_per_unit)
    return Layout(
        electrode_centres, 2 * electrode_radii, outline=drawn_outline or outline, labels=labels, name=path.stem
    )


def _convert_entity(entity, decode_text: Callable[[str], str]) -> _DrawnEntity:
    """Convert an entity to plane coordinates of the drawing, since mirrored entities have coordinate axes of their own.
    Texts are decoded, since formats before 2007 write letters outside Latin as \\U+0162."""
    entity_kind = entity.dxftype()
    if entity_kind == "CIRCLE":
        x, y, _ = entity.ocs().to_wcs(entity.dxf.center)
        return _DrawnEntity(entity_kind, circle=(x, y, float(entity.dxf.radius)))
    if entity_kind == "TEXT":
        x, y, _ = entity.ocs().to_wcs(entity.get_placement()[1])
        return _DrawnEntity(entity_kind, position=(x, y), text=decode_text(entity.dxf.text).strip())
    if entity_kind in ("LWPOLYLINE", "POLYLINE"):
        polyline_points = entity.vertices_in_wcs() if entity_kind == "LWPOLYLINE" else entity.points_in_wcs()
        polyline_vertices = np.array([(x, y) for x, y, _ in polyline_points]).reshape(-1, 2)
        return _DrawnEntity(
            entity_kind, loop=polyline_vertices, has_arcs=bool(entity.has_arc), is_closed=bool(entity.is_closed)
        )
    return _DrawnEntity(entity_kind)


def _circle_of_entity(entity: _DrawnEntity) -> tuple[float, float, float]:
    if entity.kind != "CIRCLE":
        raise ValueError(
            f"there is a {entity.kind[:40]} on the layer {_ELECTRODE_LAYER}; electrodes are circles, and blocks must "
            "be "
            "exploded to circles."
        )
    return entity.circle


def _outline_of_entities(entities: list[_DrawnEntity], metres_per_unit: float) -> Domain | None:
    if not entities:
        return None
    if len(entities) == 1 and entities[0].kind == "CIRCLE":
        x, y, circle_radius = _circle_of_entity(entities[0])
        return Disk(metres_per_unit * circle_radius, (metres_per_unit * x, metres_per_unit * y))
    outline_loops = sorted(
        (metres_per_unit * _polyline_vertices(entity) for entity in entities),
        key=lambda outline_loop: -np.prod(np.ptp(outline_loop, axis=0)),
    )
    return Polygon(outline_loops[0], outline_loops[1:])


def _polyline_vertices(entity: _DrawnEntity) -> np.ndarray:
    """Vertices (k, 2) of a closed polyline with straight sides, in the unit of the drawing. Raises `ValueError` for
    other entities."""
    suggested_remedy = f"on the layer {_OUTLINE_LAYER}; draw closed polylines of straight sides, or one circle."
    if entity.loop is None:
        raise ValueError(f"there is a {entity.kind[:40]} {suggested_remedy}")
    if entity.has_arcs:
        raise ValueError(f"there is a polyline with arcs {suggested_remedy}")
    polyline_vertices = entity.loop
    repeats_first_vertex = len(polyline_vertices) > 3 and np.allclose(
        polyline_vertices[0], polyline_vertices[-1], rtol=0, atol=1e-9 * np.ptp(polyline_vertices)
    )
    if not (entity.is_closed or repeats_first_vertex):
        raise ValueError(f"there is an open polyline {suggested_remedy}")
    return polyline_vertices[:-1] if repeats_first_vertex else polyline_vertices
