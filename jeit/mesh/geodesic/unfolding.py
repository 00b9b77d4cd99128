"""`unfold`: the triangles of a surface around a point, unfolded into the plane of the triangle that contains the point.

The triangle that contains the point is not moved. Every other triangle is connected to this triangle by the path that
crosses the fewest triangles, and is rotated about the side that it shares with the previous triangle of this path,
until it lies in the same plane. On a developable surface, such as a bent sheet, the result does not depend on the path,
and straight lines in the plane are exactly the geodesics on the triangles. On other surfaces the result depends on the
path; `Unfolding.exact` is False for the points for which it depends on the path. The functions accept NumPy or JAX
arrays and can be differentiated and batched.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit.mesh.mesh import Mesh
from jeit_solvers.engines import has_values, namespace, on_host, sum_into, undifferentiated, while_loop

# Maximum deviation, in radians, of the sum of angles around a node from a full turn on a developable surface: it allows
# for rounding of float32 files and steps of finite differences.
_ANGLE_TOLERANCE = 1e-4
# Number of times that the length of the paths is doubled by composing their transforms: paths of up to 2⁷ = 128
# triangles.
_MAX_PATH_DOUBLINGS = 7


class Unfolding(NamedTuple):
    """Unfolded triangles around L points on a surface of m triangles; lengths in metres.

    **Fields**: `corners` (m, 3, 2): corners of each triangle in its own plane; `turn` (L, m, 2): cosine and sine of the
    angle by which the corners are rotated, and `shift` (L, m, 2): the vector by which they are then translated, into
    the plane of the triangle that contains each point; `place` (L, 2): position of each point in this plane; `reached`
    (L, m): whether a triangle is unfolded around a point; `exact` (L,): whether the reached triangles form a
    developable surface and are at most 128 triangles away from the point.

    **Example:**

    ```python
    around = unfold(sleeve, sleeve.points[:1], np.full((1, sleeve.num_cells), 0.02))
    around.reached.sum(), around.exact
    ```
    """

    corners: Float[Array, "m 3 2"]
    turn: Float[Array, "L m 2"]
    shift: Float[Array, "L m 2"]
    place: Float[Array, "L 2"]
    reached: Bool[Array, "L m"]
    exact: Bool[Array, " L"]

    def squared(self, weights: Float[np.ndarray, "p 3"], which: Int[Array, "m k"]) -> Float[Array, "m k p"]:
        """Squared distances (m, k, p), m², from k points to positions in each triangle. `which` (m, k): indices of the
        points for each triangle; `weights` (p, 3): barycentric coordinates of the positions."""
        xp = namespace(self.corners, self.turn)
        cell_index = xp.arange(len(self.corners))[:, None]
        points = xp.einsum("pi,mid->mpd", weights, self.corners)[:, None]
        point_turns, point_shifts = (
            self.turn[which, cell_index][:, :, None],
            (self.shift - self.place[:, None])[which, cell_index],
        )
        unfolded_points = _rotate_points(point_turns, points) + point_shifts[:, :, None]
        return (unfolded_points**2).sum(axis=-1)


def unfold(mesh: Mesh, places: Float[Array, "L 3"], max_distance: Float[Array, "L m"]) -> Unfolding:
    """Unfold the triangles around points on a surface into the plane: the triangles whose centroids lie within a
    straight-line distance `max_distance` of a point, and which are connected to the triangle that contains the point.

    **Arguments:**

    - `mesh`: a surface in space.
    - `places` (L, 3): points on the surface, metres.
    - `max_distance` (L, m): maximum distance from each point to the centroid of each triangle, metres.

    **Example:**

    ```python
    around = unfold(sleeve, sleeve.points[:1], np.full((1, sleeve.num_cells), 0.02))
    ```
    """
    xp = namespace(mesh, places)
    triangle_corners = xp.asarray(mesh.points[mesh.cells])
    first_sides, second_sides = (
        triangle_corners[:, 1] - triangle_corners[:, 0],
        triangle_corners[:, 2] - triangle_corners[:, 0],
    )
    first_axis = first_sides / xp.sqrt((first_sides**2).sum(axis=1, keepdims=True))
    triangle_normals = xp.cross(first_sides, second_sides)
    triangle_normals = triangle_normals / xp.sqrt((triangle_normals**2).sum(axis=1, keepdims=True))
    plane_axes = xp.stack([first_axis, xp.cross(triangle_normals, first_axis)], axis=1)
    plane_corners = xp.einsum("mid,mad->mia", triangle_corners - triangle_corners[:, :1], plane_axes)
    frames = triangle_corners[:, 0], plane_axes, triangle_normals
    root_triangles = _containing_triangles(undifferentiated(places), *undifferentiated((frames, plane_corners)))
    squared_distance = undifferentiated(((places[:, None] - triangle_corners.mean(axis=1)) ** 2).sum(axis=-1))
    # If the values are known, compute on the host: XLA would take seconds to evaluate a sort of constants.
    opposite_side_indices, triangle_indices = (
        xp.asarray(_opposite_sides(on_host(mesh.cells))),
        xp.arange(len(triangle_corners)),
    )
    is_reached, side_to_root = _find_connected_triangles(
        opposite_side_indices // 3, squared_distance <= undifferentiated(max_distance) ** 2, root_triangles
    )
    side_index = 3 * triangle_indices + side_to_root
    previous_cells = xp.where(side_to_root < 0, triangle_indices, opposite_side_indices[side_index] // 3)
    path_turns, path_shifts = (
        side_transform[side_index] for side_transform in _transforms_across_sides(plane_corners, opposite_side_indices)
    )
    has_previous = (side_to_root >= 0)[..., None]
    path_turns, path_shifts = (
        xp.where(has_previous, path_turns, xp.array([1.0, 0.0])),
        xp.where(has_previous, path_shifts, 0.0),
    )
    path_turns, path_shifts, end_triangle = _compose_transforms(previous_cells, path_turns, path_shifts)
    plane_places = xp.einsum("ld,lad->la", places - triangle_corners[root_triangles, 0], plane_axes[root_triangles])
    is_curved = _is_curved(undifferentiated(plane_corners), mesh.cells, opposite_side_indices, mesh.num_points)
    is_invalid = is_reached & (is_curved | (end_triangle != root_triangles[:, None]))
    return Unfolding(plane_corners, path_turns, path_shifts, plane_places, is_reached, ~is_invalid.any(axis=1))


def _rotate_points(cosine_and_sine, points):
    """Rotate points (…, 2) in the plane. `cosine_and_sine` (…, 2): cosine and sine of each angle."""
    cosine, sine = cosine_and_sine[..., 0], cosine_and_sine[..., 1]
    x, y = points[..., 0], points[..., 1]
    return namespace(cosine_and_sine, points).stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _containing_triangles(query_positions, triangle_frames, plane_corners) -> Int[Array, " L"]:
    """Index of the triangle that contains each point: the triangle with the smallest sum of squares of the point's
    height above its plane and the point's distance outside it."""
    xp = namespace(query_positions, plane_corners)
    plane_origins, plane_axes, plane_normals = triangle_frames
    position_offsets = query_positions[:, None] - plane_origins
    x, y = xp.moveaxis(xp.einsum("lmd,mad->lma", position_offsets, plane_axes), -1, 0)
    third_weights = y / plane_corners[:, 2, 1]
    second_weights = (x - third_weights * plane_corners[:, 2, 0]) / plane_corners[:, 1, 0]
    distance_outside = (
        xp.maximum(-xp.minimum(xp.minimum(second_weights, third_weights), 1 - second_weights - third_weights), 0)
        * plane_corners[:, 1, 0]
    )
    return ((position_offsets * plane_normals).sum(axis=-1) ** 2 + distance_outside**2).argmin(axis=1)


