"""The nodes whose rows of the system matrix touches change, numbered touch by touch (NumPy)."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Int

from jeit.design.skin.touched_cells import TouchedCells
from jeit.forward import ForwardModel
from jeit_solvers import Strips

# Touches processed at once; and the multiple to which the number of nodes is padded: programs are compiled for each.
_AT_ONCE, _MULTIPLE = 64, 16


class TouchedNodes(eqx.Module):
    """Nodes changed by n touches.

    `strips`: all of them, in strips across the skin; `nodes` (n, k): those of each touch, as places in the strips, the
    last one repeated to be as many; `corners` (n, c, d + 1): nodes of the touches' cells, as places among those k.
    """

    strips: Strips
    nodes: Int[np.ndarray, "n k"]
    corners: Int[np.ndarray, "n c q"]


def touched_nodes(model: ForwardModel, touches: TouchedCells, strips: Strips | None = None) -> TouchedNodes:
    """Find the nodes of the cells that touches change; `strips` of these and more nodes, of these alone unless
    given."""
    mesh, cells, real = model.mesh, np.asarray(touches.cells), np.asarray(touches.change) != 0
    touched = np.zeros(mesh.num_points, bool)
    touched[np.asarray(mesh.cells)[cells[real]]] = True
    if strips is None:
        strips = Strips.create(model.system.pattern, np.asarray(mesh.points), touched)
    nowhere = strips.number * strips.wanted  # one entry for all untouched nodes
    place = np.where(touched, strips.place, nowhere).astype(np.int32)[np.asarray(mesh.cells)]
    corners, found = np.zeros((*cells.shape, mesh.cells.shape[1]), np.int32), []
    for start in range(0, len(cells), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        places = np.where(real[some, :, None], place[cells[some]], nowhere)
        corners[some], (touch, number, node) = _numbered(places, nowhere)
        found.append((start + touch, number, node))
    corners[~real] = 0
    touch, number, node = (np.concatenate(part) for part in zip(*found, strict=True))
    nodes = np.zeros((len(cells), -(-(number.max(initial=0) + 1) // _MULTIPLE) * _MULTIPLE), np.int32)
    nodes[touch, number] = node
    final = np.minimum(np.arange(nodes.shape[1]), np.bincount(touch, minlength=len(cells))[:, None] - 1)
    return TouchedNodes(strips, np.take_along_axis(nodes, final, axis=1), corners)


def _numbered(places: Int[np.ndarray, "b c q"], nowhere: int):
    """The distinct places of each of b touches counted up from 0: the number of every place given (b, c, q); and
    touch, number and place of all that are somewhere."""
    first = (nowhere + 1) * np.arange(len(places), dtype=np.int32)
    keys = places + first[:, None, None]
    reached = np.zeros(len(places) * (nowhere + 1), bool)
    reached[keys] = True
    reached[first + nowhere] = False
    distinct = np.flatnonzero(reached)
    touch, place = np.divmod(distinct, nowhere + 1)
    number = np.arange(len(distinct)) - np.searchsorted(distinct, first)[touch]
    numbers = np.zeros(len(reached), np.int32)
    numbers[distinct] = number
    return numbers[keys], (touch, number, place)
