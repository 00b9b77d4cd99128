"""Elements shared by all plots of touches: the skin's surface seen from above, its microphones, and error ellipses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike
from scipy.special import chdtri

from jeit.acoustic import Calibration, MicrophoneArray
from jeit.acoustic.surface import AbstractSurface, bounding_box, make_surface
from jeit.mesh import Domain
from jeit.plot.axes import draw_scale_bar, extent_of, hide_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY
from jeit_solvers.engines import host, on_host, slopes

MICROPHONE_COLOUR, ESTIMATE_COLOUR = "#1f6fb4", "#c8102e"
HALO = (withStroke(linewidth=2.5, foreground="white"),)
# Radius, in standard deviations, of the ellipse that contains 95 % of a two-dimensional normal distribution.
_ELLIPSE_RADIUS = float(np.sqrt(chdtri(2, 0.05)))

AnySurface = Calibration | MicrophoneArray | AbstractSurface | Domain | ArrayLike


class View(NamedTuple):
    """A surface seen along the normal of its chart, the plane onto which the surface is unrolled or projected.

    **Fields**: `surface`: the surface, with NumPy arrays; `microphones`: chart coordinates (M, 2) of the microphones in
    metres; `usable`: mask (M,) of the usable microphones.
    """

    surface: AbstractSurface
    microphones: np.ndarray
    usable: np.ndarray

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max) of the surface's outline in metres."""
        (x_min, y_min), (x_max, y_max) = bounding_box(self.surface)
        return float(x_min), float(x_max), float(y_min), float(y_max)

    def chart(self, points: ArrayLike, name: str) -> np.ndarray:
        """Chart coordinates (n, 2) of `points` (n, d) in metres. Raises `ValueError` for other shapes; `name` is the
        argument's name in the message."""
        return project_to_chart(self.surface, points, name)

    def chart_point(self, point: ArrayLike, name: str) -> np.ndarray:
        """Chart coordinates (2,) of one `point` (d,) in metres. Raises `ValueError` for a different shape; `name` is
        the argument's name in the message."""
        coordinates = np.asarray(point, float)
        if coordinates.shape != (self.surface.dimension,):
            raise ValueError(
                f"{name} has shape {coordinates.shape}; give one place ({self.surface.dimension},) in metres."
            )
        return self.chart(coordinates[None], name)[0]

    def chart_covariance(self, covariance: ArrayLike, point: ArrayLike, name: str = "covariance") -> np.ndarray:
        """Transform a `covariance` (d, d) in m² at `point` (d,) in metres to a covariance (2, 2) in the chart.

        Raises `ValueError` for a different shape; `name` is the argument's name in the message.
        """
        space_covariance, dimension = np.asarray(covariance, float), self.surface.dimension
        if space_covariance.shape != (dimension, dimension):
            raise ValueError(f"{name} has shape {space_covariance.shape}; give ({dimension}, {dimension}) in m².")
        _, chart_derivatives = slopes(self.surface.project, np.asarray(point, float)[:, None])
        jacobian = np.concatenate(chart_derivatives, axis=1)
        return jacobian @ space_covariance @ jacobian.T


def create_view(surface: AnySurface, microphones: ArrayLike | None = None, usable: ArrayLike | None = None) -> View:
    """Create the view of the surface of a calibration, a microphone array, a surface or an outline.

    `microphones` (M, d): positions of the microphones in metres, by default those of the calibration or array. `usable`
    (M,): mask of the usable microphones. Raises `ValueError` for shapes that disagree.
    """
    if isinstance(surface, Calibration):
        usable = surface.usable if usable is None else usable
        surface = surface.microphone_array
    if isinstance(surface, MicrophoneArray):
        microphones = surface.microphones if microphones is None else microphones
        surface = surface.surface
    host_surface: AbstractSurface = on_host(surface if isinstance(surface, AbstractSurface) else make_surface(surface))
    microphone_positions = (
        np.zeros((0, 2)) if microphones is None else project_to_chart(host_surface, microphones, "microphones")
    )
    is_usable = np.ones(len(microphone_positions), bool) if usable is None else np.asarray(usable, bool)
    if is_usable.shape != (len(microphone_positions),):
        raise ValueError(
            f"usable has shape {is_usable.shape}; give one for each of the {len(microphone_positions)} microphones."
        )
    return View(host_surface, microphone_positions, is_usable)


