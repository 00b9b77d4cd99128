"""`jeit layout`: compare layouts of electrodes, and move the electrodes of a layout to increase the sensitivity of the
skin's worst position, before any material is cut."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jeit.cli.options import (
    QuietOption,
    check_at_least,
    check_positive,
    check_within,
    make_folder,
    naming_options_in_errors,
)
from jeit.design import defaults

if TYPE_CHECKING:
    from jeit.design import Skin
    from jeit.design.comparison import LayoutComparison
    from jeit.design.improvement import ImprovedLayout
    from jeit.layout import Layout
    from jeit.mesh import Disk, Domain, Rectangle

layout = typer.Typer(name="layout", help="Compare and optimise layouts of electrodes.")

LayoutArgument = Annotated[
    str,
    typer.Argument(
        help="Layout by name (park-inner, park-boundary, grid-CxR, perimeter-N, inner-N), or a file: CSV in "
        "millimetres, DXF or SVG.",
        show_default=False,
    ),
]
WidthOption = Annotated[
    float, typer.Option("--width-mm", help="Of the skin, centred at 0, if the layout does not say it.")
]
HeightOption = Annotated[
    float, typer.Option("--height-mm", help="Of the skin, centred at 0, if the layout does not say it.")
]
ThicknessOption = Annotated[float, typer.Option("--thickness-mm", help="Of the skin, millimetres.")]
ConductivityOption = Annotated[float, typer.Option("--conductivity", help="Of the skin, siemens per metre.")]
# Range of conductivities in S/m: from below deionised water to above silver.
_MIN_CONDUCTIVITY, _MAX_CONDUCTIVITY = 1e-9, 1e9
_OPTIMISATION_FILES = ("layout.csv", "layout.svg", "travel.png", "report.json")
# Minimum and maximum number of nodes of the mesh used in the optimisation: enough to form cells, and few enough for the
# final mesh, which has four times as many.
_MIN_NODES, _MAX_NODES = 4, 250_000
# Printed quantities: key in the report, name and unit, and factor that converts the reported value to that unit.
_OPTIMISED_QUANTITIES = (
    ("worst_sensitivity_V", "least sensitivity / mV", 1e3),
    ("mean_sensitivity_V", "mean sensitivity / mV", 1e3),
    ("uniformity", "uniformity", 1.0),
    ("mean_variance", "mean variance", 1.0),
    ("log_information_nats", "log information / nats", 1.0),
    ("largest_variance", "largest variance", 1.0),
    ("mean_localisation_error_m", "mean bound of the place / mm", 1e3),
)
_COMPARISON_FILES = ("report.json", "comparison.png")
# Maximum number of touched positions along a side of the skin: 65,536 touches in total.
_MAX_POSITIONS_PER_SIDE = 256
# Option name for each argument name that error messages of the called functions mention.
_OPTION_NAMES = {
    "thickness": "--thickness-mm",
    "cell_size": "--cell-mm",
    "num_pairs": "--pairs",
    "num_taxels": "--taxels",
    "margin": "--margin-mm",
    "outline": "--width-mm and --height-mm",
}
# Printed quantities: name and unit, key in the report, and factor that converts the reported value to that unit.
_COMPARED_QUANTITIES = (
    ("electrodes", "electrodes", 1.0),
    ("measurements", "measurements", 1.0),
    ("least sensitivity / mV", "sensitivity_min_V", 1e3),
    ("mean sensitivity / mV", "sensitivity_mean_V", 1e3),
    ("uniformity", "sensitivity_uniformity", 1.0),
    ("blind spot / % of the area", "blind_spot_fraction", 100.0),
    ("taxels", "taxel_count", 1.0),
    ("taxels over a place", "taxel_overlap", 1.0),
    ("two-point estimate / mm", "two_point_mm", 1.0),
)


@layout.callback(invoke_without_command=True)
def _print_help(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def _read_with_outline(name: str, width: float, height: float) -> "Layout":
    """Read an electrode layout with the outline of its skin; `name`: name of a built-in layout, or path of a file. If
    the layout has no outline, the outline is a rectangle of `width` × `height` (mm).

    Raises `ValueError` for a layout with fewer than three electrodes.
    """
    from jeit.layout import named_layout, read_layout
    from jeit.layout.layout import MAX_SKIN_SIZE, MIN_SKIN_SIZE
    from jeit.mesh import Rectangle

    def outline_from_options() -> Rectangle:
        for option, side in (("--width-mm", width), ("--height-mm", height)):
            check_within(option, side, 1e3 * MIN_SKIN_SIZE, 1e3 * MAX_SKIN_SIZE, "mm")
        return Rectangle(1e-3 * width, 1e-3 * height)

    with naming_options_in_errors({"name": "layout", "path": "layout"}):
        if not Path(name).suffix:
            layout = named_layout(name) if name.startswith("park-") else named_layout(name, outline_from_options())
        else:
            layout = read_layout(name)
            if layout.outline is None:
                layout = read_layout(name, outline=outline_from_options())
    if layout.num_electrodes < 3:
        raise ValueError(f"'{layout.name}' has {layout.num_electrodes} electrodes; give a layout of three or more.")
    return layout


def _check_layer(thickness: float, conductivity: float) -> None:
    """Raise `ValueError` unless --thickness-mm is more than the depth of a touch, and --conductivity is from 1e-9 to
    1e9 S/m."""
    from jeit.design.defaults import DEPTH

    if not 1e3 * DEPTH < thickness < float("inf"):
        raise ValueError(
            f"--thickness-mm must be more than the {1e3 * DEPTH:g} mm that a touch is deep; it is {thickness:g}."
        )
    check_within("--conductivity", conductivity, _MIN_CONDUCTIVITY, _MAX_CONDUCTIVITY, "S/m")


@layout.command()
def optimise(
    layout: LayoutArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"Folder for {', '.join(_OPTIMISATION_FILES)}.", show_default=False)
    ],
    minimum_spacing: Annotated[
        float, typer.Option("--minimum-spacing-mm", help="Of electrodes' centres, millimetres.")
    ] = 1e3 * defaults.MINIMUM_SPACING,
    keep_out: Annotated[
        list[str] | None,
        typer.Option(
            help="Where no electrode may be, millimetres: a disc x,y,radius or a rectangle x1,y1,x2,y2. Give it again "
            "for more."
        ),
    ] = None,
    symmetry: Annotated[
        Literal["mirror-x", "mirror-y", "rotate-2", "rotate-4"] | None,
        typer.Option(help="About the middle of the skin's box.", show_default=False),
    ] = None,
    sizes: Annotated[bool, typer.Option("--sizes", help="Change sizes too, between half and twice.")] = False,
    starts: Annotated[int, typer.Option(help="The layout, and random ones.")] = 1,
    steps: Annotated[int, typer.Option(help="At most.")] = defaults.STEPS,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    thickness: ThicknessOption = 1e3 * defaults.THICKNESS,
    conductivity: ConductivityOption = defaults.CONDUCTIVITY,
    contact_impedance: Annotated[
        float | None, typer.Option(help=f"ohm·m² (the layout's, or {defaults.CONTACT_IMPEDANCE:g}).")
    ] = None,
    noise: Annotated[float, typer.Option(help="Standard deviation of a voltage at 1 mA, volts.")] = defaults.NOISE,
    num_points: Annotated[int, typer.Option(help="Nodes of the mesh to optimise on, about.")] = defaults.NUM_POINTS,
    width: WidthOption = 1e3 * defaults.SIDE,
    height: HeightOption = 1e3 * defaults.SIDE,
    quiet: QuietOption = False,
) -> None:
    """Move the electrodes of LAYOUT to increase the skin's lowest sensitivity and to decrease the mean variance.

    All two-terminal pairs are measured, so the order of electrodes does not matter. The scores of both layouts are
    computed on a finer mesh than that of the optimisation.
    """
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.design import DesignSpace, improve_layout
    from jeit.design.reports import write_improved_layout

    _check_layer(thickness, conductivity)
    check_positive({"--noise": noise})
    if contact_impedance is not None:
        check_positive({"--contact-impedance": contact_impedance})
    check_at_least({"--starts": (starts, 1), "--steps": (steps, 1), "--seed": (seed, 0)})
    if not 0 <= minimum_spacing < float("inf"):
        raise ValueError(f"--minimum-spacing-mm must not be negative; it is {minimum_spacing:g}.")
    check_within("--num-points", num_points, _MIN_NODES, _MAX_NODES)
    start = _read_with_outline(layout, width, height)
    keep_out_domains = [_parse_region(text, start.known_outline) for text in keep_out or ()]
    make_folder(output, _OPTIMISATION_FILES)
    space = DesignSpace(
        minimum_spacing=1e-3 * minimum_spacing, keep_out=keep_out_domains, symmetry=symmetry, sizes=sizes
    )
    search_options = {"noise": noise, "steps": steps, "starts": starts, "seed": seed, "num_points": num_points}
    material = {"thickness": 1e-3 * thickness, "conductivity": conductivity, "contact_impedance": contact_impedance}
    console = plain_console()

    def report_step(step_number: int, values) -> None:
        step.report(f"step {step_number} of at most {steps}, best score {values.max():.3f}")

    with Steps(console, quiet=quiet) as step:
        result = improve_layout(start, space, **search_options, **material, progress=step, callback=report_step)
        step("write")
        write_improved_layout(result, output)
    if not quiet:
        _print_improvement(console, result)
        print_written_files(console, output / _OPTIMISATION_FILES[0], *_OPTIMISATION_FILES[1:])


def _print_improvement(console, result: "ImprovedLayout") -> None:
    from jeit.cli.console import name_value_table
    from jeit.design.reports import report_improved_layout

    report = report_improved_layout(result)
    quantities = [
        (name, factor, report["start"][key], report["optimised"][key]) for key, name, factor in _OPTIMISED_QUANTITIES
    ]
    rows = [
        (name, f"{factor * score_before:.3g} → {factor * score_after:.3g}")
        for name, factor, score_before, score_after in quantities
        if score_before is not None and score_after is not None
    ]
    console.print(name_value_table(result.start.name, rows))
    console.print(f"  {report['status']}: {report['reason']}", soft_wrap=True)
    console.print(
        "  on a sheet that is touched everywhere, with all two-terminal pairs: 'jeit layout compare' computes figures "
        "of a layer\n  the bound of the place is the error that noise alone causes",
        style="dim",
        highlight=False,
        soft_wrap=True,
    )


def _parse_region(text: str, outline: "Domain") -> "Disk | Rectangle":
    """Parse a keep-out region: a disc "x,y,radius" or a rectangle "x1,y1,x2,y2", mm. Raises `ValueError` for other
    text, and for a region off the skin."""
    from jeit.mesh import Disk, Rectangle

    try:
        numbers = [1e-3 * float(number_text) for number_text in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4) or not all(abs(number) < float("inf") for number in numbers):
        raise ValueError(
            f"--keep-out is {text!r}; give a disc x,y,radius or a rectangle x1,y1,x2,y2, millimetres, such as 0,0,15."
        )
    if len(numbers) == 3:
        x, y, radius = numbers
        low_x, high_x, low_y, high_y = x - radius, x + radius, y - radius, y + radius
    else:
        (low_x, high_x), (low_y, high_y) = sorted(numbers[0::2]), sorted(numbers[1::2])
    if not (high_x > low_x and high_y > low_y):
        raise ValueError(f"--keep-out {text} has no size; give a positive radius, or two opposite corners.")
    x_min, x_max, y_min, y_max = outline.extent
    if low_x >= x_max or high_x <= x_min or low_y >= y_max or high_y <= y_min:
        raise ValueError(
            f"--keep-out {text} lies off the skin, which spans {1e3 * x_min:g} to {1e3 * x_max:g} mm by "
            f"{1e3 * y_min:g} to {1e3 * y_max:g} mm."
        )
    centre = ((low_x + high_x) / 2, (low_y + high_y) / 2)
    return Disk(numbers[2], centre) if len(numbers) == 3 else Rectangle(high_x - low_x, high_y - low_y, centre)


@layout.command()
def compare(
    first: LayoutArgument,
    second: LayoutArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for report.json and comparison.png.", show_default=False)
    ],
    thickness: ThicknessOption = 1e3 * defaults.THICKNESS,
    conductivity: ConductivityOption = defaults.CONDUCTIVITY,
    pairs: Annotated[
        int | None,
        typer.Option(
            help="Two-terminal measurements, between nearest electrodes; 0 for all pairs "
            f"(default {defaults.NUM_PAIRS}, or all)."
        ),
    ] = None,
    taxels: Annotated[
        int | None, typer.Option(help=f"Virtual taxels to look for (default {defaults.NUM_TAXELS}, or one a place).")
    ] = None,
    margin: Annotated[
        float, typer.Option("--margin-mm", help="Touch no nearer to the edge, where a touch is partly off the skin.")
    ] = 1e3 * defaults.MARGIN,
    places: Annotated[int, typer.Option(help="Places touched along a side.")] = defaults.NUM_PLACES_PER_SIDE,
    contrast: Annotated[
        float,
        typer.Option(help="Of the touched part's conductivity: 0 for an insulator, above 1 for a conductor."),
    ] = defaults.CONTRAST,
    cell: Annotated[float, typer.Option("--cell-mm", help="Size of the mesh's cells, millimetres.")] = 1e3
    * defaults.CELL_SIZE,
    seed: Annotated[int, typer.Option(help="Of the taxels' k-means.")] = 0,
    width: WidthOption = 1e3 * defaults.SIDE,
    height: HeightOption = 1e3 * defaults.SIDE,
    quiet: QuietOption = False,
) -> None:
    """Touch two layouts all over, and compare them: sensitivity, blind spots, virtual taxels."""
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.design import compare_layouts
    from jeit.design.comparison import check_same_outline
    from jeit.design.reports import write_layout_comparison
    from jeit.design.skin.names import skin_protocol
    from jeit.design.skin.skin import create_skins

    _check_layer(thickness, conductivity)
    check_positive({"--cell-mm": cell})
    check_within("--places", places, 2, _MAX_POSITIONS_PER_SIDE)
    check_at_least({"--pairs": (pairs, 0), "--taxels": (taxels, 1), "--seed": (seed, 0)})
    if not 0 <= margin < float("inf"):
        raise ValueError(f"--margin-mm must not be negative; it is {margin:g}.")
    layouts = [_read_with_outline(name, width, height) for name in (first, second)]
    make_folder(output, _COMPARISON_FILES)
    console = plain_console()
    with naming_options_in_errors(_OPTION_NAMES), Steps(console, quiet=quiet) as step:
        check_same_outline(*layouts)
        step("mesh")
        protocols = [skin_protocol(compared_layout, num_pairs=pairs) for compared_layout in layouts]
        material = {"thickness": 1e-3 * thickness, "conductivity": conductivity}
        skins_to_compare = create_skins(layouts, protocols, **material, cell_size=1e-3 * cell)
        result = compare_layouts(
            skins_to_compare[0],
            skins_to_compare[1],
            margin=1e-3 * margin,
            places=places,
            contrast=contrast,
            num_taxels=taxels,
            seed=seed,
            progress=step,
        )
        step("write")
        write_layout_comparison(result, output)
    if not quiet:
        _print_comparison(console, result)
        print_written_files(console, output / "report.json", "comparison.png")


def _model_text(skin: "Skin") -> str:
    """Describe a skin in words: layer or sheet, and its thickness."""
    thickness = f"{1e3 * float(skin.thickness):g} mm thick"
    return f"a layer {thickness}" if skin.model.mesh.dimension == 3 else f"a sheet, {thickness}"


def _print_comparison(console, result: "LayoutComparison") -> None:
    from rich.table import Table

    from jeit.design.reports.layouts import distinct_names

    figures = result.figures
    table = Table(
        "", *distinct_names([layout_figures["layout"] for layout_figures in figures]), box=None, padding=(0, 2, 0, 0)
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for name, key, factor in _COMPARED_QUANTITIES:
        table.add_row(name, *(f"{factor * layout_figures[key]:.3g}" for layout_figures in figures))
        if key == "taxel_count":
            for statistic in ("mean", "std", "max"):
                table.add_row(
                    f"taxel area, {statistic} / cm²",
                    *(f"{layout_figures['taxel_area_cm2'][statistic]:.3g}" for layout_figures in figures),
                )
    console.print()
    console.print(table)
    skin = result.skins[0]
    pairs = " and ".join(f"{skin.model.protocol.num_measurements}" for skin in result.skins)
    notes = [
        f"{_model_text(skin)}; two-terminal measurements: {pairs}",
        f"touched at {result.places} × {result.places} places, {1e3 * result.margin:g} mm or more from the edge, to "
        f"{result.contrast:g} times its conductivity",
        "blind spot: less sensitive than the other layout's least sensitive place",
    ]
    if len({skin.model.protocol.num_measurements for skin in result.skins}) > 1:
        notes.append("sensitivities are norms over all measurements: more measurements alone make them larger")
    for note in notes:
        console.print(note, style="dim", highlight=False, soft_wrap=True)
    console.print()
