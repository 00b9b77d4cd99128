"""Meshes of plane shapes (`disk`, `rectangle`, `polygon`) and of solids above them (`layer`, `box`, `cylinder`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jeit.mesh.checks import size_checked
from jeit.mesh.generate import unstructured
from jeit.mesh.generate.refine import Refinement, nodes_of_solid
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Disk, Polygon, Rectangle
from jeit.mesh.outline.domain import check_length


def disk(
    radius: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Refinement = None,
    num_boundary: int | None = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh a disk; its boundary nodes lie on the circle.

    Without refinement or required nodes, the mesh consists of concentric rings, and node 0 lies at angle 0. Any other
    mesh is unstructured, and its node 0 is the first boundary node counter-clockwise from angle 0. The mesh is a
    polygon inscribed in the circle: with N boundary nodes, the relative deficit of its area is (2 π² / 3) / N². Every
    angle is at least 25°.

    **Arguments:**

    - `radius`: radius of the disk in metres.
    - `num_points`: number of nodes, met within about 5 % (default 1,200); or `cell_size`: edge length in metres.
    - `centre` (x, y): centre of the disk in metres.
    - `refine`: one or several `Refine`, or a function that takes points (p, 2) and returns the requested edge lengths
      (p,) at these points in metres. If `num_points` is specified, the lengths are scaled by a common factor.
    - `num_boundary`: number of nodes on the circle; the cells grow from the circle inwards.
    - `boundary_points`: angles in radians at which nodes are placed.
    - `interior_points` (k, 2): positions in metres at which nodes are placed.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    mesh = disk(0.14, num_points=300)
    mesh.num_points, mesh.num_cells
    ```
    """
    return Disk(radius, centre).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        num_boundary=num_boundary,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )


