"""`ForwardModel`: electrode voltages and their Jacobian for a given conductivity."""

from __future__ import annotations

import functools
import operator
import types
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import lineax as lx
import numpy as np
from jaxtyping import Array, Inexact
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, object_text
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.point import IntegratedElectrodes
from jeit.forward.system import System, check_conductivity, field_gradients
from jeit.forward.transfer import ElectrodeImpedance, electrode_fields, impedance_parts, solved_system
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers import in_turn, on_cores
from jeit_solvers.engines import (
    RecentResultsCache,
    empty_for_jax,
    gather,
    has_values,
    host,
    namespace,
    on_device,
    on_host,
    sum_into,
)
from jeit_solvers.module import Module

# Maximum number of entries of a block of the Jacobian, so that the block fits in the cache of a core.
_MAX_BLOCK_ENTRIES = 250_000
# Minimum number of blocks that are distributed over the cores.
_MIN_PARALLEL_BLOCKS = 20
# Number of cells processed at a time, so that their fields fit in the cache of a core.
_CELLS_AT_ONCE = 4000


class _BoundMethod(Module):
    """Bound method of a model that `jax.jit` accepts. JAX needs a hash of the function that it compiles. The arrays of
    the model cannot be hashed, so the hash is computed from the identity of the model object."""

    __func__: Callable[..., Any] = eqx.field(static=True)
    __self__: eqx.Module

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        return self.__func__(self.__self__, *arguments, **keywords)

    @property
    def __wrapped__(self) -> Any:  # the function that `help` and signatures show
        return types.MethodType(self.__func__, self.__self__)

    def __hash__(self) -> int:
        return hash((self.__func__, id(self.__self__)))

    def __eq__(self, other: object) -> Any:
        return isinstance(other, _BoundMethod) and self.__func__ is other.__func__ and self.__self__ is other.__self__


class _CompilableMethod:
    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.__doc__ = function.__doc__

    def __get__(self, model: eqx.Module | None, owner: type | None = None) -> Any:
        return self.function if model is None else _BoundMethod(self.function, model)


Function = TypeVar("Function", bound=Callable[..., Any])


def compilable(function: Function) -> Function:
    """Decorate a method of a model so that `jax.jit(model.method)` works; the arrays of the model are then constants of
    the compiled program."""
    return cast(Function, _CompilableMethod(function))


