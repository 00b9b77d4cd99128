"""Local refinement of plane meshes, and the error for a requested number of nodes that is too small."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from jeit.mesh.generate.curve import Curve, SizeFunction, is_inside_curves
from jeit_solvers.module import Module

# Factor between successive trial numbers of nodes, and maximum number of nodes tried.
_NODE_NUMBER_TRIAL_FACTOR, _MAX_TRIAL_NODES = 1.1, 2e6


class TooFewNodesError(ValueError):
    """Raised if a plane mesh needs about `min_points` nodes, more than requested.

    `solid` is the message for a plane mesh that is the base of a solid, without the leading "num_points: "; {asked} and
    {least} in this message are replaced by numbers of nodes of the solid.
    """

    def __init__(self, message: str, min_points: int, solid: str):
        super().__init__(message)
        self.min_points, self.solid = min_points, solid


@contextmanager
def nodes_of_solid(num_requested: int | None, count_base_nodes: Callable[[int], int]) -> Iterator[None]:
    """Convert a `TooFewNodesError` raised inside this context into a `ValueError` about the number of nodes of a
    solid.

    `num_requested`: number of nodes requested for the solid; `count_base_nodes`: function that returns how many of a
    solid's nodes lie in its base.
    """
    try:
        yield
    except TooFewNodesError as error:
        if num_requested is None:
            raise
        num_points = float(num_requested)
        while count_base_nodes(round(num_points)) < error.min_points and num_points < _MAX_TRIAL_NODES:
            num_points *= _NODE_NUMBER_TRIAL_FACTOR
        min_points = float(f"{num_points:.2g}")
        raise ValueError(f"num_points: {error.solid.format(asked=num_requested, least=f'{min_points:.0f}')}") from None


# Maximum increase of the edge length per unit of distance, away from nodes that lie close together and in a user's size
# function.
_MAX_EDGE_LENGTH_GROWTH = 0.45


class Refine(Module):
    """Request for smaller cells near specified points, or along the whole outline.

    At a distance r from the nearest of `points`, the edges of cells have lengths of at most h + growth · max(r −
    distance, 0), where h is the cell size at the points: `cell_size`, or the background cell size divided by `factor`.

    The current density is singular at the edges of electrodes, so refinement there is effective. For 16 electrodes that
    cover half the rim of a disk, `disk(radius, num_points=1200, refine=Refine(edges, factor=5, growth=0.3),
    boundary_points=angles)`, with `edges` the end points of the electrodes and `angles` the angles of these points,
    reduces the maximum error of a voltage between electrodes that carry no current from 2.2 % (uniform rings) to 0.5 %.
    With 10,000 nodes and `factor=8, growth=0.4` the error falls below 0.1 % (for contact impedance times conductivity
    between 0.01 and 0.1 radii).

    **Fields**: `points` (k, 2): coordinates in metres, or None for the whole outline; `cell_size`: in metres; `factor`:
    ratio of the background cell size to the cell size at the points, at least 1; `growth`: increase of the edge length
    per unit of distance, at most 1 (default 0.35; above 0.7 cells are visibly stretched); `distance`: distance in
    metres from the points within which cells have their smallest size.

    **Example:**

    ```python
    ends = [[0.1, 0.0], [0.0, 0.1]]
    graded = disk(0.1, num_points=300, refine=Refine(ends, factor=4))
    ```
    """

    points: np.ndarray | None
    cell_size: float | None
    factor: float | None
    growth: float
    distance: float

    def __init__(
        self,
        points: ArrayLike | None = None,
        *,
        cell_size: float | None = None,
        factor: float | None = None,
        growth: float = 0.35,
        distance: float = 0.0,
    ):
        """Exactly one of `cell_size` and `factor` must be specified. Raises `ValueError` on values out of range."""
        if points is not None:
            points = np.atleast_2d(np.asarray(points, dtype=float))
            if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
                raise ValueError(
                    f"points: expected finite coordinates of shape (k, 2) in metres, got shape {points.shape}."
                )
        if (cell_size is None) == (factor is None):
            raise ValueError("Refine: give exactly one of cell_size (metres) and factor (times smaller).")
        if cell_size is not None and not (np.isfinite(cell_size) and cell_size > 0):
            raise ValueError(f"cell_size: expected a positive length in metres, got {cell_size!r}.")
        if factor is not None and not (np.isfinite(factor) and factor >= 1):
            raise ValueError(f"factor: cells become `factor` times smaller, so it must be >= 1, got {factor!r}.")
        if not 0 < growth <= 1:
            raise ValueError(
                f"growth: must lie in (0, 1], got {growth!r}; cells that grow faster cannot be well shaped."
            )
        if not (np.isfinite(distance) and distance >= 0):
            raise ValueError(f"distance: expected a length in metres >= 0, got {distance!r}.")
        self.points = points
        self.cell_size = cell_size
        self.factor = factor
        self.growth = float(growth)
        self.distance = float(distance)

    def smallest(self, background: float) -> float:
        """Edge length in metres at the refined points, for a background cell size in metres."""
        if self.cell_size is not None:
            return self.cell_size
        assert self.factor is not None
        return background / self.factor


Refinement = Refine | Sequence[Refine] | Callable[[np.ndarray], np.ndarray] | None


class SizeField:
    """Requested edge length at any point, for a given background cell size."""

    def __init__(self, curves: list[Curve], refine: Refinement, required_nodes: np.ndarray, spacing: np.ndarray):
        """`required_nodes` (k, 2): positions at which nodes are required; `spacing` (k,): distance of each of these
        nodes to the nearest other node or side.

        Raises `ValueError` if `refine` contains anything but `Refine` objects.
        """
        self._refinement_terms: list[tuple[Callable[[np.ndarray], np.ndarray], Refine]] = []
        self._user_size: SizeFunction | None = None
        if callable(refine):
            self._user_size = limit_growth(curves, refine)
        elif refine is not None:
            for refinement_term in (refine,) if isinstance(refine, Refine) else tuple(refine):
                if not isinstance(refinement_term, Refine):
                    raise ValueError(
                        f"refine: expected a Refine, several of them, or a function of points, got {refinement_term!r}."
                    )
                self._refinement_terms.append((_distance_function(curves, refinement_term.points), refinement_term))
        self._required_size = _size_at_close_nodes(required_nodes, spacing)
        self._min_spacing = float(spacing.min()) if len(spacing) else np.inf

    @property
    def is_user_function(self) -> bool:
        """Whether `refine` is a user's function."""
        return self._user_size is not None

    def at(self, points: np.ndarray) -> Callable[[float], np.ndarray]:
        """Return a function that computes the edge lengths (p,) at points (p, 2) from the background cell size, metres.
        If `refine` is a user's size function, the argument is instead the factor by which its sizes are multiplied."""
        if self._user_size is not None:
            user_sizes, required_sizes = self._user_size(points), self._required_size(points)
            return lambda size_factor: np.minimum(size_factor * user_sizes, required_sizes)
        distances_to_targets = [
            np.maximum(distance_function(points) - refinement_term.distance, 0.0)
            for distance_function, refinement_term in self._refinement_terms
        ]

        def size_for_background(background_size: float) -> np.ndarray:
            edge_lengths = np.full(len(points), background_size)
            for distance_beyond_target, (_, refinement_term) in zip(
                distances_to_targets, self._refinement_terms, strict=True
            ):
                edge_lengths = np.minimum(
                    edge_lengths,
                    refinement_term.smallest(background_size) + refinement_term.growth * distance_beyond_target,
                )
            # Required nodes that are farther apart than the background cell size need no refinement.
            return (
                edge_lengths
                if background_size <= self._min_spacing
                else np.minimum(edge_lengths, self._required_size(points))
            )

        return size_for_background


