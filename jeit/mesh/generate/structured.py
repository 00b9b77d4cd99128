"""Structured triangulations: concentric rings of cells in a disk, rows of cells in a rectangle.

Both triangulations consist of chains of nodes laid side by side. Where the numbers of nodes of neighbouring chains
differ slightly, the offset between the chains varies gradually. Triangles then range between equilateral and
right-angled, and no angle is smaller than about 40°.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from jeit.mesh.generate.refine import TooFewNodesError

# Height of a row divided by the mean edge length along it: a value between 1 for squares and 0.87 for equilateral
# triangles.
_RELATIVE_ROW_HEIGHT = 0.93


def triangulate_between_chains(outer_chain: np.ndarray, inner_chain: np.ndarray, *, is_closed: bool) -> np.ndarray:
    """Triangles (t, 3) between two chains of nodes that run in the same direction, `inner_chain` to the left of
    `outer_chain`.

    `outer_chain` and `inner_chain` are node indices, evenly spaced along their chains; a closed chain returns to its
    first node. Each segment of a chain forms a triangle with the node opposite to it on the other chain. The triangles
    are ordered by the midpoints of their segments.
    """
    num_outer, num_inner = (
        (len(outer_chain), len(inner_chain)) if is_closed else (len(outer_chain) - 1, len(inner_chain) - 1)
    )
    # Midpoints multiplied by 2 N_outer N_inner, as integers, so that ties are exact.
    outer_edge_middles = (2 * np.arange(num_outer) + 1) * num_inner
    inner_edge_middles = (2 * np.arange(num_inner) + 1) * num_outer
    facing_inner_nodes = np.searchsorted(inner_edge_middles, outer_edge_middles, side="left")
    facing_outer_nodes = np.searchsorted(outer_edge_middles, inner_edge_middles, side="right")
    outer_indices, inner_indices = np.arange(num_outer), np.arange(num_inner)
    lower_triangles = np.stack(
        [
            outer_chain[outer_indices],
            outer_chain[(outer_indices + 1) % len(outer_chain)],
            inner_chain[facing_inner_nodes % len(inner_chain)],
        ],
        axis=1,
    )
    upper_triangles = np.stack(
        [
            inner_chain[(inner_indices + 1) % len(inner_chain)],
            inner_chain[inner_indices],
            outer_chain[facing_outer_nodes % len(outer_chain)],
        ],
        axis=1,
    )
    return np.concatenate([lower_triangles, upper_triangles])[
        np.argsort(np.concatenate([outer_edge_middles, inner_edge_middles]), kind="stable")
    ]


def ring_counts(num_rings: int, num_boundary: int) -> np.ndarray:
    """Number of nodes on each ring, outermost first, for rings of equal thickness with about equal node spacing."""
    ring_numbers = np.arange(num_rings, 0, -1)
    return np.maximum(np.rint(num_boundary * ring_numbers / num_rings).astype(int), 3)


def choose_rings(num_points: int) -> tuple[int, int]:
    """Number of rings and number of boundary nodes such that the disk has close to `num_points` nodes."""
    guessed_rings = np.sqrt(num_points / 3.0)
    best_choice_and_cost = None
    for num_rings in range(max(1, int(guessed_rings) - 1), int(guessed_rings) + 3):
        for num_boundary in range(max(5, int(4.9 * num_rings)), int(7.3 * num_rings) + 2):
            num_nodes = 1 + int(ring_counts(num_rings, num_boundary).sum())
            # Triangles are most regular with six times as many boundary nodes as rings. The ratio differs from six only
            # as far as the number of nodes requires.
            relative_deviation = abs(num_nodes / num_points - 1.0)
            choice_cost = (
                relative_deviation > 0.03,
                relative_deviation if relative_deviation > 0.03 else 0.0,
                abs(num_boundary / num_rings - 6.0),
                relative_deviation,
            )
            if best_choice_and_cost is None or choice_cost < best_choice_and_cost[0]:
                best_choice_and_cost = (choice_cost, num_rings, num_boundary)
    assert best_choice_and_cost is not None
    return best_choice_and_cost[1], best_choice_and_cost[2]


def ring_disk(num_rings: int, num_boundary: int) -> tuple[np.ndarray, np.ndarray]:
    """Mesh of the unit disk in concentric rings: points (n, 2), with node 0 at angle 0 on the circle, and cells (m,
    3)."""
    nodes_per_ring = ring_counts(num_rings, num_boundary)
    ring_offsets = np.concatenate([[0], np.cumsum(nodes_per_ring)])
    node_radii = np.repeat(np.arange(num_rings, 0, -1) / num_rings, nodes_per_ring)
    node_angles = np.concatenate(
        [2 * np.pi * np.arange(nodes_on_ring) / nodes_on_ring for nodes_on_ring in nodes_per_ring]
    )
    points = np.concatenate(
        [node_radii[:, None] * np.stack([np.cos(node_angles), np.sin(node_angles)], 1), np.zeros((1, 2))]
    )
    nodes_of_rings = [np.arange(ring_offsets[k], ring_offsets[k + 1]) for k in range(num_rings)]
    cells = [triangulate_between_chains(a, b, is_closed=True) for a, b in pairwise(nodes_of_rings)]
    innermost_ring = nodes_of_rings[-1]
    cells.append(
        np.stack([innermost_ring, np.roll(innermost_ring, -1), np.full(len(innermost_ring), ring_offsets[-1])], axis=1)
    )
    return points, np.concatenate(cells)


def choose_rows(width: float, height: float, num_points: int, cell_size: float | None) -> tuple[int, int]:
    """Numbers of columns and rows for `row_rectangle`, for close to `num_points` nodes or cells of size `cell_size`.

    Raises `ValueError` if a mesh with so few nodes would have flat cells.
    """
    if cell_size is not None:
        # A cell with base b and height 0.93 b has the area of an equilateral triangle with edge 1.036 b.
        cell_size = min(cell_size, width, height) / 1.036
        return max(1, round(width / cell_size - 0.5)), max(1, round(height / (_RELATIVE_ROW_HEIGHT * cell_size)))
    edge_length = np.sqrt(width * height / (_RELATIVE_ROW_HEIGHT * num_points))
    guessed_rows = height / (_RELATIVE_ROW_HEIGHT * edge_length)
    # With few nodes, accept a larger deviation from the requested number rather than stretched cells.
    max_deviation = 0.03 if num_points > 200 else 0.1
    best_choice_and_cost = None
    for num_rows in range(max(1, int(0.6 * guessed_rows)), int(1.5 * guessed_rows) + 3):
        num_wide_rows = (num_rows + 1) // 2
        for num_columns in {
            int(column_count)
            for column_count in np.rint((num_points - num_wide_rows) / (num_rows + 1) - 1 + np.arange(-1, 2))
        }:
            if num_columns < 1:
                continue
            num_nodes = (num_rows + 1) * (num_columns + 1) + num_wide_rows
            relative_deviation = abs(num_nodes / num_points - 1.0)
            row_stretch = abs(np.log(height / num_rows / (_RELATIVE_ROW_HEIGHT * width / (num_columns + 0.5))))
            choice_cost = (row_stretch > 0.6, max(0.0, relative_deviation - max_deviation), row_stretch)
            if best_choice_and_cost is None or choice_cost < best_choice_and_cost[0]:
                best_choice_and_cost = (choice_cost, num_columns, num_rows)
    if best_choice_and_cost is None or best_choice_and_cost[0][0]:
        min_points = 2 * max(width / height, height / width) + 3
        raise TooFewNodesError(
            f"num_points: {num_points} nodes in a rectangle of {width:g} by {height:g} m make flat cells. Ask for at "
            f"least about {min_points:.0f}.",
            round(min_points),
            f"{{asked}} nodes in a solid on {width:g} by {height:g} m make flat cells. Ask for at least about "
            "{least}.",
        )
    return best_choice_and_cost[1], best_choice_and_cost[2]


def row_rectangle(width: float, height: float, num_columns: int, num_rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Mesh of the rectangle [0, width] × [0, height] in rows of alternately `num_columns` and `num_columns` + 1
    segments: points (n, 2), with node 0 at the lower left corner, and cells (m, 3)."""
    points, node_rows, first_node = [], [], 0
    for row_number in range(num_rows + 1):
        num_row_columns = num_columns + row_number % 2
        x = np.linspace(0.0, width, num_row_columns + 1)
        points.append(np.stack([x, np.full_like(x, height * row_number / num_rows)], axis=1))
        node_rows.append(np.arange(first_node, first_node + num_row_columns + 1))
        first_node += num_row_columns + 1
    cells = [triangulate_between_chains(a, b, is_closed=False) for a, b in pairwise(node_rows)]
    return np.concatenate(points), np.concatenate(cells)
