"""Files of recorded frames and of labelled gestures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jeit.arguments import measurable_values
from jeit.data.description import Description, TableLayout
from jeit.data.formats import table
from jeit.data.formats.text import frames_in_table
from jeit.data.measurement import Measurement
from jeit.files import atomically_written_file, npz_arrays, require_arrays


def join(measurements: Sequence[Measurement]) -> Measurement:
    """Join the frames of measurements of the same set-up in the order of `measurements`. Their times are also joined if
    all measurements have times and the joined times increase.

    The body, the electrodes and the notes are taken from the first measurement. Raises `ValueError` for an empty
    sequence, and if two measurements have different protocols.

    **Arguments:**

    - `measurements`: measurements of the same set-up.

    **Example:**

    ```python
    both = join([rest, pressed])
    both.num_frames
    ```
    """
    if not measurements:
        raise ValueError("measurements: there is none; give at least one.")
    first_measurement, *other_measurements = measurements
    for other_measurement in other_measurements:
        if (
            other_measurement.protocol is not first_measurement.protocol
            and not other_measurement.protocol.same_patterns(first_measurement.protocol)
        ):
            raise ValueError(
                f"'{other_measurement.name}' ({other_measurement.protocol.name}) is read otherwise than "
                f"'{first_measurement.name}'; join one set-up's."
            )
    joined_names = tuple(name for measurement in measurements for name in measurement.frame_names)
    time_arrays: list[Any] = [measurement.times for measurement in measurements]
    has_missing_times = any(frame_times is None for frame_times in time_arrays)
    joined_times = (
        None if has_missing_times else np.concatenate([np.asarray(frame_times) for frame_times in time_arrays])
    )
    joined_mask = np.concatenate([np.asarray(measurement.mask) for measurement in measurements])
    return replace(
        first_measurement,
        voltages=np.concatenate([np.asarray(measurement.voltages) for measurement in measurements]),
        mask=joined_mask,
        frame_names=joined_names if len(joined_names) == len(joined_mask) else (),
        times=None if joined_times is None or (np.diff(joined_times) <= 0).any() else joined_times,
    )


_FRAME_KEYS, _TIME_KEYS = ("voltages", "frames"), ("seconds", "time")


@dataclass(frozen=True)
class FrameRecording:
    """F frames of M channels from a file. **Fields**: `frames`: (F, M) voltages in volts, NaN for missing readings;
    `seconds`: (F,) times of the frames, None if unknown; `reference`: one frame (M,) or several frames (r, M) of the
    untouched skin in volts, or None; `name`: name of the file.

    **Example:**

    ```python
    np.savez("touches.npz", frames=pressed.voltages, reference=rest.voltages[0])
    read_frame_recording("touches.npz").frames
    ```
    """

    frames: Float[np.ndarray, "F M"]
    seconds: Float[np.ndarray, " F"] | None
    reference: Float[np.ndarray, "r M"] | None
    name: str


def read_frame_recording(path: str | Path, description: Description | None = None) -> FrameRecording:
    """Read recorded frames, their times and a reference from a file.

    An NPZ file of F frames and M channels contains `frames` or `voltages` (F, M), and optionally times `seconds` or
    `time` (F,), and `reference`, one frame (M,) or several frames (r, M) of the untouched skin. A table (.csv, .txt,
    .dat, .npy) has one frame per row unless `[data]` of the description states otherwise; its frames named "reference"
    become the reference. If the table has one column more than the protocol has channels, the first column contains the
    times, as in `jeit.data.read`.

    Without a description, or without a protocol in it, any number of channels is accepted, and voltages are returned in
    the unit of the file. Raises `FileNotFoundError` if the file does not exist, and `ValueError` for a file that is
    neither NPZ nor a table, for a number of channels that differs from the protocol's, and for times that decrease, are
    not finite, or do not match the number of frames.

    **Arguments:**

    - `path`: path of the file.
    - `description`: description of the sensor, with the protocol.

    **Example:**

    ```python
    np.savez("touches.npz", frames=pressed.voltages, seconds=[0.0])
    recording = read_frame_recording("touches.npz")
    ```
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"'{path}': it is a folder; give a file of frames.")
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    if not table.recognises(path):
        raise ValueError(f"'{path}': give frames as {', '.join(table.SUFFIXES)}.")
    table_layout = TableLayout() if description is None else description.layout
    protocol = None if description is None else description.protocol(path)
    num_channels = None if protocol is None else protocol.num_measurements
    try:
        stored_arrays = (
            npz_arrays(path, *_FRAME_KEYS, *_TIME_KEYS, "reference", *table_layout.keys)
            if path.suffix == ".npz"
            else {}
        )
        (table_values, column_names), frame_times = _read_number_table(path, stored_arrays, table_layout), None
        are_frames_in_rows = (
            not stored_arrays and table_layout.frames_in != "columns" and table_layout.time_column is not False
        )
        if are_frames_in_rows and num_channels is not None and table_values.shape[1] == num_channels + 1:
            table_values, frame_times, _ = frames_in_table(table_values, [num_channels], table_layout, column_names)
        frames = _frames_in_volts(table_values, table_layout, path.name, num_channels)
        frame_times = next(
            (
                _checked_times(stored_arrays[time_key], time_key, len(frames))
                for time_key in _TIME_KEYS
                if time_key in stored_arrays
            ),
            frame_times,
        )
        reference_frame = None
        if "reference" in stored_arrays:
            reference_frame = _check_frames(
                "reference", np.atleast_2d(stored_arrays["reference"]) * table_layout.scale, frames.shape[1]
            )
        elif "reference" in table_layout.frame_names and len(table_layout.frame_names) == len(frames):
            is_reference = np.array(table_layout.frame_names) == "reference"
            frames, reference_frame = frames[~is_reference], frames[is_reference]
    except ValueError as error:
        raise ValueError(f"'{path}': {error}") from None
    return FrameRecording(frames, frame_times, reference_frame, path.name)


