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
    image_on_cells = cell_values(mesh, values)
    fitted_scale = scale.of(image_on_cells, "S/m")
    ax = get_or_create_axes(ax)
    mappable = draw_slice(ax, mesh, image_on_cells, plane, electrodes, inclusions=inclusions, fitted=fitted_scale)
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
    slice_planes = create_planes(mesh, axis, at)
    image_on_cells = cell_values(mesh, values)
    fitted_scale = scale.of(image_on_cells, "S/m")
    electrode_shapes = _electrode_shapes(mesh, electrodes)
    points = slice_planes[0].on_page(np.asarray(mesh.points))
    (page_left, page_bottom), (page_right, page_top) = points.min(axis=0), points.max(axis=0)
    num_columns = _num_columns(len(slice_planes), (page_top - page_bottom) / (page_right - page_left))
    num_rows = -(-len(slice_planes) // num_columns)
    panel_width = min(3.2, 12 / num_columns)
    panel_height = panel_width * ((page_top - page_bottom) + 0.2 * (page_right - page_left)) / (page_right - page_left)
    figure = (
        Figure(figsize=(num_columns * panel_width + 1.3, num_rows * (panel_height + 0.3)), layout="constrained")
        if figure is None
        else figure
    )
    panel_grid = figure.add_gridspec(num_rows, num_columns + 1, width_ratios=[1] * num_columns + [0.05])
    slice_panels = [figure.add_subplot(panel_grid[divmod(k, num_columns)]) for k in range(len(slice_planes))]
    for slice_panel, slice_plane in zip(slice_panels, slice_planes, strict=True):
        mappable = draw_slice(
            slice_panel, mesh, image_on_cells, slice_plane, electrode_shapes, inclusions=inclusions, fitted=fitted_scale
        )
        finish_slice(
            slice_panel,
            slice_plane,
            (page_left, page_right, page_bottom, page_top),
            draw_cross=slice_panel is slice_panels[0],
        )
        if scale.bar and slice_panel is slice_panels[-1]:
            bar_axes = figure.add_subplot(panel_grid[:, num_columns])
            fitted_scale.draw_bar(slice_panel, mappable, bar_axes)
    return figure


def create_planes(mesh: Mesh, axis: str, coordinates_or_number: Sequence[float] | int) -> list[Plane]:
    """Planes perpendicular to an axis. `coordinates_or_number`: coordinates of the planes in metres, or their number; a
    number of planes are evenly spaced, with half a spacing at both ends. Raises `ValueError` for an unknown axis, and
    for too many or no planes."""
    if axis not in AXES:
        raise ValueError(f"axis must be 'x', 'y' or 'z'; it is {describe(axis)}.")
    node_coordinates = np.asarray(mesh.points)[:, AXES.index(axis)]
    if isinstance(coordinates_or_number, int | np.integer) and not isinstance(coordinates_or_number, bool):
        if not 1 <= coordinates_or_number <= MAX_SLICES:
            raise ValueError(
                f"at must be a number of slices from 1 to {MAX_SLICES}, or their places; it is {coordinates_or_number}."
            )
        plane_positions = node_coordinates.min() + (
            np.arange(coordinates_or_number) + 0.5
        ) / coordinates_or_number * np.ptp(node_coordinates)
    else:
        plane_positions = np.atleast_1d(np.asarray(coordinates_or_number, dtype=object))
        if not 1 <= len(plane_positions) <= MAX_SLICES:
            raise ValueError(
                f"at must be the places of 1 to {MAX_SLICES} slices, in metres; they are {len(plane_positions)}."
            )
    return [Plane.at(axis, plane_position) for plane_position in plane_positions]


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
    plane_section = cut_by_plane(mesh, plane)
    cells = PolyCollection(plane_section.polygons, edgecolors="face", linewidths=0.4)  # pyright: ignore[reportArgumentType]
    cells.set_array(fitted.factor * image[plane_section.cell])
    cells.set_cmap(fitted.keywords["cmap"])
    cells.set_clim(fitted.keywords["vmin"], fitted.keywords["vmax"])
    ax.add_collection(cells)
    ax.add_collection(
        LineCollection(list(plane_section.outline), colors=DARK_GREY, linewidths=0.9, capstyle="round", zorder=2)
    )
    electrode_shapes = _electrode_shapes(mesh, electrodes)
    if electrode_shapes is not None:
        _draw_cut_electrodes(
            ax, plane, electrode_shapes, 0.05 * longest_side(mesh), plane_section.polygons.reshape(-1, 2).mean(axis=0)
        )
    for inclusion in inclusions:
        draw_body_in_plane(ax, plane, inclusion)
    return cells


def finish_slice(ax: Axes, plane: Plane, window: tuple[float, float, float, float], *, draw_cross: bool) -> None:
    """Set equal scales of both axes over a `window` (left, right, low, high), and draw a title and, if `draw_cross`, a
    scale bar and arrows of the axes."""
    page_left, page_right, page_bottom, page_top = window
    page_extent = max(page_right - page_left, page_top - page_bottom)
    margin_width = 0.08 * page_extent
    ax.set_aspect("equal")
    ax.set_xlim(page_left - margin_width, page_right + margin_width)
    ax.set_ylim(page_bottom - 0.2 * page_extent, page_top + margin_width)
    ax.set_axis_off()
    if draw_cross:
        draw_scale_bar(ax, (page_left, page_right, page_bottom, page_top))
        page_directions = np.stack([plane.right, plane.up], axis=1)
        draw_axes_cross(
            ax, page_directions, (page_right - 0.05 * page_extent, page_bottom - 0.15 * page_extent), 0.07 * page_extent
        )
    ax.set_title(plane.name, fontsize=10)


def data_extent(ax: Axes) -> tuple[float, float, float, float]:
    """Extent (left, right, low, high) of the data drawn on axes."""
    data_limits = ax.dataLim
    return data_limits.x0, data_limits.x1, data_limits.y0, data_limits.y1


def cell_values(mesh: Mesh, values: ArrayLike) -> np.ndarray:
    """Values per cell (m,); values per node are averaged in each cell. Raises `ValueError` for a wrong shape and for
    complex values."""
    image_values = np.asarray(values)
    if image_values.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image_values.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image_values):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return image_values if len(image_values) == mesh.num_cells else image_values[np.asarray(mesh.cells)].mean(axis=1)


