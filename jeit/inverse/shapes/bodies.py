"""Base classes of bodies on a mesh, of any form: conductivity computed from the bodies' coefficients.

    log σ/σ₀ = drift + Σ_bodies mixture(share of a cell that a body covers, ± contrast),

± contrast where it covers all. Everything is estimated in units of its prior's standard deviation, so that the penalty
is ½‖coefficients‖².
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.arguments import describe, is_number

# Fields of `Bodies` with one value for every body, besides its start.
_OF_EACH = ("sign", "other", "alike")


@dataclass(frozen=True)
class BodyPrior(abc.ABC):
    """Prior of bodies, as standard deviations; lengths are in units of the longer side of the whole body.

    - `modes`: number of modes of a body's form; 1 makes disks and balls.
    - `place`: of the centre about where the search starts. `radius` with the spread of its logarithm.
    - `roughness`: deviation of the form from round.
    - `drift`: of the logarithm of the bath's conductivity between the two frames.
    - `apart`: over the share of the whole body by which two bodies overlap, its standard deviation. Without it two of
      opposite sign may lie on each other and cancel.

    Raises `ValueError` for what is not positive.
    """

    modes: int
    place: float = 0.15
    radius: float = 0.12
    radius_spread: float = 0.5
    roughness: float = 0.25
    drift: float = 0.1
    apart: float = 1e3

    def __post_init__(self):
        for name, value in self._numbers.items():
            if not (is_number(value) and value > 0):
                raise ValueError(f"{name} must be a positive number; it is {describe(value)}.")
        if self.modes != int(self.modes):
            raise ValueError(f"modes must be a whole number from 1; it is {describe(self.modes)}.")

    @property
    def _numbers(self) -> dict[str, Any]:
        """Values that have to be positive."""
        return vars(self)

    @property
    def is_of_one_kind(self) -> bool:
        """Whether bodies can be of one of the two kinds only."""
        return False

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Coefficients of a body: centre, log radius, contrast, and those of its form."""

    @abc.abstractmethod
    def deviation(self, span: float) -> Float[np.ndarray, " q"]:
        """Standard deviations of a body's values, 1 of its contrast; `span` of the whole body, metres."""

    @abc.abstractmethod
    def contrast_of(self, coefficient: float, other: bool) -> tuple[float, float]:
        """Contrast of log σ of a body, of the `other` kind or not, positive, and its derivative."""


class BodyImage(NamedTuple):
    """**Fields**: `image` (m,), log σ/σ₀; its derivatives `slopes`, by the drift in all cells, then by every body's
    coefficients in the cells that it reaches; `overlap` of every two bodies, in units of the whole measure, and its
    derivative `overlap_slope`."""

    image: Float[np.ndarray, " m"]
    slopes: Sequence[tuple[Any, Float[np.ndarray, "k q"]]]
    overlap: Float[np.ndarray, " p"]
    overlap_slope: Float[np.ndarray, "p n"]


class Covered(NamedTuple):
    """The `cells` (c,) that a body reaches, the `share` (c,) of each that it covers, and the derivative of that by the
    body's coefficients, `slope` (c, q)."""

    cells: Any
    share: Float[np.ndarray, " c"]
    slope: Float[np.ndarray, "c q"]