def _read_number_table(
    path: Path, stored_arrays: dict[str, np.ndarray], table_layout: TableLayout
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The numbers of a file, arranged as in the file, and the names of the columns, if the file has any."""
    if not stored_arrays:
        table_values, column_names = table.numbers(path, table_layout)
        return np.atleast_2d(table_values), column_names
    frame_key = next((name for name in (*table_layout.keys, *_FRAME_KEYS) if name in stored_arrays), None)
    if frame_key is None:
        raise ValueError(f"there is no array 'frames'; the file holds {', '.join(stored_arrays[''][:12])}.")
    return np.atleast_2d(stored_arrays[frame_key]), ()


def _frames_in_volts(
    table_values: np.ndarray, table_layout: TableLayout, name: str, num_channels: int | None
) -> Float[np.ndarray, "F M"]:
    """Voltages (frames, channels) of a table, in volts."""
    if table_values.dtype.kind not in "iufc":
        raise ValueError(f"frames are {table_values.dtype}; give numbers, in volts.")
    frames = table.arrange_frames(table_values, table_layout, name)
    if np.iscomplexobj(frames):
        raise ValueError("frames are complex; choose a part with [data] component: real, imaginary or magnitude.")
    return _check_frames(
        "frames",
        measurable_values(frames) * table_layout.scale,
        frames.shape[-1] if num_channels is None else num_channels,
    )


def _check_frames(name: str, frame_values: np.ndarray, num_channels: int) -> Float[np.ndarray, "F M"]:
    if frame_values.dtype.kind not in "iuf" or frame_values.ndim != 2 or frame_values.shape[1] != num_channels:
        raise ValueError(
            f"{name} have shape {frame_values.shape}; give one row for each frame, of {num_channels} channels."
        )
    if not len(frame_values):
        raise ValueError(f"{name}: there is none.")
    return measurable_values(frame_values.astype(float))


def _checked_times(time_values: np.ndarray, name: str, num_frames: int) -> Float[np.ndarray, " F"]:
    if time_values.dtype.kind not in "iuf" or time_values.shape != (num_frames,):
        raise ValueError(
            f"{name} is {time_values.dtype} of shape {time_values.shape}; give seconds for each of {num_frames} frames."
        )
    frame_times = time_values.astype(float)
    if not np.isfinite(frame_times).all():
        raise ValueError(f"{name}: some are not finite.")
    if num_frames > 1 and frame_times[0] == frame_times[-1] and not np.diff(frame_times).any():
        raise ValueError(f"{name} are all {frame_times[0]:g}: give when each frame came.")
    decreasing_indices = np.flatnonzero(np.diff(frame_times) < 0)
    if decreasing_indices.size:
        raise ValueError(
            f"{name} fall after frame {decreasing_indices[0]}, {frame_times[decreasing_indices[0]]:g} s: sort frames "
            "by time."
        )
    return frame_times


_ARRAY_NAMES = ("gesture", "person", "start", "seconds", "voltages", "reference", "untouched")


@dataclass(frozen=True)
class GestureSet:
    """Labelled recordings of one gesture each: n recordings with F frames in total and M channels, concatenated.

    **Fields**: `gesture`: (n,) name of each gesture; `person`: (n,) name or number of the person of each recording;
    `start`: (n + 1,) index of the first frame of each recording, followed by the number of frames F; `seconds`: (F,)
    times of the frames, from 0 in each recording; `voltages`: (F, M) volts, NaN for missing readings; `reference`: (M,)
    volts, mean of frames of the untouched skin before the recordings; `untouched`: (u, M) volts, u frames of the
    untouched skin, recorded over a period as long as the gestures.

    **Example:**

    ```python
    frames = np.concatenate([pressed.voltages, rest.voltages])
    start, seconds = np.array([0, 2]), np.array([0.0, 0.1])
    taps = GestureSet(np.array(["tap"]), np.array(["A"]), start, seconds, frames, rest.voltages[0], rest.voltages)
    ```
    """

    gesture: np.ndarray
    person: np.ndarray
    start: Int[np.ndarray, " s"]
    seconds: Float[np.ndarray, " F"]
    voltages: Float[np.ndarray, "F M"]
    reference: Float[np.ndarray, " M"]
    untouched: Float[np.ndarray, "u M"]

    def __post_init__(self):
        """Check the fields: raises `ValueError` for arrays whose shapes do not match, and for wrong types of values."""
        for name, dtype_kinds, expected_type in (
            ("gesture", "U", "text"),
            ("person", "iuU", "whole numbers or text"),
            ("start", "iu", "whole numbers"),
        ):
            field_values = getattr(self, name)
            if field_values.dtype.kind not in dtype_kinds:
                raise ValueError(f"{name} is {field_values.dtype}; give {expected_type}.")
        for name in ("seconds", "voltages", "reference", "untouched"):
            if getattr(self, name).dtype.kind not in "fiu":
                raise ValueError(f"{name} is {getattr(self, name).dtype}; give real numbers.")
        if self.gesture.ndim != 1 or self.voltages.ndim != 2:
            raise ValueError("gesture must be (n,) and voltages (F, M), one row for each frame.")
        num_recordings, (num_frames, num_channels) = len(self.gesture), self.voltages.shape
        expected_shapes = {
            "person": (num_recordings,),
            "start": (num_recordings + 1,),
            "seconds": (num_frames,),
            "reference": (num_channels,),
        }
        for name, expected_shape in expected_shapes.items():
            if getattr(self, name).shape != expected_shape:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}; with {num_recordings} gestures and voltages "
                    f"({num_frames}, {num_channels}) it is {expected_shape}."
                )
        if self.untouched.shape[1:] != (num_channels,):
            raise ValueError(
                f"untouched has shape {self.untouched.shape}; give (u, {num_channels}), as the voltages have."
            )
        if (np.diff(self.start) < 0).any():
            raise ValueError("start falls: give where each recording begins among the frames, in their order.")
        if self.start[0] or self.start[-1] != num_frames:
            raise ValueError(
                f"start goes from {self.start[0]} to {self.start[-1]}; give 0 first, and last the number of frames, "
                f"{num_frames}."
            )
        if not np.isfinite(self.seconds).all():
            raise ValueError("seconds must be finite.")

    def __len__(self) -> int:
        """Number n of recordings."""
        return len(self.gesture)

    def recording(self, number: int) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T M"]]:
        """Times (frames,) in seconds and voltages (frames, channels) in volts of one recording."""
        frames = slice(self.start[number], self.start[number + 1])
        return self.seconds[frames], self.voltages[frames].astype(float)

    def changes(self, number: int) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T M"]]:
        """Times (frames,) in seconds and voltage changes (frames, channels) from the reference, in volts, of one
        recording."""
        frame_times, voltages = self.recording(number)
        return frame_times, voltages - self.reference

    def write(self, path: str | Path) -> None:
        """Write the gesture set to an NPZ file. Raises `OSError` if the file cannot be written."""
        with atomically_written_file(path) as file:
            np.savez_compressed(file, **{name: getattr(self, name) for name in _ARRAY_NAMES})

    @classmethod
    def read(cls, path: str | Path) -> "GestureSet":
        """Read a gesture set from a file written by `write`; without the array `person`, all recordings are attributed
        to one person. Raises `OSError` if the file does not exist and `ValueError` if it is not a gesture set. Nothing
        in the file is executed."""
        try:
            stored_arrays = npz_arrays(Path(path), *_ARRAY_NAMES, otherwise="not a set of gestures")
            if "gesture" in stored_arrays:
                stored_arrays.setdefault("person", np.zeros(stored_arrays["gesture"].shape, int))
            require_arrays(stored_arrays, *_ARRAY_NAMES)
            return cls(**{name: stored_arrays[name] for name in _ARRAY_NAMES})
        except ValueError as error:
            raise ValueError(f"'{path}': {error}") from None
