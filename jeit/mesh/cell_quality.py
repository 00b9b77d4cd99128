"""Shape quality of cells, merging of coincident nodes, and readers of .stl and .obj files."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jeit.files import check_memory
from jeit.mesh.mesh import Mesh
from jeit_solvers.module import Module


class Quality(Module):
    """Shape measures of a mesh, as NumPy arrays with one entry per cell.

    **Fields**: `dimension`: 2 for triangles, 3 for tetrahedra; `num_points`: number of nodes; `smallest_angle` (m,):
    the smallest angle of a triangle, or the smallest angle between two faces of a tetrahedron, degrees; `radius_ratio`
    (m,): `dimension` times the radius of the inscribed circle or sphere divided by the radius of the circumscribed
    circle or sphere, from 0 for a flat cell to 1 for a regular cell; `shortest_edge`, `longest_edge` (m,): lengths in
    metres.

    **Example:**

    ```python
    found = quality(mesh)
    found.smallest_angle.min(), found.radius_ratio.mean()
    ```
    """

    dimension: int
    num_points: int
    smallest_angle: np.ndarray
    radius_ratio: np.ndarray
    shortest_edge: np.ndarray
    longest_edge: np.ndarray

    def __repr__(self) -> str:
        return (
            f"Quality of {self.num_points} nodes, {len(self.smallest_angle)} cells in {self.dimension}-D: "
            f"smallest angle {self.smallest_angle.min():.1f}° (mean {self.smallest_angle.mean():.1f}°), "
            f"radius ratio {self.radius_ratio.min():.2f} (mean {self.radius_ratio.mean():.2f}), "
            f"edges {self.shortest_edge.min():.3g} to {self.longest_edge.max():.3g} m"
        )


def quality(mesh: Mesh) -> Quality:
    """Compute shape measures of every cell of a mesh.

    **Arguments:**

    - `mesh`: any mesh.

    **Example:**

    ```python
    print(quality(mesh))
    ```
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    cell_corners = points[cells]
    first_corners, second_corners = np.triu_indices(mesh.dimension + 1, 1)
    edge_lengths = np.linalg.norm(cell_corners[:, first_corners] - cell_corners[:, second_corners], axis=2)
    min_angles, radius_ratios = (
        _triangle_measures(cell_corners) if mesh.dimension == 2 else _tetrahedron_measures(cell_corners)
    )
    return Quality(
        dimension=mesh.dimension,
        num_points=mesh.num_points,
        smallest_angle=min_angles,
        radius_ratio=radius_ratios,
        shortest_edge=edge_lengths.min(axis=1),
        longest_edge=edge_lengths.max(axis=1),
    )


