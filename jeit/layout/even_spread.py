"""Places spread evenly over a surface in space, by ways along it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jeit.layout.arrangements import check_count
from jeit.mesh import Mesh
from jeit.mesh.geodesic import Geodesics, Triangles

# Nodes that each place is to have round it; more are made by halving triangles.
_NODES = 30
# Halved no further than this many nodes.
_MOST = 60_000
# More places than this lie so near each other that ways between them are nearly straight: the nearest is found by
# distance in space, and by the side that it faces.
_BY_WAYS = 128


def spread(
    surface: Triangles | Mesh,
    number: int,
    *,
    face: str | None = None,
    margin: float = 0.0,
    iterations: int = 20,
) -> Float[np.ndarray, "L 3"]:
    """Positions spread evenly over a surface: (L, 3) metres, on it.

    `quasi_uniform` for surfaces: each position is the middle of the part of the surface that is nearer to it than to
    any other by ways along the surface (Lloyd's algorithm, begun from farthest points). `face`: of a shell, "inner" or
    "outer". `margin`: least distance from the edge, metres. Deterministic. Raises `ValueError` for fewer than one, a
    margin that leaves no room, and as `Triangles.of` does.
    """
    check_count(number, 1)
    triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
    while len(triangles.points) < min(_NODES * number, _MOST):
        triangles = triangles.finer()
    weight = triangles.node_areas * (triangles.distance_to_border(triangles.points) >= margin)
    usable = np.flatnonzero(weight > 0)
    if len(usable) < number:
        raise ValueError(f"margin: {1e3 * margin:g} mm leaves no room for {number} electrodes on the surface.")
    ways = Geodesics.create(triangles)
    position = triangles.points[_begin(ways, usable, weight, number)]
    for _ in range(iterations):
        owner = (ways.owners(position)[0] if number <= _BY_WAYS else _nearest(triangles, position))[usable]
        own = np.bincount(owner, weight[usable], number)
        middle = np.stack([np.bincount(owner, weight[usable] * x, number) for x in triangles.points[usable].T], axis=1)
        moved = np.where(own[:, None] > 0, middle / np.maximum(own, 1e-300)[:, None], position)
        moved = triangles.nearest(moved).points
        settled = np.linalg.norm(moved - position, axis=1).max() < 1e-3 * np.sqrt(weight.sum() / number)
        position = moved
        if settled:
            break
    return position


def _nearest(triangles: Triangles, position: Float[np.ndarray, "L 3"]) -> np.ndarray:
    """Nearest position of each node, by distance in space and by the side that they face."""
    half = 0.5 * np.sqrt(triangles.areas.sum() / len(position))
    facing = half * triangles.normals[triangles.nearest(position).triangle]
    tree = KDTree(np.hstack([position, facing]))
    return np.asarray(tree.query(np.hstack([triangles.points, half * triangles.node_normals]))[1])


def _begin(ways: Geodesics, usable: np.ndarray, weight: np.ndarray, number: int) -> np.ndarray:
    """Nodes to begin with."""
    if number > _BY_WAYS:
        share = weight[usable] / weight.sum()
        return np.random.default_rng(0).choice(usable, number, replace=False, p=share)
    points = ways.surface.points
    # Farthest from the middle: a way to begin that depends on nothing but the surface.
    middle = np.average(points[usable], axis=0, weights=weight[usable])
    chosen = [usable[np.linalg.norm(points[usable] - middle, axis=1).round(9).argmax()]]
    lengths = ways.distances(points[chosen[:1]])[0]
    while len(chosen) < number:
        chosen.append(usable[lengths[usable].argmax()])
        farthest = float(lengths[usable].max())
        lengths = np.minimum(lengths, ways.distances(points[chosen[-1:]], limit=farthest)[0])
    return np.array(chosen)
