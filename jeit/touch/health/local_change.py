"""Voltages after a local change of conductivity, computed by low-rank updates on a locally refined mesh.

To refine a flat mesh locally, triangles are halved across their longest edge. By Rivara's closure, the longest edge of
every triangle with a halved edge is halved too. As a result, there are no hanging nodes, and no triangle becomes
thinner than half of the original triangle.

If the conductivity changes in one region only, voltages are computed by dense low-rank updates of the solution before
the change. With the grounded matrix A of stiffness and contact mass, the loads B (`jeit.forward.transfer`) and a change
D of the stiffness between a few nodes t, the Woodbury identity gives Bᵀ(A + D)⁻¹B = BᵀX − X_tᵀ (1 + D G)⁻¹ D X_t, where
X = A⁻¹B, and G is A⁻¹ between the nodes t. G is computed once for all nodes of the region. The voltages for any change
then follow from a dense system with one unknown for each node t of the changed cells.
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

# Maximum number of times that a cell of the mesh is halved.
_MAX_HALVINGS_OF_CELL = 12
# Classes of electrodes that remain valid if the mesh of the skin is refined.
_MESH_INDEPENDENT = (BoundaryElectrodes, SheetDiscs, PointElectrodes, NodeElectrodes)


def finer_model(
    model: ForwardModel, centre: np.ndarray, radius: float, edge: float
) -> tuple[ForwardModel, Int[np.ndarray, " m"], float]:
    """Refine a model's mesh to edges of `edge` metres within `radius` metres of a `centre` (x, y).

    Returns the refined model; the index of the original cell that contains each refined cell; and the length of the
    edges in the refined region, metres. Three-dimensional meshes, and meshes whose facets form the electrodes, are not
    refined.
    """
    mesh = model.mesh
    check_flat(mesh, "cuts")
    if mesh.dimension == 2 and isinstance(model.electrodes, _MESH_INDEPENDENT):
        refined_mesh, parent_cells = finer_mesh(mesh, centre, radius, 0.5 * edge**2)
        return ForwardModel(refined_mesh, model.electrodes, model.protocol), parent_cells, edge
    bounding_box_sides = np.ptp(np.asarray(mesh.points), axis=0)
    if mesh.dimension == 2:
        edge = float(np.sqrt(2 * np.mean(np.asarray(measures(mesh)))))
    else:
        edge = float(np.sqrt(6 * bounding_box_sides[0] * bounding_box_sides[1] / mesh.num_cells))
    return model, np.arange(mesh.num_cells), edge


@size_checked()
def finer_mesh(mesh: Mesh, centre: np.ndarray, radius: float, area: float) -> tuple[Mesh, Int[np.ndarray, " m"]]:
    """Refine a flat mesh so that cells within `radius` metres of a `centre` (x, y) are no larger than `area`, m².

    Returns the refined mesh, and the index of the original cell that contains each refined cell.
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    parent_cells = np.arange(len(cells))
    for _ in range(_MAX_HALVINGS_OF_CELL):
        refined_mesh = Mesh.create(points, cells)
        is_near = np.linalg.norm(np.asarray(centroids(refined_mesh)) - centre, axis=1) < radius
        is_large = is_near & (np.asarray(measures(refined_mesh)) > area)
        if not is_large.any():
            break
        points, cells, parent_cells = _halve_cells(points, cells, parent_cells, is_large)
    return Mesh.create(points, cells), parent_cells


