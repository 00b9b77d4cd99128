"""`ForwardModel`: conductivity in, electrode voltages and their Jacobian out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Inexact

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.forward.assembly import check_conductivity, field_gradients
from jeit.forward.system import System
from jeit.forward.transfer import electrode_fields, transfer_impedance
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers import in_turn


class ForwardModel(eqx.Module):
    """Electrode voltages of a body of given conductivity: ∇·(σ∇u) = 0 with the complete (or point) electrode model.

    Every method takes a conductivity: a scalar, one value per cell (m,), one per node (n,), or symmetric tensors
    (m, d, d), in siemens per metre (2-D: sheet conductivity in siemens); complex values are admittivities. One of
    another shape, not positive or not finite raises `ValueError`. All are jit-compiled, differentiable in the
    conductivity and in every field of the model (`model.electrodes.position`, `.contact_impedance`,
    `model.mesh.points`, …), and may be wrapped in `jax.vmap`.

    **Fields**: `mesh`, `electrodes`, `protocol`, and `system`, the sparsity pattern and linear solver.
    """

    mesh: Mesh
    electrodes: AbstractElectrodes
    protocol: Protocol
    system: System

    def __init__(
        self,
        mesh: Mesh,
        electrodes: AbstractElectrodes,
        protocol: Protocol,
        *,
        solver: str | lx.AbstractLinearSolver = "auto",
    ):
        """`solver`: "auto" (chosen by size; `model.system.solver` says which and why), "cholesky", "cg", or any
        lineax solver. Raises `ValueError` if electrodes, mesh and protocol do not fit together.
        """
        _check(mesh, electrodes, protocol)
        self.mesh = mesh
        self.electrodes = electrodes
        self.protocol = protocol
        self.system = System.create(mesh, electrodes, solver)

    def with_electrodes(self, electrodes: AbstractElectrodes) -> "ForwardModel":
        """The same model with other electrodes of the same kind, as many; works under jit. Raises `ValueError` for
        others, and for electrodes that do not fit the mesh."""
        if type(electrodes) is not type(self.electrodes):
            raise ValueError(
                f"with_electrodes needs {type(self.electrodes).__name__}, not {type(electrodes).__name__}; make a new "
                "ForwardModel for another kind of electrode."
            )
        _check(self.mesh, electrodes, self.protocol)
        return eqx.tree_at(lambda model: model.electrodes, self, electrodes)

    def with_protocol(self, protocol: Protocol) -> "ForwardModel":
        """The same model with another protocol; `ValueError` unless it is for as many electrodes."""
        _check(self.mesh, self.electrodes, protocol)
        return eqx.tree_at(lambda model: model.protocol, self, protocol)

    def voltages(self, conductivity) -> Inexact[Array, " M"]:
        """Voltages (M,) of the protocol's channels, in volts. `conductivity` in S/m (2-D: S); raises `ValueError`."""
        return _voltages(self, check_conductivity(self.mesh, conductivity))

    def transfer_impedance(self, conductivity) -> Inexact[Array, "L L"]:
        """Z (L, L) in ohms: electrode potentials are U = Z I for currents I that sum to zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one.
        """
        return _transfer_impedance(self, check_conductivity(self.mesh, conductivity))

    def potentials(self, conductivity) -> Inexact[Array, "S n"]:
        """Potential at the nodes for every drive pattern, in volts; the mean over the electrodes is zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one.
        """
        return _potentials(self, check_conductivity(self.mesh, conductivity))

    def jacobian(self, conductivity) -> Inexact[Array, "M m"]:
        """∂(voltage)/∂(conductivity), volts per siemens per metre (2-D: per siemens).

        With respect to the cells (M, m); with respect to the nodes (M, n) if `conductivity` is given per node. Raises
        `ValueError` for a bad conductivity, and for tensors.
        """
        return self.voltages_and_jacobian(conductivity)[1]

    def voltages_and_jacobian(self, conductivity) -> tuple[Inexact[Array, " M"], Inexact[Array, "M m"]]:
        """`voltages` and `jacobian` from one factorisation and one solve per electrode.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one, and for tensors.
        """
        conductivity = check_conductivity(self.mesh, conductivity)
        if conductivity.ndim == 3:
            raise ValueError(
                "jacobian is with respect to scalar conductivities; for tensors use jax.jacfwd or jax.jacrev of "
                "model.voltages."
            )
        return _voltages_and_jacobian(self, conductivity)


