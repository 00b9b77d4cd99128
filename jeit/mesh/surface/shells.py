"""`shell`: a skin of some thickness on any surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jeit.mesh._crossings import first_crossing
from jeit.mesh._topology import odd_permutation
from jeit.mesh.generate import unstructured
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import check_length
from jeit.mesh.solids import stacked_cells, stacked_wall
from jeit.mesh.surface.bending import node_normals

_TAGS = ("inner", "outer", "side")
# Number of bisections that find the largest thickness.
_HALVINGS = 40


def shell(
    surface: Mesh,
    thickness: float,
    num_layers: int = 1,
    *,
    outward: bool = True,
    normals: ArrayLike | None = None,
) -> Mesh:
    """A skin of `thickness` metres on a surface in space: prisms along the normals at its nodes, cut into tetrahedra.

    Node k · n + i is node i of the surface, k · thickness / num_layers away from it: `outward`, or inward where that is
    False. Tags: 'inner', 'outer' and, unless the surface is closed, 'side', and those of the surface as parts of the
    side. `normals` (n, 3): unit vectors at the nodes, where they are known better than `jeit.mesh.node_normals` finds
    them.

    Raises `ValueError` for a mesh that is no surface in space, a thickness that is not positive, no layers, a shell so
    thick that prisms turn inside out, as they do beyond the radius of curvature (the message says where, and how thick
    it can be), and one that grows into itself.
    """
    if not surface.is_surface:
        raise ValueError("surface: a shell is made on a surface in space; on a flat mesh it is jeit.mesh.layer.")
    thickness = check_length("thickness", thickness)
    num_layers = unstructured.check_count("num_layers", num_layers, 1)
    points, cells, facets = (np.asarray(array) for array in (surface.points, surface.cells, surface.facets))
    count = len(points)
    unstructured.check_total(count * (num_layers + 1), "num_layers")
    away = node_normals(surface) if normals is None else _checked(normals, count)
    away = away if outward else -away
    solid = stacked_cells(cells, count, num_layers)
    # Corners were sorted, which turned some prisms; and of three tetrahedra the second counts the other way.
    upright = np.where(odd_permutation(cells) ^ (not outward), -1.0, 1.0)
    turned = np.tile(np.outer(upright, (1, -1, 1)).ravel(), num_layers)

    def stacked(height: float) -> np.ndarray:
        return np.concatenate([points + k * height / num_layers * away for k in range(num_layers + 1)])

    _check_upright(stacked, solid, turned, thickness, len(cells))
    tags: dict[str, ArrayLike] = {"inner": cells, "outer": cells + num_layers * count}
    if not outward:
        tags = {"outer": tags["inner"], "inner": tags["outer"]}
    if len(facets):
        tags["side"] = stacked_wall(facets, count, num_layers)
    for name, index in surface.tags.items():
        if name in _TAGS:
            raise ValueError(f"surface: its tag {name!r} is taken in a shell. Rename it.")
        tags[name] = stacked_wall(facets[np.asarray(index)], count, num_layers)
    mesh = Mesh.create(stacked(thickness), solid, tags=tags)
    _check_apart(mesh, thickness)
    return mesh


def _checked(normals: ArrayLike, count: int) -> np.ndarray:
    away = np.asarray(normals, dtype=float)
    if away.shape != (count, 3) or not np.allclose(np.linalg.norm(away, axis=1), 1, atol=1e-6):
        raise ValueError(f"normals: expected unit vectors at the nodes, shape ({count}, 3), got shape {away.shape}.")
    return away


def _volumes(points: np.ndarray, solid: np.ndarray, turned: np.ndarray) -> np.ndarray:
    edges = points[solid[:, 1:]] - points[solid[:, :1]]
    return turned * np.linalg.det(edges) / 6


def _check_upright(stacked, solid: np.ndarray, turned: np.ndarray, thickness: float, count: int) -> None:
    volume = _volumes(stacked(thickness), solid, turned)
    if volume.min() > 0:
        return
    if thickness > (size := float(np.ptp(stacked(0.0), axis=0).max())):
        raise ValueError(
            f"thickness: {thickness:.4g} m is more than the surface is large, {size:.4g} m. Are both in metres? If the "
            f"thickness is millimetres, give {1e-3 * thickness:.4g}; if the surface came from a file of another unit, "
            "read it with that: jeit.mesh.read(..., scale=1e-3) for millimetres, 0.0254 for inches, 1 for metres."
        )
    low, high = 0.0, thickness
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        upright = _volumes(stacked(middle), solid, turned).min() > 0
        low, high = (middle, high) if upright else (low, middle)
    worst = int(np.argmin(_volumes(stacked(high), solid, turned)))
    triangle = worst // 3 % count
    place = stacked(0.0)[solid[worst, 0]].round(6).tolist()
    most = (1 - 5e-4) * low  # in four digits not more than `low`
    raise ValueError(
        f"thickness: {thickness:.4g} m is more than the radius of curvature of the surface at triangle {triangle}, "
        f"near {place} m: the skin turns inside out there. It can be {most:.4g} m thick at most; or let it grow to the "
        "other side, or smooth the surface."
    )


def _check_apart(mesh: Mesh, thickness: float) -> None:
    points, boundary = np.asarray(mesh.points), np.asarray(mesh.facets)
    if (pair := first_crossing(points, boundary)) is not None:
        place = points[boundary[pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"thickness: a skin {thickness:.4g} m thick grows into itself near {place} m, where parts of the surface "
            "lie closer together than that. Make it thinner."
        )
