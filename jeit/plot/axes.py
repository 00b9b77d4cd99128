"""Axes, scale bars and colour scales shared by all plots."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from jeit.arguments import check_kind, describe, is_number
from jeit_solvers.module import Module

DARK_GREY = "#26292e"
LIGHT_GREY = "#8b9098"
# Colour map of changes: red is more conductive, blue more resistive, and white no change.
DIVERGING = "RdBu_r"
SEQUENTIAL = "viridis"
# Colours of curves in one plot, at most six.
SERIES_COLOURS = ("#1f6fb4", "#d1495b", "#2a9d6f", "#8a5cb8", "#d98a1c", "#5b6470")
SERIES_MARKERS = ("o", "s", "^", "D", "v", "P")
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (6.4, 5.6)) -> Axes:
    """Return `ax`, or, if it is None, the axes of a new pyplot figure of `size` inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, layout="constrained")[1]


# Distance of numbers from a body, and width of a digit in a small picture, divided by the size of the body.
_TEXT_DISTANCE, _LETTER_WIDTH = 0.04, 0.021
# Minimum distance between the ticks of a colour bar of factors, as a share of its limit.
_MIN_TICK_SPACING = 0.2


def hide_axes(ax: Axes, extent: tuple[float, float, float, float], *, numbered: bool = True) -> None:
    """Set equal scales of the x and y axes, and remove frame and ticks. Around the `extent` (metres), space is left for
    a scale bar and, if electrodes are `numbered`, for the longest number beside the body."""
    x_min, x_max, y_min, y_max = extent
    size = max(x_max - x_min, y_max - y_min)
    margin = (0.12 if numbered else 0.06) * size
    outer_texts = [
        text
        for text in ax.texts
        if text.get_horizontalalignment() != "center" and not x_min <= text.get_position()[0] <= x_max
    ]
    horizontal_margin = max(
        [margin, *((_TEXT_DISTANCE + _LETTER_WIDTH * len(text.get_text())) * size for text in outer_texts)]
    )
    ax.set_aspect("equal")
    ax.set_xlim(x_min - horizontal_margin, x_max + horizontal_margin)
    ax.set_ylim(y_min - 0.18 * size, y_max + (margin if numbered else 0.03 * size))
    ax.set_axis_off()


def extent_of(points: np.ndarray) -> tuple[float, float, float, float]:
    """Extent (x_min, x_max, y_min, y_max) of points (n, 2) or (n, 3)."""
    lower_corner, upper_corner = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return (lower_corner[0], upper_corner[0], lower_corner[1], upper_corner[1])


def soften_axes(ax: Axes) -> None:
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
    size = max(x_max - x_min, y_max - y_min)
    length = _round_down(0.27 * (x_max - x_min))
    x, y = x_min - 0.06 * size, y_min - 0.125 * size
    ax.plot([x, x + length], [y, y], color=DARK_GREY, linewidth=2.5, solid_capstyle="butt")
    millimetres = 1e3 * length
    text_transform = ax.transData + ScaledTranslation(0, -3 / 72, ax.figure.dpi_scale_trans)
    ax.text(x, y, f"{millimetres:g} mm", transform=text_transform, ha="left", va="top", color=DARK_GREY, fontsize=9)


def draw_colour_bar(
    ax: Axes,
    mappable: ScalarMappable,
    label: str,
    *,
    show_sign: bool = False,
    as_factors: bool = False,
    position: Axes | None = None,
) -> None:
    """Draw a slim colour bar at the right of `ax`, or on the axes `position`; `show_sign`: whether tick labels have a
    sign, for differences; `as_factors`: whether the values are log₁₀ of factors, which the tick labels state."""
    placement: dict[str, Any] = (
        {"ax": ax, "shrink": 0.72, "aspect": 28, "pad": 0.02} if position is None else {"cax": position}
    )
    bar = ax.figure.colorbar(mappable, ticks=MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]), **placement)
    if as_factors:
        ticks = _factor_ticks(mappable.get_clim()[1] or 0.0)
        bar.set_ticks(list(ticks), labels=list(ticks.values()))
    elif show_sign:
        bar.ax.yaxis.set_major_formatter(
            lambda value, _: "0" if abs(value) < 1e-12 else f"{value:+g}".replace("-", "−")
        )
    bar.set_label(label, color=DARK_GREY)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    bar.ax.tick_params(length=2, color=LIGHT_GREY, labelcolor=DARK_GREY)


def _factor_ticks(limit: float) -> dict[float, str]:
    """Ticks of a colour bar from -`limit` to `limit`, log₁₀ of factors, and their labels, such as "×2" and "÷2"."""
    factors = [1 + step * 10.0**decade for decade in (-4, -3, -2, -1) for step in (1, 2, 5)]
    factors += [step * 10.0**decade for decade in range(10) for step in (2, 5, 10)]
    ticks, spacing = {0.0: "1"}, _MIN_TICK_SPACING * limit
    for factor in sorted(factors, reverse=True):
        tick = math.log10(factor)
        if spacing <= tick <= limit * (1 + 1e-9) and all(abs(tick - other) >= spacing for other in ticks):
            ticks |= {tick: f"×{factor:g}", -tick: f"÷{factor:g}"}
    return ticks


