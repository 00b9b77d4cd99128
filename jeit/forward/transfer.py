"""From conductivity to the transfer impedance of the electrodes, with its derivative rule.

Let a_θ(u, w) be the energy form of the electrode model, θ standing for everything it depends on (conductivity,
contact impedance, electrode positions, mesh points), and F_l the potential for a unit current into electrode l
that leaves evenly through all. Then Z_lk = a_θ(F_l, F_k), and, F being stationary,

    dZ = -∂_θ a_θ(F, F) dθ      at fixed F,

so a first derivative in any direction is a product of fields that are known already, with no further solve. (For
point electrodes the load depends on their position, and 2 ∂_θ⟨load, F⟩ dθ is added.) Cheney, Isaacson and Newell,
SIAM Review 41 (1999) 85-101; Polydorides and Lionheart, Meas. Sci. Technol. 13 (2002) 1871-1883.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact
from numpy.typing import ArrayLike

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrodes import Contact
from jeit.forward.assembly import cell_conductivity, field_gradients
from jeit.forward.system import System
from jeit.mesh import Mesh
from jeit_solvers import NearInverse, SparseSymmetric, Strips, near_inverse, symmetric_inverse
from jeit_solvers.engines import namespace


def transfer_impedance(mesh: Mesh, conductivity: ArrayLike, electrodes: AbstractElectrodes, system: System):
    """Transfer impedance Z (L, L) in ohms: electrode potentials U = Z I for currents I that sum to zero.

    `conductivity` in S/m (2-D: S), (m,), (n,) or (m, d, d). Rows and columns of Z sum to zero, i.e. the mean electrode
    potential is the reference. Symmetric. Checks nothing: `ForwardModel.transfer_impedance` does.
    """
    formula = _quadratic if namespace(mesh, conductivity, electrodes) is np else _differentiable
    return formula(mesh, conductivity, electrodes, system)


def _quadratic(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    contact = electrodes.contact(mesh)
    operator = system.operator(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    return electrode_impedance(electrodes, system.quadratic_form(operator, contact.load))


_differentiable = eqx.filter_custom_jvp(_quadratic)


@_differentiable.def_jvp
def _transfer_impedance_jvp(primals, tangents):
    mesh, conductivity, electrodes, system = primals
    fields, impedance = electrode_fields(mesh, conductivity, electrodes, system)

    def stationary(mesh, conductivity, electrodes):
        return _stationary_form(mesh, conductivity, electrodes, fields, impedance)

    _, derivative = eqx.filter_jvp(stationary, (mesh, conductivity, electrodes), tangents[:3])
    return impedance, derivative


def electrode_fields(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System):
    """Potentials F (n, L) for a unit current into each electrode, leaving evenly through all; and Z (L, L).

    Volts per ampere; `conductivity` in S/m (2-D: S). Differentiable by the implicit rule of the linear solve (one more
    solve per direction).
    """
    return solved_system(mesh, conductivity, electrodes, system).fields_and_impedance(electrodes)


class SolvedSystem(NamedTuple):
    """The matrix A of stiffness and contact mass, siemens, the `load` (n, L) of the electrodes and X = A⁻¹ load."""

    operator: SparseSymmetric
    load: Inexact[Array, "n L"]
    solution: Inexact[Array, "n L"]

    def fields_and_impedance(self, electrodes: AbstractElectrodes):
        """F (n, L) and Z (L, L), as of `electrode_fields`."""
        impedance = electrode_impedance(electrodes, self.load.T @ self.solution)
        if not electrodes.is_point:
            return self.solution @ impedance, impedance
        fields = self.solution - self.solution.mean(axis=1, keepdims=True)
        return fields - (self.load.T @ fields).mean(axis=0), impedance


def solved_system(mesh: Mesh, conductivity, electrodes: AbstractElectrodes, system: System) -> SolvedSystem:
    """The system of the electrodes' loads, solved; `conductivity` in S/m (2-D: S)."""
    contact = electrodes.contact(mesh)
    operator = system.operator(mesh, cell_conductivity(mesh, conductivity), electrodes, contact)
    return SolvedSystem(operator, contact.load, system.solve(operator, contact.load))


@eqx.filter_jit
def fields_and_inverse(
    solved: SolvedSystem, electrodes: AbstractElectrodes, strips: Strips, reach: int
) -> tuple[Inexact[Array, "p L"], NearInverse]:
    """F at places of strips of the nodes, and K⁻¹ between them, up to `reach` strips apart, ohms, but for a constant.

    K is the matrix of the electrode model with all electrodes floating: the potential at one node for a unit current
    into another. What it leaves open, a constant, no change of conductivity sees.
    """
    fields = strips.spread(solved.fields_and_impedance(electrodes)[0])
    inverse = near_inverse(strips, solved.operator, reach)
    if electrodes.is_point:
        return fields, inverse
    # Electrodes carry what enters at the nodes back out: with X = A⁻¹ load, K⁻¹ = A⁻¹ + X Z Xᵀ, and X Z = F.
    return fields, inverse.add(strips.spread(solved.solution), fields)


def electrode_impedance(electrodes: AbstractElectrodes, product: Inexact[Array, "L L"]) -> Inexact[Array, "L L"]:
    """Z from the product loadᵀ A⁻¹ load, A being the stiffness with contact mass (complete) or grounding (point).

    Complete electrodes: eliminating the nodes leaves (D - BᵀA⁻¹B) U = I. Its columns sum to zero, so the diagonal
    is minus the sum of the others, which spares the cancellation in D - BᵀA⁻¹B at small contact impedance.
    """
    xp = namespace(product)
    product = (product + product.T) / 2
    size = product.shape[0]
    if electrodes.is_point:
        return centred(product)
    others = product * (1 - np.eye(size))
    schur = xp.diag(others.sum(axis=0)) - others
    # The constant vector is the null space; weight it like the rest, invert, and take it out again.
    level = xp.trace(schur) / size**2
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
