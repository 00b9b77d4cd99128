"""Plots of surfaces in space with values on them: any triangulated surface, and curved skins with electrodes as
discs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes.electrode_shapes import ElectrodeShapes, ProjectionSurface, shapes_of
from jeit.layout import SurfaceLayout
from jeit.mesh import measures
from jeit.mesh.geodesic import Triangles
from jeit.plot.axes import get_or_create_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, SERIES_COLOURS, ColourScale, FittedScale, check_scale
from jeit.plot.imaging.electrodes import ELECTRODE_COLOUR
from jeit.plot.solid.body import add_electrodes, longest_side, number_electrodes
from jeit.plot.solid.scene import BODY_COLOUR, CORNER_VIEW, Camera, Scene, hide_axes_in_space

# Distance, divided by the size of the skin, by which a surface must be in front of a mark to hide it.
_MARK_OFFSET = 0.02


def plot_surface(
    points: ArrayLike,
    triangles: ArrayLike,
    values: ArrayLike | None = None,
    electrodes: ElectrodeShapes | None = None,
    *,
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a surface in space.

    **Arguments:**

    - `points` (n, 3): corners of the triangles, metres.
    - `triangles` (m, 3): indices of points.
    - `values`: one value per triangle or per point; without values, the surface is grey.
    - `electrodes`: from `jeit.electrodes.shapes_of`, drawn on the surface and numbered.
    - `camera`: direction of view.
    - `scale`: colour scale; default: for changes of sheet conductivity in S.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for arrays of wrong shapes, values that are not finite, and arguments of a wrong type.

    **Example:**

    ```python
    from jeit.mesh import sphere
    ball = sphere(0.05, num_points=162)
    plot_surface(ball.points, ball.cells, ball.points[:, 2], scale=ColourScale(quantity="height", unit="m"))
    ```
    """
    point_array, triangle_array = checked_surface(points, triangles)
    check_kind("camera", camera, Camera, "a Camera, such as Camera(azimuth=-60, elevation=25)")
    check_scale(scale)
    if electrodes is not None:
        check_kind("electrodes", electrodes, ElectrodeShapes, "ElectrodeShapes, of shapes_of(mesh, electrodes)")
    ax = get_or_create_axes(ax)
    scene, fitted_scale = Scene(camera), None
    if values is None:
        surface_colours = np.array(to_rgba(BODY_COLOUR))
    else:
        surface_values = checked_values(values, len(point_array), len(triangle_array))
        fitted_scale = scale.of(surface_values, "S")
        surface_colours = map_to_colours(
            fitted_scale,
            surface_values
            if len(surface_values) == len(triangle_array)
            else surface_values[triangle_array].mean(axis=1),
        )
    scene.add_triangles(point_array, triangle_array, surface_colours, smooth=True)
    if electrodes is not None:
        add_electrodes(scene, point_array, triangle_array, electrodes)
    scene.draw(ax)
    hide_axes_in_space(ax, camera, point_array, numbered=electrodes is not None)
    if electrodes is not None:
        number_electrodes(ax, scene, point_array, triangle_array, electrodes, number_hidden=False)
    if title is not None:
        ax.set_title(title)
    if fitted_scale is not None:
        fitted_scale.draw_bar(ax, mappable(fitted_scale))
    return ax


