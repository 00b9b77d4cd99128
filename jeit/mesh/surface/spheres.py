"""`sphere`, closed, and `cap`, the part of one about its pole."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from jeit.arguments import describe
from jeit.mesh.generate import unstructured
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.loose_triangles import merged
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import check_length
from jeit.mesh.shapes import disk


def sphere(radius: float, *, num_points: int | None = None, cell_size: float | None = None) -> Mesh:
    """A closed sphere of `radius` metres round the origin.

    Every triangle of an icosahedron is cut into k² and put onto the sphere, which makes 10 k² + 2 nodes: the number
    nearest to `num_points` (1,200 if nothing is said) is taken, or edges of about `cell_size` metres. Raises
    `ValueError` on bad or contradicting arguments.
    """
    radius = check_length("radius", radius)
    target = unstructured.Target.create(num_points, cell_size)
    if target.cell_size is None:
        parts = max(1, round(np.sqrt((target.num_points - 2) / 10)))
    else:
        # 20 k² triangles of the sphere's area, each (√3 / 4) h².
        parts = max(1, round(np.sqrt(4 * np.pi / 20 / (np.sqrt(3) / 4)) * radius / target.cell_size))
    unstructured.check_total(10 * parts**2 + 2, "cell_size")
    corners = _icosahedron()
    faces = corners[ConvexHull(corners).simplices]
    i, j = np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), indexing="ij")
    inside = i + j <= parts
    share = np.stack([parts - i - j, i, j], axis=-1)[inside] / parts
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    up = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:]], axis=-1)
    down = np.stack([number[1:, 1:], number[:-1, 1:], number[1:, :-1]], axis=-1)
    own = np.concatenate([up.reshape(-1, 3), down.reshape(-1, 3)])
    own = own[(own >= 0).all(axis=1)]
    points = np.concatenate([share @ face for face in faces])
    cells = np.concatenate([own + k * len(share) for k in range(len(faces))])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    # Nodes on the icosahedron's edges were made with each of the two faces.
    points, cells = merged(points, cells, 1e-6 / parts)
    return Mesh.create(radius * points, _outward(points, cells))


def cap(
    radius: float,
    angle: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
) -> Mesh:
    """The part of a sphere of `radius` metres round the origin within `angle` radians of its pole, (0, 0, radius).

    A disk's mesh laid over it, with distances from the pole as they are on the disk: round the edge of a hemisphere
    cells are π/2 times narrower than they are long. `num_points`, `cell_size` and `refine` are those of
    `jeit.mesh.disk`, places being (x, y) on the flat disk. Tag: 'edge'. Raises `ValueError` on bad or contradicting
    arguments.
    """
    radius = check_length("radius", radius)
    if not (isinstance(angle, float | int | np.floating) and 0 < angle < 0.95 * np.pi):
        raise ValueError(
            f"angle: expected radians from the pole, more than 0 and less than 2.98, got {describe(angle)}."
        )
    flat = disk(radius * float(angle), num_points=num_points, cell_size=cell_size, refine=refine)
    x, y = np.asarray(flat.points).T
    distance = np.hypot(x, y)
    across = np.sinc(distance / radius / np.pi)  # sin(d / R) / (d / R)
    points = np.stack([x * across, y * across, radius * np.cos(distance / radius)], axis=1)
    return Mesh.create(points, flat.cells, tags={"edge": np.arange(flat.num_facets)})


def _outward(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) round the origin, turned to face away from it."""
    facing = np.linalg.det(points[cells]) > 0
    return np.where(facing[:, None], cells, cells[:, [0, 2, 1]])


def _icosahedron() -> np.ndarray:
    """Corners of an icosahedron (12, 3)."""
    golden = (1 + np.sqrt(5)) / 2
    plane = np.array([[0, a, b * golden] for a in (1, -1) for b in (1, -1)])
    return np.concatenate([np.roll(plane, k, axis=1) for k in range(3)]) / np.hypot(1, golden)
