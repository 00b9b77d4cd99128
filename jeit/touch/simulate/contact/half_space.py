"""Elastic half-space: support of a skin that is thick compared with the contact.

The surface also sinks around the load: its displacement is w = K p, where K is the convolution with Boussinesq's
solution (1 − ν²) / (π E r). The pressure p ≥ 0 of a rigid indenter under a load W satisfies w + gap = approach where
p > 0, w + gap ≥ approach elsewhere, and ∫ p = W. The pressure is found by conjugate gradients over the pixels in
contact; pixels leave the contact where the pressure would be negative, and enter it where the bodies overlap
(Polonsky and Keer, Wear 231, 1999, 206-219). K is evaluated by FFT on a raster padded to twice its size, which avoids
periodic images.
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
_NUM_COARSE_PIXELS = 24
# Minimum fraction of the load of a contact that must lie on the skin, so that the load determines the pressure.
_MIN_LOAD_FRACTION = 0.2
# Fraction of the load carried by sample points above which `_MIN_LOAD_FRACTION` is not checked.
_CHECKED_LOAD_FRACTION = 0.5
# Share of the load that a step moves between pixels, below which the iteration stops.
_PRESSURE_TOLERANCE = 1e-8
# Maximum number of steps of the iteration.
_MAX_CONTACT_STEPS = 2000


class HalfSpace(AbstractSupport):
    """An elastic half-space as the support of a skin that is thick compared with the contact.

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
        """Compute the pressure beneath `indenter` under a `load` in newtons.

        Raises `ValueError` for a load that is not positive and for indenters thinner than a pixel, and `RuntimeError`
        if the iteration does not converge.
        """
        check_load(load)

        def is_pressed(half_widths, num_pixels: int) -> np.ndarray:
            return self._solve_pressure(indenter, load, half_widths, num_pixels)[0] > 0

        half_widths = contact_window(is_pressed, indenter.reach, _NUM_COARSE_PIXELS)
        pixel_pressures, approach = self._solve_pressure(indenter, load, half_widths, self.pixels)
        pixel_centres, pixel_sides = raster(half_widths, self.pixels)
        check_resolved(pixel_pressures > 0, pixel_sides)
        contact_reach = float(
            np.linalg.norm(pixel_centres[pixel_pressures > 0], axis=-1).max() + np.hypot(*pixel_sides)
        )
        return PressureRaster(float(load), approach, contact_reach, pixel_pressures, pixel_sides)

    def spread(self, indenter: AbstractIndenter, loads, points, areas, fall=None):
        """Compute pressures (n, q) at the q points of each of n loads, scaled so that the points carry the load.

        At an edge of the skin, the points on the skin also carry the part of the load beyond the edge. Raises
        `ValueError` as `pressure` does, for a curved skin, and if less than a fifth of the load lies on the skin.
        """
        if fall is not None:
            raise ValueError("support: a HalfSpace is flat, and the skin is curved; take a Foundation.")
        unbounded_pressures = [self.pressure(indenter, load) for load in loads]
        point_pressures = np.stack(
            [
                unbounded_pressure.at(press_points)
                for unbounded_pressure, press_points in zip(unbounded_pressures, points, strict=True)
            ]
        )
        supported_loads = np.sum(point_pressures * areas, axis=1)
        for press_index in np.flatnonzero(
            (supported_loads > 0) & (supported_loads < _CHECKED_LOAD_FRACTION * np.asarray(loads))
        ):
            _check_on_skin(unbounded_pressures[press_index], points[press_index], areas[press_index])
        return (
            point_pressures
            * np.where(supported_loads > 0, loads / np.where(supported_loads > 0, supported_loads, 1.0), 0.0)[:, None]
        )

    def _solve_pressure(self, indenter: AbstractIndenter, load: float, half_widths, num_pixels: int):
        pixel_centres, pixel_sides = raster(half_widths, num_pixels)
        pixel_gaps = indenter.gap(pixel_centres)
        if not np.isfinite(pixel_gaps).any():
            return np.zeros_like(pixel_gaps), 0.0
        return rigid_contact(
            pixel_gaps, displacement_function(num_pixels, pixel_sides, self.plane_modulus), load / pixel_sides.prod()
        )


