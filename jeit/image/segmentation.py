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
    distance = np.linalg.norm(_offsets_from_point(mesh, centre, "centre"), axis=1)
    return _check_not_empty(mesh, distance <= radius, "no centroid of a cell is so near to centre; make radius larger")


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
    return _check_not_empty(mesh, is_inside_box, "no centroid of a cell lies between lower and upper")


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
    normal = np.asarray(direction, float)
    if normal.shape != (mesh.dimension,) or not np.isfinite(normal).all() or not normal.any():
        raise ValueError(f"direction must be {mesh.dimension} finite numbers, not all zero; it is {direction!r}.")
    cell_sizes = np.asarray(measures(mesh))
    origin = cell_sizes @ np.asarray(centroids(mesh)) / cell_sizes.sum() if point is None else point
    return _check_not_empty(
        mesh, _offsets_from_point(mesh, origin, "point") @ normal > 0, "no cell lies in direction of point"
    )


def _offsets_from_point(mesh: Mesh, point: ArrayLike, name: str) -> Float[np.ndarray, "m d"]:
    """Vectors (m, d) from a `point` to the centroids of the cells. Raises `ValueError` for a point with the wrong
    number of coordinates."""
    coordinates = np.asarray(point, float)
    if coordinates.shape != (mesh.dimension,) or not np.isfinite(coordinates).all():
        raise ValueError(f"{name} must be {mesh.dimension} finite numbers in metres; it has shape {coordinates.shape}.")
    return np.asarray(centroids(mesh)) - coordinates


def _check_not_empty(mesh: Mesh, region, message: str) -> Bool[np.ndarray, " m"]:
    if not region.any():
        points = np.asarray(mesh.points)
        lower_text, upper_text = (
            ", ".join(f"{coordinate:.2g}" for coordinate in corner)
            for corner in (points.min(axis=0), points.max(axis=0))
        )
        raise ValueError(f"the region is empty: {message}. The body spans [{lower_text}] to [{upper_text}], metres.")
    return np.asarray(region)


def shared_facets(mesh: Mesh) -> Int[np.ndarray, "m k"]:
    """Indices (m, k) of the k facets of each cell that are shared with another cell, -1 for facets on the boundary."""
    pairs, _ = interior_facets(mesh)
    cell, facet = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    sort_order = np.argsort(cell, kind="stable")
    cell, facet = cell[sort_order], facet[sort_order]
    shared = np.full((mesh.num_cells, mesh.dimension + 1), -1)
    shared[cell, np.arange(len(cell)) - np.searchsorted(cell, cell)] = facet
    return shared


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
    peak = np.full(len(change), -1)
    label_of_place: dict[int, int] = {}
    merged_labels: dict[int, int] = {}

    def find_root(label: int) -> int:
        while label in merged_labels:
            label = merged_labels[label]
        return label

    cells = np.flatnonzero(change > min_value)
    for cell in cells[np.argsort(-change[cells], kind="stable")].tolist():
        neighbours = [neighbour for neighbour in shared[cell].tolist() if neighbour >= 0]
        labels = {find_root(label_of_place[neighbour]) for neighbour in neighbours if neighbour in label_of_place}
        highest = max(labels, key=lambda label: change[label], default=cell)
        for label in labels - {highest}:
            if change[label] - change[cell] < least_prominence * change[label]:
                merged_labels[label] = highest
        peak[cell] = highest
        label_of_place.update(dict.fromkeys(neighbours, highest))
    peak[cells] = [find_root(label) for label in peak[cells].tolist()]
    return peak


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
    values = np.asarray(image)
    if values.ndim != 2 or np.iscomplexobj(values):
        raise ValueError(f"image must be real, (rows, columns); it has shape {values.shape} of {values.dtype}.")
    if not (0 < level < 1 and 0 <= least_peak <= 1 and 0 <= least_area < 1):
        raise ValueError(
            f"level, least_peak and least_area are shares, from 0 to 1: {level}, {least_peak}, {least_area}."
        )
    is_inside = np.isfinite(values)
    if not is_inside.any():
        raise ValueError("image: no pixel lies inside the body; all are NaN.")
    values = np.where(is_inside, values, 0)
    max_value = np.abs(values).max()
    labels = np.zeros(values.shape, np.uint8)
    for sign, label in ((1, CONDUCTIVE), (-1, RESISTIVE)):
        peak = (sign * values).max()
        if peak <= 0 or peak < least_peak * max_value:
            continue
        connected_regions = np.zeros(values.shape, np.int32)
        ndimage.label(sign * values > level * peak, output=connected_regions)
        region_sizes = np.bincount(connected_regions.ravel())
        region_sizes[0] = 0
        labels[region_sizes[connected_regions] >= max(1, least_area * is_inside.sum())] = label
    return labels
