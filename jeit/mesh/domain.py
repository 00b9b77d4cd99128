"""Outlines in metres, without a mesh: `Disk`, `Rectangle`, `Polygon`.

Readers, layouts, rasters and mesh builders share them. Arc length runs counter-clockwise along the outer outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.mesh import loops
from jeit.mesh._checks import warn_large
from jeit.mesh.generate._outlines import mesh_disk, mesh_polygon, mesh_rectangle
from jeit.mesh.mesh import Mesh


def _traced(*values: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def check_length(name: str, value: Any) -> Any:
    """Check a length in metres and make it a float (traced values pass)."""
    if _traced(value):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected one length in metres, got {value!r}.") from None
    if not np.isfinite(number) or number <= 0:
        raise ValueError(f"{name}: expected a positive length in metres, got {number:g}.")
    warn_large(number, name)
    return number


def _position(name: str, value: Any) -> Any:
    if _traced(value):
        return jnp.asarray(value)
    array = np.asarray(value, dtype=float)
    if array.shape != (2,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected two finite coordinates (x, y) in metres, got {value!r}.")
    return (float(array[0]), float(array[1]))


class Disk(eqx.Module):
    """A disk of given radius and centre, in metres; arc length starts at angle 0."""

    radius: float
    centre: tuple[float, float]

    def __init__(self, radius: float, centre: Sequence[float] = (0.0, 0.0)):
        """`radius` > 0 and `centre` (x, y) in metres; raises `ValueError` otherwise."""
        self.radius = check_length("radius", radius)
        self.centre = _position("centre", centre)

    @property
    def area(self) -> float:
        """π R² in m²."""
        return np.pi * self.radius**2

    @property
    def perimeter(self) -> float:
        """2 π R in m."""
        return 2.0 * np.pi * self.radius

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        x, y = self.centre
        return (x - self.radius, x + self.radius, y - self.radius, y + self.radius)

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """True for each of `points` (…, 2) in metres that lies in the disk or on its edge."""
        offset = jnp.asarray(points) - jnp.asarray(self.centre)
        return jnp.sum(offset**2, axis=-1) <= self.radius**2 * (1 + 1e-12)

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the circle at `arc_length` (…) in metres, counter-clockwise from angle 0."""
        angle = jnp.asarray(arc_length) / self.radius
        return jnp.asarray(self.centre) + self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)

    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Any = None) -> Mesh:
        """A mesh of the disk; see `jeit.mesh.disk`."""
        return mesh_disk(self, num_points=num_points, cell_size=cell_size, refine=refine)


