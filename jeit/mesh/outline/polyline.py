"""Closed loops of straight sides: what outlines made of them share (pure JAX).

`loops` holds the vertices (k, 2) in metres of each, first not repeated: the outer one counter-clockwise, holes
clockwise. For checks of loops see `jeit.mesh.loops`.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

Loop = Float[Array, "k 2"]


def length(loop: Loop) -> Float[Array, ""]:
    """Length of a loop in m."""
    return jnp.sum(_side_lengths(loop))


def area(loops: Sequence[Loop]) -> Float[Array, ""]:
    """Area inside the first loop less that of the holes, m² (shoelace formula)."""
    outer, *holes = (_shoelace(loop) for loop in loops)
    return sum(holes, outer)


def along(loop: Loop, arc_length: ArrayLike) -> Float[Array, "... 2"]:
    """Points (…, 2) on a loop at `arc_length` (…) in metres from its first vertex; it wraps round."""
    closed = jnp.concatenate([loop, loop[:1]])
    stops = jnp.concatenate([jnp.zeros(1), jnp.cumsum(_side_lengths(loop))])
    wrapped = jnp.mod(jnp.asarray(arc_length, dtype=stops.dtype), stops[-1])
    return jnp.stack([jnp.interp(wrapped, stops, closed[:, axis]) for axis in range(2)], axis=-1)


def contains(loops: Sequence[Loop], points: ArrayLike) -> Bool[Array, "..."]:
    """True for each of `points` (…, 2) inside the first loop and outside the holes (even-odd rule)."""
    points = jnp.asarray(points)
    inside = jnp.zeros(points.shape[:-1], bool)
    for loop in loops:
        inside = inside ^ _inside(loop, points)
    return inside


@jax.jit
def signed_distance(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, " p"]:
    """Distance (p,) of `points` (p, 2) from the nearest side in metres, negative outside."""
    points = jnp.asarray(points)
    apart = _length_of(points - _nearest_on(loops, points))
    return jnp.where(jax.lax.stop_gradient(contains(loops, points)), 1.0, -1.0) * apart


@jax.jit
def nearest(loops: Sequence[Loop], points: ArrayLike) -> Float[Array, "p 2"]:
    """`points` (p, 2) inside as they are, others moved to the nearest place on a side."""
    points = jnp.asarray(points)
    inside = jax.lax.stop_gradient(contains(loops, points))
    return jnp.where(inside[:, None], points, _nearest_on(loops, points))


def _nearest_on(loops: Sequence[Loop], points: Float[Array, "p 2"]) -> Float[Array, "p 2"]:
    start = jnp.concatenate([jnp.asarray(loop) for loop in loops])
    sides = jnp.concatenate([jnp.roll(jnp.asarray(loop), -1, axis=0) for loop in loops]) - start
    offset = points[:, None] - start
    fraction = jnp.clip(jnp.sum(offset * sides, axis=-1) / jnp.sum(sides**2, axis=-1), 0, 1)
    on_sides = start + fraction[..., None] * sides  # (p, s, 2)
    closest = jnp.argmin(jnp.sum((points[:, None] - on_sides) ** 2, axis=-1), axis=1)
    return jnp.take_along_axis(on_sides, closest[:, None, None], axis=1)[:, 0]


def _length_of(vectors: Float[Array, "p 2"]) -> Float[Array, " p"]:
    """Lengths (p,), with a derivative at zero too."""
    return jnp.sqrt(jnp.sum(vectors**2, axis=1) + 1e-24)


def _side_lengths(loop: Loop) -> Float[Array, " k"]:
    return jnp.sqrt(jnp.sum((jnp.roll(loop, -1, axis=0) - loop) ** 2, axis=1))


def _shoelace(loop: Loop) -> Float[Array, ""]:
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * jnp.sum(x * jnp.roll(y, -1) - jnp.roll(x, -1) * y)


def _inside(loop: Loop, points: Float[Array, "... 2"]) -> Bool[Array, "..."]:
    """Even-odd rule: count the sides that a ray towards +x crosses."""

    def crosses(inside: Array, side: Array) -> tuple[Array, None]:
        (x0, y0), (x1, y1) = side
        spans = (y0 > points[..., 1]) != (y1 > points[..., 1])
        height = jnp.where(spans, y1 - y0, 1.0)
        x = x0 + (points[..., 1] - y0) * (x1 - x0) / height
        return inside ^ (spans & (points[..., 0] < x)), None

    sides = jnp.stack([loop, jnp.roll(loop, -1, axis=0)], axis=1)
    return jax.lax.scan(crosses, jnp.zeros(points.shape[:-1], bool), sides)[0]
