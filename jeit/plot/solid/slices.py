"""Slices through a solid image: one at any plane, or a grid of them along an axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jeit.arguments import describe
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.image import Inclusion, Plane, cut_by_plane
from jeit.image.plane import AXES, passed_edges
from jeit.mesh import Mesh
from jeit.plot.axes import CHANGE, INK, ColourScale, FittedScale, axes_or_new, draw_colour_bar, draw_scale_bar
from jeit.plot.imaging.electrodes import METAL
from jeit.plot.solid.body import size_of
from jeit.plot.solid.isosurfaces import check_drawn, draw_cut
from jeit.plot.solid.scene import draw_axes_cross, draw_number

MOST_SLICES = 64


def plot_slice(
    mesh: Mesh,
    values: ArrayLike,
    plane: Plane,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE,
    ax: Axes | None = None,
) -> Axes:
    """Draw where a plane cuts a solid image: every cell that it passes, as it is cut, and the outline of the body.

    `values` per cell (m,), or per node (n,), of which cells have the mean; changes of conductivity in S/m unless
    `scale` says otherwise, and as strong as anywhere in the body at the ends of the colour bar. `electrodes` are drawn
    where the plane passes them, `inclusions` as what it cuts off their form, or a ball of their volume. Raises
    `ValueError` for a plane beside the body, values of another shape, and things of another kind.
    """
    check_drawn(mesh, electrodes, scale)
    image = cell_values(mesh, values)
    fitted = scale.of(image, "S/m")
    ax = axes_or_new(ax)
    drawn = draw_slice(ax, mesh, image, plane, electrodes, inclusions=inclusions, fitted=fitted)
    dress_slice(ax, plane, window_of(ax), cross=True)
    fitted.draw_bar(ax, drawn)
    return ax


def plot_slices(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    axis: str = "z",
    at: Sequence[float] | int = 9,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE,
    figure: Figure | None = None,
) -> Figure:
    """Draw a grid of slices across `axis`, all to one scale of lengths and one of colours.

    `at`: how many, evenly from one end of the body to the other, or where, metres. Other arguments as for `plot_slice`;
    raises `ValueError` as that does.
    """
    check_drawn(mesh, electrodes, scale)
    planes = planes_along(mesh, axis, at)
    image = cell_values(mesh, values)
    fitted = scale.of(image, "S/m")
    shapes = _shapes(mesh, electrodes)
    points = planes[0].on_page(np.asarray(mesh.points))
    (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
    columns = _columns(len(planes), (high - low) / (right - left))
    rows = -(-len(planes) // columns)
    width = min(3.2, 12 / columns)
    height = width * ((high - low) + 0.2 * (right - left)) / (right - left)
    figure = (
        Figure(figsize=(columns * width + 1.3, rows * (height + 0.3)), layout="constrained")
        if figure is None
        else figure
    )
    grid = figure.add_gridspec(rows, columns + 1, width_ratios=[1] * columns + [0.05])
    panels = [figure.add_subplot(grid[divmod(k, columns)]) for k in range(len(planes))]
    for panel, plane in zip(panels, planes, strict=True):
        drawn = draw_slice(panel, mesh, image, plane, shapes, inclusions=inclusions, fitted=fitted)
        dress_slice(panel, plane, (left, right, low, high), cross=panel is panels[0])
        if scale.bar and panel is panels[-1]:
            bar = figure.add_subplot(grid[:, columns])
            draw_colour_bar(panel, drawn, fitted.label, signed=scale.difference, place=bar)
    return figure


def planes_along(mesh: Mesh, axis: str, at: Sequence[float] | int) -> list[Plane]:
    """Planes across an axis: so many, evenly spaced with half a space at either end, or at these places in metres.
    Raises `ValueError`."""
    if axis not in AXES:
        raise ValueError(f"axis must be 'x', 'y' or 'z'; it is {describe(axis)}.")
    along = np.asarray(mesh.points)[:, AXES.index(axis)]
    if isinstance(at, int | np.integer) and not isinstance(at, bool):
        if not 1 <= at <= MOST_SLICES:
            raise ValueError(f"at must be a number of slices from 1 to {MOST_SLICES}, or their places; it is {at}.")
        places = along.min() + (np.arange(at) + 0.5) / at * np.ptp(along)
    else:
        places = np.atleast_1d(np.asarray(at, dtype=object))
        if not 1 <= len(places) <= MOST_SLICES:
            raise ValueError(f"at must be the places of 1 to {MOST_SLICES} slices, in metres; they are {len(places)}.")
    return [Plane.at(axis, one) for one in places]


def draw_slice(
    ax: Axes,
    mesh: Mesh,
    image,
    plane: Plane,
    electrodes: AbstractElectrodes | ElectrodeShapes | None,
    *,
    inclusions: Sequence[Inclusion],
    fitted: FittedScale,
) -> ScalarMappable:
    """The cut, its outline, electrodes and inclusions, in a scale that is fitted; what a colour bar is drawn of."""
    cut = cut_by_plane(mesh, plane)
    cells = PolyCollection(cut.polygons, edgecolors="face", linewidths=0.4)  # pyright: ignore[reportArgumentType]
    cells.set_array(fitted.factor * image[cut.cell])
    cells.set_cmap(fitted.keywords["cmap"])
    cells.set_clim(fitted.keywords["vmin"], fitted.keywords["vmax"])
    ax.add_collection(cells)
    ax.add_collection(LineCollection(list(cut.outline), colors=INK, linewidths=0.9, capstyle="round", zorder=2))
    shapes = _shapes(mesh, electrodes)
    if shapes is not None:
        _draw_cut_electrodes(ax, plane, shapes, 0.05 * size_of(mesh), cut.polygons.reshape(-1, 2).mean(axis=0))
    for one in inclusions:
        draw_cut(ax, plane, one)
    return cells


def dress_slice(ax: Axes, plane: Plane, window: tuple[float, float, float, float], *, cross: bool) -> None:
    """Equal scales over a `window` (left, right, low, high), a title and, if a `cross` is asked for, a scale bar and
    which way the axes point."""
    left, right, low, high = window
    size = max(right - left, high - low)
    room = 0.08 * size
    ax.set_aspect("equal")
    ax.set_xlim(left - room, right + room)
    ax.set_ylim(low - 0.2 * size, high + room)
    ax.set_axis_off()
    if cross:
        draw_scale_bar(ax, (left, right, low, high))
        directions = np.stack([plane.right, plane.up], axis=1)
        draw_axes_cross(ax, directions, (right - 0.05 * size, low - 0.15 * size), 0.07 * size)
    ax.set_title(plane.name, fontsize=10)


def window_of(ax: Axes) -> tuple[float, float, float, float]:
    """Limits of the drawing on axes, (left, right, low, high)."""
    box = ax.dataLim
    return box.x0, box.x1, box.y0, box.y1


def cell_values(mesh: Mesh, values: ArrayLike) -> np.ndarray:
    """Values per cell (m,), of values per node the mean of each cell's. Raises `ValueError` for another shape."""
    image = np.asarray(values)
    if image.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return image if len(image) == mesh.num_cells else image[np.asarray(mesh.cells)].mean(axis=1)