class ForwardModel(Module):
    """Electrode voltages of a body of given conductivity σ: solves ∇·(σ∇u) = 0 with the complete (or point) electrode
    model.

    Every method takes a conductivity in siemens per metre (2-D: sheet conductivity in siemens): a scalar, one value per
    cell (m,), one value per node (n,), or a symmetric tensor per cell (m, d, d). Complex values are admittivities. A
    conductivity that has a different shape, or is not positive or not finite, raises `ValueError`. A method that is
    called directly runs in NumPy. Inside `jax.jit`, as in `jax.jit(model.voltages)`, `jax.vmap` or a derivative, the
    method is compiled at the first call, and is two to four times as fast afterwards. All methods are differentiable
    with respect to the conductivity and every field of the model (`model.electrodes.position`, `.contact_impedance`,
    `model.mesh.points`, …).

    **Arguments:**

    - `mesh`, `electrodes`, `protocol`: the body, its electrodes, and the drive and measurement patterns.
    - `solver`: "auto" (chosen by size; `model.system.solver` states which solver and why), "cholesky", "cg", or any
      lineax solver. With "auto", `jeit_solvers.Multigrid` or `jeit_solvers.Pardiso`, methods run in NumPy where
      possible; with other solvers they are always compiled.

    **Fields**: `mesh`, `electrodes`, `protocol`; `system`: sparsity pattern and linear solver; `at_once`: whether
    methods run in NumPy where possible.

    **Example:**

    ```python
    model = ForwardModel(mesh, electrodes, adjacent(16))
    voltages, jacobian = model.voltages(1.0), model.jacobian(1.0)
    ```
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
        """Arguments as for the class. Raises `ValueError` if electrodes do not lie on the mesh, or if the protocol has
        a different number of electrodes."""
        _check_model_parts(mesh, electrodes, protocol)
        self.mesh = mesh
        self.electrodes = electrodes
        self.protocol = protocol
        with jax.ensure_compile_time_eval():  # a model may be created inside jit, with a known mesh
            self.system = System.create(mesh, electrodes, solver)
        self.at_once = self.system.at_once

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"ForwardModel({self.mesh!r},\n  {type(self.electrodes).__name__}, {self.protocol!r}, "
                f"{type(self.system.solver).__name__})"
            ),
            self,
        )

    def with_electrodes(self, electrodes: AbstractElectrodes) -> "ForwardModel":
        """Copy of the model with different electrodes of the same kind and number; works under `jax.jit`. Raises
        `ValueError` for electrodes of a different kind or number, and for electrodes that do not fit the mesh."""
        if type(electrodes) is not type(self.electrodes):
            raise ValueError(
                f"with_electrodes needs {type(self.electrodes).__name__}, not {type(electrodes).__name__}; make a new "
                "ForwardModel for another kind of electrode."
            )
        _check_model_parts(self.mesh, electrodes, self.protocol)
        return eqx.tree_at(lambda model: model.electrodes, self, electrodes)

    def with_protocol(self, protocol: Protocol) -> "ForwardModel":
        """Copy of the model with a different protocol. Raises `ValueError` unless the protocol has the same number of
        electrodes."""
        _check_model_parts(self.mesh, self.electrodes, protocol)
        return eqx.tree_at(lambda model: model.protocol, self, protocol)

    @compilable
    def voltages(self, conductivity: ArrayLike) -> Inexact[Array, " M"]:
        """Voltages (M,) of the protocol's channels, in volts.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
        """
        return evaluate(self, voltages_of, check_conductivity(self.mesh, conductivity))

    @compilable
    def transfer_impedance(self, conductivity: ArrayLike) -> Inexact[Array, "L L"]:
        """Transfer impedance Z (L, L) in ohms: electrode potentials are U = Z I for currents I that sum to zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
        """
        return evaluate(self, transfer_impedance_of, check_conductivity(self.mesh, conductivity))

    @compilable
    def fields(self, conductivity: ArrayLike) -> tuple[Inexact[Array, "n L"], Inexact[Array, "L L"]]:
        """Potentials F (n, L) of the nodes per unit current, in ohms, for a current into each electrode that leaves
        through all electrodes in equal parts; and the transfer impedance Z (L, L).

        `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
        """
        return evaluate(self, fields_of, check_conductivity(self.mesh, conductivity))

    @compilable
    def potentials(self, conductivity: ArrayLike) -> Inexact[Array, "S n"]:
        """Potentials (S, n) at the nodes for every drive pattern, in volts; the mean over the electrodes is zero.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity.
        """
        return evaluate(self, potentials_of, check_conductivity(self.mesh, conductivity))

    @compilable
    def jacobian(self, conductivity: ArrayLike) -> Inexact[Array, "M m"]:
        """Jacobian ∂(voltage)/∂(conductivity), in volts per siemens per metre (2-D: volts per siemens).

        Its shape is (M, m), with respect to the cells, or, for a conductivity per node, (M, n), with respect to the
        nodes. Raises `ValueError` for an invalid conductivity, and for tensors.
        """
        return self.voltages_and_jacobian(conductivity)[1]

    @compilable
    def voltages_and_jacobian(self, conductivity: ArrayLike) -> tuple[Inexact[Array, " M"], Inexact[Array, "M m"]]:
        """Voltages and Jacobian, as from `voltages` and `jacobian`, with a single factorisation and one solve per
        electrode.

        `conductivity` in S/m (2-D: S). Raises `ValueError` for an invalid conductivity, and for tensors.
        """
        conductivity = check_conductivity(self.mesh, conductivity)
        if conductivity.ndim == 3:
            raise ValueError(
                "jacobian is with respect to scalar conductivities; for tensors use jax.jacfwd or jax.jacrev of "
                "model.voltages."
            )
        return evaluate(self, voltages_and_jacobian_of, conductivity)


def evaluate(model: ForwardModel, quantity: Callable[..., Any], conductivity) -> Any:
    """Evaluate a `quantity` of a model, such as `voltages_of`: in NumPy if all values are known, in a compiled program
    if any array is traced.

    `conductivity`: an array in S/m (2-D: S). Its values are not checked: values that are not positive or not finite
    yield NaN.
    """
    if not has_values(model):
        return _COMPILED_QUANTITIES[quantity](model, conductivity)
    model_parts = model.mesh, model.electrodes, model.protocol, model.system
    if not (model.at_once and has_values(conductivity)):
        quantity_values = _COMPILED_QUANTITIES[quantity](integrated_model(*model_parts), conductivity)
        return on_host(quantity_values) if namespace(model_parts[:3], conductivity) is np else quantity_values
    with np.errstate(all="ignore"):
        quantity_values = quantity(host_model(*model_parts), on_host(conductivity))
    return quantity_values if namespace(model_parts[:3]) is np else on_device(quantity_values)


def check_model(model: ForwardModel) -> None:
    """Raise `ValueError` unless `model` is a `ForwardModel`."""
    check_kind("model", model, ForwardModel, "a ForwardModel(mesh, electrodes, protocol)")


def _check_model_parts(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol) -> None:
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
    with jax.ensure_compile_time_eval():  # a model may be created inside jit, with known values
        electrodes.check(mesh)


def select_channels(protocol: Protocol, impedance) -> Inexact[Array, " M"]:
    """Voltages of the channels (M,) for a transfer impedance Z: entries of the matrix measurement · Z · driveᵀ. The
    full matrix is computed only where this takes less work than computing the entries one by one."""
    measurement, drive = protocol.measurement, protocol.drive
    num_direct_products, num_matrix_products = (
        protocol.num_measurements * len(impedance),
        len(measurement) * (len(impedance) + len(drive)),
    )
    if num_direct_products < num_matrix_products:
        electrode_products = (measurement[protocol.measurement_index] @ impedance) * drive[protocol.drive_index]
        return electrode_products.sum(axis=1)
    voltage_table = measurement @ impedance @ drive.T
    return gather(voltage_table.reshape(-1), protocol.measurement_index * len(drive) + protocol.drive_index)


def channel_voltages(protocol: Protocol, impedance: ElectrodeImpedance) -> Inexact[Array, " M"]:
    """Voltages (M,) of the channels of a protocol for given impedances of the electrodes. Contact impedances contribute
    only to channels that measure an electrode that carries current."""
    contact_voltages = select_channels(protocol, namespace(impedance.contact).diag(impedance.contact))
    return select_channels(protocol, impedance.body) + contact_voltages


def transfer_impedance_of(model: ForwardModel | IntegratedModel, conductivity):
    """Transfer impedance Z (L, L) in ohms, for a `conductivity` in S/m (2-D: S); a quantity for `evaluate`."""
    return impedance_parts(model.mesh, conductivity, model.electrodes, model.system).transfer


def voltages_of(model: ForwardModel | IntegratedModel, conductivity):
    """Voltages (M,) of the channels, for a `conductivity` in S/m (2-D: S); a quantity for `evaluate`."""
    impedance = impedance_parts(model.mesh, conductivity, model.electrodes, model.system)
    return channel_voltages(model.protocol, impedance)


def fields_of(model: ForwardModel | IntegratedModel, conductivity):
    """Fields F (n, L) and transfer impedance Z (L, L) as defined in `ForwardModel.fields`, in ohms, for a
    `conductivity` in S/m (2-D: S); a quantity for `evaluate`."""
    return electrode_fields(model.mesh, conductivity, model.electrodes, model.system)


def fields_and_impedance_of(model: ForwardModel | IntegratedModel, conductivity):
    """Fields F (n, L) as defined in `ForwardModel.fields`, in ohms, but relative to a reference potential near the
    body; and the `ElectrodeImpedance`, for a `conductivity` in S/m (2-D: S); a quantity for `evaluate`."""
    solved = solved_system_of(model, conductivity)
    return solved.fields()[0], solved.impedance()


def solved_system_of(model: ForwardModel | IntegratedModel, conductivity):
    """The `SolvedSystem` for unit currents into the electrodes, for a `conductivity` in S/m (2-D: S); a quantity for
    `evaluate`."""
    return solved_system(model.mesh, conductivity, model.electrodes, model.system)


def potentials_of(model: ForwardModel | IntegratedModel, conductivity):
    """Potentials (S, n) of the nodes for every drive pattern, in volts, for a `conductivity` in S/m (2-D: S); a
    quantity for `evaluate`."""
    return model.protocol.drive @ fields_of(model, conductivity)[0].T


def voltages_and_jacobian_of(model: ForwardModel | IntegratedModel, conductivity):
    """Voltages (M,) and their Jacobian (M, m), or (M, n) for a conductivity per node, for a `conductivity` in S/m (2-D:
    S); a quantity for `evaluate`."""
    mesh, protocol = model.mesh, model.protocol
    fields, impedance = fields_and_impedance_of(model, conductivity)
    if namespace(conductivity, mesh) is np:
        jacobian: Any = _whole_jacobian(mesh, protocol, fields)
    else:
        jacobian = _jacobian_of_cells(protocol, field_gradients(mesh, fields))
    if conductivity.ndim == 1 and conductivity.shape[0] != mesh.num_cells:
        per_corner = jacobian.T / mesh.cells.shape[1]
        jacobian_shape = mesh.num_points, protocol.num_measurements
        corners = [sum_into(jacobian_shape, mesh.cells[:, k], per_corner) for k in range(mesh.cells.shape[1])]
        jacobian = functools.reduce(operator.add, corners).T
    return channel_voltages(protocol, impedance), jacobian


def _whole_jacobian(mesh: Mesh, protocol: Protocol, fields: Inexact[Array, "n L"]) -> Inexact[np.ndarray, "M m"]:
    gradient = field_gradients(mesh, fields)
    jacobian = empty_for_jax((protocol.num_measurements, mesh.num_cells), np.dtype(fields.dtype))

    def fill_block(cells: slice) -> None:
        jacobian[:, cells] = _jacobian_of_cells(protocol, gradient[:, cells])

    cell_blocks = _blocks_of_cells(mesh, protocol)
    if len(cell_blocks) < _MIN_PARALLEL_BLOCKS:
        for cells in cell_blocks:
            fill_block(cells)
    else:
        on_cores(fill_block, cell_blocks)
    return jacobian


def _blocks_of_cells(mesh: Mesh, protocol: Protocol) -> list[slice]:
    cells_per_block = max(1, _MAX_BLOCK_ENTRIES // protocol.num_measurements)
    return [
        slice(first_cell, min(first_cell + cells_per_block, mesh.num_cells))
        for first_cell in range(0, mesh.num_cells, cells_per_block)
    ]


def jacobian_blocks(
    mesh: Mesh, protocol: Protocol, fields: Inexact[Array, "n L"]
) -> Iterator[tuple[slice, Inexact[Array, "M b"]]]:
    """Jacobian of the channels with respect to the conductivity of cells, in V m/S (2-D: V/S). It is computed in blocks
    (M, b) of consecutive cells, because the whole Jacobian of a solid does not fit in memory. Computed in NumPy from
    the `fields` (n, L) of `fields_of`, in ohms."""
    gradient = field_gradients(mesh, fields)
    for cells in _blocks_of_cells(mesh, protocol):
        yield cells, _jacobian_of_cells(protocol, gradient[:, cells])


def field_products(mesh: Mesh, fields: Inexact[Array, "n L"]) -> Iterator[tuple[slice, Inexact[np.ndarray, "f b"]]]:
    """Integrals ∫_e ∇u_a · ∇u_b over each cell e, where u_a and u_b are the fields of electrodes a ≤ b, as blocks of
    consecutive cells. Rows are in the order of `np.triu_indices`. The Jacobian of any channel is a weighted sum of
    these integrals. Computed in NumPy from the `fields` (n, L) of `fields_of`, in ohms."""
    gradient: Any = field_gradients(mesh, fields)
    num_fields = gradient.shape[-1]
    first_rows = np.cumsum([0, *range(num_fields, 0, -1)])
    for first_cell in range(0, mesh.num_cells, _CELLS_AT_ONCE):
        cells = slice(first_cell, min(first_cell + _CELLS_AT_ONCE, mesh.num_cells))
        cell_gradients = np.ascontiguousarray(np.swapaxes(gradient[:, cells], 1, 2))
        pair_products = np.zeros((first_rows[-1], cell_gradients.shape[-1]), cell_gradients.dtype)
        for field_index in range(num_fields):
            rows_of_field = pair_products[first_rows[field_index] : first_rows[field_index + 1]]
            for gradient_component in cell_gradients:
                rows_of_field += gradient_component[field_index] * gradient_component[field_index:]
        yield cells, pair_products


def _jacobian_of_cells(protocol: Protocol, gradient: Inexact[Array, "d b L"]) -> Inexact[Array, "M b"]:
    """Jacobian ∂v/∂σ_e = -∫_e ∇u_drive · ∇u_measure of the channels for b cells e, summed axis by axis from the
    gradients of the electrodes' fields in the cells."""
    xp, jacobian = namespace(gradient), host.zeros(())
    # With a single product for all patterns and axes, XLA does not recompute the gradients for every channel.
    channel_patterns = xp.concatenate([-protocol.drive, protocol.measurement])
    pattern_gradients = channel_patterns @ gradient.reshape(-1, gradient.shape[-1]).T
    for gradient_component in xp.split(pattern_gradients, len(gradient), axis=1):
        drive = gather(gradient_component, protocol.drive_index)
        measurement_gradients = gather(gradient_component, protocol.num_drives + protocol.measurement_index)
        jacobian = jacobian + drive * measurement_gradients
    return jacobian


_COMPILED_QUANTITIES = {
    transfer_impedance_of: jax.jit(transfer_impedance_of),
    voltages_of: jax.jit(voltages_of),
    fields_of: jax.jit(fields_of),
    fields_and_impedance_of: jax.jit(fields_and_impedance_of),
    solved_system_of: jax.jit(solved_system_of),
    potentials_of: jax.jit(potentials_of),
    voltages_and_jacobian_of: jax.jit(in_turn(voltages_and_jacobian_of)),
}


class IntegratedModel(NamedTuple):
    """Parts of a forward model, in which the electrodes are replaced by the integrals of the basis functions over
    them."""

    mesh: Mesh
    electrodes: IntegratedElectrodes
    protocol: Protocol
    system: System


def _integrate_electrodes(
    mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System
) -> IntegratedModel:
    with jax.ensure_compile_time_eval():  # otherwise the cached arrays would belong to the program being traced
        return IntegratedModel(mesh, IntegratedElectrodes(electrodes, mesh), protocol, system)


def _integrate_on_host(
    mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System
) -> IntegratedModel:
    # Electrodes defined by a user may compute their integrals in JAX.
    return on_host(_integrate_electrodes(*on_host((mesh, electrodes, protocol, system))))


# A model is usually evaluated many times, and its electrodes may change while its mesh stays the same.
integrated_model = RecentResultsCache(_integrate_electrodes)
"""The `IntegratedModel` of a mesh, electrodes, a protocol and a system whose values are all known."""
host_model = RecentResultsCache(_integrate_on_host)
"""The same as `integrated_model`, but in NumPy, for calls outside compiled code, which then need no compilation."""
