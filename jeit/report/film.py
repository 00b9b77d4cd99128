"""Films of streams: a small GIF, or an MP4 where ffmpeg is installed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh

FILMS = (".gif", ".mp4")
FILM_FRAMES = 120
"""Frames of a film at most."""
# Frames per second: the greatest number, and the one used where the stream's rate is not known.
_FASTEST, _PACE = 25.0, 10.0


def check_film(name: str) -> str:
    """The name of a film's file. Raises `ValueError` for another ending, a folder in it, and where ffmpeg lacks."""
    if Path(name).suffix.lower() not in FILMS or Path(name).name != name:
        raise ValueError(f"film must be a name that ends in {' or '.join(FILMS)}; it is '{name}'.")
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
    """Write the frames of a stream as a film, `path` ending in .gif or .mp4, all on one colour scale.

    `changes` and `titles` as in `jeit.plot.plot_frames`: frames that were refused are shown as such. `limit`: the end
    of the scale, S (3-D: S/m), that of all frames unless given. `rate`: frames of the stream in a second; the film then
    takes as long as the stream, unless it had more than 25 frames a second; 10 a second unless given. Of long streams
    120 frames are taken, evenly chosen. `progress` is called with how far it is.
    Raises `ValueError` for another ending, where ffmpeg lacks, and where every frame was refused.
    """
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    from jeit.plot.axes import SOFT
    from jeit.plot.colour_scale import ColourScale
    from jeit.plot.imaging.frames import FramePicture, chosen_frames, fit_scale
    from jeit.plot.imaging.mesh import slice_text

    path, values = Path(path), np.asarray(changes)
    check_film(path.name)
    said = [f"frame {number}" for number in range(len(values))] if titles is None else list(titles)
    figure = Figure(figsize=(5.0, 4.4), layout="constrained")
    fitted, chosen = fit_scale(values, mesh, ColourScale(limit=limit)), chosen_frames(len(values), FILM_FRAMES)
    picture = FramePicture(figure.subplots(), mesh, electrodes, fitted)
    fitted.draw_bar(picture.ax, picture.drawn)
    picture.show(values[chosen[0]], said[chosen[0]])
    if text := slice_text(mesh):
        figure.supxlabel(text, fontsize=9, color=SOFT)
    figure.canvas.draw()
    figure.set_layout_engine("none")  # or the picture would move from frame to frame
    pace = min(_PACE if rate is None else rate * len(chosen) / len(values), _FASTEST)
    writer = (PillowWriter if path.suffix.lower() == ".gif" else FFMpegWriter)(fps=max(pace, 0.1))  # pyright: ignore
    with writer.saving(figure, str(path), 80):
        for done, frame in enumerate(chosen):
            picture.show(values[frame], said[frame])
            writer.grab_frame()
            if progress is not None:
                progress(f"{done + 1} of {len(chosen)}")
