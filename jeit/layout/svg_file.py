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
    transform_text, total_transform = element.get("transform", "").strip(), np.eye(2, 3)
    if re.fullmatch(r"(\w++\s*+\([^()]*+\)[\s,]*+)*+", transform_text) is None:
        raise ValueError(
            f"transform of {describe_element(element)} is {describe(transform_text)}, not a list of transforms."
        )
    for transform_kind, argument_text in re.findall(r"(\w+)\s*\(([^()]*)\)", transform_text):
        transform_numbers = [
            parse_number(element, "transform", number_text)
            for number_text in re.split(r"[\s,]+", argument_text.strip())
            if number_text
        ]
        match transform_kind, transform_numbers:
            case "matrix", [_, _, _, _, _, _]:
                transform_step = np.array(transform_numbers).reshape(3, 2).T
            case "translate", [x, *rest] if len(rest) < 2:
                transform_step = np.array([[1, 0, x], [0, 1, rest[0] if rest else 0]])
            case "scale", [x, *rest] if len(rest) < 2:
                transform_step = np.array([[x, 0, 0], [0, rest[0] if rest else x, 0]])
            case "rotate", [degrees, *centre] if len(centre) in (0, 2):
                rotation_angle, centre = math.radians(degrees), np.array(centre or [0.0, 0.0])
                rotation_matrix = np.array(
                    [
                        [math.cos(rotation_angle), -math.sin(rotation_angle)],
                        [math.sin(rotation_angle), math.cos(rotation_angle)],
                    ]
                )
                transform_step = np.column_stack([rotation_matrix, centre - rotation_matrix @ centre])
            case _:
                raise ValueError(
                    f"{describe_element(element)} has {transform_kind[:20]}({argument_text[:40]}); jeit reads matrix, "
                    "translate, scale and rotate."
                )
        total_transform = compose_transforms(total_transform, transform_step)
    if not (np.abs(total_transform) < MAX_NUMBER).all():
        raise ValueError(f"transform of {describe_element(element)} is too large for a drawing.")
    return total_transform


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
    parsed_number = float(text)
    if not abs(parsed_number) < MAX_NUMBER:
        raise ValueError(f"{name} of {describe_element(element)} is {describe(text)}, too large for a drawing.")
    return parsed_number


def read_disc(element: ElementTree.Element, matrix: np.ndarray) -> tuple[float, float, float]:
    """Centre and radius of a circle in metres, with y up. `matrix`: matrix (2, 3) to metres. Raises `ValueError` if the
    element is not a circle."""
    if local_tag(element) not in CIRCLE_AND_ELLIPSE_TAGS:
        raise ValueError(f"{describe_element(element)} stands where a circle should: electrodes are circles.")
    x, y = (parse_number(element, attribute_name, element.get(attribute_name, "0")) for attribute_name in ("cx", "cy"))
    radius_names = ("r", "r") if local_tag(element) == "circle" else ("rx", "ry")
    ellipse_radii = [
        parse_number(element, attribute_name, element.get(attribute_name)) for attribute_name in radius_names
    ]
    half_axes = np.linalg.svd(matrix[:, :2] * ellipse_radii, compute_uv=False)
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
    element_tag = local_tag(element)
    if element_tag == "rect":
        x, y = (
            parse_number(element, attribute_name, element.get(attribute_name, "0")) for attribute_name in ("x", "y")
        )
        rectangle_width, rectangle_height = (
            parse_number(element, attribute_name, element.get(attribute_name)) for attribute_name in ("width", "height")
        )
        if any(
            parse_number(element, attribute_name, element.get(attribute_name, "0")) for attribute_name in ("rx", "ry")
        ):
            raise ValueError(f"{describe_element(element)} has round corners; draw the skin with straight sides.")
        return [
            np.array(
                [
                    [x, y],
                    [x + rectangle_width, y],
                    [x + rectangle_width, y + rectangle_height],
                    [x, y + rectangle_height],
                ]
            )
        ]
    if element_tag in ("polygon", "polyline"):
        coordinate_values = [
            parse_number(element, "points", number_text)
            for number_text in re.split(r"[\s,]+", element.get("points", "").strip())
        ]
        if len(coordinate_values) % 2:
            raise ValueError(f"points of {describe_element(element)} are {len(coordinate_values)} numbers, not pairs.")
        return [_closed_loop(element, np.array(coordinate_values).reshape(-1, 2), element_tag == "polygon")]
    if element_tag == "path":
        return _path_loops(element)
    raise ValueError(
        f"{describe_element(element)} stands where the skin should: draw a rectangle, polygon, path or circle."
    )


