"""Surfaces on which sound sources lie, described by a chart with two coordinates u in metres and an outline in the
chart.

The chart of a plane surface is the plane itself. A curved surface is described by its height above the best-fitting
plane, which a thin-plate spline interpolates between known points. The height must be a single-valued function of the
chart coordinates.
"""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import describe
from jeit.mesh import Domain, Polygon
from jeit_solvers.engines import as_array, namespace, on_host, slopes
from jeit_solvers.module import Module

# Maximum number of spline knots: more would slow down evaluation without making the surface smoother.
_MAX_KNOTS = 300
# Distance in the best plane below which points are at one place, and difference of the heights of such points from
# their mean above which the surface folds, relative to the extent of the points.
_MIN_KNOT_DISTANCE, _FOLD_HEIGHT_DIFFERENCE = 1e-3, 0.01


class AbstractSurface(Module):
    """Base class of surfaces on which sources lie. `outline` is the outline of the surface in chart coordinates, in
    metres."""

    outline: eqx.AbstractVar[Polygon]

    @abc.abstractmethod
    def place(self, chart: Float[Array, "2 ..."]) -> Float[Array, "d ..."]:
        """Points (d, …) of the surface in metres from chart coordinates (2, …)."""

    @abc.abstractmethod
    def project(self, points: Float[Array, "d ..."]) -> Float[Array, "2 ..."]:
        """Chart coordinates (2, …) of points (d, …) in metres, projected along the normal of the chart's plane."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """Dimension d of the space in which the surface lies: 2 or 3."""


class Plane(AbstractSurface):
    """A plane surface, whose chart coordinates are the positions (x, y) in metres."""

    outline: Polygon

    def place(self, chart):
        """Return the chart coordinates `chart`, which are the positions in metres."""
        return chart

    def project(self, points):
        """Return the positions `points`, which are the chart coordinates in metres."""
        return points

    @property
    def dimension(self):
        """Dimension of the space in which the plane lies, 2."""
        return 2


class CurvedSurface(AbstractSurface):
    """A curved surface x(u) = origin + axes u + normal h(u) with chart coordinates u. The height h = Σ w_k ρ_k² log ρ_k
    + affine is a thin-plate spline, where ρ_k is the distance of u from knot k, w_k are the `weights`, and `affine` are
    the coefficients of 1, u₁ and u₂."""

    outline: Polygon
    origin: Float[Array, " 3"]
    axes: Float[Array, "3 2"]
    normal: Float[Array, " 3"]
    knots: Float[Array, "N 2"]
    weights: Float[Array, " N"]
    affine: Float[Array, " 3"]

    def place(self, chart):
        """Points (3, …) of the surface in metres from chart coordinates (2, …)."""
        flat_chart = chart.reshape(2, -1)
        squared_distances = namespace(self, chart).sum((flat_chart[:, None] - self.knots.T[:, :, None]) ** 2, axis=0)
        surface_height = self.weights @ _thin_plate(squared_distances) + self.affine[0] + self.affine[1:] @ flat_chart
        surface_points = self.origin[:, None] + self.axes @ flat_chart + self.normal[:, None] * surface_height
        return surface_points.reshape(3, *chart.shape[1:])

    def project(self, points):
        """Chart coordinates (2, …) of points (3, …) in metres, projected along the normal of the chart's plane."""
        flat_points = points.reshape(3, -1) - self.origin[:, None]
        return (self.axes.T @ flat_points).reshape(2, *points.shape[1:])

    @property
    def dimension(self):
        """Dimension of the space in which the surface lies, 3."""
        return 3


