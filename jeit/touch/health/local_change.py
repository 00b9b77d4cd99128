"""Voltages of a model whose conductivity changes in one region only: dense low-rank updates of one solution.

With the grounded matrix A of stiffness and contact mass, the loads B (`jeit.forward.transfer`) and a change D of the
stiffness between a few nodes t, the Woodbury identity gives Bᵀ(A + D)⁻¹B = BᵀX − X_tᵀ (1 + D G)⁻¹ D X_t, with X = A⁻¹B
and G = A⁻¹ between the nodes t. G is computed once for all nodes of the region; each change then needs the solution of
a system with as many unknowns as it has nodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
from jaxtyping import Float, Int

from jeit.forward import ForwardModel
from jeit.forward.assembly import gradients
from jeit.forward.model import evaluate, solved_system_of
from jeit.forward.transfer import SolvedSystem, centred, electrode_impedance, unit_fields
from jeit.mesh import centroids, measures
from jeit_solvers.engines import on_host

# The greatest number of nodes of a region.
_MOST_NODES = 2500
# The factor by which the radius of a region with too many nodes is reduced.
_LESS = 0.85


class LocalChange:
    """Voltages of a `model` whose conductivity changes within about `radius` metres of a `centre` (2,) only.

    `conductivity` (m,), S/m (2-D: S), before the change; `cells` (c,): the cells of the region, whose conductivity may
    change, as of `voltages`.
    """

    def __init__(
        self, model: ForwardModel, conductivity: Float[np.ndarray, " m"], centre: Float[np.ndarray, " 2"], radius: float
    ):
        self.model = model
        mesh = model.mesh
        away = np.linalg.norm(np.asarray(centroids(mesh))[:, :2] - centre, axis=1)
        corners = np.asarray(mesh.cells)
        while len(nodes := np.unique(corners[away < radius])) > _MOST_NODES:
            radius *= _LESS
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
        """Transfer impedance (L, L), ohms, after conductivity has changed by (c,) or tensors (c, d, d)."""
        return self._impedance(self._solved(change)[1])

    def slopes(
        self, change: Float[np.ndarray, "c ..."], ways: list[Float[np.ndarray, "c ..."]]
    ) -> tuple[Float[np.ndarray, "L L"], list[Float[np.ndarray, "L L"]]]:
        """Transfer impedance after a `change`, and its derivatives (L, L) in directions of conductivity."""
        cells, product, solution = self._solved(change)
        fields: Any = unit_fields(solution, product, self.resistance)[0]  # pyright: ignore[reportArgumentType]
        table = np.zeros((self.solution.shape[0], fields.shape[1]))
        nodes = np.unique(self.corners[cells])
        table[nodes] = fields
        slope = np.einsum("ckd,ckl->dcl", self.gradients[cells], table[self.corners[cells]], optimize=True)
        found = []
        for way in ways:
            part = way[cells] * self.measures[cells].reshape((-1,) + (1,) * (way.ndim - 1))
            turned = np.einsum("cab,bcl->acl", part, slope) if part.ndim == 3 else part[:, None] * slope
            energy = np.tensordot(slope, turned, axes=([0, 1], [0, 1]))
            found.append(-np.asarray(centred(energy)))  # pyright: ignore[reportArgumentType]
        return self._impedance(product), found

    def _solved(self, change: np.ndarray):
        """Solve for a change: the changed cells, Bᵀ(A + D)⁻¹B, and (A + D)⁻¹B at these cells' nodes, in order."""
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
    """Inverse of a sparse symmetric matrix between some nodes: of the Schur complement that eliminates the others."""
    others = np.setdiff1d(np.arange(matrix.shape[0]), nodes)
    left = matrix[nodes][:, nodes].toarray()
    if len(others):
        across = matrix[others][:, nodes]
        edge = np.flatnonzero(np.diff(across.tocsc().indptr))
        across = across[:, edge].toarray()
        factor = scipy.sparse.linalg.splu(matrix[others][:, others].tocsc(), permc_spec="MMD_AT_PLUS_A")
        left[np.ix_(edge, edge)] -= across.T @ factor.solve(across)
    return scipy.linalg.inv(0.5 * (left + left.T))
