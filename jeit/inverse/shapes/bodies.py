"""Base classes of bodies (inclusions in a domain), whose coefficients determine the conductivity of the cells.

    log σ/σ₀ = drift + Σ_bodies mixture(share, ± contrast),

where σ₀ is the background, `share` the fraction of a cell that a body covers, and the drift a change of the bath, the
medium around the bodies. For a completely covered cell the mixture equals ± contrast. Every coefficient is in units of
its prior standard deviation, so the penalty is ½‖coefficients‖².
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import describe, is_number
from jeit.arguments.checks import Interval
from jeit_solvers import results_on_cores

# Step of the finite differences of a centroid, in standard deviations of a coefficient.
_CENTROID_DIFFERENCE_STEP = 0.1
# Fields of `Bodies`, except `start`, that have one value per body.
_FIELDS_PER_BODY = ("sign", "is_other_kind", "is_kind_certain", "same_material", "fixed_contrast")


@dataclass(frozen=True)
class BodyPrior(abc.ABC):
    """Normal prior of bodies. Lengths are in units of the longest side of the domain.

    - `modes`: number of modes that describe a body's form; 1 gives disks and balls.
    - `place`: standard deviation of each coordinate of a body's centre about its start.
    - `radius`, `radius_spread`: median of a body's mean radius, and standard deviation of the logarithm of the mean
      radius.
    - `roughness`: standard deviation of the coefficients that describe departures of the form from a disk or ball.
    - `drift`: standard deviation of the change of the bath's log conductivity between the two frames.
    - `apart`: reciprocal of the standard deviation of the overlap of two bodies, as a fraction of the domain. Without
      this penalty on overlap, two bodies of opposite sign could lie on each other and cancel.

    Raises `ValueError` if a value is not positive.
    """

    modes: int
    place: float = 0.15
    radius: float = 0.12
    radius_spread: float = 0.5
    roughness: float = 0.25
    drift: float = 0.1
    apart: float = 1e3

    def __post_init__(self):
        for name, parameter_value in self._numeric_parameters.items():
            if not (is_number(parameter_value) and parameter_value > 0):
                raise ValueError(f"{name} must be a positive number; it is {describe(parameter_value)}.")
        if self.modes != int(self.modes):
            raise ValueError(f"modes must be a whole number from 1; it is {describe(self.modes)}.")

    @property
    def _numeric_parameters(self) -> dict[str, Any]:
        """Fields of the prior whose values must be positive, by name."""
        return vars(self)

    @property
    def is_of_one_kind(self) -> bool:
        """Whether the prior admits only one of the two kinds of bodies."""
        return False

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Number of coefficients of a body, for its centre, log radius, contrast and form."""

    @abc.abstractmethod
    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Prior standard deviations of the q parameters of a body; 1 for the contrast, whose scale is applied in
        `contrast_of`.

        `span`: longest side of the domain, metres.
        """

    @abc.abstractmethod
    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast of a body in log σ, without its sign, and the derivative of the contrast with respect to its
        `coefficient`.

        `other`: whether the body is of the other kind, a weak star or a column.
        """


@dataclass(frozen=True)
class Quantities:
    """Posterior medians and 68 % intervals of the properties of a body. A limit of an interval that the data do not
    determine is None.

    **Fields**: `change`, `change_interval`: change of conductivity relative to the background; `measure`,
    `measure_interval`: area, m², or volume, m³; `strength`, `strength_interval`: `measure` times (ρ - 1) / (ρ + n - 1),
    where ρ is the conductivity relative to the background and n the number of axes along which the body is bounded (2
    in a sheet and for a column, else 3); the strength is negative for resistive bodies; `centroid_radius`: radius,
    metres, of the circle (in a solid, of the ball) about the centroid that contains the true centroid with a
    probability of 68 %.

    **Example:**

    ```python
    known = Quantities(1.0, (0.8, 1.3), 2.8e-3, (2.2e-3, 3.5e-3), 9e-4, (8e-4, 1e-3), centroid_radius=5e-4)
    known.change_interval
    ```
    """

    change: float
    change_interval: Interval
    measure: float
    measure_interval: Interval
    strength: float
    strength_interval: Interval
    centroid_radius: float = float("nan")


MIN_POSITIVE_VALUE = 1e-30
"""Minimum area, m², or volume, m³, which replaces that of a body that has left the domain."""