def _path_loops(element: ElementTree.Element) -> list[np.ndarray]:
    path_text = element.get("d", "")
    if re.fullmatch(rf"(?:[MmLlHhVvZz]|{NUMBER_PATTERN}|[\s,])*+", path_text) is None or not path_text.strip():
        raise ValueError(f"{describe_element(element)} has curves, or is no path; draw the skin with straight sides.")
    path_loops: list[tuple[list[np.ndarray], bool]] = []
    pen_position = np.zeros(2)
    for command_letter, argument_text in re.findall(r"([MmLlHhVvZz])([^MmLlHhVvZz]*)", path_text):
        command_numbers = [
            parse_number(element, "d", number_text) for number_text in re.findall(NUMBER_PATTERN, argument_text)
        ]
        command_kind, is_relative = command_letter.upper(), command_letter.islower()
        numbers_per_step = {"H": 1, "V": 1}.get(command_kind, 2)
        if command_kind == "Z" and path_loops:
            path_loops[-1] = (path_loops[-1][0], True)
            pen_position = path_loops[-1][0][0]
            continue
        if (
            command_kind == "Z"
            or not command_numbers
            or len(command_numbers) % numbers_per_step
            or (command_kind != "M" and not path_loops)
        ):
            raise ValueError(
                f"d of {describe_element(element)} is not a path: {command_letter}{argument_text.strip()[:40]}."
            )
        for number_index in range(0, len(command_numbers), numbers_per_step):
            step_origin = (
                pen_position
                if is_relative
                else np.array({"H": [0, pen_position[1]], "V": [pen_position[0], 0]}.get(command_kind, [0, 0]))
            )
            step_vector = {"H": [command_numbers[number_index], 0], "V": [0, command_numbers[number_index]]}.get(
                command_kind, command_numbers[number_index : number_index + 2]
            )
            step_start, pen_position = pen_position, step_origin + np.array(step_vector)
            if command_kind == "M" and number_index == 0:
                path_loops.append(([pen_position], False))
            else:  # a line after Z without M starts a new loop where the closed loop began
                if path_loops[-1][1]:
                    path_loops.append(([step_start], False))
                path_loops[-1][0].append(pen_position)
    return [_closed_loop(element, np.array(loop_points), is_closed) for loop_points, is_closed in path_loops]


def _closed_loop(element: ElementTree.Element, loop_vertices: np.ndarray, is_closed: bool) -> np.ndarray:
    """Vertices of a loop without a repetition of the first vertex. Raises `ValueError` if the loop is not closed."""
    repeats_first_vertex = len(loop_vertices) > 3 and np.allclose(
        loop_vertices[0], loop_vertices[-1], rtol=0, atol=1e-6 * np.ptp(loop_vertices)
    )
    if not (is_closed or repeats_first_vertex):
        raise ValueError(f"{describe_element(element)} is not closed; close the skin's outline.")
    return loop_vertices[:-1] if repeats_first_vertex else loop_vertices


