"""`unfold`: the triangles of a surface round a place, laid into the plane of the triangle that holds the place.

Triangle after triangle is turned about the side that it shares with the one before, on the way that crosses the fewest.
Where a surface can be laid flat without stretching, as a sheet that was bent can, all ways lead to the same, and
straight lines there are the shortest ways on the surface: exactly, on its triangles. Elsewhere the result depends on
the way, and the places where it does are reported. Arrays of either engine, differentiated and batched.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit.mesh.mesh import Mesh
from jeit_solvers.engines import has_values, namespace, on_host, sum_into, undifferentiated, while_loop

# Radians that angles round a node may miss a full turn by, where the surface counts as flat or bent only: what float32
# files, and steps of finite differences, leave of it.
_FLAT = 1e-4
# Ways are joined in pairs, at most so often: to 128 triangles.
_JOININGS = 7


class Unfolding(NamedTuple):
    """Unfolded triangles round L places on a surface of m triangles, metres.

    **Fields**: `corners` (m, 3, 2), of each triangle in its own plane; `turn` (L, m, 2), cosine and sine, and `shift`
    (L, m, 2), from there into the plane of each place's triangle; `place` (L, 2), in that one; `reached` (L, m), where
    these are known, round the place; `exact` (L,), whether what was reached can be laid flat without stretching, and is
    no more than 128 triangles away.
    """

    corners: Float[Array, "m 3 2"]
    turn: Float[Array, "L m 2"]
    shift: Float[Array, "L m 2"]
    place: Float[Array, "L 2"]
    reached: Bool[Array, "L m"]
    exact: Bool[Array, " L"]

    def squared(self, weights: Float[np.ndarray, "p 3"], which: Int[Array, "m k"]) -> Float[Array, "m k p"]:
        """Squares of the lengths, m², from k of the places, for each triangle those numbered in `which`, to points of
        it with these weights of its corners."""
        xp = namespace(self.corners, self.turn)
        number = xp.arange(len(self.corners))[:, None]
        points = xp.einsum("pi,mid->mpd", weights, self.corners)[:, None]
        turn, shift = self.turn[which, number][:, :, None], (self.shift - self.place[:, None])[which, number]
        laid = _turned(turn, points) + shift[:, :, None]
        return (laid**2).sum(axis=-1)


def unfold(mesh: Mesh, places: Float[Array, "L 3"], reach: Float[Array, "L m"]) -> Unfolding:
    """The triangles of a surface whose middles lie within `reach` of places on it, metres, straight through space, and
    that hang together with the place's own."""
    xp = namespace(mesh, places)
    corners = xp.asarray(mesh.points[mesh.cells])
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = first / xp.sqrt((first**2).sum(axis=1, keepdims=True))
    out = xp.cross(first, second)
    out = out / xp.sqrt((out**2).sum(axis=1, keepdims=True))
    axes = xp.stack([along, xp.cross(out, along)], axis=1)
    local = xp.einsum("mid,mad->mia", corners - corners[:, :1], axes)
    frames = corners[:, 0], axes, out
    root = _triangles_of(undifferentiated(places), *undifferentiated((frames, local)))
    away = undifferentiated(((places[:, None] - corners.mean(axis=1)) ** 2).sum(axis=-1))
    # Where it has values, it is none of what is compiled: a sort of constants takes XLA seconds.
    twin, cell = xp.asarray(_twins(on_host(mesh.cells))), xp.arange(len(corners))
    reached, side = _hang_together(twin // 3, away <= undifferentiated(reach) ** 2, root)
    half = 3 * cell + side
    before = xp.where(side < 0, cell, twin[half] // 3)
    turn, shift = (one[half] for one in _over_sides(local, twin))
    known = (side >= 0)[..., None]
    turn, shift = xp.where(known, turn, xp.array([1.0, 0.0])), xp.where(known, shift, 0.0)
    turn, shift, last = _joined(before, turn, shift)
    place = xp.einsum("ld,lad->la", places - corners[root, 0], axes[root])
    curved = _curved(undifferentiated(local), mesh.cells, twin, mesh.num_points)
    lost = reached & (curved | (last != root[:, None]))
    return Unfolding(local, turn, shift, place, reached, ~lost.any(axis=1))


def _turned(turn, points):
    """Points (…, 2) turned by angles of cosine and sine (…, 2)."""
    cos, sin = turn[..., 0], turn[..., 1]
    x, y = points[..., 0], points[..., 1]
    return namespace(turn, points).stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _triangles_of(places, frames, local) -> Int[Array, " L"]:
    """The triangle that each place lies in: the nearest, by its height above the plane and how far it is outside."""
    xp = namespace(places, local)
    origin, axes, out = frames
    offset = places[:, None] - origin
    x, y = xp.moveaxis(xp.einsum("lmd,mad->lma", offset, axes), -1, 0)
    third = y / local[:, 2, 1]
    second = (x - third * local[:, 2, 0]) / local[:, 1, 0]
    outside = xp.maximum(-xp.minimum(xp.minimum(second, third), 1 - second - third), 0) * local[:, 1, 0]
    return ((offset * out).sum(axis=-1) ** 2 + outside**2).argmin(axis=1)


def _twins(cells) -> Int[Array, " h"]:
    """For each side of each triangle, 3 cell + number, the same side in the neighbour; itself on the edge."""
    xp = namespace(cells)
    start, end = cells.reshape(-1), xp.roll(cells, -1, axis=1).reshape(-1)
    low, high = xp.minimum(start, end), xp.maximum(start, end)
    order = xp.lexsort((high, low))
    same = (xp.diff(low[order]) == 0) & (xp.diff(high[order]) == 0)
    no = xp.zeros(1, bool)
    step = xp.where(xp.concatenate([same, no]), 1, 0) - xp.where(xp.concatenate([no, same]), 1, 0)
    other = order[xp.arange(len(order)) + step]
    return other[xp.argsort(order)]


def _hang_together(neighbour, near: Bool[Array, "L m"], root):
    """Whether the triangles `near` places are reached from the `root` (L,) over sides, and the side (L, m) of each that
    leads back, −1 of the root and what is not reached."""
    xp = namespace(neighbour, near)
    cell = xp.arange(near.shape[1])
    neighbour = neighbour.reshape(-1, 3)
    begun = cell == root[:, None]

    def grown(state):
        reached, side, _ = state
        there = reached[:, neighbour]
        new = near & ~reached & there.any(axis=-1)
        return reached | new, xp.where(new, there.argmax(axis=-1).astype(int), side), new.any()

    some = xp.ones((), bool)
    reached, side, _ = while_loop(lambda state: state[2], grown, (begun, xp.full(near.shape, -1, int), some))
    return reached, side


def _over_sides(local, twin):
    """Turn (h, 2) and shift (h, 2) from the plane of each side's triangle into that of its neighbour."""
    xp = namespace(local)
    start, end = local.reshape(-1, 2), xp.roll(local, -1, axis=1).reshape(-1, 2)
    own, other = end - start, start[twin] - end[twin]
    turn = xp.stack([(own * other).sum(axis=1), own[:, 0] * other[:, 1] - own[:, 1] * other[:, 0]], axis=1)
    turn = turn / xp.sqrt((turn**2).sum(axis=1, keepdims=True))
    return turn, end[twin] - _turned(turn, start)


def _joined(before, turn, shift):
    """From steps, each from a triangle into the one `before` (L, m), to ways, and where they end, in the place's."""
    xp = namespace(before, turn)
    row = xp.arange(len(before))[:, None]
    for _ in range(_JOININGS):
        then, moved = turn[row, before], shift[row, before]
        turn, shift = _turned(then, turn), _turned(then, shift) + moved
        before = before[row, before]
        if has_values(before) and (before[row, before] == before).all():
            break
    return turn, shift, before


def _curved(local, cells, twin, number: int) -> Bool[Array, " m"]:
    """Whether, for each triangle, the angles round one of its corners inside the surface are no full turn."""
    xp = namespace(local, cells)
    ahead, back = xp.roll(local, -1, axis=1) - local, xp.roll(local, 1, axis=1) - local
    angle = xp.arctan2(ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0], (ahead * back).sum(axis=-1))
    round_node = sum_into((number,), (cells,), angle)
    edge = (twin == xp.arange(len(twin))).reshape(-1, 3)
    ends = sum_into((number,), (cells,), 1.0 * (edge | xp.roll(edge, 1, axis=1)))
    bent = (abs(round_node - 2 * np.pi) > _FLAT) & (ends == 0)
    return bent[cells].any(axis=1)
