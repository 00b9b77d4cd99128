"""Layouts as SVG drawings: written with one user unit per millimetre; drawings made by hand can be read as well."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jeit.arguments import describe
from jeit.files import check_electrodes, check_size, read_as
from jeit.layout.csv_file import MOST_BYTES, millimetres
from jeit.layout.layout import Layout
from jeit.layout.svg_shapes import (
    LARGEST,
    NUMBER,
    ROUND,
    composed,
    described,
    disc_of,
    loops_of,
    moved,
    number_of,
    tag_of,
    transform_of,
)
from jeit.mesh import Disk, Domain, Polygon

_SPACE = "http://www.w3.org/2000/svg"
_MARGIN = 1e-3  # m, around the drawing, so that lines on its edge are seen whole
# Metres; 96 pixels are an inch.
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 25.4e-3, "px": 25.4e-3 / 96, "pt": 25.4e-3 / 72}
_ROLES = ("OUTLINE", "ELECTRODES", "LABELS")
_INKSCAPE_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_GROUPS = ("svg", "g", "a", "switch")
_UNSEEN = ("defs", "clipPath", "mask", "pattern", "symbol", "marker", "metadata", "style", "title", "desc")
_STRAIGHT = ("rect", "polygon", "polyline", "path")


def write_svg(layout: Layout, file: BinaryIO) -> None:
    """Write a drawing whose y, running down, is minus the layout's; its origin is the layout's origin."""
    x_min, x_max, y_min, y_max = layout.extent
    left, top = millimetres(x_min - _MARGIN), millimetres(-y_max - _MARGIN)
    width, height = millimetres(x_max - x_min + 2 * _MARGIN), millimetres(y_max - y_min + 2 * _MARGIN)
    size = {"width": f"{width}mm", "height": f"{height}mm", "viewBox": f"{left} {top} {width} {height}"}
    root = ElementTree.Element("svg", {"xmlns": _SPACE, **size})
    _add(root, "title").text = layout.name
    line = {"fill": "none", "stroke-width": "0.1"}
    group = _add(root, "g", id="OUTLINE", stroke="#ff0000", **line)
    if layout.outline is not None:
        layout.outline.draw(_Pen(group))
    group = _add(root, "g", id="ELECTRODES", stroke="#0000ff", **line)
    centred = {"text-anchor": "middle", "dominant-baseline": "central", "font-family": "sans-serif"}
    names = _add(root, "g", id="LABELS", fill="#808080", **centred)
    for centre, diameter, label in zip(layout.centres, layout.diameters, layout.labels, strict=True):
        circle = _circle(centre, diameter)
        _add(group, "circle", **circle)
        place = {"x": circle["cx"], "y": circle["cy"], "font-size": str(millimetres(float(diameter) / 3))}
        _add(names, "text", **place).text = label
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def read_svg(path: Path, outline: Domain | None) -> Layout:
    """Read what `write_svg` wrote, or a drawing made by hand. Raises `ValueError` for what can be read in two ways."""
    check_size(path, MOST_BYTES)
    with read_as("this is not an SVG drawing that is read"):
        root = ElementTree.parse(path, ElementTree.XMLParser(target=_Builder())).getroot()
    if root.tag != f"{{{_SPACE}}}svg":
        raise ValueError(f"this is not an SVG drawing: it begins with <{str(root.tag)[:40]}>.")
    shapes = list(_shapes(root))
    roles = {role for _, role, _ in shapes}
    labels = ["".join(one.itertext()).strip() for one, role, _ in shapes if role == "LABELS" and tag_of(one) == "text"]
    chosen = "ELECTRODES" if "ELECTRODES" in roles else None
    electrodes = [(one, to) for one, role, to in shapes if role == chosen and (chosen or tag_of(one) in ROUND)]
    if not electrodes:
        raise ValueError("there is no circle in the drawing; electrodes are circles, in a group ELECTRODES or all.")
    check_electrodes("the drawing", len(electrodes))
    circles = np.array([disc_of(one, to) for one, to in electrodes])
    drawn = _outline([(one, to) for one, role, to in shapes if role == "OUTLINE"]) if "OUTLINE" in roles else None
    if "OUTLINE" not in roles:
        drawn = _only_outline([(one, to) for one, role, to in shapes if role is None])
    return Layout(circles[:, :2], 2 * circles[:, 2], outline=drawn or outline, labels=labels or None, name=path.stem)


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _circle(centre, diameter) -> dict[str, str]:
    x, y = centre
    return {"cx": str(millimetres(x)), "cy": str(millimetres(-y)), "r": str(millimetres(diameter / 2))}


class _Pen:
    """Draws outlines into a group."""

    def __init__(self, group: ElementTree.Element):
        self.group = group

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        _add(self.group, "circle", **_circle(centre, 2 * radius))

    def loop(self, vertices: np.ndarray) -> None:
        points = " ".join(f"{millimetres(x)},{millimetres(-y)}" for x, y in vertices)
        _add(self.group, "polygon", points=points)


class _Builder(ElementTree.TreeBuilder):
    """Refuses a document type: the entities that it may define can grow without bounds."""

    def doctype(self, name, pubid, system) -> None:
        raise ValueError("the file has a <!DOCTYPE …>, which jeit does not read; remove it with a text editor.")


def _shapes(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str | None, np.ndarray]]:
    """Shapes of a drawing, in their order: element, role (of it or of a group round it), matrix (2, 3) to metres, y
    up."""
    waiting: list[tuple[ElementTree.Element, str | None, np.ndarray]] = [(root, None, _to_metres(root))]
    while waiting:
        element, role, to = waiting.pop()
        tag = tag_of(element)
        if tag in _UNSEEN or not element.tag.startswith(f"{{{_SPACE}}}") or "display:none" in _style(element):
            continue
        if tag == "use" or (tag == "svg" and element is not root):
            raise ValueError(
                f"there is {described(element)} in the drawing; unlink clones and embedded drawings first."
            )
        called = {element.get("id", ""), element.get(_INKSCAPE_LABEL, ""), *element.get("class", "").split()}
        role = next((name for name in _ROLES if name in {one.upper() for one in called}), role)
        if "transform" in element.attrib:
            to = composed(to, transform_of(element))
            if not (np.abs(to) < LARGEST).all():
                raise ValueError(f"transforms about {described(element)} are too large for a drawing.")
        if tag in _GROUPS:
            waiting += [(child, role, to) for child in reversed(element)]
        else:
            yield element, role, to


def _to_metres(root: ElementTree.Element) -> np.ndarray:
    """The matrix (2, 3) from the drawing's unit to metres, y up. Raises `ValueError` if the drawing does not say it."""
    box = [number_of(root, "viewBox", part) for part in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if part]
    scales = []
    for name, inside in (("width", box[2:3]), ("height", box[3:4])):
        size = re.fullmatch(rf"({NUMBER})\s*({'|'.join(_UNITS)})", root.get(name, "").strip())
        if size is None:
            raise ValueError(
                f"{name} is {describe(root.get(name))}, which says no length; set the document's size in mm "
                f'({name}="200mm").'
            )
        if box and (len(box) != 4 or not inside[0] > 0):
            raise ValueError(f"viewBox is {describe(root.get('viewBox'))}; it is four numbers, the last two positive.")
        scales.append(float(size[1]) * _UNITS[size[2]] / inside[0] if box else _UNITS["px"])
    if not math.isclose(*scales, rel_tol=1e-3):
        raise ValueError(
            f"viewBox is {describe(root.get('viewBox'))}, so that a unit is {1e3 * scales[0]:.4g} mm across and "
            f"{1e3 * scales[1]:.4g} mm up; make its sides as width and height."
        )
    return np.array([[scales[0], 0, 0], [0, -scales[0], 0]])


