"""Surfaces on which sources lie: charts of two coordinates u (m), with an outline in the chart.

A plane is its own chart. A curved surface is a height over its best plane, interpolated by a thin-plate spline through
known points of it; no two points of the surface may lie above each other.
"""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import describe
from jeit.mesh import Domain, Polygon
from jeit_solvers.engines import as_array, namespace, on_host, slopes

# Most knots of the spline: more make evaluations slower and the surface no smoother.
_MOST_KNOTS = 300


class AbstractSurface(eqx.Module):
    """A surface with its outline."""

    outline: eqx.AbstractVar[Polygon]

    @abc.abstractmethod
    def place(self, chart: Float[Array, "2 ..."]) -> Float[Array, "d ..."]:
        """Points in space from chart coordinates."""

    @abc.abstractmethod
    def project(self, points: Float[Array, "d ..."]) -> Float[Array, "2 ..."]:
        """Chart coordinates of points in space, along the normal of the chart's plane."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """Dimension of the space: 2 or 3."""


class Plane(AbstractSurface):
    """The plane itself: coordinates are positions (x, y)."""

    outline: Polygon

    def place(self, chart):
        """Nothing to do."""
        return chart

    def project(self, points):
        """Nothing to do."""
        return points

    @property
    def dimension(self):
        """Dimension of the space, 2."""
        return 2


class CurvedSurface(AbstractSurface):
    """x(u) = origin + axes u + normal h(u), with a thin-plate spline h = Σ w_k ρ_k² log ρ_k + affine."""

    outline: Polygon
    origin: Float[Array, " 3"]
    axes: Float[Array, "3 2"]
    normal: Float[Array, " 3"]
    knots: Float[Array, "N 2"]
    weights: Float[Array, " N"]
    affine: Float[Array, " 3"]

    def place(self, chart):
        """Points above the chart coordinates u."""
        flat = chart.reshape(2, -1)
        squared = namespace(self, chart).sum((flat[:, None] - self.knots.T[:, :, None]) ** 2, axis=0)
        height = self.weights @ _thin_plate(squared) + self.affine[0] + self.affine[1:] @ flat
        points = self.origin[:, None] + self.axes @ flat + self.normal[:, None] * height
        return points.reshape(3, *chart.shape[1:])

    def project(self, points):
        """Coordinates in the plane."""
        flat = points.reshape(3, -1) - self.origin[:, None]
        return (self.axes.T @ flat).reshape(2, *points.shape[1:])

    @property
    def dimension(self):
        """Dimension of the space, 3."""
        return 3


def make_surface(outline: Domain | ArrayLike, points: ArrayLike | None = None) -> AbstractSurface:
    """Create the surface within `outline`: vertices (K, 2), or an outline such as `Disk`; or (K, 3) in space.

    In space the surface passes through the outline and `points` (T, 3), places of taps for instance. Raises
    `ValueError` for outlines that are none, and for surfaces that fold over their best plane.
    """
    if isinstance(outline, Domain):
        edge, *holes = outline.loops()
        return Plane(Polygon(edge, holes))
    try:
        vertices = np.asarray(outline, float)
    except (TypeError, ValueError):
        wanted = "an outline, such as Disk(0.1), or vertices (K, 2) or (K, 3) in metres"
        raise ValueError(f"outline must be {wanted}; it is {describe(outline)}.") from None
    if vertices.ndim != 2 or vertices.shape[1] not in (2, 3) or len(vertices) < 3:
        raise ValueError(f"outline: give at least three vertices (K, 2) or (K, 3) in metres; got {vertices.shape}.")
    if vertices.shape[1] == 2:
        return Plane(Polygon(vertices))
    known = vertices if points is None else np.vstack([vertices, np.asarray(points, float)])
    if not np.isfinite(known).all():
        raise ValueError("outline: every coordinate of the outline and of the points on it must be finite.")
    return _curved(vertices, np.unique(known, axis=0))


def bounding_box(surface: AbstractSurface) -> tuple[Float[Array, " 2"], Float[Array, " 2"]]:
    """Lower left and upper right corner of the outline's box in the chart, metres."""
    vertices = surface.outline.vertices
    return vertices.min(axis=0), vertices.max(axis=0)