def _opposite_sides(cells) -> Int[Array, " h"]:
    """For each side of each triangle, the index of the same side in the neighbouring triangle; at the border, the
    side's own index. The index of side k (0, 1, 2) of triangle c is 3 c + k."""
    xp = namespace(cells)
    side_starts, side_ends = cells.reshape(-1), xp.roll(cells, -1, axis=1).reshape(-1)
    smaller_nodes, larger_nodes = xp.minimum(side_starts, side_ends), xp.maximum(side_starts, side_ends)
    sort_order = xp.lexsort((larger_nodes, smaller_nodes))
    is_same_as_next = (xp.diff(smaller_nodes[sort_order]) == 0) & (xp.diff(larger_nodes[sort_order]) == 0)
    false_element = xp.zeros(1, bool)
    step_to_opposite = xp.where(xp.concatenate([is_same_as_next, false_element]), 1, 0) - xp.where(
        xp.concatenate([false_element, is_same_as_next]), 1, 0
    )
    opposite_sides = sort_order[xp.arange(len(sort_order)) + step_to_opposite]
    return opposite_sides[xp.argsort(sort_order)]


def _find_connected_triangles(neighbour_triangles, is_near: Bool[Array, "L m"], root_triangles):
    """Find the triangles near each point (`is_near`) that are connected to the triangles `root_triangles` (L,) across
    sides. Returns whether each triangle (L, m) is connected, and the number (L, m) of the side across which the path to
    the root leads; −1 for the root itself and for triangles that are not connected."""
    xp = namespace(neighbour_triangles, is_near)
    triangle_indices = xp.arange(is_near.shape[1])
    neighbour_triangles = neighbour_triangles.reshape(-1, 3)
    is_root_triangle = triangle_indices == root_triangles[:, None]

    def add_neighbours(search_state):
        is_reached, side_to_root, _ = search_state
        is_reached_across = is_reached[:, neighbour_triangles]
        is_new = is_near & ~is_reached & is_reached_across.any(axis=-1)
        return (
            is_reached | is_new,
            xp.where(is_new, is_reached_across.argmax(axis=-1).astype(int), side_to_root),
            is_new.any(),
        )

    has_changed = xp.ones((), bool)
    is_reached, side_to_root, _ = while_loop(
        lambda search_state: search_state[2],
        add_neighbours,
        (is_root_triangle, xp.full(is_near.shape, -1, int), has_changed),
    )
    return is_reached, side_to_root


