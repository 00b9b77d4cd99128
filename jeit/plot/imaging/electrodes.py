"""Electrodes, drawn where they are and as wide as they are, with their numbers."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.patches import Circle, Rectangle

from jeit.electrodes import (
    AbstractElectrodes,
    BoundaryElectrodes,
    CombinedElectrodes,
    FaceDiscs,
    FacePatches,
    FacetElectrodes,
    NodeElectrodes,
    PointElectrodes,
    SheetDiscs,
)
from jeit.mesh import Mesh
from jeit.plot.axes import INK, axes_or_new

METAL = "#b8860b"


def draw_electrodes(
    mesh: Mesh, electrodes: AbstractElectrodes, *, numbers: bool = True, ax: Axes | None = None, first: int = 1
) -> Axes:
    """Draw `electrodes` seen from above, and their numbers, counted from `first`, beside them.

    Arcs are drawn along the boundary of `mesh`, discs and patches at their size, points as dots. Numbers stand outside
    the outline for electrodes on the edge of a 2-D mesh, on the electrode elsewhere.
    """
    ax = axes_or_new(ax)
    if isinstance(electrodes, CombinedElectrodes):
        for part in electrodes.parts:
            draw_electrodes(mesh, part, numbers=numbers, ax=ax, first=first)
            first += part.num_electrodes
        return ax
    points = np.asarray(mesh.points)
    place = _places(mesh, electrodes)
    if isinstance(electrodes, BoundaryElectrodes):
        arcs = [
            _along_boundary(mesh, centre, width)
            for centre, width in zip(place, np.asarray(electrodes.width), strict=True)
        ]
        ax.add_collection(LineCollection(arcs, colors=METAL, linewidths=5, capstyle="butt", zorder=3))
    elif isinstance(electrodes, FacetElectrodes) and mesh.dimension == 2:
        facets = np.asarray(mesh.facets)[np.asarray(electrodes.covers).any(axis=1)]
        ax.add_collection(LineCollection(list(points[facets]), colors=METAL, linewidths=5, zorder=3))
    elif isinstance(electrodes, (SheetDiscs, FaceDiscs)):
        discs = [Circle((x, y), r) for (x, y, *_), r in zip(place, np.asarray(electrodes.radius), strict=True)]
        ax.add_collection(PatchCollection(discs, facecolor="none", edgecolor=METAL, linewidth=1.6, zorder=3))
    elif isinstance(electrodes, FacePatches) and np.ptp(place[:, 2]) < 1e-9:
        size = zip(place, np.asarray(electrodes.width), np.asarray(electrodes.height), strict=True)
        patches = [Rectangle((x - w / 2, y - h / 2), w, h) for (x, y, _), w, h in size]
        ax.add_collection(PatchCollection(patches, facecolor="none", edgecolor=METAL, linewidth=1.6, zorder=3))
    else:
        ax.scatter(place[:, 0], place[:, 1], s=28, color=METAL, zorder=3)
    if numbers:
        _draw_numbers(ax, mesh, place, outside=not isinstance(electrodes, (SheetDiscs, FaceDiscs)), first=first)
    return ax


def _places(mesh: Mesh, electrodes: AbstractElectrodes) -> np.ndarray:
    """Centre (L, d) of every electrode."""
    points = np.asarray(mesh.points)
    if isinstance(electrodes, NodeElectrodes):
        return points[np.asarray(electrodes.nodes)]
    if isinstance(electrodes, FacetElectrodes):
        middle = points[np.asarray(mesh.facets)].mean(axis=1)
        covers = np.asarray(electrodes.covers)
        return covers.T @ middle / covers.sum(axis=0)[:, None]
    if isinstance(electrodes, (BoundaryElectrodes, SheetDiscs, FaceDiscs, FacePatches, PointElectrodes)):
        return np.asarray(electrodes.position)
    raise ValueError(f"draw_electrodes does not know how to draw {type(electrodes).__name__}.")


def _along_boundary(mesh: Mesh, centre: np.ndarray, width: float) -> np.ndarray:
    """Points (k, 2) of the piece of outline of length `width` in metres round the point nearest to `centre`."""
    points, facets = np.asarray(mesh.points), np.asarray(mesh.facets)
    ends = points[facets]
    along = ends[:, 1] - ends[:, 0]
    squared = np.sum(along**2, axis=1)
    fraction = np.clip(np.sum((centre - ends[:, 0]) * along, axis=1) / squared, 0, 1)
    nearest = np.argmin(np.sum((ends[:, 0] + fraction[:, None] * along - centre) ** 2, axis=1))
    # The loop that holds this edge, unrolled into vertices by arc length from its beginning.
    loop = np.cumsum(np.concatenate([[0], facets[1:, 0] != facets[:-1, 1]]))
    edges = np.flatnonzero(loop == loop[nearest])
    length = np.sqrt(squared[edges])
    arc = np.concatenate([[0], np.cumsum(length)])
    middle = arc[nearest - edges[0]] + fraction[nearest] * np.sqrt(squared[nearest])
    vertices = np.concatenate([ends[edges, 0], ends[edges[-1:], 1]])
    stops = np.concatenate([arc - arc[-1], arc, arc + arc[-1]])
    inside = stops[(stops > middle - width / 2) & (stops < middle + width / 2)]
    where = np.mod(np.concatenate([[middle - width / 2], inside, [middle + width / 2]]), arc[-1])
    return np.stack([np.interp(where, arc, vertices[:, axis]) for axis in range(2)], axis=1)


def _draw_numbers(ax: Axes, mesh: Mesh, place: np.ndarray, *, outside: bool, first: int) -> None:
    corners = np.asarray(mesh.points)[:, :2]
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    size = np.ptp(corners, axis=0).max()
    plane = place[:, :2]
    offset = plane - middle
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    reach = distance > 0.3 * size
    shift = np.where(reach & outside, 0.058 * size * offset / np.maximum(distance, 1e-12), 0)
    fontsize = 9 if len(place) <= 20 else 7
    for k, (x, y) in enumerate(plane + shift):
        ax.text(x, y, str(k + first), ha="center", va="center", fontsize=fontsize, color=INK, zorder=4)
