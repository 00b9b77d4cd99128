"""Combination of several kinds of electrodes, and shapes of electrodes as polygons for drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.electrodes.electrodes import (
    AbstractCompleteElectrodes,
    AbstractElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
)
from jeit.mesh import Body, Mesh, Refine
from jeit_solvers.engines import namespace, values_at_once


class CombinedElectrodes(AbstractCompleteElectrodes):
    """Complete electrodes of several kinds, numbered consecutively from one kind to the next.

    **Fields**: `parts`: the electrodes of each kind, not including point electrodes.

    **Example:**

    ```python
    rim = BoundaryElectrodes(ring(0.1, 8), 0.01, 1e-3)
    both = CombinedElectrodes(rim, SheetDiscs([[0.0, 0.0]], 0.02, 1e-4))
    ```
    """

    parts: tuple[AbstractElectrodes, ...]

    def __init__(self, *parts: AbstractElectrodes):
        """Raises `ValueError` if there are no parts, or for point electrodes, which have no contact to combine."""
        if not parts:
            raise ValueError("CombinedElectrodes needs at least one set of electrodes.")
        for electrode_group in parts:
            if electrode_group.is_point:
                raise ValueError(
                    f"{type(electrode_group).__name__} cannot be combined with complete electrodes: give them a size "
                    "and a contact impedance (SheetDiscs, FaceDiscs), or make all electrodes points."
                )
        self.parts = parts

    @property
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Contact impedances (L,) of all parts, ohm·m² (ohm·m for arcs on the edge of a sheet)."""
        return namespace(self).concatenate([electrode_group.contact_impedance for electrode_group in self.parts])

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractCompleteElectrodes:
        """Copy of the electrodes with new contact impedances, ohm·m² (ohm·m for arcs). Raises `ValueError` for values
        that are not positive."""
        impedances = as_electrode_values("contact_impedance", contact_impedance, self.num_electrodes, unit="ohm·m²")
        impedances_of_groups = jnp.split(
            impedances, np.cumsum([electrode_group.num_electrodes for electrode_group in self.parts])[:-1]
        )
        return CombinedElectrodes(
            *(
                electrode_group.with_contact_impedance(impedances_of_group)
                for electrode_group, impedances_of_group in zip(self.parts, impedances_of_groups, strict=True)
            )
        )

    def geometry(self) -> dict[str, Any]:
        """Descriptions of the electrodes of all parts."""
        return {"parts": [electrode_group.describe() for electrode_group in self.parts]}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw all parts, one after the other."""
        for electrode_group in self.parts:
            electrode_group.draw(mesh, pen)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refinements of a plane mesh that the electrodes of all parts request."""
        return tuple(
            refine_group for electrode_group in self.parts for refine_group in electrode_group.refinement(body)
        )

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the facets and cells of all parts."""
        return tuple(nodes for electrode_group in self.parts for nodes in electrode_group.contact_nodes(mesh))

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals of all parts, concatenated."""
        contacts_of_groups = [electrode_group.contact(mesh) for electrode_group in self.parts]
        return Contact(
            tuple(nodes for contact in contacts_of_groups for nodes in contact.nodes),
            tuple(mass for contact in contacts_of_groups for mass in contact.mass),
            namespace(contacts_of_groups).concatenate([contact.load for contact in contacts_of_groups], axis=1),
        )

    def check(self, mesh: Mesh) -> None:
        """Check the electrodes of every part separately. Raises `ValueError` as `check` of the parts does."""
        for electrode_group in self.parts:
            electrode_group.check(mesh)


_NUM_CIRCLE_CORNERS, _NUM_SIDE_CORNERS = 32, 8
# Number of triangles near a point, by nearest centroids, that are searched when the point is projected onto the
# surface.
_NUM_CANDIDATES = 24


