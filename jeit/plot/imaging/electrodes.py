"""Drawing of electrodes, inclusions and labels on plots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from jeit.arguments import interval_text, signed_percent
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes
from jeit.image import Inclusion
from jeit.image.rasters import CONDUCTIVE, RESISTIVE
from jeit.inverse.shapes import Star
from jeit.mesh import Mesh
from jeit.plot.axes import get_or_create_axes
from jeit.plot.colours import DARK_GREY

_LABEL_STYLES = ((-1, RESISTIVE, "dashed", "resistive"), (1, CONDUCTIVE, "solid", "conductive"))


def draw_labels(labels: ArrayLike, extent: tuple[float, float, float, float], *, ax: Axes | None = None) -> Axes:
    """Draw the outlines of the regions of a segmentation (rows, columns), see `jeit.image.segment`; outlines of
    resistive regions are dashed.

    `extent`: (x_min, x_max, y_min, y_max) in metres. Raises `ValueError` for labels that are not (rows, columns).
    """
    label_pixels = np.asarray(labels)
    if label_pixels.ndim != 2:
        raise ValueError(f"labels has shape {label_pixels.shape}; give (rows, columns).")
    ax = get_or_create_axes(ax)
    num_rows, num_columns = label_pixels.shape
    x_min, x_max, y_min, y_max = extent
    x = x_min + (np.arange(num_columns) + 0.5) * (x_max - x_min) / num_columns
    y = y_max - (np.arange(num_rows) + 0.5) * (y_max - y_min) / num_rows
    for _, region_label, outline_style, name in _LABEL_STYLES:
        region_mask = label_pixels == region_label
        if region_mask.any():
            ax.contour(x, y, region_mask, levels=[0.5], colors=DARK_GREY, linewidths=1.4, linestyles=outline_style)
            ax.plot([], [], color=DARK_GREY, linewidth=1.4, linestyle=outline_style, label=name)
    return ax


def draw_outlines(star_bodies: Sequence[Star], *, ax: Axes | None = None) -> Axes:
    """Draw the outlines of bodies in a sheet, see `jeit.inverse.shapes`, on axes in metres; outlines of resistive
    bodies are dashed. Beside each body the 68 % interval of its change of conductivity is written, if the interval is
    known."""
    ax = get_or_create_axes(ax)
    for change_sign, _, outline_style, name in _LABEL_STYLES:
        for body_index, star_body in enumerate(star_body for star_body in star_bodies if star_body.sign == change_sign):
            closed_outline = np.concatenate([star_body.outline, star_body.outline[:1]])
            ax.plot(
                *closed_outline.T,
                color=DARK_GREY,
                linewidth=1.4,
                linestyle=outline_style,
                label=None if body_index else name,
            )
    _label_intervals(ax, [star_body for star_body in star_bodies if star_body.quantities is not None])
    return ax


def _label_intervals(ax: Axes, bodies: Sequence[Star]) -> None:
    """Write the 68 % interval of each body's change of conductivity on the side of the outline that faces the middle of
    the axes, where no electrodes are; or on the opposite side if the first side already has a label."""
    (x_min, y_min), (x_max, y_max) = ax.dataLim.get_points()
    min_distances, used_positions = 0.3 * np.array([x_max - x_min, 0.2 * (y_max - y_min)]), []
    for star_body in bodies:
        side_signs = (1, -1) if star_body.centroid[1] < (y_min + y_max) / 2 else (-1, 1)
        candidate_positions = [
            (star_body.centroid[0], side_sign * (side_sign * star_body.outline[:, 1]).max()) for side_sign in side_signs
        ]
        is_free = [
            all(
                (np.abs(np.subtract(candidate_position, number_position)) > min_distances).any()
                for number_position in used_positions
            )
            for candidate_position in candidate_positions
        ]
        position_index = is_free.index(True) if any(is_free) else 0
        used_positions.append(candidate_positions[position_index])
        assert star_body.quantities is not None
        ax.annotate(
            interval_text(star_body.quantities.change_interval, signed_percent),
            candidate_positions[position_index],
            xytext=(0, 3 * side_signs[position_index]),
            textcoords="offset points",
            ha="center",
            va="bottom" if side_signs[position_index] > 0 else "top",
            fontsize=8,
            color=DARK_GREY,
            zorder=4,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )


def draw_inclusions(inclusions: Sequence[Inclusion], *, ax: Axes | None = None) -> Axes:
    """Mark every inclusion by a plus or minus sign at its centroid and a dashed circle of equal area. In 3-D, the
    circle has the radius of a ball of the inclusion's volume, for every height of the slice."""
    ax = get_or_create_axes(ax)
    halo_effects = [withStroke(linewidth=3, foreground="white")]
    for inclusion in inclusions:
        x, y = inclusion.centroid[:2]
        ax.add_patch(
            Circle(
                (x, y),
                inclusion.radius,
                fill=False,
                edgecolor=DARK_GREY,
                linewidth=1.0,
                linestyle=(0, (4, 3)),
                zorder=3,
            )
        )
        sign_marker = "+" if inclusion.sign > 0 else "_"
        ax.plot(
            x,
            y,
            marker=sign_marker,
            color=DARK_GREY,
            markersize=9,
            markeredgewidth=1.4,
            zorder=4,
            path_effects=halo_effects,
        )
    return ax


