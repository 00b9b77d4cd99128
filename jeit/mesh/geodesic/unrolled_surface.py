"""`Unrolled`: a curved surface flattened into the plane, in metres, with the stretch of each triangle.

Developable surfaces (cylinders, cones, bent sheets) are flattened without stretch, apart from the deviations of the
triangles from the developable surface. All other surfaces are flattened as rigidly as possible: rotations of the
triangles and positions of the nodes are alternately fitted by least squares (Liu, Zhang, Xu, Gotsman and Gortler, SGP
2008), starting from a conformal map (Lévy, Petitjean, Ray and Maillot, SIGGRAPH 2002). A sleeve is cut along a shortest
path from one open end to the other; a closed surface is cut between its two extreme nodes along the axis of its largest
extent.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import factorized

from jeit.mesh.geodesic.triangles import SurfacePlaces, Triangles
from jeit.mesh.mesh import Mesh
from jeit_solvers.module import Module

_NUM_RIGID_ITERATIONS = 60
# Minimum slope of a coordinate in space, in metres per metre on the flat surface, for its use as the upward direction.
_MIN_UPWARD_SLOPE = 0.3


class Unrolled(Module):
    """A surface flattened into the plane; created by `unroll`.

    **Fields**: `surface`: the triangles in space; `cells` (m, 3): the triangles as indices of flat nodes, in which
    nodes on the cut occur twice; `points` (k, 2): flat nodes, metres; `nodes` (k,): node of the surface for each flat
    node; `stretch` (m, 2): minimum and maximum factor by which each triangle is stretched.

    **Example:**

    ```python
    flat = unroll(sleeve)
    flat.points, flat.stretch.max()
    ```
    """

    surface: Triangles
    cells: Int[np.ndarray, "m 3"]
    points: Float[np.ndarray, "k 2"]
    nodes: Int[np.ndarray, " k"]
    stretch: Float[np.ndarray, "m 2"]

    @property
    def distortion(self) -> float:
        """Maximum relative change of lengths by the flattening; 0 for developable surfaces."""
        return float(np.maximum(self.stretch[:, 1] - 1, 1 - self.stretch[:, 0]).max())

    @property
    def mean_distortion(self) -> float:
        """Area-weighted mean over the surface of the maximum relative change of lengths in each triangle."""
        return float(np.average(np.abs(self.stretch - 1).max(axis=1), weights=self.surface.areas))

    @property
    def seam(self) -> Float[np.ndarray, "s 2 2"]:
        """Segments (s, 2, 2) of the flat outline that arose from the cut; there are none for an open sheet."""
        end_nodes, is_cut = self._flat_border_edges
        return self.points[end_nodes[is_cut]]

    @property
    def edge(self) -> Float[np.ndarray, "s 2 2"]:
        """Segments (s, 2, 2) of the flat outline that are edges of the original surface."""
        end_nodes, is_cut = self._flat_border_edges
        return self.points[end_nodes[~is_cut]]

    @property
    def _flat_border_edges(self):
        end_nodes = _border_edges(self.cells)
        return end_nodes, ~_are_edges_among(
            np.sort(self.nodes[end_nodes], axis=1), np.sort(self.surface.border, axis=1)
        )

    def flat(self, places: ArrayLike | SurfacePlaces) -> Float[np.ndarray, "p 2"]:
        """Positions (p, 2) on the flat surface, metres, of points (p, 3) on the surface, metres."""
        surface_places = places if isinstance(places, SurfacePlaces) else self.surface.nearest(places)
        return np.einsum("pk,pkd->pd", surface_places.weights, self.points[self.cells[surface_places.triangle]])


def unroll(surface: Triangles | Mesh, face: str | None = None, *, cut: ArrayLike | None = None) -> Unrolled:
    """Flatten a surface, or a face of a shell, as seen from outside.

    **Arguments:**

    - `surface`: a surface in space, its triangles, or a shell.
    - `face`: face of a shell, "inner" or "outer".
    - `cut`: a point (3,), metres, near which a sleeve is to be cut; by default, the side with the smallest x.

    Raises `ValueError` as `Triangles.of` does, and for surfaces with handles or disconnected parts.

    **Example:**

    ```python
    flat = unroll(sleeve)
    flat.points
    ```
    """
    triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
    cells, nodes = _cut_to_disk(triangles, cut)
    triangle_corners = triangles.corners
    plane_corners = _plane_corners(triangle_corners)
    points = _conformal_map(cells, plane_corners, len(nodes))
    points = _flatten_rigidly(cells, plane_corners, points)
    points = _turn_upright(points, triangles.points[nodes])
    deformation_gradients = _edge_matrices(points[cells]) @ np.linalg.inv(_edge_matrices(plane_corners))
    return Unrolled(triangles, cells, points, nodes, np.linalg.svd(deformation_gradients, compute_uv=False)[:, ::-1])


def _plane_corners(triangle_corners: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m 3 2"]:
    """Corners of each triangle in its own plane."""
    a, b = triangle_corners[:, 1] - triangle_corners[:, 0], triangle_corners[:, 2] - triangle_corners[:, 0]
    first_side_lengths = np.linalg.norm(a, axis=1)
    third_corner_x = (a * b).sum(axis=1) / first_side_lengths
    third_corner_y = np.linalg.norm(np.cross(a, b), axis=1) / first_side_lengths
    zero_coordinates = np.zeros_like(first_side_lengths)
    return np.stack(
        [
            np.stack([zero_coordinates, zero_coordinates], 1),
            np.stack([first_side_lengths, zero_coordinates], 1),
            np.stack([third_corner_x, third_corner_y], 1),
        ],
        axis=1,
    )


def _edge_matrices(triangles: Float[np.ndarray, "m 3 2"]) -> Float[np.ndarray, "m 2 2"]:
    return np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=2)


def _conformal_map(cells, plane_corners, num_nodes: int) -> np.ndarray:
    """Least-squares conformal map, which preserves angles as well as possible; two nodes far from each other are
    fixed."""
    fixed_nodes = _farthest_nodes(cells, plane_corners, num_nodes)
    side_vectors = np.stack(
        [
            plane_corners[:, 2] - plane_corners[:, 1],
            plane_corners[:, 0] - plane_corners[:, 2],
            plane_corners[:, 1] - plane_corners[:, 0],
        ],
        axis=1,
    )
    side_vectors = side_vectors / np.sqrt(np.abs(np.linalg.det(_edge_matrices(plane_corners))))[:, None, None]
    triangle_rows = np.repeat(np.arange(len(cells)), 3)
    real_part, imaginary_part = (
        scipy.sparse.csr_array(
            (vector_component.ravel(), (triangle_rows, cells.ravel())), shape=(len(cells), num_nodes)
        )
        for vector_component in (side_vectors[..., 0], side_vectors[..., 1])
    )
    conformal_matrix = scipy.sparse.block_array([[real_part, -imaginary_part], [imaginary_part, real_part]]).tocsc()
    fixed_coordinates = np.array(
        [fixed_nodes[0], fixed_nodes[1], fixed_nodes[0] + num_nodes, fixed_nodes[1] + num_nodes]
    )
    fixed_values = np.array([0.0, fixed_nodes[2], 0.0, 0.0])
    free_coordinates = np.setdiff1d(np.arange(2 * num_nodes), fixed_coordinates)
    columns_of_free_coordinates, right_hand_side = (
        conformal_matrix[:, free_coordinates],
        -(conformal_matrix[:, fixed_coordinates] @ fixed_values),
    )
    node_coordinates = np.zeros(2 * num_nodes)
    node_coordinates[fixed_coordinates] = fixed_values
    node_coordinates[free_coordinates] = scipy.sparse.linalg.spsolve(
        (columns_of_free_coordinates.T @ columns_of_free_coordinates).tocsc(),
        columns_of_free_coordinates.T @ right_hand_side,
    )
    return node_coordinates.reshape(2, -1).T


def _farthest_nodes(cells, plane_corners, num_nodes: int):
    """Two nodes far from each other, and their distance along edges."""
    side_lengths = np.linalg.norm(plane_corners[:, [1, 2, 0]] - plane_corners, axis=2)
    side_starts, side_ends = cells.ravel(), cells[:, [1, 2, 0]].ravel()
    edge_graph = scipy.sparse.csr_array((side_lengths.ravel(), (side_starts, side_ends)), shape=(num_nodes, num_nodes))
    first_node = int(np.argmax(dijkstra(edge_graph, directed=False, indices=0)))
    path_lengths = dijkstra(edge_graph, directed=False, indices=first_node)
    return first_node, int(np.argmax(path_lengths)), float(path_lengths.max())


def _flatten_rigidly(cells, plane_corners, points: np.ndarray) -> np.ndarray:
    """Flatten as rigidly as possible: alternately fit a rotation of each triangle to the map, and the nodes to the
    rotated triangles."""
    num_nodes = len(points)
    next_corner, previous_corner = [1, 2, 0], [2, 0, 1]
    plane_side_vectors = plane_corners[:, next_corner] - plane_corners  # side k runs from corner k to the next
    first_side_from_corner, second_side_from_corner = (
        plane_corners - plane_corners[:, previous_corner],
        plane_corners[:, next_corner] - plane_corners[:, previous_corner],
    )
    cross_products = (
        first_side_from_corner[..., 0] * second_side_from_corner[..., 1]
        - first_side_from_corner[..., 1] * second_side_from_corner[..., 0]
    )
    # Half the cotangent of the angle opposite to side k.
    cotangent_weights = (first_side_from_corner * second_side_from_corner).sum(-1) / cross_products / 2
    side_starts, side_ends = cells, cells[:, next_corner]
    matrix_rows = np.concatenate([side_starts.ravel(), side_ends.ravel(), side_starts.ravel(), side_ends.ravel()])
    matrix_columns = np.concatenate([side_starts.ravel(), side_ends.ravel(), side_ends.ravel(), side_starts.ravel()])
    side_weights = cotangent_weights.ravel()
    stiffness_matrix = scipy.sparse.csc_array(
        (np.concatenate([side_weights, side_weights, -side_weights, -side_weights]), (matrix_rows, matrix_columns)),
        shape=(num_nodes, num_nodes),
    )
    solve_laplacian = factorized(stiffness_matrix[1:, 1:].tocsc())
    for _ in range(_NUM_RIGID_ITERATIONS):
        flat_edges = points[side_ends] - points[side_starts]
        moment_matrix = np.einsum("mk,mki,mkj->mij", cotangent_weights, flat_edges, plane_side_vectors)
        u, _, v = np.linalg.svd(moment_matrix)
        u[:, :, 1] *= np.sign(np.linalg.det(u @ v))[:, None]
        rotated_edges = cotangent_weights[..., None] * np.einsum("mij,mkj->mki", u @ v, plane_side_vectors)
        right_hand_side = np.zeros_like(points)
        np.add.at(right_hand_side, side_ends, rotated_edges)
        np.subtract.at(right_hand_side, side_starts, rotated_edges)
        new_points = np.zeros_like(points)
        new_points[1:] = np.column_stack([solve_laplacian(right_hand_side[1:, flat_axis]) for flat_axis in range(2)])
        has_converged = np.abs((new_points - points) - (new_points - points).mean(axis=0)).max() < 1e-7 * np.ptp(points)
        points = new_points
        if has_converged:
            break
    return points


def _turn_upright(points: np.ndarray, space_points: np.ndarray) -> np.ndarray:
    """Rotate the flat `points` so that the z axis of space points upward, or the y or x axis if z has little slope, and
    centre them at the origin. The map is not mirrored, since the surface is seen from outside."""
    points = points - points.mean(axis=0)
    for space_axis in (2, 1, 0):
        centred_heights = space_points[:, space_axis] - space_points[:, space_axis].mean()
        (a, b), *_ = np.linalg.lstsq(points, centred_heights, rcond=None)
        if np.hypot(a, b) > _MIN_UPWARD_SLOPE:
            cosine_of_turn, sine_of_turn = np.array([b, a]) / np.hypot(a, b)
            return points @ np.array([[cosine_of_turn, sine_of_turn], [-sine_of_turn, cosine_of_turn]])
    return points


def _border_edges(cells) -> np.ndarray:
    directed_edges = cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first_edge_indices, edge_counts = np.unique(
        np.sort(directed_edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    return directed_edges[first_edge_indices[edge_counts == 1]]


def _are_edges_among(edges, reference_edges) -> np.ndarray:
    num_node_numbers = 1 + max(edges.max(initial=0), reference_edges.max(initial=0))
    return np.isin(
        edges[:, 0] * num_node_numbers + edges[:, 1], reference_edges[:, 0] * num_node_numbers + reference_edges[:, 1]
    )


def _cut_to_disk(surface: Triangles, is_cut_edge) -> tuple[np.ndarray, np.ndarray]:
    """Cut a surface so that it becomes topologically a disk. Returns the triangles after the cut, and for each new node
    the original node."""
    cells, num_nodes = surface.cells, len(surface.points)
    border_edges = surface.border
    num_loops, loop_of_edge = _border_loops(border_edges, num_nodes)
    distinct_edges = np.unique(np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    euler_characteristic = num_nodes - len(distinct_edges) + len(cells)
    edge_graph = scipy.sparse.csr_array((np.ones(len(distinct_edges)), distinct_edges.T), shape=(num_nodes, num_nodes))
    if connected_components(edge_graph, directed=False)[0] > 1:
        raise ValueError("surface: parts of it do not hang together; unroll each on its own.")
    if num_loops == 1 and euler_characteristic == 1:
        return cells, np.arange(num_nodes)
    if (num_loops, euler_characteristic) not in ((2, 0), (0, 2)):
        raise ValueError(
            f"surface: it has {num_loops} edges and Euler characteristic {euler_characteristic}; what can be unrolled "
            "is a sheet, a sleeve of two open ends, or closed without handles."
        )
    points = surface.points
    if num_loops == 2:
        end_nodes = np.unique(border_edges[loop_of_edge == 0]), np.unique(border_edges[loop_of_edge == 1])
    else:
        longest_axis = int(np.argmax(np.ptp(points, axis=0)))
        end_nodes = np.array([points[:, longest_axis].argmin()]), np.array([points[:, longest_axis].argmax()])
    path = _path_along_edges(points, distinct_edges, end_nodes, is_cut_edge, border_edges)
    return _split_along_path(cells, path, num_nodes, is_closed=num_loops == 0)


def _border_loops(border_edges, num_nodes: int):
    """Number of loops of the border, and the index of the loop of each border edge."""
    if not len(border_edges):
        return 0, np.zeros(0, int)
    border_graph = scipy.sparse.csr_array((np.ones(len(border_edges)), border_edges.T), shape=(num_nodes, num_nodes))
    loop_labels = connected_components(border_graph, directed=False)[1][border_edges[:, 0]]
    distinct_labels, loop_labels = np.unique(loop_labels, return_inverse=True)
    return len(distinct_labels), loop_labels


def _path_along_edges(points, edges, end_nodes, cut_position, border_edges) -> list[int]:
    """Nodes of a path along edges from the first of the two `end_nodes` to the second, near the point `cut_position`
    and off the border."""
    mean_point = points.mean(axis=0)
    cut_position = np.asarray(cut_position, float) if cut_position is not None else None
    largest_side = np.ptp(points, axis=0).max()
    edge_midpoints = points[edges].mean(axis=1)
    if cut_position is None:
        # Edges away from the side of the smallest x cost more, which yields a straight line along that side.
        x_offsets = (edge_midpoints[:, 0] - points[:, 0].min()) / largest_side
        y_offsets = np.abs(edge_midpoints[:, 1] - mean_point[1]) / largest_side
        edge_costs = 1 + 20 * (x_offsets + y_offsets)
    else:
        cut_axis = points[end_nodes[1]].mean(axis=0) - points[end_nodes[0]].mean(axis=0)
        cut_axis = cut_axis / np.linalg.norm(cut_axis)
        midpoint_offsets = edge_midpoints - cut_position
        edge_costs = (
            1
            + 20
            * np.linalg.norm(midpoint_offsets - (midpoint_offsets @ cut_axis)[:, None] * cut_axis, axis=1)
            / largest_side
        )
    weighted_lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) * edge_costs
    if len(border_edges):
        weighted_lengths = np.where(
            _are_edges_among(edges, np.sort(border_edges, axis=1)), 1e3 * weighted_lengths, weighted_lengths
        )
    edge_graph = scipy.sparse.csr_array((weighted_lengths, edges.T), shape=(len(points), len(points)))
    path_lengths, path_predecessors, _ = dijkstra(
        edge_graph, directed=False, indices=end_nodes[0], return_predecessors=True, min_only=True
    )
    path = [int(end_nodes[1][np.argmin(path_lengths[end_nodes[1]])])]
    while path_predecessors[path[-1]] >= 0:
        path.append(int(path_predecessors[path[-1]]))
    return path


def _split_along_path(cells, path: list[int], num_nodes: int, *, is_closed: bool):
    """Duplicate the nodes along a path for the triangles on one side of the path. On a closed surface, the ends of the
    path are not duplicated."""
    doubled_nodes = path[1:-1] if is_closed else path
    path_edges = set(itertools.pairwise(path))
    path_nodes = set(path)
    new_nodes = {path_node: num_nodes + k for k, path_node in enumerate(doubled_nodes)}
    triangles_at: dict[int, list[int]] = {path_node: [] for path_node in doubled_nodes}
    for touching_triangle in np.flatnonzero(np.isin(cells, doubled_nodes).any(axis=1)):
        for corner_node in cells[touching_triangle]:
            if corner_node in triangles_at:
                triangles_at[int(corner_node)].append(int(touching_triangle))
    cells = cells.copy()
    original_node = cells.copy()
    for path_node in doubled_nodes:
        # The triangles around the node, joined across edges that are not on the path, form two parts; one side is the
        # part that contains a triangle traversing the path forwards.
        surrounding_triangles = triangles_at[path_node]
        side_triangles = set()
        for touching_triangle in surrounding_triangles:
            original_corners = original_node[touching_triangle].tolist()
            triangle_sides = zip(original_corners, original_corners[1:] + original_corners[:1], strict=True)
            if any(triangle_side in path_edges and path_node in triangle_side for triangle_side in triangle_sides):
                side_triangles.add(touching_triangle)
        has_grown = True
        while has_grown:
            has_grown = False
            for touching_triangle in surrounding_triangles:
                if touching_triangle in side_triangles:
                    continue
                for side_triangle in tuple(side_triangles):
                    shared_nodes = set(original_node[touching_triangle].tolist()) & set(
                        original_node[side_triangle].tolist()
                    ) - {path_node}
                    if any(
                        not _is_on_path(path_node, other_node, path_nodes, path_edges) for other_node in shared_nodes
                    ):
                        side_triangles.add(touching_triangle)
                        has_grown = True
                        break
        for touching_triangle in side_triangles:
            cells[touching_triangle][original_node[touching_triangle] == path_node] = new_nodes[path_node]
    return cells, np.concatenate([np.arange(num_nodes), np.array(doubled_nodes, int)])


def _is_on_path(node: int, other_node: int, path_nodes: set, path_edges: set) -> bool:
    return other_node in path_nodes and ((node, other_node) in path_edges or (other_node, node) in path_edges)
