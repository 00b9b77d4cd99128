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
_MAX_MAPS, _MAX_PLOT_COLUMNS = 24, 4
# The mesh of an unrolled map is refined until it has this many nodes, so that single nodes cannot be distinguished.
_MIN_MAP_NODES = 3000
# Format of the value of each swept parameter in the title of a map; the layout is given by its name.
_PARAMETER_FORMATS = {
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
_SCORE_TITLES = {"mean": "mean sensitivity", "minimum": "least sensitivity"}
# Ticks of a logarithmic scale, as multiples of powers of ten, and the format of the tick labels.
_LOG_TICK_MULTIPLES, _PLAIN_NUMBER_FORMAT = (1.0, 2.0, 5.0), "{x:g}"


def draw_scatter(data):
    """Plot the mean against the minimum sensitivity of every point of a study, with a colour for each layout."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    min_sensitivities, mean_sensitivities = data.sensitivity.min("place"), data.sensitivity.mean("place")
    for layout_name in dict.fromkeys(data.layout.values.tolist()):
        is_point_of_layout = data.layout.values == layout_name
        axes.plot(
            1e3 * min_sensitivities[is_point_of_layout],
            1e3 * mean_sensitivities[is_point_of_layout],
            "o",
            label=_escape_for_matplotlib(layout_name),
            alpha=0.8,
        )
    axes.set(xlabel="Least sensitivity (mV)", ylabel="Mean sensitivity (mV)", xscale="log", yscale="log")
    for plot_axis in (axes.xaxis, axes.yaxis):
        plot_axis.set_major_locator(LogLocator(subs=_LOG_TICK_MULTIPLES))
        plot_axis.set_major_formatter(_PLAIN_NUMBER_FORMAT)
        plot_axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def stored_score_names(data) -> list[str]:
    """Names of the scores in the results of a study, that is of the arrays with one value for each point."""
    return [score_name for score_name in data.data_vars if data[score_name].dims == ("point",)]


def values_and_unit(data, name: str) -> tuple[np.ndarray, str]:
    """Values of the score `name` for every point of a study, and their unit. Volts are converted to millivolts."""
    score_values, score_unit = data[name].values, data[name].attrs.get("units", "1")
    return (1e3 * score_values, "mV") if score_unit == "V" else (score_values, score_unit)


def draw_scores(data):
    """Plot every score of a study against the number of the point, with a colour for each layout. Infinite scores are
    drawn as triangles at the top."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    score_names = stored_score_names(data)
    num_columns = min(_MAX_PLOT_COLUMNS, len(score_names))
    num_rows = -(-len(score_names) // num_columns)
    figure = Figure(figsize=(2.8 * num_columns + 1.8, 2.2 * num_rows + 0.3), layout="constrained")
    axes_of_scores = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    point_numbers = np.arange(data.sizes["point"])
    for axes, score_name in zip(axes_of_scores, score_names, strict=False):
        score_values, score_unit = values_and_unit(data, score_name)
        for layout_index, layout_name in enumerate(dict.fromkeys(data.layout.values.tolist())):
            is_point_of_layout = data.layout.values == layout_name
            is_finite_score, is_infinite_score = (
                is_point_of_layout & np.isfinite(score_values),
                is_point_of_layout & np.isinf(score_values),
            )
            axes.plot(
                point_numbers[is_finite_score],
                score_values[is_finite_score],
                "o",
                ms=4,
                color=f"C{layout_index}",
                label=_escape_for_matplotlib(layout_name),
            )
            marker_heights = np.ones(is_infinite_score.sum())
            axes.plot(
                point_numbers[is_infinite_score],
                marker_heights,
                "^",
                ms=5,
                color=f"C{layout_index}",
                transform=axes.get_xaxis_transform(),
            )
        axes.set_title(
            _SCORE_TITLES.get(score_name, score_name.replace("_", " "))
            + ("" if score_unit == "1" else f" ({score_unit})"),
            fontsize=9,
        )
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    for axes in axes_of_scores[len(score_names) :]:
        axes.set_axis_off()
    figure.supxlabel("Point", fontsize=9)
    legend_handles, legend_labels = axes_of_scores[0].get_legend_handles_labels()
    figure.legend(legend_handles, legend_labels, loc="outside right upper", frameon=False, fontsize=8)
    return figure


def map_points(data) -> np.ndarray:
    """Indices of the finished points whose sensitivity maps are drawn in the report: all finished points, or 24 evenly
    spaced points if there are more."""
    finished_points = np.flatnonzero(data.finished.values)
    selected_indices = (
        np.linspace(0, len(finished_points) - 1, min(len(finished_points), _MAX_MAPS)).round().astype(int)
    )
    return finished_points[selected_indices]


def draw_maps(study: Study, data):
    """Plot the sensitivity maps of the points chosen by `map_points`, all with the same colour scale, and their
    electrodes."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    touched_grid = study_grid(study)
    point_indices = map_points(data)
    map_titles = point_titles(study)
    sensitivities_mV = 1e3 * data.sensitivity.values[point_indices]
    positive_sensitivities = sensitivities_mV[sensitivities_mV > 0]
    colour_normalisation = LogNorm(positive_sensitivities.min(), positive_sensitivities.max())
    num_columns = min(_MAX_PLOT_COLUMNS, len(point_indices))
    num_rows = -(-len(point_indices) // num_columns)
    row_height = 2.4 + 0.15 * max(map_title.count("\n") for map_title in map_titles)
    figure = Figure(figsize=(max(2.6 * num_columns, 4.0) + 0.8, row_height * num_rows + 0.3), layout="constrained")
    axes_of_maps = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    map_drawing = (
        _UnrolledMaps(study.outline, touched_grid)
        if isinstance(study.outline, Triangles)
        else _FlatMaps(study.outline, touched_grid)
    )
    map_image = None
    for axes, point_index, sensitivity_values in zip(axes_of_maps, point_indices, sensitivities_mV, strict=False):
        point_layout = study.points[point_index].layout
        map_image = map_drawing.draw_map_values(axes, sensitivity_values, norm=colour_normalisation, cmap="magma")
        diameters_mm = 1e3 * np.asarray(point_layout.diameters)
        electrode_circles = EllipseCollection(
            diameters_mm,
            diameters_mm,
            np.zeros_like(diameters_mm),
            units="xy",
            offsets=1e3 * map_drawing.to_plane(point_layout.centres),
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors="c",
        )
        axes.add_collection(electrode_circles)
        axes.set_title(map_titles[point_index], fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in axes_of_maps[len(point_indices) :]:
        axes.set_axis_off()
    assert map_image is not None
    figure.colorbar(
        map_image,
        ax=axes_of_maps.tolist(),
        label="Sensitivity (mV)",
        ticks=LogLocator(subs=_LOG_TICK_MULTIPLES),
        format=_PLAIN_NUMBER_FORMAT,
        shrink=min(1.0, 1.5 / num_rows),
    )
    return figure


class _FlatMaps:
    """Drawing of sensitivity maps of flat skins, in millimetres."""

    def __init__(self, outline: Rectangle, grid: TouchGrid):
        self.extent, self.grid = tuple(1e3 * coordinate for coordinate in outline.extent), grid

    def draw_map_values(self, axes, sensitivity_values, **style):
        return axes.imshow(self.grid.raster(sensitivity_values), origin="lower", extent=self.extent, **style)

    def to_plane(self, electrode_centres) -> np.ndarray:
        return np.asarray(electrode_centres)


class _UnrolledMaps:
    """Drawing of sensitivity maps of curved skins, unrolled, in millimetres. Every node has the value of the touched
    position that is nearest along the surface."""

    def __init__(self, outline: Triangles, grid: TouchGrid):
        refined_surface = outline
        while len(refined_surface.points) < _MIN_MAP_NODES:
            refined_surface = refined_surface.finer()
        self.unrolled_surface = unroll(refined_surface)
        self.nearest_places = Geodesics.create(refined_surface).owners(grid.places)[0][self.unrolled_surface.nodes]

    def draw_map_values(self, axes, sensitivity_values, **style):
        axes.set_aspect("equal")
        x, y = 1e3 * self.unrolled_surface.points.T
        return axes.tripcolor(
            x,
            y,
            self.unrolled_surface.cells,
            np.asarray(sensitivity_values)[self.nearest_places],
            shading="gouraud",
            **style,
        )

    def to_plane(self, electrode_centres) -> np.ndarray:
        return self.unrolled_surface.flat(np.asarray(electrode_centres))


def point_titles(study: Study) -> list[str]:
    """Title of every point of a study: its number and layout, followed by the other parameters that differ between
    points, two per line."""
    parameters_of_points = [point.coordinates for point in study.points]
    varying_parameters = [
        parameter_name
        for parameter_name in _PARAMETER_FORMATS
        if len({parameter_values[parameter_name] for parameter_values in parameters_of_points}) > 1
    ]
    title_texts = []
    for point_index, parameter_values in enumerate(parameters_of_points):
        parameter_texts = [
            _parameter_text(parameter_name, parameter_values[parameter_name]) for parameter_name in varying_parameters
        ]
        label_lines = [
            ", ".join(parameter_texts[first_text : first_text + 2]) for first_text in range(0, len(parameter_texts), 2)
        ]
        title_texts.append(
            "\n".join([f"{point_index}: {_escape_for_matplotlib(str(parameter_values['layout']))}", *label_lines])
        )
    return title_texts


def _parameter_text(parameter_name: str, parameter_value) -> str:
    return (
        "all pairs"
        if parameter_name == "pairs" and not parameter_value
        else _PARAMETER_FORMATS[parameter_name].format(parameter_value)
    )


def _escape_for_matplotlib(plain_text: str) -> str:
    """Escape a text so that matplotlib shows the text unchanged: dollar signs do not start a formula, and a leading
    underscore does not hide a label."""
    return " " * plain_text.startswith("_") + plain_text.replace("$", r"\$")


_REPORTED_PACKAGES = ("jeit", "jax", "numpy", "zarr", "xarray", "matplotlib")
_PAGE_STYLES = """
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
    study_results = open_results(study, store)
    if not study_results.finished.values.any():
        raise ValueError(f"{store}: no chunk of the study is finished, so there is nothing to report; resume it.")
    progress = study_progress(study, store)
    store_versions, current_versions = (
        Store(study, store, create=False).versions,
        {package_name: metadata.version(package_name) for package_name in _REPORTED_PACKAGES},
    )
    html_parts = [
        f"<h1>{escape(study.name)}</h1>",
        f"<p>{progress.points} of {progress.all_points} points finished, in {progress.chunks} of {progress.all_chunks} "
        f"chunks. Sensitivity: ‖Δv‖₂ of all channels to one touch, {'exact' if study.exact else 'linearised'}, on "
        f"{'a layer' if study.points[0].layers else 'a sheet'}.</p>",
        *(
            [_figure_html(draw_scatter(study_results), "Mean and least sensitivity of every point")]
            if len(study.points) > 1
            else []
        ),
        *(
            [_figure_html(draw_scores(study_results), "Scores of every point; triangles are infinite")]
            if stored_score_names(study_results)
            else []
        ),
        _figure_html(
            draw_maps(study, study_results),
            f"Sensitivity maps of {len(map_points(study_results))} points, electrodes as circles, axes in millimetres"
            f"{', of the skin unrolled' if study.surface else ''}",
        ),
        "<h2>Points</h2>",
        _points_table(study, study_results),
        "<h2>Configuration</h2>",
        f"<pre>{escape(study.text)}</pre>",
        f"<p>Fingerprint {study.fingerprint}</p>",
        "<h2>Versions</h2>",
        f"<p>Computed with {_versions_text(store_versions)}.</p>",
        f"<p>Reported with {_versions_text(current_versions)}, Python {platform.python_version()}, "
        f"{escape(platform.platform())}.</p>",
    ]
    html_page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(study.name)}</title>'
        f"<style>{_PAGE_STYLES}</style></head>\n<body>\n" + "\n".join(html_parts) + "\n</body></html>\n"
    )
    path = Path(path)
    temporary_path = path.with_name(f".{path.name}.tmp")
    try:
        temporary_path.write_text(html_page, "utf-8")
        temporary_path.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"the report cannot be written ({error.strerror})", str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary_path.unlink()


