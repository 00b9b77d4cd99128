"""Plots of a study's results, for its report."""

from __future__ import annotations

import numpy as np

from jeit.design.skin.touch_grid import TouchGrid
from jeit.design.study.batch import study_grid
from jeit.design.study.spec import Study
from jeit.mesh import Rectangle
from jeit.mesh.geodesic import Geodesics, Triangles, unroll

# Most maps in a report.
_MAPS, _COLUMNS = 24, 4
# Number of nodes of an unrolled map above which they are not distinguishable.
_NODES = 3000
# Text of swept values above a map; the electrodes are given by the layout's name.
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
# Titles of scores whose name in the store needs another word.
_TITLES = {"mean": "mean sensitivity", "minimum": "least sensitivity"}
# Ticks of a logarithmic scale, times powers of ten, and their format.
_TICKS, _PLAIN_NUMBER = (1.0, 2.0, 5.0), "{x:g}"


def draw_scatter(data):
    """Plot mean against least sensitivity, with a colour for each layout."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    least, mean = data.sensitivity.min("place"), data.sensitivity.mean("place")
    for layout in dict.fromkeys(data.layout.values.tolist()):
        these = data.layout.values == layout
        axes.plot(1e3 * least[these], 1e3 * mean[these], "o", label=_plain(layout), alpha=0.8)
    axes.set(xlabel="Least sensitivity (mV)", ylabel="Mean sensitivity (mV)", xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=_TICKS))
        axis.set_major_formatter(_PLAIN_NUMBER)
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def scores_of(data) -> list[str]:
    """Names of the scores, the arrays with one value for each point."""
    return [name for name in data.data_vars if data[name].dims == ("point",)]


def values_and_unit(data, name: str) -> tuple[np.ndarray, str]:
    """Values of a score at every point, and their unit: as in the store, but millivolts for volts."""
    values, unit = data[name].values, data[name].attrs.get("units", "1")
    return (1e3 * values, "mV") if unit == "V" else (values, unit)


def draw_scores(data):
    """Plot every score, point by point, with a colour for each layout."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    names = scores_of(data)
    columns = min(_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.8 * columns + 1.8, 2.2 * rows + 0.3), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    point = np.arange(data.sizes["point"])
    for axes, name in zip(panels, names, strict=False):
        values, unit = values_and_unit(data, name)
        for number, layout in enumerate(dict.fromkeys(data.layout.values.tolist())):
            these = data.layout.values == layout
            finite, infinite = these & np.isfinite(values), these & np.isinf(values)
            axes.plot(point[finite], values[finite], "o", ms=4, color=f"C{number}", label=_plain(layout))
            top = np.ones(infinite.sum())
            axes.plot(point[infinite], top, "^", ms=5, color=f"C{number}", transform=axes.get_xaxis_transform())
        axes.set_title(_TITLES.get(name, name.replace("_", " ")) + ("" if unit == "1" else f" ({unit})"), fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    figure.supxlabel("Point", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=8)
    return figure


def shown(data) -> np.ndarray:
    """Indices of the finished points whose maps are drawn: all, or the largest number allowed, evenly spaced."""
    finished = np.flatnonzero(data.finished.values)
    chosen = np.linspace(0, len(finished) - 1, min(len(finished), _MAPS)).round().astype(int)
    return finished[chosen]


def draw_maps(study: Study, data):
    """Plot the sensitivity maps of the points in `shown`, on one scale, with their electrodes."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    grid = study_grid(study)
    numbers = shown(data)
    titles = titles_of(study)
    values = 1e3 * data.sensitivity.values[numbers]
    positive = values[values > 0]
    scale = LogNorm(positive.min(), positive.max())
    columns = min(_COLUMNS, len(numbers))
    rows = -(-len(numbers) // columns)
    height = 2.4 + 0.15 * max(title.count("\n") for title in titles)
    figure = Figure(figsize=(max(2.6 * columns, 4.0) + 0.8, height * rows + 0.3), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    view = _Unrolled(study.outline, grid) if isinstance(study.outline, Triangles) else _Flat(study.outline, grid)
    image = None
    for axes, number, map_values in zip(panels, numbers, values, strict=False):
        layout = study.points[number].layout
        image = view.draw(axes, map_values, norm=scale, cmap="magma")
        diameter = 1e3 * np.asarray(layout.diameters)
        circles = EllipseCollection(
            diameter,
            diameter,
            np.zeros_like(diameter),
            units="xy",
            offsets=1e3 * view.places(layout.centres),
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors="c",
        )
        axes.add_collection(circles)
        axes.set_title(titles[number], fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in panels[len(numbers) :]:
        axes.set_axis_off()
    assert image is not None
    figure.colorbar(
        image,
        ax=panels.tolist(),
        label="Sensitivity (mV)",
        ticks=LogLocator(subs=_TICKS),
        format=_PLAIN_NUMBER,
        shrink=min(1.0, 1.5 / rows),
    )
    return figure


class _Flat:
    """Maps of flat skins, in millimetres."""

    def __init__(self, outline: Rectangle, grid: TouchGrid):
        self.extent, self.grid = tuple(1e3 * length for length in outline.extent), grid

    def draw(self, axes, values, **style):
        return axes.imshow(self.grid.raster(values), origin="lower", extent=self.extent, **style)

    def places(self, centres) -> np.ndarray:
        return np.asarray(centres)


class _Unrolled:
    """Maps of curved skins, unrolled, in millimetres; every position has the value of the nearest touch along the
    surface."""

    def __init__(self, outline: Triangles, grid: TouchGrid):
        fine = outline
        while len(fine.points) < _NODES:
            fine = fine.finer()
        self.flat = unroll(fine)
        self.owners = Geodesics.create(fine).owners(grid.places)[0][self.flat.nodes]

    def draw(self, axes, values, **style):
        axes.set_aspect("equal")
        x, y = 1e3 * self.flat.points.T
        return axes.tripcolor(x, y, self.flat.cells, np.asarray(values)[self.owners], shading="gouraud", **style)

    def places(self, centres) -> np.ndarray:
        return self.flat.flat(np.asarray(centres))


def titles_of(study: Study) -> list[str]:
    """Title of every point: number and layout, and below them the other values that differ between points, two per
    line."""
    coordinates = [point.coordinates for point in study.points]
    varying = [name for name in _LABELS if len({values[name] for values in coordinates}) > 1]
    titles = []
    for number, values in enumerate(coordinates):
        labels = [_label(name, values[name]) for name in varying]
        lines = [", ".join(labels[start : start + 2]) for start in range(0, len(labels), 2)]
        titles.append("\n".join([f"{number}: {_plain(str(values['layout']))}", *lines]))
    return titles


def _label(name: str, value) -> str:
    return "all pairs" if name == "pairs" and not value else _LABELS[name].format(value)


def _plain(text: str) -> str:
    """Text that matplotlib shows unchanged: formulas are escaped, and labels that begin with an underscore are kept."""
    return " " * text.startswith("_") + text.replace("$", r"\$")
