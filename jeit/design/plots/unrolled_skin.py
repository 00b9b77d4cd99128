"""Plots of curved skins, unrolled to a plane, seen from outside and drawn to scale."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import FaceDiscs, SurfaceDiscs
from jeit.layout import SurfaceLayout
from jeit.mesh.geodesic import Unrolled
from jeit.plot.axes import draw_scale_bar, extent_of, get_or_create_axes, hide_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, LIGHT_GREY, SERIES_COLOURS, ColourScale, check_scale

# The plot states the distortion of lengths if its mean exceeds this relative value.
_MIN_STATED_DISTORTION = 0.005


def plot_unrolled(
    unrolled: Unrolled,
    values: ArrayLike | None = None,
    electrodes: SurfaceLayout | SurfaceDiscs | FaceDiscs | None = None,
    *,
    marks: Mapping[str, ArrayLike] | None = None,
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot a curved surface unrolled to a plane, with dashed lines along the cut.

    If unrolling changes lengths on the surface by more than half a per cent on average, the plot states this
    distortion.

    **Arguments:**

    - `unrolled`: the surface, as returned by `jeit.mesh.unroll`.
    - `values`: one value for each triangle of the surface, drawn in a uniform colour, or one for each node,
      interpolated.
    - `electrodes`: disc electrodes, drawn as circles with their numbers or labels.
    - `marks`: dictionary from names in the legend to positions (p, 3) on the surface that are marked, metres.
    - `scale`: mapping from values to colours; the default suits changes of sheet conductivity in siemens.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for values that do not match triangles or nodes, are complex or not finite, and for arguments of
    the wrong type.

    **Example:**

    ```python
    ax = plot_unrolled(unroll(curved.model.mesh), electrodes=curved.layout)
    ax.figure.savefig("unrolled.png")
    ```
    """
    check_kind("unrolled", unrolled, Unrolled, "a surface laid flat, as of unroll(skin.model.mesh)")
    check_scale(scale)
    ax = get_or_create_axes(ax, (7.4, 5.2))
    unrolled_points = unrolled.points
    triangulation = Triangulation(unrolled_points[:, 0], unrolled_points[:, 1], unrolled.cells)
    if values is not None:
        value_array = _check_values(unrolled, values)
        scaled_colours = scale.of(value_array, "S")
        is_per_cell = len(value_array) == len(unrolled.cells)
        shading_style: dict[str, Any] = {"shading": "gouraud"}
        if is_per_cell:
            shading_style = {"shading": "flat", "edgecolors": "face", "linewidth": 0.5}
        mesh_image = ax.tripcolor(
            triangulation,
            scaled_colours.factor * (value_array if is_per_cell else value_array[unrolled.nodes]),
            **shading_style,
            **scaled_colours.keywords,
        )
        scaled_colours.draw_bar(ax, mesh_image)
    _draw_edges(ax, unrolled)
    if electrodes is not None:
        _draw_electrodes(ax, unrolled, electrodes)
    for (mark_name, mark_places), mark_colour in zip((marks or {}).items(), SERIES_COLOURS, strict=False):
        flat_positions = unrolled.flat(np.atleast_2d(np.asarray(mark_places, float)))
        ax.plot(
            flat_positions[:, 0],
            flat_positions[:, 1],
            "o",
            color=mark_colour,
            markersize=5,
            markeredgecolor="white",
            label=mark_name,
            zorder=5,
        )
    plot_extent = extent_of(unrolled_points)
    hide_axes(ax, plot_extent, numbered=False)
    draw_scale_bar(ax, plot_extent)
    if marks:
        ax.legend(loc="lower right", frameon=False, labelcolor=DARK_GREY, ncols=len(marks), borderaxespad=0)
    if unrolled.mean_distortion > _MIN_STATED_DISTORTION:
        mean_percent, max_percent = 100 * unrolled.mean_distortion, 100 * unrolled.distortion
        distortion_text = f"lengths off by {mean_percent:.2g} % on average, {max_percent:.2g} % at most"
        ax.text(0.5, 0.02, distortion_text, transform=ax.transAxes, ha="center", color=LIGHT_GREY, fontsize=8)
    if title:
        ax.set_title(title)
    return ax


def _check_values(unrolled: Unrolled, plotted_values: ArrayLike) -> np.ndarray:
    value_array, cell_and_node_counts = np.asarray(plotted_values), (len(unrolled.cells), len(unrolled.surface.points))
    if value_array.shape not in ((cell_and_node_counts[0],), (cell_and_node_counts[1],)):
        raise ValueError(
            f"values has shape {value_array.shape}; give one for each of the {cell_and_node_counts[0]} triangles or "
            f"the {cell_and_node_counts[1]} nodes."
        )
    if np.iscomplexobj(value_array):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return value_array


def _draw_edges(ax: Axes, unrolled: Unrolled) -> None:
    for boundary_edges, line_style in ((unrolled.edge, "solid"), (unrolled.seam, (0, (3, 2)))):
        ax.add_collection(
            LineCollection(list(boundary_edges), colors=LIGHT_GREY, linewidths=1.0, linestyles=[line_style])
        )


def _draw_electrodes(ax: Axes, unrolled: Unrolled, electrodes) -> None:
    electrode_classes = (SurfaceLayout, SurfaceDiscs, FaceDiscs)
    check_kind(
        "electrodes", electrodes, electrode_classes, "those of a curved skin: its layout, or skin.model.electrodes"
    )
    if isinstance(electrodes, SurfaceLayout):
        electrode_centres, electrode_radii, electrode_names = (
            electrodes.centres,
            electrodes.diameters / 2,
            electrodes.labels,
        )
    else:
        electrode_centres, electrode_radii = electrodes.position, electrodes.radius
        electrode_names = [str(k + 1) for k in range(electrodes.num_electrodes)]
    for flat_centre, electrode_radius, electrode_name in zip(
        unrolled.flat(electrode_centres), np.asarray(electrode_radii), electrode_names, strict=True
    ):
        ax.add_patch(
            Circle(
                tuple(flat_centre),
                float(electrode_radius),
                facecolor="#ffffffa0",
                edgecolor=DARK_GREY,
                linewidth=0.8,
                zorder=3,
            )
        )
        ax.annotate(electrode_name, tuple(flat_centre), ha="center", va="center", fontsize=6, color=DARK_GREY, zorder=4)
