"""Shells of a specified thickness on surfaces in space; bending of sheets; and surfaces of solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array

from jeit.arguments import check_name, describe
from jeit.mesh._surface import first_crossing
from jeit.mesh.checks import size_checked
from jeit.mesh.generate import unstructured
from jeit.mesh.mesh import Mesh, normals
from jeit.mesh.outline.domain import check_length
from jeit.mesh.solids import stacked_cells, stacked_wall
from jeit.mesh.topology import odd_permutation


def surface_of(mesh: Mesh, tag: str | None = None) -> Mesh:
    """Extract the boundary triangles of a solid as a surface in space that faces outward.

    **Arguments:**

    - `mesh`: a mesh of tetrahedra.
    - `tag`: name in `mesh.tags` of the triangles to extract; by default, the whole boundary is extracted.

    Raises `ValueError` for a mesh that is not a solid, an unknown tag, and triangles that do not form one surface: for
    a shell, choose 'inner' or 'outer'.

    **Example:**

    ```python
    top = surface_of(solid, "top")
    ```
    """
    if mesh.dimension != 3:
        raise ValueError("mesh: only solids have a boundary surface; this one consists of triangles.")
    boundary_facets = np.asarray(mesh.facets)
    if tag is not None:
        check_name("tag", tag, mesh.tags)
        boundary_facets = boundary_facets[np.asarray(mesh.tags[tag])]
    used_nodes, cells = np.unique(boundary_facets, return_inverse=True)
    with size_checked():
        return Mesh.create(np.asarray(mesh.points)[used_nodes], cells.reshape(boundary_facets.shape))


# Minimum cosine of the angle between the mean normal at a node and the normals of its triangles: below it, the node is
# treated as part of a crease, where the mean normal is used.
_MIN_CREASE_COSINE = np.cos(np.radians(50.0))
# Number of coefficients of the quadratic surface fitted to neighbours, and minimum ratio of the smallest to the largest
# eigenvalue of the normal equations of this fit.
_NUM_COEFFICIENTS, _MIN_EIGENVALUE_RATIO = 5, 1e-6


def node_normals(mesh: Mesh) -> np.ndarray:
    """Unit normals (n, 3) at the nodes of a surface in space.

    A quadratic surface is fitted to the first and second neighbours of each node; on a smooth surface, the normal of
    the fit is accurate to second order in the cell size, also at the border. At creases, and where there are too few
    neighbours, the normal is the angle-weighted mean of the normals of the triangles. The normals are computed with
    NumPy and have no derivatives. Raises `ValueError` for a solid.

    **Arguments:**

    - `mesh`: a surface in space, or a plane mesh.

    **Example:**

    ```python
    outward = node_normals(sleeve)
    ```
    """
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    cell_normals = np.asarray(normals(mesh))
    if not mesh.is_surface:
        return np.broadcast_to(cell_normals[:1], (mesh.num_points, 3)).copy()
    cell_corners = points[cells]
    previous_edges, next_edges = (
        np.roll(cell_corners, 1, axis=1) - cell_corners,
        np.roll(cell_corners, -1, axis=1) - cell_corners,
    )
    length_products = np.linalg.norm(previous_edges, axis=2) * np.linalg.norm(next_edges, axis=2)
    corner_angles = np.arccos(np.clip((previous_edges * next_edges).sum(axis=2) / length_products, -1, 1))
    mean_normals = np.zeros_like(points)
    np.add.at(mean_normals, cells, corner_angles[..., None] * cell_normals[:, None])
    mean_normals /= np.linalg.norm(mean_normals, axis=1, keepdims=True)
    min_cosine = np.ones(len(points))
    np.minimum.at(min_cosine, cells, (mean_normals[cells] * cell_normals[:, None]).sum(axis=2))
    node_slopes, is_determined = _fit_slopes(points, cells, mean_normals)
    is_smooth_node = (min_cosine > _MIN_CREASE_COSINE) & is_determined
    fitted_normals = mean_normals - np.where(is_smooth_node[:, None], node_slopes, 0)
    return fitted_normals / np.linalg.norm(fitted_normals, axis=1, keepdims=True)


def _fit_slopes(
    points: np.ndarray, cells: np.ndarray, node_normal_estimates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a quadratic surface to the first and second neighbours of each node, as a height above the plane
    perpendicular to `node_normal_estimates`. Returns the slopes (n, 3) of the fit at the nodes, and whether the
    neighbours determine the fit."""
    num_nodes = len(points)
    node_pairs = np.concatenate([cells[:, [a, b]] for a in range(3) for b in range(3)])
    adjacency_matrix = coo_array((np.ones(len(node_pairs)), node_pairs.T), shape=(num_nodes, num_nodes)).tocsr()
    two_ring_neighbours = coo_array(adjacency_matrix @ adjacency_matrix)
    centre_node, neighbour_node = two_ring_neighbours.row, two_ring_neighbours.col
    is_distinct = centre_node != neighbour_node
    centre_node, neighbour_node = centre_node[is_distinct], neighbour_node[is_distinct]
    auxiliary_axis = np.eye(3)[np.abs(node_normal_estimates).argmin(axis=1)]
    first_axis = np.cross(node_normal_estimates, auxiliary_axis)
    first_axis /= np.linalg.norm(first_axis, axis=1, keepdims=True)
    # Local axes (n, 3, 3).
    local_axes = np.stack([first_axis, np.cross(node_normal_estimates, first_axis), node_normal_estimates], axis=1)
    local_offsets = np.einsum("pij,pj->pi", local_axes[centre_node], points[neighbour_node] - points[centre_node])
    neighbourhood_radii = np.sqrt(
        np.bincount(centre_node, (local_offsets**2).sum(axis=1), num_nodes)
        / np.bincount(centre_node, minlength=num_nodes)
    )
    u, v, scaled_heights = (local_offsets / neighbourhood_radii[centre_node][:, None]).T
    quadratic_terms = np.stack([u, v, u * u / 2, u * v, v * v / 2], axis=1)
    normal_matrix, right_hand_side = (
        np.zeros((num_nodes, _NUM_COEFFICIENTS, _NUM_COEFFICIENTS)),
        np.zeros((num_nodes, _NUM_COEFFICIENTS)),
    )
    for k in range(_NUM_COEFFICIENTS):
        right_hand_side[:, k] = np.bincount(centre_node, quadratic_terms[:, k] * scaled_heights, num_nodes)
        for j in range(_NUM_COEFFICIENTS):
            normal_matrix[:, k, j] = np.bincount(centre_node, quadratic_terms[:, k] * quadratic_terms[:, j], num_nodes)
    matrix_eigenvalues = np.linalg.eigvalsh(normal_matrix)
    is_determined = matrix_eigenvalues[:, 0] > _MIN_EIGENVALUE_RATIO * matrix_eigenvalues[:, -1]
    normal_matrix[~is_determined] = np.eye(_NUM_COEFFICIENTS)
    height_slopes = np.linalg.solve(normal_matrix, right_hand_side[..., None])[:, :2, 0]
    return np.einsum("ni,nij->nj", height_slopes, local_axes[:, :2]), is_determined


