"""Plots of curved skins in space, with values on the surface and electrodes as discs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes.electrode_shapes import ProjectionSurface, shapes_of
from jeit.layout import SurfaceLayout
from jeit.mesh import measures
from jeit.mesh.geodesic import Triangles
from jeit.plot.axes import CHANGE, INK, SERIES_COLOURS, ColourScale, axes_or_new, check_scale
from jeit.plot.imaging.electrodes import METAL
from jeit.plot.solid.body import size_of
from jeit.plot.solid.scene import CORNER_VIEW, Camera, Scene, hide_axes_in_space
from jeit.plot.solid.shaded_surface import BODY, checked_values, colours_of, mappable

# Tolerance for marks being hidden by the surface on which they lie: distance divided by the size of the skin.
_MARK_OFFSET = 0.02


def plot_curved_skin(
    layout: SurfaceLayout,
    values: ArrayLike | None = None,
    *,
    marks: Mapping[str, ArrayLike] | None = None,
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the surface of a curved skin in space, with its electrodes as discs on it.

    **Arguments:**

    - `layout`: the skin.
    - `values`: one value per triangle or per node of `layout.surface`; without values, the surface is grey.
    - `marks`: points (p, 3) in metres by name in the legend, drawn at the nearest points of the surface. Points hidden
      by the surface are left out.
    - `camera`: direction of view.
    - `scale`: colour scale; default: for changes of sheet conductivity in S.
    - `title`, `ax`: as for `plot_image`.

    Raises `ValueError` for values that have another shape or are not finite, and for arguments of another type.

    **Example:**

    ```python
    from jeit.layout import SurfaceLayout
    from jeit.mesh import tube
    plot_curved_skin(SurfaceLayout.spread(tube(0.04, 0.1, num_points=300), 8, 0.01))
    ```
    """
    check_kind("layout", layout, SurfaceLayout, "a SurfaceLayout, skin.layout of a curved skin")
    check_kind("camera", camera, Camera, "a Camera, such as Camera(azimuth=-60, elevation=25)")
    check_scale(scale)
    mesh = layout.surface
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    ax = axes_or_new(ax)
    scene, fitted_scale, colours = Scene(camera), None, np.array(to_rgba(BODY))
    if values is not None:
        image = checked_values(values, len(points), len(cells))
        fitted_scale = scale.of(image, "S")
        colours = colours_of(fitted_scale, image if len(image) == len(cells) else image[cells].mean(axis=1))
    scene.add_triangles(points, cells, colours, smooth=True)
    surface = ProjectionSurface(points, cells)
    # Pieces are sorted by the depth of their centres, so discs are moved in front of the triangles on which they lie.
    depth_offset = float(np.sqrt(np.asarray(measures(mesh)).max()))
    for corners in shapes_of(mesh, layout.discs(1.0)).polygons():
        (normal,) = surface.normals(corners.mean(axis=0)[None])
        cosine = abs(float(normal @ camera.toward))
        rim = np.ones(len(corners), bool)
        scene.add_polygon(corners, METAL, depth_offset=depth_offset / max(cosine, 0.1), rim=rim)
    scene.draw(ax)
    triangles = Triangles.of(mesh)
    for (name, mark_points), colour in zip((marks or {}).items(), SERIES_COLOURS, strict=False):
        surface_points = triangles.nearest(np.atleast_2d(np.asarray(mark_points, float))).points
        visible_points = _visible_points(mesh, surface_points, camera)
        ax.plot(
            *camera.on_page(visible_points).T,
            "o",
            color=colour,
            markersize=5,
            markeredgecolor="white",
            label=name,
            zorder=5,
        )
    hide_axes_in_space(ax, camera, points, numbered=False)
    if marks:
        # The legend is below the axes, since the arrows of x, y and z are inside.
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            ncols=len(marks),
            frameon=False,
            labelcolor=INK,
            borderaxespad=0,
        )
    if title is not None:
        ax.set_title(title)
    if fitted_scale is not None:
        fitted_scale.draw_bar(ax, mappable(fitted_scale))
    return ax


def _visible_points(mesh, points, camera: Camera):
    """Select the points that the surface does not hide: no part of the surface is nearer to the viewer on the same
    ray."""
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    page_corners, depths = camera.on_page(corners), camera.nearness(corners)
    visible = []
    for point in points:
        page_position, depth = camera.on_page(point[None])[0], float(camera.nearness(point[None])[0])
        a, b, c = (page_corners[:, k] - page_position for k in range(3))
        areas = np.stack([b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0], c[:, 0] * a[:, 1] - c[:, 1] * a[:, 0],
                          a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1)  # fmt: skip
        doubled_area = areas.sum(axis=1)
        weights = areas / np.where(doubled_area == 0, 1.0, doubled_area)[:, None]
        is_covering = (weights >= 0).all(axis=1) & (doubled_area != 0)
        covering_depths = (weights * depths).sum(axis=1)[is_covering]
        if not (covering_depths > depth + _MARK_OFFSET * size_of(mesh)).any():
            visible.append(point)
    return np.array(visible).reshape(-1, 3)