_SVG_NAMESPACE = "http://www.w3.org/2000/svg"
_DRAWING_MARGIN = 1e-3  # m, around the drawing, so that lines on its edge are not cut off
# Units in metres; 96 pixels are an inch.
_METRES_PER_UNIT = {"mm": 1e-3, "cm": 1e-2, "in": 25.4e-3, "px": 25.4e-3 / 96, "pt": 25.4e-3 / 72}
_GROUP_NAMES = ("OUTLINE", "ELECTRODES", "LABELS")
_INKSCAPE_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_GROUP_TAGS = ("svg", "g", "a", "switch")
_INVISIBLE_TAGS = ("defs", "clipPath", "mask", "pattern", "symbol", "marker", "metadata", "style", "title", "desc")
_STRAIGHT_SHAPES = ("rect", "polygon", "polyline", "path")


def write_svg(layout: Layout, file: BinaryIO) -> None:
    """Write an electrode layout as an SVG drawing. Layout and drawing have the same origin; the y axis of the drawing
    points down, so y coordinates in the drawing are the negatives of the y coordinates in the layout."""
    x_min, x_max, y_min, y_max = layout.extent
    view_box_left, view_top = millimetres(x_min - _DRAWING_MARGIN), millimetres(-y_max - _DRAWING_MARGIN)
    page_width, page_height = (
        millimetres(x_max - x_min + 2 * _DRAWING_MARGIN),
        millimetres(y_max - y_min + 2 * _DRAWING_MARGIN),
    )
    page_attributes = {
        "width": f"{page_width}mm",
        "height": f"{page_height}mm",
        "viewBox": f"{view_box_left} {view_top} {page_width} {page_height}",
    }
    root_element = ElementTree.Element("svg", {"xmlns": _SVG_NAMESPACE, **page_attributes})
    _add_element(root_element, "title").text = layout.name
    line_style = {"fill": "none", "stroke-width": "0.1"}
    drawing_group = _add_element(root_element, "g", id="OUTLINE", stroke="#ff0000", **line_style)
    if layout.outline is not None:
        layout.outline.draw(_SvgPen(drawing_group))
    drawing_group = _add_element(root_element, "g", id="ELECTRODES", stroke="#0000ff", **line_style)
    text_style = {"text-anchor": "middle", "dominant-baseline": "central", "font-family": "sans-serif"}
    label_group = _add_element(root_element, "g", id="LABELS", fill="#808080", **text_style)
    centres, diameters = np.asarray(layout.centres), np.asarray(layout.diameters)
    for electrode_centre, electrode_diameter, label in zip(centres, diameters, layout.labels, strict=True):
        circle_attributes = _add_circle(electrode_centre, electrode_diameter)
        _add_element(drawing_group, "circle", **circle_attributes)
        text_position = {
            "x": circle_attributes["cx"],
            "y": circle_attributes["cy"],
            "font-size": str(millimetres(float(electrode_diameter) / 3)),
        }
        _add_element(label_group, "text", **text_position).text = label
    ElementTree.indent(root_element)
    ElementTree.ElementTree(root_element).write(file, encoding="utf-8", xml_declaration=True)


