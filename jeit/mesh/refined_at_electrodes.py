"""Meshes of solids whose cells are smallest at the planes that contain edges of electrodes, because the current density
is unbounded at the edges of electrodes.

Along each axis, the cell size at the planes is a twentieth of the largest cell size (`_RELATIVE_SMALLEST_CELL_SIZE`)
and increases away from the planes, up to a maximum size that follows from the number of nodes. A box is graded along x,
y and z; a solid above any other outline is graded along z, and its plane mesh is refined separately.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq

from jeit.mesh.generate.refine import Refine, nodes_of_solid
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Disk, Domain, Rectangle
from jeit.mesh.solids import layer

# Size of the cells at the planes divided by the size of the largest cells, and increase of the cell size per unit of
# distance from a plane.
_RELATIVE_SMALLEST_CELL_SIZE, _CELL_SIZE_GROWTH = 0.05, 0.8
# Distance between two planes, relative to the size of the body, below which they are merged.
_RELATIVE_MERGE_DISTANCE = 1e-4


def graded_box(outline: Rectangle, height: float, planes: Sequence[Float[np.ndarray, " k"]], num_points: int) -> Mesh:
    """Mesh of a box above a rectangle, from z = 0 up, with about `num_points` nodes and with cell faces in the given
    `planes`: positions along x, y and z.

    The mesh has the tags of `jeit.mesh.box`.
    """
    x_min, x_max, y_min, y_max = outline.extent
    axis_limits = [(x_min, x_max), (y_min, y_max), (0.0, height)]
    axis_positions = [
        _distinct_positions(plane_positions, lower_end, upper_end)
        for plane_positions, (lower_end, upper_end) in zip(planes, axis_limits, strict=True)
    ]
    max_extent = max(upper_end - lower_end for lower_end, upper_end in axis_limits)
    cell_size = _largest_cell_size(
        lambda cell_size: float(
            np.prod([len(_divide_axis(axis_boundaries, cell_size)) for axis_boundaries in axis_positions])
        ),
        num_points,
        max_extent,
    )
    node_positions = [_divide_axis(axis_boundaries, cell_size) for axis_boundaries in axis_positions]
    points = np.stack(np.meshgrid(*node_positions[:2], indexing="ij"), axis=-1).reshape(-1, 2)
    base_mesh = Mesh.create(points, _grid_triangles(len(node_positions[0]), len(node_positions[1])))
    return layer(outline.tagged(base_mesh), height, heights=node_positions[2])


def graded_layers(
    outline: Domain,
    height: float,
    planes: Float[np.ndarray, " k"],
    rim_points: Float[np.ndarray, "p 2"],
    num_points: int,
) -> Mesh:
    """Mesh of a solid above any outline, with thin layers at the heights `planes` and small cells at `rim_points`,
    points (p, 2) on the rims of electrodes, seen from above. Points of `rim_points` on the edge of a disk become nodes.
    The mesh has the tags of `jeit.mesh.layer`."""
    layer_boundaries = _distinct_positions(planes, 0.0, height)
    outline_area = float(outline.area)

    def count_nodes(trial_size: float) -> float:
        # Because of the refinement at the rims, the mean cell is about a third smaller than the largest.
        return len(_divide_axis(layer_boundaries, trial_size)) * (1 + 1.1 * outline_area / (0.65 * trial_size) ** 2)

    def layer_heights(num_nodes: int) -> Float[np.ndarray, " n"]:
        return _divide_axis(
            layer_boundaries, _largest_cell_size(count_nodes, num_nodes, max(height, np.sqrt(outline_area)))
        )

    node_heights = layer_heights(num_points)
    edge_refinement = (
        Refine(rim_points, factor=1 / _RELATIVE_SMALLEST_CELL_SIZE, growth=_CELL_SIZE_GROWTH)
        if len(rim_points)
        else None
    )
    num_nodes = max(4, round(num_points / len(node_heights)))
    with nodes_of_solid(num_points, lambda num_requested: round(num_requested / len(layer_heights(num_requested)))):
        if isinstance(outline, Disk) and len(rim_points):
            centre_offsets = rim_points - np.asarray(outline.centre)
            is_on_edge = np.abs(np.hypot(*centre_offsets.T) - float(outline.radius)) < _RELATIVE_MERGE_DISTANCE * float(
                outline.radius
            )
            rim_angles = np.arctan2(centre_offsets[is_on_edge, 1], centre_offsets[is_on_edge, 0])
            base_mesh = outline.mesh(
                num_points=num_nodes, refine=edge_refinement, boundary_points=rim_angles if len(rim_angles) else None
            )
        else:
            base_mesh = outline.mesh(num_points=num_nodes, refine=edge_refinement)
    return layer(base_mesh, height, heights=node_heights)


def _distinct_positions(
    plane_positions: Float[np.ndarray, " k"], lower_end: float, upper_end: float
) -> Float[np.ndarray, " s"]:
    """Distinct positions of the planes between `lower_end` and `upper_end`, with these two ends included."""
    inner_positions = np.sort(plane_positions[(plane_positions > lower_end) & (plane_positions < upper_end)])
    distinct_positions, min_gap = [lower_end], _RELATIVE_MERGE_DISTANCE * (upper_end - lower_end)
    for inner_position in inner_positions:
        if inner_position - distinct_positions[-1] > min_gap and upper_end - inner_position > min_gap:
            distinct_positions.append(float(inner_position))
    return np.array([*distinct_positions, upper_end])


def _divide_axis(plane_positions: Float[np.ndarray, " s"], max_size: float) -> Float[np.ndarray, " n"]:
    """Positions of nodes along an axis: the planes `plane_positions`, and nodes between them at distances that grow
    away from these planes up to `max_size`, metres."""
    node_positions = [plane_positions[:1]]
    for lower_position, upper_position in pairwise(plane_positions):
        # Number of cells between `lower_position` and each of many positions.
        axis_samples = np.linspace(lower_position, upper_position, 400)
        sample_midpoints = (axis_samples[1:] + axis_samples[:-1]) / 2
        cell_widths = np.minimum(
            max_size,
            _RELATIVE_SMALLEST_CELL_SIZE * max_size
            + _CELL_SIZE_GROWTH * np.minimum(sample_midpoints - lower_position, upper_position - sample_midpoints),
        )
        cumulative_count = np.concatenate([[0.0], np.cumsum(np.diff(axis_samples) / cell_widths)])
        num_cells = max(1, round(cumulative_count[-1]))
        node_positions.append(
            np.interp(np.arange(1, num_cells + 1) * (cumulative_count[-1] / num_cells), cumulative_count, axis_samples)
        )
        node_positions[-1][-1] = upper_position
    return np.concatenate(node_positions)


def _largest_cell_size(count_nodes: Callable[[float], float], num_points: int, max_size: float) -> float:
    """Size of the largest cells for which a mesh has about `num_points` nodes; `max_size` if even a mesh with cells of
    this size has more nodes."""
    if count_nodes(max_size) >= num_points:
        return max_size
    cell_size: Any = brentq(
        lambda trial_size: count_nodes(trial_size) - num_points - 0.5, 1e-4 * max_size, max_size, xtol=1e-5 * max_size
    )
    return float(cell_size)


def _grid_triangles(num_rows: int, num_columns: int) -> Int[np.ndarray, "t 3"]:
    """Triangles of a grid of nodes in row-major order: rectangles divided along alternating diagonals."""
    i, j = (
        grid_indices.ravel()
        for grid_indices in np.meshgrid(np.arange(num_rows - 1), np.arange(num_columns - 1), indexing="ij")
    )
    a = i * num_columns + j
    b, c, d = a + num_columns, a + num_columns + 1, a + 1
    is_even_square = ((i + j) % 2 == 0)[:, None]
    first_triangles = np.where(is_even_square, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second_triangles = np.where(is_even_square, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.concatenate([first_triangles, second_triangles])
