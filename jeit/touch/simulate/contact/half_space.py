"""Elastic half-space: support of a skin that is thick compared with the contact.

The surface also sinks around the load: w = K p, where K is the convolution with Boussinesq's (1 − ν²) / (π E r). The
pressure p ≥ 0 of a rigid indenter under a load W satisfies w + gap = approach where p > 0, w + gap ≥ approach
elsewhere, and ∫ p = W. It is found by conjugate gradients over the pixels in contact; pixels leave the contact where
the pressure would be negative, and enter it where the bodies overlap (Polonsky and Keer, Wear 231, 1999, 206-219). K is
evaluated by FFT on a raster padded to twice its size, which avoids periodic images.
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
    check_resolved,
    contact_window,
    raster,
)

# Number of pixels along a side of the raster on which the contact area is located.
_COARSE = 24
# Minimum share of a contact's load that must lie on the skin, as the pressure is otherwise not determined; and share of
# the load carried by the points, above which this check is skipped.
_LEAST_SHARE, _DOUBTED = 0.2, 0.5
# Share of the load moved in a step, below which the iteration stops; and maximum number of steps.
_TOLERANCE, _MOST_STEPS = 1e-8, 2000


class HalfSpace(AbstractSupport):
    """An elastic half-space.

    **Fields**: `modulus`: Young's modulus E in pascals; `poisson`: Poisson's ratio; `pixels`: number of pixels along a
    side of the raster on which the pressure is computed, a rectangle slightly larger than the contact.

    **Example:**

    ```python
    rubber = HalfSpace(modulus=1e6, poisson=0.5, pixels=32)
    pressure = rubber.pressure(ball_indenter(0.02), 2.0)
    ```
    """

    modulus: float
    poisson: float
    pixels: int

    def __init__(self, modulus: float, poisson: float = 0.5, pixels: int = 64):
        """Create a half-space. Raises `ValueError` for a modulus that is not positive, a Poisson's ratio outside the
        range of isotropic bodies, and fewer than 8 pixels."""
        check_modulus(modulus)
        if not (is_number(poisson) and -1 < poisson <= 0.5):
            raise ValueError(f"poisson must be above −1 and at most 0.5, that of rubber; it is {describe(poisson)}.")
        if not (isinstance(pixels, int) and pixels >= 8):
            raise ValueError(f"pixels must be a whole number, 8 or more; it is {describe(pixels)}.")
        self.modulus, self.poisson, self.pixels = float(modulus), float(poisson), pixels

    @property
    def plane_modulus(self) -> float:
        """Plane-strain modulus E* = E / (1 − ν²), pascals."""
        return self.modulus / (1 - self.poisson**2)

    def pressure(self, indenter: AbstractIndenter, load: float) -> PressureRaster:
        """Pressure beneath `indenter` under a `load` in newtons.

        Raises `ValueError` for a load that is not positive and for indenters thinner than a pixel, and `RuntimeError`
        if the iteration does not converge.
        """
        check_load(load)

        def is_pressed(window, num_pixels: int) -> np.ndarray:
            return self._solve_pressure(indenter, load, window, num_pixels)[0] > 0

        window = contact_window(is_pressed, indenter.reach, _COARSE)
        values, approach = self._solve_pressure(indenter, load, window, self.pixels)
        points, pixel = raster(window, self.pixels)
        check_resolved(values > 0, pixel)
        reach = float(np.linalg.norm(points[values > 0], axis=-1).max() + np.hypot(*pixel))
        return PressureRaster(float(load), approach, reach, values, pixel)

    def spread(self, indenter: AbstractIndenter, loads, points, areas, fall=None):
        """Pressures (n, q) at the points of n loads, scaled to carry the load: at an edge, the points on the skin also
        carry the part of the load beyond it. Raises `ValueError` as `pressure`, for a curved skin, and if less than a
        fifth of the load lies on the skin.
        """
        if fall is not None:
            raise ValueError("support: a HalfSpace is flat, and the skin is curved; take a Foundation.")
        free = [self.pressure(indenter, load) for load in loads]
        pressures = np.stack([one.at(own) for one, own in zip(free, points, strict=True)])
        carried = np.sum(pressures * areas, axis=1)
        for number in np.flatnonzero((carried > 0) & (carried < _DOUBTED * np.asarray(loads))):
            _check_on_skin(free[number], points[number], areas[number])
        return pressures * np.where(carried > 0, loads / np.where(carried > 0, carried, 1.0), 0.0)[:, None]

    def _solve_pressure(self, indenter: AbstractIndenter, load: float, window, num_pixels: int):
        points, pixel = raster(window, num_pixels)
        gap = indenter.gap(points)
        if not np.isfinite(gap).any():
            return np.zeros_like(gap), 0.0
        return rigid_contact(gap, displacement_function(num_pixels, pixel, self.plane_modulus), load / pixel.prod())


def _check_on_skin(pressure: PressureRaster, points, areas) -> None:
    """Check how much of a pressure lies on the skin, given by points and their areas. Raises `ValueError` if it is less
    than a fifth."""
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


def displacement_function(num_pixels: int, pixel, plane_modulus: float):
    """Return a function that computes the displacements (N, N) of the centres of pixels, metres, from pressures (N, N),
    pascals. `num_pixels`: N; `pixel`: sides of a pixel, metres.

    The displacement due to a rectangle under uniform pressure is that of Love (1929): Johnson, Contact Mechanics, 1985,
    equation 3.25.
    """
    along, half = np.arange(2 * num_pixels) - num_pixels, np.asarray(pixel) / 2
    x, y = np.meshgrid(pixel[0] * along, pixel[1] * along)

    def corner_displacement(x, y):
        return x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y))

    influence = sum(i * j * corner_displacement(x + i * half[0], y + j * half[1]) for i in (1, -1) for j in (1, -1)) / (
        np.pi * plane_modulus
    )
    spectrum = np.fft.rfft2(np.fft.ifftshift(influence))

    def displacements(pressure):
        padded = np.fft.rfft2(pressure, s=(2 * num_pixels, 2 * num_pixels))
        return np.fft.irfft2(padded * spectrum, s=(2 * num_pixels, 2 * num_pixels))[:num_pixels, :num_pixels]

    return displacements


def rigid_contact(gap: np.ndarray, displacements, total_pressure: float) -> tuple[np.ndarray, float]:
    """Find the pressures ≥ 0 with sum `total_pressure` whose displacements, computed by `displacements`, close the
    `gap`; return them and the approach, metres. The gap is infinite where nothing can touch. Raises `RuntimeError` if
    the iteration does not converge."""
    may = np.isfinite(gap)
    gap = np.where(may, gap, 0.0)
    pressure = may * (total_pressure / may.sum())
    direction, last, again = np.zeros_like(gap), 1.0, False
    for _ in range(_MOST_STEPS):
        touching = pressure > 0
        distance = displacements(pressure) + gap
        distance -= distance[touching].mean()
        square = np.sum(distance[touching] ** 2)
        direction = np.where(touching, distance + (square / last if again else 0.0) * direction, 0.0)
        last = square
        response = displacements(direction)
        response -= response[touching].mean()
        slope = np.sum(response * direction)
        if square == 0 or slope <= 0:  # converged to rounding errors, or only one pixel is in contact
            break
        length = np.sum(distance[touching] * direction[touching]) / slope
        before, pressure = pressure, np.where(touching, np.maximum(pressure - length * direction, 0.0), 0.0)
        overlapping = may & (pressure == 0) & (distance < 0)
        again = not overlapping.any()
        pressure[overlapping] -= length * distance[overlapping]
        pressure *= total_pressure / pressure.sum()
        if again and np.abs(pressure - before).sum() < _TOLERANCE * total_pressure:
            break
    else:
        raise RuntimeError(f"the contact was not found in {_MOST_STEPS} steps; give the support fewer pixels.")
    return pressure, float((displacements(pressure) + gap)[pressure > 0].mean())