def _distance_function(curves: list[Curve], points: np.ndarray | None) -> Callable[[np.ndarray], np.ndarray]:
    if points is None:
        return lambda query_positions: np.min([curve.distance(query_positions) for curve in curves], axis=0)
    point_tree = KDTree(points)
    return lambda query_positions: point_tree.query(query_positions)[0]


def _size_at_close_nodes(required_nodes: np.ndarray, node_spacing: np.ndarray) -> SizeFunction:
    """Size function that limits the edge length at each required node to its `node_spacing` and lets it grow away from
    the node."""
    if not len(required_nodes):
        return lambda points: np.full(len(points), np.inf)
    node_tree = KDTree(required_nodes)
    num_neighbours = min(8, len(required_nodes))
    if num_neighbours > 1:
        # Propagate the spacing of distant nodes, so that the nearest few nodes suffice to evaluate the size.
        for _ in range(4):
            node_distances, neighbour_nodes = node_tree.query(required_nodes, k=num_neighbours)
            node_spacing = np.min(node_spacing[neighbour_nodes] + _MAX_EDGE_LENGTH_GROWTH * node_distances, axis=1)

    def size_at_points(points: np.ndarray) -> np.ndarray:
        node_distances, neighbour_nodes = node_tree.query(points, k=num_neighbours)
        node_distances, neighbour_nodes = (
            node_distances.reshape(len(points), num_neighbours),
            neighbour_nodes.reshape(len(points), num_neighbours),
        )
        return np.min(node_spacing[neighbour_nodes] + _MAX_EDGE_LENGTH_GROWTH * node_distances, axis=1)

    return size_at_points


