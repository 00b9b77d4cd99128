"""Reading and writing of electrode layouts as SVG drawings."""

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
from jeit.layout.csv_file import MAX_FILE_BYTES, millimetres
from jeit.layout.layout import Layout
from jeit.mesh import Disk, Domain, Polygon

# Pattern of a number. Its quantifiers are possessive, so that a text that is not a number is rejected in one pass,
# however long it is.
NUMBER_PATTERN = r"[-+]?+(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?+\d++)?+"
# Maximum number in a drawing, so that its square can still be computed after transforms.
MAX_NUMBER = 1e30
CIRCLE_AND_ELLIPSE_TAGS = ("circle", "ellipse")


def read_transform(element: ElementTree.Element) -> np.ndarray:
    """Matrix (2, 3) of the transform of an SVG element. Raises `ValueError` for a transform that cannot be read."""
    text, matrix = element.get("transform", "").strip(), np.eye(2, 3)
    if re.fullmatch(r"(\w++\s*+\([^()]*+\)[\s,]*+)*+", text) is None:
        raise ValueError(f"transform of {describe_element(element)} is {describe(text)}, not a list of transforms.")
    for kind, argument_text in re.findall(r"(\w+)\s*\(([^()]*)\)", text):
        numbers = [
            parse_number(element, "transform", number_text)
            for number_text in re.split(r"[\s,]+", argument_text.strip())
            if number_text
        ]
        match kind, numbers:
            case "matrix", [_, _, _, _, _, _]:
                step = np.array(numbers).reshape(3, 2).T
            case "translate", [x, *rest] if len(rest) < 2:
                step = np.array([[1, 0, x], [0, 1, rest[0] if rest else 0]])
            case "scale", [x, *rest] if len(rest) < 2:
                step = np.array([[x, 0, 0], [0, rest[0] if rest else x, 0]])
            case "rotate", [degrees, *centre] if len(centre) in (0, 2):
                angle, centre = math.radians(degrees), np.array(centre or [0.0, 0.0])
                rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
                step = np.column_stack([rotation, centre - rotation @ centre])
            case _:
                raise ValueError(
                    f"{describe_element(element)} has {kind[:20]}({argument_text[:40]}); jeit reads matrix, "
                    "translate, scale and rotate."
                )
        matrix = compose_transforms(matrix, step)
    if not (np.abs(matrix) < MAX_NUMBER).all():
        raise ValueError(f"transform of {describe_element(element)} is too large for a drawing.")
    return matrix


def compose_transforms(outer_transform: np.ndarray, inner_transform: np.ndarray) -> np.ndarray:
    """Matrix (2, 3) that applies the transform `inner_transform`, then `outer_transform`."""
    return outer_transform[:, :2] @ inner_transform + np.column_stack([np.zeros((2, 2)), outer_transform[:, 2]])


def transform_points(points, matrix: np.ndarray) -> np.ndarray:
    """Apply the transform `matrix` (2, 3) to points (k, 2)."""
    return np.asarray(points, float).reshape(-1, 2) @ matrix[:, :2].T + matrix[:, 2]


def local_tag(element: ElementTree.Element) -> str:
    """Tag of an SVG element without its namespace, such as "circle"."""
    return element.tag.split("}")[-1]


def describe_element(element: ElementTree.Element) -> str:
    """Text that names an SVG element in error messages."""
    return (
        f"<{local_tag(element)[:20]} id={describe(element.get('id'))}>"
        if "id" in element.attrib
        else f"a <{local_tag(element)[:20]}>"
    )


def parse_number(element: ElementTree.Element, name: str, text: str | None) -> float:
    """Convert `text`, the value of the attribute `name`, to a number. Raises `ValueError` if `text` is not a number."""
    if text is None or re.fullmatch(NUMBER_PATTERN, text.strip()) is None:
        raise ValueError(f"{name} of {describe_element(element)} is {describe(text)}, not a number.")
    value = float(text)
    if not abs(value) < MAX_NUMBER:
        raise ValueError(f"{name} of {describe_element(element)} is {describe(text)}, too large for a drawing.")
    return value


def read_disc(element: ElementTree.Element, matrix: np.ndarray) -> tuple[float, float, float]:
    """Centre and radius of a circle in metres, with y up. `matrix`: matrix (2, 3) to metres. Raises `ValueError` if the
    element is not a circle."""
    if local_tag(element) not in CIRCLE_AND_ELLIPSE_TAGS:
        raise ValueError(f"{describe_element(element)} stands where a circle should: electrodes are circles.")
    x, y = (parse_number(element, name, element.get(name, "0")) for name in ("cx", "cy"))
    names = ("r", "r") if local_tag(element) == "circle" else ("rx", "ry")
    radii = [parse_number(element, name, element.get(name)) for name in names]
    half_axes = np.linalg.svd(matrix[:, :2] * radii, compute_uv=False)
    if half_axes[0] > half_axes[1] * (1 + 1e-3):
        raise ValueError(
            f"{describe_element(element)} is {2e3 * half_axes[0]:.4g} mm long and {2e3 * half_axes[1]:.4g} mm wide "
            "as it is drawn; electrodes are circles."
        )
    centre = transform_points([x, y], matrix)[0]
    return float(centre[0]), float(centre[1]), float(half_axes.mean())


