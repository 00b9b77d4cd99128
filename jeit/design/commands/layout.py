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
    check_seed,
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
_MIN_MESH_NODES, _MAX_MESH_NODES = 4, 250_000
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
def _print_help(command_context: typer.Context) -> None:
    if command_context.invoked_subcommand is None:
        typer.echo(command_context.get_help())


def _read_layout_with_outline(name_or_path: str, width_mm: float, height_mm: float) -> "Layout":
    """Read an electrode layout with the outline of its skin; `name_or_path`: name of a built-in layout, or path of a
    file. If the layout has no outline, the outline is a rectangle of `width_mm` × `height_mm` (mm).

    Raises `ValueError` for a layout with fewer than three electrodes.
    """
    from jeit.layout import named_layout, read_layout
    from jeit.layout.layout import MAX_SKIN_SIZE, MIN_SKIN_SIZE
    from jeit.mesh import Rectangle

    def outline_from_options() -> Rectangle:
        for option_name, side_length_mm in (("--width-mm", width_mm), ("--height-mm", height_mm)):
            check_within(option_name, side_length_mm, 1e3 * MIN_SKIN_SIZE, 1e3 * MAX_SKIN_SIZE, "mm")
        return Rectangle(1e-3 * width_mm, 1e-3 * height_mm)

    with naming_options_in_errors({"name": "layout", "path": "layout"}):
        if not Path(name_or_path).suffix:
            layout = (
                named_layout(name_or_path)
                if name_or_path.startswith("park-")
                else named_layout(name_or_path, outline_from_options())
            )
        else:
            layout = read_layout(name_or_path)
            if layout.outline is None:
                layout = read_layout(name_or_path, outline=outline_from_options())
    if layout.num_electrodes < 3:
        raise ValueError(f"'{layout.name}' has {layout.num_electrodes} electrodes; give a layout of three or more.")
    return layout


