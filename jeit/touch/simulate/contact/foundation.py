"""A thin soft layer on a rigid back: pressure at a place depends only on the indentation there."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_metres, describe, is_number
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.pressure import (
    AbstractPressure,
    AbstractSupport,
    check_load,
    check_seen,
    contact_window,
    raster,
)

# Pixels along a side: of the raster that finds the contact, and of that on which the load is balanced.
_COARSE, _FINE = 24, 96


class FoundationPressure(AbstractPressure):
    """k (approach − gap) where that is positive; `stiffness` k in Pa/m. Known at every point, without a raster."""

    indenter: AbstractIndenter
    stiffness: float

    def at(self, points):
        """Pressure from the indenter's gap at points."""
        return self.stiffness * np.maximum(self.approach - self.indenter.gap(points), 0.0)


class Foundation(AbstractSupport):
    """Winkler's foundation: p = E δ / thickness (Johnson, Contact Mechanics, 1985, section 4.3).

    **Fields**: `modulus` E of the layer in pascals, that of compression between plates that keep it from spreading;
    `thickness` in metres. It is for layers thinner than the contact is wide.
    """

    modulus: float
    thickness: float

    def __init__(self, modulus: float, thickness: float):
        """Raises `ValueError` for values that are not positive."""
        check_modulus(modulus)
        check_metres("thickness", thickness)
        self.modulus, self.thickness = float(modulus), float(thickness)

    @property
    def stiffness(self) -> float:
        """Pressure over indentation, Pa/m."""
        return self.modulus / self.thickness

    def pressure(self, indenter: AbstractIndenter, load: float) -> FoundationPressure:
        """Pressure beneath `indenter` under `load` newtons.

        Raises `ValueError` for a load that is not positive, one that presses through the layer, and indenters thinner
        than a pixel.
        """
        check_load(load)

        def balanced(window, number: int) -> tuple[np.ndarray, float]:
            points, pixel = raster(window, number)
            gap = indenter.gap(points)
            area = np.full(gap.size, pixel.prod())
            return gap, float(level(gap.ravel(), area, load / self.stiffness))

        def pressed(window, number: int) -> np.ndarray:
            gap, approach = balanced(window, number)
            return gap < approach

        window = contact_window(pressed, indenter.reach, _COARSE)
        gap, approach = balanced(window, _FINE)
        points, pixel = raster(window, _FINE)
        check_seen(gap < approach, pixel)
        self._check_approach(approach, load)
        reach = float(np.linalg.norm(points[gap < approach], axis=-1).max() + np.hypot(*pixel))
        return FoundationPressure(float(load), approach, reach, indenter, self.stiffness)

    def spread(self, indenter: AbstractIndenter, loads, points, areas, fall=None):
        """The approach is the one that balances the load on these very points; of a curved skin gaps are as much wider
        as it falls away."""
        gap = indenter.gap(points) if fall is None else indenter.gap(points) + fall
        approach = level(gap, areas, loads / self.stiffness)
        deepest = approach.argmax()
        self._check_approach(approach[deepest], loads[deepest])
        return self.stiffness * np.maximum(approach[:, None] - gap, 0.0)

    def _check_approach(self, approach: float, load: float) -> None:
        if approach >= self.thickness:
            raise ValueError(
                f"load is {load:g} N, which takes the indenter {1e3 * approach:.3g} mm into a layer "
                f"{1e3 * self.thickness:.3g} mm thick; give less load, a wider indenter or a stiffer layer."
            )


def level(
    gap: Float[np.ndarray, "*n q"], area: Float[np.ndarray, "*n q"], volume: Float[np.ndarray, "*n"] | float
) -> Float[np.ndarray, "*n"]:
    """The level δ at which Σ area · max(δ − gap, 0) is `volume`; 0 where every gap is infinite.

    Water poured over ground: with the lowest m places under water δ is (volume + Σ area gap) / Σ area over these, exact
    for the m at which the next place stands out.
    """
    order = np.argsort(gap, axis=-1)
    heights = np.take_along_axis(gap, order, axis=-1)
    areas = np.where(np.isfinite(heights), np.take_along_axis(area, order, axis=-1), 0.0)
    lifted = areas * np.where(areas > 0, heights, 0.0)
    ground, covered = np.cumsum(lifted, axis=-1), np.cumsum(areas, axis=-1)
    levels = (np.asarray(volume)[..., None] + ground) / np.where(covered > 0, covered, np.inf)
    above = np.concatenate([heights[..., 1:], np.full((*heights.shape[:-1], 1), np.inf)], axis=-1)
    first = np.argmax((levels <= above) & (covered > 0), axis=-1)
    return np.take_along_axis(levels, first[..., None], axis=-1)[..., 0]


def check_modulus(modulus) -> None:
    """Raise `ValueError` for what is no positive modulus in pascals."""
    if not (is_number(modulus) and modulus > 0):
        raise ValueError(f"modulus must be positive, in pascals (1e6 for a soft rubber); it is {describe(modulus)}.")
