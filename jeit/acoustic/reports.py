"""Output files of acoustic localisation: reports, tables and plots of calibrations and tracks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from jeit.acoustic import Localiser, LocatedTouches
from jeit.acoustic.calibration.calibrate import CalibrationFit
from jeit.acoustic.localisation.locate import microphones_in_use
from jeit.acoustic.localisation.locations import Locations, LocationStatus
from jeit.acoustic.localisation.pixels import last_overlay_image, map_brightness
from jeit.acoustic.touch_tracks import Track
from jeit.report.folder import package_version, results, to_plain_values, write_json, write_rows


def write_calibration(fit: CalibrationFit, path: str | Path) -> None:
    """Write a calibration to a JSON file for `Calibration.load`, and a plot of the calibration beside this file.

    **Arguments:**

    - `fit`: result of `calibrate_microphones`.
    - `path`: path of the JSON file, whose folder is created if needed; the plot has the same name with the suffix
      `.png`.

    Raises `ValueError` if `path` is a folder, has the suffix `.png`, or is in a folder that cannot be created.

    **Example:**

    ```python
    write_calibration(fit, "skin.json")
    calibration = Calibration.load("skin.json")
    ```
    """
    path, picture_path = calibration_files(path)
    with results(path.parent, (path.name, picture_path.name)) as output_folder:
        fit.calibration.save(output_folder / path.name)
        draw_calibration(fit).savefig(output_folder / picture_path.name, dpi=130)


def calibration_files(path: str | Path) -> tuple[Path, Path]:
    """Return the paths of the calibration file and the plot that `write_calibration` writes. Raises `ValueError` if
    `path` is a folder or has the suffix `.png`."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"path {path} is a folder; give a file, such as {path / 'calibration.json'}.")
    picture_path = path.with_suffix(".png")
    if picture_path == path:
        raise ValueError(f"path {path}: the calibration is JSON; give another name, such as {path.stem}.json.")
    return path, picture_path


def draw_calibration(fit: CalibrationFit):
    """Plot the receptive fields of all microphones. Returns a matplotlib `Figure`; no display is needed."""
    from matplotlib.figure import Figure

    from jeit.acoustic.plots import plot_receptive_fields

    figure = Figure(figsize=(9.6, 8.4), layout="constrained")
    plot_receptive_fields(fit, title=fit.calibration.name, ax=figure.subplots())
    return figure


_REPORTED_PACKAGES = ("jeit", "jax", "numpy", "scipy")
# Number of pixels along each side of a map of the skin, and number of frames whose maps are computed at once.
_NUM_MAP_PIXELS, _NUM_CHUNK_FRAMES = 100, 256


def write_track(found: LocatedTouches, folder: str | Path) -> None:
    """Write the result of `locate_touches` to the files `track.csv`, `report.json` and `track.png` of a folder.

    The table has a row for each frame, with these columns: `time_s`; the estimated position `x_m`, `y_m`, its standard
    deviations `std_x_m`, `std_y_m`, and the `covariance` of x and y in m²; `strength` in the unit of intensity;
    `status`; the smoothed position `track_x_m`, `track_y_m` and its standard deviations `track_std_x_m`,
    `track_std_y_m`; and the number of the `touch`, from 1. For a surface in space, columns for z follow. Missing values
    are empty.

    **Arguments:**

    - `found`: result of `locate_touches`.
    - `folder`: the folder, which is created if needed.

    Raises `ValueError` if the folder cannot be created.

    **Example:**

    ```python
    located = locate_touches(recording, calibration)
    write_track(located, "out")
    ```
    """
    with results(folder, ("track.csv", "report.json", "track.png")) as output_folder:
        column_names = _column_names(found.locations.position.shape[1])
        write_rows(output_folder / "track.csv", column_names, _track_rows(found.locations, found.track))
        write_json(report_track(found), output_folder / "report.json")
        draw_track(found).savefig(output_folder / "track.png", dpi=150)


def report_track(located_touches: LocatedTouches) -> dict[str, Any]:
    """Summarise the result of `locate_touches` in a dictionary for a JSON report, with None for unknown values."""
    locations, track, calibration = located_touches.locations, located_touches.track, located_touches.calibration
    touch_reports = []
    for item_number, touch in enumerate(track.touches, 1):
        frame_slice = slice(touch.first, touch.last + 1)
        touch_strengths = locations.strength[frame_slice]
        frame_statuses = [
            str(frame_status)
            for frame_status in locations.status[frame_slice]
            if frame_status != LocationStatus.NO_TOUCH
        ]
        touch_reports.append(
            {
                "touch": item_number,
                "onset_s": touch.onset,
                "offset_s": touch.offset,
                "path_length_m": touch.length,
                "mean_position_m": np.nanmean(track.position[frame_slice], axis=0),
                "status": {
                    frame_status: frame_statuses.count(frame_status) for frame_status in dict.fromkeys(frame_statuses)
                },
                "greatest_strength": np.nanmax(touch_strengths),
            }
        )
    frames_with_two_touches = np.flatnonzero(locations.status == LocationStatus.TWO_TOUCHES)
    microphone_reports = []
    for item_number, (microphone_fault, is_used) in enumerate(zip(locations.faults, locations.used.T, strict=True)):
        used_fraction = float(is_used.mean())
        microphone_reports.append(
            {"microphone": item_number, "used_share": used_fraction, "fault": microphone_fault or None}
        )
    return to_plain_values(
        {
            "recording": locations.name,
            "calibration": calibration.name,
            "method": located_touches.method,
            "decay": calibration.microphone_array.decay.name,
            "frames": len(locations.times),
            "duration_s": locations.times[-1] - locations.times[0],
            "status": locations.counts(),
            "touches": touch_reports,
            "rejected_frames": int(track.rejected.sum()),
            "median_standard_deviation_m": _median_deviation(locations),
            "two_touches": [
                {
                    "time_s": float(locations.times[frame_index]),
                    "positions_m": [locations.position[frame_index], locations.second[frame_index]],
                    "strengths": [locations.strength[frame_index], locations.second_strength[frame_index]],
                }
                for frame_index in frames_with_two_touches
            ],
            "microphones": microphone_reports,
            "notes": list(locations.notes),
            "units": {
                "length": "m",
                "time": "s",
                "strength": "intensity of a typical microphone right under the source",
            },
            "versions": {package_name: package_version(package_name) for package_name in _REPORTED_PACKAGES},
        }
    )


