"""Meshes of bodies that are refined at their electrodes, checks of electrode positions, and rectangular electrodes
(`FacePatches`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import MILLIMETRE_HINT
from jeit.electrodes.electrodes import (
    AbstractElectrodes,
    AbstractMovableElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
    as_positions,
    check_dimension,
)
from jeit.electrodes.facets import covered_moments, facet_normals, is_undistorted_from_above, tangent_frames
from jeit.mesh import Body, Mesh, OwnMesh, Rectangle, Refine, Solid
from jeit.mesh.checks import size_checked
from jeit.mesh.mesh import facet_measures
from jeit_solvers.engines import has_values, namespace, on_host, sum_into, undifferentiated, values_at_once

# Distance from a face, relative to the size of the body, within which a position is taken to lie on the face; also used
# in checks of electrodes.
_FACE_TOLERANCE = 1e-3
# Number of points on the rim of a patch on a horizontal face.
_NUM_RIM_POINTS = 16


@size_checked()
def body_mesh(body: Body, electrodes: AbstractElectrodes, num_points: int | None = None) -> Mesh:
    """Mesh a body with smaller cells at the electrodes: with the cell sizes that the electrodes' `refinement` requests
    or, for rectangular electrodes on solids, with layers and rows of cells that end at the edges of the electrodes.

    The edges of rectangular electrodes on a box, and their upper and lower edges on the wall of another solid, coincide
    with cell faces. An `OwnMesh` is not remeshed.

    **Arguments:**

    - `body`: an outline, a `Solid` or an `OwnMesh`.
    - `electrodes`: the electrodes, with lengths in metres.
    - `num_points`: number of nodes, approximately.

    Raises `ValueError` if `num_points` is missing, or if it is specified for an `OwnMesh`.

    **Example:**

    ```python
    from jeit.mesh import Disk
    fine = body_mesh(Disk(0.1), BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3), num_points=400)
    ```
    """
    if isinstance(body, OwnMesh):
        if num_points is not None:
            raise ValueError(
                f"num_points has no effect: the body is a mesh of your own, of {body.given.num_points} nodes, and is "
                "taken as it is; leave it out, or give a finer or coarser mesh."
            )
        return body.given
    if num_points is None:
        raise ValueError(
            "num_points is missing: give about how many nodes the mesh is to have, such as 2000, or 10000 of a solid."
        )
    if not isinstance(body, Solid):
        return body.mesh(num_points=num_points, refine=electrodes.refinement(body) or None)
    from jeit.mesh.refined_at_electrodes import graded_box, graded_layers

    if not isinstance(electrodes, FacePatches):
        return body.mesh(num_points=num_points, refine=electrodes.refinement(body) or None)
    body_outline, body_height = body.outline, float(body.thickness)
    positions = np.asarray(electrodes.position)
    half_sizes = np.stack([np.asarray(electrodes.width), np.asarray(electrodes.height)], axis=1) / 2
    x_min, x_max, y_min, y_max = body_outline.extent
    face_tolerance = _FACE_TOLERANCE * max(x_max - x_min, y_max - y_min, body_height)
    is_horizontal = (np.abs(positions[:, 2]) < face_tolerance) | (
        np.abs(positions[:, 2] - body_height) < face_tolerance
    )
    vertical_ends = positions[~is_horizontal, 2, None] + half_sizes[~is_horizontal, 1:] * np.array([-1.0, 1.0])
    if isinstance(body_outline, Rectangle):
        is_on_x_wall = (np.abs(positions[:, 0] - x_min) < face_tolerance) | (
            np.abs(positions[:, 0] - x_max) < face_tolerance
        )
        electrode_ends_x = _electrode_ends(positions[:, 0], half_sizes[:, 0], is_horizontal | ~is_on_x_wall)
        electrode_ends_y = np.concatenate(
            [
                _electrode_ends(positions[:, 1], half_sizes[:, 1], is_horizontal),
                _electrode_ends(positions[:, 1], half_sizes[:, 0], is_on_x_wall & ~is_horizontal),
            ]
        )
        return graded_box(
            body_outline, body_height, (electrode_ends_x, electrode_ends_y, vertical_ends.ravel()), num_points
        )
    rim_points = [
        np.zeros((0, 2)),
        *(
            _rim_points(body_outline, *patch_geometry)
            for patch_geometry in zip(positions, half_sizes, is_horizontal, strict=True)
        ),
    ]
    return graded_layers(body_outline, body_height, vertical_ends.ravel(), np.concatenate(rim_points), num_points)


def _electrode_ends(
    centre: Float[np.ndarray, " L"], half_size: Float[np.ndarray, " L"], selected
) -> Float[np.ndarray, " e"]:
    """Positions along an axis where the selected electrodes begin and end, from their `centre` and `half_size` along
    this axis."""
    return np.concatenate([(centre - half_size)[selected], (centre + half_size)[selected]])


def _rim_points(outline, centre, half_size, is_horizontal: bool) -> Float[np.ndarray, "p 2"]:
    """Points on the rim of an electrode, seen from above: all around an electrode on a horizontal face, and the two
    ends of an electrode on a wall."""
    if is_horizontal:
        angle = 2 * np.pi * np.arange(_NUM_RIM_POINTS) / _NUM_RIM_POINTS
        unit_circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # For a rectangle, the points where rays from its centre meet its sides.
        return centre[:2] + unit_circle * half_size / np.abs(unit_circle).max(axis=1, keepdims=True)
    nearest_outline_point = np.asarray(outline.nearest(centre[None, :2]))[0]
    step_length = 1e-3 * half_size[0]
    stepped_outline_points = np.asarray(outline.nearest(nearest_outline_point + step_length * np.eye(2)))
    tangent = (stepped_outline_points - nearest_outline_point)[
        np.argmax(np.linalg.norm(stepped_outline_points - nearest_outline_point, axis=1))
    ]
    tangent = tangent / np.linalg.norm(tangent)
    return np.asarray(
        outline.nearest(np.stack([centre[:2] - half_size[0] * tangent, centre[:2] + half_size[0] * tangent]))
    )


# Distance between two electrodes, divided by the size of the smaller electrode, below which they count as coincident.
_MIN_SEPARATION = 1e-3

DistanceFunction = Callable[[Float[np.ndarray, "L 3"]], Float[np.ndarray, " L"]]


def check_on_surface(
    position: Float[np.ndarray, "L 3"], max_distances: Float[np.ndarray, " L"], distance_from_surface: DistanceFunction
) -> None:
    """Raise `ValueError` for the first electrode whose distance from the surface of the body exceeds `max_distances`
    metres. `distance_from_surface`: function that returns the distances (L,) of positions (L, 3), metres."""
    distances_from_surface = distance_from_surface(position)
    for electrode_index in np.flatnonzero(distances_from_surface > max_distances)[:1]:
        advice_to_user = "give a place on it."
        if _all_on_surface(position / 1000, max_distances, distance_from_surface):
            advice_to_user = MILLIMETRE_HINT
        elif _all_on_surface(position * 1000, 1000 * max_distances, distance_from_surface):
            advice_to_user = "is the mesh in millimetres? Read it with scale = 1e-3."
        raise ValueError(
            f"position: electrode {electrode_index + 1} at {np.round(position[electrode_index], 6).tolist()} m lies "
            f"{_length_text(float(distances_from_surface[electrode_index]))} off the body's surface; {advice_to_user}"
        )


def _all_on_surface(position, max_distances, distance_from_surface: DistanceFunction) -> bool:
    """Whether all positions lie on the surface and are not all nearly the same. Positions that nearly coincide may lie
    on the surface by chance."""
    return bool(
        (np.ptp(position, axis=0).max() > max_distances).all()
        and (distance_from_surface(position) <= max_distances).all()
    )


def check_no_coincidence(position: Float[np.ndarray, "L 3"], size: Float[np.ndarray, " L"]) -> None:
    """Raise `ValueError` for the first two electrodes at the same position. `size`: smaller dimension of each
    electrode, metres."""
    distances_between_electrodes = np.linalg.norm(position[:, None] - position, axis=-1)
    coincident_electrodes = np.argwhere(
        np.triu(distances_between_electrodes < _MIN_SEPARATION * np.minimum(size[:, None], size), 1)
    )
    for first_electrode, second_electrode in coincident_electrodes[:1]:
        raise ValueError(
            f"position: electrodes {first_electrode + 1} and {second_electrode + 1} are at the same place, "
            f"{np.round(position[first_electrode], 6).tolist()} m; give each its own."
        )


def check_size(name: str, sizes: Float[np.ndarray, " L"], max_size: float, object_name: str) -> None:
    """Raise `ValueError` with the argument's `name` for the first electrode larger than `max_size` metres, the size of
    the object that the electrode lies on; `object_name` names this object."""
    for electrode_index in np.flatnonzero(sizes > (1 + _MIN_SEPARATION) * max_size)[:1]:
        electrode_size = float(sizes[electrode_index])
        unit_hint = (
            MILLIMETRE_HINT
            if 10 * max_size < electrode_size <= 1000 * max_size
            else "give the size of what lies on it."
        )
        raise ValueError(
            f"{name}: electrode {electrode_index + 1}'s is {_length_text(electrode_size)}, larger than {object_name}, "
            f"{_length_text(max_size)}; {unit_hint}"
        )


def check_placed(electrodes: AbstractMovableElectrodes, mesh: Mesh) -> None:
    """Raise `ValueError` for rectangular electrodes that lie off the surface of the mesh, or are larger than the
    surface."""
    electrode_sizes = {
        name: np.asarray(geometry_value)
        for name, geometry_value in electrodes.geometry().items()
        if name in ("width", "height")
    }
    mesh_points = np.asarray(mesh.points)
    from jeit.mesh.geodesic import Triangles

    surface = Triangles(mesh_points, np.asarray(mesh.facets))
    half_size = np.maximum(*electrode_sizes.values()) / 2
    check_on_surface(
        np.asarray(electrodes.position), half_size, lambda positions_to_check: surface.nearest(positions_to_check).away
    )
    diagonal = float(np.linalg.norm(np.ptp(mesh_points, axis=0)))
    for name, sizes_along_axis in electrode_sizes.items():
        check_size(name, sizes_along_axis, diagonal, "the body")


def _length_text(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 1 else f"{metres:.3g} m"


# Maximum number of non-overlapping patches that can reach a triangle no larger than the patches.
_MAX_PATCHES_PER_TRIANGLE = 8
# Triangle that replaces the triangles that a patch does not reach.
_UNIT_TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


class FacePatches(AbstractMovableElectrodes):
    """Complete electrodes that are rectangles on the surface of a 3-D mesh, independent of its nodes.

    A patch lies in the tangent plane at its position: its width is horizontal (perpendicular to z), and its height runs
    upward along the surface. On a horizontal face, width is along x and height along y. On a curved face the patch
    covers the projection of the rectangle onto the face: on a cylinder of radius R, an electrode of arc length a has
    the width 2 R sin(a / 2 R).

    **Fields**: `position` (L, 3): centres of the L electrodes on the surface, metres; `width`, `height` (L,): metres;
    `contact_impedance` (L,): ohm·m².

    **Example:**

    ```python
    electrodes = FacePatches(ring(0.1, 8, height=0.05), width=0.04, height=0.05, contact_impedance=1e-4)
    electrodes.check(tank)
    ```
    """

    position: Float[Array, "L 3"]
    width: Float[Array, " L"]
    height: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, width: ArrayLike, height: ArrayLike, contact_impedance: ArrayLike):
        """`width`, `height` and `contact_impedance` may each be one number for all electrodes. Raises `ValueError` for
        values that are not positive and for positions that are not finite."""
        self.position = as_positions(position, (3,))
        self.width = as_electrode_values("width", width, len(self.position), unit="metres")
        self.height = as_electrode_values("height", height, len(self.position), unit="metres")
        self.contact_impedance = as_electrode_values(
            "contact_impedance", contact_impedance, len(self.position), unit="ohm·m²"
        )

    def geometry(self) -> dict[str, Array]:
        """Positions, widths and heights of the electrodes, metres."""
        return {"position": self.position, "width": self.width, "height": self.height}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw electrodes on horizontal faces as rectangles, all others as dots."""
        positions, is_flat = np.asarray(self.position), is_undistorted_from_above(mesh, self.position)
        electrode_sizes = np.asarray(self.width), np.asarray(self.height)
        for position, electrode_width, electrode_height, is_undistorted in zip(
            positions, *electrode_sizes, is_flat, strict=True
        ):
            if is_undistorted:
                pen.rectangle(position, electrode_width, electrode_height)
            else:
                pen.dot(position)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes do not lie on a plane mesh."""
        return ()

    def directions(self, mesh: Mesh) -> Float[np.ndarray, "L a 3"]:
        """Unit vectors along width and height of each patch."""
        return np.stack(tangent_frames(on_host(mesh), np.asarray(self.position))[1:], axis=1)

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the boundary triangles of `mesh`."""
        return (mesh.facets,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Exact contact integrals over the parts of boundary triangles that lie within the patches, seen along the
        normals of the patches."""
        xp = namespace(self, mesh)
        area, half_size = facet_measures(mesh), xp.stack([self.width, self.height], axis=-1) / 2
        normal, tangent, upward_direction = tangent_frames(mesh, self.position)
        corners = mesh.points[mesh.facets]
        nearest_indices, is_facet_reached = _reaching_patches(
            mesh, self.position, half_size, (normal, tangent, upward_direction)
        )
        reached_facets = is_facet_reached.any(axis=1).nonzero()[0] if xp is np else np.arange(len(area))
        nearest_indices, is_facet_reached = nearest_indices[reached_facets], is_facet_reached[reached_facets]
        corner_offsets = corners[reached_facets][:, None] - self.position[nearest_indices][:, :, None]  # (q, k, 3, 3)
        corner_coordinates = xp.stack(
            [(corner_offsets * axis[nearest_indices][:, :, None]).sum(axis=-1) for axis in (tangent, upward_direction)],
            axis=-1,
        )
        # A triangle perpendicular to the patch has no projected area; replace it to avoid a division by zero.
        corner_coordinates = xp.where(is_facet_reached[..., None, None], corner_coordinates, _UNIT_TRIANGLE)
        covered_area, covered_mass = covered_moments(corner_coordinates, half_size[nearest_indices])
        current = xp.where(is_facet_reached, area[reached_facets][:, None] / self.contact_impedance[nearest_indices], 0)
        mass = (current[..., None, None] * covered_mass).sum(axis=1)
        nodes = mesh.facets[reached_facets]
        load_shape = mesh.num_points, self.num_electrodes
        load = sum_into(load_shape, (nodes[:, None], nearest_indices[..., None]), current[..., None] * covered_area)
        if xp is np:
            masses_of_all_patches: Any = np.zeros((len(area), 3, 3), mass.dtype)
            masses_of_all_patches[reached_facets] = mass
            mass = masses_of_all_patches
        return Contact((mesh.facets,), (mass,), load)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for patches off the surface, overlapping, larger than the body, or too small for the
        mesh."""
        check_dimension("FacePatches", mesh, 3)
        if not has_values(self, mesh):
            return
        electrodes, mesh = on_host((self, mesh))
        check_no_coincidence(electrodes.position, np.minimum(electrodes.width, electrodes.height))
        covered_areas = electrodes.contact(mesh).load * electrodes.contact_impedance
        covered_fractions = covered_areas.sum(axis=0) / (electrodes.width * electrodes.height)
        # A patch on a curved wall is longer than its chord: by a tenth at 80° of arc.
        misplaced_electrodes = np.flatnonzero((covered_fractions < 0.8) | (covered_fractions > 1.25))
        if misplaced_electrodes.size:
            check_placed(electrodes, mesh)
            raise ValueError(
                f"position: {100 * covered_fractions[misplaced_electrodes[0]]:.0f} % of electrode "
                f"{misplaced_electrodes[0] + 1}'s area is found on the mesh's surface; move it onto the surface, or "
                "refine the mesh there if the patch is smaller than a facet."
            )
        relative_overlap = (covered_areas.T @ covered_areas) / np.sqrt(
            np.outer(*(2 * [(covered_areas**2).sum(axis=0)]))
        )
        np.fill_diagonal(relative_overlap, 0)
        if relative_overlap.max() > 0.2:
            first_electrode, second_electrode = np.unravel_index(relative_overlap.argmax(), relative_overlap.shape)
            raise ValueError(f"Electrodes {first_electrode + 1} and {second_electrode + 1} overlap; move them apart.")


def _reaching_patches(mesh: Mesh, position, half_size, frames):
    """Patches (b, k) that may cover a part of each boundary triangle, nearest first, and whether each patch reaches the
    triangle.

    A triangle must lie on the same side of the body as the patch: it must have a similar normal, and its distance from
    the plane of the patch must be less than half the longer side of the patch. The results have no derivatives.
    """
    xp = namespace(mesh, position)
    corners = mesh.points[mesh.facets]
    centres = corners.mean(axis=1)
    radius = xp.sqrt(((corners - centres[:, None]) ** 2).sum(axis=-1).max(axis=1))
    offsets_along_axes = [centres @ axis.T - (position * axis).sum(axis=1) for axis in frames]
    excess_distances = [xp.maximum(abs(offsets_along_axes[1 + i]) - half_size[:, i], 0) for i in range(2)]
    is_facing = (facet_normals(mesh) @ frames[0].T > 0.5) & (abs(offsets_along_axes[0]) < half_size.max(axis=1))
    squared_distance = undifferentiated(
        xp.where(is_facing, excess_distances[0] ** 2 + excess_distances[1] ** 2, xp.inf)
    )
    is_facet_reached = squared_distance <= undifferentiated(radius**2)[:, None]
    num_nearest_patches = min(_MAX_PATCHES_PER_TRIANGLE, len(position))
    if xp is np:
        num_nearest_patches = max(1, min(num_nearest_patches, int(is_facet_reached.sum(axis=1).max(initial=0))))
        nearest_indices = np.argsort(squared_distance, axis=1, kind="stable")[:, :num_nearest_patches]
    else:
        nearest_indices = jax.lax.top_k(-squared_distance, num_nearest_patches)[1]
    return nearest_indices, xp.take_along_axis(is_facet_reached, nearest_indices, axis=1)