# Distance from a fold to a node, divided by the distance between folds, below which the fold is moved onto the node, to
# avoid slivers.
_FOLD_SNAP_DISTANCE = 0.1
# Distance from a node to a line, divided by the width of the sheet, below which the node lies on the line.
_LINE_TOLERANCE = 1e-12


def bend(mesh: Mesh, radius: float, *, axis: str = "y", num_folds: int | None = None) -> Mesh:
    """Bend a flat sheet around a cylinder that touches the sheet from below along its middle.

    Like paper, the sheet is not stretched: it is folded along straight lines parallel to the cylinder's axis and stays
    flat between these lines, so all lengths and all voltages are preserved. The folds run along the rows of nodes if
    the mesh has rows (the meshes of `jeit.mesh.rectangle` have rows for axis "x"). Otherwise the sheet is divided into
    `num_folds` strips, and cells are cut where folds cross them; `bend(mesh, numpy.inf)` is the flat sheet with the
    same cells. Fold lines lie on the cylinder. The upper side of the sheet becomes the outer side of the surface. The
    surface has the tags of the sheet.

    **Arguments:**

    - `mesh`: a plane mesh.
    - `radius`: radius of the cylinder in metres; a negative radius bends the sheet upward.
    - `axis`: direction of the cylinder, "x" or "y".
    - `num_folds`: number of strips, by default about one per cell across the sheet.

    Raises `ValueError` for a mesh that is not a flat sheet, a radius of zero, and a sheet so wide that it would overlap
    itself.

    **Example:**

    ```python
    bent = bend(sheet, 0.1)
    bent.space_dimension
    ```
    """
    if mesh.dimension != 2 or mesh.is_surface:
        raise ValueError("mesh: only a flat (2-D) sheet bends without stretching; this one is not flat.")
    if axis not in ("x", "y"):
        raise ValueError(f"axis: the cylinder's axis is 'x' or 'y', not {describe(axis)}.")
    if isinstance(radius, bool) or not isinstance(radius, float | int | np.floating) or not abs(radius) > 0:
        raise ValueError(f"radius: expected a length in metres that is not zero, got {describe(radius)}.")
    if num_folds is not None and (isinstance(num_folds, bool) or not isinstance(num_folds, int) or num_folds < 1):
        raise ValueError(f"num_folds: expected a whole number of at least 1, got {describe(num_folds)}.")
    bent_axis = 0 if axis == "y" else 1
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    fold_positions = _fold_positions(points[:, bent_axis], points[cells], bent_axis, num_folds)
    tagged_edges = {
        name: np.asarray(mesh.facets)[np.asarray(facet_indices)] for name, facet_indices in mesh.tags.items()
    }
    for line in fold_positions[1:-1]:
        points, cells, tagged_edges = _cut_cells(points, cells, tagged_edges, points[:, bent_axis] - line)
    horizontal_coordinate, vertical_coordinate = _roll_coordinates(points[:, bent_axis], fold_positions, float(radius))
    coordinate_columns = (
        [horizontal_coordinate, points[:, 1], vertical_coordinate]
        if bent_axis == 0
        else [points[:, 0], horizontal_coordinate, vertical_coordinate]
    )
    return Mesh.create(np.stack(coordinate_columns, axis=1), cells, tags=tagged_edges)


