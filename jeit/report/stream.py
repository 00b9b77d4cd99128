"""Files of a stream: a table and images, which are written frame by frame, and pictures, which are drawn at the end.
The memory that is needed does not depend on the number of frames."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import tempfile
import zipfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import counted, describe, is_number
from jeit.files import atomically_written_file, atomically_written_files, remove_unfinished_files
from jeit.image.inclusions import StrongestRegion
from jeit.inverse.calibration import Calibration
from jeit.inverse.streaming.stream import FrameImage, FrameStatus
from jeit.report.folder import results_folder
from jeit.report.series import FILM_FRAMES, check_film, write_film

PICTURES = ("contact sheet", "film")
"""Names of the pictures of a stream, as passed to `drawing`."""

_TABLE_COLUMNS = ("frame", "status", "channels", "misfit", "iterations", "latency_ms", "x_m", "y_m", "peak", "reason")
# Statuses of frames for which no change of conductivity was imaged.
_STATUSES_WITHOUT_CHANGE = (FrameStatus.REFUSED, FrameStatus.UNCHANGED)
# End of the colour scale of streams without changes, as a fraction of the conductivity of the background. It is large
# enough that noise is not visible.
_UNCHANGED_COLOUR_LIMIT = 0.01
# Maximum number of refused frames named below the contact sheet.
_MAX_LISTED_REFUSALS = 8
# Number of bytes read and compressed at once, and maximum number of values of a `SeriesSample`.
_BLOCK_BYTES, _MAX_SAMPLE_VALUES = 2**20, 2**16


@dataclass(frozen=True)
class WrittenStream:
    """Counts and latencies of the frames of a stream: the result of `write_stream`.

    - `number`: number of frames.
    - `counts`: number of frames by status.
    - `latency`: (K,) seconds, latencies of the imaged frames, or an evenly spaced sample for long streams.
    - `first_reason`: reason why the first refused frame was refused; empty if no frame was refused.
    """

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
    """Write a stream of any length to `folder`: `frames.csv`, with a line for every frame as it arrives, and at the end
    `images.npz`, the contact sheet `frames.png`, and a film. Images are stored on the disk, not in memory.

    **Arguments:**

    - `images`: images of `jeit.inverse.stream`.
    - `calibration`: calibration of the imager of these images (see `jeit.imaging.prepare_imager`).
    - `folder`: folder of the files, created if needed.
    - `name`: name of the stream, for error messages.
    - `film`: name of the film's file, ending in .gif or, if ffmpeg is installed, .mp4; None for no film.
    - `rate`: frames per second, for titles with times instead of frame numbers, and for the pace of the film.
    - `progress`: function called with every image.
    - `drawing`: function called at the end with the step, "images" or one of `PICTURES`, sometimes followed by a colon
      and the progress. If `drawing` raises an error, the files written so far remain.

    `frames.csv` has the place in metres and the value, S (3-D: S/m), of the maximum change of each image; both are
    empty for unchanged frames. `images.npz` has `conductivity` (frames, cells), NaN for refused frames, `background`,
    `points` and `cells`. Pictures show evenly spaced frames and mark refused frames; no pictures are drawn if all
    frames were refused. Images and pictures of an earlier stream are deleted first. Each of these files is written
    completely or not at all. Raises `ValueError` for a stream without frames and for values that cannot be a folder, a
    film or a rate, and `OSError` if the disk is full.

    **Example:**

    ```python
    frames = np.concatenate([frames_of(rest), frames_of(pressed)])
    written = write_stream(stream(imager, frames), calibration, "out", film=None)
    ```
    """
    if film is not None:
        check_film(film)
    if rate is not None and not (is_number(rate) and rate > 0):
        raise ValueError(f"rate must be positive, frames in a second; it is {describe(rate)}.")
    file_names = ("frames.csv", "images.npz", "frames.png", *([] if film is None else [film]))
    folder = results_folder(folder, file_names)
    for earlier_file_name in file_names[1:]:
        (folder / earlier_file_name).unlink(missing_ok=True)  # the file belongs to an earlier stream
    remove_unfinished_files(folder)
    report_drawing = drawing or (lambda task: None)
    mesh, stream_summary = calibration.model.mesh, _StreamSummary(calibration)
    with GrowingRows(folder, (mesh.num_cells,)) as image_rows:
        with GrowingTable(folder / "frames.csv", _TABLE_COLUMNS) as frame_table:
            for frame_image in images:
                table_row, image = stream_summary.add_frame(frame_image)
                with reporting_partial_results(image_rows):
                    frame_table.write(table_row)
                    image_rows.append(image)
                if progress is not None:
                    progress(frame_image)
        if not image_rows.number:
            raise ValueError(f"'{name}': there was no frame in it.")
        model_arrays = {"background": calibration.conductivity, "points": mesh.points, "cells": mesh.cells}
        report_drawing("images")
        with reporting_partial_results(image_rows):
            image_rows.write_npz(
                folder / "images.npz",
                "conductivity",
                model_arrays,
                lambda progress_text: report_drawing(f"images: {progress_text}"),
            )
        latencies = stream_summary.latencies.values()
        if latencies.size:
            _StreamPictures(folder, film, rate, report_drawing).draw_pictures(image_rows, stream_summary)
        return WrittenStream(image_rows.number, stream_summary.status_counts, latencies, stream_summary.first_reason)


class _StreamSummary:
    """Statistics of the frames of a stream. The memory that they need does not depend on the number of frames."""

    def __init__(self, calibration: Calibration):
        self.calibration = calibration
        mesh, self.background = calibration.model.mesh, float(calibration.conductivity)
        self._strongest_region = StrongestRegion(mesh)
        self._refused_image = np.full(mesh.num_cells, np.nan, np.float32)
        self.latencies, self.status_counts, self.first_reason = SeriesSample(), {}, ""
        self.refused_frames, self.first_imaged_frame, self.max_change = [], -1, 0.0

    def add_frame(self, frame_image: FrameImage) -> tuple[list[object], Float[np.ndarray, " m"]]:
        """Add a frame to the statistics; return its line of the table, and its image."""
        self.status_counts[str(frame_image.status)] = self.status_counts.get(str(frame_image.status), 0) + 1
        if frame_image.conductivity is None:
            self.first_reason = self.first_reason or frame_image.reason
            self.refused_frames += [frame_image.number] if len(self.refused_frames) < _MAX_LISTED_REFUSALS else []
            return _table_row(frame_image, self._strongest_region, self.background), self._refused_image
        self.first_imaged_frame = frame_image.number if self.first_imaged_frame < 0 else self.first_imaged_frame
        self.latencies.append(frame_image.latency)
        image = frame_image.conductivity.astype(np.float32)
        self.max_change = max(self.max_change, float(np.abs(image - np.float32(self.background)).max()))
        return _table_row(frame_image, self._strongest_region, self.background), image

    @property
    def colour_limit(self) -> float:
        """End of the colour scale: the maximum change, or, for streams without changes, `_UNCHANGED_COLOUR_LIMIT` times
        the background, so that noise does not fill the scale."""
        has_changed_frames = sum(self.status_counts.values()) > sum(
            self.status_counts.get(status, 0) for status in _STATUSES_WITHOUT_CHANGE
        )
        return self.max_change if has_changed_frames else _UNCHANGED_COLOUR_LIMIT * self.background


@dataclass(frozen=True)
class _StreamPictures:
    """Settings of the pictures of a stream: folder, film, frame rate, and the function to which progress is
    reported."""

    folder: Path
    film_name: str | None
    frame_rate: float | None
    report_progress: Callable[[str], None]

    def draw_pictures(self, image_rows: GrowingRows, stream_summary: _StreamSummary) -> None:
        """Draw the contact sheet and the film from evenly spaced rows."""
        from jeit.plot import ColourScale, plot_frames
        from jeit.plot.imaging.series import NUM_CONTACT_SHEET_FRAMES, FrameCount

        model, colour_limit = stream_summary.calibration.model, stream_summary.colour_limit
        self.report_progress(PICTURES[0])
        changes, titles = self._selected_changes(image_rows, stream_summary, NUM_CONTACT_SHEET_FRAMES)
        frame_count = FrameCount(
            image_rows.number,
            stream_summary.status_counts.get("refused", 0),
            self._frame_titles(stream_summary.refused_frames),
        )
        colour_scale = ColourScale(limit=colour_limit)
        contact_sheet = plot_frames(
            model.mesh, changes, model.electrodes, titles=titles, scale=colour_scale, count=frame_count
        )
        with atomically_written_file(self.folder / "frames.png") as file:
            contact_sheet.savefig(file, dpi=120)
        if self.film_name is None:
            return
        changes, titles = self._selected_changes(image_rows, stream_summary, FILM_FRAMES)
        film_rate = None if self.frame_rate is None else self.frame_rate * len(changes) / image_rows.number
        with atomically_written_files(self.folder) as temporary_folder:
            write_film(
                temporary_folder / self.film_name,
                model.mesh,
                changes,
                model.electrodes,
                titles=titles,
                rate=film_rate,
                limit=colour_limit,
                progress=lambda progress_text: self.report_progress(f"{PICTURES[1]}: {progress_text}"),
            )

    def _selected_changes(
        self, image_rows: GrowingRows, stream_summary: _StreamSummary, max_frames: int
    ) -> tuple[Float[np.ndarray, "k m"], list[str]]:
        from jeit.plot.imaging.series import select_frames

        selected_frames = select_frames(image_rows.number, max_frames)
        images = image_rows.read(selected_frames)
        if not np.isfinite(images).any():  # all selected frames were refused: include a frame that was imaged
            selected_frames = sorted({stream_summary.first_imaged_frame, *selected_frames[1:]})
            images = image_rows.read(selected_frames)
        return images - np.float32(stream_summary.background), self._frame_titles(selected_frames)

    def _frame_titles(self, frame_numbers: Iterable[int]) -> list[str]:
        return [
            f"frame {frame_number}" if self.frame_rate is None else f"{frame_number / self.frame_rate:.2f} s"
            for frame_number in frame_numbers
        ]


def _table_row(frame_image: FrameImage, strongest_region: StrongestRegion, background: float) -> list[object]:
    """Values of a frame for its line of `frames.csv`."""
    latency_text = f"{1e3 * frame_image.latency:.3f}"
    if frame_image.conductivity is None:
        return [
            frame_image.number,
            frame_image.status,
            int(frame_image.usable.sum()),
            "",
            frame_image.iterations,
            latency_text,
            "",
            "",
            "",
            frame_image.reason,
        ]
    misfit_text = "" if np.isnan(frame_image.misfit) else f"{frame_image.misfit:.4g}"
    first_cells = [
        frame_image.number,
        frame_image.status,
        int(frame_image.usable.sum()),
        misfit_text,
        frame_image.iterations,
        latency_text,
    ]
    if frame_image.status == FrameStatus.UNCHANGED:
        return [*first_cells, "", "", "", frame_image.reason]
    centroid, peak = strongest_region(frame_image.conductivity - background)
    return [*first_cells, *(f"{value:.5f}" for value in centroid[:2]), f"{peak:.5g}", frame_image.reason]


class GrowingTable:
    """A CSV file that is written line by line. Each line is on the disk when `write` returns; if the process is killed
    or the disk is full, the line is missing, never incomplete. An existing file or link is replaced. Raises `OSError`
    if the file cannot be written."""

    def __init__(self, path: Path, columns: Sequence[str]):
        path.unlink(missing_ok=True)
        self._file = path.open("wb", buffering=0)
        self.write(columns)

    def write(self, row: Iterable[Any]) -> None:
        """Write one line, completely or not at all."""
        text_buffer = io.StringIO()
        csv.writer(text_buffer).writerow(row)
        encoded_line = text_buffer.getvalue().encode("utf-8", "backslashreplace")
        line_start, num_bytes_written = self._file.tell(), 0
        try:
            while num_bytes_written < len(encoded_line):
                num_bytes_written += self._file.write(encoded_line[num_bytes_written:])
        except OSError:
            self._file.truncate(line_start)
            raise

    def __enter__(self) -> "GrowingTable":
        return self

    def __exit__(self, *_) -> None:
        self._file.close()


class GrowingRows:
    """Array (n, *shape) of single precision that is stored row by row in a temporary file in `folder`. The operating
    system deletes the file when the process ends. Raises `OSError` if the disk is full."""

    def __init__(self, folder: Path, shape: tuple[int, ...]):
        self.folder, self.shape, self.number = folder, shape, 0
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (closed in __exit__)

    def append(self, row: Float[np.ndarray, "*shape"]) -> None:
        """Append one row."""
        self._file.write(np.asarray(row, np.float32).tobytes())
        self.number += 1

    def read(self, row_indices: Iterable[int]) -> Float[np.ndarray, "k *shape"]:
        """Read the rows with the given `row_indices`. This method must be called only after the last `append`."""
        row_bytes, rows = 4 * int(np.prod(self.shape)), []
        for row_index in row_indices:
            self._file.seek(row_bytes * row_index)
            rows.append(np.frombuffer(self._file.read(row_bytes), np.float32).reshape(self.shape))
        return np.stack(rows)

    def write_npz(
        self,
        path: Path,
        name: str,
        other_arrays: Mapping[str, ArrayLike],
        progress: Callable[[str], None] | None = None,
    ) -> None:
        """Write an NPZ file, completely or not at all, with all rows as the array `name`, and with the arrays
        `other_arrays`. The rows are copied block by block; for large files, `progress` is called with the percentage
        written."""
        npy_header = {"descr": "<f4", "fortran_order": False, "shape": (self.number, *self.shape)}
        with atomically_written_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as npy_file:
                np.lib.format.write_array_header_1_0(npy_file, npy_header)
                for copied_share, block in self._file_blocks():
                    if progress is not None and self._file.tell() > _BLOCK_BYTES:
                        progress(f"{100 * copied_share:.0f} %")
                    npy_file.write(block)
            for other_name, values in other_arrays.items():
                with archive.open(f"{other_name}.npy", "w", force_zip64=True) as npy_file:
                    np.lib.format.write_array(npy_file, np.asarray(values), allow_pickle=False)

    def _file_blocks(self) -> Iterator[tuple[float, bytes]]:
        """Yield the file of rows in blocks, each preceded by the fraction of the file that has been read at the end of
        the block."""
        file_size = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        while block := self._file.read(_BLOCK_BYTES):
            yield self._file.tell() / file_size, block

    def __enter__(self) -> "GrowingRows":
        return self

    def __exit__(self, *_) -> None:
        with contextlib.suppress(OSError):  # data that have not been written are no longer needed
            self._file.close()


@contextlib.contextmanager
def reporting_partial_results(rows: GrowingRows) -> Iterator[None]:
    """Context manager that replaces an `OSError`, for example that of a full disk, by an `OSError` whose message also
    states how many frames have been written."""
    try:
        yield
    except OSError as error:
        written_frames_text = f"frames.csv has the {counted(rows.number, 'frame')} until then"
        message = f"{error.strerror or error}: what came of the stream could not all be written; {written_frames_text}"
        raise OSError(error.errno, message, str(rows.folder)) from error


class SeriesSample:
    """Evenly spaced sample of a series of numbers of any length: every number of a series of up to 65,536 numbers,
    every second number of a longer series, then every fourth, and so on. Of a long series, 32,768 to 65,536 numbers are
    stored."""

    def __init__(self) -> None:
        self._stored_values, self._sampling_step, self._num_appended = array("d"), 1, 0

    def append(self, value: float) -> None:
        """Add the next number of the series, and store it if it belongs to the sample."""
        if self._num_appended % self._sampling_step == 0:
            if len(self._stored_values) == _MAX_SAMPLE_VALUES:
                self._stored_values, self._sampling_step = self._stored_values[::2], 2 * self._sampling_step
            self._stored_values.append(value)
        self._num_appended += 1

    def values(self) -> Float[np.ndarray, " k"]:
        """Return the stored numbers."""
        return np.array(self._stored_values)