def _halve_cells(points: np.ndarray, cells: np.ndarray, parent_cells: np.ndarray, is_large: Bool[np.ndarray, " m"]):
    """Halve the cells that `is_large` marks, and further cells as needed to avoid hanging nodes. Returns the points,
    the cells, and the index of each cell's original cell."""
    node_pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).astype(np.int64)
    pair_numbers = node_pairs[..., 0] * len(points) + node_pairs[..., 1]  # numbers are sorted faster than rows
    edges, edge_numbers = np.unique(pair_numbers, return_inverse=True)
    edges, edge_numbers = np.column_stack(np.divmod(edges, len(points))), edge_numbers.reshape(-1, 3)
    edge_lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # If two edges of a cell are equally long, all cells must choose the same edge as the longest.
    edge_lengths = edge_lengths * (1 + 1e-9 * np.arange(len(edge_lengths)) / len(edge_lengths))
    longest_edges = edge_numbers[np.arange(len(cells)), edge_lengths[edge_numbers].argmax(axis=1)]
    is_split = np.zeros(len(edges), bool)
    is_split[longest_edges[is_large]] = True
    while True:
        has_hanging_node = is_split[edge_numbers].any(axis=1) & ~is_split[longest_edges]
        if not has_hanging_node.any():
            break
        is_split[longest_edges[has_hanging_node]] = True
    midpoint_nodes = np.full(len(edges), -1)
    midpoint_nodes[is_split] = len(points) + np.arange(is_split.sum())
    points = np.concatenate([points, points[edges[is_split]].mean(axis=1)])
    # Turn each cell so that its longest edge comes first, then halve it.
    longest_positions = edge_lengths[edge_numbers].argmax(axis=1)
    rows = np.arange(len(cells))[:, None]
    rotated_cells, rotated_edges = (
        cells[rows, (longest_positions[:, None] + np.arange(3)) % 3],
        edge_numbers[rows, (longest_positions[:, None] + np.arange(3)) % 3],
    )
    is_unchanged = ~is_split[longest_edges]
    first_node, second_node, third_node = rotated_cells[~is_unchanged].T
    new_nodes, parents_of_halved = midpoint_nodes[rotated_edges[~is_unchanged]], parent_cells[~is_unchanged]
    new_cells, new_parents = [rotated_cells[is_unchanged]], [parent_cells[is_unchanged]]
    half_triangles = ((second_node, third_node, new_nodes[:, 1]), (third_node, first_node, new_nodes[:, 2]))
    for corner, opposite_corner, edge_midpoint in half_triangles:
        # Half of a cell is the triangle (corner, opposite, midpoint of the longest edge); its edge from corner to
        # opposite may be halved too.
        is_halved_cell = edge_midpoint >= 0
        longest_midpoint = new_nodes[:, 0]
        new_cells += [
            np.column_stack([corner, opposite_corner, longest_midpoint])[~is_halved_cell],
            np.column_stack([corner, edge_midpoint, longest_midpoint])[is_halved_cell],
            np.column_stack([edge_midpoint, opposite_corner, longest_midpoint])[is_halved_cell],
        ]
        new_parents += [
            parents_of_halved[~is_halved_cell],
            parents_of_halved[is_halved_cell],
            parents_of_halved[is_halved_cell],
        ]
    return points, np.concatenate(new_cells), np.concatenate(new_parents)


# Maximum number of mesh nodes of a region of changed conductivity.
_MAX_NUM_NODES = 2500
# Factor by which the radius of a region with too many nodes is reduced.
_SHRINKAGE_FACTOR = 0.85


