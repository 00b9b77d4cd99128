"""Numbers beside electrodes: outside the outline where there is room, so that neither metal nor image is covered."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from jeit.mesh import Mesh
from jeit.plot.axes import INK

# Over the size of the body: how far a number stands from its electrode, and how near the edge one lies that is on it.
_AWAY, _ON_EDGE = 0.058, 0.02
# Over that distance: how far numbers stand that begin there, in place of having their middle there.
_CLOSER = 0.7
# Free outside the outline, over that distance, or else the number stands inside.
_ROOM = 1.6


def draw_numbers(
    ax: Axes, mesh: Mesh, places: Float[np.ndarray, "L 2"], beside: Bool[np.ndarray, " L"], first: int
) -> None:
    """Number electrodes at `places`, counted from `first`: on them, or where that would hide them `beside` them.

    Beside one on the edge of a sheet is outward along the normal, or inward where a notch is too narrow; beside one
    inside it is above; and beside one of a solid, seen from above, away from the middle. Electrodes above each other
    share a place for their numbers.
    """
    corners = np.asarray(mesh.points)[:, :2]
    away = _AWAY * np.ptp(corners, axis=0).max()
    if mesh.dimension == 2:
        shift, inside = _off_the_edge(mesh, places, away)
    else:
        shift, inside = _off_the_middle(corners, places, away), np.zeros(len(places), bool)
    shift[~beside] = 0
    fontsize = 9 if len(places) <= 20 else 7
    rim = [withStroke(linewidth=2, foreground="white")]
    for one in at_one_place(places, 0.1 * away):
        k = one[0]
        effects = rim if inside[k] or not beside[k] else None  # the image lies behind
        style = {"ha": "center", "va": "center", "fontsize": fontsize, "color": INK, "zorder": 4}
        told = ", ".join(str(k + first) for k in one)
        if len(one) > 1:
            style["ha"] = _beside(shift[k])
        x, y = places[k] + (1.0 if style["ha"] == "center" else _CLOSER) * shift[k]
        ax.text(x, y, told, path_effects=effects, **style)


def _beside(shift: Float[np.ndarray, " 2"]) -> str:
    """How several numbers, which are wide, are aligned that far from their electrode: off it, not across it."""
    if abs(shift[0]) < 0.8 * abs(shift[1]):
        return "center"
    return "left" if shift[0] > 0 else "right"


def at_one_place(places: Float[np.ndarray, "L 2"], near: float) -> list[list[int]]:
    """Electrodes within `near` of each other, as rings round a tank have them, seen from above: together."""
    together: list[list[int]] = []
    for k, place in enumerate(places):
        for one in together:
            if np.linalg.norm(places[one[0]] - place) < near:
                one.append(k)
                break
        else:
            together.append([k])
    return together


def _off_the_edge(mesh: Mesh, places, away: float) -> tuple[Float[np.ndarray, "L 2"], Bool[np.ndarray, " L"]]:
    """Shifts of numbers (L, 2) on a sheet, and whether they end inside it."""
    start, end = np.asarray(mesh.points)[np.asarray(mesh.facets)].swapaxes(0, 1)
    shift, inside = np.tile([0.0, 0.7 * away], (len(places), 1)), np.ones(len(places), bool)
    for k, place in enumerate(places):
        distance = _distances(place, start, end)
        if distance.min() > _ON_EDGE / _AWAY * away:
            continue
        # At a corner two edges are nearest: the number stands along the bisector.
        nearest = distance <= distance.min() + 1e-6 * away
        outward = _normals(start[nearest], end[nearest]).sum(axis=0)
        outward /= max(np.linalg.norm(outward), 1e-12)
        inside[k] = _free(place, outward, start, end, 0.01 * away) < _ROOM * away
        shift[k] = (-away if inside[k] else away) * outward
    return shift, inside


def _off_the_middle(corners, places, away: float) -> Float[np.ndarray, "L 2"]:
    """Shifts of numbers (L, 2) away from the middle of a body, none for those near it."""
    offset = places - (corners.min(axis=0) + corners.max(axis=0)) / 2
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    reach = distance > 0.3 * np.ptp(corners, axis=0).max()
    return np.where(reach, away * offset / np.maximum(distance, 1e-12), 0)


def _normals(start, end) -> Float[np.ndarray, "b 2"]:
    """Outward unit normals of edges with the body on their left."""
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    return np.stack([along[:, 1], -along[:, 0]], axis=1)


def _distances(place, start, end) -> Float[np.ndarray, " b"]:
    """Of a place from every edge."""
    along = end - start
    fraction = np.clip(np.sum((place - start) * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
    return np.linalg.norm(start + fraction[:, None] * along - place, axis=1)


def _free(place, direction, start, end, least: float) -> float:
    """How far it is from a place, in a unit direction, to the next edge farther off than `least`."""
    along, offset = end - start, start - place
    across = direction[0] * along[:, 1] - direction[1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # edges along the direction are not met
        far = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / across
        where = (offset[:, 0] * direction[1] - offset[:, 1] * direction[0]) / across
    return float(np.min(far[(far > least) & (where >= 0) & (where <= 1)], initial=np.inf))
