"""Scenes in space: a camera, and triangles, polygons and lines drawn as the camera sees them.

The 3-D axes of matplotlib sort whole objects by depth, so that electrodes would be visible through bodies. Here all
pieces are sorted by depth, and the projection is parallel, so that one scale bar applies to the whole picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.patheffects import withStroke

from jeit.arguments import describe, is_number
from jeit.plot.axes import draw_scale_bar
from jeit.plot.colours import DARK_GREY

# Direction towards the light, above and to the left of the viewer: components to the right and up on the page, and
# towards the viewer.
_LIGHT_DIRECTION = np.array([-0.35, 0.5, 0.79])
# Minimum brightness of surfaces.
_MIN_BRIGHTNESS = 0.66


@dataclass(frozen=True)
class Camera:
    """Direction of view of a parallel projection, in which lengths perpendicular to the direction of view are true to
    scale.

    **Fields**: `azimuth`: angle of the viewer around the z axis, in degrees from the x axis towards y; `elevation`:
    angle of the viewer above the plane z = 0, in degrees. Azimuth −90 with elevation 0 is the view of the front, along
    y; elevation 90 is the view from above. Raises `ValueError` for values that are not angles, and for elevations
    beyond 90 degrees.

    **Example:**

    ```python
    plot_isosurfaces(solid, solid_image, camera=Camera(azimuth=-30, elevation=40))
    ```
    """

    azimuth: float = -60.0
    elevation: float = 25.0

    def __post_init__(self):
        for name, angle_value in (("azimuth", self.azimuth), ("elevation", self.elevation)):
            if not is_number(angle_value):
                raise ValueError(f"{name} must be an angle in degrees; it is {describe(angle_value)}.")
        if not -90 <= self.elevation <= 90:
            raise ValueError(f"elevation must lie between −90 (from below) and 90 degrees; it is {self.elevation:g}.")

    @property
    def toward(self) -> Float[np.ndarray, "3"]:
        """Unit vector towards the viewer."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])

    @property
    def right(self) -> Float[np.ndarray, "3"]:
        """Unit vector to the right on the page."""
        azimuth = np.radians(self.azimuth)
        return np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Unit vector upwards on the page."""
        return np.cross(self.toward, self.right)

    def on_page(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Project points (…, 3) onto the page: coordinates (…, 2) to the right and upwards, metres."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    def nearness(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Coordinate (…) of points (…, 3) along the direction towards the viewer, metres."""
        return points @ self.toward

    def light(self, normals: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Brightness (m,) of surfaces with the given normals of any length, from `_MIN_BRIGHTNESS` to 1; both sides of
        a surface have the same brightness."""
        normal_lengths = np.maximum(np.linalg.norm(normals, axis=-1), 1e-300)
        unit_normals = normals / normal_lengths[:, None]
        unit_normals = unit_normals * np.where(unit_normals @ self.toward < 0, -1.0, 1.0)[:, None]
        light_direction = (
            _LIGHT_DIRECTION[0] * self.right + _LIGHT_DIRECTION[1] * self.up + _LIGHT_DIRECTION[2] * self.toward
        )
        return _MIN_BRIGHTNESS + (1 - _MIN_BRIGHTNESS) * np.clip(
            unit_normals @ light_direction / np.linalg.norm(light_direction), 0, 1
        )


CORNER_VIEW = Camera()


_RIM_EFFECTS = [withStroke(linewidth=2.2, foreground="white")]
_HALO_EFFECTS = [withStroke(linewidth=3, foreground="white")]
_AXIS_NAMES = ("x", "y", "z")
# Colour of surfaces without values.
BODY_COLOUR = "#b9bec6"


class Scene:
    """Collection of triangles and lines as seen by a `camera`, which are drawn together, sorted by depth."""

    def __init__(self, camera: Camera):
        self.camera = camera
        self._piece_corners: list[np.ndarray] = []
        self._piece_nearness: list[np.ndarray] = []
        self._face_colours: list[np.ndarray] = []
        self._edge_colours: list[np.ndarray] = []
        self._line_widths: list[np.ndarray] = []

    def add_triangles(
        self,
        points: Float[np.ndarray, "n 3"],
        triangles: Int[np.ndarray, "m 3"],
        colours: Float[np.ndarray, "m 4"],
        *,
        smooth: bool = False,
        is_lit: bool = True,
        depth_offset: Float[np.ndarray, "m"] | float = 0.0,
    ) -> None:
        """Add triangles with colours (m, 4). `smooth`: whether to light them as a smooth surface; `is_lit`: whether to
        darken triangles turned away from the light; `depth_offset`: distance in metres by which the triangles are moved
        towards the viewer when sorted by depth."""
        triangle_corners = points[triangles]
        triangle_normals = np.cross(
            triangle_corners[:, 1] - triangle_corners[:, 0], triangle_corners[:, 2] - triangle_corners[:, 0]
        )
        if smooth:
            node_normals = np.stack(
                [
                    np.bincount(triangles.ravel(), np.repeat(normal_component, 3), len(points))
                    for normal_component in triangle_normals.T
                ],
                axis=1,
            )
            triangle_normals = node_normals[triangles].sum(axis=1)
        face_colours = np.array(np.broadcast_to(colours, (len(triangles), 4)), dtype=float)
        if is_lit:
            face_colours[:, :3] *= self.camera.light(triangle_normals)[:, None]
        distances_towards_viewer = self.camera.nearness(triangle_corners.mean(axis=1)) + depth_offset
        # Edges in the colour of their face close gaps. Translucent triangles have no edges, as these would be visible
        # as a net.
        is_opaque = face_colours[:, 3] > 0.99
        self._add_pieces(
            triangle_corners[:, [0, 1, 2, 2]],
            distances_towards_viewer,
            face_colours,
            np.where(is_opaque[:, None], face_colours, 0),
            0.7 * is_opaque,
        )

    def add_polygon(
        self, corners: Float[np.ndarray, "k 3"], colour, *, depth_offset: float, rim: Bool[np.ndarray, " k"]
    ) -> None:
        """Add a convex polygon on a surface, divided into pieces that are sorted separately; `depth_offset` as in
        `add_triangles`. Edges on the `rim` are drawn as lines."""
        polygon_centre = corners.mean(axis=0)
        corner_index = np.arange(len(corners))
        points = np.concatenate([corners, (corners + polygon_centre) / 2, polygon_centre[None]])
        inner_vertices, next_corner, num_corners = (
            corner_index + len(corners),
            (corner_index + 1) % len(corners),
            len(corners),
        )
        triangles = np.concatenate(
            [
                np.stack([corner_index, next_corner, next_corner + num_corners], axis=1),
                np.stack([corner_index, next_corner + num_corners, inner_vertices], axis=1),
                np.stack([inner_vertices, next_corner + num_corners, np.full(num_corners, 2 * num_corners)], axis=1),
            ]
        )
        self.add_triangles(points, triangles, np.array(to_rgba(colour)), depth_offset=depth_offset)
        rim_edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)[rim]
        self.add_lines(rim_edges, DARK_GREY, 0.5, depth_offset=depth_offset + abs(depth_offset) * 0.05)

    def add_lines(
        self, end_points: Float[np.ndarray, "s 2 3"], colour, width: float, *, depth_offset: float = 0.0
    ) -> None:
        """Add lines between pairs of `end_points`, `width` in points; `depth_offset` as in `add_triangles`."""
        line_colours = np.broadcast_to(to_rgba(colour), (len(end_points), 4))
        distances_towards_viewer = self.camera.nearness(end_points.mean(axis=1)) + depth_offset
        self._add_pieces(
            end_points[:, [0, 1, 1, 0]],
            distances_towards_viewer,
            np.zeros((len(end_points), 4)),
            line_colours,
            np.full(len(end_points), width),
        )

    def _add_pieces(self, piece_corners, distances_towards_viewer, face_colours, edge_colours, line_widths) -> None:
        self._piece_corners.append(self.camera.on_page(piece_corners))
        self._piece_nearness.append(distances_towards_viewer)
        self._face_colours.append(face_colours)
        self._edge_colours.append(edge_colours)
        self._line_widths.append(line_widths)

    def draw(self, ax: Axes) -> None:
        """Draw all pieces of the scene, from the farthest to the nearest."""
        if not self._piece_corners:
            return
        drawing_order = np.argsort(np.concatenate(self._piece_nearness), kind="stable")
        piece_corners, face_colours, edge_colours, line_widths = (
            np.concatenate(piece_arrays)[drawing_order]
            for piece_arrays in (self._piece_corners, self._face_colours, self._edge_colours, self._line_widths)
        )
        ax.add_collection(
            PolyCollection(
                piece_corners,  # pyright: ignore[reportArgumentType]
                facecolors=face_colours,
                edgecolors=edge_colours,
                linewidths=line_widths,
                closed=True,
                capstyle="round",
                joinstyle="round",
            ),
            autolim=False,
        )


def hide_axes_in_space(ax: Axes, camera: Camera, points: Float[np.ndarray, "n 3"], *, numbered: bool) -> None:
    """Set equal scales and limits around the projected `points`, remove the frame, and draw a scale bar and arrows of
    the axes below. `numbered`: whether to leave space for numbers of electrodes."""
    page_points = camera.on_page(points)
    (page_left, page_bottom), (page_right, page_top) = page_points.min(axis=0), page_points.max(axis=0)
    page_extent = max(page_right - page_left, page_top - page_bottom)
    margin_width = (0.09 if numbered else 0.03) * page_extent
    ax.set_aspect("equal")
    ax.set_xlim(page_left - max(margin_width, 0.07 * page_extent), page_right + max(margin_width, 0.07 * page_extent))
    ax.set_ylim(page_bottom - 0.24 * page_extent - 0.4 * margin_width, page_top + margin_width)
    ax.set_axis_off()
    draw_scale_bar(ax, (page_left, page_right, page_bottom - 0.4 * margin_width, page_top))
    cross_position = (page_right - 0.05 * page_extent, page_bottom - 0.4 * margin_width - 0.14 * page_extent)
    draw_axes_cross(ax, camera.on_page(np.eye(3)), cross_position, 0.09 * page_extent)


def draw_axes_cross(ax: Axes, directions: Float[np.ndarray, "3 2"], origin: tuple[float, float], length: float) -> None:
    """Draw arrows with letters for the x, y and z axes at `origin` on the page, in metres; axes that point towards the
    viewer are left out.

    `directions`: (3, 2), projected unit vectors; `length`: length of an arrow that is not shortened by projection.
    """
    for axis_name, axis_direction in zip(_AXIS_NAMES, directions, strict=True):
        if np.hypot(*axis_direction) < 0.15:
            continue
        arrow_tip = np.array(origin) + length * axis_direction
        arrow_style = {
            "arrowstyle": "-|>,head_width=0.14,head_length=0.28",
            "color": DARK_GREY,
            "linewidth": 0.9,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        ax.annotate("", xy=tuple(arrow_tip), xytext=origin, arrowprops=arrow_style, annotation_clip=False)
        # The distance of the letter from the tip does not depend on the length of the arrow.
        x, y = arrow_tip + 0.3 * length * axis_direction / np.hypot(*axis_direction)
        ax.text(x, y, axis_name, ha="center", va="center", fontsize=8, color=DARK_GREY)


def draw_number(
    ax: Axes, position: Float[np.ndarray, "2"], text: str, *, fontsize: float, is_faint: bool, alignment: str = "center"
) -> None:
    """Draw a number on the page with a white rim; `alignment`: horizontal alignment relative to `position`."""
    x, y = position
    ax.text(
        x, y, text, ha=alignment, va="center", fontsize=fontsize, color=DARK_GREY, alpha=0.45 if is_faint else 1.0,
        path_effects=_RIM_EFFECTS, zorder=4,
    )  # fmt: skip


def mark_sign(ax: Axes, x: float, y: float, sign: int) -> None:
    """Draw a plus at a conductive inclusion, or a minus at a resistive inclusion."""
    marker = "+" if sign > 0 else "_"
    ax.plot(
        x, y, marker=marker, color=DARK_GREY, markersize=8, markeredgewidth=1.4, zorder=4, path_effects=_HALO_EFFECTS
    )
