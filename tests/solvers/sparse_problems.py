"""Sparse symmetric positive definite systems of many shapes, and their dense equivalents, for tests of solvers."""

import jax
import numpy as np
from scipy.spatial import Delaunay

from jeit_solvers import SparsityPattern


def disk_cells(num_points, seed=0):
    """Points in the unit disk and their Delaunay triangles."""
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(0, 1, num_points)), rng.uniform(0, 2 * np.pi, num_points)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return points, Delaunay(points).simplices


def box_cells(per_side):
    """Points of a slightly disturbed cubic grid and their Delaunay tetrahedra."""
    rng = np.random.default_rng(1)
    axes = np.arange(per_side, dtype=float)
    points = np.stack(np.meshgrid(axes, axes, axes), axis=-1).reshape(-1, 3)
    points += rng.uniform(-0.2, 0.2, points.shape)
    return points, Delaunay(points).simplices


def element_matrices(num_elements, nodes, seed=0):
    """Random graph Laplacians of single elements, plus a little mass: positive definite, like a stiffness matrix."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.2, 2.0, (num_elements, nodes, nodes))
    weights = weights + weights.transpose(0, 2, 1)
    off = weights * (1 - np.eye(nodes))
    return (
        np.einsum("mij,jk->mik", off.sum(axis=2, keepdims=True) * np.eye(nodes), np.eye(nodes))
        - off
        + 0.1 * np.eye(nodes)
    )


def from_cells(points, cells, seed=0):
    pattern = SparsityPattern.from_elements([cells], len(points))
    # In NumPy, because JAX would compile each operation for each problem.
    return pattern, jax.device_put(pattern.assemble(element_matrices(*cells.shape, seed))), points


def dense(pattern, values):
    """The matrix as an array of NumPy, which needs no program for each size."""
    return pattern.to_scipy(values).toarray()


def _from_dense(matrix):
    """As `SparsityPattern.from_matrix`, but assembled in NumPy."""
    rows, columns = np.nonzero(np.tril(matrix))
    pattern = SparsityPattern.from_entries(rows, columns, len(matrix))
    return pattern, jax.device_put(pattern.assemble(matrix[rows, columns])), None


def disk():
    return from_cells(*disk_cells(90))


def disk_without_coordinates():
    pattern, values, _ = disk()
    return pattern, values, None


def box():
    return from_cells(*box_cells(5))


def chain():
    n = 70
    return _from_dense(np.diag(np.full(n, 2.1)) - np.eye(n, k=1) - np.eye(n, k=-1))


def single_node():
    return _from_dense(np.array([[4.0]]))


def diagonal():
    return _from_dense(np.diag(np.arange(1.0, 41.0)))


def disconnected():
    blocks = [dense(*case()[:2]) for case in (chain, small_dense, single_node, chain)]
    n = sum(len(block) for block in blocks)
    whole, start = np.zeros((n, n)), 0
    for block in blocks:
        whole[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return _from_dense(whole)


def arrow():
    n = 80
    matrix = np.diag(np.full(n, 3.0))
    matrix[-1, :-1] = matrix[:-1, -1] = 0.1
    matrix[-1, -1] = 10.0
    return _from_dense(matrix)


def small_dense():
    rng = np.random.default_rng(3)
    square = rng.standard_normal((50, 50))
    return _from_dense(square @ square.T + 10 * np.eye(50))


def large_dense():
    """One front of 300 rows, for the nested block loop of the dense factorisation."""
    rng = np.random.default_rng(4)
    square = rng.standard_normal((300, 300))
    return _from_dense(square @ square.T + 30 * np.eye(300))


PROBLEMS = (
    disk,
    disk_without_coordinates,
    box,
    chain,
    single_node,
    diagonal,
    disconnected,
    arrow,
    small_dense,
    large_dense,
)
