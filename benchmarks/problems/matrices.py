"""Finite-element matrices with newly assembled values, as plain arrays, for the comparison of solvers alone."""

from __future__ import annotations

import numpy as np

NUM_RIGHT_HAND_SIDES = 16
# Number of matrices in a batch, for less (MANY) and more (FEW) than SMALL nodes.
MANY, FEW, SMALL = 64, 16, 3000


def meshes(disks: tuple[int, ...], solids: bool = True):
    """jeit's meshes by name: disks of about `disks` nodes, and, if `solids`, a box (9,922 nodes) and a layer (14,885
    nodes)."""
    from jeit.mesh import box, disk, layer

    found = {f"disk {count}": disk(1.0, num_points=count) for count in disks}
    if solids:
        found["box"] = box(1.0, 1.0, 1.0, num_points=10_000)
        found["layer"] = layer(disk(1.0, num_points=3000), 0.1, 4)
    return found


def make(mesh) -> dict[str, np.ndarray]:
    """Stiffness matrices for random conductivities from 0.1 to 10, with a resistive layer all over the boundary.

    Returns `rows` and `columns` (nonzeros,) of the lower triangle, `values` (matrices, nonzeros), right-hand sides
    `load` (nodes, 16), and the mesh.
    """
    import jax
    import jax.numpy as jnp

    from jeit.mesh import gradients, measures
    from jeit_solvers import SparsityPattern

    pattern = SparsityPattern.from_elements([mesh.cells, mesh.facets], mesh.num_points)
    slopes, size, nodes = gradients(mesh), measures(mesh), mesh.facets.shape[1]
    boundary = (jnp.ones((len(mesh.facets), nodes, nodes)) + jnp.eye(nodes)) / len(mesh.facets)

    @jax.jit
    def assemble(key):
        conductivity = 10.0 ** jax.random.uniform(key, (mesh.num_cells,), minval=-1.0, maxval=1.0)
        stiffness = jnp.einsum("mid,mjd,m->mij", slopes, slopes, size * conductivity)
        return pattern.assemble(stiffness, boundary)

    keys = jax.random.split(jax.random.key(1), MANY if mesh.num_points < SMALL else FEW)
    load = jax.random.normal(jax.random.key(0), (mesh.num_points, NUM_RIGHT_HAND_SIDES))
    return {
        "points": np.asarray(mesh.points),
        "cells": np.asarray(mesh.cells),
        "facets": np.asarray(mesh.facets),
        "rows": np.asarray(pattern.rows),
        "columns": np.asarray(pattern.columns),
        "values": np.stack([assemble(key) for key in keys]),
        "load": np.asarray(load),
    }


def symmetric(problem: dict[str, np.ndarray], number: int):
    """The matrix `number` of a problem, with both triangles, in SciPy's compressed-column format (nodes, nodes)."""
    from scipy.sparse import coo_array

    rows, columns, values = problem["rows"], problem["columns"], problem["values"][number]
    below = rows != columns
    entries = np.concatenate([values, values[below]])
    places = np.concatenate([rows, columns[below]]), np.concatenate([columns, rows[below]])
    return coo_array((entries, places), shape=2 * (len(problem["load"]),)).tocsc()


def residual(problem: dict[str, np.ndarray], number: int, solution: np.ndarray) -> float:
    """Residual of a solution (nodes, 16) for the matrix `number`, relative to the load, in the Frobenius norm."""
    left = symmetric(problem, number) @ solution - problem["load"]
    return float(np.linalg.norm(left) / np.linalg.norm(problem["load"]))