def _electrode_shapes(mesh: Mesh, electrodes) -> ElectrodeShapes | None:
    if electrodes is None or isinstance(electrodes, ElectrodeShapes):
        return electrodes
    return shapes_of(mesh, electrodes)


def _draw_cut_electrodes(
    ax: Axes, plane: Plane, electrode_shapes: ElectrodeShapes, number_distance: float, section_centre
) -> None:
    """Draw a thick line where a plane intersects an electrode, and the number of the electrode outside the body beside
    the line."""
    lines_by_electrode: dict[int, list[np.ndarray]] = {}
    for polygon_corners, electrode_index in zip(electrode_shapes.polygons(), electrode_shapes.electrode, strict=True):
        corner_distances = plane.distance(polygon_corners)
        if len(polygon_corners) < 3 or corner_distances.min() > 0 or corner_distances.max() < 0:
            continue
        ring_indices = np.arange(1, len(polygon_corners) - 1)
        fan_triangles = np.stack([np.zeros_like(ring_indices), ring_indices, ring_indices + 1], axis=1)
        cut_lines = plane.on_page(crossed_edges(fan_triangles, corner_distances).at_corners(polygon_corners))
        if len(cut_lines):
            lines_by_electrode.setdefault(int(electrode_index), []).extend(cut_lines)
    for electrode_index, cut_lines in lines_by_electrode.items():
        ax.add_collection(LineCollection(cut_lines, colors=ELECTRODE_COLOUR, linewidths=4, capstyle="butt", zorder=3))
        segment_ends = np.concatenate(cut_lines)
        cut_centre = segment_ends.mean(axis=0)
        if np.ptp(segment_ends, axis=0).max() < 0.1 * number_distance:
            continue  # only a corner of the electrode is cut
        # The number is placed perpendicular to the line, away from the middle of the section.
        cut_normal = np.linalg.svd(segment_ends - cut_centre)[2][1]
        cut_centre = cut_centre + number_distance * cut_normal * np.sign(cut_normal @ (cut_centre - section_centre))
        draw_number(ax, cut_centre, str(electrode_index + 1), fontsize=7, is_faint=False)


