"""Bodies, which can be meshed, and domains: bodies bounded by an outline."""

from __future__ import annotations

import abc
from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import describe
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.mesh import Mesh
from jeit.mesh.sizes import warn_large
from jeit_solvers.engines import has_values


class Body(eqx.Module):
    """Base of all bodies: plane outlines (`Domain`), solids above one (`Solid`), and meshes of your own (`OwnMesh`)."""

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box seen from above, (x_min, x_max, y_min, y_max) in metres."""

    @abc.abstractmethod
    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices (k, 2) in metres of the edges of a plane body, the outer one first; none of a solid."""

    @abc.abstractmethod
    def describe(self) -> dict[str, Any]:
        """The name of the "shape" and its sizes, lengths in metres, in words that JSON and TOML have."""

    @abc.abstractmethod
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """A mesh of it with `num_points` nodes or of `cell_size` metres, finer where `refine` asks, seen from above.

        Raises `ValueError` on bad or contradicting arguments.
        """


# Greatest distance of an outline from the origin, over its size: ten digits of its shape are left there.
_FARTHEST = 1e6


class Pen(Protocol):
    """Interface to draw outlines: into a drawing's file, or by a geometry kernel. The first stroke encloses the
    others."""

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        """A circle, in metres."""

    def loop(self, vertices: np.ndarray) -> None:
        """A closed loop of straight sides with these `vertices` (k, 2) in metres, the first not repeated."""


class Domain(Body):
    """An outline in metres, without a mesh: `Disk`, `Rectangle`, `Polygon`, or one of your own.

    Readers, layouts, rasters and mesh builders ask for nothing but what stands here, so that a new outline is one
    class. Arc length runs counter-clockwise along the outer edge. For edges of straight sides, or drawn as chords, each
    method is a line that calls `jeit.mesh.outline.polygon`; see `Polygon`.
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
        """Points (…, 2) on the outer edge at `arc_length` (…) in metres; it wraps round."""

    @abc.abstractmethod
    def loops(self, num_chords: int = 120) -> tuple[Float[Array, "k 2"], ...]:
        """Vertices (k, 2) in metres of the outer edge, counter-clockwise, and of every hole, clockwise.

        The first vertex is not repeated. A curved edge becomes `num_chords` chords: a circle,
        with 120, a polygon that is nowhere more than 0.04 % of the radius inside it.
        """

    @abc.abstractmethod
    def contains(self, points: ArrayLike) -> Bool[Array, "..."]:
        """True for each of `points` (…, 2) in metres that lies inside."""

    @abc.abstractmethod
    def signed_distance(self, points: ArrayLike) -> Float[Array, " p"]:
        """Distance (p,) of `points` (p, 2) from the edge in metres, negative outside.

        To be differentiated almost everywhere; within 1e-12 m of the edge it is smoothed.
        """

    @abc.abstractmethod
    def nearest(self, points: ArrayLike) -> Float[Array, "p 2"]:
        """`points` (p, 2) in metres, those outside moved to the nearest place on the edge."""

    @abc.abstractmethod
    def describe(self) -> dict[str, Any]:
        """The name of the "shape" and what it is made from, lengths in metres, in words that JSON and TOML have.

        All but "shape" are the arguments that make the outline again.
        """

    @abc.abstractmethod
    def draw(self, pen: Pen) -> None:
        """Draw the edge and then the holes: circles as circles, everything else as loops of straight sides."""

    @abc.abstractmethod
    def mesh(self, num_points: int | None = None, cell_size: float | None = None, refine: Refinement = None) -> Mesh:
        """A mesh of triangles with `num_points` nodes or of `cell_size` metres; see `jeit.mesh.disk`.

        Raises `ValueError` on bad or contradicting arguments.
        """


def numerics(*values: Any) -> Any:
    """JAX's numpy where any of `values` is being traced, NumPy where all are known."""
    return np if has_values(*values) else jnp


def check_length(name: str, value: Any, across: float = 1.0) -> Any:
    """Check a length in metres and make it a float (traced values pass); `ValueError` unless it is positive. What it is
    the length of is `across` times as large, and warned of by that."""
    if not has_values(value):
        return value
    try:
        number = np.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected one length in metres, got {value!r}.") from None
    if not np.isfinite(number) or number <= 0:
        raise ValueError(f"{name}: expected a positive length in metres, got {describe(value)}.")
    warn_large(number, name, across)
    return number


def check_near_origin(name: str, far: Any, size: Any) -> None:
    """Raise `ValueError`, about the argument `name`, for an outline of `size` metres that lies so `far` away, metres,
    that rounding of its coordinates would be seen in it (traced values pass)."""
    if has_values(far, size) and float(np.max(np.abs(np.asarray(far)))) > _FARTHEST * float(size):
        away = float(np.max(np.abs(np.asarray(far))))
        raise ValueError(
            f"{name}: {away:.3g} m from the origin, and only {float(size):.3g} m across; give its coordinates about a "
            "point of its own."
        )


def check_position(name: str, value: Any) -> Any:
    """Check a place (x, y) in metres and make it two floats (traced values pass); `ValueError` if it is none."""
    if not has_values(value):
        return jnp.asarray(value)
    array = np.asarray(value, dtype=float)
    if array.shape != (2,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected two finite coordinates (x, y) in metres, got {value!r}.")
    return (float(array[0]), float(array[1]))