@dataclass(frozen=True)
class ElectrodeShapes:
    """Polygons for drawing electrodes, one or more per electrode.

    **Fields**: `corners` (q, d): corners of all polygons, one polygon after the other, metres, in space
    counter-clockwise as seen from outside; a dot has a single corner; `sizes` (p,): number of corners of each polygon;
    `electrode` (p,): index of the electrode that each polygon belongs to.

    **Example:**

    ```python
    shapes = shapes_of(mesh, BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3))
    shapes.number, shapes.middles
    ```
    """

    corners: Float[np.ndarray, "q d"]
    sizes: Int[np.ndarray, " p"]
    electrode: Int[np.ndarray, " p"]

    @property
    def number(self) -> int:
        """Number of electrodes."""
        return int(self.electrode.max()) + 1 if len(self.electrode) else 0

    def polygons(self) -> list[Float[np.ndarray, "k d"]]:
        """Corners of each polygon."""
        return np.split(self.corners, np.cumsum(self.sizes)[:-1])

    def middles(self) -> Float[np.ndarray, "L d"]:
        """Mean of the corners of every electrode."""
        electrode_of_corners = np.repeat(self.electrode, self.sizes)
        num_corners = np.bincount(electrode_of_corners, minlength=self.number)
        return np.stack(
            [
                np.bincount(electrode_of_corners, corner_coordinate, self.number) / num_corners
                for corner_coordinate in self.corners.T
            ],
            axis=1,
        )


def shapes_of(mesh: Mesh, electrodes: AbstractElectrodes) -> ElectrodeShapes:
    """Polygons that draw electrodes on a mesh.

    **Arguments:**

    - `mesh`: a solid, a surface in space or a plane mesh.
    - `electrodes`: the electrodes on the mesh.

    **Example:**

    ```python
    shapes_of(solid, plates(solid, ["left", "right"], 0.01)).polygons
    ```
    """
    polygons: list[np.ndarray] = []
    electrode_indices: list[int] = []
    for electrode_index, electrode_polygons in enumerate(_all_polygons(mesh, electrodes)):
        polygons += electrode_polygons
        electrode_indices += [electrode_index] * len(electrode_polygons)
    return ElectrodeShapes(
        np.concatenate(polygons), np.array([len(polygon) for polygon in polygons]), np.array(electrode_indices)
    )


def _all_polygons(mesh: Mesh, electrodes: AbstractElectrodes) -> list[list[np.ndarray]]:
    """Polygons that draw each electrode."""
    mesh_points = np.asarray(mesh.points)
    if mesh_points.shape[1] == 2:
        polygon_pen = _PlanePen()
        electrodes.draw(mesh, polygon_pen)
        return polygon_pen.polygons
    from jeit.electrodes.facets import FacetElectrodes

    if isinstance(electrodes, CombinedElectrodes):
        return [polygons for electrode_group in electrodes.parts for polygons in _all_polygons(mesh, electrode_group)]
    triangles = surface_triangles(mesh)
    if isinstance(electrodes, FacetElectrodes):
        corners = mesh_points[np.asarray(mesh.facets)]
        return [list(corners[covered_fractions > 0]) for covered_fractions in np.asarray(electrodes.covers).T]
    electrode_geometry = {
        name: np.asarray(geometry_value) for name, geometry_value in electrodes.geometry().items() if name != "parts"
    }
    if "position" not in electrode_geometry:
        load = np.asarray(electrodes.contact(mesh).load)
        return [[centre[None]] for centre in (load / load.sum(axis=0)).T @ mesh_points]
    positions = electrode_geometry["position"]
    surface = ProjectionSurface(mesh_points, triangles)
    frames = surface.frames(positions)
    if "radius" in electrode_geometry:
        angle = 2 * np.pi * np.arange(_NUM_CIRCLE_CORNERS) / _NUM_CIRCLE_CORNERS
        electrode_sizes = np.broadcast_to(electrode_geometry["radius"], len(positions))
        flat_shapes = [
            disc_radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) for disc_radius in electrode_sizes
        ]
    elif "width" in electrode_geometry and "height" in electrode_geometry:
        side_coordinates = np.arange(_NUM_SIDE_CORNERS) / _NUM_SIDE_CORNERS * 2 - 1
        ones_of_side = np.ones(_NUM_SIDE_CORNERS)
        unit_square = np.concatenate(
            [
                np.stack(side_corners, axis=1)
                for side_corners in (
                    (side_coordinates, -ones_of_side),
                    (ones_of_side, side_coordinates),
                    (-side_coordinates, ones_of_side),
                    (-ones_of_side, -side_coordinates),
                )
            ]
        )
        electrode_sizes = (
            np.broadcast_to(electrode_geometry["width"], len(positions)),
            np.broadcast_to(electrode_geometry["height"], len(positions)),
        )
        flat_shapes = [
            unit_square * [electrode_width / 2, electrode_height / 2]
            for electrode_width, electrode_height in zip(*electrode_sizes, strict=True)
        ]
    else:
        return [[position[None]] for position in positions]
    return [
        [surface.project(position + flat_shape @ frame[1:], frame[0])]
        for position, flat_shape, frame in zip(positions, flat_shapes, frames, strict=True)
    ]


