"""Commands for networks that image indentation depth: train a network, and image frames with it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from jeit.cli.options import NETWORK_METHOD, QuietOption, check_seed, make_folder, naming_options_in_errors

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from jeit.touch.networks import FrameDepth, ImageNetwork


class _FrameFile(NamedTuple):
    """Frames read from a file.

    `frames` (F, M): volts, NaN where there is no reading; `numbers` (F,): number of each frame in the file; `reference`
    (r, M): frames of the untouched skin in the same file, volts, or None.
    """

    frames: "Float[np.ndarray, 'F M']"
    frame_numbers: "Int[np.ndarray, ' F']"
    untouched_frames: "Float[np.ndarray, 'r M'] | None"


def image_by_network(
    model: Path | None,
    inputs: tuple[Any, Path | None, str | None, str | None],
    output: Path,
    *,
    method: str | None,
    unused_options: dict[str, Any],
    quiet: bool,
    frame: int | str | None = None,
    streamed: bool = False,
) -> None:
    """Image frames by the network in the file or folder `model`, and write the results to the folder `output`.

    `inputs`: data file, or "-" for standard input; file of reference frames; format of both files; and description of
    the skin that the network was trained for, or of a measurement. A table with one frame in each row needs neither
    format nor description. `frame`: number of the frame to image, by default the first; if `streamed`, all frames are
    imaged. `unused_options`: values of command-line options that do not apply to networks, None if not given. Raises
    `ValueError` if such an option was given, if there is no model or no reference, if `method` is not "network", for
    data of another skin or protocol, and if no frame could be imaged.
    """
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.cli.options import make_folder
    from jeit.cli.streams import FrameCounter, StreamStopper
    from jeit.design import describes_skin, read_described_skin
    from jeit.imaging.stream_preparation import parse_frames
    from jeit.report.stream import PICTURES
    from jeit.touch.networks import read_network, resting_frame, stream_depths
    from jeit.touch.reports.image_network import DEPTH_FILES, write_depths

    if method != NETWORK_METHOD:
        raise ValueError(f"--model is for --method network, not {method or 'the default'}; leave one out.")
    if model is None:
        raise ValueError("--method network needs --model, the folder of 'jeit learn image'.")
    if ineffective_options := [
        option_name for option_name, option_value in unused_options.items() if option_value is not None
    ]:
        raise ValueError(f"--{ineffective_options[0]} has no use with --method network; leave it out.")
    frames_path, reference, file_kind, description_path = inputs
    console = plain_console()
    with StreamStopper() as stream_stopper, Steps(console, quiet=quiet) as show_step:
        make_folder(output, DEPTH_FILES)
        show_step("read")
        described_skin = None
        if description_path is not None and describes_skin(description_path):
            described_skin, description_path = read_described_skin(description_path), None
        network = read_network(model, skin=described_skin)
        is_read_as_table = described_skin is not None
        base_frames = (
            None
            if reference is None
            else _read_frame_file(
                "--reference", reference, file_kind, description_path, network, None, is_table=is_read_as_table
            )
        )
        untouched_frames = None if base_frames is None else base_frames.frames
        if frames_path == "-":
            frames, frame_numbers = parse_frames(sys.stdin), None
        else:
            frame_index = None if streamed else 0 if frame is None else frame
            frame_file = _read_frame_file(
                "DATA",
                frames_path,
                file_kind,
                description_path,
                network,
                frame_index,
                is_table=is_read_as_table,
                format_example=reference,
            )
            frames, frame_numbers, untouched_frames = (
                frame_file.frames,
                frame_file.frame_numbers,
                frame_file.untouched_frames if untouched_frames is None else untouched_frames,
            )
        if untouched_frames is None:
            raise ValueError("--reference: give a file of frames of the untouched skin.")
        reference_frame = resting_frame(untouched_frames, str(reference or frames_path))
        show_step("image")
        frame_counter = FrameCounter(show_step, None if frame_numbers is None else len(frame_numbers))

        def print_refused_frame(frame_depth: "FrameDepth") -> None:
            frame_counter.count_frame()
            if frame_depth.depth is None and not quiet:
                console.print(f"  frame {frame_depth.number}: refused. {frame_depth.reason}", soft_wrap=True)

        frame_depths = stream_depths(network, stream_stopper.frames_until_signal(frames), reference_frame)
        if frame_numbers is not None:
            frame_depths = (
                numbered_depth._replace(number=int(frame_numbers[numbered_depth.number]))
                for numbered_depth in frame_depths
            )
        report_drawing = stream_stopper.drawing_reporter(PICTURES, show_step)
        with stream_stopper.exit_after_signal(frame_counter, "frames.csv", "depth.npz"):
            written_depths = write_depths(
                frame_depths,
                network,
                output,
                name=str(frames_path),
                progress=print_refused_frame,
                drawing=report_drawing,
            )
    if quiet:
        return
    deepest_frame, median_latency_ms = written_depths.deepest, 1e3 * np.median(written_depths.latency)
    console.print(f"\n{counted(written_depths.imaged, 'frame')} imaged, median {median_latency_ms:.2f} ms each")
    if deepest_frame.depth > network.floor:
        x, y = 1e3 * deepest_frame.middle
        console.print(
            f"deepest: {1e3 * deepest_frame.depth:.2f} mm at ({x:.1f}, {y:.1f}) mm, in frame {deepest_frame.number}"
        )
    else:
        console.print(f"untouched: nothing is deeper than noise makes it, {1e3 * network.floor:.2g} mm")
    print_written_files(console, output / "frames.csv", "depth.npz", "depth.png", "report.json")


def _read_frame_file(
    option: str,
    frames_path: Path,
    file_kind: str | None,
    description: str | None,
    network: "ImageNetwork",
    wanted_frame: int | str | None,
    *,
    is_table: bool,
    format_example: Path | None = None,
) -> _FrameFile:
    """Read all frames of a file, or only the frame with the number `wanted_frame`.

    A table without a description, or any file if `is_table`, has one frame in each row, with its channels in the order
    of the network. Its units and columns are those of the file `format_example` if that file has a description, unless
    `is_table`.
    """
    import numpy as np

    from jeit.cli.options import read_file
    from jeit.data import load_description, read_frame_recording
    from jeit.data.formats import table
    from jeit.imaging.stream_preparation import frames_of
    from jeit.touch.networks.depth_maps import check_measured

    has_description = (
        file_kind is not None or description is not None or table.find_description(frames_path) is not None
    )
    if is_table or (table.recognises(frames_path) and not has_description):
        description_file = None if format_example is None or is_table else table.find_description(format_example)
        recording = read_frame_recording(
            frames_path, None if description_file is None else load_description(description_file)
        )
        frames, untouched_frames = recording.frames, recording.reference
        if frames.shape[1] != network.made_for["channels"]:
            raise ValueError(
                f"'{frames_path}' has {frames.shape[1]} channels, and the network was trained for "
                f"{network.made_for['channels']}; train one for these."
            )
        frame_numbers = np.arange(len(frames))
        if wanted_frame is not None:
            if not (isinstance(wanted_frame, int) and -len(frames) <= wanted_frame < len(frames)):
                raise ValueError(f"--frame must be a number from 0 to {len(frames) - 1}; it is {wanted_frame!r}.")
            frame_numbers = frame_numbers[[wanted_frame]]
        return _FrameFile(frames[frame_numbers], frame_numbers, untouched_frames)
    measurement = read_file(option, frames_path, file_kind, description)
    check_measured(network, measurement)
    frame_names, frame_numbers = measurement.frame_names, np.arange(measurement.num_frames)
    untouched_frames = frames_of(measurement.frame("reference")) if "reference" in frame_names else None
    frames = frames_of(measurement)
    if wanted_frame is not None:
        frames = frames_of(measurement.frame(wanted_frame))
        frame_numbers = frame_numbers[
            [frame_names.index(wanted_frame) if isinstance(wanted_frame, str) else wanted_frame]
        ]
    return _FrameFile(frames, frame_numbers, untouched_frames)


learn = typer.Typer(name="learn", help="Train networks on simulated touches of a described skin.")


@learn.callback(invoke_without_command=True)
def _print_help(context: typer.Context) -> None:
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
    preset: Annotated[str, typer.Option(help="full; or quick, a training of two minutes.")] = "full",
    design: Annotated[
        str,
        typer.Option(help="unrolled: a network with the skin's forward model; three-stages: that of Park et al. 2022."),
    ] = "unrolled",
    touches: Annotated[
        int | None,
        typer.Option(help="Number of simulated touches in the training set (default: that of the preset).", min=1),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random touches and of the initial weights.")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a dask scheduler whose workers simulate the touches (default: this process)."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Train a network that images indentation depth: simulates touches, trains on them, and prints the accuracy.

    Writes network.jeit, report.json and learning.png to the folder MODEL. Simulated touches and unfinished trainings
    are stored in MODEL/work: if the command is interrupted, the same command resumes.
    """
    from contextlib import ExitStack

    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, name_value_table, plain_console, print_written_files
    from jeit.design import read_described_skin
    from jeit.design.commands.study import connect_to_scheduler
    from jeit.touch.networks import learn_images
    from jeit.touch.reports.image_network import LEARNT_FILES, write_learnt_images

    check_seed(seed)
    require_extra("learn", "a network that images touches")
    require_extra("cluster", "a store of simulated touches")
    make_folder(output, LEARNT_FILES)
    console = plain_console()
    with ExitStack() as exit_stack:
        show_step = exit_stack.enter_context(Steps(console, quiet=quiet))
        show_step("read")
        with naming_options_in_errors({"path": "skin"}):
            described_skin = read_described_skin(skin)
        dask_client = None if scheduler is None else exit_stack.enter_context(connect_to_scheduler(scheduler))
        show_step("learn")
        learnt = learn_images(
            described_skin,
            output,
            preset=preset,
            design=design,
            touches=touches,
            seed=seed,
            client=dask_client,
            progress=show_step.report,
        )
        show_step("write")
        write_learnt_images(learnt, output)
    if quiet:
        return
    place_errors = learnt.standing.place
    table_rows = [
        ("network", f"{learnt.network.design}, {learnt.network.made_for['channels']} channels"),
        *(
            (
                stage_name,
                f"{training_result.reason}, best after {training_result.course.steps[training_result.course.best]} "
                "batches",
            )
            for stage_name, training_result in learnt.courses.items()
        ),
        ("touches never seen", f"{100 * learnt.standing.explained:.1f} % of squared depth explained"),
        ("a ball of 15 mm", f"{1e3 * place_errors['mean']:.2f} ± {1e3 * place_errors['sd']:.2f} mm off"),
        ("its greatest depth", f"estimated as {learnt.standing.deepest:.2f} of the true one"),
        (
            "time",
            ", ".join(f"{stage_name} {stage_seconds:.0f} s" for stage_name, stage_seconds in learnt.seconds.items()),
        ),
    ]
    console.print()
    console.print(name_value_table(f"Learnt of {skin.name}", table_rows))
    print_written_files(console, output / "network.jeit", "report.json", "learning.png")
