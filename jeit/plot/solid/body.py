"""What stands round an image in space: the body's hull, translucent, and electrodes on it, numbered."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba

from jeit.electrodes.electrode_shapes import Draped, ElectrodeShapes, surface_triangles
from jeit.mesh import Mesh
from jeit.plot.axes import SOFT
from jeit.plot.imaging.electrodes import METAL
from jeit.plot.solid.scene import BODY, Scene, draw_number

_HULL = 0.1
# Cosine of the angle between facets beyond which their edge is one of the body.
_SHARP = 0.85
# Over the size of the body: how much nearer electrodes count than the surface under them, and how far off numbers are.
_BEFORE, _AWAY = 0.03, 0.045
# And how far numbers are apart that can be read.
_CLEAR = 0.03


def size_of(mesh: Mesh) -> float:
    """The longest side of the box round a mesh, metres."""
    return float(np.ptp(np.asarray(mesh.points), axis=0).max())


def add_hull(scene: Scene, mesh: Mesh) -> None:
    """The boundary of a solid, that one looks through, with its edges and its outline."""
    points, triangles = np.asarray(mesh.points), surface_triangles(mesh)
    scene.add_triangles(points, triangles, np.array(to_rgba(BODY, _HULL)), smooth=True, lit=False)
    scene.add_lines(points[visible_edges(points, triangles, scene.camera.toward)], SOFT, 0.9)


def visible_edges(points, triangles, toward: Float[np.ndarray, "3"]) -> np.ndarray:
    """Edges (s, 2) of a surface that a draughtsman draws: sharp ones, open ones, and where it turns out of sight."""
    normal = np.cross(
        points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    )
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    of = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(edges.T)
    edges, of = edges[order], of[order]
    pair = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    first, second = normal[of[pair]], normal[of[pair + 1]]
    # A surface seen from the side within rounding is on neither side of its outline.
    side = np.stack([first @ toward, second @ toward])
    side = np.where(np.abs(side) < 1e-9, 0, side)
    drawn = (np.sum(first * second, axis=1) < _SHARP) | ((side > 0).any(axis=0) & (side <= 0).any(axis=0))
    alone = np.ones(len(edges), bool)
    alone[pair] = alone[pair + 1] = False
    return np.concatenate([edges[pair[drawn]], edges[alone]])


def add_electrodes(scene: Scene, points, triangles, shapes: ElectrodeShapes) -> None:
    """Electrodes on a surface: those on the side that is looked at over all behind it, others under it."""
    surface, size = Draped(points, triangles), float(np.ptp(points, axis=0).max())
    for corners in shapes.polygons():
        (outward,) = surface.normals(corners.mean(axis=0)[None])
        if len(corners) == 1:
            angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
            _, across, up = surface.frames(corners)[0]
            corners = corners + 0.012 * size * (np.outer(np.cos(angle), across) + np.outer(np.sin(angle), up))
        scene.add_polygon(corners, METAL, outward, _BEFORE * size)


def number_electrodes(ax: Axes, scene: Scene, points, triangles, shapes: ElectrodeShapes) -> None:
    """Numbers from 1 beside electrodes, outward; faint on the side that is not looked at."""
    middles = shapes.middles()
    normals = Draped(points, triangles).normals(middles)
    places = scene.camera.on_page(middles + _AWAY * float(np.ptp(points, axis=0).max()) * normals)
    fontsize = 8 if len(places) <= 20 else 6.5
    faint = normals @ scene.camera.toward < -0.05
    near, clear = places[~faint], _CLEAR * float(np.ptp(points, axis=0).max())
    for k, place in enumerate(places):
        # What is behind has no number where one in front has its own.
        if not faint[k] or not len(near) or np.linalg.norm(near - place, axis=1).min() > clear:
            draw_number(ax, place, str(k + 1), fontsize=fontsize, faint=bool(faint[k]))
