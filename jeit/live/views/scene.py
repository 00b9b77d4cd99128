"""Scenes: outline, electrodes, channels and raster of a body, which a page draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jeit.electrodes import AbstractElectrodes
from jeit.image import Raster
from jeit.live.pictures import Scene
from jeit.mesh import Mesh
from jeit.protocol import Protocol

# Number of pixels along the longer side of an image, and number of vertices of a circle.
_NUM_PIXELS, _NUM_VERTICES = 160, 36
# Coefficient of a pattern, relative to its largest coefficient, below which an electrode is considered unused.
_MIN_COEFFICIENT = 1e-9


class PixelGrid:
    """Pixel grid on a plane mesh, or on a slice through a solid at half its height, for the images of a page.

    `extent`: x of the left and right edge, y of the lower and upper edge, metres. Raises `ValueError` for a curved
    surface in space.
    """

    def __init__(self, mesh: Mesh, num_pixels: int = _NUM_PIXELS):
        points = np.asarray(mesh.points)[:, :2]
        (x_min, y_min), (x_max, y_max) = points.min(axis=0), points.max(axis=0)
        size = max(x_max - x_min, y_max - y_min) / num_pixels
        shape = max(1, round((y_max - y_min) / size)), max(1, round((x_max - x_min) / size))
        raster = Raster.create(mesh, shape=shape, extent=(x_min, x_max, y_min, y_max))
        cell = np.asarray(raster.cell)
        self.extent = raster.extent
        self._inside_indices = np.flatnonzero(cell.ravel() >= 0)
        self._cell_indices = cell.ravel()[self._inside_indices]
        self._blank_image = np.full(shape, np.nan, np.float32)

    @property
    def inside(self) -> np.ndarray:
        """Mask (rows, columns) of the pixels inside the body."""
        mask = np.zeros(self._blank_image.size, bool)
        mask[self._inside_indices] = True
        return mask.reshape(self._blank_image.shape)

    def __call__(self, image: Float[np.ndarray, " m"]) -> Float[np.ndarray, "H W"]:
        """Sample an image (cells,) at the pixels (rows, columns), in single precision; NaN outside the body."""
        pixels = self._blank_image.copy()
        pixels.ravel()[self._inside_indices] = image[self._cell_indices]
        return pixels


def scene_of(
    mesh: Mesh,
    electrodes: AbstractElectrodes,
    protocol: Protocol,
    grid: PixelGrid,
    *,
    title: str,
    quantity: str,
    unit: str,
    diverging: bool,
    notes: Sequence[str] = (),
) -> Scene:
    """Create the scene of a body with electrodes, whose images are sampled on `grid`."""
    outline = closed_outline(mesh) if mesh.dimension == 2 else _slice_outline(grid)
    names = [str(number) for number in range(1, electrodes.num_electrodes + 1)]
    return Scene(
        title=title,
        quantity=quantity,
        unit=unit,
        diverging=diverging,
        extent=grid.extent,
        outline=outline,
        electrodes=electrode_curves(mesh, electrodes),
        names=names,
        channels=channel_names(protocol),
        notes=tuple(notes),
    )


def channel_names(protocol: Protocol) -> list[str]:
    """Names of the channels of a protocol, such as "1-2 → 3-4": numbers, from 1, of the driving electrodes and of the
    measuring electrodes."""
    drive, measurement = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    return [
        f"{_pattern_name(drive_row)} → {_pattern_name(measurement_row)}"
        for drive_row, measurement_row in zip(drive, measurement, strict=True)
    ]


def electrode_curves(mesh: Mesh, electrodes: AbstractElectrodes) -> list[Float[np.ndarray, "n 2"]]:
    """Curve of n points (n, 2) around each electrode as seen from above, in metres; a single point for a point
    electrode."""
    pen = _CurvePen()
    electrodes.draw(mesh, pen)
    return pen.curves


def _pattern_name(row: np.ndarray) -> str:
    """Name of a pattern: its electrodes with positive coefficients, followed by those with negative coefficients; for
    more than two electrodes, only the first electrode and "…"."""
    max_coefficient = np.abs(row).max()
    positive, negative = (np.flatnonzero(sign * row > _MIN_COEFFICIENT * max_coefficient) + 1 for sign in (1, -1))
    if len(positive) + len(negative) > 2:
        return f"{(positive if len(positive) else negative)[0]}…"
    return "-".join(map(str, (*positive, *negative)))


def closed_outline(mesh: Mesh) -> list[Float[np.ndarray, "n 2"]]:
    """Closed curves of n points (n, 2) each along the boundary of a plane mesh, in metres."""
    facets, points = np.asarray(mesh.facets), np.asarray(mesh.points)
    starts = np.flatnonzero(np.append(True, facets[1:, 0] != facets[:-1, 1]))
    return [points[np.append(loop[:, 0], loop[0, 0])] for loop in np.split(facets, starts[1:])]


def _slice_outline(grid: PixelGrid) -> list[np.ndarray]:
    """Outline of a slice through a solid, from the mask of the pixels inside the solid."""
    from contourpy import contour_generator

    inside = np.pad(grid.inside.astype(float), 1)
    rows, columns = grid.inside.shape
    x_min, x_max, y_min, y_max = grid.extent
    x = x_min + (np.arange(-1, columns + 1) + 0.5) * (x_max - x_min) / columns
    y = y_max - (np.arange(-1, rows + 1) + 0.5) * (y_max - y_min) / rows
    return [np.asarray(line) for line in contour_generator(x, y, inside).lines(0.5)]


class _CurvePen:
    """Pen that collects the electrodes it draws as curves; see `jeit.electrodes.electrodes.ElectrodePen`."""

    def __init__(self):
        self.curves: list[np.ndarray] = []

    def lines(self, pieces: list[np.ndarray], middle: np.ndarray) -> None:
        self.curves.append(
            np.concatenate([np.asarray(piece)[:, :2] for piece in pieces]) if pieces else middle[None, :2]
        )

    def disc(self, middle: np.ndarray, radius: float) -> None:
        angle = np.linspace(0, 2 * np.pi, _NUM_VERTICES + 1)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        self.curves.append(np.asarray(middle)[:2] + float(radius) * circle)

    def rectangle(self, middle: np.ndarray, width: float, height: float) -> None:
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
        self.curves.append(np.asarray(middle)[:2] + corners * [width, height])

    def dot(self, middle: np.ndarray) -> None:
        self.curves.append(np.asarray(middle)[None, :2])
