"""Checks and measures of polygonal loops (NumPy)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jeit.mesh._topology import signed_area

# Pairs of sides that are compared at once.
_PAIRS = 250_000


def check_loop(vertices: ArrayLike, name: str, *, clockwise: bool) -> np.ndarray:
    """Vertices (k, 2) of a simple loop turned the way asked, its first vertex kept; `ValueError` if it is none."""
    try:
        loop = np.asarray(vertices, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected coordinates of shape (k, 2) in metres; {error}.") from None
    if loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3:
        raise ValueError(f"{name}: expected at least three vertices, shape (k, 2), got {loop.shape}.")
    if not np.isfinite(loop).all():
        bad = int(np.flatnonzero(~np.isfinite(loop).all(axis=1))[0])
        raise ValueError(f"{name}: vertex {bad} is {loop[bad].tolist()}. Every coordinate must be a finite number.")
    extent = np.ptp(loop, axis=0).max()
    length = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    if length.min() <= 1e-9 * extent:
        first = int(np.argmin(length))
        hint = " Do not repeat the first vertex at the end." if first == len(loop) - 1 else " Remove one."
        raise ValueError(f"{name}: vertices {first} and {(first + 1) % len(loop)} coincide.{hint}")
    crossing = _first_crossing(loop)
    if crossing is not None:
        raise ValueError(
            f"{name}: the outline crosses or touches itself: side {crossing[0]} (from vertex {crossing[0]}) meets side "
            f"{crossing[1]}. Give the vertices in order along a simple closed outline."
        )
    if (signed_area(loop) < 0) != clockwise:
        loop = np.concatenate([loop[:1], loop[:0:-1]])
    return loop


def check_apart(outer: np.ndarray, holes: Sequence[np.ndarray]) -> None:
    """Raise `ValueError` unless every hole lies inside the outline and apart from the others."""
    for k, hole in enumerate(holes):
        if not inside(hole, [outer]).all() or _touching(hole, outer):
            raise ValueError(f"holes[{k}]: does not lie strictly inside the outline. Move or shrink it.")
        for j, other in enumerate(holes[:k]):
            if _touching(hole, other) or inside(hole[:1], [other])[0] or inside(other[:1], [hole])[0]:
                raise ValueError(f"holes[{k}]: overlaps or touches holes[{j}]. Merge them into one hole.")


def inside(points: np.ndarray, loops: Sequence[np.ndarray]) -> np.ndarray:
    """True for points (p, 2) inside an odd number of loops (even-odd rule), (p,)."""
    result = np.zeros(len(points), bool)
    x, y = points.T
    for loop in loops:
        for (x0, y0), (x1, y1) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            result ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return result


def along(points: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Arc length (p,) from the first vertex of a loop to where it comes nearest to points (p, 2)."""
    sides = np.roll(loop, -1, axis=0) - loop
    offset = points[:, None] - loop
    fraction = np.clip((offset * sides).sum(-1) / (sides**2).sum(-1), 0.0, 1.0)
    nearest = np.argmin(np.linalg.norm(offset - fraction[..., None] * sides, axis=-1), axis=1)
    length = np.linalg.norm(sides, axis=1)
    return np.cumsum(length)[nearest] - (1 - fraction[np.arange(len(points)), nearest]) * length[nearest]


def distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance (p, s) of points (p, 2) from segments given by `start` and `end` (s, 2)."""
    along = end - start
    offset = points[:, None] - start
    fraction = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - fraction[..., None] * along, axis=-1)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _meeting(first: np.ndarray, second: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Pairs (p, 2) of a side of one loop and a side of another that cross or come within `tolerance` of each other, in
    order, some at a time: only sides whose boxes do are looked at, and never all with all at once."""
    a, b, c, d = first, np.roll(first, -1, axis=0), second, np.roll(second, -1, axis=0)
    low, high = np.minimum(a, b) - tolerance, np.maximum(a, b) + tolerance
    other_low, other_high = np.minimum(c, d), np.maximum(c, d)
    rows = max(1, _PAIRS // len(second))
    for start in range(0, len(first), rows):
        block = slice(start, start + rows)
        near = ((low[block, None] <= other_high) & (other_low <= high[block, None])).all(axis=-1)
        one, other = np.nonzero(near)
        one += start
        yield np.column_stack([one, other])[_meet(a[one], b[one], c[other], d[other], tolerance)]


def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether each segment from a to b crosses or comes within `tolerance` of that from c to d, all (p, 2)."""
    crosses = (_turn(a, b, c) * _turn(a, b, d) < 0) & (_turn(c, d, a) * _turn(c, d, b) < 0)
    near = (_apart(a, c, d) <= tolerance) | (_apart(b, c, d) <= tolerance)
    return crosses | near | (_apart(c, a, b) <= tolerance) | (_apart(d, a, b) <= tolerance)


def _apart(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance (p,) of each of points (p, 2) from its own segment."""
    along, offset = end - start, points - start
    fraction = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - fraction[:, None] * along, axis=-1)


def _first_crossing(loop: np.ndarray) -> tuple[int, int] | None:
    count = len(loop)
    for pairs in _meeting(loop, loop, 1e-9 * np.ptp(loop, axis=0).max()):
        apart = np.abs(pairs[:, 0] - pairs[:, 1])
        others = pairs[(apart > 1) & (apart < count - 1)]
        if len(others):
            return int(others[0].min()), int(others[0].max())
    # Neighbouring sides share a vertex and can only meet elsewhere by folding back onto each other.
    before, after = np.roll(loop, 1, axis=0) - loop, np.roll(loop, -1, axis=0) - loop
    cosine = (before * after).sum(1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1))
    folded = np.flatnonzero(cosine > 1 - 1e-12)
    if folded.size:
        vertex = int(folded[0])
        return (vertex - 1) % count, vertex
    return None


def _touching(first: np.ndarray, second: np.ndarray) -> bool:
    return any(len(pairs) for pairs in _meeting(first, second, 1e-9 * np.ptp(second, axis=0).max()))
