"""Points on the cells of a skin at which pressure is computed, in the frames of presses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jeit.design.skin.reached_cells import is_curved, said, touched_surface
from jeit.mesh import Mesh, check_flat, measures
from jeit.mesh.geodesic import Triangles
from jeit.touch.simulate.contact.press import Press

# Barycentric coordinates in a cell are multiples of 1 / (lattice + 1), moved inwards by the same for all.
_LATTICE = 2
# Cosine of the angle between a curved skin and a press, from which on it is beneath; what is within a distance of the
# press's axis is then within 1 / cos(60° / 2) times as much of the place pressed, on a ball.
_BENEATH, _CHORD = 0.5, 1.2
# Of the z axis along a normal, from which on "up" in the plane that touches a curved skin is along y.
_LEVEL = 0.866
# The greatest distance of a press from the surface, relative to its largest triangle.
_OFF = 0.5


class Curved(NamedTuple):
    """Of a curved skin: the `surface` that is touched, normals (m, k, 3) of it where the cells' `corners` are, and
    (m, 3) where the cells are."""

    surface: Triangles
    corners: Float[np.ndarray, "m k 3"]
    cells: Float[np.ndarray, "m 3"]


class Samples(NamedTuple):
    """Places (m, s, d) on m cells of a skin, in the plane or on the surface that is touched, metres; the `area` (m,)
    that each of a cell's stands for, m²; the radius of the largest cell, metres; where the cells' `corners` (m, k, d)
    are there; and what is known of a `curved` skin, None of a flat one."""

    points: Float[np.ndarray, "m s d"]
    area: Float[np.ndarray, " m"]
    radius: float
    corners: Float[np.ndarray, "m k d"]
    curved: Curved | None = None

    @classmethod
    def of(cls, mesh: Mesh, face: str = "outer") -> "Samples":
        """Of a sheet, or of a layer, whose cells are all pressed as the skin above them is: of a curved one that on
        its `face`."""
        if is_curved(mesh):
            return cls._of_curved(mesh, face)
        check_flat(mesh, "these presses")
        corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        thickness = np.ptp(corners[..., 2]) if mesh.dimension == 3 else 1.0
        corners = corners[..., :2]
        points = lattice(corners, _LATTICE)
        area = np.asarray(measures(mesh)) / thickness / points.shape[1]
        return cls(points, area, _radius(corners), corners)

    @classmethod
    def _of_curved(cls, mesh: Mesh, face: str) -> "Samples":
        surface, cells, size = touched_surface(mesh, face), np.asarray(mesh.cells), np.asarray(measures(mesh))
        feet = surface.nearest(np.asarray(mesh.points))
        corners, normals = feet.points[cells], surface.normals_at(feet)[cells]
        above = surface.nearest(corners.mean(axis=1)).triangle
        points = _rounded(corners, normals, _LATTICE)
        # Of a layer, cells beneath a triangle share its area by their volumes.
        share = size / np.bincount(above, size, len(surface.cells))[above]
        area = share * surface.areas[above] / points.shape[1]
        return cls(points, area, _radius(corners), corners, Curved(surface, normals, surface.normals[above]))

    def on(self, cells: Int[np.ndarray, " c"], number: int) -> Float[np.ndarray, "c s d"]:
        """Places in some of the cells, more of them the greater `number` is."""
        if self.curved is None:
            return lattice(self.corners[cells], number)
        return _rounded(self.corners[cells], self.curved.corners[cells], number)

    def check(self, presses: Sequence[Press]) -> None:
        """Raise `ValueError` for presses whose places have another dimension, or are off a curved skin."""
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
                f"{said(position[lost[0]])} mm, by {1e3 * away[lost[0]]:.3g} mm; places are in metres, on the touched "
                "face."
            )

    def near(self, presses: Sequence[Press], cells: Sequence) -> list[Int[np.ndarray, " c"]]:
        """Those of the cells of each press that face it: a sleeve's far side does not."""
        if self.curved is None:
            return [np.asarray(own, int) for own in cells]
        towards = _frames(self.curved.surface, presses)[1][:, 2]
        own = [np.asarray(one, int) for one in cells]
        return [some[self.curved.cells[some] @ axis > _BENEATH] for some, axis in zip(own, towards, strict=True)]

    @property
    def chord(self) -> float:
        """How far from a press places may be, straight through space, for each metre from its axis."""
        return 1.0 if self.curved is None else _CHORD

    def seen(self, presses: Sequence[Press], cells: Int[np.ndarray, "b c"], points: Float[np.ndarray, "b q d"]):
        """Places in the frames of the presses' indenters (b, q, 2); how far below the plane through the place pressed
        each is (b, q), 0 on a flat skin; and what shares of the cells' areas (b, c) are seen from the indenter.

        An indenter comes straight down, along the inward normal at the place pressed, so that what is beneath a point
        of it is what that line meets: of a surface that falls away it is farther down.
        """
        cos, sin = (function([press.angle for press in presses])[:, None] for function in (np.cos, np.sin))
        if self.curved is None:
            x, y = np.moveaxis(points - np.array([press.position for press in presses])[:, None], -1, 0)
            fall, share = np.zeros(points.shape[:-1]), np.ones(cells.shape)
        else:
            origin, axes = _frames(self.curved.surface, presses)
            x, y, up = np.moveaxis(np.einsum("bqd,bad->bqa", points - origin[:, None], axes), -1, 0)
            fall, share = -up, np.einsum("bcd,bd->bc", self.curved.cells[cells], axes[:, 2])
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1), fall, share


