"""`jeit layout optimise`: move the electrodes of a layout to increase the sensitivity of the skin's worst position."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jeit.cli.options import Quiet, check_at_least, check_positive, check_within, make_folder
from jeit.design import defaults
from jeit.design.commands import skins

if TYPE_CHECKING:
    from jeit.design.improvement import ImprovedLayout
    from jeit.mesh import Disk, Domain, Rectangle

RESULTS = ("layout.csv", "layout.svg", "travel.png", "report.json")
# Minimum and maximum number of nodes of the mesh used in the optimisation: enough to form cells, and few enough for the
# final mesh, which has four times as many.
_MIN_NODES, _MAX_NODES = 4, 250_000
# Printed quantities: key in the report, name and unit, and factor that converts the reported value to that unit.
_QUANTITIES = (
    ("worst_sensitivity_V", "least sensitivity / mV", 1e3),
    ("mean_sensitivity_V", "mean sensitivity / mV", 1e3),
    ("uniformity", "uniformity", 1.0),
    ("mean_variance", "mean variance", 1.0),
    ("log_information_nats", "log information / nats", 1.0),
    ("largest_variance", "largest variance", 1.0),
    ("mean_localisation_error_m", "mean bound of the place / mm", 1e3),
)


def optimise(
    layout: skins.LayoutName,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"Folder for {', '.join(RESULTS)}.", show_default=False)
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
    thickness: skins.Thickness = 1e3 * defaults.THICKNESS,
    conductivity: skins.Conductivity = defaults.CONDUCTIVITY,
    contact_impedance: Annotated[
        float | None, typer.Option(help=f"ohm·m² (the layout's, or {defaults.CONTACT_IMPEDANCE:g}).")
    ] = None,
    noise: Annotated[float, typer.Option(help="Standard deviation of a voltage at 1 mA, volts.")] = defaults.NOISE,
    num_points: Annotated[int, typer.Option(help="Nodes of the mesh to optimise on, about.")] = defaults.NUM_POINTS,
    width: skins.Width = 1e3 * defaults.SIDE,
    height: skins.Height = 1e3 * defaults.SIDE,
    quiet: Quiet = False,
) -> None:
    """Move the electrodes of LAYOUT to increase the skin's lowest sensitivity and to decrease the mean variance.

    All two-terminal pairs are measured, so the order of electrodes does not matter. The scores of both layouts are
    computed on a finer mesh than that of the optimisation.
    """
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.design import DesignSpace, improve_layout
    from jeit.design.reports import write_improved_layout

    skins.check_layer(thickness, conductivity)
    check_positive({"--noise": noise})
    if contact_impedance is not None:
        check_positive({"--contact-impedance": contact_impedance})
    check_at_least({"--starts": (starts, 1), "--steps": (steps, 1), "--seed": (seed, 0)})
    if not 0 <= minimum_spacing < float("inf"):
        raise ValueError(f"--minimum-spacing-mm must not be negative; it is {minimum_spacing:g}.")
    check_within("--num-points", num_points, _MIN_NODES, _MAX_NODES)
    start = skins.read_with_outline(layout, width, height)
    keep_out_domains = [_parse_region(text, start.known_outline) for text in keep_out or ()]
    make_folder(output, RESULTS)
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
        say_written(console, output / RESULTS[0], *RESULTS[1:])


def _print_improvement(console, result: "ImprovedLayout") -> None:
    from jeit.cli.console import pairs
    from jeit.design.reports import report_improved_layout

    report = report_improved_layout(result)
    quantities = [(name, factor, report["start"][key], report["optimised"][key]) for key, name, factor in _QUANTITIES]
    rows = [
        (name, f"{factor * before:.3g} → {factor * after:.3g}")
        for name, factor, before, after in quantities
        if before is not None and after is not None
    ]
    console.print(pairs(result.start.name, rows))
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
