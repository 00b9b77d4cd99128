"""The paper's two electrode layouts on a layer with touches all over it, for the case `design_figures`.

Text S4 and Figs. S11 and S12 of Park et al., Science Robotics 7, eabm7187 (2022).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.harness.case import Table
from benchmarks.harness.timing import say

if TYPE_CHECKING:
    from jaxtyping import Array

    from jeit.design.comparison import SkinResponse
    from jeit.design.skin.touch_shapes import AbstractIndentation

LAYOUTS = ("park-inner", "park-boundary")
MARGIN, PAIRS, THICKNESS = 10e-3, 94, 10e-3


class Setting(NamedTuple):
    """Settings of the study: number of touches along a side, number of clusters (taxels), margins to the edge in
    metres, mesh of the comparison (cell size in metres, layers of cells), mesh of the study of thickness (cell size;
    thickness in metres and layers of cells), meshes with finer layers for a check, and shapes of touches.
    """

    places: int = 48
    taxels: int = 90
    margins: tuple[float, ...] = (0.0, 5e-3, 10e-3, 15e-3)
    mesh: tuple[float, int] = (4.5e-3, 5)
    study_cell: float = 7e-3
    # All cells are 1.25 mm high.
    study: tuple[tuple[float, int], ...] = ((5e-3, 4), (7.5e-3, 6), (10e-3, 8), (15e-3, 12), (20e-3, 16))
    check: tuple[tuple[float, int], ...] = ((10e-3, 16),)
    shapes: tuple[str, ...] = ("bell", "hemisphere")


QUICK = Setting(12, 12, (10e-3,), (9e-3, 3), 9e-3, ((10e-3, 3),), (), ("bell",))


def changes(
    name: str,
    places: int,
    mesh: tuple[float, int],
    thickness: float = THICKNESS,
    indentation: AbstractIndentation | None = None,
    contrast: float = 0.0,
) -> Array:
    """Changes (touches, 496) of the voltages of all electrode pairs at 1 mA, due to touches all over a skin of 1
    S/m."""
    from jeit.design import sensitivity_map, touch_grid
    from jeit.electrodes import FaceDiscs
    from jeit.forward import ForwardModel
    from jeit.layout import named_layout
    from jeit.mesh import Rectangle, layer, rectangle
    from jeit.protocol import two_terminal

    layout, (cell_size, num_layers) = named_layout(name), mesh
    solid = layer(rectangle(0.2, 0.2, cell_size=cell_size), thickness, num_layers)
    bottom = np.column_stack([layout.centres, np.zeros(32)])
    model = ForwardModel(solid, FaceDiscs(bottom, layout.diameters / 2, 1e-4), two_terminal(32, current=1e-3))
    grid = touch_grid(Rectangle(0.2, 0.2), places, places)
    return sensitivity_map(model, 1.0, grid, indentation=indentation, contrast=contrast).changes


def response_of(
    name: str, setting: Setting, changed: Array, margin: float = MARGIN, pairs: int = PAIRS
) -> SkinResponse:
    """The response of the layout `name` to touches farther than `margin` metres from the edge, measured with the
    `pairs` nearest electrode pairs; `changed` has the changes of all pairs."""
    import jax

    from jeit.design import find_taxels, touches_away_from_the_edge
    from jeit.design.comparison import SkinResponse
    from jeit.design.measurements import nearest_pairs
    from jeit.design.sensitivity import SensitivityMap
    from jeit.layout import named_layout
    from jeit.mesh import Rectangle

    layout = named_layout(name)
    grid = touches_away_from_the_edge(Rectangle(0.2, 0.2), margin, setting.places, setting.places)
    there = grid.rows * setting.places + grid.columns
    channels = np.sort(nearest_pairs(layout.centres, pairs))
    theta = SensitivityMap(grid, changed[there][:, channels])
    key = jax.random.key(0)
    taxels = find_taxels(theta.changes, grid.places, grid.cell_area, num_taxels=setting.taxels, key=key)
    return SkinResponse(layout, theta, taxels)


def area(figures: dict) -> str:
    """Text of the mean ± standard deviation of the taxels' areas, in cm²."""
    return f"{figures['taxel_area_cm2']['mean']:.1f} ± {figures['taxel_area_cm2']['std']:.1f}"


def largest(figures: dict) -> str:
    """Text of the area of the largest taxel, in cm²."""
    return f"{figures['taxel_area_cm2']['max']:.0f}"


def blind(figures: dict) -> str:
    """Text of the fraction of the skin in which touches are not detected (blind spot), in per cent."""
    return f"{100 * figures['blind_spot_fraction']:.1f} %"


