"""Plots of slices through a solid image: one slice by any plane, a grid of slices along an axis, or an overview of
isosurfaces in space and three slices through the strongest change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jeit.arguments import describe, interval_text, signed_percent
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.image import Inclusion, Plane, cut_by_plane
from jeit.image.plane import AXES, crossed_edges
from jeit.mesh import Mesh, centroids
from jeit.plot.axes import draw_scale_bar, get_or_create_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, ColourScale, FittedScale
from jeit.plot.imaging.electrodes import ELECTRODE_COLOUR
from jeit.plot.solid.body import longest_side
from jeit.plot.solid.isosurfaces import DEFAULT_LEVELS, check_drawn, draw_body_in_plane, draw_in_space
from jeit.plot.solid.scene import CORNER_VIEW, Camera, draw_axes_cross, draw_number
from jeit.plot.solid.surfaces import mappable

MAX_SLICES = 64
# Maximum number of inclusions listed in the caption of the overview.
_MAX_LISTED_INCLUSIONS = 5


def plot_slice(
    mesh: Mesh,
    values: ArrayLike,
    plane: Plane,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE_SCALE,
    ax: Axes | None = None,
) -> Axes:
    """Draw the section of a solid image by a plane: the sections of all cells, and the outline of the body.

    **Arguments:**

    - `mesh`: a mesh of tetrahedra.
    - `values`: values per cell (m,), or values per node (n,), which are averaged in each cell; changes of conductivity
      in S/m, or as described by `scale`. The colour scale is fitted to the whole body.
    - `plane`: the plane.
    - `electrodes`: electrodes, which are drawn where the plane intersects them.
    - `inclusions`: inclusions, drawn as the section of their form, or of a ball of the same volume if they have no
      form.
    - `scale`, `ax`: as for `plot_isosurfaces`.

    Raises `ValueError` for a plane that misses the body, values of a wrong shape, and arguments of a wrong type.

    **Example:**

    ```python
    from jeit.image import Plane
    plot_slice(solid, solid_image, Plane.at("z", 0.03))
    ```
    """
    check_drawn(mesh, electrodes, scale)
    image = cell_values(mesh, values)
    fitted_scale = scale.of(image, "S/m")
    ax = get_or_create_axes(ax)
    mappable = draw_slice(ax, mesh, image, plane, electrodes, inclusions=inclusions, fitted=fitted_scale)
    finish_slice(ax, plane, data_extent(ax), draw_cross=True)
    fitted_scale.draw_bar(ax, mappable)
    return ax


def plot_slices(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    axis: str = "z",
    at: Sequence[float] | int = 9,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE_SCALE,
    figure: Figure | None = None,
) -> Figure:
    """Draw a grid of slices of a solid image, with common scales of lengths and colours.

    **Arguments:**

    - `mesh`, `values`, `electrodes`, `inclusions`, `scale`: as for `plot_slice`.
    - `axis`: "x", "y" or "z"; the slices are perpendicular to this axis.
    - `at`: number of slices, evenly spaced over the body, or their coordinates on the axis in metres.
    - `figure`: the figure to draw in; default: a new one.

    Raises `ValueError` in the same cases as `plot_slice`.

    **Example:**

    ```python
    plot_slices(solid, solid_image, axis="z", at=[0.01, 0.03])
    ```
    """
    check_drawn(mesh, electrodes, scale)
    planes = create_planes(mesh, axis, at)
    image = cell_values(mesh, values)
    fitted_scale = scale.of(image, "S/m")
    shapes = _electrode_shapes(mesh, electrodes)
    points = planes[0].on_page(np.asarray(mesh.points))
    (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
    columns = _num_columns(len(planes), (high - low) / (right - left))
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
        mappable = draw_slice(panel, mesh, image, plane, shapes, inclusions=inclusions, fitted=fitted_scale)
        finish_slice(panel, plane, (left, right, low, high), draw_cross=panel is panels[0])
        if scale.bar and panel is panels[-1]:
            bar = figure.add_subplot(grid[:, columns])
            fitted_scale.draw_bar(panel, mappable, bar)
    return figure


def create_planes(mesh: Mesh, axis: str, coordinates_or_number: Sequence[float] | int) -> list[Plane]:
    """Planes perpendicular to an axis. `coordinates_or_number`: coordinates of the planes in metres, or their number; a
    number of planes are evenly spaced, with half a spacing at both ends. Raises `ValueError` for an unknown axis, and
    for too many or no planes."""
    if axis not in AXES:
        raise ValueError(f"axis must be 'x', 'y' or 'z'; it is {describe(axis)}.")
    coordinates = np.asarray(mesh.points)[:, AXES.index(axis)]
    if isinstance(coordinates_or_number, int | np.integer) and not isinstance(coordinates_or_number, bool):
        if not 1 <= coordinates_or_number <= MAX_SLICES:
            raise ValueError(
                f"at must be a number of slices from 1 to {MAX_SLICES}, or their places; it is {coordinates_or_number}."
            )
        plane_positions = coordinates.min() + (np.arange(coordinates_or_number) + 0.5) / coordinates_or_number * np.ptp(
            coordinates
        )
    else:
        plane_positions = np.atleast_1d(np.asarray(coordinates_or_number, dtype=object))
        if not 1 <= len(plane_positions) <= MAX_SLICES:
            raise ValueError(
                f"at must be the places of 1 to {MAX_SLICES} slices, in metres; they are {len(plane_positions)}."
            )
    return [Plane.at(axis, position) for position in plane_positions]


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
    """Draw a section of a solid image with its outline, electrodes and inclusions in a fitted colour scale; return the
    mappable for a colour bar."""
    section = cut_by_plane(mesh, plane)
    cells = PolyCollection(section.polygons, edgecolors="face", linewidths=0.4)  # pyright: ignore[reportArgumentType]
    cells.set_array(fitted.factor * image[section.cell])
    cells.set_cmap(fitted.keywords["cmap"])
    cells.set_clim(fitted.keywords["vmin"], fitted.keywords["vmax"])
    ax.add_collection(cells)
    ax.add_collection(
        LineCollection(list(section.outline), colors=DARK_GREY, linewidths=0.9, capstyle="round", zorder=2)
    )
    shapes = _electrode_shapes(mesh, electrodes)
    if shapes is not None:
        _draw_cut_electrodes(ax, plane, shapes, 0.05 * longest_side(mesh), section.polygons.reshape(-1, 2).mean(axis=0))
    for inclusion in inclusions:
        draw_body_in_plane(ax, plane, inclusion)
    return cells


def finish_slice(ax: Axes, plane: Plane, window: tuple[float, float, float, float], *, draw_cross: bool) -> None:
    """Set equal scales of both axes over a `window` (left, right, low, high), and draw a title and, if `draw_cross`, a
    scale bar and arrows of the axes."""
    left, right, low, high = window
    size = max(right - left, high - low)
    margin_width = 0.08 * size
    ax.set_aspect("equal")
    ax.set_xlim(left - margin_width, right + margin_width)
    ax.set_ylim(low - 0.2 * size, high + margin_width)
    ax.set_axis_off()
    if draw_cross:
        draw_scale_bar(ax, (left, right, low, high))
        directions = np.stack([plane.right, plane.up], axis=1)
        draw_axes_cross(ax, directions, (right - 0.05 * size, low - 0.15 * size), 0.07 * size)
    ax.set_title(plane.name, fontsize=10)


def data_extent(ax: Axes) -> tuple[float, float, float, float]:
    """Extent (left, right, low, high) of the data drawn on axes."""
    box = ax.dataLim
    return box.x0, box.x1, box.y0, box.y1


def cell_values(mesh: Mesh, values: ArrayLike) -> np.ndarray:
    """Values per cell (m,); values per node are averaged in each cell. Raises `ValueError` for a wrong shape and for
    complex values."""
    image = np.asarray(values)
    if image.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return image if len(image) == mesh.num_cells else image[np.asarray(mesh.cells)].mean(axis=1)


def _electrode_shapes(mesh: Mesh, electrodes) -> ElectrodeShapes | None:
    if electrodes is None or isinstance(electrodes, ElectrodeShapes):
        return electrodes
    return shapes_of(mesh, electrodes)


def _draw_cut_electrodes(ax: Axes, plane: Plane, shapes: ElectrodeShapes, distance: float, section_centre) -> None:
    """Draw a thick line where a plane intersects an electrode, and the number of the electrode outside the body beside
    the line."""
    lines_by_electrode: dict[int, list[np.ndarray]] = {}
    for corners, electrode_index in zip(shapes.polygons(), shapes.electrode, strict=True):
        distances = plane.distance(corners)
        if len(corners) < 3 or distances.min() > 0 or distances.max() < 0:
            continue
        ring_indices = np.arange(1, len(corners) - 1)
        fan_triangles = np.stack([np.zeros_like(ring_indices), ring_indices, ring_indices + 1], axis=1)
        lines = plane.on_page(crossed_edges(fan_triangles, distances).at_corners(corners))
        if len(lines):
            lines_by_electrode.setdefault(int(electrode_index), []).extend(lines)
    for electrode_index, lines in lines_by_electrode.items():
        ax.add_collection(LineCollection(lines, colors=ELECTRODE_COLOUR, linewidths=4, capstyle="butt", zorder=3))
        segment_ends = np.concatenate(lines)
        position = segment_ends.mean(axis=0)
        if np.ptp(segment_ends, axis=0).max() < 0.1 * distance:
            continue  # only a corner of the electrode is cut
        # The number is placed perpendicular to the line, away from the middle of the section.
        normal = np.linalg.svd(segment_ends - position)[2][1]
        position = position + distance * normal * np.sign(normal @ (position - section_centre))
        draw_number(ax, position, str(electrode_index + 1), fontsize=7, is_faint=False)


def _num_columns(num_panels: int, aspect_ratio: float) -> int:
    """Number of columns of a grid of `num_panels` panels on a landscape page; `aspect_ratio`: ratio of height to width
    of a panel."""
    preferred_num_columns = max(1, round(float(np.sqrt(1.6 * num_panels * aspect_ratio))))
    # Of several similar numbers of columns, the number that leaves the fewest panels empty is chosen.
    candidates = range(max(1, preferred_num_columns - 1), preferred_num_columns + 2)
    return min(
        num_panels, min(candidates, key=lambda columns: (-num_panels % columns, abs(columns - preferred_num_columns)))
    )


def plot_solid(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    levels: Sequence[float] = DEFAULT_LEVELS,
    inclusions: Sequence[Inclusion] = (),
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE_SCALE,
    figure: Figure | None = None,
) -> Figure:
    """Draw a solid image as isosurfaces in space, beside three perpendicular slices through its strongest change. The
    slices pass through the centroid of the first of `inclusions`, or else of the cell whose value differs most from the
    median. The outlines of the slices are drawn in space, too.

    **Arguments:**

    - `mesh`, `values`, `electrodes`, `levels`, `inclusions`, `camera`, `scale`: as for `plot_isosurfaces`.
    - `figure`: the figure to draw in; default: a new one.

    Raises `ValueError` in the same cases as `plot_isosurfaces`.

    **Example:**

    ```python
    plot_solid(solid, solid_image, ends)
    ```
    """
    check_drawn(mesh, electrodes, scale)
    image = cell_values(mesh, values)
    fitted_scale = scale.of(image, "S/m")
    shapes = _electrode_shapes(mesh, electrodes)
    common_point = common_point_of_slices(mesh, image, inclusions)
    planes = [Plane.at(axis, float(common_point[AXES.index(axis)])) for axis in ("z", "x", "y")]
    figure = Figure(figsize=(12.6, 6.4), layout="constrained") if figure is None else figure
    grid = figure.add_gridspec(2, 4, width_ratios=(1.75, 1, 1, 0.045))
    space = figure.add_subplot(grid[:, 0])
    draw_in_space(
        space,
        mesh,
        values,
        shapes,
        levels=levels,
        inclusions=inclusions,
        camera=camera,
        fitted=fitted_scale,
        planes=planes,
    )
    half_size = longest_side(mesh) / 2
    for plane, grid_cell in zip(planes, (grid[0, 1], grid[0, 2], grid[1, 1]), strict=True):
        panel = figure.add_subplot(grid_cell)
        draw_slice(panel, mesh, image, plane, shapes, inclusions=inclusions, fitted=fitted_scale)
        page_points = plane.on_page(np.asarray(mesh.points))
        x, y = (page_points.min(axis=0) + page_points.max(axis=0)) / 2
        # All slices are drawn with the same scale of lengths.
        finish_slice(panel, plane, (x - half_size, x + half_size, y - half_size, y + half_size), draw_cross=True)
    _caption(figure.add_subplot(grid[1, 2]), common_point, levels, inclusions, difference=scale.difference)
    if scale.bar:
        bar = figure.add_subplot(grid[:, 3])
        fitted_scale.draw_bar(space, mappable(fitted_scale), bar)
    return figure


def common_point_of_slices(mesh: Mesh, image: np.ndarray, inclusions: Sequence[Inclusion] = ()) -> np.ndarray:
    """Common point (3,) of the slices: the centroid of the first inclusion, or else the centroid of the cell whose
    value differs most from the median."""
    if inclusions:
        return np.array(inclusions[0].centroid)
    return np.asarray(centroids(mesh))[np.abs(image - (np.median(image))).argmax()]


def _caption(ax: Axes, common_point, levels, inclusions: Sequence[Inclusion], *, difference: bool) -> None:
    """Draw a caption that describes the slices, the isosurfaces and the inclusions."""
    ax.set_axis_off()
    level_texts = ", ".join(f"{100 * level:g}" for level in sorted(levels))
    scale_text = "of the strongest change" if difference else "of the way from least to greatest"
    lines = [f"slices through ({_position_text(common_point)}) mm", f"surfaces at {level_texts} % {scale_text}"]
    if inclusions:
        ball_text = "" if all(inclusion.form for inclusion in inclusions) else ", drawn as balls of their volume"
        lines += ["", f"found, dashed{ball_text}:"]
    for inclusion in inclusions[:_MAX_LISTED_INCLUSIONS]:
        sign = "+" if inclusion.sign > 0 else "−"
        column = "column of " if inclusion.is_column else ""
        radius = "" if inclusion.centroid_radius is None else f" ±{1e3 * inclusion.centroid_radius:.2g}"
        place_text = f"({_position_text(inclusion.centroid)}){radius} mm"
        lines.append(f"{sign}  {column}{1e6 * inclusion.area:.3g} cm³ at {place_text}")
        if inclusion.contrast_interval is not None:
            lines.append(f"    {interval_text(inclusion.contrast_interval, signed_percent)}")
    if len(inclusions) > _MAX_LISTED_INCLUSIONS:
        lines.append(f"and {len(inclusions) - _MAX_LISTED_INCLUSIONS} more")
    ax.text(0, 0.9, "\n".join(lines), transform=ax.transAxes, va="top", fontsize=8.5, color=DARK_GREY, linespacing=1.6)


def _position_text(position) -> str:
    return ", ".join(f"{1e3 * value:.0f}" for value in position).replace("-", "−")
