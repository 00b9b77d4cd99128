"""Plots of the response of a skin to touches: sensitivity maps and their histograms, maps of virtual taxels, histograms
of taxel areas, and the similarity of each position to a taxel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, check_name
from jeit.design.sensitivity import SensitivityMap
from jeit.design.taxels import Taxels
from jeit.plot.axes import draw_legend_above, draw_scale_bar, extent_of, get_or_create_axes, hide_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SEQUENTIAL_COLOUR_MAP, draw_colour_bar

_LAYOUT_COLOURS = (DARK_GREY, "#c8102e", "#1f6fb4", "#2a9d6f")
_TAXEL_COLOURS = (*_LAYOUT_COLOURS, "#8a5cb8", "#d98a1c")
_CLUSTER_COLOUR_MAP = "Set3"
_COLOUR_BAR_LABELS = {"area": "Taxel area (cm²)", "coverage": "Taxels over a point", "label": ""}


def plot_sensitivity_map(
    theta: SensitivityMap,
    *,
    electrodes: ArrayLike | None = None,
    limit: float | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the sensitivity Θ to touches over the skin, in millivolts.

    **Arguments:**

    - `theta`: the sensitivity map.
    - `electrodes`: positions (L, 2) of the electrodes to be marked, metres.
    - `limit`: upper end of the colour bar, volts, by default the maximum of Θ.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if `theta` is not a `SensitivityMap`.

    **Example:**

    ```python
    ax = plot_sensitivity_map(response.sensitivity, electrodes=layout.centres)
    ax.figure.savefig("sensitivity.png")
    ```
    """
    _check_is_sensitivity_map("theta", theta)
    ax = get_or_create_axes(ax)
    touched_grid = theta.grid
    num_rows, num_columns = touched_grid.shape
    lower_left_corner = np.asarray(touched_grid.places[0]) - np.array(
        [touched_grid.columns[0], touched_grid.rows[0]]
    ) * np.array(touched_grid.pitch)
    lower_left_corner = lower_left_corner - np.array(touched_grid.pitch) / 2
    map_extent = (
        lower_left_corner[0],
        lower_left_corner[0] + num_columns * touched_grid.pitch[0],
        lower_left_corner[1],
        lower_left_corner[1] + num_rows * touched_grid.pitch[1],
    )
    max_sensitivity = float(np.max(np.asarray(theta.values))) if limit is None else limit
    map_image = ax.imshow(
        1e3 * theta.image(),
        origin="lower",
        extent=map_extent,
        cmap=SEQUENTIAL_COLOUR_MAP,
        vmin=0,
        vmax=1e3 * max_sensitivity,
        aspect="equal",
    )
    draw_colour_bar(ax, map_image, "Sensitivity (mV)")
    if electrodes is not None:
        x, y = np.asarray(electrodes).T[:2]
        ax.plot(x, y, "o", markersize=4, markerfacecolor="white", markeredgecolor=DARK_GREY, markeredgewidth=0.8)
    hide_axes(ax, map_extent, numbered=False)
    draw_scale_bar(ax, map_extent)
    if title:
        ax.set_title(title)
    return ax


