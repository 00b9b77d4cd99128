"""HTML report of a study: table of its points (skins), and plots of their scores and sensitivity maps."""

from __future__ import annotations

import base64
import contextlib
import io
import math
import platform
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jeit.design.skin.touch_shapes import TouchGrid
from jeit.design.study.batch import study_grid
from jeit.design.study.run import study_progress
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results
from jeit.mesh import Rectangle
from jeit.mesh.geodesic import Geodesics, Triangles, unroll

# Maximum number of sensitivity maps in a report, and of maps side by side.
_MAX_MAPS, _NUM_COLUMNS = 24, 4
# The mesh of an unrolled map is refined until it has this many nodes, so that single nodes cannot be distinguished.
_MIN_MAP_NODES = 3000
# Format of the value of each swept parameter in the title of a map; the layout is given by its name.
_LABELS = {
    "diameter_mm": "⌀ {:g} mm",
    "contact_impedance_ohm_m2": "{:g} Ω m²",
    "thickness_mm": "{:g} mm thick",
    "conductivity_S_per_m": "{:g} S/m",
    "protocol": "{}",
    "pairs": "{} pairs",
    "noise_V": "noise {:g} V",
    "cell_mm": "cells {:g} mm",
}
# Titles of scores whose titles differ from their names in the store of results.
_TITLES = {"mean": "mean sensitivity", "minimum": "least sensitivity"}
# Ticks of a logarithmic scale, as multiples of powers of ten, and the format of the tick labels.
_TICKS, _PLAIN_NUMBER = (1.0, 2.0, 5.0), "{x:g}"


