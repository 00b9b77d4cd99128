"""`jeit layout optimise`: move the electrodes of a layout to where the skin feels its worst place best."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jeit.cli import skins
from jeit.cli.options import Quiet, check_at_least, check_positive, check_within, make_folder, naming_options

if TYPE_CHECKING:
    from jeit.design import Optimisation, Scores
    from jeit.mesh import Disk, Domain, Rectangle

RESULTS = ("layout.csv", "layout.svg", "travel.png", "report.json")
# Nodes to optimise on: fewest that make cells at all, and as many as there can be four times of.
_LEAST_NODES, _MOST_NODES = 4, 250_000
# Of the mesh that results are confirmed on, times those of the one optimised on; and of places along a side.
_FINER, _PLACES, _MORE_PLACES = 4, 16, 24
# Correlation length of the amplitudes of touches before any is felt, in metres: two deviations of the bell.
_CORRELATION = 15e-3
# Options by the names that their values have further down.
_OPTIONS = {
    "contact_impedance": "--contact-impedance",
    "num_points": "--num-points",
    "symmetry": "--symmetry",
    "keep_out": "--keep-out",
    "minimum_spacing": "--minimum-spacing-mm",
}
# What is told: its key in the report, its name and unit, and what to multiply by.
_TOLD = (
    ("worst_sensitivity_V", "least sensitivity / mV", 1e3),
    ("mean_sensitivity_V", "mean sensitivity / mV", 1e3),
    ("uniformity", "uniformity", 1.0),
    ("mean_variance", "mean variance", 1.0),
    ("log_information_nats", "log information / nats", 1.0),
    ("largest_variance", "largest variance", 1.0),
    ("mean_localisation_error_m", "mean localisation error / mm", 1e3),
)


def optimise(
    layout: skins.LayoutName,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"Folder for {', '.join(RESULTS)}.", show_default=False)
    ],
    minimum_spacing: Annotated[
        float, typer.Option("--minimum-spacing-mm", help="Of electrodes' centres, millimetres.")
    ] = 8.0,
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
    steps: Annotated[int, typer.Option(help="At most.")] = 60,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    thickness: skins.Thickness = 10.0,
    conductivity: skins.Conductivity = 1.0,
    contact_impedance: Annotated[float | None, typer.Option(help="ohm·m² (the layout's, or 1e-4).")] = None,
    noise: Annotated[float, typer.Option(help="Standard deviation of a voltage at 1 mA, volts.")] = 2e-5,
    num_points: Annotated[int, typer.Option(help="Nodes of the mesh to optimise on, about.")] = 1300,
    width: skins.Width = 200.0,
    height: skins.Height = 200.0,
    quiet: Quiet = False,
) -> None:
    """Move the electrodes of LAYOUT until its worst sensitivity and mean variance are as good as they get.

    All two-terminal pairs are measured, so the order of electrodes does not matter. Figures of both layouts are on a
    finer mesh than the one optimised on.
    """
    import jax
    from rich.console import Console

    from jeit.cli.console import Steps, pairs
    from jeit.design import Bell, TouchPrior, layout_scores, optimise_layout, sheet_touches, touch_grid
    from jeit.forward import ForwardModel
    from jeit.layout import write_layout
    from jeit.protocol import two_terminal

    skins.check_layer(thickness, conductivity)
    check_positive({"--noise": noise})
    if contact_impedance is not None:
        check_positive({"--contact-impedance": contact_impedance})
    check_at_least({"--starts": (starts, 1), "--steps": (steps, 1), "--seed": (seed, 0)})
    if not 0 <= minimum_spacing < float("inf"):
        raise ValueError(f"--minimum-spacing-mm must not be negative; it is {minimum_spacing:g}.")
    check_within("--num-points", num_points, _LEAST_NODES, _MOST_NODES)
    start, outline = skins.read(layout, width, height)
    free = [_region(text, outline) for text in keep_out or ()]
    known = start.contact_impedance is not None
    contact = contact_impedance if contact_impedance is not None else None if known else 1e-4
    make_folder(output, RESULTS)

    def setting(nodes: int, places: int):
        mesh = outline.mesh(num_points=nodes)
        grid = touch_grid(outline, places, places).places
        discs = start.sheet_discs(contact)
        try:
            discs.check(mesh)
        except ValueError:
            smallest = 2e3 * float(discs.radius.min())
            raise ValueError(
                f"--num-points {nodes} makes cells too coarse for electrodes {smallest:.3g} mm across; give more."
            ) from None
        model = ForwardModel(mesh, discs, two_terminal(start.num_electrodes))
        touches = sheet_touches(mesh, Bell(), grid, thickness=1e-3 * thickness)
        return model, touches, {"prior": TouchPrior.create(grid, correlation=_CORRELATION), "noise": noise}

    conductance = 1e-3 * thickness * conductivity
    console = Console(highlight=False)

    def say(done: int, values) -> None:
        step.tell(f"step {done} of at most {steps}, best score {values.max():.3f}")

    with naming_options(_OPTIONS), Steps(console, quiet=quiet) as step:
        step("mesh")
        model, touches, options = setting(num_points, _PLACES)
        step("optimise")
        found = optimise_layout(
            start,
            model,
            conductance,
            touches,
            **options,
            outline=outline,
            minimum_spacing=1e-3 * minimum_spacing,
            keep_out=free,
            symmetry=symmetry,
            sizes=sizes,
            steps=steps,
            starts=starts,
            key=jax.random.key(seed),
            callback=say,
        )
        if found.status == "infeasible":
            raise ValueError(f"no layout found: {found.reason}")
        step("confirm")
        model, touches, options = setting(_FINER * num_points, _MORE_PLACES)
        scores = {}
        for name, one in (("start", start), ("optimised", found.layout)):
            moved = model.with_electrodes(one.sheet_discs(contact))
            scores[name] = _figures(layout_scores(moved, conductance, touches, **options))
        step("write")
        write_layout(found.layout, output / "layout.csv")
        write_layout(found.layout, output / "layout.svg")
        _draw(found, free, output / "travel.png")
        report = {"layout": start.name, "status": found.status, "reason": found.reason, **scores}
        report |= {"starts": found.values.tolist(), "steps": found.history.shape[1] - 1, "seed": seed}
        report["options"] = {
            "thickness_mm": thickness,
            "conductivity_S_per_m": conductivity,
            "noise_V": noise,
            "minimum_spacing_mm": minimum_spacing,
            "keep_out_mm": keep_out or [],
            "symmetry": symmetry,
            "sizes": sizes,
            "num_points": num_points,
        }
        (output / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if not quiet:
        both = [(name, factor, scores["start"][key], scores["optimised"][key]) for key, name, factor in _TOLD]
        rows = [
            (name, f"{factor * before:.3g} → {factor * after:.3g}")
            for name, factor, before, after in both
            if before is not None and after is not None
        ]
        console.print(pairs(start.name, rows))
        console.print(f"  {found.status}: {found.reason}", soft_wrap=True)
        console.print(f"[dim]Written:[/dim] {output / RESULTS[0]}, {', '.join(RESULTS[1:])}", soft_wrap=True)


def _figures(scores: "Scores") -> dict[str, float | None]:
    """In SI units; None where there is no finite value."""
    import numpy as np

    values = {
        "worst_sensitivity_V": scores.worst,
        "mean_sensitivity_V": scores.mean,
        "uniformity": scores.uniformity,
        "mean_variance": scores.mean_variance,
        "log_information_nats": scores.log_information,
        "largest_variance": scores.largest_variance,
        "mean_localisation_error_m": scores.localisation_error.mean(),
    }
    return {name: float(value) if np.isfinite(value) else None for name, value in values.items()}


def _region(text: str, outline: "Domain") -> "Disk | Rectangle":
    """A disc "x,y,radius" or rectangle "x1,y1,x2,y2" in mm. Raises `ValueError` if it is none or off the skin."""
    from jeit.mesh import Disk, Rectangle

    try:
        numbers = [1e-3 * float(part) for part in text.split(",")]
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
    middle = ((low_x + high_x) / 2, (low_y + high_y) / 2)
    return Disk(numbers[2], middle) if len(numbers) == 3 else Rectangle(high_x - low_x, high_y - low_y, middle)


def _draw(found: "Optimisation", free: "Sequence[Domain]", path: Path) -> None:
    from matplotlib.figure import Figure

    from jeit.plot import plot_travel

    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    plot_travel(found, found.best or 0, keep_out=tuple(free), ax=figure.subplots())
    figure.savefig(path, dpi=150)
