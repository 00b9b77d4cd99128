"""Shapes of an SVG drawing as numbers: transforms, circles, and closed loops of straight sides."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree

import numpy as np

from jeit.arguments import describe

# Possessive: what is no number is found so in one pass, however long it is.
NUMBER = r"[-+]?+(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?+\d++)?+"
# Greatest number in a drawing: its square can still be computed after moving and scaling.
LARGEST = 1e30
ROUND = ("circle", "ellipse")


def transform_of(element: ElementTree.Element) -> np.ndarray:
    """The matrix (2, 3) of an element's transform. Raises `ValueError` for one that cannot be read."""
    text, found = element.get("transform", "").strip(), np.eye(2, 3)
    if re.fullmatch(r"(\w++\s*+\([^()]*+\)[\s,]*+)*+", text) is None:
        raise ValueError(f"transform of {described(element)} is {describe(text)}, not a list of transforms.")
    for kind, inside in re.findall(r"(\w+)\s*\(([^()]*)\)", text):
        numbers = [number_of(element, "transform", part) for part in re.split(r"[\s,]+", inside.strip()) if part]
        match kind, numbers:
            case "matrix", [_, _, _, _, _, _]:
                one = np.array(numbers).reshape(3, 2).T
            case "translate", [x, *rest] if len(rest) < 2:
                one = np.array([[1, 0, x], [0, 1, rest[0] if rest else 0]])
            case "scale", [x, *rest] if len(rest) < 2:
                one = np.array([[x, 0, 0], [0, rest[0] if rest else x, 0]])
            case "rotate", [degrees, *middle] if len(middle) in (0, 2):
                angle, middle = math.radians(degrees), np.array(middle or [0.0, 0.0])
                turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
                one = np.column_stack([turn, middle - turn @ middle])
            case _:
                raise ValueError(
                    f"{described(element)} has {kind[:20]}({inside[:40]}); jeit reads matrix, translate, scale and "
                    "rotate."
                )
        found = composed(found, one)
    if not (np.abs(found) < LARGEST).all():
        raise ValueError(f"transform of {described(element)} is too large for a drawing.")
    return found


