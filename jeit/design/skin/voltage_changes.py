"""Voltage changes by single touches: exact, by low-rank updates of one factorisation, or linear.

A touch adds D to the system matrix K of the electrode model, nonzero only among its k nodes. With the fields F for unit
currents into the electrodes and G = K⁻¹, both restricted to those nodes,

    ΔZ = −Fᵀ D F + (D F)ᵀ Y,    (G⁻¹ + D) Y = D F,

(Sherman-Morrison-Woodbury), by conjugate gradients with G as the preconditioner: they need products with G and D only,
never G⁻¹, in few steps, as touches of a bounded depth change the energy of any field by a bounded factor; nodes that a
touch cuts off make the matrix singular, but nothing flows there. With the residual R of Y, (D F)ᵀ Y + Yᵀ R lacks
Rᵀ (G⁻¹ + D)⁻¹ R, and Rᵀ G R is most of that. G is needed only between nodes of one touch, which lie near each other.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind
from jeit.design.skin.reached_cells import said
from jeit.design.skin.touched_cells import TouchedCells, touched_nodes
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, evaluate, select_channels, solved_system_of
from jeit.forward.system import cell_conductivity, check_conductivity, stiffness
from jeit.forward.transfer import fields_and_inverse
from jeit.protocol import Protocol
from jeit_solvers import over_cores
from jeit_solvers.engines import has_values, on_device

# Tolerance of the error's bound, relative to the voltages; most steps.
_TOLERANCE, _MOST_STEPS = 1e-8, 200
# Flow around what is cut off changes by a factor that its shape bounds, not the conductivity left. And where next to
# nothing is left, the conductivity bounds too much.
_CUT_OFF, _MOST_WEAKENED = 10.0, 1e6
# Voltages below this, relative to the load's energy, are rounding errors.
_SMALLEST = 1e-12
# Touches processed at once, so that their blocks of the inverse or the Jacobian fit into the cache.
EXACT_AT_ONCE, _LINEAR = 2, 8
# Multiple to which the inverse's reach is padded: programs are compiled for each.
_STRIPS = 3


def touch_changes(
    model: ForwardModel, conductivity, touched: TouchedCells, *, linear: bool = False
) -> Float[Array, "n M"]:
    """Compute the changes (n, M) of the protocol's M voltages by n single touches, in volts.

    `linear`: J δσ, the Jacobian's, differentiable in everything and batched with `vmap`; else exact, as if the model
    had been solved anew for every touch, to 1e-8 of the largest. Raises `ValueError` for touches of another mesh and
    for exact changes under `jit`, `grad` or `vmap`, and `RuntimeError` where exact changes are not found: by conductors
    of contrast above some 1e6, whose limit is reached long before, and where a touch cuts an electrode off.
    `conductivity` as in `ForwardModel.voltages`, real, S/m (2-D: S); tensors, which a touch scales, for exact changes.
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
        return _linear(model, cell_conductivity(model.mesh, conductivity), touched)
    return _exact(model, cell_conductivity(model.mesh, conductivity), touched)