def project_to_chart(surface: AbstractSurface, points: ArrayLike, name: str) -> np.ndarray:
    """Chart coordinates (n, 2) of `points` (n, d) in metres. Raises `ValueError` for other shapes; `name` is the
    argument's name in the message."""
    coordinates = np.asarray(points, float)
    if coordinates.ndim != 2 or coordinates.shape[1] != surface.dimension:
        raise ValueError(f"{name} has shape {coordinates.shape}; give (n, {surface.dimension}) in metres.")
    return np.asarray(surface.project(host.asarray(coordinates.T))).T


def outline_path(view: View) -> Path:
    """Path of the surface's outline and its holes in chart coordinates."""
    closed_loops = (
        Path(np.concatenate([outline_loop, outline_loop[:1]]), closed=True)
        for outline_loop in view.surface.outline.loops()
    )
    return Path.make_compound_path(*closed_loops)


def draw_surface(ax: Axes, view: View, *, microphones: bool = True, is_faint: bool = False) -> list[Line2D]:
    """Draw the surface's outline, a scale bar and the microphones, with crosses for unusable microphones. Returns the
    legend entries."""
    ax.add_patch(
        PathPatch(outline_path(view), facecolor="none", edgecolor=DARK_GREY, linewidth=0.9, joinstyle="round", zorder=2)
    )
    # Microphones may lie outside the outline.
    shown_points = np.concatenate([np.reshape(view.extent, (2, 2)).T, view.microphones])
    x_min, x_max, y_min, y_max = extent_of(shown_points)
    axes_margin = 0.06 * max(x_max - x_min, y_max - y_min)
    hide_axes(ax, (x_min, x_max, y_min, y_max))
    # The scale bar is closer to the outline than in plots of electrodes, since no labels are drawn outside the outline.
    draw_scale_bar(ax, (x_min + axes_margin, x_max, y_min + axes_margin, y_max))
    ax.set_xlim(x_min - 0.5 * axes_margin, x_max + 0.5 * axes_margin)
    ax.set_ylim(y_min - 2 * axes_margin, y_max + 0.5 * axes_margin)
    if not microphones:
        return []
    legend_handles = []
    dot_style = {"marker": "o", "linestyle": "none", "markersize": 6.5, "zorder": 2.5, "label": "microphone"}
    dot_style |= {"markerfacecolor": "none", "markeredgewidth": 1.0} if is_faint else {"markeredgewidth": 0.8}
    dot_style |= (
        {"markeredgecolor": LIGHT_GREY}
        if is_faint
        else {"markerfacecolor": MICROPHONE_COLOUR, "markeredgecolor": "white"}
    )
    cross_style = {
        "marker": "x",
        "linestyle": "none",
        "markersize": 7,
        "markeredgewidth": 1.6,
        "color": DARK_GREY,
        "zorder": 2.6,
    }
    if view.usable.any():
        legend_handles += ax.plot(*view.microphones[view.usable].T, **dot_style)
    if not view.usable.all():
        legend_handles += ax.plot(*view.microphones[~view.usable].T, **cross_style, label="not usable")
    return legend_handles


def draw_ellipse(ax: Axes, centre: np.ndarray, covariance: np.ndarray, *, colour: str = ESTIMATE_COLOUR) -> None:
    """Draw the 95 % ellipse of a normal distribution with mean `centre` (2,) in metres and `covariance` (2, 2) in
    m²."""
    axis_variances, principal_axes = np.linalg.eigh(covariance)
    major_axis, minor_axis = 2 * _ELLIPSE_RADIUS * np.sqrt(np.maximum(axis_variances[::-1], 0))
    rotation_degrees = np.degrees(np.arctan2(principal_axes[1, 1], principal_axes[0, 1]))
    x, y = centre
    ellipse = Ellipse(
        (x, y), major_axis, minor_axis, angle=rotation_degrees, fill=False, edgecolor=colour, linewidth=1.4, zorder=4
    )
    ellipse.set_path_effects([*HALO])
    ax.add_patch(ellipse)


def draw_legend(ax: Axes, handles: list) -> None:
    """Draw a legend of the entries `handles` below the plot, with as many columns as fit. Without entries, no legend is
    drawn."""
    if not handles:
        return
    # A legend entry takes 0.45 inches for a marker with its gaps, and 0.065 inches for each letter.
    entry_widths = [0.45 + 0.065 * len(str(legend_handle.get_label())) for legend_handle in handles]
    available_width = ax.bbox.width / ax.figure.dpi
    num_columns = (
        len(handles) if sum(entry_widths) <= available_width else max(1, int(available_width / max(entry_widths)))
    )
    ax.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=num_columns,
        frameon=False,
        borderpad=0,
        borderaxespad=0,
        handletextpad=0.5,
        columnspacing=1.4,
        fontsize=9,
        labelcolor=DARK_GREY,
    )
