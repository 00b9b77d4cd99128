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
    presses = [press for presses_of_touch in touches for press in presses_of_touch]
    if not presses:
        return PressedCells(np.zeros((len(touches), 1), int), np.zeros((len(touches), 1, samples.points.shape[1])))
    cells_of_presses = _pressed_cells(samples, support, presses, progress)
    if all(len(presses_of_touch) == 1 for presses_of_touch in touches):
        return cells_of_presses
    rows_of_cells, pressures_of_touches, first_press = [], [], 0
    for presses_of_touch in touches:
        press_slice = slice(first_press, first_press + len(presses_of_touch))
        first_press += len(presses_of_touch)
        is_pressed_cell = cells_of_presses.pressure[press_slice].any(axis=-1)
        touch_cells, cell_indices = np.unique(cells_of_presses.cells[press_slice][is_pressed_cell], return_inverse=True)
        total_pressures = np.zeros((len(touch_cells), cells_of_presses.pressure.shape[-1]))
        np.add.at(total_pressures, cell_indices, cells_of_presses.pressure[press_slice][is_pressed_cell])
        rows_of_cells.append(touch_cells)
        pressures_of_touches.append(total_pressures)
    return _pad_and_stack(rows_of_cells, pressures_of_touches)


def _pressed_cells(
    samples: Samples, support: AbstractSupport, presses: Sequence[Press], progress: Callable[[str], None] | None
) -> PressedCells:
    samples.check(presses)
    press_positions = np.array([press.position for press in presses])
    indenter_numbers = _indenter_numbers(presses)
    max_reaches = samples.max_chord_ratio * np.array([press.indenter.reach for press in presses])
    # The extent of the pressure on a flat skin is no upper bound for that on a concave skin.
    reach_bounds = max_reaches if samples.curved is not None else _reach_bounds(support, presses, indenter_numbers)
    contact_radii = np.minimum(reach_bounds, max_reaches) + samples.radius
    cell_tree = KDTree(samples.points.mean(axis=1))
    candidate_cells = cell_tree.query_ball_point(press_positions, contact_radii, return_sorted=True)
    skin_areas = samples.points.shape[1] * np.array([samples.area[cells].sum() for cells in candidate_cells])
    presses_beyond_skin = np.flatnonzero(skin_areas < _MIN_SKIN_FRACTION * np.pi * contact_radii**2)
    candidate_cells[presses_beyond_skin] = cell_tree.query_ball_point(
        press_positions[presses_beyond_skin], max_reaches[presses_beyond_skin] + samples.radius, return_sorted=True
    )
    candidate_cells = samples.facing_cells(presses, candidate_cells)
    num_cells = np.array([len(cells) for cells in candidate_cells])
    empty_presses = np.flatnonzero(num_cells == 0)
    if empty_presses.size:
        raise ValueError(
            f"position: {empty_presses.size} of {len(presses)} presses lie off the skin, the first at "
            f"{millimetre_text(press_positions[empty_presses[0]])} mm; places are in metres."
        )
    rows_of_cells: list = [None] * len(presses)
    pressures_of_presses: list = [None] * len(presses)
    num_finished = 0
    for indenter_number in np.unique(indenter_numbers):
        press_indices = np.flatnonzero(indenter_numbers == indenter_number)
        press_indices = press_indices[np.argsort(num_cells[press_indices], kind="stable")]
        for press_chunk in np.split(press_indices, range(_PRESSES_AT_ONCE, len(press_indices), _PRESSES_AT_ONCE)):
            cells, is_not_padding = pad_rows(
                [np.asarray(candidate_cells[press_index], int) for press_index in press_chunk]
            )
            chunk_pressures = _pressures_of_equal_indenters(
                samples, support, [presses[press_index] for press_index in press_chunk], cells, is_not_padding
            )
            for press_index, touch_cells, touch_pressure in zip(press_chunk, cells, chunk_pressures, strict=True):
                is_pressed_cell = touch_pressure.any(axis=-1)
                rows_of_cells[press_index], pressures_of_presses[press_index] = (
                    touch_cells[is_pressed_cell],
                    touch_pressure[is_pressed_cell],
                )
            num_finished += len(press_chunk)
            if progress is not None:
                progress(f"pressure: {num_finished} of {len(presses)}")
    return _pad_and_stack(rows_of_cells, pressures_of_presses)


