"""Shape measures of the cells of a mesh."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from jeit.mesh.mesh import Mesh


class Quality(eqx.Module):
    """Shape measures of a mesh, as NumPy arrays with one entry per cell.

    **Fields**: `smallest_angle` (m,) in degrees, the smallest corner of a triangle or the smallest angle between two
    faces of a tetrahedron; `radius_ratio` (m,), d times the radius of the inscribed over that of the circumscribed
    circle or sphere, 1 for a regular cell, 0 for a flat one; `shortest_edge`, `longest_edge` (m,) in metres.
    """

    dimension: int
    num_points: int
    smallest_angle: np.ndarray
    radius_ratio: np.ndarray
    shortest_edge: np.ndarray
    longest_edge: np.ndarray

    def __repr__(self) -> str:
        return (
            f"Quality of {self.num_points} nodes, {len(self.smallest_angle)} cells in {self.dimension}-D: "
            f"smallest angle {self.smallest_angle.min():.1f}° (mean {self.smallest_angle.mean():.1f}°), "
            f"radius ratio {self.radius_ratio.min():.2f} (mean {self.radius_ratio.mean():.2f}), "
            f"edges {self.shortest_edge.min():.3g} to {self.longest_edge.max():.3g} m"
        )


def quality(mesh: Mesh) -> Quality:
    """Measure the shape of every cell of a mesh; see `Quality`."""
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    corners = points[cells]
    first, second = np.triu_indices(mesh.dimension + 1, 1)
    length = np.linalg.norm(corners[:, first] - corners[:, second], axis=2)
    angle, ratio = _triangles(corners) if mesh.dimension == 2 else _tetrahedra(corners)
    return Quality(
        dimension=mesh.dimension,
        num_points=mesh.num_points,
        smallest_angle=angle,
        radius_ratio=ratio,
        shortest_edge=length.min(axis=1),
        longest_edge=length.max(axis=1),
    )


def _triangles(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(edges, axis=2)
    if corners.shape[2] == 2:
        doubled = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    else:
        doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    before = -np.roll(edges, 1, axis=1)
    angle = np.degrees(np.arctan2(doubled[:, None], (edges * before).sum(axis=2))).min(axis=1)
    # r = 2 A / (a + b + c) and R = a b c / (4 A).
    return angle, 2 * (doubled / length.sum(axis=1)) * (2 * doubled / length.prod(axis=1))


def _tetrahedra(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    # Inward normals of the faces opposite nodes 1, 2, 3 and 0, as long as twice the area of the face.
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    normals = np.concatenate([normals, -normals.sum(axis=1, keepdims=True)], axis=1)
    area = np.linalg.norm(normals, axis=2)
    unit = normals / area[..., None]
    first, second = np.triu_indices(4, 1)
    cosine = np.clip(-(unit[:, first] * unit[:, second]).sum(axis=2), -1.0, 1.0)
    angle = np.degrees(np.arccos(cosine)).min(axis=1)
    volume = np.abs((a * normals[:, 0]).sum(axis=1))
    # r = 3 V / ΣA; the centre of the circumscribed sphere is Σ |x_i|² n_i / (2 · 6 V) from node 0.
    squares = np.stack([(a**2).sum(1), (b**2).sum(1), (c**2).sum(1)], axis=1)
    circumradius = np.linalg.norm((squares[..., None] * normals[:, :3]).sum(axis=1), axis=1) / (2 * volume)
    return angle, 3 * (volume / area.sum(axis=1)) / circumradius
