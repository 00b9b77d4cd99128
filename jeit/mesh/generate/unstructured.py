"""Unstructured plane meshes with a specified number of nodes or cell size, local refinement, and nodes at specified
positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import check_metres
from jeit.mesh import topology
from jeit.mesh.generate import _triangulate
from jeit.mesh.generate._triangulate import GeneratorState, doubled_areas, triangulate
from jeit.mesh.generate.curve import Curve, SizeFunction, is_inside_curves
from jeit.mesh.generate.refine import Refinement, SizeField, TooFewNodesError
from jeit.mesh.mesh import Mesh

DEFAULT_NUM_POINTS = 1200
# Maximum number of nodes of a mesh.
MAX_POINTS = 1_000_000
# Minimum distance between required nodes, relative to the length of the outline.
_MIN_NODE_DISTANCE = 1e-6
# Tolerated relative error of the number of nodes before smoothing and repair, which may change the number slightly.
_NODE_COUNT_TOLERANCE = 0.02


@dataclass(frozen=True)
class MeshTarget:
    """Target size of a mesh.

    **Fields**: `num_points`: number of nodes; `cell_size`: cell size in metres, or None to use `num_points`;
    `is_requested`: whether the number of nodes was specified; otherwise it is the default.
    """

    num_points: int
    cell_size: float | None
    is_requested: bool

    @staticmethod
    def create(num_points: int | None, cell_size: float | None) -> MeshTarget:
        """Create a target from the two arguments of a mesh function. Raises `ValueError` if both arguments are
        specified or one of them is out of range."""
        if num_points is not None and cell_size is not None:
            raise ValueError("num_points, cell_size: give one of the two, not both.")
        if cell_size is not None:
            check_metres("cell_size", cell_size)
        num_nodes = DEFAULT_NUM_POINTS if num_points is None else check_count("num_points", num_points, 4)
        check_total(num_nodes, "num_points")
        return MeshTarget(num_nodes, cell_size, num_points is not None)


def check_count(name: str, value: int, minimum: int) -> int:
    """Convert a count to an integer. Raises `ValueError` unless the count is a whole number of at least `minimum`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < minimum:
        raise ValueError(f"{name}: expected a whole number of at least {minimum}, got {value!r}.")
    return int(value)


def check_total(num_points: float, name: str) -> None:
    """Raise `ValueError` if the mesh would have more than the maximum number of nodes."""
    if num_points > MAX_POINTS:
        raise ValueError(
            f"{name}: this would make about {num_points:.2g} nodes; the limit is {MAX_POINTS:.0e}. Lengths are in "
            "metres: check the units, or ask for larger cells."
        )


def check_positions(name: str, positions: ArrayLike) -> np.ndarray:
    """Convert `positions` along an outline to an array (k,). Raises `ValueError` for a different shape, no positions,
    NaN or infinity."""
    position_array = np.asarray(positions, dtype=float)
    if position_array.ndim != 1 or not len(position_array) or not np.isfinite(position_array).all():
        raise ValueError(
            f"{name}: expected finite positions along the outline, shape (k,), got {positions!r}. A disk takes angles "
            "in radians, other outlines arc lengths in metres."
        )
    return position_array


def mesh_within(
    curves: list[Curve],
    area: float,
    target: MeshTarget,
    refine: Refinement = None,
    boundary_points: ArrayLike | None = None,
    interior_points: ArrayLike | None = None,
) -> Mesh:
    """Mesh the region of `area` m² inside the first of `curves` and outside the other curves, which are holes.

    Nodes are placed at `boundary_points`, arc lengths (k,) in metres on the first curve, and at `interior_points` (k,
    2) in metres. Raises `ValueError` for invalid or contradictory arguments.
    """
    arc_lengths = [
        _merge_with_corners(curve, required_stops)
        for curve, required_stops in zip(curves, _required_positions(curves, boundary_points), strict=True)
    ]
    fixed_nodes = _check_interior(interior_points, curves)
    size_field = SizeField(curves, refine, *_required_spacing(curves, arc_lengths, fixed_nodes))
    generator_state = None
    if target.cell_size is not None:
        size_function = partial(
            _capped_size_at if size_field.is_user_function else _size_at, size_field, target.cell_size
        )
        check_total(_estimate_num_nodes(curves, size_function, area), "cell_size")
    elif size_field.is_user_function and not target.is_requested:
        size_function = partial(_size_at, size_field, 1.0)
        check_total(_estimate_num_nodes(curves, size_function, area), "refine")
    else:
        size_function, generator_state = _fit_cell_size(
            curves, arc_lengths, fixed_nodes, size_field, target.num_points, area
        )
    return Mesh.create(*_triangulate.generate(curves, arc_lengths, fixed_nodes, size_function, generator_state))


def _required_positions(curves: list[Curve], boundary_points: ArrayLike | None) -> list[np.ndarray]:
    """Arc lengths of required nodes on each curve, apart from its corners; a curve without corners has a node at its
    start."""
    arc_lengths = [np.zeros(0 if len(curve.corners) else 1) for curve in curves]
    if boundary_points is not None:
        arc_lengths[0] = np.mod(check_positions("boundary_points", boundary_points), curves[0].length)
    return arc_lengths