ELECTRODE_COLOUR = "#b8860b"


def draw_electrodes(
    mesh: Mesh, electrodes: AbstractElectrodes, *, numbers: bool = True, ax: Axes | None = None, first: int = 1
) -> Axes:
    """Draw `electrodes` as seen from above, with their numbers, beginning with `first`.

    Arcs are drawn along the boundary of `mesh`, discs and patches to scale, and points as dots. Numbers are outside the
    outline for electrodes on the edge of a 2-D mesh, inside discs, and beside dots. Raises `ValueError` for electrodes
    without known places.
    """
    ax = get_or_create_axes(ax)
    electrode_pen = _MatplotlibPen()
    electrodes.draw(mesh, electrode_pen)
    if electrode_pen.boundary_segments:
        ax.add_collection(
            LineCollection(
                electrode_pen.boundary_segments, colors=ELECTRODE_COLOUR, linewidths=5, capstyle="butt", zorder=3
            )
        )
    if electrode_pen.shapes:
        shape_collection = PatchCollection(
            electrode_pen.shapes, facecolor="none", edgecolor=ELECTRODE_COLOUR, linewidth=1.6, zorder=3
        )
        ax.add_collection(shape_collection)
    if electrode_pen.dots:
        x, y = np.array(electrode_pen.dots).T
        ax.scatter(x, y, s=28, color=ELECTRODE_COLOUR, zorder=3)
    if numbers:
        draw_numbers(
            ax, mesh, np.array(electrode_pen.number_positions), np.array(electrode_pen.is_number_beside), first
        )
    return ax


def draw_shapes(mesh: Mesh, shapes: ElectrodeShapes, *, ax: Axes) -> None:
    """Draw electrodes of a plane mesh from their polygons, with their numbers from 1. Polygons of two corners are lines
    along the edge, and polygons of one corner dots."""
    for polygon_corners in shapes.polygons():
        if len(polygon_corners) == 2:
            ax.plot(*polygon_corners.T, color=ELECTRODE_COLOUR, linewidth=5, solid_capstyle="butt", zorder=3)
        elif len(polygon_corners) == 1:
            ax.scatter(*polygon_corners[0], s=28, color=ELECTRODE_COLOUR, zorder=3)
        else:
            ax.add_patch(
                Polygon(polygon_corners, facecolor="none", edgecolor=ELECTRODE_COLOUR, linewidth=1.6, zorder=3)
            )
    first_indices = np.unique(shapes.electrode, return_index=True)[1]
    draw_numbers(ax, mesh, shapes.middles(), shapes.sizes[first_indices] < 3, 1)


