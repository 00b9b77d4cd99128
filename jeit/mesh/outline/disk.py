"""`Disk`: a circular outline, meshed in concentric rings unless refinement or node positions are requested."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.mesh.checks import size_checked
from jeit.mesh.generate import structured
from jeit.mesh.generate.curve import circle
from jeit.mesh.generate.refine import Refine, Refinement
from jeit.mesh.generate.unstructured import MeshTarget, check_count, check_positions, check_total, mesh_within
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import Domain, Pen, array_module, check_length, check_near_origin, check_position
from jeit_solvers.engines import as_array


class Disk(Domain):
    """A disk with a radius and a centre in metres; arc length starts at angle 0.

    **Arguments:**

    - `radius`: radius in metres, positive.
    - `centre` (x, y): centre in metres.

    **Example:**

    ```python
    tank = Disk(0.1)
    tank.area, tank.contains([[0.0, 0.0], [0.2, 0.0]])
    ```
    """

    radius: float
    centre: tuple[float, float]

    def __init__(self, radius: float, centre: Sequence[float] = (0.0, 0.0)):
        """`radius` and `centre` (x, y) are in metres. Raises `ValueError` unless the radius is positive and the centre
        finite."""
        self.radius = check_length("radius", radius, 2)
        self.centre = check_position("centre", centre)
        check_near_origin("centre", self.centre, self.radius)

    @property
    def area(self) -> float:
        """Area π R² in m²."""
        return np.pi * self.radius**2

    @property
    def perimeter(self) -> float:
        """Circumference 2 π R in m."""
        return 2.0 * np.pi * self.radius

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        x, y = self.centre
        return (x - self.radius, x + self.radius, y - self.radius, y + self.radius)

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the circle at `arc_length` (…) in metres, counter-clockwise from angle 0."""
        xp = array_module(self, arc_length)
        polar_angle = xp.asarray(arc_length) / self.radius
        return as_array(
            xp.asarray(self.centre) + self.radius * xp.stack([xp.cos(polar_angle), xp.sin(polar_angle)], axis=-1)
        )

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the polygon with `num_chords` sides that is inscribed in the circle."""
        return (self.boundary(self.perimeter * np.arange(num_chords) / num_chords),)

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies in the disk or on its edge."""
        xp = array_module(self, points)
        centre_offset = xp.asarray(points) - xp.asarray(self.centre)
        return as_array((centre_offset**2).sum(axis=-1) <= self.radius**2 * (1 + 1e-12))

    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the circle, metres, negative outside: R minus the distance from the
        centre."""
        return as_array(self.radius - self._from_centre(points)[1])

    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move the `points` (p, 2), metres, that lie outside the disk radially onto the circle."""
        centre_offset, centre_distance = self._from_centre(points)
        xp = array_module(self, points)
        return as_array(xp.asarray(self.centre) + centre_offset * xp.minimum(1, self.radius / centre_distance[:, None]))

    def _from_centre(self, points: ArrayLike) -> tuple[Any, Any]:
        """Offsets (p, 2) and distances (p,) from the centre; the distances are differentiable at the centre, too."""
        xp = array_module(self, points)
        centre_offset = xp.asarray(points) - xp.asarray(self.centre)
        return centre_offset, xp.sqrt((centre_offset**2).sum(axis=1) + 1e-24)

    def describe(self) -> dict:
        """Name of the shape, radius and centre, in metres."""
        return {"shape": "disk", "radius": float(self.radius), "centre": [float(x) for x in self.centre]}

    def draw(self, pen: Pen) -> None:
        """Draw the disk as one circle."""
        pen.circle(self.centre, self.radius)

    @size_checked()
    def mesh(
        self,
        num_points: int | None = None,
        cell_size: float | None = None,
        refine: Refinement = None,
        *,
        num_boundary: int | None = None,
        boundary_points: ArrayLike | None = None,
        interior_points: ArrayLike | None = None,
    ) -> Mesh:
        """Mesh the disk. The arguments and the errors raised are those of `jeit.mesh.disk`."""
        disk_centre = np.asarray(self.centre)
        if num_boundary is not None:
            refine = self._refine_rim(num_boundary, refine)
        if refine is None and boundary_points is None and interior_points is None:
            points, cells = structured.ring_disk(*self._choose_rings(num_points, cell_size))
            return Mesh.create(disk_centre + self.radius * points, cells)
        boundary_arc_lengths = None
        if boundary_points is not None:
            boundary_arc_lengths = self.radius * np.mod(check_positions("boundary_points", boundary_points), 2 * np.pi)
        mesh_target = MeshTarget.create(num_points, cell_size)
        mesh = mesh_within(
            [circle(self.radius, disk_centre)], self.area, mesh_target, refine, boundary_arc_lengths, interior_points
        )
        max_deviation = (
            0
            if num_boundary is None
            else 0.1 * num_boundary + (1 if boundary_arc_lengths is None else len(boundary_arc_lengths))
        )
        if num_boundary is not None and abs(mesh.num_facets - num_boundary) > max_deviation:
            raise ValueError(
                f"num_boundary: cells of the size asked give {mesh.num_facets} nodes on the circle, not "
                f"{num_boundary}. Ask for fewer nodes inside (num_points), larger cells, or more nodes on the circle."
            )
        return mesh

    def _refine_rim(self, num_boundary: int, refine: Refinement) -> Refinement:
        num_boundary = check_count("num_boundary", num_boundary, 3)
        if callable(refine):
            raise ValueError("num_boundary: cannot be combined with a size function; let the function give the size.")
        rim_refinement = Refine(cell_size=self.perimeter / num_boundary)
        return (rim_refinement, *(() if refine is None else (refine,) if isinstance(refine, Refine) else tuple(refine)))

    def _choose_rings(self, num_points: int | None, cell_size: float | None) -> tuple[int, int]:
        mesh_target = MeshTarget.create(num_points, cell_size)
        if mesh_target.cell_size is None:
            ring_numbers = structured.choose_rings(mesh_target.num_points)
        else:
            # With six nodes more on each ring, cells with legs t and π/3 t have the area of equilateral triangles with
            # edge 1.1 t.
            num_rings = max(1, round(1.1 * self.radius / mesh_target.cell_size))
            ring_numbers = (num_rings, 6 * num_rings)
        check_total(ring_numbers[0] * ring_numbers[1] // 2, "cell_size")
        return ring_numbers
