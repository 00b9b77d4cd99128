"""Outlines that consist of closed loops with straight sides: `Polygon`, possibly with holes, and `Rectangle`, meshed in
rows unless refinement or node positions are requested; and functions of loops for such outlines.

`loops` contains the vertices (k, 2) of each loop in metres, the first not repeated: the outer loop counter-clockwise,
holes clockwise. Distances are computed with NumPy if all values are known, because JAX would compile again for every
number of points. For checks of loops see `jeit.mesh.topology`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.mesh import topology
from jeit.mesh.checks import size_checked, warn_large
from jeit.mesh.generate import structured
from jeit.mesh.generate.curve import closed_line
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.generate.unstructured import MeshTarget, check_total, mesh_within
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import Domain, Pen, array_module, check_length, check_near_origin, check_position
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled, on_host

Loop = Float[Array, "k 2"]


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
        outer_loop = topology.check_loop(vertices, "vertices", clockwise=False)
        checked_holes = [topology.check_loop(hole, f"holes[{k}]", clockwise=True) for k, hole in enumerate(holes)]
        topology.check_holes(outer_loop, checked_holes)
        check_near_origin("vertices", outer_loop, np.ptp(outer_loop, axis=0).max())
        warn_large(float(np.ptp(outer_loop, axis=0).max()), "vertices")
        self.vertices = as_array(outer_loop)
        self.holes = tuple(as_array(hole) for hole in checked_holes)

    @property
    def area(self) -> Float[Array, ""]:
        """Area inside the outline minus the area of the holes, in m² (shoelace formula)."""
        return area_of_loops(self.loops())

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outer outline in m."""
        return loop_length(self.vertices)

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
        return points_on_loop(self.vertices, arc_length)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the outline and of every hole."""
        return (self.vertices, *self.holes)

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies inside the outline and outside the holes (even-odd rule)."""
        return loops_contain(self.loops(), points)

    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside and in holes."""
        return distance_from_loops(self.loops(), points)

    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move each of `points` (p, 2), metres, that lies outside or in a hole to the nearest point on a side."""
        return nearest_in_loops(self.loops(), points)

    def describe(self) -> dict:
        """Name of the shape, vertices, and vertices of the holes if there are any."""
        hole_vertices = {"holes": [np.asarray(hole).tolist() for hole in self.holes]} if self.holes else {}
        return {"shape": "polygon", "vertices": np.asarray(self.vertices).tolist(), **hole_vertices}

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
        outline_curves = [closed_line(np.asarray(loop)) for loop in self.loops()]
        mesh_target = MeshTarget.create(num_points, cell_size)
        return mesh_within(outline_curves, float(self.area), mesh_target, refine, boundary_points, interior_points)


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
        """Corners (4, 2) in metres, counter-clockwise from the lower left corner."""
        x_min, x_max, y_min, y_max = self.extent
        return as_array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outline at `arc_length` (…) in metres, counter-clockwise from the lower left."""
        return points_on_loop(self.vertices, arc_length)

    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices of the rectangle."""
        return (self.vertices,)

    @numpy_or_compiled
    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies in the rectangle or on its edge."""
        xp = namespace(self, points)
        centre_offset = abs(xp.asarray(points) - xp.asarray(self.centre))
        half_side_lengths = 0.5 * xp.asarray([self.width, self.height])
        return (centre_offset <= half_side_lengths * (1 + 1e-12)).all(axis=-1)

    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside."""
        return distance_from_loops(self.loops(), points)

    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move each of `points` (p, 2), metres, that lies outside to the nearest point on a side."""
        return nearest_in_loops(self.loops(), points)

    def describe(self) -> dict:
        """Name of the shape, width, height and centre."""
        side_lengths = {"width": float(self.width), "height": float(self.height)}
        return {"shape": "rectangle", **side_lengths, "centre": [float(x) for x in self.centre]}

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
        mesh_target = MeshTarget.create(num_points, cell_size)
        if refine is None and boundary_points is None and interior_points is None:
            mesh = self._mesh_rows(mesh_target)
        else:
            outline_curve = closed_line(np.asarray(self.vertices))
            mesh = mesh_within([outline_curve], self.area, mesh_target, refine, boundary_points, interior_points)
        return self.tagged(mesh)

    def tagged(self, mesh: Mesh) -> Mesh:
        """Add tags for the sides of the rectangle to a mesh of the rectangle."""
        return Mesh(mesh.points, mesh.cells, mesh.facets, self._side_facets(mesh))

    def _mesh_rows(self, mesh_target: MeshTarget) -> Mesh:
        x_min, _, y_min, _ = self.extent
        row_and_column_counts = structured.choose_rows(
            self.width, self.height, mesh_target.num_points, mesh_target.cell_size
        )
        check_total(row_and_column_counts[0] * row_and_column_counts[1], "cell_size")
        points, cells = structured.row_rectangle(self.width, self.height, *row_and_column_counts)
        return Mesh.create(points + np.array([x_min, y_min]), cells)

    def _side_facets(self, mesh: Mesh) -> dict:
        """Indices of the facets on each side, by the name of the side."""
        x_left, x_right, y_bottom, y_top = self.extent
        end_points = np.asarray(mesh.points)[np.asarray(mesh.facets)]
        side_tolerance = 1e-9 * max(self.width, self.height)
        axis_and_position = {"left": (0, x_left), "right": (0, x_right), "bottom": (1, y_bottom), "top": (1, y_top)}
        return {
            name: as_array(
                np.flatnonzero((np.abs(end_points[:, :, normal_axis] - side_position) < side_tolerance).all(axis=1)),
                np.int32,
            )
            for name, (normal_axis, side_position) in axis_and_position.items()
        }


def loop_length(loop: Loop) -> Float[Array, ""]:
    """Length of a loop in m."""
    return jnp.sum(_side_lengths(loop))


def area_of_loops(loops: Sequence[Loop]) -> Float[Array, ""]:
    """Area inside the first loop minus the area of the holes, m² (shoelace formula)."""
    outer_area, *hole_areas = (_signed_loop_area(loop) for loop in on_host(loops))
    return as_array(sum(hole_areas, outer_area))


@numpy_or_compiled
def points_on_loop(loop: Loop, arc_length: ArrayLike) -> Float[Array, "... 2"]:
    """Points (…, 2) on a loop at `arc_length` (…) in metres from its first vertex, taken modulo the length of the
    loop."""
    xp = namespace(loop)
    closed_loop = xp.concatenate([loop, loop[:1]])
    cumulative_lengths = xp.concatenate([xp.zeros(1), xp.cumsum(_side_lengths(loop))])
    wrapped_arc_length = xp.mod(xp.asarray(arc_length, dtype=cumulative_lengths.dtype), cumulative_lengths[-1])
    return xp.stack(
        [xp.interp(wrapped_arc_length, cumulative_lengths, closed_loop[:, axis_number]) for axis_number in range(2)],
        axis=-1,
    )


@numpy_or_compiled
def loops_contain(loops: Sequence[Loop], points: ArrayLike) -> Bool[Array, "..."]:
    """Whether each of `points` (…, 2) lies inside the first loop and outside the holes (even-odd rule)."""
    if namespace(loops, points) is np:
        point_array = np.asarray(points)
        return topology.is_inside_loops(point_array.reshape(-1, 2), loops).reshape(point_array.shape[:-1])  # pyright: ignore
    points = jnp.asarray(points)
    is_inside = jnp.zeros(points.shape[:-1], bool)
    for loop in loops:
        is_inside = is_inside ^ _is_inside(loop, points)
    return is_inside


def distance_from_loops(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, " p"]:
    """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside."""
    xp = array_module(loops, points)
    point_array, is_inside, nearest_points = _project_onto_loops(xp, loops, points)
    side_distances = xp.sqrt(((point_array - nearest_points) ** 2).sum(axis=1) + 1e-24)  # differentiable at zero, too
    return as_array(xp.where(is_inside, side_distances, -side_distances))


def nearest_in_loops(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, "p 2"]:
    """Move each of `points` (p, 2) that lies outside to the nearest point on a side; points inside are returned
    unchanged."""
    xp = array_module(loops, points)
    point_array, is_inside, nearest_points = _project_onto_loops(xp, loops, points)
    return as_array(xp.where(is_inside[:, None], point_array, nearest_points))


def _project_onto_loops(xp: Any, loops: Sequence[Loop], points: ArrayLike) -> tuple[Any, Any, Any]:
    """Convert `points` (p, 2) to an array. Also returns whether each point lies inside (p,), and the point on a side
    that is nearest to it (p, 2)."""
    loop_arrays, point_array = [xp.asarray(loop) for loop in loops], xp.asarray(points, float)
    side_starts = xp.concatenate(loop_arrays)
    side_vectors = xp.concatenate([xp.roll(loop, -1, axis=0) for loop in loop_arrays]) - side_starts
    start_offsets = point_array[:, None] - side_starts
    side_fractions = xp.clip((start_offsets * side_vectors).sum(axis=-1) / (side_vectors**2).sum(axis=-1), 0, 1)
    points_on_sides = side_starts + side_fractions[..., None] * side_vectors  # (p, s, 2)
    nearest_side_index = xp.argmin(((point_array[:, None] - points_on_sides) ** 2).sum(axis=-1), axis=1)
    nearest_points = xp.take_along_axis(points_on_sides, nearest_side_index[:, None, None], axis=1)[:, 0]
    is_inside = (
        topology.is_inside_loops(point_array, loop_arrays)
        if xp is np
        else jax.lax.stop_gradient(loops_contain(loop_arrays, point_array))
    )
    return point_array, is_inside, nearest_points


def _side_lengths(loop: Loop) -> Float[Array, " k"]:
    xp = namespace(loop)
    return xp.sqrt(((xp.roll(loop, -1, axis=0) - loop) ** 2).sum(axis=1))


def _signed_loop_area(loop: Loop) -> Float[Array, ""]:
    xp = namespace(loop)
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * (x * xp.roll(y, -1) - xp.roll(x, -1) * y).sum()


def _is_inside(loop: Loop, points: Float[Array, "... 2"]) -> Bool[Array, "..."]:
    """Even-odd rule: count the sides that a ray towards +x crosses."""

    def toggle_at_crossing(is_inside: Array, loop_side: Array) -> tuple[Array, None]:
        (x0, y0), (x1, y1) = loop_side
        is_spanning_point = (y0 > points[..., 1]) != (y1 > points[..., 1])
        side_height = jnp.where(is_spanning_point, y1 - y0, 1.0)
        x = x0 + (points[..., 1] - y0) * (x1 - x0) / side_height
        return is_inside ^ (is_spanning_point & (points[..., 0] < x)), None

    loop_sides = jnp.stack([loop, jnp.roll(loop, -1, axis=0)], axis=1)
    return jax.lax.scan(toggle_at_crossing, jnp.zeros(points.shape[:-1], bool), loop_sides)[0]
