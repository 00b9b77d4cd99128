"""Star shapes: an outline r(θ) round a centre, one contrast inside, and the bath that may have drifted.

    log r(θ) = log r₀ + Σ aₙ cos nθ + bₙ sin nθ,  n = 2 … N,
    log σ/σ₀ = drift + Σ_bodies ± 2 artanh(s tanh(contrast / 2)),

with s the share of a cell that a body covers: Maxwell Garnett's mixture, log σ/σ₀ = ± contrast where it covers all.
Everything is estimated in units of its prior's standard deviation, so that the penalty is ½‖c‖².
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from jeit.arguments import is_number, told
from jeit.mesh import Mesh, measures

# Corners' weights of the six points at which a cell is asked whether it lies in a body.
_SAMPLES = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2.5, 2.5, 1], [2.5, 1, 2.5], [1, 2.5, 2.5]]) / 6
# Over how much of a cell's size an outline is blurred: enough to be differentiable.
_BLUR = 0.2
# Beyond so many widths of the blur from an outline a cell's share is less than 1e-12.
_REACH = 30
_OUTLINE = 128


@dataclass(frozen=True)
class StarPrior:
    """What bodies are expected to be; standard deviations, lengths in units of the longer side of the whole body.

    - `modes`: N, the finest waves of an outline; 1 makes disks.
    - `place`: of the centre about where the search starts. `radius` with the spread of its logarithm.
    - `roughness`: of the logarithm of r in the second mode; the others have 2/n of it.
    - `contrast` of log σ and its spread. What is ten times as conductive or resistive as the bath is hardly told from
      what is more so: strong bodies are best held strong.
    - `weak_contrast` and the spread of its logarithm: of bodies that data tell to be weak. `odds_against_weak`: how
      many times as likely strong ones are beforehand.
    - `drift`: of the logarithm of the bath's conductivity between the two frames.
    - `apart`: over the share of the whole body by which two stars overlap, its standard deviation. Without it two of
      opposite sign may lie on each other and cancel.

    Raises `ValueError` for what is not positive.
    """

    modes: int = 4
    place: float = 0.15
    radius: float = 0.12
    radius_spread: float = 0.5
    roughness: float = 0.25
    contrast: float = 4.5
    contrast_spread: float = 0.5
    weak_contrast: float = 0.7
    weak_spread: float = 0.8
    odds_against_weak: float = 20.0
    drift: float = 0.1
    apart: float = 1e3

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (is_number(value) and value > 0):
                raise ValueError(f"{name} must be a positive number; it is {told(value)}.")
        if self.modes != int(self.modes):
            raise ValueError(f"modes must be a whole number from 1; it is {told(self.modes)}.")

    @property
    def size(self) -> int:
        """Coefficients of a body: centre, log radius, contrast, and two of every mode from the second."""
        return 4 + 2 * (self.modes - 1)

    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Standard deviations of a body's values, 1 of its contrast; `span` of the whole body, metres."""
        mode = self.roughness * 2 / np.arange(2, self.modes + 1)
        first = [self.place * span, self.place * span, self.radius_spread, 1.0]
        return np.concatenate([first, np.repeat(mode, 2)])

    def contrast_of(self, coefficient: float, weak: bool) -> tuple[float, float]:
        """Contrast of log σ of a body, and its derivative."""
        if not weak:
            return self.contrast + self.contrast_spread * coefficient, self.contrast_spread
        contrast = self.weak_contrast * np.exp(self.weak_spread * coefficient)
        return contrast, self.weak_spread * contrast