def _triangle_measures(cell_corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edge_vectors = np.roll(cell_corners, -1, axis=1) - cell_corners
    edge_lengths = np.linalg.norm(edge_vectors, axis=2)
    if cell_corners.shape[2] == 2:
        doubled_areas = np.abs(
            edge_vectors[:, 0, 0] * edge_vectors[:, 1, 1] - edge_vectors[:, 0, 1] * edge_vectors[:, 1, 0]
        )
    else:
        doubled_areas = np.linalg.norm(np.cross(edge_vectors[:, 0], edge_vectors[:, 1]), axis=1)
    previous_edges = -np.roll(edge_vectors, 1, axis=1)
    min_angles = np.degrees(np.arctan2(doubled_areas[:, None], (edge_vectors * previous_edges).sum(axis=2))).min(axis=1)
    # Radii of the inscribed circle, r = 2 A / (a + b + c), and of the circumscribed circle, R = a b c / (4 A), of a
    # triangle with edges a, b, c and area A.
    return min_angles, 2 * (doubled_areas / edge_lengths.sum(axis=1)) * (2 * doubled_areas / edge_lengths.prod(axis=1))


def _tetrahedron_measures(cell_corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (cell_corners[:, k] - cell_corners[:, 0] for k in (1, 2, 3))
    # Inward normals of the faces opposite to nodes 1, 2, 3 and 0; the length of each is twice the area of its face.
    face_normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    face_normals = np.concatenate([face_normals, -face_normals.sum(axis=1, keepdims=True)], axis=1)
    doubled_face_areas = np.linalg.norm(face_normals, axis=2)
    unit_normals = face_normals / doubled_face_areas[..., None]
    first_corners, second_corners = np.triu_indices(4, 1)
    dihedral_cosines = np.clip(
        -(unit_normals[:, first_corners] * unit_normals[:, second_corners]).sum(axis=2), -1.0, 1.0
    )
    min_angles = np.degrees(np.arccos(dihedral_cosines)).min(axis=1)
    scaled_volumes = np.abs((a * face_normals[:, 0]).sum(axis=1))
    # The inscribed sphere has the radius 3 V / ΣA, with the volume V and the areas A of the faces. The centre of the
    # circumscribed sphere relative to node 0 is Σ |x_i|² n_i / (2 · 6 V), with the edges x_i from node 0 and the
    # normals n_i.
    squared_edge_lengths = np.stack([(a**2).sum(1), (b**2).sum(1), (c**2).sum(1)], axis=1)
    scaled_circumradii = np.linalg.norm((squared_edge_lengths[..., None] * face_normals[:, :3]).sum(axis=1), axis=1) / (
        2 * scaled_volumes
    )
    return min_angles, 3 * (scaled_volumes / doubled_face_areas.sum(axis=1)) / scaled_circumradii


def merge_points(points: np.ndarray, cells: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Merge points (n, d) closer than `tolerance` metres to each other, and renumber the cells (m, k).

    Each group of such points is replaced by its first point. Cells with two corners in the same group are removed.
    """
    close_pairs = KDTree(points).query_pairs(tolerance, output_type="ndarray")
    closeness_graph = coo_array((np.ones(len(close_pairs)), close_pairs.T), shape=(len(points), len(points)))
    _, component_labels = connected_components(closeness_graph, directed=False)
    _, first_points_of_groups, group_of_point = np.unique(component_labels, return_index=True, return_inverse=True)
    # Number the groups in the order of their first points.
    sort_order = np.argsort(first_points_of_groups)
    new_node_index = np.empty(len(sort_order), int)
    new_node_index[sort_order] = np.arange(len(sort_order))
    renumbered_cells = new_node_index[group_of_point][cells]
    sorted_cells = np.sort(renumbered_cells, axis=1)
    is_valid = (sorted_cells[:, 1:] != sorted_cells[:, :-1]).all(axis=1)
    return points[first_points_of_groups[sort_order]], renumbered_cells[is_valid]


# Layout of a triangle in a binary .stl file: a normal, three corners, and two bytes of attributes.
_STL_TRIANGLE_DTYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER_BYTES = 84
_STL_VERTEX_PATTERN = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
# Distance, relative to the largest coordinate, below which nodes are merged: .stl and .obj files store six digits.
_MERGE_TOLERANCE = 2e-6
# Maximum number of characters of an error message about the content of a file.
_MAX_LINE_LENGTH_IN_MESSAGE = 120
# Maximum memory needed to read a file, divided by the file's size; an .obj file describes a face in few characters.
_MEMORY_PER_FILE_BYTE_BY_FORMAT = {".stl": 8, ".obj": 16}


def read_leniently(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read points (n, 3) and triangles (m, 3) from an .stl or .obj file, in the file's unit, merging coincident points.

    Polygons are divided into triangles that share the polygon's first corner; degenerate triangles are removed. Raises
    `ValueError` with the file's `name` if the file contains no valid triangles.
    """
    file_suffix = path.suffix.lower()
    check_memory(name, _MEMORY_PER_FILE_BYTE_BY_FORMAT[file_suffix] * path.stat().st_size)
    file_bytes = path.read_bytes()
    try:
        points, cells = _parse_stl(file_bytes) if file_suffix == ".stl" else _parse_obj(file_bytes)
    except (ValueError, IndexError, OverflowError) as error:
        message = " ".join(str(error).split())
        message = (
            message if len(message) <= _MAX_LINE_LENGTH_IN_MESSAGE else f"{message[:_MAX_LINE_LENGTH_IN_MESSAGE]} …"
        )
        raise ValueError(f"path: {name} does not work as a mesh file: {message}.") from None
    if not len(cells):
        raise ValueError(f"path: {name} does not work as a mesh file: there are no triangles in it.")
    if not np.isfinite(points[cells]).all():
        raise ValueError(f"path: {name} does not work as a mesh file: a coordinate is no finite number.")
    used_point_indices, new_node_index = np.unique(cells, return_inverse=True)
    points, cells = points[used_point_indices], new_node_index.reshape(cells.shape)
    largest_extent, first_point = float(np.ptp(points, axis=0).max()), points[0].tolist()
    points, cells = merge_points(points, cells, _MERGE_TOLERANCE * float(np.abs(points).max()))
    if not len(cells):
        raise ValueError(
            f"path: {name} does not work as a mesh file: no triangle in it has an area. All that it holds lies within "
            f"{largest_extent:.3g} of {first_point}. Were its digits lost? Write it again, in millimetres, and read it "
            "with scale=1e-3."
        )
    return points, cells


def _parse_stl(file_bytes: bytes) -> tuple[np.ndarray, np.ndarray]:
    num_triangles = int.from_bytes(file_bytes[_STL_HEADER_BYTES - 4 : _STL_HEADER_BYTES], "little")
    if len(file_bytes) == _STL_HEADER_BYTES + num_triangles * _STL_TRIANGLE_DTYPE.itemsize:
        triangle_corners = np.frombuffer(file_bytes, _STL_TRIANGLE_DTYPE, offset=_STL_HEADER_BYTES)["corners"].astype(
            float
        )
    elif file_bytes[:5].lower() != b"solid":
        raise ValueError("it is neither a text that begins with 'solid' nor as long as its number of triangles asks")
    else:
        triangle_corners = np.array(
            [
                [float(coordinate_text) for coordinate_text in vertex_coordinates]
                for vertex_coordinates in _STL_VERTEX_PATTERN.findall(file_bytes)
            ]
        )
        if triangle_corners.size % 9:
            raise ValueError("a facet has not three vertices")
    points = triangle_corners.reshape(-1, 3)
    return points, np.arange(len(points)).reshape(-1, 3)


def _parse_obj(file_bytes: bytes) -> tuple[np.ndarray, np.ndarray]:
    points: list[list[float]] = []
    cells: list[tuple[int, int, int]] = []
    for line in file_bytes.replace(b"\\\n", b" ").splitlines():
        line_keyword, *line_values = line.split() or [b""]
        if line_keyword == b"v":
            points.append([float(coordinate_text) for coordinate_text in line_values[:3]])  # colours may follow
            if len(points[-1]) != 3:
                raise ValueError("a vertex has not three coordinates")
        elif line_keyword == b"f":
            face_corners = [_vertex_index(corner_text, len(points)) for corner_text in line_values]
            cells += [(face_corners[0], *corner_pair) for corner_pair in pairwise(face_corners[1:])]
    triangle_array = np.array(cells, np.int64).reshape(-1, 3)
    if triangle_array.size and triangle_array.max() >= len(points):
        raise ValueError(f"a face names vertex {triangle_array.max() + 1}, and there are {len(points)}")
    return np.array(points, float).reshape(-1, 3), triangle_array


def _vertex_index(corner_text: bytes, num_vertices: int) -> int:
    """Vertex index of a corner of a face, given as vertex/texture/normal; negative numbers count back from the last
    vertex."""
    vertex_number = int(corner_text.split(b"/")[0])
    if vertex_number == 0 or vertex_number < -num_vertices:
        raise ValueError(f"a face names vertex {vertex_number}, and {num_vertices} came before it")
    return vertex_number - 1 if vertex_number > 0 else num_vertices + vertex_number