def in_space(
    surface: AbstractSurface, chart: Float[Array, "2 F"], covariance: Float[Array, "2 2 F"]
) -> tuple[Float[Array, "F d"], Float[Array, "F d d"]]:
    """Positions in space, and their covariances, from positions and covariances in the chart."""
    place, along = slopes(surface.place, chart)
    xp = namespace(place, covariance)
    along = xp.stack(along)
    return place.T, xp.einsum("kaf,klf,lbf->fab", along, covariance, along)


def longer_side(surface: AbstractSurface) -> Float[Array, ""]:
    """The longer side of the outline's box, metres."""
    low, high = bounding_box(surface)
    return (high - low).max()


def chart_grid(surface: AbstractSurface, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres of columns × rows pixels that fill the outline's box, (2, rows, columns), bottom row first; and the mask
    of those inside the outline, (rows, columns)."""
    at_hand: AbstractSurface = on_host(surface)
    (left, bottom), (right, top) = bounding_box(at_hand)
    x = left + (right - left) * (np.arange(columns) + 0.5) / columns
    y = bottom + (top - bottom) * (np.arange(rows) + 0.5) / rows
    grid = np.stack(np.meshgrid(x, y))
    return grid, np.asarray(at_hand.outline.contains(np.moveaxis(grid, 0, -1)))


def outline_sides(surface: AbstractSurface) -> tuple[Float[Array, "2 K"], Float[Array, "2 K"]]:
    """Start and end of each side of the outline and of its holes, in the chart."""
    loops = surface.outline.loops()
    xp = namespace(loops)
    start, end = (xp.concatenate([xp.roll(loop, -shift, axis=0) for loop in loops]) for shift in (0, 1))
    return start.T, end.T


def _thin_plate(squared):
    """ρ² log ρ of ρ², and 0 at 0."""
    xp = namespace(squared)
    positive = squared.real > 0
    safe = xp.where(positive, squared, 1.0)
    return xp.where(positive, 0.5 * safe * xp.log(safe), 0.0)


def _curved(vertices: np.ndarray, known: np.ndarray) -> CurvedSurface:
    origin = known.mean(axis=0)
    _, spread, directions = np.linalg.svd(known - origin, full_matrices=False)
    if spread[1] <= 1e-6 * spread[0]:
        raise ValueError("outline: its vertices lie on one line; give the outline of a surface, in metres.")
    normal = directions[2] * (1.0 if directions[2][np.argmax(np.abs(directions[2]))] > 0 else -1.0)
    # The chart's first axis follows that of space which is most nearly in its plane.
    leading = np.eye(3)[np.argmin(np.abs(normal) + np.array([0.0, 1e-3, 2e-3]))]
    first = leading - normal * (normal @ leading)
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    chart, height = (known - origin) @ axes, (known - origin) @ normal
    scale = np.ptp(chart, axis=0).max()
    keep = _spread(chart, _MOST_KNOTS)
    chart, height = chart[keep], height[keep]
    apart = np.linalg.norm(chart[:, None] - chart, axis=-1) + 2 * scale * np.eye(len(chart))
    first_of, second_of = np.unravel_index(apart.argmin(), apart.shape)
    if apart.min() < 1e-3 * scale and abs(height[first_of] - height[second_of]) > 10 * apart.min():
        raise ValueError(
            "positions: the surface folds over its best plane (two points lie above each other), which jeit cannot "
            "chart; calibrate its parts one by one."
        )
    squared = np.sum((chart[:, None] - chart) ** 2, axis=-1)
    kernel = _thin_plate(squared)
    polynomial = np.column_stack([np.ones(len(chart)), chart])
    # A little smoothing, so that points known to a fraction of a per cent do not make waves.
    system = np.block([[kernel + 1e-9 * scale**2 * np.eye(len(chart)), polynomial], [polynomial.T, np.zeros((3, 3))]])
    solution = np.linalg.lstsq(system, np.concatenate([height, np.zeros(3)]), rcond=None)[0]
    arrays = (origin, axes, normal, chart, solution[:-3], solution[-3:])
    return CurvedSurface(Polygon((vertices - origin) @ axes), *(as_array(array) for array in arrays))


def _spread(points: np.ndarray, most: int) -> np.ndarray:
    """Indices of at most `most` points, far from each other."""
    if len(points) <= most:
        return np.arange(len(points))
    chosen, distance = [0], np.full(len(points), np.inf)
    while len(chosen) < most:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
