"""Voltage changes due to single touches of a skin: exact, by low-rank updates of one factorisation, or linearised; and
`RestingSkin`: precomputed quantities of an untouched skin, for exact changes due to many touches.

A touch adds a matrix D to the system matrix K of the electrode model; D is nonzero only between the k nodes of the
touch. Let F be the potentials for unit currents into the electrodes and G = K⁻¹, both restricted to these k nodes. By
the Sherman-Morrison-Woodbury formula, the transfer impedance changes by

    ΔZ = −Fᵀ D F + (D F)ᵀ Y,    (G⁻¹ + D) Y = D F.

The system for Y is solved by conjugate gradients with G as the preconditioner, which requires products with G and D
only, not with G⁻¹. Few steps are needed, since a touch changes the energy of any field by a bounded factor. Nodes that
a touch disconnects make G⁻¹ + D singular, but no current flows at these nodes. An approximate Y leaves the residual R =
D F − (G⁻¹ + D) Y. Then (D F)ᵀ Y + Yᵀ R differs from the exact (D F)ᵀ Y by Rᵀ (G⁻¹ + D)⁻¹ R. The main part of this
difference, Rᵀ G R, is added. G is needed only between nodes of the same touch, which are close to each other.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.arguments import check_kind
from jeit.design.skin.touched_cells import TouchedCells, millimetre_text, touched_nodes
from jeit.forward import ForwardModel
from jeit.forward.model import channel_voltages, check_model, evaluate, select_channels, solved_system_of
from jeit.forward.system import cell_conductivity, check_conductivity, stiffness
from jeit.forward.transfer import fields_and_inverse
from jeit.protocol import Protocol
from jeit_solvers import NearInverse, Strips, over_cores
from jeit_solvers.engines import evaluate_in_numpy, has_values, on_device
from jeit_solvers.module import Module

# Tolerance of the error bound, relative to the voltage changes, and maximum number of conjugate-gradient steps.
_TOLERANCE, _MAX_STEPS = 1e-8, 200
# Factor by which an insulating touch is assumed to lower the energy of a field (the true factor depends on the shape of
# the touched part), and maximum of this factor for touched parts with a very low remaining conductivity.
_INSULATING_ENERGY_FACTOR, _MAX_FACTOR = 10.0, 1e6
# Voltage changes below this value, relative to the energy of the load D F, are rounding errors.
_MIN_RELATIVE_VOLTAGE = 1e-12
# Number of touches processed at once for exact and linearised changes, so that their blocks of the inverse or of the
# Jacobian fit into the cache.
EXACT_BATCH_SIZE, _LINEAR_BATCH_SIZE = 2, 8
# Multiple to which the number of strips of nodes that a touch spans is padded, since a program is compiled for each
# number.
_NUM_STRIPS_MULTIPLE = 3
# Number of touches per call of a compiled program. The numbers of nodes and of cells of a touch are padded to sizes,
# and these are the ratios of successive sizes. One program is compiled for each size, and the cost of a touch grows
# with the square of its number of nodes.
_TOUCHES_PER_CALL, _NODE_SIZE_RATIO, _CELL_SIZE_RATIO = 2 * EXACT_BATCH_SIZE, 2**0.5, 2.0


def touch_changes(
    model: ForwardModel, conductivity, touched: TouchedCells, *, linear: bool = False
) -> Float[Array, "n M"]:
    """Compute the changes (n, M) of the M voltages of the protocol due to n single touches, in volts.

    - `conductivity`: real conductivity as in `ForwardModel.voltages`, S/m (2-D: S). Exact changes allow conductivity
      tensors, which a touch scales.
    - `linear`: if True, the linearised changes J δσ from the Jacobian J, which are differentiable and can be batched
      with `vmap`. Otherwise the exact changes, which differ from those of a separate solution for every touch by up to
      1e-8 of the largest change.

    Raises `ValueError` for touches of a different mesh and for exact changes under `jit`, `grad` or `vmap`. Raises
    `RuntimeError` if the computation of exact changes does not converge: for conductors with a contrast above about
    1e6, where the voltages no longer depend on the contrast, and if a touch disconnects an electrode.
    """
    check_model(model)
    check_kind("touched", touched, TouchedCells, "TouchedCells, as of skin.touched_cells(places)")
    conductivity = check_conductivity(model.mesh, conductivity)
    if jnp.iscomplexobj(conductivity) or (linear and conductivity.ndim == 3):
        raise ValueError("touches need a real conductivity, and linear changes a scalar one.")
    if touched.num_cells != model.mesh.num_cells:
        raise ValueError(
            f"the touches are of a mesh of {touched.num_cells} cells, and the model's has {model.mesh.num_cells}; "
            "touch the model's own, touched_cells(model.mesh, …)."
        )
    if not linear and not has_values(model, conductivity, touched):
        raise ValueError("exact changes cannot be traced by jit, grad or vmap; take linear=True there.")
    if linear:
        return _linear_changes(model, cell_conductivity(model.mesh, conductivity), touched)
    return _exact_changes(model, cell_conductivity(model.mesh, conductivity), touched)


@jax.jit
def _linear_changes(model: ForwardModel, conductivity, touched: TouchedCells):
    jacobian = model.jacobian(conductivity).T  # (m, M)
    conductivity_changes = touched.change * conductivity[touched.cells]

    def chunk_changes(indices):
        return jnp.einsum("bc,bcm->bm", conductivity_changes[indices], jacobian[touched.cells[indices]])

    num_touches = len(conductivity_changes)
    indices = jnp.minimum(
        jnp.arange(-(-num_touches // _LINEAR_BATCH_SIZE) * _LINEAR_BATCH_SIZE), num_touches - 1
    ).reshape(-1, _LINEAR_BATCH_SIZE)
    return _join_chunks(jax.lax.map(chunk_changes, indices))[:num_touches]


def _exact_changes(model: ForwardModel, conductivity, touched: TouchedCells):
    touch_geometry = touched_nodes(model, touched)
    max_distance = (
        -(-touch_geometry.strips.max_strip_distance(touch_geometry.nodes) // _NUM_STRIPS_MULTIPLE)
        * _NUM_STRIPS_MULTIPLE
    )
    solved_system = evaluate(model, solved_system_of, conductivity)
    fields_and_inverse_of_skin = fields_and_inverse(solved_system, touch_geometry.strips, max_distance)
    touches = on_device((touched.cells, touched.change, touch_geometry.nodes, touch_geometry.corners))
    compute_changes = partial(
        exact_voltage_changes, model.protocol, cell_stiffness(model, conductivity), fields_and_inverse_of_skin, touches
    )
    return _changes_over_cores(compute_changes, touched)


def _changes_over_cores(compute_changes, touched: TouchedCells):
    """Compute the changes due to all touches in one call of a compiled program per core."""
    num_touches = len(touched.cells)
    changes = over_cores(compute_changes, num_touches, EXACT_BATCH_SIZE)[:num_touches]
    check_finite_changes(changes, np.asarray(touched.places))
    return changes


def check_finite_changes(changes, places: Float[np.ndarray, "n d"]) -> None:
    """Raise `RuntimeError` if the voltage changes due to any of the touches at `places`, metres, are not finite."""
    failed_touches = np.flatnonzero(~np.isfinite(np.asarray(changes)).all(axis=1))
    if failed_touches.size:
        raise RuntimeError(
            f"the changes by {failed_touches.size} of {len(places)} touches were not found in {_MAX_STEPS} steps, the "
            f"first at {millimetre_text(places[failed_touches[0]])} mm; does it cut an electrode off, or are "
            "conductivities many orders of magnitude apart?"
        )


@jax.jit
def cell_stiffness(model: ForwardModel, conductivity) -> Float[Array, "m q q"]:
    """Contribution (m, q, q) of each of m cells with q nodes to the system matrix, siemens. `conductivity`:
    conductivity of the cells, S/m (2-D: S)."""
    return _unpack_symmetric(stiffness(model.mesh, conductivity), model.mesh.dimension + 1)


@jax.jit
def exact_voltage_changes(protocol: Protocol, element_matrices, fields_and_inverse, touches, touch_indices):
    """Compute the exact voltage changes due to the touches with indices `touch_indices` (c, s), s touches at a time.

    `element_matrices`: result of `cell_stiffness`; `fields_and_inverse`: result of the function with this name;
    `touches`: cells and changes of all touches as in `TouchedCells`, and their nodes and corners as in
    `TouchedNodes`."""
    fields, inverse = fields_and_inverse
    select_voltages = jax.vmap(lambda relative_change: select_channels(protocol, relative_change))

    def chunk_changes(chunk_indices):
        cells, relative_change, nodes, corners = (array[chunk_indices] for array in touches)
        blocks = element_matrices[cells] * relative_change[..., None, None]
        return select_voltages(
            _impedance_changes(
                blocks, corners, inverse.blocks(nodes), fields[nodes], _weakening_factor(relative_change)
            )
        )

    return _join_chunks(jax.lax.map(chunk_changes, touch_indices))


def _join_chunks(chunks: Float[Array, "c s *m"]) -> Float[Array, "cs *m"]:
    return chunks.reshape(-1, *chunks.shape[2:])


def _weakening_factor(change: Float[Array, "b c"]) -> Float[Array, " b"]:
    """Largest factor (b,) by which each of b touches lowers the energy of an electric field."""
    remaining_conductivity = 1 + change
    return jnp.clip(
        jnp.where(
            remaining_conductivity > 0,
            1 / jnp.where(remaining_conductivity > 0, remaining_conductivity, 1.0),
            _INSULATING_ENERGY_FACTOR,
        ).max(axis=1),
        1,
        _MAX_FACTOR,
    )


def _impedance_changes(blocks, corners, inverse, fields, weakening_factor):
    """Change ΔZ (b, L, L) of the transfer impedance between L electrodes due to each of b touches.

    ΔZ = −Fᵀ D F + (D F)ᵀ Y, where Y solves (G⁻¹ + D) Y = D F. D, the change of the system matrix by a touch, is
    assembled from `blocks` (b, c, q, q), siemens, for its c cells with nodes `corners` (b, c, q), indices among the k
    nodes of the touch. G: `inverse` (b, k, k), ohms, the inverse of the system matrix between these nodes. F: `fields`
    (b, k, L), ohms, the potentials of these nodes for unit currents into the electrodes. `weakening_factor` (b,): see
    `_weakening_factor`. The b systems are solved together, by conjugate gradients, until the last system has converged;
    R is the residual of Y.
    """
    touch = jnp.arange(len(fields))[:, None, None]
    num_nodes = fields.shape[1]
    touch_matrix = jnp.zeros((len(fields), num_nodes, num_nodes))
    touch_matrix = touch_matrix.at[touch[..., None], corners[..., :, None], corners[..., None, :]].add(blocks)
    right_hand_side = touch_matrix @ fields

    def step(state):
        solution, residual, scaled_residual, direction, scaled_direction, energy, ratio, num_steps = state
        direction = scaled_residual + ratio * direction
        # `scaled_direction` is G⁻¹ times the search direction, computed without a solve as the same combination of
        # residuals.
        scaled_direction = residual + ratio * scaled_direction
        system_product = scaled_direction + touch_matrix @ direction
        curvature = jnp.sum(direction * system_product, axis=1, keepdims=True)
        # The solutions of converged touches are not changed any more, since their residual and curvature are rounding
        # errors.
        is_unconverged = (energy > max_energy) & (curvature > 0)
        step_length = jnp.where(is_unconverged, energy / jnp.where(is_unconverged, curvature, 1.0), 0.0)
        solution, residual = solution + step_length * direction, residual - step_length * system_product
        scaled_residual = inverse @ residual
        new_energy = jnp.sum(residual * scaled_residual, axis=1, keepdims=True)
        ratio = jnp.where(is_unconverged, new_energy / jnp.where(is_unconverged, energy, 1.0), 0.0)
        return solution, residual, scaled_residual, direction, scaled_direction, new_energy, ratio, num_steps + 1

    def is_unfinished(state):
        *_, energy, _, num_steps = state
        return (num_steps < _MAX_STEPS) & jnp.any(energy > max_energy)

    scaled_load, zeros = inverse @ right_hand_side, jnp.zeros_like(right_hand_side)
    initial_energy = jnp.sum(right_hand_side * scaled_load, axis=1, keepdims=True)
    # The remaining error is at most the energy Rᵀ G R times `weakening_factor`. The voltages change by at least Fᵀ D F
    # due to insulators, and by at least (Fᵀ D F)² divided by the energy of the load due to conductors.
    linearised_magnitude = jnp.abs(jnp.sum(fields * right_hand_side, axis=1, keepdims=True))
    voltages = jnp.minimum(
        linearised_magnitude, linearised_magnitude**2 / jnp.where(initial_energy > 0, initial_energy, 1.0)
    )
    max_energy = (
        _TOLERANCE * jnp.maximum(voltages, _MIN_RELATIVE_VOLTAGE * initial_energy) / weakening_factor[:, None, None]
    )
    initial_state = (
        zeros,
        right_hand_side,
        scaled_load,
        zeros,
        zeros,
        initial_energy,
        jnp.zeros_like(initial_energy),
        jnp.zeros((), int),
    )
    solution, residual, scaled_residual, *_, energy, _, _ = jax.lax.while_loop(is_unfinished, step, initial_state)
    change = _transpose(solution) @ (right_hand_side + residual) + _transpose(residual) @ scaled_residual
    change -= _transpose(fields) @ right_hand_side
    # Voltage changes below this limit consist of rounding errors of the load D F.
    is_rounding_error = jnp.sum(voltages, axis=(1, 2)) < _MIN_RELATIVE_VOLTAGE * jnp.sum(initial_energy, axis=(1, 2))
    converged = jnp.all(energy <= max_energy, axis=(1, 2)) & ~is_rounding_error
    return jnp.where(converged[:, None, None], (change + _transpose(change)) / 2, jnp.nan)


def _transpose(matrices):
    return jnp.swapaxes(matrices, -1, -2)


def _unpack_symmetric(packed: Float[Array, "p m"], size: int) -> Float[Array, "m q q"]:
    """Unpack symmetric matrices (m, q, q) from their lower triangles (p, m)."""
    rows, columns = np.tril_indices(size)
    packed_indices = np.zeros((size, size), int)
    packed_indices[rows, columns] = packed_indices[columns, rows] = np.arange(len(rows))
    return jnp.moveaxis(packed[packed_indices], -1, 0)


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
        solved_untouched_system = evaluate(model, solved_system_of, conductivity)
        voltages = on_device(
            evaluate_in_numpy(
                lambda solved_untouched_system, protocol: channel_voltages(
                    protocol, solved_untouched_system.impedance()
                ),
                solved_untouched_system,
                model.protocol,
            )
        )
        skin_fields_and_inverse = fields_and_inverse(solved_untouched_system, strips, max(strips.num_strips - 1, 1))
        return cls(model, voltages, cell_stiffness(model, conductivity), strips, *skin_fields_and_inverse)

    def changes(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """Compute the exact voltage changes (n, M) of M channels due to n single touches, volts, as `touch_changes`
        does. Raises `RuntimeError` in the cases of `touch_changes`."""
        touch_geometry = touched_nodes(self.model, touched, self.strips)
        cells, relative_changes = np.asarray(touched.cells), np.asarray(touched.change)
        num_changed_cells = np.count_nonzero(relative_changes, axis=1)
        sizes = np.stack(
            [
                _padded_size((touch_geometry.nodes < touch_geometry.nodes[:, -1:]).sum(axis=1) + 1, _NODE_SIZE_RATIO),
                _padded_size(num_changed_cells, _CELL_SIZE_RATIO),
            ],
            axis=1,
        )
        voltage_changes = np.zeros((len(cells), self.model.protocol.num_measurements))
        skin_fields_and_inverse = self.fields, self.inverse
        for size in np.unique(sizes[num_changed_cells > 0], axis=0):
            touches_of_size = np.flatnonzero((sizes == size).all(axis=1) & (num_changed_cells > 0))
            padded_nodes = _pad_rows(touch_geometry.nodes, size[0], "edge")
            arrays = (
                _pad_rows(array, size[1], "constant") for array in (cells, relative_changes, touch_geometry.corners)
            )
            padded_cells, padded_changes, padded_corners = arrays
            for chunk in np.split(touches_of_size, range(_TOUCHES_PER_CALL, len(touches_of_size), _TOUCHES_PER_CALL)):
                rows = chunk[np.minimum(np.arange(_TOUCHES_PER_CALL), len(chunk) - 1)]
                touches = on_device(
                    (padded_cells[rows], padded_changes[rows], padded_nodes[rows], padded_corners[rows])
                )
                compute_changes = partial(
                    exact_voltage_changes, self.model.protocol, self.element, skin_fields_and_inverse, touches
                )
                voltage_changes[chunk] = np.asarray(over_cores(compute_changes, _TOUCHES_PER_CALL, EXACT_BATCH_SIZE))[
                    : len(chunk)
                ]
        check_finite_changes(voltage_changes, np.asarray(touched.places))
        return voltage_changes

    def changes_of_equal_touches(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """As `changes` (n, M), in volts, for touches of about equal numbers of cells and nodes: all are padded to the
        largest, and one program computes them. One is compiled for each number of touches, and for each size."""
        touch_geometry = touched_nodes(self.model, touched, self.strips)
        nodes = _pad_rows(
            touch_geometry.nodes, int(_padded_size(touch_geometry.nodes.shape[1], _NODE_SIZE_RATIO)), "edge"
        )
        touches = on_device((touched.cells, touched.change, nodes, touch_geometry.corners))
        skin_fields_and_inverse = self.fields, self.inverse
        compute_changes = partial(
            exact_voltage_changes, self.model.protocol, self.element, skin_fields_and_inverse, touches
        )
        return np.asarray(_changes_over_cores(compute_changes, touched))


def _padded_size(count, ratio: float):
    """Round `count` up to the next number in a series of multiples of 16, in which each is about `ratio` times the
    previous multiple."""
    exponent = np.ceil(np.log(np.maximum(count, 16) / 16) / np.log(ratio) - 1e-9)
    return (np.ceil(ratio**exponent - 1e-9) * 16).astype(int)


def _pad_rows(rows: np.ndarray, length: int, padding_mode) -> np.ndarray:
    """Truncate or pad the n rows of `rows` (n, k, …) from k to `length` entries."""
    num_missing = max(length - rows.shape[1], 0)
    return np.pad(rows[:, :length], [(0, 0), (0, num_missing), *[(0, 0)] * (rows.ndim - 2)], padding_mode)
