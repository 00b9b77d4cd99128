"""Local change of conductivity: cells near a line that lose conductivity, on a mesh that is finer there.

To refine a flat mesh locally, triangles are halved across their longest edge. Rivara's closure: a triangle with any
halved edge has its longest edge halved too, so that no triangle becomes thinner than half of what it was, and there are
no hanging nodes.

If the conductivity changes in one region only, voltages are computed by dense low-rank updates of one solution. With
the grounded matrix A of stiffness and contact mass, the loads B (`jeit.forward.transfer`) and a change D of the
stiffness between a few nodes t, the Woodbury identity gives Bᵀ(A + D)⁻¹B = BᵀX − X_tᵀ (1 + D G)⁻¹ D X_t, where X =
A⁻¹B, and G is A⁻¹ between the nodes t. G is computed once for all nodes of the region. The
voltages for any change then follow from a dense system with one unknown for each node t that the change touches.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
from jaxtyping import Bool, Float, Int

from jeit.electrodes import BoundaryElectrodes, NodeElectrodes, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.forward.model import evaluate, solved_system_of
from jeit.forward.system import gradients
from jeit.forward.transfer import SolvedSystem, centred, electrode_impedance, unit_fields
from jeit.mesh import Mesh, centroids, check_flat, measures
from jeit.mesh.checks import size_checked
from jeit_solvers.engines import on_host

# Maximum number of times that a cell is halved.
_ROUNDS = 12
# Electrodes that remain valid if the mesh of the skin gets more nodes.
_MESH_INDEPENDENT = (BoundaryElectrodes, SheetDiscs, PointElectrodes, NodeElectrodes)


def finer_model(
    model: ForwardModel, centre: np.ndarray, radius: float, edge: float
) -> tuple[ForwardModel, Int[np.ndarray, " m"], float]:
    """Refine a model's mesh to edges of `edge` metres within `radius` metres of a `centre` (2,).

    Returns the model; the number of the original cell that contains each of its cells (m,); and the length of the edges
    in the refined region, metres. Three-dimensional meshes, and meshes whose facets form the electrodes, are not
    refined.
    """
    mesh = model.mesh
    check_flat(mesh, "cuts")
    if mesh.dimension == 2 and isinstance(model.electrodes, _MESH_INDEPENDENT):
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

    Returns the mesh, and the number of the original cell that contains each of its cells (m,).
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    parent = np.arange(len(cells))
    for _ in range(_ROUNDS):
        made = Mesh.create(points, cells)
        near = np.linalg.norm(np.asarray(centroids(made)) - centre, axis=1) < radius
        large = near & (np.asarray(measures(made)) > area)
        if not large.any():
            break
        points, cells, parent = _halve(points, cells, parent, large)
    return Mesh.create(points, cells), parent


def _halve(points: np.ndarray, cells: np.ndarray, parent: np.ndarray, large: Bool[np.ndarray, " m"]):
    """Halve the `large` cells, and others as needed to avoid hanging nodes; returns points, cells and parents."""
    pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    number = number.reshape(-1, 3)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # If two edges of a cell are equally long, both neighbours must choose the same one.
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
    # Turn each cell so that its longest edge comes first, then halve it.
    place = lengths[number].argmax(axis=1)
    rows = np.arange(len(cells))[:, None]
    turned, own = cells[rows, (place[:, None] + np.arange(3)) % 3], number[rows, (place[:, None] + np.arange(3)) % 3]
    kept = ~split[longest]
    a, b, c = turned[~kept].T
    new, whose = middle[own[~kept]], parent[~kept]
    made, of = [turned[kept]], [parent[kept]]
    for corner, other, across in ((b, c, new[:, 1]), (c, a, new[:, 2])):
        # A half is the triangle (corner, other, middle of the longest edge); its edge from corner to other may be
        # halved too.
        halved = across >= 0
        top = new[:, 0]
        made += [
            np.column_stack([corner, other, top])[~halved],
            np.column_stack([corner, across, top])[halved],
            np.column_stack([across, other, top])[halved],
        ]
        of += [whose[~halved], whose[halved], whose[halved]]
    return points, np.concatenate(made), np.concatenate(of)


# Maximum number of nodes of a region.
_MOST_NODES = 2500
# Factor by which the radius of a region with too many nodes is reduced.
_SHRINKAGE = 0.85


class LocalChange:
    """Voltages of a `model` whose conductivity changes only within about `radius` metres of a `centre` (2,).

    `conductivity` (m,): before the change, S/m (2-D: S). The attribute `cells` (c,) holds the numbers of the cells in
    the region, whose conductivity may change.
    """

    def __init__(
        self, model: ForwardModel, conductivity: Float[np.ndarray, " m"], centre: Float[np.ndarray, " 2"], radius: float
    ):
        self.model = model
        mesh = model.mesh
        away = np.linalg.norm(np.asarray(centroids(mesh))[:, :2] - centre, axis=1)
        corners = np.asarray(mesh.cells)
        while len(nodes := np.unique(corners[away < radius])) > _MOST_NODES:
            radius *= _SHRINKAGE
        self.radius = radius
        self.cells: Int[np.ndarray, " c"] = np.flatnonzero(away < radius)
        place = np.full(mesh.num_points, -1)
        place[nodes] = np.arange(len(nodes))
        self.corners = place[corners[self.cells]]
        self.gradients = np.asarray(gradients(mesh))[self.cells]  # (c, k, d)
        self.measures = np.asarray(measures(mesh))[self.cells]
        self.centres = np.asarray(centroids(mesh))[self.cells][:, :2]
        solved: SolvedSystem = on_host(evaluate(model, solved_system_of, conductivity))
        self.at_rest, self.resistance = solved.product, solved.resistance
        self.solution = np.asarray(solved.solution)[nodes]
        matrix = solved.operator.pattern.to_scipy(solved.operator.values).tocsr()
        self.inverse = _inverse_between(matrix, nodes)

    def impedance(self, change: Float[np.ndarray, "c ..."]) -> Float[np.ndarray, "L L"]:
        """Transfer impedance (L, L), ohms, after a change of conductivity: scalars (c,) or tensors (c, d, d)."""
        return self._impedance(self._solve_change(change)[1])

    def derivatives(
        self, change: Float[np.ndarray, "c ..."], directions: list[Float[np.ndarray, "c ..."]]
    ) -> tuple[Float[np.ndarray, "L L"], list[Float[np.ndarray, "L L"]]]:
        """Transfer impedance (L, L), ohms, after a `change` of conductivity, and its derivatives (L, L) in the
        directions `directions`."""
        cells, product, solution = self._solve_change(change)
        fields: Any = unit_fields(solution, product, self.resistance)[0]  # pyright: ignore[reportArgumentType]
        table = np.zeros((self.solution.shape[0], fields.shape[1]))
        nodes = np.unique(self.corners[cells])
        table[nodes] = fields
        slope = np.einsum("ckd,ckl->dcl", self.gradients[cells], table[self.corners[cells]], optimize=True)
        found = []
        for way in directions:
            part = way[cells] * self.measures[cells].reshape((-1,) + (1,) * (way.ndim - 1))
            turned = np.einsum("cab,bcl->acl", part, slope) if part.ndim == 3 else part[:, None] * slope
            energy = np.tensordot(slope, turned, axes=([0, 1], [0, 1]))
            found.append(-np.asarray(centred(energy)))  # pyright: ignore[reportArgumentType]
        return self._impedance(product), found

    def _solve_change(self, change: np.ndarray):
        """Solve for a change; returns the changed cells, Bᵀ(A + D)⁻¹B, and (A + D)⁻¹B at the nodes of these cells, in
        order."""
        size = np.abs(change).reshape(len(change), -1).max(axis=1)
        cells = np.flatnonzero(size > 0)
        if not len(cells):
            return cells, np.asarray(self.at_rest), np.zeros((0, len(self.at_rest)))
        nodes, corners = np.unique(self.corners[cells], return_inverse=True)
        corners = corners.reshape(len(cells), -1)
        slope = self.gradients[cells]
        part = change[cells] * self.measures[cells].reshape((-1,) + (1,) * (change.ndim - 1))
        turned = np.einsum("cka,cab->ckb", slope, part) if part.ndim == 3 else slope * part[:, None, None]
        each = turned @ np.swapaxes(slope, 1, 2)
        stiffness = np.zeros((len(nodes), len(nodes)))
        np.add.at(stiffness, (corners[:, :, None], corners[:, None, :]), each)
        before = self.solution[nodes]
        now = np.linalg.solve(np.eye(len(nodes)) + self.inverse[np.ix_(nodes, nodes)] @ stiffness, before)
        product = self.at_rest - before.T @ (stiffness @ now)
        return cells, product, now

    def _impedance(self, product: Any) -> Float[np.ndarray, "L L"]:
        return np.asarray(electrode_impedance(product, self.resistance).transfer)


def _inverse_between(matrix, nodes: Int[np.ndarray, " t"]) -> Float[np.ndarray, "t t"]:
    """Inverse of a sparse symmetric matrix between some nodes: inverse of the Schur complement without the others."""
    others = np.setdiff1d(np.arange(matrix.shape[0]), nodes)
    left = matrix[nodes][:, nodes].toarray()
    if len(others):
        across = matrix[others][:, nodes]
        edge = np.flatnonzero(np.diff(across.tocsc().indptr))
        across = across[:, edge].toarray()
        factor = scipy.sparse.linalg.splu(matrix[others][:, others].tocsc(), permc_spec="MMD_AT_PLUS_A")
        left[np.ix_(edge, edge)] -= across.T @ factor.solve(across)
    return scipy.linalg.inv(0.5 * (left + left.T))
