"""Overview of a solid image: isosurfaces in space, and slices through the strongest change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jeit.arguments import interval_text, signed_percent
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.image import Inclusion, Plane
from jeit.image.plane import AXES
from jeit.mesh import Mesh, centroids
from jeit.plot.axes import CHANGE, INK, ColourScale
from jeit.plot.solid.body import size_of
from jeit.plot.solid.isosurfaces import HALF, check_drawn, draw_in_space
from jeit.plot.solid.scene import CORNER_VIEW, Camera
from jeit.plot.solid.shaded_surface import mappable
from jeit.plot.solid.slices import cell_values, draw_slice, finish_slice

_MAX_LISTED = 5
"""Maximum number of inclusions listed in the caption."""


def plot_solid(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    levels: Sequence[float] = HALF,
    inclusions: Sequence[Inclusion] = (),
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE,
    figure: Figure | None = None,
) -> Figure:
    """Draw a solid image as isosurfaces in space, beside three perpendicular slices through its strongest change: the
    centroid of the first of `inclusions`, or else the cell that differs most from the median. The outlines of the
    slices are drawn in space, too.

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
    shapes = electrodes
    if isinstance(electrodes, AbstractElectrodes):
        shapes = shapes_of(mesh, electrodes)
    common_point = strongest_place(mesh, image, inclusions)
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
    half_size = size_of(mesh) / 2
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


def strongest_place(mesh: Mesh, image: np.ndarray, inclusions: Sequence[Inclusion] = ()) -> np.ndarray:
    """Common point (3,) of the slices: the centroid of the first inclusion, or else the centroid of the cell whose
    value differs most from the median."""
    if inclusions:
        return np.array(inclusions[0].centroid)
    return np.asarray(centroids(mesh))[np.abs(image - (np.median(image))).argmax()]


def _caption(ax: Axes, common_point, levels, inclusions: Sequence[Inclusion], *, difference: bool) -> None:
    """Draw a caption that describes the slices, the isosurfaces and the inclusions."""
    ax.set_axis_off()
    shares = ", ".join(f"{100 * share:g}" for share in sorted(levels))
    scale_text = "of the strongest change" if difference else "of the way from least to greatest"
    lines = [f"slices through ({_position_text(common_point)}) mm", f"surfaces at {shares} % {scale_text}"]
    if inclusions:
        ball_text = "" if all(inclusion.form for inclusion in inclusions) else ", drawn as balls of their volume"
        lines += ["", f"found, dashed{ball_text}:"]
    for inclusion in inclusions[:_MAX_LISTED]:
        sign = "+" if inclusion.sign > 0 else "−"
        column = "column of " if inclusion.is_column else ""
        radius = "" if inclusion.centroid_radius is None else f" ±{1e3 * inclusion.centroid_radius:.2g}"
        place = f"({_position_text(inclusion.centroid)}){radius} mm"
        lines.append(f"{sign}  {column}{1e6 * inclusion.area:.3g} cm³ at {place}")
        if inclusion.contrast_interval is not None:
            lines.append(f"    {interval_text(inclusion.contrast_interval, signed_percent)}")
    if len(inclusions) > _MAX_LISTED:
        lines.append(f"and {len(inclusions) - _MAX_LISTED} more")
    ax.text(0, 0.9, "\n".join(lines), transform=ax.transAxes, va="top", fontsize=8.5, color=INK, linespacing=1.6)


def _position_text(position) -> str:
    return ", ".join(f"{1e3 * value:.0f}" for value in position).replace("-", "−")
