"""Planes through a solid, and what they cut it into: exactly, cell by cell, with no raster."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, is_number, told
from jeit.image.marching import passed, passed_edges
from jeit.mesh import Mesh

AXES = ("x", "y", "z")
# Over the size of the body: what lies so near a plane lies in it.
_IN_IT = 1e-9


@dataclass(frozen=True)
class Plane:
    """A plane in space and how it is looked at: `toward` the viewer, with `right` and `up` on the page.

    **Fields**: `point` (3,) metres; `toward`, `right`, `up` (3,), unit vectors at right angles; `name`, what pictures
    call it, such as "z = 10 mm".

    z points up on the page, or in horizontal planes y. Make one with `Plane.at` or `Plane.through`.
    """

    point: np.ndarray
    toward: np.ndarray
    right: np.ndarray
    up: np.ndarray
    name: str

    @classmethod
    def at(cls, axis: str, value: float) -> "Plane":
        """The plane on which `axis`, "x", "y" or "z", is `value` metres: seen from the right, the front or above, so
        that the two other axes point to the right and up. Raises `ValueError`."""
        if axis not in AXES:
            raise ValueError(f"axis must be 'x', 'y' or 'z'; it is {told(axis)}.")
        if not is_number(value):
            raise ValueError(f"value must be where the plane meets the {axis} axis, in metres; it is {told(value)}.")
        point, normal = np.zeros(3), np.zeros(3)
        point[AXES.index(axis)] = value
        normal[AXES.index(axis)] = -1.0 if axis == "y" else 1.0
        return cls(point, normal, *_page(normal), f"{axis} = {_millimetres(float(value))} mm")

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> "Plane":
        """The plane through `point` (3,) metres at right angles to `normal` (3,), which points at the viewer. Raises
        `ValueError` for what is no place or no direction."""
        place, direction = (np.asarray(one, dtype=object) for one in (point, normal))
        for name, value in (("point", place), ("normal", direction)):
            if value.shape != (3,) or not all(is_number(one) for one in value):
                raise ValueError(
                    f"{name} must be three finite numbers; it is {told(point if name == 'point' else normal)}."
                )
        place, direction = place.astype(float), direction.astype(float)
        length = float(np.linalg.norm(direction))
        if length == 0:
            raise ValueError("normal is zero; give the direction in which the plane is looked at, such as (0, 0, 1).")
        toward = direction / length
        where = ", ".join(_millimetres(value) for value in place)
        across = ", ".join(f"{value:.2g}" for value in toward).replace("-", "−")
        return cls(place, toward, *_page(toward), f"through ({where}) mm across ({across})")

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Of places (n, 3) from the plane, metres, positive towards the viewer."""
        return (points - self.point) @ self.toward

    def on_page(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Coordinates (…, 2) to the right and up, metres; along the axes of a plane of `Plane.at` the body's own."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


@dataclass(frozen=True)
class Cut:
    """What a plane cuts a solid into.

    **Fields**: `polygons` (p, 4, 2), metres on the page of the plane, the last corner twice in triangles; `cell` (p,),
    the cell that each is of; `outline` (s, 2, 2), lines where the plane meets the surface of the body.
    """

    polygons: Float[np.ndarray, "p 4 2"]
    cell: Int[np.ndarray, " p"]
    outline: Float[np.ndarray, "s 2 2"]

    @property
    def area(self) -> float:
        """Of all polygons together, m²."""
        corners = self.polygons
        x, y = corners[..., 0], corners[..., 1]
        return float(0.5 * np.abs(np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1)).sum())


def cut_by_plane(mesh: Mesh, plane: Plane) -> Cut:
    """The cells of a solid that a plane passes through, as polygons, and the outline of the cut: exact.

    A plane along facets of the mesh cuts the cells behind it, and those before it where there are none behind. Raises
    `ValueError` for a mesh that is no solid, and for a plane that misses it.
    """
    check_solid(mesh)
    check_kind("plane", plane, Plane, "a Plane, such as Plane.at('z', 0.02)")
    points, cells, facets = (np.asarray(one) for one in (mesh.points, mesh.cells, mesh.facets))
    height = plane.distance(points)
    size = float(np.ptp(points, axis=0).max())
    height = np.where(np.abs(height) < _IN_IT * size, 0.0, height)
    pieces, edges = passed(cells, height), passed_edges(facets, height)
    if len(pieces.cell) == 0:
        pieces, edges = passed(cells, -height), passed_edges(facets, -height)
    if len(pieces.cell) == 0:
        low, high = (1e3 * value for value in (height.min(), height.max()))
        beside = f"{low:.3g} mm before" if low > 0 else f"{-high:.3g} mm behind"
        raise ValueError(f"plane {plane.name} misses the body, which lies {beside} it; are both in metres?")
    polygons, outline = plane.on_page(pieces.at_corners(points)), plane.on_page(edges.at_corners(points))
    return Cut(polygons, pieces.cell, outline[np.ptp(outline, axis=1).max(axis=1) > 0])


def check_solid(mesh: Mesh) -> None:
    """Raises `ValueError` for what is no mesh of tetrahedra."""
    check_kind("mesh", mesh, Mesh, "a Mesh, such as jeit.mesh.box(0.1, 0.1, 0.05)")
    if mesh.cells.shape[1] != 4:
        raise ValueError("mesh: this is for solids of tetrahedra; draw a plane mesh with plot_image.")


def _page(toward) -> tuple[np.ndarray, np.ndarray]:
    """Right and up on the page, of a plane looked at from a direction."""
    upward = (
        np.array([0.0, 0.0, 1.0]) if abs(toward[2]) < 1 - 1e-9 else np.array([0.0, math.copysign(1, toward[2]), 0.0])
    )
    up = upward - (upward @ toward) * toward
    up /= np.linalg.norm(up)
    return np.cross(up, toward) + 0.0, up + 0.0


def _millimetres(value: float) -> str:
    # A tenth of a millimetre, or in a small body three digits.
    text = f"{1e3 * value:.1f}".removesuffix(".0") if abs(value) >= 0.0095 else f"{1e3 * value:.3g}"
    return text.replace("-", "−") if abs(value) > 5e-10 else "0"
