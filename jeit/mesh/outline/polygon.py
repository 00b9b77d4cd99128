"""`Polygon`: an outline of straight sides, possibly with holes."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.mesh import topology
from jeit.mesh.checks import size_checked, warn_large
from jeit.mesh.generate.curve import closed_line
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.generate.unstructured import Target, mesh_within
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import polyline
from jeit.mesh.outline.domain import Domain, Pen, check_near_origin
from jeit_solvers.engines import as_array, has_values


class Polygon(Domain):
    """A simple polygon, possibly with holes, in metres; arc length starts at the first vertex.

    **Arguments:**

    - `vertices` (k, 2): corners of the outer edge, metres.
    - `holes`: corners (h, 2) of each hole, metres.

    **Example:**

    ```python
    corner = Polygon([[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0.2], [0, 0.2]])
    corner.mesh(num_points=200)
    ```
    """

    vertices: Float[Array, "k 2"]
    holes: tuple[Float[Array, "h 2"], ...]

    def __init__(self, vertices: ArrayLike, holes: Sequence[ArrayLike] = ()):
        """`vertices` (k, 2) of the outline and of each of `holes`, in order, in metres, without a repetition of the
        first vertex.

        Either orientation is accepted; the outline is stored counter-clockwise, holes clockwise. Raises `ValueError`
        for fewer than three vertices, repeated vertices, an outline that crosses or touches itself, and holes that are
        not inside the outline.
        """
        if not has_values(vertices, holes):
            self.vertices = jnp.asarray(vertices)
            self.holes = tuple(jnp.asarray(hole) for hole in holes)
            return
        outer = topology.check_loop(vertices, "vertices", clockwise=False)
        inner = [topology.check_loop(hole, f"holes[{k}]", clockwise=True) for k, hole in enumerate(holes)]
        topology.check_apart(outer, inner)
        check_near_origin("vertices", outer, np.ptp(outer, axis=0).max())
        warn_large(float(np.ptp(outer, axis=0).max()), "vertices")
        self.vertices = as_array(outer)
        self.holes = tuple(as_array(hole) for hole in inner)

    @property
    def area(self) -> Float[Array, ""]:
        """Area inside the outline minus the area of the holes, in m² (shoelace formula)."""
        return polyline.area(self.loops())

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outer outline in m."""
        return polyline.length(self.vertices)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        lower_corner, upper_corner = (
            np.min(np.asarray(self.vertices), axis=0),
            np.max(np.asarray(self.vertices), axis=0),
        )
        return (float(lower_corner[0]), float(upper_corner[0]), float(lower_corner[1]), float(upper_corner[1]))

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outer outline at `arc_length` (…) in metres from the first vertex."""
        return polyline.along(self.vertices, arc_length)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the outline and of every hole."""
        return (self.vertices, *self.holes)

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies inside the outline and outside the holes (even-odd rule)."""
        return polyline.contains(self.loops(), points)

    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside and in holes."""
        return polyline.signed_distance(self.loops(), points)

    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move those of `points` (p, 2), metres, that lie outside or in a hole to the nearest point on a side."""
        return polyline.nearest(self.loops(), points)

    def describe(self) -> dict:
        """Name of the shape, vertices, and vertices of the holes if there are any."""
        holes = {"holes": [np.asarray(hole).tolist() for hole in self.holes]} if self.holes else {}
        return {"shape": "polygon", "vertices": np.asarray(self.vertices).tolist(), **holes}

    def draw(self, pen: Pen) -> None:
        """Draw the outline and each hole as a loop."""
        for loop in self.loops():
            pen.loop(np.asarray(loop))

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
        """Mesh the polygon. The arguments and the errors raised are those of `jeit.mesh.polygon`."""
        curves = [closed_line(np.asarray(loop)) for loop in self.loops()]
        target = Target.create(num_points, cell_size)
        return mesh_within(curves, float(self.area), target, refine, boundary_points, interior_points)