def limit_growth(curves: list[Curve], function: Callable[[np.ndarray], Any], resolution: int = 128) -> SizeFunction:
    """Limit the growth of a user's size function f to g = `_MAX_EDGE_LENGTH_GROWTH`: the size at a point x becomes the
    minimum over y of f(y) + g |x − y|.

    The minimum is computed on a grid by Dijkstra's algorithm; where f(x) itself is smaller than the minimum on the
    grid, f(x) is used. Raises `ValueError` if the function does not return one positive, finite size per point.
    """
    outline_points = curves[0].points_at(np.linspace(0, curves[0].length, 721))
    lower_corner_of_grid, upper_corner_of_grid = outline_points.min(axis=0), outline_points.max(axis=0)
    grid_step = float((upper_corner_of_grid - lower_corner_of_grid).max()) / resolution
    grid_axes = [
        np.arange(lower_corner_of_grid[k] - grid_step, upper_corner_of_grid[k] + 2 * grid_step, grid_step)
        for k in (0, 1)
    ]
    grid_array = np.stack(np.meshgrid(*grid_axes, indexing="ij"), axis=-1)
    grid_shape, grid_points = grid_array.shape[:2], grid_array.reshape(-1, 2)
    inside_grid_nodes = np.flatnonzero(is_inside_curves(curves, grid_points))
    user_sizes_inside = np.asarray(function(grid_points[inside_grid_nodes]), dtype=float)
    if user_sizes_inside.shape != (len(inside_grid_nodes),):
        raise ValueError(
            f"refine: the size function must return one size per point: for points of shape ({len(inside_grid_nodes)}, "
            f"2) it returned shape {user_sizes_inside.shape}."
        )
    if not (np.isfinite(user_sizes_inside).all() and (user_sizes_inside > 0).all()):
        invalid_node = inside_grid_nodes[
            int(np.flatnonzero(~(np.isfinite(user_sizes_inside) & (user_sizes_inside > 0)))[0])
        ]
        raise ValueError(
            f"refine: the size function must be positive and finite inside the domain; "
            f"at {grid_points[invalid_node].tolist()} it is not."
        )
    grid_node_index = np.arange(len(grid_points)).reshape(grid_shape)
    grid_links = [
        (grid_node_index[1:], grid_node_index[:-1], grid_step),
        (grid_node_index[:, 1:], grid_node_index[:, :-1], grid_step),
        (grid_node_index[1:, 1:], grid_node_index[:-1, :-1], grid_step * np.sqrt(2)),
        (grid_node_index[1:, :-1], grid_node_index[:-1, 1:], grid_step * np.sqrt(2)),
    ]
    link_starts = np.concatenate(
        [a.ravel() for a, _, _ in grid_links] + [np.full(len(inside_grid_nodes), len(grid_points))]
    )
    link_ends = np.concatenate([b.ravel() for _, b, _ in grid_links] + [inside_grid_nodes])
    link_weights = np.concatenate(
        [np.full(a.size, _MAX_EDGE_LENGTH_GROWTH * link_length) for a, _, link_length in grid_links]
        + [user_sizes_inside]
    )
    growth_graph = coo_array((link_weights, (link_starts, link_ends)), shape=(len(grid_points) + 1,) * 2).tocsr()
    limited_sizes = dijkstra(growth_graph, directed=False, indices=len(grid_points))[:-1].reshape(grid_shape)
    interpolate_sizes = scipy.interpolate.RegularGridInterpolator(grid_axes, limited_sizes)
    lower_corner, upper_corner = grid_array[0, 0], grid_array[-1, -1]

    def limited_size_at(points: np.ndarray) -> np.ndarray:
        # Trial nodes may lie outside the domain, where the user's function may be invalid.
        with np.errstate(all="ignore"):
            user_sizes = np.asarray(function(points), dtype=float)
        user_sizes = np.where(np.isfinite(user_sizes) & (user_sizes > 0), user_sizes, np.inf)
        return np.minimum(user_sizes, interpolate_sizes(np.clip(points, lower_corner, upper_corner)))

    return limited_size_at