def _fold_positions(
    sheet_positions: np.ndarray, cell_corners: np.ndarray, bent_axis: int, num_folds: int | None
) -> np.ndarray:
    """Coordinates in metres, across the sheet, of the lines along which it is bent, including the two borders of the
    sheet."""
    sheet_width = np.ptp(sheet_positions)
    sorted_positions = np.sort(sheet_positions)
    distinct_positions = sorted_positions[
        np.concatenate([[True], np.diff(sorted_positions) > _LINE_TOLERANCE * sheet_width])
    ]
    corner_coordinates = cell_corners[..., bent_axis]
    first_row, last_row = (
        np.searchsorted(distinct_positions, side_coordinates - _LINE_TOLERANCE * sheet_width)
        for side_coordinates in (corner_coordinates.min(axis=1), corner_coordinates.max(axis=1))
    )
    if num_folds is None and (last_row - first_row <= 1).all():
        return distinct_positions
    mean_edge_length = np.linalg.norm(cell_corners - np.roll(cell_corners, 1, axis=1), axis=2).mean()
    fold_lines = np.linspace(
        distinct_positions[0], distinct_positions[-1], 1 + (num_folds or max(1, round(sheet_width / mean_edge_length)))
    )
    nearest_positions = sorted_positions[np.abs(sorted_positions - fold_lines[:, None]).argmin(axis=1)]
    is_near = np.abs(nearest_positions - fold_lines) < _FOLD_SNAP_DISTANCE * (fold_lines[1] - fold_lines[0])
    return np.where(is_near, nearest_positions, fold_lines)