def checked_surface(points: ArrayLike, triangles: ArrayLike) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Check the points and triangles of a surface, and return them as arrays. Raises `ValueError` for wrong shapes,
    points that are not finite, and indices out of range."""
    point_array, triangle_array = np.asarray(points), np.asarray(triangles)
    if point_array.ndim != 2 or point_array.shape[1] != 3 or not np.issubdtype(point_array.dtype, np.number):
        raise ValueError(f"points has shape {point_array.shape}; give (n, 3), metres.")
    if not np.isfinite(point_array).all():
        raise ValueError("points must be finite, in metres.")
    if (
        triangle_array.ndim != 2
        or triangle_array.shape[1] != 3
        or len(triangle_array) == 0
        or not np.issubdtype(triangle_array.dtype, np.integer)
    ):
        raise ValueError(
            f"triangles has shape {triangle_array.shape} of {triangle_array.dtype}; give (m, 3) whole numbers of "
            "points."
        )
    if triangle_array.min() < 0 or triangle_array.max() >= len(point_array):
        raise ValueError(
            f"triangles names point {int(triangle_array.max())}; there are {len(point_array)}, counted from 0."
        )
    return point_array.astype(float), triangle_array


def checked_values(values: ArrayLike, num_points: int, num_triangles: int) -> Float[np.ndarray, " k"]:
    """Check the values of a surface per triangle or per point, and return them as an array. Raises `ValueError` for
    a wrong shape and for complex values."""
    surface_values = np.asarray(values)
    if surface_values.shape not in ((num_triangles,), (num_points,)):
        raise ValueError(
            f"values has shape {surface_values.shape}; give one for each of the {num_triangles} triangles or the "
            f"{num_points} points."
        )
    if np.iscomplexobj(surface_values):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return surface_values


def map_to_colours(fitted: FittedScale, values: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 4"]:
    """Colours (m, 4) of values in a fitted colour scale."""
    return colormaps[fitted.keywords["cmap"]](_normalised_colours(fitted)(fitted.factor * np.asarray(values)))


def mappable(fitted: FittedScale) -> ScalarMappable:
    """Create a matplotlib mappable with the fitted colour scale, for a colour bar."""
    return ScalarMappable(_normalised_colours(fitted), fitted.keywords["cmap"])


def _normalised_colours(fitted_scale: FittedScale) -> Normalize:
    return Normalize(fitted_scale.keywords["vmin"], fitted_scale.keywords["vmax"])


def plot_curved_skin(
    layout: SurfaceLayout,
    values: ArrayLike | None = None,
    *,
    marks: Mapping[str, ArrayLike] | None = None,
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE_SCALE,
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

    Raises `ValueError` for values that have a wrong shape or are not finite, and for arguments of a wrong type.

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
    ax = get_or_create_axes(ax)
    scene, fitted_scale, surface_colours = Scene(camera), None, np.array(to_rgba(BODY_COLOUR))
    if values is not None:
        surface_values = checked_values(values, len(points), len(cells))
        fitted_scale = scale.of(surface_values, "S")
        surface_colours = map_to_colours(
            fitted_scale, surface_values if len(surface_values) == len(cells) else surface_values[cells].mean(axis=1)
        )
    scene.add_triangles(points, cells, surface_colours, smooth=True)
    skin_surface = ProjectionSurface(points, cells)
    # Pieces are sorted by the depth of their centres, so discs are moved in front of the triangles on which they lie.
    depth_offset = float(np.sqrt(np.asarray(measures(mesh)).max()))
    for disc_corners in shapes_of(mesh, layout.discs(1.0)).polygons():
        (disc_normal,) = skin_surface.normals(disc_corners.mean(axis=0)[None])
        viewing_cosine = abs(float(disc_normal @ camera.toward))
        is_rim_edge = np.ones(len(disc_corners), bool)
        scene.add_polygon(
            disc_corners, ELECTRODE_COLOUR, depth_offset=depth_offset / max(viewing_cosine, 0.1), rim=is_rim_edge
        )
    scene.draw(ax)
    triangles = Triangles.of(mesh)
    for (name, mark_points), mark_colour in zip((marks or {}).items(), SERIES_COLOURS, strict=False):
        surface_points = triangles.nearest(np.atleast_2d(np.asarray(mark_points, float))).points
        visible_points = _visible_points(mesh, surface_points, camera)
        ax.plot(
            *camera.on_page(visible_points).T,
            "o",
            color=mark_colour,
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
            labelcolor=DARK_GREY,
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
    triangle_corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    page_corners, corner_depths = camera.on_page(triangle_corners), camera.nearness(triangle_corners)
    visibility_masks = []
    for tested_point in points:
        page_position, point_depth = (
            camera.on_page(tested_point[None])[0],
            float(camera.nearness(tested_point[None])[0]),
        )
        a, b, c = (page_corners[:, k] - page_position for k in range(3))
        partial_areas = np.stack([b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0], c[:, 0] * a[:, 1] - c[:, 1] * a[:, 0],
                          a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1)  # fmt: skip
        doubled_area = partial_areas.sum(axis=1)
        barycentric_weights = partial_areas / np.where(doubled_area == 0, 1.0, doubled_area)[:, None]
        is_covering_point = (barycentric_weights >= 0).all(axis=1) & (doubled_area != 0)
        covering_depths = (barycentric_weights * corner_depths).sum(axis=1)[is_covering_point]
        if not (covering_depths > point_depth + _MARK_OFFSET * longest_side(mesh)).any():
            visibility_masks.append(tested_point)
    return np.array(visibility_masks).reshape(-1, 3)
