"""Meshes of solids that are refined at given planes, where electrodes end and the current density is unbounded.

Along each axis, cells are smallest at the planes and grow away from them, up to a maximum size that follows from the
number of nodes. A box is graded along x, y and z; a solid above any other outline is graded along z, and its plane mesh
is refined separately.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq

from jeit.mesh.generate.refine import Refine, nodes_of_solid
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Disk, Domain, Rectangle
from jeit.mesh.solids import layer

# Size of the cells at the planes, relative to the largest cells, and growth of the cell size per length.
_FINEST, _GROWTH = 0.05, 0.8
# Planes closer to each other than this, relative to the size of the body, are merged.
_SAME = 1e-4


def graded_box(outline: Rectangle, height: float, planes: Sequence[Float[np.ndarray, " k"]], num_points: int) -> Mesh:
    """Mesh of a box above a rectangle, from z = 0 up, with about `num_points` nodes and with cell faces in the given
    `planes`: positions along x, y and z.

    Tags are those of `jeit.mesh.box`.
    """
    x_min, x_max, y_min, y_max = outline.extent
    ends = [(x_min, x_max), (y_min, y_max), (0.0, height)]
    stops = [_stops(given, low, high) for given, (low, high) in zip(planes, ends, strict=True)]
    most = max(high - low for low, high in ends)
    size = _largest(lambda size: float(np.prod([len(_divide_axis(one, size)) for one in stops])), num_points, most)
    along = [_divide_axis(one, size) for one in stops]
    points = np.stack(np.meshgrid(*along[:2], indexing="ij"), axis=-1).reshape(-1, 2)
    plane = Mesh.create(points, _grid_triangles(len(along[0]), len(along[1])))
    return layer(outline.tagged(plane), height, heights=along[2])


def graded_layers(
    outline: Domain, height: float, planes: Float[np.ndarray, " k"], rims: Float[np.ndarray, "p 2"], num_points: int
) -> Mesh:
    """Mesh of a solid above any outline, with thin layers at the heights `planes` and small cells at `rims`, points (p,
    2) seen from above. Points on the edge of a disk become nodes. Tags are those of `jeit.mesh.layer`."""
    stops = _stops(planes, 0.0, height)
    area = float(outline.area)

    def nodes(size: float) -> float:
        # Because of the refinement at the rims, the mean cell is about a third smaller than the largest.
        return len(_divide_axis(stops, size)) * (1 + 1.1 * area / (0.65 * size) ** 2)

    def levels(number: int) -> Float[np.ndarray, " n"]:
        return _divide_axis(stops, _largest(nodes, number, max(height, np.sqrt(area))))

    heights = levels(num_points)
    refine = Refine(rims, factor=1 / _FINEST, growth=_GROWTH) if len(rims) else None
    number = max(4, round(num_points / len(heights)))
    with nodes_of_solid(num_points, lambda asked: round(asked / len(levels(asked)))):
        if isinstance(outline, Disk) and len(rims):
            offset = rims - np.asarray(outline.centre)
            on_edge = np.abs(np.hypot(*offset.T) - float(outline.radius)) < _SAME * float(outline.radius)
            angles = np.arctan2(offset[on_edge, 1], offset[on_edge, 0])
            plane = outline.mesh(num_points=number, refine=refine, boundary_points=angles if len(angles) else None)
        else:
            plane = outline.mesh(num_points=number, refine=refine)
    return layer(plane, height, heights=heights)


def _stops(planes: Float[np.ndarray, " k"], low: float, high: float) -> Float[np.ndarray, " s"]:
    """Distinct positions of the planes between `low` and `high`, and the two ends."""
    within = np.sort(planes[(planes > low) & (planes < high)])
    kept, least = [low], _SAME * (high - low)
    for one in within:
        if one - kept[-1] > least and high - one > least:
            kept.append(float(one))
    return np.array([*kept, high])


def _divide_axis(stops: Float[np.ndarray, " s"], size: float) -> Float[np.ndarray, " n"]:
    """Positions of nodes along an axis: the stops, and nodes between them at distances that grow away from the stops up
    to `size`."""
    places = [stops[:1]]
    for low, high in pairwise(stops):
        # Number of cells before each of many positions.
        fine = np.linspace(low, high, 400)
        middle = (fine[1:] + fine[:-1]) / 2
        width = np.minimum(size, _FINEST * size + _GROWTH * np.minimum(middle - low, high - middle))
        count = np.concatenate([[0.0], np.cumsum(np.diff(fine) / width)])
        number = max(1, round(count[-1]))
        places.append(np.interp(np.arange(1, number + 1) * (count[-1] / number), count, fine))
        places[-1][-1] = high
    return np.concatenate(places)


def _largest(count: Callable[[float], float], wanted: int, most: float) -> float:
    """Maximum cell size for which the number of nodes is about `wanted`; `most` if even that size gives more nodes."""
    if count(most) >= wanted:
        return most
    found: Any = brentq(lambda size: count(size) - wanted - 0.5, 1e-4 * most, most, xtol=1e-5 * most)
    return float(found)


def _grid_triangles(rows: int, columns: int) -> Int[np.ndarray, "t 3"]:
    """Triangles of a grid of nodes in row-major order: rectangles divided along alternating diagonals."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    b, c, d = a + columns, a + columns + 1, a + 1
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.concatenate([first, second])
