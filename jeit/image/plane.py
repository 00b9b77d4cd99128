"""Sections of solids by planes, and isosurfaces of fields on tetrahedra, by marching simplices.

A field is specified by values at the nodes and is linear in every cell. The part of a tetrahedron where the field
equals a level, or of a triangle where the field exceeds the level, is a triangle or a quadrilateral. Each part is
stored as four corners, with the last corner repeated for a triangle. Doi and Koide, IEICE Trans. E74 (1991) 214-224,
for tetrahedra. All cells are processed at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe, is_number
from jeit.mesh import Mesh, measures

# End nodes of the edges of a tetrahedron that the level crosses, in order around the polygon of intersection. Nodes are
# sorted from the highest to the lowest value. The keys are numbers of nodes above the level.
_CROSSED_EDGES = {
    1: [[0, 1], [0, 2], [0, 3], [0, 3]],
    2: [[0, 2], [0, 3], [1, 3], [1, 2]],
    3: [[0, 3], [1, 3], [2, 3], [2, 3]],
}
# Corners of the part of a triangle above the level. Each corner is given by the end nodes of the edge on which it lies;
# a corner at a node has this node as both end nodes.
_CORNERS_ABOVE_LEVEL = {
    1: [[0, 0], [0, 1], [0, 2], [0, 2]],
    2: [[0, 0], [1, 1], [1, 2], [0, 2]],
    3: [[0, 0], [1, 1], [2, 2], [2, 2]],
}
_CROSSED_TRIANGLE_SIDES = [[0, 1], [0, 2]]


class CutPieces(NamedTuple):
    """p pieces with c corners each, cut out of simplices (triangles or tetrahedra), at most one piece per simplex.

    **Fields**: `ends`: (p, c, 2) nodes of the edge on which each corner lies; `share`: (p, c) position of the corner on
    the edge, from 0 at the first node to 1 at the second; `cell`: (p,) index of the simplex of each piece.
    """

    ends: Int[np.ndarray, "p c 2"]
    share: Float[np.ndarray, "p c"]
    cell: Int[np.ndarray, " p"]

    def at_corners(self, values: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "p c ..."]:
        """Values at the corners of the pieces, interpolated linearly from `values` at the nodes, such as positions (n,
        d)."""
        edge_fraction = self.share.reshape(*self.share.shape, *[1] * (values.ndim - 1))
        return (1 - edge_fraction) * values[self.ends[..., 0]] + edge_fraction * values[self.ends[..., 1]]


def crossed_cells(cells: Int[np.ndarray, "m 4"], values: Float[np.ndarray, " n"], level: float = 0.0) -> CutPieces:
    """The surface in tetrahedra on which the field with the `values` (n,) at the nodes equals `level`: polygons with
    four corners, in order around each polygon. A node at the level counts as above the level, so a facet of the mesh
    that lies in the surface belongs to the polygons of only one of its two cells."""
    return _cut_cells(cells, values, level, _CROSSED_EDGES)


def cut_above_level(
    triangles: Int[np.ndarray, "b 3"], values: Float[np.ndarray, " n"], level: float = 0.0
) -> CutPieces:
    """The part of a surface of triangles on which the field with the `values` (n,) at the nodes is at or above
    `level`."""
    return _cut_cells(triangles, values, level, _CORNERS_ABOVE_LEVEL)


def crossed_edges(triangles: Int[np.ndarray, "b 3"], values: Float[np.ndarray, " n"], level: float = 0.0) -> CutPieces:
    """The lines on a surface of triangles along which the field with the `values` (n,) at the nodes equals `level`:
    pieces with two corners."""
    return _cut_cells(triangles, values, level, {1: _CROSSED_TRIANGLE_SIDES, 2: [[0, 2], [1, 2]]})


def _cut_cells(cells, field_values, level: float, corner_edges_by_count: dict[int, list[list[int]]]) -> CutPieces:
    num_nodes_above = (field_values[cells] >= level).sum(axis=1)
    piece_arrays = []
    for num_corners_above, corner_edges in corner_edges_by_count.items():
        cut_cells = np.flatnonzero(num_nodes_above == num_corners_above)
        sort_order = np.argsort(-field_values[cells[cut_cells]], axis=1, kind="stable")
        end_nodes = np.take_along_axis(cells[cut_cells], sort_order, axis=1)[:, np.array(corner_edges)]
        higher_values, lower_values = field_values[end_nodes[..., 0]], field_values[end_nodes[..., 1]]
        with np.errstate(invalid="ignore"):
            edge_fractions = np.where(
                higher_values > lower_values,
                (higher_values - level) / np.where(higher_values > lower_values, higher_values - lower_values, 1),
                0,
            )
        piece_arrays.append((end_nodes, edge_fractions, cut_cells))
    return CutPieces(*(np.concatenate(joined_arrays) for joined_arrays in zip(*piece_arrays, strict=True)))


@dataclass(frozen=True)
class TriangleSurface:
    """A surface of triangles in space. **Fields**: `points`: (n, 3) corners of the triangles in metres; `triangles`:
    (m, 3) indices of points, ordered so that normals point outward.

    **Example:**

    ```python
    surface = isosurface_of(solid, solid_image, 0.3)
    surface.points, surface.enclosed
    ```
    """

    points: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "m 3"]

    @property
    def enclosed(self) -> float:
        """Volume in m³ that the surface encloses; the surface must be closed."""
        if not len(self.points):
            return 0.0
        a, b, c = np.swapaxes(self.points[self.triangles] - self.points.mean(axis=0), 0, 1)
        return float(np.sum(a * np.cross(b, c)) / 6)


def node_values(mesh: Mesh, image: Float[np.ndarray, "..."]) -> Float[np.ndarray, " n"]:
    """Values (n,) of an image at the nodes of its mesh.

    **Arguments:**

    - `mesh`: the mesh.
    - `image`: values per cell (m,), which are averaged over the cells around each node, weighted by area or volume; or
      values per node (n,), which are returned unchanged.

    Raises `ValueError` for an image of the wrong shape, complex values and NaN.

    **Example:**

    ```python
    smooth = node_values(mesh, image)
    ```
    """
    image_values = np.asarray(image)
    if image_values.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image_values.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image_values):
        raise ValueError("values are complex; take their real or imaginary part.")
    if not np.isfinite(image_values).all():
        raise ValueError("values must be finite to be drawn.")
    if image_values.shape == (mesh.num_points,):
        return image_values.astype(float)
    cells, cell_measures = np.asarray(mesh.cells), np.asarray(measures(mesh))
    nodes_per_cell = cells.shape[1]
    weighted_sums = np.bincount(cells.ravel(), np.repeat(cell_measures * image_values, nodes_per_cell), mesh.num_points)
    return weighted_sums / np.bincount(cells.ravel(), np.repeat(cell_measures, nodes_per_cell), mesh.num_points)


def isosurface_of(mesh: Mesh, values: Float[np.ndarray, "..."], level: float) -> TriangleSurface:
    """The closed surface of the region where an image exceeds `level`, or, for a negative `level`, is below `level`.

    Where the region reaches the wall of the body, the wall closes the surface. The surface has no triangles if no value
    reaches the level.

    **Arguments:**

    - `mesh`: the mesh of a solid.
    - `values`: the image, per cell (m,) or per node (n,); values per cell are first averaged to the nodes. The image is
      linear between nodes.
    - `level`: value of the image on the surface, in the unit of the image.

    Raises `ValueError` for a level that is zero or not a number, and in the same cases as `node_values`.

    **Example:**

    ```python
    surface = isosurface_of(solid, solid_image, 0.3)
    ```
    """
    check_solid(mesh)
    if not is_number(level) or level == 0:
        raise ValueError(f"level must be a value of the image, above or below zero; it is {describe(level)}.")
    level_sign = 1.0 if level > 0 else -1.0
    height_above_level = level_sign * node_values(mesh, values) - abs(level)
    points = np.asarray(mesh.points)
    inner_surface, wall_surface = (
        crossed_cells(np.asarray(mesh.cells), height_above_level),
        cut_above_level(np.asarray(mesh.facets), height_above_level),
    )
    end_nodes, edge_fractions = (
        np.concatenate([inner_surface.ends, wall_surface.ends]),
        np.concatenate([inner_surface.share, wall_surface.share]),
    )
    # Cells share one point for each crossed edge and for each node of the wall.
    end_nodes = np.where(
        ((edge_fractions == 0) | (edge_fractions == 1))[..., None],
        np.where(edge_fractions == 1, end_nodes[..., 1], end_nodes[..., 0])[..., None],
        end_nodes,
    )
    edge_fractions = np.where(end_nodes[..., 0] == end_nodes[..., 1], 0.0, edge_fractions)
    lower_nodes = end_nodes.min(axis=-1).astype(np.int64)
    edge_keys = lower_nodes * len(points) + end_nodes.max(axis=-1)
    _, first_indices, point_indices = np.unique(edge_keys, return_index=True, return_inverse=True)
    end_nodes, edge_fractions, point_indices = (
        end_nodes.reshape(-1, 2)[first_indices],
        edge_fractions.reshape(-1)[first_indices],
        point_indices.reshape(-1, 4),
    )
    points_on_edges = (1 - edge_fractions)[:, None] * points[end_nodes[:, 0]] + edge_fractions[:, None] * points[
        end_nodes[:, 1]
    ]
    # Normals point from values above the level to values below; facets of the wall have outward normals already.
    inward_directions = points[inner_surface.ends[..., 1]].sum(axis=1) - points[inner_surface.ends[..., 0]].sum(axis=1)
    outward_directions = np.concatenate(
        [inward_directions, _triangle_normals(points[np.asarray(mesh.facets)[wall_surface.cell]])]
    )
    triangles = np.concatenate([point_indices[:, [0, 1, 2]], point_indices[:, [0, 2, 3]]])
    needs_flip = (
        np.sum(
            _triangle_normals(points_on_edges[triangles]) * np.concatenate([outward_directions, outward_directions]),
            axis=1,
        )
        < 0
    )
    triangles[needs_flip] = triangles[needs_flip][:, ::-1]
    a, b, c = triangles.T
    return TriangleSurface(points_on_edges, triangles[(a != b) & (b != c) & (a != c)])


def _triangle_normals(corners: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m 3"]:
    """Normals of triangles with the given corners; each normal is as long as twice the triangle's area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