def rectangle(
    width: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh a rectangle.

    Without refinement or required nodes, the mesh consists of rows of nearly equilateral cells. Node 0 is the lower
    left corner. The sides are tagged 'left', 'right', 'bottom', 'top'.

    **Arguments:**

    - `width`, `height`: lengths along x and along y, metres.
    - `num_points`, `cell_size`, `centre`, `refine`, `interior_points`: as in `disk`.
    - `boundary_points`: arc lengths in metres, counter-clockwise from the lower left corner, at which nodes are placed.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    sheet = rectangle(0.2, 0.1, num_points=300)
    sheet.tags["left"]
    ```
    """
    return Rectangle(width, height, centre).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )


def polygon(
    vertices: ArrayLike,
    *,
    holes: Sequence[ArrayLike] = (),
    num_points: int | None = None,
    cell_size: float | None = None,
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh the inside of a simple polygon.

    The vertices are nodes, and the first vertex is node 0. Every angle is at least 25°, except at sharper corners of
    the polygon, each of which is cut off by a single isosceles cell.

    **Arguments:**

    - `vertices` (k, 2): corners of the outer edge, metres.
    - `holes`: corners (h, 2) of each hole, metres.
    - `num_points`, `cell_size`, `refine`, `interior_points`: as in `disk`.
    - `boundary_points`: arc lengths in metres along the outer outline, counter-clockwise from the first vertex, at
      which nodes are placed.

    Raises `ValueError` for an outline that is not simple, and for invalid or contradictory arguments.

    **Example:**

    ```python
    triangle = polygon([[0, 0], [0.2, 0], [0.1, 0.15]], num_points=150)
    ```
    """
    return Polygon(vertices, holes).mesh(
        num_points=num_points,
        cell_size=cell_size,
        refine=refine,
        boundary_points=boundary_points,
        interior_points=interior_points,
    )


def stacked_cells(cells: np.ndarray, num_nodes: int, num_layers: int) -> np.ndarray:
    """Tetrahedra (3 m num_layers, 4) of the prisms above triangles (m, 3); node k · `num_nodes` + i is node i of the
    plane mesh after k layers.

    Every side face of a prism is divided along the diagonal that rises from its lower-numbered to its higher-numbered
    node, so that the tetrahedra of neighbouring prisms match.
    """
    a, b, c = np.sort(cells.astype(np.int64), axis=1).T
    num_layer_nodes = num_nodes
    prism_tetrahedra = np.stack(
        [
            np.stack([a, b, c, c + num_layer_nodes], axis=1),
            np.stack([a, b, b + num_layer_nodes, c + num_layer_nodes], axis=1),
            np.stack([a, a + num_layer_nodes, b + num_layer_nodes, c + num_layer_nodes], axis=1),
        ],
        axis=1,
    ).reshape(-1, 4)
    return np.concatenate([prism_tetrahedra + k * num_nodes for k in range(num_layers)])


def stacked_wall(edges: np.ndarray, num_nodes: int, num_layers: int) -> np.ndarray:
    """Triangles (2 e num_layers, 3) of the wall above edges (e, 2), divided like the prisms in `stacked_cells`."""
    smaller_nodes, larger_nodes = np.sort(edges.astype(np.int64), axis=1).T
    lower_triangles = np.stack([smaller_nodes, larger_nodes, larger_nodes + num_nodes], axis=1)
    upper_triangles = np.stack([smaller_nodes, smaller_nodes + num_nodes, larger_nodes + num_nodes], axis=1)
    return np.concatenate(
        [
            wall_triangle + k * num_nodes
            for k in range(num_layers)
            for wall_triangle in (lower_triangles, upper_triangles)
        ]
    )


# In a solid, 'bottom' and 'top' are the horizontal faces, so the sides of a rectangle with these names are renamed.
_RENAMED_TAGS = {"bottom": "front", "top": "back"}


def layer(mesh: Mesh, thickness: float, num_layers: int = 1, *, heights: ArrayLike | None = None) -> Mesh:
    """Extrude a plane mesh to a plate from z = 0 to `thickness`; the prism above each triangle is divided into three
    tetrahedra.

    With n nodes in the plane mesh, node k · n + i is node i of the plane mesh at the height z = k · thickness /
    num_layers, or at the k-th of `heights`. Tags: 'bottom' (z = 0), 'top' (z = thickness) and 'side'.
    Each tag of an edge of the plane mesh is also the tag of the part of the side above this edge; its tags 'bottom' and
    'top' are renamed to 'front' and 'back'. Every side face of a prism is divided along the diagonal that rises from
    its lower-numbered to its higher-numbered node, so that the tetrahedra of neighbouring prisms match.

    **Arguments:**

    - `mesh`: a plane mesh.
    - `thickness`: thickness of the plate in metres.
    - `num_layers`: number of layers of prisms.
    - `heights` (num_layers + 1,): heights of the nodes in metres, from 0 to the thickness, instead of equal layers.

    Raises `ValueError` for a mesh that is not plane, a thickness that is not positive, no layers, or heights that do
    not rise from 0 to the thickness.

    **Example:**

    ```python
    plate = layer(sheet, 0.01, num_layers=2)
    plate.tags["top"]
    ```
    """
    if mesh.is_surface:
        raise ValueError(
            "mesh: this one is a surface in space; what has a thickness above it is a shell, jeit.mesh.shell."
        )
    if mesh.dimension != 2:
        raise ValueError("mesh: a layer is made from a plane (2-D) mesh, this one is 3-D.")
    thickness = check_length("thickness", thickness)
    level_heights = _check_heights(thickness, num_layers, heights)
    num_layers = len(level_heights) - 1
    plane_points, cells, boundary_edges = np.asarray(mesh.points), np.asarray(mesh.cells), np.asarray(mesh.facets)
    num_nodes = len(plane_points)
    unstructured.check_total(num_nodes * (num_layers + 1), "num_layers")
    points = np.column_stack([np.tile(plane_points, (num_layers + 1, 1)), np.repeat(level_heights, num_nodes)])

    tetrahedra = stacked_cells(cells, num_nodes, num_layers)

    def wall_triangles(edges: np.ndarray) -> np.ndarray:
        return stacked_wall(edges, num_nodes, num_layers)

    tagged_facets: dict[str, ArrayLike] = {
        "bottom": cells,
        "top": cells + num_layers * num_nodes,
        "side": wall_triangles(boundary_edges),
    }
    for name, facet_indices in mesh.tags.items():
        new_name = _RENAMED_TAGS.get(name, name)
        if new_name in tagged_facets:
            raise ValueError(
                f"mesh: its tag {name!r} would be called {new_name!r} in the layer, which is taken. Rename it."
            )
        tagged_facets[new_name] = wall_triangles(boundary_edges[np.asarray(facet_indices)])
    with size_checked():
        return Mesh.create(points, tetrahedra, tags=tagged_facets)


def _check_heights(thickness: float, num_layers: int, heights: ArrayLike | None) -> np.ndarray:
    """Heights of the nodes of a layer in metres, lowest first."""
    if heights is None:
        return np.linspace(0.0, thickness, unstructured.check_count("num_layers", num_layers, 1) + 1)
    node_heights = np.asarray(heights, float)
    if (
        node_heights.ndim != 1
        or len(node_heights) < 2
        or node_heights[0] != 0
        or node_heights[-1] != thickness
        or not (np.diff(node_heights) > 0).all()
    ):
        raise ValueError(f"heights must rise from 0 to the thickness, {thickness:g} m.")
    return node_heights


def box(
    width: float,
    depth: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    num_layers: int | None = None,
    refine: Refinement = None,
) -> Mesh:
    """Mesh a box of `width` by `depth` by `height`, centred at x = y = 0, from z = 0 up.

    Tags: 'left', 'right' (across x), 'front', 'back' (across y), 'bottom', 'top' (across z), and 'side'.

    **Arguments:**

    - `width`, `depth`, `height`: lengths along x, y and z, metres.
    - `num_points`: number of nodes, met within about 10 % (default 4,000); or `cell_size`: edge length in metres.
    - `num_layers`: number of layers along z, by default derived from `num_points` or `cell_size`.
    - `refine`: local refinement as in `disk`, at positions seen from above.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    solid = box(0.2, 0.1, 0.05, num_points=500)
    solid.tags["top"]
    ```
    """
    width, depth = check_length("width", width), check_length("depth", depth)
    height = check_length("height", height)
    num_base_points, layer_count = choose_layers(width * depth, height, num_points, cell_size, num_layers)
    with size_checked(), nodes_of_solid(num_points, count_of_base_nodes(width * depth, height, num_layers)):
        base_mesh = rectangle(width, depth, num_points=num_base_points, cell_size=cell_size, refine=refine)
        return layer(base_mesh, height, layer_count)


def cylinder(
    radius: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    num_layers: int | None = None,
    refine: Refinement = None,
    num_boundary: int | None = None,
    boundary_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh an upright cylinder around the z axis, from z = 0 up.

    Tags: 'bottom', 'top', 'side'.

    **Arguments:**

    - `radius`, `height`: radius and height of the cylinder in metres.
    - `num_points`: number of nodes, met within about 10 % (default 4,000); or `cell_size`: edge length in metres.
    - `num_layers`: number of layers along z, by default derived from `num_points` or `cell_size`.
    - `refine`, `num_boundary`, `boundary_points` (angles): as in `disk`, at positions seen from above.

    Raises `ValueError` for invalid or contradictory arguments.

    **Example:**

    ```python
    tank = cylinder(0.14, 0.05, num_points=800)
    tank.num_cells
    ```
    """
    radius, height = check_length("radius", radius, 2), check_length("height", height)
    num_base_points, layer_count = choose_layers(np.pi * radius**2, height, num_points, cell_size, num_layers)
    with size_checked(), nodes_of_solid(num_points, count_of_base_nodes(np.pi * radius**2, height, num_layers)):
        base_mesh = disk(
            radius,
            num_points=num_base_points,
            cell_size=cell_size,
            refine=refine,
            num_boundary=num_boundary,
            boundary_points=boundary_points,
        )
        return layer(base_mesh, height, layer_count)


def count_of_base_nodes(area: float, height: float, num_layers: int | None) -> Callable[[int], int]:
    """Return a function that computes the number of nodes of a solid's base from the number of nodes of the solid."""
    return lambda num_points: choose_layers(area, height, num_points, None, num_layers)[0] or num_points


def choose_layers(
    area: float, height: float, num_points: int | None, cell_size: float | None, num_layers: int | None
) -> tuple[int | None, int]:
    """Numbers of nodes of the base of `area` m², and of layers up to `height` metres. The number of nodes is None if a
    cell size is specified."""
    target_num_points = unstructured.MeshTarget.create(num_points, cell_size)
    if num_layers is not None:
        num_layers = unstructured.check_count("num_layers", num_layers, 1)
    if target_num_points.cell_size is not None:
        return None, num_layers or max(1, round(height / target_num_points.cell_size))
    num_nodes = target_num_points.num_points if target_num_points.is_requested else 4000
    # A solid of base area A and height H, with node spacing h in the plane and along z, has n = (1.1 A / h²) (H / h +
    # 1) nodes.
    if num_layers is None:
        node_spacing = np.cbrt(1.1 * area * height / num_nodes)
        for _ in range(20):
            node_spacing = np.sqrt(1.1 * area * (height / node_spacing + 1) / num_nodes)
        num_layers = max(1, round(height / node_spacing))
    return max(4, round(num_nodes / (num_layers + 1))), num_layers
