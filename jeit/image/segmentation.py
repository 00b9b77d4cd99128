"""Segmentation of images: regions defined by geometry, by thresholds and by watersheds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike
from scipy import ndimage

from jeit.arguments import describe, is_number
from jeit.image.rasters import CONDUCTIVE, RESISTIVE
from jeit.mesh import Mesh, centroids, measures
from jeit.mesh.mesh import interior_facets


def ball_region(mesh: Mesh, centre: ArrayLike, radius: float) -> Bool[np.ndarray, " m"]:
    """Mask (m,) of the cells whose centroid lies within a ball, or in a sheet within a disk.

    **Arguments:**

    - `mesh`: the mesh.
    - `centre` (d,): centre of the ball in metres.
    - `radius`: radius of the ball in metres.

    Raises `ValueError` for a centre with the wrong number of coordinates, a radius that is not positive, and an empty
    region.

    **Example:**

    ```python
    region = ball_region(mesh, [0.04, 0.0], 0.02)
    ```
    """
    if not (is_number(radius) and radius > 0):
        raise ValueError(f"radius must be a positive number of metres; it is {describe(radius)}.")
    centroid_distances = np.linalg.norm(_offsets_from_point(mesh, centre, "centre"), axis=1)
    return _check_region_not_empty(
        mesh, centroid_distances <= radius, "no centroid of a cell is so near to centre; make radius larger"
    )


def box_region(mesh: Mesh, lower: ArrayLike, upper: ArrayLike) -> Bool[np.ndarray, " m"]:
    """Mask (m,) of the cells whose centroid lies in an axis-parallel box between two corners.

    **Arguments:**

    - `mesh`: the mesh.
    - `lower`, `upper` (d,): corners of the box, metres.

    Raises `ValueError` for corners with the wrong number of coordinates, for a corner `upper` that is not larger than
    `lower`, and for an empty region.

    **Example:**

    ```python
    region = box_region(mesh, [0.0, -0.05], [0.05, 0.05])
    ```
    """
    offsets_from_lower, offsets_from_upper = (
        _offsets_from_point(mesh, lower, "lower"),
        _offsets_from_point(mesh, upper, "upper"),
    )
    if not (np.asarray(lower, float) < np.asarray(upper, float)).all():
        raise ValueError("upper must be larger than lower in every coordinate.")
    is_inside_box = (offsets_from_lower >= 0).all(axis=1) & (offsets_from_upper <= 0).all(axis=1)
    return _check_region_not_empty(mesh, is_inside_box, "no centroid of a cell lies between lower and upper")


def half_region(mesh: Mesh, direction: ArrayLike, point: ArrayLike | None = None) -> Bool[np.ndarray, " m"]:
    """Mask (m,) of the cells whose centroid lies on one side of the plane (2-D: line) through a point.

    **Arguments:**

    - `mesh`: the mesh.
    - `direction` (d,): normal of the plane, which points to the selected side; (1, 0) selects the right half.
    - `point` (d,): point in the plane in metres, by default the centroid of the body.

    Raises `ValueError` for a direction of length zero, and for an empty region.

    **Example:**

    ```python
    region = half_region(mesh, [1.0, 0.0])
    ```
    """
    plane_normal = np.asarray(direction, float)
    if plane_normal.shape != (mesh.dimension,) or not np.isfinite(plane_normal).all() or not plane_normal.any():
        raise ValueError(f"direction must be {mesh.dimension} finite numbers, not all zero; it is {direction!r}.")
    cell_sizes = np.asarray(measures(mesh))
    plane_point = cell_sizes @ np.asarray(centroids(mesh)) / cell_sizes.sum() if point is None else point
    return _check_region_not_empty(
        mesh, _offsets_from_point(mesh, plane_point, "point") @ plane_normal > 0, "no cell lies in direction of point"
    )


def _offsets_from_point(mesh: Mesh, point: ArrayLike, argument_name: str) -> Float[np.ndarray, "m d"]:
    """Vectors (m, d) from a `point` to the centroids of the cells. Raises `ValueError` for a point with the wrong
    number of coordinates."""
    point_coordinates = np.asarray(point, float)
    if point_coordinates.shape != (mesh.dimension,) or not np.isfinite(point_coordinates).all():
        raise ValueError(
            f"{argument_name} must be {mesh.dimension} finite numbers in metres; it has shape "
            f"{point_coordinates.shape}."
        )
    return np.asarray(centroids(mesh)) - point_coordinates


def _check_region_not_empty(mesh: Mesh, region_cells, failure_text: str) -> Bool[np.ndarray, " m"]:
    if not region_cells.any():
        node_positions = np.asarray(mesh.points)
        lower_text, upper_text = (
            ", ".join(f"{coordinate:.2g}" for coordinate in corner)
            for corner in (node_positions.min(axis=0), node_positions.max(axis=0))
        )
        raise ValueError(
            f"the region is empty: {failure_text}. The body spans [{lower_text}] to [{upper_text}], metres."
        )
    return np.asarray(region_cells)


def shared_facets(mesh: Mesh) -> Int[np.ndarray, "m k"]:
    """Indices (m, k) of the k facets of each cell that are shared with another cell, -1 for facets on the boundary."""
    cell_pairs, _ = interior_facets(mesh)
    adjacent_cells, facet_indices = cell_pairs.T.ravel(), np.tile(np.arange(len(cell_pairs)), 2)
    sort_order = np.argsort(adjacent_cells, kind="stable")
    adjacent_cells, facet_indices = adjacent_cells[sort_order], facet_indices[sort_order]
    facets_of_cells = np.full((mesh.num_cells, mesh.dimension + 1), -1)
    facets_of_cells[
        adjacent_cells, np.arange(len(adjacent_cells)) - np.searchsorted(adjacent_cells, adjacent_cells)
    ] = facet_indices
    return facets_of_cells


def watershed_basins(
    change: Float[np.ndarray, " m"],
    shared: Int[np.ndarray, "m k"],
    *,
    min_value: float,
    least_prominence: float,
) -> Int[np.ndarray, " m"]:
    """Segment an image by a watershed from the peaks down. Returns, for every cell above `min_value`, the index of the
    cell at the peak of its basin, and -1 for cells below `min_value`.

    `change`: (m,) value of every cell; `shared`: (m, k) indices of the facets (`shared_facets`) or nodes that cells
    share, -1 for none. Where two basins meet, the basin with the lower peak is merged into the other basin, unless the
    lower peak exceeds the value at the meeting point by at least `least_prominence` times its own value.
    """
    peak_of_cell = np.full(len(change), -1)
    basin_of_index: dict[int, int] = {}
    merged_basins: dict[int, int] = {}

    def find_merged_basin(basin: int) -> int:
        while basin in merged_basins:
            basin = merged_basins[basin]
        return basin

    cells_above = np.flatnonzero(change > min_value)
    for cell in cells_above[np.argsort(-change[cells_above], kind="stable")].tolist():
        shared_indices = [shared_index for shared_index in shared[cell].tolist() if shared_index >= 0]
        adjacent_basins = {
            find_merged_basin(basin_of_index[shared_index])
            for shared_index in shared_indices
            if shared_index in basin_of_index
        }
        highest_basin = max(adjacent_basins, key=lambda basin: change[basin], default=cell)
        for basin in adjacent_basins - {highest_basin}:
            if change[basin] - change[cell] < least_prominence * change[basin]:
                merged_basins[basin] = highest_basin
        peak_of_cell[cell] = highest_basin
        basin_of_index.update(dict.fromkeys(shared_indices, highest_basin))
    peak_of_cell[cells_above] = [find_merged_basin(basin) for basin in peak_of_cell[cells_above].tolist()]
    return peak_of_cell


def segment(
    image: Float[np.ndarray, "rows columns"],
    *,
    level: float = 0.5,
    least_peak: float = 0.3,
    least_area: float = 0.004,
) -> UInt8[np.ndarray, "rows columns"]:
    """Segment an image into labels of the pixels: 0 background or outside the body, 1 resistive, 2 conductive.

    **Arguments:**

    - `image` (rows, columns): deviation from the background, negative where resistive, NaN outside the body. For
      absolute images give the logarithm of the conductivity divided by the background conductivity, which weights both
      signs equally.
    - `level`: value at the edge of a labelled region, as a share of the peak of the same sign (one half is the middle
      of a blurred edge).
    - `least_peak`: minimum height of the peak of a sign, as a share of the higher of the positive and the negative
      peak; a sign with a lower peak gets no label.
    - `least_area`: minimum area of a connected region, as a fraction of the body; smaller regions are artefacts.

    Raises `ValueError` for an image that is not two-dimensional, or has no pixel inside the body.

    **Example:**

    ```python
    labels = segment(raster.sample(image))
    ```
    """
    image_values = np.asarray(image)
    if image_values.ndim != 2 or np.iscomplexobj(image_values):
        raise ValueError(
            f"image must be real, (rows, columns); it has shape {image_values.shape} of {image_values.dtype}."
        )
    if not (0 < level < 1 and 0 <= least_peak <= 1 and 0 <= least_area < 1):
        raise ValueError(
            f"level, least_peak and least_area are shares, from 0 to 1: {level}, {least_peak}, {least_area}."
        )
    is_inside_body = np.isfinite(image_values)
    if not is_inside_body.any():
        raise ValueError("image: no pixel lies inside the body; all are NaN.")
    image_values = np.where(is_inside_body, image_values, 0)
    max_deviation = np.abs(image_values).max()
    pixel_labels = np.zeros(image_values.shape, np.uint8)
    for sign, sign_label in ((1, CONDUCTIVE), (-1, RESISTIVE)):
        sign_peak = (sign * image_values).max()
        if sign_peak <= 0 or sign_peak < least_peak * max_deviation:
            continue
        connected_regions = np.zeros(image_values.shape, np.int32)
        ndimage.label(sign * image_values > level * sign_peak, output=connected_regions)
        region_sizes = np.bincount(connected_regions.ravel())
        region_sizes[0] = 0
        pixel_labels[region_sizes[connected_regions] >= max(1, least_area * is_inside_body.sum())] = sign_label
    return pixel_labels
