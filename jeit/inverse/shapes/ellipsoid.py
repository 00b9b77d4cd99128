"""Bodies in solids as ellipsoids and columns, and how certain their contrasts are.

A column stands through the whole height of a body: the same along x and y alone, of the area π r².

Contrasts, and what they make of the conductivity, are those of `jeit.inverse.shapes.bodies`. The derivative of a
matrix's exponential by its eigenvectors: Higham, Functions of Matrices (SIAM 2008), section 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_name
from jeit.inverse.shapes.bodies import Bodies, BodyPrior, Covered
from jeit.inverse.shapes.problem import Fit, ShapeProblem
from jeit.mesh import Mesh, measures

# Least difference of log evidence between the two kinds of body, or between one material and several, for which only
# the likelier is reported. Steps of the fit of an alternative, and its tolerance.
_UNDECIDED, _STEPS, _ROUGHLY = 4.0, 8, 1e-2
# Contribution of the mesh to the deviation of a solid body's contrast, of log σ: balls of three times the bath's
# conductivity are estimated at 3.87, 3.59 and 3.31 times where edges on their surfaces are 0.7, 0.5 and 0.35 of the
# radius, and as 3.1 to 3.2 times where they are 0.25.
_BY_THE_MESH = 0.1


def contrast_deviations(problem: ShapeProblem, fitted: Fit, each: Fit | None = None) -> list[float]:
    """Standard deviations of the contrasts of bodies. Where the data do not determine that bodies are of one material,
    theirs are large enough to include the contrasts of `each`, the fit with a material for every body."""
    contrast, deviation = _contrasts(problem, fitted)
    if each and problem.surprise(each) - each.bodies.odds < problem.surprise(fitted) - fitted.bodies.odds + _UNDECIDED:
        own, its = _contrasts(problem, each)
        deviation = np.maximum(deviation, np.abs(own - contrast) + its)
    return [float(one) for one in np.hypot(deviation, _BY_THE_MESH * (fitted.bodies.dimension == 3))]


def _contrasts(problem: ShapeProblem, fitted: Fit) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Contrasts of bodies, and their standard deviations by Laplace's approximation."""
    bodies = fitted.bodies
    contrasts = [bodies.contrast(k, row) for k, row in enumerate(bodies.rows(fitted.coefficients))]
    contrast, slope = np.array(contrasts).reshape(-1, 2).T
    return contrast, bodies.rows(problem.deviations(fitted))[:, bodies.dimension + 1] * slope


def alternatives(problem: ShapeProblem, fitted: Fit) -> list[tuple[Ellipsoid | None, float]]:
    """Bodies of the other kind, columns for ellipsoids and ellipsoids for columns, where they explain the data about as
    well, whichever is more likely beforehand; and the deviations of their contrasts."""
    bodies, number = fitted.bodies, len(fitted.bodies.sign)
    if not number or bodies.prior.is_of_one_kind or not isinstance(bodies, Ellipsoids):
        return [(None, np.nan)] * number
    most, found = problem.surprise(fitted) - bodies.odds + _UNDECIDED, []
    for k in range(number):
        other = problem.fit(*bodies.otherwise([k], fitted.coefficients), _STEPS, _ROUGHLY)
        if problem.surprise(other) - other.bodies.odds < most:
            found.append((other.bodies.body(k, other.coefficients), contrast_deviations(problem, other)[k]))
        else:
            found.append((None, np.nan))
    return found


KINDS = ("either", "ellipsoids", "columns")
"""Of bodies that there may be in a solid: balls and the like, those through its whole height, or either."""