def read_loops(element: ElementTree.Element) -> list[np.ndarray]:
    """Vertices (k, 2) of each loop of a closed shape with straight sides, in the units of the element. Raises
    `ValueError` for other shapes."""
    tag = local_tag(element)
    if tag == "rect":
        x, y = (parse_number(element, name, element.get(name, "0")) for name in ("x", "y"))
        width, height = (parse_number(element, name, element.get(name)) for name in ("width", "height"))
        if any(parse_number(element, name, element.get(name, "0")) for name in ("rx", "ry")):
            raise ValueError(f"{describe_element(element)} has round corners; draw the skin with straight sides.")
        return [np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])]
    if tag in ("polygon", "polyline"):
        values = [
            parse_number(element, "points", text) for text in re.split(r"[\s,]+", element.get("points", "").strip())
        ]
        if len(values) % 2:
            raise ValueError(f"points of {describe_element(element)} are {len(values)} numbers, not pairs.")
        return [_closed_loop(element, np.array(values).reshape(-1, 2), tag == "polygon")]
    if tag == "path":
        return _path_loops(element)
    raise ValueError(
        f"{describe_element(element)} stands where the skin should: draw a rectangle, polygon, path or circle."
    )


def _path_loops(element: ElementTree.Element) -> list[np.ndarray]:
    text = element.get("d", "")
    if re.fullmatch(rf"(?:[MmLlHhVvZz]|{NUMBER_PATTERN}|[\s,])*+", text) is None or not text.strip():
        raise ValueError(f"{describe_element(element)} has curves, or is no path; draw the skin with straight sides.")
    loops: list[tuple[list[np.ndarray], bool]] = []
    position = np.zeros(2)
    for command_letter, argument_text in re.findall(r"([MmLlHhVvZz])([^MmLlHhVvZz]*)", text):
        numbers = [parse_number(element, "d", number) for number in re.findall(NUMBER_PATTERN, argument_text)]
        kind, relative = command_letter.upper(), command_letter.islower()
        size = {"H": 1, "V": 1}.get(kind, 2)
        if kind == "Z" and loops:
            loops[-1] = (loops[-1][0], True)
            position = loops[-1][0][0]
            continue
        if kind == "Z" or not numbers or len(numbers) % size or (kind != "M" and not loops):
            raise ValueError(
                f"d of {describe_element(element)} is not a path: {command_letter}{argument_text.strip()[:40]}."
            )
        for number_index in range(0, len(numbers), size):
            origin = (
                position if relative else np.array({"H": [0, position[1]], "V": [position[0], 0]}.get(kind, [0, 0]))
            )
            step = {"H": [numbers[number_index], 0], "V": [0, numbers[number_index]]}.get(
                kind, numbers[number_index : number_index + 2]
            )
            start, position = position, origin + np.array(step)
            if kind == "M" and number_index == 0:
                loops.append(([position], False))
            else:  # a line after Z without M starts a new loop where the closed loop began
                if loops[-1][1]:
                    loops.append(([start], False))
                loops[-1][0].append(position)
    return [_closed_loop(element, np.array(points), closed) for points, closed in loops]


def _closed_loop(element: ElementTree.Element, loop: np.ndarray, closed: bool) -> np.ndarray:
    """Vertices of a loop without a repetition of the first vertex. Raises `ValueError` if the loop is not closed."""
    repeats_first_vertex = len(loop) > 3 and np.allclose(loop[0], loop[-1], rtol=0, atol=1e-6 * np.ptp(loop))
    if not (closed or repeats_first_vertex):
        raise ValueError(f"{describe_element(element)} is not closed; close the skin's outline.")
    return loop[:-1] if repeats_first_vertex else loop


_SVG_NAMESPACE = "http://www.w3.org/2000/svg"
_MARGIN = 1e-3  # m, around the drawing, so that lines on its edge are not cut off
# Units in metres; 96 pixels are an inch.
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 25.4e-3, "px": 25.4e-3 / 96, "pt": 25.4e-3 / 72}
_GROUP_NAMES = ("OUTLINE", "ELECTRODES", "LABELS")
_INKSCAPE_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_GROUP_TAGS = ("svg", "g", "a", "switch")
_INVISIBLE_TAGS = ("defs", "clipPath", "mask", "pattern", "symbol", "marker", "metadata", "style", "title", "desc")
_STRAIGHT_SHAPES = ("rect", "polygon", "polyline", "path")