def with_si_prefix(largest: float, unit: str) -> tuple[float, str]:
    """Choose the SI prefix for values up to `largest`; return the factor to multiply values with, and the unit with its
    prefix, such as (1e3, "mS")."""
    if not unit or unit == "%" or not (math.isfinite(largest) and largest > 0):
        return 1.0, unit
    exponent = 3 * math.floor(math.log10(largest) / 3 + 1e-9)
    exponent = min(max(exponent, -12), 9)
    return 10.0**-exponent, _PREFIXES[exponent] + unit


def _round_down(length: float) -> float:
    decade = 10 ** math.floor(math.log10(length))
    return max(step * decade for step in (1, 2, 5) if step * decade <= length * (1 + 1e-9))


class ColourScale(Module):
    """Map from values to colours.

    **Fields**

    - `difference`: whether values are changes, drawn with a diverging colour map centred at zero. Other values are
      drawn with a perceptually uniform sequential colour map from the minimum to the maximum.
    - `quantity`: label of the colour bar; default: conductivity or its change.
    - `unit`: unit of the values, "" for none; default: the unit of conductivity ("S" for a sheet, "S/m" for a body).
      The colour bar adds an SI prefix.
    - `limit`: value at the end of the colour bar, in `unit`; default: the maximum magnitude.
    - `colour_map`: name of a matplotlib colour map that replaces the default colour maps.
    - `bar`: whether to draw the colour bar.
    - `logarithmic`: whether the values are log₁₀ of factors; the colour bar then states the factors.

    Raises `ValueError` for a limit that is negative or not finite.

    **Example:**

    ```python
    plot_image(mesh, 1 + image, scale=ColourScale(difference=False, colour_map="magma"))
    ```
    """

    difference: bool = True
    quantity: str | None = None
    unit: str | None = None
    limit: float | None = None
    colour_map: str | None = None
    bar: bool = True
    logarithmic: bool = False

    def __check_init__(self):
        if self.limit is not None and not (is_number(self.limit) and self.limit >= 0):
            raise ValueError(f"limit must be finite and positive, in the values' unit; it is {describe(self.limit)}.")

    def of(self, values: np.ndarray, unit: str) -> "FittedScale":
        """Fit the scale to `values` of any shape; `unit`: unit of the values, used if this scale has no unit.

        Raises `ValueError` for values that are not finite.
        """
        unit = unit if self.unit is None else self.unit
        largest = float(np.abs(values).max()) if self.limit is None else float(self.limit)
        if not np.isfinite(largest):
            raise ValueError("values must be finite to be drawn.")
        factor, with_prefix = with_si_prefix(largest, unit)
        upper_limit = factor * largest or 1.0
        if self.difference:
            lower_limit = -upper_limit
        else:
            lower_limit = factor * float(values.min())
            if lower_limit >= upper_limit:  # a constant image
                lower_limit, upper_limit = (
                    lower_limit - 0.05 * abs(lower_limit) - 1e-12,
                    upper_limit + 0.05 * abs(upper_limit) + 1e-12,
                )
        conductivity_name = "sheet conductivity" if unit == "S" else "conductivity"
        quantity = self.quantity or (
            f"Change of {conductivity_name}" if self.difference else conductivity_name.capitalize()
        )
        label = f"{quantity} ({with_prefix})" if with_prefix else quantity
        colour_map = self.colour_map or (DIVERGING if self.difference else SEQUENTIAL)
        return FittedScale(factor, label, {"cmap": colour_map, "vmin": lower_limit, "vmax": upper_limit}, self)


class FittedScale(Module):
    """A colour scale fitted to values. **Fields**: `factor`: conversion of values to the unit of the colour bar;
    `label`: label of the colour bar; `keywords`: arguments of matplotlib functions; `scale`: the original scale."""

    factor: float
    label: str
    keywords: dict
    scale: ColourScale

    def draw_bar(self, ax: Axes, mappable: ScalarMappable, position: Axes | None = None) -> None:
        """Draw the colour bar of `mappable` beside `ax`, or on the axes `position`, unless the scale has no colour
        bar."""
        if self.scale.bar:
            draw_colour_bar(
                ax,
                mappable,
                self.label,
                show_sign=self.scale.difference,
                as_factors=self.scale.logarithmic,
                position=position,
            )


def check_scale(scale: ColourScale) -> None:
    """Raise `ValueError` if `scale` is not a `ColourScale`."""
    check_kind("scale", scale, ColourScale, "a ColourScale, such as ColourScale(colour_map='viridis')")


CHANGE_SCALE = ColourScale()
FACTOR_SCALE = ColourScale(quantity="Conductivity over background", unit="", logarithmic=True)