AXES = ("x", "y", "z")
# Distance from a plane, divided by the size of the body, below which a point counts as lying in the plane.
_IN_PLANE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Plane:
    """A plane in space, with the orientation in which it is viewed.

    **Fields**: `point`: (3,) point in the plane, metres; `toward`, `right`, `up`: (3,) perpendicular unit vectors
    towards the viewer, to the right and upwards on the page; `name`: name of the plane in figures, such as "z = 10 mm".

    The z axis points up on the page; in horizontal planes the y axis points up. Make a plane with `Plane.at` or
    `Plane.through`.

    **Example:**

    ```python
    plane = Plane.at("z", 0.02)
    plane.distance(solid.points), plane.name
    ```
    """

    point: np.ndarray
    toward: np.ndarray
    right: np.ndarray
    up: np.ndarray
    name: str

    @classmethod
    def at(cls, axis: str, value: float) -> "Plane":
        """The plane where the coordinate `axis`, "x", "y" or "z", equals `value` metres. The plane is viewed from the
        right, the front or above, so that the two other axes point to the right and up. Raises `ValueError` for any
        other axis or a value that is not a number."""
        if axis not in AXES:
            raise ValueError(f"axis must be 'x', 'y' or 'z'; it is {describe(axis)}.")
        if not is_number(value):
            raise ValueError(f"value must be a place on the {axis} axis, in metres; it is {describe(value)}.")
        point, normal = np.zeros(3), np.zeros(3)
        point[AXES.index(axis)] = value
        normal[AXES.index(axis)] = -1.0 if axis == "y" else 1.0
        return cls(point, normal, *_page_axes(normal), f"{axis} = {_millimetres_text(float(value))} mm")

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> "Plane":
        """The plane through `point` (3,), in metres, perpendicular to `normal` (3,), which points towards the viewer.
        Raises `ValueError` unless point and normal are three finite numbers each and the normal is not zero."""
        point_array, normal_array = (np.asarray(values, dtype=object) for values in (point, normal))
        for argument_name, argument_value in (("point", point_array), ("normal", normal_array)):
            if argument_value.shape != (3,) or not all(is_number(coordinate) for coordinate in argument_value):
                raise ValueError(
                    f"{argument_name} must be three finite numbers; it is "
                    f"{describe(point if argument_name == 'point' else normal)}."
                )
        point_array, normal_array = point_array.astype(float), normal_array.astype(float)
        normal_length = float(np.linalg.norm(normal_array))
        if normal_length == 0:
            raise ValueError("normal is zero; give the direction in which the plane is looked at, such as (0, 0, 1).")
        unit_normal = normal_array / normal_length
        point_text = ", ".join(_millimetres_text(coordinate) for coordinate in point_array)
        normal_text = ", ".join(f"{component:.2g}" for component in unit_normal).replace("-", "−")
        return cls(
            point_array, unit_normal, *_page_axes(unit_normal), f"through ({point_text}) mm across ({normal_text})"
        )

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of points (n, 3) from the plane in metres, positive towards the viewer."""
        return (points - self.point) @ self.toward

    def on_page(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Coordinates (…, 2) of points to the right and up on the page, in metres. In a plane made with `Plane.at` the
        coordinates are measured along the coordinate axes of the body."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


@dataclass(frozen=True)
class Cut:
    """Section of a solid by a plane: p polygons and an outline of s line segments.

    **Fields**: `polygons`: (p, 4, 2) corners in metres on the page of the plane, with the last corner repeated in
    triangles; `cell`: (p,) index of the cell cut by each polygon; `outline`: (s, 2, 2) line segments where the plane
    meets the surface of the body.

    **Example:**

    ```python
    section = cut_by_plane(solid, Plane.at("z", 0.02))
    section.area, section.outline
    ```
    """

    polygons: Float[np.ndarray, "p 4 2"]
    cell: Int[np.ndarray, " p"]
    outline: Float[np.ndarray, "s 2 2"]

    @property
    def area(self) -> float:
        """Total area of the polygons in m²."""
        corners = self.polygons
        x, y = corners[..., 0], corners[..., 1]
        return float(0.5 * np.abs(np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1)).sum())


def cut_by_plane(mesh: Mesh, plane: Plane) -> Cut:
    """Exact section of a solid by a plane: the polygon cut out of each cell, and the outline of the section.

    If the plane contains facets of the mesh, it cuts the cells behind these facets as seen by the viewer, or the cells
    in front of them if no cells lie behind.

    **Arguments:**

    - `mesh`: the mesh of the solid.
    - `plane`: the plane.

    Raises `ValueError` for a mesh that is not a solid, and for a plane that does not meet the solid.

    **Example:**

    ```python
    section = cut_by_plane(solid, Plane.through([0.0, 0.0, 0.02], [1.0, 0.0, 1.0]))
    ```
    """
    check_solid(mesh)
    check_kind("plane", plane, Plane, "a Plane, such as Plane.at('z', 0.02)")
    points, cells, facets = (np.asarray(values) for values in (mesh.points, mesh.cells, mesh.facets))
    signed_distances = plane.distance(points)
    body_size = float(np.ptp(points, axis=0).max())
    signed_distances = np.where(np.abs(signed_distances) < _IN_PLANE_TOLERANCE * body_size, 0.0, signed_distances)
    cut_pieces, outline_pieces = crossed_cells(cells, signed_distances), crossed_edges(facets, signed_distances)
    if len(cut_pieces.cell) == 0:
        cut_pieces, outline_pieces = crossed_cells(cells, -signed_distances), crossed_edges(facets, -signed_distances)
    if len(cut_pieces.cell) == 0:
        min_distance, max_distance = (1e3 * distance for distance in (signed_distances.min(), signed_distances.max()))
        distance_text = f"{min_distance:.3g} mm before" if min_distance > 0 else f"{-max_distance:.3g} mm behind"
        raise ValueError(f"plane {plane.name} misses the body, which lies {distance_text} it; are both in metres?")
    polygons, outline = plane.on_page(cut_pieces.at_corners(points)), plane.on_page(outline_pieces.at_corners(points))
    return Cut(polygons, cut_pieces.cell, outline[np.ptp(outline, axis=1).max(axis=1) > 0])


def check_solid(mesh: Mesh) -> None:
    """Raise `ValueError` unless `mesh` is a mesh of tetrahedra."""
    check_kind("mesh", mesh, Mesh, "a Mesh, such as jeit.mesh.box(0.1, 0.1, 0.05)")
    if mesh.cells.shape[1] != 4:
        raise ValueError("mesh: this is for solids of tetrahedra; draw a plane mesh with plot_image.")


def _page_axes(view_direction) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up on the page, for a plane viewed from the direction `view_direction`."""
    page_reference = (
        np.array([0.0, 0.0, 1.0])
        if abs(view_direction[2]) < 1 - 1e-9
        else np.array([0.0, math.copysign(1, view_direction[2]), 0.0])
    )
    upward_axis = page_reference - (page_reference @ view_direction) * view_direction
    upward_axis /= np.linalg.norm(upward_axis)
    return np.cross(upward_axis, view_direction) + 0.0, upward_axis + 0.0


def _millimetres_text(length: float) -> str:
    # The length in millimetres is rounded to a tenth, or to three digits if it is below 9.5 mm.
    length_text = f"{1e3 * length:.1f}".removesuffix(".0") if abs(length) >= 0.0095 else f"{1e3 * length:.3g}"
    return length_text.replace("-", "−") if abs(length) > 5e-10 else "0"
