"""Parts of plots in space besides the image: the translucent hull of the body, and numbered electrodes on it."""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba

from jeit.electrodes.electrode_shapes import ElectrodeShapes, ProjectionSurface, surface_triangles
from jeit.mesh import Mesh
from jeit.plot.colours import LIGHT_GREY
from jeit.plot.imaging.electrodes import ELECTRODE_COLOUR, group_coincident
from jeit.plot.solid.scene import BODY_COLOUR, Scene, draw_number

_HULL_OPACITY = 0.1
# Cosine of the angle between the normals of two facets, below which their common edge is drawn as an edge of the body.
_MAX_EDGE_COSINE = 0.85
# Distance by which electrodes are drawn nearer to the viewer than the surface under them, and distance of numbers from
# electrodes, both divided by the size of the body.
_ELECTRODE_OFFSET, _NUMBER_DISTANCE = 0.06, 0.045
# Minimum distance between numbers, so that they are readable, divided by the size of the body.
_MIN_NUMBER_DISTANCE = 0.03
# Share of the visible body that electrodes may cover before they are drawn translucent, and opacity of translucent
# electrodes.
_MAX_COVERED_SHARE, _TRANSLUCENT_OPACITY = 0.4, 0.16


def longest_side(mesh: Mesh) -> float:
    """Longest side of the bounding box of a mesh, metres."""
    return float(np.ptp(np.asarray(mesh.points), axis=0).max())


def add_hull(scene: Scene, mesh: Mesh) -> None:
    """Add the translucent boundary of a solid to a scene, with its edges and its outline."""
    points, triangles = np.asarray(mesh.points), surface_triangles(mesh)
    scene.add_triangles(points, triangles, np.array(to_rgba(BODY_COLOUR, _HULL_OPACITY)), smooth=True, is_lit=False)
    scene.add_lines(points[visible_edges(points, triangles, scene.camera.toward)], LIGHT_GREY, 0.9)


def visible_edges(points, triangles, view_direction: Float[np.ndarray, "3"]) -> np.ndarray:
    """Edges (s, 2) of a surface to draw as lines, as seen from the direction `view_direction`: sharp edges, edges of an
    open boundary, and the outline, at which the surface turns away from the viewer."""
    triangle_normals = np.cross(
        points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    )
    triangle_normals = triangle_normals / np.maximum(np.linalg.norm(triangle_normals, axis=1, keepdims=True), 1e-300)
    triangle_edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    triangle_index = np.repeat(np.arange(len(triangles)), 3)
    edge_order = np.lexsort(triangle_edges.T)
    triangle_edges, triangle_index = triangle_edges[edge_order], triangle_index[edge_order]
    shared_edge_rows = np.flatnonzero((triangle_edges[1:] == triangle_edges[:-1]).all(axis=1))
    first_normals, second_normals = (
        triangle_normals[triangle_index[shared_edge_rows]],
        triangle_normals[triangle_index[shared_edge_rows + 1]],
    )
    # Facets parallel to the line of sight, within rounding errors, face neither to the viewer nor away.
    facing_cosines = np.stack([first_normals @ view_direction, second_normals @ view_direction])
    facing_cosines = np.where(np.abs(facing_cosines) < 1e-9, 0, facing_cosines)
    is_drawn = (np.sum(first_normals * second_normals, axis=1) < _MAX_EDGE_COSINE) | (
        (facing_cosines > 0).any(axis=0) & (facing_cosines <= 0).any(axis=0)
    )
    is_boundary = np.ones(len(triangle_edges), bool)
    is_boundary[shared_edge_rows] = is_boundary[shared_edge_rows + 1] = False
    return np.concatenate([triangle_edges[shared_edge_rows[is_drawn]], triangle_edges[is_boundary]])


def add_electrodes(
    scene: Scene, points, triangles, shapes: ElectrodeShapes, *, translucent_in_front: bool = False
) -> None:
    """Add electrodes on a surface to a scene: in front of the surface on the side of the body that faces the viewer,
    behind it on the opposite side.

    `translucent_in_front`: whether the electrodes in front are drawn translucent if they would hide much of the body.
    """
    body_surface, body_extent = ProjectionSurface(points, triangles), float(np.ptp(points, axis=0).max())
    electrode_polygons = shapes.polygons()
    polygon_normals = body_surface.normals(
        np.array([polygon_corners.mean(axis=0) for polygon_corners in electrode_polygons])
    )
    electrode_rims = _rim_edges(electrode_polygons, shapes.electrode, 1e-6 * body_extent)
    front_polygons = [
        electrode_polygon
        for electrode_polygon, polygon_normal in zip(electrode_polygons, polygon_normals, strict=True)
        if polygon_normal @ scene.camera.toward > 0
    ]
    is_in_front_of_body = (
        translucent_in_front
        and sum(_visible_area(scene, electrode_polygon) for electrode_polygon in front_polygons)
        > _MAX_COVERED_SHARE * _visible_area(scene, points[triangles]) / 2
    )
    for polygon_corners, polygon_normal, is_rim_edge in zip(
        electrode_polygons, polygon_normals, electrode_rims, strict=True
    ):
        if len(polygon_corners) == 1:
            disc_angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
            _, first_axis, second_axis = body_surface.frames(polygon_corners)[0]
            polygon_corners = polygon_corners + 0.012 * body_extent * (
                np.outer(np.cos(disc_angles), first_axis) + np.outer(np.sin(disc_angles), second_axis)
            )
            is_rim_edge = np.ones(12, bool)
        facing_sign = float(np.sign(polygon_normal @ scene.camera.toward))
        polygon_colour = to_rgba(
            ELECTRODE_COLOUR, _TRANSLUCENT_OPACITY if is_in_front_of_body and facing_sign > 0 else 1.0
        )
        scene.add_polygon(
            polygon_corners, polygon_colour, depth_offset=_ELECTRODE_OFFSET * body_extent * facing_sign, rim=is_rim_edge
        )


