"""`jeit listen`: classify the sounds of a recording; `jeit listen fit`: train the classifier on labelled clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from jeit.cli.options import QuietOption, check_at_least, check_seed, make_folder, naming_options_in_errors

if TYPE_CHECKING:
    from jeit.touch.listening import SoundLabels


_LOUDNESS_CHOICES = {"auto": None, "counts": True, "ignored": False}


class _GroupNamedCommand(TyperCommand):
    """Command whose name in help texts and error messages is that of its command group, `jeit listen`."""

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        return super().make_context(parent.info_name, args, parent=parent.parent, **extra)


class _DefaultCommandGroup(TyperGroup):
    """Command group that runs its first command unless the first argument is --help or the name of a command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] != "--help" and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        next(iter(self.commands.values())).format_help(ctx, formatter)


listen = typer.Typer(
    name="listen",
    cls=_DefaultCommandGroup,
    help="Classify the sounds in a recording, every 0.1 s; 'listen fit' trains the classifier on labelled clips.",
)


@listen.callback(invoke_without_command=True)
def _print_help(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@listen.command("recording", cls=_GroupNamedCommand, hidden=True)
def classify_recording(
    recording: Annotated[
        Path,
        typer.Argument(
            help="WAV file of one or more channels, or NPZ file with samples (M, S) and rate in hertz; FLAC, Ogg and "
            "other formats if soundfile is installed.",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            "--model",
            "-m",
            help="Folder that 'jeit listen fit' wrote, or the file listener.jeit in it.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for events.csv, report.json, timeline.png.", show_default=False),
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            "-c",
            help="File that 'jeit calibrate-microphones' wrote; with it, places are estimated.",
            show_default=False,
        ),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Classify the sounds in a recording, every 0.1 s; writes events.csv, report.json and timeline.png.

    MODEL is a classifier trained on labelled clips: see 'jeit listen fit --help'.
    """
    from jeit.acoustic import Calibration, Recording, read_recording
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.touch.listening import Listener
    from jeit.touch.reports.listener import SOUND_LABEL_FILES, write_sound_labels

    make_folder(output, SOUND_LABEL_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        listener = Listener.read(model)
        microphone_calibration = None if calibration is None else Calibration.load(calibration)
        sounds = read_recording(recording)
        if not isinstance(sounds, Recording):
            raise ValueError(f"{recording.name}: it holds intensities; sounds can be classified only in samples.")
        show_step("listen")
        sound_labels = listener.classify(sounds, calibration=microphone_calibration)
        show_step("write")
        write_sound_labels(sound_labels, output, model=str(model))
    if not quiet:
        _print_summary(console, sound_labels)
        print_written_files(console, output / "events.csv", "report.json", "timeline.png")


@listen.command()
def fit(
    clips: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER-BY-CLASS",
            help="Folder with a sub-folder for each class, which contains clips of that class: WAV, NPZ, or a "
            "format that "
            "soundfile reads. Clips in a folder within these, such as of one person, are held out together.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MODEL", help="Folder for the model.", show_default=False)
    ],
    method: Annotated[
        str,
        typer.Option(
            help="network, paper-network, trees, spectrum or linear; auto: the method that classifies most "
            "held-out clips "
            "correctly."
        ),
    ] = "auto",
    loudness: Annotated[
        str,
        typer.Option(
            help="counts: loudness is a feature; ignored: it is not, so that gain does not matter; auto: counts "
            "if more "
            "held-out clips are then classified correctly."
        ),
    ] = "auto",
    batches: Annotated[
        int | None, typer.Option(help="Maximum number of batches for which a network is trained (default 1500).")
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            help="Seed of the random numbers for the initial weights and the training of networks.",
            min=0,
            max=2**32 - 1,
        ),
    ] = 0,
    quiet: QuietOption = False,
) -> None:
    """Train a classifier of sounds on labelled clips; prints its accuracy on held-out clips.

    Writes listener.jeit, report.json and learning.png, the confusion matrix, to the folder MODEL.
    If the command is interrupted, the same command resumes the training.
    """
    import shutil

    import jax

    from jeit.arguments import counted
    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, name_value_table, plain_console, print_written_files
    from jeit.touch.listening import Listener, read_clips
    from jeit.touch.listening.learners import MAX_TRAINING_BATCHES
    from jeit.touch.reports.listener import LISTENER_FILES, summary, write_listener

    require_extra("learn", "training a classifier of sounds")
    if loudness not in _LOUDNESS_CHOICES:
        raise ValueError(f"--loudness must be one of {', '.join(_LOUDNESS_CHOICES)}; it is '{loudness}'.")
    check_at_least({"--batches": (batches, 1)})
    check_seed(seed)
    if batches is not None and method in ("trees", "spectrum", "linear"):
        raise ValueError(f"--batches applies to networks only, not to --method {method}; leave one out.")
    if clips.resolve() in output.resolve().parents or clips.resolve() == output.resolve():
        raise ValueError(f"--output {output} lies in the folder of clips, where it would be a class; give another.")
    make_folder(output, LISTENER_FILES)
    console = plain_console()
    # Folder of unfinished trainings, deleted at the end.
    training_folder = output / "training"
    with Steps(console, quiet=quiet) as show_step:
        show_step("read")
        labelled_clips = read_clips(clips, progress=show_step.report)
        show_step("learn")
        with naming_options_in_errors({"method": "--method", "labels": "FOLDER-BY-CLASS"}):
            listener = Listener.fit(
                labelled_clips,
                method=method,
                loudness=_LOUDNESS_CHOICES[loudness],
                key=jax.random.key(seed),
                batches=batches or MAX_TRAINING_BATCHES,
                folder=training_folder,
                progress=show_step.report,
            )
        show_step("write")
        write_listener(listener, output)
        shutil.rmtree(training_folder, ignore_errors=True)
    if quiet:
        return
    channels_text = counted(listener.channels, "channel")
    table_rows = [
        ("clips", f"{counted(len(labelled_clips), 'clip')} of {len(listener.names)} classes, {channels_text}"),
        ("sound", f"up to {listener.highest:g} Hz"),
        ("loudness", "counts" if listener.loudness else "ignored"),
        ("method", listener.method),
        ("held out", summary(listener)),
    ]
    table_rows += [("note", note) for note in listener.notes]
    console.print()
    console.print(name_value_table(f"Learnt from {listener.name}", table_rows))
    print_written_files(console, output / "listener.jeit", "report.json", "learning.png")


def _print_summary(console, sound_labels: "SoundLabels") -> None:
    """Print the class of the whole recording, and a line for each sound in it."""
    from rich.table import Table

    from jeit.cli.console import name_value_table

    recording_class, class_probability = sound_labels.whole
    class_text = f"{recording_class}, {100 * class_probability:.0f} %" if recording_class else "nothing"
    table_rows = [
        ("windows", str(len(sound_labels))),
        ("as a whole", class_text),
        *(("note", note) for note in sound_labels.notes),
    ]
    console.print()
    console.print(name_value_table(sound_labels.name, table_rows))
    console.print()
    has_positions = sound_labels.position is not None
    column_names = ("sound", "from / s", "to / s", "sure / %", *(("x / mm", "y / mm") if has_positions else ()))
    sound_table = Table(*column_names, box=None, padding=(0, 2, 0, 0))
    for table_column in sound_table.columns[1:]:
        table_column.justify = "right"
    for event in sound_labels.events:
        position_cells = (
            [""] * (2 * has_positions)
            if event.place is None
            else [f"{1e3 * coordinate:z.1f}" for coordinate in event.place[:2]]
        )
        certainty_text = f"{100 * event.probability:.0f}" if event.name else ""
        sound_table.add_row(
            event.name or "quiet", f"{event.start:.2f}", f"{event.end:.2f}", certainty_text, *position_cells
        )
    console.print(sound_table)
    console.print()
