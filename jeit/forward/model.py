"""ForwardModel: conductivity in, electrode voltages and their Jacobian out."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import lineax as lx
import numpy as np
from jaxtyping import Array, Inexact
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.point import IntegratedElectrodes
from jeit.forward.system import System, check_conductivity, field_gradients
from jeit.forward.transfer import ElectrodeImpedance, electrode_fields, impedance_parts, solved_system
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers import SparseCholesky, in_turn
from jeit_solvers.engines import Recent, gather, has_values, host, namespace, on_device, on_host, sum_into

# Numbers of a Jacobian at a time, where it is made in pieces: so many stay in a core's cache.
_BLOCK = 250_000
# Cells at a time whose fields stay in a core's cache.
_CELLS = 4000


class ForwardModel(eqx.Module):
    """Electrode voltages of a body of given conductivity: ∇·(σ∇u) = 0 with the complete (or point) electrode model.

    Every method takes a conductivity: a scalar, one value per cell (m,), one per node (n,), or symmetric tensors
    (m, d, d), in siemens per metre (2-D: sheet conductivity in siemens); complex values are admittivities. One of
    another shape, not positive or not finite raises `ValueError`. Called as it is, a method answers at once, in NumPy;
    inside `jax.jit`, `jax.vmap` or a derivative it is compiled, once, and two to four times as fast from then on. All
    are differentiable in the conductivity and in every field of the model (`model.electrodes.position`,
    `.contact_impedance`, `model.mesh.points`, …).

    **Fields**: `mesh`, `electrodes`, `protocol`; `system`, the sparsity pattern and linear solver; `at_once`, whether
    NumPy answers where it can.
    """

    mesh: Mesh
    electrodes: AbstractElectrodes
    protocol: Protocol
    system: System
    at_once: bool = eqx.field(static=True)

    def __init__(
        self,
        mesh: Mesh,
        electrodes: AbstractElectrodes,
        protocol: Protocol,
        *,
        solver: str | lx.AbstractLinearSolver = "auto",
    ):
        """`solver`: "auto" (chosen by size; `model.system.solver` says which and why), "cholesky", "cg", or any lineax
        solver; one that is asked for is always compiled. Raises `ValueError` if electrodes, mesh and protocol do not
        fit together.
        """
        _check(mesh, electrodes, protocol)
        self.mesh = mesh
        self.electrodes = electrodes
        self.protocol = protocol
        with jax.ensure_compile_time_eval():  # a model may be made inside jit, of a mesh that is known
            self.system = System.create(mesh, electrodes, solver)
        # Conjugate gradients for a system too large to factorise are compiled; and a solver that was asked for is used.
        self.at_once = isinstance(solver, str) and solver == "auto" and isinstance(self.system.solver, SparseCholesky)

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

    def voltages(self, conductivity: ArrayLike) -> Inexact[Array, " M"]:
        """Voltages (M,) of the protocol's channels, in volts. `conductivity` in S/m (2-D: S); raises `ValueError`."""
        return evaluate(self, voltages_of, check_conductivity(self.mesh, conductivity))

    def transfer_impedance(self, conductivity: ArrayLike) -> Inexact[Array, "L L"]:
        """Z (L, L) in ohms: electrode potentials are U = Z I for currents I that sum to zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one.
        """
        return evaluate(self, transfer_impedance_of, check_conductivity(self.mesh, conductivity))

    def fields(self, conductivity: ArrayLike) -> tuple[Inexact[Array, "n L"], Inexact[Array, "L L"]]:
        """Potentials F (n, L) of the nodes for a unit current into each electrode that leaves evenly through all, in
        ohms, and the transfer impedance Z (L, L).

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one.
        """
        return evaluate(self, fields_of, check_conductivity(self.mesh, conductivity))

    def potentials(self, conductivity: ArrayLike) -> Inexact[Array, "S n"]:
        """Potential at the nodes for every drive pattern, in volts; the mean over the electrodes is zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one.
        """
        return evaluate(self, potentials_of, check_conductivity(self.mesh, conductivity))

    def jacobian(self, conductivity: ArrayLike) -> Inexact[Array, "M m"]:
        """∂(voltage)/∂(conductivity), volts per siemens per metre (2-D: per siemens).

        With respect to the cells (M, m); with respect to the nodes (M, n) if `conductivity` is given per node. Raises
        `ValueError` for a bad conductivity, and for tensors.
        """
        return self.voltages_and_jacobian(conductivity)[1]

    def voltages_and_jacobian(self, conductivity: ArrayLike) -> tuple[Inexact[Array, " M"], Inexact[Array, "M m"]]:
        """`voltages` and `jacobian` from one factorisation and one solve per electrode.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for a bad one, and for tensors.
        """
        conductivity = check_conductivity(self.mesh, conductivity)
        if conductivity.ndim == 3:
            raise ValueError(
                "jacobian is with respect to scalar conductivities; for tensors use jax.jacfwd or jax.jacrev of "
                "model.voltages."
            )
        return evaluate(self, voltages_and_jacobian_of, conductivity)


