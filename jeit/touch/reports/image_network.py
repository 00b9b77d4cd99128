"""Write the results of training a network that images indentation depth, and of imaging frames with it, to folders."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jeit.arguments import counted
from jeit.files import atomically_written_file, remove_unfinished_files
from jeit.report.folder import package_version, results, results_folder, to_plain_values, write_json
from jeit.report.stream import PICTURES, GrowingRows, GrowingTable, SeriesSample, reporting_partial_results
from jeit.touch.networks import ImageNetwork, LearntImages
from jeit.touch.networks.depth_maps import FrameDepth
from jeit.touch.networks.linear_channels import depth_centroids
from jeit.touch.simulate.contact.indent_sets import pixel_places

LEARNT_FILES = ("network.jeit", "report.json", "learning.png")
DEPTH_FILES = ("frames.csv", "depth.npz", "depth.png", "report.json")
_REPORTED_PACKAGES = ("jeit", "jax", "equinox", "optax", "numpy")
# Maximum number of depth maps that are drawn.
_MAX_DRAWN_MAPS = 6
# Maximum number of refused frames that a report lists.
_MAX_LISTED_FRAMES = 1000


def write_learnt_images(learnt: LearntImages, folder: str | Path) -> None:
    """Write the accuracy and training histories of a network to `report.json` and the picture `learning.png` in its
    folder.

    `folder`: folder to which `learn_images` wrote the network. Raises `ValueError` if `folder` cannot be a folder.
    """
    with results(folder, LEARNT_FILES) as result_folder:
        write_json(report_learnt_images(learnt), result_folder / "report.json")
        draw_learnt_images(learnt).savefig(result_folder / "learning.png", dpi=130)


def report_learnt_images(learnt: LearntImages) -> dict[str, Any]:
    """Report the accuracy and the trainings of an image network as plain numbers, strings, lists and dictionaries."""
    network = learnt.network
    training_reports = {
        training_name: {
            "ended": training_result.reason,
            "batches": training_result.course.steps[-1],
            "best_batches": training_result.course.steps[training_result.course.best],
            "best_loss_held_out": training_result.course.validation[training_result.course.best],
            "loss_held_out": training_result.course.validation,
            "loss": training_result.course.training,
        }
        for training_name, training_result in learnt.courses.items()
    }
    return to_plain_values(
        {
            "design": network.design,
            "made_for": network.made_for,
            "map": {"shape": network.shape, "extent_m": network.extent, "thickness_m": network.thickness},
            "relative_noise": network.noise,
            "share_of_squared_depth_explained": learnt.standing.explained,
            "error_of_a_ball_m": learnt.standing.place,
            "estimated_depth_of_a_ball": learnt.standing.deepest,
            "trainings": training_reports,
            "seconds": learnt.seconds,
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def draw_learnt_images(learnt: LearntImages):
    """Draw the losses in training of an image network, and true (above) and estimated depth maps of test touches.

    Returns a matplotlib `Figure` that needs no display.
    """
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_depth_map, plot_losses

    true_maps, estimated_maps = learnt.standing.right, learnt.standing.estimated
    figure = Figure(figsize=(3 + 2.6 * (len(true_maps) + 1), 5.4), layout="constrained")
    subfigures = figure.subfigures(1, 2, width_ratios=(4.4, 2.6 * max(len(true_maps), 1)), squeeze=False)
    loss_figure, map_figure = subfigures[0]
    plot_losses(learnt.courses, ax=loss_figure.subplots())
    map_axes = map_figure.subplots(2, len(true_maps), squeeze=False)
    thickness = learnt.network.thickness
    max_depth = thickness * float(true_maps.max())
    for row_axes, (row_title, maps_of_kind) in zip(
        map_axes, (("right", true_maps), ("estimated", estimated_maps)), strict=True
    ):
        for ax, depth_map in zip(row_axes, maps_of_kind, strict=True):
            plot_depth_map(
                thickness * depth_map, learnt.network.extent, most=max_depth, colour_bar=ax is row_axes[-1], ax=ax
            )
        row_axes[0].set_title(row_title)
    return figure


class DeepestFrame(NamedTuple):
    """The frame of a recording in which the skin is indented most.

    **Fields**: `number`: number of the frame in the file; `depth`: maximum depth in the frame, metres; `middle` (2,):
    centroid of the indentation, metres, NaN if no depth exceeds the noise floor.
    """

    number: int
    depth: float
    middle: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class WrittenDepths:
    """Summary of the depth maps that `write_depths` has written.

    **Fields**: `number`: number of frames; `imaged`: number of frames that were imaged; `deepest`: the frame with the
    largest depth; `latency` (K,): computing time of K imaged frames, seconds; for many frames, of an evenly spaced
    sample.
    """

    number: int
    imaged: int
    deepest: DeepestFrame
    latency: Float[np.ndarray, " K"]


def write_depths(
    frame_depths: Iterable[FrameDepth],
    network: ImageNetwork,
    folder: str | Path,
    *,
    name: str,
    progress: Callable[[FrameDepth], None] | None = None,
    drawing: Callable[[str], None] | None = None,
) -> WrittenDepths:
    """Write the depth maps that a network estimated from the frames of a recording to a folder.

    As each frame arrives, a line is written to `frames.csv`: `x_m`, `y_m`, the centroid of the indentation, and
    `depth_m`, its maximum depth. At the end, `depth.npz` with all maps, `depth.png` and `report.json` are written. The
    number of frames is not limited by memory, since maps are stored on disk.

    `frame_depths`: the frames that `stream_depths` yields; `name`: name of the recording. Maps of refused frames are
    NaN; if no depth exceeds the noise floor, the centroid is left empty. `progress` is called with every frame;
    `drawing` is called with the name of each step at the end, as `write_stream` does. Each file is written completely
    or not at all. Raises `ValueError` if `folder` cannot be a folder, and if no frame was imaged, in which case no file
    remains; `OSError` on a full disk.
    """
    result_folder = results_folder(folder, DEPTH_FILES)
    for file_name in DEPTH_FILES[1:]:
        (result_folder / file_name).unlink(missing_ok=True)  # files of earlier frames
    remove_unfinished_files(result_folder)
    report_message = drawing or (lambda message: None)
    with GrowingRows(result_folder, network.shape) as map_rows:
        frame_statistics = _FrameStatistics(network)
        with GrowingTable(result_folder / "frames.csv", ("frame", "x_m", "y_m", "depth_m")) as frame_table:
            for frame in frame_depths:
                table_row, depth_map = frame_statistics.add_frame(frame)
                with reporting_partial_results(map_rows):
                    frame_table.write(table_row)
                    map_rows.append(depth_map)
                if progress is not None:
                    progress(frame)
        if not frame_statistics.imaged:
            (result_folder / "frames.csv").unlink()
            first_reason = frame_statistics.first_reason or "there is none"
            raise ValueError(
                f"'{name}': {counted(map_rows.number, 'frame')}, and none could be imaged; the first: {first_reason}"
            )
        report_message("images")
        with reporting_partial_results(map_rows):
            extent = np.array(network.extent)
            map_rows.write_npz(
                result_folder / "depth.npz",
                "depth",
                {"extent": extent},
                lambda progress_text: report_message(f"images: {progress_text}"),
            )
        with results(result_folder, ("report.json",)) as report_folder:
            write_json(frame_statistics.report(name, map_rows.number), report_folder / "report.json")
        report_message(PICTURES[0])
        row_indices, frame_numbers = (
            frame_statistics.row.values().astype(int),
            frame_statistics.number.values().astype(int),
        )
        drawn_indices = np.unique(np.linspace(0, len(row_indices) - 1, _MAX_DRAWN_MAPS).round().astype(int))
        with atomically_written_file(result_folder / "depth.png") as file:
            _draw_depths(
                map_rows.read(row_indices[drawn_indices]),
                frame_numbers[drawn_indices],
                frame_statistics.deepest_frame.depth,
                network,
            ).savefig(file, dpi=130)
        return WrittenDepths(
            map_rows.number, frame_statistics.imaged, frame_statistics.deepest_frame, frame_statistics.latency.values()
        )


class _FrameStatistics:
    """Statistics of the frames that a network imaged, in memory that does not grow with the number of frames."""

    def __init__(self, network: ImageNetwork):
        self.network, self._places = network, pixel_places(network.extent, network.shape)
        self._empty_map = np.full(network.shape, np.nan)
        self.imaged, self.number_refused, self.first_reason = 0, 0, ""
        self.refused_frames: list[int] = []
        self.row, self.number, self.latency = SeriesSample(), SeriesSample(), SeriesSample()
        self.deepest_frame = DeepestFrame(-1, -np.inf, np.full(2, np.nan))

    def add_frame(self, frame: FrameDepth) -> tuple[list[object], Float[np.ndarray, "rows columns"]]:
        """Add a frame to the statistics; return its row of the table and its depth map."""
        if frame.depth is None:
            self.number_refused += 1
            self.first_reason = self.first_reason or frame.reason
            self.refused_frames += [frame.number] if len(self.refused_frames) < _MAX_LISTED_FRAMES else []
            return [frame.number, "", "", ""], self._empty_map
        for series_sample, sampled_value in (
            (self.row, self.imaged + self.number_refused),
            (self.number, frame.number),
        ):
            series_sample.append(sampled_value)
        self.latency.append(frame.latency)
        self.imaged += 1
        max_depth = float(frame.depth.max())
        depth_centroid = depth_centroids(frame.depth[None], self._places)[0]
        if not max_depth > self.network.floor:
            depth_centroid = np.full(2, np.nan)
        if max_depth > self.deepest_frame.depth:
            self.deepest_frame = DeepestFrame(frame.number, max_depth, depth_centroid)
        number_texts = [
            f"{sampled_value:.6g}" if np.isfinite(sampled_value) else ""
            for sampled_value in (*depth_centroid, max_depth)
        ]
        return [frame.number, *number_texts], frame.depth

    def report(self, recording_name: str, num_frames: int) -> dict[str, Any]:
        """Report the statistics of the imaged frames as plain numbers, strings, lists and dictionaries."""
        network = self.network
        return to_plain_values(
            {
                "frames": recording_name,
                "number": num_frames,
                "refused": self.refused_frames,
                "number_refused": self.number_refused,
                "design": network.design,
                "map": {"shape": network.shape, "extent_m": network.extent},
                "deepest_m": self.deepest_frame.depth,
                "depth_by_noise_alone_m": network.floor,
                "units": {"length": "m"},
                "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
            }
        )


def _draw_depths(
    depth_maps: Float[np.ndarray, "k rows columns"],
    frame_numbers: Int[np.ndarray, " k"],
    depth_limit: float,
    network: ImageNetwork,
):
    """Draw depth maps of k frames with these `frame_numbers`; `depth_limit`: maximum depth of all frames, metres."""
    from matplotlib.figure import Figure

    from jeit.touch.plots import plot_depth_map

    figure = Figure(figsize=(4.2 * len(depth_maps), 4.2), layout="constrained")
    # The colour scale reaches at least 4 times the noise floor, so that noise on an untouched skin does not fill it.
    max_depth = max(depth_limit, 4 * network.floor)
    for ax, depth_map, frame_number in zip(
        figure.subplots(1, len(depth_maps), squeeze=False)[0], depth_maps, frame_numbers, strict=True
    ):
        is_last = frame_number == frame_numbers[-1]
        plot_depth_map(
            depth_map, network.extent, most=max_depth, colour_bar=is_last, title=f"frame {frame_number}", ax=ax
        )
    return figure
