"""From conductivity to the transfer impedance of the electrodes, with its derivative rule.

Let a_θ(u, w) be the energy form of the electrode model, θ standing for everything it depends on (conductivity,
contact impedance, electrode positions, mesh points), and F_l the potential for a unit current into electrode l
that leaves evenly through all. Then Z_lk = a_θ(F_l, F_k), and, F being stationary,

    dZ = -∂_θ a_θ(F, F) dθ      at fixed F,

so a first derivative in any direction is a product of fields that are known already, with no further solve. (For
point electrodes the load depends on their position, and 2 ∂_θ⟨load, F⟩ dθ is added.) Cheney, Isaacson and Newell,
SIAM Review 41 (1999) 85-101; Polydorides and Lionheart, Meas. Sci. Technol. 13 (2002) 1871-1883.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jeit.electrodes import AbstractElectrodes, Contact
from jeit.forward.assembly import cell_conductivity, field_gradients
from jeit.forward.system import System
from jeit.mesh import Mesh
from jeit_solvers import over_cores, symmetric_inverse

# Rows of an inverse that are solved for at once.
_ROWS = 64


@eqx.filter_custom_jvp
def transfer_impedance(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    """Transfer impedance Z (L, L) in ohms: electrode potentials U = Z I for currents I that sum to zero.

    Rows and columns of Z sum to zero, i.e. the mean electrode potential is the reference. Symmetric.
    """
    contact = electrodes.contact(mesh)
    operator = system.operator(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    return _impedance(electrodes, system.quadratic_form(operator, contact.load))


@transfer_impedance.def_jvp
def _transfer_impedance_jvp(primals, tangents):
    mesh, conductivity, electrodes, system = primals
    fields, impedance = electrode_fields(mesh, conductivity, electrodes, system)

    def stationary(mesh, conductivity, electrodes):
        return _stationary_form(mesh, conductivity, electrodes, fields, impedance)

    _, derivative = eqx.filter_jvp(stationary, (mesh, conductivity, electrodes), tangents[:3])
    return impedance, derivative


def electrode_fields(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    """Potentials F (n, L) for a unit current into each electrode, leaving evenly through all; and Z (L, L).

    Volts per ampere. Differentiable by the implicit rule of the linear solve (one more solve per direction).
    """
    contact = electrodes.contact(mesh)
    operator = system.operator(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    solution = system.solve(operator, contact.load)
    impedance = _impedance(electrodes, contact.load.T @ solution)
    if not electrodes.is_point:
        return solution @ impedance, impedance
    fields = solution - solution.mean(axis=1, keepdims=True)
    return fields - (contact.load.T @ fields).mean(axis=0), impedance


def fields_and_inverse(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System, nodes):
    """F (u, L) at some nodes (u,), and the block of K⁻¹ among them (u, u), ohms, but for a constant in each.

    K is the matrix of the electrode model with all electrodes floating: the potential at one node for a unit current
    into another. What it leaves open, a constant, no change of conductivity sees. The last row may come repeatedly.
    """
    known = _before_inverse(mesh, conductivity, electrodes, system, nodes)
    inverse = over_cores(partial(_rows_of_inverse, system, known, nodes), len(nodes), _ROWS)
    return known[0], inverse


@eqx.filter_jit
def _before_inverse(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System, nodes):
    """F at nodes; what is to be added to A⁻¹ there, X (u, L) of X Fᵀ, or None; A, and what the solver made of it."""
    contact = electrodes.contact(mesh)
    operator = system.operator(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    fields, _ = electrode_fields(mesh, conductivity, electrodes, system)
    # Electrodes carry what enters at the nodes back out: with X = A⁻¹ load, K⁻¹ = A⁻¹ + X Z Xᵀ, and X Z = F.
    loads = None if electrodes.is_point else system.solve(operator, contact.load)[nodes]
    return fields[nodes], loads, operator, system.solver.init(operator, {})


@eqx.filter_jit
def _rows_of_inverse(system: System, known, nodes, rows):
    fields, loads, operator, state = known

    def some(rows):
        inverse = system.inverse_columns(operator, state, nodes[rows])[nodes].T
        return inverse if loads is None else inverse + loads[rows] @ fields.T

    return jax.lax.map(some, rows).reshape(-1, len(nodes))


def _impedance(electrodes: AbstractElectrodes, product: Inexact[Array, "L L"]) -> Inexact[Array, "L L"]:
    """Z from the product loadᵀ A⁻¹ load, A being the stiffness with contact mass (complete) or grounding (point).

    Complete electrodes: eliminating the nodes leaves (D - BᵀA⁻¹B) U = I. Its columns sum to zero, so the diagonal
    is minus the sum of the others, which spares the cancellation in D - BᵀA⁻¹B at small contact impedance.
    """
    product = (product + product.T) / 2
    size = product.shape[0]
    if electrodes.is_point:
        return centred(product)
    others = product * (1 - jnp.eye(size))
    schur = jnp.diag(others.sum(axis=0)) - others
    # The constant vector is the null space; weight it like the rest, invert, and take it out again.
    level = jnp.trace(schur) / size**2
    return centred(symmetric_inverse(schur + level))


def centred(matrix: Inexact[Array, "L L"]) -> Inexact[Array, "L L"]:
    """The symmetric part of `matrix` with the mean of every row and column taken out."""
    matrix = (matrix + matrix.T) / 2
    mean = matrix.mean(axis=0)
    return matrix - mean - mean[:, None] + mean.mean()


def _stationary_form(mesh, conductivity, electrodes, fields, impedance):
    """2⟨load, F⟩ - a(F, F) as a matrix (L, L): equals Z, and its derivative at fixed F is that of Z."""
    conductivity = cell_conductivity(mesh, conductivity)
    contact = electrodes.contact(mesh)
    gradient = field_gradients(mesh, fields)
    if conductivity.ndim == 1:
        energy = sum((component.T * conductivity) @ component for component in gradient)
    else:
        energy = jnp.einsum("imp,mij,jmq->pq", gradient, conductivity, gradient)
    if electrodes.is_point:
        source = contact.load.T @ fields
        return centred(source + source.T - energy)
    return -energy - _contact_energy(contact, fields, impedance)


def _contact_energy(contact: Contact, fields, impedance):
    """Σ_l (1/z_l) ∫_l (u - U_l)(w - W_l) for all pairs of fields, as a matrix (L, L)."""
    inside = 0
    for nodes, mass in zip(contact.nodes, contact.mass, strict=True):
        local = fields.at[nodes].get(mode="promise_in_bounds")  # (q, k, L)
        inside += jnp.einsum("qip,qij,qjr->pr", local, mass, local)
    across = fields.T @ contact.load @ impedance
    return inside - across - across.T + impedance.T @ (contact.load.sum(axis=0)[:, None] * impedance)