def make_surface(outline: Domain | ArrayLike, points: ArrayLike | None = None) -> AbstractSurface:
    """Create the surface of a skin with the given `outline`.

    A plane surface is specified by vertices (K, 2) in metres or an outline such as `Disk`; a curved surface by vertices
    (K, 3) in metres and optionally `points` (T, 3), such as the positions of taps. The curved surface is a smooth
    surface that passes close to the vertices and points. Raises `ValueError` for invalid outlines, and for surfaces
    that fold over their best-fitting plane.
    """
    if isinstance(outline, Domain):
        outer_loop, *holes = outline.loops()
        return Plane(Polygon(outer_loop, holes))
    try:
        outline_vertices = np.asarray(outline, float)
    except (TypeError, ValueError):
        outline_requirement = "an outline, such as Disk(0.1), or vertices (K, 2) or (K, 3) in metres"
        raise ValueError(f"outline must be {outline_requirement}; it is {describe(outline)}.") from None
    if outline_vertices.ndim != 2 or outline_vertices.shape[1] not in (2, 3) or len(outline_vertices) < 3:
        raise ValueError(
            f"outline: give at least three vertices (K, 2) or (K, 3) in metres; got {outline_vertices.shape}."
        )
    if outline_vertices.shape[1] == 2:
        return Plane(Polygon(outline_vertices))
    surface_points = outline_vertices if points is None else np.vstack([outline_vertices, np.asarray(points, float)])
    if not np.isfinite(surface_points).all():
        raise ValueError("outline: every coordinate of the outline and of the points on it must be finite.")
    return _curved_surface(outline_vertices, np.unique(surface_points, axis=0))


def bounding_box(surface: AbstractSurface) -> tuple[Float[Array, " 2"], Float[Array, " 2"]]:
    """Lower left and upper right corner (2,) of the bounding box of a surface's outline in the chart, in metres."""
    vertices = surface.outline.vertices
    return vertices.min(axis=0), vertices.max(axis=0)


def to_three_dimensions(
    surface: AbstractSurface, chart: Float[Array, "2 F"], covariance: Float[Array, "2 2 F"]
) -> tuple[Float[Array, "F d"], Float[Array, "F d d"]]:
    """Transform positions (2, F) and covariances (2, 2, F) in the chart to positions (F, d) and covariances (F, d, d)
    in space."""
    space_position, chart_derivatives = slopes(surface.place, chart)
    xp = namespace(space_position, covariance)
    chart_derivatives = xp.stack(chart_derivatives)
    return space_position.T, xp.einsum("kaf,klf,lbf->fab", chart_derivatives, covariance, chart_derivatives)


def longer_side(surface: AbstractSurface) -> Float[Array, ""]:
    """Length in metres of the longer side of the bounding box of a surface's outline."""
    lower_corner, upper_corner = bounding_box(surface)
    return (upper_corner - lower_corner).max()


