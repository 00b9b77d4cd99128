"""Pressure of indenters on the cells of a mesh, at several sample points per cell, in equilibrium with the load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.design.skin.reached_cells import millimetre_text
from jeit.design.skin.touched_cells import pad_rows
from jeit.touch.simulate.contact.indenters import DiscIndenter
from jeit.touch.simulate.contact.press import AbstractSupport, Press
from jeit.touch.simulate.contact.samples import Samples

# Lattice for contacts on few samples; number of samples below which it is used; width that it resolves, as a share of
# the radius of a cell.
_FINE_LATTICE, _FEW, _RESOLVED_WIDTH = 11, 6, 1 / 6
# Number of presses computed at once, so that the arrays fit in the cache.
_AT_ONCE = 16
# Factor of the reach of a contact with about half its area on the skin; 2^(1/4) for a ball on a Winkler foundation.
_MARGIN = 1.25
# Share of skin in the area within reach of a press, below which its pressure may extend farther.
_ON_SKIN = 0.6


class PressedCells(NamedTuple):
    """Cells under touches, and the pressure on them.

    **Fields**: `cells`: (n, c), numbers of the cells under n touches; `pressure`: (n, c, s), pressure at the samples
    of each cell, pascals. Rows of touches with fewer cells are padded with zeros."""

    cells: Int[np.ndarray, "n c"]
    pressure: Float[np.ndarray, "n c s"]


def pressed_cells(
    samples: Samples,
    support: AbstractSupport,
    touches: Sequence[tuple[Press, ...]],
    progress: Callable[[str], None] | None = None,
) -> PressedCells:
    """Compute the cells under touches and their pressure; the pressures of all presses of a touch are added.

    Parts of an indenter beyond the edge of the skin carry no load. `progress` is called with the number of presses
    done. Raises `ValueError` for presses off the skin, and as the support.
    """
    presses = [press for touch in touches for press in touch]
    if not presses:
        return PressedCells(np.zeros((len(touches), 1), int), np.zeros((len(touches), 1, samples.points.shape[1])))
    found = _pressed_cells(samples, support, presses, progress)
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
    return _pad_and_stack(rows, pressures)


def _pressed_cells(
    samples: Samples, support: AbstractSupport, presses: Sequence[Press], progress: Callable[[str], None] | None
) -> PressedCells:
    samples.check(presses)
    position = np.array([press.position for press in presses])
    shapes = _indenter_numbers(presses)
    farthest = samples.chord * np.array([press.indenter.reach for press in presses])
    # The extent of the pressure on a flat skin is no upper bound for that on a concave skin.
    reaches = farthest if samples.curved is not None else _reach_bounds(support, presses, shapes)
    extent = np.minimum(reaches, farthest) + samples.radius
    tree = KDTree(samples.points.mean(axis=1))
    near = tree.query_ball_point(position, extent, return_sorted=True)
    on_skin = samples.points.shape[1] * np.array([samples.area[cells].sum() for cells in near])
    beyond = np.flatnonzero(on_skin < _ON_SKIN * np.pi * extent**2)
    near[beyond] = tree.query_ball_point(position[beyond], farthest[beyond] + samples.radius, return_sorted=True)
    near = samples.facing_cells(presses, near)
    number = np.array([len(cells) for cells in near])
    empty = np.flatnonzero(number == 0)
    if empty.size:
        raise ValueError(
            f"position: {empty.size} of {len(presses)} presses lie off the skin, the first at "
            f"{millimetre_text(position[empty[0]])} mm; places are in metres."
        )
    rows: list = [None] * len(presses)
    pressures: list = [None] * len(presses)
    done = 0
    for shape in np.unique(shapes):
        same = np.flatnonzero(shapes == shape)
        same = same[np.argsort(number[same], kind="stable")]
        for some in np.split(same, range(_AT_ONCE, len(same), _AT_ONCE)):
            cells, there = pad_rows([np.asarray(near[one], int) for one in some])
            pressure = _pressures_of_equal_indenters(samples, support, [presses[one] for one in some], cells, there)
            for one, own, pressed in zip(some, cells, pressure, strict=True):
                kept = pressed.any(axis=-1)
                rows[one], pressures[one] = own[kept], pressed[kept]
            done += len(some)
            if progress is not None:
                progress(f"pressure: {done} of {len(presses)}")
    return _pad_and_stack(rows, pressures)


def _indenter_numbers(presses: Sequence[Press]) -> Int[np.ndarray, " n"]:
    """Numbers of the indenters of presses; equal indenters have the same number."""
    numbers: dict = {}
    known: dict[int, int] = {}
    for press in presses:
        if id(press.indenter) not in known:
            leaves, structure = jax.tree.flatten(press.indenter)
            values = tuple((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)
            known[id(press.indenter)] = numbers.setdefault((structure, values), len(numbers))
    return np.array([known[id(press.indenter)] for press in presses])


def _reach_bounds(support: AbstractSupport, presses: Sequence[Press], shapes) -> Float[np.ndarray, " n"]:
    """Upper bound of the distance from the origin at which each press exerts pressure, metres.

    The bound is the reach for the load rounded up to a power of two, times `_MARGIN` for presses at the edge of the
    skin.
    """
    known: dict[tuple[int, int], float] = {}
    doublings = np.ceil(np.log2([press.load for press in presses]))
    for press, *case in zip(presses, shapes, doublings, strict=True):
        if tuple(case) not in known:
            try:
                extent = _MARGIN * support.pressure(press.indenter, 2.0 ** case[1]).reach
            except ValueError:  # the rounded load exceeds the limit of the support; the load of the press may not
                extent = press.indenter.reach
            known[tuple(case)] = min(extent, press.indenter.reach)
    return np.array([known[case] for case in zip(shapes, doublings, strict=True)])


def _pressures_of_equal_indenters(samples: Samples, support: AbstractSupport, presses: Sequence[Press], cells, is_cell):
    """Pressures (b, c, s) of presses with the same indenter at the samples of `cells` (b, c)."""
    points = samples.points[cells]
    shape = points.shape[:-1]
    local, fall, share = samples.to_indenter_frames(presses, cells, points.reshape(len(cells), -1, points.shape[-1]))
    area = np.broadcast_to((share * samples.area[cells] * is_cell)[..., None], shape).reshape(len(cells), -1)
    load = np.array([press.load for press in presses])
    pressure = support.spread(presses[0].indenter, load, local, area, _height_below_plane(samples, fall)) * (area > 0)
    pressure = pressure.reshape(shape)
    for one in np.flatnonzero(np.count_nonzero(pressure, axis=(1, 2)) < _FEW).tolist():
        pressure[one] = _pressures_on_finer_lattice(samples, support, presses[one], cells[one], is_cell[one])
    return pressure


def _pressures_on_finer_lattice(samples: Samples, support: AbstractSupport, press: Press, cells, is_cell):
    """Pressures (c, s) of a press on few samples: the mean over a finer lattice in each of the `cells` (c,).

    If the press touches no point of the finer lattice either, the nearest sample carries the load. Raises `ValueError`
    for a press that touches no skin.
    """
    points = samples.lattice_points(cells, _FINE_LATTICE)
    fine, coarse = points.shape[1], samples.points.shape[1]
    local, fall, share = samples.to_indenter_frames([press], cells[None], points.reshape(1, -1, points.shape[-1]))
    area = np.repeat(share[0] * samples.area[cells] * is_cell * coarse / fine, fine)[None]
    load = np.array([press.load])
    pressure = support.spread(press.indenter, load, local, area, _height_below_plane(samples, fall)) * (area > 0)
    if pressure.any():
        return np.repeat(pressure.reshape(-1, fine).mean(axis=1, keepdims=True), coarse, axis=1)
    pressure = np.zeros((len(cells), coarse))
    distance = np.linalg.norm(local.reshape(-1, fine, 2), axis=-1).min(axis=1)
    cell = np.where(is_cell, distance, np.inf).argmin()
    if not (distance[cell] < _RESOLVED_WIDTH * samples.radius and np.isfinite(press.indenter.gap(np.zeros(2)))):
        raise ValueError(
            f"position: the press at {millimetre_text(press.position)} mm touches no skin, or does with less than a "
            "tenth of a "
            "cell's width; move it, or give a wider indenter or a finer mesh."
        )
    nearest = np.linalg.norm(samples.points[cells[cell]] - press.position, axis=-1).argmin()
    here, small = np.zeros((1, 1, 2)), (share[0, cell] * samples.area[cells[cell]]).reshape(1, 1)
    pressure[cell, nearest] = support.spread(DiscIndenter(samples.radius), load, here, small)[0, 0]
    return pressure


def _height_below_plane(samples: Samples, fall):
    """Distance of the surface below the plane of the press, for curved skins; None for flat skins."""
    return None if samples.curved is None else fall


def _pad_and_stack(rows: list, pressures: list) -> PressedCells:
    """Stack the cells and pressures of all touches, padded with zeros to the largest number of cells."""
    cells, there = pad_rows(rows)
    pressure = np.zeros((*cells.shape, pressures[0].shape[-1]))
    pressure[there] = np.concatenate(pressures)
    return PressedCells(cells, pressure)