def surface_triangles(mesh: Mesh) -> Int[np.ndarray, "m 3"]:
    """Boundary triangles of a solid, or cells of a surface in space."""
    return np.asarray(mesh.facets if mesh.cells.shape[1] == 4 else mesh.cells)


class ProjectionSurface:
    """A surface of triangles onto which flat shapes are projected: `points` (n, 3), `triangles` (m, 3)."""

    def __init__(self, points: Float[np.ndarray, "n 3"], triangles: Int[np.ndarray, "m 3"]):
        self._corners = points[triangles]
        normal = np.cross(self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0])
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        self._centroid_tree = KDTree(self._corners.mean(axis=1))

    def normals(self, positions: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
        """Outward normals of the triangle nearest to each point."""
        return self._normal[self._centroid_tree.query(positions)[1]]

    def frames(self, positions: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3 3"]:
        """Unit vectors at each point: outward, horizontal and upward, as in `FacePatches`."""
        normal = self.normals(positions)
        upward_direction = np.where(np.abs(normal[:, 2:]) > 0.9, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
        tangent = np.cross(upward_direction, normal)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return np.stack([normal, tangent, np.cross(normal, tangent)], axis=1)

    def project(self, positions: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 3"]:
        """Project points along the normal onto the nearest triangle in that direction; points that meet no triangle are
        returned unchanged."""
        candidate_triangles = self._centroid_tree.query(positions, k=min(_NUM_CANDIDATES, len(self._corners)))[
            1
        ].reshape(len(positions), -1)
        corners = self._corners[candidate_triangles]
        first_edge, second_edge = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
        # Möller and Trumbore: place + signed_distance normal = corner + first_coordinate first_edge + second_coordinate
        # second_edge.
        edge_normal = np.cross(normal, second_edge)
        volume = np.sum(first_edge * edge_normal, axis=-1)
        is_parallel = np.abs(volume) < 1e-12 * np.linalg.norm(first_edge, axis=-1) * np.linalg.norm(
            second_edge, axis=-1
        )
        volume = np.where(is_parallel, 1.0, volume)
        offset_from_corner = positions[:, None] - corners[:, :, 0]
        first_coordinate = np.sum(offset_from_corner * edge_normal, axis=-1) / volume
        offset_normal = np.cross(offset_from_corner, first_edge)
        second_coordinate = offset_normal @ normal / volume
        signed_distance = np.sum(second_edge * offset_normal, axis=-1) / volume
        ray_hits_facet = (
            ~is_parallel
            & (first_coordinate > -1e-6)
            & (second_coordinate > -1e-6)
            & (first_coordinate + second_coordinate < 1 + 1e-6)
        )
        distances_to_triangles = np.where(ray_hits_facet, np.abs(signed_distance), np.inf)
        nearest_triangles, row = distances_to_triangles.argmin(axis=1), np.arange(len(positions))
        shift_along_normal = np.where(
            np.isfinite(distances_to_triangles[row, nearest_triangles]), signed_distance[row, nearest_triangles], 0.0
        )
        return positions + shift_along_normal[:, None] * normal


class _PlanePen:
    """Pen that collects the electrodes of a plane mesh as polygons; arcs become segments with two corners."""

    def __init__(self):
        self.polygons: list[list[np.ndarray]] = []

    def lines(self, segments: list[np.ndarray], centre: np.ndarray) -> None:
        drawn_lines = [np.asarray(segment) for segment in segments]
        self.polygons.append([drawn_line[k : k + 2] for drawn_line in drawn_lines for k in range(len(drawn_line) - 1)])

    def disc(self, centre: np.ndarray, radius: float) -> None:
        angle = 2 * np.pi * np.arange(_NUM_CIRCLE_CORNERS) / _NUM_CIRCLE_CORNERS
        self.polygons.append([centre[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])

    def rectangle(self, centre: np.ndarray, width: float, height: float) -> None:
        self.polygons.append([centre[:2] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]])

    def dot(self, centre: np.ndarray) -> None:
        self.polygons.append([np.asarray(centre[:2])[None]])
