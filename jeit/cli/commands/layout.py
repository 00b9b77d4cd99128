"""`jeit layout`: layouts of electrodes compared and improved, before any material is cut."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli import skins
from jeit.cli.commands.layout_optimise import optimise
from jeit.cli.options import Quiet, check_at_least, check_positive, check_within, make_folder, naming_options

if TYPE_CHECKING:
    from jeit.design import SkinResponse
    from jeit.layout import Layout
    from jeit.mesh import Domain

layout = typer.Typer(name="layout", help="Compare and optimise layouts of electrodes.")

layout.command()(optimise)

_FILES = ("report.json", "comparison.png")
# Measurements and taxels, as in Park et al. 2022, where a skin has so many pairs of electrodes and places.
_PAIRS, _TAXELS = 94, 90
# Letters of a name in the picture.
_LONGEST = 32
# Along a side: 65,536 touches in all.
_MOST_PLACES = 256


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
    thickness: skins.Thickness = 10.0,
    conductivity: skins.Conductivity = 1.0,
    pairs: Annotated[
        int | None,
        typer.Option(
            help=f"Two-terminal measurements, between nearest electrodes; 0 for all pairs (default {_PAIRS}, or all)."
        ),
    ] = None,
    taxels: Annotated[
        int | None, typer.Option(help=f"Virtual taxels to look for (default {_TAXELS}, or one a place).")
    ] = None,
    margin: Annotated[
        float, typer.Option("--margin-mm", help="Touch no nearer to the edge, where a touch is partly off the skin.")
    ] = 10.0,
    places: Annotated[int, typer.Option(help="Places touched along a side.")] = 48,
    contrast: Annotated[
        float,
        typer.Option(help="Of the touched part's conductivity: 0 for an insulator, above 1 for a conductor."),
    ] = 0.0,
    cell: Annotated[float, typer.Option("--cell-mm", help="Size of the mesh's cells, millimetres.")] = 4.5,
    seed: Annotated[int, typer.Option(help="Of the taxels' k-means.")] = 0,
    width: skins.Width = 200.0,
    height: skins.Height = 200.0,
    quiet: Quiet = False,
) -> None:
    """Touch two layouts all over, and say what each feels: sensitivity, blind spots, virtual taxels."""
    import jax
    from rich.console import Console

    from jeit.cli.console import Steps
    from jeit.design import TouchedSkin, comparison, touches_away_from_the_edge

    skins.check_layer(thickness, conductivity)
    check_positive({"--cell-mm": cell})
    check_within("--places", places, 2, _MOST_PLACES)
    check_at_least({"--pairs": (pairs, 0), "--taxels": (taxels, 1), "--seed": (seed, 0)})
    if not 0 <= margin < float("inf"):
        raise ValueError(f"--margin-mm must not be negative; it is {margin:g}.")
    both = [skins.read(name, width, height) for name in (first, second)]
    _check_same(*both)
    make_folder(output, _FILES)
    arguments = {
        "thickness": "--thickness-mm",
        "cell_size": "--cell-mm",
        "num_pairs": "--pairs",
        "num_taxels": "--taxels",
        "margin": "--margin-mm",
        "contrast": "--contrast",
    }
    console = Console(highlight=False)
    with naming_options(arguments), Steps(console, quiet=quiet) as step:
        step("mesh")
        # Both, before either is touched: what is wrong with one is said at once.
        touched = []
        for one, outline in both:
            grid = touches_away_from_the_edge(outline, 1e-3 * margin, places, places)
            every = one.num_electrodes * (one.num_electrodes - 1) // 2
            touched.append(
                TouchedSkin.create(
                    one,
                    grid,
                    thickness=1e-3 * thickness,
                    conductivity=conductivity,
                    cell_size=1e-3 * cell,
                    num_pairs=min(_PAIRS, every) if pairs is None else pairs or None,
                    contrast=contrast,
                    num_taxels=min(_TAXELS, len(grid.places)) if taxels is None else taxels,
                )
            )
        felt = []
        for skin in touched:
            step(f"touch {skin.layout.name}")
            felt.append(skin.feel(jax.random.key(seed)))
        step("write")
        told = comparison(felt[0], felt[1])
        report = {
            "layouts": told,
            "options": {
                "thickness_mm": thickness,
                "conductivity_S_per_m": conductivity,
                "pairs": pairs,
                "taxels": taxels,
                "contrast": contrast,
                "margin_mm": margin,
                "places": places,
                "cell_mm": cell,
                "seed": seed,
            },
        }
        (output / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", "utf-8")
        _draw(felt).savefig(output / "comparison.png", dpi=130, bbox_inches="tight")
    if not quiet:
        _show(console, told)
        console.print(f"[dim]Written:[/dim] {output / 'report.json'}, comparison.png", soft_wrap=True)


def _check_same(one: "tuple[Layout, Domain]", other: "tuple[Layout, Domain]") -> None:
    """Raise `ValueError` unless both layouts are on the same skin, but for where its drawing has its origin."""
    sizes = []
    for _, outline in (one, other):
        low_x, high_x, low_y, high_y = outline.extent
        sizes.append((high_x - low_x, high_y - low_y, outline.area))
    if any(abs(a - b) > 1e-3 * a for a, b in zip(*sizes, strict=True)):
        said = " and ".join(
            f"'{layout.name}' {1e3 * width:.4g} × {1e3 * height:.4g} mm"
            for (layout, _), (width, height, _) in zip((one, other), sizes, strict=True)
        )
        raise ValueError(
            f"the layouts are on different skins, {said}; a file that does not say its skin takes --width-mm and "
            "--height-mm."
        )


def _draw(felt: "list[SkinResponse]"):
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch

    from jeit.plot import plot_sensitivity_histograms, plot_sensitivity_map, plot_taxel_areas, plot_taxels
    from jeit.plot.axes import INK, bare, draw_scale_bar
    from jeit.plot.design.travel import outline_path

    figure = Figure(figsize=(15.5, 9.0), layout="constrained")
    axes = figure.subplots(2, 3)
    highest = max(float(one.sensitivity.values.max()) for one in felt)
    largest = max(float(one.taxels.max_area) for one in felt)
    names = _told_apart([_shortened(one.layout.name) for one in felt])
    for row, name, one in zip(axes, names, felt, strict=True):
        centres, skin = one.layout.centres, one.layout.known_outline
        plot_sensitivity_map(one.sensitivity, electrodes=centres, limit=highest, title=name, ax=row[0])
        plot_taxels(one.taxels, electrodes=centres, limit=largest, title=f"{name}: taxels", ax=row[1])
        # Its bar, drawn last, is placed by the touched part; both maps are of the whole skin.
        for bar in (row[1].lines[-1], row[1].texts[-1]):
            bar.remove()
        draw_scale_bar(row[1], skin.extent)
        for ax in row[:2]:
            ax.add_patch(PathPatch(outline_path(skin), facecolor="none", edgecolor=INK, linewidth=0.9))
            bare(ax, skin.extent)
    plot_sensitivity_histograms({name: one.sensitivity for name, one in zip(names, felt, strict=True)}, ax=axes[0, 2])
    plot_taxel_areas({name: one.taxels for name, one in zip(names, felt, strict=True)}, ax=axes[1, 2])
    return figure


def _told_apart(names: list[str]) -> list[str]:
    return names if names[0] != names[1] else [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _shortened(name: str) -> str:
    """A layout's name, as much of it as there is room for above a map."""
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…"


def _show(console, told: list[dict]) -> None:
    from rich.table import Table

    table = Table("", *_told_apart([one["layout"] for one in told]), box=None, padding=(0, 2, 0, 0))
    for column in table.columns[1:]:
        column.justify = "right"

    def row(name: str, key: str, factor: float = 1.0, digits: int = 3) -> None:
        table.add_row(name, *(f"{factor * one[key]:.{digits}g}" for one in told))

    row("electrodes", "electrodes")
    row("measurements", "measurements")
    row("least sensitivity / mV", "sensitivity_min_V", 1e3)
    row("mean sensitivity / mV", "sensitivity_mean_V", 1e3)
    row("uniformity", "sensitivity_uniformity")
    row("blind spot / % of the area", "blind_spot_fraction", 100)
    row("taxels", "taxel_count")
    for key in ("mean", "std", "max"):
        table.add_row(f"taxel area, {key} / cm²", *(f"{one['taxel_area_cm2'][key]:.3g}" for one in told))
    row("taxels over a place", "taxel_overlap")
    row("two-point estimate / mm", "two_point_mm")
    console.print()
    console.print(table)
    console.print("[dim]blind spot: less sensitive than the other layout's least sensitive place[/dim]")
    console.print()