def composed(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The matrix (2, 3) that moves by `inner`, then by `outer`."""
    return outer[:, :2] @ inner + np.column_stack([np.zeros((2, 2)), outer[:, 2]])


def moved(points, to: np.ndarray) -> np.ndarray:
    """Points (k, 2) moved by a matrix (2, 3)."""
    return np.asarray(points, float).reshape(-1, 2) @ to[:, :2].T + to[:, 2]


def tag_of(element: ElementTree.Element) -> str:
    """The kind of an element."""
    return element.tag.split("}")[-1]


def described(element: ElementTree.Element) -> str:
    """An element as messages name it."""
    return (
        f"<{tag_of(element)[:20]} id={describe(element.get('id'))}>"
        if "id" in element.attrib
        else f"a <{tag_of(element)[:20]}>"
    )


def number_of(element: ElementTree.Element, name: str, text: str | None) -> float:
    """The number that `text`, of the attribute `name`, is. Raises `ValueError`."""
    if text is None or re.fullmatch(NUMBER, text.strip()) is None:
        raise ValueError(f"{name} of {described(element)} is {describe(text)}, not a number.")
    value = float(text)
    if not abs(value) < LARGEST:
        raise ValueError(f"{name} of {described(element)} is {describe(text)}, too large for a drawing.")
    return value


def disc_of(element: ElementTree.Element, to: np.ndarray) -> tuple[float, float, float]:
    """Centre and radius of a circle in metres, y up. Raises `ValueError` for what is none."""
    if tag_of(element) not in ROUND:
        raise ValueError(f"{described(element)} stands where a circle should: electrodes are circles.")
    x, y = (number_of(element, name, element.get(name, "0")) for name in ("cx", "cy"))
    names = ("r", "r") if tag_of(element) == "circle" else ("rx", "ry")
    radii = [number_of(element, name, element.get(name)) for name in names]
    half = np.linalg.svd(to[:, :2] * radii, compute_uv=False)
    if half[0] > half[1] * (1 + 1e-3):
        raise ValueError(
            f"{described(element)} is {2e3 * half[0]:.4g} mm long and {2e3 * half[1]:.4g} mm wide as it is drawn; "
            "electrodes are circles."
        )
    centre = moved([x, y], to)[0]
    return float(centre[0]), float(centre[1]), float(half.mean())


def loops_of(element: ElementTree.Element) -> list[np.ndarray]:
    """Vertices (k, 2) of a closed shape of straight sides, in its own unit; `ValueError` if it is none."""
    tag = tag_of(element)
    if tag == "rect":
        x, y = (number_of(element, name, element.get(name, "0")) for name in ("x", "y"))
        width, height = (number_of(element, name, element.get(name)) for name in ("width", "height"))
        if any(number_of(element, name, element.get(name, "0")) for name in ("rx", "ry")):
            raise ValueError(f"{described(element)} has round corners; draw the skin with straight sides.")
        return [np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])]
    if tag in ("polygon", "polyline"):
        values = [number_of(element, "points", text) for text in re.split(r"[\s,]+", element.get("points", "").strip())]
        if len(values) % 2:
            raise ValueError(f"points of {described(element)} are {len(values)} numbers, not pairs.")
        return [_closed(element, np.array(values).reshape(-1, 2), tag == "polygon")]
    if tag == "path":
        return _path_loops(element)
    raise ValueError(f"{described(element)} stands where the skin should: draw a rectangle, polygon, path or circle.")


def _path_loops(element: ElementTree.Element) -> list[np.ndarray]:
    text = element.get("d", "")
    if re.fullmatch(rf"(?:[MmLlHhVvZz]|{NUMBER}|[\s,])*+", text) is None or not text.strip():
        raise ValueError(f"{described(element)} has curves, or is no path; draw the skin with straight sides.")
    loops: list[tuple[list[np.ndarray], bool]] = []
    place = np.zeros(2)
    for letter, inside in re.findall(r"([MmLlHhVvZz])([^MmLlHhVvZz]*)", text):
        numbers = [number_of(element, "d", number) for number in re.findall(NUMBER, inside)]
        kind, relative = letter.upper(), letter.islower()
        size = {"H": 1, "V": 1}.get(kind, 2)
        if kind == "Z" and loops:
            loops[-1] = (loops[-1][0], True)
            place = loops[-1][0][0]
            continue
        if kind == "Z" or not numbers or len(numbers) % size or (kind != "M" and not loops):
            raise ValueError(f"d of {described(element)} is not a path: {letter}{inside.strip()[:40]}.")
        for index in range(0, len(numbers), size):
            origin = place if relative else np.array({"H": [0, place[1]], "V": [place[0], 0]}.get(kind, [0, 0]))
            step = {"H": [numbers[index], 0], "V": [0, numbers[index]]}.get(kind, numbers[index : index + 2])
            start, place = place, origin + np.array(step)
            if kind == "M" and index == 0:
                loops.append(([place], False))
            else:  # after a Z without an M, a line goes on from where the loop began
                if loops[-1][1]:
                    loops.append(([start], False))
                loops[-1][0].append(place)
    return [_closed(element, np.array(points), closed) for points, closed in loops]


def _closed(element: ElementTree.Element, loop: np.ndarray, closed: bool) -> np.ndarray:
    """Vertices of a loop, the first not repeated."""
    meets = len(loop) > 3 and np.allclose(loop[0], loop[-1], rtol=0, atol=1e-6 * np.ptp(loop))
    if not (closed or meets):
        raise ValueError(f"{described(element)} is not closed; close the skin's outline.")
    return loop[:-1] if meets else loop