def write_svg(layout: Layout, file: BinaryIO) -> None:
    """Write an electrode layout as an SVG drawing. Layout and drawing have the same origin; the y axis of the drawing
    points down, so y coordinates in the drawing are the negatives of the y coordinates in the layout."""
    x_min, x_max, y_min, y_max = layout.extent
    view_box_left, view_top = millimetres(x_min - _MARGIN), millimetres(-y_max - _MARGIN)
    width, height = millimetres(x_max - x_min + 2 * _MARGIN), millimetres(y_max - y_min + 2 * _MARGIN)
    size = {"width": f"{width}mm", "height": f"{height}mm", "viewBox": f"{view_box_left} {view_top} {width} {height}"}
    root_element = ElementTree.Element("svg", {"xmlns": _SVG_NAMESPACE, **size})
    _add_element(root_element, "title").text = layout.name
    line_style = {"fill": "none", "stroke-width": "0.1"}
    group = _add_element(root_element, "g", id="OUTLINE", stroke="#ff0000", **line_style)
    if layout.outline is not None:
        layout.outline.draw(_SvgPen(group))
    group = _add_element(root_element, "g", id="ELECTRODES", stroke="#0000ff", **line_style)
    text_style = {"text-anchor": "middle", "dominant-baseline": "central", "font-family": "sans-serif"}
    label_group = _add_element(root_element, "g", id="LABELS", fill="#808080", **text_style)
    centres, diameters = np.asarray(layout.centres), np.asarray(layout.diameters)
    for centre, diameter, label in zip(centres, diameters, layout.labels, strict=True):
        circle = _add_circle(centre, diameter)
        _add_element(group, "circle", **circle)
        text_position = {"x": circle["cx"], "y": circle["cy"], "font-size": str(millimetres(float(diameter) / 3))}
        _add_element(label_group, "text", **text_position).text = label
    ElementTree.indent(root_element)
    ElementTree.ElementTree(root_element).write(file, encoding="utf-8", xml_declaration=True)


def read_svg(path: Path, outline: Domain | None) -> Layout:
    """Read an electrode layout from an SVG drawing, written by `write_svg` or by hand. Raises `ValueError` for an
    invalid or ambiguous drawing."""
    check_size(path, MAX_FILE_BYTES)
    with read_as("this is not an SVG drawing that is read"):
        root = ElementTree.parse(path, ElementTree.XMLParser(target=_Builder())).getroot()
    if root.tag != f"{{{_SVG_NAMESPACE}}}svg":
        raise ValueError(f"this is not an SVG drawing: it begins with <{str(root.tag)[:40]}>.")
    shapes = list(_drawn_shapes(root))
    shape_roles = {role for _, role, _ in shapes}
    labels = [
        "".join(element.itertext()).strip()
        for element, role, _ in shapes
        if role == "LABELS" and local_tag(element) == "text"
    ]
    electrode_role = "ELECTRODES" if "ELECTRODES" in shape_roles else None
    electrodes = [
        (element, matrix)
        for element, role, matrix in shapes
        if role == electrode_role and (electrode_role or local_tag(element) in CIRCLE_AND_ELLIPSE_TAGS)
    ]
    if not electrodes:
        raise ValueError("there is no circle in the drawing; electrodes are circles, in a group ELECTRODES or all.")
    check_electrodes("the drawing", len(electrodes))
    circles = np.array([read_disc(element, matrix) for element, matrix in electrodes])
    drawn_outline = (
        _create_outline([(element, matrix) for element, role, matrix in shapes if role == "OUTLINE"])
        if "OUTLINE" in shape_roles
        else None
    )
    if "OUTLINE" not in shape_roles:
        drawn_outline = _single_closed_outline([(element, matrix) for element, role, matrix in shapes if role is None])
    return Layout(
        circles[:, :2], 2 * circles[:, 2], outline=drawn_outline or outline, labels=labels or None, name=path.stem
    )