def _cut_cells(
    points: np.ndarray, cells: np.ndarray, edges_by_tag: dict[str, np.ndarray], height_over_line: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Cut cells and named edges along a line; `height_over_line` (n,): signed distances of the nodes from the line."""
    node_sides = np.where(
        np.abs(height_over_line) <= _LINE_TOLERANCE * np.ptp(height_over_line), 0, np.sign(height_over_line)
    ).astype(int)
    cell_sides = node_sides[cells]
    is_crossed = (cell_sides.min(axis=1) < 0) & (cell_sides.max(axis=1) > 0)
    if not is_crossed.any():
        return points, cells, edges_by_tag
    crossed_edges = np.sort(cells[is_crossed][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    crossed_edges = np.unique(crossed_edges[node_sides[crossed_edges].prod(axis=1) < 0], axis=0)
    crossing_fractions = (
        height_over_line[crossed_edges[:, 0]]
        / (height_over_line[crossed_edges[:, 0]] - height_over_line[crossed_edges[:, 1]])
    )[:, None]
    midpoint_nodes = {(a, b): len(points) + k for k, (a, b) in enumerate(map(tuple, crossed_edges.tolist()))}
    points = np.concatenate(
        [
            points,
            (1 - crossing_fractions) * points[crossed_edges[:, 0]] + crossing_fractions * points[crossed_edges[:, 1]],
        ]
    )

    def midpoint_node(a: int, b: int) -> int:
        return midpoint_nodes[min(a, b), max(a, b)]

    new_cells = []
    for crossed_corners in cells[is_crossed].tolist():
        corner_signs = node_sides[crossed_corners].tolist()
        if 0 in corner_signs:
            k = corner_signs.index(0)
            a, b, c = crossed_corners[k:] + crossed_corners[:k]
            first_midpoint = midpoint_node(b, c)
            new_cells += [(a, b, first_midpoint), (a, first_midpoint, c)]
        else:
            k = corner_signs.index(-sum(corner_signs))
            a, b, c = crossed_corners[k:] + crossed_corners[:k]
            first_midpoint, second_midpoint = midpoint_node(a, b), midpoint_node(a, c)
            new_cells.append((a, first_midpoint, second_midpoint))
            is_first_diagonal_shorter = np.linalg.norm(points[first_midpoint] - points[c]) < np.linalg.norm(
                points[b] - points[second_midpoint]
            )
            new_cells += (
                [(first_midpoint, b, c), (first_midpoint, c, second_midpoint)]
                if is_first_diagonal_shorter
                else [(first_midpoint, b, second_midpoint), (b, c, second_midpoint)]
            )
    named_edges = {}
    for name, edge_ends in edges_by_tag.items():
        is_crossed_edge = node_sides[edge_ends].prod(axis=1) < 0
        edge_halves = [
            [(a, midpoint_node(a, b)), (midpoint_node(a, b), b)] for a, b in edge_ends[is_crossed_edge].tolist()
        ]
        named_edges[name] = np.concatenate([edge_ends[~is_crossed_edge], np.array(edge_halves, int).reshape(-1, 2)])
    return points, np.concatenate([cells[~is_crossed], np.array(new_cells)]), named_edges


def _roll_coordinates(
    sheet_positions: np.ndarray, fold_positions: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal and vertical coordinates of positions (n,) on the sheet after bending. The `fold_positions` lie on a
    circle; the middle of the sheet stays at 0."""
    sheet_centre = (fold_positions[0] + fold_positions[-1]) / 2
    if np.isinf(radius):
        return sheet_positions - sheet_centre, np.zeros_like(sheet_positions)
    strip_widths = np.diff(fold_positions)
    bend_radius = abs(radius)
    is_too_wide = strip_widths.max() > 2 * bend_radius
    fold_angles = 2 * np.arcsin(np.minimum(strip_widths / (2 * bend_radius), 1))
    if is_too_wide or fold_angles.sum() >= 2 * np.pi:
        sheet_width = fold_positions[-1] - fold_positions[0]
        raise ValueError(
            f"radius: a sheet {sheet_width:.4g} m wide would overlap itself on a cylinder of radius {bend_radius:.4g} "
            f"m. It needs more than {sheet_width / (2 * np.pi):.4g} m, and finer cells where these are large; a closed "
            "sleeve is a jeit.mesh.tube."
        )
    fold_line_angles = np.concatenate([[0.0], np.cumsum(fold_angles)])
    fold_line_angles -= np.interp(sheet_centre, fold_positions, fold_line_angles)
    horizontal_of_folds, vertical_of_folds = (
        bend_radius * np.sin(fold_line_angles),
        bend_radius * (np.cos(fold_line_angles) - 1) * np.sign(radius),
    )
    return np.interp(sheet_positions, fold_positions, horizontal_of_folds), np.interp(
        sheet_positions, fold_positions, vertical_of_folds
    )


_SHELL_TAGS = ("inner", "outer", "side")
# Number of bisection steps to find the maximum thickness.
_BISECTION_STEPS = 40


def shell(
    surface: Mesh,
    thickness: float,
    num_layers: int = 1,
    *,
    outward: bool = True,
    normals: ArrayLike | None = None,
) -> Mesh:
    """Mesh a skin on a surface in space: prisms along the normals at the nodes, divided into tetrahedra.

    With n nodes in the surface, node k · n + i is its node i displaced by k · thickness / num_layers. Tags: 'inner',
    'outer' and, unless the surface is closed, 'side', and the tags of the surface for the parts of the side.

    **Arguments:**

    - `surface`: a surface in space.
    - `thickness`: thickness of the skin in metres.
    - `num_layers`: number of layers of prisms.
    - `outward`: whether the skin extends outward from the surface; otherwise it extends inward.
    - `normals` (n, 3): unit normals at the nodes; default: `jeit.mesh.node_normals`, which may be less accurate.

    Raises `ValueError` for a mesh that is not a surface in space, a thickness that is not positive, no layers, a shell
    that intersects itself, and a thickness, such as one above the radius of curvature, at which prisms turn inside out.
    In the last case, the message states the position and the maximum thickness.

    **Example:**

    ```python
    skin = shell(sleeve, 0.005)
    skin.tags["outer"]
    ```
    """
    if not surface.is_surface:
        raise ValueError("surface: this mesh is flat, and a shell needs a surface in space; use jeit.mesh.layer.")
    thickness = check_length("thickness", thickness)
    num_layers = unstructured.check_count("num_layers", num_layers, 1)
    points, cells, border_edges = (np.asarray(array) for array in (surface.points, surface.cells, surface.facets))
    num_nodes = len(points)
    unstructured.check_total(num_nodes * (num_layers + 1), "num_layers")
    node_directions = node_normals(surface) if normals is None else _check_normals(normals, num_nodes)
    node_directions = node_directions if outward else -node_directions
    shell_tetrahedra = stacked_cells(cells, num_nodes, num_layers)
    # Sorting the corners in `stacked_cells` inverts some prisms. The second of the three tetrahedra of a prism has the
    # opposite orientation to the other two tetrahedra.
    orientation_signs = np.where(odd_permutation(cells) ^ (not outward), -1.0, 1.0)
    tetrahedron_signs = np.tile(np.outer(orientation_signs, (1, -1, 1)).ravel(), num_layers)

    def layer_points(layer_height: float) -> np.ndarray:
        return np.concatenate([points + k * layer_height / num_layers * node_directions for k in range(num_layers + 1)])

    _check_upright(layer_points, shell_tetrahedra, tetrahedron_signs, thickness, len(cells))
    tagged_facets: dict[str, ArrayLike] = {"inner": cells, "outer": cells + num_layers * num_nodes}
    if not outward:
        tagged_facets = {"outer": tagged_facets["inner"], "inner": tagged_facets["outer"]}
    if len(border_edges):
        tagged_facets["side"] = stacked_wall(border_edges, num_nodes, num_layers)
    for name, facet_indices in surface.tags.items():
        if name in _SHELL_TAGS:
            raise ValueError(f"surface: its tag {name!r} is taken in a shell. Rename it.")
        tagged_facets[name] = stacked_wall(border_edges[np.asarray(facet_indices)], num_nodes, num_layers)
    mesh = Mesh.create(layer_points(thickness), shell_tetrahedra, tags=tagged_facets)
    _check_no_self_contact(mesh, thickness)
    return mesh


def _check_normals(normals: ArrayLike, num_nodes: int) -> np.ndarray:
    unit_normals = np.asarray(normals, dtype=float)
    if unit_normals.shape != (num_nodes, 3) or not np.allclose(np.linalg.norm(unit_normals, axis=1), 1, atol=1e-6):
        raise ValueError(
            f"normals: expected unit vectors at the nodes, shape ({num_nodes}, 3), got shape {unit_normals.shape}."
        )
    return unit_normals


def _scaled_tetrahedron_volumes(
    points: np.ndarray, tetrahedra: np.ndarray, tetrahedron_signs: np.ndarray
) -> np.ndarray:
    edge_vectors = points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]
    return tetrahedron_signs * np.linalg.det(edge_vectors) / 6


