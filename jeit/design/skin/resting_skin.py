"""`RestingSkin`: precomputed quantities of an untouched skin, for exact voltage changes due to many touches."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.design.skin.touched_cells import TouchedCells, touched_nodes
from jeit.design.skin.voltage_changes import EXACT_AT_ONCE, cell_stiffness, changes_between, check_finite_changes
from jeit.forward import ForwardModel
from jeit.forward.model import channel_voltages, check_model, evaluate, solved_system_of
from jeit.forward.system import cell_conductivity, check_conductivity
from jeit.forward.transfer import fields_and_inverse
from jeit_solvers import NearInverse, Strips, over_cores
from jeit_solvers.engines import on_device
from jeit_solvers.module import Module

# Number of touches per call of a compiled program, and ratios of successive sizes to which a touch's numbers of nodes
# and of cells are padded. One program is compiled for each size, and the cost of a touch grows with the square of its
# number of nodes.
_TOUCHES_PER_CALL, _NODE_SIZE_RATIO, _CELL_SIZE_RATIO = 2 * EXACT_AT_ONCE, 2**0.5, 2.0


class RestingSkin(Module):
    """An untouched skin, with the entries of the inverse system matrix for all pairs of nodes that may be touched.

    **Fields**

    - `model`: forward model of the skin; `voltages` (M,): voltages of the M channels without a touch, volts.
    - `element` (m, q, q): contribution of each of m cells with q nodes to the system matrix.
    - `strips`: the nodes that may be touched, ordered in strips across the skin.
    - `fields` (p, L): potentials at these p nodes for unit currents into the L electrodes; `inverse`: entries of the
      inverse system matrix for pairs of these nodes.
    """

    model: ForwardModel
    voltages: Float[Array, " M"]
    element: Float[Array, "m q q"]
    strips: Strips
    fields: Float[Array, "p L"]
    inverse: NearInverse

    @classmethod
    def create(
        cls, model: ForwardModel, conductivity, touchable: Bool[np.ndarray, " n"], *, max_bytes: float = 2**31
    ) -> "RestingSkin | None":
        """Precompute the quantities of an untouched skin from its forward model and its `conductivity`, S/m (2-D: S).

        `touchable`: mask (n,) of the nodes that touches may reach. Returns None if the inverse would take more than
        `max_bytes` bytes. The inverse takes slightly more than 8 bytes for each pair of touchable nodes. Raises
        `ValueError` if `model` is not a forward model, and for an invalid conductivity.
        """
        check_model(model)
        conductivity = cell_conductivity(model.mesh, check_conductivity(model.mesh, conductivity))
        strips = Strips.create(model.system.pattern, np.asarray(model.mesh.points), np.asarray(touchable))
        if 8 * float(strips.num_strips * strips.selected_per_strip) ** 2 > max_bytes:
            return None
        solved = evaluate(model, solved_system_of, conductivity)
        voltages = channel_voltages(model.protocol, solved.impedance())
        skin_fields_and_inverse = fields_and_inverse(solved, strips, max(strips.num_strips - 1, 1))
        return cls(model, voltages, cell_stiffness(model, conductivity), strips, *skin_fields_and_inverse)

    def changes(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """Compute the exact voltage changes (n, M) of M channels due to n single touches, volts, as `touch_changes`
        does. Raises `RuntimeError` in the cases of `touch_changes`."""
        touched_at = touched_nodes(self.model, touched, self.strips)
        cells, relative_changes = np.asarray(touched.cells), np.asarray(touched.change)
        num_changed_cells = np.count_nonzero(relative_changes, axis=1)
        sizes = np.stack(
            [
                _padded_size((touched_at.nodes < touched_at.nodes[:, -1:]).sum(axis=1) + 1, _NODE_SIZE_RATIO),
                _padded_size(num_changed_cells, _CELL_SIZE_RATIO),
            ],
            axis=1,
        )
        voltage_changes = np.zeros((len(cells), self.model.protocol.num_measurements))
        skin_fields_and_inverse = self.fields, self.inverse
        for size in np.unique(sizes[num_changed_cells > 0], axis=0):
            touches_of_size = np.flatnonzero((sizes == size).all(axis=1) & (num_changed_cells > 0))
            padded_nodes = _pad_rows(touched_at.nodes, size[0], "edge")
            arrays = (_pad_rows(array, size[1], "constant") for array in (cells, relative_changes, touched_at.corners))
            padded_cells, padded_changes, padded_corners = arrays
            for chunk in np.split(touches_of_size, range(_TOUCHES_PER_CALL, len(touches_of_size), _TOUCHES_PER_CALL)):
                rows = chunk[np.minimum(np.arange(_TOUCHES_PER_CALL), len(chunk) - 1)]
                touches = on_device(
                    (padded_cells[rows], padded_changes[rows], padded_nodes[rows], padded_corners[rows])
                )
                work = partial(changes_between, self.model.protocol, self.element, skin_fields_and_inverse, touches)
                voltage_changes[chunk] = np.asarray(over_cores(work, _TOUCHES_PER_CALL, EXACT_AT_ONCE))[: len(chunk)]
        check_finite_changes(voltage_changes, np.asarray(touched.places))
        return voltage_changes


def _padded_size(count, ratio: float):
    """Round `count` up to the next number in a series of multiples of 16, in which each is about `ratio` times the
    previous multiple."""
    exponent = np.ceil(np.log(np.maximum(count, 16) / 16) / np.log(ratio) - 1e-9)
    return (np.ceil(ratio**exponent - 1e-9) * 16).astype(int)


def _pad_rows(rows: np.ndarray, length: int, mode) -> np.ndarray:
    """Truncate or pad the n rows of `rows` (n, k, …) from k to `length` entries."""
    num_missing = max(length - rows.shape[1], 0)
    return np.pad(rows[:, :length], [(0, 0), (0, num_missing), *[(0, 0)] * (rows.ndim - 2)], mode)