def _style(element: ElementTree.Element) -> str:
    return "".join(f"{element.get('style', '')};display:{element.get('display', '')}".split())


def _outline(drawn: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain:
    """Outline from the content of the group OUTLINE: one circle, or shapes of straight sides, holes in the largest."""
    if len(drawn) == 1 and tag_of(drawn[0][0]) in ROUND:
        x, y, radius = disc_of(*drawn[0])
        return Disk(radius, (x, y))
    loops = [moved(loop, to) for one, to in drawn for loop in loops_of(one)]
    loops.sort(key=lambda loop: -np.prod(np.ptp(loop, axis=0)))
    return Polygon(loops[0], loops[1:])


def _only_outline(drawn: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain | None:
    """The only closed shape of straight sides in a drawing without a group OUTLINE; None if nothing could be one."""
    found, complaints = [], []
    for one, to in drawn:
        if tag_of(one) in _STRAIGHT:
            try:
                loops_of(one)
                found.append((one, to))
            except ValueError as error:
                complaints.append(error)
    if len(found) > 1:
        raise ValueError(
            f"there are {len(found)} closed shapes, {described(found[0][0])} the first; put the skin's into a group "
            "OUTLINE."
        )
    if not found and complaints:
        raise complaints[0]
    return _outline(found) if found else None