def _add_element(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _add_circle(centre, diameter) -> dict[str, str]:
    x, y = centre
    return {"cx": str(millimetres(x)), "cy": str(millimetres(-y)), "r": str(millimetres(diameter / 2))}


class _SvgPen:
    """Pen that draws circles and polygons into a group of an SVG drawing."""

    def __init__(self, group: ElementTree.Element):
        self.group = group

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        _add_element(self.group, "circle", **_add_circle(centre, 2 * radius))

    def loop(self, vertices: np.ndarray) -> None:
        points = " ".join(f"{millimetres(x)},{millimetres(-y)}" for x, y in vertices)
        _add_element(self.group, "polygon", points=points)


class _Builder(ElementTree.TreeBuilder):
    """Parser that rejects a document type declaration, since entities defined in it can expand without bounds."""

    def doctype(self, name, pubid, system) -> None:
        raise ValueError("the file has a <!DOCTYPE …>, which jeit does not read; remove it with a text editor.")


def _drawn_shapes(root_element: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str | None, np.ndarray]]:
    """Yield the shapes of a drawing in their order: the element; its role, which is the name in `_GROUP_NAMES` of the
    element or of an enclosing group, or None; and the matrix (2, 3) from the element's units to metres, with y up."""
    stack: list[tuple[ElementTree.Element, str | None, np.ndarray]] = [
        (root_element, None, _matrix_to_metres(root_element))
    ]
    while stack:
        element, role, matrix = stack.pop()
        tag = local_tag(element)
        if (
            tag in _INVISIBLE_TAGS
            or not element.tag.startswith(f"{{{_SVG_NAMESPACE}}}")
            or "display:none" in _style(element)
        ):
            continue
        if tag == "use" or (tag == "svg" and element is not root_element):
            raise ValueError(
                f"there is {describe_element(element)} in the drawing; unlink clones and embedded drawings first."
            )
        names = {element.get("id", ""), element.get(_INKSCAPE_LABEL, ""), *element.get("class", "").split()}
        role = next((name for name in _GROUP_NAMES if name in {text.upper() for text in names}), role)
        if "transform" in element.attrib:
            matrix = compose_transforms(matrix, read_transform(element))
            if not (np.abs(matrix) < MAX_NUMBER).all():
                raise ValueError(f"transforms about {describe_element(element)} are too large for a drawing.")
        if tag in _GROUP_TAGS:
            stack += [(child, role, matrix) for child in reversed(element)]
        else:
            yield element, role, matrix


def _matrix_to_metres(root_element: ElementTree.Element) -> np.ndarray:
    """Matrix (2, 3) from the units of the drawing to metres, with y up. Raises `ValueError` if the drawing does not
    state its size."""
    box = [
        parse_number(root_element, "viewBox", number_text)
        for number_text in re.split(r"[\s,]+", root_element.get("viewBox", "").strip())
        if number_text
    ]
    scales = []
    for name, view_box_sizes in (("width", box[2:3]), ("height", box[3:4])):
        size = re.fullmatch(rf"({NUMBER_PATTERN})\s*({'|'.join(_UNITS)})", root_element.get(name, "").strip())
        if size is None:
            raise ValueError(
                f"{name} is {describe(root_element.get(name))}, which says no length; set the document's size in mm "
                f'({name}="200mm").'
            )
        if box and (len(box) != 4 or not view_box_sizes[0] > 0):
            raise ValueError(
                f"viewBox is {describe(root_element.get('viewBox'))}; it is four numbers, the last two positive."
            )
        scales.append(float(size[1]) * _UNITS[size[2]] / view_box_sizes[0] if box else _UNITS["px"])
    if not math.isclose(*scales, rel_tol=1e-3):
        raise ValueError(
            f"viewBox is {describe(root_element.get('viewBox'))}, so that a unit is {1e3 * scales[0]:.4g} mm across "
            f"and {1e3 * scales[1]:.4g} mm up; make its sides as width and height."
        )
    return np.array([[scales[0], 0, 0], [0, -scales[0], 0]])


def _style(element: ElementTree.Element) -> str:
    return "".join(f"{element.get('style', '')};display:{element.get('display', '')}".split())


def _create_outline(drawn_shapes: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain:
    """Outline from the content of the group OUTLINE: a single circle, or shapes with straight sides, of which the
    largest is the skin and others are holes."""
    if len(drawn_shapes) == 1 and local_tag(drawn_shapes[0][0]) in CIRCLE_AND_ELLIPSE_TAGS:
        x, y, radius = read_disc(*drawn_shapes[0])
        return Disk(radius, (x, y))
    loops = [transform_points(loop, matrix) for element, matrix in drawn_shapes for loop in read_loops(element)]
    loops.sort(key=lambda loop: -np.prod(np.ptp(loop, axis=0)))
    return Polygon(loops[0], loops[1:])


def _single_closed_outline(shapes: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain | None:
    """Outline of a drawing without a group OUTLINE: its only closed shape with straight sides; None if the drawing has
    no shape with straight sides."""
    closed_shapes, errors = [], []
    for element, matrix in shapes:
        if local_tag(element) in _STRAIGHT_SHAPES:
            try:
                read_loops(element)
                closed_shapes.append((element, matrix))
            except ValueError as error:
                errors.append(error)
    if len(closed_shapes) > 1:
        raise ValueError(
            f"there are {len(closed_shapes)} closed shapes, {describe_element(closed_shapes[0][0])} the first; put "
            "the skin's into a group OUTLINE."
        )
    if not closed_shapes and errors:
        raise errors[0]
    return _create_outline(closed_shapes) if closed_shapes else None