def _shapes(mesh: Mesh, electrodes) -> ElectrodeShapes | None:
    if electrodes is None or isinstance(electrodes, ElectrodeShapes):
        return electrodes
    return shapes_of(mesh, electrodes)


def _draw_cut_electrodes(ax: Axes, plane: Plane, shapes: ElectrodeShapes, away: float, middle) -> None:
    """Draw a thick line where a plane passes electrodes, and their numbers outward of it."""
    found: dict[int, list[np.ndarray]] = {}
    for corners, number in zip(shapes.polygons(), shapes.electrode, strict=True):
        height = plane.distance(corners)
        if len(corners) < 3 or height.min() > 0 or height.max() < 0:
            continue
        ring = np.arange(1, len(corners) - 1)
        fan = np.stack([np.zeros_like(ring), ring, ring + 1], axis=1)
        lines = plane.on_page(passed_edges(fan, height).at_corners(corners))
        if len(lines):
            found.setdefault(int(number), []).extend(lines)
    for number, lines in found.items():
        ax.add_collection(LineCollection(lines, colors=METAL, linewidths=4, capstyle="butt", zorder=3))
        ends = np.concatenate(lines)
        place = ends.mean(axis=0)
        if np.ptp(ends, axis=0).max() < 0.1 * away:
            continue  # a corner
        # Across the line that it is seen as, away from the middle of the cut.
        outward = np.linalg.svd(ends - place)[2][1]
        place = place + away * outward * np.sign(outward @ (place - middle))
        draw_number(ax, place, str(number + 1), fontsize=7, faint=False)


def _columns(number: int, tall: float) -> int:
    """Columns of a grid of panels that are `tall` times as high as wide, for a page wider than it is high."""
    best = max(1, round(float(np.sqrt(1.6 * number * tall))))
    # Among similar numbers of columns, the one that leaves the fewest places empty.
    near = range(max(1, best - 1), best + 2)
    return min(number, min(near, key=lambda columns: (-number % columns, abs(columns - best))))
