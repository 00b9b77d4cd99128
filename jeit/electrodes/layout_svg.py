"""Layouts as SVG drawings, one user unit a millimetre."""

import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from jeit.electrodes.layout import Layout
from jeit.electrodes.layout_csv import millimetres
from jeit.mesh import Disk, Domain, Polygon

_SPACE = "http://www.w3.org/2000/svg"
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MARGIN = 1e-3  # m, around the drawing, so that lines on its edge are seen whole
_ADVICE = "jeit reads the SVG files it wrote; export other drawings as DXF, or write a CSV table."


def write_svg(layout: Layout, path: Path) -> None:
    """Write a drawing whose y, running down, is minus the layout's; its origin is the layout's origin."""
    x_min, x_max, y_min, y_max = layout.extent
    left, top = millimetres(x_min - _MARGIN), millimetres(-y_max - _MARGIN)
    width, height = millimetres(x_max - x_min + 2 * _MARGIN), millimetres(y_max - y_min + 2 * _MARGIN)
    size = {"width": f"{width}mm", "height": f"{height}mm", "viewBox": f"{left} {top} {width} {height}"}
    root = ElementTree.Element("svg", {"xmlns": _SPACE, **size})
    _add(root, "title").text = layout.name
    line = {"fill": "none", "stroke-width": "0.1"}
    outline = layout.outline
    group = _add(root, "g", id="OUTLINE", stroke="#ff0000", **line)
    if isinstance(outline, Disk):
        _add(group, "circle", **_circle(outline.centre, 2 * outline.radius))
    elif outline is not None:
        for loop in (outline.vertices, *getattr(outline, "holes", ())):
            _add(group, "polygon", points=" ".join(f"{millimetres(x)},{millimetres(-y)}" for x, y in np.asarray(loop)))
    group = _add(root, "g", id="ELECTRODES", stroke="#0000ff", **line)
    centred = {"text-anchor": "middle", "dominant-baseline": "central", "font-family": "sans-serif"}
    names = _add(root, "g", id="LABELS", fill="#808080", **centred)
    for centre, diameter, label in zip(layout.centres, layout.diameters, layout.labels, strict=True):
        circle = _circle(centre, diameter)
        _add(group, "circle", **circle)
        place = {"x": circle["cx"], "y": circle["cy"], "font-size": str(millimetres(diameter / 3))}
        _add(names, "text", **place).text = label
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def read_svg(path: Path, outline: Domain | None) -> Layout:
    """Read what `write_svg` wrote. Raises `ValueError` for drawings in other units, or moved by transforms."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeError, ValueError) as error:
        raise ValueError(f"this is not an SVG drawing: {error}.") from None
    if root.tag != f"{{{_SPACE}}}svg":
        raise ValueError(f"this is not an SVG drawing: it begins with <{root.tag}>.")
    _check_millimetres(root)
    for element in root.iter():
        if "transform" in element.attrib:
            raise ValueError(f"{_called(element)} is moved by a transform, so its coordinates are others. {_ADVICE}")
    groups = {name: root.findall(f".//{{{_SPACE}}}g[@id='{name}']/*") for name in ("OUTLINE", "ELECTRODES", "LABELS")}
    if not groups["ELECTRODES"]:
        raise ValueError(f"there is no group ELECTRODES with circles in it. {_ADVICE}")
    circles = np.array([_disc(element) for element in groups["ELECTRODES"]])
    labels = ["".join(element.itertext()).strip() for element in groups["LABELS"]] or None
    drawn = _outline(groups["OUTLINE"])
    return Layout(circles[:, :2], 2 * circles[:, 2], outline=drawn or outline, labels=labels, name=path.stem)


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _circle(centre, diameter) -> dict[str, str]:
    x, y = centre
    return {"cx": str(millimetres(x)), "cy": str(millimetres(-y)), "r": str(millimetres(diameter / 2))}


def _check_millimetres(root: ElementTree.Element) -> None:
    """Raise `ValueError` unless one unit of the drawing is a millimetre."""
    box = [_value(root, "viewBox", part) for part in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if part]
    for name, inside in (("width", box[2:3]), ("height", box[3:4])):
        size = re.fullmatch(rf"({_NUMBER})\s*mm", root.get(name, "").strip())
        if size is None:
            raise ValueError(f"{name} is {root.get(name)!r}, not in millimetres. {_ADVICE}")
        if len(box) != 4 or not math.isclose(float(size[1]), inside[0], rel_tol=1e-6):
            raise ValueError(
                f"viewBox is {root.get('viewBox')!r}, so that a unit of the drawing is no millimetre. {_ADVICE}"
            )


def _called(element: ElementTree.Element) -> str:
    tag = element.tag.split("}")[-1]
    return f"<{tag} id={element.get('id')!r}>" if "id" in element.attrib else f"a <{tag}>"


def _value(element: ElementTree.Element, name: str, text: str | None) -> float:
    if text is None or re.fullmatch(_NUMBER, text.strip()) is None:
        raise ValueError(f"{name} of {_called(element)} is {text!r}, not a number. {_ADVICE}")
    return float(text)


def _disc(element: ElementTree.Element) -> tuple[float, float, float]:
    """Centre and radius of a circle in metres, y up."""
    if element.tag != f"{{{_SPACE}}}circle":
        raise ValueError(f"{_called(element)} stands where a <circle> should. {_ADVICE}")
    x, y, radius = (1e-3 * _value(element, name, element.get(name)) for name in ("cx", "cy", "r"))
    return x, -y, radius


def _outline(elements: list[ElementTree.Element]) -> Domain | None:
    if not elements:
        return None
    if elements[0].tag == f"{{{_SPACE}}}circle":
        x, y, radius = _disc(elements[0])
        return Disk(radius, (x, y))
    loops = []
    for element in elements:
        if element.tag != f"{{{_SPACE}}}polygon":
            raise ValueError(f"{_called(element)} stands where a <polygon> should. {_ADVICE}")
        values = [_value(element, "points", text) for text in re.split(r"[\s,]+", element.get("points", "").strip())]
        if len(values) % 2:
            raise ValueError(f"points of {_called(element)} are {len(values)} numbers, not pairs. {_ADVICE}")
        loops.append(1e-3 * np.array(values).reshape(-1, 2) * [1, -1])
    return Polygon(loops[0], loops[1:])
