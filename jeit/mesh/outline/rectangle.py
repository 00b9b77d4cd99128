"""`Rectangle`: an outline with sides along the axes, meshed in rows unless refinement or node positions are
requested."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.mesh.checks import size_checked
from jeit.mesh.generate import structured
from jeit.mesh.generate.curve import closed_line
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.generate.unstructured import Target, check_total, mesh_within
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import polyline
from jeit.mesh.outline.domain import Domain, Pen, check_length, check_near_origin, check_position
from jeit_solvers.engines import as_array, either_engine, has_values, namespace


class Rectangle(Domain):
    """A rectangle with sides along the axes, in metres; arc length starts at the lower left corner.

    **Arguments:**

    - `width`, `height`: lengths along x and along y, metres, positive.
    - `centre` (x, y): centre in metres.

    **Example:**

    ```python
    skin = Rectangle(0.2, 0.1)
    skin.vertices
    ```
    """

    width: float
    height: float
    centre: tuple[float, float]

    def __init__(self, width: float, height: float, centre: Sequence[float] = (0.0, 0.0)):
        """`width` (along x) and `height` (along y), and `centre` (x, y) are in metres. Raises `ValueError` unless width
        and height are positive and the centre is finite."""
        self.width = check_length("width", width)
        self.height = check_length("height", height)
        self.centre = check_position("centre", centre)
        if has_values(self.width, self.height):
            check_near_origin("centre", self.centre, min(self.width, self.height))

    @property
    def area(self) -> float:
        """Width times height in m²."""
        return self.width * self.height

    @property
    def perimeter(self) -> float:
        """Perimeter 2 (width + height) in m."""
        return 2.0 * (self.width + self.height)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        x, y = self.centre
        return (x - self.width / 2, x + self.width / 2, y - self.height / 2, y + self.height / 2)

    @property
    def vertices(self) -> Float[Array, "4 2"]:
        """Corners (4, 2) in metres, counter-clockwise from the lower left one."""
        x_min, x_max, y_min, y_max = self.extent
        return as_array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outline at `arc_length` (…) in metres, counter-clockwise from the lower left."""
        return polyline.along(self.vertices, arc_length)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the rectangle."""
        return (self.vertices,)

    @either_engine
    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies in the rectangle or on its edge."""
        xp = namespace(self, points)
        offset = abs(xp.asarray(points) - xp.asarray(self.centre))
        half = 0.5 * xp.asarray([self.width, self.height])
        return (offset <= half * (1 + 1e-12)).all(axis=-1)

    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside."""
        return polyline.signed_distance(self.loops(), points)

    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move those of `points` (p, 2), metres, that lie outside to the nearest point on a side."""
        return polyline.nearest(self.loops(), points)

    def describe(self) -> dict:
        """Name of the shape, width, height and centre."""
        sides = {"width": float(self.width), "height": float(self.height)}
        return {"shape": "rectangle", **sides, "centre": [float(x) for x in self.centre]}

    def draw(self, pen: Pen) -> None:
        """Draw the rectangle as one loop of four sides."""
        pen.loop(np.asarray(self.vertices))

    @size_checked()
    def mesh(
        self,
        num_points: int | None = None,
        cell_size: float | None = None,
        refine: Refinement = None,
        *,
        boundary_points: ArrayLike | None = None,
        interior_points: ArrayLike | None = None,
    ) -> Mesh:
        """Mesh the rectangle and tag its sides. The arguments and the errors raised are those of
        `jeit.mesh.rectangle`."""
        target = Target.create(num_points, cell_size)
        if refine is None and boundary_points is None and interior_points is None:
            mesh = self._mesh_rows(target)
        else:
            curve = closed_line(np.asarray(self.vertices))
            mesh = mesh_within([curve], self.area, target, refine, boundary_points, interior_points)
        return self.tagged(mesh)

    def tagged(self, mesh: Mesh) -> Mesh:
        """Add tags for the sides of the rectangle to a mesh of the rectangle."""
        return Mesh(mesh.points, mesh.cells, mesh.facets, self._side_facets(mesh))

    def _mesh_rows(self, target: Target) -> Mesh:
        x_min, _, y_min, _ = self.extent
        rows = structured.choose_rows(self.width, self.height, target.num_points, target.cell_size)
        check_total(rows[0] * rows[1], "cell_size")
        points, cells = structured.row_rectangle(self.width, self.height, *rows)
        return Mesh.create(points + np.array([x_min, y_min]), cells)

    def _side_facets(self, mesh: Mesh) -> dict:
        """Indices of the facets on each side, by the name of the side."""
        left, right, bottom, top = self.extent
        ends = np.asarray(mesh.points)[np.asarray(mesh.facets)]
        tolerance = 1e-9 * max(self.width, self.height)
        sides = {"left": (0, left), "right": (0, right), "bottom": (1, bottom), "top": (1, top)}
        return {
            name: as_array(np.flatnonzero((np.abs(ends[:, :, axis] - value) < tolerance).all(axis=1)), np.int32)
            for name, (axis, value) in sides.items()
        }