def draw_scatter(data):
    """Plot the mean against the minimum sensitivity of every point of a study, with a colour for each layout."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    min_sensitivities, mean_sensitivities = data.sensitivity.min("place"), data.sensitivity.mean("place")
    for layout in dict.fromkeys(data.layout.values.tolist()):
        has_layout = data.layout.values == layout
        axes.plot(
            1e3 * min_sensitivities[has_layout],
            1e3 * mean_sensitivities[has_layout],
            "o",
            label=_escape_for_matplotlib(layout),
            alpha=0.8,
        )
    axes.set(xlabel="Least sensitivity (mV)", ylabel="Mean sensitivity (mV)", xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=_TICKS))
        axis.set_major_formatter(_PLAIN_NUMBER)
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def stored_score_names(data) -> list[str]:
    """Names of the scores in the results of a study, that is of the arrays with one value for each point."""
    return [name for name in data.data_vars if data[name].dims == ("point",)]


def values_and_unit(data, name: str) -> tuple[np.ndarray, str]:
    """Values of the score `name` for every point of a study, and their unit. Volts are converted to millivolts."""
    values, unit = data[name].values, data[name].attrs.get("units", "1")
    return (1e3 * values, "mV") if unit == "V" else (values, unit)


def draw_scores(data):
    """Plot every score of a study against the number of the point, with a colour for each layout. Infinite scores are
    drawn as triangles at the top."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    names = stored_score_names(data)
    columns = min(_NUM_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.8 * columns + 1.8, 2.2 * rows + 0.3), layout="constrained")
    axes_of_scores = figure.subplots(rows, columns, squeeze=False).ravel()
    point_numbers = np.arange(data.sizes["point"])
    for axes, name in zip(axes_of_scores, names, strict=False):
        values, unit = values_and_unit(data, name)
        for layout_index, layout in enumerate(dict.fromkeys(data.layout.values.tolist())):
            has_layout = data.layout.values == layout
            is_finite, is_infinite = has_layout & np.isfinite(values), has_layout & np.isinf(values)
            axes.plot(
                point_numbers[is_finite],
                values[is_finite],
                "o",
                ms=4,
                color=f"C{layout_index}",
                label=_escape_for_matplotlib(layout),
            )
            vertical_positions = np.ones(is_infinite.sum())
            axes.plot(
                point_numbers[is_infinite],
                vertical_positions,
                "^",
                ms=5,
                color=f"C{layout_index}",
                transform=axes.get_xaxis_transform(),
            )
        axes.set_title(_TITLES.get(name, name.replace("_", " ")) + ("" if unit == "1" else f" ({unit})"), fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    for axes in axes_of_scores[len(names) :]:
        axes.set_axis_off()
    figure.supxlabel("Point", fontsize=9)
    handles, labels = axes_of_scores[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=8)
    return figure


def map_points(data) -> np.ndarray:
    """Indices of the finished points whose sensitivity maps are drawn in the report: all finished points, or 24 evenly
    spaced points if there are more."""
    finished_points = np.flatnonzero(data.finished.values)
    selected_positions = (
        np.linspace(0, len(finished_points) - 1, min(len(finished_points), _MAX_MAPS)).round().astype(int)
    )
    return finished_points[selected_positions]


def draw_maps(study: Study, data):
    """Plot the sensitivity maps of the points chosen by `map_points`, all with the same colour scale, and their
    electrodes."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    grid = study_grid(study)
    point_indices = map_points(data)
    titles = point_titles(study)
    values = 1e3 * data.sensitivity.values[point_indices]
    positive_values = values[values > 0]
    scale = LogNorm(positive_values.min(), positive_values.max())
    columns = min(_NUM_COLUMNS, len(point_indices))
    rows = -(-len(point_indices) // columns)
    height = 2.4 + 0.15 * max(title.count("\n") for title in titles)
    figure = Figure(figsize=(max(2.6 * columns, 4.0) + 0.8, height * rows + 0.3), layout="constrained")
    axes_of_maps = figure.subplots(rows, columns, squeeze=False).ravel()
    map_drawing = (
        _UnrolledMaps(study.outline, grid) if isinstance(study.outline, Triangles) else _FlatMaps(study.outline, grid)
    )
    image = None
    for axes, point_index, map_values in zip(axes_of_maps, point_indices, values, strict=False):
        layout = study.points[point_index].layout
        image = map_drawing.draw_values(axes, map_values, norm=scale, cmap="magma")
        diameter = 1e3 * np.asarray(layout.diameters)
        circles = EllipseCollection(
            diameter,
            diameter,
            np.zeros_like(diameter),
            units="xy",
            offsets=1e3 * map_drawing.to_plane(layout.centres),
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors="c",
        )
        axes.add_collection(circles)
        axes.set_title(titles[point_index], fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in axes_of_maps[len(point_indices) :]:
        axes.set_axis_off()
    assert image is not None
    figure.colorbar(
        image,
        ax=axes_of_maps.tolist(),
        label="Sensitivity (mV)",
        ticks=LogLocator(subs=_TICKS),
        format=_PLAIN_NUMBER,
        shrink=min(1.0, 1.5 / rows),
    )
    return figure


class _FlatMaps:
    """Drawing of sensitivity maps of flat skins, in millimetres."""

    def __init__(self, outline: Rectangle, grid: TouchGrid):
        self.extent, self.grid = tuple(1e3 * length for length in outline.extent), grid

    def draw_values(self, axes, values, **style):
        return axes.imshow(self.grid.raster(values), origin="lower", extent=self.extent, **style)

    def to_plane(self, centres) -> np.ndarray:
        return np.asarray(centres)


class _UnrolledMaps:
    """Drawing of sensitivity maps of curved skins, unrolled, in millimetres. Every node has the value of the touched
    position that is nearest along the surface."""

    def __init__(self, outline: Triangles, grid: TouchGrid):
        refined_surface = outline
        while len(refined_surface.points) < _MIN_MAP_NODES:
            refined_surface = refined_surface.finer()
        self.unrolled_surface = unroll(refined_surface)
        self.nearest_places = Geodesics.create(refined_surface).owners(grid.places)[0][self.unrolled_surface.nodes]

    def draw_values(self, axes, values, **style):
        axes.set_aspect("equal")
        x, y = 1e3 * self.unrolled_surface.points.T
        return axes.tripcolor(
            x, y, self.unrolled_surface.cells, np.asarray(values)[self.nearest_places], shading="gouraud", **style
        )

    def to_plane(self, centres) -> np.ndarray:
        return self.unrolled_surface.flat(np.asarray(centres))


def point_titles(study: Study) -> list[str]:
    """Title of every point of a study: its number and layout, followed by the other parameters that differ between
    points, two per line."""
    coordinates = [point.coordinates for point in study.points]
    varying_parameters = [name for name in _LABELS if len({values[name] for values in coordinates}) > 1]
    titles = []
    for point_index, values in enumerate(coordinates):
        labels = [_parameter_text(name, values[name]) for name in varying_parameters]
        label_lines = [", ".join(labels[start : start + 2]) for start in range(0, len(labels), 2)]
        titles.append("\n".join([f"{point_index}: {_escape_for_matplotlib(str(values['layout']))}", *label_lines]))
    return titles


def _parameter_text(name: str, value) -> str:
    return "all pairs" if name == "pairs" and not value else _LABELS[name].format(value)


def _escape_for_matplotlib(text: str) -> str:
    """Escape a text so that matplotlib shows the text unchanged: dollar signs do not start a formula, and a leading
    underscore does not hide a label."""
    return " " * text.startswith("_") + text.replace("$", r"\$")


_PACKAGES = ("jeit", "jax", "numpy", "zarr", "xarray", "matplotlib")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 13px } th, td { padding: .2em .7em; text-align: right }
th { border-bottom: 1px solid #888 } tr:nth-child(even) { background: #f4f4f4 } td.text, th.text { text-align: left }
img { max-width: 100% } pre { background: #f4f4f4; padding: 1em; overflow-x: auto } div.wide { overflow-x: auto }
"""


def write_study_report(study: Study, store: str | Path, path: str | Path) -> None:
    """Write the finished results of a study as one HTML file. An existing file is replaced as a whole.

    The page shows the sensitivity maps of up to 24 finished points with the same colour scale, a plot of mean against
    minimum sensitivity, parameters and scores of every point, the study file with its fingerprint, and the versions of
    packages.

    **Arguments:**

    - `study`: the study.
    - `store`: path of the Zarr store with its results.
    - `path`: path of the HTML file.

    Raises `ValueError` if no chunk of the study is finished, `OSError` if the page cannot be written, and in the cases
    of `open_results`.

    **Example:**

    ```python
    run_study(study, "study.zarr")  # with zarr
    write_study_report(study, "study.zarr", "study.html")
    ```
    """
    data = open_results(study, store)
    if not data.finished.values.any():
        raise ValueError(f"{store}: no chunk of the study is finished, so there is nothing to report; resume it.")
    progress = study_progress(study, store)
    store_versions, current_versions = (
        Store(study, store, create=False).versions,
        {name: metadata.version(name) for name in _PACKAGES},
    )
    html_parts = [
        f"<h1>{escape(study.name)}</h1>",
        f"<p>{progress.points} of {progress.all_points} points finished, in {progress.chunks} of {progress.all_chunks} "
        f"chunks. Sensitivity: ‖Δv‖₂ of all channels to one touch, {'exact' if study.exact else 'linearised'}, on "
        f"{'a layer' if study.points[0].layers else 'a sheet'}.</p>",
        *(
            [_figure_html(draw_scatter(data), "Mean and least sensitivity of every point")]
            if len(study.points) > 1
            else []
        ),
        *(
            [_figure_html(draw_scores(data), "Scores of every point; triangles are infinite")]
            if stored_score_names(data)
            else []
        ),
        _figure_html(
            draw_maps(study, data),
            f"Sensitivity maps of {len(map_points(data))} points, electrodes as circles, axes in millimetres"
            f"{', of the skin unrolled' if study.surface else ''}",
        ),
        "<h2>Points</h2>",
        _points_table(study, data),
        "<h2>Configuration</h2>",
        f"<pre>{escape(study.text)}</pre>",
        f"<p>Fingerprint {study.fingerprint}</p>",
        "<h2>Versions</h2>",
        f"<p>Computed with {_versions_text(store_versions)}.</p>",
        f"<p>Reported with {_versions_text(current_versions)}, Python {platform.python_version()}, "
        f"{escape(platform.platform())}.</p>",
    ]
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(study.name)}</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(html_parts) + "\n</body></html>\n"
    )
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(page, "utf-8")
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"the report cannot be written ({error.strerror})", str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _figure_html(figure: Any, caption: str) -> str:
    image_file = io.BytesIO()
    figure.savefig(image_file, format="png", dpi=110)
    base64_image = base64.b64encode(image_file.getvalue()).decode()
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{base64_image}">' + (
        f"<figcaption>{escape(caption)}.</figcaption></figure>"
    )