def plot_sensitivity_histograms(
    maps: Mapping[str, SensitivityMap], *, bins: int = 40, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot histograms of several sensitivity maps, as shares of the skin's area. A dashed line marks the minimum of the
    first map.

    **Arguments:**

    - `maps`: sensitivity maps by name, for the legend.
    - `bins`: number of bins of equal width in the histogram.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if `maps` is not a mapping to sensitivity maps.

    **Example:**

    ```python
    ax = plot_sensitivity_histograms({"grid": response.sensitivity}, bins=10)
    ax.figure.savefig("histogram.png")
    ```
    """
    check_kind("maps", maps, Mapping, "{name: map}")
    for layout_name, sensitivity in maps.items():
        _check_is_sensitivity_map(f"maps['{layout_name}']", sensitivity)
    ax = get_or_create_axes(ax)
    max_sensitivity = max(float(np.max(np.asarray(sensitivity.values))) for sensitivity in maps.values())
    bin_edges = np.linspace(0, max_sensitivity, bins + 1)
    for layout_colour, (layout_name, sensitivity) in zip(_LAYOUT_COLOURS, maps.items(), strict=False):
        ax.stairs(
            100 * sensitivity.histogram(bin_edges)[0],
            1e3 * bin_edges,
            color=layout_colour,
            label=layout_name,
            linewidth=1.4,
        )
    first_name, sensitivity = next(iter(maps.items()))
    ax.axvline(
        1e3 * float(sensitivity.minimum), color=LIGHT_GREY, linewidth=1, linestyle="--", label=f"least of {first_name}"
    )
    ax.set_xlabel("Sensitivity (mV)", color=DARK_GREY)
    ax.set_ylabel("Share of the area (%)", color=DARK_GREY)
    style_graph_axes(ax)
    draw_legend_above(ax)
    if title:
        ax.set_title(title)
    return ax


def _check_is_sensitivity_map(argument_name: str, sensitivity_map: SensitivityMap) -> None:
    check_kind(argument_name, sensitivity_map, SensitivityMap, "a SensitivityMap, as of jeit.design.sensitivity_map")


def plot_taxels(
    taxels: Taxels,
    *,
    colour: str = "area",
    outlines: bool = False,
    electrodes: ArrayLike | None = None,
    limit: float | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot a map of the virtual taxels of one electrode layout.

    **Arguments:**

    - `taxels`: the taxels, as returned by `find_taxels`.
    - `colour`: quantity shown by colours: "area", the area of the taxel whose cluster contains the position;
      "coverage", the number of taxels that cover the position; "label", a colour for each cluster.
    - `outlines`: whether to draw the outline of each taxel, along which the similarity equals the threshold.
    - `electrodes`: positions (L, 2) or (L, 3) of the electrodes to be marked, metres.
    - `limit`: value at the upper end of the colour bar, in m² for "area".
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for an unknown `colour`, and for taxels of a batch of layouts.

    **Example:**

    ```python
    ax = plot_taxels(response.taxels, colour="label", electrodes=layout.centres)
    ax.figure.savefig("taxels.png")
    ```
    """
    check_name("colour", colour, _COLOUR_BAR_LABELS)
    _check_single_layout(taxels)
    cluster_labels = np.asarray(taxels.labels)
    ax = get_or_create_axes(ax)
    if colour == "label":
        cell_patches = _draw_cells(ax, taxels, _map_colours(taxels)[cluster_labels], colour_map=_CLUSTER_COLOUR_MAP)
        cell_patches.set_clim(0, colormaps[_CLUSTER_COLOUR_MAP].N - 1)
    else:
        cell_values = (
            1e4 * np.asarray(taxels.areas)[cluster_labels] if colour == "area" else np.asarray(taxels.coverage)
        )
        cell_patches = _draw_cells(ax, taxels, cell_values, colour_map=SEQUENTIAL_COLOUR_MAP)
        cell_patches.set_clim(
            0, float(cell_values.max()) if limit is None else limit * (1e4 if colour == "area" else 1)
        )
        draw_colour_bar(ax, cell_patches, _COLOUR_BAR_LABELS[colour])
    if outlines:
        outline_style = {"colour": DARK_GREY if colour == "label" else "white", "width": 0.7}
        _draw_outlines(ax, taxels, range(len(taxels.similarity)), **outline_style)
    _finish_axes(ax, taxels, electrodes, title)
    return ax


def plot_taxel_areas(
    taxels: Taxels | Mapping[str, Taxels], *, bins: int = 20, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot the histogram of the taxel areas of one or several layouts. The legend gives the mean ± standard deviation
    of each layout's areas.

    **Arguments:**

    - `taxels`: taxels of one layout, or of one to six layouts by name.
    - `bins`: number of bins of equal width from 0 to the largest area, the same for all layouts.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for taxels of a batch of layouts, and if the number of layouts is not from one to six.

    **Example:**

    ```python
    ax = plot_taxel_areas({"grid": response.taxels}, bins=5)
    ax.figure.savefig("areas.png")
    ```
    """
    taxels_by_layout = dict(taxels) if isinstance(taxels, Mapping) else {"taxels": taxels}
    if not 1 <= len(taxels_by_layout) <= len(_TAXEL_COLOURS):
        raise ValueError(
            f"taxels are of {len(taxels_by_layout)} layouts; give 1 to {len(_TAXEL_COLOURS)}, {{name: taxels}}."
        )
    for layout_taxels in taxels_by_layout.values():
        _check_single_layout(layout_taxels)
    areas_by_layout = {
        layout_name: 1e4 * np.asarray(layout_taxels.areas) for layout_name, layout_taxels in taxels_by_layout.items()
    }
    bin_edges = np.linspace(0, max(taxel_areas.max() for taxel_areas in areas_by_layout.values()) or 1.0, bins + 1)
    ax = get_or_create_axes(ax, (5.8, 3.8))
    for (layout_name, taxel_areas), layout_colour in zip(areas_by_layout.items(), _TAXEL_COLOURS, strict=False):
        legend_label = f"{layout_name}: {taxel_areas.mean():.1f} ± {taxel_areas.std():.1f} cm²"
        bin_counts = np.histogram(taxel_areas, bin_edges)[0]
        ax.stairs(bin_counts, bin_edges, fill=True, color=layout_colour, alpha=0.25)
        ax.stairs(bin_counts, bin_edges, color=layout_colour, linewidth=1.6, label=legend_label)
    ax.set_xlabel("Taxel area (cm²)", color=DARK_GREY)
    ax.set_ylabel("Taxels", color=DARK_GREY)
    ax.set_title(title or "")
    style_graph_axes(ax)
    draw_legend_above(ax)
    return ax


def plot_similarity(
    taxels: Taxels,
    index: int,
    *,
    electrodes: ArrayLike | None = None,
    title: str | None = None,
    colour_bar: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Plot the cosine similarity of each position's voltage change to the mean voltage change of taxel `index`,
    and the taxel's outline.

    `electrodes`: positions (L, 2) or (L, 3) of the electrodes to be marked, metres. Raises `ValueError` for an
    `index` that no taxel has, and for taxels of a batch of layouts.
    """
    _check_single_layout(taxels)
    num_taxels = len(taxels.similarity)
    if not isinstance(index, (int, np.integer)) or not 0 <= index < num_taxels:
        raise ValueError(
            f"index must be from 0 to {num_taxels - 1}, of one of the {num_taxels} taxels; it is {index!r}."
        )
    ax = get_or_create_axes(ax)
    cell_patches = _draw_cells(ax, taxels, np.asarray(taxels.similarity[index]), colour_map="magma")
    # Negative similarities are drawn as 0.
    cell_patches.set_clim(0, 1)
    _draw_outlines(ax, taxels, [index], colour="white", width=1.6)
    _finish_axes(ax, taxels, electrodes, f"{1e4 * float(taxels.areas[index]):.1f} cm²" if title is None else title)
    if colour_bar:
        draw_colour_bar(ax, cell_patches, "Cosine similarity")
    return ax


def _check_single_layout(taxels: Taxels) -> None:
    check_kind("taxels", taxels, Taxels, "Taxels, as of find_taxels")
    if taxels.similarity.ndim != 2:
        raise ValueError(
            f"taxels are of a batch of {taxels.similarity.shape[0]} layouts; draw one of them, "
            "jax.tree.map(lambda array: array[0], taxels)."
        )


def _cell_side_lengths(taxels: Taxels) -> tuple[np.ndarray, np.ndarray]:
    """Widths and heights (n,) of the drawn cells, metres: the spacings of the grid, or the sides of squares of the
    given area if the positions form no grid."""
    spacings_by_axis = [
        np.diff(np.unique(axis_coordinates.round(9))) for axis_coordinates in np.asarray(taxels.places).T
    ]
    square_sides = np.sqrt(np.asarray(taxels.cell_area))
    if all(
        len(grid_spacings) and np.allclose(grid_spacings, grid_spacings[0], rtol=1e-3)
        for grid_spacings in spacings_by_axis
    ):
        return np.full_like(square_sides, spacings_by_axis[0][0]), np.full_like(square_sides, spacings_by_axis[1][0])
    return square_sides, square_sides


def _draw_cells(ax: Axes, taxels: Taxels, cell_values: np.ndarray, *, colour_map: str) -> PolyCollection:
    cell_half_sizes = np.stack(_cell_side_lengths(taxels), axis=1)[:, None] / 2
    cell_corners = np.asarray(taxels.places)[:, None] + cell_half_sizes * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    # Cell edges are drawn in the colour of the cell, which hides gaps between cells.
    cell_patches = PolyCollection(
        list(cell_corners), array=cell_values, cmap=colormaps[colour_map], edgecolors="face", linewidth=0.4
    )
    ax.add_collection(cell_patches)
    return cell_patches


def _map_colours(taxels: Taxels) -> np.ndarray:
    """Indices (k,) of the colours of the k clusters: each cluster gets the first colour of the palette that none of its
    neighbours has."""
    cluster_labels, num_taxels = np.asarray(taxels.labels), len(taxels.similarity)
    first_edge_labels, second_edge_labels = cluster_labels[_triangulate_places(taxels).edges].T
    are_neighbouring_taxels = np.zeros((num_taxels, num_taxels), bool)
    are_neighbouring_taxels[first_edge_labels, second_edge_labels] = are_neighbouring_taxels[
        second_edge_labels, first_edge_labels
    ] = True
    np.fill_diagonal(are_neighbouring_taxels, False)
    taxel_colours = np.full(num_taxels, -1)
    for taxel_index in range(num_taxels):
        unused_colours = np.setdiff1d(np.arange(num_taxels), taxel_colours[are_neighbouring_taxels[taxel_index]])
        taxel_colours[taxel_index] = unused_colours[0] % colormaps[_CLUSTER_COLOUR_MAP].N
    return taxel_colours


def _triangulate_places(taxels: Taxels) -> Triangulation:
    return Triangulation(*np.asarray(taxels.places).T)


def _draw_outlines(ax: Axes, taxels: Taxels, taxel_indices: Iterable[int], *, colour: str, width: float) -> None:
    triangulation = _triangulate_places(taxels)
    for taxel_similarities in np.asarray(taxels.similarity)[list(taxel_indices)]:
        if taxel_similarities.min() < taxels.threshold <= taxel_similarities.max():
            ax.tricontour(
                triangulation, taxel_similarities, levels=[taxels.threshold], colors=[colour], linewidths=width
            )


def _finish_axes(ax: Axes, taxels: Taxels, electrodes: ArrayLike | None, title: str | None) -> None:
    if electrodes is not None:
        electrode_positions = np.asarray(electrodes, float)
        if electrode_positions.ndim != 2 or electrode_positions.shape[1] not in (2, 3):
            raise ValueError(
                f"electrodes has shape {electrode_positions.shape}; give positions (L, 2) or (L, 3) in metres."
            )
        marker_style = {
            "markersize": 4.5,
            "markerfacecolor": "white",
            "markeredgecolor": DARK_GREY,
            "markeredgewidth": 0.8,
        }
        ax.plot(*electrode_positions[:, :2].T, marker="o", linestyle="none", **marker_style)
    cell_half_sizes = np.stack(_cell_side_lengths(taxels), axis=1) / 2
    touched_places = np.asarray(taxels.places)
    map_extent = extent_of(np.concatenate([touched_places - cell_half_sizes, touched_places + cell_half_sizes]))
    hide_axes(ax, map_extent, numbered=False)
    draw_scale_bar(ax, map_extent)
    ax.set_title(title or "")
