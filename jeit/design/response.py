"""Response of a skin of one layout to touches: sensitivity and virtual taxels, as in text S4 of Park et al. 2022."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array

from jeit.arguments import check_key
from jeit.design.defaults import NUM_TAXELS, THRESHOLD
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.skin import Skin, check_skin
from jeit.design.skin.touch_grid import TouchGrid, check_grid
from jeit.design.skin.touched_cells import TouchedCells
from jeit.design.taxels import Taxels, find_taxels
from jeit.layout import Layout, SurfaceLayout


class SkinResponse(eqx.Module):
    """Response of a skin of one `layout` to touches: its `sensitivity`, and its `taxels`."""

    layout: Layout | SurfaceLayout
    sensitivity: SensitivityMap
    taxels: Taxels


def skin_response(
    skin: Skin,
    grid: TouchGrid,
    *,
    key: Array,
    touched: TouchedCells | None = None,
    num_taxels: int | None = None,
    threshold: float = THRESHOLD,
    linear: bool = False,
) -> SkinResponse:
    """Compute the sensitivity and virtual taxels of a skin from single touches at every position of `grid`.

    **Arguments:**

    - `key`: for the taxels' k-means, from `jax.random.key`.
    - `touched`: the conductivity changes by the touches, `skin.touched_cells(grid.places)` unless given.
    - `num_taxels`: 90 unless given, at most one per position; `threshold`: as in `find_taxels`.
    - `linear`: whether to compute linear instead of exact changes of the voltages.

    Raises `ValueError` for more taxels than places, touches of other places, and as `Skin.touched_cells` and
    `Skin.voltage_changes` do.
    """
    check_skin("skin", skin)
    check_grid(grid)
    check_key(key)
    number = number_of_taxels(grid, num_taxels)
    touched = skin.touched_cells(grid.places) if touched is None else touched
    if len(touched.places) != len(grid.places):
        raise ValueError(f"touched is of {len(touched.places)} places, and grid has {len(grid.places)}; give its own.")
    sensitivity = SensitivityMap(grid, skin.voltage_changes(touched, linear=linear))
    taxels = find_taxels(
        sensitivity.changes, grid.places, grid.cell_area, num_taxels=number, threshold=threshold, key=key
    )
    return SkinResponse(skin.layout, sensitivity, taxels)


def number_of_taxels(grid: TouchGrid, num_taxels: int | None) -> int:
    """Number of taxels, as in `skin_response`. Raises `ValueError` for none, or more than positions."""
    if num_taxels is None:
        return min(NUM_TAXELS, len(grid.places))
    if not 1 <= num_taxels <= len(grid.places):
        raise ValueError(f"num_taxels is {num_taxels}; give from 1 to the {len(grid.places)} places touched.")
    return num_taxels
