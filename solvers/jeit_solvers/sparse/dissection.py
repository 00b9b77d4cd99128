"""Nested dissection: an elimination order with little fill, computed in NumPy and SciPy once per sparsity pattern.

The graph of the matrix is halved recursively. Each halving removes a *separator*, a set of nodes without which no edge
connects the two halves. Eliminating halves before separators keeps fill low: O(n log n) entries and O(n^1.5) operations
for a planar mesh (George, SIAM J. Numer. Anal. 10, 1973).

If coordinates of the nodes are given, a part is halved by a straight line (in three dimensions by a plane). Otherwise
two nodes that lie far apart are chosen, and each half consists of the nodes that are nearer, in graph distance, to one
of the two. The smallest separator of two halves is computed from a maximum matching of the edges between them (König's
theorem; Pothen and Fan, ACM Trans. Math. Softw. 16, 1990).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching

# Coordinates, relative to their extent, are rounded to this number of decimals, so that the elimination order does not
# depend on rounding errors.
_COORDINATE_DECIMALS = 7


def nested_dissection(graph: csr_array, depth: int, coordinates: np.ndarray | None = None) -> np.ndarray:
    """Split a symmetric graph (n, n) without diagonal into a complete binary tree of `depth` levels of separators.

    Returns the number (n,) of the tree node to which each node of the graph belongs. The root is 0, and the children of
    t are 2 t + 1 and 2 t + 2; leaves contain the nodes that belong to no separator. With `coordinates` (n, d) of the
    nodes, each separator lies along a straight line or plane; without `coordinates`, separators are found from graph
    distances.
    """
    num_graph_nodes = _num_nodes(graph)
    front_indices, parts_to_halve = np.zeros(num_graph_nodes, dtype=np.int64), np.arange(num_graph_nodes)
    if coordinates is not None:
        lower_corner, bounding_size = (
            coordinates.min(axis=0),
            max(np.ptp(coordinates, axis=0).max(), np.finfo(float).tiny),
        )
        coordinates = np.round((coordinates - lower_corner) / bounding_size, _COORDINATE_DECIMALS)
    graph_entries = graph.tocoo()
    edge_rows, edge_columns = graph_entries.coords
    for _ in range(depth):
        # All parts of a level are halved at once; a separator belongs to the tree node that it separates.
        local_indices = np.full(num_graph_nodes, -1)
        tree_nodes, local_indices[parts_to_halve] = np.unique(front_indices[parts_to_halve], return_inverse=True)
        edge_rows, edge_columns = _edges_within_parts(local_indices, edge_rows, edge_columns)
        side_of_node = _halve_parts(graph, edge_rows, edge_columns, local_indices, tree_nodes.size, coordinates)
        parts_to_halve = parts_to_halve[side_of_node[parts_to_halve] < 2]
        front_indices[parts_to_halve] = 2 * front_indices[parts_to_halve] + 1 + side_of_node[parts_to_halve]
    return front_indices


def _edges_within_parts(
    part_of_node: np.ndarray, edge_rows: np.ndarray, edge_columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Edges, as `edge_rows` and `edge_columns`, that connect two nodes of the same part of a graph."""
    is_inside = (part_of_node[edge_rows] == part_of_node[edge_columns]) & (part_of_node[edge_rows] >= 0)
    return edge_rows[is_inside], edge_columns[is_inside]