# Barycentric weights of the twenty points at which a cell is sampled; each stands for an equal part of it.
_SAMPLES = np.array([[2 * n + 1 for n in one] for one in np.ndindex(4, 4, 4, 4) if sum(one) == 3]) / 10
# Width of the blur of a surface, in units of a cell's size: enough to be differentiable, but small, since blurred
# bodies are fitted as smaller and stronger ones.
_BLUR = 0.1
# Exponents of the power means in cells on a surface, for bodies more and less conductive than the bath. With them the
# change of voltages of balls, 0.1 to 12 times as conductive, is that of meshes cut along them to 1 to 5 % where edges
# are half the radius; with one for both, 0.15, those of 12 times changed 13 to 19 % too much, with the first order of
# the edges.
_POWERS = {1: -1.0, -1: 0.5}
# Distance from a surface within which edges are short, in units of the least half axis; and the least value of that
# axis that is used, in units of the mean radius.
_BAND, _LEAST_AXIS = 0.1, 0.6
# Widths of the blur from a surface beyond which a cell's share is less than 1e-8.
_REACH = 20
# Orthonormal directions of S.
_STRETCHES = np.array(
    [
        np.diag([1, -1, 0]) / np.sqrt(2),
        np.diag([1, 1, -2]) / np.sqrt(6),
        np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]]) / np.sqrt(2),
    ]
)
# The directions that are level, and have no trace along x and y.
_LEVEL = np.array([1.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class EllipsoidPrior(BodyPrior):
    """Prior of ellipsoids: `modes` 2, or 1 for balls; `roughness`, of the logarithm of the axes' ratios; `contrast` of
    log σ and the spread of its logarithm; `odds_for_columns`, how many times as likely as an ellipsoid a column is
    beforehand: most tanks hold columns; `odds_for_one_material`, how many times as likely all bodies of a sign, more or
    less conductive than the bath, are of the same as each of its own; `kinds` of bodies that there may be, one of
    `KINDS`. Smooth images of solids locate bodies well, so `place` is small. The rest as of `BodyPrior`.

    Raises `ValueError` for what is not positive, and for other kinds.
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
        """Whether it is known beforehand whether bodies are columns."""
        return self.kinds != KINDS[0]

    @property
    def size(self) -> int:
        """Coefficients of a body: centre, log radius, contrast, and five of its stretches."""
        return 5 + 5 * (self.modes > 1)

    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Standard deviations of a body's values, 1 of its contrast; `span` of the whole body, metres."""
        first = [self.place * span] * 3 + [self.radius_spread, 1.0]
        return np.concatenate([first, np.full(self.size - 5, self.roughness)])

    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast of log σ of a body of either kind, positive, and its derivative."""
        contrast = self.contrast * np.exp(self.contrast_spread * coefficient)
        return contrast, self.contrast_spread * contrast


class Ellipsoid(eqx.Module):
    """A body found in a solid, an ellipsoid or a column.

    **Fields**: `sign`, +1 conductive or -1 resistive; `centre` (3,) metres; `axes` (3, 3), half axes as rows, metres,
    the longest first; `volume` m³ and `centroid` (3,) metres, of the part that lies in the whole body; `contrast` of
    log σ, positive; `column`, whether it is no ellipsoid, but stands through the whole height, half of which is one of
    the half axes then; `alike`, whether it is taken to be of one material with the others of its sign; `rise`, the
    factor by which the least objective grows without this body, which distinguishes a body from a ghost.
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

    @property
    def measure(self) -> float:
        """The volume, m³."""
        return self.volume

    @property
    def contrast_is_determined(self) -> bool:
        """Whether the contrast is determined by the data: true of every ellipsoid."""
        return True

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether points, metres, lie inside."""
        length = (self.axes**2).sum(axis=1)
        along = (points - self.centre) @ self.axes.T / length
        if self.column:
            along = along[..., np.abs(self.axes[:, 2]) < 0.5 * np.sqrt(length)]
        return (along**2).sum(axis=-1) < 1


@dataclass(frozen=True)
class Ellipsoids(Bodies):
    """Ellipsoids on a mesh.

    **Fields**, besides those of `Bodies`: `points` (m, s, 3), where cells are sampled, metres; `width` (m,) of the
    blur, metres; `total` volume, m³; `ends` of the height, z in metres.
    """

    points: Float[np.ndarray, "m s 3"]
    width: Float[np.ndarray, " m"]
    total: float
    ends: tuple[float, float]

    @classmethod
    def create(cls, mesh: Mesh, prior: BodyPrior, start, sign) -> Ellipsoids:
        """`start` (k, 3), metres."""
        points, volume = np.asarray(mesh.points), np.asarray(measures(mesh))
        sampled = _SAMPLES @ points[np.asarray(mesh.cells)]
        start, total = np.reshape(np.asarray(start, float), (-1, 3)), float(volume.sum())
        sign, no = np.asarray(sign, float), np.zeros(len(start), bool)
        span, ends = float(np.ptp(points, axis=0).max()), (float(points[:, 2].min()), float(points[:, 2].max()))
        return cls(prior, volume / total, span, start, sign, no, no, sampled, _BLUR * np.cbrt(volume), total, ends)

    @property
    def odds(self) -> float:
        """Logarithm of the prior odds against the bodies' kinds: columns, and bodies of one material, are more
        likely."""
        materials = len(set(self.sign[self.first != np.arange(len(self.sign))]))
        columns = 0 if self.prior.is_of_one_kind else self.other.sum()
        prior = np.log([self.prior.odds_for_columns, self.prior.odds_for_one_material])
        return -float(prior @ [columns, materials])

    @property
    def num_splits(self) -> int:
        """One, the longest axis: merged neighbours make a long body, and every trial costs some tens of solves of a
        solid."""
        return 1

    def otherwise(self, some, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """The same with `some` taken for columns, columns for ellipsoids, of the same volume, the rest of their
        coefficients kept."""
        rows, other = self.rows(coefficients), self.other.copy()
        for k in some:
            volume = max(self.body(k, coefficients).volume, 1e-6 * self.total) / np.pi
            radius = np.cbrt(3 / 4 * volume) if other[k] else np.sqrt(volume / (self.ends[1] - self.ends[0]))
            rows[k, 3] = np.log(radius / (self.prior.radius * self.span)) / self.prior.radius_spread
            rows[k, 2], other[k] = 0, not other[k]
            rows[k, 5:] *= _LEVEL[: self.prior.size - 5]
        return replace(self, other=other), np.append(coefficients[0], rows)

    def of_one_material(self, sign: int, coefficients) -> tuple[Ellipsoids, Float[np.ndarray, " n"]]:
        """The same with all bodies of a sign of one material, of their mean contrast, and of about the same effect:
        volume times (ρ - 1) / (ρ + 2), of a column (ρ - 1) / (ρ + 1), ρ times as conductive as the bath."""
        rows, some, contrast = self.rows(coefficients), np.flatnonzero(self.sign == sign), self.dimension + 1
        before = rows[:, contrast].copy()
        rows[some, contrast] = before[some].mean()
        for k in some:
            after, past = (
                np.exp(sign * self.prior.contrast_of(one, False)[0]) for one in (rows[k, contrast], before[k])
            )
            ends = 1.0 if self.other[k] else 2.0
            larger = (past - 1) * (after + ends) / ((past + ends) * (after - 1))
            rows[k, 3] += np.log(larger) / (ends + 1) / self.prior.radius_spread
        return replace(self, alike=self.alike | (self.sign == sign)), np.append(coefficients[0], rows)

    def mixture(self, share, contrast):
        """log(1 + share (exp(p contrast) - 1)) / p: of a conductive body and the bath the harmonic mean, p = -1, of
        a resistive one the power mean of p = 1/2."""
        power = _POWERS[1 if contrast > 0 else -1]
        rise = np.expm1(power * contrast)
        mean = 1 + share * rise
        return np.log(mean) / power, rise / (power * mean), share * (1 + rise) / mean

    def shown(self, coefficients) -> Float[np.ndarray, " m"]:
        """log σ/σ₀ (m,) for pictures, in which it is half of a body's on its surface: of cells that are covered in part
        the geometric mean, which is not what their voltages are those of."""
        image = np.full(len(self.weight), coefficients[0] * self.prior.drift)
        for k, row in enumerate(self.rows(coefficients)):
            cells, share, _ = self.covered(k, row)
            image[cells] += share * self.sign[k] * self.contrast(k, row)[0]
        return image

    def on(self, mesh: Mesh) -> Ellipsoids:
        """The same on another mesh of the same solid."""
        there = Ellipsoids.create(mesh, self.prior, self.start, self.sign)
        return replace(there, other=self.other, alike=self.alike, span=self.span)

    def edges(self, coefficients, edge: float, corners: Float[np.ndarray, "m 4 3"]) -> Float[np.ndarray, " m"]:
        """Greatest length of the edges of cells with these `corners`, metres: on surfaces `edge` times the least half
        axis, infinite elsewhere."""
        longest = np.full(len(corners), np.inf)
        for k, row in enumerate(self.rows(coefficients)):
            form, offset = self._form(k, row), (corners - self.centre(k, row)) * self._axes_of(k)
            least = self._least_axis(form)
            distance = np.linalg.norm(offset, axis=2)
            reach = np.linalg.norm(offset @ np.linalg.inv(form), axis=2)
            outside = distance - distance / np.maximum(reach, 1e-9)
            low, high = outside.min(axis=1), outside.max(axis=1)
            holds = distance.min(axis=1) < high - low  # corners all round a body that is less than a cell
            near = ((low < _BAND * least) | holds) & (high > -_BAND * least)
            longest[near] = np.minimum(longest[near], edge * least)
        return longest

    def moved(self, coefficients, others: Bodies, after) -> bool:
        """Whether surfaces have left the cells that were made finer for them, from some coefficients to those `after`
        of `others`; or bodies have gone, or are of another kind."""
        if not np.array_equal(self.other, others.other):
            return True
        for k, (row, other) in enumerate(zip(self.rows(coefficients), others.rows(after), strict=True)):
            shift = np.linalg.norm((self.centre(k, row) - others.centre(k, other)) * self._axes_of(k))
            form = self._form(k, row)
            if shift + np.linalg.norm(form - self._form(k, other), 2) > 2 * _BAND * self._least_axis(form):
                return True
        return False

    def _axes_of(self, k: int) -> Float[np.ndarray, "3"]:
        """1 for the axes along which body k ends: x, y and, unless it is a column, z."""
        return np.array([1.0, 1.0, 0.0 if self.other[k] else 1.0])

    def _form(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """r exp(S), metres: what makes the body of the unit ball."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        return (direction * np.exp(self.log_radius(row) + log_stretch)) @ direction.T

    @staticmethod
    def _least_axis(form: Float[np.ndarray, "3 3"]) -> float:
        """The least half axis, metres, or what is heeded of it."""
        axes = np.linalg.eigvalsh(form)
        return float(max(axes[0], _LEAST_AXIS * np.cbrt(axes.prod())))

    def axis(self, k: int, row, number: int):
        """Eigenvectors of S, that of the greatest first; of a column those that lie level."""
        form = self._form(k, row) * self._axes_of(k)
        return np.linalg.eigh(form)[1][:, 2 - number]

    def body(self, k: int, coefficients, rise: float = np.nan) -> Ellipsoid:
        """Body k, with what lies in the whole one of it."""
        row = self.rows(coefficients)[k]
        cells, share, _ = self.covered(k, row)
        within = share * self.weight[cells]
        centre, volume = self.centre(k, row), float(within.sum()) * self.total
        centroid = within @ self.points[cells].mean(axis=1) / within.sum() if volume > 0 else centre
        form, column = self._form(k, row), bool(self.other[k])
        if column:
            form[2, 2], centre[2] = (self.ends[1] - self.ends[0]) / 2, sum(self.ends) / 2
        length, direction = np.linalg.eigh(form)
        contrast, axes = float(self.contrast(k, row)[0]), (length * direction).T[::-1]
        alike = int((self.first == self.first[k]).sum()) > 1
        return Ellipsoid(int(self.sign[k]), centre, axes, volume, centroid, contrast, column, alike, float(rise))

    def covered(self, k: int, row) -> Covered:
        """Cells that ellipsoid k reaches."""
        log_stretch, direction = np.linalg.eigh(self._stretch(k, row))
        squeeze = (direction * np.exp(-log_stretch)) @ direction.T
        centre, radius = self.centre(k, row), np.exp(min(self.log_radius(row), np.log(10 * self.span)))
        farthest, axes = radius * np.exp(log_stretch[-1]), self._axes_of(k)
        reached = np.linalg.norm((self.points[:, 0] - centre) * axes, axis=1) < farthest + _REACH * self.width
        cells = np.flatnonzero(reached)
        offset, width = (self.points[cells] - centre) * axes, self.width[cells, None]
        offset = np.where(np.abs(offset).max(axis=-1, keepdims=True) > 0, offset, 1e-9 * self.span)
        distance = np.linalg.norm(offset, axis=-1)
        round_offset = offset @ squeeze
        reach = np.linalg.norm(round_offset, axis=-1)
        # Along the line from the centre, the surface lies at radius · distance / reach.
        surface = radius * distance / reach
        # The blur takes less off a convex body than it adds: reduced by the excess, the body keeps its volume.
        excess = (np.pi * width) ** 2 * (axes.sum() - 1) / (6 * surface)
        inside = 0.5 * (1 + np.tanh(0.5 * (surface - excess - distance) / width))
        edge = inside * (1 - inside) / width / len(_SAMPLES)  # d share / d(surface - excess - distance)
        grown = surface + excess  # d(surface - excess) / d log surface
        by_reach = -edge * grown / reach**2  # times round_offset · d round_offset
        by_offset = (edge * (grown - distance) / distance**2)[..., None] * offset
        by_centre = -(by_offset + by_reach[..., None] * (round_offset @ squeeze)).sum(axis=1)
        outer = np.einsum("cs,csi,csj->cij", by_reach, round_offset, offset)
        stretches = (self._squeeze_slopes(log_stretch, direction) * self._kept(k)[:, None, None])[: self.prior.size - 5]
        form = outer.reshape(len(cells), 9) @ stretches.reshape(-1, 9).T
        columns = [by_centre, (edge * grown).sum(axis=1)[:, None], np.zeros((len(cells), 1)), form]
        slope = np.concatenate(columns, axis=1) * self.prior.deviation(self.span)
        return Covered(cells, inside.mean(axis=1), slope)

    def _kept(self, k: int) -> Float[np.ndarray, "5"]:
        """1 for the directions of S that body k is stretched along."""
        return _LEVEL if self.other[k] else np.ones(5)

    def _stretch(self, k: int, row) -> Float[np.ndarray, "3 3"]:
        """S."""
        values = self.prior.roughness * row[5:] * self._kept(k)[: len(row) - 5]
        return np.tensordot(values, _STRETCHES[: len(values)], 1) if len(values) else np.zeros((3, 3))

    @staticmethod
    def _squeeze_slopes(log_stretch, direction) -> Float[np.ndarray, "5 3 3"]:
        """Derivatives of exp(-S) along the directions of S."""
        apart = log_stretch[:, None] - log_stretch
        middle = (log_stretch[:, None] + log_stretch) / 2
        # (exp(-a) - exp(-b)) / (a - b) = -exp(-(a + b) / 2) sinh(h) / h with h = (a - b) / 2.
        half = np.where(np.abs(apart) > 1e-12, apart / 2, 1)
        divided = -np.exp(-middle) * np.where(np.abs(apart) > 1e-12, np.sinh(half) / half, 1)
        return direction @ ((direction.T @ _STRETCHES @ direction) * divided) @ direction.T
