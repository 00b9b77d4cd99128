"""Draw the topology of a map: neurons as masses, neighbours connected by springs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import check_key, check_kind
from jeit.arguments.extras import optional
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

# Steps of the springs, and the distance of neighbours, relative to the usual one, below which springs grow no stronger.
_STEPS, _LEAST = 60, 1e-2


def drawn_map(learnt: SelfOrganisingMap, key: Array) -> Float[np.ndarray, "R C 2"]:
    """Places (R, C, 2) of a map's neurons on paper, from -1 to 1, by Fruchterman and Reingold's springs (1991).

    Each neuron is tied to its four neighbours on the grid, the stronger the nearer its frame is to theirs; all repel
    each other. They start from their places on the grid, moved a little at random by `key`: which way round the drawing
    comes out says nothing. Raises `ValueError` for what is no map, and no key.
    """
    networkx = optional("networkx", "a map drawn as a graph")
    import jax

    check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
    check_key(key)
    rows, columns = learnt.shape
    first, second = neighbours(learnt.shape)
    flat = learnt.weights.reshape(rows * columns, -1)
    distance = np.linalg.norm(flat[first] - flat[second], axis=1)
    usual = float(np.median(distance)) or 1.0
    strength = usual / np.maximum(distance, _LEAST * usual)
    graph = networkx.Graph()
    graph.add_nodes_from(range(rows * columns))
    graph.add_weighted_edges_from(zip(first.tolist(), second.tolist(), strength.tolist(), strict=True))
    grid = np.stack(np.unravel_index(np.arange(rows * columns), learnt.shape), axis=1) / max(rows, columns)
    grid = grid + 1e-3 * np.asarray(jax.random.normal(key, grid.shape))
    start = dict(enumerate(grid))
    drawn = networkx.spring_layout(graph, pos=start, iterations=_STEPS, method="force", seed=0)
    return np.array([drawn[one] for one in range(rows * columns)]).reshape(rows, columns, 2)


def neighbours(shape: tuple[int, int]) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Numbers of the neurons, row by row, at both ends of every edge of a grid of this shape."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    return first, np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