class Star(eqx.Module):
    """A body that was found.

    **Fields**: `sign`, +1 conductive or -1 resistive; `centre` (2,), of the star, metres; `outline` (k, 2), metres,
    counter-clockwise; `contrast` of log σ, positive, told by the data where the body is `weak`, else the prior's, "at
    least about so much"; `rise`, how many times the objective is, at its least, without this body: what tells a body
    from a ghost.
    """

    sign: int
    centre: Float[np.ndarray, "2"]
    outline: Float[np.ndarray, "k 2"]
    contrast: float
    weak: bool
    rise: float

    @property
    def area(self) -> float:
        """m²."""
        return float(abs(self._moments()[0]))

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Of the area, (2,) metres."""
        area, first = self._moments()
        return first / area

    def holds(self, points: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
        """Which of points, metres, lie inside."""
        corner, offset = self._from_centre(self.outline), self._from_centre(points)
        angle = np.unwrap(np.angle(corner))
        turn = angle[0] + (np.angle(offset) - angle[0]) % (2 * np.pi)
        reach = np.interp(turn, np.append(angle, angle[0] + 2 * np.pi), np.abs(np.append(corner, corner[0])))
        return np.abs(offset) < reach

    def _from_centre(self, points) -> Complex[np.ndarray, "*n"]:
        return (points[..., 0] - self.centre[0]) + 1j * (points[..., 1] - self.centre[1])

    def _moments(self):
        x, y = self.outline.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        return cross.sum() / 2, (self.outline + np.roll(self.outline, -1, axis=0)).T @ cross / 6


class StarImage(NamedTuple):
    """**Fields**: `image` (m,), log σ/σ₀; its derivatives `slopes`, by the drift in all cells, then by every star's
    coefficients in the cells that it reaches; `overlap` of every two stars, in units of the whole area, and its
    derivative `overlap_slope`."""

    image: Float[np.ndarray, " m"]
    slopes: Sequence[tuple[Any, Float[np.ndarray, "k q"]]]
    overlap: Float[np.ndarray, " p"]
    overlap_slope: Float[np.ndarray, "p n"]


class _Values(NamedTuple):
    """A star's: `waves` are aₙ - i bₙ; `contrast_slope`, by its coefficient."""

    centre: complex
    log_radius: float
    contrast: float
    contrast_slope: float
    waves: Complex[np.ndarray, " w"]


