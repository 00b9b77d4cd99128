"""Images cut into regions: by thresholds, and by watersheds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike
from scipy import ndimage

from jeit.arguments import describe, is_number
from jeit.image.merit import CONDUCTIVE, RESISTIVE
from jeit.mesh import Mesh, centroids, measures
from jeit.mesh.geometry import interior_facets


def ball_region(mesh: Mesh, centre: ArrayLike, radius: float) -> Bool[np.ndarray, " m"]:
    """(m,) True for cells whose centroid lies within `radius` metres of `centre` (d,); in a sheet a disk.

    Raises `ValueError` for a centre of other coordinates, a radius that is not positive, and where no cell is left.
    """
    if not (is_number(radius) and radius > 0):
        raise ValueError(f"radius must be a positive number of metres; it is {describe(radius)}.")
    distance = np.linalg.norm(_from(mesh, centre, "centre"), axis=1)
    return _some(mesh, distance <= radius, "no centroid of a cell is so near to centre; make radius larger")


def box_region(mesh: Mesh, lower: ArrayLike, upper: ArrayLike) -> Bool[np.ndarray, " m"]:
    """(m,) True for cells whose centroid lies between the corners `lower` and `upper` (d,), metres.

    Raises `ValueError` for corners of other coordinates or the wrong way round, and where no cell is left.
    """
    above, below = _from(mesh, lower, "lower"), _from(mesh, upper, "upper")
    if not (np.asarray(lower, float) < np.asarray(upper, float)).all():
        raise ValueError("upper must be larger than lower in every coordinate.")
    between = (above >= 0).all(axis=1) & (below <= 0).all(axis=1)
    return _some(mesh, between, "no centroid of a cell lies between lower and upper")


def half_region(mesh: Mesh, direction: ArrayLike, point: ArrayLike | None = None) -> Bool[np.ndarray, " m"]:
    """(m,) True for cells whose centroid lies from `point` (d,) metres in `direction` (d,): the right half for (1, 0).

    `point`: the body's own middle unless given. Raises `ValueError` for a direction of length zero, and where no cell
    is left.
    """
    towards = np.asarray(direction, float)
    if towards.shape != (mesh.dimension,) or not np.isfinite(towards).all() or not towards.any():
        raise ValueError(f"direction must be {mesh.dimension} finite numbers, not all zero; it is {direction!r}.")
    size = np.asarray(measures(mesh))
    middle = size @ np.asarray(centroids(mesh)) / size.sum() if point is None else point
    return _some(mesh, _from(mesh, middle, "point") @ towards > 0, "no cell lies in direction of point")


def _from(mesh: Mesh, place: ArrayLike, name: str) -> Float[np.ndarray, "m d"]:
    """Centroids, seen from a place."""
    given = np.asarray(place, float)
    if given.shape != (mesh.dimension,) or not np.isfinite(given).all():
        raise ValueError(f"{name} must be {mesh.dimension} finite numbers in metres; it has shape {given.shape}.")
    return np.asarray(centroids(mesh)) - given


def _some(mesh: Mesh, chosen, nothing: str) -> Bool[np.ndarray, " m"]:
    if not chosen.any():
        points = np.asarray(mesh.points)
        low, high = (", ".join(f"{x:.2g}" for x in one) for one in (points.min(axis=0), points.max(axis=0)))
        raise ValueError(f"the region is empty: {nothing}. The body spans [{low}] to [{high}], metres.")
    return np.asarray(chosen)


def shared_facets(mesh: Mesh) -> Int[np.ndarray, "m k"]:
    """Numbers of the facets that each cell shares with another, -1 for those on the boundary; once per mesh."""
    pairs, _ = interior_facets(mesh)
    cell, facet = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.argsort(cell, kind="stable")
    cell, facet = cell[order], facet[order]
    shared = np.full((mesh.num_cells, mesh.dimension + 1), -1)
    shared[cell, np.arange(len(cell)) - np.searchsorted(cell, cell)] = facet
    return shared


def basins(
    change: Float[np.ndarray, " m"],
    shared: Int[np.ndarray, "m k"],
    *,
    floor: float,
    least_prominence: float,
) -> Int[np.ndarray, " m"]:
    """The peak (a cell's index) that every cell above `floor` belongs to, -1 below: a watershed from the top down.

    `change` (m,) of every cell, and numbers of what it shares with others, its facets (`shared_facets`) or nodes, -1
    for none. Where two basins meet, the lower one is swallowed unless its peak stands out from the meeting point, by
    `least_prominence` times its height.
    """
    peak = np.full(len(change), -1)
    reached: dict[int, int] = {}
    swallowed: dict[int, int] = {}

    def root(label: int) -> int:
        while label in swallowed:
            label = swallowed[label]
        return label

    cells = np.flatnonzero(change > floor)
    for cell in cells[np.argsort(-change[cells], kind="stable")].tolist():
        places = [place for place in shared[cell].tolist() if place >= 0]
        labels = {root(reached[place]) for place in places if place in reached}
        highest = max(labels, key=lambda label: change[label], default=cell)
        for label in labels - {highest}:
            if change[label] - change[cell] < least_prominence * change[label]:
                swallowed[label] = highest
        peak[cell] = highest
        reached.update(dict.fromkeys(places, highest))
    peak[cells] = [root(label) for label in peak[cells].tolist()]
    return peak


def segment(
    image: Float[np.ndarray, "rows columns"],
    *,
    level: float = 0.5,
    least_peak: float = 0.3,
    least_area: float = 0.004,
) -> UInt8[np.ndarray, "rows columns"]:
    """Labels of the pixels: 0 background, 1 resistive, 2 conductive; 0 outside the body.

    `image` (rows, columns): departure from the background, negative where resistive, NaN outside the body; for absolute
    images the logarithm of conductivity over background, which weighs both signs alike. Either sign is kept if its peak
    is at least `least_peak` times the strongest of both, and covers what exceeds `level` times its own peak: where that
    is half, the middle of a blurred edge. Islands of less than `least_area` of the body are artefacts. Raises
    `ValueError` for an image that is not two-dimensional, or has no pixel inside the body.
    """
    values = np.asarray(image)
    if values.ndim != 2 or np.iscomplexobj(values):
        raise ValueError(f"image must be real, (rows, columns); it has shape {values.shape} of {values.dtype}.")
    if not (0 < level < 1 and 0 <= least_peak <= 1 and 0 <= least_area < 1):
        raise ValueError(
            f"level, least_peak and least_area are shares, from 0 to 1: {level}, {least_peak}, {least_area}."
        )
    inside = np.isfinite(values)
    if not inside.any():
        raise ValueError("image: no pixel lies inside the body; all are NaN.")
    values = np.where(inside, values, 0)
    strongest = np.abs(values).max()
    labels = np.zeros(values.shape, np.uint8)
    for sign, label in ((1, CONDUCTIVE), (-1, RESISTIVE)):
        peak = (sign * values).max()
        if peak <= 0 or peak < least_peak * strongest:
            continue
        islands = np.zeros(values.shape, np.int32)
        ndimage.label(sign * values > level * peak, output=islands)
        size = np.bincount(islands.ravel())
        size[0] = 0
        labels[size[islands] >= max(1, least_area * inside.sum())] = label
    return labels
