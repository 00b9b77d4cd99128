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
_ENERGY_TOLERANCE, _MAX_SOLVER_STEPS = 1e-8, 200
# Factor by which an insulating touch is assumed to lower the energy of a field (the true factor depends on the shape of
# the touched part), and maximum of this factor for touched parts with a very low remaining conductivity.
_INSULATING_ENERGY_FACTOR, _MAX_WEAKENING_FACTOR = 10.0, 1e6
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

    def changes_of_chunk(touch_indices):
        return jnp.einsum("bc,bcm->bm", conductivity_changes[touch_indices], jacobian[touched.cells[touch_indices]])

    num_touches = len(conductivity_changes)
    touch_indices = jnp.minimum(
        jnp.arange(-(-num_touches // _LINEAR_BATCH_SIZE) * _LINEAR_BATCH_SIZE), num_touches - 1
    ).reshape(-1, _LINEAR_BATCH_SIZE)
    return _join_chunks(jax.lax.map(changes_of_chunk, touch_indices))[:num_touches]


def _exact_changes(model: ForwardModel, conductivity, touched: TouchedCells):
    touch_geometry = touched_nodes(model, touched)
    max_strip_distance = (
        -(-touch_geometry.strips.max_strip_distance(touch_geometry.nodes) // _NUM_STRIPS_MULTIPLE)
        * _NUM_STRIPS_MULTIPLE
    )
    solved_system = evaluate(model, solved_system_of, conductivity)
    fields_and_inverse_of_skin = fields_and_inverse(solved_system, touch_geometry.strips, max_strip_distance)
    touch_arrays = on_device((touched.cells, touched.change, touch_geometry.nodes, touch_geometry.corners))
    compute_changes = partial(
        exact_voltage_changes,
        model.protocol,
        cell_stiffness(model, conductivity),
        fields_and_inverse_of_skin,
        touch_arrays,
    )
    return _changes_over_cores(compute_changes, touched)


def _changes_over_cores(compute_changes, touched: TouchedCells):
    """Compute the changes due to all touches in one call of a compiled program per core."""
    num_touches = len(touched.cells)
    voltage_changes = over_cores(compute_changes, num_touches, EXACT_BATCH_SIZE)[:num_touches]
    check_finite_changes(voltage_changes, np.asarray(touched.places))
    return voltage_changes


def check_finite_changes(changes, places: Float[np.ndarray, "n d"]) -> None:
    """Raise `RuntimeError` if the voltage changes due to any of the touches at `places`, metres, are not finite."""
    failed_touches = np.flatnonzero(~np.isfinite(np.asarray(changes)).all(axis=1))
    if failed_touches.size:
        raise RuntimeError(
            f"the changes by {failed_touches.size} of {len(places)} touches were not found in {_MAX_SOLVER_STEPS} "
            f"steps, the first at {millimetre_text(places[failed_touches[0]])} mm; does it cut an electrode off, or "
            "are conductivities many orders of magnitude apart?"
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
    electrode_fields, inverse_of_skin = fields_and_inverse
    select_voltages = jax.vmap(lambda relative_change: select_channels(protocol, relative_change))

    def changes_of_chunk(chunk_indices):
        changed_cells, relative_change, nodes, corner_indices = (touch_array[chunk_indices] for touch_array in touches)
        element_changes = element_matrices[changed_cells] * relative_change[..., None, None]
        return select_voltages(
            _impedance_changes(
                element_changes,
                corner_indices,
                inverse_of_skin.blocks(nodes),
                electrode_fields[nodes],
                _weakening_factor(relative_change),
            )
        )

    return _join_chunks(jax.lax.map(changes_of_chunk, touch_indices))


def _join_chunks(chunk_values: Float[Array, "c s *m"]) -> Float[Array, "cs *m"]:
    return chunk_values.reshape(-1, *chunk_values.shape[2:])


def _weakening_factor(relative_changes: Float[Array, "b c"]) -> Float[Array, " b"]:
    """Largest factor (b,) by which each of b touches lowers the energy of an electric field."""
    remaining_conductivity = 1 + relative_changes
    return jnp.clip(
        jnp.where(
            remaining_conductivity > 0,
            1 / jnp.where(remaining_conductivity > 0, remaining_conductivity, 1.0),
            _INSULATING_ENERGY_FACTOR,
        ).max(axis=1),
        1,
        _MAX_WEAKENING_FACTOR,
    )


def _impedance_changes(element_changes, corner_indices, inverse_of_skin, electrode_fields, weakening_factor):
    """Change ΔZ (b, L, L) of the transfer impedance between L electrodes due to each of b touches.

    ΔZ = −Fᵀ D F + (D F)ᵀ Y, where Y solves (G⁻¹ + D) Y = D F. D, the change of the system matrix by a touch, is
    assembled from `element_changes` (b, c, q, q), siemens, for its c cells with nodes `corner_indices` (b, c, q),
    indices among the k nodes of the touch. G: `inverse_of_skin` (b, k, k), ohms, the inverse of the system matrix
    between these nodes. F: `electrode_fields` (b, k, L), ohms, the potentials of these nodes for unit currents into the
    electrodes. `weakening_factor` (b,): see `_weakening_factor`. The b systems are solved together, by conjugate
    gradients, until the last system has converged; R is the residual of Y.
    """
    touch_indices = jnp.arange(len(electrode_fields))[:, None, None]
    num_nodes = electrode_fields.shape[1]
    touch_stiffness = jnp.zeros((len(electrode_fields), num_nodes, num_nodes))
    touch_stiffness = touch_stiffness.at[
        touch_indices[..., None], corner_indices[..., :, None], corner_indices[..., None, :]
    ].add(element_changes)
    right_hand_side = touch_stiffness @ electrode_fields

    def conjugate_gradient_step(solver_state):
        (
            field_solution,
            field_residual,
            scaled_residual,
            search_direction,
            scaled_direction,
            residual_energy,
            direction_ratio,
            num_steps,
        ) = solver_state
        search_direction = scaled_residual + direction_ratio * search_direction
        # `scaled_direction` is G⁻¹ times the search direction, computed without a solve as the same combination of
        # residuals.
        scaled_direction = field_residual + direction_ratio * scaled_direction
        system_product = scaled_direction + touch_stiffness @ search_direction
        energy_curvature = jnp.sum(search_direction * system_product, axis=1, keepdims=True)
        # The solutions of converged touches are not changed any more, since their residual and curvature are rounding
        # errors.
        is_unconverged = (residual_energy > max_energy) & (energy_curvature > 0)
        step_length = jnp.where(is_unconverged, residual_energy / jnp.where(is_unconverged, energy_curvature, 1.0), 0.0)
        field_solution, field_residual = (
            field_solution + step_length * search_direction,
            field_residual - step_length * system_product,
        )
        scaled_residual = inverse_of_skin @ field_residual
        new_residual_energy = jnp.sum(field_residual * scaled_residual, axis=1, keepdims=True)
        direction_ratio = jnp.where(
            is_unconverged, new_residual_energy / jnp.where(is_unconverged, residual_energy, 1.0), 0.0
        )
        return (
            field_solution,
            field_residual,
            scaled_residual,
            search_direction,
            scaled_direction,
            new_residual_energy,
            direction_ratio,
            num_steps + 1,
        )

    def has_unfinished_touches(solver_state):
        *_, residual_energy, _, num_steps = solver_state
        return (num_steps < _MAX_SOLVER_STEPS) & jnp.any(residual_energy > max_energy)

    scaled_load, zero_fields = inverse_of_skin @ right_hand_side, jnp.zeros_like(right_hand_side)
    initial_energy = jnp.sum(right_hand_side * scaled_load, axis=1, keepdims=True)
    # The remaining error is at most the energy Rᵀ G R times `weakening_factor`. The voltages change by at least Fᵀ D F
    # due to insulators, and by at least (Fᵀ D F)² divided by the energy of the load due to conductors.
    linearised_magnitude = jnp.abs(jnp.sum(electrode_fields * right_hand_side, axis=1, keepdims=True))
    voltage_scales = jnp.minimum(
        linearised_magnitude, linearised_magnitude**2 / jnp.where(initial_energy > 0, initial_energy, 1.0)
    )
    max_energy = (
        _ENERGY_TOLERANCE
        * jnp.maximum(voltage_scales, _MIN_RELATIVE_VOLTAGE * initial_energy)
        / weakening_factor[:, None, None]
    )
    initial_solver_state = (
        zero_fields,
        right_hand_side,
        scaled_load,
        zero_fields,
        zero_fields,
        initial_energy,
        jnp.zeros_like(initial_energy),
        jnp.zeros((), int),
    )
    field_solution, field_residual, scaled_residual, *_, residual_energy, _, _ = jax.lax.while_loop(
        has_unfinished_touches, conjugate_gradient_step, initial_solver_state
    )
    impedance_change = (
        _transpose_matrices(field_solution) @ (right_hand_side + field_residual)
        + _transpose_matrices(field_residual) @ scaled_residual
    )
    impedance_change -= _transpose_matrices(electrode_fields) @ right_hand_side
    # Voltage changes below this limit consist of rounding errors of the load D F.
    is_rounding_error = jnp.sum(voltage_scales, axis=(1, 2)) < _MIN_RELATIVE_VOLTAGE * jnp.sum(
        initial_energy, axis=(1, 2)
    )
    has_converged = jnp.all(residual_energy <= max_energy, axis=(1, 2)) & ~is_rounding_error
    return jnp.where(
        has_converged[:, None, None], (impedance_change + _transpose_matrices(impedance_change)) / 2, jnp.nan
    )


def _transpose_matrices(matrix_batch):
    return jnp.swapaxes(matrix_batch, -1, -2)


def _unpack_symmetric(packed_triangles: Float[Array, "p m"], matrix_size: int) -> Float[Array, "m q q"]:
    """Unpack symmetric matrices (m, q, q) from their lower triangles (p, m)."""
    row_indices, column_indices = np.tril_indices(matrix_size)
    packed_indices = np.zeros((matrix_size, matrix_size), int)
    packed_indices[row_indices, column_indices] = packed_indices[column_indices, row_indices] = np.arange(
        len(row_indices)
    )
    return jnp.moveaxis(packed_triangles[packed_indices], -1, 0)


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
        resting_voltages = on_device(
            evaluate_in_numpy(
                lambda solved_untouched_system, protocol: channel_voltages(
                    protocol, solved_untouched_system.impedance()
                ),
                solved_untouched_system,
                model.protocol,
            )
        )
        skin_fields_and_inverse = fields_and_inverse(solved_untouched_system, strips, max(strips.num_strips - 1, 1))
        return cls(model, resting_voltages, cell_stiffness(model, conductivity), strips, *skin_fields_and_inverse)

    def changes(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """Compute the exact voltage changes (n, M) of M channels due to n single touches, volts, as `touch_changes`
        does. Raises `RuntimeError` in the cases of `touch_changes`."""
        touch_geometry = touched_nodes(self.model, touched, self.strips)
        changed_cells, relative_changes = np.asarray(touched.cells), np.asarray(touched.change)
        num_changed_cells = np.count_nonzero(relative_changes, axis=1)
        padded_sizes = np.stack(
            [
                _padded_size((touch_geometry.nodes < touch_geometry.nodes[:, -1:]).sum(axis=1) + 1, _NODE_SIZE_RATIO),
                _padded_size(num_changed_cells, _CELL_SIZE_RATIO),
            ],
            axis=1,
        )
        voltage_changes = np.zeros((len(changed_cells), self.model.protocol.num_measurements))
        skin_fields_and_inverse = self.fields, self.inverse
        for padded_size in np.unique(padded_sizes[num_changed_cells > 0], axis=0):
            touches_of_size = np.flatnonzero((padded_sizes == padded_size).all(axis=1) & (num_changed_cells > 0))
            padded_nodes = _pad_rows(touch_geometry.nodes, padded_size[0], "edge")
            padded_arrays = (
                _pad_rows(cell_array, padded_size[1], "constant")
                for cell_array in (changed_cells, relative_changes, touch_geometry.corners)
            )
            padded_cells, padded_changes, padded_corners = padded_arrays
            for touch_chunk in np.split(
                touches_of_size, range(_TOUCHES_PER_CALL, len(touches_of_size), _TOUCHES_PER_CALL)
            ):
                chunk_rows = touch_chunk[np.minimum(np.arange(_TOUCHES_PER_CALL), len(touch_chunk) - 1)]
                padded_touches = on_device(
                    (
                        padded_cells[chunk_rows],
                        padded_changes[chunk_rows],
                        padded_nodes[chunk_rows],
                        padded_corners[chunk_rows],
                    )
                )
                compute_changes = partial(
                    exact_voltage_changes, self.model.protocol, self.element, skin_fields_and_inverse, padded_touches
                )
                voltage_changes[touch_chunk] = np.asarray(
                    over_cores(compute_changes, _TOUCHES_PER_CALL, EXACT_BATCH_SIZE)
                )[: len(touch_chunk)]
        check_finite_changes(voltage_changes, np.asarray(touched.places))
        return voltage_changes

    def changes_of_equal_touches(self, touched: TouchedCells) -> Float[np.ndarray, "n M"]:
        """As `changes` (n, M), in volts, for touches of about equal numbers of cells and nodes: all are padded to the
        largest, and one program computes them. One is compiled for each number of touches, and for each size."""
        touch_geometry = touched_nodes(self.model, touched, self.strips)
        padded_nodes = _pad_rows(
            touch_geometry.nodes, int(_padded_size(touch_geometry.nodes.shape[1], _NODE_SIZE_RATIO)), "edge"
        )
        padded_touches = on_device((touched.cells, touched.change, padded_nodes, touch_geometry.corners))
        skin_fields_and_inverse = self.fields, self.inverse
        compute_changes = partial(
            exact_voltage_changes, self.model.protocol, self.element, skin_fields_and_inverse, padded_touches
        )
        return np.asarray(_changes_over_cores(compute_changes, touched))


def _padded_size(entry_count, size_ratio: float):
    """Round `entry_count` up to the next number in a series of multiples of 16, in which each is about `size_ratio`
    times the previous multiple."""
    size_exponent = np.ceil(np.log(np.maximum(entry_count, 16) / 16) / np.log(size_ratio) - 1e-9)
    return (np.ceil(size_ratio**size_exponent - 1e-9) * 16).astype(int)


def _pad_rows(unpadded_rows: np.ndarray, padded_length: int, padding_mode) -> np.ndarray:
    """Truncate or pad the n rows of `unpadded_rows` (n, k, …) from k to `padded_length` entries."""
    num_missing_entries = max(padded_length - unpadded_rows.shape[1], 0)
    return np.pad(
        unpadded_rows[:, :padded_length],
        [(0, 0), (0, num_missing_entries), *[(0, 0)] * (unpadded_rows.ndim - 2)],
        padding_mode,
    )