def _figure_html(figure: Any, caption: str) -> str:
    image_file = io.BytesIO()
    figure.savefig(image_file, format="png", dpi=110)
    base64_image = base64.b64encode(image_file.getvalue()).decode()
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{base64_image}">' + (
        f"<figcaption>{escape(caption)}.</figcaption></figure>"
    )


def _points_table(study: Study, study_results) -> str:
    """HTML table with a row for every point of a study: the swept parameters, then the scores."""
    table_columns: dict[str, list] = {"point": list(range(len(study.points)))}
    table_columns |= {
        column_name: study_results[column_name].values.tolist() for column_name in study.points[0].coordinates
    }
    for column_name in stored_score_names(study_results):
        column_values, score_unit = values_and_unit(study_results, column_name)
        table_columns[column_name if score_unit == "1" else f"{column_name} / {score_unit}"] = column_values.tolist()
    # Titles are aligned as the texts or numbers below them.
    header_cells = (
        f'<th class="text">{escape(column_title)}</th>'
        if isinstance(column_values[0], str)
        else f"<th>{escape(column_title)}</th>"
        for column_title, column_values in table_columns.items()
    )
    table_rows = zip(*table_columns.values(), strict=True)
    row_texts = ["".join(header_cells), *("".join(map(_cell_text, table_row)) for table_row in table_rows)]
    return '<div class="wide"><table>' + "\n".join(f"<tr>{row_text}</tr>" for row_text in row_texts) + "</table></div>"


def _cell_text(cell_value) -> str:
    if isinstance(cell_value, str):
        return f'<td class="text">{escape(cell_value)}</td>'
    if math.isinf(cell_value):
        return "<td>∞</td>"
    return f"<td>{'–' if math.isnan(cell_value) else f'{cell_value:.4g}'}</td>"


def _versions_text(package_versions: dict[str, str]) -> str:
    return ", ".join(
        f"{escape(package_name)} {escape(package_version)}"
        for package_name, package_version in package_versions.items()
    )