def _indenter_numbers(presses: Sequence[Press]) -> Int[np.ndarray, " n"]:
    """Return the number of the indenter of each press (n,); equal indenters have the same number."""
    numbers_by_content: dict = {}
    numbers_by_id: dict[int, int] = {}
    for press in presses:
        if id(press.indenter) not in numbers_by_id:
            tree_leaves, tree_structure = jax.tree.flatten(press.indenter)
            leaf_values = tuple((np.shape(tree_leaf), np.asarray(tree_leaf).tobytes()) for tree_leaf in tree_leaves)
            numbers_by_id[id(press.indenter)] = numbers_by_content.setdefault(
                (tree_structure, leaf_values), len(numbers_by_content)
            )
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
    sample_points = samples.points[cells]
    sample_shape = sample_points.shape[:-1]
    local_points, height_differences, area_ratios = samples.to_indenter_coordinates(
        presses, cells, sample_points.reshape(len(cells), -1, sample_points.shape[-1])
    )
    sample_areas = np.broadcast_to((area_ratios * samples.area[cells] * is_cell)[..., None], sample_shape).reshape(
        len(cells), -1
    )
    press_loads = np.array([press.load for press in presses])
    sample_pressures = support.spread(
        presses[0].indenter, press_loads, local_points, sample_areas, _depth_below_plane(samples, height_differences)
    ) * (sample_areas > 0)
    sample_pressures = sample_pressures.reshape(sample_shape)
    for press_index in np.flatnonzero(np.count_nonzero(sample_pressures, axis=(1, 2)) < _MIN_NUM_SAMPLES).tolist():
        sample_pressures[press_index] = _pressures_on_finer_lattice(
            samples, support, presses[press_index], cells[press_index], is_cell[press_index]
        )
    return sample_pressures


def _pressures_on_finer_lattice(samples: Samples, support: AbstractSupport, press: Press, cells, is_cell):
    """Compute pressures (c, s) of a press that covers few samples: means over a finer lattice in each of `cells` (c,).

    If the press touches no point of the finer lattice either, the nearest sample carries the load. Raises `ValueError`
    for a press that touches no skin.
    """
    fine_points = samples.lattice_points(cells, _FINE_LATTICE)
    num_fine_samples, num_samples = fine_points.shape[1], samples.points.shape[1]
    local_points, height_differences, area_ratios = samples.to_indenter_coordinates(
        [press], cells[None], fine_points.reshape(1, -1, fine_points.shape[-1])
    )
    sample_areas = np.repeat(
        area_ratios[0] * samples.area[cells] * is_cell * num_samples / num_fine_samples, num_fine_samples
    )[None]
    press_loads = np.array([press.load])
    sample_pressures = support.spread(
        press.indenter, press_loads, local_points, sample_areas, _depth_below_plane(samples, height_differences)
    ) * (sample_areas > 0)
    if sample_pressures.any():
        return np.repeat(
            sample_pressures.reshape(-1, num_fine_samples).mean(axis=1, keepdims=True), num_samples, axis=1
        )
    sample_pressures = np.zeros((len(cells), num_samples))
    origin_distances = np.linalg.norm(local_points.reshape(-1, num_fine_samples, 2), axis=-1).min(axis=1)
    nearest_cell = np.where(is_cell, origin_distances, np.inf).argmin()
    if not (
        origin_distances[nearest_cell] < _RESOLVED_CELL_RADIUS_FRACTION * samples.radius
        and np.isfinite(press.indenter.gap(np.zeros(2)))
    ):
        raise ValueError(
            f"position: the press at {millimetre_text(press.position)} mm touches no skin, or does with less than a "
            "tenth of a "
            "cell's width; move it, or give a wider indenter or a finer mesh."
        )
    nearest_sample = np.linalg.norm(samples.points[cells[nearest_cell]] - press.position, axis=-1).argmin()
    indenter_origin, cell_area = (
        np.zeros((1, 1, 2)),
        (area_ratios[0, nearest_cell] * samples.area[cells[nearest_cell]]).reshape(1, 1),
    )
    sample_pressures[nearest_cell, nearest_sample] = support.spread(
        DiscIndenter(samples.radius), press_loads, indenter_origin, cell_area
    )[0, 0]
    return sample_pressures


def _depth_below_plane(samples: Samples, depth_below_plane):
    """Return `depth_below_plane`, the distance of a curved skin's surface below the plane of the press; None for flat
    skins."""
    return None if samples.curved is None else depth_below_plane


def _pad_and_stack(rows_of_cells: list, pressures_of_touches: list) -> PressedCells:
    """Stack the cells and pressures of all touches. Rows are padded with zeros to the largest number of cells."""
    padded_cells, is_cell = pad_rows(rows_of_cells)
    padded_pressures = np.zeros((*padded_cells.shape, pressures_of_touches[0].shape[-1]))
    padded_pressures[is_cell] = np.concatenate(pressures_of_touches)
    return PressedCells(padded_cells, padded_pressures)
