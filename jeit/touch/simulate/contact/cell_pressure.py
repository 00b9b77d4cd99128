"""Pressure of indenters on the cells of a mesh, at several sample points per cell, in equilibrium with the load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jeit.design.skin.touched_cells import millimetre_text, pad_rows
from jeit.touch.simulate.contact.indenters import DiscIndenter
from jeit.touch.simulate.contact.press import AbstractSupport, Press
from jeit.touch.simulate.contact.samples import Samples

# Fineness of the finer lattice of samples for contacts on few samples.
_FINE_LATTICE = 11
# Number of samples below which the finer lattice is used.
_MIN_NUM_SAMPLES = 6
# Width that the finer lattice resolves, as a share of the radius of a cell.
_RESOLVED_CELL_RADIUS_FRACTION = 1 / 6
# Number of presses computed at once, so that the arrays fit in the cache.
_PRESSES_AT_ONCE = 16
# Factor by which the reach of a contact grows if about half its area is off the skin; 2^(1/4) for a ball on a Winkler
# foundation.
_REACH_GROWTH_FACTOR = 1.25
# Minimum fraction of skin in the area within reach of a press; below this fraction, the pressure may extend farther.
_MIN_SKIN_FRACTION = 0.6


class PressedCells(NamedTuple):
    """Mesh cells under each of n touches, and the pressure on these cells.

    **Fields**: `cells`: (n, c), numbers of the c cells under each touch; `pressure`: (n, c, s), pressure at the s
    sample points of each cell, pascals. Rows of touches with fewer cells than c are padded with zeros."""

    cells: Int[np.ndarray, "n c"]
    pressure: Float[np.ndarray, "n c s"]


def pressed_cells(
    samples: Samples,
    support: AbstractSupport,
    touches: Sequence[tuple[Press, ...]],
    progress: Callable[[str], None] | None = None,
) -> PressedCells:
    """Compute the cells under touches and the pressure on them; the pressures of all presses of a touch are added.

    Parts of an indenter beyond the edge of the skin carry no load. `progress` is called with a message on the number of
    presses computed so far. Raises `ValueError` for presses off the skin, and as `pressure` of the support does.
    """
    presses = [press for touch in touches for press in touch]
    if not presses:
        return PressedCells(np.zeros((len(touches), 1), int), np.zeros((len(touches), 1, samples.points.shape[1])))
    pressed = _pressed_cells(samples, support, presses, progress)
    if all(len(touch) == 1 for touch in touches):
        return pressed
    rows_of_cells, pressures, first_press = [], [], 0
    for touch in touches:
        touch_presses = slice(first_press, first_press + len(touch))
        first_press += len(touch)
        is_pressed = pressed.pressure[touch_presses].any(axis=-1)
        cells, cell_indices = np.unique(pressed.cells[touch_presses][is_pressed], return_inverse=True)
        total_pressures = np.zeros((len(cells), pressed.pressure.shape[-1]))
        np.add.at(total_pressures, cell_indices, pressed.pressure[touch_presses][is_pressed])
        rows_of_cells.append(cells)
        pressures.append(total_pressures)
    return _pad_and_stack(rows_of_cells, pressures)


def _pressed_cells(
    samples: Samples, support: AbstractSupport, presses: Sequence[Press], progress: Callable[[str], None] | None
) -> PressedCells:
    samples.check(presses)
    positions = np.array([press.position for press in presses])
    indenter_numbers = _indenter_numbers(presses)
    max_reaches = samples.max_chord_ratio * np.array([press.indenter.reach for press in presses])
    # The extent of the pressure on a flat skin is no upper bound for that on a concave skin.
    reach_bounds = max_reaches if samples.curved is not None else _reach_bounds(support, presses, indenter_numbers)
    contact_radii = np.minimum(reach_bounds, max_reaches) + samples.radius
    tree = KDTree(samples.points.mean(axis=1))
    candidate_cells = tree.query_ball_point(positions, contact_radii, return_sorted=True)
    skin_areas = samples.points.shape[1] * np.array([samples.area[cells].sum() for cells in candidate_cells])
    presses_beyond_skin = np.flatnonzero(skin_areas < _MIN_SKIN_FRACTION * np.pi * contact_radii**2)
    candidate_cells[presses_beyond_skin] = tree.query_ball_point(
        positions[presses_beyond_skin], max_reaches[presses_beyond_skin] + samples.radius, return_sorted=True
    )
    candidate_cells = samples.facing_cells(presses, candidate_cells)
    num_cells = np.array([len(cells) for cells in candidate_cells])
    empty_presses = np.flatnonzero(num_cells == 0)
    if empty_presses.size:
        raise ValueError(
            f"position: {empty_presses.size} of {len(presses)} presses lie off the skin, the first at "
            f"{millimetre_text(positions[empty_presses[0]])} mm; places are in metres."
        )
    rows_of_cells: list = [None] * len(presses)
    pressures: list = [None] * len(presses)
    num_finished = 0
    for indenter_number in np.unique(indenter_numbers):
        press_indices = np.flatnonzero(indenter_numbers == indenter_number)
        press_indices = press_indices[np.argsort(num_cells[press_indices], kind="stable")]
        for chunk in np.split(press_indices, range(_PRESSES_AT_ONCE, len(press_indices), _PRESSES_AT_ONCE)):
            cells, is_not_padding = pad_rows([np.asarray(candidate_cells[press_index], int) for press_index in chunk])
            pressure = _pressures_of_equal_indenters(
                samples, support, [presses[press_index] for press_index in chunk], cells, is_not_padding
            )
            for press_index, touch_cells, touch_pressure in zip(chunk, cells, pressure, strict=True):
                is_pressed = touch_pressure.any(axis=-1)
                rows_of_cells[press_index], pressures[press_index] = touch_cells[is_pressed], touch_pressure[is_pressed]
            num_finished += len(chunk)
            if progress is not None:
                progress(f"pressure: {num_finished} of {len(presses)}")
    return _pad_and_stack(rows_of_cells, pressures)


def _indenter_numbers(presses: Sequence[Press]) -> Int[np.ndarray, " n"]:
    """Return the number of the indenter of each press (n,); equal indenters have the same number."""
    numbers: dict = {}
    numbers_by_id: dict[int, int] = {}
    for press in presses:
        if id(press.indenter) not in numbers_by_id:
            leaves, structure = jax.tree.flatten(press.indenter)
            values = tuple((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)
            numbers_by_id[id(press.indenter)] = numbers.setdefault((structure, values), len(numbers))
    return np.array([numbers_by_id[id(press.indenter)] for press in presses])


def _reach_bounds(support: AbstractSupport, presses: Sequence[Press], indenter_numbers) -> Float[np.ndarray, " n"]:
    """Compute an upper bound (n,) of the distance from the origin at which each press exerts pressure, metres.

    The bound is the reach of the pressure under the load rounded up to a power of two newtons, times
    `_REACH_GROWTH_FACTOR`, which allows for presses at the edge of the skin.
    """
    known_reaches: dict[tuple[int, int], float] = {}
    log2_loads = np.ceil(np.log2([press.load for press in presses]))
    for press, *indenter_and_doublings in zip(presses, indenter_numbers, log2_loads, strict=True):
        if tuple(indenter_and_doublings) not in known_reaches:
            try:
                max_reach = (
                    _REACH_GROWTH_FACTOR * support.pressure(press.indenter, 2.0 ** indenter_and_doublings[1]).reach
                )
            except ValueError:  # the rounded load exceeds the limit of the support; the load of the press may not
                max_reach = press.indenter.reach
            known_reaches[tuple(indenter_and_doublings)] = min(max_reach, press.indenter.reach)
    return np.array(
        [
            known_reaches[indenter_and_doublings]
            for indenter_and_doublings in zip(indenter_numbers, log2_loads, strict=True)
        ]
    )


def _pressures_of_equal_indenters(samples: Samples, support: AbstractSupport, presses: Sequence[Press], cells, is_cell):
    """Compute pressures (b, c, s) of b presses with the same indenter at the s samples of the `cells` (b, c)."""
    points = samples.points[cells]
    sample_shape = points.shape[:-1]
    local_points, height_differences, area_ratios = samples.to_indenter_coordinates(
        presses, cells, points.reshape(len(cells), -1, points.shape[-1])
    )
    sample_areas = np.broadcast_to((area_ratios * samples.area[cells] * is_cell)[..., None], sample_shape).reshape(
        len(cells), -1
    )
    loads = np.array([press.load for press in presses])
    pressure = support.spread(
        presses[0].indenter, loads, local_points, sample_areas, _depth_below_plane(samples, height_differences)
    ) * (sample_areas > 0)
    pressure = pressure.reshape(sample_shape)
    for press_index in np.flatnonzero(np.count_nonzero(pressure, axis=(1, 2)) < _MIN_NUM_SAMPLES).tolist():
        pressure[press_index] = _pressures_on_finer_lattice(
            samples, support, presses[press_index], cells[press_index], is_cell[press_index]
        )
    return pressure


def _pressures_on_finer_lattice(samples: Samples, support: AbstractSupport, press: Press, cells, is_cell):
    """Compute pressures (c, s) of a press that covers few samples: means over a finer lattice in each of `cells` (c,).

    If the press touches no point of the finer lattice either, the nearest sample carries the load. Raises `ValueError`
    for a press that touches no skin.
    """
    points = samples.lattice_points(cells, _FINE_LATTICE)
    num_fine_samples, num_samples = points.shape[1], samples.points.shape[1]
    local_points, height_differences, area_ratios = samples.to_indenter_coordinates(
        [press], cells[None], points.reshape(1, -1, points.shape[-1])
    )
    sample_areas = np.repeat(
        area_ratios[0] * samples.area[cells] * is_cell * num_samples / num_fine_samples, num_fine_samples
    )[None]
    loads = np.array([press.load])
    pressure = support.spread(
        press.indenter, loads, local_points, sample_areas, _depth_below_plane(samples, height_differences)
    ) * (sample_areas > 0)
    if pressure.any():
        return np.repeat(pressure.reshape(-1, num_fine_samples).mean(axis=1, keepdims=True), num_samples, axis=1)
    pressure = np.zeros((len(cells), num_samples))
    distances = np.linalg.norm(local_points.reshape(-1, num_fine_samples, 2), axis=-1).min(axis=1)
    nearest_cell = np.where(is_cell, distances, np.inf).argmin()
    if not (
        distances[nearest_cell] < _RESOLVED_CELL_RADIUS_FRACTION * samples.radius
        and np.isfinite(press.indenter.gap(np.zeros(2)))
    ):
        raise ValueError(
            f"position: the press at {millimetre_text(press.position)} mm touches no skin, or does with less than a "
            "tenth of a "
            "cell's width; move it, or give a wider indenter or a finer mesh."
        )
    nearest_sample = np.linalg.norm(samples.points[cells[nearest_cell]] - press.position, axis=-1).argmin()
    origin, cell_area = (
        np.zeros((1, 1, 2)),
        (area_ratios[0, nearest_cell] * samples.area[cells[nearest_cell]]).reshape(1, 1),
    )
    pressure[nearest_cell, nearest_sample] = support.spread(DiscIndenter(samples.radius), loads, origin, cell_area)[
        0, 0
    ]
    return pressure


def _depth_below_plane(samples: Samples, depth_below_plane):
    """Return `depth_below_plane`, the distance of a curved skin's surface below the plane of the press; None for flat
    skins."""
    return None if samples.curved is None else depth_below_plane


def _pad_and_stack(rows_of_cells: list, pressures: list) -> PressedCells:
    """Stack the cells and pressures of all touches. Rows are padded with zeros to the largest number of cells."""
    cells, is_cell = pad_rows(rows_of_cells)
    pressure = np.zeros((*cells.shape, pressures[0].shape[-1]))
    pressure[is_cell] = np.concatenate(pressures)
    return PressedCells(cells, pressure)
