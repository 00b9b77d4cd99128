"""Axes and scale bars shared by all plots."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation

from jeit.plot.colours import DARK_GREY, LIGHT_GREY


def get_or_create_axes(ax: Axes | None, size: tuple[float, float] = (6.4, 5.6)) -> Axes:
    """Return `ax`, or, if it is None, the axes of a new pyplot figure of `size` inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, layout="constrained")[1]


# Distance of numbers from a body, and width of a digit in a small picture, divided by the size of the body.
_RELATIVE_TEXT_DISTANCE, _RELATIVE_LETTER_WIDTH = 0.04, 0.021


def hide_axes(ax: Axes, extent: tuple[float, float, float, float], *, numbered: bool = True) -> None:
    """Set equal scales of the x and y axes, and remove frame and ticks. Around the `extent` (metres), space is left for
    a scale bar and, if electrodes are `numbered`, for the longest number beside the body."""
    x_min, x_max, y_min, y_max = extent
    largest_extent = max(x_max - x_min, y_max - y_min)
    margin_width = (0.12 if numbered else 0.06) * largest_extent
    outer_texts = [
        text
        for text in ax.texts
        if text.get_horizontalalignment() != "center" and not x_min <= text.get_position()[0] <= x_max
    ]
    horizontal_margin = max(
        [
            margin_width,
            *(
                (_RELATIVE_TEXT_DISTANCE + _RELATIVE_LETTER_WIDTH * len(text.get_text())) * largest_extent
                for text in outer_texts
            ),
        ]
    )
    ax.set_aspect("equal")
    ax.set_xlim(x_min - horizontal_margin, x_max + horizontal_margin)
    ax.set_ylim(y_min - 0.18 * largest_extent, y_max + (margin_width if numbered else 0.03 * largest_extent))
    ax.set_axis_off()


def extent_of(points: np.ndarray) -> tuple[float, float, float, float]:
    """Extent (x_min, x_max, y_min, y_max) of points (n, 2) or (n, 3)."""
    lower_corner, upper_corner = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return (lower_corner[0], upper_corner[0], lower_corner[1], upper_corner[1])


def style_graph_axes(ax: Axes) -> None:
    """Style the axes of a graph: spines only at the left and at the bottom, in grey, and dark tick labels."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(LIGHT_GREY)
    ax.tick_params(color=LIGHT_GREY, labelcolor=DARK_GREY, which="both")


def draw_horizontal_grid(ax: Axes) -> None:
    """Draw faint horizontal grid lines behind the plot."""
    ax.grid(axis="y", color="#e6e8eb", linewidth=0.6)
    ax.set_axisbelow(True)


def draw_legend_above(ax: Axes) -> None:
    """Draw a legend above the curves; the y axis begins at zero, and its upper limit is raised to make room."""
    num_entries = len(ax.get_legend_handles_labels()[1])
    ax.autoscale_view()
    ax.set_ylim(0, ax.get_ylim()[1] * (1.02 + 0.08 * num_entries))
    ax.legend(loc="upper right", frameon=False, labelcolor=DARK_GREY, borderaxespad=0)


def draw_scale_bar(ax: Axes, extent: tuple[float, float, float, float]) -> None:
    """Draw a scale bar of a round length, about a quarter of the width of the picture, below its lower left corner."""
    x_min, x_max, y_min, y_max = extent
    largest_extent = max(x_max - x_min, y_max - y_min)
    bar_length = _round_to_scale_length(0.27 * (x_max - x_min))
    x, y = x_min - 0.06 * largest_extent, y_min - 0.125 * largest_extent
    ax.plot([x, x + bar_length], [y, y], color=DARK_GREY, linewidth=2.5, solid_capstyle="butt")
    length_in_millimetres = 1e3 * bar_length
    text_transform = ax.transData + ScaledTranslation(0, -3 / 72, ax.figure.dpi_scale_trans)
    ax.text(
        x,
        y,
        f"{length_in_millimetres:g} mm",
        transform=text_transform,
        ha="left",
        va="top",
        color=DARK_GREY,
        fontsize=9,
    )


def _round_to_scale_length(max_length: float) -> float:
    power_of_ten = 10 ** math.floor(math.log10(max_length))
    return max(
        leading_digit * power_of_ten
        for leading_digit in (1, 2, 5)
        if leading_digit * power_of_ten <= max_length * (1 + 1e-9)
    )