def chart_grid(surface: AbstractSurface, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres (2, rows, columns) of the pixels of a raster over the outline's bounding box, bottom row
    first, and the mask (rows, columns) of the pixels inside the outline."""
    host_surface: AbstractSurface = on_host(surface)
    (x_min, y_min), (x_max, y_max) = bounding_box(host_surface)
    x = x_min + (x_max - x_min) * (np.arange(columns) + 0.5) / columns
    y = y_min + (y_max - y_min) * (np.arange(rows) + 0.5) / rows
    pixel_centres = np.stack(np.meshgrid(x, y))
    return pixel_centres, np.asarray(host_surface.outline.contains(np.moveaxis(pixel_centres, 0, -1)))


def outline_sides(surface: AbstractSurface) -> tuple[Float[Array, "2 K"], Float[Array, "2 K"]]:
    """Start and end points (2, K) of all K sides of a surface's outline and its holes, in chart coordinates."""
    outline_loops = surface.outline.loops()
    xp = namespace(outline_loops)
    side_starts, side_ends = (
        xp.concatenate([xp.roll(outline_loop, -index_shift, axis=0) for outline_loop in outline_loops])
        for index_shift in (0, 1)
    )
    return side_starts.T, side_ends.T


def _thin_plate(squared_distances):
    """Thin-plate kernel ρ² log ρ as a function of ρ²; 0 for ρ = 0."""
    xp = namespace(squared_distances)
    is_positive_distance = squared_distances.real > 0
    positive_squared = xp.where(is_positive_distance, squared_distances, 1.0)
    return xp.where(is_positive_distance, 0.5 * positive_squared * xp.log(positive_squared), 0.0)


def _curved_surface(outline_vertices: np.ndarray, points_on_surface: np.ndarray) -> CurvedSurface:
    chart_origin = points_on_surface.mean(axis=0)
    _, singular_values, principal_directions = np.linalg.svd(points_on_surface - chart_origin, full_matrices=False)
    if singular_values[1] <= 1e-6 * singular_values[0]:
        raise ValueError("outline: its vertices lie on one line; give the outline of a surface, in metres.")
    plane_normal = principal_directions[2] * (
        1.0 if principal_directions[2][np.argmax(np.abs(principal_directions[2]))] > 0 else -1.0
    )
    # The first axis of the chart is the projection of the coordinate axis that is most nearly parallel to the
    # best-fitting plane.
    least_aligned_axis = np.eye(3)[np.argmin(np.abs(plane_normal) + np.array([0.0, 1e-3, 2e-3]))]
    first_axis = least_aligned_axis - plane_normal * (plane_normal @ least_aligned_axis)
    first_axis /= np.linalg.norm(first_axis)
    chart_axes = np.stack([first_axis, np.cross(plane_normal, first_axis)], axis=1)
    chart_points, point_heights = (
        (points_on_surface - chart_origin) @ chart_axes,
        (points_on_surface - chart_origin) @ plane_normal,
    )
    chart_size = np.ptp(chart_points, axis=0).max()
    knot_points = chart_points[_farthest_points(chart_points, _MAX_KNOTS, _MIN_KNOT_DISTANCE * chart_size)]
    knot_distances, knot_index = KDTree(knot_points).query(chart_points)
    is_same_as_knot = knot_distances <= _MIN_KNOT_DISTANCE * chart_size
    knot_index, height_at_knot = knot_index[is_same_as_knot], point_heights[is_same_as_knot]
    # A place that was touched several times has the mean height.
    knot_height = np.bincount(knot_index, height_at_knot) / np.bincount(knot_index)
    if (np.abs(height_at_knot - knot_height[knot_index]) > _FOLD_HEIGHT_DIFFERENCE * chart_size).any():
        raise ValueError(
            "positions: the surface folds over its best plane (two points lie above each other), which jeit cannot "
            "chart; calibrate its parts one by one."
        )
    chart_points, point_heights = knot_points, knot_height
    squared_distances = np.sum((chart_points[:, None] - chart_points) ** 2, axis=-1)
    spline_kernel = _thin_plate(squared_distances)
    polynomial_terms = np.column_stack([np.ones(len(chart_points)), chart_points])
    # The spline is slightly smoothed, so that small errors of the points, a fraction of a per cent, do not make the
    # surface wavy.
    spline_system = np.block(
        [
            [spline_kernel + 1e-9 * chart_size**2 * np.eye(len(chart_points)), polynomial_terms],
            [polynomial_terms.T, np.zeros((3, 3))],
        ]
    )
    spline_solution = np.linalg.lstsq(spline_system, np.concatenate([point_heights, np.zeros(3)]), rcond=None)[0]
    surface_arrays = (chart_origin, chart_axes, plane_normal, chart_points, spline_solution[:-3], spline_solution[-3:])
    return CurvedSurface(
        Polygon((outline_vertices - chart_origin) @ chart_axes),
        *(as_array(surface_array) for surface_array in surface_arrays),
    )


def _farthest_points(points: np.ndarray, max_points: int, min_distance: float) -> np.ndarray:
    """Indices, in increasing order, of at most `max_points` of the `points` that are far from each other
    (farthest-point sampling), and more than `min_distance` apart."""
    chosen_indices, distances_to_chosen = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen_indices) < max_points and distances_to_chosen.max() > min_distance:
        chosen_indices.append(int(distances_to_chosen.argmax()))
        distances_to_chosen = np.minimum(
            distances_to_chosen, np.linalg.norm(points - points[chosen_indices[-1]], axis=1)
        )
    return np.sort(chosen_indices)
