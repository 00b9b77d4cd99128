"""What is left of a stream on disk: a line for every frame as it comes, and at the end all images and pictures."""

import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.arguments import is_number, told
from jeit.inverse.calibration import Calibration
from jeit.inverse.streaming.frame_check import FrameStatus
from jeit.inverse.streaming.stream import FrameImage
from jeit.mesh import centroids
from jeit.report.film import check_film, write_film
from jeit.report.folder import results_folder

_COLUMNS = ("frame", "status", "channels", "misfit", "iterations", "latency_ms", "x_m", "y_m", "peak", "reason")
_NOTHING = (FrameStatus.REFUSED, FrameStatus.UNCHANGED)
# Share of the background at the end of a colour scale on which nothing is to be seen.
_FAINT = 0.01


@dataclass(frozen=True)
class WrittenStream:
    """What `write_stream` has written: the `number` of frames, `counts` of them by status, the `latency` in seconds of
    those that were imaged, (K,), and of the others the `first_reason`, empty if there is none."""

    number: int
    counts: dict[str, int]
    latency: Float[np.ndarray, " K"]
    first_reason: str = ""


def write_stream(
    images: Iterable[FrameImage],
    calibration: Calibration,
    folder: str | Path,
    *,
    name: str = "stream",
    film: str | None = "film.gif",
    rate: float | None = None,
    progress: Callable[[FrameImage], None] | None = None,
    drawing: Callable[[str], None] | None = None,
) -> WrittenStream:
    """Write `frames.csv`, a line for every image as it comes, and at the end `images.npz`, `frames.png`, a contact
    sheet, and a film, into `folder`.

    `images`: those of `jeit.inverse.stream`, of an imager made with `calibration`, see `jeit.imaging.prepare_imager`.
    The table has the place in metres and the height, S (3-D: S/m), of each image's strongest change, of frames that are
    unchanged none. The NPZ holds
    `conductivity` (frames, cells), NaN for frames that were refused, `background`, `points` and `cells`. `film`: the
    name of its file, ending in .gif or, where ffmpeg is installed, .mp4; None for none. `rate`: frames in a second, for
    times in place of numbers, and the pace of the film. Pictures show refused frames as such; where all are, there is
    none. `progress` is called with every image, and `drawing` then with what is drawn. An earlier stream's images and
    pictures are taken away first. Raises `ValueError`, with the `name` of the stream, if no frame came, and for what
    cannot be a folder, a film or a rate.
    """
    if film is not None:
        check_film(film)
    if rate is not None and not (is_number(rate) and rate > 0):
        raise ValueError(f"rate must be positive, frames in a second; it is {told(rate)}.")
    made = ("frames.csv", "images.npz", "frames.png", *([] if film is None else [film]))
    folder = results_folder(folder, made)
    for earlier in made[1:]:
        (folder / earlier).unlink(missing_ok=True)  # would not go with these frames
    mesh, background = calibration.model.mesh, float(calibration.conductivity)
    centre = np.asarray(centroids(mesh))[:, :2]
    nothing = np.full(mesh.num_cells, np.nan, np.float32)
    kept, latency, counts, refusals = [], [], {}, []
    with open(folder / "frames.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for one in images:
            table.writerow(_row(one, centre, background))
            file.flush()  # whoever follows the file sees every frame at once
            kept.append(nothing if one.conductivity is None else one.conductivity.astype(np.float32))
            latency += [one.latency] if one.imaged else []
            refusals += [] if one.imaged else [one.reason]
            counts[str(one.status)] = counts.get(str(one.status), 0) + 1
            if progress is not None:
                progress(one)
    if not kept:
        raise ValueError(f"'{name}': there was no frame in it.")
    np.savez_compressed(
        folder / "images.npz",
        conductivity=np.stack(kept),
        background=np.asarray(calibration.conductivity),
        points=np.asarray(mesh.points),
        cells=np.asarray(mesh.cells),
    )
    if latency:
        # Where all is noise, it is not to fill the colours.
        changed = len(kept) > sum(counts.get(status, 0) for status in _NOTHING)
        limit = None if changed else _FAINT * background
        pictures = _Pictures(folder, film, rate, limit, drawing or (lambda said: None))
        pictures.draw(np.stack(kept) - np.float32(background), calibration)
    return WrittenStream(len(kept), counts, np.array(latency), refusals[0] if refusals else "")


@dataclass(frozen=True)
class _Pictures:
    """Which are drawn into a folder, where their scale ends, and who is told."""

    folder: Path
    film: str | None
    rate: float | None
    limit: float | None
    tell: Callable[[str], None]

    def draw(self, changes: Float[np.ndarray, "F m"], calibration: Calibration) -> None:
        """The contact sheet, and the film."""
        from jeit.plot import ColourScale, plot_frames

        model, rate = calibration.model, self.rate
        titles = [f"frame {one}" if rate is None else f"{one / rate:.2f} s" for one in range(len(changes))]
        self.tell("contact sheet")
        sheet = plot_frames(model.mesh, changes, model.electrodes, titles=titles, scale=ColourScale(limit=self.limit))
        sheet.savefig(self.folder / "frames.png", dpi=120)
        if self.film is not None:
            path, told = self.folder / self.film, lambda far: self.tell(f"film: {far}")
            write_film(
                path, model.mesh, changes, model.electrodes, titles=titles, rate=rate, limit=self.limit, progress=told
            )


def _row(one: FrameImage, centre, background: float) -> list[object]:
    """The columns of a frame."""
    spent = f"{1e3 * one.latency:.3f}"
    if one.conductivity is None:
        return [one.number, one.status, int(one.usable.sum()), "", one.iterations, spent, "", "", "", one.reason]
    change = one.conductivity - background
    peak = int(np.argmax(np.abs(change)))
    misfit = "" if np.isnan(one.misfit) else f"{one.misfit:.4g}"
    head = [one.number, one.status, int(one.usable.sum()), misfit, one.iterations, spent]
    if one.status == FrameStatus.UNCHANGED:
        return [*head, "", "", "", one.reason]
    return [*head, *(f"{value:.5f}" for value in centre[peak]), f"{change[peak]:.5g}", one.reason]
