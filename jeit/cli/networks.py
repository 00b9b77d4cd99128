"""Frames imaged by a network on the command line: what `reconstruct` and `stream` share of it."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from jeit.touch.networks import ImageNetwork


class _Given(NamedTuple):
    """Frames of a file, volts, NaN where there is no reading, what number each has there, and the reference beside
    them, if there is one."""

    frames: "Float[np.ndarray, 'F M']"
    numbers: "Int[np.ndarray, ' F']"
    reference: "Float[np.ndarray, 'r M'] | None"


def image_by_network(
    model: Path | None,
    given: tuple[Any, Path | None, str | None, str | None],
    output: Path,
    *,
    method: str | None,
    unused: dict[str, Any],
    quiet: bool,
    frame: int | str | None = None,
    streamed: bool = False,
) -> None:
    """Image a file's frames, all of them where they are `streamed`, or those of standard input, "-".

    `given`: data, reference, format and description: that of the skin which the network learnt, or of a measurement; a
    table of one frame a row needs neither. `unused`: options that a network has no use for, None where they were not
    given. Raises `ValueError` where one was, without a model or a reference, for another method, data of another skin
    or protocol, and where no frame could be imaged.
    """
    import numpy as np

    from jeit.arguments import counted
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.cli.options import make_folder
    from jeit.design import describes_skin, read_described_skin
    from jeit.imaging.stream_preparation import parse_frames
    from jeit.report.image_network import DEPTH_FILES, write_depths
    from jeit.touch.networks import read_network, resting_frame, stream_depths

    if method != "network":
        raise ValueError(f"--model is for --method network, not {method or 'the default'}; leave one out.")
    if model is None:
        raise ValueError("--method network needs --model, the folder of 'jeit learn image'.")
    if idle := [name for name, value in unused.items() if value is not None]:
        raise ValueError(f"--{idle[0]} has no use with --method network; leave it out.")
    data, reference, kind, description = given
    make_folder(output, DEPTH_FILES)
    console = plain_console()
    with Steps(console, quiet=quiet) as step:
        step("read")
        skin = None
        if description is not None and describes_skin(description):
            skin, description = read_described_skin(description), None
        network = read_network(model, skin=skin)
        plain = skin is not None
        base = None if reference is None else _read(reference, kind, description, network, None, plain=plain)
        still = None if base is None else base.frames
        if data == "-":
            frames, numbers = parse_frames(sys.stdin), None
        else:
            one = None if streamed else 0 if frame is None else frame
            measured = _read(data, kind, description, network, one, plain=plain, like=reference)
            frames, numbers, still = measured.frames, measured.numbers, measured.reference if still is None else still
        if still is None:
            raise ValueError("--reference: give a file of frames of the skin that nobody touches.")
        rest = resting_frame(still, str(reference or data))
        step("image")
        found = []
        for one in stream_depths(network, frames, rest):
            own = one.number if numbers is None else int(numbers[one.number])
            found.append(one._replace(number=own))
            step.tell(f"frame {own}")
            if one.depth is None and not quiet:
                console.print(f"  frame {own}: refused. {one.reason}", soft_wrap=True)
        imaged = [one for one in found if one.depth is not None]
        if not imaged:
            reason = found[0].reason if found else "there is none"
            raise ValueError(f"'{data}': {counted(len(found), 'frame')}, and none could be imaged; the first: {reason}")
        step("write")
        nothing = np.full(network.shape, np.nan)
        maps = np.stack([nothing if one.depth is None else one.depth for one in found])
        columns = write_depths(maps, network, output, name=str(data), numbers=[one.number for one in found])
    if quiet:
        return
    deepest = columns["depth_m"]
    most = int(np.nanargmax(deepest))
    latency = 1e3 * np.median([one.latency for one in found])
    console.print(f"\n{counted(len(imaged), 'frame')} imaged, median {latency:.2f} ms each")
    if deepest[most] > network.floor:
        x, y = 1e3 * columns["x_m"][most], 1e3 * columns["y_m"][most]
        number = found[most].number
        console.print(f"deepest: {1e3 * deepest[most]:.2f} mm at ({x:.1f}, {y:.1f}) mm, in frame {number}")
    else:
        console.print(f"untouched: nothing is deeper than noise makes it, {1e3 * network.floor:.2g} mm")
    say_written(console, output / "frames.csv", "depth.npz", "depth.png", "report.json")


def _read(
    path: Path,
    kind: str | None,
    description: str | None,
    network: "ImageNetwork",
    frame: int | str | None,
    *,
    plain: bool,
    like: Path | None = None,
) -> _Given:
    """All frames of a file, or the one asked for. A table that nothing describes has a frame a row, in the network's
    order of channels, and so has one that is `plain`; its units and columns are those of the file that it is `like`."""
    import numpy as np

    from jeit.data import load_description, read, read_frame_recording, table
    from jeit.imaging.stream_preparation import frames_of
    from jeit.touch.networks.measured import check_measured

    described = kind is not None or description is not None or table.find_description(path) is not None
    if plain or (table.recognises(path) and not described):
        beside = None if like is None or plain else table.find_description(like)
        recording = read_frame_recording(path, None if beside is None else load_description(beside))
        frames, still = recording.frames, recording.reference
        if frames.shape[1] != network.made_for["channels"]:
            raise ValueError(
                f"'{path}' has {frames.shape[1]} channels, and the network was trained for "
                f"{network.made_for['channels']}; train one for these."
            )
        numbers = np.arange(len(frames))
        if frame is not None:
            if not (isinstance(frame, int) and -len(frames) <= frame < len(frames)):
                raise ValueError(f"--frame must be a number from 0 to {len(frames) - 1}; it is {frame!r}.")
            numbers = numbers[[frame]]
        return _Given(frames[numbers], numbers, still)
    measured = read(path, kind, description)
    check_measured(network, measured)
    names, numbers = measured.frame_names, np.arange(measured.num_frames)
    still = frames_of(measured.frame("reference")) if "reference" in names else None
    frames = frames_of(measured)
    if frame is not None:
        frames = frames_of(measured.frame(frame))
        numbers = numbers[[names.index(frame) if isinstance(frame, str) else frame]]
    return _Given(frames, numbers, still)