def _check_layer_options(thickness_mm: float, conductivity: float) -> None:
    """Raise `ValueError` unless --thickness-mm is more than the depth of a touch, and --conductivity is from 1e-9 to
    1e9 S/m."""
    from jeit.design.defaults import DEPTH

    if not 1e3 * DEPTH < thickness_mm < float("inf"):
        raise ValueError(
            f"--thickness-mm must be more than the {1e3 * DEPTH:g} mm that a touch is deep; it is {thickness_mm:g}."
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

    _check_layer_options(thickness, conductivity)
    check_positive({"--noise": noise})
    if contact_impedance is not None:
        check_positive({"--contact-impedance": contact_impedance})
    check_at_least({"--starts": (starts, 1), "--steps": (steps, 1)})
    check_seed(seed)
    if not 0 <= minimum_spacing < float("inf"):
        raise ValueError(f"--minimum-spacing-mm must not be negative; it is {minimum_spacing:g}.")
    check_within("--num-points", num_points, _MIN_MESH_NODES, _MAX_MESH_NODES)
    initial_layout = _read_layout_with_outline(layout, width, height)
    keep_out_domains = [_parse_region(region_text, initial_layout.known_outline) for region_text in keep_out or ()]
    make_folder(output, _OPTIMISATION_FILES)
    design_space = DesignSpace(
        minimum_spacing=1e-3 * minimum_spacing, keep_out=keep_out_domains, symmetry=symmetry, sizes=sizes
    )
    search_options = {"noise": noise, "steps": steps, "starts": starts, "seed": seed, "num_points": num_points}
    material_options = {
        "thickness": 1e-3 * thickness,
        "conductivity": conductivity,
        "contact_impedance": contact_impedance,
    }
    console = plain_console()

    def report_step(step_number: int, scores_of_starts) -> None:
        progress_steps.report(f"step {step_number} of at most {steps}, best score {scores_of_starts.max():.3f}")

    with Steps(console, quiet=quiet) as progress_steps:
        improved_layout = improve_layout(
            initial_layout,
            design_space,
            **search_options,
            **material_options,
            progress=progress_steps,
            callback=report_step,
        )
        progress_steps("write")
        write_improved_layout(improved_layout, output)
    if not quiet:
        _print_improvement(console, improved_layout)
        print_written_files(console, output / _OPTIMISATION_FILES[0], *_OPTIMISATION_FILES[1:])


def _print_improvement(console, improved_layout: "ImprovedLayout") -> None:
    from jeit.cli.console import name_value_table
    from jeit.design.reports import report_improved_layout

    improvement_report = report_improved_layout(improved_layout)
    scores_of_quantities = [
        (quantity_name, unit_factor, improvement_report["start"][score_key], improvement_report["optimised"][score_key])
        for score_key, quantity_name, unit_factor in _OPTIMISED_QUANTITIES
    ]
    table_rows = [
        (quantity_name, f"{unit_factor * score_before:.3g} → {unit_factor * score_after:.3g}")
        for quantity_name, unit_factor, score_before, score_after in scores_of_quantities
        if score_before is not None and score_after is not None
    ]
    console.print(name_value_table(improved_layout.start.name, table_rows))
    console.print(f"  {improvement_report['status']}: {improvement_report['reason']}", soft_wrap=True)
    console.print(
        "  on a sheet that is touched everywhere, with all two-terminal pairs: 'jeit layout compare' computes figures "
        "of a layer\n  the bound of the place is the error that noise alone causes",
        style="dim",
        highlight=False,
        soft_wrap=True,
    )


def _parse_region(region_text: str, skin_outline: "Domain") -> "Disk | Rectangle":
    """Parse a keep-out region: a disc "x,y,radius" or a rectangle "x1,y1,x2,y2", mm. Raises `ValueError` for other
    text, and for a region off the skin."""
    from jeit.mesh import Disk, Rectangle

    try:
        region_numbers = [1e-3 * float(number_text) for number_text in region_text.split(",")]
    except ValueError:
        region_numbers = []
    if len(region_numbers) not in (3, 4) or not all(
        abs(region_number) < float("inf") for region_number in region_numbers
    ):
        raise ValueError(
            f"--keep-out is {region_text!r}; give a disc x,y,radius or a rectangle x1,y1,x2,y2, millimetres, such as "
            "0,0,15."
        )
    if len(region_numbers) == 3:
        x, y, disc_radius = region_numbers
        low_x, high_x, low_y, high_y = x - disc_radius, x + disc_radius, y - disc_radius, y + disc_radius
    else:
        (low_x, high_x), (low_y, high_y) = sorted(region_numbers[0::2]), sorted(region_numbers[1::2])
    if not (high_x > low_x and high_y > low_y):
        raise ValueError(f"--keep-out {region_text} has no size; give a positive radius, or two opposite corners.")
    skin_x_min, skin_x_max, skin_y_min, skin_y_max = skin_outline.extent
    if low_x >= skin_x_max or high_x <= skin_x_min or low_y >= skin_y_max or high_y <= skin_y_min:
        raise ValueError(
            f"--keep-out {region_text} lies off the skin, which spans {1e3 * skin_x_min:g} to {1e3 * skin_x_max:g} mm "
            f"by {1e3 * skin_y_min:g} to {1e3 * skin_y_max:g} mm."
        )
    region_centre = ((low_x + high_x) / 2, (low_y + high_y) / 2)
    return (
        Disk(region_numbers[2], region_centre)
        if len(region_numbers) == 3
        else Rectangle(high_x - low_x, high_y - low_y, region_centre)
    )


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

    _check_layer_options(thickness, conductivity)
    check_positive({"--cell-mm": cell})
    check_within("--places", places, 2, _MAX_POSITIONS_PER_SIDE)
    check_at_least({"--pairs": (pairs, 0), "--taxels": (taxels, 1)})
    check_seed(seed)
    if not 0 <= margin < float("inf"):
        raise ValueError(f"--margin-mm must not be negative; it is {margin:g}.")
    layouts = [_read_layout_with_outline(layout_name, width, height) for layout_name in (first, second)]
    make_folder(output, _COMPARISON_FILES)
    console = plain_console()
    with naming_options_in_errors(_OPTION_NAMES), Steps(console, quiet=quiet) as progress_steps:
        check_same_outline(*layouts)
        progress_steps("mesh")
        protocols = [skin_protocol(compared_layout, num_pairs=pairs) for compared_layout in layouts]
        material_options = {"thickness": 1e-3 * thickness, "conductivity": conductivity}
        skins_to_compare = create_skins(layouts, protocols, **material_options, cell_size=1e-3 * cell)
        comparison = compare_layouts(
            skins_to_compare[0],
            skins_to_compare[1],
            margin=1e-3 * margin,
            places=places,
            contrast=contrast,
            num_taxels=taxels,
            seed=seed,
            progress=progress_steps,
        )
        progress_steps("write")
        write_layout_comparison(comparison, output)
    if not quiet:
        _print_comparison(console, comparison)
        print_written_files(console, output / "report.json", "comparison.png")


def _skin_model_text(skin: "Skin") -> str:
    """Describe a skin in words: layer or sheet, and its thickness."""
    thickness_text = f"{1e3 * float(skin.thickness):g} mm thick"
    return f"a layer {thickness_text}" if skin.model.mesh.dimension == 3 else f"a sheet, {thickness_text}"


def _print_comparison(console, comparison: "LayoutComparison") -> None:
    from rich.table import Table

    from jeit.design.reports.layouts import distinct_names

    scores_of_layouts = comparison.figures
    score_table = Table(
        "",
        *distinct_names([layout_scores["layout"] for layout_scores in scores_of_layouts]),
        box=None,
        padding=(0, 2, 0, 0),
    )
    for table_column in score_table.columns[1:]:
        table_column.justify = "right"
    for quantity_name, score_key, unit_factor in _COMPARED_QUANTITIES:
        score_table.add_row(
            quantity_name, *(f"{unit_factor * layout_scores[score_key]:.3g}" for layout_scores in scores_of_layouts)
        )
        if score_key == "taxel_count":
            for area_statistic in ("mean", "std", "max"):
                score_table.add_row(
                    f"taxel area, {area_statistic} / cm²",
                    *(f"{layout_scores['taxel_area_cm2'][area_statistic]:.3g}" for layout_scores in scores_of_layouts),
                )
    console.print()
    console.print(score_table)
    first_skin = comparison.skins[0]
    measurement_counts_text = " and ".join(
        f"{first_skin.model.protocol.num_measurements}" for first_skin in comparison.skins
    )
    footnotes = [
        f"{_skin_model_text(first_skin)}; two-terminal measurements: {measurement_counts_text}",
        f"touched at {comparison.places} × {comparison.places} places, {1e3 * comparison.margin:g} mm or more from the "
        f"edge, to {comparison.contrast:g} times its conductivity",
        "blind spot: less sensitive than the other layout's least sensitive place",
    ]
    if len({first_skin.model.protocol.num_measurements for first_skin in comparison.skins}) > 1:
        footnotes.append("sensitivities are norms over all measurements: more measurements alone make them larger")
    for footnote in footnotes:
        console.print(footnote, style="dim", highlight=False, soft_wrap=True)
    console.print()
