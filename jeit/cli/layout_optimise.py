"""`jeit layout optimise`: move the electrodes of a layout to where the skin feels its worst place best."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import Height, LayoutName, Quiet, Width, make_folder, read_skin

if TYPE_CHECKING:
    from jeit.design import Optimisation, Scores

RESULTS = ("layout.csv", "layout.svg", "travel.png", "report.json")
# Of the mesh that results are confirmed on, times those of the one optimised on; and of places along a side.
_FINER, _PLACES, _MORE_PLACES = 4, 16, 24
# Correlation length of the amplitudes of touches before any is felt, in metres: two deviations of the bell.
_CORRELATION = 15e-3


def optimise(
    layout: LayoutName,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"Folder for {', '.join(RESULTS)}.", show_default=False)
    ],
    minimum_spacing: Annotated[float, typer.Option(help="Of electrodes' centres, millimetres.")] = 8.0,
    symmetry: Annotated[str | None, typer.Option(help="mirror-x, mirror-y, rotate-2 or rotate-4.")] = None,
    sizes: Annotated[bool, typer.Option("--sizes", help="Change sizes too, between half and twice.")] = False,
    starts: Annotated[int, typer.Option(help="The layout, and random ones.")] = 1,
    steps: Annotated[int, typer.Option(help="At most.")] = 60,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    thickness: Annotated[float, typer.Option(help="Of the skin, millimetres.")] = 10.0,
    conductivity: Annotated[float, typer.Option(help="Of the skin, S/m.")] = 0.2,
    contact_impedance: Annotated[float | None, typer.Option(help="ohm·m² (the layout's, or 1e-4).")] = None,
    noise: Annotated[float, typer.Option(help="Standard deviation of a voltage at 1 mA, volts.")] = 1e-4,
    num_points: Annotated[int, typer.Option(help="Nodes of the mesh to optimise on, about.")] = 1300,
    width: Width = 200.0,
    height: Height = 200.0,
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
    from jeit.electrodes import write_layout
    from jeit.forward import ForwardModel
    from jeit.protocol import two_terminal

    for name, value in (("thickness", thickness), ("conductivity", conductivity), ("noise", noise)):
        if not value > 0:
            raise ValueError(f"--{name} must be positive; it is {value:g}.")
    start, outline = read_skin(layout, width, height)
    known = start.contact_impedance is not None
    contact = contact_impedance if contact_impedance is not None else None if known else 1e-4
    make_folder(output, RESULTS)

    def setting(nodes: int, places: int):
        mesh = outline.mesh(num_points=nodes)
        grid = touch_grid(outline, places, places).places
        model = ForwardModel(mesh, start.sheet_discs(contact), two_terminal(start.num_electrodes))
        touches = sheet_touches(mesh, Bell(), grid, thickness=1e-3 * thickness)
        return model, touches, {"prior": TouchPrior.create(grid, correlation=_CORRELATION), "noise": noise}

    conductance = 1e-3 * thickness * conductivity
    console = Console(highlight=False)
    with Steps(console, quiet=quiet) as step:
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
            symmetry=symmetry,  # pyright: ignore[reportArgumentType]
            sizes=sizes,
            steps=steps,
            starts=starts,
            key=jax.random.key(seed),
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
        _draw(found, output / "travel.png")
        report = {"layout": start.name, "status": found.status, "reason": found.reason, **scores}
        report |= {"starts": found.values.tolist(), "steps": found.history.shape[1] - 1, "seed": seed}
        (output / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if not quiet:
        rows = [
            (name.replace("_", " "), f"{before:.3g} → {scores['optimised'][name]:.3g}")
            for name, before in scores["start"].items()
            if before is not None and scores["optimised"][name] is not None
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


def _draw(found: "Optimisation", path: Path) -> None:
    from matplotlib.figure import Figure

    from jeit.plot import plot_travel

    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    best = [k for k, value in enumerate(found.values) if value == found.value]
    plot_travel(found, best[0] if best else 0, ax=figure.subplots())
    figure.savefig(path, dpi=150)
