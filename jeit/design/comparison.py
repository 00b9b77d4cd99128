"""Comparison of electrode layouts: the response of each layout to touches, and the scores of two layouts side by
side."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jeit.arguments import check_key
from jeit.design.defaults import CONTRAST, MARGIN, NUM_PLACES_PER_SIDE, NUM_TAXELS, THRESHOLD
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.skin import Skin, check_skin
from jeit.design.skin.touch_shapes import TouchGrid, check_grid, touches_away_from_the_edge
from jeit.design.skin.touched_cells import TouchedCells
from jeit.design.taxels import Taxels, find_taxels
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh.geodesic import Triangles
from jeit_solvers.module import Module


class SkinResponse(Module):
    """Response of a skin to touches.

    **Fields**: `layout`: layout of the skin's electrodes; `sensitivity`: the skin's sensitivity map; `taxels`: the
    skin's virtual taxels.
    """

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

    - `skin`: the skin; `grid`: the touched positions.
    - `key`: random key for the k-means clustering of the taxels, from `jax.random.key`.
    - `touched`: conductivity changes due to the touches, by default `skin.touched_cells(grid.places)`.
    - `num_taxels`: number of taxels, by default 90, or the number of positions if fewer than 90.
    - `threshold`: cosine similarity threshold, as in `find_taxels`.
    - `linear`: whether to compute linearised instead of exact voltage changes.

    Raises `ValueError` for more taxels than positions, if `touched` and `grid` have different numbers of positions, and
    in the cases of `Skin.touched_cells` and `Skin.voltage_changes`.

    **Example:**

    ```python
    response = skin_response(sheet, touches, num_taxels=4, key=key)
    print(response.sensitivity.minimum, response.taxels.mean_area)
    ```
    """
    check_skin("skin", skin)
    check_grid(grid)
    check_key(key)
    checked_num_taxels = number_of_taxels(grid, num_taxels)
    touched = skin.touched_cells(grid.places) if touched is None else touched
    if len(touched.places) != len(grid.places):
        raise ValueError(f"touched is of {len(touched.places)} places, and grid has {len(grid.places)}; give its own.")
    sensitivity = SensitivityMap(grid, skin.voltage_changes(touched, linear=linear))
    taxels = find_taxels(
        sensitivity.changes, grid.places, grid.cell_area, num_taxels=checked_num_taxels, threshold=threshold, key=key
    )
    return SkinResponse(skin.layout, sensitivity, taxels)


def number_of_taxels(grid: TouchGrid, num_taxels: int | None) -> int:
    """Number of taxels: `num_taxels`, or 90 (at most one per position) if `num_taxels` is None. Raises `ValueError`
    unless `num_taxels` is from 1 to the number of positions."""
    if num_taxels is None:
        return min(NUM_TAXELS, len(grid.places))
    if not 1 <= num_taxels <= len(grid.places):
        raise ValueError(
            f"num_taxels is {num_taxels}; it must be from 1 to {len(grid.places)}, the number of places touched."
        )
    return num_taxels


# A position is a blind spot if its sensitivity is below the lowest sensitivity of the other layout by more than this
# relative margin. Rounding errors of coordinates thus do not produce blind spots.
_BLIND_SPOT_MARGIN = 1e-6


class LayoutComparison(Module):
    """Sensitivity and virtual taxels of two skins, from `compare_layouts`.

    **Fields**: `skins`: the two skins; `responses`: the response of each skin to touches; `margin` (metres), `places`,
    `contrast` and `seed`: the arguments of `compare_layouts`.
    """

    skins: tuple[Skin, Skin]
    responses: tuple[SkinResponse, SkinResponse]
    margin: float
    places: int = eqx.field(static=True)
    contrast: float
    seed: int = eqx.field(static=True)

    @property
    def figures(self) -> list[dict]:
        """Scores of the two layouts, one dictionary each, as returned by `comparison_figures`."""
        return comparison_figures(*self.responses)


