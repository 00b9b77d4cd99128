"""`jeit locate`: a recording of a calibrated array of microphones in; where and when it was touched out."""

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import BandHigh, BandLow, Hop, Quiet, Window, intensity_settings, make_folder


def locate(
    recording: Annotated[
        Path,
        typer.Argument(
            help="NPZ file with samples (M, S) and rate in hertz, or intensity (F, M) and times (F,) in seconds; or a "
            "WAV file with a channel for each microphone.",
            show_default=False,
        ),
    ],
    calibration: Annotated[
        Path, typer.Option("--calibration", "-c", help="File of jeit calibrate-microphones.", show_default=False)
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for track.csv, report.json, track.png.", show_default=False)
    ],
    method: Annotated[
        str, typer.Option(help="likelihood, or consistency for the loss of Park 2022 on a 200 × 200 map, refined.")
    ] = "likelihood",
    gap: Annotated[float, typer.Option(help="Seconds of silence that end a touch.")] = 0.15,
    low: BandLow = None,
    high: BandHigh = None,
    window: Window = None,
    hop: Hop = None,
    quiet: Quiet = False,
) -> None:
    """Locate every touch of a recording; writes track.csv, report.json and track.png."""
    from rich.console import Console

    from jeit.acoustic import Calibration, Recording, measure, read_recording, track
    from jeit.acoustic import locate as find
    from jeit.acoustic.localiser import METHODS
    from jeit.cli.console import Steps
    from jeit.track_report import write_track

    if method not in METHODS:
        raise ValueError(f"--method must be one of {', '.join(METHODS)}; it is '{method}'.")
    if not 0 < gap < float("inf"):
        raise ValueError(f"--gap must be positive, in seconds; it is {gap}.")
    settings = intensity_settings(low, high, window, hop)
    make_folder(output, ("track.csv", "report.json", "track.png"))
    console = Console(highlight=False)
    with Steps(console, quiet=quiet) as step:
        step("read")
        known = Calibration.load(calibration)
        sound = read_recording(recording)
        if settings is not None and not isinstance(sound, Recording):
            raise ValueError("--low, --high, --window and --hop are for samples; this recording holds intensities.")
        step("measure intensities")
        heard = measure(sound, known, settings)
        step("locate")
        found = find(heard, known, method=method, map_shape=(200, 200) if method == "consistency" else None)
        step("track")
        overlap = 1.0
        if isinstance(sound, Recording):
            used = settings or known.intensity
            overlap = max(1.0, used.window / used.hop) if used is not None else 4.0
        path = track(found, gap=gap, overlap=overlap)
        step("write")
        write_track(output, found, path, known, heard, method=method)
    if quiet:
        return
    import numpy as np
    from rich.table import Table

    from jeit.cli.console import pairs

    said = ", ".join(f"{number} {status}" for status, number in found.counts().items())
    broken = [f"{k}: {fault}" for k, fault in enumerate(found.faults) if fault]
    rows = [("frames", f"{len(found.times)}: {said}"), ("touches", str(len(path.touches)))]
    rows += [("microphones", fault) for fault in broken] + [("note", note) for note in found.notes]
    console.print()
    console.print(pairs(found.name, rows))
    if path.touches:
        console.print()
        table = Table("touch", "from / s", "to / s", "x / mm", "y / mm", "± / mm", "path / mm", "frames", box=None)
        for column in table.columns:
            column.justify = "right"
        for number, touch in enumerate(path.touches, 1):
            frames = slice(touch.first, touch.last + 1)
            x, y = 1e3 * path.position[frames, :2].mean(axis=0)
            off = 1e3 * float(np.median(np.sqrt(np.linalg.eigvalsh(path.covariance[frames])[:, -1])))
            places = (f"{x:.1f}", f"{y:.1f}", f"{off:.1f}", f"{1e3 * touch.length:.0f}")
            kinds = [kind for kind in found.status[frames] if kind != "no touch"]
            said = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
            table.add_row(str(number), f"{touch.onset:.3f}", f"{touch.offset:.3f}", *places, said)
        console.print(table)
    console.print()
    console.print(f"[dim]Written:[/dim] {output / 'track.csv'}, report.json, track.png", soft_wrap=True)
