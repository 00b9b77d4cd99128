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
        inclusion_surface = inclusion.form.surface()
        section_segments = crossed_edges(
            inclusion_surface.triangles, plane.distance(inclusion_surface.points)
        ).at_corners(inclusion_surface.points)
        if len(section_segments):
            hull_corners = _draw_dashed_hull(ax, plane.on_page(section_segments.reshape(-1, 3)))
            x, y = (hull_corners.min(axis=0) + hull_corners.max(axis=0)) / 2
            mark_sign(ax, x, y, inclusion.sign)
        return
    inclusion_centre = np.array(inclusion.centroid)
    squared_radius = inclusion.radius**2 - float(plane.distance(inclusion_centre)) ** 2
    if squared_radius > 0:
        x, y = plane.on_page(inclusion_centre)
        ax.add_patch(Circle((x, y), float(np.sqrt(squared_radius)), **_DASH_PATTERN))
        mark_sign(ax, x, y, inclusion.sign)


def _draw_dashed_hull(ax: Axes, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    """Draw the convex hull of points as a dashed line, and return its corners."""
    hull_corners = points[ConvexHull(points, qhull_options="QJ").vertices]
    ax.add_patch(Polygon(hull_corners, **_DASH_PATTERN))
    return hull_corners


DEFAULT_LEVELS = (0.5,)
OUTER_OPACITY = 0.3
# Isosurfaces of changes of one sign are drawn if the maximum change of this sign is at least this fraction of the
# maximum change of either sign.
_MIN_RELATIVE_PEAK = 0.3


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
    isosurfaces = level_surfaces(mesh, values, levels, is_signed=fitted.scale.difference)
    for isosurface_value, isosurface_level, isosurface in isosurfaces:
        isosurface_colour = np.array(map_to_colours(fitted, np.array([isosurface_value]))[0])
        isosurface_colour[3] = 1.0 if isosurface_level == max(levels) else OUTER_OPACITY
        scene.add_triangles(isosurface.points, isosurface.triangles, isosurface_colour, smooth=True)
    for plane in planes:
        section_outline = cut_by_plane(mesh, plane).outline
        end_points = (
            section_outline[..., :1] * plane.right
            + section_outline[..., 1:] * plane.up
            + (plane.point @ plane.toward) * plane.toward
        )
        scene.add_lines(end_points, DARK_GREY, 0.6)
    electrode_shapes = shapes_of(mesh, electrodes) if isinstance(electrodes, AbstractElectrodes) else electrodes
    points, boundary_facets = np.asarray(mesh.points), np.asarray(mesh.facets)
    if electrode_shapes is not None:
        add_electrodes(scene, points, boundary_facets, electrode_shapes, translucent_in_front=bool(isosurfaces))
    scene.draw(ax)
    hide_axes_in_space(ax, camera, points, numbered=electrode_shapes is not None)
    if electrode_shapes is not None:
        number_electrodes(ax, scene, points, boundary_facets, electrode_shapes)
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
    level_fractions = check_levels(levels)
    image_at_nodes = node_values(mesh, np.asarray(values))
    reference_value = 0.0 if is_signed else float(image_at_nodes.min())
    min_peak = _MIN_RELATIVE_PEAK * float(np.abs(image_at_nodes - reference_value).max())
    found_surfaces = []
    for change_sign in (1.0, -1.0) if is_signed else (1.0,):
        peak_change = float((change_sign * (image_at_nodes - reference_value)).max())
        if peak_change > 0 and peak_change >= min_peak:
            for level_fraction in level_fractions:
                isosurface_value = change_sign * level_fraction * peak_change
                found_surfaces.append(
                    (
                        reference_value + isosurface_value,
                        level_fraction,
                        isosurface_of(mesh, image_at_nodes - reference_value, isosurface_value),
                    )
                )
    return found_surfaces


def check_levels(levels: Sequence[float]) -> list[float]:
    """Check the levels of isosurfaces, and return them as a list. Raises `ValueError` for a level that is not between 0
    and 1."""
    level_fractions: Float[np.ndarray, " k"] | Sequence = np.atleast_1d(np.asarray(levels, dtype=object))
    if len(level_fractions) == 0 or not all(
        is_number(level_fraction) and 0 < level_fraction < 1 for level_fraction in level_fractions
    ):
        level_texts = ", ".join(describe(level_fraction) for level_fraction in level_fractions[:4]) or "none"
        raise ValueError(f"levels must be shares of the strongest change, from 0 to 1; given were {level_texts}.")
    return [float(level_fraction) for level_fraction in level_fractions]


def check_drawn(mesh: Mesh, electrodes, scale: ColourScale) -> None:
    """Check a solid mesh, electrodes and a colour scale. Raises `ValueError` for arguments of a wrong type, and for a
    mesh that is not a solid."""
    check_solid(mesh)
    check_scale(scale)
    if electrodes is not None:
        electrode_kinds = (AbstractElectrodes, ElectrodeShapes)
        check_kind("electrodes", electrodes, electrode_kinds, "those of jeit.electrodes, such as FacePatches")