def _size_at(size_field: SizeField, background_size: float, points: np.ndarray) -> np.ndarray:
    return size_field.at(points)(background_size)


def _capped_size_at(size_field: SizeField, max_size: float, points: np.ndarray) -> np.ndarray:
    return np.minimum(size_field.at(points)(1.0), max_size)


def _merge_with_corners(curve: Curve, required_positions: np.ndarray) -> np.ndarray:
    """Merge required positions on a curve with its corners. Raises `ValueError` if two positions are too close to each
    other."""
    arc_lengths = np.sort(np.concatenate([curve.corners, np.mod(required_positions, curve.length)]))
    if len(arc_lengths) < 2:
        return arc_lengths
    relative_gaps = np.diff(np.append(arc_lengths, arc_lengths[0] + curve.length)) / curve.length
    is_too_close = (relative_gaps > 1e-9) & (relative_gaps < _MIN_NODE_DISTANCE)
    if is_too_close.any():
        first_close_index = int(np.flatnonzero(is_too_close)[0])
        first_length, next_length = (
            arc_lengths[first_close_index],
            arc_lengths[(first_close_index + 1) % len(arc_lengths)],
        )
        raise ValueError(
            f"boundary_points: two nodes at arc lengths {first_length:g} and {next_length:g} m are closer than a "
            "millionth of the outline (a corner counts). Make them equal or move one."
        )
    is_distinct = relative_gaps > 1e-9
    # Replace a position that coincides with a corner by the corner, so that corners are not moved.
    distinct_arc_lengths = arc_lengths[is_distinct]
    if len(curve.corners):
        corner_distances = np.abs(distinct_arc_lengths[:, None] - curve.corners)
        corner_distances = np.minimum(corner_distances, curve.length - corner_distances)
        nearest_corner = corner_distances.argmin(axis=1)
        distinct_arc_lengths = np.where(
            corner_distances.min(axis=1) < 2e-9 * curve.length, curve.corners[nearest_corner], distinct_arc_lengths
        )
    return np.unique(distinct_arc_lengths)


def _check_interior(interior_points: ArrayLike | None, curves: list[Curve]) -> np.ndarray:
    if interior_points is None:
        return np.zeros((0, 2))
    fixed_nodes = np.atleast_2d(np.asarray(interior_points, dtype=float))
    if fixed_nodes.ndim != 2 or fixed_nodes.shape[1] != 2 or not np.isfinite(fixed_nodes).all():
        raise ValueError(
            f"interior_points: expected finite coordinates of shape (k, 2), got shape {fixed_nodes.shape}."
        )
    curve_distances = np.min([curve.distance(fixed_nodes) for curve in curves], axis=0)
    outside_points = np.flatnonzero(
        ~is_inside_curves(curves, fixed_nodes) | (curve_distances < _MIN_NODE_DISTANCE * curves[0].length)
    )
    if outside_points.size:
        raise ValueError(
            f"interior_points: point {outside_points[0]} at {fixed_nodes[outside_points[0]].tolist()} does not lie "
            "inside the outline. Use boundary_points for nodes on it."
        )
    if (
        len(fixed_nodes) > 1
        and KDTree(fixed_nodes).query(fixed_nodes, k=2)[0][:, 1].min() < _MIN_NODE_DISTANCE * curves[0].length
    ):
        raise ValueError("interior_points: two points coincide or nearly so. Keep one of them.")
    return fixed_nodes


