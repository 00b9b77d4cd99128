"""`jeit learn`: networks that learn from simulated touches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import Quiet, make_folder, naming_options

learn = typer.Typer(name="learn", help="Networks that learn from simulated touches of a described skin.")


@learn.callback(invoke_without_command=True)
def _top(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@learn.command()
def image(
    skin: Annotated[
        Path,
        typer.Argument(
            metavar="SKIN.toml",
            help="The skin: tables skin, electrodes (with layout), measurement and mesh, as in a study file.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MODEL", help="Folder for the network.", show_default=False)
    ],
    preset: Annotated[str, typer.Option(help="full, or quick: two minutes, for a first look.")] = "full",
    design: Annotated[
        str,
        typer.Option(help="unrolled: a network that knows the skin's physics; three-stages: that of Park et al. 2022."),
    ] = "unrolled",
    touches: Annotated[
        int | None, typer.Option(help="How many touches to learn from; as the preset says unless given.", min=1)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of touches and starting weights.", min=0)] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a dask scheduler, whose workers simulate; in this process unless given."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Learn to image how deep a skin is indented: simulates touches, trains a network, and says how well it does.

    Writes network.jeit, report.json and learning.png to the folder MODEL; touches and trainings under way stay in
    MODEL/work. Stopped or killed at any moment, the same command goes on where it was.
    """
    from contextlib import ExitStack

    from jeit.arguments.extras import need_extra
    from jeit.cli.console import Steps, pairs, plain_console, say_written
    from jeit.design import read_described_skin
    from jeit.design.commands.study import connected
    from jeit.touch.networks import learn_images
    from jeit.touch.reports.image_network import LEARNT_FILES, write_learnt_images

    need_extra("learn", "a network that images touches")
    need_extra("cluster", "a store of simulated touches")
    make_folder(output, LEARNT_FILES)
    console = plain_console()
    with ExitStack() as stack:
        step = stack.enter_context(Steps(console, quiet=quiet))
        step("read")
        with naming_options({"path": "skin"}):
            described = read_described_skin(skin)
        client = None if scheduler is None else stack.enter_context(connected(scheduler))
        step("learn")
        learnt = learn_images(
            described,
            output,
            preset=preset,
            design=design,
            touches=touches,
            seed=seed,
            client=client,
            progress=step.report,
        )
        step("write")
        write_learnt_images(learnt, output)
    if quiet:
        return
    place = learnt.standing.place
    rows = [
        ("network", f"{learnt.network.design}, {learnt.network.made_for['channels']} channels"),
        *(
            (name, f"{one.reason}, best after {one.course.steps[one.course.best]} batches")
            for name, one in learnt.courses.items()
        ),
        ("touches never seen", f"{100 * learnt.standing.explained:.1f} % of squared depth explained"),
        ("a ball of 15 mm", f"{1e3 * place['mean']:.2f} ± {1e3 * place['sd']:.2f} mm off"),
        ("its greatest depth", f"estimated as {learnt.standing.deepest:.2f} of the true one"),
        ("time", ", ".join(f"{name} {seconds:.0f} s" for name, seconds in learnt.seconds.items())),
    ]
    console.print()
    console.print(pairs(f"Learnt of {skin.name}", rows))
    say_written(console, output / "network.jeit", "report.json", "learning.png")
