"""Meshes of plane outlines: disk, rectangle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jeit.mesh import _structured
from jeit.mesh.domain import Disk, Rectangle
from jeit.mesh.mesh import Mesh

_DEFAULT_NUM_POINTS = 1200


def disk(
    radius: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Any = None,
) -> Mesh:
    """A disk of `radius` metres."""
    domain = Disk(radius, centre)
    if cell_size is not None:
        num_rings = max(1, round(radius / (0.98 * cell_size)))
        num_boundary = 6 * num_rings
    else:
        num_rings, num_boundary = _structured.choose_rings(num_points or _DEFAULT_NUM_POINTS)
    points, cells = _structured.ring_disk(num_rings, num_boundary)
    return Mesh.create(np.asarray(domain.centre) + domain.radius * points, cells)


def rectangle(
    width: float,
    height: float,
    *,
    num_points: int | None = None,
    cell_size: float | None = None,
    centre: Sequence[float] = (0.0, 0.0),
    refine: Any = None,
) -> Mesh:
    """A rectangle of `width` by `height` metres, tags 'left', 'right', 'bottom', 'top'."""
    domain = Rectangle(width, height, centre)
    if cell_size is None:
        cell_size = float(np.sqrt(width * height / (num_points or _DEFAULT_NUM_POINTS)))
    num_columns = max(1, round(width / cell_size - 0.5))
    num_rows = max(1, round(height / (0.93 * cell_size)))
    points, cells = _structured.row_rectangle(domain.width, domain.height, num_columns, num_rows)
    left, _, bottom, _ = domain.extent
    mesh = Mesh.create(points + [left, bottom], cells)
    middle = np.asarray(mesh.points)[np.asarray(mesh.facets)].mean(axis=1)
    extent = domain.extent
    tags = {}
    for name, axis, value in (
        ("left", 0, extent[0]),
        ("right", 0, extent[1]),
        ("bottom", 1, extent[2]),
        ("top", 1, extent[3]),
    ):
        tags[name] = np.flatnonzero(np.abs(middle[:, axis] - value) < 1e-9 * max(width, height))
    return Mesh.create(mesh.points, mesh.cells, tags=tags)
