"""Colour scales: the map from values to colours, and the label of the colour bar."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable

from jeit.arguments import check_kind, describe, is_number
from jeit.plot.axes import DIVERGING, SEQUENTIAL, draw_colour_bar, prefixed


class ColourScale(eqx.Module):
    """Map from values to colours.

    **Fields**

    - `difference`: values are changes, drawn on a diverging map centred at zero; otherwise on a perceptually uniform
      sequential one, from the least to the greatest.
    - `quantity`: label of the colour bar, the conductivity or its change unless given.
    - `unit`: of the values, that of the conductivity unless given ("S" of a sheet, "S/m" of a body), "" for none; the
      colour bar finds the prefix.
    - `limit`: value at the end of the colour bar, in `unit`; the largest magnitude drawn unless given.
    - `colour_map`: name of a matplotlib colour map, for another than the two.
    - `bar`: whether to draw the colour bar.

    Raises `ValueError` for a limit that is not a finite number from zero up.
    """

    difference: bool = True
    quantity: str | None = None
    unit: str | None = None
    limit: float | None = None
    colour_map: str | None = None
    bar: bool = True

    def __check_init__(self):
        if self.limit is not None and not (is_number(self.limit) and self.limit >= 0):
            raise ValueError(f"limit must be finite and positive, in the values' unit; it is {describe(self.limit)}.")

    def of(self, values: np.ndarray, unit: str) -> "FittedScale":
        """The scale for `values` (any shape), without NaN, whose unit is `unit` unless this scale has one.

        Raises `ValueError` for values that are not finite.
        """
        unit = unit if self.unit is None else self.unit
        largest = float(np.abs(values).max()) if self.limit is None else float(self.limit)
        if not np.isfinite(largest):
            raise ValueError("values must be finite to be drawn.")
        factor, with_prefix = prefixed(largest, unit)
        high = factor * largest or 1.0
        if self.difference:
            low = -high
        else:
            low = factor * float(values.min())
            if low >= high:  # a constant image
                low, high = low - 0.05 * abs(low) - 1e-12, high + 0.05 * abs(high) + 1e-12
        sheet = "sheet conductivity" if unit == "S" else "conductivity"
        what = self.quantity or (f"Change of {sheet}" if self.difference else sheet.capitalize())
        label = f"{what} ({with_prefix})" if with_prefix else what
        colours = self.colour_map or (DIVERGING if self.difference else SEQUENTIAL)
        return FittedScale(factor, label, {"cmap": colours, "vmin": low, "vmax": high}, self)


class FittedScale(eqx.Module):
    """A scale for certain values: the `factor` to the unit on the colour bar, its `label`, matplotlib's `keywords`."""

    factor: float
    label: str
    keywords: dict
    scale: ColourScale

    def draw_bar(self, ax: Axes, drawn: ScalarMappable) -> None:
        """The colour bar of what was drawn beside `ax`, where the scale has one."""
        if self.scale.bar:
            draw_colour_bar(ax, drawn, self.label, signed=self.scale.difference)


def check_scale(scale: ColourScale) -> None:
    """Raises `ValueError` for what is no `ColourScale`."""
    check_kind("scale", scale, ColourScale, "a ColourScale, such as ColourScale(colour_map='viridis')")


CHANGE = ColourScale()
LOGARITHM = ColourScale(quantity="log₁₀ of conductivity over background", unit="")
