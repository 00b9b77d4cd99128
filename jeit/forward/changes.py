"""Derivatives of the voltages along changes of the conductivity that reach few cells, with no Jacobian of them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from jeit.forward.assembly import field_gradients, stiffness
from jeit.forward.model import ForwardModel, channel_voltages, evaluate, fields_and_impedance_of, select_channels
from jeit.forward.transfer import ElectrodeImpedance
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers.engines import on_host

# Cells at a time, whose products of gradients stay near the processor.
_CELLS = 256


class Change(NamedTuple):
    """How conductivity changes by q coefficients: by `slope` (k, q), S/m (2-D: S), in `cells` (k,), not elsewhere; in
    all cells where `cells` is None."""

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
        energy = np.concatenate([self._energy(*change) for change in changes])
        return np.stack([-select_channels(self.protocol, one) for one in energy], axis=1)  # pyright: ignore

    def _energy(self, cells, slope) -> Float[np.ndarray, "q L L"]:
        """∫ dσ ∇F_k · ∇F_l for every coefficient: where all cells change by the matrix of stiffness, which nodes know;
        where some do by the gradients in these."""
        fields: Any = self.fields
        if cells is None:
            return np.stack([self._energy_everywhere(one) for one in slope.T])
        there = np.asarray(self.mesh.cells)[cells]
        nodes, corners = np.unique(there, return_inverse=True)
        points = np.asarray(self.mesh.points)[nodes]
        part = replace(self.mesh, points=points, cells=corners.reshape(there.shape), tags={})
        return _energy(field_gradients(part, fields[nodes]), slope)

    def _energy_everywhere(self, change: Float[np.ndarray, " m"]) -> Float[np.ndarray, "L L"]:
        cells, size = np.asarray(self.mesh.cells), self.mesh.num_points
        rows, columns = np.tril_indices(cells.shape[1])
        values: Any = np.array(stiffness(self.mesh, change))  # pyright: ignore[reportArgumentType]
        values[rows == columns] /= 2
        places = (cells[:, rows].T.ravel(), cells[:, columns].T.ravel())
        lower = scipy.sparse.coo_array((values.ravel(), places), shape=(size, size)).tocsr()
        half = self.fields.T @ (lower @ self.fields)
        return half + half.T


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
