"""`Geodesics`: geodesic distances along a triangulated surface between any of its points.

A wave front propagates over the triangles. From the distances at two corners of a triangle, the triangle and the
virtual source of the wave are laid into one plane. If the straight line from the source to the third corner crosses the
side between the two corners, the length of this line is the distance at the third corner; otherwise the shortest path
passes through one of the two corners. The distance is exact where the triangles between the source and the corner can
be laid into one plane. (Novotni and Klein, WSCG 2002, 341-347, who extend the fast marching of Kimmel and Sethian, PNAS
95 (1998) 8431-8435, to circular waves.)

On other surfaces, Gaussian curvature K changes the curvature of the front, by about K d/3 after a path of length d. The
formula for a sphere of Gaussian curvature K is used. Updates never increase a distance, so the nodes may be processed
in any order: the neighbours of all nodes whose distance has changed are updated, for all sources together, until no
distance changes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.mesh.geodesic.triangles import SurfacePlaces, Triangles
from jeit.mesh.mesh import Mesh
from jeit_solvers.module import Module

# Minimum relative decrease of a distance that is propagated, and number of sources processed together, which limits the
# memory for distances (s, n).
_MIN_DISTANCE_DECREASE, _SOURCES_PER_BATCH = 1e-10, 128
# Maximum length of a path on a sphere, in radians: near the antipode the wave converges to a point.
_MAX_PATH_ANGLE_ON_SPHERE = 2.6
# Maximum disagreement, as a fraction of the side of a triangle, between distances at its corners that belong to the
# same wave.
_MAX_RELATIVE_WAVE_MISMATCH = 0.02
# Maximum distance of a user's points from the surface, relative to the surface's extent, chosen so that points on the
# other side of a thick skin are accepted.
_MAX_RELATIVE_DISTANCE_OFF_SURFACE = 0.25


class _TriangleCorners(NamedTuple):
    """All corners of all triangles, each in the plane of its triangle: the opposite side starts at the origin and runs
    along x."""

    node: np.ndarray  # (c,) node at the corner, and the two nodes of the opposite side
    side_start: np.ndarray
    side_end: np.ndarray
    side_length: np.ndarray  # (c,) length of the side, and coordinates of the corner, metres
    x: np.ndarray
    y: np.ndarray


class Geodesics(Module):
    """Geodesic distances on a surface; created by `Geodesics.create`.

    **Fields**: `surface`: the triangles; `corners`: their corners; `curvature` (n,): Gaussian curvature at the nodes,
    1/m²; `touching` (6 m,): corners grouped by the nodes of their opposite sides, the group of node i being
    `touching[first[i]:first[i + 1]]`; `first` (n + 1,): bounds of the groups.

    **Example:**

    ```python
    paths = Geodesics.create(sleeve)
    paths.distances(sleeve.points[:2])
    ```
    """

    surface: Triangles
    corners: _TriangleCorners
    curvature: Float[np.ndarray, " n"]
    first: Int[np.ndarray, " n1"]
    touching: Int[np.ndarray, " q"]

    @classmethod
    def create(cls, surface: Triangles | Mesh, face: str | None = None) -> "Geodesics":
        """Prepare geodesic distances on a surface, or on the facets of a shell that have the tag `face`. Raises
        `ValueError` as `Triangles.of` does."""
        triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
        cells, points = triangles.cells, triangles.points
        corner_nodes, side_starts, side_ends = (
            np.roll(cells, -corner_shift, axis=1).ravel() for corner_shift in range(3)
        )
        corner_coordinates = _triangle_coordinates(points[side_starts], points[side_ends], points[corner_nodes])
        end_nodes = np.concatenate([side_starts, side_ends])
        sort_order = np.argsort(end_nodes, kind="stable")
        first_indices = np.concatenate([[0], np.cumsum(np.bincount(end_nodes, minlength=len(points)))])
        triangle_corners = _TriangleCorners(corner_nodes, side_starts, side_ends, *corner_coordinates)
        return cls(
            triangles,
            triangle_corners,
            _gaussian_curvature(triangles, triangle_corners),
            first_indices,
            sort_order % len(corner_nodes),
        )

    def distances(
        self,
        sources: ArrayLike | SurfacePlaces,
        targets: ArrayLike | SurfacePlaces | None = None,
        *,
        limit: float = np.inf,
    ) -> Float[np.ndarray, "s p"]:
        """Geodesic distances (s, p), metres, from `sources` (s, 3) to `targets` (p, 3), or (s, n) to all nodes if
        `targets` is None. Points off the surface are replaced by the nearest points on the surface.

        Distances beyond `limit`, metres, and between disconnected parts are infinite. Raises `ValueError` for points
        farther from the surface than a quarter of its extent.
        """
        source_places = (
            sources if isinstance(sources, SurfacePlaces) else self._project_onto_surface("sources", sources)
        )
        if isinstance(targets, SurfacePlaces) or targets is None:
            target_places = targets
        else:
            target_places = self._project_onto_surface("targets", targets)
        distance_batches = []
        for batch_start in range(0, len(source_places.triangle), _SOURCES_PER_BATCH):
            source_batch = SurfacePlaces(
                *(
                    getattr(source_places, name)[batch_start : batch_start + _SOURCES_PER_BATCH]
                    for name in _PLACE_FIELDS
                )
            )
            node_distances, path_curvatures = self._distances_to_nodes(source_batch, limit)
            distance_batches.append(
                node_distances
                if target_places is None
                else self._distances_in_triangles(source_batch, node_distances, path_curvatures, target_places)
            )
        distance_batches = np.concatenate(distance_batches) if distance_batches else np.zeros((0, 0))
        distance_batches[distance_batches > limit] = np.inf
        return distance_batches

    def _project_onto_surface(self, name: str, given_places: ArrayLike) -> SurfacePlaces:
        """Nearest points on the surface. Raises `ValueError` with the argument's `name` for points that are too far
        from the surface."""
        surface_places = self.surface.nearest(given_places)
        largest_side = float(np.ptp(self.surface.points, axis=0).max())
        off_surface_indices = np.flatnonzero(
            ~(surface_places.away <= _MAX_RELATIVE_DISTANCE_OFF_SURFACE * largest_side)
        )
        if off_surface_indices.size:
            raise ValueError(
                f"{name}: {off_surface_indices.size} of {len(surface_places.away)} lie off the surface, the first, at "
                f"{np.asarray(given_places, float)[off_surface_indices[0]].tolist()} m, by "
                f"{1e3 * surface_places.away[off_surface_indices[0]]:.3g} mm; give places on it, in metres."
            )
        return surface_places

    def between(self, places: ArrayLike) -> Float[np.ndarray, "p p"]:
        """Geodesic distances (p, p) between all pairs of points (p, 3), metres: symmetric, with a zero diagonal."""
        surface_points = self.surface.nearest(places)
        distance_matrix = self.distances(surface_points, surface_points)
        distance_matrix = (distance_matrix + distance_matrix.T) / 2
        np.fill_diagonal(distance_matrix, 0)
        return distance_matrix

    def owners(self, sources: ArrayLike | SurfacePlaces) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """For each node, the index of the nearest of the `sources` (s, 3) and the geodesic distance to this source,
        metres."""
        source_places = sources if isinstance(sources, SurfacePlaces) else self.surface.nearest(sources)
        nodes = self.surface.cells[source_places.triangle]
        straight_lengths = np.linalg.norm(self.surface.points[nodes] - source_places.points[:, None], axis=-1)
        node_distances, nearest_sources = (
            np.full(len(self.surface.points), np.inf),
            np.full(len(self.surface.points), -1),
        )
        source_index = np.repeat(np.arange(len(nodes)), 3)
        changed_nodes = _lower_distances(
            node_distances, nearest_sources, nodes.ravel(), straight_lengths.ravel(), source_index
        )
        while changed_nodes.size:
            _, corner_indices = self._opposite_corners(changed_nodes, np.zeros_like(changed_nodes))
            side_starts, side_ends, corner_nodes = (
                self.corners.side_start[corner_indices],
                self.corners.side_end[corner_indices],
                self.corners.node[corner_indices],
            )
            local_coordinates = (corner_coordinates[corner_indices] for corner_coordinates in self.corners[3:])
            new_lengths, is_by_start = _distances_across_sides(
                node_distances[side_starts],
                node_distances[side_ends],
                *local_coordinates,
                same_source=nearest_sources[side_starts] == nearest_sources[side_ends],
            )
            changed_nodes = _lower_distances(
                node_distances,
                nearest_sources,
                corner_nodes,
                new_lengths,
                np.where(is_by_start, nearest_sources[side_starts], nearest_sources[side_ends]),
            )
        return nearest_sources, node_distances

    def _distances_to_nodes(self, source_places: SurfacePlaces, max_distance: float):
        """Distances (s, n) from the sources to all nodes, and mean curvatures (s, n) along the paths."""
        num_nodes = len(self.surface.points)
        distances = np.full(len(source_places.triangle) * num_nodes, np.inf)
        path_curvatures = np.tile(self.curvature, len(source_places.triangle))
        nodes = self.surface.cells[source_places.triangle]
        entry_indices = (np.arange(len(nodes))[:, None] * num_nodes + nodes).ravel()
        distances[entry_indices] = np.linalg.norm(
            self.surface.points[nodes] - source_places.points[:, None], axis=-1
        ).ravel()
        changed_entry_indices = entry_indices
        while changed_entry_indices.size:
            source_offsets, corner_indices = self._opposite_corners(
                changed_entry_indices % num_nodes, changed_entry_indices - changed_entry_indices % num_nodes
            )
            side_starts, side_ends = (
                source_offsets + self.corners.side_start[corner_indices],
                source_offsets + self.corners.side_end[corner_indices],
            )
            local_coordinates = (corner_coordinates[corner_indices] for corner_coordinates in self.corners[3:])
            mean_curvature = (path_curvatures[side_starts] + path_curvatures[side_ends]) / 2
            new_lengths, is_by_start = _distances_across_sides(
                distances[side_starts], distances[side_ends], *local_coordinates, curvature=mean_curvature
            )
            corner_nodes = self.corners.node[corner_indices]
            entry_indices = source_offsets + corner_nodes
            is_shorter = (new_lengths < (1 - _MIN_DISTANCE_DECREASE) * distances[entry_indices]) & (
                new_lengths <= 2 * max_distance
            )
            entry_indices, new_lengths, corner_nodes = (
                entry_indices[is_shorter],
                new_lengths[is_shorter],
                corner_nodes[is_shorter],
            )
            previous_lengths = np.where(is_by_start, distances[side_starts], distances[side_ends])[is_shorter]
            np.minimum.at(distances, entry_indices, new_lengths)
            with np.errstate(invalid="ignore"):
                path_fraction = np.where(new_lengths > 0, np.clip(previous_lengths / new_lengths, 0, 1), 0.0)
            is_smallest = new_lengths == distances[entry_indices]
            path_curvatures[entry_indices[is_smallest]] = (
                path_fraction * mean_curvature[is_shorter] + (1 - path_fraction) * self.curvature[corner_nodes]
            )[is_smallest]
            # Nodes beyond the limit are not propagated.
            changed_entry_indices = np.unique(entry_indices[distances[entry_indices] <= max_distance])
        return distances.reshape(-1, num_nodes), path_curvatures.reshape(-1, num_nodes)

    def _opposite_corners(self, nodes, node_values):
        """Find, for each of `nodes`, the corners of triangles whose opposite side ends at the node. Returns, for each
        of these corners, the node's entry of `node_values`, and the index of the corner."""
        num_corners = self.first[nodes + 1] - self.first[nodes]
        end_indices = np.cumsum(num_corners)
        corner_offsets = np.arange(end_indices[-1]) - np.repeat(end_indices - num_corners, num_corners)
        return np.repeat(node_values, num_corners), self.touching[
            np.repeat(self.first[nodes], num_corners) + corner_offsets
        ]

    def near(self, sources: ArrayLike, targets: SurfacePlaces, limit: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each of the `sources` (s, 3), the indices of the targets within a geodesic distance of `limit` metres,
        and their geodesic distances in metres. Only targets whose straight-line distance is at most `limit` are
        considered."""
        source_places = self.surface.nearest(sources)
        target_tree, neighbour_lists = KDTree(targets.points), []
        for batch_start in range(0, len(source_places.triangle), _SOURCES_PER_BATCH):
            source_batch = SurfacePlaces(
                *(
                    getattr(source_places, name)[batch_start : batch_start + _SOURCES_PER_BATCH]
                    for name in _PLACE_FIELDS
                )
            )
            node_distances, path_curvatures = self._distances_to_nodes(source_batch, limit)
            close_targets = [
                np.asarray(target_indices, int)
                for target_indices in target_tree.query_ball_point(source_batch.points, limit, return_sorted=True)
            ]
            source_indices = np.repeat(
                np.arange(len(close_targets)), [len(target_indices) for target_indices in close_targets]
            )
            target_indices = np.concatenate(close_targets) if close_targets else np.zeros(0, int)
            target_places = SurfacePlaces(*(getattr(targets, name)[target_indices] for name in _PLACE_FIELDS))
            target_lengths = self._distances_in_triangles(
                source_batch, node_distances, path_curvatures, target_places, source_indices
            )
            split_indices = np.cumsum([len(target_indices) for target_indices in close_targets])[:-1]
            for target_rows, is_target in zip(
                np.split(target_indices, split_indices), np.split(target_lengths, split_indices), strict=True
            ):
                neighbour_lists.append((target_rows[is_target < limit], is_target[is_target < limit]))
        return neighbour_lists

    def _distances_in_triangles(
        self,
        sources: SurfacePlaces,
        node_distances: Float[np.ndarray, "s n"],
        path_curvatures,
        targets: SurfacePlaces,
        source_indices=None,
    ):
        """Distances (s, p) from the sources to targets inside triangles; or (p,), if `source_indices` contains the
        index of the source for each target."""
        cells = self.surface.cells[targets.triangle]
        triangle_corners = self.surface.points[cells]
        source_rows = np.arange(len(node_distances))[:, None] if source_indices is None else source_indices
        min_distances = np.inf
        for first_corner, second_corner, third_corner in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            end_indices = (source_rows, cells[:, first_corner]), (source_rows, cells[:, second_corner])
            start_distance, end_distance = (node_distances[side_end_index] for side_end_index in end_indices)
            side_lengths, x, y = _triangle_coordinates(
                triangle_corners[:, first_corner], triangle_corners[:, second_corner], targets.points
            )
            distances_across_side, _ = _distances_across_sides(
                start_distance,
                end_distance,
                side_lengths,
                x,
                y,
                curvature=(path_curvatures[end_indices[0]] + path_curvatures[end_indices[1]]) / 2,
            )
            # Where paths from two directions meet, the distances at the ends of a side belong to different waves, and
            # contradict the distance at the third corner. In that case the path passes through a corner.
            with np.errstate(invalid="ignore", over="ignore"):
                source_x, source_depth, _ = _virtual_source(start_distance, end_distance, side_lengths)
                _, corner_x, corner_y = _triangle_coordinates(
                    triangle_corners[:, first_corner],
                    triangle_corners[:, second_corner],
                    triangle_corners[:, third_corner],
                )
                distance_mismatch = (
                    np.hypot(corner_x - source_x, corner_y + source_depth)
                    - node_distances[source_rows, cells[:, third_corner]]
                )
            distance_through_corner = start_distance + np.sqrt(x**2 + y**2)
            min_distances = np.minimum(
                min_distances,
                np.where(
                    np.abs(distance_mismatch) < _MAX_RELATIVE_WAVE_MISMATCH * side_lengths,
                    distances_across_side,
                    distance_through_corner,
                ),
            )
        straight_lengths = np.linalg.norm(sources.points[source_rows] - targets.points, axis=-1)
        return np.where(sources.triangle[source_rows] == targets.triangle, straight_lengths, min_distances)


_PLACE_FIELDS = "triangle", "weights", "points", "away"


def _triangle_coordinates(side_start, side_end, corner_point):
    """Length of the side from `side_start` to `side_end`, and coordinates of the `corner_point`: x along the side from
    its start, and y perpendicular to it; metres, each (c,)."""
    side_length = np.linalg.norm(side_end - side_start, axis=-1)
    x = ((corner_point - side_start) * (side_end - side_start)).sum(axis=-1) / side_length
    return side_length, x, np.sqrt(np.maximum(((corner_point - side_start) ** 2).sum(axis=-1) - x**2, 0.0))


def _distances_across_sides(
    start_distance, end_distance, side_length, x, y, *, same_source: Any = True, curvature: Any = 0.0
):
    """Distances at corners, computed from the distances at the start and the end of the opposite sides, and whether the
    path through the start is shorter than the path through the end. Paths across the interior of a side are considered
    only where `same_source` is True, i.e. where the distances at both ends of the side are from the same source.
    `curvature`: mean Gaussian curvature along the path, 1/m²."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        distance_through_start = np.sqrt(x**2 + y**2) + start_distance
        distance_through_end = np.sqrt((side_length - x) ** 2 + y**2) + end_distance
        source_x, source_depth, squared_source_depth = _virtual_source(start_distance, end_distance, side_length)
        crossing_position = (source_x * y + x * source_depth) / np.where(source_depth + y > 0, source_depth + y, 1.0)
        is_crossing_side = (
            (squared_source_depth >= 0)
            & (crossing_position >= 0)
            & (crossing_position <= side_length)
            & same_source
            & (source_depth + y > 0)
        )
        straight_distance = np.sqrt((x - source_x) ** 2 + (y + source_depth) ** 2)
        # Sagitta of the wave front at the crossing, minus the sagitta of a wave front in the plane.
        squared_length = (crossing_position - source_x) ** 2 + squared_source_depth
        front_curvature = np.where(
            squared_length > 0, squared_source_depth / np.where(squared_length > 0, squared_length, 1.0), 0.0
        )
        straight_distance += (
            0.5
            * _front_flattening(curvature, np.sqrt(squared_length))
            * front_curvature
            * crossing_position
            * (side_length - crossing_position)
        )
    return np.where(
        is_crossing_side, straight_distance, np.minimum(distance_through_start, distance_through_end)
    ), distance_through_start <= distance_through_end


def _virtual_source(start_distance, end_distance, side_length):
    """Point source of a wave that has known distances from the start and the end of a side of a triangle: its
    coordinate along the side, its distance from the line of the side, and the square of this distance, which is
    negative if no point in the plane has both distances."""
    source_x = (start_distance**2 - end_distance**2 + side_length**2) / (2 * side_length)
    squared_source_depth = start_distance**2 - source_x**2
    return source_x, np.sqrt(np.maximum(squared_source_depth, 0.0)), squared_source_depth


def _front_flattening(curvature, path_length):
    """1/length - κ, in 1/m, where κ is the curvature of the wave front after a path of this `path_length`, metres, on a
    surface of Gaussian curvature K = `curvature`, 1/m²: κ = √K cot(√K length), with the hyperbolic cotangent for
    negative K."""
    path_angle = np.sqrt(np.abs(curvature)) * path_length
    is_small_angle, spherical_angle, hyperbolic_angle = (
        path_angle < 1e-3,
        np.clip(path_angle, 1e-3, _MAX_PATH_ANGLE_ON_SPHERE),
        np.clip(path_angle, 1e-3, 10.0),
    )
    relative_flattening = np.where(
        curvature > 0, 1 - spherical_angle / np.tan(spherical_angle), 1 - hyperbolic_angle / np.tanh(hyperbolic_angle)
    )
    return np.where(
        is_small_angle, curvature * path_length / 3, relative_flattening / np.where(is_small_angle, 1.0, path_length)
    )


def _gaussian_curvature(surface: Triangles, triangle_corners: _TriangleCorners) -> Float[np.ndarray, " n"]:
    """Gaussian curvature (n,) at the nodes, 1/m²: the angle defect, i.e. 2π minus the sum of the angles at the node,
    divided by a third of the area of its triangles. Defect and area are averaged over two rings of neighbours. Nodes on
    the border do not contribute."""
    num_nodes, corner_nodes = len(surface.points), triangle_corners.node
    side_angles = (
        np.arctan2(triangle_corners.y, triangle_corners.x),
        np.arctan2(triangle_corners.y, triangle_corners.side_length - triangle_corners.x),
    )
    angle_defect = 2 * np.pi - np.bincount(corner_nodes, np.pi - side_angles[0] - side_angles[1], num_nodes)
    node_areas = surface.node_areas
    border_nodes = np.unique(surface.border)
    angle_defect[border_nodes], node_areas[border_nodes] = 0.0, 0.0
    for _ in range(2):
        angle_defect, node_areas = (
            node_values
            + np.bincount(triangle_corners.side_start, node_values[triangle_corners.side_end], num_nodes)
            + np.bincount(triangle_corners.side_end, node_values[triangle_corners.side_start], num_nodes)
            for node_values in (angle_defect, node_areas)
        )
    return np.where(node_areas > 0, angle_defect / np.where(node_areas > 0, node_areas, 1.0), 0.0)


def _lower_distances(node_distances, nearest_sources, nodes, new_lengths, source_index) -> np.ndarray:
    """Lower the distances of `nodes` to the minimum of the new distances `new_lengths`, and store the corresponding
    entry of `source_index` as their owner. Returns the nodes whose distance has decreased."""
    is_lower = new_lengths < (1 - _MIN_DISTANCE_DECREASE) * node_distances[nodes]
    nodes, new_lengths, source_index = nodes[is_lower], new_lengths[is_lower], source_index[is_lower]
    sort_order = np.lexsort((new_lengths, nodes))
    changed_nodes, first_entry_indices = np.unique(nodes[sort_order], return_index=True)
    node_distances[changed_nodes], nearest_sources[changed_nodes] = (
        new_lengths[sort_order][first_entry_indices],
        source_index[sort_order][first_entry_indices],
    )
    return changed_nodes