def evaluate(model: ForwardModel, quantity: Callable[..., Any], conductivity) -> Any:
    """A `quantity` of a model: at once where all values are at hand, compiled where anything is traced.

    `conductivity` as an array, S/m (2-D: S). It is not looked at: one that is not positive or not finite gives NaN.
    """
    if not has_values(model):
        return _COMPILED[quantity](model, conductivity)
    parts = model.mesh, model.electrodes, model.protocol, model.system
    if not (model.at_once and has_values(conductivity)):
        found = _COMPILED[quantity](integrated_model(*parts), conductivity)
        return on_host(found) if namespace(parts[:3], conductivity) is np else found
    with np.errstate(all="ignore"):
        found = quantity(host_model(*parts), on_host(conductivity))
    return found if namespace(parts[:3]) is np else on_device(found)


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
    return gather(table.reshape(-1), protocol.measurement_index * len(driven) + protocol.drive_index)


def channel_voltages(protocol: Protocol, impedance: ElectrodeImpedance) -> Inexact[Array, " M"]:
    """Voltages of the channels; what contacts add, only where current is read that goes through them."""
    across = select_channels(protocol, namespace(impedance.contact).diag(impedance.contact))
    return select_channels(protocol, impedance.body) + across


def transfer_impedance_of(model: ForwardModel | IntegratedModel, conductivity):
    """Z (L, L) in ohms, of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    return impedance_parts(model.mesh, conductivity, model.electrodes, model.system).transfer


def voltages_of(model: ForwardModel | IntegratedModel, conductivity):
    """Voltages (M,) of the channels, of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    impedance = impedance_parts(model.mesh, conductivity, model.electrodes, model.system)
    return channel_voltages(model.protocol, impedance)


def fields_of(model: ForwardModel | IntegratedModel, conductivity):
    """F (n, L) and Z (L, L) in ohms, of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    return electrode_fields(model.mesh, conductivity, model.electrodes, model.system)


def fields_and_impedance_of(model: ForwardModel | IntegratedModel, conductivity):
    """F (n, L) in ohms, against a reference near the body, and the `ElectrodeImpedance`, of a `conductivity` in S/m
    (2-D: S); for `evaluate`."""
    solved = solved_system_of(model, conductivity)
    return solved.fields()[0], solved.impedance()


def solved_system_of(model: ForwardModel | IntegratedModel, conductivity):
    """The system solved for the electrodes' loads, of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    return solved_system(model.mesh, conductivity, model.electrodes, model.system)


