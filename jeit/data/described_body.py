"""Construction of body and electrodes from the sections `[geometry]` and `[electrodes]` of a description file, and
checks that the electrodes lie on the body."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jeit.electrodes import AbstractElectrodes, BoundaryElectrodes, FaceDiscs, FacePatches, PointElectrodes, SheetDiscs
from jeit.electrodes.face_patches import check_no_coincidence, check_on_surface, check_size
from jeit.electrodes.facets import plates
from jeit.files import check_electrodes
from jeit.layout import perimeter, ring
from jeit.mesh import Body, Disk, Domain, OwnMesh, Rectangle, Solid
from jeit.mesh import read as read_mesh
from jeit.mesh.checks import MAX_PLAUSIBLE_SIZE, size_checked
from jeit.mesh.outline import OUTLINES

if TYPE_CHECKING:
    from jeit.data.description_tables import ElectrodesTable, FacetsTable, GeometryTable, MeshTable, PlacedTable

_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
# Size of the body divided by the length that a key of `[geometry]` specifies.
_BODY_SIZE_PER_KEY_VALUE = {"radius": 2.0, "width": 1.0, "depth": 1.0, "height": 1.0, "thickness": 1.0}


def warn_large_body(table: GeometryTable, body: Body, origin: str) -> None:
    """Warn if lengths in `[geometry]` of the description file `origin` are so large that they seem not to be in
    metres."""
    from jeit.data.description_tables import PolygonTable  # already imported when the table was read

    lengths = {key: float(getattr(table, key, None) or 0) for key in _BODY_SIZE_PER_KEY_VALUE}
    large_lengths = {
        key: length for key, length in lengths.items() if _BODY_SIZE_PER_KEY_VALUE[key] * length > MAX_PLAUSIBLE_SIZE
    }
    if isinstance(body, OwnMesh):
        key_names, size = "mesh", _largest_side(body.given.points)
        suggestions = {unit: f"scale = {factor * getattr(table, 'scale', 1.0):g}" for unit, factor in _UNITS.items()}
    elif isinstance(table, PolygonTable) and not large_lengths:
        key_names, size = "vertices", _largest_side(table.vertices)
        suggestions = {unit: f"{factor:g} times those" for unit, factor in _UNITS.items()}
    else:
        key_names, size = (
            ", geometry.".join(large_lengths),
            max((_BODY_SIZE_PER_KEY_VALUE[key] * large_lengths[key] for key in large_lengths), default=0.0),
        )
        suggestions = {
            unit: " and ".join(f"{factor * length:g}" for length in large_lengths.values())
            for unit, factor in _UNITS.items()
        }
    if not size > MAX_PLAUSIBLE_SIZE:
        return
    length_text = " and ".join(f"{length:g} m" for length in large_lengths.values()) or f"{size:.3g} m"
    warnings.warn(
        f"{origin}: geometry.{key_names}: {length_text} {'are' if len(large_lengths) > 1 else 'is'} large for what "
        f"electrodes are put on. If the lengths are millimetres, give {suggestions['millimetres']}, if centimetres, "
        f"{suggestions['centimetres']}, if inches, {suggestions['inches']}, and so all other lengths: jeit computes in "
        "metres.",
        UserWarning,
        stacklevel=5,
    )


def _largest_side(points) -> float:
    return float(np.ptp(np.asarray(points), axis=0).max())


# Maximum distance of an electrode from the surface as a fraction of the electrode's smaller dimension, and maximum
# overhang beyond the wall as a fraction of the wall's height.
_MAX_SURFACE_DISTANCE = 0.1
_MAX_ELECTRODE_OVERHANG = 0.02


def check_on_solid(electrodes: AbstractElectrodes, body: Solid) -> None:
    """Raise `ValueError` for electrodes that lie off the surface of a solid, that coincide, that are wider than the
    body (patches), or that extend above or below its wall."""
    if isinstance(electrodes, FacePatches):
        height = np.asarray(electrodes.height)
        smaller_sizes = np.minimum(electrodes.width, height)
    elif isinstance(electrodes, FaceDiscs):
        smaller_sizes, height = 2 * np.asarray(electrodes.radius), np.zeros(electrodes.num_electrodes)
    else:
        return
    positions = np.asarray(electrodes.position)
    check_on_surface(
        positions, _MAX_SURFACE_DISTANCE * smaller_sizes, lambda points: _surface_distance(body, points)[0]
    )
    check_no_coincidence(positions, smaller_sizes)
    if isinstance(electrodes, FacePatches):
        x_min, x_max, y_min, y_max = body.extent
        side_lengths = x_max - x_min, y_max - y_min
        max_width = max(side_lengths) if isinstance(body.outline, Disk | Rectangle) else float(np.hypot(*side_lengths))
        check_size("width", np.asarray(electrodes.width), max_width, "the body")
    z, body_height = positions[:, 2], body.thickness
    overhangs, is_on_wall = (
        np.maximum(height / 2 - z, z + height / 2 - body_height),
        _surface_distance(body, positions)[1],
    )
    for electrode_index in np.flatnonzero(is_on_wall & (overhangs > _MAX_ELECTRODE_OVERHANG * height))[:1]:
        lower_end, upper_end = (
            z[electrode_index] - height[electrode_index] / 2,
            z[electrode_index] + height[electrode_index] / 2,
        )
        key = "height: " if height[electrode_index] > body_height else ""
        raise ValueError(
            f"{key}electrode {electrode_index + 1} reaches from {lower_end:.4g} to {upper_end:.4g} m, and its wall "
            f"from 0 to {body_height:.4g} m: give the size of what lies on the wall, and its middle."
        )


def _surface_distance(body: Solid, points: Float[np.ndarray, "L 3"]):
    """Distances of points (points, 3) from the surface of a solid, in metres, and whether the wall is nearer than the
    top and bottom."""
    z = points[:, 2]
    wall_distances, lid_distances = (
        np.asarray(body.outline.signed_distance(points[:, :2])),
        np.minimum(z, body.thickness - z),
    )
    distances_to_wall, distances_to_lid = np.abs(wall_distances), np.abs(lid_distances)
    # Outside the body, the distances beyond the wall and beyond the lid are the legs of a right triangle.
    outside_distances = np.hypot(np.minimum(wall_distances, 0), np.minimum(lid_distances, 0))
    return np.where(
        outside_distances > 0, outside_distances, np.minimum(distances_to_wall, distances_to_lid)
    ), distances_to_wall <= distances_to_lid


def _box(width: float, depth: float, height: float) -> Solid:
    return Solid(Rectangle(width, depth), height)


def _cylinder(radius: float, height: float) -> Solid:
    return Solid(Disk(radius), height)


SHAPES: dict[str, Callable[..., Body]] = {**OUTLINES, "box": _box, "cylinder": _cylinder}
"""Constructor of each body, by the name of its shape."""
ELECTRODES: dict[str, dict[int, type[Any]]] = {
    "boundary": {2: BoundaryElectrodes},
    "disc": {2: SheetDiscs, 3: FaceDiscs},
    "patch": {3: FacePatches},
    "point": {2: PointElectrodes, 3: PointElectrodes},
}
"""Classes of electrodes with positions, by kind and number of coordinates."""
_SIZE_FIELDS = {"boundary": ("width",), "disc": ("radius",), "patch": ("width", "height"), "point": ()}
# Keys of a shape's table that are not arguments of its constructor.
_NON_ARGUMENT_KEYS = {"shape", "thickness"}


def described_body(table: GeometryTable, folder: Path, origin: str) -> Body:
    """Construct the body that the section `[geometry]` of a description specifies; `folder` contains the mesh file that
    the section may name.

    Raises `ValueError` if the section is not valid, and warns if lengths seem too large to be in metres.
    """
    with size_checked():
        body = _body(table, folder, origin)
    warn_large_body(table, body, origin)
    return body


def _body(table: GeometryTable, folder: Path, origin: str) -> Body:
    from jeit.data.description_tables import MeshTable  # already imported when the table was read

    if isinstance(table, MeshTable):
        return _mesh_from_file(table, folder, origin)
    arguments = {name: getattr(table, name) for name in type(table).model_fields if name not in _NON_ARGUMENT_KEYS}
    try:
        body = SHAPES[table.shape](**arguments)
        thickness = getattr(table, "thickness", None)
        return Solid(body, thickness) if isinstance(body, Domain) and thickness is not None else body
    except ValueError as error:
        raise error_with_location(error, origin, "geometry") from None


def _mesh_from_file(table: MeshTable, folder: Path, origin: str) -> OwnMesh:
    file = folder / table.mesh
    if Path(table.mesh).name != table.mesh or ":" in table.mesh:
        raise error_with_location(
            f"must be the name of a file beside {origin}, without folders.", origin, "geometry.mesh"
        )
    if not file.is_file():
        raise error_with_location(
            f"there is no file {table.mesh[:80]}; put it beside {origin}.", origin, "geometry.mesh"
        )
    if file.resolve().parent != folder.resolve():
        raise error_with_location(f"is a link to another place; put the file beside {origin}.", origin, "geometry.mesh")
    try:
        return OwnMesh(read_mesh(file, scale=table.scale))
    except (ValueError, OSError) as error:
        raise error_with_location(str(error).removeprefix("path: "), origin, "geometry.mesh") from None


def described_electrodes(table: ElectrodesTable, body: Body | None, origin: str) -> AbstractElectrodes:
    """Construct the electrodes that the section `[electrodes]` of a description specifies, on `body` if the body is
    described.

    Raises `ValueError` if the electrodes are not valid.
    """
    try:
        if table.kind == "facets":
            return _facets(table, body)
        position = _positions(table, body, origin)
        num_coordinates = position.shape[-1]
        if num_coordinates not in ELECTRODES[table.kind]:
            raise ValueError(
                f"positions: {num_coordinates} coordinates are not those of kind = '{table.kind}', which lies on "
                f"{'an edge: give x and y' if table.kind == 'boundary' else 'a solid: give x, y and z'}."
            )
        constructor = ELECTRODES[table.kind][num_coordinates]
        if table.kind == "point":
            return constructor(position)
        electrodes = constructor(
            position, *(getattr(table, size) for size in _SIZE_FIELDS[table.kind]), table.contact_impedance
        )
        if isinstance(body, Solid):
            check_on_solid(electrodes, body)
        elif isinstance(body, OwnMesh) and isinstance(electrodes, FacePatches):
            electrodes.check(body.given)
        return electrodes
    except ValueError as error:
        raise error_with_location(_replace_argument_by_key(str(error)), origin, "electrodes") from None


def _replace_argument_by_key(message: str) -> str:
    """Replace the argument name at the beginning of an error message about electrodes by the corresponding key of the
    description."""
    argument, colon, problem = message.partition(": ")
    key = {"position": "positions", "positions": "positions", "width": "width", "height": "height"}.get(argument)
    return f"electrodes.{key}{colon}{problem}" if key else message


def _facets(table: FacetsTable, body: Body | None) -> AbstractElectrodes:
    """Electrodes that are named groups of boundary facets of the body's mesh."""
    if not isinstance(body, OwnMesh):
        raise ValueError("kind = 'facets' is of facets that a mesh has names for: give [geometry] mesh.")
    return plates(body.given, table.tags, table.contact_impedance)


