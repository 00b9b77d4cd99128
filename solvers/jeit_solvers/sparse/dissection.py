"""Nested dissection: an elimination order with little fill (NumPy and SciPy, once for a sparsity pattern).

The graph is halved again and again. Each halving takes out a *separator*, a set of nodes without which the two halves
do not touch. Eliminating halves before separators keeps fill low: O(n log n) entries and O(n^1.5) operations for a
planar mesh (George, SIAM J. Numer. Anal. 10, 1973).

The halving is a straight cut through the nodes' coordinates where they are given. Otherwise it is the perpendicular
bisector, in graph distance, of two nodes that lie far apart. The nodes along the cut are thinned to the smallest
possible separator by a maximum matching of the cut edges (König's theorem; Pothen and Fan, ACM Trans. Math. Softw. 16,
1990).
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching


def nested_dissection(graph: csr_array, depth: int, coordinates: np.ndarray | None = None) -> np.ndarray:
    """Split a symmetric graph (n, n) without diagonal into a complete binary tree, `depth` separators high.

    Returns for each node of the graph the node of the tree it belongs to (n,): the root is 0, the children of t are
    2 t + 1 and 2 t + 2; leaves hold what no separator took. `coordinates` (n, d) of the nodes make the cuts straight.
    """
    owner = np.zeros(_num_nodes(graph), dtype=np.int64)
    parts: list[tuple[int, int, np.ndarray, csr_array]] = [(0, 0, np.arange(_num_nodes(graph)), graph)]
    while parts:
        tree_node, level, nodes, part = parts.pop()
        if level == depth or nodes.size == 0:
            owner[nodes] = tree_node
            continue
        side = bisect(part, None if coordinates is None else coordinates[nodes])
        owner[nodes[side == 2]] = tree_node
        for half in (0, 1):
            chosen = np.flatnonzero(side == half)
            parts.append((2 * tree_node + 1 + half, level + 1, nodes[chosen], part[chosen][:, chosen]))
    return owner


def bisect(graph: csr_array, coordinates: np.ndarray | None) -> np.ndarray:
    """Halve a graph: 0 and 1 for the halves, 2 for the separator between them, for every node.

    Several cuts are tried, and the one kept whose separator is smallest for its balance.
    """
    size = _num_nodes(graph)
    if size == 1:
        return np.array([2])
    entries = graph.tocoo()
    rows, columns = entries.coords
    # Fronts are padded to the largest of their stage: the smaller the part, the more an even split is worth, and the
    # less a node more in the separator costs.
    small = size < 400
    shares, price_of_imbalance = ((0.46, 0.5, 0.54), 0.5) if small else ((0.45, 0.5, 0.55), 0.1)
    best, best_cost = np.zeros(size, dtype=np.int64), np.inf
    for key in _cut_keys(graph, coordinates):
        order = np.argsort(key, kind="stable")
        for share in shares:
            upper = np.ones(size, dtype=bool)
            upper[order[: max(1, round(share * size))]] = False
            side = upper.astype(np.int64)
            crossing = upper[columns] & ~upper[rows]
            side[_smallest_cover(rows[crossing], columns[crossing], size)] = 2
            counts = np.bincount(side, minlength=3)
            cost = counts[2] + price_of_imbalance * abs(counts[0] - counts[1])
            if cost < best_cost:
                best, best_cost = side, cost
    return best


def _cut_keys(graph: csr_array, coordinates: np.ndarray | None) -> list[np.ndarray]:
    """Functions on the nodes whose level sets are sensible cuts."""
    if coordinates is not None:
        centred = coordinates - coordinates.mean(axis=0)
        _, axes = np.linalg.eigh(centred.T @ centred)
        projected = centred @ axes[:, ::-1]
        if projected.shape[1] == 1:
            return [projected[:, 0]]
        # The long axis, and the two diagonals to either side of it: near-square parts have no clear long axis.
        long_axis, next_axis = projected[:, 0], projected[:, 1]
        return [long_axis, long_axis + 0.4 * next_axis, long_axis - 0.4 * next_axis]
    size = _num_nodes(graph)
    count, label = connected_components(graph, directed=False)
    if count > 1:
        # Parts that do not touch need no separator: whole components go to either side, the largest first.
        sizes = np.bincount(label)
        rank = np.empty(count, dtype=np.int64)
        rank[np.argsort(-sizes, kind="stable")] = np.arange(count)
        largest = np.flatnonzero(rank[label] == 0)
        if 2 * largest.size <= size:
            return [rank[label].astype(float)]
        key = np.full(size, np.inf)
        key[largest] = _far_ends(graph[largest][:, largest])
        return [key]
    return [_far_ends(graph)]


def _far_ends(graph: csr_array) -> np.ndarray:
    """Difference of the graph distances to two nodes that lie far apart; its level sets are nearly straight."""
    start = breadth_first_order(graph, 0, directed=False, return_predecessors=False)[-1]
    from_start = _distances(graph, start)
    end = int(np.argmax(from_start))
    from_end = _distances(graph, end)
    return (from_start - from_end) + 1e-3 * from_start


def _distances(graph: csr_array, start: int) -> np.ndarray:
    """Number of edges between `start` and every node of a connected graph."""
    order, predecessor = breadth_first_order(graph, start, directed=False)
    position = np.empty(_num_nodes(graph), dtype=np.int64)
    position[order] = np.arange(order.size)
    # Breadth-first order lists layer after layer, and parents before children: where parents leave a layer, one ends.
    parent = position[predecessor[order[1:]]]
    distance = np.zeros(order.size)
    layer_start, layer = 1, 1
    while layer_start < order.size:
        layer_end = layer_start + int(np.searchsorted(parent[layer_start - 1 :], layer_start, side="left"))
        distance[layer_start:layer_end] = layer
        layer_start, layer = layer_end, layer + 1
    result = np.empty(order.size)
    result[order] = distance
    return result


def _smallest_cover(lower: np.ndarray, upper: np.ndarray, size: int) -> np.ndarray:
    """Fewest nodes that touch every edge between two sides (König: as many as a maximum matching has edges)."""
    if lower.size == 0:
        return np.empty(0, dtype=np.int64)
    left, left_local = np.unique(lower, return_inverse=True)
    right, right_local = np.unique(upper, return_inverse=True)
    edges = csr_array((np.ones(lower.size, dtype=np.int8), (left_local, right_local)), shape=(left.size, right.size))
    match_of_left = maximum_bipartite_matching(edges, perm_type="column")
    match_of_right = np.full(right.size, -1)
    matched = match_of_left >= 0
    match_of_right[match_of_left[matched]] = np.flatnonzero(matched)
    # Alternating paths from the unmatched left nodes; the cover is what they miss on the left and reach on the right.
    reached_left = ~matched
    reached_right = np.zeros(right.size, dtype=bool)
    while True:
        found = np.zeros(right.size, dtype=bool)
        found[right_local[reached_left[left_local]]] = True
        found &= ~reached_right
        if not found.any():
            break
        reached_right |= found
        back = match_of_right[found]
        reached_left[back[back >= 0]] = True
    return np.concatenate([left[~reached_left], right[reached_right]])


def _num_nodes(graph: csr_array) -> int:
    return graph.indptr.size - 1
