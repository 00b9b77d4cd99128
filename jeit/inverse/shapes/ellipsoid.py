"""Ellipsoids and columns as bodies in a solid, and the standard deviations of their contrasts.

An ellipsoid is the image of the unit ball under r exp(S), with a symmetric S of zero trace. A column extends through
the whole height of the domain; its cross-section is an ellipse of area π r².

`jeit.inverse.shapes.bodies` describes contrast and conductivity. The derivative of the matrix exponential is computed
from eigenvectors: Higham, Functions of Matrices (SIAM 2008), section 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_name
from jeit.inverse.shapes.bodies import TINY, Bodies, BodyPrior, Covered, Quantities, polarisation
from jeit.inverse.shapes.problem import Fit, ShapeProblem
from jeit.mesh import Mesh, measures
from jeit_solvers.module import Module

# Difference of log evidence above which only the likelier of two descriptions is reported (ellipsoid or column, one
# material or several); maximum number of steps when an alternative is fitted; tolerance of that fit.
_UNDECIDED_ODDS, _STEPS, _COARSE_TOLERANCE = 4.0, 8, 1e-2
# Contribution of the mesh to the standard deviation of a contrast in log σ, in a sheet and in a solid. Balls of three
# times the bath's conductivity are estimated as 3.87, 3.59 and 3.31 times as conductive if edges on their surfaces are
# 0.7, 0.5 and 0.35 of the radius, and as 3.1 to 3.2 times if they are 0.25 of it. Disks of four times the conductivity
# of a sheet are estimated as 4.0 to 4.2 times on meshes of 2,000 to 8,000 nodes.
_BY_THE_MESH = {2: 0.03, 3: 0.1}


def contrast_deviations(problem: ShapeProblem, fitted: Fit, each: Fit | None = None) -> list[float]:
    """Standard deviations of the contrasts of bodies, in log σ: those that the problem explains, and `unmodelled`."""
    return np.hypot(_contrasts(problem, fitted)[1], unmodelled_deviations(problem, fitted, each)).tolist()


def unmodelled_deviations(problem: ShapeProblem, fitted: Fit, each: Fit | None = None) -> Float[np.ndarray, " k"]:
    """Standard deviations of the contrasts of bodies, in log σ, that Laplace's approximation of the problem lacks: that
    of the mesh, and that of the materials.

    `each`: fit in which every body has its own material. If the data do not rule it out, its contrasts are included.
    """
    variance = np.full(len(fitted.bodies.sign), _BY_THE_MESH[fitted.bodies.dimension] ** 2)
    if (
        each
        and problem.surprise(each) - each.bodies.odds < problem.surprise(fitted) - fitted.bodies.odds + _UNDECIDED_ODDS
    ):
        contrast, deviation = _contrasts(problem, fitted)
        own, its = _contrasts(problem, each)
        variance += np.maximum((np.abs(own - contrast) + its) ** 2 - deviation**2, 0)
    return np.sqrt(variance)


def _contrasts(problem: ShapeProblem, fitted: Fit) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Contrasts of bodies, and their standard deviations from Laplace's approximation."""
    bodies = fitted.bodies
    contrasts = [bodies.contrast(k, row) for k, row in enumerate(bodies.rows(fitted.coefficients))]
    contrast, slope = np.array(contrasts).reshape(-1, 2).T
    return contrast, bodies.rows(problem.deviations(fitted))[:, bodies.dimension + 1] * slope


def alternatives(problem: ShapeProblem, fitted: Fit) -> list[tuple[Ellipsoid | None, float]]:
    """For each body, the body of the other kind (ellipsoid or column) that explains the data about as well, and the
    standard deviation of its contrast; None and NaN if there is none. The prior odds of the kinds are ignored."""
    bodies, number = fitted.bodies, len(fitted.bodies.sign)
    if not number or bodies.prior.is_of_one_kind or not isinstance(bodies, Ellipsoids):
        return [(None, np.nan)] * number
    most, found = problem.surprise(fitted) - bodies.odds + _UNDECIDED_ODDS, []
    for k in range(number):
        other = problem.fit(*bodies.otherwise([k], fitted.coefficients), _STEPS, _COARSE_TOLERANCE)
        if problem.surprise(other) - other.bodies.odds < most:
            found.append((other.bodies.body(k, other.coefficients), contrast_deviations(problem, other)[k]))
        else:
            found.append((None, np.nan))
    return found