def _halve_parts(
    graph: csr_array,
    edge_rows: np.ndarray,
    edge_columns: np.ndarray,
    part_of_node: np.ndarray,
    num_parts: int,
    coordinates,
) -> np.ndarray:
    """Halve every part of a graph. Returns for every node (n,) 0 or 1 for the halves, 2 for the separator between them.

    `part_of_node`: (n,) index of the part of each node, -1 for none; `num_parts`: number of parts; `edge_rows`,
    `edge_columns`: edges within parts. Several separators are tried for each part; the best separator minimises its
    number of nodes plus a penalty for imbalance of the halves.
    """
    nodes = np.flatnonzero(part_of_node >= 0)
    node_parts = part_of_node[nodes]
    part_sizes = np.bincount(node_parts, minlength=num_parts)
    # Fronts are padded to the largest front of their stage. The smaller the part, the more an even split is worth, and
    # the less an additional node in the separator costs.
    is_small_part = part_sizes < 400
    imbalance_penalty = np.where(is_small_part, 0.5, 0.1)
    best_side_of_node, best_split_costs = np.full(part_of_node.size, 2), np.full(num_parts, np.inf)
    for sorting_values in _splitting_functions(graph, nodes, node_parts, num_parts, coordinates):
        sort_order = np.lexsort((sorting_values, node_parts))
        node_ranks = np.empty(nodes.size, dtype=np.int64)
        node_ranks[sort_order] = np.arange(nodes.size) - np.repeat(np.cumsum(part_sizes) - part_sizes, part_sizes)
        for offset_from_middle in (-1, 0, 1):
            lower_fraction = 0.5 + offset_from_middle * np.where(is_small_part, 0.04, 0.05)
            num_below = np.maximum(1, np.rint(lower_fraction * part_sizes)).astype(np.int64)
            side_of_node = np.zeros(part_of_node.size, dtype=np.int64)
            side_of_node[nodes] = node_ranks >= num_below[node_parts]
            is_crossing = side_of_node[edge_columns] > side_of_node[edge_rows]
            side_of_node[_minimum_vertex_cover(edge_rows[is_crossing], edge_columns[is_crossing])] = 2
            side_counts = np.bincount(3 * node_parts + side_of_node[nodes], minlength=3 * num_parts).reshape(-1, 3)
            split_costs = side_counts[:, 2] + imbalance_penalty * np.abs(side_counts[:, 0] - side_counts[:, 1])
            is_better = split_costs < best_split_costs
            best_split_costs[is_better] = split_costs[is_better]
            changed_nodes = nodes[is_better[node_parts]]
            best_side_of_node[changed_nodes] = side_of_node[changed_nodes]
    return best_side_of_node


def _splitting_functions(
    graph: csr_array, nodes: np.ndarray, part_of_node: np.ndarray, num_parts: int, coordinates
) -> list[np.ndarray]:
    """Functions on `nodes` (k,) by which parts can be split, into the nodes where a function is below a value and the
    nodes where the function is above this value."""
    if coordinates is not None:
        return _projected_coordinates(coordinates[nodes], part_of_node, num_parts)
    sort_order = np.argsort(part_of_node, kind="stable")
    splitting_values = np.empty(nodes.size)
    for part_nodes in np.split(sort_order, np.cumsum(np.bincount(part_of_node, minlength=num_parts))[:-1]):
        nodes_of_part = nodes[part_nodes]
        splitting_values[part_nodes] = _distance_function(graph[nodes_of_part][:, nodes_of_part])
    return [splitting_values]


def _projected_coordinates(coordinates: np.ndarray, part_of_node: np.ndarray, num_parts: int) -> list[np.ndarray]:
    """Coordinates of the nodes along the long axis of their part, and along two directions at an angle to this axis,
    because nearly square parts have no clear long axis."""
    dimension = coordinates.shape[1]

    def sum_over_parts(node_values):
        return np.stack([np.bincount(part_of_node, value_column, num_parts) for value_column in node_values.T], axis=1)

    part_sizes = np.maximum(np.bincount(part_of_node, minlength=num_parts), 1)[:, None]
    centred_coordinates = coordinates - (sum_over_parts(coordinates) / part_sizes)[part_of_node]
    covariances = sum_over_parts(
        (centred_coordinates[:, :, None] * centred_coordinates[:, None]).reshape(-1, dimension**2)
    )
    _, principal_axes = np.linalg.eigh(covariances.reshape(num_parts, dimension, dimension))
    projected_coordinates = np.einsum("ni,nij->nj", centred_coordinates, principal_axes[part_of_node][:, :, ::-1])
    if dimension == 1:
        return [projected_coordinates[:, 0]]
    long_axis, next_axis = projected_coordinates[:, 0], projected_coordinates[:, 1]
    return [long_axis, long_axis + 0.4 * next_axis, long_axis - 0.4 * next_axis]