@dataclass(frozen=True)
class Bodies(abc.ABC):
    """Bodies of one form. Coefficients: the drift, then body by body: centre, log radius, contrast, and the form's own.

    **Fields**: `prior` of every body; `weight` (m,), every cell's share of the whole measure; `span`, the longest side
    of the whole body; `start` (k, d), metres, and `sign` (k,) of every body; `other` (k,), whether it is of the form's
    other kind: weak among stars, a column among ellipsoids; `alike` (k,), whether it is of one material with all others
    of its sign that are: they share the contrast of the first of them, and their own coefficients of contrast have no
    effect.
    """

    prior: Any
    weight: Float[np.ndarray, " m"]
    span: float
    start: Float[np.ndarray, "k d"]
    sign: Float[np.ndarray, " k"]
    other: Bool[np.ndarray, " k"]
    alike: Bool[np.ndarray, " k"]

    @property
    @abc.abstractmethod
    def odds(self) -> float:
        """Logarithm of the prior odds against bodies of their kinds."""

    @property
    @abc.abstractmethod
    def num_splits(self) -> int:
        """Number of axes, from the longest, along which a body is tentatively split in two."""

    @abc.abstractmethod
    def otherwise(self, some: Any, coefficients: Float[np.ndarray, " n"]) -> tuple[Self, Float[np.ndarray, " n"]]:
        """The same bodies with `some` of them of the other kind, with about the same effect."""

    @abc.abstractmethod
    def mixture(self, share: Float[np.ndarray, " c"], contrast: float) -> tuple[Any, Any, Any]:
        """log σ/σ₀ (c,) of cells of which a body of a `contrast`, + or -, covers a `share`; its derivatives by both."""

    @abc.abstractmethod
    def covered(self, k: int, row: Float[np.ndarray, " q"]) -> Covered:
        """The cells that body k, of these coefficients, covers."""

    @abc.abstractmethod
    def axis(self, k: int, row: Float[np.ndarray, " q"], number: int) -> Float[np.ndarray, " d"]:
        """Unit vector along an axis of body k, the longest first."""

    @abc.abstractmethod
    def body(self, k: int, coefficients: Float[np.ndarray, " n"], rise: float = np.nan) -> Any:
        """Body k, as far as it lies in the whole one."""

    @property
    def dimension(self) -> int:
        """Spatial dimension d."""
        return self.start.shape[1]

    @property
    def first(self) -> Int[np.ndarray, " k"]:
        """Index of the body whose contrast each body has: itself, or the first of the same material."""
        order, first = np.arange(len(self.sign)), np.arange(len(self.sign))
        for one in (self.alike & (self.sign == sign) for sign in (-1, 1)):
            first[one] = order[one].min(initial=len(order))
        return first

    def rows(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k q"]:
        """Coefficients of every body."""
        rows = coefficients[1:].reshape(len(self.sign), self.prior.size).copy()
        rows[:, self.dimension + 1] = rows[self.first, self.dimension + 1]
        return rows

    def by_coefficients(self, by_rows: Float[np.ndarray, "r n"]) -> Float[np.ndarray, "r n"]:
        """Derivatives by the coefficients from those by the drift and every body's row."""
        by_rows, order = by_rows.copy(), np.arange(len(self.sign))
        contrast = 1 + order * self.prior.size + self.dimension + 1
        for k in order[self.first != order]:
            by_rows[:, contrast[self.first[k]]] += by_rows[:, contrast[k]]
            by_rows[:, contrast[k]] = 0
        return by_rows

    def of_radii(self, radii) -> Float[np.ndarray, " n"]:
        """Coefficients of disks or balls, metres, at the start."""
        rows = np.zeros((len(self.sign), self.prior.size))
        relative = np.log(np.asarray(radii, float) / (self.prior.radius * self.span)) / self.prior.radius_spread
        rows[:, self.dimension] = np.clip(relative, -2, 2)
        return np.append(0, rows)

    def centre(self, k: int, row: Float[np.ndarray, " q"]) -> Float[np.ndarray, " d"]:
        """Centre of body k, metres."""
        return self.start[k] + self.prior.place * self.span * row[: self.dimension]

    def log_radius(self, row: Float[np.ndarray, " q"]) -> float:
        """Logarithm of the mean radius of a body, metres."""
        return np.log(self.prior.radius * self.span) + self.prior.radius_spread * row[self.dimension]

    def contrast(self, k: int, row: Float[np.ndarray, " q"]) -> tuple[float, float]:
        """Contrast of log σ of body k, positive, and its derivative by the coefficient."""
        return self.prior.contrast_of(row[self.dimension + 1], bool(self.other[k]))

    def shown(self, coefficients: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """log σ/σ₀ (m,) for pictures."""
        return self.image(coefficients).image

    def only(self, some) -> Self:
        """A subset of the bodies."""
        some = np.asarray(some, int)
        return replace(self, **{name: getattr(self, name)[some] for name in ("start", *_OF_EACH)})

    def without(self, k: int, coefficients) -> tuple[Self, Float[np.ndarray, " n"]]:
        """The others, and their coefficients."""
        others = self.only(np.delete(np.arange(len(self.sign)), k))
        return others, np.append(coefficients[0], np.delete(self.rows(coefficients), k, axis=0))

    def split(self, k: int, coefficients, number: int) -> tuple[Self, Float[np.ndarray, " n"]]:
        """Two round ones in place of body k, last, of half its measure each, that lie side by side along an axis."""
        others, remaining = self.without(k, coefficients)
        row, d = self.rows(coefficients)[k], self.dimension
        half = np.zeros(self.prior.size)
        half[d : d + 2] = row[d : d + 2]
        half[d] -= np.log(2) / d / self.prior.radius_spread
        step = np.exp(self.log_radius(half)) * self.axis(k, row, number)
        if d == 3:
            step = step * 2 ** (-1 / 3)  # as far out as the middles of the two halves, and some more
        middle = self.centre(k, row)
        start = np.concatenate([others.start, [middle + step, middle - step]])
        each = {name: np.append(getattr(others, name), [getattr(self, name)[k]] * 2) for name in _OF_EACH}
        return replace(self, start=start, **each), np.concatenate([remaining, half, half])

    def with_modes(self, modes: int, coefficients) -> tuple[Self, Float[np.ndarray, " n"]]:
        """The same bodies with more modes, or fewer."""
        new = replace(self, prior=replace(self.prior, modes=modes))
        rows = np.zeros((len(self.sign), new.prior.size))
        kept = min(new.prior.size, self.prior.size)
        rows[:, :kept] = self.rows(coefficients)[:, :kept]
        return new, np.append(coefficients[0], rows)

    def image(self, coefficients) -> BodyImage:
        """log σ/σ₀ per cell, how far the bodies overlap, and the derivatives of both."""
        size, d = len(self.weight), self.dimension
        rows = self.rows(coefficients)
        parts = [self.covered(k, row) for k, row in enumerate(rows)]
        drift, everywhere = np.full((size, 1), self.prior.drift), None
        image = coefficients[0] * drift[:, 0]
        slopes: list[tuple[Any, Any]] = [(everywhere, drift)]
        shares = np.zeros((len(parts), size))
        for k, (cells, share, slope) in enumerate(parts):
            contrast, contrast_slope = (self.sign[k] * one for one in self.contrast(k, rows[k]))
            mixed, by_share, by_contrast = self.mixture(share, contrast)
            image[cells] += mixed
            change = by_share[:, None] * slope
            change[:, d + 1] = by_contrast * contrast_slope
            slopes.append((cells, change))
            shares[k, cells] = share
        overlap, overlap_slope = [], []
        weighed = self.weight * shares
        for j, k in itertools.combinations(range(len(parts)), 2):
            by_row = np.zeros((len(parts), self.prior.size))
            for one, other in ((j, k), (k, j)):
                cells, _, slope = parts[one]
                by_row[one] = weighed[other, cells] @ slope
            overlap.append(weighed[j] @ shares[k])
            overlap_slope.append(np.append(0, by_row))
        return BodyImage(image, slopes, np.array(overlap), np.reshape(overlap_slope, (-1, len(coefficients))))
