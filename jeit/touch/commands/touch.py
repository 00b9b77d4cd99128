"""`jeit touch`: find contacts, train skins on recorded presses, predict touches with them, and classify gestures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import QuietOption, check_positive, make_folder, naming_options_in_errors
from jeit.touch.commands.touch_health import health
from jeit.touch.commands.touch_watch import gestures, watch

touch = typer.Typer(
    name="touch",
    help="Contacts of a recording; skins that learn, from recorded presses and without a model, where, how hard and by "
    "what they are touched; gestures, named as they end; and damage.",
)
touch.command()(gestures)
touch.command()(watch)
touch.command()(health)


# Number of nodes of the mesh for images. Contacts are located more precisely than the size of the mesh's cells.
_NUM_MESH_NODES = 400
# Assumed frame rate of a recording without times, frames/s.
_DEFAULT_FRAME_RATE = 10.0
# Maximum number of touches that are printed.
_MAX_PRINTED_TOUCHES = 30


@touch.callback(invoke_without_command=True)
def _print_help(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@touch.command()
def contacts(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Frames of the skin: .npz with frames (F, M) and seconds (F,), or a table with a frame a line.",
            show_default=False,
        ),
    ],
    skin: Annotated[
        Path,
        typer.Option(metavar="SKIN.toml", help="Geometry, electrodes and protocol of the skin.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for contacts.csv, contacts.png.", show_default=False)
    ],
    reference: Annotated[
        Path | None,
        typer.Option(help="File of frames of the untouched skin; by default the first frames of the recording."),
    ] = None,
    untouched: Annotated[
        float, typer.Option(help="Seconds at the beginning in which nobody touches the skin, without a --reference.")
    ] = 1.0,
    rate: Annotated[
        float | None, typer.Option(help="Frames per second, if the recording has no times (default 10).")
    ] = None,
    lowers: Annotated[
        bool, typer.Option("--lowers", help="A touch lowers conductivity, as on hydrogel (default: it raises it).")
    ] = False,
    weakest: Annotated[
        float,
        typer.Option(help="Least change of a contact, relative to the strongest of its frame; below are side lobes."),
    ] = 0.4,
    quiet: QuietOption = False,
) -> None:
    """Find all contacts in the frames of a recording, without learning: when, where, and which belong to one touch.

    Writes contacts.csv, a line for each contact in each frame, report.json with the touches, and contacts.png.
    """
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.data import load_description, read_frame_recording
    from jeit.touch import TouchImages, find_recorded_contacts, untouched_frames
    from jeit.touch.reports.touch_watch import CONTACT_FILES, write_contacts

    check_positive({"--untouched": untouched} | ({} if rate is None else {"--rate": rate}))
    if not 0 <= weakest <= 1:
        raise ValueError(f"--weakest must be between 0 and 1; it is {weakest:g}.")
    make_folder(output, CONTACT_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        with naming_options_in_errors({"description": "--skin"}):
            description = load_description(skin)
        recording_of_frames = read_frame_recording(recording, description)
        frame_times = recording_of_frames.seconds
        if frame_times is None:
            frame_times = np.arange(len(recording_of_frames.frames)) / (rate or _DEFAULT_FRAME_RATE)
        with naming_options_in_errors({"untouched": "--untouched"}):
            untouched_voltages = (
                untouched_frames(recording_of_frames, frame_times, untouched)
                if reference is None
                else read_frame_recording(reference, description).frames
            )
        show_step("prepare")
        touch_images = TouchImages.prepare(description, untouched_voltages, progress=show_step.report)
        show_step("find")
        recorded_contacts = find_recorded_contacts(
            touch_images,
            recording_of_frames.frames,
            frame_times,
            untouched_voltages,
            sign=-1 if lowers else 1,
            weakest=weakest,
        )
        show_step("write")
        write_contacts(recorded_contacts, touch_images, output, name=recording.name)
    if quiet:
        return
    console.print(f"\n{counted(len(frame_times), 'frame')}: {counted(len(recorded_contacts.touches), 'touch')}")
    if recording_of_frames.seconds is None and rate is None:
        console.print(f"  note: no times are known: {_DEFAULT_FRAME_RATE:g} frames a second are assumed; see --rate")
    for note in recorded_contacts.notes:
        console.print(f"  note: {note}", soft_wrap=True)
    _print_touches(console, recorded_contacts.touches, touch_images.background)
    print_written_files(console, output / "contacts.csv", "report.json", "contacts.png")


@touch.command()
def fit(
    presses: Annotated[
        Path,
        typer.Argument(
            metavar="PRESSES.npz",
            help="frames (N, M); reference (M,) or (N, M) of the untouched skin; any of positions (N, 2 or 3) m, force "
            "(N,) N, label (N,) text, touched (N, K) true for keys pressed; group (N,) (session, person); time (N,) s.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SKIN", help="Folder for the learnt skin.", show_default=False)
    ],
    method: Annotated[
        str | None,
        typer.Option(
            help="ridge, neighbours, gaussian-process, trees, forest, network, som, blend for places and forces; or "
            "a classifier of labels; auto (default): the method with the lowest error on held-out presses."
        ),
    ] = None,
    description: Annotated[
        Path | None,
        typer.Option(
            metavar="SKIN.toml",
            help="Geometry, electrodes and protocol of the skin, if known: images of the skin are then used as "
            "features too, so that fewer presses are needed.",
        ),
    ] = None,
    channels: Annotated[
        int | None, typer.Option(help="Number of channels to use, the most informative ones (default: all).")
    ] = None,
    per_session: Annotated[
        bool,
        typer.Option(
            "--per-session",
            help="Standardise the changes of each group separately, which removes drift between groups.",
        ),
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Train models of a skin on recorded presses; prints their errors on presses held out in intervals of time.

    Writes skin.skops, report.json and learning.png, a picture of the errors, to the folder SKIN.
    """
    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, name_value_table, plain_console, print_written_files
    from jeit.data import load_description
    from jeit.mesh import OwnMesh
    from jeit.touch import LearntSkin, read_presses
    from jeit.touch.reports.learnt_skin import SKIN_FILES, summary, write_learnt_skin

    require_extra("learn", "learning a skin")
    make_folder(output, SKIN_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        recorded_presses = read_presses(presses)
        forward_model = None
        if description is not None:
            skin_description = load_description(description)
            forward_model = skin_description.model(
                presses, num_points=None if isinstance(skin_description.domain, OwnMesh) else _NUM_MESH_NODES
            )
        show_step("learn")
        with naming_options_in_errors(
            {"num_channels": "--channels", "per_session": "--per-session", "model": "--description"}
        ):
            learnt_skin = LearntSkin.fit(
                recorded_presses,
                method=method or "auto",
                model=forward_model,
                num_channels=channels,
                per_session=per_session,
                progress=show_step.report,
            )
        show_step("write")
        write_learnt_skin(learnt_skin, output)
    if quiet:
        return
    num_presses, num_channels = recorded_presses.frames.shape
    table_rows = [("presses", f"{num_presses} of {num_channels} channels")]
    for quantity_name, standing in learnt_skin.standing.items():
        table_rows += [
            (f"{quantity_name}: method", standing.method),
            (f"{quantity_name}, held out", summary(quantity_name, standing)),
        ]
    console.print()
    console.print(name_value_table(f"Learnt from {recorded_presses.name}", table_rows))
    _print_notes(console, learnt_skin.notes)
    print_written_files(console, output / "skin.skops", "report.json", "learning.png")


@touch.command()
def predict(
    skin: Annotated[
        Path,
        typer.Argument(
            metavar="SKIN", help="Folder that 'jeit touch fit' wrote, or the file skin.skops in it.", show_default=False
        ),
    ],
    frames: Annotated[
        Path,
        typer.Argument(
            metavar="FRAMES.npz",
            help="frames (n, M); reference (M,) or (n, M) if the presses had one; group (n,) if fitted per session.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for touches.csv, report.json, touches.png.", show_default=False),
    ],
    quiet: QuietOption = False,
) -> None:
    """Predict for each frame where, how hard and by what the skin is touched, and how certain that is."""
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.touch import read_frames, read_skin
    from jeit.touch.reports.learnt_skin import TOUCH_FILES, write_touches

    make_folder(output, TOUCH_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        learnt_skin, frame_arrays = read_skin(skin), read_frames(frames)
        show_step("predict")
        touches = learnt_skin.predict(**frame_arrays)
        show_step("write")
        write_touches(touches, output, skin=str(skin), name=frames.name)
    if quiet:
        return
    summary_texts = [counted(len(touches), "frame"), f"{int(touches.unlike.sum())} unlike any learnt from"]
    if touches.position is not None and touches.position_std is not None:
        has_place = np.isfinite(touches.position).all(axis=1)
        summary_texts.append(f"{int(has_place.sum())} with a place")
        if has_place.any():
            summary_texts[-1] += (
                f", standard deviation {1e3 * np.median(touches.position_std[has_place]):.3g} mm (median)"
            )
    console.print("\n" + "; ".join(summary_texts))
    _print_notes(console, touches.notes)
    print_written_files(console, output / "touches.csv", "report.json", "touches.png")


def _print_touches(console, touches, background: float) -> None:
    """Print when and where each touch begins and ends, and its strongest change relative to the background."""
    from rich.table import Table

    column_names = ("touch", "from / s", "to / s", "first place / mm", "last place / mm", "strongest change")
    touch_table = Table(*column_names, box=None, padding=(0, 2, 0, 0))
    for table_column in touch_table.columns:
        table_column.justify = "right"
    for touch_path in touches[:_MAX_PRINTED_TOUCHES]:
        positions_mm = [f"({1e3 * x:+.1f}, {1e3 * y:+.1f})" for x, y in touch_path.position[[0, -1]]]
        relative_peak = touch_path.peak[abs(touch_path.peak).argmax()] / background
        touch_table.add_row(
            str(touch_path.number),
            f"{touch_path.onset:.2f}",
            f"{touch_path.offset:.2f}",
            *positions_mm,
            f"{100 * relative_peak:+.0f} %",
        )
    if touches:
        console.print()
        console.print(touch_table)
    if len(touches) > _MAX_PRINTED_TOUCHES:
        console.print(f"  {len(touches) - _MAX_PRINTED_TOUCHES} more in report.json")


def _print_notes(console, notes) -> None:
    for note in notes:
        console.print(f"  note: {note}", soft_wrap=True)