def comparison_table(setting: Setting, changed: dict[str, Array]) -> Table:
    """A table of both layouts for several margins, and with all electrode pairs, compared with the paper."""
    from jeit.design.comparison import comparison_figures

    rows = [["Park et al. 2022", "94", "33 %", "", "12.6 ± 1.4", "41", "30.5 ± 27.3", "112"]]
    for margin, pairs in [*((margin, PAIRS) for margin in setting.margins), (MARGIN, 496)]:
        inner, boundary = (response_of(name, setting, changed[name], margin, pairs) for name in LAYOUTS)
        one, other = comparison_figures(inner, boundary)
        percentile = np.percentile(np.asarray(inner.sensitivity.values), 1)
        below = f"{100 * float(boundary.sensitivity.blind_spot(percentile)):.1f} %"
        row = [f"here, {1e3 * margin:g} mm", str(pairs), blind(other), below]
        rows.append([*row, area(one), f"{one['two_point_mm']:.0f}", area(other), largest(other)])
    header = ["touched no nearer to the edge than", "pairs", "blind spot, boundary", "below the 1st percentile"]
    header += ["taxels, inner, cm²", "two-point, inner, mm", "taxels, boundary, cm²", "largest, cm²"]
    return Table(header, rows, "Margins and pairs")


def thickness_table(setting: Setting) -> tuple[Table, dict[float, list[SkinResponse]]]:
    """A table of both layouts on layers of several thicknesses, and the responses by thickness."""
    from jeit.design.comparison import comparison_figures

    rows, studied = [], {}
    for thickness, num_layers in (*setting.study, *setting.check):
        say(f"{1e3 * thickness:g} mm, {num_layers} layers")
        mesh = setting.study_cell, num_layers
        both = [response_of(name, setting, changes(name, setting.places, mesh, thickness)) for name in LAYOUTS]
        studied.setdefault(thickness, both)
        for name, figures in zip(LAYOUTS, comparison_figures(*both), strict=True):
            row = [f"{1e3 * thickness:g}", str(num_layers), name]
            row += [f"{1e3 * figures['sensitivity_min_V']:.3g}", f"{1e3 * figures['sensitivity_mean_V']:.3g}"]
            row += [f"{figures['sensitivity_uniformity']:.2f}", blind(figures), area(figures), largest(figures)]
            rows.append([*row, f"{figures['two_point_mm']:.0f}"])
    header = ["thickness, mm", "layers of cells", "layout", "least Θ, mV", "mean Θ, mV", "uniformity", "blind spot"]
    return Table([*header, "taxels, cm²", "largest, cm²", "two-point, mm"], rows, "Thickness"), studied


def kinds_table(setting: Setting, changed: dict[str, Array]) -> Table:
    """A table of both layouts for bell-shaped and hemispherical touches, which are insulating or conduct ten times as
    well as the skin."""
    from jeit.design import Bell, Hemisphere
    from jeit.design.comparison import comparison_figures

    rows = []
    for shape in setting.shapes:
        indentation = Bell() if shape == "bell" else Hemisphere()
        for kind, contrast in (("insulating", 0.0), ("conductive", 10.0)):
            say(f"{kind} {shape}")
            both = []
            for name in LAYOUTS:
                known = changed[name] if shape == "bell" and not contrast else None
                if known is None:
                    options = {"indentation": indentation, "contrast": contrast}
                    known = changes(name, setting.places, setting.mesh, **options)
                both.append(response_of(name, setting, known))
            one, other = comparison_figures(*both)
            least = [f"{1e3 * figures['sensitivity_min_V']:.3g}" for figures in (one, other)]
            row = [f"{kind} {shape}", *least, blind(other), blind(one), area(one), f"{one['two_point_mm']:.0f}"]
            rows.append([*row, area(other), largest(other)])
    header = ["touch", "least Θ, inner, mV", "least Θ, boundary, mV", "blind spot, boundary", "blind spot, inner"]
    header += ["taxels, inner, cm²", "two-point, inner, mm", "taxels, boundary, cm²", "largest, cm²"]
    return Table(header, rows, "Kinds of touch")


def draw_thickness(studied: dict[float, list[SkinResponse]], path) -> None:
    """Draw the distributions of sensitivity and of the taxels' areas for each thickness (metres), as in Fig. S12 of the
    paper."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    colours = "#1f6fb4", "#c8102e"
    figure = Figure(figsize=(9.6, 4.0), layout="constrained")
    theta, taxels = figure.subplots(1, 2)
    for shift, colour in enumerate(colours):
        at = np.arange(len(studied)) + 0.4 * (shift - 0.5)
        both = [responses[shift] for responses in studied.values()]
        for ax, values in (
            (theta, [1e3 * np.asarray(one.sensitivity.values) for one in both]),
            (taxels, [1e4 * np.asarray(one.taxels.areas) for one in both]),
        ):
            box = ax.boxplot(values, positions=at, widths=0.32, whis=(0, 100), patch_artist=True, manage_ticks=False)
            for patch in box["boxes"]:
                patch.set(facecolor=colour, alpha=0.55, edgecolor=colour)
            for line in (*box["whiskers"], *box["caps"], *box["medians"]):
                line.set_color(colour)
    theta.set(yscale="log", ylabel="Sensitivity (mV)", title="(a) Sensitivity, over the skin")
    taxels.set(ylabel="Taxel area (cm²)", ylim=(0, None), title="(b) Virtual taxels")
    for ax in (theta, taxels):
        ax.set_xticks(range(len(studied)), [f"{1e3 * thickness:g}" for thickness in studied])
        ax.set_xlabel("Thickness (mm)")
        ax.spines[["top", "right"]].set_visible(False)
    handles = [Patch(color=colour, alpha=0.55) for colour in colours]
    theta.legend(handles, LAYOUTS, frameon=False, loc="upper right")
    figure.savefig(path, dpi=110)