def potentials_of(model: ForwardModel | IntegratedModel, conductivity):
    """Potentials (S, n) in volts, of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    return model.protocol.drive @ fields_of(model, conductivity)[0].T


def voltages_and_jacobian_of(model: ForwardModel | IntegratedModel, conductivity):
    """Voltages (M,) and their Jacobian (M, m), of a `conductivity` in S/m (2-D: S); for `evaluate`."""
    mesh, protocol = model.mesh, model.protocol
    fields, impedance = fields_and_impedance_of(model, conductivity)
    if namespace(conductivity, mesh) is np:
        jacobian: Any = np.empty((protocol.num_measurements, mesh.num_cells), fields.dtype)
        for cells, block in jacobian_blocks(mesh, protocol, fields):
            jacobian[:, cells] = block
    else:
        jacobian = _of_cells(protocol, field_gradients(mesh, fields))
    if conductivity.ndim == 1 and conductivity.shape[0] != mesh.num_cells:
        per_corner = jacobian.T / mesh.cells.shape[1]
        shape = mesh.num_points, protocol.num_measurements
        corners = [sum_into(shape, mesh.cells[:, k], per_corner) for k in range(mesh.cells.shape[1])]
        jacobian = functools.reduce(operator.add, corners).T
    return channel_voltages(protocol, impedance), jacobian


def jacobian_blocks(
    mesh: Mesh, protocol: Protocol, fields: Inexact[Array, "n L"]
) -> Iterator[tuple[slice, Inexact[Array, "M b"]]]:
    """The Jacobian of the channels in the conductivity of cells, V m/S (2-D: V/S), some cells after others: of a solid
    body it is too large to be held, and what is made of it is not. In NumPy; `fields` as of `fields_of`, ohms."""
    gradient = field_gradients(mesh, fields)
    size = max(1, _BLOCK // protocol.num_measurements)
    for start in range(0, mesh.num_cells, size):
        cells = slice(start, min(start + size, mesh.num_cells))
        yield cells, _of_cells(protocol, gradient[:, cells])


def field_products(mesh: Mesh, fields: Inexact[Array, "n L"]) -> Iterator[tuple[slice, Inexact[np.ndarray, "f b"]]]:
    """∫_e ∇u_a · ∇u_b of the electrodes' fields for a ≤ b, rows as of `np.triu_indices`, some cells after others: what
    the Jacobian of any channel is a sum of. In NumPy; `fields` as of `fields_of`, ohms."""
    gradient: Any = field_gradients(mesh, fields)
    count = gradient.shape[-1]
    starts = np.cumsum([0, *range(count, 0, -1)])
    for start in range(0, mesh.num_cells, _CELLS):
        cells = slice(start, min(start + _CELLS, mesh.num_cells))
        along = np.ascontiguousarray(np.swapaxes(gradient[:, cells], 1, 2))
        products = np.zeros((starts[-1], along.shape[-1]), along.dtype)
        for field in range(count):
            rows = products[starts[field] : starts[field + 1]]
            for component in along:
                rows += component[field] * component[field:]
        yield cells, products


def _of_cells(protocol: Protocol, gradient: Inexact[Array, "d b L"]) -> Inexact[Array, "M b"]:
    """∂v/∂σ_e = -∫_e ∇u_drive · ∇u_measure, axis by axis, from the fields' gradients in cells."""
    xp, jacobian = namespace(gradient), host.zeros(())
    # One product for all patterns and axes: it also keeps XLA from computing the gradients anew for every channel.
    patterns = xp.concatenate([-protocol.drive, protocol.measurement])
    rows = patterns @ gradient.reshape(-1, gradient.shape[-1]).T
    for component in xp.split(rows, len(gradient), axis=1):
        drive = gather(component, protocol.drive_index)
        measure = gather(component, protocol.num_drives + protocol.measurement_index)
        jacobian = jacobian + drive * measure
    return jacobian


_COMPILED = {
    transfer_impedance_of: jax.jit(transfer_impedance_of),
    voltages_of: jax.jit(voltages_of),
    fields_of: jax.jit(fields_of),
    fields_and_impedance_of: jax.jit(fields_and_impedance_of),
    solved_system_of: jax.jit(solved_system_of),
    potentials_of: jax.jit(potentials_of),
    voltages_and_jacobian_of: jax.jit(in_turn(voltages_and_jacobian_of)),
}


class IntegratedModel(NamedTuple):
    """The parts of a forward model, with the integrals in place of the electrodes."""

    mesh: Mesh
    electrodes: IntegratedElectrodes
    protocol: Protocol
    system: System


def _integrated(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System) -> IntegratedModel:
    with jax.ensure_compile_time_eval():  # or what is kept would belong to the program that is being traced
        return IntegratedModel(mesh, IntegratedElectrodes(electrodes, mesh), protocol, system)


def _on_host(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System) -> IntegratedModel:
    # Electrodes of a user's own may work their integrals out in JAX.
    return on_host(_integrated(*on_host((mesh, electrodes, protocol, system))))


# A model is asked for one thing after another, and its electrodes may change while its mesh stays.
integrated_model = Recent(_integrated)
"""The `IntegratedModel` of a mesh, electrodes, a protocol and a system that all have values."""
host_model = Recent(_on_host)
"""The same in NumPy, for what is asked outside compiled code: no call waits for a compiler."""
