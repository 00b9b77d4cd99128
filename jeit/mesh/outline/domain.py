"""Base classes of bodies, which can be meshed, and of domains, which are bodies bounded by an outline."""

from __future__ import annotations

import abc
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import describe
from jeit.mesh.checks import warn_large
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.mesh import Mesh
from jeit_solvers.engines import has_values
from jeit_solvers.module import Module


class Body(Module):
    """Base class of all bodies: plane outlines (`Domain`), solids above an outline (`Solid`), and existing meshes
    (`OwnMesh`).

    **Example:**

    ```python
    body: Body = Solid(Disk(0.1), 0.05)
    body.mesh(num_points=500).num_cells
    ```
    """

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box seen from above, (x_min, x_max, y_min, y_max) in metres."""

    @abc.abstractmethod
    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices (k, 2), in metres, of each boundary loop of a plane body, the outer loop first; empty for a
        solid."""

    @abc.abstractmethod
    def describe(self) -> dict[str, Any]:
        """Name of the "shape" and its sizes, lengths in metres, as values that JSON and TOML can represent."""

    @abc.abstractmethod
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """Mesh the body with `num_points` nodes or cells of `cell_size` metres; `refine` requests smaller cells as seen
        from above.

        Raises `ValueError` for invalid or contradictory arguments.
        """


# Maximum distance of an outline from the origin, divided by its size: beyond it, double precision leaves fewer than ten
# digits for the shape.
_MAX_DISTANCE_FROM_ORIGIN = 1e6


class Pen(Protocol):
    """Interface to draw outlines, into a drawing file or a geometry kernel. The first circle or loop drawn encloses all
    others."""

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        """Draw a circle; lengths in metres."""

    def loop(self, vertices: np.ndarray) -> None:
        """Draw a closed loop of straight sides with `vertices` (k, 2) in metres, the first of which is not repeated."""


class Domain(Body):
    """An outline in metres, without a mesh: `Disk`, `Rectangle`, `Polygon`, or a subclass of your own.

    Readers, layouts, rasters and mesh builders use only the methods defined here, so a new outline needs only one
    class. Arc length runs counter-clockwise along the outer edge. For outlines with straight sides, or approximated by
    chords, each method can be a single call of a function in `jeit.mesh.outline.straight_sided`; see `Polygon`.

    **Example:**

    ```python
    outline: Domain = Rectangle(0.2, 0.1)
    outline.boundary([0.0, outline.perimeter / 2])
    ```
    """

    @property
    @abc.abstractmethod
    def area(self) -> float | Float[Array, ""]:
        """Enclosed area without holes, m²."""

    @property
    @abc.abstractmethod
    def perimeter(self) -> float | Float[Array, ""]:
        """Length of the outer edge, m."""

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) in metres."""

    @abc.abstractmethod
    def boundary(self, arc_length: ArrayLike) -> Float[Array, "... 2"]:
        """Points (…, 2) on the outer edge at `arc_length` (…) in metres, taken modulo the perimeter."""

    @abc.abstractmethod
    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices (k, 2), in metres, of the outer edge, counter-clockwise, and of every hole, clockwise.

        The first vertex is not repeated. A curved edge is replaced by `num_chords` chords; with 120 chords, the polygon
        of a circle lies at most 0.04 % of the radius inside the circle.
        """

    @abc.abstractmethod
    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """Whether each of `points` (…, 2), in metres, lies inside the outline."""

    @abc.abstractmethod
    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the edge in metres, negative outside.

        The distance is differentiable almost everywhere; within 1e-12 m of the edge it is smoothed.
        """

    @abc.abstractmethod
    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """Move each of `points` (p, 2), metres, that lies outside the outline to the nearest point on the edge of the
        outline."""

    @abc.abstractmethod
    def describe(self) -> dict[str, Any]:
        """Name of the "shape" and its parameters, lengths in metres, as values that JSON and TOML can represent.

        All entries except "shape" are arguments that create the same outline.
        """

    @abc.abstractmethod
    def draw(self, pen: Pen) -> None:
        """Draw the edge and then the holes: circles as circles, all other loops with straight sides."""

    @abc.abstractmethod
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """Mesh the domain with triangles, with `num_points` nodes or cells of `cell_size` metres; see `jeit.mesh.disk`.

        Raises `ValueError` for invalid or contradictory arguments.
        """


def array_module(*values: Any) -> Any:
    """The array module to compute with: jax.numpy if any of `values` is being traced, otherwise NumPy."""
    return np if has_values(*values) else jnp


def check_length(name: str, value: Any, size_factor: float = 1.0) -> Any:
    """Check a length in metres and convert it to a float; traced values are returned unchanged. Raises `ValueError`
    unless the length is positive, and warns if the object is large: `size_factor` is the object's size divided by
    `value`."""
    if not has_values(value):
        return value
    try:
        checked_length = np.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected one length in metres, got {value!r}.") from None
    if not np.isfinite(checked_length) or checked_length <= 0:
        raise ValueError(f"{name}: expected a positive length in metres, got {describe(value)}.")
    warn_large(checked_length, name, size_factor)
    return checked_length


def check_near_origin(name: str, coordinates: Any, size: Any) -> None:
    """Raise `ValueError` with the argument's `name` if an outline of `size` metres, with `coordinates` in metres, is so
    far from the origin that the coordinates lose accuracy. Traced values are not checked."""
    if not has_values(coordinates, size):
        return
    origin_distance = float(np.max(np.abs(np.asarray(coordinates))))
    if origin_distance > _MAX_DISTANCE_FROM_ORIGIN * float(size):
        raise ValueError(
            f"{name}: {origin_distance:.3g} m from the origin, and only {float(size):.3g} m across; give its "
            "coordinates about a point of its own."
        )


def check_position(name: str, value: Any) -> Any:
    """Check a position (x, y) in metres and convert it to two floats; traced values are converted without a check.
    Raises `ValueError` for anything but two finite numbers."""
    if not has_values(value):
        return jnp.asarray(value)
    position_array = np.asarray(value, dtype=float)
    if position_array.shape != (2,) or not np.isfinite(position_array).all():
        raise ValueError(f"{name}: expected two finite coordinates (x, y) in metres, got {value!r}.")
    return (float(position_array[0]), float(position_array[1]))
