"""Closed curves parametrised by arc length, for the mesh generator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from jeit.mesh import topology

SizeFunction = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Curve:
    """A closed curve of `length` metres.

    **Fields**: `points_at`: function that returns the points (p, 2) at arc lengths (p,); `contains`: function that
    returns whether the curve encloses points; `distance`: function that returns the distances of points from the curve,
    metres; `corners`: arc lengths of the corners, which always become nodes; `angles`: interior angles of the domain at
    the corners, radians.
    """

    length: float
    points_at: Callable[[np.ndarray], np.ndarray]
    contains: Callable[[np.ndarray], np.ndarray]
    distance: Callable[[np.ndarray], np.ndarray]
    corners: np.ndarray
    angles: np.ndarray


def circle(radius: float, centre: np.ndarray) -> Curve:
    """A circle; arc length runs counter-clockwise from angle 0."""

    def points_at(arc_length: np.ndarray) -> np.ndarray:
        polar_angle = np.asarray(arc_length) / radius
        return centre + radius * np.stack([np.cos(polar_angle), np.sin(polar_angle)], axis=-1)

    def from_centre(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - centre, axis=1)

    return Curve(
        length=2 * np.pi * radius,
        points_at=points_at,
        contains=lambda points: from_centre(points) < radius,
        distance=lambda points: np.abs(radius - from_centre(points)),
        corners=np.zeros(0),
        angles=np.zeros(0),
    )


def create_smooth_curve(length: float, points_at: Callable[[np.ndarray], np.ndarray], num_chords: int = 720) -> Curve:
    """A closed curve without corners. `points_at` returns points (p, 2) at arc lengths (p,); the domain lies to the
    left.

    The functions `inside` and `distance` of the curve use a polygon of `num_chords` chords.
    """
    chord_ends = points_at(length * np.arange(num_chords) / num_chords)
    inscribed_polygon = closed_line(chord_ends)
    return Curve(length, points_at, inscribed_polygon.contains, inscribed_polygon.distance, np.zeros(0), np.zeros(0))


def closed_line(vertices: np.ndarray) -> Curve:
    """A closed polygon; arc length starts at the first vertex, and the domain lies to the left."""
    closed_vertices = np.concatenate([vertices, vertices[:1]])
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed_vertices, axis=0), axis=1))])

    def points_at(arc_length: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.interp(arc_length, arc_lengths, closed_vertices[:, axis_number]) for axis_number in range(2)], axis=-1
        )

    def distances_to_sides(points: np.ndarray) -> np.ndarray:
        min_distances = np.full(len(points), np.inf)
        for side_start, side_end in pairwise(closed_vertices):
            min_distances = np.minimum(min_distances, topology.distance(points, side_start[None], side_end[None])[:, 0])
        return min_distances

    side_vectors = np.roll(vertices, -1, axis=0) - vertices
    previous_sides = np.roll(vertices, 1, axis=0) - vertices
    turning_angles = np.arctan2(
        side_vectors[:, 0] * previous_sides[:, 1] - side_vectors[:, 1] * previous_sides[:, 0],
        (side_vectors * previous_sides).sum(axis=1),
    )
    return Curve(
        length=float(arc_lengths[-1]),
        points_at=points_at,
        contains=lambda points: topology.is_inside_loops(points, [vertices]),
        distance=distances_to_sides,
        corners=arc_lengths[:-1],
        angles=np.mod(turning_angles, 2 * np.pi),
    )


def is_inside_curves(curves: list[Curve], points: np.ndarray) -> np.ndarray:
    """Whether points lie inside the first curve and outside all other curves, which are holes."""
    is_inside = np.zeros(len(points), bool)
    for curve in curves:
        is_inside ^= curve.contains(points)
    return is_inside


def divide(curve: Curve, arc_lengths: np.ndarray, size: SizeFunction) -> np.ndarray:
    """Arc lengths of nodes along a curve, which include `arc_lengths` and are spaced by the cell size that `size`
    requests."""
    arc_lengths = np.unique(arc_lengths)
    if not len(arc_lengths):
        arc_lengths = np.zeros(1)
    sampled_lengths = np.append(arc_lengths, arc_lengths[0] + curve.length)
    while True:
        sample_midpoints, sample_widths = 0.5 * (sampled_lengths[1:] + sampled_lengths[:-1]), np.diff(sampled_lengths)
        is_long = sample_widths > 0.5 * size(curve.points_at(sample_midpoints % curve.length))
        if not is_long.any():
            break
        sampled_lengths = np.sort(np.concatenate([sampled_lengths, sample_midpoints[is_long]]))
    node_density = 1.0 / size(curve.points_at(0.5 * (sampled_lengths[1:] + sampled_lengths[:-1]) % curve.length))
    cumulative_count = np.concatenate([[0.0], np.cumsum(np.diff(sampled_lengths) * node_density)])
    cumulative_counts_at_stops = np.interp(
        np.append(arc_lengths, arc_lengths[0] + curve.length), sampled_lengths, cumulative_count
    )
    min_pieces = max(1, -(-3 // len(arc_lengths)))
    node_lengths = []
    for stop_length, count_at_start, count_at_end in zip(
        arc_lengths, cumulative_counts_at_stops[:-1], cumulative_counts_at_stops[1:], strict=True
    ):
        num_pieces = max(min_pieces, round(count_at_end - count_at_start))
        stops_between_ends = np.interp(
            count_at_start + (count_at_end - count_at_start) * np.arange(1, num_pieces) / num_pieces,
            cumulative_count,
            sampled_lengths,
        )
        node_lengths.append(np.append(stop_length, stops_between_ends))
    return np.sort(np.concatenate(node_lengths) % curve.length)
