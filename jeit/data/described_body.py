"""The sections `[geometry]` and `[electrodes]` of a description: the body, and what touches it."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jeit.data._sections import choice, located, need, refuse_unknown
from jeit.electrodes import AbstractElectrodes, BoundaryElectrodes, FaceDiscs, FacePatches, PointElectrodes, SheetDiscs
from jeit.electrodes.facets import plates
from jeit.layout import perimeter, ring
from jeit.mesh import Body, Disk, Domain, OwnMesh, Rectangle, Solid
from jeit.mesh import read as read_mesh
from jeit.mesh.outline import OUTLINES

_GEOMETRY, _ELECTRODES = "[geometry]", "[electrodes]"


def _box(width: float, depth: float, height: float) -> Solid:
    return Solid(Rectangle(width, depth), height)


def _cylinder(radius: float, height: float) -> Solid:
    return Solid(Disk(radius), height)


SHAPES: dict[str, Callable[..., Body]] = {**OUTLINES, "box": _box, "cylinder": _cylinder}
"""What makes each body, by the name of its shape."""
_ARGUMENTS = {
    shape: {name: one.default is one.empty for name, one in inspect.signature(make).parameters.items()}
    for shape, make in SHAPES.items()
}
ELECTRODES: dict[str, dict[int, type[Any]]] = {
    "boundary": {2: BoundaryElectrodes},
    "disc": {2: SheetDiscs, 3: FaceDiscs},
    "patch": {3: FacePatches},
    "point": {2: PointElectrodes, 3: PointElectrodes},
}
"""Electrodes at positions, by kind and the number of their coordinates."""
SIZES = {"boundary": ("width",), "disc": ("radius",), "patch": ("width", "height"), "point": ()}
"""What must be said of the size of each kind, metres."""
KEYS = {
    "geometry": {"shape", "thickness", "mesh", "scale"}.union(*_ARGUMENTS.values()),
    "electrodes": {
        "kind", "layout", "number", "start_angle_degrees", "clockwise", "start", "levels", "positions", "tags",
        "contact_impedance",
    }.union(*SIZES.values()),
}  # fmt: skip


def described_body(section: dict[str, Any], folder: Path, origin: str) -> Body:
    """The body of a section `[geometry]`; a mesh's file is looked for in `folder`. Raises `ValueError`."""
    if "mesh" in section:
        return _own_mesh(section, folder, origin)
    shape = choice(need(section, "shape", origin, f"{_GEOMETRY} (or 'mesh')"), SHAPES, origin, f"{_GEOMETRY} shape")
    arguments = {
        name: need(section, name, origin, f"{_GEOMETRY} {shape}") if needed else section[name]
        for name, needed in _ARGUMENTS[shape].items()
        if needed or name in section
    }
    known = {"shape", *_ARGUMENTS[shape]} | ({"thickness"} if shape in OUTLINES else set())
    refuse_unknown(section, known, origin, f"{_GEOMETRY} {shape}")
    try:
        body = SHAPES[shape](**arguments)
        return Solid(body, section["thickness"]) if isinstance(body, Domain) and "thickness" in section else body
    except ValueError as error:
        raise located(error, origin, _GEOMETRY) from None


def _own_mesh(section: dict[str, Any], folder: Path, origin: str) -> OwnMesh:
    refuse_unknown(section, {"mesh", "scale"}, origin, f"{_GEOMETRY} with a mesh")
    if not isinstance(section["mesh"], str):
        raise ValueError(f"{origin}: {_GEOMETRY} mesh must be the name of a file; got {section['mesh']!r}.")
    file = folder / section["mesh"]
    if not file.is_file():
        raise ValueError(f"{origin}: {_GEOMETRY} mesh: there is no file {file}; name it from where {origin} is.")
    try:
        return OwnMesh(read_mesh(file, scale=section.get("scale", 1.0)))
    except (ValueError, OSError) as error:
        raise located(error, origin, f"{_GEOMETRY} mesh") from None


def described_electrodes(section: dict[str, Any], body: Body | None, origin: str) -> AbstractElectrodes:
    """The electrodes of a section `[electrodes]` on a body, if that is described. Raises `ValueError`."""
    kind = choice(section.get("kind", "boundary"), (*ELECTRODES, "facets"), origin, f"{_ELECTRODES} kind")
    try:
        if kind == "facets":
            return _facets(section, body, origin)
        position = _positions(section, body, origin)
        coordinates = position.shape[-1] if position.ndim == 2 else 2
        if coordinates not in ELECTRODES[kind]:
            raise ValueError(
                f"positions: {coordinates} coordinates are not those of kind = '{kind}', which lies on "
                f"{'an edge: give x and y' if kind == 'boundary' else 'a solid: give x, y and z'}."
            )
        make = ELECTRODES[kind][coordinates]
        if kind == "point":
            return make(position)
        sizes = [np.asarray(need(section, size, origin, f"{_ELECTRODES} {kind}"), float) for size in SIZES[kind]]
        contact_impedance = need(section, "contact_impedance", origin, _ELECTRODES)
        return make(position, *sizes, np.asarray(contact_impedance, float))
    except (ValueError, TypeError) as error:
        raise located(error, origin, _ELECTRODES) from None


def _facets(section: dict[str, Any], body: Body | None, origin: str) -> AbstractElectrodes:
    """Groups of facets that the mesh has names for."""
    if not isinstance(body, OwnMesh):
        raise ValueError("kind = 'facets' is of facets that a mesh has names for: give [geometry] mesh.")
    tags = need(section, "tags", origin, f"{_ELECTRODES} facets")
    return plates(body.given, tags, need(section, "contact_impedance", origin, _ELECTRODES))


def _positions(section: dict[str, Any], body: Body | None, origin: str) -> np.ndarray:
    if "positions" in section:
        return np.asarray(section["positions"], dtype=float)
    layout = need(section, "layout", origin, f"{_ELECTRODES} (or 'positions')")
    choice(layout, ("ring", "perimeter"), origin, f"{_ELECTRODES} layout")
    number = need(section, "number", origin, _ELECTRODES)
    if body is None:
        raise ValueError(f"layout = {layout!r} needs [geometry] to lie on.")
    if isinstance(body, OwnMesh):
        raise ValueError(f"layout = {layout!r} needs a shape to lie on; on a mesh of your own give 'positions'.")
    outline = body.outline if isinstance(body, Solid) else body
    assert isinstance(outline, Domain)
    around = _around(section, layout, outline, number)
    if not isinstance(body, Solid):
        return around
    levels = np.atleast_1d(np.asarray(need(section, "levels", origin, f"{_ELECTRODES} on a solid"), float))
    if levels.ndim != 1 or not ((levels >= 0) & (levels <= body.thickness)).all():
        raise ValueError(f"levels must be heights from 0 to {body.thickness:g} m; they are {levels.tolist()}.")
    # Level after level, each with as many electrodes.
    return np.concatenate([np.column_stack([around, np.full(len(around), level)]) for level in levels])


def _around(section: dict[str, Any], layout: str, outline: Domain, number: int) -> np.ndarray:
    """Places (L, 2) along the edge of an outline."""
    if layout == "perimeter":
        return perimeter(outline, number, start=section.get("start", 0.0))
    if not isinstance(outline, Disk):
        raise ValueError('layout = "ring" needs a disk or a cylinder; use "perimeter" for other shapes.')
    return ring(
        outline.radius,
        number,
        start_angle=np.radians(section.get("start_angle_degrees", 90.0)),
        clockwise=section.get("clockwise", False),
        centre=outline.centre,
    )
