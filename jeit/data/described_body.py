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

_LENGTH_UNIT_FACTORS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
# Size of the body divided by the length that a key of `[geometry]` specifies.
_BODY_SIZE_PER_KEY_VALUE = {"radius": 2.0, "width": 1.0, "depth": 1.0, "height": 1.0, "thickness": 1.0}


def warn_large_body(table: GeometryTable, body: Body, origin: str) -> None:
    """Warn if lengths in `[geometry]` of the description file `origin` are so large that they seem not to be in
    metres."""
    from jeit.data.description_tables import PolygonTable  # already imported when the table was read

    lengths_by_key = {
        length_key: float(getattr(table, length_key, None) or 0) for length_key in _BODY_SIZE_PER_KEY_VALUE
    }
    large_lengths = {
        length_key: key_length
        for length_key, key_length in lengths_by_key.items()
        if _BODY_SIZE_PER_KEY_VALUE[length_key] * key_length > MAX_PLAUSIBLE_SIZE
    }
    if isinstance(body, OwnMesh):
        key_names, largest_size = "mesh", _largest_side(body.given.points)
        suggestions_by_unit = {
            unit_name: f"scale = {unit_factor * getattr(table, 'scale', 1.0):g}"
            for unit_name, unit_factor in _LENGTH_UNIT_FACTORS.items()
        }
    elif isinstance(table, PolygonTable) and not large_lengths:
        key_names, largest_size = "vertices", _largest_side(table.vertices)
        suggestions_by_unit = {
            unit_name: f"{unit_factor:g} times those" for unit_name, unit_factor in _LENGTH_UNIT_FACTORS.items()
        }
    else:
        key_names, largest_size = (
            ", geometry.".join(large_lengths),
            max(
                (_BODY_SIZE_PER_KEY_VALUE[length_key] * large_lengths[length_key] for length_key in large_lengths),
                default=0.0,
            ),
        )
        suggestions_by_unit = {
            unit_name: " and ".join(f"{unit_factor * key_length:g}" for key_length in large_lengths.values())
            for unit_name, unit_factor in _LENGTH_UNIT_FACTORS.items()
        }
    if not largest_size > MAX_PLAUSIBLE_SIZE:
        return
    length_text = " and ".join(f"{key_length:g} m" for key_length in large_lengths.values()) or f"{largest_size:.3g} m"
    warnings.warn(
        f"{origin}: geometry.{key_names}: {length_text} {'are' if len(large_lengths) > 1 else 'is'} large for what "
        f"electrodes are put on. If the lengths are millimetres, give {suggestions_by_unit['millimetres']}, if "
        f"centimetres, {suggestions_by_unit['centimetres']}, if inches, {suggestions_by_unit['inches']}, and so all "
        "other lengths: jeit computes in metres.",
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
        electrode_heights = np.asarray(electrodes.height)
        smaller_sizes = np.minimum(electrodes.width, electrode_heights)
    elif isinstance(electrodes, FaceDiscs):
        smaller_sizes, electrode_heights = 2 * np.asarray(electrodes.radius), np.zeros(electrodes.num_electrodes)
    else:
        return
    electrode_positions = np.asarray(electrodes.position)
    check_on_surface(
        electrode_positions, _MAX_SURFACE_DISTANCE * smaller_sizes, lambda points: _surface_distance(body, points)[0]
    )
    check_no_coincidence(electrode_positions, smaller_sizes)
    if isinstance(electrodes, FacePatches):
        x_min, x_max, y_min, y_max = body.extent
        side_lengths = x_max - x_min, y_max - y_min
        max_width = max(side_lengths) if isinstance(body.outline, Disk | Rectangle) else float(np.hypot(*side_lengths))
        check_size("width", np.asarray(electrodes.width), max_width, "the body")
    z, body_height = electrode_positions[:, 2], body.thickness
    electrode_overhangs, is_on_wall = (
        np.maximum(electrode_heights / 2 - z, z + electrode_heights / 2 - body_height),
        _surface_distance(body, electrode_positions)[1],
    )
    for electrode_index in np.flatnonzero(
        is_on_wall & (electrode_overhangs > _MAX_ELECTRODE_OVERHANG * electrode_heights)
    )[:1]:
        lower_end, upper_end = (
            z[electrode_index] - electrode_heights[electrode_index] / 2,
            z[electrode_index] + electrode_heights[electrode_index] / 2,
        )
        faulty_key = "height: " if electrode_heights[electrode_index] > body_height else ""
        raise ValueError(
            f"{faulty_key}electrode {electrode_index + 1} reaches from {lower_end:.4g} to {upper_end:.4g} m, and its "
            f"wall from 0 to {body_height:.4g} m: give the size of what lies on the wall, and its middle."
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


def _construct_box(width: float, depth: float, height: float) -> Solid:
    return Solid(Rectangle(width, depth), height)


def _construct_cylinder(radius: float, height: float) -> Solid:
    return Solid(Disk(radius), height)


SHAPES: dict[str, Callable[..., Body]] = {**OUTLINES, "box": _construct_box, "cylinder": _construct_cylinder}
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
        constructed_body = _construct_body(table, folder, origin)
    warn_large_body(table, constructed_body, origin)
    return constructed_body


def _construct_body(geometry_table: GeometryTable, folder: Path, file_name: str) -> Body:
    from jeit.data.description_tables import MeshTable  # already imported when the table was read

    if isinstance(geometry_table, MeshTable):
        return _mesh_from_file(geometry_table, folder, file_name)
    shape_arguments = {
        name: getattr(geometry_table, name)
        for name in type(geometry_table).model_fields
        if name not in _NON_ARGUMENT_KEYS
    }
    try:
        constructed_body = SHAPES[geometry_table.shape](**shape_arguments)
        body_thickness = getattr(geometry_table, "thickness", None)
        return (
            Solid(constructed_body, body_thickness)
            if isinstance(constructed_body, Domain) and body_thickness is not None
            else constructed_body
        )
    except ValueError as error:
        raise error_with_location(error, file_name, "geometry") from None


def _mesh_from_file(geometry_table: MeshTable, folder: Path, file_name: str) -> OwnMesh:
    file = folder / geometry_table.mesh
    if Path(geometry_table.mesh).name != geometry_table.mesh or ":" in geometry_table.mesh:
        raise error_with_location(
            f"must be the name of a file beside {file_name}, without folders.", file_name, "geometry.mesh"
        )
    if not file.is_file():
        raise error_with_location(
            f"there is no file {geometry_table.mesh[:80]}; put it beside {file_name}.", file_name, "geometry.mesh"
        )
    if file.resolve().parent != folder.resolve():
        raise error_with_location(
            f"is a link to another place; put the file beside {file_name}.", file_name, "geometry.mesh"
        )
    try:
        return OwnMesh(read_mesh(file, scale=geometry_table.scale))
    except (ValueError, OSError) as error:
        raise error_with_location(str(error).removeprefix("path: "), file_name, "geometry.mesh") from None


def described_electrodes(table: ElectrodesTable, body: Body | None, origin: str) -> AbstractElectrodes:
    """Construct the electrodes that the section `[electrodes]` of a description specifies, on `body` if the body is
    described.

    Raises `ValueError` if the electrodes are not valid.
    """
    try:
        if table.kind == "facets":
            return _facet_electrodes(table, body)
        electrode_positions = _electrode_positions(table, body, origin)
        num_coordinates = electrode_positions.shape[-1]
        if num_coordinates not in ELECTRODES[table.kind]:
            raise ValueError(
                f"positions: {num_coordinates} coordinates are not those of kind = '{table.kind}', which lies on "
                f"{'an edge: give x and y' if table.kind == 'boundary' else 'a solid: give x, y and z'}."
            )
        electrode_constructor = ELECTRODES[table.kind][num_coordinates]
        if table.kind == "point":
            return electrode_constructor(electrode_positions)
        electrodes = electrode_constructor(
            electrode_positions,
            *(getattr(table, electrode_sizes) for electrode_sizes in _SIZE_FIELDS[table.kind]),
            table.contact_impedance,
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
    argument_name, colon_text, problem_text = message.partition(": ")
    table_key = {"position": "positions", "positions": "positions", "width": "width", "height": "height"}.get(
        argument_name
    )
    return f"electrodes.{table_key}{colon_text}{problem_text}" if table_key else message


def _facet_electrodes(electrodes_table: FacetsTable, body: Body | None) -> AbstractElectrodes:
    """Electrodes that are named groups of boundary facets of the body's mesh."""
    if not isinstance(body, OwnMesh):
        raise ValueError("kind = 'facets' is of facets that a mesh has names for: give [geometry] mesh.")
    return plates(body.given, electrodes_table.tags, electrodes_table.contact_impedance)


def _electrode_positions(electrodes_table: PlacedTable, body: Body | None, file_name: str) -> np.ndarray:
    if electrodes_table.positions is not None:
        return electrodes_table.positions
    if body is None:
        raise ValueError(f"layout = {electrodes_table.layout!r} needs [geometry] to lie on.")
    if isinstance(body, OwnMesh):
        raise ValueError(
            f"layout = {electrodes_table.layout!r} needs a shape to lie on; on a mesh of your own give 'positions'."
        )
    body_outline = body.outline if isinstance(body, Solid) else body
    assert isinstance(body_outline, Domain)
    assert electrodes_table.number is not None
    if not isinstance(body, Solid):
        if electrodes_table.levels is not None:
            raise ValueError("levels are heights on a solid, and this is a sheet; leave them out, or give a thickness.")
        return _edge_positions(electrodes_table, body_outline, electrodes_table.number)
    if electrodes_table.levels is None:
        raise ValueError("on a solid it needs 'levels', heights in metres.")
    electrode_levels = np.atleast_1d(electrodes_table.levels)
    check_electrodes(f"{file_name}: electrodes", len(electrode_levels) * electrodes_table.number)
    if electrode_levels.max() > body.thickness:
        raise ValueError(f"levels must be heights from 0 to {body.thickness:g} m; one is {electrode_levels.max():g}.")
    level_positions = _edge_positions(electrodes_table, body_outline, electrodes_table.number)
    # Electrodes are ordered level after level, with the same number on each level.
    return np.concatenate(
        [
            np.column_stack([level_positions, np.full(len(level_positions), electrode_level)])
            for electrode_level in electrode_levels
        ]
    )


def _edge_positions(electrodes_table: PlacedTable, body_outline: Domain, num_electrodes: int) -> np.ndarray:
    """Positions (electrodes, 2) of electrodes along the edge of an outline."""
    if electrodes_table.layout == "perimeter":
        edge_positions = perimeter(body_outline, num_electrodes, start=electrodes_table.start)
        return np.roll(edge_positions[::-1], 1, axis=0) if electrodes_table.clockwise else edge_positions
    if not isinstance(body_outline, Disk):
        raise ValueError('layout = "ring" needs a disk or a cylinder; use "perimeter" for other shapes.')
    return ring(
        body_outline.radius,
        num_electrodes,
        start_angle=np.radians(electrodes_table.start_angle_degrees),
        clockwise=electrodes_table.clockwise,
        centre=body_outline.centre,
    )


def error_with_location(error: Exception | str, origin: str, key: str) -> ValueError:
    """Return a `ValueError` with the text of `error`, preceded by the file `origin` and the `key`, cut to 400
    characters."""
    text = str(error).removeprefix(f"{origin}: ")
    return ValueError(f"{origin[:80]}: {text if text.startswith(key) else f'{key}: {text}'}"[:400])
