"""Refine a flat mesh locally, to resolve thin structures: triangles are halved across their longest edge.

Rivara's closure: a triangle with any halved edge has its longest edge halved too, so that no triangle gets thinner than
half of what it was, and there are no hanging nodes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from jeit.electrodes import BoundaryElectrodes, NodeElectrodes, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Mesh, centroids, check_flat, measures
from jeit.mesh.sizes import size_checked

# The greatest number of times that a cell is halved.
_ROUNDS = 12
# Electrodes that can be used unchanged with another mesh of the same skin with more nodes.
_FREE = (BoundaryElectrodes, SheetDiscs, PointElectrodes, NodeElectrodes)


def finer_model(
    model: ForwardModel, centre: np.ndarray, radius: float, edge: float
) -> tuple[ForwardModel, Int[np.ndarray, " m"], float]:
    """Refine a model's mesh to edges of `edge` metres within `radius` metres of a `centre` (2,).

    Returns the model; for each of its cells (m,), the number of the original cell that it is part of; and the length of
    its edges there, metres. A layer, and a skin whose electrodes are facets of its mesh, stay as they are.
    """
    mesh = model.mesh
    check_flat(mesh, "cuts")
    if mesh.dimension == 2 and isinstance(model.electrodes, _FREE):
        finer, parent = finer_mesh(mesh, centre, radius, 0.5 * edge**2)
        return ForwardModel(finer, model.electrodes, model.protocol), parent, edge
    extent = np.ptp(np.asarray(mesh.points), axis=0)
    if mesh.dimension == 2:
        edge = float(np.sqrt(2 * np.mean(np.asarray(measures(mesh)))))
    else:
        edge = float(np.sqrt(6 * extent[0] * extent[1] / mesh.num_cells))
    return model, np.arange(mesh.num_cells), edge


@size_checked()
def finer_mesh(mesh: Mesh, centre: np.ndarray, radius: float, area: float) -> tuple[Mesh, Int[np.ndarray, " m"]]:
    """Refine a flat mesh so that cells within `radius` metres of a `centre` (2,) are no larger than `area`, m².

    Returns the mesh; and for each cell (m,), the number of the original cell that it is part of.
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    parent = np.arange(len(cells))
    for _ in range(_ROUNDS):
        made = Mesh.create(points, cells)
        near = np.linalg.norm(np.asarray(centroids(made)) - centre, axis=1) < radius
        large = near & (np.asarray(measures(made)) > area)
        if not large.any():
            break
        points, cells, parent = _halved(points, cells, parent, large)
    return Mesh.create(points, cells), parent


def _halved(points: np.ndarray, cells: np.ndarray, parent: np.ndarray, large: Bool[np.ndarray, " m"]):
    """Halve the `large` cells, and those needed to leave no hanging nodes; returns points, cells and parents."""
    pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    number = number.reshape(-1, 3)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # Of two edges of equal length, both neighbours must choose the same.
    lengths = lengths * (1 + 1e-9 * np.arange(len(lengths)) / len(lengths))
    longest = number[np.arange(len(cells)), lengths[number].argmax(axis=1)]
    split = np.zeros(len(edges), bool)
    split[longest[large]] = True
    while True:
        hanging = split[number].any(axis=1) & ~split[longest]
        if not hanging.any():
            break
        split[longest[hanging]] = True
    middle = np.full(len(edges), -1)
    middle[split] = len(points) + np.arange(split.sum())
    points = np.concatenate([points, points[edges[split]].mean(axis=1)])
    # The longest edge first in each cell, then the halves by their own edge.
    place = lengths[number].argmax(axis=1)
    rows = np.arange(len(cells))[:, None]
    turned, own = cells[rows, (place[:, None] + np.arange(3)) % 3], number[rows, (place[:, None] + np.arange(3)) % 3]
    kept = ~split[longest]
    a, b, c = turned[~kept].T
    new, whose = middle[own[~kept]], parent[~kept]
    made, of = [turned[kept]], [parent[kept]]
    for corner, other, across in ((b, c, new[:, 1]), (c, a, new[:, 2])):
        # A half is (corner, other, middle of the longest); its edge from corner to other may be halved again.
        halved = across >= 0
        top = new[:, 0]
        made += [
            np.column_stack([corner, other, top])[~halved],
            np.column_stack([corner, across, top])[halved],
            np.column_stack([across, other, top])[halved],
        ]
        of += [whose[~halved], whose[halved], whose[halved]]
    return points, np.concatenate(made), np.concatenate(of)
