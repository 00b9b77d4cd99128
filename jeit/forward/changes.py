"""Derivatives of the voltages along changes of the conductivity that reach few cells, with no Jacobian of them all."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.forward.assembly import field_gradients
from jeit.forward.model import ForwardModel, channel_voltages, evaluate, fields_and_impedance_of, select_channels
from jeit.forward.transfer import ElectrodeImpedance
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers.engines import on_host

# Cells at a time, whose products of gradients stay near the processor.
_CELLS = 256


class Change(NamedTuple):
    """How conductivity changes by q coefficients: by `slope` (k, q), S/m (2-D: S), in `cells` (k,), not elsewhere."""

    cells: Any
    slope: Float[np.ndarray, "k q"]


class SolvedFields(NamedTuple):
    """**Fields**: `mesh` and `protocol` of a model; `fields` F (n, L) and `impedance`, ohms; all in NumPy."""

    mesh: Mesh
    protocol: Protocol
    fields: Float[np.ndarray, "n L"]
    impedance: ElectrodeImpedance

    @property
    def voltages(self) -> Float[np.ndarray, " M"]:
        """Voltages of the channels (M,)."""
        return channel_voltages(self.protocol, self.impedance)  # pyright: ignore[reportReturnType]

    def derivatives(self, changes: Sequence[Change]) -> Float[np.ndarray, "M n"]:
        """Their derivatives by the coefficients of all `changes`: each -∫ dσ ∇u_drive · ∇u_measure, worked out for
        pairs of electrodes."""
        gradient = field_gradients(self.mesh, self.fields)  # pyright: ignore[reportArgumentType]
        energy = np.concatenate([_energy(gradient[:, change.cells], change.slope) for change in changes])
        return np.stack([-select_channels(self.protocol, one) for one in energy], axis=1)  # pyright: ignore


def solved_fields(model: ForwardModel, conductivity: Float[np.ndarray, " m"]) -> SolvedFields:
    """The fields of a model for a `conductivity` per cell, S/m (2-D: S); checks nothing."""
    fields, impedance = evaluate(model, fields_and_impedance_of, conductivity)
    return SolvedFields(*on_host((model.mesh, model.protocol, fields, impedance)))


def _energy(gradient, slope) -> Float[np.ndarray, "q L L"]:
    """∫ dσ ∇F_k · ∇F_l for every coefficient."""
    number = gradient.shape[-1]
    energy = np.zeros((slope.shape[1], number**2), np.result_type(gradient, slope))
    for start in range(0, len(slope), _CELLS):
        some = slice(start, start + _CELLS)
        local = np.ascontiguousarray(np.moveaxis(gradient[:, some], 0, -1))
        energy += slope[some].T @ (local @ local.transpose(0, 2, 1)).reshape(len(local), -1)
    return energy.reshape(-1, number, number)
