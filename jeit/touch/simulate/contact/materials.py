"""Materials of a layer, from elastic constants to conductivity, and elastic foundations."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_metres, check_name, describe, is_number
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.press import (
    AbstractPressure,
    AbstractSupport,
    check_load,
    check_seen,
    check_support,
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


class Material(eqx.Module):
    """What a skin is made of; SI units. Other values: `dataclasses.replace(material("velostat"), noise=0.0)`.

    **At rest**: `conductivity`, S/m, and `thickness`, metres, of what conducts; `support`, what carries the load.

    **Pressed**: σ = σ₀ (1 + c q / (q + p½)) under an effective pressure q, c
    being `saturation`, the relative change that no pressure exceeds, and p½ `half_pressure`, pascals, where it is half
    so large. q follows the pressure with `hysteresis`, the greatest difference of unloading and loading over the
    greatest pressure, and `creep`: (share, seconds) of every branch that is late.

    **Drifting**, relative: `conductivity_trend` and `contact_trend` per second,
    `conductivity_walk` and `contact_walk` per root of a second; the contacts' are of every electrode's impedance.

    **Read**: `noise`, standard deviation of every voltage relative to the root mean square of all; `gain_spread`,
    standard deviation of the logarithm of every channel's gain.
    """

    conductivity: float
    thickness: float
    support: AbstractSupport
    saturation: float
    half_pressure: float
    hysteresis: float = 0.0
    creep: tuple[tuple[float, float], ...] = ()
    conductivity_trend: float = 0.0
    conductivity_walk: float = 0.0
    contact_trend: float = 0.0
    contact_walk: float = 0.0
    noise: float = 0.0
    gain_spread: float = 0.0

    def __check_init__(self):
        """Raises `ValueError` for what no material has."""
        check_metres("thickness", self.thickness)
        check_support("support", self.support)
        for name in ("conductivity", "half_pressure"):
            _check(name, getattr(self, name), lambda value: value > 0, "positive")
        _check("saturation", self.saturation, lambda value: value > -1, "above −1, where nothing conducts")
        _check("hysteresis", self.hysteresis, lambda value: 0 <= value < 1, "from 0 to below 1")
        for name in ("conductivity_walk", "contact_walk", "noise", "gain_spread"):
            _check(name, getattr(self, name), lambda value: value >= 0, "zero or more")
        for name in ("conductivity_trend", "contact_trend"):
            _check(name, getattr(self, name), lambda _: True, "a number")
        if not _are_branches(self.creep):
            raise ValueError(
                f"creep: give (share, seconds) of every branch, shares of sum below 1, such as ((0.1, 1.0), (0.1, "
                f"60.0)); it is {self.creep!r}."
            )

    def change(self, pressure: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Relative change of conductivity at effective pressures (…), pascals: c q / (q + p½)."""
        pressure = np.asarray(pressure)
        return self.saturation * pressure / (pressure + self.half_pressure)


def _check(name: str, value, holds: Callable[[float], bool], wanted: str) -> None:
    if not (is_number(value) and holds(value)):
        raise ValueError(f"{name} must be {wanted}; it is {describe(value)}.")


def _are_branches(creep) -> bool:
    """Whether it is pairs of a share and seconds, the shares of a sum below 1."""
    if not isinstance(creep, (tuple, list)) or not all(
        isinstance(one, (tuple, list)) and len(one) == 2 for one in creep
    ):
        return False
    if not all(is_number(share) and is_number(seconds) and share >= 0 and seconds > 0 for share, seconds in creep):
        return False
    return sum(share for share, _ in creep) < 1


# What papers print is named; all else is chosen, so that skins differ as their authors say they do.
MATERIALS = {
    # Chen et al. 2022, Pugach et al. 2015: carbon-filled polyolefin, 500 Ω cm, 0.1 mm. Two equal sheets conduct twice
    # as well at most; Chen's double layer tends to a limit at 39 N. Pugach calls its hysteresis high. Chosen: half of
    # the change at 30 kPa; 2 mm of soft rubber; hysteresis; creep from half a second to minutes; drift; 80 dB; gains.
    "velostat": Material(
        conductivity=0.2,
        thickness=1e-4,
        support=Foundation(1e6, 2e-3),
        saturation=1.0,
        half_pressure=30e3,
        hysteresis=0.15,
        creep=((0.08, 0.5), (0.07, 10.0), (0.05, 120.0)),
        conductivity_trend=1e-6,
        conductivity_walk=5e-5,
        contact_trend=2e-6,
        contact_walk=2e-4,
        noise=1e-4,
        gain_spread=0.01,
    ),
    # Silvera Tawil et al. 2011: 12.5 mS a square, 0.6 mm, under 5 mm of foam, and squares of 660 mS that would allow a
    # 54-fold conductivity were they one sheet in perfect contact. Russo et al. 2017: from 10 kPa up, elastic return and
    # hysteresis. Chosen: five-fold at most, half of that change at 20 kPa; foam of 300 kPa; hysteresis and creep less
    # than those of the film; drift; noise of 70 dB, that of a fabric's many contacts; gains.
    "conductive fabric": Material(
        conductivity=12.5e-3 / 0.6e-3,
        thickness=0.6e-3,
        support=Foundation(300e3, 5e-3),
        saturation=4.0,
        half_pressure=20e3,
        hysteresis=0.08,
        creep=((0.06, 0.3), (0.04, 20.0)),
        conductivity_trend=1e-6,
        conductivity_walk=1e-4,
        contact_trend=5e-6,
        contact_walk=5e-4,
        noise=3e-4,
        gain_spread=0.01,
    ),
    # Park et al. 2022: 10 mm, pressing raises the impedance, hysteresis below 3 %. jeit.design: 1 S/m. Chosen: a tenth
    # of the conductivity is left at most, half of that change at 50 kPa; 100 kPa; hardly any creep; drift, as gels dry;
    # 66 dB (Park prints 0.45 Ω, of a specimen whose resistance he does not).
    "hydrogel": Material(
        conductivity=1.0,
        thickness=10e-3,
        support=Foundation(100e3, 10e-3),
        saturation=-0.9,
        half_pressure=50e3,
        hysteresis=0.03,
        creep=((0.02, 5.0),),
        conductivity_trend=-5e-6,
        conductivity_walk=3e-5,
        contact_trend=1e-6,
        contact_walk=1e-4,
        noise=5e-4,
        gain_spread=0.01,
    ),
}


def material(name: str) -> Material:
    """The material of this name: "velostat", "conductive fabric" or "hydrogel". Raises `ValueError` for another."""
    check_name("name", name, MATERIALS)
    return MATERIALS[name]