def compare_layouts(
    first: Skin,
    second: Skin,
    *,
    margin: float = MARGIN,
    places: int = NUM_PLACES_PER_SIDE,
    contrast: float = CONTRAST,
    num_taxels: int | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LayoutComparison:
    """Compute the responses of two skins with different layouts to touches at a grid of positions, as the command `jeit
    layout compare` does.

    **Arguments:**

    - `first`, `second`: skins with the same outline, created with `Skin.create`.
    - `margin`: minimum distance of touches from the edge of the skin, metres; a touch closer to the edge would lie
      partly outside.
    - `places`: number of touched positions along each side of the skin.
    - `contrast`: conductivity of the touched part divided by that of the rest of the skin: 0 for an insulator, above 1
      for a conductor.
    - `num_taxels`: number of virtual taxels, by default 90, or the number of positions if fewer than 90.
    - `seed`: random seed for the k-means clustering of the taxels.
    - `progress`: function called with the name of each step of the computation as the step begins.

    Raises `ValueError` for skins with different outlines, for a margin that leaves no position, and in the cases of
    `skin_response`.

    **Example:**

    ```python
    comparison = compare_layouts(sheet, other, places=8, num_taxels=4)
    write_layout_comparison(comparison, "out")
    ```
    """
    check_skin("first", first)
    check_skin("second", second)
    check_same_outline(first.layout, second.layout)
    report_progress = progress or (lambda step_name: None)
    prepared_skins = []
    # Both skins are checked before any response is computed, so that errors are raised early.
    for skin in (first, second):
        grid = touches_away_from_the_edge(skin.outline, margin, places, places)
        checked_num_taxels = number_of_taxels(grid, num_taxels)
        prepared_skins.append((skin, grid, skin.touched_cells(grid.places, contrast=contrast), checked_num_taxels))
    responses = []
    for skin, grid, touched, checked_num_taxels in prepared_skins:
        report_progress(f"touch {skin.layout.name}")
        random_key = jax.random.key(seed)
        responses.append(skin_response(skin, grid, key=random_key, touched=touched, num_taxels=checked_num_taxels))
    return LayoutComparison((first, second), (responses[0], responses[1]), margin, places, contrast, seed)


def check_same_outline(first_layout: Layout | SurfaceLayout, second_layout: Layout | SurfaceLayout) -> None:
    """Raise `ValueError` unless both layouts are on skins of the same size. For flat skins, the areas of the outlines
    and the sides of their bounding boxes must agree; for curved skins, the areas of the surfaces."""
    if isinstance(first_layout, SurfaceLayout) or isinstance(second_layout, SurfaceLayout):
        skin_areas = [_layout_area(layout) for layout in (first_layout, second_layout)]
        if type(first_layout) is not type(second_layout) or abs(skin_areas[0] - skin_areas[1]) > 1e-2 * skin_areas[0]:
            raise ValueError(
                f"the layouts are on different skins, '{first_layout.name}' of {1e4 * skin_areas[0]:.4g} and "
                f"'{second_layout.name}' of {1e4 * skin_areas[1]:.4g} cm²; compare layouts on the same surface."
            )
        return
    sizes_and_areas = []
    for layout in (first_layout, second_layout):
        low_x, high_x, low_y, high_y = layout.known_outline.extent
        sizes_and_areas.append((high_x - low_x, high_y - low_y, float(layout.known_outline.area)))
    if any(
        abs(first_size - second_size) > 1e-3 * first_size
        for first_size, second_size in zip(*sizes_and_areas, strict=True)
    ):
        size_text = " and ".join(
            f"'{layout.name}' {1e3 * skin_width:.4g} × {1e3 * skin_height:.4g} mm"
            for layout, (skin_width, skin_height, _) in zip((first_layout, second_layout), sizes_and_areas, strict=True)
        )
        raise ValueError(
            f"the layouts are on different skins, {size_text}; a file that does not say its skin is read with outline=."
        )


def _layout_area(layout: Layout | SurfaceLayout) -> float:
    if isinstance(layout, SurfaceLayout):
        return float(Triangles.of(layout.surface).areas.sum())
    return float(layout.known_outline.area)


def comparison_figures(first_response: SkinResponse, second_response: SkinResponse) -> list[dict]:
    """Scores of each of two layouts, as dictionaries of plain numbers.

    - `sensitivity_…_V`: minimum and mean sensitivity, volts; `sensitivity_uniformity`: mean sensitivity divided by its
      root mean square.
    - `blind_spot_fraction`: fraction of the skin's area that is less sensitive than the other layout's least sensitive
      position.
    - `taxel_count`: number of taxels with an area above zero; `taxel_area_cm2`: mean, standard deviation and maximum of
      the taxels' areas, cm².
    - `taxel_overlap`: mean number of taxels that cover a position; `two_point_mm`: mean diameter of the taxels.
    """
    return [
        _score_figures(*responses_to_compare)
        for responses_to_compare in ((first_response, second_response), (second_response, first_response))
    ]


def _score_figures(layout_response: SkinResponse, other_layout_response: SkinResponse) -> dict:
    sensitivity, taxels = layout_response.sensitivity, layout_response.taxels
    taxel_areas = 1e4 * np.asarray(taxels.areas)
    return {
        "layout": layout_response.layout.name,
        "electrodes": layout_response.layout.num_electrodes,
        "measurements": sensitivity.changes.shape[1],
        "sensitivity_min_V": float(sensitivity.minimum),
        "sensitivity_mean_V": float(sensitivity.mean),
        "sensitivity_uniformity": float(sensitivity.uniformity),
        "blind_spot_fraction": float(
            sensitivity.blind_spot((1 - _BLIND_SPOT_MARGIN) * other_layout_response.sensitivity.minimum)
        ),
        "taxel_count": int((taxel_areas > 0).sum()),
        "taxel_area_cm2": {
            "mean": float(taxel_areas.mean()),
            "std": float(taxel_areas.std()),
            "max": float(taxel_areas.max()),
        },
        "taxel_overlap": float(taxels.overlap),
        "two_point_mm": 1e3 * float(taxels.two_point_discrimination),
    }
