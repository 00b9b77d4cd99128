"""Transfer impedance of the electrodes as a function of the conductivity, with its derivative rule.

Let a_θ(u, w) be the energy form of the electrode model, where θ denotes its parameters (conductivity, contact
impedance, electrode positions, mesh points). Let F_l be the potential for a unit current into electrode l that leaves
through all electrodes in equal parts. Then Z_lk = a_θ(F_l, F_k), and, because F is a stationary point of 2⟨load, F⟩ -
a_θ(F, F),

    dZ = -∂_θ a_θ(F, F) dθ      at fixed F,

so a first derivative in any direction is computed from products of known fields, without a further solve. (For point
electrodes the load depends on their position, and 2 ∂_θ⟨load, F⟩ dθ is added.) Cheney, Isaacson and Newell, SIAM Review
41 (1999) 85-101; Polydorides and Lionheart, Meas. Sci. Technol. 13 (2002) 1871-1883.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact
from numpy.typing import ArrayLike

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrodes import Contact
from jeit.forward.system import System, cell_conductivity, field_gradients
from jeit.mesh import Mesh
from jeit_solvers import NearInverse, SparseSymmetric, Strips, near_inverse, symmetric_inverse
from jeit_solvers.engines import namespace, undifferentiated


class ElectrodeImpedance(NamedTuple):
    """Transfer impedance of the electrodes in two parts, up to terms that cancel for currents that sum to zero. The
    parts are stored separately, because the resistance of a nearly open contact is so large that their sum would lose
    the digits of the part from the body.

    **Fields**: `body`: (L, L) mean potentials under the electrodes for unit currents; `contact`: (L,) voltage drop at
    each contact per unit current, z / |e| with the contact impedance z and the electrode's area |e|, zero for point
    electrodes; both in ohms.
    """

    body: Inexact[Array, "L L"]
    contact: Inexact[Array, " L"]

    @property
    def transfer(self) -> Inexact[Array, "L L"]:
        """Transfer impedance Z (L, L) in ohms, in which every row and column has zero mean."""
        return centred(self.body + namespace(self.body).diag(self.contact))


def transfer_impedance(mesh: Mesh, conductivity: ArrayLike, electrodes: AbstractElectrodes, system: System):
    """Transfer impedance Z (L, L) in ohms: electrode potentials are U = Z I for currents I that sum to zero.

    Z is symmetric; its rows and columns sum to zero, so potentials are relative to the mean of all electrodes.
    Arguments are not checked, unlike in `ForwardModel.transfer_impedance`.

    **Arguments:**

    - `mesh`: the mesh.
    - `conductivity`: per cell (m,), per node (n,) or tensors per cell (m, d, d), in S/m (2-D: S).
    - `electrodes`: the electrodes on the mesh.
    - `system`: sparsity pattern and linear solver, such as `ForwardModel.system`.

    **Example:**

    ```python
    model = ForwardModel(mesh, electrodes, adjacent(16))
    impedance = transfer_impedance(mesh, np.ones(mesh.num_cells), electrodes, model.system)
    ```
    """
    return impedance_parts(mesh, conductivity, electrodes, system).transfer


def impedance_parts(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System) -> ElectrodeImpedance:
    """The transfer impedance in two parts, body and contacts, as an `ElectrodeImpedance`; `conductivity` in S/m (2-D:
    S)."""
    impedance_function = (
        _impedance_by_quadratic_form if namespace(mesh, conductivity, electrodes) is np else _differentiable
    )
    return impedance_function(mesh, conductivity, electrodes, system)


def _impedance_by_quadratic_form(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    contact = electrodes.contact(mesh)
    system_operator, load = system.grounded_system(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    return electrode_impedance(system.quadratic_form(system_operator, load), contact_resistance(electrodes, contact))


_differentiable = eqx.filter_custom_jvp(_impedance_by_quadratic_form)


@_differentiable.def_jvp
def _impedance_parts_jvp(primals, tangents):
    mesh, conductivity, electrodes, system = primals
    solved = solved_system(mesh, conductivity, electrodes, system)
    impedance, (fields, potentials) = solved.impedance(), solved.fields()

    def stationary(mesh, conductivity, electrodes):
        stationary_form = _stationary_form(mesh, conductivity, electrodes, fields, potentials)
        resistance = contact_resistance(electrodes, electrodes.contact(mesh))
        if resistance is None:
            return ElectrodeImpedance(stationary_form, jnp.zeros_like(impedance.contact))
        return ElectrodeImpedance(stationary_form - jnp.diag(resistance), resistance)

    return impedance, eqx.filter_jvp(stationary, (mesh, conductivity, electrodes), tangents[:3])[1]


def electrode_fields(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    """Potentials F (n, L) of the nodes for a unit current into each electrode that leaves through all electrodes in
    equal parts; and the transfer impedance Z (L, L).

    Both are in volts per ampere; `conductivity` in S/m (2-D: S). Both are differentiable by implicit differentiation of
    the linear system, with one more solve per direction.
    """
    solved_fields = solved_system(mesh, conductivity, electrodes, system)
    fields, potentials = solved_fields.fields()
    return fields - potentials.mean(axis=0), solved_fields.impedance().transfer


class SolvedSystem(NamedTuple):
    """The solved finite-element system. **Fields**: `operator`: grounded matrix A in siemens, and `load`: (n, c), both
    from `System.grounded`; `solution`: X = A⁻¹ load; `resistance`: resistances of the contacts from
    `contact_resistance`."""

    operator: SparseSymmetric
    load: Inexact[Array, "n c"]
    solution: Inexact[Array, "n c"]
    resistance: Inexact[Array, " L"] | None

    @property
    def product(self) -> Inexact[Array, "c c"]:
        """The product loadᵀ A⁻¹ load."""
        return self.load.T @ self.solution

    def impedance(self) -> ElectrodeImpedance:
        """Impedance of the electrodes."""
        return electrode_impedance(self.product, self.resistance)

    def fields(self) -> tuple[Inexact[Array, "n L"], Inexact[Array, "L L"]]:
        """Potentials F (n, L) of the nodes and U (L, L) of the electrodes for a unit current into each electrode that
        leaves through all electrodes in equal parts. All potentials are relative to the same reference potential near
        the body, which does not depend on the contact impedances."""
        return unit_fields(self.solution, self.product, self.resistance)


def unit_fields(
    solution: Inexact[Array, "k c"], product: Inexact[Array, "c c"], resistance: Inexact[Array, " L"] | None
) -> tuple[Inexact[Array, "k L"], Inexact[Array, "L L"]]:
    """Potentials F at some nodes and U of the electrodes as defined in `SolvedSystem.fields`, computed from the rows of
    the solution X at these nodes and the product loadᵀ X."""
    potentials = product
    if resistance is not None:
        terminal_matrix = terminal_impedance(product)[:, :-1]
        solution, potentials = solution @ terminal_matrix, terminal_matrix[:-1]
    return solution - solution.mean(axis=1, keepdims=True), potentials - potentials.mean(axis=1, keepdims=True)


def solved_system(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System) -> SolvedSystem:
    """Solve the finite-element system for the loads of the electrodes; `conductivity` in S/m (2-D: S)."""
    contact = electrodes.contact(mesh)
    system_operator, load = system.grounded_system(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    return SolvedSystem(
        system_operator, load, system.solve(system_operator, load), contact_resistance(electrodes, contact)
    )


@eqx.filter_jit
def fields_and_inverse(
    solved: SolvedSystem, strips: Strips, max_distance: int
) -> tuple[Inexact[Array, "p L"], NearInverse]:
    """Potentials F (`SolvedSystem.fields`) of the nodes in the order of `strips`, and the entries of K⁻¹ between nodes
    up to `max_distance` strips apart, in ohms.

    K is the matrix of the electrode model in which the ground and all electrodes but one are floating. An entry of K⁻¹
    is the potential of one node for a unit current into another node. The choice of the electrode that is not floating
    does not affect the derivatives with respect to conductivity.
    """
    fields, unit_solution = strips.spread(solved.fields()[0]), strips.spread(solved.solution)
    inverse = near_inverse(strips, solved.operator, max_distance)
    if solved.resistance is None:
        return fields, inverse
    # The current that enters at a node leaves through an electrode: with X = A⁻¹ load, K⁻¹ = A⁻¹ + X Z Xᵀ.
    return fields, inverse.add(unit_solution, unit_solution @ terminal_impedance(solved.product))


def contact_resistance(electrodes: AbstractElectrodes, contact: Contact) -> Inexact[Array, " L"] | None:
    """Resistances z / |e| (L,) of the contacts of the electrodes, in ohms; None for point electrodes."""
    return None if electrodes.is_point else 1 / contact.load.sum(axis=0)


def electrode_impedance(product: Inexact[Array, "c c"], resistance: Inexact[Array, " L"] | None) -> ElectrodeImpedance:
    """Impedance of the electrodes from the product loadᵀ A⁻¹ load, with A and the loads of `System.grounded`, and from
    the resistances of the contacts.

    Let B be the loads of the electrodes, D⁻¹ the resistances of the contacts, u the nodal potentials, U the potentials
    of the electrodes and I their currents. The mean potentials under complete electrodes are D⁻¹ Bᵀ u = D⁻¹ BᵀA⁻¹B U.
    The remainder of U, the voltage drop D⁻¹ I at the contacts, is stored separately, so no digits are lost at large
    contact impedance.
    """
    if resistance is None:
        return ElectrodeImpedance((product + product.T) / 2, namespace(product).zeros_like(product[0]))
    body = resistance[:, None] * (product[:-1] @ terminal_impedance(product)[:, :-1])
    return ElectrodeImpedance((body + body.T) / 2, resistance.astype(body.dtype))


def terminal_impedance(product: Inexact[Array, "c c"]) -> Inexact[Array, "c c"]:
    """Impedance matrix of the terminals (electrodes and ground): potentials of all terminals for a unit current into
    each terminal that leaves through a reference terminal.

    Eliminating the nodal potentials from the system leaves (D - BᵀA⁻¹B) U = I, with the symbols of
    `electrode_impedance`. The columns of the matrix D - BᵀA⁻¹B sum to zero, so its diagonal is computed from the sum of
    the off-diagonal entries. This avoids the cancellation in D - BᵀA⁻¹B at small contact impedance. The reference
    terminal is the terminal with the largest conductance to the others. Rows and columns are scaled by their diagonals,
    because the contact impedances may differ by orders of magnitude.
    """
    xp = namespace(product)
    mutual_coupling = (product + product.T) / 2 * (1 - np.eye(len(product)))
    diagonal = mutual_coupling.sum(axis=0)
    is_not_reference = np.arange(len(product)) != xp.argmax(undifferentiated(abs(diagonal)))
    is_free_pair = is_not_reference * is_not_reference[:, None]
    row_scale = undifferentiated(1 / xp.sqrt(xp.where(is_not_reference, abs(diagonal), 1)))
    row_scale = row_scale * row_scale[:, None]
    scaled_matrix = (xp.diag(xp.where(is_not_reference, diagonal, 1)) - is_free_pair * mutual_coupling) * row_scale
    impedance = symmetric_inverse(scaled_matrix) * row_scale * is_free_pair
    return impedance + undifferentiated(_refinement_correction(mutual_coupling, impedance, xp.diag(is_not_reference)))


def _refinement_correction(
    other_impedance: Inexact[Array, "c c"], impedance: Inexact[Array, "c c"], current: Inexact[Array, "c c"]
):
    """Correction of the impedance of terminals by one step of iterative refinement; needed if two terminals are nearly
    short-circuited.

    The current between two terminals is computed from the difference of their potentials. The current that leaves one
    terminal therefore equals the current that enters the other, even with rounding errors. The residual is `current`
    minus all these currents; it retains the digits that couple a short-circuited pair to the other terminals.
    """
    xp = namespace(other_impedance)
    if xp is np:
        electrode_currents = np.stack(
            [row @ (potential - impedance) for row, potential in zip(other_impedance, impedance, strict=True)]
        )
    else:
        electrode_currents = (other_impedance[:, :, None] * (impedance[:, None] - impedance)).sum(axis=1)
    potential_correction = impedance @ (current - electrode_currents)
    return (potential_correction + potential_correction.T) / 2


def centred(matrix: Inexact[Array, "L L"]) -> Inexact[Array, "L L"]:
    """The symmetric part of `matrix`, with the mean of every row and column subtracted."""
    matrix = (matrix + matrix.T) / 2
    mean = matrix.mean(axis=0)
    return matrix - mean - mean[:, None] + mean.mean()


def _stationary_form(mesh, conductivity, electrodes, fields, impedance):
    """The form 2⟨load, F⟩ - a(F, F) of the module's docstring as a matrix (L, L). Its derivative at fixed F and Z
    equals the derivative of the transfer impedance Z."""
    conductivity = cell_conductivity(mesh, conductivity)
    contact = electrodes.contact(mesh)
    gradient = field_gradients(mesh, fields)
    if conductivity.ndim == 1:
        body_energy = sum((gradient_component.T * conductivity) @ gradient_component for gradient_component in gradient)
    else:
        body_energy = jnp.einsum("imp,mij,jmq->pq", gradient, conductivity, gradient)
    if electrodes.is_point:
        contact_source = contact.load.T @ fields
        return contact_source + contact_source.T - body_energy
    return -body_energy - _contact_energy(contact, fields, impedance)


def _contact_energy(contact: Contact, fields, impedance):
    """Energy Σ_l (1/z_l) ∫_l (u - U_l)(w - W_l) in the contacts for all pairs of fields u, w with electrode potentials
    U, W, as a matrix (L, L)."""
    body_term = 0
    for nodes, mass in zip(contact.nodes, contact.mass, strict=True):
        local_fields = fields.at[nodes].get(mode="promise_in_bounds")  # (q, k, L)
        body_term += jnp.einsum("qip,qij,qjr->pr", local_fields, mass, local_fields)
    coupling_energy = fields.T @ contact.load @ impedance
    return (
        body_term - coupling_energy - coupling_energy.T + impedance.T @ (contact.load.sum(axis=0)[:, None] * impedance)
    )