def polarisation(contrast, axes: int):
    """Strength of a round body per area or volume, (ρ - 1) / (ρ + n - 1), for the conductivity ratio ρ = e^`contrast`
    and n = `axes`, the number of axes along which the body is bounded. Ammari and Kang, Polarization and Moment Tensors
    (2007), chapter 4."""
    return np.expm1(contrast) / (np.exp(contrast) + axes - 1)


def results_of_parts(bodies: Bodies, function: Callable[[Any], Any], parts: Sequence[Any]) -> list[Any]:
    """Results of a `function` that fits `bodies`, for each of its `parts`: on several cores in a solid. The arrays of a
    sheet are so small that several threads would mostly wait for each other in Python."""
    return (
        results_on_cores(function, parts)
        if bodies.dimension == 3
        else [function(argument_part) for argument_part in parts]
    )


class BodyImage(NamedTuple):
    """Image of the conductivity of bodies, and derivatives of the image.

    **Fields**: `image` (m,): log σ/σ₀; `slopes`: pairs of cells and derivatives of the image in these cells, first with
    respect to the drift in all cells (None), then with respect to each body's coefficients in the cells that the body
    reaches; `overlap`: overlap of every pair of bodies, as a fraction of the domain; `overlap_slope`: derivatives of
    the overlap with respect to the drift and the coefficients of every body.
    """

    image: Float[np.ndarray, " m"]
    slopes: Sequence[tuple[Any, Float[np.ndarray, "k q"]]]
    overlap: Float[np.ndarray, " p"]
    overlap_slope: Float[np.ndarray, "p n"]


class CellCoverage(NamedTuple):
    """Coverage of cells by a body.

    **Fields**: `cells` (c,): indices of the cells that the body reaches; `share` (c,): fraction of each of these cells
    that the body covers; `slope` (c, q): derivatives of `share` with respect to the body's coefficients.
    """

    cells: Any
    share: Float[np.ndarray, " c"]
    slope: Float[np.ndarray, "c q"]


