"""Plot of a self-organising map: its lattice of neurons, and a value of each neuron."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from jeit.arguments import check_kind, real_array
from jeit.plot.axes import draw_scale_bar, extent_of, get_or_create_axes, hide_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SEQUENTIAL_COLOUR_MAP, draw_colour_bar
from jeit.touch.kohonen import MapTouch

# Area of a neuron's marker, points², in a map of the reference size.
_MARKER_AREA = 26.0
# Number of neurons of the map of the reference size.
_REFERENCE_NEURONS = 1024


def plot_map(
    places: Float[np.ndarray, "R C 2"],
    values: Float[np.ndarray, "R C"] | None = None,
    *,
    label: str = "Activity",
    touches: Sequence[MapTouch] = (),
    on_skin: bool = True,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the neurons of a self-organising map, and lines between neighbours.

    Neurons whose place is NaN are left out.

    **Arguments:**

    - `places`: places (R, C, 2) of the neurons, metres, such as `PlacedMap.places`; with `on_skin=False`, in any unit,
      such as the result of `drawn_map`.
    - `values`: values (R, C) of the neurons, such as the activity in a frame, drawn in colour.
    - `label`: name of the values, for the colour bar.
    - `touches`: touches, as returned by `touches_reported`, each drawn as a cross.
    - `on_skin`: whether places are on the skin, in metres; a scale bar is then drawn.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` for arrays of other shapes, and if no neuron has a place.

    **Example:**

    ```python
    ax = plot_map(placed.places, learnt_map.activity(map_frames[:1])[0])
    ax.figure.savefig("map.png")
    ```
    """
    places = real_array("places", places, "places (R, C, 2) of neurons")
    if places.ndim != 3 or places.shape[2] != 2:
        raise ValueError(f"places must be (R, C, 2); they have shape {places.shape}.")
    has_place = np.isfinite(places).all(axis=2)
    if not has_place.any():
        raise ValueError("places: no neuron has one.")
    if values is not None and np.shape(values) != places.shape[:2]:
        raise ValueError(f"values must be one for each neuron, {places.shape[:2]}; they have shape {np.shape(values)}.")
    check_kind("touches", touches, (list, tuple), "a list of touches, as of touches_reported")
    ax = get_or_create_axes(ax)
    extent = extent_of(places[has_place])
    hide_axes(ax, extent, numbered=False)
    lattice_edges = [
        lattice_edge
        for line_starts, line_ends in ((places[:-1], places[1:]), (places[:, :-1], places[:, 1:]))
        for lattice_edge in np.stack([line_starts, line_ends], axis=-2).reshape(-1, 2, 2)
        if np.isfinite(lattice_edge).all()
    ]
    ax.add_collection(
        LineCollection(lattice_edges, colors=DARK_GREY if values is None else LIGHT_GREY, linewidths=0.5, zorder=1)
    )
    if values is not None:
        marker_area = _MARKER_AREA * min(4.0, _REFERENCE_NEURONS / has_place.size)
        neuron_markers = ax.scatter(
            *places[has_place].T,
            c=np.asarray(values)[has_place],
            s=marker_area,
            cmap=SEQUENTIAL_COLOUR_MAP,
            linewidths=0,
            zorder=2,
        )
        draw_colour_bar(ax, neuron_markers, label)
    for touch in touches:
        ax.plot(*touch.place, marker="+", color="#d1495b", markersize=13, markeredgewidth=2.2, zorder=4)
    if on_skin:
        draw_scale_bar(ax, extent)
    if title is not None:
        ax.set_title(title)
    return ax
