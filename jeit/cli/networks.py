"""Frames imaged by a network on the command line: what `reconstruct` and `stream` share of it."""

import sys
from pathlib import Path
from typing import Any


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

    `given`: data, reference, format and description. `unused`: options that a network has no use for, None where they
    were not given. Raises `ValueError` where one was, without a model or a reference, for another method, data of
    another skin or protocol, and where no frame could be imaged.
    """
    import numpy as np
    from rich.console import Console

    from jeit.arguments import counted
    from jeit.cli.console import Steps
    from jeit.cli.options import make_folder
    from jeit.data import read
    from jeit.imaging.stream_preparation import frames_of, parse_frames
    from jeit.report.image_network import DEPTH_FILES, write_depths
    from jeit.touch.networks import read_network, resting_frame, stream_depths
    from jeit.touch.networks.measured import check_measured

    if method != "network":
        raise ValueError(f"--model is for --method network, not {method or 'the default'}; leave one out.")
    if model is None:
        raise ValueError("--method network needs --model, the folder of 'jeit learn image'.")
    if idle := [name for name, value in unused.items() if value is not None]:
        raise ValueError(f"--{idle[0]} has no use with --method network; leave it out.")
    data, reference, *kind = given
    make_folder(output, DEPTH_FILES)
    console = Console(highlight=False)
    with Steps(console, quiet=quiet) as step:
        step("read")
        network = read_network(model)
        base = None if reference is None else read(reference, *kind)
        measured = base if data == "-" else read(data, *kind, like=base)
        assert measured is not None
        check_measured(network, measured)
        rest = resting_frame(network, measured.frame("reference") if base is None else base)
        if data == "-":
            frames: Any = parse_frames(sys.stdin)
        else:
            frames = frames_of(measured if streamed else measured.frame(0 if frame is None else frame))
        step("image")
        found = []
        for one in stream_depths(network, frames, rest):
            found.append(one)
            step.tell(f"frame {one.number}")
            if one.depth is None and not quiet:
                console.print(f"  frame {one.number}: refused. {one.reason}", soft_wrap=True)
        imaged = [one for one in found if one.depth is not None]
        if not imaged:
            reason = found[0].reason if found else "there is none"
            raise ValueError(f"'{data}': {counted(len(found), 'frame')}, and none could be imaged; the first: {reason}")
        step("write")
        nothing = np.full(network.shape, np.nan)
        maps = np.stack([nothing if one.depth is None else one.depth for one in found])
        columns = write_depths(maps, network, output, name=str(data))
    if quiet:
        return
    deepest = columns["depth_m"]
    most = int(np.nanargmax(deepest))
    x, y = 1e3 * columns["x_m"][most], 1e3 * columns["y_m"][most]
    latency = 1e3 * np.median([one.latency for one in found])
    console.print(f"\n{counted(len(imaged), 'frame')} imaged, median {latency:.2f} ms each")
    console.print(f"deepest: {1e3 * deepest[most]:.2f} mm at ({x:.1f}, {y:.1f}) mm, in frame {most}")
    console.print(f"[dim]Written:[/dim] {output / 'frames.csv'}, depth.npz, depth.png, report.json", soft_wrap=True)