def draw_track(located_touches: LocatedTouches):
    """Plot the paths of the touches in a recording. Returns a matplotlib `Figure`; no display is needed."""
    from matplotlib.figure import Figure

    from jeit.acoustic.plots import plot_track

    figure = Figure(figsize=(6.6, 5.8), layout="constrained")
    figure_title = located_touches.locations.name
    plot_track(
        located_touches.track,
        located_touches.locations,
        located_touches.calibration,
        overlay=_overlay_maps(located_touches),
        title=figure_title,
        ax=figure.subplots(),
    )
    return figure


def _overlay_maps(located_touches: LocatedTouches) -> np.ndarray | None:
    """Overlay (rows, columns) of the brightness maps of all frames with one located touch, in which older frames are
    fainter; None if there is no such frame."""
    locations, intensities = located_touches.locations, located_touches.intensities
    located_frames = np.flatnonzero(locations.has_position & (locations.status != LocationStatus.TWO_TOUCHES))
    if not located_frames.size:
        return None
    microphone_array, is_used_reading, _ = microphones_in_use(intensities, located_touches.calibration)
    localiser = Localiser.create(
        microphone_array, method=located_touches.method, map_shape=(_NUM_MAP_PIXELS, _NUM_MAP_PIXELS), compiled=False
    )
    located_times = locations.times[located_frames]
    time_constant = max(0.3, 0.5 * float(located_times[-1] - located_times[0]))
    overlay_image = np.zeros((_NUM_MAP_PIXELS, _NUM_MAP_PIXELS))
    for first_position in range(0, located_frames.size, _NUM_CHUNK_FRAMES):
        chunk_frames = located_frames[first_position : first_position + _NUM_CHUNK_FRAMES]
        map_brightnesses = map_brightness(
            localiser.maps(intensities.power[chunk_frames], is_used_reading[chunk_frames]),
            method=located_touches.method,
        )
        overlay_image = np.maximum(
            overlay_image,
            last_overlay_image(
                map_brightnesses, locations.times[chunk_frames], time=located_times[-1], time_constant=time_constant
            ),
        )
    return overlay_image


def _column_names(dimension: int) -> list[str]:
    column_names = ["time_s", "x_m", "y_m", "std_x_m", "std_y_m", "covariance", "strength", "status"]
    column_names += ["track_x_m", "track_y_m", "track_std_x_m", "track_std_y_m", "touch"]
    if dimension == 3:
        column_names += ["z_m", "std_z_m", "covariance_xz", "covariance_yz", "track_z_m", "track_std_z_m"]
    return column_names


def _track_rows(locations: Locations, track: Track):
    dimension = locations.position.shape[1]
    touch_numbers = np.zeros(len(locations.times), int)
    for touch_number, touch in enumerate(track.touches, 1):
        touch_numbers[touch.first : touch.last + 1] = touch_number
    frame_deviations, track_deviations = (
        np.sqrt(np.diagonal(position_estimate.covariance, axis1=1, axis2=2)) for position_estimate in (locations, track)
    )
    for k, frame_time in enumerate(locations.times):
        frame_position, frame_covariance = locations.position[k], locations.covariance[k]
        table_row = [
            f"{frame_time:.6f}",
            *_format_numbers(frame_position[:2]),
            *_format_numbers(frame_deviations[k, :2]),
            _format_number(frame_covariance[0, 1]),
            _format_number(locations.strength[k]),
        ]
        table_row += [
            locations.status[k],
            *_format_numbers(track.position[k, :2]),
            *_format_numbers(track_deviations[k, :2]),
            touch_numbers[k] or "",
        ]
        if dimension == 3:
            table_row += [
                _format_number(frame_position[2]),
                _format_number(frame_deviations[k, 2]),
                _format_number(frame_covariance[0, 2]),
                _format_number(frame_covariance[1, 2]),
            ]
            table_row += [_format_number(track.position[k, 2]), _format_number(track_deviations[k, 2])]
        yield table_row


def _median_deviation(locations: Locations) -> float:
    """Median over the located frames of the standard deviation along the major axis of the error ellipse, in metres."""
    if not locations.has_position.any():
        return math.nan
    return float(np.median(np.sqrt(np.linalg.eigvalsh(locations.covariance[locations.has_position])[:, -1])))


def _format_number(number) -> str:
    return f"{number:.9g}" if np.isfinite(number) else ""


def _format_numbers(numbers) -> list[str]:
    return [_format_number(number) for number in numbers]
