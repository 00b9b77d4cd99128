"""`jeit choose`: comparison of the rules for the regularisation hyperparameter on a measured file, with the image of
each rule."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import (
    AsIs,
    Contact,
    Data,
    Description,
    Format,
    Frame,
    Key,
    Nodes,
    Quiet,
    Reference,
    ReferenceFrames,
    ReferenceKey,
    make_folder,
    naming_options,
    number_or_name,
    read_pair,
)

if TYPE_CHECKING:
    from jeit.imaging import ComparedRules


def choose(
    data: Data,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for choice.png and choice.json.", show_default=False)
    ],
    reference: Reference = None,
    reference_frames: ReferenceFrames = None,
    rule: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this rule: gcv, l-curve, discrepancy, noise-figure or best-resolution; may be given repeatedly."
        ),
    ] = None,
    key: Key = None,
    reference_key: ReferenceKey = None,
    format: Format = None,
    description: Description = None,
    prior: Annotated[str | None, typer.Option(help="tikhonov, laplace, noser, gaussian (default) or matern.")] = None,
    contact: Contact = None,
    num_points: Nodes = None,
    frame: Frame = None,
    as_is: AsIs = False,
    quiet: Quiet = False,
) -> None:
    """Compare the rules that choose the regularisation hyperparameter of DATA's image; writes choice.png and
    choice.json."""
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.imaging import ImagingSettings, compare_on_data
    from jeit.report import write_choice

    setting_values = {"prior": prior, "contact": contact, "num_points": num_points, "as_is": as_is}
    settings = ImagingSettings(**{name: value for name, value in setting_values.items() if value is not None})
    make_folder(output, ("choice.png", "choice.json"))
    console = plain_console()
    with Steps(console, quiet=quiet) as step:
        step("read")
        measurement, reference_measurement = read_pair(
            data, reference, reference_frames, format, description, (key, reference_key)
        )
        frame_selector = None if frame is None else number_or_name(frame, int)
        with naming_options({"rules": "--rule"}):
            result = compare_on_data(
                measurement, reference_measurement, settings, rules=rule or None, frame=frame_selector, progress=step
            )
        step("write")
        write_choice(result, output)
    if not quiet:
        show(console, result)
        say_written(console, output / "choice.png", "choice.json")


def show(console, result: "ComparedRules") -> None:
    """Print a row for every rule, with the chosen hyperparameter and the reason to doubt the choice, if any."""
    from rich.table import Table

    from jeit.arguments import percent

    table = Table("rule", "λ", "residual", "noise figure", "inclusions", box=None, padding=(0, 2))
    for column in table.columns[1:]:
        column.justify = "right"
    for name, outcome in result.outcomes.items():
        table.add_row(
            f"{name} *" if outcome.choice.edge else name,
            f"{float(outcome.choice.hyperparameter):.3g}",
            percent(outcome.residual),
            f"{outcome.noise_figure:.3g}",
            str(len(outcome.inclusions)),
        )
    console.print()
    console.print(result.prepared.measurement.name, style="bold")
    console.print(table)
    for outcome in result.outcomes.values():
        if outcome.choice.edge:
            console.print(f"  * {outcome.choice.note}", soft_wrap=True)
    for reason in result.refused.values():
        console.print(f"  {reason.removeprefix('hyperparameter: ')}", soft_wrap=True)
    for doubt in result.prepared.doubts:
        console.print(f"  doubt: {doubt}", soft_wrap=True)
    console.print()