class _MatplotlibPen:
    """Collects the electrodes to draw, by kind, with the centre of each electrode and whether its number is drawn
    beside it."""

    def __init__(self):
        self.boundary_segments: list[np.ndarray] = []
        self.shapes: list[Patch] = []
        self.dots: list[np.ndarray] = []
        self.number_positions: list[np.ndarray] = []
        self.is_number_beside: list[bool] = []

    def _add_number(self, number_position: np.ndarray, *, is_beside: bool) -> None:
        self.number_positions.append(number_position[:2])
        self.is_number_beside.append(is_beside)

    def lines(self, segments: list[np.ndarray], centre: np.ndarray) -> None:
        self.boundary_segments += segments
        self._add_number(centre, is_beside=True)

    def disc(self, centre: np.ndarray, radius: float) -> None:
        self.shapes.append(Circle((centre[0], centre[1]), radius))
        self._add_number(centre, is_beside=False)

    def rectangle(self, centre: np.ndarray, width: float, height: float) -> None:
        self.shapes.append(Rectangle((centre[0] - width / 2, centre[1] - height / 2), width, height))
        self._add_number(centre, is_beside=True)

    def dot(self, centre: np.ndarray) -> None:
        self.dots.append(centre[:2])
        self._add_number(centre, is_beside=True)


# Distance of a number from its electrode, and maximum distance from the edge of an electrode that counts as lying on
# the edge, both divided by the size of the body.
_NUMBER_DISTANCE, _EDGE_TOLERANCE = 0.058, 0.02
# Factor of the distance of a number from its electrode for texts that are not centred.
_ALIGNED_DISTANCE_FACTOR = 0.7
# A number is drawn outside the outline if the free distance there is at least this factor times the distance of the
# number from its electrode.
_MIN_FREE_DISTANCE = 1.6


def draw_numbers(
    ax: Axes, mesh: Mesh, positions: Float[np.ndarray, "L 2"], is_beside: Bool[np.ndarray, " L"], first_number: int
) -> None:
    """Draw the numbers of electrodes at `positions`, beginning with `first_number`: on the electrode, or `is_beside`
    it.

    The number beside an electrode on the edge of a sheet is outside along the normal, or inside if a notch is too
    narrow. Beside an electrode within a sheet it is above the electrode, and on a solid seen from above it is away from
    the middle. Electrodes above each other share one text.
    """
    mesh_corners = np.asarray(mesh.points)[:, :2]
    number_distance = _NUMBER_DISTANCE * np.ptp(mesh_corners, axis=0).max()
    if mesh.dimension == 2:
        number_shifts, is_inside = _shifts_from_edge(mesh, positions, number_distance)
    else:
        number_shifts, is_inside = (
            _shifts_from_centre(mesh_corners, positions, number_distance),
            np.zeros(len(positions), bool),
        )
    number_shifts[~is_beside] = 0
    fontsize = 9 if len(positions) <= 20 else 7
    white_rim = [withStroke(linewidth=2, foreground="white")]
    for electrode_group in group_coincident(positions, 0.1 * number_distance):
        k = electrode_group[0]
        # A white rim where the text is on the image.
        text_effects = white_rim if is_inside[k] or not is_beside[k] else None
        text_style = {"ha": "center", "va": "center", "fontsize": fontsize, "color": DARK_GREY, "zorder": 4}
        text = ", ".join(str(k + first_number) for k in electrode_group)
        if len(electrode_group) > 1:
            text_style["ha"] = _text_alignment(number_shifts[k])
        x, y = positions[k] + (1.0 if text_style["ha"] == "center" else _ALIGNED_DISTANCE_FACTOR) * number_shifts[k]
        ax.text(x, y, text, path_effects=text_effects, **text_style)


def _text_alignment(number_shift: Float[np.ndarray, " 2"]) -> str:
    """Horizontal alignment of a text of several numbers beside an electrode, so that it does not cover the
    electrode."""
    if abs(number_shift[0]) < 0.8 * abs(number_shift[1]):
        return "center"
    return "left" if number_shift[0] > 0 else "right"


def group_coincident(positions: Float[np.ndarray, "L 2"], tolerance: float) -> list[list[int]]:
    """Group electrodes within a distance `tolerance` of each other, for example electrodes above each other in several
    rings of a tank seen from above."""
    electrode_groups: list[list[int]] = []
    for k, position in enumerate(positions):
        for electrode_group in electrode_groups:
            if np.linalg.norm(positions[electrode_group[0]] - position) < tolerance:
                electrode_group.append(k)
                break
        else:
            electrode_groups.append([k])
    return electrode_groups