def _check_on_skin(unbounded_pressure: PressureRaster, skin_points, point_areas) -> None:
    """Raise `ValueError` if less than a fifth of a load lies on the skin, which `skin_points` (q, 2) with `point_areas`
    (q,) represent."""
    is_on_skin = point_areas > 0
    pixel_centres, pixel_sides = raster(
        unbounded_pressure.pixel * len(unbounded_pressure.values) / 2, len(unbounded_pressure.values)
    )
    skin_distances, nearest_cells = KDTree(skin_points[is_on_skin]).query(pixel_centres[unbounded_pressure.values > 0])
    pixel_forces = unbounded_pressure.values[unbounded_pressure.values > 0] * pixel_sides.prod()
    load_fraction = (
        pixel_forces[skin_distances < np.sqrt(point_areas[is_on_skin][nearest_cells])].sum() / unbounded_pressure.load
    )
    if load_fraction < _MIN_LOAD_FRACTION:
        raise ValueError(
            f"position: of {unbounded_pressure.load:g} N on a half-space, {100 * load_fraction:.0f} % of its pressure "
            f"would lie on the skin, less than {100 * _MIN_LOAD_FRACTION:.0f} %; press farther from the edge, or take "
            "a Foundation."
        )


def displacement_function(num_pixels: int, pixel, plane_modulus: float):
    """Return a function that computes the displacements (N, N) of the centres of pixels, metres, from pressures (N, N),
    pascals. `num_pixels`: N; `pixel`: sides of a pixel, metres.

    The displacement due to a rectangle under uniform pressure is that of Love (1929): Johnson, Contact Mechanics, 1985,
    equation 3.25.
    """
    pixel_indices, half_pixel = np.arange(2 * num_pixels) - num_pixels, np.asarray(pixel) / 2
    x, y = np.meshgrid(pixel[0] * pixel_indices, pixel[1] * pixel_indices)

    def corner_displacement(x, y):
        return x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y))

    influence_function = sum(
        sign_of_x * sign_of_y * corner_displacement(x + sign_of_x * half_pixel[0], y + sign_of_y * half_pixel[1])
        for sign_of_x in (1, -1)
        for sign_of_y in (1, -1)
    ) / (np.pi * plane_modulus)
    influence_spectrum = np.fft.rfft2(np.fft.ifftshift(influence_function))

    def displacements(pressure):
        pressure_spectrum = np.fft.rfft2(pressure, s=(2 * num_pixels, 2 * num_pixels))
        return np.fft.irfft2(pressure_spectrum * influence_spectrum, s=(2 * num_pixels, 2 * num_pixels))[
            :num_pixels, :num_pixels
        ]

    return displacements


def rigid_contact(gap: np.ndarray, displacements, total_pressure: float) -> tuple[np.ndarray, float]:
    """Find the pressures ≥ 0 with sum `total_pressure` whose displacements close the `gap`, metres; return the
    pressures and the approach of the bodies, metres.

    `displacements`: function that computes displacements from pressures. The gap is infinite at pixels that cannot be
    in contact. Raises `RuntimeError` if the iteration does not converge.
    """
    is_below_indenter = np.isfinite(gap)
    gap = np.where(is_below_indenter, gap, 0.0)
    contact_pressure = is_below_indenter * (total_pressure / is_below_indenter.sum())
    search_direction, previous_squared_residual, has_previous_direction = np.zeros_like(gap), 1.0, False
    for _ in range(_MAX_CONTACT_STEPS):
        is_touching = contact_pressure > 0
        gap_residual = displacements(contact_pressure) + gap
        gap_residual -= gap_residual[is_touching].mean()
        squared_residual = np.sum(gap_residual[is_touching] ** 2)
        search_direction = np.where(
            is_touching,
            gap_residual
            + (squared_residual / previous_squared_residual if has_previous_direction else 0.0) * search_direction,
            0.0,
        )
        previous_squared_residual = squared_residual
        direction_displacements = displacements(search_direction)
        direction_displacements -= direction_displacements[is_touching].mean()
        direction_curvature = np.sum(direction_displacements * search_direction)
        if (
            squared_residual == 0 or direction_curvature <= 0
        ):  # converged to rounding errors, or only one pixel is in contact
            break
        step_length = np.sum(gap_residual[is_touching] * search_direction[is_touching]) / direction_curvature
        previous_pressure, contact_pressure = (
            contact_pressure,
            np.where(is_touching, np.maximum(contact_pressure - step_length * search_direction, 0.0), 0.0),
        )
        is_overlapping = is_below_indenter & (contact_pressure == 0) & (gap_residual < 0)
        has_previous_direction = not is_overlapping.any()
        contact_pressure[is_overlapping] -= step_length * gap_residual[is_overlapping]
        contact_pressure *= total_pressure / contact_pressure.sum()
        if (
            has_previous_direction
            and np.abs(contact_pressure - previous_pressure).sum() < _PRESSURE_TOLERANCE * total_pressure
        ):
            break
    else:
        raise RuntimeError(f"the contact was not found in {_MAX_CONTACT_STEPS} steps; give the support fewer pixels.")
    return contact_pressure, float((displacements(contact_pressure) + gap)[contact_pressure > 0].mean())
