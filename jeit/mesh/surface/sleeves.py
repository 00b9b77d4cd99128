"""Surfaces of standard shapes: tubes, forearms, spheres and spherical caps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

from jeit.arguments import describe
from jeit.mesh.cell_quality import merge_points
from jeit.mesh.generate import unstructured
from jeit.mesh.generate.refine import Refinement
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline.domain import check_length
from jeit.mesh.solids import disk

# Height of a row of equilateral triangles, divided by their edge.
_RELATIVE_ROW_HEIGHT = np.sqrt(3) / 2
_MIN_NODES_AROUND_SLEEVE = 6
# Number of points on an ellipse for computing its arc length.
_NUM_ELLIPSE_SAMPLES = 4096


def tube(
    radius: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    num_around: int | None = None,
) -> Mesh:
    """Mesh the lateral surface of an upright cylinder around the z axis, from z = 0 up: a sleeve, open at both ends.

    Rows of nodes lie on the cylinder, every second row rotated by half the distance between nodes; node 0 lies at angle
    0. Tags: 'bottom', 'top'. For a part of a cylinder, bend a sheet with `bend`.

    **Arguments:**

    - `radius`, `height`: radius and height of the tube in metres.
    - `num_points`: number of nodes, met within about 5 % (default 1,200); or `cell_size`: edge length in metres; or
      `num_around`: number of nodes around the tube.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    sleeve = tube(0.04, 0.2, num_points=300)
    ```
    """
    radius, height = check_length("radius", radius), check_length("height", height)
    num_per_ring, num_rows = _node_counts(2 * np.pi * radius, height, num_points, cell_size, num_around)
    return _sleeve_mesh(height, np.full((num_rows + 1, 2), radius), num_per_ring)


def forearm(
    length: float,
    wrist: float | Sequence[float],
    elbow: float | Sequence[float],
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    num_around: int | None = None,
) -> Mesh:
    """Mesh a tapered sleeve around the z axis, from the `wrist` at z = 0 to the `elbow` at z = `length`.

    Sections between wrist and elbow are interpolated linearly, and nodes are evenly spaced around each section. Tags:
    'bottom', 'top'.

    **Arguments:**

    - `length`: length of the sleeve in metres.
    - `wrist`, `elbow`: radius of a circular section in metres, or semi-axes (along x, along y) of an elliptical
      section.
    - `num_points`, `cell_size`, `num_around`: as in `tube`.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    arm = forearm(0.2, 0.03, (0.045, 0.04), num_points=300)
    ```
    """
    length = check_length("length", length)
    end_semi_axes = np.stack([_semi_axes("wrist", wrist), _semi_axes("elbow", elbow)])
    mean_girth = float(np.mean([_arc_lengths(*semi_axes_of_end)[-1] for semi_axes_of_end in end_semi_axes]))
    slant_length = float(np.hypot(length, np.abs(end_semi_axes[1] - end_semi_axes[0]).mean()))
    num_per_ring, num_rows = _node_counts(mean_girth, slant_length, num_points, cell_size, num_around)
    height_fractions = np.linspace(0, 1, num_rows + 1)[:, None]
    return _sleeve_mesh(
        length, (1 - height_fractions) * end_semi_axes[0] + height_fractions * end_semi_axes[1], num_per_ring
    )


def _semi_axes(name: str, given_radii: float | Sequence[float]) -> np.ndarray:
    try:
        semi_axes = np.asarray(given_radii, dtype=float)
    except (TypeError, ValueError):
        semi_axes = np.zeros(3)
    if semi_axes.shape not in ((), (2,)):
        raise ValueError(f"{name}: give a radius in metres, or two, along x and along y.")
    return np.array([check_length(name, float(semi_axis)) for semi_axis in np.broadcast_to(semi_axes, 2)])


def _node_counts(
    girth: float, height: float, num_points: int | None, cell_size: float | None, num_around: int | None
) -> tuple[int, int]:
    """Number of nodes around a sleeve, and number of rows of triangles along it."""
    if num_around is not None:
        if num_points is not None or cell_size is not None:
            raise ValueError("num_around: give it, num_points or cell_size, not two of them.")
        num_per_ring = unstructured.check_count("num_around", num_around, _MIN_NODES_AROUND_SLEEVE)
        return num_per_ring, max(1, round(height / (_RELATIVE_ROW_HEIGHT * girth / num_per_ring)))
    mesh_target = unstructured.MeshTarget.create(num_points, cell_size)
    if mesh_target.cell_size is None:
        # Number of nodes n = (g / h) (H / (0.87 h) + 1), with the girth g, the height H and the edge length h.
        num_nodes = mesh_target.num_points
        edge_length = np.sqrt(girth * height / (_RELATIVE_ROW_HEIGHT * num_nodes))
        for _ in range(30):
            edge_length = np.sqrt(girth * (height / _RELATIVE_ROW_HEIGHT + edge_length) / num_nodes)
        num_rows = max(1, round(height / (_RELATIVE_ROW_HEIGHT * edge_length)))
        num_per_ring = max(_MIN_NODES_AROUND_SLEEVE, round(num_nodes / (num_rows + 1)))
    else:
        num_per_ring = max(_MIN_NODES_AROUND_SLEEVE, round(girth / mesh_target.cell_size))
        num_rows = max(1, round(height / (_RELATIVE_ROW_HEIGHT * girth / num_per_ring)))
    unstructured.check_total(
        num_per_ring * (num_rows + 1), "num_points" if mesh_target.cell_size is None else "cell_size"
    )
    return num_per_ring, num_rows


def _arc_lengths(a: float, b: float) -> np.ndarray:
    """Arc length along an ellipse with semi-axes a and b, at evenly spaced values of its angular parameter."""
    angular_parameters = np.linspace(0, 2 * np.pi, _NUM_ELLIPSE_SAMPLES + 1)
    ellipse_points = np.stack([a * np.cos(angular_parameters), b * np.sin(angular_parameters)], axis=1)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ellipse_points, axis=0), axis=1))])


def _sleeve_mesh(height: float, semi_axes: np.ndarray, num_per_ring: int) -> Mesh:
    """Mesh a sleeve from rows of nodes on ellipses with `semi_axes` (r + 1, 2), evenly spaced along each ellipse."""
    ring_points = []
    for row_number, (a, b) in enumerate(semi_axes):
        relative_angles = (np.arange(num_per_ring) + row_number % 2 / 2) / num_per_ring
        node_angles = 2 * np.pi * relative_angles
        if a != b:
            arc_length_samples = _arc_lengths(a, b)
            node_angles = np.interp(
                relative_angles * arc_length_samples[-1],
                arc_length_samples,
                np.linspace(0, 2 * np.pi, _NUM_ELLIPSE_SAMPLES + 1),
            )
        ring_points.append(
            np.stack(
                [a * np.cos(node_angles), b * np.sin(node_angles), np.full(num_per_ring, height * row_number)], axis=1
            )
        )
    points = np.concatenate(ring_points)
    points[:, 2] /= len(semi_axes) - 1
    node_index = np.arange(len(points)).reshape(len(semi_axes), num_per_ring)
    cells = [
        _triangles_between_rings(lower_ring, upper_ring, row_number % 2)
        for row_number, (lower_ring, upper_ring) in enumerate(pairwise(node_index))
    ]

    def ring_edges(ring: np.ndarray) -> np.ndarray:
        return np.stack([ring, np.roll(ring, -1)], axis=1)

    return Mesh.create(
        points, np.concatenate(cells), tags={"bottom": ring_edges(node_index[0]), "top": ring_edges(node_index[-1])}
    )


def _triangles_between_rings(lower_ring: np.ndarray, upper_ring: np.ndarray, is_lower_ahead: int) -> np.ndarray:
    """Triangles between two rings with equal numbers of nodes, offset by half the node spacing; `is_lower_ahead`:
    whether the nodes of the lower ring are ahead by this offset."""
    next_lower_nodes, next_upper_nodes = np.roll(lower_ring, -1), np.roll(upper_ring, -1)
    if is_lower_ahead:
        return np.concatenate(
            [
                np.stack([lower_ring, next_lower_nodes, next_upper_nodes], 1),
                np.stack([lower_ring, next_upper_nodes, upper_ring], 1),
            ]
        )
    return np.concatenate(
        [
            np.stack([lower_ring, next_lower_nodes, upper_ring], 1),
            np.stack([next_lower_nodes, next_upper_nodes, upper_ring], 1),
        ]
    )


def sphere(radius: float, *, num_points: int | None = None, cell_size: float | None = None) -> Mesh:
    """Mesh a closed sphere around the origin.

    Every triangle of an icosahedron is divided into k² triangles, which are projected onto the sphere. The mesh has 10
    k² + 2 nodes; k is chosen so that the number of nodes or the cell size is closest to the requested value.

    **Arguments:**

    - `radius`: radius of the sphere in metres.
    - `num_points`: number of nodes (default 1,200); or `cell_size`: edge length in metres.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    ball = sphere(0.05, num_points=162)
    ```
    """
    radius = check_length("radius", radius)
    mesh_target = unstructured.MeshTarget.create(num_points, cell_size)
    if mesh_target.cell_size is None:
        num_divisions = max(1, round(np.sqrt((mesh_target.num_points - 2) / 10)))
    else:
        # The area of the sphere is divided into 20 k² triangles of area (√3 / 4) h².
        num_divisions = max(1, round(np.sqrt(4 * np.pi / 20 / (np.sqrt(3) / 4)) * radius / mesh_target.cell_size))
    unstructured.check_total(10 * num_divisions**2 + 2, "cell_size")
    icosahedron_corners = _icosahedron_corners()
    face_nodes = icosahedron_corners[ConvexHull(icosahedron_corners).simplices]
    i, j = np.meshgrid(np.arange(num_divisions + 1), np.arange(num_divisions + 1), indexing="ij")
    is_inside = i + j <= num_divisions
    barycentric_weights = np.stack([num_divisions - i - j, i, j], axis=-1)[is_inside] / num_divisions
    node_index = np.full(is_inside.shape, -1)
    node_index[is_inside] = np.arange(is_inside.sum())
    upward_triangles = np.stack([node_index[:-1, :-1], node_index[1:, :-1], node_index[:-1, 1:]], axis=-1)
    downward_triangles = np.stack([node_index[1:, 1:], node_index[:-1, 1:], node_index[1:, :-1]], axis=-1)
    face_cells = np.concatenate([upward_triangles.reshape(-1, 3), downward_triangles.reshape(-1, 3)])
    face_cells = face_cells[(face_cells >= 0).all(axis=1)]
    points = np.concatenate([barycentric_weights @ face_corners for face_corners in face_nodes])
    cells = np.concatenate([face_cells + k * len(barycentric_weights) for k in range(len(face_nodes))])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    # Nodes on the edges of the icosahedron were created once for each of the two faces.
    points, cells = merge_points(points, cells, 1e-6 / num_divisions)
    return Mesh.create(radius * points, _orient_outward(points, cells))


def cap(
    radius: float,
    angle: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
) -> Mesh:
    """Mesh the part of a sphere around the origin within `angle` of its pole (0, 0, radius).

    The mesh of a disk is laid onto the sphere so that distances from the pole are preserved; at the edge of a
    hemisphere, cells are compressed along the edge by a factor of π/2. Tag: 'edge'.

    **Arguments:**

    - `radius`: radius of the sphere in metres.
    - `angle`: angle from the pole to the edge, radians.
    - `num_points`, `cell_size`, `refine`: as in `disk`, with positions (x, y) on the flat disk.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    dome = cap(0.1, np.pi / 3, num_points=200)
    dome.is_surface
    ```
    """
    radius = check_length("radius", radius)
    if not (isinstance(angle, float | int | np.floating) and 0 < angle < 0.95 * np.pi):
        raise ValueError(
            f"angle: expected radians from the pole, more than 0 and less than 2.98, got {describe(angle)}."
        )
    flat_disk = disk(radius * float(angle), num_points=num_points, cell_size=cell_size, refine=refine)
    x, y = np.asarray(flat_disk.points).T
    axis_distances = np.hypot(x, y)
    radial_factor = np.sinc(axis_distances / radius / np.pi)  # sin(d / R) / (d / R)
    points = np.stack([x * radial_factor, y * radial_factor, radius * np.cos(axis_distances / radius)], axis=1)
    return Mesh.create(points, flat_disk.cells, tags={"edge": np.arange(flat_disk.num_facets)})


def _orient_outward(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Orient triangles (m, 3) so that they face away from the origin."""
    is_outward = np.linalg.det(points[cells]) > 0
    return np.where(is_outward[:, None], cells, cells[:, [0, 2, 1]])


def _icosahedron_corners() -> np.ndarray:
    """Corners of an icosahedron (12, 3)."""
    golden_ratio = (1 + np.sqrt(5)) / 2
    golden_rectangle = np.array([[0, a, b * golden_ratio] for a in (1, -1) for b in (1, -1)])
    return np.concatenate([np.roll(golden_rectangle, k, axis=1) for k in range(3)]) / np.hypot(1, golden_ratio)
