"""Inclusions in pictures of solids, dashed: of bodies that were fitted their own outline, of others a ball's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull

from jeit.image import Inclusion, Plane
from jeit.image.plane import passed_edges
from jeit.plot.axes import INK
from jeit.plot.solid.camera import Camera
from jeit.plot.solid.scene import mark_sign

_DASHED = {"fill": False, "edgecolor": INK, "linewidth": 1, "linestyle": (0, (4, 3)), "zorder": 3}


def draw_seen(ax: Axes, camera: Camera, inclusion: Inclusion) -> None:
    """The outline that is seen of an inclusion, and its sign at its centroid."""
    x, y = camera.on_page(np.array(inclusion.centroid))
    if inclusion.form is None:  # a ball is seen as a disc of its radius from every side
        ax.add_patch(Circle((x, y), inclusion.radius, **_DASHED))
    else:
        _draw_round(ax, camera.on_page(inclusion.form.surface().points))
    mark_sign(ax, x, y, inclusion.sign)


def draw_cut(ax: Axes, plane: Plane, inclusion: Inclusion) -> None:
    """The outline that a plane cuts an inclusion in, and its sign in the middle of that."""
    if inclusion.form is not None:
        surface = inclusion.form.surface()
        cut = passed_edges(surface.triangles, plane.distance(surface.points)).at_corners(surface.points)
        if len(cut):
            corners = _draw_round(ax, plane.on_page(cut.reshape(-1, 3)))
            x, y = (corners.min(axis=0) + corners.max(axis=0)) / 2
            mark_sign(ax, x, y, inclusion.sign)
        return
    centre = np.array(inclusion.centroid)
    squared = inclusion.radius**2 - float(plane.distance(centre)) ** 2
    if squared > 0:
        x, y = plane.on_page(centre)
        ax.add_patch(Circle((x, y), float(np.sqrt(squared)), **_DASHED))
        mark_sign(ax, x, y, inclusion.sign)


def _draw_round(ax: Axes, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    """A dashed line round points of what is convex; its corners."""
    corners = points[ConvexHull(points, qhull_options="QJ").vertices]
    ax.add_patch(Polygon(corners, **_DASHED))
    return corners
