"""Files of series of frames: pictures, arrays, tables, reports and films."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jeit.electrodes import AbstractElectrodes
from jeit.image import Oscillation, oscillation
from jeit.imaging.sequence import ImagedSequence
from jeit.mesh import Mesh
from jeit.report.folder import describe_measurement, results, to_plain_values, write_json, write_rows

FILM_FORMATS = (".gif", ".mp4")
FILM_FRAMES = 120
"""Maximum number of frames of a film."""
# Maximum frame rate of a film in frames per second, and default frame rate if that of the stream is not known.
_MAX_FILM_RATE, _DEFAULT_FILM_RATE = 25.0, 10.0


def check_film(name: str) -> str:
    """Check the name of a film's file, and return it. Raises `ValueError` for an unknown suffix, a path with a folder,
    and for .mp4 if ffmpeg is not installed."""
    if Path(name).suffix.lower() not in FILM_FORMATS or Path(name).name != name:
        raise ValueError(f"film must be a name that ends in {' or '.join(FILM_FORMATS)}; it is '{name}'.")
    if name.lower().endswith(".mp4"):
        from matplotlib.animation import FFMpegWriter

        if not FFMpegWriter.isAvailable():
            raise ValueError(f"film: '{name}' needs ffmpeg, which is not installed; name it .gif, or install ffmpeg.")
    return name


def write_film(
    path: str | Path,
    mesh: Mesh,
    changes: Float[np.ndarray, "F m"],
    electrodes: AbstractElectrodes | None = None,
    *,
    titles: Sequence[str] | None = None,
    rate: float | None = None,
    limit: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write the frames of a stream as a film with one colour scale.

    **Arguments:**

    - `path`: file of the film, .gif or .mp4.
    - `mesh`, `electrodes`: as in `jeit.plot.plot_image`.
    - `changes`, `titles`: as in `jeit.plot.plot_frames`; refused frames are shown as refused.
    - `limit`: end of the colour scale, S (3-D: S/m); default: the maximum over all frames.
    - `rate`: frames per second of the stream; the film lasts as long as the stream, but has at most 25 frames per
      second. Default: the film has 10 frames per second.
    - `progress`: called with the number of frames drawn.

    For longer streams, 120 evenly spaced frames are drawn. Raises `ValueError` for an unknown suffix, for .mp4 if
    ffmpeg is not installed, and if every frame was refused.

    **Example:**

    ```python
    write_film("press.gif", mesh, np.outer(np.linspace(0, 1, 5), np.ones(mesh.num_cells)))
    ```
    """
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    from jeit.plot.colours import LIGHT_GREY, ColourScale
    from jeit.plot.imaging.image import slice_text
    from jeit.plot.imaging.series import FramePicture, fit_scale, select_frames

    path, frame_changes = Path(path), np.asarray(changes)
    check_film(path.name)
    frame_titles = [f"frame {number}" for number in range(len(frame_changes))] if titles is None else list(titles)
    figure = Figure(figsize=(5.0, 4.4), layout="constrained")
    colour_scale, selected_frames = (
        fit_scale(frame_changes, mesh, ColourScale(limit=limit)),
        select_frames(len(frame_changes), FILM_FRAMES),
    )
    frame_picture = FramePicture(figure.subplots(), mesh, electrodes, colour_scale)
    colour_scale.draw_bar(frame_picture.ax, frame_picture.mappable)
    frame_picture.show(frame_changes[selected_frames[0]], frame_titles[selected_frames[0]])
    if slice_caption := slice_text(mesh):
        figure.supxlabel(slice_caption, fontsize=9, color=LIGHT_GREY)
    figure.canvas.draw()
    figure.set_layout_engine("none")  # keeps the same layout in all frames
    film_rate = min(
        _DEFAULT_FILM_RATE if rate is None else rate * len(selected_frames) / len(frame_changes), _MAX_FILM_RATE
    )
    writer = (PillowWriter if path.suffix.lower() == ".gif" else FFMpegWriter)(fps=max(film_rate, 0.1))  # pyright: ignore
    with writer.saving(figure, str(path), 80):
        for film_position, frame_number in enumerate(selected_frames):
            frame_picture.show(frame_changes[frame_number], frame_titles[frame_number])
            writer.grab_frame()
            if progress is not None:
                progress(f"{film_position + 1} of {len(selected_frames)}")


SERIES_FILES = ("series.png", "series.npz", "regions.csv", "report.json")