KINDS = ("either", "ellipsoids", "columns")
"""Kinds of bodies that a solid may contain: ellipsoids, columns through its whole height, or either."""

# Barycentric weights of the twenty points at which a cell is sampled; each represents an equal part of the cell.
_SAMPLES = np.array([[2 * n + 1 for n in one] for one in np.ndindex(4, 4, 4, 4) if sum(one) == 3]) / 10
# Width of the blur of a surface, in units of the cell size: large enough for the coverage to be differentiable, but
# small, because blurred bodies are estimated too small and too strong.
_BLUR = 0.1
# Exponents of the power mean in cells on a surface, for bodies more (1) and less (-1) conductive than the bath. With
# edges of half the radius, the change of voltages due to balls 0.1 to 12 times as conductive as the bath then agrees
# within 1 to 5 % with that on meshes whose facets follow the surface. A single exponent of 0.15 made the change due to
# balls of 12 times the conductivity 13 to 19 % too large, an error proportional to the edge length.
_POWERS = {1: -1.0, -1: 0.5}
# Distance from a surface within which cells are refined, in units of the shortest half axis; lower limit of that half
# axis, in units of the geometric mean of the three.
_BAND, _LEAST_AXIS = 0.1, 0.6
# Distance from a surface, in widths of the blur, beyond which the covered share of a cell is less than 1e-8.
_REACH = 20
# Orthonormal basis of the symmetric matrices S of zero trace.
_STRETCHES = np.array(
    [
        np.diag([1, -1, 0]) / np.sqrt(2),
        np.diag([1, 1, -2]) / np.sqrt(6),
        np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]]) / np.sqrt(2),
    ]
)
# 1 for the elements of that basis that stretch a column: those within the x-y plane and without trace there.
_LEVEL = np.array([1.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class EllipsoidPrior(BodyPrior):
    """Prior of ellipsoids and columns, for `reconstruct_shapes` in a solid.

    **Arguments:**

    - `modes`: 2, or 1 for balls.
    - `place`, `radius`, `radius_spread`, `drift`, `apart`: as in `StarPrior`; `place` is small, because smooth images
      of solids locate bodies well.
    - `roughness`: standard deviation of the five coefficients of S, the log stretches.
    - `contrast`, `contrast_spread`: median of the contrast in log σ, and standard deviation of its logarithm.
    - `odds_for_columns`: prior odds of a column relative to an ellipsoid; most tanks hold columns.
    - `odds_for_one_material`: prior odds that all bodies of one sign are of one material, relative to one for each.
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
    def _numbers(self):
        return {name: value for name, value in vars(self).items() if name != "kinds"}

    @property
    def is_of_one_kind(self) -> bool:
        """Whether only one kind of body is considered."""
        return self.kinds != KINDS[0]

    @property
    def size(self) -> int:
        """Number of coefficients of a body: centre, log radius, contrast and, unless it is a ball, five stretches."""
        return 5 + 5 * (self.modes > 1)

    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Prior standard deviations of a body's parameters, 1 for its contrast; `span`: longest side of the domain,
        metres."""
        first = [self.place * span] * 3 + [self.radius_spread, 1.0]
        return np.concatenate([first, np.full(self.size - 5, self.roughness)])

    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast in log σ, without its sign, and its derivative with respect to the coefficient; the same for both
        kinds."""
        contrast = self.contrast * np.exp(self.contrast_spread * coefficient)
        return contrast, self.contrast_spread * contrast


class Ellipsoid(Module):
    """Ellipsoid or column found in a solid.

    **Fields**: `sign`: +1 if more conductive than the bath, -1 if less; `centre` (3,): metres; `axes` (3, 3): half axes
    as rows, metres, the longest first; `volume`, `centroid` (3,): volume in m³ and centroid in metres of the part
    inside the domain; `contrast`: contrast in log σ, without its sign; `column`: whether the body is a column, one of
    whose half axes is half the domain's height; `alike`: whether the body is assumed to be of the same material as
    others of its sign; `rise`: factor by which the minimum of the objective increases without this body, small for a
    ghost; `quantities`: posterior medians and intervals, if they were estimated.

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
        """Volume, m³."""
        return self.volume

    @property
    def bounded_axes(self) -> int:
        """Number of axes along which the body is bounded: 2 for a column, else 3."""
        return 2 if self.column else 3

    @property
    def contrast_is_determined(self) -> bool:
        """Whether the data determine the contrast: no end of its interval is open."""
        return self.quantities is None or None not in self.quantities.change_interval

    def with_quantities(self, known: Quantities) -> Ellipsoid:
        """The body with its quantities; its volume and contrast become the medians."""
        scale = (known.measure / max(self.volume, TINY)) ** (1 / self.bounded_axes)
        upright = self.column & (np.abs(self.axes[:, 2]) > 0.5 * np.linalg.norm(self.axes, axis=1))
        return replace(
            self,
            axes=self.axes * np.where(upright, 1.0, scale)[:, None],
            volume=known.measure,
            contrast=float(np.abs(np.log1p(known.change))),
            quantities=known,
        )

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether each of `points`, in metres, lies inside the body."""
        length = (self.axes**2).sum(axis=1)
        along = (points - self.centre) @ self.axes.T / length
        if self.column:
            along = along[..., np.abs(self.axes[:, 2]) < 0.5 * np.sqrt(length)]
        return (along**2).sum(axis=-1) < 1


@dataclass(frozen=True)
class Ellipsoids(Bodies):
    """Ellipsoids and columns on a mesh.

    **Fields**, besides those of `Bodies`: `points` (3, m, s): sampling points of the cells, metres; `width` (m,): width
    of the blur, metres; `total`: volume of the domain, m³; `ends`: lowest and highest z of the domain, metres.
    """

    points: Float[np.ndarray, "3 m s"]
    width: Float[np.ndarray, " m"]
    total: float
    ends: tuple[float, float]

    @classmethod
    def create(cls, mesh: Mesh, prior: BodyPrior, start, sign) -> Ellipsoids:
        """Create ellipsoids for a mesh, with starting centres `start` (k, 3), metres."""
        points, volume = np.asarray(mesh.points), np.asarray(measures(mesh))
        sampled = points.T[:, np.asarray(mesh.cells)] @ _SAMPLES.T
        start, total = np.reshape(np.asarray(start, float), (-1, 3)), float(volume.sum())
        sign, no = np.asarray(sign, float), np.zeros(len(start), bool)
        free = np.full(len(start), np.nan)
        span, ends = float(np.ptp(points, axis=0).max()), (float(points[:, 2].min()), float(points[:, 2].max()))
        return cls(
            prior, volume / total, span, start, sign, no, no, free, sampled, _BLUR * np.cbrt(volume), total, ends
        )

    def bounded_axes(self, k: int) -> int:
        """2 for a column, else 3."""
        return 2 if self.other[k] else 3

    @property
    def odds(self) -> float:
        """Logarithm of the prior odds against the bodies' kinds and materials; negative for columns and for bodies
        that share a material, which are likelier a priori."""
        materials = len(set(self.sign[self.first != np.arange(len(self.sign))]))
        columns = 0 if self.prior.is_of_one_kind else self.other.sum()
        prior = np.log([self.prior.odds_for_columns, self.prior.odds_for_one_material])
        return -float(prior @ [columns, materials])

    @property
    def num_splits(self) -> int:
        """1: only the longest axis, because two neighbours that were fitted as one body make it long, and each trial
        takes tens of forward solves."""
        return 1

    def otherwise(self, some, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """The bodies with those of indices `some` changed from ellipsoid to column or back, at the same volume; and
        their coefficients. Stretches that the new kind does not have are set to zero."""
        rows, other = self.rows(coefficients), self.other.copy()
        for k in some:
            volume = max(self.body(k, coefficients).volume, 1e-6 * self.total) / np.pi
            radius = np.cbrt(3 / 4 * volume) if other[k] else np.sqrt(volume / (self.ends[1] - self.ends[0]))
            rows[k, 3] = np.log(radius / (self.prior.radius * self.span)) / self.prior.radius_spread
            rows[k, 2], other[k] = 0, not other[k]
            rows[k, 5:] *= _LEVEL[: self.prior.size - 5]
        return replace(self, other=other), np.append(coefficients[0], rows)

    def of_one_material(self, sign: int, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """The bodies with all those of a sign made of one material, and their coefficients.

        The contrast coefficient becomes the mean. Radii are adjusted to keep the strengths.
        """
        rows, some, contrast = self.rows(coefficients), np.flatnonzero(self.sign == sign), self.dimension + 1
        before = rows[:, contrast].copy()
        rows[some, contrast] = before[some].mean()
        for k in some.tolist():
            after, past = (
                polarisation(sign * self.prior.contrast_of(one, False)[0], self.bounded_axes(k))
                for one in (rows[k, contrast], before[k])
            )
            rows[k, 3] += np.log(past / after) / self.bounded_axes(k) / self.prior.radius_spread
        return replace(self, alike=self.alike | (self.sign == sign)), np.append(coefficients[0], rows)

    def mixture(self, share, contrast):
        """log(1 + share (exp(p contrast) - 1)) / p, the power mean of body and bath: harmonic (p = -1) for a conductive
        body, p = 1/2 for a resistive one. Also its derivatives with respect to `share` and `contrast`."""
        power = _POWERS[1 if contrast > 0 else -1]
        rise = np.expm1(power * contrast)
        mean = 1 + share * rise
        return np.log(mean) / power, rise / (power * mean), share * (1 + rise) / mean

    def shown(self, coefficients) -> Float[np.ndarray, " m"]:
        """log σ/σ₀ (m,) for display. Partly covered cells have the geometric mean of body and bath, so the value is
        halfway between them on the surface; the voltages are computed with `mixture` instead."""
        image = np.full(len(self.weight), coefficients[0] * self.prior.drift)
        for k, row in enumerate(self.rows(coefficients)):
            cells, share, _ = self.covered(k, row)
            image[cells] += share * self.sign[k] * self.contrast(k, row)[0]
        return image

    def on(self, mesh: Mesh) -> Ellipsoids:
        """The bodies on another mesh of the same domain."""
        there = Ellipsoids.create(mesh, self.prior, self.start, self.sign)
        return replace(there, other=self.other, alike=self.alike, span=self.span)

    def edges(self, coefficients, edge: float, corners: Float[np.ndarray, "m 4 3"]) -> Float[np.ndarray, " m"]:
        """Maximum edge length in metres of cells with these `corners`: `edge` times the shortest half axis at the
        surface of a body, infinite elsewhere."""
        longest = np.full(len(corners), np.inf)
        for k, row in enumerate(self.rows(coefficients)):
            form, offset = self._form(k, row), (corners - self.centre(k, row)) * self._axes_of(k)
            least = self._least_axis(form)
            distance = np.linalg.norm(offset, axis=2)
            reach = np.linalg.norm(offset @ np.linalg.inv(form), axis=2)
            outside = distance - distance / np.maximum(reach, 1e-9)
            low, high = outside.min(axis=1), outside.max(axis=1)
            holds = distance.min(axis=1) < high - low  # the corners surround a body that is smaller than a cell
            near = ((low < _BAND * least) | holds) & (high > -_BAND * least)
            longest[near] = np.minimum(longest[near], edge * least)
        return longest

    def moved(self, coefficients, others: Bodies, after) -> bool:
        """Whether, between `coefficients` and the coefficients `after` of the bodies `others`, a surface has left the
        cells that were refined for it, a body was removed, or a body changed kind."""
        if not np.array_equal(self.other, others.other):
            return True
        for k, (row, other) in enumerate(zip(self.rows(coefficients), others.rows(after), strict=True)):
            shift = np.linalg.norm((self.centre(k, row) - others.centre(k, other)) * self._axes_of(k))
            form = self._form(k, row)
            if shift + np.linalg.norm(form - self._form(k, other), 2) > 2 * _BAND * self._least_axis(form):
                return True
        return False

    def _axes_of(self, k: int) -> Float[np.ndarray, "3"]:
        """1 for the axes along which body k is bounded: x, y and, unless it is a column, z; else 0."""
        return np.array([1.0, 1.0, 0.0 if self.other[k] else 1.0])

    def _form(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """Matrix r exp(S), metres, which maps the unit ball to the body."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        return (direction * np.exp(self.log_radius(row) + log_stretch)) @ direction.T

    @staticmethod
    def _least_axis(form: Float[np.ndarray, "3 3"]) -> float:
        """Shortest half axis in metres, at least `_LEAST_AXIS` times the geometric mean of the three."""
        axes = np.linalg.eigvalsh(form)
        return float(max(axes[0], _LEAST_AXIS * np.cbrt(axes.prod())))

    def axis(self, k: int, row, number: int):
        """Unit vector along axis `number` of body k, counted from the longest; for a column, of its cross-section."""
        form = self._form(k, row) * self._axes_of(k)
        return np.linalg.eigh(form)[1][:, 2 - number]

    def body(self, k: int, coefficients, rise: float = np.nan) -> Ellipsoid:
        """Description of body k; volume and centroid are those of the part inside the domain."""
        row = self.rows(coefficients)[k]
        cells, share, _ = self.covered(k, row)
        within = share * self.weight[cells]
        centre, volume = self.centre(k, row), float(within.sum()) * self.total
        centroid = self.points[:, cells].mean(axis=2) @ within / within.sum() if volume > 0 else centre
        form, column = self._form(k, row), bool(self.other[k])
        if column:
            form[2, 2], centre[2] = (self.ends[1] - self.ends[0]) / 2, sum(self.ends) / 2
        length, direction = np.linalg.eigh(form)
        contrast, axes = float(self.contrast(k, row)[0]), (length * direction).T[::-1]
        alike = int((self.first == self.first[k]).sum()) > 1
        return Ellipsoid(int(self.sign[k]), centre, axes, volume, centroid, contrast, column, alike, float(rise))

    def covered(self, k: int, row) -> Covered:
        """Coverage of cells by body k, whose coefficients are `row`."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        squeeze = (direction * np.exp(-log_stretch)) @ direction.T
        centre, radius = self.centre(k, row), np.exp(min(self.log_radius(row), np.log(10 * self.span)))
        farthest, axes = radius * np.exp(log_stretch[-1]), self._axes_of(k)
        reached = _lengths((self.points[:, :, 0] - centre[:, None]) * axes[:, None]) < farthest + _REACH * self.width
        cells = np.flatnonzero(reached)
        offset = (self.points[:, cells] - centre[:, None, None]) * axes[:, None, None]
        distance, width = _lengths(offset), self.width[cells, None]
        if (at_centre := distance == 0).any():
            offset[:, at_centre] = 1e-9 * self.span
            distance = _lengths(offset)
        round_offset = np.tensordot(squeeze, offset, 1)
        reach = _lengths(round_offset)
        # On the ray from the centre, the surface is at the distance radius · distance / reach.
        surface = radius * distance / reach
        # The blur of a convex surface adds more volume than it removes. Reducing the surface by `excess` compensates.
        excess = (np.pi * width) ** 2 * (axes.sum() - 1) / (6 * surface)
        inside = 0.5 * (1 + np.tanh(0.5 * (surface - excess - distance) / width))
        edge = inside * (1 - inside) / width / len(_SAMPLES)  # d share / d(surface - excess - distance)
        grown = surface + excess  # d(surface - excess) / d log surface
        by_round_offset = -edge * grown / reach**2 * round_offset
        by_offset = edge * (grown - distance) / distance**2 * offset
        by_centre = -(by_offset.sum(axis=2) + squeeze @ by_round_offset.sum(axis=2)).T
        outer = np.einsum("ics,jcs->cij", by_round_offset, offset)
        stretches = (self._squeeze_slopes(log_stretch, direction) * self._mask(k)[:, None, None])[: self.prior.size - 5]
        form = outer.reshape(len(cells), 9) @ stretches.reshape(-1, 9).T
        columns = [by_centre, (edge * grown).sum(axis=1)[:, None], np.zeros((len(cells), 1)), form]
        slope = np.concatenate(columns, axis=1) * self.prior.deviation(self.span)
        return Covered(cells, inside.mean(axis=1), slope)

    def _mask(self, k: int) -> Float[np.ndarray, "5"]:
        """1 for the elements of the basis of S along which body k may be stretched, else 0."""
        return _LEVEL if self.other[k] else np.ones(5)

    def _stretch(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """Log stretch S of body k."""
        values = self.prior.roughness * row[5:] * self._mask(k)[: len(row) - 5]
        return np.tensordot(values, _STRETCHES[: len(values)], 1) if len(values) else np.zeros((3, 3))

    @staticmethod
    def _squeeze_slopes(log_stretch, direction) -> Float[np.ndarray, "5 3 3"]:
        """Derivatives of exp(-S) with respect to the coefficients of S in its basis."""
        apart = log_stretch[:, None] - log_stretch
        middle = (log_stretch[:, None] + log_stretch) / 2
        # (exp(-a) - exp(-b)) / (a - b) = -exp(-(a + b) / 2) sinh(h) / h with h = (a - b) / 2.
        half = np.where(np.abs(apart) > 1e-12, apart / 2, 1)
        divided = -np.exp(-middle) * np.where(np.abs(apart) > 1e-12, np.sinh(half) / half, 1)
        return direction @ ((direction.T @ _STRETCHES @ direction) * divided) @ direction.T


def _lengths(vectors: Float[np.ndarray, "3 *n"]) -> Float[np.ndarray, "*n"]:
    return np.sqrt(np.einsum("i...,i...->...", vectors, vectors))