def _num_columns(num_panels: int, aspect_ratio: float) -> int:
    """Number of columns of a grid of `num_panels` panels on a landscape page; `aspect_ratio`: ratio of height to width
    of a panel."""
    preferred_num_columns = max(1, round(float(np.sqrt(1.6 * num_panels * aspect_ratio))))
    # Of several similar numbers of columns, the number that leaves the fewest panels empty is chosen.
    candidate_numbers = range(max(1, preferred_num_columns - 1), preferred_num_columns + 2)
    return min(
        num_panels,
        min(
            candidate_numbers,
            key=lambda candidate_number: (
                -num_panels % candidate_number,
                abs(candidate_number - preferred_num_columns),
            ),
        ),
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
    image_on_cells = cell_values(mesh, values)
    fitted_scale = scale.of(image_on_cells, "S/m")
    electrode_shapes = _electrode_shapes(mesh, electrodes)
    common_plane_point = common_point_of_slices(mesh, image_on_cells, inclusions)
    slice_planes = [
        Plane.at(normal_axis, float(common_plane_point[AXES.index(normal_axis)])) for normal_axis in ("z", "x", "y")
    ]
    figure = Figure(figsize=(12.6, 6.4), layout="constrained") if figure is None else figure
    panel_grid = figure.add_gridspec(2, 4, width_ratios=(1.75, 1, 1, 0.045))
    space_axes = figure.add_subplot(panel_grid[:, 0])
    draw_in_space(
        space_axes,
        mesh,
        values,
        electrode_shapes,
        levels=levels,
        inclusions=inclusions,
        camera=camera,
        fitted=fitted_scale,
        planes=slice_planes,
    )
    half_longest_side = longest_side(mesh) / 2
    for slice_plane, grid_cell in zip(
        slice_planes, (panel_grid[0, 1], panel_grid[0, 2], panel_grid[1, 1]), strict=True
    ):
        slice_panel = figure.add_subplot(grid_cell)
        draw_slice(
            slice_panel, mesh, image_on_cells, slice_plane, electrode_shapes, inclusions=inclusions, fitted=fitted_scale
        )
        page_points = slice_plane.on_page(np.asarray(mesh.points))
        x, y = (page_points.min(axis=0) + page_points.max(axis=0)) / 2
        # All slices are drawn with the same scale of lengths.
        finish_slice(
            slice_panel,
            slice_plane,
            (x - half_longest_side, x + half_longest_side, y - half_longest_side, y + half_longest_side),
            draw_cross=True,
        )
    _draw_caption(
        figure.add_subplot(panel_grid[1, 2]), common_plane_point, levels, inclusions, is_difference=scale.difference
    )
    if scale.bar:
        bar_axes = figure.add_subplot(panel_grid[:, 3])
        fitted_scale.draw_bar(space_axes, mappable(fitted_scale), bar_axes)
    return figure


def common_point_of_slices(mesh: Mesh, image: np.ndarray, inclusions: Sequence[Inclusion] = ()) -> np.ndarray:
    """Common point (3,) of the slices: the centroid of the first inclusion, or else the centroid of the cell whose
    value differs most from the median."""
    if inclusions:
        return np.array(inclusions[0].centroid)
    return np.asarray(centroids(mesh))[np.abs(image - (np.median(image))).argmax()]


def _draw_caption(
    ax: Axes, common_plane_point, isosurface_levels, inclusions: Sequence[Inclusion], *, is_difference: bool
) -> None:
    """Draw a caption that describes the slices, the isosurfaces and the inclusions."""
    ax.set_axis_off()
    level_texts = ", ".join(f"{100 * isosurface_level:g}" for isosurface_level in sorted(isosurface_levels))
    scale_text = "of the strongest change" if is_difference else "of the way from least to greatest"
    caption_lines = [
        f"slices through ({_position_text(common_plane_point)}) mm",
        f"surfaces at {level_texts} % {scale_text}",
    ]
    if inclusions:
        ball_text = "" if all(inclusion.form for inclusion in inclusions) else ", drawn as balls of their volume"
        caption_lines += ["", f"found, dashed{ball_text}:"]
    for inclusion in inclusions[:_MAX_LISTED_INCLUSIONS]:
        sign_text = "+" if inclusion.sign > 0 else "−"
        column_text = "column of " if inclusion.is_column else ""
        radius_text = "" if inclusion.centroid_radius is None else f" ±{1e3 * inclusion.centroid_radius:.2g}"
        place_text = f"({_position_text(inclusion.centroid)}){radius_text} mm"
        caption_lines.append(f"{sign_text}  {column_text}{1e6 * inclusion.area:.3g} cm³ at {place_text}")
        if inclusion.contrast_interval is not None:
            caption_lines.append(f"    {interval_text(inclusion.contrast_interval, signed_percent)}")
    if len(inclusions) > _MAX_LISTED_INCLUSIONS:
        caption_lines.append(f"and {len(inclusions) - _MAX_LISTED_INCLUSIONS} more")
    ax.text(
        0,
        0.9,
        "\n".join(caption_lines),
        transform=ax.transAxes,
        va="top",
        fontsize=8.5,
        color=DARK_GREY,
        linespacing=1.6,
    )


def _position_text(position) -> str:
    return ", ".join(f"{1e3 * coordinate:.0f}" for coordinate in position).replace("-", "−")