@dataclass(frozen=True)
class Bodies(abc.ABC):
    """k bodies of one form, stars or ellipsoids. The n coefficients are the drift, then for each body the centre, log
    radius, contrast and form.

    **Fields**: `prior`: prior of every body; `weight` (m,): measure of each cell as a fraction of the domain; `span`:
    longest side of the domain, metres; `start` (k, d): starting centres, metres; `sign` (k,): +1 for bodies more
    conductive than the bath, -1 for less; `is_other_kind` (k,): whether a body is of the other kind (weak for stars, a
    column for ellipsoids); `is_kind_certain` (k,): whether the data exclude the body of the other kind, so that it is
    not tried again; `same_material` (k,): whether a body is of the same material as all other marked bodies of its
    sign, in which case the contrast coefficient of the first such body applies to all of them; `fixed_contrast` (k,):
    contrast that replaces the one from the coefficient, NaN where the contrast is estimated.
    """

    prior: Any
    weight: Float[np.ndarray, " m"]
    span: float
    start: Float[np.ndarray, "k d"]
    sign: Float[np.ndarray, " k"]
    is_other_kind: Bool[np.ndarray, " k"]
    is_kind_certain: Bool[np.ndarray, " k"]
    same_material: Bool[np.ndarray, " k"]
    fixed_contrast: Float[np.ndarray, " k"]

    @property
    @abc.abstractmethod
    def odds(self) -> float:
        """Logarithm of the prior odds against the kinds of the bodies."""

    @property
    @abc.abstractmethod
    def num_splits(self) -> int:
        """Number of axes along which splitting a body in two is tried, the longest first."""

    @abc.abstractmethod
    def with_other_kind(
        self, indices: Any, coefficients: Float[np.ndarray, " n"]
    ) -> tuple[Self, Float[np.ndarray, " n"]]:
        """Change the bodies of `indices` to the other kind, with nearly the same effect on the voltages. Returns all
        bodies and their coefficients."""

    @abc.abstractmethod
    def mixed_log_conductivity(self, share: Float[np.ndarray, " c"], contrast: float) -> tuple[Any, Any, Any]:
        """log σ/σ₀ (c,) of cells of which a body with signed `contrast` covers the fraction `share`; and the
        derivatives of log σ/σ₀ with respect to `share` and `contrast`."""

    @abc.abstractmethod
    def coverage(self, k: int, row: Float[np.ndarray, " q"]) -> CellCoverage:
        """Coverage of cells by body k, whose coefficients are `row`."""

    @abc.abstractmethod
    def axis(self, k: int, row: Float[np.ndarray, " q"], number: int) -> Float[np.ndarray, " d"]:
        """Unit vector along axis `number` of body k, counted from the longest."""

    @abc.abstractmethod
    def body(self, k: int, coefficients: Float[np.ndarray, " n"], rise: float = np.nan) -> Any:
        """Description of body k, such as a `Star`. The area or volume is that of the part inside the domain."""

    def centroid_slope(self, k: int, coefficients, deviations: Float[np.ndarray, " q"]) -> Float[np.ndarray, "d q"]:
        """Derivatives of the centroid of body k with respect to its q coefficients, metres, by finite differences over
        a part of the coefficients' standard `deviations`."""
        coefficient_slopes = []
        for index, coefficient_deviation in enumerate(deviations):
            coefficient_step = np.zeros(len(coefficients))
            coefficient_step[1 + k * self.prior.size + index] = _CENTROID_DIFFERENCE_STEP * coefficient_deviation
            shifted_centroids = [
                self.body(k, coefficients + step_sign * coefficient_step).centroid for step_sign in (-1, 1)
            ]
            coefficient_slopes.append(
                (shifted_centroids[1] - shifted_centroids[0]) / (2 * _CENTROID_DIFFERENCE_STEP * coefficient_deviation)
            )
        return np.stack(coefficient_slopes, axis=1)

    @property
    def dimension(self) -> int:
        """Spatial dimension d."""
        return self.start.shape[1]

    def bounded_axes(self, k: int) -> int:
        """Number of axes along which body k is bounded."""
        return self.dimension

    @property
    def first(self) -> Int[np.ndarray, " k"]:
        """For each body, index of the body whose contrast coefficient applies: the body itself, or the first body of
        its material."""
        body_indices, first_of_material = np.arange(len(self.sign)), np.arange(len(self.sign))
        for has_same_sign in (self.same_material & (self.sign == sign) for sign in (-1, 1)):
            first_of_material[has_same_sign] = body_indices[has_same_sign].min(initial=len(body_indices))
        return first_of_material

    def rows(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k q"]:
        """Coefficients of every body, one row per body, with shared contrast coefficients filled in."""
        coefficient_rows = coefficients[1:].reshape(len(self.sign), self.prior.size).copy()
        coefficient_rows[:, self.dimension + 1] = coefficient_rows[self.first, self.dimension + 1]
        return coefficient_rows

    def by_coefficients(self, row_derivatives: Float[np.ndarray, "r n"]) -> Float[np.ndarray, "r n"]:
        """Convert derivatives with respect to the drift and the coefficients returned by `rows` to derivatives with
        respect to the coefficients, in which bodies of the same material share a contrast coefficient."""
        row_derivatives, body_indices = row_derivatives.copy(), np.arange(len(self.sign))
        contrast_columns = 1 + body_indices * self.prior.size + self.dimension + 1
        for k in body_indices[self.first != body_indices]:
            row_derivatives[:, contrast_columns[self.first[k]]] += row_derivatives[:, contrast_columns[k]]
            row_derivatives[:, contrast_columns[k]] = 0
        return row_derivatives

    def of_radii(self, radii) -> Float[np.ndarray, " n"]:
        """Coefficients of disks or balls with these `radii` in metres at the starting centres."""
        coefficient_rows = np.zeros((len(self.sign), self.prior.size))
        relative_log_radii = (
            np.log(np.asarray(radii, float) / (self.prior.radius * self.span)) / self.prior.radius_spread
        )
        coefficient_rows[:, self.dimension] = np.clip(relative_log_radii, -2, 2)
        return np.append(0, coefficient_rows)

    def centre(self, k: int, row: Float[np.ndarray, " q"]) -> Float[np.ndarray, " d"]:
        """Centre of body k in metres."""
        return self.start[k] + self.prior.place * self.span * row[: self.dimension]

    def log_radius(self, row: Float[np.ndarray, " q"]) -> float:
        """Logarithm of the mean radius of a body in metres."""
        return np.log(self.prior.radius * self.span) + self.prior.radius_spread * row[self.dimension]

    def contrast(self, k: int, row: Float[np.ndarray, " q"]) -> tuple[float, float]:
        """Contrast of body k in log σ, without its sign, and the derivative of the contrast with respect to its
        coefficient."""
        if np.isfinite(self.fixed_contrast[k]):
            return float(self.fixed_contrast[k]), 0.0
        return self.prior.contrast_of(row[self.dimension + 1], bool(self.is_other_kind[k]))

    def display_image(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """Image log σ/σ₀ (m,) of the bodies, for display."""
        return self.image(coefficients).image

    def subset(self, indices) -> Self:
        """Copy with only the bodies of `indices`."""
        indices = np.asarray(indices, int)
        return replace(self, **{name: getattr(self, name)[indices] for name in ("start", *_FIELDS_PER_BODY)})

    def without(self, k: int, coefficients) -> tuple[Self, Float[np.ndarray, " n"]]:
        """All bodies except body k, and their coefficients."""
        other_bodies = self.subset(np.delete(np.arange(len(self.sign)), k))
        return other_bodies, np.append(coefficients[0], np.delete(self.rows(coefficients), k, axis=0))

    def split(self, k: int, coefficients, number: int) -> tuple[Self, Float[np.ndarray, " n"]]:
        """Replace body k by two round bodies of half its area or volume each, side by side along axis `number`.

        Returns the bodies, the two new bodies last, and the coefficients of all bodies.
        """
        other_bodies, remaining_coefficients = self.without(k, coefficients)
        row, dimension = self.rows(coefficients)[k], self.dimension
        row_of_half = np.zeros(self.prior.size)
        row_of_half[dimension : dimension + 2] = row[dimension : dimension + 2]
        row_of_half[dimension] -= np.log(2) / dimension / self.prior.radius_spread
        centre_offset = np.exp(self.log_radius(row_of_half)) * self.axis(k, row, number)
        if dimension == 3:
            centre_offset = centre_offset * 2 ** (-1 / 3)  # somewhat farther out than the centroids of the two halves
        centre = self.centre(k, row)
        start_centres = np.concatenate([other_bodies.start, [centre + centre_offset, centre - centre_offset]])
        other_fields = {
            name: np.append(getattr(other_bodies, name), [getattr(self, name)[k]] * 2) for name in _FIELDS_PER_BODY
        }
        other_fields["is_kind_certain"][-2:] = False
        return replace(self, start=start_centres, **other_fields), np.concatenate(
            [remaining_coefficients, row_of_half, row_of_half]
        )

    def with_modes(self, modes: int, coefficients) -> tuple[Self, Float[np.ndarray, " n"]]:
        """The bodies with a different number of modes of their form, and their coefficients; the coefficients of added
        modes are zero."""
        new_bodies = replace(self, prior=replace(self.prior, modes=modes))
        coefficient_rows = np.zeros((len(self.sign), new_bodies.prior.size))
        num_shared = min(new_bodies.prior.size, self.prior.size)
        coefficient_rows[:, :num_shared] = self.rows(coefficients)[:, :num_shared]
        return new_bodies, np.append(coefficients[0], coefficient_rows)

    def image(self, coefficients) -> BodyImage:
        """Compute the image log σ/σ₀ per cell, the overlaps of the bodies, and the derivatives of image and overlaps
        with respect to the coefficients."""
        num_cells, dimension = len(self.weight), self.dimension
        coefficient_rows = self.rows(coefficients)
        coverages = [self.coverage(k, row) for k, row in enumerate(coefficient_rows)]
        drift_slope, all_cells = np.full((num_cells, 1), self.prior.drift), None
        image = coefficients[0] * drift_slope[:, 0]
        image_slopes: list[tuple[Any, Any]] = [(all_cells, drift_slope)]
        cell_shares = np.zeros((len(coverages), num_cells))
        for k, (cells, cell_share, coverage_slope) in enumerate(coverages):
            signed_contrast, contrast_slope = (
                self.sign[k] * contrast_value for contrast_value in self.contrast(k, coefficient_rows[k])
            )
            body_image, share_slope, mixture_slope = self.mixed_log_conductivity(cell_share, signed_contrast)
            image[cells] += body_image
            body_slope = share_slope[:, None] * coverage_slope
            body_slope[:, dimension + 1] = mixture_slope * contrast_slope
            image_slopes.append((cells, body_slope))
            cell_shares[k, cells] = cell_share
        pair_overlaps, pair_overlap_slopes = [], []
        weighted_shares = self.weight * cell_shares
        for j, k in itertools.combinations(range(len(coverages)), 2):
            row_slopes = np.zeros((len(coverages), self.prior.size))
            for body, other_body in ((j, k), (k, j)):
                cells, _, coverage_slope = coverages[body]
                row_slopes[body] = weighted_shares[other_body, cells] @ coverage_slope
            pair_overlaps.append(weighted_shares[j] @ cell_shares[k])
            pair_overlap_slopes.append(np.append(0, row_slopes))
        return BodyImage(
            image, image_slopes, np.array(pair_overlaps), np.reshape(pair_overlap_slopes, (-1, len(coefficients)))
        )