def _transforms_across_sides(plane_corners, opposite_side_indices):
    """Rotation (h, 2), as cosine and sine, and translation (h, 2) for each half-edge (a side of one triangle), from the
    plane of its triangle into the plane of the neighbouring triangle."""
    xp = namespace(plane_corners)
    side_starts, side_ends = plane_corners.reshape(-1, 2), xp.roll(plane_corners, -1, axis=1).reshape(-1, 2)
    side_vectors, opposite_side_vectors = (
        side_ends - side_starts,
        side_starts[opposite_side_indices] - side_ends[opposite_side_indices],
    )
    side_turns = xp.stack(
        [
            (side_vectors * opposite_side_vectors).sum(axis=1),
            side_vectors[:, 0] * opposite_side_vectors[:, 1] - side_vectors[:, 1] * opposite_side_vectors[:, 0],
        ],
        axis=1,
    )
    side_turns = side_turns / xp.sqrt((side_turns**2).sum(axis=1, keepdims=True))
    return side_turns, side_ends[opposite_side_indices] - _rotate_points(side_turns, side_starts)


def _compose_transforms(next_on_path, path_turns, path_shifts):
    """Compose the rotations and translations along the path from each triangle to the root. `next_on_path` (L, m): next
    triangle on the path from each triangle. Returns the rotation and translation for the whole path, and the triangle
    where it ends."""
    xp = namespace(next_on_path, path_turns)
    point_rows = xp.arange(len(next_on_path))[:, None]
    for _ in range(_MAX_PATH_DOUBLINGS):
        next_turn, next_shift = path_turns[point_rows, next_on_path], path_shifts[point_rows, next_on_path]
        path_turns, path_shifts = (
            _rotate_points(next_turn, path_turns),
            _rotate_points(next_turn, path_shifts) + next_shift,
        )
        next_on_path = next_on_path[point_rows, next_on_path]
        if has_values(next_on_path) and (next_on_path[point_rows, next_on_path] == next_on_path).all():
            break
    return path_turns, path_shifts, next_on_path


def _is_curved(plane_corners, cells, opposite_side_indices, num_nodes: int) -> Bool[Array, " m"]:
    """For each triangle, whether the angles around one of its corners inside the surface do not sum to a full turn."""
    xp = namespace(plane_corners, cells)
    next_edges, previous_edges = (
        xp.roll(plane_corners, -1, axis=1) - plane_corners,
        xp.roll(plane_corners, 1, axis=1) - plane_corners,
    )
    corner_angles = xp.arctan2(
        next_edges[..., 0] * previous_edges[..., 1] - next_edges[..., 1] * previous_edges[..., 0],
        (next_edges * previous_edges).sum(axis=-1),
    )
    angle_sums = sum_into((num_nodes,), (cells,), corner_angles)
    is_border_side = (opposite_side_indices == xp.arange(len(opposite_side_indices))).reshape(-1, 3)
    num_border_sides = sum_into((num_nodes,), (cells,), 1.0 * (is_border_side | xp.roll(is_border_side, 1, axis=1)))
    is_curved_node = (abs(angle_sums - 2 * np.pi) > _ANGLE_TOLERANCE) & (num_border_sides == 0)
    return is_curved_node[cells].any(axis=1)
