"""Sample points on the cells of a skin, at which pressure is computed, and their coordinates in the frames of
indenters."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jeit.design.skin.touched_cells import is_curved, millimetre_text, touched_surface
from jeit.mesh import Mesh, check_flat, measures
from jeit.mesh.geodesic import Triangles
from jeit.touch.simulate.contact.press import Press

# Fineness n of the lattice of samples in a cell: barycentric coordinates are (i + 1/k) / (n + 1) with integers i of sum
# n, for a cell with k corners.
_LATTICE_FINENESS = 2
# Minimum cosine of the angle between the normals of a curved skin at a cell beneath the indenter and at the place
# pressed. On a ball, the distance of a point from the place pressed is then at most 1 / cos(60° / 2) times the distance
# of the point from the axis of the press.
_MIN_NORMAL_COSINE, _MAX_CHORD_RATIO = 0.5, 1.2
# Minimum z component of a normal, above which "up" in the tangent plane of a curved skin is along y.
_MIN_VERTICAL_COMPONENT = 0.866
# Maximum distance of a press from the surface of a skin, relative to the square root of the area of the surface's
# largest triangle.
_MAX_RELATIVE_DISTANCE = 0.5


class CurvedGeometry(NamedTuple):
    """Geometry of a curved skin. **Fields**: `surface`: the touched surface; `corners`: (m, k, 3), unit normals of the
    surface at the k corners of each of m cells; `cells`: (m, 3), unit normals of the surface at the cells."""

    surface: Triangles
    corners: Float[np.ndarray, "m k 3"]
    cells: Float[np.ndarray, "m 3"]


class Samples(NamedTuple):
    """Sample points on m cells of a skin, in the plane or on the touched surface.

    - `points`: (m, s, d), s sample points in each cell, metres, with d = 2 coordinates, or 3 on a curved skin.
    - `area`: (m,), area per sample of each cell, m².
    - `radius`: radius of the largest cell, metres.
    - `corners`: (m, k, d), k corners of each cell, projected onto the plane or the touched surface, metres.
    - `curved`: geometry of a curved skin; None for flat skins.
    """

    points: Float[np.ndarray, "m s d"]
    area: Float[np.ndarray, " m"]
    radius: float
    corners: Float[np.ndarray, "m k d"]
    curved: CurvedGeometry | None = None

    @classmethod
    def from_mesh(cls, mesh: Mesh, face: str = "outer") -> "Samples":
        """Create the sample points of a sheet, or of a layer, whose cells each bear the pressure on the surface above.
        In a curved layer, this surface is its outer or inner `face`."""
        if is_curved(mesh):
            return cls._from_curved_mesh(mesh, face)
        check_flat(mesh, "these presses")
        cell_corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        thickness = np.ptp(cell_corners[..., 2]) if mesh.dimension == 3 else 1.0
        cell_corners = cell_corners[..., :2]
        sample_points = lattice(cell_corners, _LATTICE_FINENESS)
        sample_areas = np.asarray(measures(mesh)) / thickness / sample_points.shape[1]
        return cls(sample_points, sample_areas, _largest_cell_radius(cell_corners), cell_corners)

    @classmethod
    def _from_curved_mesh(cls, mesh: Mesh, face: str) -> "Samples":
        touched_triangles, mesh_cells, cell_measures = (
            touched_surface(mesh, face),
            np.asarray(mesh.cells),
            np.asarray(measures(mesh)),
        )
        nearest_points = touched_triangles.nearest(np.asarray(mesh.points))
        cell_corners, corner_normals = (
            nearest_points.points[mesh_cells],
            touched_triangles.normals_at(nearest_points)[mesh_cells],
        )
        triangle_indices = touched_triangles.nearest(cell_corners.mean(axis=1)).triangle
        sample_points = _curved_lattice(cell_corners, corner_normals, _LATTICE_FINENESS)
        # In a layer, the area of a triangle of the surface is divided among the cells beneath the triangle in
        # proportion to their volumes.
        area_shares = (
            cell_measures / np.bincount(triangle_indices, cell_measures, len(touched_triangles.cells))[triangle_indices]
        )
        sample_areas = area_shares * touched_triangles.areas[triangle_indices] / sample_points.shape[1]
        return cls(
            sample_points,
            sample_areas,
            _largest_cell_radius(cell_corners),
            cell_corners,
            CurvedGeometry(touched_triangles, corner_normals, touched_triangles.normals[triangle_indices]),
        )

    def lattice_points(self, cells: Int[np.ndarray, " c"], fineness: int) -> Float[np.ndarray, "c s d"]:
        """Return sample points (c, s, d) in `cells`, on a lattice with s points per cell; s increases with
        `fineness`."""
        if self.curved is None:
            return lattice(self.corners[cells], fineness)
        return _curved_lattice(self.corners[cells], self.curved.corners[cells], fineness)

    def check(self, presses: Sequence[Press]) -> None:
        """Raise `ValueError` for presses whose positions do not have as many coordinates as the sample points, and for
        positions off a curved skin."""
        dimension, skin_kind = self.points.shape[-1], "flat" if self.curved is None else "curved"
        for press in presses:
            if len(press.position) != dimension:
                raise ValueError(
                    f"position: a press on a {skin_kind} skin is at "
                    f"{'(x, y)' if dimension == 2 else '(x, y, z) on it'}, in metres; this one has "
                    f"{len(press.position)} coordinates."
                )
        if self.curved is None:
            return
        press_positions = np.array([press.position for press in presses])
        surface_distances = self.curved.surface.nearest(press_positions).away
        invalid_presses = np.flatnonzero(
            surface_distances > _MAX_RELATIVE_DISTANCE * np.sqrt(self.curved.surface.areas.max())
        )
        if invalid_presses.size:
            raise ValueError(
                f"position: {invalid_presses.size} of {len(presses)} presses lie off the skin, the first at "
                f"{millimetre_text(press_positions[invalid_presses[0]])} mm, by "
                f"{1e3 * surface_distances[invalid_presses[0]]:.3g} mm; places are in metres, on the touched face."
            )

    def facing_cells(self, presses: Sequence[Press], cells: Sequence) -> list[Int[np.ndarray, " c"]]:
        """Select, from the `cells` near each press, the cells whose normals point towards the indenter. Cells on the
        opposite side of a tube are thus left out."""
        cell_arrays = [np.asarray(cell_indices, int) for cell_indices in cells]
        if self.curved is None:
            return cell_arrays
        press_axes = _indenter_axes(self.curved.surface, presses)[1][:, 2]
        cell_normals = self.curved.cells
        return [
            cell_indices[cell_normals[cell_indices] @ press_axis > _MIN_NORMAL_COSINE]
            for cell_indices, press_axis in zip(cell_arrays, press_axes, strict=True)
        ]

    @property
    def max_chord_ratio(self) -> float:
        """Maximum ratio of the distance of a point from the place pressed to the distance of the point from the axis of
        the press."""
        return 1.0 if self.curved is None else _MAX_CHORD_RATIO

    def to_indenter_coordinates(
        self, presses: Sequence[Press], cells: Int[np.ndarray, "b c"], points: Float[np.ndarray, "b q d"]
    ):
        """Transform points (b, q, d) to the frames of b indenters.

        An indenter moves along the inward normal at the place pressed. Returns the coordinates of the points in the
        frames (b, q, 2); the distance (b, q) of the points below the tangent plane at the place pressed, 0 on a flat
        skin; and the ratio (b, c) of each cell's area projected along this normal to its area.
        """
        cos, sin = (
            trigonometric_function([press.angle for press in presses])[:, None]
            for trigonometric_function in (np.cos, np.sin)
        )
        if self.curved is None:
            x, y = np.moveaxis(points - np.array([press.position for press in presses])[:, None], -1, 0)
            depths_below_plane, area_ratios = np.zeros(points.shape[:-1]), np.ones(cells.shape)
        else:
            press_origins, press_axes = _indenter_axes(self.curved.surface, presses)
            x, y, heights_above_plane = np.moveaxis(
                np.einsum("bqd,bad->bqa", points - press_origins[:, None], press_axes), -1, 0
            )
            depths_below_plane, area_ratios = (
                -heights_above_plane,
                np.einsum("bcd,bd->bc", self.curved.cells[cells], press_axes[:, 2]),
            )
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1), depths_below_plane, area_ratios


def lattice(corners: Float[np.ndarray, "m k d"], fineness: int) -> Float[np.ndarray, "m s d"]:
    """Return evenly spaced points (m, s, d) in cells with `corners` (m, k, d); s increases with `fineness`."""
    return np.einsum("sk,mkd->msd", _barycentric_weights(corners.shape[1], fineness), corners)


def _barycentric_weights(num_corners: int, lattice_fineness: int) -> Float[np.ndarray, "s k"]:
    lattice_integers = [
        index_tuple
        for index_tuple in itertools.product(range(lattice_fineness + 1), repeat=num_corners)
        if sum(index_tuple) == lattice_fineness
    ]
    return (np.array(lattice_integers) + 1 / num_corners) / (lattice_fineness + 1)


def _curved_lattice(cell_corners, corner_normals, lattice_fineness: int) -> Float[np.ndarray, "m s 3"]:
    """Return the points of `lattice`, moved from the flat triangles onto the curved surface that the triangles
    approximate."""
    barycentric_weights = _barycentric_weights(cell_corners.shape[1], lattice_fineness)
    return project_to_curved_surface(
        np.einsum("sk,mkd->msd", barycentric_weights, cell_corners),
        barycentric_weights,
        cell_corners[:, None],
        corner_normals[:, None],
    )


def project_to_curved_surface(points, weights, corners, normals) -> Float[np.ndarray, "... 3"]:
    """Move points (…, 3) of flat triangles onto the curved surface with unit `normals` (…, k, 3) at the `corners`
    (…, k, 3); `weights`: (…, k), barycentric coordinates of the points.

    Each point is projected onto the tangent planes at the corners. It is moved halfway to the interpolated projections,
    which is exact to second order (Boubekeur and Alexa, Phong tessellation, ACM Transactions on Graphics 27(5), 2008,
    at 1/2).
    """
    plane_distances = np.sum((corners - points[..., None, :]) * normals, axis=-1)
    return points + np.einsum("...k,...k,...kd->...d", weights / 2, plane_distances, normals)


def _indenter_axes(surface: Triangles, presses: Sequence[Press]):
    """Return the points (b, 3) of a surface where b indenters press, and the axes (b, 3, 3) of the indenters' frames:
    right, up and outwards, as seen from outside with z upwards."""
    nearest_points = surface.nearest(np.array([press.position for press in presses]))
    triangle_corners = surface.cells[nearest_points.triangle]
    press_origins = project_to_curved_surface(
        nearest_points.points,
        nearest_points.weights,
        surface.points[triangle_corners],
        surface.node_normals[triangle_corners],
    )
    outward_axes = surface.normals_at(nearest_points)
    upward_directions = np.where(
        np.abs(outward_axes[:, 2:]) > _MIN_VERTICAL_COMPONENT, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    )
    upward_directions -= np.sum(upward_directions * outward_axes, axis=1, keepdims=True) * outward_axes
    upward_directions /= np.linalg.norm(upward_directions, axis=1, keepdims=True)
    return press_origins, np.stack([np.cross(upward_directions, outward_axes), upward_directions, outward_axes], axis=1)


def _largest_cell_radius(cell_corners) -> float:
    return float(np.linalg.norm(cell_corners - cell_corners.mean(axis=1, keepdims=True), axis=-1).max())
