"""`jeit choose`: comparison of the rules for the regularisation hyperparameter on a measured file, with the image of
each rule."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import (
    AsIsOption,
    ContactOption,
    DataArgument,
    DescriptionOption,
    FormatOption,
    FrameOption,
    KeyOption,
    NodesOption,
    QuietOption,
    ReferenceArgument,
    ReferenceFramesOption,
    ReferenceKeyOption,
    convert_to_number_if_possible,
    make_folder,
    naming_options_in_errors,
    read_pair,
)

if TYPE_CHECKING:
    from jeit.imaging import ComparedRules


def choose(
    data: DataArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for choice.png and choice.json.", show_default=False)
    ],
    reference: ReferenceArgument = None,
    reference_frames: ReferenceFramesOption = None,
    rule: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this rule: gcv, l-curve, discrepancy, noise-figure or best-resolution; may be given repeatedly."
        ),
    ] = None,
    key: KeyOption = None,
    reference_key: ReferenceKeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
    prior: Annotated[str | None, typer.Option(help="tikhonov, laplace, noser, gaussian (default) or matern.")] = None,
    contact: ContactOption = None,
    num_points: NodesOption = None,
    frame: FrameOption = None,
    as_is: AsIsOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compare the rules that choose the regularisation hyperparameter of DATA's image; writes choice.png and
    choice.json."""
    from jeit.cli.console import Steps, plain_console, print_written_files
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
        frame_selector = None if frame is None else convert_to_number_if_possible(frame, int)
        with naming_options_in_errors({"rules": "--rule"}):
            result = compare_on_data(
                measurement, reference_measurement, settings, rules=rule or None, frame=frame_selector, progress=step
            )
        step("write")
        write_choice(result, output)
    if not quiet:
        print_comparison_of_rules(console, result)
        print_written_files(console, output / "choice.png", "choice.json")


def print_comparison_of_rules(console, result: "ComparedRules") -> None:
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