@jax.jit
def _linear(model: ForwardModel, conductivity, touched: TouchedCells):
    jacobian = model.jacobian(conductivity).T  # (m, M)
    changed = touched.change * conductivity[touched.cells]

    def some(index):
        return jnp.einsum("bc,bcm->bm", changed[index], jacobian[touched.cells[index]])

    number = len(changed)
    index = jnp.minimum(jnp.arange(-(-number // _LINEAR) * _LINEAR), number - 1).reshape(-1, _LINEAR)
    return _joined(jax.lax.map(some, index))[:number]


def _exact(model: ForwardModel, conductivity, touched: TouchedCells):
    touched_at = touched_nodes(model, touched)
    reach = -(-touched_at.strips.reach(touched_at.nodes) // _STRIPS) * _STRIPS
    solved = evaluate(model, solved_system_of, conductivity)
    known = fields_and_inverse(solved, touched_at.strips, reach)
    touches = on_device((touched.cells, touched.change, touched_at.nodes, touched_at.corners))
    number, element = len(touched.cells), cell_stiffness(model, conductivity)
    work = partial(changes_between, model.protocol, element, known, touches)
    found = over_cores(work, number, EXACT_AT_ONCE)[:number]
    check_found(found, np.asarray(touched.places))
    return found


def check_found(changes, places: Float[np.ndarray, "n d"]) -> None:
    """Raise `RuntimeError` where changes by touches at `places`, metres, were not found."""
    lost = np.flatnonzero(~np.isfinite(np.asarray(changes)).all(axis=1))
    if lost.size:
        raise RuntimeError(
            f"the changes by {lost.size} of {len(places)} touches were not found in {_MOST_STEPS} steps, the first at "
            f"{said(places[lost[0]])} mm; does it cut an electrode off, or are conductivities many orders of "
            "magnitude apart?"
        )


@jax.jit
def cell_stiffness(model: ForwardModel, conductivity) -> Float[Array, "m q q"]:
    """Each cell's part of the system matrix, siemens; `conductivity` of the cells."""
    return _symmetric(stiffness(model.mesh, conductivity), model.mesh.dimension + 1)


@jax.jit
def changes_between(protocol: Protocol, element, known, touches, index):
    """Changes of the voltages by the touches with these numbers (c, s), s of them at a time.

    `element` as of `cell_stiffness`; `known` as of `fields_and_inverse`; `touches`: their cells, changes, nodes and
    corners, as of `TouchedCells` and `touched_nodes`."""
    fields, inverse = known
    select = jax.vmap(lambda change: select_channels(protocol, change))

    def some(index):
        cells, change, nodes, corners = (array[index] for array in touches)
        blocks = element[cells] * change[..., None, None]
        return select(_impedance_changes(blocks, corners, inverse.blocks(nodes), fields[nodes], _weakened(change)))

    return _joined(jax.lax.map(some, index))


def _joined(chunks: Float[Array, "c s *m"]) -> Float[Array, "cs *m"]:
    return chunks.reshape(-1, *chunks.shape[2:])


def _weakened(change: Float[Array, "b c"]) -> Float[Array, " b"]:
    """Largest factor by which touches lower the energy of a field."""
    left = 1 + change
    return jnp.clip(jnp.where(left > 0, 1 / jnp.where(left > 0, left, 1.0), _CUT_OFF).max(axis=1), 1, _MOST_WEAKENED)


def _impedance_changes(blocks, corners, inverse, fields, weakened):
    """ΔZ (b, L, L) of b touches, from D as `blocks` (b, c, q, q) of cells at `corners` (b, c, q), G (b, k, k) and F
    (b, k, L). The steps are those of all touches together, until the last has converged."""
    touch = jnp.arange(len(fields))[:, None, None]
    size = fields.shape[1]
    added = jnp.zeros((len(fields), size, size))
    added = added.at[touch[..., None], corners[..., :, None], corners[..., None, :]].add(blocks)
    load = added @ fields

    def step(state):
        solution, residual, scaled_residual, direction, scaled, energy, ratio, number = state
        direction = scaled_residual + ratio * direction
        scaled = residual + ratio * scaled  # G⁻¹ of the direction, which is a combination of what G was applied to
        product = scaled + added @ direction
        curvature = jnp.sum(direction * product, axis=1, keepdims=True)
        # Converged touches are left unchanged: their residual and curvature are rounding errors.
        going = (energy > enough) & (curvature > 0)
        length = jnp.where(going, energy / jnp.where(going, curvature, 1.0), 0.0)
        solution, residual = solution + length * direction, residual - length * product
        scaled_residual = inverse @ residual
        new = jnp.sum(residual * scaled_residual, axis=1, keepdims=True)
        ratio = jnp.where(going, new / jnp.where(going, energy, 1.0), 0.0)
        return solution, residual, scaled_residual, direction, scaled, new, ratio, number + 1

    def unfinished(state):
        *_, energy, _, number = state
        return (number < _MOST_STEPS) & jnp.any(energy > enough)

    scaled_load, blank = inverse @ load, jnp.zeros_like(load)
    first = jnp.sum(load * scaled_load, axis=1, keepdims=True)
    # What is left of the error is at most Rᵀ G R, the energy, times what weakens it. Insulators change the voltages by
    # Fᵀ D F and more, conductors by its square over the load's energy at least.
    linear = jnp.abs(jnp.sum(fields * load, axis=1, keepdims=True))
    voltages = jnp.minimum(linear, linear**2 / jnp.where(first > 0, first, 1.0))
    enough = _TOLERANCE * jnp.maximum(voltages, _SMALLEST * first) / weakened[:, None, None]
    start = blank, load, scaled_load, blank, blank, first, jnp.zeros_like(first), jnp.zeros((), int)
    solution, residual, scaled_residual, *_, energy, _, _ = jax.lax.while_loop(unfinished, step, start)
    change = _transposed(solution) @ (load + residual) + _transposed(residual) @ scaled_residual
    change -= _transposed(fields) @ load
    # Rounding of the load is all that is left of voltages that are so small beside it.
    drowned = jnp.sum(voltages, axis=(1, 2)) < _SMALLEST * jnp.sum(first, axis=(1, 2))
    converged = jnp.all(energy <= enough, axis=(1, 2)) & ~drowned
    return jnp.where(converged[:, None, None], (change + _transposed(change)) / 2, jnp.nan)


def _transposed(matrices):
    return jnp.swapaxes(matrices, -1, -2)


def _symmetric(packed: Float[Array, "p m"], size: int) -> Float[Array, "m q q"]:
    """Symmetric matrices from their lower triangles."""
    rows, columns = np.tril_indices(size)
    place = np.zeros((size, size), int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return jnp.moveaxis(packed[place], -1, 0)
