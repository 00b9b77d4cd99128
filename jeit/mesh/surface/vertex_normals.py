"""Normals of a surface at its nodes, where its triangles do not agree on one."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array

from jeit.mesh.geometry import normals
from jeit.mesh.mesh import Mesh

# Where triangles at a node are turned against each other by more, there is an edge, and nothing to be smoothed.
_CREASE = np.cos(np.radians(50.0))
# Of the coefficients of a quadratic form that are fitted to neighbours, and how well it must be told by them.
_TERMS, _LEAST = 5, 1e-6


def node_normals(mesh: Mesh) -> np.ndarray:
    """Unit normals (n, 3) at the nodes of a surface in space.

    That of a quadratic surface through the neighbours of each node and theirs, to the second order of the cell size on
    a smooth surface, up to its edge; at creases, and where neighbours are few, the mean of the triangles' normals
    weighted with their angles. NumPy; not differentiated. Raises `ValueError` for a solid.
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    facing = np.asarray(normals(mesh))
    if not mesh.is_surface:
        return np.broadcast_to(facing[:1], (mesh.num_points, 3)).copy()
    corners = points[cells]
    before, after = np.roll(corners, 1, axis=1) - corners, np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
    angle = np.arccos(np.clip((before * after).sum(axis=2) / lengths, -1, 1))
    mean = np.zeros_like(points)
    np.add.at(mean, cells, angle[..., None] * facing[:, None])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    least = np.ones(len(points))
    np.minimum.at(least, cells, (mean[cells] * facing[:, None]).sum(axis=2))
    slope, told = _slopes(points, cells, mean)
    smooth = (least > _CREASE) & told
    fitted = mean - np.where(smooth[:, None], slope, 0)
    return fitted / np.linalg.norm(fitted, axis=1, keepdims=True)


def _slopes(points: np.ndarray, cells: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (n, 3) at each node of a quadratic surface through its neighbours and theirs, as a height over the plane
    across `normal`; and whether there are enough of them."""
    count = len(points)
    pairs = np.concatenate([cells[:, [a, b]] for a in range(3) for b in range(3)])
    near = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)).tocsr()
    within_two = coo_array(near @ near)
    one, other = within_two.row, within_two.col
    apart = one != other
    one, other = one[apart], other[apart]
    helper = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normal, across), normal], axis=1)  # (n, 3, 3)
    offset = np.einsum("pij,pj->pi", axes[one], points[other] - points[one])
    scale = np.sqrt(np.bincount(one, (offset**2).sum(axis=1), count) / np.bincount(one, minlength=count))
    u, v, height = (offset / scale[one][:, None]).T
    terms = np.stack([u, v, u * u / 2, u * v, v * v / 2], axis=1)
    matrix, right = np.zeros((count, _TERMS, _TERMS)), np.zeros((count, _TERMS))
    for k in range(_TERMS):
        right[:, k] = np.bincount(one, terms[:, k] * height, count)
        for j in range(_TERMS):
            matrix[:, k, j] = np.bincount(one, terms[:, k] * terms[:, j], count)
    values = np.linalg.eigvalsh(matrix)
    told = values[:, 0] > _LEAST * values[:, -1]
    matrix[~told] = np.eye(_TERMS)
    found = np.linalg.solve(matrix, right[..., None])[:, :2, 0]
    return np.einsum("ni,nij->nj", found, axes[:, :2]), told
