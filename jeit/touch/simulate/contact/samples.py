"""Sample points on the cells of a skin at which pressure is computed, and their coordinates in the frames of
presses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jeit.design.skin.reached_cells import is_curved, millimetre_text, touched_surface
from jeit.mesh import Mesh, check_flat, measures
from jeit.mesh.geodesic import Triangles
from jeit.touch.simulate.contact.press import Press

# Lattice n of the samples in a cell: barycentric coordinates are (i + 1/k) / (n + 1) with integers i of sum n, for a
# cell with k corners.
_LATTICE = 2
# Minimum cosine of the angle between the normal of a curved skin and that at the press, for the skin to be beneath the
# indenter. On a ball, the distance of a point from the place pressed is then at most 1 / cos(60° / 2) times its
# distance from the axis of the press.
_BENEATH, _CHORD = 0.5, 1.2
# Minimum z component of a normal, above which "up" in the tangent plane of a curved skin is along y.
_LEVEL = 0.866
# Maximum distance of a press from the surface, relative to the root of the area of its largest triangle.
_OFF = 0.5


class CurvedGeometry(NamedTuple):
    """Geometry of a curved skin. **Fields**: `surface`: the touched surface; `corners`: (m, k, 3), its unit normals at
    the corners of cells; `cells`: (m, 3), its unit normals at the cells."""

    surface: Triangles
    corners: Float[np.ndarray, "m k 3"]
    cells: Float[np.ndarray, "m 3"]


class Samples(NamedTuple):
    """Sample points on m cells of a skin, in the plane or on the touched surface.

    - `points`: (m, s, d), sample points, metres.
    - `area`: (m,), area per sample of each cell, m².
    - `radius`: radius of the largest cell, metres.
    - `corners`: (m, k, d), corners of the cells, projected onto the plane or the touched surface, metres.
    - `curved`: geometry of a curved skin; None for flat skins.
    """

    points: Float[np.ndarray, "m s d"]
    area: Float[np.ndarray, " m"]
    radius: float
    corners: Float[np.ndarray, "m k d"]
    curved: CurvedGeometry | None = None

    @classmethod
    def from_mesh(cls, mesh: Mesh, face: str = "outer") -> "Samples":
        """Create the samples of a sheet or a layer. The cells of a layer are pressed like the surface above them, in a
        curved layer like its `face`."""
        if is_curved(mesh):
            return cls._of_curved(mesh, face)
        check_flat(mesh, "these presses")
        corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        thickness = np.ptp(corners[..., 2]) if mesh.dimension == 3 else 1.0
        corners = corners[..., :2]
        points = lattice(corners, _LATTICE)
        area = np.asarray(measures(mesh)) / thickness / points.shape[1]
        return cls(points, area, _largest_cell_radius(corners), corners)

    @classmethod
    def _of_curved(cls, mesh: Mesh, face: str) -> "Samples":
        surface, cells, size = touched_surface(mesh, face), np.asarray(mesh.cells), np.asarray(measures(mesh))
        feet = surface.nearest(np.asarray(mesh.points))
        corners, normals = feet.points[cells], surface.normals_at(feet)[cells]
        above = surface.nearest(corners.mean(axis=1)).triangle
        points = _curved_lattice(corners, normals, _LATTICE)
        # In a layer, the area of a triangle of the surface is divided among the cells beneath it by their volumes.
        share = size / np.bincount(above, size, len(surface.cells))[above]
        area = share * surface.areas[above] / points.shape[1]
        return cls(
            points,
            area,
            _largest_cell_radius(corners),
            corners,
            CurvedGeometry(surface, normals, surface.normals[above]),
        )

    def lattice_points(self, cells: Int[np.ndarray, " c"], fineness: int) -> Float[np.ndarray, "c s d"]:
        """Sample points (c, s, d) in the given cells, on a lattice whose fineness increases with `fineness`."""
        if self.curved is None:
            return lattice(self.corners[cells], fineness)
        return _curved_lattice(self.corners[cells], self.curved.corners[cells], fineness)

    def check(self, presses: Sequence[Press]) -> None:
        """Check the positions of presses. Raises `ValueError` for positions with another number of coordinates, and for
        positions off a curved skin."""
        dimension, kind = self.points.shape[-1], "flat" if self.curved is None else "curved"
        for press in presses:
            if len(press.position) != dimension:
                raise ValueError(
                    f"position: a press on a {kind} skin is at {'(x, y)' if dimension == 2 else '(x, y, z) on it'}, in "
                    f"metres; this one has {len(press.position)} coordinates."
                )
        if self.curved is None:
            return
        position = np.array([press.position for press in presses])
        away = self.curved.surface.nearest(position).away
        lost = np.flatnonzero(away > _OFF * np.sqrt(self.curved.surface.areas.max()))
        if lost.size:
            raise ValueError(
                f"position: {lost.size} of {len(presses)} presses lie off the skin, the first at "
                f"{millimetre_text(position[lost[0]])} mm, by {1e3 * away[lost[0]]:.3g} mm; places are in metres, on "
                "the touched "
                "face."
            )

    def facing_cells(self, presses: Sequence[Press], cells: Sequence) -> list[Int[np.ndarray, " c"]]:
        """Select the cells of each press that face it, unlike the far side of a sleeve."""
        if self.curved is None:
            return [np.asarray(own, int) for own in cells]
        towards = _indenter_axes(self.curved.surface, presses)[1][:, 2]
        own = [np.asarray(one, int) for one in cells]
        return [some[self.curved.cells[some] @ axis > _BENEATH] for some, axis in zip(own, towards, strict=True)]

    @property
    def chord(self) -> float:
        """Maximum ratio of the distance of a point from the place pressed to its distance from the axis of the
        press."""
        return 1.0 if self.curved is None else _CHORD

    def to_indenter_frames(
        self, presses: Sequence[Press], cells: Int[np.ndarray, "b c"], points: Float[np.ndarray, "b q d"]
    ):
        """Transform points to the frames of indenters, which move along the inward normal at the place pressed.

        Returns the coordinates of the points in the frames (b, q, 2); their distance (b, q) below the tangent plane at
        the place pressed, 0 on a flat skin; and the ratio (b, c) of the area of each cell as projected along the normal
        to its area.
        """
        cos, sin = (function([press.angle for press in presses])[:, None] for function in (np.cos, np.sin))
        if self.curved is None:
            x, y = np.moveaxis(points - np.array([press.position for press in presses])[:, None], -1, 0)
            fall, share = np.zeros(points.shape[:-1]), np.ones(cells.shape)
        else:
            origin, axes = _indenter_axes(self.curved.surface, presses)
            x, y, up = np.moveaxis(np.einsum("bqd,bad->bqa", points - origin[:, None], axes), -1, 0)
            fall, share = -up, np.einsum("bcd,bd->bc", self.curved.cells[cells], axes[:, 2])
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1), fall, share


def lattice(corners: Float[np.ndarray, "m k d"], fineness: int) -> Float[np.ndarray, "m s d"]:
    """Evenly spaced points (m, s, d) in cells with the given corners; their number s increases with `fineness`."""
    return np.einsum("sk,mkd->msd", _barycentric_weights(corners.shape[1], fineness), corners)


def _barycentric_weights(num_corners: int, fineness: int) -> Float[np.ndarray, "s k"]:
    steps = [each for each in itertools.product(range(fineness + 1), repeat=num_corners) if sum(each) == fineness]
    return (np.array(steps) + 1 / num_corners) / (fineness + 1)


def _curved_lattice(corners, normals, fineness: int) -> Float[np.ndarray, "m s 3"]:
    """Points of the `lattice`, moved from flat triangles onto the curved surface that they approximate."""
    weights = _barycentric_weights(corners.shape[1], fineness)
    return project_to_curved_surface(
        np.einsum("sk,mkd->msd", weights, corners), weights, corners[:, None], normals[:, None]
    )


def project_to_curved_surface(points, weights, corners, normals) -> Float[np.ndarray, "... 3"]:
    """Move points (…, 3) of flat triangles onto the curved surface with unit `normals` (…, k, 3) at the `corners`
    (…, k, 3); `weights`: (…, k), barycentric coordinates of the points.

    Points are moved half of the way to the interpolated projections onto the tangent planes at the corners, which is
    exact to second order (Boubekeur and Alexa, Phong tessellation, ACM Transactions on Graphics 27(5), 2008, at 1/2).
    """
    below = np.sum((corners - points[..., None, :]) * normals, axis=-1)
    return points + np.einsum("...k,...k,...kd->...d", weights / 2, below, normals)


def _indenter_axes(surface: Triangles, presses: Sequence[Press]):
    """Points pressed (b, 3) and axes of the frames there (b, 3, 3): right, up and outwards, as seen from outside with z
    upwards."""
    at = surface.nearest(np.array([press.position for press in presses]))
    corners = surface.cells[at.triangle]
    origin = project_to_curved_surface(at.points, at.weights, surface.points[corners], surface.node_normals[corners])
    out = surface.normals_at(at)
    up = np.where(np.abs(out[:, 2:]) > _LEVEL, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    up -= np.sum(up * out, axis=1, keepdims=True) * out
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return origin, np.stack([np.cross(up, out), up, out], axis=1)


def _largest_cell_radius(corners) -> float:
    return float(np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=-1).max())
