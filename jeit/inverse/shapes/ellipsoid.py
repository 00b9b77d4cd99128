"""Ellipsoids and columns as bodies in a solid.

An ellipsoid is the image of the unit ball under r exp(S), with a symmetric matrix S of zero trace. A column extends
through the whole height of the domain; its cross-section is an ellipse of area π r².

Contrast and conductivity are defined in `jeit.inverse.shapes.bodies`. The derivative of the matrix exponential is
computed from eigenvectors: Higham, Functions of Matrices (SIAM 2008), section 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_name
from jeit.inverse.shapes.bodies import MIN_POSITIVE_VALUE, Bodies, BodyPrior, CellCoverage, Quantities, polarisation
from jeit.mesh import Mesh, measures
from jeit_solvers.module import Module

KINDS = ("either", "ellipsoids", "columns")
"""Kinds of bodies that a solid may contain: ellipsoids, columns through its whole height, or either."""

# Barycentric coordinates of the twenty points at which a cell is sampled; all represent equal parts of the cell.
_BARYCENTRIC_SAMPLES = (
    np.array([[2 * n + 1 for n in indices] for indices in np.ndindex(4, 4, 4, 4) if sum(indices) == 3]) / 10
)
# Width of the blur of a surface, in units of the cell size: large enough for the coverage to be differentiable, but
# small, because the estimates of blurred bodies are too small and too strong.
_RELATIVE_BLUR_WIDTH = 0.1
# Exponents of the power mean of the conductivities of body and bath in cells that a surface cuts, for bodies more (1)
# and less (-1) conductive than the bath. With edges of half the radius, the change of voltages due to balls 0.1 to 12
# times as conductive as the bath then agrees within 1 to 5 % with that on meshes whose facets follow the surface. With
# a single exponent of 0.15, the change due to balls of 12 times the conductivity was 13 to 19 % too large, an error
# proportional to the edge length.
_POWER_MEAN_EXPONENTS = {1: -1.0, -1: 0.5}
# Distance from a surface within which cells are refined, in units of the body's shortest half axis.
_RELATIVE_REFINEMENT_DISTANCE = 0.1
# Lower limit of the shortest half axis, in units of the geometric mean of the three.
_MIN_AXIS_RATIO = 0.6
# Distance from a surface, in widths of the blur, beyond which the covered share of a cell is less than 1e-8.
_MAX_BLUR_DISTANCE = 20
# Orthonormal basis of the symmetric matrices S of zero trace.
_STRETCH_BASIS = np.array(
    [
        np.diag([1, -1, 0]) / np.sqrt(2),
        np.diag([1, 1, -2]) / np.sqrt(6),
        np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]]) / np.sqrt(2),
    ]
)
# 1 for the elements of this basis that stretch a column: those within the x-y plane that have no trace in this plane.
_IS_COLUMN_STRETCH = np.array([1.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class EllipsoidPrior(BodyPrior):
    """Prior of ellipsoids and columns, for `reconstruct_shapes` in a solid.

    **Arguments:**

    - `modes`: 2 for ellipsoids, 1 for balls.
    - `place`, `radius`, `radius_spread`, `drift`, `apart`: as in `StarPrior`; `place` is small, because smooth images
      of solids locate bodies well.
    - `roughness`: standard deviation of the five coefficients of the log stretch S.
    - `contrast`, `contrast_spread`: median of the contrast in log σ, and standard deviation of its logarithm.
    - `odds_for_columns`: prior odds of a column relative to an ellipsoid; most tanks contain columns.
    - `odds_for_one_material`: prior odds of one material for all bodies of a sign, relative to a different material for
      each body.
    - `kinds`: kinds of bodies considered, one of `KINDS`.

    Raises `ValueError` if a number is not positive or `kinds` is not in `KINDS`.

    **Example:**

    ```python
    balls = EllipsoidPrior(modes=1)
    ```
    """

    modes: int = 2
    place: float = 0.04
    contrast: float = 1.5
    contrast_spread: float = 0.7
    odds_for_columns: float = 20.0
    odds_for_one_material: float = 3.0
    kinds: str = KINDS[0]

    def __post_init__(self):
        super().__post_init__()
        check_name("kinds", self.kinds, KINDS)

    @property
    def _numeric_parameters(self):
        return {name: parameter_value for name, parameter_value in vars(self).items() if name != "kinds"}

    @property
    def is_of_one_kind(self) -> bool:
        """Whether only one kind of body is considered."""
        return self.kinds != KINDS[0]

    @property
    def size(self) -> int:
        """Number of coefficients of a body: centre, log radius, contrast and, except for balls, five stretches."""
        return 5 + 5 * (self.modes > 1)

    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Prior standard deviations of a body's parameters, 1 for the contrast; `span`: longest side of the domain,
        metres."""
        coefficient_deviations = [self.place * span] * 3 + [self.radius_spread, 1.0]
        return np.concatenate([coefficient_deviations, np.full(self.size - 5, self.roughness)])

    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast of a body in log σ, without its sign, and its derivative with respect to the `coefficient`; the same
        for both kinds."""
        body_contrast = self.contrast * np.exp(self.contrast_spread * coefficient)
        return body_contrast, self.contrast_spread * body_contrast


class Ellipsoid(Module):
    """Ellipsoid or column in a solid.

    **Fields**: `sign`: +1 if more conductive than the bath, -1 if less; `centre` (3,): centre, metres; `axes` (3, 3):
    half axes as rows, metres, the longest first; `volume`, `centroid` (3,): volume in m³ and centroid in metres of the
    part inside the domain; `contrast`: contrast in log σ, without its sign; `column`: whether the body is a column, one
    of whose half axes is half the domain's height; `alike`: whether the body is assumed to be of the same material as
    other bodies of its sign; `rise`: factor by which the minimum of the objective increases without this body, small
    for a ghost; `quantities`: posterior medians and intervals of the body's properties, None if not estimated.

    **Example:**

    ```python
    body = Ellipsoid(+1, np.zeros(3), 0.02 * np.eye(3), 3.4e-5, np.zeros(3), 1.0, column=False, alike=False, rise=2.0)
    body.holds([[0.0, 0.0, 0.01]])
    ```
    """

    sign: int
    centre: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    volume: float
    centroid: Float[np.ndarray, "3"]
    contrast: float
    column: bool
    alike: bool
    rise: float
    quantities: Quantities | None = None

    @property
    def measure(self) -> float:
        """Volume of the part of the body inside the domain, m³."""
        return self.volume

    @property
    def bounded_axes(self) -> int:
        """Number of axes along which the body is bounded: 2 for a column, else 3."""
        return 2 if self.column else 3

    @property
    def contrast_is_determined(self) -> bool:
        """Whether the data determine the contrast: both limits of its interval are determined, or no interval was
        estimated."""
        return self.quantities is None or None not in self.quantities.change_interval

    def with_quantities(self, known: Quantities) -> Ellipsoid:
        """Copy of the body with the quantities `known`; volume and contrast become the medians."""
        length_ratio = (known.measure / max(self.volume, MIN_POSITIVE_VALUE)) ** (1 / self.bounded_axes)
        is_upright = self.column & (np.abs(self.axes[:, 2]) > 0.5 * np.linalg.norm(self.axes, axis=1))
        return replace(
            self,
            axes=self.axes * np.where(is_upright, 1.0, length_ratio)[:, None],
            volume=known.measure,
            contrast=float(np.abs(np.log1p(known.change))),
            quantities=known,
        )

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether each of `points`, in metres, lies inside the body."""
        squared_lengths = (self.axes**2).sum(axis=1)
        relative_position = (points - self.centre) @ self.axes.T / squared_lengths
        if self.column:
            relative_position = relative_position[..., np.abs(self.axes[:, 2]) < 0.5 * np.sqrt(squared_lengths)]
        return (relative_position**2).sum(axis=-1) < 1


