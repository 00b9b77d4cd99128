"""Pressure on the cells of a mesh, at a few samples of each, which a load is balanced on."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.design.skin.touched_cells import padded
from jeit.mesh import Mesh, measures
from jeit.simulate.contact.press import Press
from jeit.simulate.contact.pressure import AbstractSupport

# Of a cell: barycentric coordinates are multiples of 1 / (_LATTICE + 1), moved inwards by the same for all.
_LATTICE = 2
# Presses whose pressures are worked out at once: so much memory is in the cache.
_AT_ONCE = 16
# How much farther a contact reaches that has about half its area on the skin; Winkler's ball: 2^(1/4).
_MARGIN = 1.25


class Samples(NamedTuple):
    """Places (m, s, 2) in the plane on m cells of a skin, metres; the `area` (m,) that each of a cell's stands for, m²;
    and the radius of the largest cell, metres."""

    points: Float[np.ndarray, "m s 2"]
    area: Float[np.ndarray, " m"]
    radius: float

    @classmethod
    def of(cls, mesh: Mesh) -> "Samples":
        """Of a sheet, or of a layer, whose cells are all pressed as the skin above them is."""
        corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        dimension = mesh.dimension
        steps = [each for each in itertools.product(range(_LATTICE + 1), repeat=dimension + 1) if sum(each) == _LATTICE]
        weights = (np.array(steps) + 1 / (dimension + 1)) / (_LATTICE + 1)
        points = np.einsum("sk,mkd->msd", weights, corners[..., :2])
        thickness = np.ptp(corners[..., 2]) if dimension == 3 else 1.0
        area = np.asarray(measures(mesh)) / thickness / len(steps)
        radius = np.linalg.norm(corners[..., :2] - corners[..., :2].mean(axis=1, keepdims=True), axis=-1).max()
        return cls(points, area, float(radius))


class PressedCells(NamedTuple):
    """`cells` (n, c) under n touches, and the `pressure` (n, c, s) at their samples, pascals; 0 where a touch has
    fewer."""

    cells: Int[np.ndarray, "n c"]
    pressure: Float[np.ndarray, "n c s"]


def pressed_cells(samples: Samples, support: AbstractSupport, touches: Sequence[tuple[Press, ...]]) -> PressedCells:
    """Cells under touches, each of one press or several; what several press, the sum of their pressures does.

    What of an indenter is over the edge of the skin carries nothing. Raises `ValueError` for presses off the skin, and
    as the support does.
    """
    presses = [press for touch in touches for press in touch]
    if not presses:
        return PressedCells(np.zeros((len(touches), 1), int), np.zeros((len(touches), 1, samples.points.shape[1])))
    found = _of_each(samples, support, presses)
    if all(len(touch) == 1 for touch in touches):
        return found
    rows, pressures, first = [], [], 0
    for touch in touches:
        own = slice(first, first + len(touch))
        first += len(touch)
        there = found.pressure[own].any(axis=-1)
        cells, place = np.unique(found.cells[own][there], return_inverse=True)
        total = np.zeros((len(cells), found.pressure.shape[-1]))
        np.add.at(total, place, found.pressure[own][there])
        rows.append(cells)
        pressures.append(total)
    return _joined(rows, pressures)


def _of_each(samples: Samples, support: AbstractSupport, presses: Sequence[Press]) -> PressedCells:
    position = np.array([press.position for press in presses])
    shapes = _shapes(presses)
    reach = _reaches(support, presses, shapes) + samples.radius
    near = KDTree(samples.points.mean(axis=1)).query_ball_point(position, reach, return_sorted=True)
    number = np.array([len(cells) for cells in near])
    empty = np.flatnonzero(number == 0)
    if empty.size:
        x, y = 1e3 * position[empty[0]]
        raise ValueError(
            f"position: {empty.size} of {len(presses)} presses lie off the skin, the first at ({x:.4g}, {y:.4g}) mm; "
            "places are in metres."
        )
    rows: list = [None] * len(presses)
    pressures: list = [None] * len(presses)
    for shape in np.unique(shapes):
        same = np.flatnonzero(shapes == shape)
        same = same[np.argsort(number[same], kind="stable")]
        for some in np.split(same, range(_AT_ONCE, len(same), _AT_ONCE)):
            cells, there = padded([np.asarray(near[one], int) for one in some])
            pressure = _alike(samples, support, [presses[one] for one in some], cells, there)
            for one, own, pressed in zip(some, cells, pressure, strict=True):
                kept = pressed.any(axis=-1)
                rows[one], pressures[one] = own[kept], pressed[kept]
    return _joined(rows, pressures)


def _shapes(presses: Sequence[Press]) -> Int[np.ndarray, " n"]:
    """A number for each indenter, the same for those that are equal."""
    numbers: dict = {}
    known: dict[int, int] = {}
    for press in presses:
        if id(press.indenter) not in known:
            leaves, structure = jax.tree.flatten(press.indenter)
            values = tuple((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)
            known[id(press.indenter)] = numbers.setdefault((structure, values), len(numbers))
    return np.array([known[id(press.indenter)] for press in presses])


def _reaches(support: AbstractSupport, presses: Sequence[Press], shapes) -> Float[np.ndarray, " n"]:
    """How far from its origin each press is felt, at most, metres: as far as with up to twice its load, and some more
    where the skin's edge leaves it less area."""
    known: dict[tuple[int, int], float] = {}
    doublings = np.ceil(np.log2([press.load for press in presses]))
    for press, *case in zip(presses, shapes, doublings, strict=True):
        if tuple(case) not in known:
            try:
                felt = _MARGIN * support.pressure(press.indenter, 2.0 ** case[1]).reach
            except ValueError:  # more than it can carry: that of this press may not be
                felt = press.indenter.reach
            known[tuple(case)] = min(felt, press.indenter.reach)
    return np.array([known[case] for case in zip(shapes, doublings, strict=True)])


def _alike(samples: Samples, support: AbstractSupport, presses: Sequence[Press], cells, there):
    """Pressures (b, c, s) of presses with one and the same indenter at the samples of `cells` (b, c)."""
    points = samples.points[cells]
    shape = points.shape[:-1]
    area = np.broadcast_to((samples.area[cells] * there)[..., None], shape).reshape(len(cells), -1)
    local = _in_frame(presses, points.reshape(len(cells), -1, 2))
    load = np.array([press.load for press in presses])
    pressure = support.spread(presses[0].indenter, load, local, area) * (area > 0)
    lost = np.flatnonzero(~pressure.any(axis=1))
    if lost.size:  # between the samples: all of it on the nearest
        distance = np.where(area > 0, np.linalg.norm(local, axis=-1), np.inf)[lost]
        nearest = distance.argmin(axis=1)
        pressure[lost, nearest] = load[lost] / area[lost, nearest]
    return pressure.reshape(shape)


def _in_frame(presses: Sequence[Press], points: Float[np.ndarray, "b q 2"]) -> Float[np.ndarray, "b q 2"]:
    """Points in the frames of the presses' indenters."""
    cos, sin = (function([press.angle for press in presses])[:, None] for function in (np.cos, np.sin))
    x, y = np.moveaxis(points - np.array([press.position for press in presses])[:, None], -1, 0)
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _joined(rows: list, pressures: list) -> PressedCells:
    cells, there = padded(rows)
    pressure = np.zeros((*cells.shape, pressures[0].shape[-1]))
    pressure[there] = np.concatenate(pressures)
    return PressedCells(cells, pressure)
