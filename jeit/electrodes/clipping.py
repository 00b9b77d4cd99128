"""Integrals of P1 functions over what a rectangle covers of triangles: exact, and differentiable in both.

A triangle is cut by pushing what lies beyond a side of the rectangle back onto the line of that side. The closed line
of its edges stays closed, and goes round the part within once and along the side to and fro, which adds nothing. So
every triangle becomes a polygon of as many corners, in one array, whose integrals follow from its corners.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from jeit_solvers.engines import namespace, undifferentiated

# Share of a triangle that is taken for none: its digits are few, which the best contacts would show.
_TOUCHED = 1e-12


def covered_moments(
    corners: Float[Array, "*q 3 2"], half_size: Float[Array, "*q 2"]
) -> tuple[Float[Array, "*q 3"], Float[Array, "*q 3 3"]]:
    """∫φ_i and ∫φ_iφ_j over the part of triangles within rectangles |x| ≤ a, |y| ≤ b, relative to the triangle's area.

    `corners`: of the triangles, in the rectangle's own coordinates, metres; `half_size`: (a, b), metres. A triangle
    that has no area gives numbers without meaning.
    """
    xp = namespace(corners, half_size)
    outline = corners
    for axis in range(2):
        outline = _pushed_within(outline, axis, half_size[..., axis])
    # Barycentric coordinates of the second and third corner, in which the triangle is (0, 0), (1, 0), (0, 1).
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    offset = outline - corners[..., :1, :]
    double = _cross(first, second)[..., None]
    place = xp.stack([_cross(offset, second[..., None, :]), _cross(first[..., None, :], offset)], axis=-1)
    place = place / double[..., None]
    following = xp.roll(place, -1, axis=-2)
    # A fan of triangles from the first corner, whose areas count with their signs; twice, for the triangle's is 1/2.
    weight = _cross(place, following)
    ends = [xp.concatenate([1 - one.sum(axis=-1, keepdims=True), one], axis=-1) for one in (place, following)]
    total = ends[0] + ends[1] + np.array([1.0, 0.0, 0.0]).astype(place.dtype)
    twice = sum(xp.einsum("...k,...ki,...kj->...ij", weight, one, one) for one in (total, *ends))
    corner = np.zeros((3, 3))
    corner[0, 0] = 1
    twice = (twice + weight.sum(axis=-1)[..., None, None] * corner.astype(place.dtype)) / 12
    # Of what is only touched, rounding is left, which good contacts would make much of: it goes, but not what it grows
    # by. And each mass has to be the sum of its products to the last digit, for where contacts are good their
    # difference drives currents.
    twice = twice - undifferentiated(xp.where(twice.sum(axis=(-1, -2), keepdims=True) > _TOUCHED, 0, twice))
    twice = (twice + xp.swapaxes(twice, -1, -2)) / 2
    return twice.sum(axis=-1), twice


def _pushed_within(outline: Float[Array, "*q k 2"], axis: int, half: Float[Array, "*q"]) -> Float[Array, "*q l 2"]:
    """Closed lines (…, k, 2) with what is beyond ± `half` along an axis moved there: three corners for each."""
    xp = namespace(outline, half)
    step = xp.roll(outline, -1, axis=-2) - outline
    along, half = step[..., axis], half[..., None]
    slope = xp.where(along == 0, 1, along)
    meets = [xp.clip((side * half - outline[..., axis]) / slope, 0, 1) for side in (-1, 1)]
    share = xp.stack([xp.zeros_like(along), xp.minimum(*meets), xp.maximum(*meets)], axis=-1)
    corners = outline[..., None, :] + share[..., None] * step[..., None, :]
    corners = corners.reshape(*corners.shape[:-3], 3 * corners.shape[-3], 2)  # of no triangle too
    own = xp.clip(corners[..., axis], -half, half)
    other = corners[..., 1 - axis]
    return xp.stack([own, other] if axis == 0 else [other, own], axis=-1)


def _cross(a: Float[Array, "*q 2"], b: Float[Array, "*q 2"]) -> Float[Array, "*q"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