def _positions(table: PlacedTable, body: Body | None, origin: str) -> np.ndarray:
    if table.positions is not None:
        return table.positions
    if body is None:
        raise ValueError(f"layout = {table.layout!r} needs [geometry] to lie on.")
    if isinstance(body, OwnMesh):
        raise ValueError(f"layout = {table.layout!r} needs a shape to lie on; on a mesh of your own give 'positions'.")
    outline = body.outline if isinstance(body, Solid) else body
    assert isinstance(outline, Domain)
    assert table.number is not None
    if not isinstance(body, Solid):
        if table.levels is not None:
            raise ValueError("levels are heights on a solid, and this is a sheet; leave them out, or give a thickness.")
        return _edge_positions(table, outline, table.number)
    if table.levels is None:
        raise ValueError("on a solid it needs 'levels', heights in metres.")
    levels = np.atleast_1d(table.levels)
    check_electrodes(f"{origin}: electrodes", len(levels) * table.number)
    if levels.max() > body.thickness:
        raise ValueError(f"levels must be heights from 0 to {body.thickness:g} m; one is {levels.max():g}.")
    level_positions = _edge_positions(table, outline, table.number)
    # Electrodes are ordered level after level, with the same number on each level.
    return np.concatenate(
        [np.column_stack([level_positions, np.full(len(level_positions), level)]) for level in levels]
    )


def _edge_positions(table: PlacedTable, outline: Domain, num_electrodes: int) -> np.ndarray:
    """Positions (electrodes, 2) of electrodes along the edge of an outline."""
    if table.layout == "perimeter":
        positions = perimeter(outline, num_electrodes, start=table.start)
        return np.roll(positions[::-1], 1, axis=0) if table.clockwise else positions
    if not isinstance(outline, Disk):
        raise ValueError('layout = "ring" needs a disk or a cylinder; use "perimeter" for other shapes.')
    return ring(
        outline.radius,
        num_electrodes,
        start_angle=np.radians(table.start_angle_degrees),
        clockwise=table.clockwise,
        centre=outline.centre,
    )


def error_with_location(error: Exception | str, origin: str, key: str) -> ValueError:
    """Return a `ValueError` with the text of `error`, preceded by the file `origin` and the `key`, cut to 400
    characters."""
    text = str(error).removeprefix(f"{origin}: ")
    return ValueError(f"{origin[:80]}: {text if text.startswith(key) else f'{key}: {text}'}"[:400])
