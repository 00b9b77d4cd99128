"""Functions for outlines that consist of closed loops with straight sides.

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

from jeit.mesh.outline.domain import numerics
from jeit.mesh.topology import inside as enclosed
from jeit_solvers.engines import either_engine, namespace

Loop = Float[Array, "k 2"]


def length(loop: Loop) -> Float[Array, ""]:
    """Length of a loop in m."""
    return jnp.sum(_side_lengths(loop))


def area(loops: Sequence[Loop]) -> Float[Array, ""]:
    """Area inside the first loop minus the area of the holes, m² (shoelace formula)."""
    outer, *holes = (_shoelace(loop) for loop in loops)
    return sum(holes, outer)


@either_engine
def along(loop: Loop, arc_length: ArrayLike) -> Float[Array, "... 2"]:
    """Points (…, 2) on a loop at `arc_length` (…) in metres from its first vertex, taken modulo the length of the
    loop."""
    xp = namespace(loop)
    closed_loop = xp.concatenate([loop, loop[:1]])
    stops = xp.concatenate([xp.zeros(1), xp.cumsum(_side_lengths(loop))])
    wrapped_length = xp.mod(xp.asarray(arc_length, dtype=stops.dtype), stops[-1])
    return xp.stack([xp.interp(wrapped_length, stops, closed_loop[:, axis]) for axis in range(2)], axis=-1)


@either_engine
def contains(loops: Sequence[Loop], points: ArrayLike) -> Bool[Array, "..."]:
    """Whether each of `points` (…, 2) lies inside the first loop and outside the holes (even-odd rule)."""
    if namespace(loops, points) is np:
        point_array = np.asarray(points)
        return enclosed(point_array.reshape(-1, 2), loops).reshape(point_array.shape[:-1])  # pyright: ignore
    points = jnp.asarray(points)
    is_inside = jnp.zeros(points.shape[:-1], bool)
    for loop in loops:
        is_inside = is_inside ^ _is_inside(loop, points)
    return is_inside


def signed_distance(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, " p"]:
    """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside."""
    xp = numerics(loops, points)
    point_array, is_inside, nearest_points = _project_onto_loops(xp, loops, points)
    distances = xp.sqrt(((point_array - nearest_points) ** 2).sum(axis=1) + 1e-24)  # differentiable at zero, too
    return jnp.asarray(xp.where(is_inside, distances, -distances))


def nearest(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, "p 2"]:
    """Move those of `points` (p, 2) that lie outside to the nearest point on a side; points inside are returned
    unchanged."""
    xp = numerics(loops, points)
    point_array, is_inside, nearest_points = _project_onto_loops(xp, loops, points)
    return jnp.asarray(xp.where(is_inside[:, None], point_array, nearest_points))


def _project_onto_loops(xp: Any, loops: Sequence[Loop], points: ArrayLike) -> tuple[Any, Any, Any]:
    """Convert `points` (p, 2) to an array; also returns whether each lies inside (p,), and the nearest point on a side
    (p, 2)."""
    chains, point_array = [xp.asarray(loop) for loop in loops], xp.asarray(points, float)
    start = xp.concatenate(chains)
    sides = xp.concatenate([xp.roll(loop, -1, axis=0) for loop in chains]) - start
    offset = point_array[:, None] - start
    fraction = xp.clip((offset * sides).sum(axis=-1) / (sides**2).sum(axis=-1), 0, 1)
    on_sides = start + fraction[..., None] * sides  # (p, s, 2)
    closest_side = xp.argmin(((point_array[:, None] - on_sides) ** 2).sum(axis=-1), axis=1)
    nearest_points = xp.take_along_axis(on_sides, closest_side[:, None, None], axis=1)[:, 0]
    is_inside = enclosed(point_array, chains) if xp is np else jax.lax.stop_gradient(contains(chains, point_array))
    return point_array, is_inside, nearest_points


def _side_lengths(loop: Loop) -> Float[Array, " k"]:
    xp = namespace(loop)
    return xp.sqrt(((xp.roll(loop, -1, axis=0) - loop) ** 2).sum(axis=1))


def _shoelace(loop: Loop) -> Float[Array, ""]:
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * jnp.sum(x * jnp.roll(y, -1) - jnp.roll(x, -1) * y)


def _is_inside(loop: Loop, points: Float[Array, "... 2"]) -> Bool[Array, "..."]:
    """Even-odd rule: count the sides that a ray towards +x crosses."""

    def toggle_at_crossing(is_inside: Array, side: Array) -> tuple[Array, None]:
        (x0, y0), (x1, y1) = side
        spans_point = (y0 > points[..., 1]) != (y1 > points[..., 1])
        side_height = jnp.where(spans_point, y1 - y0, 1.0)
        x = x0 + (points[..., 1] - y0) * (x1 - x0) / side_height
        return is_inside ^ (spans_point & (points[..., 0] < x)), None

    sides = jnp.stack([loop, jnp.roll(loop, -1, axis=0)], axis=1)
    return jax.lax.scan(toggle_at_crossing, jnp.zeros(points.shape[:-1], bool), sides)[0]
