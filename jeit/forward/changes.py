"""Derivatives of voltages with respect to conductivity changes in a few cells, and to contact impedances.

For the fields F (`ForwardModel.fields`) and the contact impedance z_l, the energy in the contact of electrode l is
E_l(F, F) = (1/z_l) ∫_l (F - Z_l)², where Z is the transfer impedance. Because F is a stationary point (see
`jeit.forward.transfer`), the derivative of the transfer impedance with respect to the contact impedance needs no
further solve:

    ∂Z / ∂ log z_l = E_l(F, F).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.electrodes.electrodes import AbstractElectrodes, AbstractMovableElectrodes, Contact
from jeit.forward.model import ForwardModel, channel_voltages, evaluate, fields_and_impedance_of, select_channels
from jeit.forward.system import cached_geometry, stiffness
from jeit.forward.transfer import ElectrodeImpedance
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers import SparsityPattern
from jeit_solvers.engines import as_array, on_host

# Number of cells processed at a time, so that their products of gradients stay in the cache.
_CELLS_AT_ONCE = 64


class ConductivityChange(NamedTuple):
    """Change of conductivity that is linear in q coefficients. **Fields**: `cells`: (k,) indices of the cells that
    change, or None for all cells; `slope`: (k, q) change of conductivity of each cell per unit coefficient, in S/m
    (2-D: S)."""

    cells: Any
    slope: Float[np.ndarray, "k q"]


class SolvedFields(NamedTuple):
    """Solution of a forward model, in NumPy. **Fields**: `mesh`, `protocol`, `pattern`: mesh, protocol and sparsity
    pattern of the model; `fields`: potentials F (n, L) as defined in `ForwardModel.fields`, in ohms; `impedance`:
    impedance of the electrodes in ohms."""

    mesh: Mesh
    protocol: Protocol
    pattern: SparsityPattern
    fields: Float[np.ndarray, "n L"]
    impedance: ElectrodeImpedance

    @property
    def voltages(self) -> Float[np.ndarray, " M"]:
        """Voltages (M,) of the channels."""
        return channel_voltages(self.protocol, self.impedance)  # pyright: ignore[reportReturnType]

    def derivatives(self, changes: Sequence[ConductivityChange]) -> Float[np.ndarray, "M n"]:
        """Derivatives of the voltages with respect to the coefficients of all `changes`: -∫ dσ ∇u_drive · ∇u_measure.
        They are computed from integrals for pairs of electrodes."""
        energy_changes = np.concatenate([self._energy(*conductivity_change) for conductivity_change in changes])
        return np.stack(
            [-select_channels(self.protocol, impedance_change) for impedance_change in energy_changes], axis=1
        )  # pyright: ignore

    def _energy(self, cells, slope) -> Float[np.ndarray, "q L L"]:
        """Integrals ∫ dσ ∇F_k · ∇F_l for pairs of electrodes k, l and every coefficient of a change dσ. They are
        computed from the stiffness matrix if all cells change, otherwise from the gradients in the cells that
        change."""
        if cells is None:
            return np.stack([self._energy_everywhere(cell_change) for cell_change in slope.T])
        return _field_energies(self.mesh, self.fields, cells, slope)

    def _energy_everywhere(self, cell_change: Float[np.ndarray, " m"]) -> Float[np.ndarray, "L L"]:
        empty_contacts = (None,) * (self.pattern.num_groups - 1)
        stiffness_values: Any = self.pattern.assemble(stiffness(self.mesh, cell_change), *empty_contacts)  # pyright: ignore
        return self.pattern.quadratic_form(stiffness_values, self.fields)


def solved_fields(model: ForwardModel, conductivity: Float[np.ndarray, " m"]) -> SolvedFields:
    """Compute the fields of a model for a `conductivity` per cell, in S/m (2-D: S), which is not checked."""
    fields, impedance = evaluate(model, fields_and_impedance_of, conductivity)
    return SolvedFields(*on_host((model.mesh, model.protocol, model.system.pattern, fields, impedance)))


def _field_energies(mesh: Mesh, fields, cells, conductivity_slope) -> Float[np.ndarray, "q L L"]:
    """Integrals ∫ dσ ∇F_k · ∇F_l over some cells as matrices (q, L, L) over pairs of L electrodes, one for each of q
    coefficients.

    Cells that change with one coefficient only, such as those inside a body whose contrast changes, take a third of the
    work of the others.
    """
    nodes = np.asarray(mesh.cells)[cells]
    gradient, cell_measure = (np.asarray(geometry_array)[cells] for geometry_array in cached_geometry(mesh))
    scaled_basis_gradients = np.ascontiguousarray(gradient.transpose(0, 2, 1)) * np.sqrt(cell_measure)[:, None, None]
    num_fields, is_nonzero = fields.shape[1], conductivity_slope != 0
    num_nonzero = is_nonzero.sum(axis=1)
    energy_products = np.zeros((conductivity_slope.shape[1], num_fields**2), np.result_type(fields, conductivity_slope))
    for chunk_of_indices in _split_indices(np.flatnonzero(num_nonzero > 1)):
        local_fields = scaled_basis_gradients[chunk_of_indices] @ fields[nodes[chunk_of_indices]]
        energy_products += conductivity_slope[chunk_of_indices].T @ (
            local_fields.transpose(0, 2, 1) @ local_fields
        ).reshape(len(chunk_of_indices), -1)
    energy_products = energy_products.reshape(-1, num_fields, num_fields)
    for coefficient_index, is_only_nonzero in enumerate((is_nonzero & (num_nonzero == 1)[:, None]).T):
        for chunk_of_indices in _split_indices(np.flatnonzero(is_only_nonzero)):
            local_fields = scaled_basis_gradients[chunk_of_indices] @ fields[nodes[chunk_of_indices]]
            scaled_local_fields = conductivity_slope[chunk_of_indices, coefficient_index, None, None] * local_fields
            energy_products[coefficient_index] += local_fields.reshape(-1, num_fields).T @ scaled_local_fields.reshape(
                -1, num_fields
            )
    return energy_products


def _split_indices(indices: Int[np.ndarray, " k"]) -> list[Int[np.ndarray, " p"]]:
    """Divide `indices` into parts of `_CELLS_AT_ONCE`."""
    return [
        indices[chunk_start : chunk_start + _CELLS_AT_ONCE] for chunk_start in range(0, len(indices), _CELLS_AT_ONCE)
    ]


# Contact impedance in ohm·m² of an electrode that carries no current, compared with an electrode of unit contact
# impedance.
_OPEN_CONTACT_IMPEDANCE = 1e30


class _ContactMass(NamedTuple):
    nodes: Int[np.ndarray, "q k"]
    mass: Float[np.ndarray, "q k k"]


def _select_contact(mesh: Mesh, electrodes: AbstractElectrodes, is_selected: Bool[np.ndarray, " L"]) -> Contact:
    """Contact integrals for unit contact impedance of the electrodes with `is_selected`, and open contacts of all
    others."""
    contact_impedance = np.where(is_selected, 1.0, _OPEN_CONTACT_IMPEDANCE)
    return on_host(electrodes.with_contact_impedance(contact_impedance)).contact(mesh)


def _groups_without_neighbours(shares_cell_matrix: Bool[np.ndarray, "L L"]) -> list[Bool[np.ndarray, " L"]]:
    """Divide electrodes into as few groups as a simple search finds, so that no two electrodes of a group share a facet
    or cell. `shares_cell_matrix`: whether two electrodes share one. Each group is a mask of its members."""
    electrode_groups: list[Bool[np.ndarray, " L"]] = []
    for electrode, is_neighbour in enumerate(shares_cell_matrix):
        free_group = next(
            (free_group for free_group in electrode_groups if not (free_group & is_neighbour).any()), None
        )
        if free_group is None:
            electrode_groups.append(free_group := np.zeros(len(shares_cell_matrix), bool))
        free_group[electrode] = True
    return electrode_groups


class ContactSensitivity:
    """Derivative ∂Z/∂ log z of the transfer impedance Z with respect to each contact impedance z, on one mesh.
    `electrodes`: electrodes of the complete electrode model, whose positions and sizes are fixed."""

    def __init__(self, mesh: Mesh, electrodes: AbstractElectrodes):
        mesh, num_electrodes = on_host(mesh), electrodes.num_electrodes
        contact = _select_contact(mesh, electrodes, np.ones(num_electrodes, bool))
        load = np.asarray(contact.load)
        self._loads: list[Float[np.ndarray, " n"]] = list(load.T)
        self._contact_masses: list[list[_ContactMass]] = [[] for _ in range(num_electrodes)]
        # If an electrode covers a part of a facet or cell, all nodes of this facet or cell have a load.
        is_touched = [(load[np.asarray(nodes)] != 0).all(axis=1) for nodes in contact.nodes]
        shared_node_counts = sum(
            is_touched_by_electrode.T.astype(float) @ is_touched_by_electrode for is_touched_by_electrode in is_touched
        )
        electrode_groups = _groups_without_neighbours((shared_node_counts > 0) & ~np.eye(num_electrodes, dtype=bool))
        for is_in_group in electrode_groups:
            own_contact = contact if is_in_group.all() else _select_contact(mesh, electrodes, is_in_group)
            for nodes, mass, is_touched_by_electrode in zip(
                own_contact.nodes, own_contact.mass, is_touched, strict=True
            ):
                nodes, mass = np.asarray(nodes), np.asarray(mass)
                largest_mass_entries = np.abs(mass).max(axis=(1, 2), initial=0)
                is_covered = largest_mass_entries > 2 / _OPEN_CONTACT_IMPEDANCE * largest_mass_entries.max(initial=0)
                for electrode in np.flatnonzero(is_in_group):
                    nodes_of_electrode = np.flatnonzero(is_covered & is_touched_by_electrode[:, electrode])
                    self._contact_masses[electrode].append(
                        _ContactMass(nodes[nodes_of_electrode], mass[nodes_of_electrode])
                    )

    def __call__(
        self, fields: Float[np.ndarray, "n L"], impedance: Float[np.ndarray, "L L"], contact_impedance
    ) -> Float[np.ndarray, "L L L"]:
        """Compute the derivatives ∂Z/∂ log z_l of the transfer impedance, (L, L, L) in ohms, from the `fields` F and
        the `impedance` Z for the same `contact_impedance` (L,)."""
        return (
            np.stack([self._energy(electrode, fields, impedance) for electrode in range(len(impedance))])
            / (np.asarray(contact_impedance)[:, None, None])
        )

    def _energy(self, electrode: int, fields, impedance):
        load, electrode_impedance = self._loads[electrode], impedance[electrode]
        cross_energy = np.outer(load @ fields, electrode_impedance)
        energy = load.sum() * np.outer(electrode_impedance, electrode_impedance) - cross_energy - cross_energy.T
        for nodes, mass in self._contact_masses[electrode]:
            local_fields = fields[nodes]
            energy += np.einsum("qip,qir->pr", local_fields, np.einsum("qij,qjr->qir", mass, local_fields))
        return energy


# Fraction of the mesh's width by which electrodes are shifted for finite differences.
_RELATIVE_FINITE_DIFFERENCE_SHIFT = 1e-4


class PlacementSensitivity:
    """Derivatives of the transfer impedance Z with respect to shifts of the electrodes along the directions in which
    they can move, and with respect to the logarithm of each contact impedance z. They are central differences of the
    contact energy at fixed fields. `electrodes` must be movable."""

    def __init__(self, mesh: Mesh, electrodes: AbstractMovableElectrodes):
        mesh = on_host(mesh)
        self.directions = np.asarray(electrodes.directions(mesh))
        self._contact_impedance = np.asarray(electrodes.contact_impedance)
        self._step = _RELATIVE_FINITE_DIFFERENCE_SHIFT * float(np.ptp(np.asarray(mesh.points), axis=0).max())
        self._sensitivity = ContactSensitivity(mesh, electrodes)
        self._shifted_sensitivities = []
        for direction_index in range(self.directions.shape[1]):
            shift_lengths = np.zeros(self.directions.shape[:2])
            shift_lengths[:, direction_index] = self._step
            shifted_electrodes = [
                shift_electrodes(electrodes, self.directions, displacements)
                for displacements in (shift_lengths, -shift_lengths)
            ]
            self._shifted_sensitivities.append(
                [ContactSensitivity(mesh, moved_electrodes) for moved_electrodes in shifted_electrodes]
            )

    def __call__(self, fields: Float[np.ndarray, "n L"], impedance: Float[np.ndarray, "L L"]):
        """Derivatives (p, L, L) of the transfer impedance Z: first for the L · a shifts, electrode by electrode, in
        ohms per metre, then for the L values log z, in ohms. `fields`: F (n, L), and `impedance`: Z (L, L), both in
        ohms, for these electrodes."""
        contact = self._contact_impedance
        shift_derivatives = []
        for forward_sensitivity, backward_sensitivity in self._shifted_sensitivities:
            contact_energies = [
                shifted_sensitivity(fields, impedance, contact)
                for shifted_sensitivity in (backward_sensitivity, forward_sensitivity)
            ]
            shift_derivatives.append((contact_energies[0] - contact_energies[1]) / (2 * self._step))
        shift_derivatives = np.stack(shift_derivatives, axis=1).reshape(-1, *impedance.shape)
        return np.concatenate([shift_derivatives, self._sensitivity(fields, impedance, contact)])


def shift_electrodes(
    electrodes: AbstractMovableElectrodes, directions: Float[np.ndarray, "L a d"], shift: Float[np.ndarray, "L a"]
) -> AbstractMovableElectrodes:
    """Copy electrodes, with the position of each electrode displaced by `shift` (L, a), metres, along the electrode's
    unit vectors `directions` (L, a, d)."""
    position = np.asarray(electrodes.position) + np.einsum("la,lad->ld", shift, directions)
    return eqx.tree_at(lambda moved_electrodes: moved_electrodes.position, electrodes, as_array(position))
