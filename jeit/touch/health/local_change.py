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
        is_near_centre = np.linalg.norm(np.asarray(centroids(refined_mesh)) - centre, axis=1) < radius
        is_large_cell = is_near_centre & (np.asarray(measures(refined_mesh)) > area)
        if not is_large_cell.any():
            break
        points, cells, parent_cells = _halve_cells(points, cells, parent_cells, is_large_cell)
    return Mesh.create(points, cells), parent_cells


def _halve_cells(
    points: np.ndarray, cells: np.ndarray, parent_cells: np.ndarray, is_large_cell: Bool[np.ndarray, " m"]
):
    """Halve the cells that `is_large_cell` marks, and further cells as needed to avoid hanging nodes. Returns the
    points, the cells, and the index of each cell's original cell."""
    node_pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).astype(np.int64)
    pair_numbers = node_pairs[..., 0] * len(points) + node_pairs[..., 1]  # numbers are sorted faster than rows
    edges, edge_numbers = np.unique(pair_numbers, return_inverse=True)
    edges, edge_numbers = np.column_stack(np.divmod(edges, len(points))), edge_numbers.reshape(-1, 3)
    edge_lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # If two edges of a cell are equally long, all cells must choose the same edge as the longest.
    edge_lengths = edge_lengths * (1 + 1e-9 * np.arange(len(edge_lengths)) / len(edge_lengths))
    longest_edges = edge_numbers[np.arange(len(cells)), edge_lengths[edge_numbers].argmax(axis=1)]
    is_split_edge = np.zeros(len(edges), bool)
    is_split_edge[longest_edges[is_large_cell]] = True
    while True:
        has_hanging_node = is_split_edge[edge_numbers].any(axis=1) & ~is_split_edge[longest_edges]
        if not has_hanging_node.any():
            break
        is_split_edge[longest_edges[has_hanging_node]] = True
    midpoint_nodes = np.full(len(edges), -1)
    midpoint_nodes[is_split_edge] = len(points) + np.arange(is_split_edge.sum())
    points = np.concatenate([points, points[edges[is_split_edge]].mean(axis=1)])
    # Turn each cell so that its longest edge comes first, then halve it.
    longest_edge_positions = edge_lengths[edge_numbers].argmax(axis=1)
    cell_indices = np.arange(len(cells))[:, None]
    rotated_cells, rotated_edges = (
        cells[cell_indices, (longest_edge_positions[:, None] + np.arange(3)) % 3],
        edge_numbers[cell_indices, (longest_edge_positions[:, None] + np.arange(3)) % 3],
    )
    is_unchanged_cell = ~is_split_edge[longest_edges]
    first_node, second_node, third_node = rotated_cells[~is_unchanged_cell].T
    midpoints_of_halved, parents_of_halved = (
        midpoint_nodes[rotated_edges[~is_unchanged_cell]],
        parent_cells[~is_unchanged_cell],
    )
    new_cells, new_parents = [rotated_cells[is_unchanged_cell]], [parent_cells[is_unchanged_cell]]
    half_triangles = (
        (second_node, third_node, midpoints_of_halved[:, 1]),
        (third_node, first_node, midpoints_of_halved[:, 2]),
    )
    for corner, opposite_corner, edge_midpoint in half_triangles:
        # Half of a cell is the triangle (corner, opposite, midpoint of the longest edge); its edge from corner to
        # opposite may be halved too.
        is_halved_cell = edge_midpoint >= 0
        longest_midpoint = midpoints_of_halved[:, 0]
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
        cell_distances = np.linalg.norm(np.asarray(centroids(mesh))[:, :2] - centre, axis=1)
        cell_nodes = np.asarray(mesh.cells)
        while len(region_nodes := np.unique(cell_nodes[cell_distances < radius])) > _MAX_NUM_NODES:
            radius *= _SHRINKAGE_FACTOR
        self.radius = radius
        self.cells: Int[np.ndarray, " c"] = np.flatnonzero(cell_distances < radius)
        region_node_numbers = np.full(mesh.num_points, -1)
        region_node_numbers[region_nodes] = np.arange(len(region_nodes))
        self.corners = region_node_numbers[cell_nodes[self.cells]]
        self.gradients = np.asarray(gradients(mesh))[self.cells]  # (cells, nodes of a cell, coordinates)
        self.measures = np.asarray(measures(mesh))[self.cells]
        self.centres = np.asarray(centroids(mesh))[self.cells][:, :2]
        solved_system: SolvedSystem = on_host(evaluate(model, solved_system_of, conductivity))
        self.rest_product, self.resistance = solved_system.product, solved_system.resistance
        self.solution = np.asarray(solved_system.solution)[region_nodes]
        system_matrix = solved_system.operator.pattern.to_scipy(solved_system.operator.values).tocsr()
        self.inverse = _inverse_at_nodes(system_matrix, region_nodes)
        self._last_solved: tuple[np.ndarray, tuple] | None = None

    def impedance(self, change: Float[np.ndarray, "c ..."]) -> Float[np.ndarray, "L L"]:
        """Compute the transfer impedance matrix (electrodes, electrodes), ohms, after a `change` of the conductivity in
        the region's cells: scalars (cells,) or tensors (cells, d, d) in d dimensions."""
        return self._transfer_impedance(self._solve_change(change)[1])

    def derivatives(
        self, change: Float[np.ndarray, "c ..."], directions: list[Float[np.ndarray, "c ..."]]
    ) -> tuple[Float[np.ndarray, "L L"], list[Float[np.ndarray, "L L"]]]:
        """Compute the transfer impedance matrix (electrodes, electrodes), ohms, after a `change` of conductivity in the
        region, and its derivatives along the changes in `directions`."""
        changed_cells, electrode_product, changed_solution = self._solve_change(change)
        changed_node_fields: Any = unit_fields(changed_solution, electrode_product, self.resistance)[0]  # pyright: ignore[reportArgumentType]
        nodal_fields = np.zeros((self.solution.shape[0], changed_node_fields.shape[1]))
        changed_nodes = np.unique(self.corners[changed_cells])
        nodal_fields[changed_nodes] = changed_node_fields
        field_gradients = np.einsum(
            "ckd,ckl->dcl", self.gradients[changed_cells], nodal_fields[self.corners[changed_cells]], optimize=True
        )
        impedance_derivatives = []
        for conductivity_direction in directions:
            conductance_changes = conductivity_direction[changed_cells] * self.measures[changed_cells].reshape(
                (-1,) + (1,) * (conductivity_direction.ndim - 1)
            )
            current_changes = (
                np.einsum("cab,bcl->acl", conductance_changes, field_gradients)
                if conductance_changes.ndim == 3
                else conductance_changes[:, None] * field_gradients
            )
            power_changes = np.tensordot(field_gradients, current_changes, axes=([0, 1], [0, 1]))
            impedance_derivatives.append(-np.asarray(centred(power_changes)))  # pyright: ignore[reportArgumentType]
        return self._transfer_impedance(electrode_product), impedance_derivatives

    def _solve_change(self, conductivity_change: np.ndarray):
        """Solve the forward problem after a change of conductivity; returns the indices of the changed cells, Bᵀ(A +
        D)⁻¹B, and (A + D)⁻¹B at the nodes of these cells, with the grounded matrix A, its change D and the loads B.

        The last result is kept: a fit computes the voltages after a change, and then their derivatives."""
        if self._last_solved is None or not np.array_equal(self._last_solved[0], conductivity_change):
            self._last_solved = conductivity_change.copy(), self._solve_new_change(conductivity_change)
        return self._last_solved[1]

    def _solve_new_change(self, conductivity_change: np.ndarray):
        changed_cells = np.flatnonzero(conductivity_change.reshape(len(conductivity_change), -1).any(axis=1))
        if not len(changed_cells):
            return changed_cells, np.asarray(self.rest_product), np.zeros((0, len(self.rest_product)))
        changed_nodes, changed_cell_nodes = np.unique(self.corners[changed_cells], return_inverse=True)
        changed_cell_nodes = changed_cell_nodes.reshape(len(changed_cells), -1)
        cell_gradients = self.gradients[changed_cells]
        conductance_changes = conductivity_change[changed_cells] * self.measures[changed_cells].reshape(
            (-1,) + (1,) * (conductivity_change.ndim - 1)
        )
        weighted_gradients = (
            np.einsum("cka,cab->ckb", cell_gradients, conductance_changes)
            if conductance_changes.ndim == 3
            else cell_gradients * conductance_changes[:, None, None]
        )
        cell_stiffness = weighted_gradients @ np.swapaxes(cell_gradients, 1, 2)
        row_nodes, column_nodes = np.broadcast_arrays(changed_cell_nodes[:, :, None], changed_cell_nodes[:, None, :])
        stiffness_change = scipy.sparse.csr_array(
            (cell_stiffness.ravel(), (row_nodes.ravel(), column_nodes.ravel())),
            shape=(len(changed_nodes), len(changed_nodes)),
        )
        initial_solution = self.solution[changed_nodes]
        changed_solution = np.linalg.solve(
            np.eye(len(changed_nodes)) + self.inverse[np.ix_(changed_nodes, changed_nodes)] @ stiffness_change,
            initial_solution,
        )
        electrode_product = self.rest_product - initial_solution.T @ (stiffness_change @ changed_solution)
        return changed_cells, electrode_product, changed_solution

    def _transfer_impedance(self, electrode_product: Any) -> Float[np.ndarray, "L L"]:
        return np.asarray(electrode_impedance(electrode_product, self.resistance).transfer)


def _inverse_at_nodes(system_matrix, kept_nodes: Int[np.ndarray, " t"]) -> Float[np.ndarray, "t t"]:
    """Compute the inverse of a sparse symmetric matrix, restricted to `kept_nodes`: the inverse of the Schur complement
    after elimination of all other nodes."""
    other_nodes = np.setdiff1d(np.arange(system_matrix.shape[0]), kept_nodes)
    schur_complement = system_matrix[kept_nodes][:, kept_nodes].toarray()
    if len(other_nodes):
        coupling_matrix = system_matrix[other_nodes][:, kept_nodes]
        coupled_nodes = np.flatnonzero(np.diff(coupling_matrix.tocsc().indptr))
        coupling_matrix = coupling_matrix[:, coupled_nodes].toarray()
        lu_factors = scipy.sparse.linalg.splu(
            system_matrix[other_nodes][:, other_nodes].tocsc(), permc_spec="MMD_AT_PLUS_A"
        )
        schur_complement[np.ix_(coupled_nodes, coupled_nodes)] -= coupling_matrix.T @ lu_factors.solve(coupling_matrix)
    return scipy.linalg.inv(0.5 * (schur_complement + schur_complement.T))
