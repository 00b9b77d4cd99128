"""Plots of isosurfaces of solid images, with the hull of the body and outlines of inclusions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from jeit.arguments import check_kind, describe, is_number
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.image import Inclusion, Plane, TriangleSurface, cut_by_plane, isosurface_of, node_values
from jeit.image.plane import check_solid, crossed_edges
from jeit.mesh import Mesh
from jeit.plot.axes import get_or_create_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, ColourScale, FittedScale, check_scale
from jeit.plot.solid.body import add_electrodes, add_hull, number_electrodes
from jeit.plot.solid.scene import CORNER_VIEW, Camera, Scene, hide_axes_in_space, mark_sign
from jeit.plot.solid.surfaces import map_to_colours, mappable

_DASH_PATTERN = {"fill": False, "edgecolor": DARK_GREY, "linewidth": 1, "linestyle": (0, (4, 3)), "zorder": 3}


def draw_visible_body(ax: Axes, camera: Camera, inclusion: Inclusion) -> None:
    """Draw the outline of an inclusion as seen by the camera, and its sign at its centroid."""
    x, y = camera.on_page(np.array(inclusion.centroid))
    if inclusion.form is None:  # a ball, whose outline is a circle from every side
        ax.add_patch(Circle((x, y), inclusion.radius, **_DASH_PATTERN))
    else:
        _draw_dashed_hull(ax, camera.on_page(inclusion.form.surface().points))
    mark_sign(ax, x, y, inclusion.sign)


def draw_body_in_plane(ax: Axes, plane: Plane, inclusion: Inclusion) -> None:
    """Draw the outline of the section of an inclusion by a plane, and its sign in the middle."""
    if inclusion.form is not None:
        surface = inclusion.form.surface()
        segments = crossed_edges(surface.triangles, plane.distance(surface.points)).at_corners(surface.points)
        if len(segments):
            corners = _draw_dashed_hull(ax, plane.on_page(segments.reshape(-1, 3)))
            x, y = (corners.min(axis=0) + corners.max(axis=0)) / 2
            mark_sign(ax, x, y, inclusion.sign)
        return
    centre = np.array(inclusion.centroid)
    squared_radius = inclusion.radius**2 - float(plane.distance(centre)) ** 2
    if squared_radius > 0:
        x, y = plane.on_page(centre)
        ax.add_patch(Circle((x, y), float(np.sqrt(squared_radius)), **_DASH_PATTERN))
        mark_sign(ax, x, y, inclusion.sign)


def _draw_dashed_hull(ax: Axes, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    """Draw the convex hull of points as a dashed line, and return its corners."""
    corners = points[ConvexHull(points, qhull_options="QJ").vertices]
    ax.add_patch(Polygon(corners, **_DASH_PATTERN))
    return corners


DEFAULT_LEVELS = (0.5,)
OUTER_OPACITY = 0.3
# Isosurfaces of changes of one sign are drawn if the maximum change of this sign is at least this fraction of the
# maximum change of either sign.
_MIN_PEAK = 0.3


def plot_isosurfaces(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    levels: Sequence[float] = DEFAULT_LEVELS,
    inclusions: Sequence[Inclusion] = (),
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE_SCALE,
    ax: Axes | None = None,
) -> Axes:
    """Draw isosurfaces of a solid image, at specified shares of the maximum change of each sign.

    **Arguments:**

    - `mesh`: a mesh of tetrahedra.
    - `values`: values per cell (m,) or per node (n,); changes of conductivity in S/m, or as described by `scale`.
    - `electrodes`: electrodes, which are drawn on the body and numbered.
    - `levels`: shares between 0 and 1. The surface of the highest level is opaque, others are translucent. Changes of
      one sign are left out if their maximum is less than 0.3 times the maximum of the opposite sign. For absolute
      images (see `ColourScale.difference`), levels are fractions of the range from minimum to maximum.
    - `inclusions`: inclusions, drawn as their sign and the outline of their form, or of a ball of the same volume if
      they have no form.
    - `camera`: direction of view.
    - `scale`: colour scale; default: for changes of conductivity in S/m.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for values of a wrong shape, levels out of range, a mesh that is not a solid, and arguments of
    a wrong type.

    **Example:**

    ```python
    plot_isosurfaces(solid, solid_image, ends, levels=(0.3, 0.6))
    ```
    """
    check_drawn(mesh, electrodes, scale)
    fitted_scale = scale.of(np.asarray(values), "S/m")
    ax = draw_in_space(
        get_or_create_axes(ax),
        mesh,
        values,
        electrodes,
        levels=levels,
        inclusions=inclusions,
        camera=camera,
        fitted=fitted_scale,
    )
    fitted_scale.draw_bar(ax, mappable(fitted_scale))
    return ax


def draw_in_space(
    ax: Axes,
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None,
    *,
    levels: Sequence[float],
    inclusions: Sequence[Inclusion],
    camera: Camera,
    fitted: FittedScale,
    planes: Sequence[Plane] = (),
) -> Axes:
    """Draw isosurfaces as `plot_isosurfaces`, but with a fitted colour scale, without a colour bar, and with the
    outlines of sections by `planes`. Raises `ValueError` in the same cases as `plot_isosurfaces`."""
    check_kind("camera", camera, Camera, "a Camera, such as Camera(azimuth=-60, elevation=25)")
    scene = Scene(camera)
    add_hull(scene, mesh)
    surfaces = level_surfaces(mesh, values, levels, is_signed=fitted.scale.difference)
    for value, fraction, surface in surfaces:
        colour = np.array(map_to_colours(fitted, np.array([value]))[0])
        colour[3] = 1.0 if fraction == max(levels) else OUTER_OPACITY
        scene.add_triangles(surface.points, surface.triangles, colour, smooth=True)
    for plane in planes:
        outline = cut_by_plane(mesh, plane).outline
        end_points = (
            outline[..., :1] * plane.right + outline[..., 1:] * plane.up + (plane.point @ plane.toward) * plane.toward
        )
        scene.add_lines(end_points, DARK_GREY, 0.6)
    shapes = shapes_of(mesh, electrodes) if isinstance(electrodes, AbstractElectrodes) else electrodes
    points, facets = np.asarray(mesh.points), np.asarray(mesh.facets)
    if shapes is not None:
        add_electrodes(scene, points, facets, shapes, translucent_in_front=bool(surfaces))
    scene.draw(ax)
    hide_axes_in_space(ax, camera, points, numbered=shapes is not None)
    if shapes is not None:
        number_electrodes(ax, scene, points, facets, shapes)
    for inclusion in inclusions:
        draw_visible_body(ax, camera, inclusion)
    return ax


def level_surfaces(
    mesh: Mesh, values: ArrayLike, levels: Sequence[float], *, is_signed: bool
) -> list[tuple[float, float, TriangleSurface]]:
    """Compute isosurfaces; return the value, the level and the surface of each isosurface.

    `levels`: shares of the maximum change of each sign if `is_signed`, otherwise fractions of the range from minimum to
    maximum. Raises `ValueError` for levels that are not between 0 and 1.
    """
    fractions = check_levels(levels)
    image = node_values(mesh, np.asarray(values))
    reference = 0.0 if is_signed else float(image.min())
    min_peak = _MIN_PEAK * float(np.abs(image - reference).max())
    surfaces = []
    for sign in (1.0, -1.0) if is_signed else (1.0,):
        peak_change = float((sign * (image - reference)).max())
        if peak_change > 0 and peak_change >= min_peak:
            for fraction in fractions:
                level = sign * fraction * peak_change
                surfaces.append((reference + level, fraction, isosurface_of(mesh, image - reference, level)))
    return surfaces


def check_levels(levels: Sequence[float]) -> list[float]:
    """Check the levels of isosurfaces, and return them as a list. Raises `ValueError` for a level that is not between 0
    and 1."""
    fractions: Float[np.ndarray, " k"] | Sequence = np.atleast_1d(np.asarray(levels, dtype=object))
    if len(fractions) == 0 or not all(is_number(level) and 0 < level < 1 for level in fractions):
        level_texts = ", ".join(describe(level) for level in fractions[:4]) or "none"
        raise ValueError(f"levels must be shares of the strongest change, from 0 to 1; given were {level_texts}.")
    return [float(level) for level in fractions]


def check_drawn(mesh: Mesh, electrodes, scale: ColourScale) -> None:
    """Check a solid mesh, electrodes and a colour scale. Raises `ValueError` for arguments of a wrong type, and for a
    mesh that is not a solid."""
    check_solid(mesh)
    check_scale(scale)
    if electrodes is not None:
        kinds = (AbstractElectrodes, ElectrodeShapes)
        check_kind("electrodes", electrodes, kinds, "those of jeit.electrodes, such as FacePatches")
