"""Pictures of objects in notebooks: images, meshes, layouts, measurements and series."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from jeit.report.image import draw_image
from jeit_solvers.engines import has_values

# Resolution of pictures in dots per inch, and maximum number of frames of a measurement that are drawn.
_PICTURE_DPI, _MAX_DRAWN_FRAMES = 90, 12


def picture(value: Any) -> bytes | None:
    """Picture of an object as PNG; None for objects of a kind that has no picture, and for objects that are traced by
    `jax.jit` or a derivative."""
    draw_function = _DRAW_FUNCTIONS.get(type(value).__name__)
    if draw_function is None or not has_values(value):
        return None
    png_file = io.BytesIO()
    draw_function(value).savefig(png_file, dpi=_PICTURE_DPI, format="png")
    return png_file.getvalue()


def page(value: Any) -> str | None:
    """HTML of an object: its text above its picture, without scripts; None if the object has no picture."""
    png = picture(value)
    if png is None:
        return None
    encoded_png = base64.b64encode(png).decode("ascii")
    return (
        f'<pre>{html.escape(repr(value))}</pre><img alt="{type(value).__name__}" '
        f'src="data:image/png;base64,{encoded_png}">'
    )


def _draw_mesh(mesh: Any) -> Figure:
    if mesh.is_surface:
        from jeit.plot.solid.surfaces import plot_surface

        figure = Figure(figsize=(5.0, 4.6), layout="constrained")
        plot_surface(np.asarray(mesh.points), np.asarray(mesh.cells), ax=figure.subplots())
        return figure
    from jeit.plot.imaging.image import plot_mesh

    figure = Figure(figsize=(5.0, 4.6), layout="constrained")
    title = f"{mesh.num_points:,} nodes, {mesh.num_cells:,} cells"
    plot_mesh(mesh, title=title, ax=figure.subplots())
    return figure


def _draw_layout(layout: Any) -> Figure:
    from matplotlib.patches import Circle

    from jeit.plot.axes import draw_scale_bar, hide_axes
    from jeit.plot.colours import DARK_GREY, LIGHT_GREY

    figure = Figure(figsize=(5.0, 4.6), layout="constrained")
    ax = figure.subplots()
    centres, radii = np.asarray(layout.centres), np.asarray(layout.diameters) / 2
    if layout.outline is not None:
        for loop in layout.outline.loops():
            ax.plot(*np.concatenate([loop, loop[:1]]).T, color=DARK_GREY, linewidth=1)
    for centre, radius, label in zip(centres, radii, layout.labels, strict=True):
        ax.add_patch(Circle(tuple(centre), float(radius), facecolor="none", edgecolor=LIGHT_GREY))
        ax.annotate(label, tuple(centre), ha="center", va="center", fontsize=7)
    x_range, y_range = np.asarray(ax.dataLim.intervalx), np.asarray(ax.dataLim.intervaly)
    extent = (x_range[0], x_range[1], y_range[0], y_range[1])
    hide_axes(ax, extent, numbered=False)
    draw_scale_bar(ax, extent)
    ax.set_title(layout.name, fontsize=10)
    return figure


def _draw_measurement(measurement: Any) -> Figure:
    from jeit.plot.colours import choose_si_prefix

    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    ax = figure.subplots()
    frame_indices = np.unique(np.linspace(0, measurement.num_frames - 1, _MAX_DRAWN_FRAMES).round().astype(int))
    drawn_voltages = np.where(measurement.mask, np.real(np.asarray(measurement.voltages)), np.nan)[frame_indices]
    prefix_factor, unit = choose_si_prefix(
        float(np.abs(drawn_voltages[np.isfinite(drawn_voltages)]).max(initial=0)) or 1.0, "V"
    )
    ax.plot(prefix_factor * drawn_voltages.T, linewidth=0.8)
    ax.set(xlabel="Channel", ylabel=f"Voltage ({unit})")
    drawn_frames_text = "" if len(frame_indices) == measurement.num_frames else f"{len(frame_indices)} of "
    ax.set_title(f"{measurement.name}: {drawn_frames_text}{measurement.num_frames} frames", fontsize=10)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_series(series: Any) -> Figure:
    from jeit.plot.imaging.series import plot_frames

    return plot_frames(series.mesh, series.changes, titles=series.titles)


def _draw_figures_of_merit(figures_of_merit: Any) -> Figure:
    from jeit.plot.imaging.judgement import plot_figures_of_merit

    figure = Figure(figsize=(10.6, 5.6), layout="constrained")
    figures_per_target = jax.tree.map(np.atleast_1d, figures_of_merit)
    plot_figures_of_merit({"targets": figures_per_target}, ax=figure.subplots())
    return figure


_DRAW_FUNCTIONS: dict[str, Callable[[Any], Figure]] = {
    "ImagedDifference": draw_image,
    "Mesh": _draw_mesh,
    "Layout": _draw_layout,
    "Measurement": _draw_measurement,
    "ImageSeries": _draw_series,
    "FiguresOfMerit": _draw_figures_of_merit,
    "Skin": lambda skin: _draw_layout(skin.layout),
}
