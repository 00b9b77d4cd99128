"""Arrangements: positions for electrodes of any kind, as arrays (L, d) in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import KDTree

from jeit.arguments import describe, is_number
from jeit.mesh import Domain


def ring(
    radius: float,
    num_electrodes: int,
    *,
    start_angle: float = np.pi / 2,
    clockwise: bool = False,
    centre: tuple[float, float] = (0.0, 0.0),
    height: float | None = None,
) -> np.ndarray:
    """Positions evenly spaced on a circle: (L, 2) metres, or (L, 3) at a `height` (3-D tanks).

    `start_angle`: of the first electrode, radians counter-clockwise from +x (default: 12 o'clock). Raises
    `ValueError` for a radius that is not positive or fewer than two electrodes.
    """
    check_count(num_electrodes, 2)
    if not radius > 0:
        raise ValueError(f"radius must be positive, in metres; it is {radius}.")
    step = (-1 if clockwise else 1) * 2 * np.pi / num_electrodes
    angle = start_angle + step * np.arange(num_electrodes)
    position = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return position if height is None else np.column_stack([position, np.full(num_electrodes, float(height))])


def ring_and_centre(radius: float, num_electrodes: int, **options: Any) -> np.ndarray:
    """A `ring` of electrodes and one more in its centre, which comes last: (num_electrodes + 1, d) metres.

    For `jeit.protocol.reference_electrode`. `options` and errors are those of `ring`.
    """
    position = ring(radius, num_electrodes, **options)
    return np.vstack([position, position.mean(axis=0)])


def perimeter(domain: Domain, num_electrodes: int, *, start: float = 0.0) -> np.ndarray:
    """Positions evenly spaced along the edge of an outline, counter-clockwise: (L, 2) metres.

    `start`: arc length of the first electrode in metres, counted as in `domain.boundary` (a rectangle begins at its
    lower left corner; half a pitch keeps electrodes off the corners when L is a multiple of four).
    Raises `ValueError` for fewer than two.
    """
    check_count(num_electrodes, 2)
    arc_length = start + domain.perimeter * np.arange(num_electrodes) / num_electrodes
    return np.asarray(domain.boundary(arc_length % domain.perimeter))


def grid(
    width: float, height: float, columns: int, rows: int, *, centre: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """A regular grid of rows × columns positions that spans width × height metres, row by row from the lower left.

    (L, 2) metres. Raises `ValueError` for sides that are not positive and for no rows or columns.
    """
    check_count(columns, 1)
    check_count(rows, 1)
    if not (width > 0 or columns == 1) or not (height > 0 or rows == 1):
        raise ValueError(f"width and height must be positive, in metres; they are {width} and {height}.")
    x = centre[0] + (np.linspace(-width / 2, width / 2, columns) if columns > 1 else np.zeros(1))
    y = centre[1] + (np.linspace(-height / 2, height / 2, rows) if rows > 1 else np.zeros(1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def quasi_uniform(domain: Domain, num_electrodes: int, *, margin: float = 0.0, iterations: int = 200) -> np.ndarray:
    """Positions spread evenly inside any outline: (L, 2) metres.

    Centroids of a centroidal Voronoi tessellation (Lloyd's algorithm on a fine grid of sample points, begun from
    farthest points), so every electrode serves about the same area. `margin`: least distance to the outline,
    metres. Deterministic. Raises `ValueError` if the margin leaves no room.
    """
    check_count(num_electrodes, 1)
    x_min, x_max, y_min, y_max = domain.extent
    spacing = np.sqrt((x_max - x_min) * (y_max - y_min) / max(20_000, 200 * num_electrodes))
    x, y = np.arange(x_min + spacing / 2, x_max, spacing), np.arange(y_min + spacing / 2, y_max, spacing)
    samples = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    samples = samples[np.asarray(domain.contains(samples))]
    if margin > 0:
        edge = domain.boundary(np.linspace(0, domain.perimeter, int(4 * domain.perimeter / spacing), endpoint=False))
        samples = samples[KDTree(edge).query(samples)[0] >= margin]
    if len(samples) < num_electrodes:
        raise ValueError(f"margin: {margin} m leaves no room for {num_electrodes} electrodes inside the outline.")
    position = samples[[np.argmin(np.sum((samples - samples.mean(axis=0)) ** 2, axis=1))]]
    distance = np.full(len(samples), np.inf)
    while len(position) < num_electrodes:
        distance = np.minimum(distance, np.sum((samples - position[-1]) ** 2, axis=1))
        position = np.vstack([position, samples[distance.argmax()]])
    for _ in range(iterations):
        owner = KDTree(position).query(samples)[1]
        count = np.bincount(owner, minlength=num_electrodes)
        total = np.stack([np.bincount(owner, samples[:, k], num_electrodes) for k in range(2)], axis=1)
        moved = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], position)
        if np.abs(moved - position).max() < 1e-3 * spacing:
            break
        position = moved
    return position


def check_count(number: int, least: int) -> None:
    """Raise `ValueError` for what is no whole number of electrodes, or fewer than `least`."""
    if not is_number(number) or int(number) != number or number < least:
        raise ValueError(f"Give a whole number of electrodes, at least {least}; got {describe(number)}.")