def _check_upright(
    layer_points, tetrahedra: np.ndarray, tetrahedron_signs: np.ndarray, thickness: float, num_triangles: int
) -> None:
    scaled_volumes = _scaled_tetrahedron_volumes(layer_points(thickness), tetrahedra, tetrahedron_signs)
    if scaled_volumes.min() > 0:
        return
    if thickness > (surface_extent := float(np.ptp(layer_points(0.0), axis=0).max())):
        raise ValueError(
            f"thickness: {thickness:.4g} m is more than the surface is large, {surface_extent:.4g} m. Are both in "
            f"metres? If the thickness is millimetres, give {1e-3 * thickness:.4g}; if the surface came from a file of "
            "another unit, read it with that: jeit.mesh.read(..., scale=1e-3) for millimetres, 0.0254 for inches, 1 "
            "for metres."
        )
    lower_thickness, upper_thickness = 0.0, thickness
    for _ in range(_BISECTION_STEPS):
        trial_thickness = (lower_thickness + upper_thickness) / 2
        is_upright = _scaled_tetrahedron_volumes(layer_points(trial_thickness), tetrahedra, tetrahedron_signs).min() > 0
        lower_thickness, upper_thickness = (
            (trial_thickness, upper_thickness) if is_upright else (lower_thickness, trial_thickness)
        )
    worst_tetrahedron = int(
        np.argmin(_scaled_tetrahedron_volumes(layer_points(upper_thickness), tetrahedra, tetrahedron_signs))
    )
    worst_triangle = worst_tetrahedron // 3 % num_triangles
    worst_position = layer_points(0.0)[tetrahedra[worst_tetrahedron, 0]].round(6).tolist()
    max_thickness = (1 - 5e-4) * lower_thickness  # does not exceed `lower_thickness` after rounding to four digits
    raise ValueError(
        f"thickness: {thickness:.4g} m is more than the radius of curvature of the surface at triangle "
        f"{worst_triangle}, near {worst_position} m: the skin turns inside out there. It can be {max_thickness:.4g} m "
        "thick at most; or let it grow to the other side, or smooth the surface."
    )


def _check_no_self_contact(mesh: Mesh, thickness: float) -> None:
    points, boundary_triangles = np.asarray(mesh.points), np.asarray(mesh.facets)
    if (contact_pair := first_crossing(points, boundary_triangles)) is not None:
        contact_position = points[boundary_triangles[contact_pair[0]]].mean(axis=0).round(6).tolist()
        raise ValueError(
            f"thickness: a skin {thickness:.4g} m thick grows into itself near {contact_position} m, where parts of "
            "the surface lie closer together than that. Make it thinner."
        )
