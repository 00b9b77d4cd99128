"""`Triangles`: a triangulated surface in space as arrays, with a search for the point of the surface that is nearest to
any point."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.mesh.mesh import Mesh
from jeit_solvers.module import Module

# Number of triangles, by nearest centroids, among which the nearest triangle is searched.
_NUM_CANDIDATE_TRIANGLES = 16


class SurfacePlaces(Module):
    """Points on a triangulated surface; p is their number.

    **Fields**: `triangle` (p,): index of the triangle; `weights` (p, 3): barycentric coordinates in this triangle;
    `points` (p, 3): positions, metres; `away` (p,): distance from the surface of the point that was projected, metres.

    **Example:**

    ```python
    places = Triangles.of(sleeve).nearest([[0.05, 0.0, 0.05]])
    places.points, places.away
    ```
    """

    triangle: Int[np.ndarray, " p"]
    weights: Float[np.ndarray, "p 3"]
    points: Float[np.ndarray, "p 3"]
    away: Float[np.ndarray, " p"]

    def of_nodes(self, triangles: "Triangles", values: ArrayLike) -> np.ndarray:
        """Interpolate values at the nodes (n, …) linearly to the points (p, …)."""
        corner_values = np.asarray(values)[triangles.cells[self.triangle]]
        return np.einsum("pk,pk...->p...", self.weights, corner_values)


class Triangles(Module):
    """Triangles of a surface in space, with the geometry that geodesics need; usually created from a mesh by
    `Triangles.of`.

    **Fields**: `points` (n, 3) metres; `cells` (m, 3), counter-clockwise as seen from outside.

    **Example:**

    ```python
    surface = Triangles.of(sleeve)
    surface.areas.sum(), surface.normals
    ```
    """

    points: Float[np.ndarray, "n 3"]
    cells: Int[np.ndarray, "m 3"]

    @classmethod
    def of(cls, mesh: Mesh, face: str | None = None) -> "Triangles":
        """Triangles of a surface, or the facets of a solid mesh with the tag `face`, such as "inner" or "outer" of a
        shell.

        Unused nodes are removed. Raises `ValueError` for a plane mesh, and for an unknown tag.
        """
        points = np.asarray(mesh.points, float)
        if points.shape[1] != 3:
            raise ValueError("mesh is plane; a surface in space is needed, with points (n, 3).")
        cells = np.asarray(mesh.cells)
        if cells.shape[1] == 4:
            if face not in mesh.tags:
                raise ValueError(f"face: the mesh has the tags {sorted(mesh.tags)}, and '{face}' is none of them.")
            cells = np.asarray(mesh.facets)[np.asarray(mesh.tags[face])]
        used_nodes, renumbered_cells = np.unique(cells, return_inverse=True)
        return cls(points[used_nodes], renumbered_cells.reshape(cells.shape))

    @property
    def corners(self) -> Float[np.ndarray, "m 3 3"]:
        """Corners of every triangle, metres."""
        return self.points[self.cells]

    @property
    def areas(self) -> Float[np.ndarray, " m"]:
        """Areas of the triangles, m²."""
        return np.linalg.norm(self._edge_cross_products, axis=1) / 2

    @property
    def normals(self) -> Float[np.ndarray, "m 3"]:
        """Outward unit normals of the triangles."""
        return self._edge_cross_products / np.linalg.norm(self._edge_cross_products, axis=1, keepdims=True)

    @property
    def node_areas(self) -> Float[np.ndarray, " n"]:
        """A third of the total area of the triangles at each node, m²."""
        return np.bincount(self.cells.ravel(), np.repeat(self.areas / 3, 3), len(self.points))

    @property
    def node_normals(self) -> Float[np.ndarray, "n 3"]:
        """Outward unit normals at the nodes: area-weighted means of the normals of the triangles."""
        corner_cross_products = np.repeat(self._edge_cross_products, 3, axis=0)
        summed_normals = np.stack(
            [
                np.bincount(self.cells.ravel(), product_component, len(self.points))
                for product_component in corner_cross_products.T
            ],
            axis=1,
        )
        return summed_normals / np.linalg.norm(summed_normals, axis=1, keepdims=True)

    @property
    def border(self) -> Int[np.ndarray, "b 2"]:
        """Edges (b, 2) that belong to one triangle only; a closed surface has none."""
        directed_edges = self.cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        _, first_edge_indices, edge_counts = np.unique(
            self._edge_numbers(directed_edges), return_index=True, return_counts=True
        )
        return directed_edges[first_edge_indices[edge_counts == 1]]

    def _edge_numbers(self, edges: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, " e"]:
        """A number for each edge, equal for both directions and in the order of the smaller, then the larger node:
        numbers are sorted several times faster than pairs."""
        return edges.min(axis=1).astype(np.int64) * len(self.points) + edges.max(axis=1)

    @cached_property
    def _edge_cross_products(self) -> Float[np.ndarray, "m 3"]:
        triangle_corners = self.corners
        return np.cross(
            triangle_corners[:, 1] - triangle_corners[:, 0], triangle_corners[:, 2] - triangle_corners[:, 0]
        )

    @cached_property
    def _centroid_tree(self) -> KDTree:
        return KDTree(self.corners.mean(axis=1))

    def nearest(self, places: ArrayLike) -> SurfacePlaces:
        """Points on the surface nearest to `places` (p, 3), metres."""
        query_positions = np.asarray(places, float)
        num_candidates = min(_NUM_CANDIDATE_TRIANGLES, len(self.cells))
        candidate_triangles = self._centroid_tree.query(query_positions, num_candidates)[1].reshape(
            len(query_positions), num_candidates
        )
        candidate_corners = self.points[self.cells[candidate_triangles]]
        barycentric_weights = _nearest_in_triangles(candidate_corners, query_positions[:, None])
        points = np.einsum("pqk,pqkd->pqd", barycentric_weights, candidate_corners)
        candidate_distances = np.linalg.norm(points - query_positions[:, None], axis=-1)
        nearest_candidate_index = candidate_distances.argmin(axis=1)
        query_rows = np.arange(len(query_positions))
        return SurfacePlaces(
            candidate_triangles[query_rows, nearest_candidate_index],
            barycentric_weights[query_rows, nearest_candidate_index],
            points[query_rows, nearest_candidate_index],
            candidate_distances[query_rows, nearest_candidate_index],
        )

    def normals_at(self, places: SurfacePlaces) -> Float[np.ndarray, "p 3"]:
        """Outward unit normals at points on the surface, interpolated from the normals at the nodes."""
        interpolated_normals = places.of_nodes(self, self.node_normals)
        return interpolated_normals / np.linalg.norm(interpolated_normals, axis=1, keepdims=True)

    def distance_to_border(self, places: ArrayLike) -> Float[np.ndarray, " p"]:
        """Straight-line distances (p,) of points (p, 3) from the border, metres; infinite for a closed surface."""
        border_edges, query_positions = self.border, np.asarray(places, float)
        if not len(border_edges):
            return np.full(len(query_positions), np.inf)
        edge_starts, edge_ends = self.points[border_edges[:, 0]], self.points[border_edges[:, 1]]
        edge_fractions = (np.arange(16) / 16)[:, None, None]
        border_points = ((1 - edge_fractions) * edge_starts + edge_fractions * edge_ends).reshape(-1, 3)
        return KDTree(border_points).query(query_positions)[0]

    def finer(self) -> "Triangles":
        """Divide each triangle into four at the midpoints of its sides."""
        directed_edges = self.cells[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
        _, first_edge_indices, edge_index = np.unique(
            self._edge_numbers(directed_edges), return_index=True, return_inverse=True
        )
        a, b, c = self.cells.T
        p, q, r = (edge_index.reshape(-1, 3) + len(self.points)).T
        cells = np.concatenate([np.stack(nodes, axis=1) for nodes in ((a, r, q), (r, b, p), (q, p, c), (p, q, r))])
        return Triangles(
            np.concatenate([self.points, self.points[directed_edges[first_edge_indices]].mean(axis=1)]), cells
        )


def _nearest_in_triangles(
    triangle_corners: Float[np.ndarray, "... 3 3"], points: Float[np.ndarray, "... 3"]
) -> np.ndarray:
    """Barycentric coordinates (…, 3) of the point of each triangle that is nearest to `points`."""
    first_sides, second_sides = (
        triangle_corners[..., 1, :] - triangle_corners[..., 0, :],
        triangle_corners[..., 2, :] - triangle_corners[..., 0, :],
    )
    first_corner_offset = points - triangle_corners[..., 0, :]
    aa, bb, ab = (first_sides**2).sum(-1), (second_sides**2).sum(-1), (first_sides * second_sides).sum(-1)
    a, b = (first_corner_offset * first_sides).sum(-1), (first_corner_offset * second_sides).sum(-1)
    squared_doubled_area = aa * bb - ab**2
    u, v = (bb * a - ab * b) / squared_doubled_area, (aa * b - ab * a) / squared_doubled_area
    weights_in_plane = np.stack([1 - u - v, u, v], axis=-1)
    nearest_weights = np.where((weights_in_plane >= 0).all(axis=-1, keepdims=True), weights_in_plane, np.nan)
    min_distance = np.where(np.isnan(nearest_weights[..., 0]), np.inf, 0.0)
    for side_start, side_end in ((0, 1), (1, 2), (2, 0)):
        side_vector = triangle_corners[..., side_end, :] - triangle_corners[..., side_start, :]
        side_fraction = np.clip(
            ((points - triangle_corners[..., side_start, :]) * side_vector).sum(-1) / (side_vector**2).sum(-1), 0, 1
        )
        side_distance = np.linalg.norm(
            triangle_corners[..., side_start, :] + side_fraction[..., None] * side_vector - points, axis=-1
        )
        side_weights = np.zeros_like(weights_in_plane)
        side_weights[..., side_start], side_weights[..., side_end] = 1 - side_fraction, side_fraction
        is_nearer = side_distance < min_distance
        min_distance, nearest_weights = (
            np.where(is_nearer, side_distance, min_distance),
            np.where(is_nearer[..., None], side_weights, nearest_weights),
        )
    return nearest_weights