def lattice(corners: Float[np.ndarray, "m k d"], number: int) -> Float[np.ndarray, "m s d"]:
    """Places (m, s, d) in cells of these corners, spread evenly; more of them the greater `number` is."""
    return np.einsum("sk,mkd->msd", _weights(corners.shape[1], number), corners)


def _weights(size: int, number: int) -> Float[np.ndarray, "s k"]:
    steps = [each for each in itertools.product(range(number + 1), repeat=size) if sum(each) == number]
    return (np.array(steps) + 1 / size) / (number + 1)


def _rounded(corners, normals, number: int) -> Float[np.ndarray, "m s 3"]:
    """Places of the `lattice`, moved from the triangles onto the surface that they stand for."""
    weights = _weights(corners.shape[1], number)
    return rounded(np.einsum("sk,mkd->msd", weights, corners), weights, corners[:, None], normals[:, None])


def rounded(points, weights, corners, normals) -> Float[np.ndarray, "... 3"]:
    """Points (…, 3) of flat triangles with `weights` (…, k) of `corners` (…, k, 3), on the curved surface whose unit
    `normals` (…, k, 3) there are: half of the way to where the planes that touch it at the corners are, exact to second
    order (Boubekeur and Alexa, Phong tessellation, ACM Transactions on Graphics 27(5), 2008, at 1/2)."""
    below = np.sum((corners - points[..., None, :]) * normals, axis=-1)
    return points + np.einsum("...k,...k,...kd->...d", weights / 2, below, normals)


def _frames(surface: Triangles, presses: Sequence[Press]):
    """Places pressed (b, 3) and axes there (b, 3, 3): to the right, up and out, as one sees the skin with z upwards."""
    at = surface.nearest(np.array([press.position for press in presses]))
    corners = surface.cells[at.triangle]
    origin = rounded(at.points, at.weights, surface.points[corners], surface.node_normals[corners])
    out = surface.normals_at(at)
    up = np.where(np.abs(out[:, 2:]) > _LEVEL, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    up -= np.sum(up * out, axis=1, keepdims=True) * out
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return origin, np.stack([np.cross(up, out), up, out], axis=1)


def _radius(corners) -> float:
    return float(np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=-1).max())