def check_model(model: ForwardModel) -> None:
    """Raise `ValueError` for what is no `ForwardModel`."""
    check_kind("model", model, ForwardModel, "a ForwardModel(mesh, electrodes, protocol)")


def _check(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol) -> None:
    if not isinstance(mesh, Mesh):
        raise ValueError(f"mesh must be a Mesh, not {type(mesh).__name__}; see jeit.mesh.disk and jeit.mesh.read.")
    if not isinstance(electrodes, AbstractElectrodes):
        raise ValueError(
            f"electrodes must be one of the kinds in jeit.electrodes, not {type(electrodes).__name__}; positions "
            "become electrodes with PointElectrodes(position) or BoundaryElectrodes(position, width, "
            "contact_impedance)."
        )
    if not isinstance(protocol, Protocol):
        raise ValueError(f"protocol must be a jeit.protocol.Protocol, not {type(protocol).__name__}.")
    if electrodes.num_electrodes != protocol.num_electrodes:
        raise ValueError(
            f"There are {electrodes.num_electrodes} electrodes, and protocol '{protocol.name}' is for "
            f"{protocol.num_electrodes}; make both for the same number."
        )
    with jax.ensure_compile_time_eval():  # a model may be made inside jit, of values that are known
        electrodes.check(mesh)


def select_channels(protocol: Protocol, impedance) -> Inexact[Array, " M"]:
    """Voltages of the channels: entries of measurement · Z · driveᵀ, or they alone where that is less work."""
    measured, driven = protocol.measurement, protocol.drive
    each, every = protocol.num_measurements * len(impedance), len(measured) * (len(impedance) + len(driven))
    if each < every:
        products = (measured[protocol.measurement_index] @ impedance) * driven[protocol.drive_index]
        return products.sum(axis=1)
    table = measured @ impedance @ driven.T
    return table.at[protocol.measurement_index, protocol.drive_index].get(mode="promise_in_bounds")


@jax.jit
def _transfer_impedance(model: ForwardModel, conductivity):
    return transfer_impedance(model.mesh, conductivity, model.electrodes, model.system)


@jax.jit
def _voltages(model: ForwardModel, conductivity):
    return select_channels(model.protocol, _transfer_impedance(model, conductivity))


@jax.jit
def _potentials(model: ForwardModel, conductivity):
    fields, _ = electrode_fields(model.mesh, conductivity, model.electrodes, model.system)
    return model.protocol.drive @ fields.T


@jax.jit
@in_turn
def _voltages_and_jacobian(model: ForwardModel, conductivity):
    mesh, protocol = model.mesh, model.protocol
    fields, impedance = electrode_fields(mesh, conductivity, model.electrodes, model.system)
    # One product for all patterns and axes: it also keeps XLA from computing the gradients anew for every channel.
    patterns = jnp.concatenate([-protocol.drive, protocol.measurement])
    gradient = field_gradients(mesh, fields)
    rows = patterns @ gradient.reshape(-1, gradient.shape[-1]).T
    # ∂v/∂σ_e = -∫_e ∇u_drive · ∇u_measure, axis by axis.
    jacobian = jnp.zeros(())
    for component in jnp.split(rows, mesh.dimension, axis=1):
        drive = component.at[protocol.drive_index].get(mode="promise_in_bounds")
        measure = component.at[protocol.num_drives + protocol.measurement_index].get(mode="promise_in_bounds")
        jacobian += drive * measure
    if conductivity.ndim == 1 and conductivity.shape[0] != mesh.num_cells:
        per_corner = jacobian / mesh.cells.shape[1]
        jacobian = sum(
            jax.ops.segment_sum(per_corner.T, mesh.cells[:, k], num_segments=mesh.num_points).T
            for k in range(mesh.cells.shape[1])
        )
    return select_channels(protocol, impedance), jacobian