def write_series(
    series_result: ImagedSequence,
    folder: str | Path,
    *,
    regions: Mapping[str, Bool[np.ndarray, " m"]] | None = None,
    oscillations: Sequence[Oscillation] = (),
    film: str | None = None,
) -> dict[str, Any]:
    """Write `series.png`, `series.npz`, `regions.csv`, `report.json` and, if its name is given, a film to `folder`;
    return the report.

    **Arguments:**

    - `series_result`: the images.
    - `folder`: created if needed.
    - `regions`: cells (m,) of each region, by name; default: the whole body.
    - `oscillations`: oscillations of `series_result.series.changes`.
    - `film`: name of the film's file, ending in .gif or .mp4.

    `regions.csv` has the time in seconds, or the number of the frame, and the mean change of each region, S/m (2-D:
    S), empty for refused frames. `series.npz` has `changes` (F, m), `times` (F,), `background`, `points`, `cells`,
    the functional image `functional` (m,), and, for k oscillations, `frequency` (k,), `amplitude` (k, m) and
    `phase` (k, m) in radians. Raises `ValueError` for names that cannot be a folder or a film.

    **Example:**

    ```python
    report = write_series(series, "out")
    ```
    """
    series, model = series_result.series, series_result.prepared.model
    region_masks = {"whole body": np.ones(series.mesh.num_cells, bool)} if not regions else dict(regions)
    film_names = () if film is None else (check_film(film),)
    region_curves = {name: series.mean_change(region) for name, region in region_masks.items()}
    report = _series_report(series_result, region_curves, oscillations)
    from jeit.plot.imaging.series import plot_series

    with results(folder, (*SERIES_FILES, *film_names)) as temporary_folder:
        plot_series(series, region_masks, oscillations, model.electrodes).savefig(
            temporary_folder / "series.png", dpi=130
        )
        np.savez_compressed(
            temporary_folder / "series.npz",
            changes=series.changes,
            times=series.times,
            background=series.background,
            points=np.asarray(series.mesh.points),
            cells=np.asarray(series.mesh.cells),
            functional=series.functional(),
            frequency=np.array([fitted_oscillation.frequency for fitted_oscillation in oscillations], float),
            amplitude=np.array([fitted_oscillation.amplitude for fitted_oscillation in oscillations], float).reshape(
                -1, series.mesh.num_cells
            ),
            phase=np.array([fitted_oscillation.phase for fitted_oscillation in oscillations], float).reshape(
                -1, series.mesh.num_cells
            ),
        )
        table_rows = zip(series.times, *region_curves.values(), strict=True)
        formatted_rows = (
            [f"{time:.9g}", *("" if np.isnan(value) else f"{value:.6g}" for value in row)] for time, *row in table_rows
        )
        write_rows(
            temporary_folder / "regions.csv", ("time_s" if series.timed else "frame", *region_curves), formatted_rows
        )
        write_json(report, temporary_folder / "report.json")
        if film is not None:
            titles, rate = series.titles, series.frame_rate
            write_film(temporary_folder / film, series.mesh, series.changes, model.electrodes, titles=titles, rate=rate)
    return report


def _series_report(
    sequence: ImagedSequence, region_curves: Mapping[str, np.ndarray], oscillations: Sequence[Oscillation]
) -> dict:
    series = sequence.series
    oscillation_reports = []
    for fitted_oscillation in oscillations:
        region_oscillations = {
            name: oscillation(region_curve, series.times, fitted_oscillation.frequency)
            for name, region_curve in region_curves.items()
        }
        region_reports = {
            name: {
                "amplitude": float(region_oscillation.amplitude),
                "noise": float(region_oscillation.noise),
                "phase_degrees": float(np.degrees(region_oscillation.phase)),
            }
            for name, region_oscillation in region_oscillations.items()
        }
        oscillation_reports.append(
            {
                "frequency": fitted_oscillation.frequency,
                "resolution": fitted_oscillation.resolution,
                "unit": "Hz",
                "regions": region_reports,
            }
        )
    return to_plain_values(
        {
            "measurement": describe_measurement(sequence.prepared.measurement),
            "frames": len(series.times),
            "refused": int(sequence.refused.sum()),
            "refused_frames": [
                {"frame": frame_number, "reason": reason} for frame_number, reason in sorted(sequence.reasons.items())
            ],
            "frames_with_moved_electrodes": np.flatnonzero(sequence.moved).tolist(),
            "frame_rate": series.frame_rate,
            "frame_rate_unit": "Hz",
            "background": series.background,
            "unit": series.unit,
            "hyperparameter": float(sequence.reconstruction.hyperparameter),
            "doubts": list(sequence.doubts),
            "oscillations": oscillation_reports,
        }
    )