def _points_table(study: Study, data) -> str:
    """HTML table with a row for every point of a study: the swept parameters, then the scores."""
    columns: dict[str, list] = {"point": list(range(len(study.points)))}
    columns |= {name: data[name].values.tolist() for name in study.points[0].coordinates}
    for name in stored_score_names(data):
        values, unit = values_and_unit(data, name)
        columns[name if unit == "1" else f"{name} / {unit}"] = values.tolist()
    # Titles are aligned as the texts or numbers below them.
    titles = (
        f'<th class="text">{escape(title)}</th>' if isinstance(values[0], str) else f"<th>{escape(title)}</th>"
        for title, values in columns.items()
    )
    rows = zip(*columns.values(), strict=True)
    row_texts = ["".join(titles), *("".join(map(_cell_text, row)) for row in rows)]
    return '<div class="wide"><table>' + "\n".join(f"<tr>{row_text}</tr>" for row_text in row_texts) + "</table></div>"


def _cell_text(value) -> str:
    if isinstance(value, str):
        return f'<td class="text">{escape(value)}</td>'
    if math.isinf(value):
        return "<td>∞</td>"
    return f"<td>{'–' if math.isnan(value) else f'{value:.4g}'}</td>"


def _versions_text(versions: dict[str, str]) -> str:
    return ", ".join(f"{escape(name)} {escape(version)}" for name, version in versions.items())
