"""Changes of voltages by touches, one touch at a time: exact by low-rank updates of one factorisation, or linear.

A touch adds D to the system matrix K of the electrode model, nonzero only among its k nodes. With the fields F for unit
currents into the electrodes and G = K⁻¹, both restricted to those nodes,

    ΔZ = −Fᵀ D F + (D F)ᵀ Y,    (G⁻¹ + D) Y = D F,

(Sherman-Morrison-Woodbury), by conjugate gradients with G as the preconditioner: they need products with G and D only,
never G⁻¹, in few steps, as touches of a bounded depth change the energy of any field by a bounded factor; nodes that a
touch cuts off make the matrix singular, but nothing flows there. With the residual R of Y, the error of
(D F)ᵀ Y + Yᵀ R is of the order of its square.
"""

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

# Of the square of the residual, relative: the voltages are as exact as that.
_TOLERANCE, _MOST_STEPS, _LEAST = 1e-10, 200, 1e-300
# Touches worked on at once: their blocks of the inverse are to stay in the cache.
_CHUNK = 32


def touch_changes(model: ForwardModel, conductivity, presses: Presses, *, linear: bool = False) -> Float[Array, "n M"]:
    """Changes (n, M) of the protocol's M voltages by n touches, one at a time, in volts.

    `linear`: J δσ, the Jacobian's, differentiable in everything and batched with `vmap`; else exact, as if the model
    had been solved anew for every touch. Raises `ValueError` where a touch has cells that the mesh has not.
    """
    conductivity = check_conductivity(model.mesh, conductivity)
    if conductivity.ndim == 3 or jnp.iscomplexobj(conductivity):
        raise ValueError("touches need a real, scalar conductivity.")
    if linear:
        return _linear(model, cell_conductivity(model.mesh, conductivity), presses)
    touched = _nodes(model.mesh, presses)
    return _exact(model, cell_conductivity(model.mesh, conductivity), presses, touched)


@jax.jit
def _linear(model: ForwardModel, conductivity, presses: Presses):
    jacobian = model.jacobian(conductivity).T  # (m, M)
    changed = presses.change * conductivity[presses.cells]

    def some(touches):
        cells, amount = touches
        return jnp.einsum("bc,bcm->bm", amount, jacobian[cells])

    return _in_chunks(some, (presses.cells, changed))


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
    each, local = [], np.zeros(corners.shape, np.int32)
    for k, (one, used) in enumerate(zip(corners, real, strict=True)):
        nodes, places = np.unique(one[used], return_inverse=True)
        local[k, used] = places.reshape(-1, corners.shape[-1])
        each.append(np.searchsorted(union, nodes))
    most = -(-max(map(len, each)) // 8) * 8
    padded = np.stack([np.pad(one, (0, most - len(one)), mode="edge") for one in each])
    return _Touched(union, padded.astype(np.int32), local)


@jax.jit
def _exact(model: ForwardModel, conductivity, presses: Presses, touched: _Touched):
    fields, inverse = fields_and_inverse(model.mesh, conductivity, model.electrodes, model.system, touched.union)
    element = _symmetric(stiffness(model.mesh, conductivity), model.mesh.dimension + 1)  # (m, q, q)

    def some(touches):
        cells, change, nodes, corners = touches
        blocks = element[cells] * change[..., None, None]
        return select(_impedance_changes(blocks, corners, inverse[nodes[:, :, None], nodes[:, None]], fields[nodes]))

    select = jax.vmap(lambda change: select_channels(model.protocol, change))
    return _in_chunks(some, (presses.cells, presses.change, touched.nodes, touched.corners))


def _in_chunks(function, arrays):
    number = len(arrays[0])
    chunks = -(-number // _CHUNK)
    index = jnp.minimum(jnp.arange(chunks * _CHUNK), number - 1).reshape(chunks, _CHUNK)
    result = jax.lax.map(lambda some: function(tuple(array[some] for array in arrays)), index)
    return result.reshape(-1, *result.shape[2:])[:number]


def _impedance_changes(blocks, corners, inverse, fields):
    """ΔZ (b, L, L) of b touches: D as `blocks` (b, c, q, q) of cells at `corners` (b, c, q), G (b, k, k), F (b, k, L).

    The steps are those of all touches together, until the last has converged.
    """
    touch = jnp.arange(len(fields))[:, None, None]
    size = fields.shape[1]
    added = jnp.zeros((len(fields), size, size))
    added = added.at[touch[..., None], corners[..., :, None], corners[..., None, :]].add(blocks)
    load = added @ fields

    def step(state):
        solution, residual, direction, scaled, energy, number = state
        product = scaled + added @ direction
        length = energy / jnp.maximum(jnp.sum(direction * product, axis=1, keepdims=True), _LEAST)
        solution, residual = solution + length * direction, residual - length * product
        preconditioned = inverse @ residual
        new = jnp.sum(residual * preconditioned, axis=1, keepdims=True)
        ratio = new / jnp.maximum(energy, _LEAST)
        # G⁻¹ of the direction, which is a combination of what G was applied to.
        return solution, residual, preconditioned + ratio * direction, residual + ratio * scaled, new, number + 1

    def unfinished(state):
        return (state[-1] < _MOST_STEPS) & jnp.any(state[-2] > _TOLERANCE * first)

    direction = inverse @ load
    first = jnp.sum(load * direction, axis=1, keepdims=True)
    start = jnp.zeros_like(load), load, direction, load, first, jnp.zeros((), int)
    solution, residual, *_ = jax.lax.while_loop(unfinished, step, start)
    change = _transposed(load) @ solution + _transposed(solution) @ residual - _transposed(fields) @ load
    return (change + _transposed(change)) / 2


def _transposed(matrices):
    return jnp.swapaxes(matrices, -1, -2)


def _symmetric(packed: Float[Array, "p m"], size: int) -> Float[Array, "m q q"]:
    """Full matrices from lower triangles."""
    rows, columns = np.tril_indices(size)
    place = np.zeros((size, size), int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return jnp.moveaxis(packed[place], -1, 0)