def _shifts_from_edge(
    mesh: Mesh, positions, number_distance: float
) -> tuple[Float[np.ndarray, "L 2"], Bool[np.ndarray, " L"]]:
    """Shifts (L, 2) of numbers from their electrodes on a sheet, and whether each number is inside the sheet."""
    edge_starts, edge_ends = np.asarray(mesh.points)[np.asarray(mesh.facets)].swapaxes(0, 1)
    number_shifts, is_inside = np.tile([0.0, 0.7 * number_distance], (len(positions), 1)), np.ones(len(positions), bool)
    for k, position in enumerate(positions):
        edge_distances = _edge_distances(position, edge_starts, edge_ends)
        if edge_distances.min() > _EDGE_TOLERANCE / _NUMBER_DISTANCE * number_distance:
            continue
        # At a corner two edges are nearest, and the number is placed along the bisector.
        is_nearest_side = edge_distances <= edge_distances.min() + 1e-6 * number_distance
        outward_normal = _edge_normals(edge_starts[is_nearest_side], edge_ends[is_nearest_side]).sum(axis=0)
        outward_normal /= max(np.linalg.norm(outward_normal), 1e-12)
        is_inside[k] = (
            _free_distance(position, outward_normal, edge_starts, edge_ends, 0.01 * number_distance)
            < _MIN_FREE_DISTANCE * number_distance
        )
        number_shifts[k] = (-number_distance if is_inside[k] else number_distance) * outward_normal
    return number_shifts, is_inside


def _shifts_from_centre(mesh_corners, positions, number_distance: float) -> Float[np.ndarray, "L 2"]:
    """Shifts (L, 2) of numbers away from the middle of a body; zero for electrodes near the middle."""
    centre_offsets = positions - (mesh_corners.min(axis=0) + mesh_corners.max(axis=0)) / 2
    centre_distances = np.linalg.norm(centre_offsets, axis=1, keepdims=True)
    is_far_from_centre = centre_distances > 0.3 * np.ptp(mesh_corners, axis=0).max()
    return np.where(is_far_from_centre, number_distance * centre_offsets / np.maximum(centre_distances, 1e-12), 0)


def _edge_normals(edge_starts, edge_ends) -> Float[np.ndarray, "b 2"]:
    """Outward unit normals of edges that have the body on their left."""
    edge_directions = (edge_ends - edge_starts) / np.linalg.norm(edge_ends - edge_starts, axis=1, keepdims=True)
    return np.stack([edge_directions[:, 1], -edge_directions[:, 0]], axis=1)


def _edge_distances(position, edge_starts, edge_ends) -> Float[np.ndarray, " b"]:
    """Distance of a position from every edge."""
    edge_vectors = edge_ends - edge_starts
    edge_fractions = np.clip(
        np.sum((position - edge_starts) * edge_vectors, axis=1) / np.sum(edge_vectors**2, axis=1), 0, 1
    )
    return np.linalg.norm(edge_starts + edge_fractions[:, None] * edge_vectors - position, axis=1)


def _free_distance(position, ray_direction, edge_starts, edge_ends, min_distance: float) -> float:
    """Distance from a position along a unit direction to the first edge that is farther away than `min_distance`."""
    edge_vectors, start_offsets = edge_ends - edge_starts, edge_starts - position
    cross_products = ray_direction[0] * edge_vectors[:, 1] - ray_direction[1] * edge_vectors[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # edges parallel to the direction give infinity or NaN
        ray_distance = (
            start_offsets[:, 0] * edge_vectors[:, 1] - start_offsets[:, 1] * edge_vectors[:, 0]
        ) / cross_products
        side_fraction = (
            start_offsets[:, 0] * ray_direction[1] - start_offsets[:, 1] * ray_direction[0]
        ) / cross_products
    return float(
        np.min(
            ray_distance[(ray_distance > min_distance) & (side_fraction >= 0) & (side_fraction <= 1)], initial=np.inf
        )
    )