def _required_spacing(
    curves: list[Curve], arc_lengths: list[np.ndarray], fixed_nodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (k, 2) of required nodes, and the distance (k,) of each required node to the nearest other required
    node, or to the nearest side that the node does not lie on, whichever is smaller."""
    node_chains = [
        curve.points_at(curve_arc_lengths) for curve, curve_arc_lengths in zip(curves, arc_lengths, strict=True)
    ]
    required_positions = np.concatenate([*node_chains, fixed_nodes])
    if len(required_positions) < 2:
        outline_distances = np.array([curves[0].distance(interior_node[None])[0] for interior_node in fixed_nodes])
        return (required_positions, outline_distances) if len(fixed_nodes) else (np.zeros((0, 2)), np.zeros(0))
    node_spacing = KDTree(required_positions).query(required_positions, k=2)[0][:, 1]
    first_position = 0
    for node_chain in node_chains:
        num_nodes = len(node_chain)
        for k, (chain_node, next_chain_node) in enumerate(pairwise(np.concatenate([node_chain, node_chain[:1]]))):
            if num_nodes < 2 or (chain_node == next_chain_node).all():
                continue
            outline_distances = topology.distance(required_positions, chain_node[None], next_chain_node[None])[:, 0]
            outline_distances[[first_position + k, first_position + (k + 1) % num_nodes]] = np.inf
            node_spacing = np.minimum(node_spacing, np.where(outline_distances > 0, outline_distances, np.inf))
        first_position += num_nodes
    for curve in curves:
        if len(fixed_nodes):
            node_spacing[first_position:] = np.minimum(node_spacing[first_position:], curve.distance(fixed_nodes))
    return required_positions, node_spacing


def _interior_samples(curves: list[Curve]) -> np.ndarray:
    """Points of a regular grid that lie inside the domain."""
    outline_points = curves[0].points_at(np.linspace(0, curves[0].length, 400))
    grid_axes = [np.linspace(outline_points[:, k].min(), outline_points[:, k].max(), 60) for k in (0, 1)]
    grid_points = np.stack(np.meshgrid(*grid_axes), axis=-1).reshape(-1, 2)
    return grid_points[is_inside_curves(curves, grid_points)]


def _estimate_num_nodes(curves: list[Curve], size_function: SizeFunction, domain_area: float) -> float:
    """Estimate the number of nodes of a mesh whose cell sizes are the values of the function `size_function`, from
    samples inside the domain and along its outline."""
    num_nodes = domain_area * float(np.mean(1.0 / size_function(_interior_samples(curves)) ** 2))
    for curve in curves:
        num_nodes += curve.length * float(
            np.mean(1.0 / size_function(curve.points_at(np.linspace(0, curve.length, 400))))
        )
    return num_nodes


def _fit_cell_size(
    curves: list[Curve],
    arc_lengths: list[np.ndarray],
    fixed_nodes: np.ndarray,
    size_field: SizeField,
    num_points: int,
    domain_area: float,
) -> tuple[SizeFunction, GeneratorState]:
    """Scale the background cell size, or the user's size function, so that the mesh has about `num_points` nodes.
    Returns the size function and the outline filled with nodes.

    The number of nodes is about ∫ c/h² over the domain, h being the cell size: a first mesh determines the constant c
    and the sample points, and further meshes correct the cell size.
    """
    first_num_points = num_points / 4 if num_points > 4000 else num_points
    background_size = float(np.sqrt(1.1 * domain_area / first_num_points))
    if size_field.is_user_function:
        background_size *= float(np.sqrt(np.mean(1.0 / size_field.at(_interior_samples(curves))(1.0) ** 2)))
    best_state_with_size: tuple[float, SizeFunction, GeneratorState] | None = None
    for _ in range(6):
        size_function = partial(_size_at, size_field, background_size)
        generator_state = _triangulate.outline_nodes(curves, arc_lengths, fixed_nodes, size_function, 1.0)
        _triangulate.insert_nodes(generator_state, size_function)
        points = generator_state.points()
        relative_excess = len(points) / num_points - 1.0
        if best_state_with_size is None or abs(relative_excess) < best_state_with_size[0]:
            best_state_with_size = (abs(relative_excess), size_function, generator_state)
        if abs(relative_excess) < _NODE_COUNT_TOLERANCE:
            break
        cells = triangulate(generator_state, points)
        background_size = _correct_background(
            size_field.at(points[cells].mean(axis=1)),
            doubled_areas(points, cells),
            background_size,
            relative_excess,
            num_points,
        )
    assert best_state_with_size is not None
    return best_state_with_size[1], best_state_with_size[2]


def _correct_background(
    sizes_at_samples: Callable[[float], np.ndarray],
    sample_weights: np.ndarray,
    background_size: float,
    relative_excess: float,
    num_points: int,
) -> float:
    """Background cell size for which ∫ 1/h², h being the cell size at a point, is smaller by the factor 1 +
    `relative_excess` than for the background cell size `background_size`; `relative_excess` is the relative surplus of
    nodes."""

    def density_integral(trial_size: float) -> float:
        return float(np.sum(sample_weights / sizes_at_samples(trial_size) ** 2))

    target_integral = density_integral(background_size) / (1.0 + relative_excess)
    if density_integral(1e3 * background_size) > 1.1 * target_integral:
        min_num_nodes = round(num_points * density_integral(1e3 * background_size) / target_integral)
        raise TooFewNodesError(
            f"num_points: the outline and refinement alone need about {min_num_nodes} nodes, more than the "
            f"{num_points} asked. Ask for more nodes, less refinement (larger cell_size, smaller factor) or faster "
            "growth.",
            min_num_nodes,
            "the surface alone, as fine as electrodes or refine want it, needs about {least} nodes, more than the "
            "{asked} asked. Ask for more.",
        )
    # Search for a factor of `background_size`, so that the mesh of a body twice as large is exactly twice as large.
    lower_log_factor, upper_log_factor = -np.log(1e3), np.log(1e3)
    for _ in range(30):
        middle_log_factor = 0.5 * (lower_log_factor + upper_log_factor)
        lower_log_factor, upper_log_factor = (
            (middle_log_factor, upper_log_factor)
            if density_integral(background_size * float(np.exp(middle_log_factor))) > target_integral
            else (lower_log_factor, middle_log_factor)
        )
    return background_size * float(np.exp(0.5 * (lower_log_factor + upper_log_factor)))
