"""A skin thick against the contact: an elastic half-space, whose surface sinks around a load too.

The surface sinks by w = K p, K being the convolution with Boussinesq's (1 − ν²) / (π E r). A rigid indenter under a
load W asks for pressure p ≥ 0 with w + gap = approach where p > 0, w + gap ≥ approach elsewhere, and ∫ p = W: by
conjugate gradients along the contact, pixels leaving where pressure would be negative and entering where bodies overlap
(Polonsky and Keer, Wear 231, 1999, 206-219), with K by FFT over a raster padded to twice its sides, so that no period
is seen.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from jeit.arguments import describe, is_number
from jeit.touch.simulate.contact.indenters import AbstractIndenter
from jeit.touch.simulate.contact.materials import check_modulus
from jeit.touch.simulate.contact.press import (
    AbstractSupport,
    PressureRaster,
    check_load,
    check_seen,
    contact_window,
    raster,
)

# Pixels along a side of the raster that finds the contact.
_COARSE = 24
# The least share of a free contact's pressure on the skin, below which the pressure there is undetermined; and the
# share that the points have to carry for it not to be computed.
_LEAST_SHARE, _DOUBTED = 0.2, 0.5
# Share of the load that the last step moves; and the greatest number of steps.
_TOLERANCE, _MOST_STEPS = 1e-8, 2000


class HalfSpace(AbstractSupport):
    """An elastic half-space: its `modulus` E in pascals and Poisson's ratio `poisson`.

    `pixels`: along a side of the raster on which the pressure is computed, over a rectangle little wider than the
    contact.
    """

    modulus: float
    poisson: float
    pixels: int

    def __init__(self, modulus: float, poisson: float = 0.5, pixels: int = 64):
        """Raises `ValueError` for a modulus that is not positive, a ratio that no isotropic body has, fewer than 8
        pixels."""
        check_modulus(modulus)
        if not (is_number(poisson) and -1 < poisson <= 0.5):
            raise ValueError(f"poisson must be above −1 and at most 0.5, that of rubber; it is {describe(poisson)}.")
        if not (isinstance(pixels, int) and pixels >= 8):
            raise ValueError(f"pixels must be a whole number, 8 or more; it is {describe(pixels)}.")
        self.modulus, self.poisson, self.pixels = float(modulus), float(poisson), pixels

    @property
    def plane_modulus(self) -> float:
        """E* = E / (1 − ν²), pascals."""
        return self.modulus / (1 - self.poisson**2)

    def pressure(self, indenter: AbstractIndenter, load: float) -> PressureRaster:
        """Pressure beneath `indenter` under `load` newtons.

        Raises `ValueError` for a load that is not positive and for indenters thinner than a pixel, and `RuntimeError`
        where the contact is not found.
        """
        check_load(load)

        def pressed(window, number: int) -> np.ndarray:
            return self._balanced(indenter, load, window, number)[0] > 0

        window = contact_window(pressed, indenter.reach, _COARSE)
        values, approach = self._balanced(indenter, load, window, self.pixels)
        points, pixel = raster(window, self.pixels)
        check_seen(values > 0, pixel)
        reach = float(np.linalg.norm(points[values > 0], axis=-1).max() + np.hypot(*pixel))
        return PressureRaster(float(load), approach, reach, values, pixel)

    def spread(self, indenter: AbstractIndenter, loads, points, areas, fall=None):
        """Each load's own pressure at these points, scaled to carry it: over an edge, what is cut off is made up for by
        what is left. Raises `ValueError` also where less than a fifth is left, and for a curved skin, which it is not.
        """
        if fall is not None:
            raise ValueError("support: a HalfSpace is flat, and the skin is curved; take a Foundation.")
        free = [self.pressure(indenter, load) for load in loads]
        pressures = np.stack([one.at(own) for one, own in zip(free, points, strict=True)])
        carried = np.sum(pressures * areas, axis=1)
        for number in np.flatnonzero((carried > 0) & (carried < _DOUBTED * np.asarray(loads))):
            _check_on_skin(free[number], points[number], areas[number])
        return pressures * np.where(carried > 0, loads / np.where(carried > 0, carried, 1.0), 0.0)[:, None]

    def _balanced(self, indenter: AbstractIndenter, load: float, window, number: int):
        points, pixel = raster(window, number)
        gap = indenter.gap(points)
        if not np.isfinite(gap).any():
            return np.zeros_like(gap), 0.0
        return rigid_contact(gap, sinking(number, pixel, self.plane_modulus), load / pixel.prod())


def _check_on_skin(pressure: PressureRaster, points, areas) -> None:
    """Raise `ValueError` where less than a fifth of a pressure lies on the skin, of which there are these points."""
    there = areas > 0
    places, pixel = raster(pressure.pixel * len(pressure.values) / 2, len(pressure.values))
    distance, nearest = KDTree(points[there]).query(places[pressure.values > 0])
    forces = pressure.values[pressure.values > 0] * pixel.prod()
    share = forces[distance < np.sqrt(areas[there][nearest])].sum() / pressure.load
    if share < _LEAST_SHARE:
        raise ValueError(
            f"position: of {pressure.load:g} N on a half-space, {100 * share:.0f} % of its pressure would lie on the "
            f"skin, less than {100 * _LEAST_SHARE:.0f} %; press farther from the edge, or take a Foundation."
        )


def sinking(number: int, pixel, plane_modulus: float):
    """Return the function from pressures (N, N), pascals, on pixels of these sides to the displacement of their
    centres, metres.

    A uniformly pressed rectangle sinks as in Love (1929): Johnson, Contact Mechanics, 1985, equation 3.25.
    """
    along, half = np.arange(2 * number) - number, np.asarray(pixel) / 2
    x, y = np.meshgrid(pixel[0] * along, pixel[1] * along)

    def corner(x, y):
        return x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y))

    influence = sum(i * j * corner(x + i * half[0], y + j * half[1]) for i in (1, -1) for j in (1, -1)) / (
        np.pi * plane_modulus
    )
    spectrum = np.fft.rfft2(np.fft.ifftshift(influence))

    def sink(pressure):
        padded = np.fft.rfft2(pressure, s=(2 * number, 2 * number))
        return np.fft.irfft2(padded * spectrum, s=(2 * number, 2 * number))[:number, :number]

    return sink


def rigid_contact(gap: np.ndarray, sink, total: float) -> tuple[np.ndarray, float]:
    """Pressures, zero or more, of sum `total`, under which `sink` closes the `gap`, infinite where nothing can touch;
    and the approach, metres. Raises `RuntimeError` where they are not found."""
    may = np.isfinite(gap)
    gap = np.where(may, gap, 0.0)
    pressure = may * (total / may.sum())
    direction, last, again = np.zeros_like(gap), 1.0, False
    for _ in range(_MOST_STEPS):
        touching = pressure > 0
        distance = sink(pressure) + gap
        distance -= distance[touching].mean()
        square = np.sum(distance[touching] ** 2)
        direction = np.where(touching, distance + (square / last if again else 0.0) * direction, 0.0)
        last = square
        response = sink(direction)
        response -= response[touching].mean()
        slope = np.sum(response * direction)
        if square == 0 or slope <= 0:  # only rounding is left, or a single pixel touches
            break
        length = np.sum(distance[touching] * direction[touching]) / slope
        before, pressure = pressure, np.where(touching, np.maximum(pressure - length * direction, 0.0), 0.0)
        overlapping = may & (pressure == 0) & (distance < 0)
        again = not overlapping.any()
        pressure[overlapping] -= length * distance[overlapping]
        pressure *= total / pressure.sum()
        if again and np.abs(pressure - before).sum() < _TOLERANCE * total:
            break
    else:
        raise RuntimeError(f"the contact was not found in {_MOST_STEPS} steps; give the support fewer pixels.")
    return pressure, float((sink(pressure) + gap)[pressure > 0].mean())
