"""Changes of voltages by touches, one touch at a time: exact by low-rank updates of one factorisation, or linear.

A touch adds D to the system matrix K of the electrode model, nonzero only among its k nodes. With the fields F for unit
currents into the electrodes and G = K⁻¹, both restricted to those nodes,

    ΔZ = −Fᵀ D F + (D F)ᵀ Y,    (G⁻¹ + D) Y = D F,

(Sherman-Morrison-Woodbury), by conjugate gradients with G as the preconditioner: they need products with G and D only,
never G⁻¹, in few steps, as touches of a bounded depth change the energy of any field by a bounded factor; nodes that a
touch cuts off make the matrix singular, but nothing flows there. With the residual R of Y, (D F)ᵀ Y + Yᵀ R lacks
Rᵀ (G⁻¹ + D)⁻¹ R, and Rᵀ G R is most of that.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.design.press import Presses
from jeit.forward import ForwardModel
from jeit.forward.assembly import cell_conductivity, check_conductivity, stiffness
from jeit.forward.model import select_channels
from jeit.forward.transfer import fields_and_inverse
from jeit.mesh import Mesh
from jeit_solvers import over_cores

# Of Rᵀ G R, relative to the voltages, which are more exact than that.
_TOLERANCE, _SMALLEST, _MOST_STEPS = 1e-9, 1e-12, 200
# Touches worked on at once: their blocks of the inverse are to stay in the cache.
_CHUNK = 8
# Touches whose nodes are sought at once.
_AT_ONCE = 64


def touch_changes(model: ForwardModel, conductivity, presses: Presses, *, linear: bool = False) -> Float[Array, "n M"]:
    """Changes (n, M) of the protocol's M voltages by n touches, one at a time, in volts.

    `linear`: J δσ, the Jacobian's, differentiable in everything and batched with `vmap`; else exact, as if the model
    had been solved anew for every touch. Raises `ValueError` for touches of another mesh, and `RuntimeError`
    where exact changes are not found.
    """
    conductivity = check_conductivity(model.mesh, conductivity)
    if conductivity.ndim == 3 or jnp.iscomplexobj(conductivity):
        raise ValueError("touches need a real, scalar conductivity.")
    if presses.num_cells != model.mesh.num_cells:
        raise ValueError(
            f"the touches are of a mesh of {presses.num_cells} cells, and the model's has {model.mesh.num_cells}; "
            "press on the model's own, press(model.mesh, …)."
        )
    if linear:
        return _linear(model, cell_conductivity(model.mesh, conductivity), presses)
    return _exact(model, cell_conductivity(model.mesh, conductivity), presses)


@jax.jit
def _linear(model: ForwardModel, conductivity, presses: Presses):
    jacobian = model.jacobian(conductivity).T  # (m, M)
    changed = presses.change * conductivity[presses.cells]

    def some(index):
        return jnp.einsum("bc,bcm->bm", changed[index], jacobian[presses.cells[index]])

    number = len(changed)
    index = jnp.minimum(jnp.arange(-(-number // _CHUNK) * _CHUNK), number - 1).reshape(-1, _CHUNK)
    return _joined(jax.lax.map(some, index))[:number]


class _Touched(eqx.Module):
    """Nodes of touches: `union` (u,) of all; `nodes` (n, k) of each, as places in the union, repeated to be as many;
    `corners` (n, c, d + 1), the nodes of cells, as places among those k."""

    union: Int[np.ndarray, " u"]
    nodes: Int[np.ndarray, "n k"]
    corners: Int[np.ndarray, "n c q"]


def _nodes(mesh: Mesh, presses: Presses) -> _Touched:
    cells, real = np.asarray(presses.cells), np.asarray(presses.change) != 0
    corners = np.asarray(mesh.cells)[cells]  # (n, c, q)
    union = np.unique(corners[real])
    place = np.full(mesh.num_points, -1)
    place[union] = np.arange(len(union))
    own = np.where(real[..., None], place[corners], len(union))  # all that is not touched is one node more
    local, each = np.zeros(corners.shape, np.int32), []
    for some in np.array_split(np.arange(len(own)), -(-len(own) // _AT_ONCE)):
        row = np.arange(len(some))[:, None, None]
        reached = np.zeros((len(some), len(union) + 1), bool)
        reached[row, own[some]] = True
        local[some] = (np.cumsum(reached, axis=1, dtype=np.int32) - 1)[row, own[some]]
        each += [np.flatnonzero(one) for one in reached[:, :-1]]
    local[~real] = 0
    most = -(-max(map(len, each)) // 8) * 8
    padded = np.stack([np.pad(one, (0, most - len(one)), mode="edge") for one in each])
    return _Touched(union, padded.astype(np.int32), local)


def _exact(model: ForwardModel, conductivity, presses: Presses):
    touched = _nodes(model.mesh, presses)
    known = fields_and_inverse(model.mesh, conductivity, model.electrodes, model.system, jnp.asarray(touched.union))
    touches = jax.tree.map(jnp.asarray, (presses.cells, presses.change, touched.nodes, touched.corners))
    number = len(presses.cells)
    found = over_cores(partial(_changes, model, conductivity, known, touches), number, _CHUNK)[:number]
    lost = np.flatnonzero(~np.isfinite(np.asarray(found)).all(axis=1))
    if lost.size:
        x, y = np.asarray(presses.places)[lost[0]]
        raise RuntimeError(
            f"the changes by {lost.size} of {number} touches were not found in {_MOST_STEPS} steps, the first at "
            f"({1e3 * x:.4g}, {1e3 * y:.4g}) mm; are conductivities many orders of magnitude apart?"
        )
    return found


@jax.jit
def _changes(model: ForwardModel, conductivity, known, touches, index):
    """Changes of the voltages by the touches with these numbers (c, s), s of them at a time."""
    fields, inverse = known
    element = _symmetric(stiffness(model.mesh, conductivity), model.mesh.dimension + 1)  # (m, q, q)
    select = jax.vmap(lambda change: select_channels(model.protocol, change))

    def some(index):
        cells, change, nodes, corners = (array[index] for array in touches)
        blocks = element[cells] * change[..., None, None]
        return select(_impedance_changes(blocks, corners, inverse[nodes[:, :, None], nodes[:, None]], fields[nodes]))

    return _joined(jax.lax.map(some, index))


def _joined(chunks: Float[Array, "c s *m"]) -> Float[Array, "cs *m"]:
    return chunks.reshape(-1, *chunks.shape[2:])


def _impedance_changes(blocks, corners, inverse, fields):
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
        # What has converged stays: nothing but rounding is left of it, and of its curvature.
        going = (energy > _TOLERANCE * scale) & (curvature > 0)
        length = jnp.where(going, energy / jnp.where(going, curvature, 1.0), 0.0)
        solution, residual = solution + length * direction, residual - length * product
        scaled_residual = inverse @ residual
        new = jnp.sum(residual * scaled_residual, axis=1, keepdims=True)
        ratio = jnp.where(going, new / jnp.where(going, energy, 1.0), 0.0)
        return solution, residual, scaled_residual, direction, scaled, new, ratio, number + 1

    def unfinished(state):
        *_, energy, _, number = state
        return (number < _MOST_STEPS) & jnp.any(energy > _TOLERANCE * scale)

    scaled_load, blank = inverse @ load, jnp.zeros_like(load)
    first = jnp.sum(load * scaled_load, axis=1, keepdims=True)
    # Of what is to be found: conductors make the load large, and not the voltages.
    small = jnp.sum(fields * load, axis=1, keepdims=True) ** 2 / jnp.where(first > 0, first, 1.0)
    scale = jnp.clip(small, _SMALLEST * first, first)
    start = blank, load, scaled_load, blank, blank, first, jnp.zeros_like(first), jnp.zeros((), int)
    solution, residual, scaled_residual, *_, energy, _, _ = jax.lax.while_loop(unfinished, step, start)
    change = _transposed(solution) @ (load + residual) + _transposed(residual) @ scaled_residual
    change -= _transposed(fields) @ load
    converged = jnp.all(energy <= _TOLERANCE * scale, axis=(1, 2))
    return jnp.where(converged[:, None, None], (change + _transposed(change)) / 2, jnp.nan)


def _transposed(matrices):
    return jnp.swapaxes(matrices, -1, -2)


def _symmetric(packed: Float[Array, "p m"], size: int) -> Float[Array, "m q q"]:
    """Full matrices from lower triangles."""
    rows, columns = np.tril_indices(size)
    place = np.zeros((size, size), int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return jnp.moveaxis(packed[place], -1, 0)
