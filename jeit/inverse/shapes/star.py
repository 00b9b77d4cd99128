"""Star-shaped bodies in a sheet, or in the plane of a tank, each with an outline r(θ) around a centre.

    log r(θ) = log r₀ + Σ (aₙ cos nθ + bₙ sin nθ),  n = 2 … N.

Contrast and conductivity are defined in `jeit.inverse.shapes.bodies`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jeit.inverse.shapes.bodies import MIN_POSITIVE_VALUE, Bodies, BodyPrior, CellCoverage, Quantities
from jeit.mesh import Mesh, measures
from jeit_solvers.module import Module

# Barycentric coordinates of the six points at which a cell is sampled.
_BARYCENTRIC_SAMPLES = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2.5, 2.5, 1], [2.5, 1, 2.5], [1, 2.5, 2.5]]) / 6
# Width of the blur of an outline, in units of the cell size: large enough for the coverage to be differentiable.
_RELATIVE_BLUR_WIDTH = 0.2
# Distance from an outline, in widths of the blur, beyond which the covered share of a cell is less than 1e-12.
_MAX_BLUR_DISTANCE = 30
_NUM_OUTLINE_POINTS = 128
# Minimum effect of a star on the electric field, relative to that of a weak star of the same size.
_MIN_RELATIVE_EFFECT = 0.01


@dataclass(frozen=True)
class StarPrior(BodyPrior):
    """Prior of star-shaped bodies, for `reconstruct_shapes` in a sheet.

    **Arguments:**

    - `modes`: N, number of the highest mode of an outline; 1 gives disks.
    - `place`: standard deviation of each coordinate of a body's centre about its start, in units of the longest side of
      the domain.
    - `radius`, `radius_spread`: median of a body's mean radius, in the same unit, and standard deviation of the
      logarithm of the mean radius.
    - `drift`: standard deviation of the change of the bath's log conductivity between the two frames.
    - `apart`: reciprocal of the standard deviation of the overlap of two bodies, as a fraction of the domain.
    - `roughness`: standard deviation of the outline's coefficients a₂ and b₂; aₙ and bₙ have 2/n times this standard
      deviation.
    - `contrast`, `contrast_spread`: mean and standard deviation of the contrast in log σ of a strong body, which is at
      least ten times as conductive or resistive as the bath. Data hardly distinguish such a contrast from a higher one,
      so the mean is high and the standard deviation small.
    - `weak_contrast`, `weak_spread`: median of the contrast in log σ of a weak body, and standard deviation of its
      logarithm.
    - `odds_against_weak`: prior odds of a strong body relative to a weak one.

    **Example:**

    ```python
    disks = StarPrior(modes=1)
    reconstruct_shapes(model, voltages, 1.0, start=[(1, (0.04, 0.0), 0.03)], prior=disks).bodies
    ```
    """

    modes: int = 4
    contrast: float = 4.5
    contrast_spread: float = 0.5
    weak_contrast: float = 0.7
    weak_spread: float = 0.8
    odds_against_weak: float = 20.0

    @property
    def size(self) -> int:
        """Number of coefficients of a star: two for the centre, the log radius, the contrast, and two for each mode
        from the second."""
        return 4 + 2 * (self.modes - 1)

    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Prior standard deviations of the q parameters of a star, 1 for the contrast; `span`: longest side of the
        domain, metres."""
        mode_deviations = self.roughness * 2 / np.arange(2, self.modes + 1)
        coefficient_deviations = [self.place * span, self.place * span, self.radius_spread, 1.0]
        return np.concatenate([coefficient_deviations, np.repeat(mode_deviations, 2)])

    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast of a star in log σ, without its sign, and the derivative of the contrast with respect to its
        `coefficient`. The star is weak if `other`."""
        if not other:
            return self.contrast + self.contrast_spread * coefficient, self.contrast_spread
        body_contrast = self.weak_contrast * np.exp(self.weak_spread * coefficient)
        return body_contrast, self.weak_spread * body_contrast


class Star(Module):
    """Body with a star-shaped outline in a sheet.

    **Fields**: `sign`: +1 if more conductive than the bath, -1 if less; `centre` (2,): centre of the star, metres;
    `outline` (k, 2): points of the outline, metres, counter-clockwise; `contrast`: contrast in log σ, without its sign;
    `weak`: whether the body is weak, so that the data determine its contrast; the contrast of other bodies follows the
    prior and is roughly a lower limit; `rise`: factor by which the minimum of the objective increases without this
    body, small for a ghost; `quantities`: posterior medians and intervals of the body's properties, None if not
    estimated.

    **Example:**

    ```python
    body = Star(+1, np.array([0.04, 0.0]), np.array([[0.06, 0.0], [0.04, 0.02], [0.02, 0.0]]), 0.7, True, 3.0)
    body.area, body.centroid
    ```
    """

    sign: int
    centre: Float[np.ndarray, "2"]
    outline: Float[np.ndarray, "k 2"]
    contrast: float
    weak: bool
    rise: float
    quantities: Quantities | None = None

    @property
    def area(self) -> float:
        """Area inside the outline, m²."""
        return float(abs(self._area_moments()[0]))

    @property
    def measure(self) -> float:
        """Area inside the outline, m²."""
        return self.area

    @property
    def contrast_is_determined(self) -> bool:
        """Whether the data determine the contrast: both limits of the contrast's interval are determined or, without an
        interval, the body is weak."""
        return self.weak if self.quantities is None else None not in self.quantities.change_interval

    def with_quantities(self, known: Quantities) -> Star:
        """Copy of the body with the quantities `known`. Area and contrast become the medians, but the fitted outline
        does not change if the data do not determine how small a strong body is."""
        length_ratio = (
            1.0 if known.measure_interval[0] is None else np.sqrt(known.measure / max(self.area, MIN_POSITIVE_VALUE))
        )
        scaled_outline = self.centroid + (self.outline - self.centroid) * length_ratio
        return replace(self, outline=scaled_outline, contrast=float(np.abs(np.log1p(known.change))), quantities=known)

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Centroid of the area inside the outline, (2,) metres."""
        area, first_moment = self._area_moments()
        return first_moment / area

    def holds(self, points: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
        """Whether each of `points`, in metres, lies inside the body."""
        outline_offsets, point_offsets = self._from_centre(self.outline), self._from_centre(points)
        corner_angles = np.unwrap(np.angle(outline_offsets))
        direction_angles = corner_angles[0] + (np.angle(point_offsets) - corner_angles[0]) % (2 * np.pi)
        outline_distances = np.interp(
            direction_angles,
            np.append(corner_angles, corner_angles[0] + 2 * np.pi),
            np.abs(np.append(outline_offsets, outline_offsets[0])),
        )
        return np.abs(point_offsets) < outline_distances

    def _from_centre(self, points) -> Complex[np.ndarray, "*n"]:
        return (points[..., 0] - self.centre[0]) + 1j * (points[..., 1] - self.centre[1])

    def _area_moments(self):
        x, y = self.outline.T
        cross_products = x * np.roll(y, -1) - np.roll(x, -1) * y
        return cross_products.sum() / 2, (self.outline + np.roll(self.outline, -1, axis=0)).T @ cross_products / 6


class _StarValues(NamedTuple):
    """Parameters of a star: centre (x + iy, metres), log radius, and outline coefficients `waves` aₙ - i bₙ."""

    centre: complex
    log_radius: float
    waves: Complex[np.ndarray, " w"]


@dataclass(frozen=True)
class Stars(Bodies):
    """Star-shaped bodies on a mesh of m cells.

    **Fields**, besides those of `Bodies`: `points` (m, s): sampling points of the cells, x + iy in metres; `width`
    (m,): width of the outline's blur in each cell, metres; `edges` (b, 2): end points of the edges of the domain's
    boundary, x + iy in metres.
    """

    points: Complex[np.ndarray, "m s"]
    width: Float[np.ndarray, " m"]
    edges: Complex[np.ndarray, "b 2"]

    @classmethod
    def create(cls, mesh: Mesh, prior: BodyPrior, start, sign) -> Stars:
        """Create stars for a mesh, with starting centres `start` (k, 2), metres."""
        complex_points = np.asarray(mesh.points) @ np.array([1, 1j])
        corners, boundary_edges = complex_points[np.asarray(mesh.cells)], complex_points[np.asarray(mesh.facets)]
        body_extent = float(np.ptp(np.asarray(mesh.points), axis=0).max())
        area = np.asarray(measures(mesh))
        start = np.reshape(np.asarray(start, float), (-1, 2))
        blur_width, area_fractions = _RELATIVE_BLUR_WIDTH * np.sqrt(area), area / area.sum()
        sign, none_true = np.asarray(sign, float), np.zeros(len(start), bool)
        no_contrasts = np.full(len(start), np.nan)
        complex_points = corners @ _BARYCENTRIC_SAMPLES.T
        return cls(
            prior,
            area_fractions,
            body_extent,
            start,
            sign,
            none_true,
            none_true,
            none_true,
            no_contrasts,
            complex_points,
            blur_width,
            boundary_edges,
        )

    @property
    def odds(self) -> float:
        """Logarithm of the prior odds against those star-shaped bodies whose contrast is low."""
        return float(self.is_other_kind.sum() * np.log(self.prior.odds_against_weak))

    @property
    def num_splits(self) -> int:
        """Number of axes along which splitting a star is tried: 2."""
        return 2

    def with_other_kind(self, indices, coefficients) -> tuple[Stars, Float[np.ndarray, " n"]]:
        """Make the stars of `indices` weak, and enlarge them so that their effect on the electric field stays the same.
        Returns all stars and their coefficients."""
        coefficient_rows, is_weak = self.rows(coefficients), self.is_other_kind.copy()
        for k in indices:
            relative_strength = np.tanh(self.contrast(k, coefficient_rows[k])[0] / 2) / np.tanh(
                self.prior.weak_contrast / 2
            )
            # Of a star fitted with the other sign, it is negative.
            relative_strength = max(relative_strength, _MIN_RELATIVE_EFFECT)
            coefficient_rows[k, 2] += np.log(relative_strength) / 2 / self.prior.radius_spread
            coefficient_rows[k, 3], is_weak[k] = 0, True
        return replace(self, is_other_kind=is_weak), np.append(coefficients[0], coefficient_rows)

    def mixed_log_conductivity(self, share, contrast):
        """log σ/σ₀ of partly covered cells, 2 artanh(share · tanh(contrast / 2)), by Maxwell Garnett's formula: a
        partly covered cell has `share` times the effect of a covered cell on the electric field. Also the derivatives
        with respect to `share` and `contrast`."""
        relative_strength = np.tanh(contrast / 2)
        artanh_slope = 1 / (1 - (share * relative_strength) ** 2)
        return (
            2 * np.arctanh(share * relative_strength),
            2 * relative_strength * artanh_slope,
            artanh_slope * share * (1 - relative_strength**2),
        )

    def axis(self, k: int, row, number: int):
        """Unit vector along the longer axis of star k (`number` 0) or across it (1); along x or y for a disk."""
        wave_coefficients = self._star_values(k, row).waves
        angle = number * np.pi / 2 - (np.angle(wave_coefficients[0]) / 2 if len(wave_coefficients) else 0)
        return np.array([np.cos(angle), np.sin(angle)])

    def body(self, k: int, coefficients, rise: float = np.nan) -> Star:
        """Star k, with its outline clipped to the domain."""
        row = self.rows(coefficients)[k]
        centre, log_radius, wave_coefficients = self._star_values(k, row)
        outline_directions = np.exp(2j * np.pi * np.arange(_NUM_OUTLINE_POINTS) / _NUM_OUTLINE_POINTS)
        outline_distances = np.exp(log_radius + self._radial_wave(wave_coefficients, outline_directions)[0])
        edge_distances, is_inside = _first_crossing_distances(centre, outline_directions, self.edges)
        cells, cell_shares, _ = self.coverage(k, row)
        if not is_inside and (covered_fractions := cell_shares * self.weight[cells]).sum() > 0:
            outline_positions = centre + outline_directions * outline_distances
            centre = covered_fractions @ self.points[cells].mean(axis=1) / covered_fractions.sum()
            outline_distances, _ = _first_crossing_distances(
                centre, outline_directions, np.stack([outline_positions, np.roll(outline_positions, -1)], axis=1)
            )
            edge_distances, _ = _first_crossing_distances(centre, outline_directions, self.edges)
        outline_positions = centre + outline_directions * np.minimum(outline_distances, edge_distances)
        outline_points = np.stack([outline_positions.real, outline_positions.imag], axis=1)
        centre_point = np.array([centre.real, centre.imag])
        body_contrast = float(self.contrast(k, row)[0])
        return Star(
            int(self.sign[k]), centre_point, outline_points, body_contrast, bool(self.is_other_kind[k]), float(rise)
        )

    def _star_values(self, k: int, row) -> _StarValues:
        wave_values = self.prior.deviation(self.span)[4:] * row[4:]
        return _StarValues(
            complex(*self.centre(k, row)), self.log_radius(row), wave_values[0::2] - 1j * wave_values[1::2]
        )

    def _radial_wave(self, wave_coefficients, direction):
        """Value of Σ (aₙ cos nθ + bₙ sin nθ) and its derivative with respect to θ, for `direction` exp iθ; and the
        powers exp inθ, n = 2 … N."""
        mode_numbers = np.arange(2, self.prior.modes + 1)
        repeated_directions = np.broadcast_to(direction, (self.prior.modes, *direction.shape))
        direction_powers = np.cumprod(repeated_directions, axis=0, dtype=complex)[1:]
        wave_sums = np.tensordot(
            np.stack([wave_coefficients, 1j * mode_numbers * wave_coefficients]), direction_powers, 1
        )
        return wave_sums[0].real, wave_sums[1].real, direction_powers

    def coverage(self, k: int, row) -> CellCoverage:
        """Coverage of cells by star k, whose coefficients are `row`."""
        centre, log_radius, wave_coefficients = self._star_values(k, row)
        # Upper limit of the distance of the outline from the centre. The star does not cover cells that lie farther
        # outside than `_MAX_BLUR_DISTANCE` times the width of its blurred edge.
        max_distance = np.exp(np.minimum(log_radius + np.abs(wave_coefficients).sum(), np.log(10 * self.span)))
        cells = np.flatnonzero(np.abs(self.points[:, 0] - centre) < max_distance + _MAX_BLUR_DISTANCE * self.width)
        centre_offset, blur_width = self.points[cells] - centre, self.width[cells, None]
        distance_from_centre = np.maximum(np.abs(centre_offset), 1e-9 * self.span)
        unit_direction = centre_offset / distance_from_centre
        wave_of_direction, wave_slope, direction_powers = self._radial_wave(wave_coefficients, unit_direction)
        radius = np.exp(np.minimum(log_radius + wave_of_direction, np.log(10 * self.span)))
        inside_fraction = 0.5 * (1 + np.tanh(0.5 * (radius - distance_from_centre) / blur_width))
        # d share / d(r - distance)
        share_slope = inside_fraction * (1 - inside_fraction) / blur_width / len(_BARYCENTRIC_SAMPLES)
        # If the centre moves by dz, the distance decreases by Re(dz/u) and θ by Im(dz/u) / distance, with the
        # `unit_direction` u.
        centre_slopes = (share_slope * (1 - 1j * radius * wave_slope / distance_from_centre) * unit_direction).sum(
            axis=1
        )
        radius_slopes = share_slope * radius
        mode_slopes = np.einsum("ms,nms->mn", radius_slopes, direction_powers)
        cell_shares = inside_fraction.mean(axis=1)
        slope_columns = [centre_slopes.real, centre_slopes.imag, radius_slopes.sum(axis=1), np.zeros_like(cell_shares)]
        slope_columns += [mode_component for mode in mode_slopes.T for mode_component in (mode.real, mode.imag)]
        return CellCoverage(cells, cell_shares, np.stack(slope_columns, axis=1) * self.prior.deviation(self.span))


def _first_crossing_distances(centre: complex, direction, edges) -> tuple[Float[np.ndarray, " k"], bool]:
    """Distances (k,) from `centre` at which the ray in each `direction` (k,) first crosses `edges` (b, 2), infinite if
    the ray crosses none; and whether the closed line formed by the edges encloses `centre`."""
    edge_starts, edge_vectors = edges[:, 0] - centre, edges[:, 1] - edges[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross_products = _cross_products(direction[:, None], edge_vectors)
        crossing_distance, edge_fraction = (
            _cross_products(edge_starts, edge_vectors) / cross_products,
            _cross_products(edge_starts, direction[:, None]) / cross_products,
        )
    is_edge_crossed = (crossing_distance > 0) & (edge_fraction >= 0) & (edge_fraction < 1)
    return np.where(is_edge_crossed, crossing_distance, np.inf).min(axis=1), bool(
        (is_edge_crossed.sum(axis=1) % 2).mean() > 0.5
    )


def _cross_products(first_vectors, second_vectors):
    return (np.conj(first_vectors) * second_vectors).imag
