"""A flat mesh made finer where something thin has to be told: triangles halved across their longest edge.

Rivara's closure: a triangle of which any edge is halved has its longest halved too, so that no triangle gets thinner
than half of what it was, and no node hangs.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from jeit.electrodes import BoundaryElectrodes, NodeElectrodes, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Mesh, centroids, check_flat, measures
from jeit.mesh.sizes import size_checked

# Halvings of a cell at most.
_ROUNDS = 12
# Electrodes that another mesh of the same skin, with more nodes, takes as they are.
_FREE = (BoundaryElectrodes, SheetDiscs, PointElectrodes, NodeElectrodes)


def finer_model(
    model: ForwardModel, centre: np.ndarray, radius: float, edge: float
) -> tuple[ForwardModel, Int[np.ndarray, " m"], float]:
    """A model of a skin with edges of `edge` metres within `radius` metres of a `centre` (2,); of each of its cells
    (m,), the number of that which it is a part of; and the length of its edges there, metres.

    A layer, and a skin whose electrodes are facets of its mesh, stays as it is.
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
    """A flat mesh whose cells within `radius` metres of a `centre` (2,) are no larger than `area`, m²; and of each
    cell (m,), the number of that which it is a part of."""
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
    """Points, cells and parents after those that are `large`, and what hangs on them, are halved."""
    pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    number = number.reshape(-1, 3)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # Of two edges of one length, both sides must take the same.
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
