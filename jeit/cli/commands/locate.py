"""`jeit locate`: a recording of a calibrated array of microphones in; where and when it was touched out."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import BandHigh, BandLow, Hop, Quiet, Window, intensity_settings, make_folder

if TYPE_CHECKING:
    from jeit.acoustic import Locations, Track

# Of a touch that has moved farther, start and end are printed, not the middle.
_STROKE = 0.015  # m


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
    silence: Annotated[
        Path | None,
        typer.Option(
            help="Recording of the untouched array, samples or WAV, for the noise floor: where touches never pause.",
            show_default=False,
        ),
    ] = None,
    low: BandLow = None,
    high: BandHigh = None,
    window: Window = None,
    hop: Hop = None,
    quiet: Quiet = False,
) -> None:
    """Locate every touch of a recording; writes track.csv, report.json and track.png."""
    import numpy as np
    from rich.console import Console

    from jeit.acoustic import Calibration, Recording, calibrated_intensities, read_recording, track
    from jeit.acoustic import locate as find
    from jeit.acoustic.localisation.localiser import METHODS
    from jeit.acoustic.signal.faults import describe_faults
    from jeit.cli.console import Steps
    from jeit.report import write_track

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
        quiet_sound = None if silence is None else read_recording(silence)
        if quiet_sound is not None and not (isinstance(sound, Recording) and isinstance(quiet_sound, Recording)):
            raise ValueError("--silence is for samples, and must hold samples: intensities have their floor.")
        step("measure intensities")
        heard = calibrated_intensities(sound, known, settings, silence=quiet_sound)
        if len(heard.times) > 1 and np.median(np.diff(heard.times)) > gap:
            raise ValueError(
                f"frames are {np.median(np.diff(heard.times)):g} s apart, more than the --gap of {gap:g} s that ends a "
                "touch: give times in seconds, or a longer --gap."
            )
        step("locate")
        found = find(heard, known, method=method, map_shape=(200, 200) if method == "consistency" else None)
        step("track")
        path = track(found, gap=gap)
        step("write")
        write_track(output, found, path, known, heard, method=method)
    if quiet:
        return
    from rich.table import Table

    from jeit.cli.console import pairs

    said = ", ".join(f"{number} {status}" for status, number in found.counts().items())
    rows = [("frames", f"{len(found.times)}: {said}"), ("touches", str(len(path.touches)))]
    rows += [("faults", describe_faults(found.faults))] * any(found.faults) + [("note", note) for note in found.notes]
    console.print()
    console.print(pairs(found.name, rows))
    if path.touches:
        console.print()
        names = ("touch", "from / s", "to / s", "x / mm", "y / mm", "± / mm", "path / mm")
        table = Table(*names, box=None, padding=(0, 1, 0, 0))
        for column in table.columns:
            column.justify, column.no_wrap = "right", True
        table.add_column("frames", justify="right")
        for row in _rows(found, path):
            table.add_row(*row)
        console.print(table)
    console.print()
    console.print(f"[dim]Written:[/dim] {output / 'track.csv'}, report.json, track.png", soft_wrap=True)


def _rows(found: "Locations", path: "Track") -> Iterator[tuple[str, ...]]:
    """Of every touch, and of the one beside it where there are two at once."""
    import numpy as np

    for number, touch in enumerate(path.touches, 1):
        frames = slice(touch.first, touch.last + 1)
        place = 1e3 * path.position[frames, :2]
        off = 1e3 * float(np.median(np.sqrt(np.linalg.eigvalsh(path.covariance[frames])[:, -1])))
        if touch.length > _STROKE:
            where = [f"{along[0]:z.1f} → {along[-1]:z.1f}" for along in place.T]
        else:
            where = [f"{along.mean():z.1f}" for along in place.T]
        kinds = [kind for kind in found.status[frames] if kind != "no touch"]
        said = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        when = (f"{touch.onset:.3f}", f"{touch.offset:.3f}")
        yield str(number), *when, *where, f"{off:.1f}", f"{1e3 * touch.length:.0f}", said
        both = touch.first + np.flatnonzero(found.status[frames] == "two touches")
        if both.size:
            # Which of the two is the stronger may change: the other is the one farther from the track.
            pair = np.stack([found.position[both], found.second[both]])
            apart = np.linalg.norm(pair - path.position[both], axis=-1)
            other = 1e3 * pair[apart.argmax(axis=0), np.arange(both.size), :2].mean(axis=0)
            when = (f"{found.times[both[0]]:.3f}", f"{found.times[both[-1]]:.3f}")
            yield f"{number}, other", *when, *(f"{along:z.1f}" for along in other), "", "", f"{both.size} two touches"
