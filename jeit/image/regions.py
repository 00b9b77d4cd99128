"""Regions of interest: which cells of a mesh lie in a ball, a box, or on one side of a plane."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import is_number, told
from jeit.mesh import Mesh, centroids, measures


def ball_region(mesh: Mesh, centre: ArrayLike, radius: float) -> Bool[np.ndarray, " m"]:
    """(m,) True for cells whose centroid lies within `radius` metres of `centre` (d,); in a sheet a disk.

    Raises `ValueError` for a centre of other coordinates, a radius that is not positive, and where no cell is left.
    """
    if not (is_number(radius) and radius > 0):
        raise ValueError(f"radius must be a positive number of metres; it is {told(radius)}.")
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
