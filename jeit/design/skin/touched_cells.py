"""Cells and nodes of a skin's mesh that a touch changes, and the relative change of each cell's conductivity.

The cells within reach of a touch are found by distance along the surface and depth below the surface.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from jeit.arguments import check_kind
from jeit.design.defaults import CONTRAST, MAX_CONTRAST
from jeit.design.skin.touch_shapes import AbstractIndentation, check_places
from jeit.electrodes.discs import smooth_step
from jeit.forward import ForwardModel
from jeit.mesh import Mesh, centroids
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit_solvers import Strips
from jeit_solvers.engines import as_array, host
from jeit_solvers.module import Module

# Maximum distance of touched positions from the surface of a curved skin, relative to the skin's thickness, or for a
# sheet to the size of its cells.
_MAX_RELATIVE_DISTANCE = 0.5


class ReachedCells(NamedTuple):
    """Mesh cells of a skin within reach of n touches.

    **Fields**: `cells`: indices of the cells within reach of each touch; `distances`: distances of these cells'
    centroids from the position of the touch along the surface, metres; `centroid_depths` (m,): depth below the surface
    of the centroid of every cell of the mesh, metres; `thickness`: thickness of a layer, metres, None for a sheet.
    """

    cells: list[Int[np.ndarray, " c"]]
    distances: list[Float[np.ndarray, " c"]]
    centroid_depths: Float[np.ndarray, " m"]
    thickness: float | None


def is_curved(mesh: Mesh) -> bool:
    """Whether a mesh is that of a curved skin: a surface in space, or a shell on such a surface."""
    return mesh.is_surface or {"inner", "outer"} <= set(mesh.tags)


def touched_surface(mesh: Mesh, face: str = "outer") -> Triangles:
    """Return the touched surface of a curved skin: the sheet itself, or the `face` ("outer" or "inner") of a shell."""
    return Triangles.of(mesh, None if mesh.is_surface else face)


def reached_cells(
    mesh: Mesh, places: Float[np.ndarray, "n d"], radius: float, max_depth: float, face: str = "outer"
) -> ReachedCells:
    """Find the cells whose centroids lie within `radius` metres of `places` along the surface of a skin, and less than
    `max_depth` metres below the surface.

    In a flat layer, depth is measured from its top, at the maximum z; in a shell, from its `face` along the inward
    normal. Raises `ValueError` for positions that are not on the surface of a curved skin.
    """
    cell_centroids = np.asarray(centroids(mesh))
    if is_curved(mesh):
        return _reached_cells_on_surface(mesh, cell_centroids, places, radius, max_depth, face)
    centroid_depths, thickness = np.zeros(len(cell_centroids)), None
    if mesh.dimension == 3:
        node_heights = np.asarray(mesh.points)[:, 2]
        centroid_depths, thickness = node_heights.max() - cell_centroids[:, 2], float(np.ptp(node_heights))
    candidate_cells = np.flatnonzero(centroid_depths < max_depth)
    indices_within_radius = KDTree(cell_centroids[candidate_cells, :2]).query_ball_point(
        places, radius, return_sorted=True
    )
    cells_of_touches = [candidate_cells[np.asarray(reached_indices, int)] for reached_indices in indices_within_radius]
    touch_distances = [
        np.linalg.norm(cell_centroids[cells_of_touch, :2] - touch_place, axis=-1)
        for cells_of_touch, touch_place in zip(cells_of_touches, places, strict=True)
    ]
    return ReachedCells(cells_of_touches, touch_distances, centroid_depths, thickness)


def _reached_cells_on_surface(
    mesh: Mesh, cell_centroids, places, max_touch_distance: float, max_depth: float, face: str
) -> ReachedCells:
    touched_triangles = touched_surface(mesh, face)
    thickness = None if mesh.is_surface else shell_thickness(mesh)
    max_surface_distance = _MAX_RELATIVE_DISTANCE * (
        np.sqrt(touched_triangles.areas.max()) if thickness is None else thickness
    )
    surface_distances = touched_triangles.nearest(places).away
    invalid_places = np.flatnonzero(surface_distances > max_surface_distance)
    if invalid_places.size:
        raise ValueError(
            f"places: {invalid_places.size} of {len(places)} lie off the skin's surface, the first, at "
            f"{millimetre_text(places[invalid_places[0]])} "
            f"mm, by {1e3 * surface_distances[invalid_places[0]]:.3g} mm; give places on the touched face, in metres, "
            "such as touch_grid(skin.outline).places."
        )
    nearest_points = touched_triangles.nearest(cell_centroids)
    centroid_depths = np.zeros(len(cell_centroids)) if mesh.is_surface else nearest_points.away
    candidate_cells = np.flatnonzero(centroid_depths < max_depth)
    candidate_points = type(nearest_points)(
        nearest_points.triangle[candidate_cells],
        nearest_points.weights[candidate_cells],
        nearest_points.points[candidate_cells],
        nearest_points.away[candidate_cells],
    )
    indices_and_lengths = Geodesics.create(touched_triangles).near(places, candidate_points, max_touch_distance)
    return ReachedCells(
        [candidate_cells[reached_indices] for reached_indices, _ in indices_and_lengths],
        [geodesic_lengths for _, geodesic_lengths in indices_and_lengths],
        centroid_depths,
        thickness,
    )


def shell_thickness(mesh: Mesh) -> float:
    """Thickness of a shell, metres: the median distance of the nodes of its inner face from its outer face."""
    inner_points = Triangles.of(mesh, "inner").points
    return float(np.median(Triangles.of(mesh, "outer").nearest(inner_points).away))


def millimetre_text(place) -> str:
    """Format a position in metres as a text in millimetres, such as "(12, 3.5)"."""
    return "(" + ", ".join(f"{1e3 * coordinate:.4g}" for coordinate in place) + ")"


class TouchedCells(Module):
    """Mesh cells changed by n touches: each touch changes the conductivity of up to c cells from σ to σ (1 + change).

    **Fields**

    - `places`: centres of the touches (n, 2), on a curved skin (n, 3), metres.
    - `cells` (n, c): indices of the changed cells; `change` (n, c): relative change of each cell's conductivity, −1 for
      a cell that becomes an insulator. Touches with fewer than c cells are padded with changes of 0.
    - `num_cells`: number of cells of the mesh.
    """

    places: Float[Array, "n d"]
    cells: Int[Array, "n c"]
    change: Float[Array, "n c"]
    num_cells: int = eqx.field(static=True)


def touched_cells(
    mesh: Mesh,
    indentation: AbstractIndentation,
    places,
    *,
    thickness: float | None = None,
    contrast: float = CONTRAST,
    edge: float = 0.0,
    face: str = "outer",
) -> TouchedCells:
    """Compute the mesh cells changed by single indentations of a sheet or of the top of a layer at `places` (n, 2), on
    a curved skin (n, 3), metres.

    `contrast`: conductivity of the touched part divided by that of the rest of the skin: 0, the default, for an
    insulating indenter (Park et al. 2022, text S4), above 1 for a conductor.

    **Layer** (3-D mesh, top at its maximum z): the conductivity of cells whose centroids lie in the indented part is
    multiplied by `contrast`. With an `edge` in metres, the change rises smoothly over a depth of twice `edge`, and is
    differentiable with respect to depth and position.

    **Sheet** (2-D mesh) that represents a layer of `thickness` metres: the conductivity of a fraction depth / thickness
    of the cross-section is multiplied by `contrast`.

    **Curved skin** (a surface in space, or a shell on such a surface): as for a sheet or a layer, but distances are
    along the touched surface, which is the `face` of a shell, and depths along the inward normal.

    Raises `ValueError` for positions where no cell is touched, for an indentation as deep as the skin, and if
    `thickness` is missing for a sheet or given for a layer.
    """
    places = check_places(places, 3 if is_curved(mesh) else 2)
    check_kind("indentation", indentation, AbstractIndentation, "an indentation, such as Bell() or Hemisphere()")
    _check_values(contrast, edge)
    is_solid_layer = mesh.dimension == 3
    max_depth = float(indentation.depth_at(host.zeros(())))
    if is_solid_layer and thickness is not None:
        raise ValueError("thickness is for sheets; that of a layer is in its mesh.")
    if not is_solid_layer and (thickness is None or not 0 < thickness < np.inf):
        raise ValueError(f"thickness must be given for a sheet, in metres, positive; it is {thickness!r}.")
    cells_in_reach = reached_cells(
        mesh, places, indentation.reach, max_depth + edge if is_solid_layer else np.inf, face
    )
    thickness = cells_in_reach.thickness if is_solid_layer else thickness
    assert thickness is not None
    if max_depth >= thickness:
        raise ValueError(
            f"the indentation is {1e3 * max_depth:.3g} mm deep, and the skin {1e3 * thickness:.3g} mm thick; press "
            "less."
        )
    padded_cells, is_not_padding = pad_rows(cells_in_reach.cells)
    touch_distances = np.full(padded_cells.shape, np.inf)
    touch_distances[is_not_padding] = np.concatenate(cells_in_reach.distances)
    indentation_depths, centroid_depths = (
        np.asarray(indentation.depth_at(as_array(touch_distances))),
        cells_in_reach.centroid_depths,
    )
    if not is_solid_layer:
        indented_fractions = indentation_depths / thickness
    elif edge:
        indented_fractions = np.asarray(
            smooth_step(jnp.asarray((indentation_depths - centroid_depths[padded_cells]) / edge))
        )
    else:
        indented_fractions = (indentation_depths > centroid_depths[padded_cells]).astype(float)
    is_changed = is_not_padding & (indented_fractions > 0)
    empty_touches = np.flatnonzero(~is_changed.any(axis=1))
    if empty_touches.size:
        raise ValueError(
            f"{empty_touches.size} of {len(places)} touches change no cell, the first at "
            f"{millimetre_text(places[empty_touches[0]])} mm: they lie "
            "off the skin (places are in metres), or its cells are too coarse for so shallow an indentation; refine "
            "the mesh, in a layer upwards."
        )
    changed_cells, is_not_padding = pad_rows(
        [
            cells_of_touch[is_changed_cell]
            for cells_of_touch, is_changed_cell in zip(padded_cells, is_changed, strict=True)
        ]
    )
    conductivity_changes = np.zeros(changed_cells.shape)
    conductivity_changes[is_not_padding] = (contrast - 1) * indented_fractions[is_changed]
    return TouchedCells(as_array(places), as_array(changed_cells), as_array(conductivity_changes), mesh.num_cells)


def pad_rows(rows: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Join `rows` of integers of different lengths into one array, padded with zeros. Returns this array and a mask of
    the entries that are not padding."""
    row_lengths = np.array([len(unpadded_row) for unpadded_row in rows])
    is_row_entry = np.arange(max(row_lengths.max(), 1)) < row_lengths[:, None]
    padded_rows = np.zeros(is_row_entry.shape, np.int32)
    padded_rows[is_row_entry] = np.concatenate(rows)
    return padded_rows, is_row_entry


