"""`jeit layout`: compare and improve layouts of electrodes, before any material is cut."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import Quiet, check_at_least, check_positive, check_within, make_folder, naming_options
from jeit.design import defaults
from jeit.design.commands import skins
from jeit.design.commands.layout_optimise import optimise

if TYPE_CHECKING:
    from jeit.design import Skin
    from jeit.design.comparison import LayoutComparison

layout = typer.Typer(name="layout", help="Compare and optimise layouts of electrodes.")

layout.command()(optimise)

_FILES = ("report.json", "comparison.png")
# Maximum number of touched positions along a side of the skin: 65,536 touches in total.
_MAX_POSITIONS = 256
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
_QUANTITIES = (
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
def _top(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@layout.command()
def compare(
    first: skins.LayoutName,
    second: skins.LayoutName,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for report.json and comparison.png.", show_default=False)
    ],
    thickness: skins.Thickness = 1e3 * defaults.THICKNESS,
    conductivity: skins.Conductivity = defaults.CONDUCTIVITY,
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
    places: Annotated[int, typer.Option(help="Places touched along a side.")] = defaults.PLACES,
    contrast: Annotated[
        float,
        typer.Option(help="Of the touched part's conductivity: 0 for an insulator, above 1 for a conductor."),
    ] = defaults.CONTRAST,
    cell: Annotated[float, typer.Option("--cell-mm", help="Size of the mesh's cells, millimetres.")] = 1e3
    * defaults.CELL_SIZE,
    seed: Annotated[int, typer.Option(help="Of the taxels' k-means.")] = 0,
    width: skins.Width = 1e3 * defaults.SIDE,
    height: skins.Height = 1e3 * defaults.SIDE,
    quiet: Quiet = False,
) -> None:
    """Touch two layouts all over, and compare them: sensitivity, blind spots, virtual taxels."""
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.design import compare_layouts
    from jeit.design.comparison import check_same_outline
    from jeit.design.reports import write_layout_comparison
    from jeit.design.skin.protocol import skin_protocol
    from jeit.design.skin.skin import skins_of

    skins.check_layer(thickness, conductivity)
    check_positive({"--cell-mm": cell})
    check_within("--places", places, 2, _MAX_POSITIONS)
    check_at_least({"--pairs": (pairs, 0), "--taxels": (taxels, 1), "--seed": (seed, 0)})
    if not 0 <= margin < float("inf"):
        raise ValueError(f"--margin-mm must not be negative; it is {margin:g}.")
    layouts = [skins.read_with_outline(name, width, height) for name in (first, second)]
    make_folder(output, _FILES)
    console = plain_console()
    with naming_options(_OPTION_NAMES), Steps(console, quiet=quiet) as step:
        check_same_outline(*layouts)
        step("mesh")
        protocols = [skin_protocol(compared_layout, num_pairs=pairs) for compared_layout in layouts]
        material = {"thickness": 1e-3 * thickness, "conductivity": conductivity}
        skins_to_compare = skins_of(layouts, protocols, **material, cell_size=1e-3 * cell)
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
        say_written(console, output / "report.json", "comparison.png")


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
    for name, key, factor in _QUANTITIES:
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
    pairs = " and ".join(f"{one.model.protocol.num_measurements}" for one in result.skins)
    notes = [
        f"{_model_text(skin)}; two-terminal measurements: {pairs}",
        f"touched at {result.places} × {result.places} places, {1e3 * result.margin:g} mm or more from the edge, to "
        f"{result.contrast:g} times its conductivity",
        "blind spot: less sensitive than the other layout's least sensitive place",
    ]
    if len({one.model.protocol.num_measurements for one in result.skins}) > 1:
        notes.append("sensitivities are norms over all measurements: more measurements alone make them larger")
    for note in notes:
        console.print(note, style="dim", highlight=False, soft_wrap=True)
    console.print()