def _distance_function(graph: csr_array) -> np.ndarray:
    """Compute from graph distances a function on the nodes of one part of a graph; the part is split by its values."""
    num_graph_nodes = _num_nodes(graph)
    if num_graph_nodes == 1:
        return np.zeros(1)
    num_components, component_labels = connected_components(graph, directed=False)
    if num_components == 1:
        return _distance_difference(graph)
    # Unconnected components need no separator: whole components go to either side, the largest first.
    component_sizes = np.bincount(component_labels)
    component_ranks = np.empty(num_components, dtype=np.int64)
    component_ranks[np.argsort(-component_sizes, kind="stable")] = np.arange(num_components)
    largest_components = np.flatnonzero(component_ranks[component_labels] == 0)
    if 2 * largest_components.size <= num_graph_nodes:
        return component_ranks[component_labels].astype(float)
    distance_values = np.full(num_graph_nodes, np.inf)
    distance_values[largest_components] = _distance_difference(graph[largest_components][:, largest_components])
    return distance_values


def _distance_difference(graph: csr_array) -> np.ndarray:
    """Difference of each node's graph distances to two nodes that lie far apart. Nodes with equal differences lie
    nearly on a straight line."""
    start_node = breadth_first_order(graph, 0, directed=False, return_predecessors=False)[-1]
    distances_from_start = _graph_distances(graph, start_node)
    end_node = int(np.argmax(distances_from_start))
    distances_from_end = _graph_distances(graph, end_node)
    return (distances_from_start - distances_from_end) + 1e-3 * distances_from_start


def _graph_distances(graph: csr_array, start_node: int) -> np.ndarray:
    """Number of edges between `start_node` and every node of a connected graph."""
    visit_order, node_predecessors = breadth_first_order(graph, start_node, directed=False)
    visit_positions = np.empty(_num_nodes(graph), dtype=np.int64)
    visit_positions[visit_order] = np.arange(visit_order.size)
    # Breadth-first order lists layer after layer, and parents before children: a layer ends where the parents leave the
    # previous layer.
    parent_positions = visit_positions[node_predecessors[visit_order[1:]]]
    visit_distances = np.zeros(visit_order.size)
    layer_start, layer_number = 1, 1
    while layer_start < visit_order.size:
        layer_end = layer_start + int(np.searchsorted(parent_positions[layer_start - 1 :], layer_start, side="left"))
        visit_distances[layer_start:layer_end] = layer_number
        layer_start, layer_number = layer_end, layer_number + 1
    node_distances = np.empty(visit_order.size)
    node_distances[visit_order] = visit_distances
    return node_distances


def _minimum_vertex_cover(lower_nodes: np.ndarray, upper_nodes: np.ndarray) -> np.ndarray:
    """Smallest set of nodes that contains at least one end of every edge (lower[i], upper[i]). By König's theorem this
    set has as many nodes as a maximum matching has edges."""
    if lower_nodes.size == 0:
        return np.empty(0, dtype=np.int64)
    left_nodes, local_left_nodes = np.unique(lower_nodes, return_inverse=True)
    right_nodes, local_right_nodes = np.unique(upper_nodes, return_inverse=True)
    bipartite_edges = csr_array(
        (np.ones(lower_nodes.size, dtype=np.int8), (local_left_nodes, local_right_nodes)),
        shape=(left_nodes.size, right_nodes.size),
    )
    match_of_left = maximum_bipartite_matching(bipartite_edges, perm_type="column")
    match_of_right = np.full(right_nodes.size, -1)
    is_matched = match_of_left >= 0
    match_of_right[match_of_left[is_matched]] = np.flatnonzero(is_matched)
    # Follow alternating paths from the unmatched left nodes; the cover consists of the left nodes not reached and the
    # right nodes reached.
    reached_left_nodes = ~is_matched
    reached_right_nodes = np.zeros(right_nodes.size, dtype=bool)
    while True:
        newly_reached = np.zeros(right_nodes.size, dtype=bool)
        newly_reached[local_right_nodes[reached_left_nodes[local_left_nodes]]] = True
        newly_reached &= ~reached_right_nodes
        if not newly_reached.any():
            break
        reached_right_nodes |= newly_reached
        matched_left_nodes = match_of_right[newly_reached]
        reached_left_nodes[matched_left_nodes[matched_left_nodes >= 0]] = True
    return np.concatenate([left_nodes[~reached_left_nodes], right_nodes[reached_right_nodes]])


def _num_nodes(graph: csr_array) -> int:
    return graph.indptr.size - 1