class LocalChange:
    """Voltages of a `model` whose conductivity changes only within about `radius` metres of a `centre` (x, y).

    `conductivity` (cells,): conductivity before the change, S/m (2-D: S). The attribute `cells` contains the indices of
    the cells in the region, whose conductivity may change.
    """

    def __init__(
        self, model: ForwardModel, conductivity: Float[np.ndarray, " m"], centre: Float[np.ndarray, " 2"], radius: float
    ):
        self.model = model
        mesh = model.mesh
        distances = np.linalg.norm(np.asarray(centroids(mesh))[:, :2] - centre, axis=1)
        corners = np.asarray(mesh.cells)
        while len(nodes := np.unique(corners[distances < radius])) > _MAX_NUM_NODES:
            radius *= _SHRINKAGE_FACTOR
        self.radius = radius
        self.cells: Int[np.ndarray, " c"] = np.flatnonzero(distances < radius)
        region_numbers = np.full(mesh.num_points, -1)
        region_numbers[nodes] = np.arange(len(nodes))
        self.corners = region_numbers[corners[self.cells]]
        self.gradients = np.asarray(gradients(mesh))[self.cells]  # (cells, nodes of a cell, coordinates)
        self.measures = np.asarray(measures(mesh))[self.cells]
        self.centres = np.asarray(centroids(mesh))[self.cells][:, :2]
        solved: SolvedSystem = on_host(evaluate(model, solved_system_of, conductivity))
        self.rest_product, self.resistance = solved.product, solved.resistance
        self.solution = np.asarray(solved.solution)[nodes]
        matrix = solved.operator.pattern.to_scipy(solved.operator.values).tocsr()
        self.inverse = _restricted_inverse(matrix, nodes)
        self._last_solved: tuple[np.ndarray, tuple] | None = None

    def impedance(self, change: Float[np.ndarray, "c ..."]) -> Float[np.ndarray, "L L"]:
        """Compute the transfer impedance matrix (electrodes, electrodes), ohms, after a `change` of the conductivity in
        the region's cells: scalars (cells,) or tensors (cells, d, d) in d dimensions."""
        return self._impedance(self._solve_change(change)[1])

    def derivatives(
        self, change: Float[np.ndarray, "c ..."], directions: list[Float[np.ndarray, "c ..."]]
    ) -> tuple[Float[np.ndarray, "L L"], list[Float[np.ndarray, "L L"]]]:
        """Compute the transfer impedance matrix (electrodes, electrodes), ohms, after a `change` of conductivity in the
        region, and its derivatives along the changes in `directions`."""
        cells, product, solution = self._solve_change(change)
        fields: Any = unit_fields(solution, product, self.resistance)[0]  # pyright: ignore[reportArgumentType]
        nodal_fields = np.zeros((self.solution.shape[0], fields.shape[1]))
        nodes = np.unique(self.corners[cells])
        nodal_fields[nodes] = fields
        field_gradients = np.einsum(
            "ckd,ckl->dcl", self.gradients[cells], nodal_fields[self.corners[cells]], optimize=True
        )
        impedance_derivatives = []
        for direction in directions:
            conductance_changes = direction[cells] * self.measures[cells].reshape((-1,) + (1,) * (direction.ndim - 1))
            current_changes = (
                np.einsum("cab,bcl->acl", conductance_changes, field_gradients)
                if conductance_changes.ndim == 3
                else conductance_changes[:, None] * field_gradients
            )
            energies = np.tensordot(field_gradients, current_changes, axes=([0, 1], [0, 1]))
            impedance_derivatives.append(-np.asarray(centred(energies)))  # pyright: ignore[reportArgumentType]
        return self._impedance(product), impedance_derivatives

    def _solve_change(self, change: np.ndarray):
        """Solve the forward problem after a change of conductivity; returns the indices of the changed cells, Bᵀ(A +
        D)⁻¹B, and (A + D)⁻¹B at the nodes of these cells, with the grounded matrix A, its change D and the loads B.

        The last result is kept: a fit computes the voltages after a change, and then their derivatives."""
        if self._last_solved is None or not np.array_equal(self._last_solved[0], change):
            self._last_solved = change.copy(), self._solve_new_change(change)
        return self._last_solved[1]

    def _solve_new_change(self, change: np.ndarray):
        cells = np.flatnonzero(change.reshape(len(change), -1).any(axis=1))
        if not len(cells):
            return cells, np.asarray(self.rest_product), np.zeros((0, len(self.rest_product)))
        nodes, corners = np.unique(self.corners[cells], return_inverse=True)
        corners = corners.reshape(len(cells), -1)
        cell_gradients = self.gradients[cells]
        conductance_changes = change[cells] * self.measures[cells].reshape((-1,) + (1,) * (change.ndim - 1))
        weighted_gradients = (
            np.einsum("cka,cab->ckb", cell_gradients, conductance_changes)
            if conductance_changes.ndim == 3
            else cell_gradients * conductance_changes[:, None, None]
        )
        cell_stiffness = weighted_gradients @ np.swapaxes(cell_gradients, 1, 2)
        rows, columns = np.broadcast_arrays(corners[:, :, None], corners[:, None, :])
        stiffness = scipy.sparse.csr_array(
            (cell_stiffness.ravel(), (rows.ravel(), columns.ravel())), shape=(len(nodes), len(nodes))
        )
        initial_solution = self.solution[nodes]
        changed_solution = np.linalg.solve(
            np.eye(len(nodes)) + self.inverse[np.ix_(nodes, nodes)] @ stiffness, initial_solution
        )
        product = self.rest_product - initial_solution.T @ (stiffness @ changed_solution)
        return cells, product, changed_solution

    def _impedance(self, product: Any) -> Float[np.ndarray, "L L"]:
        return np.asarray(electrode_impedance(product, self.resistance).transfer)


def _restricted_inverse(matrix, nodes: Int[np.ndarray, " t"]) -> Float[np.ndarray, "t t"]:
    """Compute the inverse of a sparse symmetric matrix, restricted to `nodes`: the inverse of the Schur complement
    after elimination of all other nodes."""
    other_nodes = np.setdiff1d(np.arange(matrix.shape[0]), nodes)
    schur_complement = matrix[nodes][:, nodes].toarray()
    if len(other_nodes):
        coupling = matrix[other_nodes][:, nodes]
        coupled_nodes = np.flatnonzero(np.diff(coupling.tocsc().indptr))
        coupling = coupling[:, coupled_nodes].toarray()
        factor = scipy.sparse.linalg.splu(matrix[other_nodes][:, other_nodes].tocsc(), permc_spec="MMD_AT_PLUS_A")
        schur_complement[np.ix_(coupled_nodes, coupled_nodes)] -= coupling.T @ factor.solve(coupling)
    return scipy.linalg.inv(0.5 * (schur_complement + schur_complement.T))
