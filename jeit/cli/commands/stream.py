"""`jeit stream`: frame after frame to images, from a file or from standard input."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import Contact, Description, Format, Quiet, make_folder, number_or_name

_COLUMNS = ("frame", "status", "channels", "misfit", "iterations", "latency_ms", "x_m", "y_m", "peak", "reason")


def stream(
    data: Annotated[
        str,
        typer.Argument(
            help="Measured file with the frames, or - for standard input: a frame a line, its voltages parted by "
            "spaces or commas (nan: no reading).",
            show_default=False,
        ),
    ],
    reference: Annotated[
        Path,
        typer.Option(help="Measured file of the undisturbed body; says protocol and electrodes.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for frames.csv and images.npz.", show_default=False)
    ],
    format: Format = None,
    description: Description = None,
    method: Annotated[str, typer.Option(help="gauss-newton, levenberg-marquardt or linear.")] = "gauss-newton",
    hyperparameter: Annotated[
        str | None,
        typer.Option(help="A number, or the rule that chooses it (default noise-figure).", metavar="VALUE|RULE"),
    ] = None,
    steps: Annotated[int, typer.Option(help="Most iterations for a frame.")] = 4,
    memory: Annotated[
        float, typer.Option(help="Frames over which an image changes: smooths in time (Kalman). 0: every frame alone.")
    ] = 0.0,
    contact: Contact = None,
    num_points: Annotated[int, typer.Option(help="Nodes of the mesh, about.")] = 1200,
    quiet: Quiet = False,
) -> None:
    """Image every frame of DATA as it comes; bad frames are refused with the reason, and the stream goes on.

    Writes frames.csv line by line (x, y and peak of the strongest change, metres and S), and at the end images.npz with
    `conductivity` (frames, cells), NaN for frames that were refused, `points`, `cells` and `background`.
    """
    import csv

    import numpy as np
    from rich.console import Console

    from jeit.cli.console import Steps, scaled
    from jeit.data import read
    from jeit.imaging.preparation import Clock, body_of, calibrated_model, select_frames
    from jeit.inverse import Imager
    from jeit.inverse import stream as images_of
    from jeit.inverse.stream.imager import check_settings
    from jeit.mesh import centroids

    check_settings(method, steps, memory)
    make_folder(output, ("frames.csv", "images.npz"))
    (output / "images.npz").unlink(missing_ok=True)  # an earlier stream's, which would not go with these frames
    console = Console(highlight=False)
    with Steps(console, quiet=quiet) as step:
        step("read")
        empty = read(reference, format, description)
        measured = empty if data == "-" else read(Path(data), format, description)
        _, base = select_frames(measured, empty)
        if not base.protocol.same_patterns(measured.protocol):
            raise ValueError(f"'{measured.name}' was measured with another protocol than the reference '{base.name}'.")
        domain, electrodes = body_of(measured, base)
        calibration, _ = calibrated_model(
            base, domain, electrodes, contact=contact, num_points=num_points, clock=Clock(step)
        )
        step("prepare")
        background = calibration.conductivity
        imager = Imager.create(
            calibration.model,
            background,
            reference=base.filled()[0],
            mask=base.mask[0],
            method=method,
            hyperparameter=None if hyperparameter is None else number_or_name(hyperparameter),
            steps=steps,
            memory=memory,
        )
    mesh = calibration.model.mesh
    centre, kept, latencies, counts = np.asarray(centroids(mesh)), [], [], {}
    frames = _lines(sys.stdin) if data == "-" else np.where(measured.mask, measured.voltages, np.nan)
    with open(output / "frames.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for one in images_of(imager, frames):
            row: list[object] = [one.number, one.status, int(one.usable.sum())]
            if one.conductivity is None:
                kept.append(np.full(mesh.num_cells, np.nan, np.float32))
                row += ["", one.iterations, f"{1e3 * one.latency:.3f}", "", "", "", one.reason]
            else:
                kept.append(one.conductivity.astype(np.float32))
                change = one.conductivity - float(background)
                peak = int(np.argmax(np.abs(change)))
                place = [f"{value:.5f}" for value in centre[peak, :2]]
                misfit = "" if np.isnan(one.misfit) else f"{one.misfit:.4g}"
                row += [misfit, one.iterations, f"{1e3 * one.latency:.3f}", *place, f"{change[peak]:.5g}", one.reason]
                latencies.append(one.latency)
            table.writerow(row)
            file.flush()  # whoever follows the file sees every frame at once
            counts[one.status] = counts.get(one.status, 0) + 1
            if one.reason and not quiet:
                console.print(f"  frame {one.number}: {one.status}. {one.reason}", soft_wrap=True)
    if not kept:
        raise ValueError(f"'{data}': there was no frame in it.")
    np.savez_compressed(
        output / "images.npz",
        conductivity=np.stack(kept),
        background=np.asarray(background),
        points=np.asarray(mesh.points),
        cells=np.asarray(mesh.cells),
    )
    if not quiet:
        said = ", ".join(f"{number} {status}" for status, number in sorted(counts.items()))
        console.print(f"\n{len(kept)} frames: {said}; background {scaled(float(background), 'S')}")
        if latencies:
            middle, high = (1e3 * np.quantile(latencies, share) for share in (0.5, 0.99))
            console.print(f"latency: median {middle:.2f} ms, 99 % within {high:.2f} ms")
        console.print(f"[dim]Written:[/dim] {output / 'frames.csv'}, images.npz", soft_wrap=True)


def _lines(file) -> Iterator[object]:
    """A frame for every line that is not empty; one that does not hold numbers comes as its text, and is refused."""
    for line in file:
        parts = line.strip().rstrip(",;").replace(";", ",").split(",")
        words = line.split() if len(parts) == 1 else [part.strip() or "nan" for part in parts]
        if not line.strip():
            continue
        try:
            yield [float(word) for word in words]
        except ValueError:
            yield line