@dataclass(frozen=True)
class Stars:
    """Some stars on a mesh: from coefficients to conductivity. Coefficients: the drift, then star by star.

    **Fields**: `prior` of every star; `points` (m, s), where cells are sampled, x + iy in metres; `width` (m,) of the
    blur, metres; `weight` (m,), every cell's share of the area; `edges` (b, 2) of the whole body, from point to point;
    `span`, the longer side of the whole body; `start` (k,), x + iy, and `sign` (k,) of every star; `weak` (k,), whether
    it is taken for weak, not strong.
    """

    prior: StarPrior
    points: Complex[np.ndarray, "m s"]
    width: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    edges: Complex[np.ndarray, "b 2"]
    span: float
    start: Complex[np.ndarray, " k"]
    sign: Float[np.ndarray, " k"]
    weak: Bool[np.ndarray, " k"]

    @classmethod
    def create(cls, mesh: Mesh, prior: StarPrior, start, sign) -> Stars:
        """`start` (k, 2), metres."""
        points = np.asarray(mesh.points) @ np.array([1, 1j])
        corners, edges = points[np.asarray(mesh.cells)], points[np.asarray(mesh.facets)]
        span = float(np.ptp(np.asarray(mesh.points), axis=0).max())
        area = np.asarray(measures(mesh))
        start = np.reshape(start, (-1, 2)) @ np.array([1, 1j])
        width, weight = _BLUR * np.sqrt(area), area / area.sum()
        sign, weak = np.asarray(sign, float), np.zeros(len(start), bool)
        return cls(prior, corners @ _SAMPLES.T, width, weight, edges, span, start, sign, weak)

    def rows(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k q"]:
        """Coefficients of every star."""
        return coefficients[1:].reshape(len(self.sign), self.prior.size)

    def of_radii(self, radii) -> Float[np.ndarray, " n"]:
        """Coefficients of disks, metres, at the start."""
        rows = np.zeros((len(self.sign), self.prior.size))
        relative = np.log(np.asarray(radii, float) / (self.prior.radius * self.span)) / self.prior.radius_spread
        rows[:, 2] = np.clip(relative, -2, 2)
        return np.append(0, rows)

    def without(self, k: int, coefficients) -> tuple[Stars, Float[np.ndarray, " n"]]:
        """The others, and their coefficients."""
        start, sign, weak = (np.delete(one, k) for one in (self.start, self.sign, self.weak))
        others = replace(self, start=start, sign=sign, weak=weak)
        return others, np.append(coefficients[0], np.delete(self.rows(coefficients), k, axis=0))

    def split(self, k: int, coefficients, angle: float) -> tuple[Stars, Float[np.ndarray, " n"]]:
        """Two disks in place of star k, last, of half its area each, that lie side by side at `angle`, radians, from
        its longer axis."""
        others, remaining = self.without(k, coefficients)
        centre, log_radius, _, _, waves = self._values(k, self.rows(coefficients)[k])
        angle = angle - (np.angle(waves[0]) / 2 if len(waves) else 0)
        half = np.zeros(self.prior.size)
        half[2:4] = self.rows(coefficients)[k, 2:4]
        half[2] -= np.log(2) / 2 / self.prior.radius_spread
        step = np.exp(log_radius + 1j * angle) / np.sqrt(2)
        start = np.append(others.start, [centre + step, centre - step])
        sign, weak = np.append(others.sign, [self.sign[k]] * 2), np.append(others.weak, [self.weak[k]] * 2)
        return replace(self, start=start, sign=sign, weak=weak), np.concatenate([remaining, half, half])

    def weakened(self, some, coefficients) -> tuple[Stars, Float[np.ndarray, " n"]]:
        """The same with `some` stars taken for weak, and so much larger that they do as much to the field."""
        rows, weak = self.rows(coefficients).copy(), self.weak.copy()
        for k in some:
            strength = np.tanh(self._values(k, rows[k]).contrast / 2) / np.tanh(self.prior.weak_contrast / 2)
            rows[k, 2] += np.log(strength) / 2 / self.prior.radius_spread
            rows[k, 3], weak[k] = 0, True
        return replace(self, weak=weak), np.append(coefficients[0], rows)

    def with_modes(self, modes: int, coefficients) -> tuple[Stars, Float[np.ndarray, " n"]]:
        """The same stars with more modes, or fewer."""
        new = replace(self, prior=replace(self.prior, modes=modes))
        rows = np.zeros((len(self.sign), new.prior.size))
        kept = min(new.prior.size, self.prior.size)
        rows[:, :kept] = self.rows(coefficients)[:, :kept]
        return new, np.append(coefficients[0], rows)

    def image(self, coefficients) -> StarImage:
        """log σ/σ₀ per cell, how far the stars overlap, and the derivatives of both."""
        size = len(self.width)
        parts = [self._one(k, row) for k, row in enumerate(self.rows(coefficients))]
        drift, everywhere = np.full((size, 1), self.prior.drift), slice(None)
        image = coefficients[0] * drift[:, 0]
        slopes: list[tuple[Any, Any]] = [(everywhere, drift)]
        shares = np.zeros((len(parts), size))
        for k, (values, cells, share, slope) in enumerate(parts):
            # What a cell of which a share is covered does to the field is so much of what all of it would do.
            strength = np.tanh(values.contrast / 2)
            image[cells] += 2 * self.sign[k] * np.arctanh(share * strength)
            steep = self.sign[k] / (1 - (share * strength) ** 2)
            change = (2 * strength * steep)[:, None] * slope
            change[:, 3] = steep * share * (1 - strength**2) * values.contrast_slope
            slopes.append((cells, change))
            shares[k, cells] = share
        overlap, overlap_slope = [], []
        weighed = self.weight * shares
        for j, k in itertools.combinations(range(len(parts)), 2):
            rows = np.zeros((len(parts), self.prior.size))
            for one, other in ((j, k), (k, j)):
                _, cells, _, slope = parts[one]
                rows[one] = weighed[other, cells] @ slope
            overlap.append(weighed[j] @ shares[k])
            overlap_slope.append(np.append(0, rows))
        return StarImage(image, slopes, np.array(overlap), np.reshape(overlap_slope, (-1, len(coefficients))))

    def star(self, k: int, coefficients, rise: float = np.nan) -> Star:
        """Star k, as far as it lies in the body."""
        centre, log_radius, contrast, _, waves = self._values(k, self.rows(coefficients)[k])
        direction = np.exp(2j * np.pi * np.arange(_OUTLINE) / _OUTLINE)
        reach = np.exp(log_radius + self._wave(waves, direction)[0])
        to_edge, inside = _first_crossing(centre, direction, self.edges)
        _, cells, share, _ = self._one(k, self.rows(coefficients)[k])
        if not inside and (covered := share * self.weight[cells]).sum() > 0:
            outline = centre + direction * reach
            centre = covered @ self.points[cells].mean(axis=1) / covered.sum()
            reach, _ = _first_crossing(centre, direction, np.stack([outline, np.roll(outline, -1)], axis=1))
            to_edge, _ = _first_crossing(centre, direction, self.edges)
        outline = centre + direction * np.minimum(reach, to_edge)
        pair = np.stack([outline.real, outline.imag], axis=1)
        middle = np.array([centre.real, centre.imag])
        return Star(int(self.sign[k]), middle, pair, float(contrast), bool(self.weak[k]), float(rise))

    def _values(self, k: int, row) -> _Values:
        prior, values = self.prior, self.prior.deviation(self.span) * row
        return _Values(
            self.start[k] + values[0] + 1j * values[1],
            np.log(prior.radius * self.span) + values[2],
            *prior.contrast_of(row[3], self.weak[k]),
            values[4::2] - 1j * values[5::2],
        )

    def _wave(self, waves, direction):
        """Σ aₙ cos nθ + bₙ sin nθ and its slope, for directions exp iθ; and the powers exp inθ, n = 2 … N."""
        number = np.arange(2, self.prior.modes + 1)
        powers = np.cumprod(np.broadcast_to(direction, (self.prior.modes, *direction.shape)), axis=0)[1:]
        sums = np.tensordot(np.stack([waves, 1j * number * waves]), powers, 1)
        return sums[0].real, sums[1].real, powers

    def _one(self, k: int, row):
        """Star k's values, the cells it reaches (c,), its share of each, and the derivative of that (c, q)."""
        values = self._values(k, row)
        centre, log_radius, waves = values.centre, values.log_radius, values.waves
        # No outline lies farther out, and beyond so many widths of the blur no share is left.
        farthest = np.exp(np.minimum(log_radius + np.abs(waves).sum(), np.log(10 * self.span)))
        cells = np.flatnonzero(np.abs(self.points[:, 0] - centre) < farthest + _REACH * self.width)
        offset, width = self.points[cells] - centre, self.width[cells, None]
        distance = np.maximum(np.abs(offset), 1e-9 * self.span)
        direction = offset / distance
        wave, slope, powers = self._wave(waves, direction)
        radius = np.exp(np.minimum(log_radius + wave, np.log(10 * self.span)))
        inside = 0.5 * (1 + np.tanh(0.5 * (radius - distance) / width))
        edge = inside * (1 - inside) / width / len(_SAMPLES)  # d share / d(r - distance)
        # As the centre moves by dz, the distance falls by Re(dz/u), and θ by Im(dz/u) / distance; u is the direction.
        towards = (edge * (1 - 1j * radius * slope / distance) * direction).sum(axis=1)
        along = edge * radius
        modes = np.einsum("ms,nms->mn", along, powers)
        share = inside.mean(axis=1)
        columns = [towards.real, towards.imag, along.sum(axis=1), np.zeros_like(share)]
        columns += [part for mode in modes.T for part in (mode.real, mode.imag)]
        return values, cells, share, np.stack(columns, axis=1) * self.prior.deviation(self.span)


def _first_crossing(centre: complex, direction, edges) -> tuple[Float[np.ndarray, " k"], bool]:
    """How far from `centre` lines in some `direction` (k,) first cross `edges` (b, 2), infinity where they do not; and
    whether the closed line that these are goes round it."""
    start, along = edges[:, 0] - centre, edges[:, 1] - edges[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = _cross(direction[:, None], along)
        distance, share = _cross(start, along) / across, _cross(start, direction[:, None]) / across
    crossed = (distance > 0) & (share >= 0) & (share < 1)
    return np.where(crossed, distance, np.inf).min(axis=1), bool((crossed.sum(axis=1) % 2).mean() > 0.5)


def _cross(one, other):
    return (np.conj(one) * other).imag
