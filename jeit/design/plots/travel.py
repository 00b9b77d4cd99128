"""Plot of the paths of the electrodes in a layout optimisation."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, PathPatch
from matplotlib.path import Path

from jeit.arguments import check_kind
from jeit.design.optimisation.optimise import Optimisation
from jeit.layout.surface_layout import flat_layout
from jeit.mesh import Domain
from jeit.plot.axes import draw_scale_bar, get_or_create_axes, hide_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY
from jeit.plot.imaging.electrodes import ELECTRODE_COLOUR

_KEEP_OUT_STYLE = {"facecolor": "none", "edgecolor": LIGHT_GREY, "hatch": "////", "linewidth": 0.5, "zorder": 1}


def plot_travel(
    optimisation: Optimisation,
    start: int = 0,
    *,
    keep_out: tuple[Domain, ...] = (),
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the path of every electrode for one start of a layout optimisation. Hollow discs mark the initial positions,
    filled discs the final positions.

    **Arguments:**

    - `optimisation`: result of `optimise_layout`.
    - `start`: index of the start, from 0.
    - `keep_out`: regions without electrodes, to be hatched.
    - `title`: title of the plot; by default the mean distance between the electrodes' initial and final positions in
      millimetres.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for a start that does not exist, and if `optimisation` is not an `Optimisation`.

    **Example:**

    ```python
    optimised = optimise_layout(sheet, objective, steps=1)
    plot_travel(optimised).figure.savefig("travel.png")
    ```
    """
    check_kind("optimisation", optimisation, Optimisation, "an Optimisation, as of optimise_layout")
    num_starts = len(optimisation.centres)
    if not isinstance(start, (int, np.integer)) or not 0 <= start < num_starts:
        raise ValueError(
            f"start must be from 0 to {num_starts - 1}, of one of the {num_starts} starts; it is {start!r}."
        )
    final_centres, electrode_radii = optimisation.centres[start], optimisation.radii[start]
    electrode_paths = np.concatenate([optimisation.snapshots[start], final_centres[None]])
    ax = get_or_create_axes(ax)
    skin_outline = flat_layout(optimisation.layout).outline
    if skin_outline is not None:
        ax.add_patch(
            PathPatch(outline_path(skin_outline), facecolor="none", edgecolor=DARK_GREY, linewidth=0.9, zorder=2)
        )
        skin_extent = skin_outline.extent
        hide_axes(ax, skin_extent, numbered=False)
        draw_scale_bar(ax, skin_extent)
    for keep_out_domain in keep_out:
        ax.add_patch(PathPatch(outline_path(keep_out_domain), **_KEEP_OUT_STYLE))
    initial_circles = [Circle((x, y), r) for (x, y), r in zip(electrode_paths[0], electrode_radii, strict=True)]
    final_circles = [Circle((x, y), r) for (x, y), r in zip(final_centres, electrode_radii, strict=True)]
    ax.add_collection(PatchCollection(initial_circles, facecolor="none", edgecolor=LIGHT_GREY, linewidth=1.0, zorder=3))
    ax.add_collection(LineCollection(list(electrode_paths.swapaxes(0, 1)), colors=LIGHT_GREY, linewidths=1.2, zorder=3))
    ax.add_collection(
        PatchCollection(final_circles, facecolor=ELECTRODE_COLOUR, edgecolor=DARK_GREY, linewidth=0.6, zorder=4)
    )
    _draw_legend(ax, has_excluded_areas=bool(keep_out))
    travelled_distances = np.linalg.norm(final_centres - electrode_paths[0], axis=1)
    ax.set_title(
        f"Moved {1e3 * travelled_distances.mean():.0f} mm on average" if title is None else title, color=DARK_GREY
    )
    return ax


def _draw_legend(ax: Axes, *, has_excluded_areas: bool) -> None:
    """Draw the legend of the positions below the plot, beside the scale bar."""
    disc_style = {"marker": "o", "markersize": 8, "linestyle": "none"}
    legend_handles: list[Artist] = [
        Line2D([], [], markerfacecolor="none", markeredgecolor=LIGHT_GREY, label="where it began", **disc_style),
        Line2D([], [], color=LIGHT_GREY, linewidth=1.2, label="way, step by step"),
        Line2D(
            [],
            [],
            markerfacecolor=ELECTRODE_COLOUR,
            markeredgecolor=DARK_GREY,
            markeredgewidth=0.6,
            label="where it ended",
            **disc_style,
        ),
    ]
    if has_excluded_areas:
        legend_handles.append(Patch(facecolor="none", edgecolor=LIGHT_GREY, hatch="////", label="kept free"))
    legend_style = {
        "frameon": False,
        "fontsize": 9,
        "labelcolor": DARK_GREY,
        "borderaxespad": 0.2,
        "columnspacing": 1.2,
    }
    ax.legend(handles=legend_handles, loc="lower right", ncols=2, **legend_style)


def outline_path(domain: Domain) -> Path:
    """Convert the boundary of a domain, including its holes, to closed loops of a matplotlib path, in metres."""
    boundary_loops = [np.asarray(boundary_loop) for boundary_loop in domain.loops()]
    return Path.make_compound_path(
        *(Path(np.concatenate([boundary_loop, boundary_loop[:1]]), closed=True) for boundary_loop in boundary_loops)
    )