def _visible_area(scene: Scene, polygon_corners: Float[np.ndarray, "*m k 3"]) -> float:
    """Total area of polygons as projected onto the page, m²."""
    x, y = np.moveaxis(
        scene.camera.on_page(polygon_corners.reshape(-1, 3)).reshape(*polygon_corners.shape[:-1], 2), -1, 0
    )
    doubled_areas = (x * np.roll(y, -1, axis=-1) - np.roll(x, -1, axis=-1) * y).sum(axis=-1)
    return float(np.abs(doubled_areas).sum() / 2)


def _rim_edges(electrode_polygons, electrode, rounding_distance: float) -> list[np.ndarray]:
    """Whether each edge of each polygon is on the rim of its electrode, i.e. no other polygon of the electrode shares
    the edge. Corners closer than `rounding_distance` count as equal."""
    edge_keys = []
    for polygon_corners, electrode_index in zip(electrode_polygons, electrode.tolist(), strict=True):
        rounded_corners = [
            tuple(polygon_corner)
            for polygon_corner in np.round(polygon_corners / rounding_distance).astype(np.int64).tolist()
        ]
        next_corners = [*rounded_corners[1:], rounded_corners[0]]
        edge_keys.append(
            [(electrode_index, *sorted(corner_pair)) for corner_pair in zip(rounded_corners, next_corners, strict=True)]
        )
    num_occurrences = Counter(edge_key for polygon_keys in edge_keys for edge_key in polygon_keys)
    return [np.array([num_occurrences[edge_key] == 1 for edge_key in polygon_keys]) for polygon_keys in edge_keys]


def number_electrodes(
    ax: Axes, scene: Scene, points, triangles, shapes: ElectrodeShapes, *, number_hidden: bool = True
) -> None:
    """Draw the number of each electrode, from 1, outside the body beside the electrode. Numbers on the side of the body
    facing away from the viewer are faint, or are left out unless `number_hidden`.

    Electrodes seen close to each other share one text.
    """
    electrode_centres = shapes.middles()
    electrode_normals = ProjectionSurface(points, triangles).normals(electrode_centres)
    number_positions = scene.camera.on_page(
        electrode_centres + _NUMBER_DISTANCE * float(np.ptp(points, axis=0).max()) * electrode_normals
    )
    fontsize = 8 if len(number_positions) <= 20 else 6.5
    is_on_far_side = electrode_normals @ scene.camera.toward < -0.05
    front_positions, min_distance = (
        number_positions[~is_on_far_side],
        _MIN_NUMBER_DISTANCE * float(np.ptp(points, axis=0).max()),
    )
    horizontal_position = scene.camera.on_page(points)[:, 0]
    left_limit, right_limit = horizontal_position.min() + min_distance, horizontal_position.max() - min_distance
    for is_drawn_faintly in (False, True) if number_hidden else (False,):
        electrode_indices = np.flatnonzero(is_on_far_side == is_drawn_faintly)
        for electrode_group in group_coincident(number_positions[electrode_indices], min_distance):
            number_position = number_positions[electrode_indices[electrode_group]].mean(axis=0)
            # Numbers of electrodes behind the body are left out where they would overlap a number in front.
            if (
                is_drawn_faintly
                and len(front_positions)
                and np.linalg.norm(front_positions - number_position, axis=1).min() <= min_distance
            ):
                continue
            outward_text_alignment = (
                "right" if number_position[0] < left_limit else "left" if number_position[0] > right_limit else "center"
            )
            text_alignment = outward_text_alignment if len(electrode_group) > 1 else "center"
            draw_number(
                ax,
                number_position,
                _number_text((electrode_indices[electrode_group] + 1).tolist()),
                fontsize=fontsize,
                is_faint=is_drawn_faintly,
                alignment=text_alignment,
            )


def _number_text(numbers: list[int]) -> str:
    """Text of sorted numbers, with three or more consecutive numbers as a range, such as "4–6"."""
    number_runs: list[list[int]] = []
    for number in numbers:
        if number_runs and number == number_runs[-1][-1] + 1:
            number_runs[-1].append(number)
        else:
            number_runs.append([number])
    return ", ".join(
        f"{number_run[0]}–{number_run[-1]}" if len(number_run) > 2 else ", ".join(map(str, number_run))
        for number_run in number_runs
    )
