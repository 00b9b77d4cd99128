"""Electrodes, drawn where they are and as wide as they are, with their numbers."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.patches import Circle, Patch, Polygon, Rectangle

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes
from jeit.mesh import Mesh
from jeit.plot.axes import axes_or_new
from jeit.plot.imaging.electrode_numbers import draw_numbers

METAL = "#b8860b"


def draw_electrodes(
    mesh: Mesh, electrodes: AbstractElectrodes, *, numbers: bool = True, ax: Axes | None = None, first: int = 1
) -> Axes:
    """Draw `electrodes` seen from above, and their numbers, counted from `first`, beside them.

    Arcs are drawn along the boundary of `mesh`, discs and patches at their size, points as dots. Numbers stand outside
    the outline for electrodes on the edge of a 2-D mesh, in discs, and beside dots. Raises `ValueError` for electrodes
    that do not know where they are.
    """
    ax = axes_or_new(ax)
    pen = _Pen()
    electrodes.draw(mesh, pen)
    if pen.arcs:
        ax.add_collection(LineCollection(pen.arcs, colors=METAL, linewidths=5, capstyle="butt", zorder=3))
    if pen.shapes:
        shapes = PatchCollection(pen.shapes, facecolor="none", edgecolor=METAL, linewidth=1.6, zorder=3)
        ax.add_collection(shapes)
    if pen.dots:
        x, y = np.array(pen.dots).T
        ax.scatter(x, y, s=28, color=METAL, zorder=3)
    if numbers:
        draw_numbers(ax, mesh, np.array(pen.places), np.array(pen.beside), first)
    return ax


def draw_shapes(mesh: Mesh, shapes: ElectrodeShapes, *, ax: Axes) -> None:
    """Draw electrodes of a plane mesh that are known as polygons, and their numbers from 1: lines of two corners along
    its edge, dots, and what has a size."""
    for corners in shapes.polygons():
        if len(corners) == 2:
            ax.plot(*corners.T, color=METAL, linewidth=5, solid_capstyle="butt", zorder=3)
        elif len(corners) == 1:
            ax.scatter(*corners[0], s=28, color=METAL, zorder=3)
        else:
            ax.add_patch(Polygon(corners, facecolor="none", edgecolor=METAL, linewidth=1.6, zorder=3))
    first = np.unique(shapes.electrode, return_index=True)[1]
    draw_numbers(ax, mesh, shapes.middles(), shapes.sizes[first] < 3, 1)


class _Pen:
    """Collects what is drawn, by kind; and of each electrode its middle, and whether its number stands beside it."""

    def __init__(self):
        self.arcs: list[np.ndarray] = []
        self.shapes: list[Patch] = []
        self.dots: list[np.ndarray] = []
        self.places: list[np.ndarray] = []
        self.beside: list[bool] = []

    def _number(self, middle: np.ndarray, *, beside: bool) -> None:
        self.places.append(middle[:2])
        self.beside.append(beside)

    def lines(self, pieces: list[np.ndarray], middle: np.ndarray) -> None:
        self.arcs += pieces
        self._number(middle, beside=True)

    def disc(self, middle: np.ndarray, radius: float) -> None:
        self.shapes.append(Circle((middle[0], middle[1]), radius))
        self._number(middle, beside=False)

    def rectangle(self, middle: np.ndarray, width: float, height: float) -> None:
        self.shapes.append(Rectangle((middle[0] - width / 2, middle[1] - height / 2), width, height))
        self._number(middle, beside=True)

    def dot(self, middle: np.ndarray) -> None:
        self.dots.append(middle[:2])
        self._number(middle, beside=True)
