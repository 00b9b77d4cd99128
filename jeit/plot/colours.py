"""Colours of plots: the palette, scales from values to colours with their units, and colour bars."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.ticker import MaxNLocator

from jeit.arguments import check_kind, describe, is_number
from jeit_solvers.module import Module

DARK_GREY = "#26292e"
LIGHT_GREY = "#8b9098"
# Colour map of changes: red is more conductive, blue more resistive, and white no change.
DIVERGING_COLOUR_MAP = "RdBu_r"
SEQUENTIAL_COLOUR_MAP = "viridis"
# Colours of curves in one plot, at most six.
SERIES_COLOURS = ("#1f6fb4", "#d1495b", "#2a9d6f", "#8a5cb8", "#d98a1c", "#5b6470")
SERIES_MARKERS = ("o", "s", "^", "D", "v", "P")
_SI_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
# Minimum distance between the ticks of a colour bar of factors, as a share of its limit.
_MIN_TICK_SPACING = 0.2


def draw_colour_bar(
    ax: Axes,
    mappable: ScalarMappable,
    label: str,
    *,
    show_sign: bool = False,
    has_factor_labels: bool = False,
    position: Axes | None = None,
) -> None:
    """Draw a slim colour bar at the right of `ax`, or on the axes `position`; `show_sign`: whether tick labels have a
    sign, for differences; `has_factor_labels`: whether the values are log₁₀ of factors, which the tick labels state."""
    placement_options: dict[str, Any] = (
        {"ax": ax, "shrink": 0.72, "aspect": 28, "pad": 0.02} if position is None else {"cax": position}
    )
    colour_bar = ax.figure.colorbar(mappable, ticks=MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]), **placement_options)
    if has_factor_labels:
        tick_labels_by_value = _factor_ticks(mappable.get_clim()[1] or 0.0)
        colour_bar.set_ticks(list(tick_labels_by_value), labels=list(tick_labels_by_value.values()))
    elif show_sign:
        colour_bar.ax.yaxis.set_major_formatter(
            lambda tick_value, _: "0" if abs(tick_value) < 1e-12 else f"{tick_value:+g}".replace("-", "−")
        )
    colour_bar.set_label(label, color=DARK_GREY)
    colour_bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    colour_bar.ax.tick_params(length=2, color=LIGHT_GREY, labelcolor=DARK_GREY)


def _factor_ticks(max_log_factor: float) -> dict[float, str]:
    """Ticks of a colour bar from -`max_log_factor` to `max_log_factor`, log₁₀ of factors, and their labels, such as
    "×2" and "÷2"."""
    candidate_factors = [
        1 + leading_digit * 10.0**exponent_of_ten for exponent_of_ten in (-4, -3, -2, -1) for leading_digit in (1, 2, 5)
    ]
    candidate_factors += [
        leading_digit * 10.0**exponent_of_ten for exponent_of_ten in range(10) for leading_digit in (2, 5, 10)
    ]
    labels_by_value, min_spacing = {0.0: "1"}, _MIN_TICK_SPACING * max_log_factor
    for candidate_factor in sorted(candidate_factors, reverse=True):
        tick_value = math.log10(candidate_factor)
        if min_spacing <= tick_value <= max_log_factor * (1 + 1e-9) and all(
            abs(tick_value - other_tick) >= min_spacing for other_tick in labels_by_value
        ):
            labels_by_value |= {tick_value: f"×{candidate_factor:g}", -tick_value: f"÷{candidate_factor:g}"}
    return labels_by_value


def choose_si_prefix(max_value: float, unit: str) -> tuple[float, str]:
    """Choose the SI prefix for values up to `max_value`; return the factor to multiply values with, and the unit with
    its prefix, such as (1e3, "mS")."""
    if not unit or unit == "%" or not (math.isfinite(max_value) and max_value > 0):
        return 1.0, unit
    exponent_of_ten = 3 * math.floor(math.log10(max_value) / 3 + 1e-9)
    exponent_of_ten = min(max(exponent_of_ten, -12), 9)
    return 10.0**-exponent_of_ten, _SI_PREFIXES[exponent_of_ten] + unit


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
        max_value = float(np.abs(values).max()) if self.limit is None else float(self.limit)
        if not np.isfinite(max_value):
            raise ValueError("values must be finite to be drawn.")
        prefix_factor, prefixed_unit = choose_si_prefix(max_value, unit)
        upper_limit = prefix_factor * max_value or 1.0
        if self.difference:
            lower_limit = -upper_limit
        else:
            lower_limit = prefix_factor * float(values.min())
            if lower_limit >= upper_limit:  # a constant image
                lower_limit, upper_limit = (
                    lower_limit - 0.05 * abs(lower_limit) - 1e-12,
                    upper_limit + 0.05 * abs(upper_limit) + 1e-12,
                )
        conductivity_name = "sheet conductivity" if unit == "S" else "conductivity"
        quantity_name = self.quantity or (
            f"Change of {conductivity_name}" if self.difference else conductivity_name.capitalize()
        )
        axis_label = f"{quantity_name} ({prefixed_unit})" if prefixed_unit else quantity_name
        colour_map = self.colour_map or (DIVERGING_COLOUR_MAP if self.difference else SEQUENTIAL_COLOUR_MAP)
        return FittedScale(
            prefix_factor, axis_label, {"cmap": colour_map, "vmin": lower_limit, "vmax": upper_limit}, self
        )


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
                has_factor_labels=self.scale.logarithmic,
                position=position,
            )


def check_scale(scale: ColourScale) -> None:
    """Raise `ValueError` if `scale` is not a `ColourScale`."""
    check_kind("scale", scale, ColourScale, "a ColourScale, such as ColourScale(colour_map='viridis')")


CHANGE_SCALE = ColourScale()
FACTOR_SCALE = ColourScale(quantity="Conductivity over background", unit="", logarithmic=True)