@dataclass(frozen=True)
class Ellipsoids(Bodies):
    """Ellipsoids and columns on a mesh of m cells.

    **Fields**, besides those of `Bodies`: `points` (3, m, s): sampling points of the cells, metres; `width` (m,): width
    of the surfaces' blur, metres; `total`: volume of the domain, m³; `ends`: lowest and highest z, metres.
    """

    points: Float[np.ndarray, "3 m s"]
    width: Float[np.ndarray, " m"]
    total: float
    ends: tuple[float, float]

    @classmethod
    def create(cls, mesh: Mesh, prior: BodyPrior, start, sign) -> Ellipsoids:
        """Create ellipsoids for a mesh, with starting centres `start` (k, 3), metres."""
        points, volume = np.asarray(mesh.points), np.asarray(measures(mesh))
        samples = points.T[:, np.asarray(mesh.cells)] @ _BARYCENTRIC_SAMPLES.T
        start, total = np.reshape(np.asarray(start, float), (-1, 3)), float(volume.sum())
        sign, all_false = np.asarray(sign, float), np.zeros(len(start), bool)
        nans = np.full(len(start), np.nan)
        span, ends = float(np.ptp(points, axis=0).max()), (float(points[:, 2].min()), float(points[:, 2].max()))
        width = _RELATIVE_BLUR_WIDTH * np.cbrt(volume)
        return cls(
            prior, volume / total, span, start, sign, all_false, all_false, all_false, nans, samples, width, total, ends
        )

    def bounded_axes(self, k: int) -> int:
        """Number of axes along which body k is bounded: 2 for a column, else 3."""
        return 2 if self.is_other_kind[k] else 3

    @property
    def odds(self) -> float:
        """Logarithm of the prior odds against the bodies' kinds and materials; negative for columns and for bodies
        that share a material, which are likelier a priori."""
        num_shared_materials = len(set(self.sign[self.first != np.arange(len(self.sign))]))
        num_columns = 0 if self.prior.is_of_one_kind else self.is_other_kind.sum()
        log_odds = np.log([self.prior.odds_for_columns, self.prior.odds_for_one_material])
        return -float(log_odds @ [num_columns, num_shared_materials])

    @property
    def num_splits(self) -> int:
        """Number of axes along which a split is tried: 1, the longest, because two adjacent bodies fitted as one body
        form a long body, and each trial requires tens of forward solves."""
        return 1

    def with_other_kind(self, indices, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """Change the bodies of `indices` from ellipsoid to column or back, at the same volume. Stretches that the new
        kind does not have are set to zero. Returns all bodies and their coefficients."""
        body_rows, is_column = self.rows(coefficients), self.is_other_kind.copy()
        for k in indices:
            volume = max(self.body(k, coefficients).volume, 1e-6 * self.total) / np.pi
            radius = np.cbrt(3 / 4 * volume) if is_column[k] else np.sqrt(volume / (self.ends[1] - self.ends[0]))
            body_rows[k, 3] = np.log(radius / (self.prior.radius * self.span)) / self.prior.radius_spread
            body_rows[k, 2], is_column[k] = 0, not is_column[k]
            body_rows[k, 5:] *= _IS_COLUMN_STRETCH[: self.prior.size - 5]
        return replace(self, is_other_kind=is_column), np.append(coefficients[0], body_rows)

    def of_one_material(self, sign: int, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """Assign one material to all bodies of a `sign`, with the mean of their contrast coefficients and with radii
        changed so that the strengths stay the same. Returns all bodies and their coefficients."""
        body_rows, body_indices, column = self.rows(coefficients), np.flatnonzero(self.sign == sign), self.dimension + 1
        old_coefficients = body_rows[:, column].copy()
        body_rows[body_indices, column] = old_coefficients[body_indices].mean()
        for k in body_indices.tolist():
            new_strength, old_strength = (
                polarisation(sign * self.prior.contrast_of(coefficient, False)[0], self.bounded_axes(k))
                for coefficient in (body_rows[k, column], old_coefficients[k])
            )
            body_rows[k, 3] += np.log(old_strength / new_strength) / self.bounded_axes(k) / self.prior.radius_spread
        return replace(self, same_material=self.same_material | (self.sign == sign)), np.append(
            coefficients[0], body_rows
        )

    def mixed_log_conductivity(self, share, contrast):
        """log(1 + share (exp(p contrast) - 1)) / p, the power mean of body and bath: harmonic (p = -1) for a conductive
        body, p = 1/2 for a resistive one. Also its derivatives with respect to `share` and `contrast`."""
        exponent = _POWER_MEAN_EXPONENTS[1 if contrast > 0 else -1]
        rise = np.expm1(exponent * contrast)
        power_mean = 1 + share * rise
        return np.log(power_mean) / exponent, rise / (exponent * power_mean), share * (1 + rise) / power_mean

    def display_image(self, coefficients) -> Float[np.ndarray, " m"]:
        """Image log σ/σ₀ (m,) of the bodies, for display. Partly covered cells have the geometric mean of body and
        bath, so log σ on a surface is halfway between the two; voltages are computed with `mixed_log_conductivity`
        instead."""
        image = np.full(len(self.weight), coefficients[0] * self.prior.drift)
        for k, row in enumerate(self.rows(coefficients)):
            cells, cell_shares, _ = self.coverage(k, row)
            image[cells] += cell_shares * self.sign[k] * self.contrast(k, row)[0]
        return image

    def on(self, mesh: Mesh) -> Ellipsoids:
        """Copy of the bodies on another mesh of the same domain."""
        bodies = Ellipsoids.create(mesh, self.prior, self.start, self.sign)
        names = "is_other_kind", "is_kind_certain", "same_material", "span"
        return replace(bodies, **{name: getattr(self, name) for name in names})

    def edges(self, coefficients, edge: float, corners: Float[np.ndarray, "m 4 3"]) -> Float[np.ndarray, " m"]:
        """Maximum edge length in metres of cells with these `corners`: `edge` times the shortest half axis at the
        surface of a body, infinite elsewhere."""
        max_lengths = np.full(len(corners), np.inf)
        for k, row in enumerate(self.rows(coefficients)):
            shape_matrix, corner_offset = self._shape_matrix(k, row), (corners - self.centre(k, row)) * self._axes_of(k)
            shortest_axis = self._min_axis(shape_matrix)
            centre_distance = np.linalg.norm(corner_offset, axis=2)
            scaled_distance = np.linalg.norm(corner_offset @ np.linalg.inv(shape_matrix), axis=2)
            distance_outside = centre_distance - centre_distance / np.maximum(scaled_distance, 1e-9)
            min_distance, max_distance = distance_outside.min(axis=1), distance_outside.max(axis=1)
            # The corners surround a body smaller than a cell.
            encloses_body = centre_distance.min(axis=1) < max_distance - min_distance
            is_near_surface = ((min_distance < _RELATIVE_REFINEMENT_DISTANCE * shortest_axis) | encloses_body) & (
                max_distance > -_RELATIVE_REFINEMENT_DISTANCE * shortest_axis
            )
            max_lengths[is_near_surface] = np.minimum(max_lengths[is_near_surface], edge * shortest_axis)
        return max_lengths

    def left_refined_cells(self, coefficients, other_bodies: Bodies, new_coefficients) -> bool:
        """Whether a surface has left the cells that were refined for it, a body was removed, or a body changed kind,
        between these bodies with `coefficients` and the bodies `other_bodies` with `new_coefficients`."""
        if not np.array_equal(self.is_other_kind, other_bodies.is_other_kind):
            return True
        for k, (row, new_row) in enumerate(
            zip(self.rows(coefficients), other_bodies.rows(new_coefficients), strict=True)
        ):
            centre_shift = np.linalg.norm((self.centre(k, row) - other_bodies.centre(k, new_row)) * self._axes_of(k))
            shape_matrix = self._shape_matrix(k, row)
            if centre_shift + np.linalg.norm(
                shape_matrix - self._shape_matrix(k, new_row), 2
            ) > 2 * _RELATIVE_REFINEMENT_DISTANCE * self._min_axis(shape_matrix):
                return True
        return False

    def _axes_of(self, k: int) -> Float[np.ndarray, "3"]:
        """Mask of the axes along which body k is bounded: 1 for x, y and, unless body k is a column, z; else 0."""
        return np.array([1.0, 1.0, 0.0 if self.is_other_kind[k] else 1.0])

    def _shape_matrix(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """Matrix r exp(S), metres, which maps the unit ball to the body."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        return (direction * np.exp(self.log_radius(row) + log_stretch)) @ direction.T

    @staticmethod
    def _min_axis(matrix: Float[np.ndarray, "3 3"]) -> float:
        """Shortest half axis in metres, at least `_MIN_AXIS_RATIO` times the geometric mean of the three."""
        axes = np.linalg.eigvalsh(matrix)
        return float(max(axes[0], _MIN_AXIS_RATIO * np.cbrt(axes.prod())))

    def axis(self, k: int, row, number: int):
        """Unit vector along axis `number` of body k, counted from the longest; for a column, along an axis of its
        cross-section."""
        shape_matrix = self._shape_matrix(k, row) * self._axes_of(k)
        return np.linalg.eigh(shape_matrix)[1][:, 2 - number]

    def body(self, k: int, coefficients, rise: float = np.nan) -> Ellipsoid:
        """Body k as an `Ellipsoid`, with volume and centroid of the part inside the domain."""
        row = self.rows(coefficients)[k]
        cells, cell_shares, _ = self.coverage(k, row)
        volume_fractions = cell_shares * self.weight[cells]
        centre, volume = self.centre(k, row), float(volume_fractions.sum()) * self.total
        centroid = (
            self.points[:, cells].mean(axis=2) @ volume_fractions / volume_fractions.sum() if volume > 0 else centre
        )
        shape_matrix, is_column = self._shape_matrix(k, row), bool(self.is_other_kind[k])
        if is_column:
            shape_matrix[2, 2], centre[2] = (self.ends[1] - self.ends[0]) / 2, sum(self.ends) / 2
        half_lengths, direction = np.linalg.eigh(shape_matrix)
        contrast, axes = float(self.contrast(k, row)[0]), (half_lengths * direction).T[::-1]
        shares_material = int((self.first == self.first[k]).sum()) > 1
        return Ellipsoid(
            int(self.sign[k]), centre, axes, volume, centroid, contrast, is_column, shares_material, float(rise)
        )

    def centroid_slope(self, k: int, coefficients, deviations) -> Float[np.ndarray, "3 q"]:
        """Derivatives of the centroid of body k with respect to its q coefficients, metres."""
        row = self.rows(coefficients)[k]
        cells, cell_shares, share_slope = self.coverage(k, row)
        centre, cell_weight = self.points[:, cells].mean(axis=2), self.weight[cells]
        volume_fractions = cell_shares * cell_weight
        if not volume_fractions.sum() > 0:  # the body has left the domain: its centroid is its centre
            return np.eye(3, len(row)) * self.prior.place * self.span
        centroid = centre @ volume_fractions / volume_fractions.sum()
        return (centre - centroid[:, None]) @ (cell_weight[:, None] * share_slope) / volume_fractions.sum()

    def coverage(self, k: int, row) -> CellCoverage:
        """Coverage of cells by body k, whose coefficients are `row`."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        inverse_stretch = (direction * np.exp(-log_stretch)) @ direction.T
        centre, radius = self.centre(k, row), np.exp(min(self.log_radius(row), np.log(10 * self.span)))
        axes = self._axes_of(k)
        # Depth of one point of every cell below the surface, along the ray from the centre.
        centre_offset = (self.points[:, :, 0] - centre[:, None]) * axes[:, None]
        centre_distance = np.maximum(_vector_lengths(centre_offset), 1e-9 * self.span)
        surface_depth = centre_distance * (
            radius / np.maximum(_vector_lengths(inverse_stretch @ centre_offset), 1e-9 * self.span) - 1
        )
        is_near_surface = np.abs(surface_depth) < _MAX_BLUR_DISTANCE * self.width
        cells, inner_cells = np.flatnonzero(is_near_surface), np.flatnonzero(~is_near_surface & (surface_depth > 0))
        centre_offset = (self.points[:, cells] - centre[:, None, None]) * axes[:, None, None]
        centre_distance, blur_width = _vector_lengths(centre_offset), self.width[cells, None]
        if (is_at_centre := centre_distance == 0).any():
            centre_offset[:, is_at_centre] = 1e-9 * self.span
            centre_distance = _vector_lengths(centre_offset)
        round_offset = np.tensordot(inverse_stretch, centre_offset, 1)
        scaled_distance = _vector_lengths(round_offset)
        # On the ray from the centre, the surface is at the distance radius · centre_distance / scaled_distance.
        surface = radius * centre_distance / scaled_distance
        # The blur of a convex surface adds more volume than it removes. Moving the surface inwards by `excess_radius`
        # compensates for this.
        excess_radius = (np.pi * blur_width) ** 2 * (axes.sum() - 1) / (6 * surface)
        inside_share = 0.5 * (1 + np.tanh(0.5 * (surface - excess_radius - centre_distance) / blur_width))
        # d share / d(surface - excess_radius - centre_distance)
        share_slope = inside_share * (1 - inside_share) / blur_width / len(_BARYCENTRIC_SAMPLES)
        radius_growth = surface + excess_radius  # d(surface - excess_radius) / d log surface
        round_offset_slope = -share_slope * radius_growth / scaled_distance**2 * round_offset
        offset_slope = share_slope * (radius_growth - centre_distance) / centre_distance**2 * centre_offset
        centre_slope = -(offset_slope.sum(axis=2) + inverse_stretch @ round_offset_slope.sum(axis=2)).T
        outer_products = np.einsum("ics,jcs->cij", round_offset_slope, centre_offset)
        stretch_slopes = (self._stretch_slopes(log_stretch, direction) * self._stretch_mask(k)[:, None, None])[
            : self.prior.size - 5
        ]
        form_slope = outer_products.reshape(len(cells), 9) @ stretch_slopes.reshape(-1, 9).T
        columns = [
            centre_slope,
            (share_slope * radius_growth).sum(axis=1)[:, None],
            np.zeros((len(cells), 1)),
            form_slope,
        ]
        slopes = np.concatenate(columns, axis=1) * self.prior.deviation(self.span)
        return CellCoverage(
            np.concatenate([cells, inner_cells]),
            np.concatenate([inside_share.mean(axis=1), np.ones(len(inner_cells))]),
            np.concatenate([slopes, np.zeros((len(inner_cells), slopes.shape[1]))]),
        )

    def _stretch_mask(self, k: int) -> Float[np.ndarray, "5"]:
        """Mask (5,) of the basis of S: 1 for the elements along which body k may be stretched, else 0."""
        return _IS_COLUMN_STRETCH if self.is_other_kind[k] else np.ones(5)

    def _stretch(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """Log stretch S (3, 3) of body k, a symmetric matrix."""
        stretches = self.prior.roughness * row[5:] * self._stretch_mask(k)[: len(row) - 5]
        return np.tensordot(stretches, _STRETCH_BASIS[: len(stretches)], 1) if len(stretches) else np.zeros((3, 3))

    @staticmethod
    def _stretch_slopes(log_stretch, direction) -> Float[np.ndarray, "5 3 3"]:
        """Derivatives of exp(-S) with respect to the coefficients of S in its basis."""
        stretch_differences = log_stretch[:, None] - log_stretch
        mean_log_stretches = (log_stretch[:, None] + log_stretch) / 2
        # (exp(-a) - exp(-b)) / (a - b) = -exp(-(a + b) / 2) sinh(h) / h with h = (a - b) / 2.
        half_differences = np.where(np.abs(stretch_differences) > 1e-12, stretch_differences / 2, 1)
        difference_quotients = -np.exp(-mean_log_stretches) * np.where(
            np.abs(stretch_differences) > 1e-12, np.sinh(half_differences) / half_differences, 1
        )
        return direction @ ((direction.T @ _STRETCH_BASIS @ direction) * difference_quotients) @ direction.T


def _vector_lengths(vectors: Float[np.ndarray, "3 *n"]) -> Float[np.ndarray, "*n"]:
    return np.sqrt(np.einsum("i...,i...->...", vectors, vectors))