def read_svg(path: Path, outline: Domain | None) -> Layout:
    """Read an electrode layout from an SVG drawing, written by `write_svg` or by hand. Raises `ValueError` for an
    invalid or ambiguous drawing."""
    check_size(path, MAX_FILE_BYTES)
    with read_as("this is not an SVG drawing that is read"):
        root_element = ElementTree.parse(path, ElementTree.XMLParser(target=_SafeTreeBuilder())).getroot()
    if root_element.tag != f"{{{_SVG_NAMESPACE}}}svg":
        raise ValueError(f"this is not an SVG drawing: it begins with <{str(root_element.tag)[:40]}>.")
    drawn_shapes = list(_drawn_shapes(root_element))
    shape_roles = {shape_role for _, shape_role, _ in drawn_shapes}
    labels = [
        "".join(element.itertext()).strip()
        for element, shape_role, _ in drawn_shapes
        if shape_role == "LABELS" and local_tag(element) == "text"
    ]
    electrode_role = "ELECTRODES" if "ELECTRODES" in shape_roles else None
    electrodes = [
        (element, shape_matrix)
        for element, shape_role, shape_matrix in drawn_shapes
        if shape_role == electrode_role and (electrode_role or local_tag(element) in CIRCLE_AND_ELLIPSE_TAGS)
    ]
    if not electrodes:
        raise ValueError("there is no circle in the drawing; electrodes are circles, in a group ELECTRODES or all.")
    check_electrodes("the drawing", len(electrodes))
    electrode_circles = np.array([read_disc(element, shape_matrix) for element, shape_matrix in electrodes])
    drawn_outline = (
        _create_outline(
            [(element, shape_matrix) for element, shape_role, shape_matrix in drawn_shapes if shape_role == "OUTLINE"]
        )
        if "OUTLINE" in shape_roles
        else None
    )
    if "OUTLINE" not in shape_roles:
        drawn_outline = _single_closed_outline(
            [(element, shape_matrix) for element, shape_role, shape_matrix in drawn_shapes if shape_role is None]
        )
    return Layout(
        electrode_circles[:, :2],
        2 * electrode_circles[:, 2],
        outline=drawn_outline or outline,
        labels=labels or None,
        name=path.stem,
    )


def _add_element(parent_element: ElementTree.Element, element_tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent_element, element_tag, attributes)


def _add_circle(circle_centre, circle_diameter) -> dict[str, str]:
    x, y = circle_centre
    return {"cx": str(millimetres(x)), "cy": str(millimetres(-y)), "r": str(millimetres(circle_diameter / 2))}


class _SvgPen:
    """Pen that draws circles and polygons into a group of an SVG drawing."""

    def __init__(self, group: ElementTree.Element):
        self.group = group

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        _add_element(self.group, "circle", **_add_circle(centre, 2 * radius))

    def loop(self, vertices: np.ndarray) -> None:
        points = " ".join(f"{millimetres(x)},{millimetres(-y)}" for x, y in vertices)
        _add_element(self.group, "polygon", points=points)


class _SafeTreeBuilder(ElementTree.TreeBuilder):
    """Parser that rejects a document type declaration, since entities defined in it can expand without bounds."""

    def doctype(self, name, pubid, system) -> None:
        raise ValueError("the file has a <!DOCTYPE …>, which jeit does not read; remove it with a text editor.")


def _drawn_shapes(root_element: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str | None, np.ndarray]]:
    """Yield the shapes of a drawing in their order: the element; its role, which is the name in `_GROUP_NAMES` of the
    element or of an enclosing group, or None; and the matrix (2, 3) from the element's units to metres, with y up."""
    pending_elements: list[tuple[ElementTree.Element, str | None, np.ndarray]] = [
        (root_element, None, _matrix_to_metres(root_element))
    ]
    while pending_elements:
        element, element_role, element_matrix = pending_elements.pop()
        element_tag = local_tag(element)
        if (
            element_tag in _INVISIBLE_TAGS
            or not element.tag.startswith(f"{{{_SVG_NAMESPACE}}}")
            or "display:none" in _inline_style(element)
        ):
            continue
        if element_tag == "use" or (element_tag == "svg" and element is not root_element):
            raise ValueError(
                f"there is {describe_element(element)} in the drawing; unlink clones and embedded drawings first."
            )
        group_names = {element.get("id", ""), element.get(_INKSCAPE_LABEL, ""), *element.get("class", "").split()}
        element_role = next(
            (
                group_name
                for group_name in _GROUP_NAMES
                if group_name in {name_text.upper() for name_text in group_names}
            ),
            element_role,
        )
        if "transform" in element.attrib:
            element_matrix = compose_transforms(element_matrix, read_transform(element))
            if not (np.abs(element_matrix) < MAX_NUMBER).all():
                raise ValueError(f"transforms about {describe_element(element)} are too large for a drawing.")
        if element_tag in _GROUP_TAGS:
            pending_elements += [(child_element, element_role, element_matrix) for child_element in reversed(element)]
        else:
            yield element, element_role, element_matrix