def _check_values(contrast: float, edge_width: float) -> None:
    if not 0 <= contrast <= MAX_CONTRAST or contrast == 1:
        raise ValueError(
            f"contrast must be a factor for the conductivity, 0 for an insulator, above 1 for a conductor, up to "
            f"{MAX_CONTRAST:g}, where the limit is reached long before; it is {contrast!r}."
        )
    if not 0 <= edge_width < np.inf:
        raise ValueError(f"edge must be a depth in metres, not negative; it is {edge_width!r}.")


# Number of touches processed at once, and multiple to which a touch's number of nodes is padded, since a program is
# compiled for each number of nodes.
_TOUCHES_AT_ONCE, _PADDING_MULTIPLE = 64, 16


class TouchedNodes(Module):
    """Mesh nodes of the cells that n touches change.

    **Fields**

    - `strips`: the nodes of all touches, ordered in strips across the skin.
    - `nodes` (n, k): nodes of each touch, as indices into the order of `strips`; touches with fewer than k nodes repeat
      their last node.
    - `corners` (n, c, d + 1): nodes of the changed cells of each touch, as indices into the touch's row of `nodes`.
    """

    strips: Strips
    nodes: Int[np.ndarray, "n k"]
    corners: Int[np.ndarray, "n c q"]


def touched_nodes(model: ForwardModel, touches: TouchedCells, strips: Strips | None = None) -> TouchedNodes:
    """Find the mesh nodes of the cells that touches change. `strips`: order of a set of nodes that contains these
    nodes; by default an order of these nodes only."""
    mesh, cells, is_changed = model.mesh, np.asarray(touches.cells), np.asarray(touches.change) != 0
    is_touched_node = np.zeros(mesh.num_points, bool)
    is_touched_node[np.asarray(mesh.cells)[cells[is_changed]]] = True
    if strips is None:
        strips = Strips.create(model.system.pattern, np.asarray(mesh.points), is_touched_node)
    shared_untouched_index = strips.num_strips * strips.selected_per_strip  # one entry for all untouched nodes
    strip_indices = np.where(is_touched_node, strips.place, shared_untouched_index).astype(np.int32)[
        np.asarray(mesh.cells)
    ]
    corner_indices, chunk_results = np.zeros((*cells.shape, mesh.cells.shape[1]), np.int32), []
    for first_touch in range(0, len(cells), _TOUCHES_AT_ONCE):
        touch_slice = slice(first_touch, first_touch + _TOUCHES_AT_ONCE)
        chunk_nodes = np.where(
            is_changed[touch_slice, :, None], strip_indices[cells[touch_slice]], shared_untouched_index
        )
        corner_indices[touch_slice], (touch_indices, node_numbers, distinct_nodes) = _number_nodes(
            chunk_nodes, shared_untouched_index
        )
        chunk_results.append((first_touch + touch_indices, node_numbers, distinct_nodes))
    corner_indices[~is_changed] = 0
    touch_indices, node_numbers, distinct_nodes = (
        np.concatenate(result_arrays) for result_arrays in zip(*chunk_results, strict=True)
    )
    padded_nodes = np.zeros(
        (len(cells), -(-(node_numbers.max(initial=0) + 1) // _PADDING_MULTIPLE) * _PADDING_MULTIPLE), np.int32
    )
    padded_nodes[touch_indices, node_numbers] = distinct_nodes
    entry_indices = np.minimum(
        np.arange(padded_nodes.shape[1]), np.bincount(touch_indices, minlength=len(cells))[:, None] - 1
    )
    return TouchedNodes(strips, np.take_along_axis(padded_nodes, entry_indices, axis=1), corner_indices)


def _number_nodes(nodes: Int[np.ndarray, "b c q"], padding_index: int):
    """Number the distinct mesh nodes of each of b touches from 0, except for the index `padding_index`, which marks
    padding. Returns the number of every entry of `nodes` (b, c, q), and for every distinct node its touch, number and
    index."""
    first_key_of_touch = (padding_index + 1) * np.arange(len(nodes), dtype=np.int32)
    touch_node_keys = nodes + first_key_of_touch[:, None, None]
    is_used_key = np.zeros(len(nodes) * (padding_index + 1), bool)
    is_used_key[touch_node_keys] = True
    is_used_key[first_key_of_touch + padding_index] = False
    distinct_keys = np.flatnonzero(is_used_key)
    touch_indices, distinct_nodes = np.divmod(distinct_keys, padding_index + 1)
    number_within_touch = (
        np.arange(len(distinct_keys)) - np.searchsorted(distinct_keys, first_key_of_touch)[touch_indices]
    )
    numbers_of_keys = np.zeros(len(is_used_key), np.int32)
    numbers_of_keys[distinct_keys] = number_within_touch
    return numbers_of_keys[touch_node_keys], (touch_indices, number_within_touch, distinct_nodes)