class Rectangle(eqx.Module):
    """A rectangle with sides along the axes, in metres; arc length starts at the lower left corner."""

    width: float
    height: float
    centre: tuple[float, float]

    def __init__(self, width: float, height: float, centre: Sequence[float] = (0.0, 0.0)):
        """`width` (along x), `height` (along y) > 0 and `centre` in metres; raises `ValueError` otherwise."""
        self.width = check_length("width", width)
        self.height = check_length("height", height)
        self.centre = _position("centre", centre)

    @property
    def area(self) -> float:
        """Width times height in m²."""
        return self.width * self.height

    @property
    def perimeter(self) -> float:
        """2 (width + height) in m."""
        return 2.0 * (self.width + self.height)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        x, y = self.centre
        return (x - self.width / 2, x + self.width / 2, y - self.height / 2, y + self.height / 2)

    @property
    def vertices(self) -> Float[Array, "4 2"]:
        """Corners (4, 2) in metres, counter-clockwise from the lower left one."""
        left, right, low, high = self.extent
        return jnp.array([[left, low], [right, low], [right, high], [left, high]])

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """True for each of `points` (…, 2) in metres that lies in the rectangle or on its edge."""
        offset = jnp.abs(jnp.asarray(points) - jnp.asarray(self.centre))
        half = 0.5 * jnp.asarray([self.width, self.height])
        return jnp.all(offset <= half * (1 + 1e-12), axis=-1)

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outline at `arc_length` (…) in metres, counter-clockwise from the lower left."""
        return _along(self.vertices, arc_length)

    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Any = None) -> Mesh:
        """A mesh of the rectangle; see `jeit.mesh.rectangle`."""
        return mesh_rectangle(self, num_points=num_points, cell_size=cell_size, refine=refine)


class Polygon(eqx.Module):
    """A simple polygon, possibly with holes, in metres; arc length starts at the first vertex."""

    vertices: Float[Array, "k 2"]
    holes: tuple[Float[Array, "h 2"], ...]

    def __init__(self, vertices: ArrayLike, holes: Sequence[ArrayLike] = ()):
        """`vertices` (k, 2) of the outline and of each of `holes`, in order, in metres, first not repeated.

        Either orientation is taken; the outline is kept counter-clockwise, holes clockwise. Raises
        `ValueError` on fewer than three or repeated vertices, an outline that crosses or touches itself, and holes that
        are not inside.
        """
        if _traced(vertices, holes):
            self.vertices = jnp.asarray(vertices)
            self.holes = tuple(jnp.asarray(hole) for hole in holes)
            return
        outer = loops.check_loop(vertices, "vertices", clockwise=False)
        inner = [loops.check_loop(hole, f"holes[{k}]", clockwise=True) for k, hole in enumerate(holes)]
        loops.check_apart(outer, inner)
        warn_large(float(np.ptp(outer, axis=0).max()), "vertices")
        self.vertices = jnp.asarray(outer)
        self.holes = tuple(jnp.asarray(hole) for hole in inner)

    @property
    def area(self) -> Float[Array, ""]:
        """Enclosed area without the holes, in m² (shoelace formula)."""
        return sum((_shoelace(hole) for hole in self.holes), _shoelace(self.vertices))

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outer outline in m."""
        return jnp.sum(_side_lengths(self.vertices))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""
        low, high = np.min(np.asarray(self.vertices), axis=0), np.max(np.asarray(self.vertices), axis=0)
        return (float(low[0]), float(high[0]), float(low[1]), float(high[1]))

    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """True for each of `points` (…, 2) in metres inside the outline and outside the holes (even-odd rule)."""
        points = jnp.asarray(points)
        inside = jnp.zeros(points.shape[:-1], bool)
        for loop in (self.vertices, *self.holes):
            inside = inside ^ _inside(loop, points)
        return inside

    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outer outline at `arc_length` (…) in metres from the first vertex."""
        return _along(self.vertices, arc_length)

    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Any = None) -> Mesh:
        """A mesh of the polygon; see `jeit.mesh.polygon`."""
        return mesh_polygon(self, num_points=num_points, cell_size=cell_size, refine=refine)


Domain = Disk | Rectangle | Polygon


def _side_lengths(loop: Float[Array, "k 2"]) -> Float[Array, " k"]:
    return jnp.sqrt(jnp.sum((jnp.roll(loop, -1, axis=0) - loop) ** 2, axis=1))


def _shoelace(loop: Float[Array, "k 2"]) -> Float[Array, ""]:
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * jnp.sum(x * jnp.roll(y, -1) - jnp.roll(x, -1) * y)


def _along(loop: Float[Array, "k 2"], arc_length: ArrayLike) -> Float[Array, "... 2"]:
    """Piecewise-linear walk along a closed loop; arc length wraps round."""
    closed = jnp.concatenate([loop, loop[:1]])
    stops = jnp.concatenate([jnp.zeros(1), jnp.cumsum(_side_lengths(loop))])
    wrapped = jnp.mod(jnp.asarray(arc_length, dtype=stops.dtype), stops[-1])
    return jnp.stack([jnp.interp(wrapped, stops, closed[:, axis]) for axis in range(2)], axis=-1)


def _inside(loop: Float[Array, "k 2"], points: Float[Array, "... 2"]) -> Bool[Array, "..."]:
    """Even-odd rule: count the sides that a ray towards +x crosses."""

    def crosses(inside: Array, side: Array) -> tuple[Array, None]:
        (x0, y0), (x1, y1) = side
        spans = (y0 > points[..., 1]) != (y1 > points[..., 1])
        height = jnp.where(spans, y1 - y0, 1.0)
        x = x0 + (points[..., 1] - y0) * (x1 - x0) / height
        return inside ^ (spans & (points[..., 0] < x)), None

    sides = jnp.stack([loop, jnp.roll(loop, -1, axis=0)], axis=1)
    return jax.lax.scan(crosses, jnp.zeros(points.shape[:-1], bool), sides)[0]