def _matrix_to_metres(root_element: ElementTree.Element) -> np.ndarray:
    """Matrix (2, 3) from the units of the drawing to metres, with y up. Raises `ValueError` if the drawing does not
    state its size."""
    view_box = [
        parse_number(root_element, "viewBox", number_text)
        for number_text in re.split(r"[\s,]+", root_element.get("viewBox", "").strip())
        if number_text
    ]
    metres_per_unit = []
    for side_name, view_box_sizes in (("width", view_box[2:3]), ("height", view_box[3:4])):
        size_match = re.fullmatch(
            rf"({NUMBER_PATTERN})\s*({'|'.join(_METRES_PER_UNIT)})", root_element.get(side_name, "").strip()
        )
        if size_match is None:
            raise ValueError(
                f"{side_name} is {describe(root_element.get(side_name))}, which says no length; set the document's "
                f'size in mm ({side_name}="200mm").'
            )
        if view_box and (len(view_box) != 4 or not view_box_sizes[0] > 0):
            raise ValueError(
                f"viewBox is {describe(root_element.get('viewBox'))}; it is four numbers, the last two positive."
            )
        metres_per_unit.append(
            float(size_match[1]) * _METRES_PER_UNIT[size_match[2]] / view_box_sizes[0]
            if view_box
            else _METRES_PER_UNIT["px"]
        )
    if not math.isclose(*metres_per_unit, rel_tol=1e-3):
        raise ValueError(
            f"viewBox is {describe(root_element.get('viewBox'))}, so that a unit is {1e3 * metres_per_unit[0]:.4g} mm "
            f"across and {1e3 * metres_per_unit[1]:.4g} mm up; make its sides as width and height."
        )
    return np.array([[metres_per_unit[0], 0, 0], [0, -metres_per_unit[0], 0]])


def _inline_style(element: ElementTree.Element) -> str:
    return "".join(f"{element.get('style', '')};display:{element.get('display', '')}".split())


def _create_outline(drawn_shapes: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain:
    """Outline from the content of the group OUTLINE: a single circle, or shapes with straight sides, of which the
    largest is the skin and others are holes."""
    if len(drawn_shapes) == 1 and local_tag(drawn_shapes[0][0]) in CIRCLE_AND_ELLIPSE_TAGS:
        x, y, disc_radius = read_disc(*drawn_shapes[0])
        return Disk(disc_radius, (x, y))
    outline_loops = [
        transform_points(outline_loop, shape_matrix)
        for element, shape_matrix in drawn_shapes
        for outline_loop in read_loops(element)
    ]
    outline_loops.sort(key=lambda outline_loop: -np.prod(np.ptp(outline_loop, axis=0)))
    return Polygon(outline_loops[0], outline_loops[1:])


def _single_closed_outline(drawn_shapes: list[tuple[ElementTree.Element, np.ndarray]]) -> Domain | None:
    """Outline of a drawing without a group OUTLINE: its only closed shape with straight sides; None if the drawing has
    no shape with straight sides."""
    closed_shapes, shape_errors = [], []
    for element, shape_matrix in drawn_shapes:
        if local_tag(element) in _STRAIGHT_SHAPES:
            try:
                read_loops(element)
                closed_shapes.append((element, shape_matrix))
            except ValueError as error:
                shape_errors.append(error)
    if len(closed_shapes) > 1:
        raise ValueError(
            f"there are {len(closed_shapes)} closed shapes, {describe_element(closed_shapes[0][0])} the first; put "
            "the skin's into a group OUTLINE."
        )
    if not closed_shapes and shape_errors:
        raise shape_errors[0]
    return _create_outline(closed_shapes) if closed_shapes else None
